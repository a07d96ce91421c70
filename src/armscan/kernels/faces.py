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
    Three,
    compiled,
)
from armscan.kernels.grids import BIN_BITS, slot_of

CELLS_A_BIN = 4
"""Along an axis: a bin is as wide as the radius about a point, a cell a quarter of it."""
MOST_NEAR = 1024
"""Means within the radius of a cell: those of 9 x 9 x 9 cells at most."""
WIDE = 0.02
"""Points whose variance across is less than this part of that along lie on one line."""
HALVINGS = 60
"""Steps that seek a bound between two squares of distances; many more than are taken."""
AT_ONCE = 16
FEW_PLACES = 3000
"""To go through so many takes less than to look for bins that are mostly empty."""
X, Y, Z, SQUARE = (row * MOST_NEAR for row in range(4))
"""Where the coordinates of the means near a cell begin, and the squares of their distances."""


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
                row = slots[slot_of(key, slots, bin_keys, mask)]
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
    least, middle, _ = _spreads(xx, xy, xz, yy, yz, zz)
    width = math.sqrt(max(middle, 0.0))
    thickness = math.sqrt(max(least, 0.0))
    if width < limits[2] * radius or thickness > limits[3] * width:
        return
    _axis_of(xx, xy, xz, yy, yz, zz, least, found)


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def _spreads(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> Three:
    """Eigenvalues of a symmetric matrix, rising."""
    mean = (xx + yy + zz) / 3.0
    a, b, c_ = xx - mean, yy - mean, zz - mean
    spread = math.sqrt((a * a + b * b + c_ * c_ + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if not spread > 0.0:
        return mean, mean, mean
    det = a * (b * c_ - yz * yz) - xy * (xy * c_ - yz * xz) + xz * (xy * yz - b * xz)
    cosine = min(max(0.5 * det / (spread * spread * spread), -1.0), 1.0)
    angle = math.acos(cosine) / 3.0
    least = mean + 2.0 * spread * math.cos(angle + 2.0 * math.pi / 3.0)
    largest = mean + 2.0 * spread * math.cos(angle)
    return least, 3.0 * mean - least - largest, largest


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def _axis_of(
    xx: float,
    xy: float,
    xz: float,
    yy: float,
    yz: float,
    zz: float,
    least: float,
    found: FloatsOut,
) -> None:
    """Unit eigenvector (3,) of a symmetric matrix for a single root; as it was if there is none."""
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


@compiled(is_inlined=True)
def _least_square(
    place: Floats, u: Floats, v: Floats, w: Floats, of: Floats, limit: float, least: FloatsOut
) -> float:
    """Least square of the distances of a place (4,) to others (N,) of another exposure, or a limit.

    ``least``: (`AT_ONCE`,) for what is found on the way: so many are compared at once.
    """
    x, y, z, own = place[0], place[1], place[2], place[3]
    least[:] = limit
    whole = len(u) - len(u) % AT_ONCE
    for first in range(0, whole, AT_ONCE):
        part = slice(first, first + AT_ONCE)
        a, b, c, other = u[part], v[part], w[part], of[part]
        for k in range(AT_ONCE):
            dx, dy, dz = a[k] - x, b[k] - y, c[k] - z
            square = dx * dx + dy * dy + dz * dz
            square = square if other[k] != own else math.inf
            least[k] = square if square < least[k] else least[k]
    best = limit
    for m in range(whole, len(u)):
        dx, dy, dz = u[m] - x, v[m] - y, w[m] - z
        if of[m] != own:
            best = min(best, dx * dx + dy * dy + dz * dz)
    for k in range(AT_ONCE):
        best = min(best, least[k])
    return best


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
    mask, columns = len(slots) - 1, np.ascontiguousarray(places.T)
    u_, v_, w_, of = columns[0], columns[1], columns[2], columns[3]
    least = np.zeros(AT_ONCE)
    for s in range(len(asked)):
        x, y, z, own = asked[s, 0], asked[s, 1], asked[s, 2], asked[s, 3]
        if len(places) <= FEW_PLACES:
            best = nearest[s] * nearest[s]
            nearest[s] = math.sqrt(_least_square(asked[s], u_, v_, w_, of, best, least))
            continue
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
                        row = slots[slot_of(key, slots, bin_keys, mask)]
                        if row < 0:
                            continue
                        for m in range(starts[row], starts[row + 1]):
                            if of[m] != own:
                                dx, dy, dz = u_[m] - x, v_[m] - y, w_[m] - z
                                best = min(best, dx * dx + dy * dy + dz * dz)
            ring += 1
        nearest[s] = math.sqrt(best)


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
    # of one place more than there are rows: what is not kept is written, too
    offsets, kept = np.zeros((5, len(rows) + 1)), np.zeros(len(rows) + 1, np.int64)
    x, y, z, square = offsets[0], offsets[1], offsets[2], offsets[3]
    places = np.ascontiguousarray(rows.T)
    seen, axes = np.zeros(int(limits[0]) + 1), np.zeros((3, 3))
    scratch, spans = np.zeros((14, 6)), np.zeros(2 * BINS_ABOUT, np.int64)
    last_x, last_y, last_z, n_spans = -1, -1, -1, 0
    for n in range(len(asked)):
        found[n, 0] = 0.0
        bin_x = math.floor((asked[n, 0] - low[0]) / radius) + 1
        bin_y = math.floor((asked[n, 1] - low[1]) / radius) + 1
        bin_z = math.floor((asked[n, 2] - low[2]) / radius) + 1
        if bin_x != last_x or bin_y != last_y or bin_z != last_z:
            n_spans = _spans_about(bin_x, bin_y, bin_z, slots, bin_keys, starts, spans)
            last_x, last_y, last_z = bin_x, bin_y, bin_z
        count = _nearest_rows(
            asked[n], radius, places, spans[: 2 * n_spans], int(limits[0]), offsets, kept
        )
        if count < limits[1]:
            continue
        inside, n_seen, least, first = 0, 0, math.inf, -1
        for c in range(count):
            exposure = rows[kept[c], 3]
            if exposure == asked[n, 3]:
                continue
            if square[c] < least:
                least, first = square[c], kept[c]
            is_new = True
            for k in range(n_seen):
                if seen[k] == exposure:
                    is_new = False
                    break
            if is_new:
                seen[n_seen] = exposure
                n_seen += 1
            x[inside], y[inside], z[inside] = x[c], y[c], z[c]
            inside += 1
        if inside >= limits[1] and n_seen >= limits[2]:
            found[n, 0], found[n, 1] = 1.0, rows[first, 4]
            own = found[n]
            _fit_quadric(x, y, z, inside, radius, limits[3], axes, scratch, own)


BINS_ABOUT = 27
"""A bin, and all that touch it."""
SECANTS = 20
"""Steps that seek a bound by how a surface fills; where they end without, it is halved."""


@compiled()
def _spans_about(
    bin_x: int,
    bin_y: int,
    bin_z: int,
    slots: Ints,
    bin_keys: Ints,
    starts: Ints,
    spans: IntsOut,
) -> int:
    """First row and row after the last of each bin about one, one pair after another.

    Returns how many pairs there are.
    """
    mask, count = len(slots) - 1, 0
    for i in range(bin_x - 1, bin_x + 2):
        for j in range(bin_y - 1, bin_y + 2):
            for k in range(bin_z - 1, bin_z + 2):
                key = (i << BIN_BITS | j) << BIN_BITS | k
                row = slots[slot_of(key, slots, bin_keys, mask)]
                if row >= 0:
                    spans[2 * count], spans[2 * count + 1] = starts[row], starts[row + 1]
                    count += 1
    return count


@compiled()
def _nearest_rows(
    place: Floats,
    radius: float,
    places: Table,
    spans: Ints,
    most: int,
    offsets: TableOut,
    kept: IntsOut,
) -> int:
    """Count of the nearest rows within the radius: their offsets and squares, and numbers.

    ``places``: (>= 3, M). ``spans``: Of `_spans_about`. ``offsets``: (5, M + 1) of which the
    last one is scratch.
    """
    x, y, z, square, apart = offsets[0], offsets[1], offsets[2], offsets[3], offsets[4]
    limit, count = radius * radius, 0
    for s in range(0, len(spans), 2):
        first, stop = spans[s], spans[s + 1]
        u, v, w = places[0, first:stop], places[1, first:stop], places[2, first:stop]
        for k in range(stop - first):
            dx, dy, dz = u[k] - place[0], v[k] - place[1], w[k] - place[2]
            apart[k] = dx * dx + dy * dy + dz * dz
        for k in range(stop - first):
            square[count], kept[count] = apart[k], first + k
            count += 1 if apart[k] < limit else 0
    for c in range(count):
        m = kept[c]
        x[c], y[c], z[c] = places[0, m] - place[0], places[1, m] - place[1], places[2, m] - place[2]
    if count <= most:
        return count
    bound = _nearest_bound(square[:count], radius * radius, most)
    inside = 0
    for c in range(count):
        if inside == most:
            break
        x[inside], y[inside], z[inside], square[inside] = x[c], y[c], z[c], square[c]
        kept[inside] = kept[c]
        inside += 1 if square[inside] < bound else 0
    return inside


@compiled(error_model="numpy", fastmath=FUSED)
def _nearest_bound(squares: Floats, largest: float, most: int) -> float:
    """A number below which ``most`` of the squares lie, or, of equal ones, as few more as can be.

    All lie below ``largest``, and there are more of them.
    """
    low, high, guess = 0.0, largest, largest * (most + 0.5) / len(squares)
    for step in range(SECANTS + HALVINGS):
        inside = 0.0
        for c in range(len(squares)):
            inside += 1.0 if squares[c] < guess else 0.0
        if inside == most:
            return guess
        if inside < most:
            low = guess
        else:
            high = guess
        wanted = middle = 0.5 * (low + high)
        if step < SECANTS:
            wanted = guess * (most + 0.5) / max(inside, 1.0)
        reach = 0.25 * (high - low)
        guess = min(max(wanted, middle - reach), middle + reach)
    return high


@compiled(error_model="numpy", fastmath=FUSED)
def _fit_quadric(
    x: FloatsOut,
    y: FloatsOut,
    z: FloatsOut,
    count: int,
    radius: float,
    ridge: float,
    axes: TableOut,
    scratch: TableOut,
    found: FloatsOut,
) -> None:
    """What `quadric_offsets` says of a point, from offsets (N,) of the points near it.

    ``axes``: (3, 3), and ``scratch``: (14, 6), for what is found on the way.
    """
    is_wide = _principal_rows(x, y, z, count, axes)
    _turn_offsets(x, y, z, count, 1.0 / radius, axes)
    gram, side = scratch[:6], scratch[6]
    _sum_terms(x, y, z, count, gram, side)
    inverse = _solve_terms(gram, side, ridge, scratch[7:])
    a, b, c, d, e, f = side[0], side[1], side[2], side[3], side[4], side[5]
    left = 0.0
    for k in range(count):
        u, v = x[k], y[k]
        apart = z[k] - (a + b * u + c * v + d * u * u + e * u * v + f * v * v)
        left += apart * apart
    found[2] = -a
    for k in range(3):
        found[3 + k] = axes[2, k]
    found[6], found[7] = math.sqrt(left / max(count - 6.0, 1.0)), inverse
    found[8] = math.hypot(gram[1, 0], gram[2, 0]) / count if is_wide else -1.0


@compiled(error_model="numpy", fastmath=FUSED)
def _principal_rows(x: Floats, y: Floats, z: Floats, count: int, axes: TableOut) -> bool:
    """Unit axes (3, 3), row by row, along which offsets from their mean vary most and least.

    True where they do not lie on one line.
    """
    sx = sy = sz = 0.0
    for c in range(count):
        sx += x[c]
        sy += y[c]
        sz += z[c]
    sx, sy, sz = sx / count, sy / count, sz / count
    xx = xy = xz = yy = yz = zz = 0.0
    for c in range(count):
        dx, dy, dz = x[c] - sx, y[c] - sy, z[c] - sz
        xx += dx * dx
        xy += dx * dy
        xz += dx * dz
        yy += dy * dy
        yz += dy * dz
        zz += dz * dz
    axis, first, second = axes[2], axes[0], axes[1]
    least, middle, largest = _spreads(xx, xy, xz, yy, yz, zz)
    axis[0], axis[1], axis[2] = 0.0, 0.0, 1.0
    _axis_of(xx, xy, xz, yy, yz, zz, least, axis)
    # any two axes across the least one, turned by what the scatter between them asks for
    p, q = 0, 1
    if axis[2] * axis[2] > axis[0] * axis[0]:
        p, q = 1, 2
    first[0] = first[1] = first[2] = 0.0
    first[q], first[p] = axis[p], -axis[q]
    length = 1.0 / math.sqrt(axis[p] * axis[p] + axis[q] * axis[q])
    for k in range(3):
        first[k] *= length
    second[0] = axis[1] * first[2] - axis[2] * first[1]
    second[1] = axis[2] * first[0] - axis[0] * first[2]
    second[2] = axis[0] * first[1] - axis[1] * first[0]
    ax = xx * first[0] + xy * first[1] + xz * first[2]
    ay = xy * first[0] + yy * first[1] + yz * first[2]
    az = xz * first[0] + yz * first[1] + zz * first[2]
    off = ax * second[0] + ay * second[1] + az * second[2]
    own = ax * first[0] + ay * first[1] + az * first[2]
    half = own - 0.5 * (middle + largest)
    size = math.sqrt(half * half + off * off)
    if size > 0.0:
        # of half of the angle, from where nothing cancels
        cosine = math.sqrt(0.5 * (1.0 + abs(half) / size))
        sine = 0.5 * off / (size * cosine)
        if half < 0.0:
            cosine, sine = abs(sine), math.copysign(cosine, off)
        for k in range(3):
            along, across = first[k], second[k]
            first[k] = cosine * along + sine * across
            second[k] = cosine * across - sine * along
    return bool(middle > WIDE * largest)


@compiled(error_model="numpy", fastmath=FUSED)
def _turn_offsets(
    x: FloatsOut, y: FloatsOut, z: FloatsOut, count: int, share: float, axes: Table
) -> None:
    """Offsets along the rows of ``axes`` (3, 3), times a share."""
    ux, uy, uz = share * axes[0, 0], share * axes[0, 1], share * axes[0, 2]
    vx, vy, vz = share * axes[1, 0], share * axes[1, 1], share * axes[1, 2]
    wx, wy, wz = share * axes[2, 0], share * axes[2, 1], share * axes[2, 2]
    for c in range(count):
        dx, dy, dz = x[c], y[c], z[c]
        x[c] = ux * dx + uy * dy + uz * dz
        y[c] = vx * dx + vy * dy + vz * dz
        z[c] = wx * dx + wy * dy + wz * dz


@compiled(error_model="numpy", fastmath=FUSED)
def _sum_terms(
    u: Floats, v: Floats, w: Floats, count: int, gram: TableOut, side: FloatsOut
) -> None:
    """Products of the terms 1, u, v, u^2, u v, v^2 with each other, the lower half, and with w."""
    u1 = v1 = u2 = uv = v2 = u3 = u2v = uv2 = v3 = u4 = u3v = u2v2 = uv3 = v4 = 0.0
    w1 = uw = vw = u2w = uvw = v2w = 0.0
    for c in range(count):
        uu, mixed, vv = u[c] * u[c], u[c] * v[c], v[c] * v[c]
        u1 += u[c]
        v1 += v[c]
        u2 += uu
        uv += mixed
        v2 += vv
        u3 += uu * u[c]
        u2v += uu * v[c]
        uv2 += vv * u[c]
        v3 += vv * v[c]
        u4 += uu * uu
        u3v += uu * mixed
        u2v2 += uu * vv
        uv3 += vv * mixed
        v4 += vv * vv
        w1 += w[c]
        uw += u[c] * w[c]
        vw += v[c] * w[c]
        u2w += uu * w[c]
        uvw += mixed * w[c]
        v2w += vv * w[c]
    gram[0, 0], gram[1, 0], gram[2, 0] = count, u1, v1
    gram[1, 1], gram[2, 1], gram[2, 2] = u2, uv, v2
    gram[3, 0], gram[4, 0], gram[5, 0] = u2, uv, v2
    gram[3, 1], gram[4, 1], gram[5, 1] = u3, u2v, uv2
    gram[3, 2], gram[4, 2], gram[5, 2] = u2v, uv2, v3
    gram[3, 3], gram[4, 3], gram[5, 3] = u4, u3v, u2v2
    gram[4, 4], gram[5, 4], gram[5, 5] = u2v2, uv3, v4
    side[0], side[1], side[2], side[3], side[4], side[5] = w1, uw, vw, u2w, uvw, v2w


@compiled(error_model="numpy", fastmath=FUSED)
def _solve_terms(gram: Table, side: FloatsOut, ridge: float, factor: TableOut) -> float:
    """Solve for (6,) in place; returns the first element of the inverse.

    ``gram``: (6, 6) of which the lower half counts; ``ridge`` is added to its diagonal.
    ``factor``: (7, 6) for Cholesky's, and the solution of it for the first unit vector.
    """
    for i in range(6):
        for j in range(i + 1):
            rest = gram[i, j] + (ridge if i == j else 0.0)
            for k in range(j):
                rest -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(rest) if i == j else rest / factor[j, j]
        first = 1.0 if i == 0 else 0.0
        for k in range(i):
            first -= factor[i, k] * factor[6, k]
            side[i] -= factor[i, k] * side[k]
        factor[6, i] = first / factor[i, i]
        side[i] /= factor[i, i]
    inverse = 0.0
    for i in range(5, -1, -1):
        inverse += factor[6, i] * factor[6, i]
        for k in range(i + 1, 6):
            side[i] -= factor[k, i] * side[k]
        side[i] /= factor[i, i]
    return inverse
