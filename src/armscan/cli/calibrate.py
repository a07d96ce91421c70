# SPDX-License-Identifier: Apache-2.0
"""``armscan calibrate``: a camera, two cameras, light sheets, and where the sensor sits."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from armscan.cli.options import (
    ArmFile,
    AsJson,
    BitsAlign,
    BitsUsed,
    Cache,
    DefaultOf,
    Document,
    Force,
    ForceBad,
    LaserColourOption,
    Side,
    StripeMethodOption,
    Target,
    given,
    run,
)

CAMERA_EXAMPLE = (
    "\b\nExample:\n"
    "  armscan calibrate camera 'photos/*.png' --target chessboard:11x6:13 -o camera.json\n\n"
    "\b\nTake 12 or more photos: the board fills most of the image, reaches every corner in some,\n"
    "and is tilted by 20 to 45 degrees to all sides. Focus and zoom stay as they are."
)
STEREO_EXAMPLE = (
    "\b\nExample:\n"
    "  armscan calibrate stereo 'photos/left*.png' 'photos/right*.png' \\\n"
    "      --target chessboard:9x6:25 -o stereo.json\n\n"
    "\b\nTake 10 to 20 pairs at rest, both images at one instant; the board is tilted by 20 to 45\n"
    "degrees to all sides and reaches the corners of both images. Lists pair in their order."
)
LASER_EXAMPLE = (
    "\b\nExample:\n"
    "  armscan calibrate laser --camera camera.json --on 'on/*.png' --off 'off/*.png' \\\n"
    "      --target chessboard:11x6:13 -o sensor.json\n\n"
    "\b\nPut the board at several depths and tilts in the laser. If the laser outshines it,\n"
    "take each placement twice, with and without laser; images pair by name, else by order.\n"
    "Of a source of many lines no image need show them all; a recording (--scan) says which\n"
    "laser and which camera took part."
)
HAND_EYE_EXAMPLE = (
    "\b\nExample:\n"
    "  armscan calibrate hand-eye scan --sensor sensor.json --plate plate.csv -o scanner.json\n"
    "  armscan calibrate hand-eye --profiles 'p*.yml' --poses RobPoses.rob \\\n"
    "      --euler extrinsic-xyz --sphere-diameter 80 -o scanner.json\n\n"
    "\b\nLay the plate down, probe it, and take 12 or more postures at rest: tilted by 30 to 45\n"
    "degrees in several directions, nearer and farther."
)
Distortion = Annotated[
    str | None,
    typer.Option(
        help="auto, none, k1, k1k2, k1k2p1p2 or k1k2p1p2k3.",
        show_default=DefaultOf("armscan.calibration.cameras.result:CameraOptions.distortion"),
    ),
]


def camera(
    *,
    images: Annotated[
        list[str] | None,
        typer.Argument(help="Image files, folders, or quoted patterns.", show_default=False),
    ] = None,
    target: Target,
    output: Document = Path("camera.json"),
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
    distortion: Distortion = None,
    fix: Annotated[
        list[str] | None, typer.Option(help="Hold 'aspect' (fx = fy) or 'centre'; repeatable.")
    ] = None,
    board_warp: Annotated[
        bool, typer.Option("--board-warp", help="Also solve a bow of the board.")
    ] = False,
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = None,
    force: Force = False,
    force_bad: ForceBad = False,
    cache: Cache = True,
    as_json: AsJson = False,
) -> None:
    """Calibrate a camera from photographs of a flat target."""
    from armscan.calibration.cameras.result import CameraOptions
    from armscan.errors import OptionError
    from armscan.jobs.cameras import calibrate_camera
    from armscan.storage.images import ImageOptions

    held = set(fix or ())
    if unknown := sorted(held - {"aspect", "centre"}):
        raise OptionError(f"--fix {unknown[0]} is not known", remedy="choose aspect or centre")
    options = given(
        CameraOptions,
        distortion=distortion,
        is_aspect_fixed="aspect" in held,
        is_principal_point_fixed="centre" in held,
        solve_warp=board_warp,
        leave_out=tuple(leave_out or ()),
        leave_out_misfits=auto_leave_out,
    )
    pixels = given(ImageOptions, bits_used=bits_used, align=bits_align)
    run(
        lambda job: calibrate_camera(
            job, target, images or (), scan=scan, options=options, image_options=pixels
        ),
        as_json=as_json,
        output=output,
        force=force,
        force_bad=force_bad,
        cache=cache,
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
    output: Document = Path("stereo.json"),
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
    distortion: Distortion = None,
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = None,
    force: Force = False,
    force_bad: ForceBad = False,
    cache: Cache = True,
    as_json: AsJson = False,
) -> None:
    """Calibrate two cameras and where they are to each other."""
    from armscan.calibration.cameras.pairs import StereoOptions
    from armscan.calibration.cameras.result import CameraOptions
    from armscan.errors import OptionError
    from armscan.jobs.cameras import calibrate_stereo
    from armscan.storage.images import ImageOptions

    cameras = (left_camera, right_camera)
    is_given = any(path is not None for path in cameras)
    if intrinsics == "fixed" and not is_given:
        raise OptionError(
            "there is nothing to hold", where="--intrinsics fixed", remedy="give --left and --right"
        )
    options = given(
        StereoOptions,
        camera=given(CameraOptions, distortion=distortion),
        intrinsics=intrinsics,
        leave_out=tuple(leave_out or ()),
        leave_out_misfits=auto_leave_out,
    )
    if not is_given:
        options = replace(options, intrinsics="free")
    pixels = given(ImageOptions, bits_used=bits_used, align=bits_align)
    run(
        lambda job: calibrate_stereo(
            job,
            target,
            left,
            right,
            scan=scan,
            cameras=cameras,
            options=options,
            image_options=pixels,
        ),
        as_json=as_json,
        output=output,
        force=force,
        force_bad=force_bad,
        cache=cache,
    )


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
    scan: Annotated[
        Path | None,
        typer.Option(help="Recording of the board instead of images; paired by its views."),
    ] = None,
    output: Document = Path("sensor.json"),
    sheets: Annotated[
        int | None,
        typer.Option(
            "--sheets",
            "--lines",
            help="Light sheets that were on together, or lines of each source; 0 finds out.",
            show_default=DefaultOf("armscan.calibration.sheets.result:SheetOptions.n_sheets"),
        ),
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option("--name", help="Name of a sheet, from left to right; repeat for each."),
    ] = None,
    leave_out: Annotated[
        list[str] | None,
        typer.Option(
            help="Image, or view of a recording, not to use, by name or quoted pattern; repeatable."
        ),
    ] = None,
    plane_only: Annotated[
        bool, typer.Option("--plane-only", help="Hold every sheet to a plane, without a bow.")
    ] = False,
    margin_mm: Annotated[
        float | None,
        typer.Option(
            help="Use stripe points this far outside the target's points; else as the boards agree."
        ),
    ] = None,
    stripe_method: StripeMethodOption = None,
    laser_colour: LaserColourOption = None,
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = None,
    force: Force = False,
    force_bad: ForceBad = False,
    cache: Cache = True,
    as_json: AsJson = False,
) -> None:
    """Calibrate light sheets from images of laser lines on a flat target."""
    from armscan.calibration.sheets.result import SheetOptions
    from armscan.jobs.sheets import SheetImages, calibrate_sheets
    from armscan.pipeline.laser import LaserOptions
    from armscan.storage.images import ImageOptions
    from armscan.vision.stripe.image import StripeOptions

    images = SheetImages(tuple(on or ()), tuple(off or ()), scan, tuple(leave_out or ()))
    options = LaserOptions(
        stripes=given(StripeOptions, method=stripe_method, laser_colour=laser_colour),
        sheets=given(
            SheetOptions,
            margin_mm=margin_mm,
            n_sheets=sheets,
            sheet_names=tuple(name or ()),
            is_bow_allowed=not plane_only,
        ),
    )
    pixels = given(ImageOptions, bits_used=bits_used, align=bits_align)
    run(
        lambda job: calibrate_sheets(
            job, camera, target, images, options=options, image_options=pixels
        ),
        as_json=as_json,
        output=output,
        force=force,
        force_bad=force_bad,
        cache=cache,
    )


def hand_eye(
    *,
    scans: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Folders of recordings; several are calibrated one by one and together.",
            show_default=False,
        ),
    ] = None,
    sensor: Annotated[
        Path | None, typer.Option(help="Calibration of camera and sheets.", show_default=False)
    ] = None,
    plate: Annotated[
        Path | None,
        typer.Option(help="Probed points of the plate, or its A,B,C,D.", show_default=False),
    ] = None,
    plane: Annotated[
        str, typer.Option(help="The plate as A,B,C,D in Base, mm, in place of --plate.")
    ] = "",
    side: Annotated[
        Side | None,
        typer.Option(help="Where the plate's face looks, roughly; left out, to the arm's tool."),
    ] = None,
    solve_plate: Annotated[
        bool,
        typer.Option("--solve-plate", help="Solve the plate along; a rough plane is enough then."),
    ] = False,
    sphere_diameter: Annotated[
        float | None,
        typer.Option(
            help="A sphere of this diameter, mm, in place of a plate.", show_default=False
        ),
    ] = None,
    profiles: Annotated[
        list[str] | None,
        typer.Option(help="Profiles of a sensor that delivers points, one a posture; repeatable."),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(help="Table of the robot's poses, one a profile.", show_default=False),
    ] = None,
    euler: Annotated[
        str,
        typer.Option(
            help="Angles in --poses: intrinsic-xyz, extrinsic-xyz (FANUC), intrinsic-zxz."
        ),
    ] = "extrinsic-xyz",
    arm: ArmFile = None,
    arm_position_mm: Annotated[
        float | None, typer.Option(help="Scatter of the arm, mm an axis; left out, estimated.")
    ] = None,
    arm_rotation_deg: Annotated[
        float | None,
        typer.Option(help="Scatter of its orientation; left out, from the position."),
    ] = None,
    plate_flatness_mm: Annotated[
        float | None,
        typer.Option(help="Scatter of the plate's surface; left out, estimated."),
    ] = None,
    output: Document = Path("scanner.json"),
    stripe_method: StripeMethodOption = None,
    laser_colour: LaserColourOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find where the sensor sits on the arm, from postures over a flat plate or a sphere."""
    from armscan.calibration.hand_eye.observations import HandEyeOptions
    from armscan.calibration.hand_eye.sphere_sections import SphereOptions
    from armscan.geometry.rotations import check_convention
    from armscan.jobs.hand_eye import Artefact, StripeSource, calibrate_hand_eye
    from armscan.vision.stripe.image import StripeOptions

    source = StripeSource(
        scans=tuple(scans or ()),
        sensor=sensor,
        arm=arm,
        profiles=tuple(profiles or ()),
        poses=poses,
        euler=check_convention(euler),
    )
    artefact = Artefact(plate, plane, None if side is None else side.value, sphere_diameter)
    rotation_rad = None if arm_rotation_deg is None else math.radians(arm_rotation_deg)
    options = given(
        HandEyeOptions,
        arm_position_mm=arm_position_mm,
        arm_rotation_rad=rotation_rad,
        plate_flatness_mm=plate_flatness_mm,
        solve_plate=solve_plate,
    )
    of_sphere = given(SphereOptions, arm_position_mm=arm_position_mm, arm_rotation_rad=rotation_rad)
    stripes = given(StripeOptions, method=stripe_method, laser_colour=laser_colour)
    run(
        lambda job: calibrate_hand_eye(
            job, source, artefact, options=options, sphere_options=of_sphere, stripe_options=stripes
        ),
        as_json=as_json,
        output=output,
        force=force,
    )
