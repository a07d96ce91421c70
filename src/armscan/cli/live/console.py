# SPDX-License-Identifier: Apache-2.0
"""``armscan console``: calibrate, scan and inspect in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

CONSOLE_EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan console monday --rig rig.toml\n"
    "  armscan console practice --rig 'twin:thesis-single?seed=1'"
)


def console(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Folder of the session: new, empty, or one to go on with.", show_default=False
        ),
    ],
    rig: Annotated[
        str | None,
        typer.Option(
            help="rig.toml, or twin:HEAD?seed=1 for the simulator. Left out, the session can be "
            "looked at and calculated again.",
            show_default=False,
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(help="Port of the page; 8270 or a free one unless said.", show_default=False),
    ] = None,
    host: Annotated[
        str | None,
        typer.Option(
            help="Address to listen at, 127.0.0.1 unless said; any other asks for a token.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Open the operator's console: a page in the browser from calibration to report."""
    from armscan.console.pages import run_console

    where = {} if host is None else {"host": host}
    run_console(folder, rig or "", port=port, tell=typer.echo, **where)
