# SPDX-License-Identifier: Apache-2.0
"""The bench on which the photo set is taken: one camera, one red line laser, a board, a bust."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, ImageArray
from armscan.geometry.frames import Board, Part, Sensor
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import rotation_from_vector
from armscan.simulation.board import PrintedBoard
from armscan.simulation.board_photo import outline_px, render_board
from armscan.simulation.body import Body
from armscan.simulation.bust import bust
from armscan.simulation.detector import Detector
from armscan.simulation.flat_pattern import CirclePattern
from armscan.simulation.light import LineLaser
from armscan.simulation.optics import RenderCamera
from armscan.simulation.render import Speckle, render_laser, render_room
from armscan.simulation.scene import Lamp, Scene
from armscan.simulation.stripe_truth import StripeTruth
from armscan.simulation.surfaces import Floor

BOARD = CirclePattern(columns=11, rows=9, pitch_mm=12.0, diameter_mm=6.0)
TARGET = "circle-grid:11x9:12"

Place = tuple[float, float, float, float, float, float]

CAMERA_PLACES: tuple[Place, ...] = (
    (0, 0, 2, 0.50, 0.50, 245),
    (32, 0, -3, 0.50, 0.50, 255),
    (-32, 0, 4, 0.50, 0.46, 260),
    (0, 36, 0, 0.50, 0.50, 250),
    (0, -36, 3, 0.48, 0.52, 250),
    (26, 24, 10, 0.31, 0.37, 290),
    (-26, 24, -8, 0.31, 0.63, 295),
    (26, -24, -12, 0.69, 0.37, 290),
    (-26, -24, 9, 0.69, 0.63, 290),
    (14, -16, 84, 0.50, 0.50, 310),
    (-18, 30, 40, 0.36, 0.50, 330),
    (20, -30, -35, 0.64, 0.50, 330),
)
"""Tilt about x, about y, roll (degrees), centre (parts of the image), distance (mm)."""

LASER_PLACES: tuple[Place, ...] = (
    (0, 0, 1, 0.48, 0.50, 255),
    (24, 8, -4, 0.50, 0.50, 285),
    (-24, -6, 5, 0.52, 0.48, 300),
    (4, 32, 2, 0.50, 0.52, 320),
    (-8, -30, -6, 0.54, 0.50, 345),
    (12, 10, 8, 0.56, 0.50, 375),
)
"""The same, for the laser: the board passes through the depths that the object will have."""

_TABLE_TILT_RAD = np.radians(10.0)
_BUST_TURN_RAD = np.radians(-22.0)
_BUST_FOOT_MM = (5.0, 90.0, 325.0)
_WALL_BEHIND_MM = 230.0
_LAMP = Lamp(even=0.6, direct=0.7, position_mm=(260.0, -330.0, -200.0))
_DIM_FOR_LASER = 0.3
_DIM_FOR_OBJECT = 0.6
_JITTER_DEG = 2.0
_JITTER_SHARE = 0.01
_RIM_PX = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Bench:
    """Camera, laser and what stands around; photographs come out as grey levels.

    Parameters
    ----------
    camera, laser, detector, speckle
        The instruments.
    wall_light
        (H, W, 3) the wall behind the boards under full room light.
    """

    camera: RenderCamera
    laser: LineLaser
    detector: Detector
    speckle: Speckle
    wall_light: FloatArray

    @staticmethod
    def build(width_px: int, height_px: int, laser_irradiance: float, skew_rad: float) -> Bench:
        """Set up a bench whose field of view does not depend on the size of the image."""
        scale = width_px / 1280.0
        camera = RenderCamera(
            fx=1402.6 * scale,
            fy=1401.1 * scale,
            cx=0.5 * (width_px - 1) + 7.3 * scale,
            cy=0.5 * (height_px - 1) - 4.6 * scale,
            k1=-0.092,
            k2=0.071,
            p1=3.1e-4,
            p2=-2.4e-4,
            width_px=width_px,
            height_px=height_px,
            blur_sigma_px=0.75,
        )
        laser = LineLaser(
            "A",
            np.array([-130.0, 5.0, 20.0]),
            np.array([138.0, 0.0, 290.0]),
            np.array([0.02, 1.0, 0.0]),
            skew_rad=skew_rad,
            irradiance=laser_irradiance,
        )
        wall = render_room(Scene((_wall(),), lamp=_LAMP), camera)
        return Bench(camera, laser, Detector(halo_sigma_px=8.0 * scale), Speckle(), wall)

    def photograph_board(
        self, place: Place, rng: np.random.Generator
    ) -> tuple[ImageArray, Pose[Sensor, Board]]:
        """Photo (H, W) of the board under full light, and where the board is."""
        board = self._board_at(place, rng)
        light = render_board(board, self.camera, _LAMP, self.wall_light)
        return self.detector.expose(light[..., 0], rng), board.sensor_from_board

    def photograph_stripe(
        self, place: Place, rng: np.random.Generator
    ) -> tuple[ImageArray, ImageArray, Pose[Sensor, Board], StripeTruth]:
        """Photos (H, W, 3) of the board in dim light with and without the laser, and the truth."""
        board = self._board_at(place, rng)
        dim = _DIM_FOR_LASER * render_board(board, self.camera, _LAMP, self.wall_light)
        scene = Scene((board, _wall()), (self.laser,), _LAMP)
        on, off, stripe = self._with_and_without(scene, dim, rng)
        return on, off, board.sensor_from_board, stripe

    def photograph_object(
        self, rng: np.random.Generator
    ) -> tuple[ImageArray, ImageArray, Body, StripeTruth]:
        """Photos (H, W, 3) of the bust with and without the laser, and the truth."""
        table = _table_rotation()
        turn = rotation_from_vector(np.array([0.0, _BUST_TURN_RAD, 0.0]))
        pose: Pose[Sensor, Part] = Pose(table @ turn, np.array(_BUST_FOOT_MM))
        body = bust(pose)
        floor = Floor(pose.translation_mm, table[:, 1], (0.13, 0.12, 0.115))
        scene = Scene((body, floor, _wall()), (self.laser,), _LAMP)
        dim = _DIM_FOR_OBJECT * render_room(scene, self.camera)
        on, off, stripe = self._with_and_without(scene, dim, rng)
        return on, off, body, stripe

    def _with_and_without(
        self, scene: Scene, room: FloatArray, rng: np.random.Generator
    ) -> tuple[ImageArray, ImageArray, StripeTruth]:
        line = render_laser(scene, self.camera, self.laser, self.speckle, rng)
        glow = self.detector.scatter(line.light)[..., None] * np.asarray(self.laser.colour)
        on = self.detector.expose(room + glow, rng)
        return on, self.detector.expose(room, rng), line.truth

    def _board_at(self, place: Place, rng: np.random.Generator) -> PrintedBoard:
        """Board near a place; moved away until all of it is in view."""
        jitter = rng.normal(size=6)
        degrees = np.array(place[:3]) + _JITTER_DEG * jitter[:3]
        centre = np.array(place[3:5]) + _JITTER_SHARE * jitter[3:5]
        distance = place[5] * (1.0 + _JITTER_SHARE * jitter[5])
        tilt_x, tilt_y, roll = np.radians(degrees)
        rotation = (
            rotation_from_vector(np.array([0.0, tilt_y, 0.0]))
            @ rotation_from_vector(np.array([tilt_x, 0.0, 0.0]))
            @ rotation_from_vector(np.array([0.0, 0.0, roll]))
        )
        middle = BOARD.marks_board_mm.mean(axis=0)
        size = np.array([self.camera.width_px, self.camera.height_px])
        ray = np.array([*self.camera.rays(centre * size), 1.0])
        while True:
            pose: Pose[Sensor, Board] = Pose(rotation, distance * ray - rotation @ middle)
            board = PrintedBoard(BOARD, pose)
            rim = outline_px(board, self.camera)
            if bool(((rim > _RIM_PX) & (rim < size - _RIM_PX)).all()):
                return board
            distance *= 1.02


def _wall() -> Floor:
    """The wall behind everything."""
    table = _table_rotation()
    foot = np.array(_BUST_FOOT_MM) - _WALL_BEHIND_MM * table[:, 2]
    return Floor(foot, table[:, 2], (0.2, 0.235, 0.27))


def _table_rotation() -> FloatArray:
    """Axes of the table in the Sensor frame: right, up, towards the viewer."""
    tilt = rotation_from_vector(np.array([_TABLE_TILT_RAD, 0.0, 0.0]))
    return np.asarray(tilt @ np.diag([1.0, -1.0, -1.0]))
