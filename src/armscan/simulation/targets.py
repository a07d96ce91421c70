# SPDX-License-Identifier: Apache-2.0
"""Where the calibration target is held before a head: for its cameras, and for its light sheets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.poses import Pose
from armscan.geometry.rotations import rotation_from_vector
from armscan.simulation.arm.hand import PLANS, overlap_middle_mm, viewing_axes
from armscan.simulation.head import Head, MountedCamera, sheet_middle_mm
from armscan.simulation.objects.boards import CirclePattern
from armscan.simulation.station import Target

PATTERN = CirclePattern(columns=11, rows=9, pitch_mm=3.75, diameter_mm=1.875)
TARGET = "circle-grid:11x9:3.75"
Place = Sequence[float]
"""A row of ``scenes.toml``: tilt about x, about y and roll in degrees, then where."""

_RIM_PX = 12.0
_JITTER_DEG = 2.0
_JITTER_SHARE = 0.008
_JITTER_MM = 1.0
_SLIDES, _ASIDES, _SHARES = 41, 11, 21
_STEP_AWAY_MM = 1.0
_UPRIGHT = np.eye(3)
_FEW_LINES = 5


def made_target(sigma_mm: float, rng: np.random.Generator) -> CirclePattern:
    """The target with every circle a little off its place, as a maker delivers it."""
    if sigma_mm == 0.0:
        return PATTERN
    missed = sigma_mm * rng.standard_normal((PATTERN.columns * PATTERN.rows, 2))
    return replace(PATTERN, misplaced_mm=tuple((float(x), float(y)) for x, y in missed))


def camera_targets(head: Head, pattern: CirclePattern, rng: np.random.Generator) -> list[Target]:
    """The target at all places for the cameras, each a little off as by hand.

    For slanted sheets it is turned from place to place, so that marks that miss their places then
    miss them to other sides: what the camera is left with would bend the sheets' depths apart.
    """
    plan = PLANS["camera_targets"]
    if len(head.cameras) > 1:
        return [held_before_all(head, pattern, place, rng) for place in plan["two_cameras"]]
    quarter = 90.0 if len(head.lasers) > 1 else 0.0
    return [
        held_before_camera(head, pattern, [x, y, roll + quarter * (k % 4), *where], rng)
        for k, (x, y, roll, *where) in enumerate(plan["one_camera"])
    ]


def laser_targets(head: Head, pattern: CirclePattern, rng: np.random.Generator) -> list[Target]:
    """The target at all places for the light sheets."""
    plan = PLANS["laser_targets"]
    if head.kind == "one_line":
        return [held_in_sheet(head, pattern, place, rng) for place in plan["one_line"]]
    if head.kind == "crossed":
        return [held_before_all(head, pattern, place, rng) for place in plan["crossed"]]
    # a few lines in the middle are met at each place
    is_many = len(head.lasers) > _FEW_LINES
    places = plan["many"] if is_many else plan["many"][::2]
    outer = [*plan["left_first"], *plan["left_last"]] if is_many else []
    return [held_before_all(head, pattern, place, rng) for place in places] + [
        held_before_all(head, pattern, place, rng, is_for_left=True) for place in outer
    ]


def held_before_camera(
    head: Head, pattern: CirclePattern, place: Place, rng: np.random.Generator
) -> Target:
    """Target near a place in the image of one camera, moved away until all marks are in view."""
    across, down, depth_mm = place[3:]
    jitter = rng.uniform(-1.0, 1.0, 6)
    rotation = _rotation(place, jitter)
    size = np.array([head.camera.width_px, head.camera.height_px])
    share = np.array([across, down]) + _JITTER_SHARE * jitter[3:5]
    ray = np.array([*head.camera.rays(share * size), 1.0])
    depth = depth_mm * (1.0 + _JITTER_SHARE * jitter[5])
    while True:
        target = Target(pattern, Pose(rotation, _first_mark_mm(rotation, depth * ray)))
        if is_in_view(target, head.cameras):
            return target
        depth *= 1.01


def held_in_sheet(
    head: Head, pattern: CirclePattern, place: Place, rng: np.random.Generator
) -> Target:
    """Target that the stripe meets at a depth, slid in its plane until all marks are in view."""
    aside_mm, depth_mm = place[3:]
    jitter = rng.uniform(-1.0, 1.0, 5)
    rotation = _rotation(place, jitter)
    depth = depth_mm * (1.0 + _JITTER_SHARE * jitter[3])
    on_stripe = sheet_middle_mm(head, depth)
    for share in np.linspace(1.0, 0.0, _ASIDES):
        aside = _in_plane(rotation, on_stripe, share * (aside_mm + jitter[4]), on_stripe[1])
        inward = _in_plane(rotation, on_stripe, aside[0], 0.0)
        for slide in np.linspace(0.0, 1.0, _SLIDES):
            middle = aside + slide * (inward - aside)
            target = Target(pattern, Pose(rotation, _first_mark_mm(rotation, middle)))
            if is_in_view(target, head.cameras):
                return target
    raise InputError(f"the target at {depth:.0f} mm is larger than the camera's view")


def held_before_all(
    head: Head,
    pattern: CirclePattern,
    place: Place,
    rng: np.random.Generator,
    *,
    is_for_left: bool = False,
) -> Target:
    """Target as near to a place as its marks stay in view; moved away if they do nowhere.

    ``is_for_left``: it is enough that the left camera sees all marks.
    """
    across, down, farther = place[3:]
    jitter = rng.uniform(-1.0, 1.0, 6)
    axes = viewing_axes(head)
    rotation = _rotation(place, jitter, axes)
    farther += _JITTER_MM * jitter[5]
    aside = np.array([across, down]) + _JITTER_MM * jitter[3:5]
    cameras = head.cameras[:1] if is_for_left else head.cameras
    while True:
        middles = overlap_middle_mm(head, farther) + _nearest_first(aside) @ axes[:, :2].T
        origins = _first_mark_mm(rotation, middles)
        seen = _are_in_view(rotation, origins, cameras)
        if seen.any():
            return Target(pattern, Pose(rotation, origins[np.argmax(seen)]))
        farther += _STEP_AWAY_MM


def is_in_view(target: Target, cameras: Sequence[MountedCamera]) -> bool:
    """True if each of some cameras sees all marks; the blank rim may leave the image."""
    pose = target.base_from_board
    return bool(_are_in_view(pose.rotation, pose.translation_mm[None, :], cameras)[0])


def _are_in_view(
    rotation: FloatArray, origins_mm: FloatArray, cameras: Sequence[MountedCamera]
) -> BoolArray:
    """(N,) the same for targets of one rotation whose first marks are at (N, 3), in Sensor."""
    x_min, y_min, x_max, y_max = PATTERN.extent_board_mm
    rim = PATTERN.pitch_mm - PATTERN.diameter_mm
    (left, right), (top, bottom) = (x_min + rim, x_max - rim), (y_min + rim, y_max - rim)
    corners = np.array([[left, top, 0], [right, top, 0], [right, bottom, 0], [left, bottom, 0.0]])
    placed = corners @ rotation.T + origins_mm[:, None, :]
    result = np.ones(len(origins_mm), dtype=np.bool_)
    for mounted in cameras:
        camera, place = mounted.camera, mounted.camera_from_sensor
        seen = camera.project(placed @ place.rotation.T + place.translation_mm)
        size = np.array([camera.width_px, camera.height_px])
        result &= ((seen > _RIM_PX) & (seen < size - _RIM_PX)).all(axis=(1, 2))
    return result


def _first_mark_mm(rotation: FloatArray, middles_mm: FloatArray) -> FloatArray:
    """(..., 3) places of the first mark for middles (..., 3) of the target."""
    middle = np.append(PATTERN.marks_board_mm.mean(axis=0)[:2], 0.0)
    return np.asarray(middles_mm - rotation @ middle)


def _rotation(place: Place, jitter: FloatArray, axes: FloatArray = _UPRIGHT) -> FloatArray:
    """(3, 3) rolled first, then tilted about x, then about y, then as the axes (3, 3) stand."""
    degrees = np.array(place[:3]) + _JITTER_DEG * jitter[:3]
    about_x, about_y, roll = (
        rotation_from_vector(np.radians(angle) * axis)
        for angle, axis in zip(degrees, np.eye(3), strict=True)
    )
    return np.asarray(axes @ about_y @ about_x @ roll)


def _in_plane(rotation: FloatArray, point_mm: FloatArray, x_mm: float, y_mm: float) -> FloatArray:
    """(3,) point with coordinates x, y in the plane of a target through another point."""
    normal = rotation[:, 2]
    rest = normal @ point_mm - normal[0] * x_mm - normal[1] * y_mm
    return np.array([x_mm, y_mm, rest / normal[2]])


def _nearest_first(aside_mm: FloatArray) -> FloatArray:
    """(N, 2) places between the middle and the one that is wanted, the nearest to it first."""
    shares = np.linspace(0.0, 1.0, _SHARES)
    places = np.stack(np.meshgrid(shares, shares), axis=-1).reshape(-1, 2) * aside_mm
    return np.asarray(places[np.argsort(np.linalg.norm(places - aside_mm, axis=1), kind="stable")])
