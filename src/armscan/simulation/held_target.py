# SPDX-License-Identifier: Apache-2.0
"""The calibration target, and whether all cameras of a head see all of its marks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.poses import Pose
from armscan.simulation.flat_pattern import CirclePattern
from armscan.simulation.head import MountedCamera
from armscan.simulation.station import Target

PATTERN = CirclePattern(columns=11, rows=9, pitch_mm=3.75, diameter_mm=1.875)
TARGET = "circle-grid:11x9:3.75"
_RIM_PX = 12.0


def made_target(sigma_mm: float, rng: np.random.Generator) -> CirclePattern:
    """The target with every circle a little off its place, as a maker delivers it."""
    if sigma_mm == 0.0:
        return PATTERN
    missed = sigma_mm * rng.standard_normal((PATTERN.columns * PATTERN.rows, 2))
    return replace(PATTERN, misplaced_mm=tuple((float(x), float(y)) for x, y in missed))


def with_middle(pattern: CirclePattern, rotation: FloatArray, middle_mm: FloatArray) -> Target:
    """Target, turned by (3, 3), whose middle is at a point (3,)."""
    return Target(pattern, Pose(rotation, first_marks_mm(rotation, middle_mm)))


def first_marks_mm(rotation: FloatArray, middles_mm: FloatArray) -> FloatArray:
    """(..., 3) places of the first mark for middles (..., 3) of the target."""
    middle = np.append(PATTERN.marks_board_mm.mean(axis=0)[:2], 0.0)
    return np.asarray(middles_mm - rotation @ middle)


def is_in_view(target: Target, cameras: Sequence[MountedCamera]) -> bool:
    """True if each of some cameras sees all marks; the blank rim may leave the image."""
    pose = target.base_from_board
    return bool(are_in_view(pose.rotation, pose.translation_mm[None, :], cameras)[0])


def are_in_view(
    rotation: FloatArray, origins_mm: FloatArray, cameras: Sequence[MountedCamera]
) -> BoolArray:
    """(N,) the same for targets of one rotation whose first marks are at (N, 3), in Sensor."""
    corners = _corners_mm() @ rotation.T + origins_mm[:, None, :]
    result = np.ones(len(origins_mm), dtype=np.bool_)
    for mounted in cameras:
        camera, place = mounted.camera, mounted.camera_from_sensor
        rim = camera.project(corners @ place.rotation.T + place.translation_mm)
        size = np.array([camera.width_px, camera.height_px])
        result &= ((rim > _RIM_PX) & (rim < size - _RIM_PX)).all(axis=(1, 2))
    return result


def _corners_mm() -> FloatArray:
    """(4, 3) corners around all marks, in Board."""
    x_min, y_min, x_max, y_max = PATTERN.extent_board_mm
    rim = PATTERN.pitch_mm - PATTERN.diameter_mm
    x_min, y_min, x_max, y_max = x_min + rim, y_min + rim, x_max - rim, y_max - rim
    return np.array([[x_min, y_min, 0], [x_max, y_min, 0], [x_max, y_max, 0], [x_min, y_max, 0.0]])
