# SPDX-License-Identifier: Apache-2.0
"""Where a target is held before a head of one line, or of one camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.rotation import rotation_from_vector
from armscan.simulation.flat_pattern import CirclePattern
from armscan.simulation.head import Head
from armscan.simulation.held_target import is_in_view, with_middle
from armscan.simulation.sheet_middle import sheet_middle_mm
from armscan.simulation.station import Target


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
