# SPDX-License-Identifier: Apache-2.0
"""Does the chessboard go on beyond the corners that were found?

OpenCV's finders also accept a part of a larger board. Beyond the last inner corners a real board
shows a light rim: there the four quadrants of a lattice point hold half the contrast of an inner
corner, so that a row of points with (nearly) full contrast is one more row of corners.
"""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.vision.targets.grey import RawGrey, sample

_FULL_CONTRAST = 0.75
_PROBE = 0.3
_MAX_GROWTH = 30


def true_size(grey: RawGrey, grid_px: FloatArray) -> tuple[int, int]:
    """Count the corners (columns, rows) of the board of which ``grid_px`` may be a part.

    Parameters
    ----------
    grey
        (H, W) raw levels.
    grid_px
        (rows, columns, 2) inner corners, image pixels.
    """
    rows, columns = grid_px.shape[:2]
    grown = [
        _rows_beyond(grey, grid)
        for grid in (
            grid_px,
            grid_px[::-1],
            grid_px.transpose(1, 0, 2),
            grid_px[:, ::-1].transpose(1, 0, 2),
        )
    ]
    return columns + grown[2] + grown[3], rows + grown[0] + grown[1]


def _rows_beyond(grey: RawGrey, grid: FloatArray) -> int:
    """Rows of corners past the last row of ``grid``."""
    inner = np.median(np.abs(_contrast(grey, grid[-2], grid[-2] - grid[-3])))
    last, step = grid[-1], grid[-1] - grid[-2]
    shrink = np.linalg.norm(step, axis=1) / np.linalg.norm(grid[-2] - grid[-3], axis=1)
    ratio = float(np.median(shrink))
    for count in range(_MAX_GROWTH):
        step = step * ratio
        last = last + step
        contrast = _contrast(grey, last, step)
        sign = (-1.0) ** np.arange(len(contrast))
        if not np.abs(np.median(sign * contrast)) > _FULL_CONTRAST * inner:
            return count
    return _MAX_GROWTH


def _contrast(grey: RawGrey, row_px: FloatArray, step_px: FloatArray) -> FloatArray:
    """Signed contrast (N,) of the four quadrants around the points of a row; NaN outside."""
    along = np.gradient(row_px, axis=0)
    total = np.zeros(len(row_px))
    for a in (-_PROBE, _PROBE):
        for b in (-_PROBE, _PROBE):
            total += np.sign(a * b) * sample(grey, row_px + a * along + b * step_px)
    return total
