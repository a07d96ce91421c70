# SPDX-License-Identifier: Apache-2.0
"""Where a target is held so that two cameras see it, or so that several sheets cross it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.rotation import rotation_from_vector
from armscan.simulation.flat_pattern import CirclePattern
from armscan.simulation.head import Head
from armscan.simulation.held_target import are_in_view, first_marks_mm, with_middle
from armscan.simulation.posture import overlap_middle_mm, viewing_axes
from armscan.simulation.station import Target


@dataclass(frozen=True, slots=True)
class SharedPlace:
    """Where a target is held.

    Parameters
    ----------
    tilt_x_deg, tilt_y_deg, roll_deg
        Turned from facing all cameras alike, upright: rolled first, then tilted about x, then
        about y.
    across_mm, down_mm
        Middle of the target beside the place on which all cameras look.
    farther_mm
        And beyond it.
    is_for_left
        True if it is enough that the left camera sees all marks.
    """

    tilt_x_deg: float
    tilt_y_deg: float
    roll_deg: float
    across_mm: float
    down_mm: float
    farther_mm: float
    is_for_left: bool = False


STEREO_CAMERA_PLACES: tuple[SharedPlace, ...] = (
    SharedPlace(0, 0, 2, 0, 0, -18),
    SharedPlace(0, 3, -3, -20, -9, 0),
    SharedPlace(3, 0, 4, 20, -9, 0),
    SharedPlace(-3, 0, 2, -20, 9, 0),
    SharedPlace(0, -3, -5, 20, 9, 0),
    SharedPlace(28, 0, 5, 0, -1, 0),
    SharedPlace(-30, 2, -6, 0, 1, 2),
    SharedPlace(2, 20, 8, -6, 0, 2),
    SharedPlace(-2, -21, 3, 6, 0, 2),
    SharedPlace(34, 8, 20, -12, -7, 8),
    SharedPlace(-26, 16, -15, 14, -7, 10),
    SharedPlace(24, -18, -35, -12, 7, 10),
    SharedPlace(-22, -16, 40, 12, 7, 12),
    SharedPlace(8, 22, 85, 0, 0, 8),
    SharedPlace(-20, 10, 90, 0, 0, 24),
    SharedPlace(12, -12, 10, 24, 11, 18),
    SharedPlace(-10, 13, -12, -24, -11, 20),
    SharedPlace(6, -6, -80, 0, 0, 28),
)

CROSS_LASER_PLACES: tuple[SharedPlace, ...] = (
    SharedPlace(-6, 3, 1, 0, 2, -23),
    SharedPlace(-20, 10, -2, -7, -4, -14),
    SharedPlace(6, -12, 3, 8, 5, -12),
    SharedPlace(-24, -8, 2, 12, -9, -2),
    SharedPlace(-8, 18, -5, -12, 9, 0),
    SharedPlace(4, -18, 6, -12, -9, 3),
    SharedPlace(-18, 5, 3, 12, 9, 8),
    SharedPlace(16, 2, 0, 0, -4, 10),
    SharedPlace(-12, -16, 4, 14, -10, 17),
    SharedPlace(-22, 12, -6, -14, 10, 18),
    SharedPlace(10, 10, 2, 14, 8, 26),
    SharedPlace(-8, -6, -3, -14, -8, 27),
)
"""Both stripes cross the target each time, near their crossing or farther out on each arm."""

_MULTI_DEPTHS_MM = (-20, -10, -2, 7, 16, 26)
MULTI_LASER_PLACES: tuple[SharedPlace, ...] = tuple(
    SharedPlace(tilt_x, tilt_y, roll, across, down, farther + change)
    for k, farther in enumerate(_MULTI_DEPTHS_MM)
    for tilt_x, tilt_y, roll, across, down, change in (
        (3 - 2 * k, 3 * k - 6, 2, -30, -20, 1),
        (2 * k - 6, 5 - 2 * k, -3, 30, 20, -1),
        (18 * (-1) ** k, 10 - 4 * k, 4, 2, 3, 2),
        (5 * k - 14, 12 * (-1) ** k, 20 - 8 * k, 14 * (-1) ** k, -9 * (-1) ** k, -2),
    )
)
"""At each of six depths: where the first lines are, where the last are, in the middle, and towards
the lines' ends."""
MULTI_LEFT_PLACES: tuple[SharedPlace, ...] = (
    SharedPlace(4, -8, 3, -60, -26, -20, is_for_left=True),
    SharedPlace(-8, 12, -2, -60, -26, -10, is_for_left=True),
    SharedPlace(8, 20, 2, -60, -26, 0, is_for_left=True),
    SharedPlace(2, 0, 6, -60, -26, -15, is_for_left=True),
)
"""The first lines leave the view that both cameras share; the left one sees them nearer."""
MULTI_FAR_PLACES: tuple[SharedPlace, ...] = (
    SharedPlace(-4, 6, -3, 60, 26, -22, is_for_left=True),
    SharedPlace(6, -10, 3, 60, 26, -15, is_for_left=True),
    SharedPlace(-8, -16, 5, 60, 26, -7, is_for_left=True),
    SharedPlace(4, 12, -2, 60, 26, 2, is_for_left=True),
    SharedPlace(-10, 2, 2, 60, 26, 11, is_for_left=True),
    SharedPlace(8, -6, -6, 60, 26, 20, is_for_left=True),
)
"""The last lines, near and far, as far aside as the left camera sees the target."""

_JITTER_DEG = 2.0
_JITTER_MM = 1.0
_SHARES = 21
_STEP_AWAY_MM = 1.0


def held_before_all(
    head: Head, pattern: CirclePattern, place: SharedPlace, rng: np.random.Generator
) -> Target:
    """Target as near to a place as its marks stay in view; moved away if they do nowhere."""
    jitter = rng.uniform(-1.0, 1.0, 6)
    axes = viewing_axes(head)
    degrees = np.array([place.tilt_x_deg, place.tilt_y_deg, place.roll_deg])
    about_x, about_y, roll = (
        rotation_from_vector(np.radians(angle) * axis)
        for angle, axis in zip(degrees + _JITTER_DEG * jitter[:3], np.eye(3), strict=True)
    )
    rotation = axes @ about_y @ about_x @ roll
    farther = place.farther_mm + _JITTER_MM * jitter[5]
    aside = np.array([place.across_mm, place.down_mm]) + _JITTER_MM * jitter[3:5]
    cameras = head.cameras[:1] if place.is_for_left else head.cameras
    while True:
        middles = overlap_middle_mm(head, farther) + _nearest_first(aside) @ axes[:, :2].T
        seen = are_in_view(rotation, first_marks_mm(rotation, middles), cameras)
        if seen.any():
            return with_middle(pattern, rotation, middles[np.argmax(seen)])
        farther += _STEP_AWAY_MM


def _nearest_first(aside_mm: FloatArray) -> FloatArray:
    """(N, 2) places between the middle and the one that is wanted, the nearest to it first."""
    shares = np.linspace(0.0, 1.0, _SHARES)
    places = np.stack(np.meshgrid(shares, shares), axis=-1).reshape(-1, 2) * aside_mm
    return np.asarray(places[np.argsort(np.linalg.norm(places - aside_mm, axis=1), kind="stable")])
