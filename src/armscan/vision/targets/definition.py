# SPDX-License-Identifier: Apache-2.0
"""Calibration targets: what they are, and how they are named on the command line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from armscan.geometry.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class CircleGrid:
    """Grid of circles; ``is_asymmetric`` shifts every second row by half a pitch (as OpenCV)."""

    columns: int
    rows: int
    pitch_mm: float
    is_asymmetric: bool = False

    @property
    def points_board_mm(self) -> FloatArray:
        """(columns * rows, 3) circle centres in the Board frame, row by row."""
        j, i = np.mgrid[: self.rows, : self.columns]
        x = (2 * i + j % 2) * self.pitch_mm if self.is_asymmetric else i * self.pitch_mm
        return np.stack([x, j * self.pitch_mm, 0.0 * x], axis=-1).reshape(-1, 3)

    @property
    def size_mm(self) -> float:
        """The length whose wrong value scales every result."""
        return self.pitch_mm


@dataclass(frozen=True, slots=True)
class Chessboard:
    """Chessboard, counted in inner corners."""

    columns: int
    rows: int
    square_mm: float

    @property
    def points_board_mm(self) -> FloatArray:
        """(columns * rows, 3) inner corners in the Board frame, row by row."""
        j, i = np.mgrid[: self.rows, : self.columns]
        return np.stack([i, j, 0 * i], axis=-1).reshape(-1, 3) * self.square_mm

    @property
    def size_mm(self) -> float:
        """The length whose wrong value scales every result."""
        return self.square_mm


@dataclass(frozen=True, slots=True)
class Charuco:
    """ChArUco board, counted in squares; its points are the inner corners."""

    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str

    @property
    def points_board_mm(self) -> FloatArray:
        """((columns - 1) * (rows - 1), 3) inner corners in the Board frame, row by row."""
        j, i = np.mgrid[1 : self.rows, 1 : self.columns]
        return np.stack([i, j, 0 * i], axis=-1).reshape(-1, 3) * self.square_mm

    @property
    def size_mm(self) -> float:
        """The length whose wrong value scales every result."""
        return self.square_mm


Target: TypeAlias = CircleGrid | Chessboard | Charuco
