# SPDX-License-Identifier: Apache-2.0
"""``armscan reconstruct``: points from stripe images."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, cast

import typer

from armscan.cli.options import (
    AsJson,
    Background,
    BitsAlign,
    BitsUsed,
    DepthMargin,
    Force,
    LaserColourOption,
    Right,
    RightBackground,
    Sheet,
    StripeMethodOption,
    Volume,
    progress_bar,
    show,
)

EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan reconstruct scan --scanner scanner.json -o cloud.ply\n"
    "  armscan reconstruct scan/laser.png --background scan/dark.png --sensor sensor.json \\\n"
    "      --sheet A -o cloud.ply\n"
    "  armscan reconstruct left.png --right right.png --sensor sensor.json -o cloud.ply"
)


def reconstruct(
    *,
    images: Annotated[
        list[str],
        typer.Argument(
            help="A recording's folder; or images with the laser on: files, folders, patterns.",
            show_default=False,
        ),
    ],
    sensor: Annotated[
        Path,
        typer.Option(
            "--sensor",
            "--scanner",
            help="Calibration: a recording with scanner.json is placed in Base, all else is in "
            "the Sensor frame.",
            show_default=False,
        ),
    ],
    background: Background = None,
    right: Right = None,
    right_background: RightBackground = None,
    sheet: Sheet = "",
    depth_margin: DepthMargin = None,
    volume: Volume = "",
    arm: Annotated[
        Path | None,
        typer.Option(help="arm.toml, for recordings of joint angles.", show_default=False),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Cloud to write, .ply or .xyz.")
    ] = Path("cloud.ply"),
    stripe_method: StripeMethodOption = "fit",
    laser_colour: LaserColourOption = "auto",
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = "low",
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Measure points from a recording of a scan, or from images of laser lines on objects."""
    from armscan.jobs.reconstruct import CloudRequest, run_measurement
    from armscan.pipeline.measure import MeasureOptions
    from armscan.reconstruction.triangulate import DepthRange
    from armscan.storage.images import Alignment, ImageOptions
    from armscan.vision.stripe.image import LaserColour, StripeMethod, StripeOptions

    request = CloudRequest(
        sensor=sensor,
        images=tuple(images),
        background=tuple(background or ()),
        right=tuple(right or ()),
        right_background=tuple(right_background or ()),
        output=output,
        options=MeasureOptions(
            stripes=StripeOptions(
                method=cast(StripeMethod, stripe_method),
                laser_colour=cast(LaserColour, laser_colour),
            ),
            depths=None if depth_margin is None else DepthRange(depth_margin),
            sheet=sheet,
        ),
        image_options=ImageOptions(bits_used=bits_used, align=cast(Alignment, bits_align)),
        volume=volume,
        arm=arm,
        is_overwriting=force,
        command=("armscan", *sys.argv[1:]),
    )
    with progress_bar() as progress:
        summary = run_measurement(request, progress)
    show(summary, as_json=as_json)
