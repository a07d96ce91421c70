# SPDX-License-Identifier: Apache-2.0
"""``armscan calibrate camera``: intrinsics from photographs of a flat target."""

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
    Target,
    progress_bar,
    show,
)

EXAMPLE = (
    "\b\nExample:\n"
    "  armscan calibrate camera 'photos/*.png' --target chessboard:11x6:13 -o camera.json\n\n"
    "\b\nTake 12 or more photos: the board fills most of the image, reaches every corner in some,\n"
    "and is tilted by 20 to 45 degrees to all sides. Focus and zoom stay as they are."
)


def camera(
    *,
    images: Annotated[
        list[str] | None,
        typer.Argument(help="Image files, folders, or quoted patterns.", show_default=False),
    ] = None,
    target: Target,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Document to write; a page goes beside it.")
    ] = Path("camera.json"),
    scan: Annotated[
        Path | None, typer.Option(help="Recording of the target instead of images.")
    ] = None,
    leave_out: Annotated[
        list[str] | None,
        typer.Option(help="Image not to use, by name or quoted pattern; repeat for more."),
    ] = None,
    auto_leave_out: Annotated[
        bool, typer.Option("--auto-leave-out", help="Leave out views that do not fit.")
    ] = False,
    distortion: Annotated[
        str, typer.Option(help="auto, none, k1, k1k2, k1k2p1p2 or k1k2p1p2k3.")
    ] = "auto",
    fix: Annotated[
        list[str] | None, typer.Option(help="Hold 'aspect' (fx = fy) or 'centre'; repeatable.")
    ] = None,
    board_warp: Annotated[
        bool, typer.Option("--board-warp", help="Also solve a bow of the board.")
    ] = False,
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = "low",
    force: Force = False,
    force_bad: ForceBad = False,
    cache: Cache = True,
    as_json: AsJson = False,
) -> None:
    """Calibrate a camera from photographs of a flat target."""
    from armscan.calibration.cameras.result import CameraOptions, DistortionModel
    from armscan.errors import OptionError
    from armscan.jobs.camera import CameraRequest, run_camera_calibration
    from armscan.storage.images import Alignment, ImageOptions

    held = set(fix or ())
    if unknown := sorted(held - {"aspect", "centre"}):
        raise OptionError(f"--fix {unknown[0]} is not known", remedy="choose aspect or centre")
    request = CameraRequest(
        images=tuple(images or ()),
        scan=scan,
        target=target,
        output=output,
        options=CameraOptions(
            distortion=cast(DistortionModel, distortion),
            is_aspect_fixed="aspect" in held,
            is_principal_point_fixed="centre" in held,
            solve_warp=board_warp,
            leave_out=tuple(leave_out or ()),
            leave_out_misfits=auto_leave_out,
        ),
        image_options=ImageOptions(bits_used=bits_used, align=cast(Alignment, bits_align)),
        is_overwriting=force,
        is_forced=force_bad,
        is_caching=cache,
        command=("armscan", *sys.argv[1:]),
    )
    with progress_bar() as progress:
        summary = run_camera_calibration(request, progress)
    show(summary, as_json=as_json)
