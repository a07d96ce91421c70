# SPDX-License-Identifier: Apache-2.0
"""Printed boards: circle grids, chessboards and ChArUco boards as functions of the place on the
board.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.simulation.optics.scene import MISS


class FlatPattern(Protocol):
    """What the renderer asks of a print."""

    @property
    def marks_board_mm(self) -> FloatArray:
        """(N, 3) true marks: circle centres or corners, row by row."""

    @property
    def extent_board_mm(self) -> tuple[float, float, float, float]:
        """Print's rectangle ``x_min, y_min, x_max, y_max``; beyond it lies the surround."""

    def is_light(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        """Tell the tone at points inside the print."""

    def edge_distance_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Return a distance to the nearest edge that is never larger than the true one."""


@dataclass(frozen=True, slots=True)
class CirclePattern:
    """Grid of discs, ``diameter_mm`` across; an asymmetric grid shifts odd rows by one pitch.

    As in OpenCV, ``pitch_mm`` of an asymmetric grid is the distance between rows, and half the
    distance between neighbours in a row. ``misplaced_mm`` holds, row by row, by how much each disc
    missed its place (x, y) when it was made; empty for an exact print.
    """

    columns: int
    rows: int
    pitch_mm: float
    diameter_mm: float
    is_asymmetric: bool = False
    is_light_on_dark: bool = False
    margin_mm: float | None = None
    misplaced_mm: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        if len(self.misplaced_mm) not in (0, self.columns * self.rows):
            raise InputError(
                f"{len(self.misplaced_mm)} displacements for {self.columns * self.rows} discs"
            )

    @property
    def marks_board_mm(self) -> FloatArray:
        """(N, 3) centres, row by row."""
        step = self._step_mm
        marks = [
            (column * step + self._row_shift_mm(row), row * self.pitch_mm, 0.0)
            for row in range(self.rows)
            for column in range(self.columns)
        ]
        centres = np.array(marks)
        centres[:, :2] += self._shifts_mm
        return centres

    @property
    def extent_board_mm(self) -> tuple[float, float, float, float]:
        """One pitch around the outermost centres unless ``margin_mm`` says otherwise."""
        margin = self.pitch_mm if self.margin_mm is None else self.margin_mm
        right = (self.columns - 1) * self._step_mm + (self.pitch_mm if self.is_asymmetric else 0.0)
        return -margin, -margin, right + margin, (self.rows - 1) * self.pitch_mm + margin

    def is_light(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        """Tell the tone: inside a disc or not."""
        is_inside = self._radius_squared(x_mm, y_mm) < 0.25 * self.diameter_mm**2
        return is_inside if self.is_light_on_dark else ~is_inside

    def edge_distance_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Distance to the rim of the disc in whose cell the point lies."""
        return np.abs(np.sqrt(self._radius_squared(x_mm, y_mm)) - 0.5 * self.diameter_mm)

    @property
    def _step_mm(self) -> float:
        return (2.0 if self.is_asymmetric else 1.0) * self.pitch_mm

    def _row_shift_mm(self, row: int) -> float:
        return self.pitch_mm if self.is_asymmetric and row % 2 else 0.0

    def _radius_squared(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        row = np.clip(np.rint(y_mm / self.pitch_mm), 0, self.rows - 1)
        shift = self.pitch_mm * (row % 2) if self.is_asymmetric else 0.0
        column = np.clip(np.rint((x_mm - shift) / self._step_mm), 0, self.columns - 1)
        dx = x_mm - shift - column * self._step_mm
        dy = y_mm - row * self.pitch_mm
        if self.misplaced_mm:
            missed = self._shifts_mm[(row * self.columns + column).astype(np.int64)]
            dx, dy = dx - missed[..., 0], dy - missed[..., 1]
        return np.asarray(dx * dx + dy * dy)

    @property
    def _shifts_mm(self) -> FloatArray:
        if not self.misplaced_mm:
            return np.zeros((self.columns * self.rows, 2))
        return np.array(self.misplaced_mm)


@dataclass(frozen=True, slots=True, eq=False)
class PrintedBoard:
    """A flat print somewhere in the scene, seen from its front only.

    Parameters
    ----------
    pattern
        The print.
    sensor_from_board
        Where it is; its z axis points away from the camera.
    light, dark
        Albedo of the two tones, for every colour.
    edge_mm
        Width over which a sample averages the two tones: about the size of a sample's footprint.
    """

    pattern: FlatPattern
    sensor_from_board: Pose[Sensor, Board]
    light: float = 0.85
    dark: float = 0.08
    edge_mm: float = 0.1

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`."""
        normal = -self.sensor_from_board.rotation[:, 2]
        along = directions @ normal
        height = (origins_mm - self.sensor_from_board.translation_mm) @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where((along < 0.0) & (height > 0.0), -height / along, np.nan)
        points = origins_mm + distance[:, None] * directions
        return np.where(self._is_on_print(self._on_board(points)), distance, MISS)

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return np.broadcast_to(-self.sensor_from_board.rotation[:, 2], points_mm.shape)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        board = self._on_board(points_mm)
        x, y = board[:, 0], board[:, 1]
        side = np.where(self.pattern.is_light(x, y), 1.0, -1.0)
        signed = side * self.pattern.edge_distance_mm(x, y)
        share = np.clip(0.5 + signed / self.edge_mm, 0.0, 1.0)
        albedo = self.dark + (self.light - self.dark) * share
        return np.repeat(albedo[:, None], 3, axis=1)

    def _on_board(self, points_mm: FloatArray) -> FloatArray:
        pose = self.sensor_from_board
        return np.asarray((points_mm - pose.translation_mm) @ pose.rotation)

    def _is_on_print(self, board_mm: FloatArray) -> BoolArray:
        x_min, y_min, x_max, y_max = self.pattern.extent_board_mm
        x, y = board_mm[:, 0], board_mm[:, 1]
        return np.asarray((x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max))
