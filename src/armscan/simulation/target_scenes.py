# SPDX-License-Identifier: Apache-2.0
"""The head before its calibration target: images for the camera, pairs for the light sheet.

No arm takes part, so Base is the Sensor frame here and the target moves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Base, Board, Sensor
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import rotation_from_vector
from armscan.records.session import ExposureRow
from armscan.simulation.flat_pattern import CirclePattern
from armscan.simulation.head import Head
from armscan.simulation.scene import Lamp
from armscan.simulation.station import ExposureSettings, Station, Target
from armscan.simulation.surfaces import Floor
from armscan.simulation.thing import Thing
from armscan.simulation.twin_scan import Shot

PATTERN = CirclePattern(columns=11, rows=9, pitch_mm=3.75, diameter_mm=1.875)
TARGET = "circle-grid:11x9:3.75"


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

LASER_PLACES: tuple[Place, ...] = (
    Place(-6, 3, 1, 0.50, 0.34, 118),
    Place(-20, 8, -4, 0.44, 0.38, 125),
    Place(4, -10, 5, 0.56, 0.45, 132),
    Place(-25, -6, 2, 0.40, 0.50, 139),
    Place(-8, 20, -6, 0.60, 0.54, 146),
    Place(0, -18, 3, 0.42, 0.58, 152),
    Place(-18, 4, 8, 0.58, 0.62, 159),
    Place(-4, -4, -3, 0.50, 0.66, 166),
)

_LAMP = Lamp(even=0.7, direct=0.35, position_mm=(120.0, -260.0, -250.0), up=(0.0, 0.0, -1.0))
_BACKGROUND = Thing(
    "table", Floor(np.array([0.0, 0.0, 280.0]), np.array([0.0, 0.0, -1.0]), (0.25, 0.25, 0.25))
)
_WITH_LASER = 0.15
"""Room light while the stripe is photographed, over that of the target's image."""
_JITTER_DEG = 2.0
_JITTER_SHARE = 0.008
_RIM_PX = 12.0
_INTERVAL_NS = 2_000_000_000


def camera_shots(head: Head, rng: np.random.Generator) -> tuple[Shot, ...]:
    """The target at all `CAMERA_PLACES`, each a little off as by hand."""
    settings = ExposureSettings(head.full_window, room_light=head.imaging.target_light)
    shots = []
    for k, place in enumerate(CAMERA_PLACES):
        row = ExposureRow(k, _INTERVAL_NS * (k + 1), 0, f"images/{k + 1:02d}.png")
        shots.append(_shot(row, _held(head, place, rng), settings))
    return tuple(shots)


def laser_shots(head: Head, rng: np.random.Generator) -> tuple[Shot, ...]:
    """The target at all `LASER_PLACES`, each with the laser on in dim light, then without it."""
    light = head.imaging.target_light
    names = tuple(laser.name for laser in head.lasers)
    lit = ExposureSettings(head.full_window, names, room_light=_WITH_LASER * light)
    unlit = ExposureSettings(head.full_window, room_light=light)
    shots = []
    for k, place in enumerate(LASER_PLACES):
        target = _held(head, place, rng)
        for j, (state, settings) in enumerate((("on", lit), ("off", unlit))):
            row = ExposureRow(
                2 * k + j,
                _INTERVAL_NS * (2 * k + j + 1),
                0,
                f"images/{state}/{k + 1:02d}.png",
                lasers=settings.lasers,
                view=f"{k + 1:02d}",
            )
            shots.append(_shot(row, target, settings))
    return tuple(shots)


def _shot(row: ExposureRow, target: Target, settings: ExposureSettings) -> Shot:
    here: Pose[Base, Sensor] = Pose(np.eye(3), np.zeros(3))
    return Shot(row, Station((_BACKGROUND,), target, _LAMP), here, settings)


def _held(head: Head, place: Place, rng: np.random.Generator) -> Target:
    """Target near a place, moved away until all of it is in view."""
    jitter = rng.uniform(-1.0, 1.0, 6)
    degrees = np.array([place.tilt_x_deg, place.tilt_y_deg, place.roll_deg])
    about_x, about_y, roll = (
        rotation_from_vector(np.radians(angle) * axis)
        for angle, axis in zip(degrees + _JITTER_DEG * jitter[:3], np.eye(3), strict=True)
    )
    rotation = about_y @ about_x @ roll
    size = np.array([head.camera.width_px, head.camera.height_px])
    share = np.array([place.across, place.down]) + _JITTER_SHARE * jitter[3:5]
    ray = np.array([*head.camera.rays(share * size), 1.0])
    depth = place.depth_mm * (1.0 + _JITTER_SHARE * jitter[5])
    middle = np.append(PATTERN.marks_board_mm.mean(axis=0)[:2], 0.0)
    while True:
        pose: Pose[Base, Board] = Pose(rotation, depth * ray - rotation @ middle)
        rim = head.camera.project(_corners_mm() @ rotation.T + pose.translation_mm)
        if bool(((rim > _RIM_PX) & (rim < size - _RIM_PX)).all()):
            return Target(PATTERN, pose)
        depth *= 1.01


def _corners_mm() -> FloatArray:
    """(4, 3) corners of the printed board, in Board."""
    x_min, y_min, x_max, y_max = PATTERN.extent_board_mm
    return np.array([[x_min, y_min, 0], [x_max, y_min, 0], [x_max, y_max, 0], [x_min, y_max, 0.0]])
