# SPDX-License-Identifier: Apache-2.0
"""Photographs of prints, also of those that the twin does not hold before its heads: chessboards
and ChArUco boards.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.poses import Pose
from armscan.simulation.objects.boards import (
    FLAT,
    FlatPattern,
    PrintedBoard,
    Substrate,
    print_reflectance,
)
from armscan.simulation.optics.camera import RenderCamera


@dataclass(frozen=True, slots=True)
class ChessboardPattern:
    """Chessboard of ``columns`` x ``rows`` inner corners; the square at (-x, -y) is dark."""

    columns: int
    rows: int
    square_mm: float

    @property
    def marks_board_mm(self) -> FloatArray:
        """(N, 3) inner corners, row by row."""
        j, i = np.mgrid[: self.rows, : self.columns]
        return np.stack([i, j, 0 * i], axis=-1).reshape(-1, 3) * self.square_mm

    @property
    def extent_board_mm(self) -> tuple[float, float, float, float]:
        """One square and a half around the outermost inner corners: the rim is light."""
        margin = 1.5 * self.square_mm
        right, bottom = (self.columns - 1) * self.square_mm, (self.rows - 1) * self.square_mm
        return -margin, -margin, right + margin, bottom + margin

    def is_light(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        """Tell the tone: by the parity of the square, light on the rim."""
        i, j = np.floor(x_mm / self.square_mm), np.floor(y_mm / self.square_mm)
        on_rim = (i < -1) | (j < -1) | (i >= self.columns) | (j >= self.rows)
        return np.asarray(on_rim | ((i + j) % 2 == 1))

    def edge_distance_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Distance to the nearest line of the squares' lattice."""
        return _lattice_distance(x_mm, y_mm, self.square_mm)


@dataclass(frozen=True, slots=True)
class CharucoPattern:
    """ChArUco board of ``columns`` x ``rows`` squares, as OpenCV 4.6 and later lays it out.

    The first square is dark, markers lie in the light squares, numbered row by row; the Board
    frame's origin is the outer corner of the first square.
    """

    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str

    @property
    def marks_board_mm(self) -> FloatArray:
        """(N, 3) inner corners, row by row."""
        j, i = np.mgrid[1 : self.rows, 1 : self.columns]
        return np.stack([i, j, 0 * i], axis=-1).reshape(-1, 3) * self.square_mm

    @property
    def extent_board_mm(self) -> tuple[float, float, float, float]:
        """Half a square around the squares: the rim is light."""
        margin = 0.5 * self.square_mm
        width, height = self.columns * self.square_mm, self.rows * self.square_mm
        return -margin, -margin, width + margin, height + margin

    def is_light(self, x_mm: FloatArray, y_mm: FloatArray) -> BoolArray:
        """Tell the tone: by the square's parity, then by the marker's bit."""
        i, j = np.floor(x_mm / self.square_mm), np.floor(y_mm / self.square_mm)
        on_rim = (i < 0) | (j < 0) | (i >= self.columns) | (j >= self.rows)
        light = np.asarray(on_rim | ((i + j) % 2 == 1))
        cells = self._marker_cells()
        offset, cell = self._marker_lattice(cells.shape[1])
        inner_x, inner_y = x_mm - i * self.square_mm - offset, y_mm - j * self.square_mm - offset
        marked = light & ~on_rim & (np.minimum(inner_x, inner_y) >= 0.0)
        marked &= np.maximum(inner_x, inner_y) < self.marker_mm
        last = cells.shape[1] - 1
        a = np.minimum(inner_x[marked] / cell, last).astype(np.int64)
        b = np.minimum(inner_y[marked] / cell, last).astype(np.int64)
        number = (j[marked] * self.columns + i[marked]).astype(np.int64) // 2
        light[marked] = cells[number, b, a]
        return light

    def edge_distance_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Distance to the nearest line of the squares' or the markers' lattice."""
        squares = _lattice_distance(x_mm, y_mm, self.square_mm)
        offset, cell = self._marker_lattice(self._marker_cells().shape[1])
        inner_x = np.mod(x_mm, self.square_mm) - offset
        inner_y = np.mod(y_mm, self.square_mm) - offset
        outside = (
            np.maximum(
                np.abs(inner_x - 0.5 * self.marker_mm), np.abs(inner_y - 0.5 * self.marker_mm)
            )
            - 0.5 * self.marker_mm
        )
        cells = np.maximum(_lattice_distance(inner_x, inner_y, cell), outside)
        parity = np.floor(x_mm / self.square_mm) + np.floor(y_mm / self.square_mm)
        return np.where(parity % 2 == 1, np.minimum(squares, cells), squares)

    def _marker_lattice(self, n_cells: int) -> tuple[float, float]:
        return 0.5 * (self.square_mm - self.marker_mm), self.marker_mm / n_cells

    def _marker_cells(self) -> BoolArray:
        code = getattr(cv2.aruco, self.dictionary, None)
        if not isinstance(code, int):
            raise InputError(f"{self.dictionary} is no ArUco dictionary of OpenCV")
        dictionary = cv2.aruco.getPredefinedDictionary(code)
        side = dictionary.markerSize + 2
        count = (self.columns * self.rows) // 2
        cells = [dictionary.generateImageMarker(k, side) > 127 for k in range(count)]
        return np.array(cells)


def _lattice_distance(x_mm: FloatArray, y_mm: FloatArray, step_mm: float) -> FloatArray:
    dx = np.abs(x_mm - step_mm * np.rint(x_mm / step_mm))
    dy = np.abs(y_mm - step_mm * np.rint(y_mm / step_mm))
    return np.minimum(dx, dy)


@dataclass(frozen=True, slots=True)
class Lighting:
    """Grey levels of the print (8-bit scale: 255 is full scale).

    Parameters
    ----------
    light_level, dark_level
        Levels of the two tones where the illumination is full.
    surround
        Reflectance beyond the print, between the two tones.
    gradient
        Fraction of the illumination lost from one border of the image to the opposite one.
    gradient_azimuth_rad
        Direction in the image along which it gets darker; 0 is to the right.
    """

    light_level: float = 200.0
    dark_level: float = 40.0
    surround: float = 1.0
    gradient: float = 0.0
    gradient_azimuth_rad: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class RenderedTarget:
    """A rendered image with its truth.

    Parameters
    ----------
    image
        (H, W) grey levels without noise.
    marks_px
        (N, 2) true projections of the pattern's marks.
    """

    image: FloatArray
    marks_px: FloatArray


def render_flat_target(
    camera: RenderCamera,
    pattern: FlatPattern,
    rotation: FloatArray,
    translation_mm: FloatArray,
    lighting: Lighting | None = None,
    *,
    substrate: Substrate = FLAT,
) -> RenderedTarget:
    """Render a print seen by a camera.

    Parameters
    ----------
    camera
        Lens, sensor and blur.
    pattern
        The print.
    rotation, translation_mm
        (3, 3) and (3,): ``camera_from_board``.
    lighting
        Grey levels and illumination.
    substrate
        Paper and bow.

    Raises
    ------
    InputError
        If the camera looks at the back of the print.
    """
    light = Lighting() if lighting is None else lighting
    board = PrintedBoard(pattern, Pose(rotation, translation_mm), substrate=substrate)
    span = light.light_level - light.dark_level
    reflectance = print_reflectance(board, camera, light.surround)
    levels = light.dark_level + span * reflectance.astype(np.float64)
    marks = pattern.marks_board_mm.copy()
    marks[:, 2] += substrate.height_mm(pattern, marks[:, 0], marks[:, 1])
    return RenderedTarget(
        levels * illumination(camera, light),
        camera.project(board.sensor_from_board.apply(marks)),
    )


def illumination(camera: RenderCamera, lighting: Lighting) -> FloatArray:
    """Return the relative illumination (H, W), 1 where it is full."""
    if lighting.gradient == 0.0:
        return np.broadcast_to(1.0, (camera.height_px, camera.width_px))
    u = (np.arange(camera.width_px) / max(camera.width_px - 1, 1))[None, :] - 0.5
    v = (np.arange(camera.height_px) / max(camera.height_px - 1, 1))[:, None] - 0.5
    cosine, sine = np.cos(lighting.gradient_azimuth_rad), np.sin(lighting.gradient_azimuth_rad)
    along = (u * cosine + v * sine) / (abs(cosine) + abs(sine))
    return np.asarray(1.0 - lighting.gradient * (along + 0.5))
