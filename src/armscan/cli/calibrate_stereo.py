# SPDX-License-Identifier: Apache-2.0
"""``armscan calibrate stereo``: two cameras from pairs of photographs of a flat target."""

from __future__ import annotations

import sys
from dataclasses import replace
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
    Target,
    progress_bar,
    show,
)

EXAMPLE = (
    "\b\nExample:\n"
    "  armscan calibrate stereo 'photos/left*.png' 'photos/right*.png' \\\n"
    "      --target chessboard:9x6:25 -o stereo.json\n\n"
    "\b\nTake 10 to 20 pairs at rest, both images at one instant; the board is tilted by 20 to 45\n"
    "degrees to all sides and reaches the corners of both images. Lists pair in their order."
)


def stereo(
    *,
    left: Annotated[
        str, typer.Argument(help="Left images: a folder or a quoted pattern.", show_default=False)
    ] = "",
    right: Annotated[
        str, typer.Argument(help="Right images, in the same order.", show_default=False)
    ] = "",
    target: Target,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Document to write; a page goes beside it.")
    ] = Path("stereo.json"),
    scan: Annotated[
        Path | None,
        typer.Option(help="Recording of cameras 0 and 1 instead of images; paired by instant."),
    ] = None,
    left_camera: Annotated[
        Path | None, typer.Option("--left", help="Calibration of the left camera by itself.")
    ] = None,
    right_camera: Annotated[
        Path | None, typer.Option("--right", help="Calibration of the right camera by itself.")
    ] = None,
    intrinsics: Annotated[
        str, typer.Option(help="What these are for: prior (beside the images) or fixed (held).")
    ] = "prior",
    leave_out: Annotated[
        list[str] | None,
        typer.Option(
            help="Image whose pair is not used, by name or quoted pattern; repeat for more."
        ),
    ] = None,
    auto_leave_out: Annotated[
        bool, typer.Option("--auto-leave-out", help="Take pairs apart that disagree.")
    ] = False,
    distortion: Annotated[
        str, typer.Option(help="auto, none, k1, k1k2, k1k2p1p2 or k1k2p1p2k3.")
    ] = "auto",
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = "low",
    force: Force = False,
    force_bad: ForceBad = False,
    cache: Cache = True,
    as_json: AsJson = False,
) -> None:
    """Calibrate two cameras and where they are to each other."""
    from armscan.calibration.cameras.pairs import StereoOptions
    from armscan.calibration.cameras.result import CameraOptions, DistortionModel
    from armscan.errors import OptionError
    from armscan.jobs.stereo import StereoRequest, run_stereo_calibration
    from armscan.models.two_views import IntrinsicsUse
    from armscan.storage.images import Alignment, ImageOptions

    given = StereoOptions(
        camera=CameraOptions(distortion=cast(DistortionModel, distortion)),
        intrinsics=cast(IntrinsicsUse, intrinsics),
        leave_out=tuple(leave_out or ()),
        leave_out_misfits=auto_leave_out,
    )
    is_given = left_camera is not None or right_camera is not None
    if intrinsics == "fixed" and not is_given:
        raise OptionError(
            "there is nothing to hold", where="--intrinsics fixed", remedy="give --left and --right"
        )
    request = StereoRequest(
        left=left,
        right=right,
        target=target,
        output=output,
        scan=scan,
        left_camera=left_camera,
        right_camera=right_camera,
        options=given if is_given else replace(given, intrinsics="free"),
        image_options=ImageOptions(bits_used=bits_used, align=cast(Alignment, bits_align)),
        is_overwriting=force,
        is_forced=force_bad,
        is_caching=cache,
        command=("armscan", *sys.argv[1:]),
    )
    with progress_bar() as progress:
        summary = run_stereo_calibration(request, progress)
    show(summary, as_json=as_json)
