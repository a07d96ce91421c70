# SPDX-License-Identifier: Apache-2.0
"""Where calibration targets are held before the head: for one camera, for two, and for the
lasers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.poses import Pose
from armscan.geometry.rotations import rotation_from_vector
from armscan.simulation.arm.hand import overlap_middle_mm, viewing_axes
from armscan.simulation.head import Head, MountedCamera, sheet_middle_mm
from armscan.simulation.objects.boards import CirclePattern
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


@dataclass(frozen=True, slots=True)
class Place:
    """Where a target is held.

    Parameters
    ----------
    tilt_x_deg, tilt_y_deg, roll_deg
        Turned from facing the camera upright: rolled first, then tilted about x, then about y.
    across, down
        Where the target's middle appears, as parts of the image's width and height.
    depth_mm
        Depth of its middle.
    """

    tilt_x_deg: float
    tilt_y_deg: float
    roll_deg: float
    across: float
    down: float
    depth_mm: float


@dataclass(frozen=True, slots=True)
class StripePlace:
    """Where a target is held so that the stripe crosses it.

    Parameters
    ----------
    tilt_x_deg, tilt_y_deg, roll_deg
        As for `Place`.
    aside_mm
        Middle of the target beside the middle of the stripe.
    depth_mm
        Depth of the middle of the stripe.
    """

    tilt_x_deg: float
    tilt_y_deg: float
    roll_deg: float
    aside_mm: float
    depth_mm: float


CAMERA_PLACES: tuple[Place, ...] = (
    Place(0, 0, 2, 0.50, 0.50, 124),
    Place(0, 3, -3, 0.29, 0.35, 140),
    Place(3, 0, 4, 0.71, 0.35, 140),
    Place(-3, 0, 2, 0.29, 0.65, 140),
    Place(0, -3, -5, 0.71, 0.65, 140),
    Place(30, 0, 5, 0.50, 0.48, 138),
    Place(-32, 2, -6, 0.50, 0.52, 140),
    Place(2, 32, 8, 0.45, 0.50, 140),
    Place(-2, -34, 3, 0.55, 0.50, 142),
    Place(42, 10, 20, 0.35, 0.42, 148),
    Place(-28, 32, -15, 0.64, 0.42, 150),
    Place(26, -32, -35, 0.36, 0.60, 150),
    Place(-24, -30, 40, 0.64, 0.60, 152),
    Place(8, 44, 85, 0.50, 0.50, 150),
    Place(-20, 12, 90, 0.50, 0.50, 164),
)

TURNED_CAMERA_PLACES: tuple[Place, ...] = tuple(
    replace(place, roll_deg=place.roll_deg + 90.0 * (k % 4))
    for k, place in enumerate(CAMERA_PLACES)
)
"""The same, the target turned from place to place: marks that miss their places then miss them to
other sides. Slanted sheets need it: what the camera is left with bends their depths apart."""

LASER_PLACES: tuple[StripePlace, ...] = (
    StripePlace(-6, 3, 1, -12.0, 117),
    StripePlace(-22, 10, -2, 15.0, 124),
    StripePlace(6, -12, 3, 17.0, 131),
    StripePlace(-26, -8, 2, -19.0, 138),
    StripePlace(-8, 20, -5, -20.0, 145),
    StripePlace(2, -20, 6, 21.0, 150),
    StripePlace(-20, 5, 3, -24.0, 157),
    StripePlace(18, 2, 0, 24.0, 164),
)
"""Near and far on both sides: the target is half as wide as the stripe."""

_JITTER_DEG = 2.0
_JITTER_SHARE = 0.008
_SLIDES, _ASIDES = 41, 11


def held_before_camera(
    head: Head, pattern: CirclePattern, place: Place, rng: np.random.Generator
) -> Target:
    """Target near a place, moved away until all marks are in view."""
    jitter = rng.uniform(-1.0, 1.0, 6)
    rotation = _rotation(place, jitter[:3])
    size = np.array([head.camera.width_px, head.camera.height_px])
    share = np.array([place.across, place.down]) + _JITTER_SHARE * jitter[3:5]
    ray = np.array([*head.camera.rays(share * size), 1.0])
    depth = place.depth_mm * (1.0 + _JITTER_SHARE * jitter[5])
    while True:
        target = with_middle(pattern, rotation, depth * ray)
        if is_in_view(target, head.cameras):
            return target
        depth *= 1.01


def held_in_sheet(
    head: Head, pattern: CirclePattern, place: StripePlace, rng: np.random.Generator
) -> Target:
    """Target that the stripe meets at a depth, slid in its plane until all marks are in view."""
    jitter = rng.uniform(-1.0, 1.0, 5)
    rotation = _rotation(place, jitter[:3])
    depth = place.depth_mm * (1.0 + _JITTER_SHARE * jitter[3])
    on_stripe = sheet_middle_mm(head, depth)
    for share in np.linspace(1.0, 0.0, _ASIDES):
        aside = _in_plane(rotation, on_stripe, share * (place.aside_mm + jitter[4]), on_stripe[1])
        inward = _in_plane(rotation, on_stripe, aside[0], 0.0)
        for slide in np.linspace(0.0, 1.0, _SLIDES):
            target = with_middle(pattern, rotation, aside + slide * (inward - aside))
            if is_in_view(target, head.cameras):
                return target
    raise InputError(f"the target at {depth:.0f} mm is larger than the camera's view")


def _rotation(place: Place | StripePlace, jitter: FloatArray) -> FloatArray:
    degrees = np.array([place.tilt_x_deg, place.tilt_y_deg, place.roll_deg])
    about_x, about_y, roll = (
        rotation_from_vector(np.radians(angle) * axis)
        for angle, axis in zip(degrees + _JITTER_DEG * jitter, np.eye(3), strict=True)
    )
    return np.asarray(about_y @ about_x @ roll)


def _in_plane(rotation: FloatArray, point_mm: FloatArray, x_mm: float, y_mm: float) -> FloatArray:
    """(3,) point with coordinates x, y in the plane of a target through another point."""
    normal = rotation[:, 2]
    rest = normal @ point_mm - normal[0] * x_mm - normal[1] * y_mm
    return np.array([x_mm, y_mm, rest / normal[2]])


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
