# SPDX-License-Identifier: Apache-2.0
"""How many corners does the chessboard really have?

OpenCV's finders also accept a part of a larger board, or take the outer corners of the border
squares for inner ones. Around an inner corner the four quadrants alternate; around an outer corner
three of them are light or lie on the light rim. The alternating sum, divided by the range of the
four, is 2 there and 1 here, whatever the light. Border lines of outer corners are taken off, lines
of inner corners beyond the border are added.
"""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.vision.targets.grey import RawGrey, sample

_INNER_CORNER = 1.5
"""Alternating sum over range: 2 at an inner, 1 at an outer corner, about 0 where there is none."""
_PROBES = (0.2, 0.3, 0.4)
_QUADRANTS = ((1, 1), (-1, 1), (-1, -1), (1, -1))
_MAX_GROWTH = 30
_SMALLEST = 3


def true_size(grey: RawGrey, grid_px: FloatArray) -> tuple[int, int]:
    """Count the corners (columns, rows) of the board of which ``grid_px`` may be a part.

    Parameters
    ----------
    grey
        (H, W) raw levels.
    grid_px
        (rows, columns, 2) inner corners, image pixels.
    """
    grid = grid_px
    for _ in range(4):
        grid = np.rot90(_without_weak_border(grey, grid))
    grown = []
    for _ in range(4):
        grown.append(_rows_beyond(grey, grid))
        grid = np.rot90(grid)
    rows, columns = grid.shape[:2]
    return columns + grown[1] + grown[3], rows + grown[0] + grown[2]


def _without_weak_border(grey: RawGrey, grid: FloatArray) -> FloatArray:
    """The lattice without those last rows that are no rows of inner corners."""
    while len(grid) > _SMALLEST and not _is_inner(
        grey, grid[-1], grid[-1] - grid[-2], if_out_of_view=True
    ):
        grid = grid[:-1]
    return grid


def _rows_beyond(grey: RawGrey, grid: FloatArray) -> int:
    """Rows of inner corners past the last row of ``grid``."""
    last, step = grid[-1], grid[-1] - grid[-2]
    before = np.linalg.norm(grid[-2] - grid[-3], axis=1)
    ratio = float(np.median(np.linalg.norm(step, axis=1) / before))
    for count in range(_MAX_GROWTH):
        step = step * ratio
        last = last + step
        if not _is_inner(grey, last, step, if_out_of_view=False):
            return count
    return _MAX_GROWTH


def _is_inner(
    grey: RawGrey, row_px: FloatArray, step_px: FloatArray, *, if_out_of_view: bool
) -> bool:
    """Tell whether most points of a row are corners where four squares meet."""
    along = np.gradient(row_px, axis=0)
    quadrants = np.stack([_quadrant(grey, row_px, a * along, b * step_px) for a, b in _QUADRANTS])
    spread = np.maximum(np.ptp(quadrants, axis=0), 1e-9)
    alternating = (quadrants[0] - quadrants[1] + quadrants[2] - quadrants[3]) / spread
    signed = (-1.0) ** np.arange(len(alternating)) * alternating
    known = signed[np.isfinite(signed)]
    if not len(known):
        return if_out_of_view
    return bool(np.abs(np.median(known)) > _INNER_CORNER)


def _quadrant(
    grey: RawGrey, corners_px: FloatArray, along_px: FloatArray, across_px: FloatArray
) -> FloatArray:
    """Mean level (N,) of the probes in one quadrant of each corner; NaN if none is in view."""
    levels = np.stack(
        [sample(grey, corners_px + p * along_px + q * across_px) for p in _PROBES for q in _PROBES]
    )
    seen = np.isfinite(levels)
    count = seen.sum(axis=0)
    total = np.where(seen, levels, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
