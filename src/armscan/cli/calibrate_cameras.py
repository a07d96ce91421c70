# SPDX-License-Identifier: Apache-2.0
"""``armscan calibrate camera``, ``stereo`` and ``hand-eye-target``, from a flat target, and
``latency``, from a plate.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from armscan.cli.delivery import OF_CALIBRATIONS, Work, job_command
from armscan.cli.options import (
    ArmFile,
    ArmPosition,
    ArmRotation,
    AutoLeaveOut,
    BitsAlign,
    BitsUsed,
    BoardWarp,
    DefaultOf,
    Document,
    EulerAngles,
    Fixed,
    LaserColourOption,
    Method,
    MethodOption,
    OptionalTarget,
    SolvePrint,
    Target,
    given,
    refuse_given,
    refuse_vain,
)

NOT_AGAIN = "images scan target method bits_used bits_align cache"
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
HAND_EYE_TARGET_EXAMPLE = (
    "\b\nExamples:\n"
    "  armscan calibrate hand-eye-target 'photos/*.png' --poses poses.csv \\\n"
    "      --target chessboard:11x6:13 --camera camera.json -o hand-eye.json\n"
    "  armscan calibrate hand-eye-target --scan scans/target --target chessboard:11x6:13 \\\n"
    "      --sensor sensor.json -o scanner.json\n\n"
    "\b\nThe target stays where it is. Take 12 or more postures at rest, the target in view: turn\n"
    "the camera by 20 to 40 degrees about two or more of its axes, nearer and farther. A pose is\n"
    "x, y, z in mm and three angles, a quaternion under a header, or a matrix of 3 x 4 or 4 x 4."
)
LATENCY_EXAMPLE = (
    "\b\nExample:\n"
    "  armscan calibrate latency scans/latency --scanner scanner.json -o scanner-timed.json\n\n"
    "\b\nFor 10 s, move the head over a flat plate nearer and away by 10 mm or more, once a\n"
    "second, unevenly, and sideways by 20 mm meanwhile. The plate fills the view all the time."
)
Photographs = Annotated[
    list[str] | None,
    typer.Argument(help="Image files, folders, or quoted patterns.", show_default=False),
]
AgainFile = Annotated[
    Path | None,
    typer.Option(
        "--from", help="Solve camera.json again from its own observations; no target, images."
    ),
]
TargetScan = Annotated[Path | None, typer.Option(help="Recording of the target instead of images.")]
NotUsed = Annotated[
    list[str] | None,
    typer.Option(help="Image not to use, by name or quoted pattern; repeat for more."),
]
Distortion = Annotated[
    str | None,
    typer.Option(
        help="auto (of a pair: all), none, k1, k1k2, k1k2p1p2, k1k2p1p2k3 or fisheye.",
        show_default=DefaultOf("armscan.calibration.cameras.result:CameraOptions.distortion"),
    ),
]


@job_command(Document, Path("camera.json"), also=OF_CALIBRATIONS)
def camera(
    context: typer.Context,
    *,
    images: Photographs = None,
    target: OptionalTarget = None,
    again: AgainFile = None,
    scan: TargetScan = None,
    leave_out: NotUsed = None,
    auto_leave_out: AutoLeaveOut = False,
    distortion: Distortion = None,
    fix: Fixed = None,
    board_warp: BoardWarp = False,
    solve_print: SolvePrint = False,
    method: MethodOption = None,
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = None,
) -> Work:
    """Calibrate a camera from photographs of a flat target."""
    from armscan.calibration.cameras.result import CameraOptions
    from armscan.errors import OptionError
    from armscan.jobs.camera import calibrate_camera, calibrate_camera_from_file
    from armscan.storage.images import ImageOptions

    held = set(fix or ())
    if unknown := sorted(held - {"aspect", "centre"}):
        raise OptionError(f"--fix {unknown[0]} is not known", remedy="choose aspect or centre")
    changed: dict[str, Any] = {
        "distortion": distortion,
        "is_aspect_fixed": "aspect" in held or None,
        "is_principal_point_fixed": "centre" in held or None,
        "solve_warp": board_warp or None,
        "solve_print": solve_print or None,
        "leave_out": tuple(leave_out) if leave_out else None,
        "leave_out_misfits": auto_leave_out or None,
    }
    if again is not None:
        refuse_given(
            context, NOT_AGAIN, "--from takes target and views from the document's own files"
        )
        changes = {key: value for key, value in changed.items() if value is not None}
        return lambda job: calibrate_camera_from_file(job, again, changes)
    if target is None:
        context.fail("Missing option '--target'.")
    options = given(CameraOptions, **changed)
    pixels = given(ImageOptions, bits_used=bits_used, align=bits_align)
    return lambda job: calibrate_camera(
        job,
        target,
        images or (),
        scan=scan,
        options=options,
        image_options=pixels,
        is_beside_thesis=method is Method.THESIS,
    )


@job_command(Document, Path("stereo.json"), also=OF_CALIBRATIONS)
def stereo(
    *,
    left: Annotated[
        str, typer.Argument(help="Left images: a folder or a quoted pattern.", show_default=False)
    ] = "",
    right: Annotated[
        str, typer.Argument(help="Right images, in the same order.", show_default=False)
    ] = "",
    target: Target,
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
        str | None,
        typer.Option(
            help="What these are for: prior (beside the images, the default) or fixed (held).",
            show_default=False,
        ),
    ] = None,
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
) -> Work:
    """Calibrate two cameras and where they are to each other."""
    from armscan.calibration.cameras.pairs import StereoOptions
    from armscan.calibration.cameras.result import CameraOptions
    from armscan.errors import OptionError
    from armscan.jobs.stereo import calibrate_stereo
    from armscan.storage.images import ImageOptions

    cameras = (left_camera, right_camera)
    is_given = any(path is not None for path in cameras)
    if is_given:
        what = "the lens and what is solved of it are those of --left and --right"
        refuse_vain({"--distortion": distortion}, what)
    options = given(
        StereoOptions,
        camera=given(CameraOptions, distortion=distortion),
        intrinsics=intrinsics or ("prior" if is_given else "free"),
        leave_out=tuple(leave_out or ()),
        leave_out_misfits=auto_leave_out,
    )
    if options.intrinsics != "free" and not is_given:
        raise OptionError(
            "there is nothing to hold"
            if options.intrinsics == "fixed"
            else "no calibration is given to count beside the images",
            where=f"--intrinsics {options.intrinsics}",
            remedy="give --left and --right",
        )
    pixels = given(ImageOptions, bits_used=bits_used, align=bits_align)
    return lambda job: calibrate_stereo(
        job,
        target,
        left,
        right,
        scan=scan,
        cameras=cameras,
        options=options,
        image_options=pixels,
    )


@job_command(Document, Path("scanner.json"), also="force cache")
def hand_eye_target(
    *,
    images: Photographs = None,
    target: Target,
    poses: Annotated[
        Path | None,
        typer.Option(help="Table of the arm's poses base_from_tool, one a photograph."),
    ] = None,
    euler: EulerAngles = None,
    scan: TargetScan = None,
    arm: ArmFile = None,
    camera: Annotated[
        Path | None, typer.Option(help="The camera's calibration, before there are light sheets.")
    ] = None,
    sensor: Annotated[
        Path | None, typer.Option(help="Calibration of camera and sheets: makes a scanner.")
    ] = None,
    leave_out: NotUsed = None,
    arm_position_mm: ArmPosition = None,
    arm_rotation_deg: ArmRotation = None,
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = None,
) -> Work:
    """Find where the camera sits on the arm.

    From views of a target at rest and the arm's poses, without a laser.
    """
    from armscan.calibration.hand_eye.observations import HandEyeOptions
    from armscan.geometry.rotations import check_convention
    from armscan.jobs.board_hand_eye import LookSource, calibrate_hand_eye_on_board
    from armscan.storage.images import ImageOptions

    source = given(
        LookSource,
        images=tuple(images or ()),
        poses=poses,
        euler=None if euler is None else check_convention(euler),
        scan=scan,
        arm=arm,
        camera=camera,
        sensor=sensor,
        leave_out=tuple(leave_out or ()),
    )
    options = given(
        HandEyeOptions,
        arm_position_mm=arm_position_mm,
        arm_rotation_rad=None if arm_rotation_deg is None else math.radians(arm_rotation_deg),
    )
    pixels = given(ImageOptions, bits_used=bits_used, align=bits_align)
    return lambda job: calibrate_hand_eye_on_board(
        job, source, target, options=options, image_options=pixels
    )


@job_command(Document, Path("scanner-timed.json"))
def latency(
    *,
    scan: Annotated[Path, typer.Argument(help="Recording of the plate.", show_default=False)],
    scanner: Annotated[Path, typer.Option(help="The scanner's document.", show_default=False)],
    arm: ArmFile = None,
    laser_colour: LaserColourOption = None,
) -> Work:
    """Find the time between camera and arm.

    From a flat plate over which the head is moved nearer and away.
    """
    from armscan.jobs.hand_eye import calibrate_latency
    from armscan.vision.stripe.image import StripeOptions

    stripes = given(StripeOptions, laser_colour=laser_colour)
    return lambda job: calibrate_latency(job, scan, scanner, arm=arm, stripe_options=stripes)
