# SPDX-License-Identifier: Apache-2.0
"""What every one of the thesis's methods returns, and the runs that three of them start from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_floats
from armscan.vision.stripe.level import CELL_PX, ImageLevel

LONGEST_RUN_PX = 90
SHORTEST_RUN_PX = 2


@dataclass(frozen=True, slots=True, eq=False)
class StripeCentres:
    """Centre points without order.

    Parameters
    ----------
    points_px
        (N, 2) image pixels.
    normals
        (N, 2) unit vectors across the line, of either sign.
    """

    points_px: FloatArray
    normals: FloatArray

    def __post_init__(self) -> None:
        n = len(self.points_px)
        for name in ("points_px", "normals"):
            object.__setattr__(self, name, frozen_floats(getattr(self, name), (n, 2), name))


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """Stretches of pixels above the threshold, all down the columns or all along the rows.

    Parameters
    ----------
    is_down
        True if the runs go down the columns.
    lines
        (N,) column or row of each run.
    first, stop
        (N,) first pixel of each run and the one after its last.
    heights
        (lines, pixels) image less background, rows are the columns or rows of the image.
    """

    is_down: bool
    lines: IntArray
    first: IntArray
    stop: IntArray
    heights: NDArray[np.float32]

    def points(self, centres: FloatArray) -> FloatArray:
        """Image points (N, 2) from positions (N,) along the runs."""
        pair = (self.lines, centres) if self.is_down else (centres, self.lines)
        return np.stack(pair, axis=1).astype(np.float64)

    def sums(self, values: FloatArray) -> FloatArray:
        """Sum (N,) of values (lines, pixels) over each run."""
        running = np.cumsum(np.pad(values, ((0, 0), (1, 0))), axis=1)
        return np.asarray(running[self.lines, self.stop] - running[self.lines, self.first])


def above_background(image: NDArray[np.float32], level: ImageLevel) -> NDArray[np.float32]:
    """Image (H, W) less its interpolated background."""
    rows, columns = (
        np.clip((np.arange(n) + 0.5) / CELL_PX - 0.5, 0.0, cells - 1.0)
        for n, cells in zip(image.shape, level.background.shape, strict=True)
    )
    grid = np.stack(np.meshgrid(rows, columns, indexing="ij"))
    surface = map_coordinates(level.background, grid, order=1, mode="nearest")
    return np.asarray(image - surface, dtype=np.float32)


def find_thesis_runs(image: NDArray[np.float32], level: ImageLevel) -> Runs:
    """Runs above the threshold across the lines: down the columns unless rows give more."""
    heights = above_background(image, level)
    down = _runs(heights.T, True, level.rise)
    along = _runs(heights, False, level.rise)
    return down if len(down.lines) >= len(along.lines) else along


def _runs(heights: NDArray[np.float32], is_down: bool, rise: float) -> Runs:
    lit: BoolArray = heights > rise
    edges = np.diff(np.pad(lit, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    lines, first = np.nonzero(edges == 1)
    _, stop = np.nonzero(edges == -1)
    fits = (stop - first <= LONGEST_RUN_PX) & (stop - first >= SHORTEST_RUN_PX)
    return Runs(is_down, lines[fits], first[fits], stop[fits], heights)
