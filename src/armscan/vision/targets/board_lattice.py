# SPDX-License-Identifier: Apache-2.0
"""Numbering of lattice points in an image: which is the origin, which way x goes.

The camera looks at the front of a print, so that in the image the board's y lies clockwise of
its x. Where several numberings remain, the one whose x points most to the right is taken.
"""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray


def numberings(corners_px: FloatArray, columns: int, rows: int) -> list[FloatArray]:
    """Return all ways to number a full lattice seen from its front.

    Parameters
    ----------
    corners_px
        (rows * columns, 2) image points, row by row from any corner, in either handedness.
    columns, rows
        Size of the lattice.

    Returns
    -------
    Arrays (rows, columns, 2), the one whose x points most to the right first.
    """
    grid = corners_px.reshape(rows, columns, 2)
    grids = [grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1]]
    if columns == rows:
        grids += [g.transpose(1, 0, 2) for g in grids]
    front = [g for g in grids if _handedness(g) > 0.0]
    return sorted(front, key=lambda g: -_rightness(g))


def lattice_steps(grid_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the way (rows, columns, 2) to the next point along x and along y, at every point."""
    return np.gradient(grid_px, axis=1), np.gradient(grid_px, axis=0)


def _handedness(grid: FloatArray) -> float:
    x, y = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    return float(x[0] * y[1] - x[1] * y[0])


def _rightness(grid: FloatArray) -> float:
    x = grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0)
    return float(x[0] / np.hypot(*x))
