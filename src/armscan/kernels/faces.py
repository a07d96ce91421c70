# SPDX-License-Identifier: Apache-2.0
"""Faces through measured points: planes and quadrics of what lies near each, found in bins that
are as wide as the radius.
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
from armscan.kernels.grids import SPREAD, principal_axes

BIN_BITS = 21
"""Of the number of a bin along an axis, counted from 1 so that a neighbour has one as well."""
CELLS_A_BIN = 4
"""Along an axis: a bin is as wide as the radius about a point, a cell a quarter of it."""
MOST_NEAR = 1024
"""Means within the radius of a cell: those of 9 x 9 x 9 cells at most."""
WIDE = 0.02
"""Points whose variance across is less than this part of that along lie on one line."""
HALVINGS = 60
"""Steps that seek a bound between two squares of distances; many more than are taken."""
X, Y, Z, SQUARE = (row * MOST_NEAR for row in range(4))
"""Where the coordinates of the means near a cell begin, and the squares of their distances."""


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
        for k in range(cells.shape[1]):
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
def nearest_others(
    asked: Table,
    low: Floats,
    width: float,
    slots: Ints,
    bin_keys: Ints,
    starts: Ints,
    places: Table,
    nearest: FloatsOut,
) -> None:
    """Distance of places to the nearest one of another exposure, sought in bins ring by ring.

    Parameters
    ----------
    asked
        (S, 4) places and their exposures.
    low, width
        (3,) as of `sort_into_bins`, and the width of a bin.
    slots, bin_keys, starts, places
        What `sort_into_bins` made of (M, 4) places and exposures.
    nearest
        (S,) input: how far is looked; output: the distance where it is less.
    """
    mask = len(slots) - 1
    for s in range(len(asked)):
        x, y, z, own = asked[s, 0], asked[s, 1], asked[s, 2], asked[s, 3]
        u, v, w = (x - low[0]) / width, (y - low[1]) / width, (z - low[2]) / width
        bin_x, bin_y, bin_z = math.floor(u), math.floor(v), math.floor(w)
        # of its bin's least far side
        u, v, w = u - bin_x, v - bin_y, w - bin_z
        room = width * min(u, v, w, 1.0 - u, 1.0 - v, 1.0 - w)
        best, ring = nearest[s] * nearest[s], 0
        while ring == 0 or (room + (ring - 1) * width) ** 2 < best:
            for i in range(-ring, ring + 1):
                for j in range(-ring, ring + 1):
                    # inside of the ring all was looked at before
                    step = 1 if max(abs(i), abs(j)) == ring else 2 * ring
                    for k in range(-ring, ring + 1, step):
                        key = (bin_x + i + 1) << BIN_BITS | (bin_y + j + 1)
                        key = key << BIN_BITS | (bin_z + k + 1)
                        row = slots[_slot_of(key, slots, bin_keys, mask)]
                        if row < 0:
                            continue
                        for m in range(starts[row], starts[row + 1]):
                            if places[m, 3] != own:
                                dx, dy, dz = places[m, 0] - x, places[m, 1] - y, places[m, 2] - z
                                best = min(best, dx * dx + dy * dy + dz * dz)
            ring += 1
        nearest[s] = math.sqrt(best)


@compiled()
def drop_hidden(
    asked: Table, first: Ints, stop: Ints, places: Table, looked_at: int, nearest: FloatsOut
) -> None:
    """Infinite distances of places that as many of their own exposure, or more, are nearer to.

    ``asked``: (S, 4). ``first``, ``stop``: (S,) rows of its own exposure in ``places`` (M, 4).
    ``looked_at``: The place itself is counted. ``nearest``: (S,) of `nearest_others`.
    """
    for s in range(len(asked)):
        nearer, square = 0, nearest[s] * nearest[s]
        for m in range(first[s], stop[s]):
            dx, dy, dz = (
                places[m, 0] - asked[s, 0],
                places[m, 1] - asked[s, 1],
                places[m, 2] - asked[s, 2],
            )
            nearer += 1 if dx * dx + dy * dy + dz * dz < square else 0
        if nearer >= looked_at:
            nearest[s] = math.inf


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


@compiled(error_model="numpy")
def quadric_offsets(
    asked: Table,
    low: Floats,
    radius: float,
    slots: Ints,
    bin_keys: Ints,
    starts: Ints,
    rows: Table,
    limits: Floats,
    found: TableOut,
) -> None:
    """Fit a quadric to the points near each asked one, over their own tangent plane.

    Parameters
    ----------
    asked
        (N, 4) places, and the exposure whose points do not count; -1 for none.
    low, radius, slots, bin_keys, starts
        As of `sort_into_bins`, with bins as wide as the radius.
    rows
        (M, 5) places, exposure and row of each point, bin by bin.
    limits
        Most points, the nearest; fewest points and fewest exposures of them; the ridge.
    found
        (N, 9): 0 where there are too few. Else 1, row of the nearest point, distance of the asked
        point from the quadric over the radius, normal (3), scatter of the points over the radius
        and the inverse normal matrix's element of that distance, and distance of the asked point
        from the points' middle over the radius; -1 where they lie on one line.
    """
    near, kept = np.zeros((len(rows), 4)), np.zeros(len(rows), np.int64)
    seen = np.zeros(int(limits[0]) + 1)
    matrix, axes = np.zeros((3, 3)), np.zeros((3, 3))
    gram, side = np.zeros((6, 6)), np.zeros((3, 6))
    for n in range(len(asked)):
        found[n, 0] = 0.0
        count = _nearest_rows(
            asked[n, 0], asked[n, 1], asked[n, 2], low, radius, slots, bin_keys, starts, rows,
            int(limits[0]), near, kept,
        )  # fmt: skip
        inside, n_seen, least, first = 0, 0, math.inf, -1
        for c in range(count):
            exposure = rows[kept[c], 3]
            if exposure == asked[n, 3]:
                continue
            if near[c, 3] < least:
                least, first = near[c, 3], kept[c]
            is_new = True
            for k in range(n_seen):
                if seen[k] == exposure:
                    is_new = False
                    break
            if is_new:
                seen[n_seen] = exposure
                n_seen += 1
            for k in range(3):
                near[inside, k] = near[c, k]
            inside += 1
        if inside >= limits[1] and n_seen >= limits[2]:
            found[n, 0], found[n, 1] = 1.0, rows[first, 4]
            _fit_quadric(near, inside, radius, limits[3], matrix, axes, gram, side, found[n])


@compiled()
def _nearest_rows(
    x: float,
    y: float,
    z: float,
    low: Floats,
    radius: float,
    slots: Ints,
    bin_keys: Ints,
    starts: Ints,
    rows: Table,
    most: int,
    near: TableOut,
    kept: IntsOut,
) -> int:
    """Count of the nearest rows within the radius: their offsets, squares and numbers."""
    mask, count = len(slots) - 1, 0
    bin_x = math.floor((x - low[0]) / radius) + 1
    bin_y = math.floor((y - low[1]) / radius) + 1
    bin_z = math.floor((z - low[2]) / radius) + 1
    for i in range(bin_x - 1, bin_x + 2):
        for j in range(bin_y - 1, bin_y + 2):
            for k in range(bin_z - 1, bin_z + 2):
                key = (i << BIN_BITS | j) << BIN_BITS | k
                row = slots[_slot_of(key, slots, bin_keys, mask)]
                if row < 0:
                    continue
                for m in range(starts[row], starts[row + 1]):
                    dx, dy, dz = rows[m, 0] - x, rows[m, 1] - y, rows[m, 2] - z
                    square = dx * dx + dy * dy + dz * dz
                    if square < radius * radius:
                        near[count, 0], near[count, 1], near[count, 2] = dx, dy, dz
                        near[count, 3] = square
                        kept[count] = m
                        count += 1
    if count <= most:
        return count
    # halved until so many lie below it; a library's selection takes seconds to compile
    low_square, bound = 0.0, radius * radius
    for _ in range(HALVINGS):
        middle = 0.5 * (low_square + bound)
        inside = 0
        for c in range(count):
            inside += 1 if near[c, 3] < middle else 0
        if inside < most:
            low_square = middle
        else:
            bound = middle
        if inside == most:
            break
    inside = 0
    for c in range(count):
        if near[c, 3] < bound and inside < most:
            for k in range(4):
                near[inside, k] = near[c, k]
            kept[inside] = kept[c]
            inside += 1
    return inside


@compiled(error_model="numpy")
def _fit_quadric(
    near: TableOut,
    count: int,
    radius: float,
    ridge: float,
    matrix: TableOut,
    axes: TableOut,
    gram: TableOut,
    side: TableOut,
    found: FloatsOut,
) -> None:
    """What `quadric_offsets` says of a point, from offsets of the points near it."""
    mean, terms = side[0], side[1]
    for i in range(6):
        mean[i] = side[2, i] = 0.0
        for j in range(6):
            gram[i, j] = 0.0
    for i in range(3):
        for j in range(3):
            matrix[i, j] = 0.0
    for c in range(count):
        for i in range(3):
            mean[i] += near[c, i] / count
    for c in range(count):
        for i in range(3):
            for j in range(3):
                matrix[i, j] += (near[c, i] - mean[i]) * (near[c, j] - mean[j])
    principal_axes(matrix, axes)
    low, high = 0, 0
    for k in range(1, 3):
        low = k if matrix[k, k] < matrix[low, low] else low
        high = k if matrix[k, k] >= matrix[high, high] else high
    middle = 3 - low - high
    sum_u = sum_v = 0.0
    for c in range(count):
        u = v = w = 0.0
        for i in range(3):
            u += near[c, i] * axes[i, high] / radius
            v += near[c, i] * axes[i, middle] / radius
            w += near[c, i] * axes[i, low] / radius
        near[c, 0], near[c, 1], near[c, 2] = u, v, w
        sum_u, sum_v = sum_u + u, sum_v + v
        _put_terms(u, v, terms)
        for i in range(6):
            side[2, i] += terms[i] * w
            for j in range(i + 1):
                gram[i, j] += terms[i] * terms[j]
    # Cholesky's factor; `mean` becomes the solution of it for the first unit vector
    for i in range(6):
        gram[i, i] += ridge
        for j in range(i + 1):
            rest = gram[i, j]
            for k in range(j):
                rest -= gram[i, k] * gram[j, k]
            gram[i, j] = math.sqrt(rest) if i == j else rest / gram[j, j]
        mean[i] = 1.0 if i == 0 else 0.0
        for k in range(i):
            mean[i] -= gram[i, k] * mean[k]
            side[2, i] -= gram[i, k] * side[2, k]
        mean[i] /= gram[i, i]
        side[2, i] /= gram[i, i]
    inverse = 0.0
    for i in range(5, -1, -1):
        inverse += mean[i] * mean[i]
        for k in range(i + 1, 6):
            side[2, i] -= gram[k, i] * side[2, k]
        side[2, i] /= gram[i, i]
    left = 0.0
    for c in range(count):
        _put_terms(near[c, 0], near[c, 1], terms)
        apart = near[c, 2]
        for i in range(6):
            apart -= terms[i] * side[2, i]
        left += apart * apart
    is_wide = matrix[middle, middle] > WIDE * matrix[high, high]
    found[2] = -side[2, 0]
    for i in range(3):
        found[3 + i] = axes[i, low]
    found[6], found[7] = math.sqrt(left / max(count - 6.0, 1.0)), inverse
    found[8] = math.hypot(sum_u, sum_v) / count if is_wide else -1.0


@compiled(is_inlined=True)
def _put_terms(u: float, v: float, terms: FloatsOut) -> None:
    terms[0], terms[1], terms[2], terms[3], terms[4], terms[5] = 1.0, u, v, u * u, u * v, v * v
