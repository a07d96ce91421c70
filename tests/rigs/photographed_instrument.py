# SPDX-License-Identifier: Apache-2.0
"""Instruments drawn at random, to be photographed with.

Nothing here is of a head of the thesis: fields of 20 to 400 mm, any triangulation angle, lines of
any width and section, prints with errors, bowed boards, arms of any size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Plate, Pose, Sensor, Tool
from armscan.geometry.rotations import rotation_from_vector
from armscan.simulation.head import Head, MountedCamera, Window
from armscan.simulation.objects.boards import CirclePattern, FlatPattern, Substrate
from armscan.simulation.objects.shapes import FlatPlate
from armscan.simulation.optics.camera import Detector, RenderCamera
from armscan.simulation.optics.lasers import LineLaser, Section
from armscan.simulation.optics.render import Imaging, Speckle
from armscan.simulation.optics.scene import (
    Sphere,
)
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

    def arm_scatter_mm(self) -> float:
        """Rms an axis of what the arm's poses move a point at the working distance by."""
        point = self.head.tool_from_sensor.apply(np.array([[0.0, 0.0, self.depth_mm]]))
        away_mm = float(np.linalg.norm(point))
        return float(np.hypot(self.arm_mm, np.sqrt(2.0 / 3.0) * self.arm_rad * away_mm))


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
