# SPDX-License-Identifier: Apache-2.0
"""Measured points on grids: what a voxel adds up (weighted places, covariances, normals, counts),
sums over cells that are numbered by one integer and found by hashing, tangent planes of the cells
near a point, and the heights of nodes.
"""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import (
    FUSED,
    Floats,
    FloatsOut,
    Ints,
    IntsOut,
    Table,
    TableOut,
    compiled,
)

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
JACOBI_SWEEPS = 6
"""Sweeps of a symmetric 3 x 3 matrix; three leave nothing but rounding (Golub and Van Loan 8.5)."""
BIN_BITS = 21
"""Of the number of a bin along an axis, counted from 1 so that a neighbour has one as well."""
CELLS_A_BIN = 4
"""Along an axis: a bin is as wide as the radius about a point, a cell a quarter of it."""
MOST_NEAR = 1024
"""Means within the radius of a cell: those of 9 x 9 x 9 cells at most."""
HALVINGS = 60
"""Steps that seek a bound between two squares of distances; many more than are taken."""
X, Y, Z, SQUARE = (row * MOST_NEAR for row in range(4))
"""Where the coordinates of the means near a cell begin, and the squares of their distances."""


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
def sort_into_bins(
    cells: Table,
    low: Floats,
    size: float,
    slots: IntsOut,
    bin_keys: IntsOut,
    starts: IntsOut,
    ordered: TableOut,
) -> None:
    """Put means of cells bin by bin, in their order within each bin.

    Parameters
    ----------
    cells
        (M, 3) means.
    low, size
        (3,) lowest corner of all, and the width of a bin.
    slots
        (S,) of -1, becomes the hash table: row of the bin, S a power of two of at least 2 M.
    bin_keys, starts
        (M,) number of each bin, and (M + 1,) first of its means; the bins that there are.
    ordered
        (M, 3) the means.
    """
    mask = len(slots) - 1
    member = np.zeros(len(cells), np.int64)
    count = 0
    for m in range(len(cells)):
        key = 0
        for k in range(3):
            key = key << BIN_BITS | int((cells[m, k] - low[k]) / size) + 1
        slot = _slot_of(key, slots, bin_keys, mask)
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
        for k in range(3):
            ordered[row, k] = cells[m, k]
    for b in range(count, 0, -1):
        starts[b] = starts[b - 1]
    starts[0] = 0


@compiled(is_inlined=True)
def _slot_of(key: int, slots: Ints, keys: Ints, mask: int) -> int:
    """Place of a number in a hash table, or the free one where it would go."""
    mixed = key * SPREAD
    slot = (mixed ^ (mixed >> 29)) & mask
    while slots[slot] >= 0 and keys[slots[slot]] != key:
        slot = (slot + 1) & mask
    return slot


@compiled()
def tangent_normals(
    points: Table,
    towards: Table,
    low: Floats,
    radius: float,
    slots: Ints,
    bin_keys: Ints,
    starts: Ints,
    cells: Table,
    limits: Floats,
    normals: TableOut,
) -> None:
    """Normal of the plane of the nearest means about each point.

    Means are gathered once for consecutive points of one cell.

    Parameters
    ----------
    points, towards
        (N, 3), and (N, 3) the places to whose side the normals point.
    low
        (3,) as of `sort_into_bins`; no point lies below it.
    radius
        Of the means that count, and the width of a bin.
    slots, bin_keys, starts, cells
        What `sort_into_bins` made.
    limits
        Fewest and most means, the least width over the radius, the largest thickness over width.
    normals
        (N, 3) unit; zero where there is none.
    """
    near = np.zeros(4 * MOST_NEAR)
    found = np.zeros(3)
    size = radius / CELLS_A_BIN
    last_x, last_y, last_z, count = -1, -1, -1, 0
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        cell_x = int((x - low[0]) / size)
        cell_y = int((y - low[1]) / size)
        cell_z = int((z - low[2]) / size)
        if cell_x != last_x or cell_y != last_y or cell_z != last_z:
            last_x, last_y, last_z = cell_x, cell_y, cell_z
            count = _gather(
                low[0] + (cell_x + 0.5) * size,
                low[1] + (cell_y + 0.5) * size,
                low[2] + (cell_z + 0.5) * size,
                low, radius, slots, bin_keys, starts, cells, near,
            )  # fmt: skip
        _least_direction(x, y, z, count, radius, limits, near, found)
        side = 0.0
        for k in range(3):
            side += found[k] * (towards[n, k] - points[n, k])
        for k in range(3):
            normals[n, k] = -found[k] if side < 0.0 else found[k]


@compiled()
def _gather(
    x: float,
    y: float,
    z: float,
    low: Floats,
    radius: float,
    slots: Ints,
    bin_keys: Ints,
    starts: Ints,
    cells: Table,
    near: FloatsOut,
) -> int:
    """Count of the means within the radius of the cell about (x, y, z), put into ``near``."""
    mask = len(slots) - 1
    half = 0.5 * radius / CELLS_A_BIN
    bin_x = int((x - low[0]) / radius) + 1
    bin_y = int((y - low[1]) / radius) + 1
    bin_z = int((z - low[2]) / radius) + 1
    count = 0
    for i in range(bin_x - 1, bin_x + 2):
        for j in range(bin_y - 1, bin_y + 2):
            for k in range(bin_z - 1, bin_z + 2):
                key = (i << BIN_BITS | j) << BIN_BITS | k
                row = slots[_slot_of(key, slots, bin_keys, mask)]
                if row < 0:
                    continue
                for m in range(starts[row], starts[row + 1]):
                    dx = max(abs(cells[m, 0] - x) - half, 0.0)
                    dy = max(abs(cells[m, 1] - y) - half, 0.0)
                    dz = max(abs(cells[m, 2] - z) - half, 0.0)
                    if dx * dx + dy * dy + dz * dz < radius * radius and count < MOST_NEAR:
                        near[X + count] = cells[m, 0]
                        near[Y + count] = cells[m, 1]
                        near[Z + count] = cells[m, 2]
                        count += 1
    return count


@compiled(error_model="numpy", fastmath=FUSED)
def _least_direction(
    x: float,
    y: float,
    z: float,
    count: int,
    radius: float,
    limits: Floats,
    near: FloatsOut,
    found: FloatsOut,
) -> None:
    """Least principal axis (3,) of the nearest means about a point; zero if they are no plane.

    Eigenvalues by their cosines (Smith, Communications of the ACM 4, 1961); where they tell a
    plane, the least one is a single root, and the rounding of the others is that of the axis.
    """
    found[0] = found[1] = found[2] = 0.0
    bound = _bound(x, y, z, count, radius * radius, limits[1], near)
    n = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
    for c in range(count):
        if near[SQUARE + c] < bound:
            dx, dy, dz = near[X + c] - x, near[Y + c] - y, near[Z + c] - z
            n += 1.0
            sx += dx
            sy += dy
            sz += dz
            xx += dx * dx
            xy += dx * dy
            xz += dx * dz
            yy += dy * dy
            yz += dy * dz
            zz += dz * dz
    if n < limits[0]:
        return
    sx, sy, sz = sx / n, sy / n, sz / n
    xx, xy, xz = xx / n - sx * sx, xy / n - sx * sy, xz / n - sx * sz
    yy, yz, zz = yy / n - sy * sy, yz / n - sy * sz, zz / n - sz * sz
    mean = (xx + yy + zz) / 3.0
    a, b, c_ = xx - mean, yy - mean, zz - mean
    spread = math.sqrt((a * a + b * b + c_ * c_ + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if not spread > 0.0:
        return
    det = a * (b * c_ - yz * yz) - xy * (xy * c_ - yz * xz) + xz * (xy * yz - b * xz)
    cosine = min(max(0.5 * det / (spread * spread * spread), -1.0), 1.0)
    angle = math.acos(cosine) / 3.0
    least = mean + 2.0 * spread * math.cos(angle + 2.0 * math.pi / 3.0)
    middle = 3.0 * mean - least - (mean + 2.0 * spread * math.cos(angle))
    width = math.sqrt(max(middle, 0.0))
    thickness = math.sqrt(max(least, 0.0))
    if width < limits[2] * radius or thickness > limits[3] * width:
        return
    a, b, c_ = xx - least, yy - least, zz - least
    longest = 0.0
    for k in range(3):
        if k == 0:
            ux, uy, uz = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
        elif k == 1:
            ux, uy, uz = xy * c_ - xz * yz, xz * xz - a * c_, a * yz - xy * xz
        else:
            ux, uy, uz = b * c_ - yz * yz, yz * xz - xy * c_, xy * yz - b * xz
        length = ux * ux + uy * uy + uz * uz
        if length > longest:
            longest = length
            found[0], found[1], found[2] = ux, uy, uz
    if longest > 0.0:
        scale = 1.0 / math.sqrt(longest)
        for k in range(3):
            found[k] *= scale


@compiled(error_model="numpy", fastmath=FUSED)
def _bound(
    x: float, y: float, z: float, count: int, square: float, most: float, near: FloatsOut
) -> float:
    """Square below which no more than ``most`` of the means lie; all of equal distance count.

    Writes the squares of their distances from the point.
    """
    inside = 0.0
    for c in range(count):
        dx, dy, dz = near[X + c] - x, near[Y + c] - y, near[Z + c] - z
        distance = dx * dx + dy * dy + dz * dz
        near[SQUARE + c] = distance
        inside += 1.0 if distance < square else 0.0
    if inside <= most:
        return square
    # a surface holds as many more as the square grows
    low, high, guess = 0.0, square, square * (most + 0.5) / inside
    for _ in range(HALVINGS):
        inside = 0.0
        for c in range(count):
            inside += 1.0 if near[SQUARE + c] < guess else 0.0
        if inside == most:
            return guess
        if inside < most:
            low = guess
        else:
            high = guess
        wanted = guess * (most + 0.5) / max(inside, 1.0)
        middle = 0.5 * (low + high)
        step = 0.25 * (high - low)
        guess = min(max(wanted, middle - step), middle + step)
    return high


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
