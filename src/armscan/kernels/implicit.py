# SPDX-License-Identifier: Apache-2.0
"""Heights of grid nodes over points with normals, summed for an implicit surface."""

from __future__ import annotations

import math

from armscan.kernels.arrays import Floats, FloatsOut, Ints, Table, compiled


@compiled()
def add_heights(
    points: Table,
    normals: Table,
    weights: Floats,
    chosen: Ints,
    corner: Ints,
    shape: Ints,
    reach: float,
    heights: FloatsOut,
    totals: FloatsOut,
) -> None:
    """Add to every node of a block how high it lies over the tangent planes of the points near it.

    Parameters
    ----------
    points, normals, weights
        (N, 3) in cells, (N, 3) unit, (N,).
    chosen
        (K,) rows that may reach the block, increasing.
    corner, shape
        (3,) first node of the block, and its nodes along each axis.
    reach
        Cells from a point to the last node that it is asked for; a Gaussian of a third of it
        weighs.
    heights, totals
        (shape[0] * shape[1] * shape[2],) sums of weighted heights in cells, and of weights.
    """
    for row in chosen:
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        first_i = max(math.ceil(x - reach) - corner[0], 0)
        last_i = min(math.floor(x + reach) - corner[0], shape[0] - 1)
        first_j = max(math.ceil(y - reach) - corner[1], 0)
        last_j = min(math.floor(y + reach) - corner[1], shape[1] - 1)
        first_k = max(math.ceil(z - reach) - corner[2], 0)
        last_k = min(math.floor(z + reach) - corner[2], shape[2] - 1)
        for i in range(first_i, last_i + 1):
            dx = i + corner[0] - x
            for j in range(first_j, last_j + 1):
                dy = j + corner[1] - y
                for k in range(first_k, last_k + 1):
                    dz = k + corner[2] - z
                    square = dx * dx + dy * dy + dz * dz
                    if square > reach * reach:
                        continue
                    weight = weights[row] * math.exp(-4.5 * square / (reach * reach))
                    node = (i * shape[1] + j) * shape[2] + k
                    height = dx * normals[row, 0] + dy * normals[row, 1] + dz * normals[row, 2]
                    heights[node] += weight * height
                    totals[node] += weight
