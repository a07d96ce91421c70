# SPDX-License-Identifier: Apache-2.0
"""Distance from each stripe point to the nearest other line."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, types

from armscan.kernels.arrays import (
    COLUMN,
    INTS_IN,
    TABLE_IN,
    TABLE_OUT,
    Float64Array,
    Int64Array,
)

OWN_SPAN = 3.0
"""Along its own chain a point is another line's only after this many times the reach."""


@njit(
    types.void(
        TABLE_IN,
        INTS_IN,
        INTS_IN,
        INTS_IN,
        INTS_IN,
        types.int64,
        types.int64,
        types.float64,
        TABLE_OUT,
    ),
    cache=True,
    nogil=True,
)
def find_other_lines(
    points: Float64Array,
    chain: Int64Array,
    start: Int64Array,
    stop: Int64Array,
    is_line: Int64Array,
    height: int,
    width: int,
    reach: float,
    distance: Float64Array,
) -> None:
    """Find the nearest point of another line, or of a far part of the same, on both sides.

    Points are sorted into square cells; a cell that holds only a point's own part of its chain is
    passed over, so that the cost is in crossings alone.

    Parameters
    ----------
    points
        (N, 6) ridge points, ordered along chains.
    chain
        (N,) chain numbers.
    start, stop
        (N,) first index, and index after the last, of each point's chain; the two ends of a chain
        count as neighbours, because it may be a loop.
    is_line
        (N,) 0 for points that do not count as a line to others.
    height, width
        Size of the image.
    reach
        Largest distance that matters, and the side of a cell.
    distance
        (N, 2) output: distance to the nearest other line on the side of smaller and of larger
        coordinate along the point's column or row; infinite where there is none within reach.
    """
    n = points.shape[0]
    rows = int(height / reach) + 1
    columns = int(width / reach) + 1
    head = np.full((rows, columns), -1, np.int64)
    first = np.zeros((rows, columns), np.int64)
    last = np.zeros((rows, columns), np.int64)
    following = np.full(n, -1, np.int64)
    own = OWN_SPAN * reach + 3.0
    for i in range(n):
        distance[i, 0] = np.inf
        distance[i, 1] = np.inf
        if is_line[i] == 0:
            continue
        r = int(points[i, 1] / reach)
        c = int(points[i, 0] / reach)
        if head[r, c] < 0:
            first[r, c] = i
        following[i] = head[r, c]
        head[r, c] = i
        last[r, c] = i
    for i in range(n):
        side_axis = 1 if int(points[i, 5]) == COLUMN else 0
        row = int(points[i, 1] / reach)
        column = int(points[i, 0] / reach)
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                j = head[r, c]
                if j < 0:
                    continue
                low = first[r, c]
                high = last[r, c]
                is_own = chain[low] == chain[i] and chain[high] == chain[i]
                if is_own and i - low <= own and high - i <= own:
                    continue
                size = stop[i] - start[i]
                while j >= 0:
                    apart = abs(i - j)
                    if chain[j] != chain[i] or min(apart, size - apart) > own:
                        dx = points[j, 0] - points[i, 0]
                        dy = points[j, 1] - points[i, 1]
                        far = math.sqrt(dx * dx + dy * dy)
                        side = 1 if points[j, side_axis] > points[i, side_axis] else 0
                        if far <= reach and far < distance[i, side]:
                            distance[i, side] = far
                    j = following[j]
