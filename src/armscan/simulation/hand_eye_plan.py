# SPDX-License-Identifier: Apache-2.0
"""Twelve ways of holding each head over the plate that fix the hand-eye well.

What a posture tells depends on the plate's normal and distance as the head sees them. The plan
spans the normals that both the laser and the camera can stand: laser upright and camera laid over,
both half-way, laid to the left and to the right, each near and far. It leaves 20 % less error than
random postures of 30-45 degrees; exchanging postures one by one gains another tenth
(``benchmarks/hand_eye_plan.py``). The rolls turn the plate's own tilt and its unevenness into
something else for each posture. Crossed lines and many lines get plans of the same kind: sheets
that cross tell a plane from each posture, and two cameras both have to stand it.
"""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Pose
from armscan.simulation.aim import Aim, sensor_over
from armscan.simulation.head import Head
from armscan.simulation.posture import aim_point_mm, facing_both
from armscan.simulation.stations import Bench

PLAN: tuple[Aim, ...] = (
    Aim(-44, -15, 0, 126),
    Aim(-44, 16, 75, 156),
    Aim(-38, -28, 20, 154),
    Aim(-36, 28, -40, 128),
    Aim(-30, -2, 110, 140),
    Aim(-8, 41, -15, 148),
    Aim(-8, -41, 50, 132),
    Aim(2, -34, -70, 152),
    Aim(2, 34, 10, 126),
    Aim(9, -12, 90, 126),
    Aim(9, 12, -25, 156),
    Aim(-2, 2, 35, 138),
)
CROSS_PLAN: tuple[Aim, ...] = (
    Aim(-42, -14, 0, 126),
    Aim(-42, 15, 75, 154),
    Aim(-33, -28, 20, 152),
    Aim(-32, 28, -40, 128),
    Aim(-25, -2, 110, 140),
    Aim(-5, 39, -15, 147),
    Aim(-5, -39, 50, 132),
    Aim(6, -32, -70, 150),
    Aim(6, 32, 10, 127),
    Aim(14, -12, 90, 127),
    Aim(14, 12, -25, 154),
    Aim(0, 2, 35, 138),
)
MULTI_PLAN: tuple[Aim, ...] = (
    Aim(-33, -7, -20, 128),
    Aim(-31, 9, 15, 152),
    Aim(-21, -17, 35, 148),
    Aim(-19, 17, -30, 131),
    Aim(-2, -22, 8, 135),
    Aim(2, 22, -15, 145),
    Aim(21, -16, 25, 129),
    Aim(19, 17, -40, 152),
    Aim(33, 6, 0, 133),
    Aim(31, -9, 30, 148),
    Aim(5, 3, 55, 126),
    Aim(-4, -3, -55, 156),
)
"""Tilts and rolls from facing both cameras alike."""
_SPOT_MM = 22.0
_GOLDEN_RAD = 2.399963
"""Turn from spot to spot on the plate: successive spots never line up."""
_JITTER_DEG = 2.0
_JITTER_ROLL_DEG = 6.0
_JITTER_DEPTH_MM = 2.0
_JITTER_SPOT_MM = 5.0


def hand_eye_poses(head: Head, bench: Bench, rng: np.random.Generator) -> list[Pose[Base, Sensor]]:
    """``base_from_sensor`` of the plan's postures over the plate, each a little off as by hand."""
    rotation = bench.base_from_plate.rotation
    poses = []
    for k, aim in enumerate(plan_of(head)):
        jitter = rng.uniform(-1.0, 1.0, 6)
        held = Aim(
            aim.tilt_x_deg + _JITTER_DEG * jitter[0],
            aim.tilt_y_deg + _JITTER_DEG * jitter[1],
            aim.roll_deg + _JITTER_ROLL_DEG * jitter[2],
            aim.depth_mm + _JITTER_DEPTH_MM * jitter[3],
        )
        on_plate = _spot_mm(k) + _JITTER_SPOT_MM * jitter[4:]
        spot = bench.base_from_plate.translation_mm + rotation[:, :2] @ on_plate
        poses.append(sensor_over(rotation, spot, held, aim_point_mm(head, held.depth_mm)))
    return poses


def plan_of(head: Head) -> tuple[Aim, ...]:
    """The plan that suits a head."""
    if len(head.cameras) == 1:
        return PLAN if len(head.sources) == 1 else CROSS_PLAN
    facing = facing_both(head)
    return tuple(
        Aim(
            facing.tilt_x_deg + aim.tilt_x_deg,
            facing.tilt_y_deg + aim.tilt_y_deg,
            facing.roll_deg + aim.roll_deg,
            aim.depth_mm,
        )
        for aim in MULTI_PLAN
    )


def _spot_mm(k: int) -> FloatArray:
    """(2,) place of the k-th posture's stripe on the plate."""
    turn = _GOLDEN_RAD * k
    return _SPOT_MM * np.array([np.cos(turn), np.sin(turn)])
