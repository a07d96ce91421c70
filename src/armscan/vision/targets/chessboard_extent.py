# SPDX-License-Identifier: Apache-2.0
"""Where does a chessboard end, and so which of its corners are those in view?

The border squares of a chessboard alternate, and beyond them lies a rim, a carrier or a table:
one tone. Where that is seen along a side, the outermost corners are the board's own, and the
count is known although another side is hidden or out of view. A hand or a sheet of paper
that covers corners does not end along a line of the squares and gives no such evidence.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.vision.targets.crossing_lattice import Lattice, cell_arrays, predict_cells
from armscan.vision.targets.crossings import Crossings
from armscan.vision.targets.grey import Grey32, sample

Side = Literal["ends", "may end", "continues", "unknown"]
"""What is seen beyond the outermost corners; "may end" where too few of them tell."""

SMALLEST = 3
"""Fewest columns and rows of corners that are taken for a chessboard."""
_MIN_FILLED = 0.6
"""Least fraction of its cells that an outermost row needs in order not to be tried without."""
_ALONG = (0.2, 0.35)
_WHOLE = 0.95
"""Least filled fraction of a rectangle that may be a whole board."""
_PROBES = (0.12, 0.2, 0.28)
"""Steps from the corners along both lines: near, so that what covers a board has to end within
this much of one of its lines in order to be taken for its end."""
_ALTERNATES = 0.5
"""Least difference between squares, of the difference beside them, that is one."""
_ONE_TONE = 0.35
"""Largest difference beyond the border squares that is none."""
_AGREEING = 0.7
_KNOWN = 0.6
_SUSPECT = 0.4
"""Fraction of the corners in view that must look like an end to make one possible."""


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """A rectangle of corners, as they lie in the image.

    Parameters
    ----------
    cells
        (N, 2) cells (a, b) of the corners found, from (0, 0); b lies clockwise of a.
    points_px
        (N, 2) their image points.
    size
        Counts along a and b.
    sides
        What is beyond: before the first and after the last a, before the first and after
        the last b.
    """

    cells: IntArray
    points_px: FloatArray
    size: tuple[int, int]
    sides: tuple[Side, Side, Side, Side]

    @property
    def is_whole(self) -> bool:
        """Tell whether the corners fill their rectangle and the board does not go on."""
        is_filled = len(self.cells) >= _WHOLE * self.size[0] * self.size[1]
        return is_filled and "continues" not in self.sides

    @property
    def counts(self) -> tuple[int, int]:
        """Counts along a and b, with one more for a side on which the board goes on."""
        more = [side == "continues" for side in self.sides]
        return self.size[0] + more[0] + more[1], self.size[1] + more[2] + more[3]


def extents(grey: Grey32, crossings: Crossings, lattice: Lattice) -> Iterator[Extent]:
    """Yield the rectangle of a lattice, then those without its sparse outermost rows.

    Parameters
    ----------
    grey
        (H, W) levels of the image in which the crossings were found.
    crossings
        All of the image.
    lattice
        Those that make a lattice.
    """
    cells, index = cell_arrays(lattice)
    while len(cells) and (np.ptp(cells, axis=0) + 1).min() >= SMALLEST:
        low = cells.min(axis=0)
        size = np.ptp(cells, axis=0) + 1
        placed = cells - low
        points = crossings.points_px[index]
        sides = _sides(grey, placed, points, size)
        yield Extent(placed, points, (int(size[0]), int(size[1])), sides)
        kept = _without_sparsest(placed, size)
        if kept is None:
            return
        cells, index = cells[kept], index[kept]


def _without_sparsest(cells: IntArray, size: IntArray) -> IntArray | None:
    """Rows of ``cells`` that remain without the emptiest outermost row; None if all are full."""
    filled = [
        (float(np.mean(np.isin(np.arange(size[1 - axis]), cells[on, 1 - axis]))), axis, end)
        for axis in (0, 1)
        for end in (0, int(size[axis]) - 1)
        for on in (cells[:, axis] == end,)
    ]
    fraction, axis, end = min(filled)
    return None if fraction >= _MIN_FILLED else np.flatnonzero(cells[:, axis] != end)


def _sides(
    grey: Grey32, cells: IntArray, points: FloatArray, size: IntArray
) -> tuple[Side, Side, Side, Side]:
    grid = _with_one_row_around(cells, points, size)
    before_b, after_b = _last_side(grey, grid[::-1]), _last_side(grey, grid)
    turned = grid.transpose(1, 0, 2)
    return _last_side(grey, turned[::-1]), _last_side(grey, turned), before_b, after_b


def _with_one_row_around(cells: IntArray, points: FloatArray, size: IntArray) -> FloatArray:
    """Image points (b + 2, a + 2, 2) of the rectangle and of one row around it."""
    b, a = np.mgrid[-1 : size[1] + 1, -1 : size[0] + 1]
    every = np.stack([a.ravel(), b.ravel()], axis=-1)
    grid = predict_cells(cells, points, every).reshape(*a.shape, 2)
    grid[cells[:, 1] + 1, cells[:, 0] + 1] = points
    return grid


def _last_side(grey: Grey32, grid: FloatArray) -> Side:
    """What lies beyond the last row; ``grid``'s outermost rows are predictions."""
    border, last, before = grid[-1, 1:-1], grid[-2, 1:-1], grid[-3, 1:-1]
    sign = (-1.0) ** np.arange(len(last))
    along_last, along = np.gradient(last, axis=0), np.gradient(border, axis=0)
    inside = sign * _difference(grey, last, along_last, before - last)
    known = np.isfinite(inside)
    if not known.any():
        return "unknown"
    contrast = float(np.median(inside[known]))
    if contrast == 0.0:
        return "unknown"
    squares = -sign * _difference(grey, border, along, last - border) / contrast
    beyond = sign * _difference(grey, border, along, border - last) / contrast
    known = np.isfinite(squares) & np.isfinite(beyond)
    if not known.any():
        return "unknown"
    alternates = squares[known] > _ALTERNATES
    is_end = alternates & (np.abs(beyond[known]) < _ONE_TONE)
    if known.sum() >= max(SMALLEST - 1, _KNOWN * len(known)):
        if np.mean(is_end) >= _AGREEING:
            return "ends"
        if np.mean(alternates & (beyond[known] > _ALTERNATES)) >= _AGREEING:
            return "continues"
    return "may end" if np.mean(is_end) >= _SUSPECT else "unknown"


def _difference(
    grey: Grey32, corners_px: FloatArray, along_px: FloatArray, across_px: FloatArray
) -> FloatArray:
    """Level (N,) ahead of each corner less that behind it, on one side; NaN out of view."""
    total = np.zeros(len(corners_px))
    for p in _ALONG:
        for q in _PROBES:
            ahead = sample(grey, corners_px + p * along_px + q * across_px)
            total += ahead - sample(grey, corners_px - p * along_px + q * across_px)
    return total / (len(_ALONG) * len(_PROBES))
