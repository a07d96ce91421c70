# SPDX-License-Identifier: Apache-2.0
"""``armscan doctor``: is everything there that armscan needs."""

from __future__ import annotations

from typing import Annotated

import typer

from armscan.cli.options import AsJson, show

EXAMPLE = "\b\nExample:\n  armscan doctor --warm"


def doctor(
    warm: Annotated[
        bool, typer.Option("--warm", help="Compile ahead, so that the first scan starts at once.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Check versions, compiler, folders and optional packages."""
    from armscan.jobs.info import examine_installation

    summary = examine_installation(warm=warm)
    show(summary, as_json=as_json)
    if summary.warnings:
        raise typer.Exit(1)
