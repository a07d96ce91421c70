# SPDX-License-Identifier: Apache-2.0
"""Smoothing along chains: local parabolas in windows that grow while their estimates agree.

Points are taken `LANES` at a time, so that the loops over them are vectorised: neighbour after
neighbour, all lanes are looked at together. Where a chain ends, or a window, is told by masks.
"""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import (
    COLUMN,
    FUSED,
    Bytes,
    BytesOut,
    Floats,
    FloatsOut,
    Image,
    ImageOut,
    Ints,
    Row,
    RowOut,
    Table,
    TableOut,
    compiled,
)
from armscan.kernels.stripe.profile_fit import BEND_GAIN, SIGMA

SHIFT, SLOPE, BEND, BEND_SIGMA, SMOOTH_SIGMA, WINDOW, PREDICTED, PREDICTED_SIGMA = range(8)
SMOOTH_ROWS = 8
"""Rows of a smoothing result."""
LEAST_POINTS = 5
MOST_TURNED_COSINE = np.float32(0.6)
X, Y, NORMAL_X, NORMAL_Y, CHAIN, WEIGHT = range(6)
COURSE_ROWS = 6
LANES = 32
"""Points that are taken together; a course has so many places before its first and after its last
point at least, and a multiple of it in all."""
COUNT = 8
MOMENTS = 9
"""Sums of w, w s, w s^2, w s^3, w s^4, w d, w s d, w s^2 d, and the count of points."""
NOWHERE = -1.0
"""Chain of a place without a point."""
ZERO, ONE, TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)
BEYOND = np.float32(1e9)
LEAST_DETERMINANT = np.float32(1e-5)
"""Of the product of its diagonal; five neighbours on one side of a point leave 0.013."""
TILE = 256
MARGIN = (TILE - LANES) // 2
NEIGHBOURS_PER_PX = 3.0
"""More than points of a chain lie within a pixel along it."""
REACHED, ALONG, ACROSS = (WEIGHT + k for k in range(3))
LANE_ROWS = ACROSS + 1


@compiled(error_model="numpy")
def lay_course(
    points: Table,
    normals: Table,
    sigma: Floats,
    chain: Ints,
    is_used: Bytes,
    unit: float,
    course: TableOut,
) -> None:
    """Lay points out for `smooth_lanes`.

    ``points``, ``normals``: (N, 2). ``sigma``: (N,) along the normal. ``chain``: (N,) numbers.
    ``is_used``: (N,) 0 for points that tell the others nothing. ``unit``: Variance of weight 1.
    ``course``: (6, P) output.
    """
    n = points.shape[0]
    course[CHAIN, :] = NOWHERE
    for i in range(n):
        at = LANES + i
        course[X, at] = points[i, 0]
        course[Y, at] = points[i, 1]
        course[NORMAL_X, at] = normals[i, 0]
        course[NORMAL_Y, at] = normals[i, 1]
        course[CHAIN, at] = chain[i]
        course[WEIGHT, at] = unit / (sigma[i] * sigma[i]) if is_used[i] != 0 else 0.0


@compiled()
def cut_tile(course: Table, first: int, margin: int, tile: RowOut) -> None:
    """Copy a block of points and so many neighbours; places count from the block's first point.

    ``course``: (6, P) as `Neighbourhoods` lays it out. ``first``: Place of lane 0. ``tile``:
    (6 `TILE`,) output, lane 0 at place `MARGIN`.
    """
    origin_x, origin_y = course[X, first], course[Y, first]
    low = max(first - margin, 0)
    high = min(first + LANES + margin, course.shape[1])
    at = MARGIN + low - first
    tile[CHAIN * TILE : (CHAIN + 1) * TILE] = np.float32(NOWHERE)
    for i in range(high - low):
        tile[X * TILE + at + i] = np.float32(course[X, low + i] - origin_x)
        tile[Y * TILE + at + i] = np.float32(course[Y, low + i] - origin_y)
    for row in range(NORMAL_X, COURSE_ROWS):
        for i in range(high - low):
            tile[row * TILE + at + i] = np.float32(course[row, low + i])


@compiled(fastmath=True)
def reach_neighbours(tile: Row, other: int, lanes: RowOut) -> None:
    """Places of one neighbour of each lane in the lane's tangent frame.

    ``tile``: Of `cut_tile`. ``other``: Place in it of lane 0's neighbour. ``lanes``: (8 `LANES`,)
    place, normal and chain of the points; the largest distance so far, which grows to `BEYOND`
    where the chain ends or turns; output: distance along the tangent and along the normal.
    """
    near = tile[other : other + CHAIN * TILE + LANES]
    for k in range(LANES):
        dx = near[X * TILE + k] - lanes[X * LANES + k]
        dy = near[Y * TILE + k] - lanes[Y * LANES + k]
        nx, ny = near[NORMAL_X * TILE + k], near[NORMAL_Y * TILE + k]
        chain = near[CHAIN * TILE + k]
        own_x = lanes[NORMAL_X * LANES + k]
        own_y = lanes[NORMAL_Y * LANES + k]
        along = dy * own_x - dx * own_y
        lanes[ALONG * LANES + k] = along
        lanes[ACROSS * LANES + k] = dx * own_x + dy * own_y
        reach = max(lanes[REACHED * LANES + k], abs(along))
        is_turned = abs(nx * own_x + ny * own_y) < MOST_TURNED_COSINE
        is_other = (chain != lanes[CHAIN * LANES + k]) | (chain < ZERO)
        reach = BEYOND if is_turned | is_other else reach
        lanes[REACHED * LANES + k] = reach


@compiled(fastmath=True)
def count_within(lanes: Row, reach: np.float32) -> np.float32:
    """Count of the lanes whose neighbour lies not beyond a reach."""
    # as a sum, which is vectorised, as a minimum is not
    count = ZERO
    for k in range(LANES):
        count += ONE if lanes[REACHED * LANES + k] <= reach else ZERO
    return count


@compiled(fastmath=True)
def add_neighbours(
    weight: Row, lanes: Row, inner: np.float32, outer: np.float32, moments: RowOut
) -> None:
    """Add the neighbours that lie farther than ``inner`` and not beyond ``outer``.

    ``weight``: (`LANES`,) theirs. ``lanes``: Of `reach_neighbours`. ``moments``: (9 `LANES`,).
    """
    for k in range(LANES):
        reach = lanes[REACHED * LANES + k]
        w = weight[k] if (reach > inner) & (reach <= outer) else ZERO
        s = lanes[ALONG * LANES + k]
        d = lanes[ACROSS * LANES + k]
        ws = w * s
        wss = ws * s
        wsss = wss * s
        moments[k] += w
        moments[LANES + k] += ws
        moments[2 * LANES + k] += wss
        moments[3 * LANES + k] += wsss
        moments[4 * LANES + k] += wsss * s
        moments[5 * LANES + k] += w * d
        moments[6 * LANES + k] += ws * d
        moments[7 * LANES + k] += wss * d
        moments[8 * LANES + k] += ONE if w > ZERO else ZERO


@compiled(fastmath=True)
def gather_moments(tile: Row, margin: int, windows_px: Row, lanes: RowOut, moments: RowOut) -> None:
    """Moments of the neighbours of one block of points, ring by ring of the windows.

    Neighbours are taken in the tangent frame of a point while they lie on its chain, within reach
    along the tangent and not turned by more than about 50 degrees. The point itself counts in the
    first ring.

    ``tile``, ``margin``: Of `cut_tile`. ``windows_px``: (K,) half widths along the tangent,
    increasing. ``lanes``: (8 `LANES`,) scratch. ``moments``: (9 K `LANES`,) output, by ring, moment
    and lane.
    """
    n_windows = windows_px.shape[0]
    of_ring = MOMENTS * LANES
    largest = windows_px[n_windows - 1]
    moments[:] = ZERO
    for k in range(LANES):
        weight = tile[WEIGHT * TILE + MARGIN + k]
        moments[k] = weight
        moments[COUNT * LANES + k] = ONE if weight > ZERO else ZERO
    for row in range(CHAIN + 1):
        own = row * TILE + MARGIN
        for k in range(LANES):
            lanes[row * LANES + k] = tile[own + k]
    for direction in (-1, 1):
        lanes[REACHED * LANES : (REACHED + 1) * LANES] = ZERO
        other = MARGIN + direction
        ring = 0
        while abs(other - MARGIN) <= margin:
            reach_neighbours(tile, other, lanes)
            n_near = count_within(lanes, largest)
            if n_near == ZERO:
                break
            while count_within(lanes, windows_px[ring]) == ZERO:
                ring += 1
            weights = tile[WEIGHT * TILE + other : WEIGHT * TILE + other + LANES]
            at = ring
            inner = windows_px[ring - 1] if ring > 0 else -ONE
            while True:
                outer = windows_px[at]
                add_neighbours(
                    weights, lanes, inner, outer, moments[at * of_ring : (at + 1) * of_ring]
                )
                if count_within(lanes, outer) == n_near:
                    break
                inner = outer
                at += 1
            other += direction


LOWER, UPPER, IS_OPEN, INFLATED, CHOSEN = (MOMENTS + SMOOTH_ROWS + k for k in range(5))
STATE_ROWS = CHOSEN + MOMENTS


@compiled(fastmath=True)
def widen(
    moments: Row, reach: np.float32, inflation: np.float32, confidence: np.float32, state: RowOut
) -> None:
    """Fit parabolas to one more ring, and take those that agree with the narrower ones.

    ``moments``: (9 `LANES`,) of the ring. ``reach``, ``inflation``, ``confidence``: As for
    `smooth_lanes`. ``state``: (30 `LANES`,) moments so far, results, interval and chosen moments.
    """
    for k in range(MOMENTS * LANES):
        state[k] += moments[k]
    for k in range(LANES):
        s0 = state[k]
        s1 = state[LANES + k]
        s2 = state[2 * LANES + k]
        s3 = state[3 * LANES + k]
        s4 = state[4 * LANES + k]
        d0 = state[5 * LANES + k]
        d1 = state[6 * LANES + k]
        d2 = state[7 * LANES + k]
        c00 = s2 * s4 - s3 * s3
        c01 = s2 * s3 - s1 * s4
        c02 = s1 * s3 - s2 * s2
        c11 = s0 * s4 - s2 * s2
        c12 = s1 * s2 - s0 * s3
        c22 = s0 * s2 - s1 * s1
        determinant = s0 * c00 + s1 * c01 + s2 * c02
        is_open = state[IS_OPEN * LANES + k]
        is_told = state[COUNT * LANES + k] >= np.float32(LEAST_POINTS)
        is_told &= determinant > LEAST_DETERMINANT * s0 * s2 * s4
        is_told &= is_open > ZERO
        share = ONE / (determinant if is_told else ONE)
        value = (c00 * d0 + c01 * d1 + c02 * d2) * share
        variance = c00 * share * inflation
        sigma = np.float32(math.sqrt(variance if is_told else ZERO))
        lower = state[LOWER * LANES + k]
        upper = state[UPPER * LANES + k]
        lower = max(lower, value - confidence * sigma) if is_told else lower
        upper = min(upper, value + confidence * sigma) if is_told else upper
        state[LOWER * LANES + k] = lower
        state[UPPER * LANES + k] = upper
        is_taken = is_told & (lower <= upper)
        state[IS_OPEN * LANES + k] = ZERO if is_told & (lower > upper) else is_open
        at = (MOMENTS + SHIFT) * LANES + k
        state[at] = value if is_taken else state[at]
        at = (MOMENTS + SLOPE) * LANES + k
        state[at] = (c01 * d0 + c11 * d1 + c12 * d2) * share if is_taken else state[at]
        at = (MOMENTS + BEND) * LANES + k
        state[at] = TWO * (c02 * d0 + c12 * d1 + c22 * d2) * share if is_taken else state[at]
        at = (MOMENTS + BEND_SIGMA) * LANES + k
        square = TWO * TWO * c22 * share * inflation
        state[at] = np.float32(math.sqrt(square)) if is_taken else state[at]
        at = (MOMENTS + SMOOTH_SIGMA) * LANES + k
        state[at] = sigma if is_taken else state[at]
        at = (MOMENTS + WINDOW) * LANES + k
        state[at] = reach if is_taken else state[at]
        at = INFLATED * LANES + k
        state[at] = inflation if is_taken else state[at]
        # the same loop, so that the mask need not be kept
        for m in range(MOMENTS):
            at = (CHOSEN + m) * LANES + k
            state[at] = state[m * LANES + k] if is_taken else state[at]


@compiled(fastmath=True)
def predict(weight: Row, state: RowOut) -> None:
    """What the neighbours alone say of each lane's point, of the moments that were chosen.

    ``weight``: (`LANES`,) of the points. ``state``: As for `widen`.
    """
    for k in range(LANES):
        s0 = state[CHOSEN * LANES + k] - weight[k]
        s1 = state[(CHOSEN + 1) * LANES + k]
        s2 = state[(CHOSEN + 2) * LANES + k]
        s3 = state[(CHOSEN + 3) * LANES + k]
        s4 = state[(CHOSEN + 4) * LANES + k]
        c00 = s2 * s4 - s3 * s3
        c01 = s2 * s3 - s1 * s4
        c02 = s1 * s3 - s2 * s2
        determinant = s0 * c00 + s1 * c01 + s2 * c02
        is_told = state[(MOMENTS + WINDOW) * LANES + k] > ZERO
        is_told &= determinant > LEAST_DETERMINANT * s0 * s2 * s4
        share = ONE / (determinant if is_told else ONE)
        value = c00 * state[(CHOSEN + 5) * LANES + k]
        value += c01 * state[(CHOSEN + 6) * LANES + k]
        value += c02 * state[(CHOSEN + 7) * LANES + k]
        variance = c00 * share * state[INFLATED * LANES + k]
        state[(MOMENTS + PREDICTED) * LANES + k] = value * share if is_told else ZERO
        sigma = np.float32(math.sqrt(variance if is_told else ZERO))
        state[(MOMENTS + PREDICTED_SIGMA) * LANES + k] = sigma


@compiled()
def smooth_lanes(
    course: Table,
    scale: float,
    sigma_px: Floats,
    windows_px: Row,
    inflation: Row,
    confidence: float,
    is_asked: Ints,
    result: ImageOut,
) -> None:
    """Smooth every point along its chain by a local quadratic in its own tangent frame.

    Windows grow while their estimates agree within the noise (intersection of confidence
    intervals): a bend stops the growth before its bias exceeds the noise.

    ``course``: (6, P) as `Neighbourhoods` lays it out. ``scale``: Variance of the
    points over what their weights say. ``sigma_px``: (N,) standard deviation along the normal.
    ``windows_px``: (K,) half widths along the tangent, increasing. ``inflation``: (K,) factor on
    the variance of each window because neighbours' noise is correlated. ``confidence``: Half width
    of the confidence intervals in sigmas. ``is_asked``: (P / `LANES`,) 0 for blocks whose results
    stay as they are. ``result``:
    (8, N) output: shift along the normal, slope of the line against the
    tangent, its second derivative (curvature) and that one's sigma, sigma of the shift, half window
    (0: not smoothed), prediction of the point's shift by its neighbours alone, and that
    prediction's sigma (0: there is none).
    """
    n = sigma_px.shape[0]
    n_windows = windows_px.shape[0]
    of_ring = MOMENTS * LANES
    state = np.zeros(STATE_ROWS * LANES, np.float32)
    lanes = np.zeros(LANE_ROWS * LANES, np.float32)
    moments = np.zeros(n_windows * of_ring, np.float32)
    tile = np.zeros(COURSE_ROWS * TILE, np.float32)
    margin = min(math.ceil(NEIGHBOURS_PER_PX * windows_px[n_windows - 1]), MARGIN)
    for first in range(0, n, LANES):
        block = first // LANES + 1
        if is_asked[block] == 0:
            continue
        last = min(n - first, LANES)
        cut_tile(course, first + LANES, margin, tile)
        gather_moments(tile, margin, windows_px, lanes, moments)
        state[:] = ZERO
        state[LOWER * LANES : (LOWER + 1) * LANES] = -BEYOND
        state[UPPER * LANES : (UPPER + 1) * LANES] = BEYOND
        state[IS_OPEN * LANES : (IS_OPEN + 1) * LANES] = ONE
        for k in range(last):
            state[(MOMENTS + SMOOTH_SIGMA) * LANES + k] = np.float32(sigma_px[first + k])
        for k in range(n_windows):
            ring = moments[k * of_ring : (k + 1) * of_ring]
            inflated = np.float32(inflation[k] * scale)
            widen(ring, windows_px[k], inflated, np.float32(confidence), state)
        own = WEIGHT * TILE + MARGIN
        predict(tile[own : own + LANES], state)
        for row in range(SMOOTH_ROWS):
            at = (MOMENTS + row) * LANES
            for k in range(last):
                result[row, first + k] = state[at + k]


@compiled(error_model="numpy")
def score_predictions(result: Image, sigma: Floats, score: FloatsOut) -> None:
    """How many sigmas (N,) points lie off what their neighbours alone say; 0 where these are few.

    ``result``: (8, N) of `smooth_lanes`. ``sigma``: (N,) of the points.
    """
    for i in range(sigma.shape[0]):
        own = float(result[PREDICTED_SIGMA, i])
        off = abs(float(result[PREDICTED, i]))
        score[i] = off / math.sqrt(own * own + sigma[i] * sigma[i]) if own > 0.0 else 0.0


@compiled(error_model="numpy")
def shift_points(
    points: Table,
    normals: Table,
    is_used: Bytes,
    result: Image,
    moved: TableOut,
    turned: TableOut,
    sigma: FloatsOut,
) -> None:
    """Move points to where their neighbourhoods say, and turn their normals.

    ``points``, ``normals``: (N, 2). ``is_used``: (N,) 0 for points that stay as they are.
    ``result``: (8, N) of `smooth_lanes`. ``moved``, ``turned``: (N, 2) output. ``sigma``: (N,) of
    points; output of those that are moved.
    """
    for i in range(points.shape[0]):
        nx, ny = normals[i, 0], normals[i, 1]
        shift = slope = 0.0
        if is_used[i] != 0:
            shift, slope = float(result[SHIFT, i]), float(result[SLOPE, i])
            sigma[i] = float(result[SMOOTH_SIGMA, i])
        moved[i, 0] = points[i, 0] + shift * nx
        moved[i, 1] = points[i, 1] + shift * ny
        x, y = nx + slope * ny, ny - slope * nx
        length = math.sqrt(x * x + y * y)
        turned[i, 0] = x / length
        turned[i, 1] = y / length


BEND_SPAN = 12
"""Points to both sides by which a sharper bend is seen, 0.001 to 0.002 of noise beside it."""
SHARPEST_BEND = 0.01
"""In 1/px: a line across a bump of 100 px."""
BEND_MARGIN = 3.0
"""Times what is seen of a bend, for it is seen roughly."""
BEYOND_BENDS = 1e9
"""In 1/px, where the bend is not seen."""
LEAST_PULL = 0.03
"""Of a centre's sigma: where not even the sharpest bend pulls so much, none is looked for."""


@compiled(error_model="numpy", is_inlined=True)
def seen_bend(points: Table, normals: Table, chain: Ints, i: int) -> float:
    """Curvature in 1/px of the circle through a point and those `BEND_SPAN` to both sides.

    `BEYOND_BENDS` where the chain ends so near. The others: As for `find_pulls`.
    """
    low, high = i - BEND_SPAN, i + BEND_SPAN
    if low < 0 or high >= points.shape[0] or chain[low] != chain[high]:
        return BEYOND_BENDS
    across, square = 0.0, 1e-12
    for k in range(2):
        across += (points[low, k] + points[high, k] - 2.0 * points[i, k]) * normals[i, k]
        square += (points[high, k] - points[low, k]) ** 2
    return 4.0 * abs(across) / square


@compiled(error_model="numpy")
def find_pulls(
    ridge: Table,
    fits: Table,
    points: Table,
    normals: Table,
    sigma: Floats,
    chain: Ints,
    pull: FloatsOut,
    matters: BytesOut,
) -> int:
    """By how much a bend moves the centre of a column or row that cuts the line at a slant.

    With curvature k, and n and t the components of the normal and the tangent along the column, a
    pixel d from the centre lies ``n d - k t^2 d^2 / 2`` from the line. To first order this adds the
    term ``k t^2 s / (2 n) u^3`` to the relative profile in ``u = d / s``.

    ``ridge``: (N, 6) ridge points. ``fits``: (N, 9) of `fit_profiles`. ``points``, ``normals``: (N,
    2). ``sigma``: (N,) of the points. ``chain``: (N,) numbers. ``pull``: (N,) output, for a
    curvature of 1. ``matters``: (N,) output, 1 where bends as sharp as there may be move more than
    `LEAST_PULL`. Returns how many of these there are.
    """
    count = 0
    for i in range(points.shape[0]):
        n = normals[i, 1] if int(ridge[i, 5]) == COLUMN else normals[i, 0]
        square = fits[i, SIGMA] * fits[i, SIGMA]
        pull[i] = fits[i, BEND_GAIN] * (1.0 - n * n) * square / (2.0 * n)
        bend = max(BEND_MARGIN * seen_bend(points, normals, chain, i), SHARPEST_BEND)
        is_pulled = abs(pull[i]) * bend > LEAST_PULL * sigma[i]
        matters[i] = is_pulled
        count += 1 if is_pulled else 0
    return count


@compiled(error_model="numpy")
def take_out_bends(result: Image, pull: Floats, ridge: Table, points: TableOut) -> None:
    """Move centres back by what bends pulled them.

    Bends are shrunk towards zero by their own noise, so that straight lines are not disturbed.

    ``result``: (8, N) of `smooth_lanes`. ``pull``, ``ridge``: (N,), (N, 6) of `find_pulls`.
    ``points``: (N, 2) input and output.
    """
    for i in range(points.shape[0]):
        bend, sigma = float(result[BEND, i]), float(result[BEND_SIGMA, i])
        square = bend * bend
        bend *= max(1.0 - sigma * sigma / max(square, 1e-30), 0.0)
        points[i, 1 if int(ridge[i, 5]) == COLUMN else 0] -= bend * pull[i]


@compiled(fastmath=FUSED, is_inlined=True)
def sum_products(values: Floats, first: int, weights: Floats) -> float:
    """Sum of products of weights and as many values from a place on."""
    total = 0.0
    for k in range(weights.shape[0]):
        total += weights[k] * values[first + k]
    return total


@compiled(error_model="numpy")
def filter_residuals(
    points: Table,
    normals: Table,
    sigma: Floats,
    chain: Ints,
    is_used: Bytes,
    weights: Floats,
    residual: FloatsOut,
    told: FloatsOut,
) -> int:
    """Distances from a filtered course over sigma; NaN where not all of the window can be used.

    ``points``, ``normals``: (N, 2). ``sigma``: (N,). ``chain``: (N,) numbers. ``is_used``: (N,) 0
    for points that do not count. ``weights``: (2 half + 1,) of the filter. ``residual``: (N,)
    output. ``told``: (N,) output: sizes of those that are told.

    Returns how many are told.
    """
    n, size = points.shape[0], weights.shape[0]
    half = size // 2
    x, y = points[:, 0].copy(), points[:, 1].copy()
    residual[:] = np.nan
    unused = -1
    count = 0
    for last in range(n):
        if is_used[last] == 0:
            unused = last
        first, i = last - size + 1, last - half
        if first <= unused or chain[first] != chain[last]:
            continue
        off_y = points[i, 1] - sum_products(y, first, weights)
        if normals[i, 0] == 0.0:
            residual[i] = off_y * normals[i, 1] / sigma[i]
        else:
            off_x = points[i, 0] - sum_products(x, first, weights)
            residual[i] = (off_x * normals[i, 0] + off_y * normals[i, 1]) / sigma[i]
        told[count] = abs(residual[i])
        count += 1
    return count


@compiled(fastmath=FUSED)
def multiply_lagged(residual: Floats, chain: Ints, lag: int, total: FloatsOut) -> None:
    """Sum of products of residuals (N,) at a distance on the same chain, and how many there are.

    ``residual``: (N,) NaN where there is none. ``total``: (2,) output.
    """
    products = count = 0.0
    later, numbers = residual[lag:], chain[lag:]
    for i in range(later.shape[0]):
        a, b = residual[i], later[i]
        is_one = (abs(a) < np.inf) & (abs(b) < np.inf) & (chain[i] == numbers[i])
        products += a * b if is_one else 0.0
        count += 1.0 if is_one else 0.0
    total[0] = products
    total[1] = count
