# SPDX-License-Identifier: Apache-2.0
"""Candidates: runs of pixels above the local background, down the columns and along the rows."""

from __future__ import annotations

import numpy as np
from numba import njit, types

from armscan.kernels.arrays import (
    COLUMN,
    IMAGE_IN,
    ROW,
    ROW_OUT,
    TABLE_OUT,
    Float32Array,
    Float64Array,
)

VALLEY_RATIO = 0.5
"""A dip below this share of the peak splits a run into two lines."""


@njit(types.void(IMAGE_IN, types.int64, types.int64, ROW_OUT), cache=True, nogil=True)
def interpolate_columns(grid: Float32Array, cell_px: int, i: int, row: Float32Array) -> None:
    """Write row ``i`` of the grid, interpolated linearly between cell centres, to ``row`` (W,)."""
    columns = grid.shape[1]
    for x in range(row.shape[0]):
        u = min(max((x + 0.5) / cell_px - 0.5, 0.0), columns - 1.0)
        k = min(int(u), max(columns - 2, 0))
        m = min(k + 1, columns - 1)
        row[x] = grid[i, k] + (u - k) * (grid[i, m] - grid[i, k])


@njit(types.float64(IMAGE_IN, types.int64, types.int64, types.int64), cache=True, nogil=True)
def level_at(image: Float32Array, axis: int, line: int, k: int) -> float:
    """Grey level at place ``k`` of a column (axis 0) or row (axis 1)."""
    return float(image[k, line] if axis == COLUMN else image[line, k])


@njit(
    types.float64(
        IMAGE_IN, types.int64, types.int64, types.int64, types.int64, types.float64, types.float64
    ),
    cache=True,
    nogil=True,
)
def hump_centre(
    image: Float32Array,
    axis: int,
    line: int,
    first: int,
    last: int,
    background: float,
    peak: float,
) -> float:
    """Centroid of what rises above half of the peak, so that a bright ground does not pull it."""
    floor = background + 0.5 * peak
    weight = moment = 0.0
    for k in range(first, last + 1):
        above = max(level_at(image, axis, line, k) - floor, 0.0)
        weight += above
        moment += above * k
    return moment / weight if weight > 0.0 else 0.5 * (first + last)


@njit(
    types.int64(
        IMAGE_IN,
        types.int64,
        types.int64,
        types.int64,
        types.int64,
        types.float64,
        types.float64,
        TABLE_OUT,
        types.int64,
    ),
    cache=True,
    nogil=True,
)
def split_run(
    image: Float32Array,
    axis: int,
    line: int,
    first: int,
    last: int,
    background: float,
    rise: float,
    runs: Float64Array,
    count: int,
) -> int:
    """Append the centre of each hump of one run; return the new count.

    A run is split where the three-pixel mean dips below half of the peaks on both sides, so that
    two lines that share a foot become two candidates.

    Parameters
    ----------
    image
        (H, W) grey levels.
    axis, line, first, last
        The run: pixels ``first..last`` of column (axis 0) or row (axis 1) ``line``.
    background, rise
        Local background, and the height above it at which the run was cut.
    runs
        (capacity, 3) output rows ``x, y, axis``; rows beyond the capacity are counted only.
    count
        Rows used so far.
    """
    peak = 0.0
    low = np.inf
    low_at = start = first
    for k in range(first, last + 2):
        is_end = k > last
        smooth = 0.0
        if not is_end:
            smooth = level_at(image, axis, line, k)
            smooth += level_at(image, axis, line, max(k - 1, first))
            smooth += level_at(image, axis, line, min(k + 1, last))
            smooth = smooth / 3.0 - background
        if is_end or (low < VALLEY_RATIO * peak and smooth > 2.0 * low + rise):
            if count < runs.shape[0]:
                stop = last if is_end else low_at
                centre = hump_centre(image, axis, line, start, stop, background, peak)
                runs[count, 0] = line if axis == COLUMN else centre
                runs[count, 1] = centre if axis == COLUMN else line
                runs[count, 2] = axis
            count += 1
            start = low_at
            peak = 0.0
        if smooth >= peak:
            peak = smooth
            low = np.inf
        if smooth < low:
            low = smooth
            low_at = k
    return count


@njit(
    types.int64(IMAGE_IN, IMAGE_IN, types.int64, types.float64, types.int64, TABLE_OUT),
    cache=True,
    nogil=True,
)
def find_runs(
    image: Float32Array,
    background: Float32Array,
    cell_px: int,
    rise: float,
    longest_px: int,
    runs: Float64Array,
) -> int:
    """Find runs of pixels more than ``rise`` above the background in one pass over the image.

    Parameters
    ----------
    image
        (H, W) grey levels.
    background
        (rows, columns) background per cell of ``cell_px`` pixels, interpolated in between.
    cell_px
        Side of a background cell.
    rise
        Height above the background.
    longest_px
        Longer runs are no cross-sections of a line and are left out.
    runs
        (capacity, 3) output rows: ``x, y`` of the centroid above the threshold, and the axis
        (0: the run goes down a column, 1: along a row).

    Returns
    -------
    int
        Count of candidates; more than the capacity if the output was too short.
    """
    height, width = image.shape
    floor = np.zeros(width, np.float32)
    upper = np.zeros(width, np.float32)
    lower = np.zeros(width, np.float32)
    above = -1
    start = np.full(width, -1, np.int64)
    count = 0
    lift = np.float32(rise)
    for y in range(height + 1):
        row_start = -1
        if y < height:
            v = min(max((y + 0.5) / cell_px - 0.5, 0.0), background.shape[0] - 1.0)
            cell = int(v)
            if cell != above:
                interpolate_columns(background, cell_px, cell, upper)
                following = min(cell + 1, background.shape[0] - 1)
                interpolate_columns(background, cell_px, following, lower)
                above = cell
            fraction = np.float32(v - cell)
            for x in range(width):
                floor[x] = upper[x] + fraction * (lower[x] - upper[x]) + lift
        for x in range(width):
            if y < height and image[y, x] > floor[x]:
                if start[x] < 0:
                    start[x] = y
                if row_start < 0:
                    row_start = x
                if x < width - 1:
                    continue
                stop = x
            else:
                if start[x] >= 0:
                    if y - start[x] <= longest_px:
                        base = float(floor[x]) - rise
                        count = split_run(
                            image, COLUMN, x, start[x], y - 1, base, rise, runs, count
                        )
                    start[x] = -1
                stop = x - 1
            if row_start >= 0:
                if stop - row_start < longest_px:
                    base = float(floor[x]) - rise
                    count = split_run(image, ROW, y, row_start, stop, base, rise, runs, count)
                row_start = -1
    return count
