# SPDX-License-Identifier: Apache-2.0
"""The rendered photographs of `demo photos` and their truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np

from armscan.errors import InputError, OutputError
from armscan.geometry.arrays import FloatArray, ImageArray
from armscan.geometry.poses import Board, Part, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector
from armscan.simulation.objects.board_image import outline_px, render_board
from armscan.simulation.objects.boards import CirclePattern, PrintedBoard
from armscan.simulation.objects.body import Body, bust
from armscan.simulation.optics.camera import Detector, RenderCamera
from armscan.simulation.optics.lasers import LineLaser
from armscan.simulation.optics.render import Speckle, StripeTruth, render_laser, render_room
from armscan.simulation.optics.scene import Floor, RoomLight, Scene

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
_LAMP = RoomLight(even=0.6, direct=0.7, position_mm=(260.0, -330.0, -200.0))
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


@dataclass(frozen=True, slots=True, eq=False)
class PhotoSetTruth:
    """What the photographs were rendered from.

    Parameters
    ----------
    seed
        Seed of placement and noise.
    target
        The board, as the command line names it.
    camera
        The simulator's camera.
    laser
        The simulator's laser; its sheet is a cone, not a plane.
    camera_boards
        Where the board was in each camera photo.
    laser_boards, laser_stripes
        Where it was in each laser photo, and the true stripes.
    body, body_stripe
        The object and its true stripe.
    """

    seed: int
    target: str
    camera: RenderCamera
    laser: LineLaser
    camera_boards: tuple[Pose[Sensor, Board], ...]
    laser_boards: tuple[Pose[Sensor, Board], ...]
    laser_stripes: tuple[StripeTruth, ...]
    body: Body
    body_stripe: StripeTruth

    @property
    def camera_parameters(self) -> FloatArray:
        """(9,) ``fx fy cx cy`` in px and ``k1 k2 p1 p2 k3``."""
        c = self.camera
        return np.array([c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.p1, c.p2, c.k3])

    @property
    def sheet_points_mm(self) -> FloatArray:
        """(N, 3) true points of the sheet in the Sensor frame: all laser stripes on the board."""
        return np.concatenate([s.points_mm[s.surface == 0] for s in self.laser_stripes])

    def sheet_offset_mm(self, points_sensor_mm: FloatArray) -> FloatArray:
        """Signed distance (N,) of points (N, 3) from the true sheet."""
        return self.laser.offset_mm(np.asarray(points_sensor_mm, dtype=np.float64))

    def object_distance_mm(self, points_sensor_mm: FloatArray) -> FloatArray:
        """Signed distance (N,) of points (N, 3) from the object's true surface."""
        return self.body.distance_mm(np.asarray(points_sensor_mm, dtype=np.float64))

    def object_normals(self, points_sensor_mm: FloatArray) -> FloatArray:
        """(N, 3) unit normals of the object's true surface next to points (N, 3)."""
        return self.body.normals(np.asarray(points_sensor_mm, dtype=np.float64))


def write_truth(path: Path, truth: PhotoSetTruth) -> None:
    """Write the truth as JSON, whole or not at all.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    write_whole(path, json.dumps(_document(truth), indent=1).encode())


def write_whole(path: Path, content: bytes) -> None:
    """Write a file under a temporary name and rename it.

    Raises
    ------
    OutputError
        If the folder or the file cannot be written.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(content)
        partial.replace(path)
    except OSError as error:
        raise OutputError(
            f"cannot write: {error.strerror or error}",
            where=str(path),
            remedy="choose a folder that can be written",
        ) from error


def _document(truth: PhotoSetTruth) -> dict[str, Any]:
    laser = truth.laser
    return {
        "simulated": True,
        "note": "The truth of the rendered photographs beside this file; no program may read it "
        "before it has measured.",
        "seed": truth.seed,
        "target": truth.target,
        "camera": asdict(truth.camera),
        "laser": {
            "name": laser.name,
            "source_sensor_mm": laser.source_mm.tolist(),
            "forward": laser.forward.tolist(),
            "across": laser.across.tolist(),
            "skew_rad": laser.skew_rad,
        },
        "camera_photos": [_pose(pose) for pose in truth.camera_boards],
        "laser_photos": [
            {**_pose(pose), **_stripe(stripe)}
            for pose, stripe in zip(truth.laser_boards, truth.laser_stripes, strict=True)
        ],
        "object": {
            **_pose(truth.body.sensor_from_part),
            "limbs": [asdict(limb) for limb in truth.body.limbs],
            **_stripe(truth.body_stripe),
        },
    }


def _pose(pose: Pose[Any, Any]) -> dict[str, Any]:
    return {
        "sensor_from_object": {
            "rotation": pose.rotation.tolist(),
            "translation_mm": pose.translation_mm.tolist(),
        }
    }


def _stripe(stripe: StripeTruth) -> dict[str, Any]:
    return {
        "stripe_px": np.round(stripe.points_px, 4).tolist(),
        "stripe_sensor_mm": np.round(stripe.points_mm, 5).tolist(),
    }


Report: TypeAlias = Callable[[int, int, str], None]


@dataclass(frozen=True, slots=True)
class PhotoSetOptions:
    """How many photos, how large, and how bright the laser is.

    Parameters
    ----------
    width_px, height_px
        Size of every photo; the field of view stays the same.
    n_camera, n_laser
        Photos of the board for the camera, and placements for the laser.
    laser_irradiance
        Light of the laser on a white board, as parts of full scale.
    skew_rad
        Bow of the laser's sheet; see `LineLaser`.
    """

    width_px: int = 1280
    height_px: int = 960
    n_camera: int = len(CAMERA_PLACES)
    n_laser: int = len(LASER_PLACES)
    laser_irradiance: float = 1.9
    skew_rad: float = 0.008

    def __post_init__(self) -> None:
        if min(self.width_px, self.height_px) < 240:
            raise InputError(f"photos of {self.width_px} x {self.height_px} px are too small")
        for count, places in ((self.n_camera, CAMERA_PLACES), (self.n_laser, LASER_PLACES)):
            if not 1 <= count <= len(places):
                raise InputError(f"{count} photos asked for; 1 to {len(places)} can be rendered")


def render_photo_set(
    folder: Path,
    seed: int = 1,
    progress: Report | None = None,
    options: PhotoSetOptions | None = None,
) -> PhotoSetTruth:
    """Render the photographs into a folder and return their truth.

    Parameters
    ----------
    folder
        Made if need be; files of the same names are replaced.
    seed
        Placement jitter and noise.
    progress
        Called with photos written, photos in all, and the name of the latest.
    options
        Counts and sizes.

    Raises
    ------
    OutputError
        If the folder cannot be written.
    """
    settings = PhotoSetOptions() if options is None else options
    rng = np.random.default_rng(seed)
    bench = Bench.build(
        settings.width_px, settings.height_px, settings.laser_irradiance, settings.skew_rad
    )
    album = _Album(folder, settings.n_camera + 2 * settings.n_laser + 2, progress)
    camera_boards = []
    for k, place in enumerate(CAMERA_PLACES[: settings.n_camera], start=1):
        image, board = bench.photograph_board(place, rng)
        album.add(f"camera/{k:02d}.png", image)
        camera_boards.append(board)
    laser_boards, stripes = [], []
    for k, place in enumerate(LASER_PLACES[: settings.n_laser], start=1):
        on, off, board, stripe = bench.photograph_stripe(place, rng)
        album.add(f"laser/on/{k:02d}.png", on)
        album.add(f"laser/off/{k:02d}.png", off)
        laser_boards.append(board)
        stripes.append(stripe)
    on, off, body, body_stripe = bench.photograph_object(rng)
    album.add("object/laser.png", on)
    album.add("object/background.png", off)
    truth = PhotoSetTruth(
        seed=seed,
        target=TARGET,
        camera=bench.camera,
        laser=bench.laser,
        camera_boards=tuple(camera_boards),
        laser_boards=tuple(laser_boards),
        laser_stripes=tuple(stripes),
        body=body,
        body_stripe=body_stripe,
    )
    write_truth(folder / "truth.json", truth)
    return truth


@dataclass(slots=True)
class _Album:
    """Writes photos and counts them."""

    folder: Path
    total: int
    progress: Report | None
    names: list[str] = field(default_factory=list)

    def add(self, name: str, image: ImageArray) -> None:
        """Write one photo, red first, as PNG; whole or not at all."""
        stored = image if image.ndim == 2 else image[..., ::-1]
        is_encoded, content = cv2.imencode(".png", stored)
        if not is_encoded:
            raise InputError("the photo cannot be encoded as PNG", where=name)
        write_whole(self.folder / name, content.tobytes())
        self.names.append(name)
        if self.progress is not None:
            self.progress(len(self.names), self.total, name)
