# SPDX-License-Identifier: Apache-2.0
"""Measured points on grids: what a voxel adds up (weighted places, covariances, normals, counts),
sums over cells that are numbered by one integer and found by hashing, points sorted into bins, and
the heights of nodes.
"""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import Floats, FloatsOut, Ints, IntsOut, Table, TableOut, compiled

N_VALUES = 28
"""Weight; weighted offset from the voxel's centre (3), covariance (6), covariance of the noise
alone (6), the same times weight and correlation length (6), normal (3); weight of points with a
normal; count; weighted intensity. Covariances as xx, xy, xz, yy, yz, zz."""
BLOCK_BITS, PART_BITS = 16, 5
MIDDLE = 2 ** (BLOCK_BITS + PART_BITS - 1)
"""Number along an axis of the voxel whose lower corner is the origin."""
NOTHING = 1e-15
"""Off-diagonals below this part of the diagonal are rounding."""
SPREAD = 0x2545F4914F6CDD1D
"""Odd multiplier of a linear congruential step (L'Ecuyer 1999): neighbouring numbers land apart."""
BIN_BITS = 21
"""Of the number of a bin along an axis, counted from 1 so that a neighbour has one as well."""
JACOBI_SWEEPS = 6
"""Sweeps of a symmetric 3 x 3 matrix; three leave nothing but rounding (Golub and Van Loan 8.5)."""


@compiled()
def principal_axes(matrix: TableOut, axes: TableOut) -> None:
    """Diagonalise a symmetric (3, 3) matrix in place by Jacobi rotations.

    Parameters
    ----------
    matrix
        Its diagonal holds the eigenvalues afterwards, in no order.
    axes
        (3, 3) unit eigenvectors in its columns.
    """
    for i in range(3):
        for j in range(3):
            axes[i, j] = 1.0 if i == j else 0.0
    for _ in range(JACOBI_SWEEPS):
        off = abs(matrix[0, 1]) + abs(matrix[0, 2]) + abs(matrix[1, 2])
        if off <= NOTHING * (abs(matrix[0, 0]) + abs(matrix[1, 1]) + abs(matrix[2, 2])):
            return
        for p in range(2):
            for q in range(p + 1, 3):
                off = matrix[p, q]
                if off == 0.0:
                    continue
                half = 0.5 * (matrix[q, q] - matrix[p, p])
                tangent = off / (abs(half) + math.hypot(half, off))
                if half < 0.0:
                    tangent = -tangent
                cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
                sine = tangent * cosine
                for k in range(3):
                    first, second = matrix[k, p], matrix[k, q]
                    matrix[k, p] = cosine * first - sine * second
                    matrix[k, q] = sine * first + cosine * second
                for k in range(3):
                    first, second = matrix[p, k], matrix[q, k]
                    matrix[p, k] = cosine * first - sine * second
                    matrix[q, k] = sine * first + cosine * second
                matrix[p, q] = matrix[q, p] = 0.0
                for k in range(3):
                    first, second = axes[k, p], axes[k, q]
                    axes[k, p] = cosine * first - sine * second
                    axes[k, q] = sine * first + cosine * second


@compiled()
def voxel_values(
    points_mm: Table,
    covariance_mm2: Table,
    noise: Table,
    normals: Table,
    size_mm: float,
    keys: IntsOut,
    values: TableOut,
) -> int:
    """Number of each point's voxel, and the row that the point adds to it.

    The noise is taken to act along the longest axes of the total covariance, where a stripe's noise
    acts: along the first as far as its variance goes, what is left along the next.

    Parameters
    ----------
    points_mm
        (N, 3).
    covariance_mm2
        (N, 9) total covariance of each.
    noise
        (N, 3): its standard deviation in mm, correlation length in points, peak grey level.
    normals
        (N, 3); zero where there is none.
    size_mm
        Edge of a voxel.
    keys
        (N,) numbers, as `armscan.fusion.cell_sums.cell_numbers` of cells counted from -2^20.
    values
        (N, `N_VALUES`).

    Returns
    -------
    int
        First point that lies beyond all voxels that can be numbered; N if there is none.
    """
    matrix, axes, own = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    part = (1 << PART_BITS) - 1
    for n in range(len(points_mm)):
        block, within = 0, 0
        for k in range(3):
            place = points_mm[n, k] / size_mm
            whole = math.floor(place)
            if not -MIDDLE <= whole < MIDDLE:
                return n
            cell = int(whole) + MIDDLE
            block = block << BLOCK_BITS | cell >> PART_BITS
            within = within << PART_BITS | cell & part
            values[n, 1 + k] = (place - whole - 0.5) * size_mm
        keys[n] = block << (3 * PART_BITS) | within
        trace = covariance_mm2[n, 0] + covariance_mm2[n, 4] + covariance_mm2[n, 8]
        weight = 1.0 / trace if trace > 0.0 else 1.0
        for i in range(3):
            for j in range(3):
                matrix[i, j] = 0.5 * (covariance_mm2[n, 3 * i + j] + covariance_mm2[n, 3 * j + i])
                own[i, j] = 0.0
        left = min(noise[n, 0] * noise[n, 0], trace)
        if left > 0.0:
            principal_axes(matrix, axes)
            for _ in range(3):
                longest = 0
                for k in range(1, 3):
                    if matrix[k, k] > matrix[longest, longest]:
                        longest = k
                taken = min(left, max(matrix[longest, longest], 0.0))
                for i in range(3):
                    for j in range(3):
                        own[i, j] += taken * axes[i, longest] * axes[j, longest]
                left -= taken
                matrix[longest, longest] = -1.0
        values[n, 0] = weight
        column = 4
        for i in range(3):
            values[n, 1 + i] *= weight
            for j in range(i, 3):
                values[n, column] = weight * covariance_mm2[n, 3 * i + j]
                values[n, column + 6] = weight * own[i, j]
                values[n, column + 12] = weight * weight * noise[n, 1] * own[i, j]
                column += 1
        is_faced = False
        for k in range(3):
            values[n, 22 + k] = weight * normals[n, k]
            is_faced = is_faced or normals[n, k] != 0.0
        values[n, 25] = weight if is_faced else 0.0
        values[n, 26] = 1.0
        values[n, 27] = weight * noise[n, 2]
    return len(points_mm)


@compiled()
def add_to_cells(
    keys: Ints,
    values: Table,
    start: int,
    slots: IntsOut,
    cell_keys: IntsOut,
    sums: TableOut,
    count: IntsOut,
) -> int:
    """Add rows to the sums of their cells, in order, until one more cell does not fit.

    Parameters
    ----------
    keys
        (N,) number of each row's cell.
    values
        (N, K).
    start
        First row to add.
    slots
        (S,) hash table, S a power of two of at least twice the cells: row of the cell, -1 if free.
    cell_keys
        (M,) number of each cell.
    sums
        (M, K).
    count
        (1,) cells in use.

    Returns
    -------
    int
        Row that was not added any more; N if all were.
    """
    mask = len(slots) - 1
    for n in range(start, len(keys)):
        key = keys[n]
        mixed = key * SPREAD
        slot = (mixed ^ (mixed >> 29)) & mask
        while slots[slot] >= 0 and cell_keys[slots[slot]] != key:
            slot = (slot + 1) & mask
        row = slots[slot]
        if row < 0:
            row = count[0]
            if row == len(cell_keys):
                return n
            slots[slot] = row
            cell_keys[row] = key
            for k in range(values.shape[1]):
                sums[row, k] = 0.0
            count[0] = row + 1
        for k in range(values.shape[1]):
            sums[row, k] += values[n, k]
    return len(keys)


@compiled()
def number_cells(points: Table, low: Floats, size: float, numbers: IntsOut) -> bool:
    """Numbers (N,) of the cells that points (N, 3) lie in, block by block.

    ``low``, ``size``: (3,) corner of the first cell, and width of a cell. ``numbers``: (N,) output.
    Returns False where a point lies below the corner, or beyond the last cell of an axis.
    """
    most, part_mask = float(2 ** (BLOCK_BITS + PART_BITS)), 2**PART_BITS - 1
    is_inside = True
    for n in range(len(points)):
        block = part = 0
        for k in range(3):
            place = math.floor((points[n, k] - low[k]) / size)
            if not 0.0 <= place < most:
                is_inside = False
                place = 0.0
            cell = int(place)
            block = block << BLOCK_BITS | cell >> PART_BITS
            part = part << PART_BITS | (cell & part_mask)
        numbers[n] = block << 3 * PART_BITS | part
    return is_inside


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


@compiled()
def first_in_cells(
    points: Table,
    exposure: Ints,
    low: Floats,
    size: float,
    slots: IntsOut,
    keys: IntsOut,
    rows: IntsOut,
) -> int:
    """Rows of the first point of each cell of each exposure, rising.

    ``points``: (N, 3), none below ``low`` (3,). ``exposure``: (N,). ``size``: Width of a cell.
    ``slots``: (S,) of -1, S a power of two of at least 2 N. ``keys``: (N,) for what is found.
    ``rows``: (N,) output. Returns how many rows there are.
    """
    mask, count = len(slots) - 1, 0
    for n in range(len(points)):
        key = 0
        for k in range(3):
            key = key << BIN_BITS | int((points[n, k] - low[k]) / size)
        mixed = (key + exposure[n] * SPREAD) * SPREAD
        slot = (mixed ^ (mixed >> 29)) & mask
        row = slots[slot]
        while row >= 0 and (keys[row] != key or exposure[rows[row]] != exposure[n]):
            slot = (slot + 1) & mask
            row = slots[slot]
        if row < 0:
            slots[slot] = count
            keys[count], rows[count] = key, n
            count += 1
    return count


@compiled()
def sort_into_bins(
    cells: Table,
    low: Floats,
    size: float,
    slots: IntsOut,
    bin_keys: IntsOut,
    starts: IntsOut,
    ordered: TableOut,
) -> None:
    """Put means of cells, or points, bin by bin, in their order within each bin.

    Parameters
    ----------
    cells
        (M, 3) places, or (M, K) with more numbers behind them.
    low, size
        (3,) lowest corner of all, and the width of a bin.
    slots
        (S,) of -1, becomes the hash table: row of the bin, S a power of two of at least 2 M.
    bin_keys, starts
        (M,) number of each bin, and (M + 1,) first of its means; the bins that there are.
    ordered
        (M, K) the same rows.
    """
    mask = len(slots) - 1
    member = np.zeros(len(cells), np.int64)
    count = 0
    for m in range(len(cells)):
        key = 0
        for k in range(3):
            key = key << BIN_BITS | int((cells[m, k] - low[k]) / size) + 1
        slot = slot_of(key, slots, bin_keys, mask)
        if slots[slot] < 0:
            slots[slot] = count
            bin_keys[count] = key
            starts[count] = 0
            count += 1
        member[m] = slots[slot]
        starts[slots[slot]] += 1
    first = 0
    for b in range(count):
        size_of_bin = starts[b]
        starts[b] = first
        first += size_of_bin
    for m in range(len(cells)):
        row = starts[member[m]]
        starts[member[m]] += 1
        for k in range(cells.shape[1]):
            ordered[row, k] = cells[m, k]
    for b in range(count, 0, -1):
        starts[b] = starts[b - 1]
    starts[0] = 0


@compiled(is_inlined=True)
def slot_of(key: int, slots: Ints, keys: Ints, mask: int) -> int:
    """Place of a number in a hash table, or the free one where it would go."""
    mixed = key * SPREAD
    slot = (mixed ^ (mixed >> 29)) & mask
    while slots[slot] >= 0 and keys[slots[slot]] != key:
        slot = (slot + 1) & mask
    return slot


@compiled()
def drop_hidden(
    asked: Table, first: Ints, stop: Ints, places: Table, looked_at: int, nearest: FloatsOut
) -> None:
    """Infinite distances of places that as many of their own exposure, or more, are nearer to.

    ``asked``: (S, 4). ``first``, ``stop``: (S,) rows of its own exposure in ``places`` (M, 4).
    ``looked_at``: The place itself is counted. ``nearest``: (S,) of `nearest_others`.
    """
    columns = np.ascontiguousarray(places.T)
    for s in range(len(asked)):
        nearer, square = 0, nearest[s] * nearest[s]
        x, y, z = asked[s, 0], asked[s, 1], asked[s, 2]
        span = slice(first[s], stop[s])
        u, v, w = columns[0, span], columns[1, span], columns[2, span]
        for m in range(len(u)):
            dx, dy, dz = u[m] - x, v[m] - y, w[m] - z
            nearer += 1 if dx * dx + dy * dy + dz * dz < square else 0
        if nearer >= looked_at:
            nearest[s] = math.inf
