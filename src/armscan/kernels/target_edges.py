# SPDX-License-Identifier: Apache-2.0
"""Edges of printed targets: pixels along an ellipse's rim, edge profiles in sectors, conics by
Sampson distance, and corners where two edges cross. What the sums mean is told where they are used,
in `armscan.vision.targets`.
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
    Two,
    compiled,
)

NEWTON_STEPS = 8
_COMMON_STEPS = 3
"""Taken of all pixels of a rim together; the few that have not settled go on one by one."""
_AT_REST_RAD = 1e-4
"""Newton steps double the digits, and the distance is stationary: the next one is for nothing."""


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def direction_angle(c: float, s: float) -> float:
    """Angle of a vector to 2e-8 rad (Abramowitz and Stegun 4.4.49), for sorting into sectors."""
    x, y = abs(c), abs(s)
    is_steep = y > x
    t = x / y if is_steep else y / (x if x > 1e-300 else 1e-300)
    r = t * t
    a = 0.0429096138 + r * (-0.0161657367 + r * 0.0028662257)
    a = 0.1999355085 + r * (-0.1420889944 + r * (0.1065626393 + r * (-0.0752896400 + r * a)))
    a = t * (1.0 + r * (-0.3333314528 + r * a))
    a = 0.5 * math.pi - a if is_steep else a
    a = math.pi - a if c < 0.0 else a
    return -a if s < 0.0 else a


@compiled(error_model="numpy", fastmath=FUSED, is_inlined=True)
def _rim_step(x: float, y: float, p: float, q: float, c: float, s: float) -> Three:
    """A Newton step to the nearest point (p c, q s) of a rim: its c and s, and the step, rad."""
    focal = q * q - p * p
    slope = focal * s * c + p * x * s - q * y * c
    bend = focal * (c * c - s * s) + p * x * c + q * y * s
    least = 0.1 * p * p
    step = slope / (bend if bend > least else least)
    step = step if step > -0.3 else -0.3
    step = step if step < 0.3 else 0.3
    norm = 1.0 / math.sqrt(1.0 + step * step)
    return (c + s * step) * norm, (s - c * step) * norm, abs(step)


@compiled(error_model="numpy", fastmath=FUSED)
def _measure_rim(p: float, q: float, count: int, near: TableOut) -> None:
    """Distance and angle of ``count`` pixels from an ellipse of half axes p and q.

    ``near``: (7, M) x and y along the axes, px; output: cosine and sine of the nearest rim point's
    parametric angle, the last step, rad; the distance, px, and the angle, rad.
    """
    x, y, c, s, last = near[0], near[1], near[2], near[3], near[4]
    for k in range(count):
        norm = 1.0 / math.sqrt(q * x[k] * q * x[k] + p * y[k] * p * y[k])
        c[k], s[k] = q * x[k] * norm, p * y[k] * norm
    for _ in range(_COMMON_STEPS):
        for k in range(count):
            c[k], s[k], last[k] = _rim_step(x[k], y[k], p, q, c[k], s[k])
    for k in range(count):
        for _ in range(NEWTON_STEPS - _COMMON_STEPS):
            if last[k] < _AT_REST_RAD:
                break
            c[k], s[k], last[k] = _rim_step(x[k], y[k], p, q, c[k], s[k])
    distance, angle = near[5], near[6]
    for k in range(count):
        outward = (x[k] - p * c[k]) * q * c[k] + (y[k] - q * s[k]) * p * s[k]
        distance[k] = outward / math.sqrt(q * c[k] * q * c[k] + p * s[k] * p * s[k])
        angle[k] = direction_angle(c[k], s[k])


@compiled(error_model="numpy")
def collect_band(
    rims: Table,
    width: Floats,
    n_columns: int,
    n_rows: int,
    place: IntsOut,
    ellipse: IntsOut,
    found: TableOut,
) -> int:
    """Collect the pixels whose distance to a rim is at most ``width``; return their count.

    ``rims``: (N, 10) centre u, v, half axes p, q, direction of p, that of q (unit vectors), and
    relative slope of the illumination along u, v, per px. ``width``: (N,) px. ``place``: (M,)
    output: ``row * n_columns + column``, ellipse by ellipse, row by row. ``ellipse``: (M,) output:
    number of the ellipse. ``found``: (3, M) output: distance, px, positive outside; parametric
    angle of the nearest rim point, rad; illumination relative to that of the centre. M: at least
    the pixels of all boxes around the bands.
    """
    count = 0
    near = np.zeros((7, 0))
    for i in range(rims.shape[0]):
        centre_u, centre_v, p, q = rims[i, 0], rims[i, 1], rims[i, 2], rims[i, 3]
        pu, pv, qu, qv = rims[i, 4], rims[i, 5], rims[i, 6], rims[i, 7]
        slope_u, slope_v = rims[i, 8], rims[i, 9]
        reach_u = math.sqrt((pu * p) ** 2 + (qu * q) ** 2) + width[i] + 1.0
        reach_v = math.sqrt((pv * p) ** 2 + (qv * q) ** 2) + width[i] + 1.0
        if not math.isfinite(centre_u + centre_v + reach_u + reach_v):
            continue
        first_u = int(max(math.floor(centre_u - reach_u), 0.0))
        first_v = int(max(math.floor(centre_v - reach_v), 0.0))
        last_u = int(min(math.ceil(centre_u + reach_u), n_columns - 1.0))
        last_v = int(min(math.ceil(centre_v + reach_v), n_rows - 1.0))
        # a parallel curve of an ellipse lies between these two ellipses
        inner_x = max(p - width[i] - 0.5, 0.1) ** -2.0
        inner_y = max(q - width[i] - 0.5, 0.1) ** -2.0
        outer_x = (p + width[i] + 0.5) ** -2.0
        outer_y = (q + width[i] + 0.5) ** -2.0
        n_box = max(last_u - first_u + 1, 0) * max(last_v - first_v + 1, 0)
        if n_box > near.shape[1]:
            near = np.zeros((7, n_box))
        n_near = 0
        for v in range(first_v, last_v + 1):
            for u in range(first_u, last_u + 1):
                du, dv = u - centre_u, v - centre_v
                x = du * pu + dv * pv
                y = du * qu + dv * qv
                if x * x * inner_x + y * y * inner_y < 1.0:
                    continue
                if x * x * outer_x + y * y * outer_y > 1.0:
                    continue
                near[0, n_near], near[1, n_near] = x, y
                place[count + n_near] = v * n_columns + u
                n_near += 1
        _measure_rim(p, q, n_near, near)
        first = count
        for k in range(n_near):
            if abs(near[5, k]) > width[i]:
                continue
            at = place[first + k]
            du, dv = at % n_columns - centre_u, at // n_columns - centre_v
            place[count] = at
            ellipse[count] = i
            found[0, count] = near[5, k]
            found[1, count] = near[6, k]
            found[2, count] = 1.0 + (slope_u * du + slope_v * dv)
            count += 1
    return count


@compiled()
def order_by_sector(
    levels: Floats,
    distance: Floats,
    angle: Floats,
    ellipse: Ints,
    n_sectors: int,
    starts: IntsOut,
    pixels: TableOut,
) -> None:
    """Order pixels by circle and sector.

    ``levels``, ``distance``, ``angle``, ``ellipse``: (M,) as from `collect_band`. ``n_sectors``: K.
    ``starts``: (N K + 1,) zeros; output: first pixel of each sector, and M. ``pixels``: (2, M)
    output: levels and distances.
    """
    sector = np.zeros(len(ellipse), np.int64)
    for m in range(len(ellipse)):
        turn = angle[m] / (2.0 * math.pi)
        turn -= math.floor(turn)
        k = min(int(turn * n_sectors), n_sectors - 1)
        sector[m] = ellipse[m] * n_sectors + k
        starts[sector[m] + 1] += 1
    for j in range(1, len(starts)):
        starts[j] += starts[j - 1]
    at = starts.copy()
    for m in range(len(ellipse)):
        k = at[sector[m]]
        at[sector[m]] = k + 1
        pixels[0, k] = levels[m]
        pixels[1, k] = distance[m]


_NODES_PER_SIGMA = 128
_NODE_SIGMAS = 1.0 / _NODES_PER_SIGMA
_FARTHEST = 8.0
_SIXTH = 1.0 / 6.0
_NORMAL = np.array(
    [
        (0.5 * math.erfc(-z / math.sqrt(2.0)), math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi))
        for z in (k * _NODE_SIGMAS - _FARTHEST for k in range(2 * 8 * _NODES_PER_SIGMA + 1))
    ]
)
"""Normal distribution and density at nodes; three terms of Taylor's series reach 2e-11 between."""
SUMS = 14


@compiled(error_model="numpy", fastmath=True)
def normal_at(z: float) -> Two:
    """Normal distribution and density, within `_FARTHEST`."""
    node = int((z + _FARTHEST) * _NODES_PER_SIGMA + 0.5)
    node = min(max(node, 0), len(_NORMAL) - 1)
    at = node * _NODE_SIGMAS - _FARTHEST
    t = z - at
    share = _NORMAL[node, 0] + _NORMAL[node, 1] * t * (
        1.0 + t * (-0.5 * at + t * ((at * at - 1.0) * _SIXTH))
    )
    a = -t * (at + 0.5 * t)
    return share, _NORMAL[node, 1] * (1.0 + a * (1.0 + a * (0.5 + a * _SIXTH)))


@compiled(error_model="numpy", fastmath=True)
def sector_sums(
    pixels: Table, first: int, last: int, sector: Floats, blur: float, sums: FloatsOut
) -> float:
    """Sum up one sector's normal equations into ``sums`` (14,); return the squared residuals.

    ``pixels``: (2, M) levels and distances, px. ``first``, ``last``: The sector's pixels.
    ``sector``: (3,) inner level, outer level, shift. ``blur``: px. The sums: the derivatives by
    the three 00, 01, 02, 11, 12, 22; with the residual 0, 1, 2; with the derivative by the blur
    0, 1, 2; that derivative squared, and with the residual.
    """
    inner, contrast, shift = sector[0], sector[1] - sector[0], sector[2]
    n00 = n01 = n02 = n11 = n12 = n22 = 0.0
    r0 = r1 = r2 = b0 = b1 = b2 = bb = br = square = 0.0
    per_blur, steepest = 1.0 / blur, contrast / blur
    for k in range(first, last):
        z = min(max((pixels[1, k] - shift) * per_blur, -_FARTHEST), _FARTHEST)
        share, density = normal_at(z)
        slope = steepest * density
        residual = pixels[0, k] - inner - contrast * share
        rest = 1.0 - share
        by_blur = -slope * z
        n00 += rest * rest
        n01 += rest * share
        n02 -= rest * slope
        n11 += share * share
        n12 -= share * slope
        n22 += slope * slope
        r0 += rest * residual
        r1 += share * residual
        r2 -= slope * residual
        b0 += rest * by_blur
        b1 += share * by_blur
        b2 -= slope * by_blur
        bb += by_blur * by_blur
        br += by_blur * residual
        square += residual * residual
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = n00, n01, n02, n11, n12, n22
    sums[6], sums[7], sums[8] = r0, r1, r2
    sums[9], sums[10], sums[11] = b0, b1, b2
    sums[12], sums[13] = bb, br
    return square


@compiled(error_model="numpy")
def solve_sector(sums: FloatsOut, weight: float) -> float:
    """Solve a sector's equations for two right-hand sides; return the shift's variance.

    ``sums``: From `sector_sums`; elements 6 to 8 and 9 to 11 are replaced by the solutions.
    ``weight``: That of what is expected of the levels.
    """
    ridge = 1e-9 * (sums[0] + sums[3] + sums[5] + 2.0 * weight) + 1e-9
    l00 = math.sqrt(sums[0] + weight + ridge)
    l10, l20 = sums[1] / l00, sums[2] / l00
    l11 = math.sqrt(sums[3] + weight + ridge - l10 * l10)
    l21 = (sums[4] - l20 * l10) / l11
    l22 = math.sqrt(sums[5] + ridge - l20 * l20 - l21 * l21)
    for k in (6, 9):
        y0 = sums[k] / l00
        y1 = (sums[k + 1] - l10 * y0) / l11
        y2 = (sums[k + 2] - l20 * y0 - l21 * y1) / l22
        sums[k + 2] = y2 / l22
        sums[k + 1] = (y1 - l21 * sums[k + 2]) / l11
        sums[k] = (y0 - l10 * sums[k + 1] - l20 * sums[k + 2]) / l00
    return 1.0 / (l22 * l22)


@compiled(error_model="numpy")
def fit_sectors(
    pixels: Table,
    starts: Ints,
    expected: Table,
    least_blur: float,
    steps: int,
    blur: FloatsOut,
    sectors: TableOut,
) -> None:
    """Fit an erf edge in each sector of each circle by Gauss-Newton steps, one blur a circle.

    The blurs' own equations come from eliminating the sectors (Schur).

    ``pixels``: (2, M) levels and distances from the rim, px, sector by sector. ``starts``:
    (N K + 1,) first pixel of each sector, and M. ``expected``: (N, 3) inner and outer level
    expected of the circle's sectors, and the weight of that in pixels; 0 expects nothing.
    ``least_blur``: px. ``steps``: Gauss-Newton steps. ``blur``: (N,) start and result, px.
    ``sectors``: (N K, 5) output: inner level, outer level, shift, px; the shift's variance for
    residuals of variance 1; sum of the squared residuals.
    """
    n_circles = blur.shape[0]
    n_sectors = sectors.shape[0] // n_circles if n_circles > 0 else 0
    solved = np.zeros((n_sectors, SUMS))
    for i in range(n_circles):
        weight = expected[i, 2]
        reach = 0.0
        for k in range(n_sectors):
            j = i * n_sectors + k
            n_outside = 0
            outside = inside = 0.0
            for m in range(starts[j], starts[j + 1]):
                reach = max(reach, abs(pixels[1, m]))
                if pixels[1, m] > 0.0:
                    n_outside += 1
                    outside += pixels[0, m]
                else:
                    inside += pixels[0, m]
            n_inside = starts[j + 1] - starts[j] - n_outside
            sectors[j, 0] = inside / max(n_inside, 1)
            sectors[j, 1] = outside / max(n_outside, 1)
            sectors[j, 2] = 0.0
        for _ in range(steps):
            stiffness = pull = 0.0
            for k in range(n_sectors):
                j = i * n_sectors + k
                sums = solved[k]
                sector_sums(pixels, starts[j], starts[j + 1], sectors[j], blur[i], sums)
                sums[6] += weight * (expected[i, 0] - sectors[j, 0])
                sums[7] += weight * (expected[i, 1] - sectors[j, 1])
                r0, r1, r2 = sums[6], sums[7], sums[8]
                b0, b1, b2 = sums[9], sums[10], sums[11]
                solve_sector(sums, weight)
                stiffness += sums[12] - b0 * sums[9] - b1 * sums[10] - b2 * sums[11]
                pull += sums[13] - r0 * sums[9] - r1 * sums[10] - r2 * sums[11]
            step = pull / max(stiffness, 1e-9)
            step = min(max(step, -0.4 * blur[i]), 0.6 * blur[i])
            new_blur = min(max(blur[i] + step, least_blur), 0.8 * reach)
            shared = new_blur - blur[i]
            blur[i] = new_blur
            for k in range(n_sectors):
                j = i * n_sectors + k
                for m in range(3):
                    sectors[j, m] += solved[k, 6 + m] - solved[k, 9 + m] * shared
                sectors[j, 2] = min(max(sectors[j, 2], -0.6 * reach), 0.6 * reach)
        for k in range(n_sectors):
            j = i * n_sectors + k
            sums = solved[k]
            sectors[j, 4] = sector_sums(pixels, starts[j], starts[j + 1], sectors[j], blur[i], sums)
            sectors[j, 3] = solve_sector(sums, weight)


TERMS = 5


@compiled(error_model="numpy")
def sampson_sums(
    points: Table,
    weights: Floats,
    terms: Floats,
    normal: TableOut,
    gradient: FloatsOut,
) -> float:
    """Normal equations of one conic's Sampson distances; return their weighted squares.

    ``points``: (K, 2) in the conic's own coordinates. ``weights``: (K,). ``terms``: (5,) elements
    11, 12, 22, 13, 23; element 33 is -1. ``normal``: (5, 5) output, lower half. ``gradient``: (5,)
    output.
    """
    a, b, c, d, e = terms[0], terms[1], terms[2], terms[3], terms[4]
    row = np.zeros(TERMS)
    normal[:] = 0.0
    gradient[:] = 0.0
    chi2 = 0.0
    for k in range(points.shape[0]):
        if weights[k] <= 0.0:
            continue
        x, y = points[k, 0], points[k, 1]
        value = a * x * x + 2.0 * b * x * y + c * y * y + 2.0 * (d * x + e * y) - 1.0
        gx, gy = a * x + b * y + d, b * x + c * y + e
        norm = max(math.sqrt(gx * gx + gy * gy), 1e-9)
        distance = 0.5 * value / norm
        half, share = 0.5 / norm, distance / (norm * norm)
        row[0] = half * x * x - share * gx * x
        row[1] = half * 2.0 * x * y - share * (gx * y + gy * x)
        row[2] = half * y * y - share * gy * y
        row[3] = half * 2.0 * x - share * gx
        row[4] = half * 2.0 * y - share * gy
        for i in range(TERMS):
            weighted = weights[k] * row[i]
            gradient[i] += weighted * distance
            for j in range(i + 1):
                normal[i, j] += weighted * row[j]
        chi2 += weights[k] * distance * distance
    return chi2


@compiled(error_model="numpy")
def invert_symmetric(matrix: TableOut, inverse: TableOut) -> None:
    """Invert a symmetric matrix from its lower half; a tiny ridge keeps degenerate ones finite.

    ``matrix``: (P, P), overwritten. ``inverse``: (P, P) output.
    """
    n = matrix.shape[0]
    trace = 0.0
    for i in range(n):
        trace += matrix[i, i]
    # to unit diagonal: what is left is the condition that counts
    ridge = 1e-13 * trace + 1e-300
    for i in range(n):
        matrix[i, i] += ridge
    for j in range(n):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        matrix[j, j] = math.sqrt(max(pivot, 1e-16 * trace + 1e-300))
        for i in range(j + 1, n):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = value / matrix[j, j]
    column = np.zeros(n)
    for m in range(n):
        for i in range(n):
            value = 1.0 if i == m else 0.0
            for k in range(i):
                value -= matrix[i, k] * column[k]
            column[i] = value / matrix[i, i]
        for i in range(n - 1, -1, -1):
            value = column[i]
            for k in range(i + 1, n):
                value -= matrix[k, i] * column[k]
            column[i] = value / matrix[i, i]
            inverse[i, m] = column[i]


@compiled(error_model="numpy")
def fit_conics(
    points: Table,
    weights: Table,
    steps: int,
    at_rest: float,
    terms: TableOut,
    covariance: TableOut,
    chi2: FloatsOut,
) -> None:
    """Fit conics by weighted Sampson distance, each from its algebraic fit.

    ``points``: (N K, 2) in each conic's own coordinates. ``weights``: (N, K); 0 leaves a point
    out. ``steps``: Most Gauss-Newton steps. ``at_rest``: A step below this ends them. ``terms``:
    (N, 5) output. ``covariance``: (N, 25) output. ``chi2``: (N,) output.
    """
    n_points = weights.shape[1]
    normal, inverse = np.zeros((TERMS, TERMS)), np.zeros((TERMS, TERMS))
    gradient, row = np.zeros(TERMS), np.zeros(TERMS)
    for n in range(weights.shape[0]):
        own = points[n * n_points : (n + 1) * n_points]
        normal[:] = 0.0
        gradient[:] = 0.0
        for k in range(n_points):
            if weights[n, k] <= 0.0:
                continue
            x, y = own[k, 0], own[k, 1]
            row[0], row[1], row[2], row[3], row[4] = x * x, 2.0 * x * y, y * y, 2.0 * x, 2.0 * y
            for i in range(TERMS):
                gradient[i] += row[i]
                for j in range(i + 1):
                    normal[i, j] += row[i] * row[j]
        invert_symmetric(normal, inverse)
        for i in range(TERMS):
            terms[n, i] = 0.0
            for j in range(TERMS):
                terms[n, i] += inverse[i, j] * gradient[j]
        for _ in range(steps):
            sampson_sums(own, weights[n], terms[n], normal, gradient)
            invert_symmetric(normal, inverse)
            largest = 0.0
            for i in range(TERMS):
                step = 0.0
                for j in range(TERMS):
                    step += inverse[i, j] * gradient[j]
                terms[n, i] -= step
                largest = max(largest, abs(step))
            if largest < at_rest:
                break
        chi2[n] = sampson_sums(own, weights[n], terms[n], normal, gradient)
        invert_symmetric(normal, inverse)
        for i in range(TERMS):
            for j in range(TERMS):
                covariance[n, i * TERMS + j] = inverse[i, j]


CROSSING = 9
"""Parameters of a corner: place u, v; angles of the normals of two edges; blur sigma, px; mean
level; contrast; slope of the level along u, v."""
_BLOCK = 32
_RIDGE = 1e-10


@compiled(error_model="numpy", fastmath=FUSED)
def row_product(rows: Table, i: int, j: int, count: int) -> float:
    """Sum of products of two rows' first ``count`` elements.

    By itself: with sums in any order beside what is written, results depend on where arrays lie.
    """
    total = 0.0
    for k in range(count):
        total += rows[i, k] * rows[j, k]
    return total


@compiled(error_model="numpy")
def crossing_sums(
    pixels: Table,
    n_pixels: int,
    corner: Floats,
    bends: Floats,
    residuals: FloatsOut,
    normal: TableOut,
    gradient: FloatsOut,
) -> float:
    """Normal equations of one corner's levels; return the squared residuals.

    ``pixels``: (3, K) offsets u, v and levels, the first ``n_pixels`` of them. ``corner``: (9,)
    parameters. ``bends``: (2,) curvature of each edge towards its normal, 1/px. ``residuals``:
    (K,) output, measured less model. ``normal``: (9, 9) output, lower half. ``gradient``: (9,)
    output.
    """
    rows = np.zeros((CROSSING + 1, _BLOCK))
    normal[:] = 0.0
    gradient[:] = 0.0
    cos_a, sin_a = math.cos(corner[2]), math.sin(corner[2])
    cos_b, sin_b = math.cos(corner[3]), math.sin(corner[3])
    per_blur = 1.0 / corner[4]
    contrast = corner[6]
    square = 0.0
    for first in range(0, n_pixels, _BLOCK):
        count = min(_BLOCK, n_pixels - first)
        for k in range(count):
            du, dv = pixels[0, first + k] - corner[0], pixels[1, first + k] - corner[1]
            across_a, along_a = cos_a * du + sin_a * dv, cos_a * dv - sin_a * du
            across_b, along_b = cos_b * du + sin_b * dv, cos_b * dv - sin_b * du
            turn_a, turn_b = bends[0] * along_a, bends[1] * along_b
            z_a = (across_a - 0.5 * turn_a * along_a) * per_blur
            z_b = (across_b - 0.5 * turn_b * along_b) * per_blur
            share_a, density_a = normal_at(min(max(z_a, -_FARTHEST), _FARTHEST))
            share_b, density_b = normal_at(min(max(z_b, -_FARTHEST), _FARTHEST))
            edge_a, edge_b = 2.0 * share_a - 1.0, 2.0 * share_b - 1.0
            slope_a = 2.0 * contrast * density_a * per_blur * edge_b
            slope_b = 2.0 * contrast * density_b * per_blur * edge_a
            rows[0, k] = (
                -slope_a * (cos_a + turn_a * sin_a) - slope_b * (cos_b + turn_b * sin_b) - corner[7]
            )
            rows[1, k] = (
                -slope_a * (sin_a - turn_a * cos_a) - slope_b * (sin_b - turn_b * cos_b) - corner[8]
            )
            rows[2, k] = slope_a * along_a * (1.0 + bends[0] * across_a)
            rows[3, k] = slope_b * along_b * (1.0 + bends[1] * across_b)
            rows[4, k] = -slope_a * z_a - slope_b * z_b
            rows[5, k] = 1.0
            rows[6, k] = edge_a * edge_b
            rows[7, k] = du
            rows[8, k] = dv
            model = corner[5] + contrast * edge_a * edge_b + corner[7] * du + corner[8] * dv
            residual = pixels[2, first + k] - model
            rows[9, k] = residual
            residuals[first + k] = residual
            square += residual * residual
        for i in range(CROSSING):
            gradient[i] += row_product(rows, i, CROSSING, count)
            for j in range(i + 1):
                normal[i, j] += row_product(rows, i, j, count)
    return square


@compiled(error_model="numpy")
def invert_scaled(normal: Table, damping: float, work: TableOut, inverse: TableOut) -> None:
    """Invert normal equations (P, P), their diagonal times ``1 + damping``, to unit diagonal."""
    n = normal.shape[0]
    scale = np.zeros(n)
    for i in range(n):
        scale[i] = 1.0 / math.sqrt(max(normal[i, i] * (1.0 + damping), 1e-12))
    for i in range(n):
        for j in range(i):
            work[i, j] = normal[i, j] * scale[i] * scale[j]
        work[i, i] = normal[i, i] * (1.0 + damping) * scale[i] * scale[i] + _RIDGE
    invert_symmetric(work, inverse)
    for i in range(n):
        for j in range(n):
            inverse[i, j] *= scale[i] * scale[j]


@compiled(error_model="numpy")
def fit_crossings(
    levels: Table,
    offsets: Table,
    weights: Table,
    bends: Table,
    blurs: Two,
    steps: int,
    at_rest_px: float,
    corners: TableOut,
    residuals: TableOut,
    inverses: TableOut,
) -> None:
    """Fit corners where two edges cross by Levenberg and Marquardt's steps.

    ``levels``: (N, K) in the windows. ``offsets``: (K, 2) of their pixels from the middle, px.
    ``weights``: (N, K); 0 leaves a pixel out. ``bends``: (N, 2) as of `crossing_sums`. ``blurs``:
    least and most sigma, px. ``steps``: Most steps. ``at_rest_px``: A corner that a step moves by
    less is done. ``corners``: (N, 9) start and result. ``residuals``: (N, K) output, also of pixels
    left out. ``inverses``: (N, 81) output, of the normal equations.
    """
    n_pixels = levels.shape[1]
    pixels, left = np.zeros((3, n_pixels)), np.zeros(n_pixels)
    normal, trial_normal = np.zeros((CROSSING, CROSSING)), np.zeros((CROSSING, CROSSING))
    work, inverse = np.zeros((CROSSING, CROSSING)), np.zeros((CROSSING, CROSSING))
    gradient, trial_gradient = np.zeros(CROSSING), np.zeros(CROSSING)
    corner, trial = np.zeros(CROSSING), np.zeros(CROSSING)
    for n in range(levels.shape[0]):
        count = 0
        for k in range(n_pixels):
            if weights[n, k] > 0.0:
                pixels[0, count], pixels[1, count] = offsets[k, 0], offsets[k, 1]
                pixels[2, count] = levels[n, k]
                count += 1
        for i in range(CROSSING):
            corner[i] = corners[n, i]
        damping = 1e-3
        cost = crossing_sums(pixels, count, corner, bends[n], left, normal, gradient)
        for _ in range(steps):
            invert_scaled(normal, damping, work, inverse)
            moved = 0.0
            for i in range(CROSSING):
                step = 0.0
                for j in range(CROSSING):
                    step += inverse[i, j] * gradient[j]
                trial[i] = corner[i] + step
                if i < 2:
                    moved = max(moved, abs(step))
            trial[4] = min(max(trial[4], blurs[0]), blurs[1])
            new = crossing_sums(pixels, count, trial, bends[n], left, trial_normal, trial_gradient)
            if new <= cost:
                cost = new
                for i in range(CROSSING):
                    corner[i], gradient[i] = trial[i], trial_gradient[i]
                    for j in range(CROSSING):
                        normal[i, j] = trial_normal[i, j]
                damping *= 0.2
            else:
                damping *= 10.0
            if moved < at_rest_px:
                break
        invert_scaled(normal, 0.0, work, inverse)
        for i in range(CROSSING):
            corners[n, i] = corner[i]
            for j in range(CROSSING):
                inverses[n, i * CROSSING + j] = inverse[i, j]
        for k in range(n_pixels):
            pixels[0, k], pixels[1, k], pixels[2, k] = offsets[k, 0], offsets[k, 1], levels[n, k]
        crossing_sums(pixels, n_pixels, corner, bends[n], residuals[n], trial_normal, gradient)
