# SPDX-License-Identifier: Apache-2.0
"""``armscan markers``: ring markers in images, and in space with two cameras."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, cast

import typer

from armscan.cli.options import AsJson, BitsAlign, BitsUsed, Force, progress_bar, show

EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan markers 'photos/*.png' -o rings.html\n"
    "  armscan markers left.png right.png --stereo stereo.json --diameter 6 -o markers.csv"
)


def markers(
    *,
    images: Annotated[
        list[str],
        typer.Argument(
            help="Image files, folders, or quoted patterns; with --stereo the left one, then the "
            "right.",
            show_default=False,
        ),
    ],
    stereo: Annotated[
        Path | None, typer.Option(help="Calibration of two cameras: match and triangulate.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help="Page NAME.html; with --stereo the table NAME.csv and a page."
        ),
    ] = None,
    diameter: Annotated[
        float | None, typer.Option(help="Outer diameter of the markers, mm; with --stereo.")
    ] = None,
    depth: Annotated[
        str, typer.Option(help="Nearest and farthest depth NEAR:FAR, mm; with --stereo.")
    ] = "",
    min_perimeter: Annotated[float, typer.Option(help="Of the outer rim, untilted, px.")] = 40.0,
    max_perimeter: Annotated[float, typer.Option(help="Of the outer rim, untilted, px.")] = 1200.0,
    max_roundness: Annotated[
        float, typer.Option(help="Long over short axis; 1.7 is a tilt of 54 degrees.")
    ] = 1.7,
    disc: Annotated[str, typer.Option(help="light (in a dark ring) or dark.")] = "light",
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = "low",
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find ring markers in images; with two calibrated cameras, where they are."""
    from armscan.jobs.markers import MarkersRequest, run_markers
    from armscan.markers.candidates import RingMatchOptions, parse_depth
    from armscan.storage.images import Alignment, ImageOptions
    from armscan.vision.rings import Disc, RingOptions

    request = MarkersRequest(
        images=tuple(images),
        stereo=stereo,
        output=output,
        rings=RingOptions(min_perimeter, max_perimeter, max_roundness, cast(Disc, disc)),
        matching=RingMatchOptions(
            depth_mm=parse_depth(depth) if depth else None, diameter_mm=diameter
        ),
        image_options=ImageOptions(bits_used=bits_used, align=cast(Alignment, bits_align)),
        is_overwriting=force,
        command=("armscan", *sys.argv[1:]),
    )
    with progress_bar() as progress:
        summary = run_markers(request, progress)
    show(summary, as_json=as_json)
