# SPDX-License-Identifier: Apache-2.0
"""``armscan calibrate laser``: light sheets from stripe images on a flat target."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, cast

import typer

from armscan.cli.options import (
    AsJson,
    BitsAlign,
    BitsUsed,
    Cache,
    Force,
    ForceBad,
    LaserColourOption,
    StripeMethodOption,
    Target,
    progress_bar,
    show,
)

EXAMPLE = (
    "\b\nExample:\n"
    "  armscan calibrate laser --camera camera.json --on 'on/*.png' --off 'off/*.png' \\\n"
    "      --target chessboard:11x6:13 -o sensor.json\n\n"
    "\b\nPut the board at several depths and tilts in the laser. If the laser outshines it,\n"
    "take each placement twice, with and without laser; images pair by name, else by order.\n"
    "Of a source of many lines no image need show them all; a recording (--scan) says which\n"
    "laser and which camera took part."
)

Scan = Annotated[
    Path | None,
    typer.Option(help="Recording of the board instead of images; paired by its views."),
]
Sheets = Annotated[
    int,
    typer.Option(
        "--sheets",
        "--lines",
        help="Light sheets that were on together, or lines of each source; 0 finds out.",
    ),
]
SheetNames = Annotated[
    list[str] | None,
    typer.Option("--name", help="Name of a sheet, from left to right; repeat for each."),
]
LeaveOut = Annotated[
    list[str] | None,
    typer.Option(
        help="Image, or view of a recording, not to use, by name or quoted pattern; repeatable."
    ),
]
PlaneOnly = Annotated[
    bool, typer.Option("--plane-only", help="Hold every sheet to a plane, without a bow.")
]


def laser(
    *,
    camera: Annotated[
        Path,
        typer.Option(
            help="Camera calibration, also of OpenCV or ROS; stereo.json for two cameras.",
            show_default=False,
        ),
    ],
    target: Target,
    on: Annotated[
        list[str] | None,
        typer.Option(help="Images with the laser on: files, folder or quoted pattern; repeatable."),
    ] = None,
    off: Annotated[
        list[str] | None, typer.Option(help="The same placements without laser; repeatable.")
    ] = None,
    scan: Scan = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Document to write; a page goes beside it.")
    ] = Path("sensor.json"),
    sheets: Sheets = 0,
    name: SheetNames = None,
    leave_out: LeaveOut = None,
    plane_only: PlaneOnly = False,
    margin_mm: Annotated[
        float | None,
        typer.Option(
            help="Use stripe points this far outside the target's points; else as the boards agree."
        ),
    ] = None,
    stripe_method: StripeMethodOption = "fit",
    laser_colour: LaserColourOption = "auto",
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = "low",
    force: Force = False,
    force_bad: ForceBad = False,
    cache: Cache = True,
    as_json: AsJson = False,
) -> None:
    """Calibrate light sheets from images of laser lines on a flat target."""
    from armscan.calibration.sheets.result import SheetOptions
    from armscan.jobs.sheets import LaserRequest, run_laser_calibration
    from armscan.pipeline.laser import LaserOptions
    from armscan.storage.images import Alignment, ImageOptions
    from armscan.vision.stripe.image import LaserColour, StripeMethod, StripeOptions

    request = LaserRequest(
        camera=camera,
        on=tuple(on or ()),
        off=tuple(off or ()),
        scan=scan,
        target=target,
        output=output,
        options=LaserOptions(
            stripes=StripeOptions(
                method=cast(StripeMethod, stripe_method),
                laser_colour=cast(LaserColour, laser_colour),
            ),
            sheets=SheetOptions(
                margin_mm=margin_mm,
                n_sheets=sheets,
                sheet_names=tuple(name or ()),
                is_bow_allowed=not plane_only,
            ),
        ),
        image_options=ImageOptions(bits_used=bits_used, align=cast(Alignment, bits_align)),
        leave_out=tuple(leave_out or ()),
        is_overwriting=force,
        is_caching=cache,
        is_forced=force_bad,
        command=("armscan", *sys.argv[1:]),
    )
    with progress_bar() as progress:
        summary = run_laser_calibration(request, progress)
    show(summary, as_json=as_json)
