# SPDX-License-Identifier: Apache-2.0
"""Where a hand holds the head over a part with ring markers: places that overlap their neighbours.

They go along the part's front and return along its back, once before the arm is moved, and after
it the other way round, the head held differently: the first place after it is near the last before.
"""

from __future__ import annotations

import numpy as np

from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Pose
from armscan.simulation.aim import Aim, sensor_over
from armscan.simulation.head import Head
from armscan.simulation.posture import aim_point_mm, facing_both
from armscan.simulation.stations import Bench

PLACES: tuple[tuple[float, float, float, float, float, float], ...] = (
    (-22, -8, 4, 3, -8, 139),
    (-9, -9, -8, 2, 6, 143),
    (6, -8, 6, -7, 15, 138),
    (21, -9, 9, 4, -5, 144),
    (22, 7, -9, -4, 10, 141),
    (7, 9, -3, 8, -16, 146),
    (-8, 8, 7, -5, 4, 140),
    (-21, 9, -6, 6, -12, 143),
)
"""Across and along the part (mm); tilts and roll (degrees) from facing it with both cameras
alike; depth (mm)."""
_HIGH_MM = 9.0
"""Middle of the faces' heights."""
_JITTER_DEG = 2.0
_JITTER_ROLL_DEG = 6.0
_JITTER_MM = 2.0


def marker_poses(
    head: Head, bench: Bench, is_moved: bool, rng: np.random.Generator
) -> list[tuple[str, Pose[Base, Sensor]]]:
    """Name and ``base_from_sensor`` of each place; after the move they are numbered on.

    Base is that before or after the arm was moved.
    """
    part = bench.marked_pose(is_moved)
    facing = facing_both(head)
    side = -1.0 if is_moved else 1.0
    first = len(PLACES) + 1 if is_moved else 1
    poses = []
    for k, (x, y, tilt_x, tilt_y, roll, depth) in enumerate(PLACES):
        jitter = rng.uniform(-1.0, 1.0, 6)
        aim = Aim(
            facing.tilt_x_deg + side * tilt_x + _JITTER_DEG * jitter[0],
            facing.tilt_y_deg + side * tilt_y + _JITTER_DEG * jitter[1],
            facing.roll_deg + side * roll + _JITTER_ROLL_DEG * jitter[2],
            depth + _JITTER_MM * jitter[3],
        )
        place = np.array([x, side * y, _HIGH_MM]) + _JITTER_MM * np.array([*jitter[4:], 0.0])
        spot = part.translation_mm + part.rotation @ place
        middle = aim_point_mm(head, aim.depth_mm)
        poses.append((f"place-{first + k:02d}", sensor_over(part.rotation, spot, aim, middle)))
    return poses
