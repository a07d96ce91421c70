# SPDX-License-Identifier: Apache-2.0
"""What a scanner head at any pose sees of a scene in Base: exposures and the truth of stripes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, ImageArray, frozen_floats
from armscan.geometry.frames import Base, Board, Sensor
from armscan.geometry.poses import Points, Pose
from armscan.simulation.board import PrintedBoard
from armscan.simulation.flat_pattern import FlatPattern
from armscan.simulation.head import Head, Window
from armscan.simulation.light import LineLaser
from armscan.simulation.render import laser_band, render_laser
from armscan.simulation.scene import Lamp, Scene
from armscan.simulation.shapes import Placed
from armscan.simulation.stripe_truth import find_stripe
from armscan.simulation.thing import Thing

ROOM = Lamp(even=0.6, direct=0.4, position_mm=(350.0, -400.0, 900.0), up=(0.0, 0.0, 1.0))
"""Light of the room around the arm: white that faces up sees about full scale; scaled later."""


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A printed target in Base, drawn sharply in images under room light.

    Parameters
    ----------
    pattern
        The print.
    base_from_board
        Where it is; the board's z axis points away from the viewer, into the board.
    light, dark
        Albedo of the two tones.
    """

    pattern: FlatPattern
    base_from_board: Pose[Base, Board]
    light: float = 0.85
    dark: float = 0.08


@dataclass(frozen=True, slots=True, eq=False)
class Station:
    """What stands around the arm, in Base.

    Parameters
    ----------
    things
        Surfaces with their finish.
    target
        A printed target, or None.
    room
        Light of the room; its brightness is scaled by each exposure.
    """

    things: tuple[Thing, ...]
    target: Target | None = None
    room: Lamp = ROOM


@dataclass(frozen=True, slots=True)
class ExposureSettings:
    """What the camera and the lasers do for one image.

    Parameters
    ----------
    window
        Part of the sensor that is read.
    lasers
        Names of the lasers that are on.
    room_light
        Brightness of white that faces up under the room's light, as a part of full scale; None for
        the preset's ambient light.
    laser_gain
        Factor on the lasers' light.
    """

    window: Window
    lasers: tuple[str, ...] = ()
    room_light: float | None = None
    laser_gain: float = 1.0

    def __post_init__(self) -> None:
        if self.laser_gain < 0.0 or (self.room_light is not None and self.room_light < 0.0):
            raise InputError("light cannot be negative")


@dataclass(frozen=True, slots=True, eq=False)
class TrueStripe:
    """True centre points of one laser's stripe, about one a column.

    Parameters
    ----------
    laser
        Name of the laser.
    points_px
        (N, 2) full-sensor pixels.
    points_sensor_mm, points_base_mm
        (N, 3) in the two frames.
    thing
        (N,) index into the station's things, as float64; the target, if any, comes after them.
    """

    laser: str
    points_px: FloatArray
    points_sensor_mm: FloatArray
    points_base_mm: FloatArray
    thing: FloatArray

    def __post_init__(self) -> None:
        n = len(self.points_px)
        shapes = {"points_px": 2, "points_sensor_mm": 3, "points_base_mm": 3}
        for name, width in shapes.items():
            object.__setattr__(self, name, frozen_floats(getattr(self, name), (n, width), name))
        object.__setattr__(self, "thing", frozen_floats(self.thing, (n,), "thing"))


def render_exposure(
    head: Head,
    station: Station,
    base_from_sensor: Sequence[Pose[Base, Sensor]],
    settings: ExposureSettings,
    rng: np.random.Generator,
) -> ImageArray:
    """Image (H, W) of one exposure.

    Parameters
    ----------
    head, station
        What looks at what.
    base_from_sensor
        Poses over the exposure time, equally long each; one if the head stands still. The room
        and the target are seen from the middle one.
    settings
        Window, lasers, light.
    rng
        Source of speckle and noise.

    Raises
    ------
    InputError
        If a laser is not of this head or no pose is given.
    """
    if not base_from_sensor:
        raise InputError("an exposure needs a pose")
    light = np.zeros((settings.window.height_px, settings.window.width_px))
    camera = head.camera.cropped(*_corners(settings.window))
    for pose in base_from_sensor:
        scene = seen_from(station, pose)
        for laser in _chosen(head, settings.lasers):
            line = render_laser(scene, camera, laser, head.imaging.speckle, rng)
            light += line.light * (settings.laser_gain / len(base_from_sensor))
    ambient = head.imaging.ambient if settings.room_light is None else settings.room_light
    return head.imaging.detector.expose(head.imaging.detector.scatter(light) + 0.5 * ambient, rng)


def true_stripes(
    head: Head, station: Station, base_from_sensor: Pose[Base, Sensor], settings: ExposureSettings
) -> tuple[TrueStripe, ...]:
    """Where the centres of the sheets that are on truly lie, for a head that stands still."""
    window = settings.window
    camera = head.camera.cropped(*_corners(window))
    scene = seen_from(station, base_from_sensor)
    stripes = []
    for laser in _chosen(head, settings.lasers):
        found = find_stripe(scene, camera, laser, laser_band(scene, camera, laser))
        in_sensor: Points[Sensor] = Points(found.points_mm)
        pixels = found.points_px + np.array([window.x_px, window.y_px])
        stripes.append(
            TrueStripe(
                laser.name,
                pixels,
                found.points_mm,
                (base_from_sensor @ in_sensor).xyz_mm,
                found.surface,
            )
        )
    return tuple(stripes)


def seen_from(station: Station, base_from_sensor: Pose[Base, Sensor]) -> Scene:
    """The station's things, then its target, in the Sensor frame."""
    sensor_from_base = base_from_sensor.inverse()
    surfaces: list[Placed | PrintedBoard] = [Placed(t, sensor_from_base) for t in station.things]
    if station.target is not None:
        surfaces.append(board_seen_from(station.target, base_from_sensor))
    return Scene(tuple(surfaces))


def board_seen_from(target: Target, base_from_sensor: Pose[Base, Sensor]) -> PrintedBoard:
    """The target in the Sensor frame."""
    pose = base_from_sensor.inverse() @ target.base_from_board
    return PrintedBoard(target.pattern, pose, target.light, target.dark)


def _chosen(head: Head, names: tuple[str, ...]) -> tuple[LineLaser, ...]:
    known = {laser.name: laser for laser in head.lasers}
    for name in names:
        if name not in known:
            raise InputError(f"head '{head.name}' has no laser '{name}'")
    return tuple(known[name] for name in names)


def _corners(window: Window) -> tuple[int, int, int, int]:
    return window.x_px, window.y_px, window.width_px, window.height_px
