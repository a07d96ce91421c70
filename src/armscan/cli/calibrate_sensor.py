# SPDX-License-Identifier: Apache-2.0
"""``armscan calibrate laser`` and ``hand-eye``: light sheets, and where the sensor sits."""

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
    BitsAlign,
    BitsUsed,
    DefaultOf,
    Document,
    EulerAngles,
    LaserColourOption,
    Method,
    MethodOption,
    OptionalTarget,
    Side,
    StripeMethodOption,
    given,
    refuse_given,
    refuse_vain,
)

NOT_AGAIN = (
    "camera target on off scan leave_out stripe_method laser_colour bits_used bits_align cache"
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
    "\b\nExamples:\n"
    "  armscan calibrate hand-eye scan --sensor sensor.json --plate plate.csv -o scanner.json\n"
    "  armscan calibrate hand-eye --profiles 'p*.yml' --poses RobPoses.rob \\\n"
    "      --euler extrinsic-xyz --sphere-diameter 80 -o scanner.json\n\n"
    "\b\nLay the plate down, probe it, and take 12 or more postures at rest: tilted by 30 to 45\n"
    "degrees in several directions, nearer and farther."
)
CameraFile = Annotated[
    Path | None,
    typer.Option(
        help="Camera calibration, also of OpenCV or ROS; stereo.json for two cameras.",
        show_default=False,
    ),
]
AgainFile = Annotated[
    Path | None,
    typer.Option(
        "--from",
        help="Solve sensor.json again from its own observations; no camera, target, images.",
    ),
]
LitImages = Annotated[
    list[str] | None,
    typer.Option(help="Images with the laser on: files, folder or quoted pattern; repeatable."),
]
DarkImages = Annotated[
    list[str] | None, typer.Option(help="The same placements without laser; repeatable.")
]
LaserScan = Annotated[
    Path | None,
    typer.Option(help="Recording of the board instead of images; paired by its views."),
]
Sheets = Annotated[
    int | None,
    typer.Option(
        "--sheets",
        "--lines",
        help="Light sheets that were on together, or lines of each source; 0 finds out.",
        show_default=DefaultOf("armscan.calibration.sheets.result:SheetOptions.n_sheets"),
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
TargetBow = Annotated[
    float | None,
    typer.Option(
        help="What the target may be bowed by where its views show none (mm); 0 if known flat.",
        show_default="1e-5 to 8e-4 of half its size",
    ),
]
TargetMargin = Annotated[
    float | None,
    typer.Option(
        help="Use stripe points this far outside the target's points; else as the boards agree."
    ),
]
Scans = Annotated[
    list[Path] | None,
    typer.Argument(
        help="Recordings, folders or .mcap; several are calibrated one by one and together.",
        show_default=False,
    ),
]
SensorFile = Annotated[
    Path | None, typer.Option(help="Calibration of camera and sheets.", show_default=False)
]
PlateFile = Annotated[
    Path | None,
    typer.Option(help="Probed points of the plate, or its A,B,C,D in a file.", show_default=False),
]
PlaneText = Annotated[
    str, typer.Option(help="The plate as A,B,C,D in Base, mm, in place of --plate.")
]
PlateSide = Annotated[
    Side | None,
    typer.Option(help="Where the plate's face looks, roughly; left out, to the arm's tool."),
]
SphereDiameter = Annotated[
    float | None,
    typer.Option(help="A sphere of this diameter, mm, in place of a plate.", show_default=False),
]
Profiles = Annotated[
    list[str] | None,
    typer.Option(help="Profiles of a sensor that delivers points, one a posture; repeatable."),
]
PoseTable = Annotated[
    Path | None,
    typer.Option(help="Table of the robot's poses, one a profile.", show_default=False),
]


@job_command(Document, Path("sensor.json"), also=OF_CALIBRATIONS)
def laser(
    context: typer.Context,
    *,
    camera: CameraFile = None,
    target: OptionalTarget = None,
    again: AgainFile = None,
    on: LitImages = None,
    off: DarkImages = None,
    scan: LaserScan = None,
    sheets: Sheets = None,
    name: SheetNames = None,
    leave_out: LeaveOut = None,
    plane_only: Annotated[
        bool, typer.Option("--plane-only", help="Hold every sheet to a plane, without a bow.")
    ] = False,
    target_bow: TargetBow = None,
    margin_mm: TargetMargin = None,
    stripe_method: StripeMethodOption = None,
    laser_colour: LaserColourOption = None,
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = None,
) -> Work:
    """Calibrate light sheets from laser lines on a flat target."""
    from armscan.calibration.sheets.result import SheetOptions
    from armscan.jobs.sheets import (
        SheetImages,
        calibrate_sheets,
        calibrate_sheets_from_file,
    )
    from armscan.pipeline.laser import LaserOptions
    from armscan.storage.images import ImageOptions
    from armscan.vision.stripe.image import StripeOptions

    changed: dict[str, Any] = {
        "margin_mm": margin_mm,
        "n_sheets": sheets,
        "sheet_names": tuple(name) if name else None,
        "is_bow_allowed": False if plane_only else None,
        "target_bow_mm": target_bow,
    }
    if again is not None:
        refuse_given(
            context, NOT_AGAIN, "--from takes cameras and stripes from the document's own files"
        )
        changes = {key: value for key, value in changed.items() if value is not None}
        return lambda job: calibrate_sheets_from_file(job, again, changes)
    if camera is None or target is None:
        context.fail(f"Missing option '{'--camera' if camera is None else '--target'}'.")
    images = SheetImages(tuple(on or ()), tuple(off or ()), scan, tuple(leave_out or ()))
    options = LaserOptions(
        stripes=given(StripeOptions, method=stripe_method, laser_colour=laser_colour),
        sheets=given(SheetOptions, **changed),
    )
    pixels = given(ImageOptions, bits_used=bits_used, align=bits_align)
    return lambda job: calibrate_sheets(
        job, camera, target, images, options=options, image_options=pixels
    )


@job_command(Document, Path("scanner.json"))
def hand_eye(
    *,
    scans: Scans = None,
    sensor: SensorFile = None,
    plate: PlateFile = None,
    plane: PlaneText = "",
    side: PlateSide = None,
    solve_plate: Annotated[
        bool,
        typer.Option("--solve-plate", help="Solve the plate along; a rough plane is enough then."),
    ] = False,
    sphere_diameter: SphereDiameter = None,
    solve_diameter: Annotated[
        bool,
        typer.Option("--solve-diameter", help="Solve the sphere's diameter along."),
    ] = False,
    profiles: Profiles = None,
    poses: PoseTable = None,
    euler: EulerAngles = None,
    arm: ArmFile = None,
    arm_position_mm: ArmPosition = None,
    arm_rotation_deg: ArmRotation = None,
    plate_flatness_mm: Annotated[
        float | None,
        typer.Option(help="Scatter of the plate's surface; left out, estimated."),
    ] = None,
    method: MethodOption = None,
    stripe_method: StripeMethodOption = None,
    laser_colour: LaserColourOption = None,
) -> Work:
    """Find where the sensor sits on the arm.

    From postures over a flat plate or a sphere; before a target see `calibrate hand-eye-target`.
    """
    from armscan.calibration.hand_eye.observations import HandEyeOptions
    from armscan.geometry.rotations import check_convention
    from armscan.jobs.hand_eye import Artefact, StripeSource, calibrate_hand_eye
    from armscan.vision.stripe.image import StripeOptions

    source = given(
        StripeSource,
        scans=tuple(scans or ()),
        sensor=sensor,
        arm=arm,
        profiles=tuple(profiles or ()),
        poses=poses,
        euler=None if euler is None else check_convention(euler),
    )
    if poses is not None:
        vain = {"--stripe-method": stripe_method, "--laser-colour": laser_colour}
        refuse_vain(vain, "profiles with --poses are points already: no image is read")
    artefact = Artefact(plate, plane, None if side is None else side.value, sphere_diameter)
    rotation_rad = None if arm_rotation_deg is None else math.radians(arm_rotation_deg)
    options = given(
        HandEyeOptions,
        arm_position_mm=arm_position_mm,
        arm_rotation_rad=rotation_rad,
        plate_flatness_mm=plate_flatness_mm,
        solve_plate=solve_plate,
        solve_diameter=solve_diameter,
    )
    stripes = given(StripeOptions, method=stripe_method, laser_colour=laser_colour)
    return lambda job: calibrate_hand_eye(
        job,
        source,
        artefact,
        options=options,
        stripe_options=stripes,
        is_beside_thesis=method is Method.THESIS,
    )
