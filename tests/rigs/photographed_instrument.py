# SPDX-License-Identifier: Apache-2.0
"""Instruments drawn at random, and what somebody who has one photographs with it.

Nothing here is of a head of the thesis: fields of 20 to 400 mm, any triangulation angle, lines of
any width and section, prints with errors, bowed boards, arms of any size. The truth stays in
memory; what is written is what a user has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray, ImageArray
from armscan.geometry.poses import Base, Board, Plate, Pose, Sensor, Tool
from armscan.geometry.rotations import rotation_from_vector
from armscan.simulation.head import Head, MountedCamera, Window
from armscan.simulation.objects.boards import CirclePattern, FlatPattern, Substrate
from armscan.simulation.objects.shapes import FlatPlate, Placed
from armscan.simulation.optics.camera import Detector, RenderCamera
from armscan.simulation.optics.lasers import LineLaser, Section
from armscan.simulation.optics.render import Imaging, Speckle
from armscan.simulation.optics.scene import (
    CERAMIC,
    MATT_PAINT,
    Floor,
    RoomLight,
    SceneObject,
    Sphere,
)
from armscan.simulation.station import ExposureSettings, Station, Target, render_exposure
from rigs.flat_prints import ChessboardPattern

SIZES = (*[(640, 480)] * 5, *[(800, 600)] * 3, (1024, 768), (1280, 960), (1600, 1200))
BACKGROUND_SHARE = 3.0
TIP_MM = 6.0
Degenerate = Literal["", "parallel boards", "boards at one depth", "parallel postures"]


@dataclass(frozen=True, slots=True)
class MisruledChessboard(ChessboardPattern):
    """A chessboard whose lines missed their places: ``columns + 2`` shifts along x, then y, mm."""

    missed_x_mm: tuple[float, ...] = ()
    missed_y_mm: tuple[float, ...] = ()

    @property
    def marks_board_mm(self) -> FloatArray:
        """(N, 3) true inner corners, row by row."""
        x, y = self._lines(self.missed_x_mm), self._lines(self.missed_y_mm)
        mesh_x, mesh_y = np.meshgrid(x[1:-1], y[1:-1])
        return np.stack([mesh_x, mesh_y, 0.0 * mesh_x], axis=-1).reshape(-1, 3)

    def is_light(self, x_mm: FloatArray, y_mm: FloatArray) -> np.ndarray:
        """Tell the tone by the lines as they are."""
        i = np.searchsorted(self._lines(self.missed_x_mm), x_mm, side="right")
        j = np.searchsorted(self._lines(self.missed_y_mm), y_mm, side="right")
        on_rim = (i == 0) | (j == 0) | (i > self.columns + 1) | (j > self.rows + 1)
        return np.asarray(on_rim | ((i + j) % 2 == 1))

    def edge_distance_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Distance to the nearest line."""
        return np.minimum(
            _nearest_mm(self._lines(self.missed_x_mm), x_mm),
            _nearest_mm(self._lines(self.missed_y_mm), y_mm),
        )

    def _lines(self, missed_mm: Sequence[float]) -> FloatArray:
        return self.square_mm * np.arange(-1, len(missed_mm) - 1) + np.asarray(missed_mm)


def _nearest_mm(lines: FloatArray, x_mm: FloatArray) -> FloatArray:
    after = np.clip(np.searchsorted(lines, x_mm), 1, len(lines) - 1)
    return np.minimum(np.abs(x_mm - lines[after - 1]), np.abs(x_mm - lines[after]))


@dataclass(frozen=True, slots=True, eq=False)
class DrawnInstrument:
    """One instrument, its target and its surroundings; all of it truth.

    Parameters
    ----------
    seed
        From which it was drawn.
    head
        Cameras and sheets.
    pattern, substrate, target
        The print as it is, and what the user takes it for.
    field_mm, depth_mm
        Width of the field at the working distance.
    arm_mm, arm_rad
        Scatter of the arm's poses: position along each axis, rotation about each.
    plate, base_from_plate, ball
        What is scanned.
    laser_light
        Room light while a line is photographed on the target.
    has_off
        Whether the target is photographed once more without laser.
    degenerate
        What of it must be refused, if anything.
    facts
        All drawn numbers, for tables.
    """

    seed: int
    head: Head
    pattern: FlatPattern
    substrate: Substrate
    target: str
    field_mm: float
    depth_mm: float
    arm_mm: float
    arm_rad: float
    plate: FlatPlate
    base_from_plate: Pose[Base, Plate]
    ball: Sphere
    laser_light: float
    has_off: bool
    degenerate: Degenerate
    facts: dict[str, Any]

    @property
    def colour(self) -> bool:
        """Whether its cameras see colours."""
        return self.head.imaging.laser_colour is not None


def draw_instrument(seed: int) -> DrawnInstrument:
    """Draw one instrument; everything follows from the seed."""
    rng = np.random.default_rng([seed, 1100])
    while True:
        field_mm = float(np.exp(rng.uniform(np.log(20.0), np.log(400.0))))
        depth_mm = float(np.exp(rng.uniform(np.log(60.0), np.log(600.0))))
        if 0.2 < field_mm / depth_mm < 1.1:
            break
    width, height = SIZES[rng.integers(len(SIZES))]
    if rng.uniform() < 0.04:
        width, height = 2448, 2048
    n_cameras = 2 if rng.uniform() < 0.35 else 1
    imaging, light_facts = _draw_imaging(rng)
    cameras = _draw_cameras(rng, n_cameras, (width, height), field_mm, depth_mm)
    lasers, line_facts = _draw_lasers(rng, cameras[0].camera, n_cameras, depth_mm, imaging)
    turn = rotation_from_vector(rng.uniform(-1.0, 1.0, 3) * np.pi / 2)
    tool_from_sensor: Pose[Tool, Sensor] = Pose(turn, rng.uniform(-150.0, 150.0, 3))
    head = Head("drawn", cameras, lasers, tool_from_sensor, imaging)
    pattern, substrate, target, board_facts = _draw_board(rng, field_mm, width / field_mm)
    arm_mm = float(np.exp(rng.uniform(np.log(0.005), np.log(0.2))))
    lever_mm = float(np.exp(rng.uniform(np.log(30.0), np.log(300.0))))
    plate_size = 2.5 * field_mm
    flatness = float(np.exp(rng.uniform(np.log(0.003), np.log(0.06))))
    level = rotation_from_vector(0.05 * rng.standard_normal(3))
    base_from_plate: Pose[Base, Plate] = Pose(
        level, np.array([500.0, -120.0, 80.0]) + 60.0 * rng.uniform(-1.0, 1.0, 3)
    )
    ball_mm = float(field_mm * rng.uniform(0.3, 0.5))
    degenerate: Degenerate = ""
    if rng.uniform() < 0.1:
        degenerate = ("parallel boards", "boards at one depth", "parallel postures")[
            rng.integers(3)
        ]
    has_off = bool(rng.uniform() < 0.75)
    laser_light = float(rng.uniform(0.0, 0.1) if has_off else rng.uniform(0.3, 0.5))
    facts = {
        "field_mm": field_mm,
        "depth_mm": depth_mm,
        "image_px": [width, height],
        "cameras": n_cameras,
        "target": target,
        "arm_mm": arm_mm,
        "lever_mm": lever_mm,
        "flatness_mm": flatness,
        "ball_mm": ball_mm,
        "has_off": has_off,
        "laser_light": laser_light,
        "degenerate": degenerate,
        **light_facts,
        **line_facts,
        **board_facts,
    }
    return DrawnInstrument(
        seed=seed,
        head=head,
        pattern=pattern,
        substrate=substrate,
        target=target,
        field_mm=field_mm,
        depth_mm=depth_mm,
        arm_mm=arm_mm,
        arm_rad=arm_mm / lever_mm,
        plate=FlatPlate.draw((plate_size, plate_size), flatness, rng, (0.8, 0.8, 0.8)),
        base_from_plate=base_from_plate,
        ball=Sphere(base_from_plate.translation_mm, 0.5 * ball_mm, (0.8, 0.8, 0.8)),
        laser_light=laser_light,
        has_off=has_off,
        degenerate=degenerate,
        facts=facts,
    )


def _draw_imaging(rng: np.random.Generator) -> tuple[Imaging, dict[str, Any]]:
    """Noise, bits, colour and the brightness of the lines."""
    bits = int(rng.choice([8, 8, 8, 10, 12]))
    colour = None
    if rng.uniform() < 0.3:
        colour = ((1.0, 0.08, 0.03), (0.05, 1.0, 0.1), (0.04, 0.12, 1.0))[rng.integers(3)]
    level = float(rng.choice([0.25, 0.45, 0.8, 0.8, 1.2, 2.0]))
    detector = Detector(
        bits=bits,
        electrons_per_level=float(rng.uniform(20.0, 200.0)),
        read_noise=float(rng.uniform(0.4, 1.6)),
        halo_share=float(rng.uniform(0.0, 0.04)),
    )
    speckle = Speckle(float(rng.uniform(0.05, 0.4)), float(rng.uniform(0.3, 1.0)))
    imaging = Imaging(
        laser_level=level,
        ambient=float(rng.uniform(0.0, 0.06)),
        target_light=float(rng.uniform(0.5, 0.95)),
        speckle=speckle,
        detector=detector,
        laser_colour=colour,
        spot_level=0.0,
        stray_share=0.0,
    )
    facts = {
        "bits": bits,
        "colour": "mono" if colour is None else "rgb"[int(np.argmax(colour))] + " laser",
        "laser_level": level,
        "electrons_per_level": detector.electrons_per_level,
        "speckle": speckle.contrast,
    }
    return imaging, facts


def _draw_cameras(
    rng: np.random.Generator,
    count: int,
    size_px: tuple[int, int],
    field_mm: float,
    depth_mm: float,
) -> tuple[MountedCamera, ...]:
    """Camera 0 looks along z; a second one looks at the same place from the side."""
    width, height = size_px
    aim = np.array([0.0, 0.0, depth_mm])
    angle = np.radians(rng.uniform(15.0, 40.0)) * rng.choice([-1.0, 1.0])
    mounted = []
    for k in range(count):
        focal = width * depth_mm / field_mm * rng.uniform(0.97, 1.03)
        corner = np.hypot(0.5 * width, 0.5 * height) / focal
        k1 = rng.uniform(-0.06, 0.03) / corner**2
        k2 = rng.uniform(-0.015, 0.015) / corner**4
        camera = RenderCamera(
            fx=focal,
            fy=focal * rng.uniform(0.998, 1.002),
            cx=0.5 * (width - 1) + 0.015 * width * rng.standard_normal(),
            cy=0.5 * (height - 1) + 0.015 * width * rng.standard_normal(),
            k1=k1,
            k2=k2,
            p1=3e-4 * rng.standard_normal() / corner,
            p2=3e-4 * rng.standard_normal() / corner,
            width_px=width,
            height_px=height,
            blur_sigma_px=float(rng.uniform(0.5, 1.2)),
        )
        pose: Pose[Any, Sensor] = Pose(np.eye(3), np.zeros(3))
        if k == 1:
            turn = rotation_from_vector(np.array([0.03 * rng.standard_normal(), angle, 0.0]))
            away = aim - turn[:, 2] * depth_mm * rng.uniform(0.97, 1.03)
            here: Pose[Sensor, Any] = Pose(turn, away)
            pose = here.inverse()
        mounted.append(MountedCamera(camera, pose, Window(0, 0, width, height)))
    return tuple(mounted)


def _draw_lasers(
    rng: np.random.Generator,
    camera: RenderCamera,
    n_cameras: int,
    depth_mm: float,
    imaging: Imaging,
) -> tuple[tuple[LineLaser, ...], dict[str, Any]]:
    """One line, crossed lines of a source each, or lines of one source side by side."""
    is_many = n_cameras == 2 and rng.uniform() < 0.6
    crossed = 1 if rng.uniform() < 0.6 else int(rng.integers(2, 4))
    sigma_px = float(np.exp(rng.uniform(np.log(0.75), np.log(3.0 if is_many else 8.0))))
    section = Section()
    if rng.uniform() < 0.7:
        section = Section(
            skew=float(rng.uniform(-0.4, 0.4)),
            tail_low=float(rng.uniform(0.0, 0.15)),
            tail_high=float(rng.uniform(0.0, 0.15)),
            tail_sigmas=float(rng.uniform(1.5, 2.5)),
        )
    pixel_mm = depth_mm / camera.fx
    first = rng.uniform(0.0, np.pi)
    lasers = []
    angles_deg = []
    for k in range(1 if is_many else crossed):
        angle = np.radians(rng.uniform(15.0, 50.0))
        along = first + k * np.pi / crossed + rng.uniform(-0.2, 0.2) * (crossed > 1)
        across = np.array([np.cos(along), np.sin(along), 0.0])
        forward = rotation_from_vector(angle * across) @ np.array([0.0, 0.0, 1.0])
        distance = depth_mm * rng.uniform(0.85, 1.1) / np.cos(angle)
        blur = np.hypot(camera.blur_sigma_px, 0.3)
        sheet_px = np.sqrt(max(sigma_px**2 - blur**2, 0.3**2))
        thickness = sheet_px * pixel_mm * np.cos(angle)
        half_field = 0.5 * camera.width_px * pixel_mm
        angles_deg.append(float(np.degrees(angle)))
        laser = LineLaser(
            "ABC"[k],
            np.array([0.0, 0.0, depth_mm]) - distance * forward,
            forward,
            across,
            half_angle_rad=float(np.arctan(1.8 * half_field / distance)),
            skew_rad=float(0.01 * rng.standard_normal()),
            waist_mm=float(thickness),
            waist_distance_mm=float(distance),
            divergence_rad=float(0.3 * thickness / distance),
            irradiance=imaging.laser_level,
            falloff=0.3,
            section=section,
        )
        lasers.append(laser)
    count = len(lasers)
    if is_many:
        count = int(rng.integers(3, 8))
        lasers = _side_by_side(lasers[0], count, camera.height_px * pixel_mm)
    facts = {
        "lines": count,
        "sources": 1 if is_many else crossed,
        "sigma_px": sigma_px,
        "angle_deg": angles_deg,
        "skew": section.skew,
        "tails": [section.tail_low, section.tail_high, section.tail_sigmas],
    }
    return tuple(lasers), facts


def _side_by_side(laser: LineLaser, count: int, room_mm: float) -> list[LineLaser]:
    """Sheets about the line through the source along which the fan spreads."""
    step = np.arctan(0.45 * room_mm / (count * laser.waist_distance_mm))
    lines = []
    for k in range(count):
        turn = rotation_from_vector((k - 0.5 * (count - 1)) * step * laser.across)
        lines.append(replace(laser, name=f"A.{k + 1}", source="A", forward=turn @ laser.forward))
    return lines


def _draw_board(
    rng: np.random.Generator, field_mm: float, px_per_mm: float
) -> tuple[FlatPattern, Substrate, str, dict[str, Any]]:
    """Print of about half the field: its true marks, its paper, and what it is sold as."""
    columns, rows = int(rng.integers(8, 12)), int(rng.integers(6, 9))
    if columns == rows:
        columns += 1
    pitch = float(f"{field_mm * rng.uniform(0.5, 0.65) / columns:.2g}")
    scale = 1.0 + float(rng.choice([0.0, 1e-4]) * rng.standard_normal())
    missed = float(rng.uniform(0.005, 0.03)) * min(1.0, field_mm / 150.0)
    if rng.uniform() < 0.4:
        missed = 0.0
    is_chess = bool(rng.uniform() < 0.5)
    if is_chess:
        shifts = missed * rng.standard_normal(columns + rows + 4)
        pattern: FlatPattern = MisruledChessboard(
            columns,
            rows,
            pitch * scale,
            tuple(shifts[: columns + 2].tolist()),
            tuple(shifts[columns + 2 :].tolist()),
        )
        word = "chessboard"
    else:
        shifts2 = missed * rng.standard_normal((columns * rows, 2))
        pattern = CirclePattern(
            columns,
            rows,
            pitch * scale,
            0.55 * pitch,
            is_light_on_dark=bool(rng.uniform() < 0.15),
            misplaced_mm=tuple((float(x), float(y)) for x, y in shifts2),
        )
        word = "circle-grid"
    spread = 0.0 if rng.uniform() < 0.4 else float(rng.uniform(0.2, 1.2)) / px_per_mm
    size = columns * pitch
    bow = (0.0, 0.0)
    if rng.uniform() < 0.4:
        bow_mm = rng.uniform(0.05, 0.5) * min(1.0, (size / 200.0) ** 2)
        bow = (float(bow_mm * rng.choice([-1, 1])), float(0.3 * bow_mm * rng.uniform(-1, 1)))
    facts = {
        "misprint_mm": missed,
        "scale_error": scale - 1.0,
        "spread_px": spread * px_per_mm,
        "bow_mm": bow,
        "board_mm": size,
    }
    return (
        pattern,
        Substrate(spread_mm=spread, bow_mm=bow),
        f"{word}:{columns}x{rows}:{pitch:g}",
        facts,
    )


# -- what is photographed ---------------------------------------------------------------------

LAMP = RoomLight(even=0.7, direct=0.3, position_mm=(300.0, -400.0, -100.0), up=(0.0, 0.0, -1.0))


@dataclass(slots=True)
class Photographer:
    """Takes photographs with one instrument; its numbers follow from the seed."""

    drawn: DrawnInstrument
    rng: np.random.Generator = field(init=False)
    n_images: int = 0

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng([self.drawn.seed, 2200])

    def board_pose(
        self, tilt_deg: float, place: tuple[float, float], depth_share: float, roll_deg: float
    ) -> Pose[Sensor, Board]:
        """Place of the board, moved inward until every camera sees all marks."""
        d = self.drawn
        azimuth = self.rng.uniform(0.0, 2.0 * np.pi)
        axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        tilt = rotation_from_vector(np.radians(tilt_deg) * axis)
        roll = rotation_from_vector(np.array([0.0, 0.0, np.radians(roll_deg)]))
        rotation = tilt @ roll
        marks = d.pattern.marks_board_mm
        middle = marks.mean(axis=0)
        depth = d.depth_mm * depth_share
        half = 0.5 * d.field_mm * depth_share
        aspect = d.head.camera.height_px / d.head.camera.width_px
        for share in np.linspace(1.0, 0.0, 9):
            for farther in (1.0, 1.06, 1.12, 1.2, 1.3) if share == 0.0 else (1.0,):
                spot = np.array(
                    [share * place[0] * half, share * place[1] * half * aspect, depth * farther]
                )
                pose: Pose[Sensor, Board] = Pose(rotation, spot - rotation @ middle)
                if self._is_seen(pose.apply(marks)):
                    return pose
        return pose

    def _is_seen(self, points_mm: FloatArray) -> bool:
        pitch = np.ptp(points_mm, axis=0).max() / 20.0
        for eye in self.drawn.head.cameras:
            seen = eye.camera.project(eye.camera_from_sensor.apply(points_mm))
            rim = 8.0 + pitch * eye.camera.fx / self.drawn.depth_mm
            size = np.array([eye.camera.width_px, eye.camera.height_px])
            if not bool(((seen > rim) & (seen < size - rim)).all()):
                return False
        return True

    def of_board(
        self, pose: Pose[Sensor, Board], lasers: tuple[str, ...], light: float, camera: int = 0
    ) -> ImageArray:
        """The board with some lasers on, in some light."""
        d = self.drawn
        target = Target(d.pattern, Pose(pose.rotation, pose.translation_mm), substrate=d.substrate)
        wall = Floor(
            np.array([0.0, 0.0, BACKGROUND_SHARE * d.depth_mm]),
            np.array([0.0, 0.0, -1.0]),
            (0.25, 0.25, 0.25),
        )
        station = Station((SceneObject("wall", wall),), target, LAMP)
        here: Pose[Base, Sensor] = Pose(np.eye(3), np.zeros(3))
        return self._expose(station, here, lasers, light, camera)

    def of_thing(
        self, thing: SceneObject, pose: Pose[Base, Sensor], lasers: tuple[str, ...], camera: int = 0
    ) -> ImageArray:
        """A thing in Base with some lasers on, in dim light."""
        return self._expose(Station((thing,)), pose, lasers, None, camera)

    def _expose(
        self,
        station: Station,
        pose: Pose[Base, Sensor],
        lasers: tuple[str, ...],
        light: float | None,
        camera: int,
    ) -> ImageArray:
        head = self.drawn.head
        window = head.cameras[camera].full_window
        settings = ExposureSettings(window, lasers, light)
        rng = np.random.default_rng([self.drawn.seed, 3300, self.n_images])
        self.n_images += 1
        return render_exposure(head, station, [pose], settings, rng, camera=camera)


def save_image(path: Path, image: ImageArray) -> None:
    """Write a PNG; colour in the order red, green, blue."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = image[..., ::-1] if image.ndim == 3 else image
    if not cv2.imwrite(str(path), pixels):
        raise OSError(f"cannot write {path}")


@dataclass(slots=True)
class RecordingWriter:
    """A folder recording, row by row.

    Parameters
    ----------
    folder
        Of the recording.
    drawn
        The instrument.
    kind
        Of the session.
    """

    folder: Path
    drawn: DrawnInstrument
    kind: str
    rows: list[str] = field(default_factory=list)
    arm: list[str] = field(default_factory=list)
    n_triggers: int = 0
    now_ns: int = 0

    def add(self, images: Sequence[ImageArray], lasers: tuple[str, ...], view: str) -> None:
        """All cameras' images of one instant."""
        self.n_triggers += 1
        self.now_ns += 1_000_000_000
        for camera, image in enumerate(images):
            name = f"images/{self.n_triggers:04d}-{camera}.png"
            save_image(self.folder / name, image)
            words = (len(self.rows), self.now_ns, camera, name, "+".join(lasers))
            self.rows.append(",".join(map(str, (*words, self.n_triggers, view))))

    def add_pose(self, pose: Pose[Base, Tool]) -> None:
        """What the arm reported at the last instant."""
        w, x, y, z = quaternion(pose.rotation)
        numbers = [*pose.translation_mm, w, x, y, z]
        cells = ",".join(f"{number:.12g}" for number in numbers)
        self.arm.append(f"{self.now_ns},{cells},{self.n_triggers}")

    def close(self) -> None:
        """Write the tables."""
        head = self.drawn.head
        camera = head.camera
        lines = [f'kind = "{self.kind}"']
        if self.arm:
            lines += ["[pose]", 'form = "quaternion"']
            lines += ["[time]", 'clock = "shared"']
        for _ in head.cameras:
            lines += [
                "[[camera]]",
                f"width_px = {camera.width_px}",
                f"height_px = {camera.height_px}",
                f"bits_used = {head.imaging.detector.bits}",
                f'colour = "{"rgb" if self.drawn.colour else "mono"}"',
            ]
        (self.folder / "session.toml").write_text("\n".join(lines) + "\n")
        table = "index,t_ns,camera,file,lasers,trigger_id,view\n"
        (self.folder / "exposures.csv").write_text(table + "\n".join(self.rows) + "\n")
        if self.arm:
            table = "t_ns,x_mm,y_mm,z_mm,qw,qx,qy,qz,trigger_id\n"
            (self.folder / "arm.csv").write_text(table + "\n".join(self.arm) + "\n")


def quaternion(rotation: FloatArray) -> FloatArray:
    """(4,) w, x, y, z of a rotation (3, 3), by the eigenvector of Bar-Itzhack's matrix."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return np.array([w, x, y, z])


# -- sets of photographs ----------------------------------------------------------------------

PLACES = (
    (0.0, 0.0),
    (-0.5, -0.5),
    (0.5, -0.5),
    (-0.5, 0.5),
    (0.5, 0.5),
    (0.0, 0.4),
    (0.4, 0.0),
    (-0.4, 0.0),
    (0.0, -0.4),
)


@dataclass(frozen=True, slots=True)
class Held:
    """Where the head or the ball truly was at each instant of a recording.

    Parameters
    ----------
    base_from_sensor
        By name of the image, of camera 0 and of camera 1.
    """

    base_from_sensor: dict[str, Pose[Base, Sensor]]


def photograph_camera_set(shoot: Photographer, folder: Path, count: int) -> None:
    """Views of the board for the cameras, in folders ``left`` and, with two, ``right``."""
    drawn, rng = shoot.drawn, shoot.rng
    for k in range(count):
        tilt = rng.uniform(0.0, 2.0) if drawn.degenerate == "parallel boards" else 0.0
        if drawn.degenerate != "parallel boards":
            tilt = rng.uniform(3.0, 10.0) if k % 4 == 0 else rng.uniform(18.0, 38.0)
        roll = 90.0 * (k % 4) + rng.uniform(-15.0, 15.0)
        share = rng.uniform(0.88, 1.2)
        pose = shoot.board_pose(tilt, PLACES[k % len(PLACES)], share, roll)
        for camera in range(len(drawn.head.cameras)):
            image = shoot.of_board(pose, (), drawn.head.imaging.target_light, camera)
            save_image(folder / ("left", "right")[camera] / f"{k + 1:02d}.png", image)


def laser_board_poses(shoot: Photographer, count: int) -> list[Pose[Sensor, Board]]:
    """Places of the board in the sheets, from near to far, about where the lines lie."""
    drawn, rng = shoot.drawn, shoot.rng
    half = np.array([0.5, 0.5 * drawn.head.camera.height_px / drawn.head.camera.width_px])
    poses = []
    for k in range(count):
        share = 0.88 + 0.24 * k / max(count - 1, 1)
        tilt = rng.uniform(5.0, 25.0)
        if drawn.degenerate == "boards at one depth":
            share, tilt = 1.0, rng.uniform(0.0, 0.3)
        depth = share * drawn.depth_mm
        middles = [
            laser.source_mm
            + (depth - laser.source_mm[2]) / laser.forward[2] * laser.forward
            + 0.2 * drawn.field_mm * rng.uniform(-1.0, 1.0) * laser.across
            for laser in drawn.head.lasers
        ]
        middle = middles[k % len(middles)] if len(drawn.head.sources) > 1 else np.mean(middles, 0)
        place = middle[:2] / (share * drawn.field_mm * half)
        if drawn.degenerate == "boards at one depth":
            place = np.zeros(2)
        poses.append(
            shoot.board_pose(
                tilt, (float(place[0]), float(place[1])), share, rng.uniform(-20.0, 20.0)
            )
        )
    return poses


def photograph_laser_set(shoot: Photographer, folder: Path, count: int) -> None:
    """One camera, one line: folders ``on`` and, where it is taken, ``off``."""
    drawn = shoot.drawn
    for k, pose in enumerate(laser_board_poses(shoot, count), start=1):
        on = shoot.of_board(pose, drawn.head.sources, drawn.laser_light)
        save_image(folder / "on" / f"{k:02d}.png", on)
        if drawn.has_off:
            off = shoot.of_board(pose, (), drawn.head.imaging.target_light)
            save_image(folder / "off" / f"{k:02d}.png", off)


def record_laser_set(shoot: Photographer, folder: Path, count: int) -> None:
    """Each source alone, then none, as a recording."""
    drawn = shoot.drawn
    writer = RecordingWriter(folder, drawn, "calibration")
    cameras = range(len(drawn.head.cameras))
    for k, pose in enumerate(laser_board_poses(shoot, count), start=1):
        states: list[tuple[tuple[str, ...], float]] = [
            ((source,), drawn.laser_light) for source in drawn.head.sources
        ]
        if drawn.has_off:
            states.append(((), drawn.head.imaging.target_light))
        for lasers, light in states:
            images = [shoot.of_board(pose, lasers, light, camera) for camera in cameras]
            writer.add(images, lasers, f"board-{k:02d}")
    writer.close()


def head_pose(
    shoot: Photographer, spot_mm: FloatArray, most_tilt_deg: float, depth_share: float
) -> Pose[Base, Sensor]:
    """Head that brings its aim to a place of Base, tilted and turned by chance.

    Every light and every camera meets the horizontal there at less than 65 degrees from upright.
    """
    drawn, rng = shoot.drawn, shoot.rng
    level = drawn.base_from_plate.rotation
    aim = np.array([0.0, 0.0, drawn.depth_mm * depth_share])
    down = np.diag([1.0, -1.0, -1.0])
    for _ in range(400):
        azimuth = rng.uniform(0.0, 2.0 * np.pi)
        tilt = np.radians(most_tilt_deg * np.sqrt(rng.uniform()))
        lean = rotation_from_vector(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
        roll = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        if drawn.degenerate == "parallel postures" and most_tilt_deg > 30.0:
            lean = rotation_from_vector(0.002 * rng.standard_normal(3))
            roll = np.eye(3)
        rotation = level @ lean @ roll @ down
        rays = [laser.forward for laser in drawn.head.lasers]
        rays += [eye.camera_from_sensor.rotation[2] for eye in drawn.head.cameras]
        upright = [-(rotation @ ray) @ level[:, 2] for ray in rays]
        if min(upright) > np.cos(np.radians(62.0)):
            break
    return Pose(rotation, spot_mm - rotation @ aim)


def _record_over(
    shoot: Photographer,
    writer: RecordingWriter,
    thing: SceneObject,
    poses: Sequence[Pose[Base, Sensor]],
    view: str,
) -> Held:
    """Expose a thing from each pose: one source after the other, or all before two cameras."""
    drawn, rng = shoot.drawn, shoot.rng
    sensor_from_tool = drawn.head.tool_from_sensor.inverse()
    cameras = range(len(drawn.head.cameras))
    together = len(cameras) > 1
    held: dict[str, Pose[Base, Sensor]] = {}
    for k, pose in enumerate(poses, start=1):
        error = rotation_from_vector(drawn.arm_rad * rng.standard_normal(3))
        true = pose @ sensor_from_tool
        shift = drawn.arm_mm * rng.standard_normal(3)
        told: Pose[Base, Tool] = Pose(error @ true.rotation, true.translation_mm + shift)
        for lasers in [drawn.head.sources] if together else [(s,) for s in drawn.head.sources]:
            images = [shoot.of_thing(thing, pose, lasers, camera) for camera in cameras]
            writer.add(images, lasers, f"{view}-{k:02d}")
            writer.add_pose(told)
            for camera in cameras:
                held[f"{writer.n_triggers:04d}-{camera}.png"] = pose
    writer.close()
    return Held(held)


def record_postures(shoot: Photographer, folder: Path, count: int) -> Held:
    """Postures over the plate for the hand-eye."""
    drawn, rng = shoot.drawn, shoot.rng
    rotation, origin = drawn.base_from_plate.rotation, drawn.base_from_plate.translation_mm
    poses = []
    for _ in range(count):
        on_plate = 0.35 * drawn.field_mm * rng.uniform(-1.0, 1.0, 2)
        spot = origin + rotation[:, :2] @ on_plate
        poses.append(head_pose(shoot, spot, 38.0, rng.uniform(0.92, 1.08)))
    writer = RecordingWriter(folder, drawn, "calibration")
    return _record_over(shoot, writer, plate_thing(drawn), poses, "posture")


def record_plate(shoot: Photographer, folder: Path, count: int) -> Held:
    """A short scan of the plate."""
    drawn = shoot.drawn
    rotation, origin = drawn.base_from_plate.rotation, drawn.base_from_plate.translation_mm
    poses = []
    for k in range(count):
        along = 0.6 * drawn.field_mm * (k / max(count - 1, 1) - 0.5)
        spot = origin + rotation[:, :2] @ np.array([along, 0.1 * along])
        poses.append(head_pose(shoot, spot, 20.0, shoot.rng.uniform(0.96, 1.04)))
    writer = RecordingWriter(folder, drawn, "scan")
    return _record_over(shoot, writer, plate_thing(drawn), poses, "pass")


def record_ball(shoot: Photographer, folder: Path, count: int) -> Held:
    """A short scan of the ball: lines across it from several sides."""
    drawn, rng = shoot.drawn, shoot.rng
    radius = drawn.ball.radius_mm
    up = drawn.base_from_plate.rotation[:, 2]
    poses = []
    for _ in range(count):
        aside = drawn.base_from_plate.rotation[:, :2] @ (0.5 * radius * rng.uniform(-1.0, 1.0, 2))
        spot = drawn.ball.centre_mm + 0.8 * radius * up + aside
        poses.append(head_pose(shoot, spot, 30.0, rng.uniform(0.97, 1.03)))
    writer = RecordingWriter(folder, drawn, "scan")
    return _record_over(shoot, writer, SceneObject("ball", drawn.ball, MATT_PAINT), poses, "pass")


def plate_thing(drawn: DrawnInstrument) -> SceneObject:
    """The plate where it lies."""
    return SceneObject("plate", Placed(drawn.plate, drawn.base_from_plate), CERAMIC)


def write_touches(shoot: Photographer, path: Path, count: int) -> None:
    """Centres of a tip that touched the plate, as the arm reported them."""
    drawn, rng = shoot.drawn, shoot.rng
    x, y = (0.7 * drawn.field_mm * rng.uniform(-1.0, 1.0, count) for _ in range(2))
    height = drawn.plate.height_mm(x, y)
    feet = np.stack([x, y, height + 0.5 * TIP_MM], axis=1)
    pose = drawn.base_from_plate
    centres = feet @ pose.rotation.T + pose.translation_mm
    centres += drawn.arm_mm * rng.standard_normal(centres.shape)
    lines = [f"# point = tip-centre, tip_diameter_mm = {TIP_MM:g}", "x_mm,y_mm,z_mm"]
    lines += [",".join(f"{number:.6f}" for number in centre) for centre in centres]
    path.write_text("\n".join(lines) + "\n")


def plate_distance_mm(drawn: DrawnInstrument, points_base_mm: FloatArray) -> FloatArray:
    """Signed distance (N,) of points (N, 3) in Base from the plate's true face."""
    pose = drawn.base_from_plate
    local = (points_base_mm - pose.translation_mm) @ pose.rotation
    return drawn.plate.distance_mm(local)
