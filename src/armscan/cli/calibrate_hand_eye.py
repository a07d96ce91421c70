# SPDX-License-Identifier: Apache-2.0
"""``armscan calibrate hand-eye``: where the sensor sits on the arm."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, cast

import typer

from armscan.cli import hand_eye_arguments as given
from armscan.cli.options import (
    AsJson,
    Force,
    LaserColourOption,
    StripeMethodOption,
    progress_bar,
    show,
)

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
    scans: given.Scans = None,
    sensor: given.Sensor = None,
    plate: given.Plate = None,
    plane: given.PlaneText = "",
    side: given.PlateSide = None,
    solve_plate: given.SolvePlate = False,
    sphere_diameter: given.SphereDiameter = None,
    profiles: given.Profiles = None,
    poses: given.Poses = None,
    euler: given.Euler = "extrinsic-xyz",
    arm: given.Arm = None,
    arm_position_mm: given.ArmPosition = None,
    arm_rotation_deg: given.ArmRotation = None,
    plate_flatness_mm: given.PlateFlatness = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Document to write; a page goes beside it.")
    ] = Path("scanner.json"),
    stripe_method: StripeMethodOption = "fit",
    laser_colour: LaserColourOption = "auto",
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find where the sensor sits on the arm, from postures over a flat plate or a sphere."""
    from armscan.calibration.hand_eye.observations import HandEyeOptions
    from armscan.geometry.rotations import check_convention
    from armscan.jobs.hand_eye import HandEyeRequest, run_hand_eye_calibration
    from armscan.vision.stripe.image import LaserColour, StripeMethod, StripeOptions

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
        stripes=StripeOptions(
            method=cast(StripeMethod, stripe_method),
            laser_colour=cast(LaserColour, laser_colour),
        ),
        is_overwriting=force,
        command=("armscan", *sys.argv[1:]),
    )
    with progress_bar() as progress:
        summary = run_hand_eye_calibration(request, progress)
    show(summary, as_json=as_json)
