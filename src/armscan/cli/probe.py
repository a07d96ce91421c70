# SPDX-License-Identifier: Apache-2.0
"""``armscan probe``: a plate from touches with the arm's probe."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.options import AsJson, Force, show

EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan probe touches/ -o plate.csv\n"
    "  armscan probe centres.csv --side +x -o plate.csv"
)


class Side(StrEnum):
    """Axis of Base along which the plate's face looks."""

    PLUS_X = "+x"
    MINUS_X = "-x"
    PLUS_Y = "+y"
    MINUS_Y = "-y"
    PLUS_Z = "+z"
    MINUS_Z = "-z"


def probe(
    touches: Annotated[
        Path,
        typer.Argument(
            help="Folder with arm.csv (a row a touch) and probe.toml; or a table of points.",
            show_default=False,
        ),
    ],
    *,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help="Points on the surface, a CSV table.", show_default=False
        ),
    ] = None,
    side: Annotated[
        Side | None,
        typer.Option(
            help="Axis that the plate's face looks along; default: to where the tool was.",
            show_default=False,
        ),
    ] = None,
    probe: Annotated[
        Path | None,
        typer.Option(help="The tip, if it is not probe.toml of the folder.", show_default=False),
    ] = None,
    feature: Annotated[
        str, typer.Option(help="Feature to use, where the table names several.", show_default=False)
    ] = "",
    leave_out: Annotated[
        bool, typer.Option("--leave-out", help="Leave out touches that do not fit the others.")
    ] = False,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Fit the plane of a plate to touches; the tip's radius is taken off on the side of the probe.

    A touch that does not fit the others is named. In probe.toml: centre_tool_mm = [x, y, z] and
    tip_diameter_mm = 6.0. A table of tip centres says so in its first line:
    # point = tip-centre, tip_diameter_mm = 6
    """
    from armscan.calibration.hand_eye.probed_plate import ProbingOptions
    from armscan.jobs.probe import ProbeRequest, run_probing

    options = ProbingOptions(
        side=None if side is None else side.value,
        leave_out_outliers=leave_out,
        feature=feature,
    )
    show(run_probing(ProbeRequest(touches, output, probe, options, force)), as_json=as_json)
