# SPDX-License-Identifier: Apache-2.0
"""Commands that drive a rig: ``armscan record`` to a file, ``armscan console`` in a browser."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.delivery import show
from armscan.cli.options import AsJson, Force, given

RECORD_EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan record rig.toml -o scan.mcap\n"
    "  armscan record rig.toml --scanner scanner.json --seconds 60 -o scan.mcap\n"
    "  armscan record --camera webcam:0 -o bench.mcap\n"
    "  armscan record 'twin:thesis-single?loop=1' --seconds 10 -o scan.mcap"
)


def record(
    *,
    rig: Annotated[
        str,
        typer.Argument(
            help="rig.toml, or twin:HEAD for the simulator; or name the devices.",
            show_default=False,
        ),
    ] = "",
    camera: Annotated[
        list[str] | None, typer.Option(help="Address of a camera; twice for two, left first.")
    ] = None,
    arm: Annotated[str, typer.Option(help="Address of the arm.")] = "",
    lasers: Annotated[str, typer.Option(help="Address of the laser controller.")] = "",
    rate: Annotated[
        float | None,
        typer.Option(
            help="Triggers a second of the controller; left out, those of rig.toml, else 80.",
            show_default=False,
        ),
    ] = None,
    common_trigger: Annotated[
        bool,
        typer.Option("--common-trigger", help="Frames and arm samples bear ids of one trigger."),
    ] = False,
    stripe_band: Annotated[
        bool,
        typer.Option(
            "--stripe-band",
            help="Pixels away from what could be a stripe become zero: a small file, equal points.",
        ),
    ] = False,
    scanner: Annotated[
        Path | None,
        typer.Option(help="scanner.json: measure and show points too.", show_default=False),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(help="End after so long; else Ctrl-C ends it.")
    ] = None,
    exposures: Annotated[int | None, typer.Option(help="End after so many.")] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Recording to write: .mcap.")
    ] = Path("scan.mcap"),
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Record cameras, arm and lasers to one file until Ctrl-C; with a scanner, see points too."""
    from armscan.jobs.live.record import RecordRequest, record_scan
    from armscan.pipeline.live.rig import RigDescription

    devices = given(
        RigDescription,
        cameras=tuple(camera or ()),
        arm=arm,
        lasers=lasers,
        trigger="external" if lasers else "free",
    )
    request = RecordRequest(
        rig,
        devices,
        scanner,
        seconds,
        exposures,
        rate_hz=rate,
        is_common_trigger=common_trigger,
        is_stripe_band=stripe_band,
    )
    is_live = sys.stderr.isatty()

    def tell(line: str) -> None:
        typer.echo(f"\r\x1b[K{line}" if is_live else line, err=True)

    def show_rate(line: str) -> None:
        # one line that is written over, unless it is kept in a file
        typer.echo(f"\r\x1b[K{line}" if is_live else line, err=True, nl=not is_live)

    summary = record_scan(request, output, tell, show_rate=show_rate, is_overwriting=force)
    if is_live:
        typer.echo(err=True)
    show(summary, as_json=as_json)


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
