# SPDX-License-Identifier: Apache-2.0
"""``armscan calibrate hand-eye``: where the sensor sits on the arm."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, cast

import typer

from armscan.cli.image_arguments import BitsAlign, BitsUsed, LaserColourOption, StripeMethodOption
from armscan.cli.output import AsJson, Force, progress_bar, show
from armscan.cli.probe import Side

EXAMPLE = (
    "\b\nExample:\n"
    "  armscan calibrate hand-eye scan --sensor sensor.json --plate plate.csv -o scanner.json\n"
    "  armscan calibrate hand-eye --profiles 'p*.yml' --poses RobPoses.rob \\\n"
    "      --euler extrinsic-xyz --sphere-diameter 80 -o scanner.json\n\n"
    "\b\nLay the plate down, probe it, and take 12 or more postures at rest: tilted by 30 to 45\n"
    "degrees in several directions, nearer and farther."
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
    arm: Annotated[
        Path | None,
        typer.Option(help="arm.toml, for recordings of joint angles.", show_default=False),
    ] = None,
    arm_position_mm: Annotated[
        float | None, typer.Option(help="Scatter of the arm, mm an axis; left out, estimated.")
    ] = None,
    arm_rotation_deg: Annotated[
        float | None, typer.Option(help="Scatter of its orientation; left out, from the position.")
    ] = None,
    plate_flatness_mm: Annotated[
        float | None, typer.Option(help="Scatter of the plate's surface; left out, estimated.")
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Document to write; a page goes beside it.")
    ] = Path("scanner.json"),
    stripe_method: StripeMethodOption = "fit",
    laser_colour: LaserColourOption = "auto",
    bits_used: BitsUsed = None,
    bits_align: BitsAlign = "low",
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find where the sensor sits on the arm, from postures over a flat plate or a sphere."""
    from armscan.calibration.hand_eye.options import HandEyeOptions
    from armscan.calibration.hand_eye.sphere_options import SphereOptions
    from armscan.geometry.euler import check_convention
    from armscan.report.hand_eye_job import run_hand_eye_calibration
    from armscan.report.hand_eye_request import HandEyeRequest
    from armscan.storage.image_options import Alignment, ImageOptions
    from armscan.vision.stripe.options import LaserColour, StripeMethod, StripeOptions

    rotation_rad = None if arm_rotation_deg is None else math.radians(arm_rotation_deg)
    request = HandEyeRequest(
        output=output,
        scans=tuple(scans or ()),
        sensor=sensor,
        profiles=tuple(profiles or ()),
        poses=poses,
        euler=check_convention(euler),
        plate=plate,
        plane=plane,
        side=None if side is None else side.value,
        sphere_diameter_mm=sphere_diameter,
        arm=arm,
        options=HandEyeOptions(
            arm_position_mm=arm_position_mm,
            arm_rotation_rad=rotation_rad,
            plate_flatness_mm=plate_flatness_mm,
            solve_plate=solve_plate,
        ),
        sphere_options=SphereOptions(
            arm_position_mm=arm_position_mm, arm_rotation_rad=rotation_rad
        ),
        stripes=StripeOptions(
            method=cast(StripeMethod, stripe_method),
            laser_colour=cast(LaserColour, laser_colour),
        ),
        image_options=ImageOptions(bits_used=bits_used, align=cast(Alignment, bits_align)),
        is_overwriting=force,
        command=("armscan", *sys.argv[1:]),
    )
    with progress_bar() as progress:
        summary = run_hand_eye_calibration(request, progress)
    show(summary, as_json=as_json)
