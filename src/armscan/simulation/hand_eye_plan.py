# SPDX-License-Identifier: Apache-2.0
"""Twelve ways of holding the head over the plate that fix the hand-eye well.

What a posture tells depends on the plate's normal and distance as the head sees them. The plan
spans the normals that both the laser and the camera can stand: laser upright and camera laid over,
both half-way, laid to the left and to the right, each near and far. It leaves 20 % less error than
random postures of 30-45 degrees; exchanging postures one by one gains another tenth
(``benchmarks/hand_eye_plan.py``). The rolls turn the plate's own tilt and its unevenness into
something else for each posture.
"""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Pose
from armscan.simulation.aim import Aim, sensor_over
from armscan.simulation.head import Head
from armscan.simulation.sheet_middle import sheet_middle_mm
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
    for k, aim in enumerate(PLAN):
        jitter = rng.uniform(-1.0, 1.0, 6)
        held = Aim(
            aim.tilt_x_deg + _JITTER_DEG * jitter[0],
            aim.tilt_y_deg + _JITTER_DEG * jitter[1],
            aim.roll_deg + _JITTER_ROLL_DEG * jitter[2],
            aim.depth_mm + _JITTER_DEPTH_MM * jitter[3],
        )
        on_plate = _spot_mm(k) + _JITTER_SPOT_MM * jitter[4:]
        spot = bench.base_from_plate.translation_mm + rotation[:, :2] @ on_plate
        poses.append(sensor_over(rotation, spot, held, sheet_middle_mm(head, held.depth_mm)))
    return poses


def _spot_mm(k: int) -> FloatArray:
    """(2,) place of the k-th posture's stripe on the plate."""
    turn = _GOLDEN_RAD * k
    return _SPOT_MM * np.array([np.cos(turn), np.sin(turn)])
