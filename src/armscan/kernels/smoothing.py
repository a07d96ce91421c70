# SPDX-License-Identifier: Apache-2.0
"""Smoothing along chains: local parabolas in windows that grow while their estimates agree.

Points are taken `LANES` at a time, so that the loops over them are vectorised: neighbour after
neighbour, all lanes are looked at together. Where a chain ends, or a window, is told by masks.
"""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import (
    Floats,
    FloatsOut,
    Ints,
    Table,
    TableOut,
    compiled,
)

SHIFT, SLOPE, BEND, BEND_SIGMA, SMOOTH_SIGMA, WINDOW, PREDICTED, PREDICTED_SIGMA = range(8)
SMOOTH_ROWS = 8
"""Rows of a smoothing result."""
LEAST_POINTS = 5
MOST_TURNED_COSINE = 0.6
X, Y, NORMAL_X, NORMAL_Y, WEIGHT, CHAIN = range(6)
COURSE_ROWS = 6
LANES = 32
"""Points that are taken together; a course has so many places before its first and after its last
point at least, and a multiple of it in all."""
COUNT = 8
MOMENTS = 9
"""Sums of w, w s, w s^2, w s^3, w s^4, w d, w s d, w s^2 d, and the count of points."""
NOWHERE = -1.0
"""Chain of a place without a point."""
BEYOND = 1e9
LEAST_DETERMINANT = 1e-9


@compiled(fastmath=True)
def reach_neighbours(course: Table, first: int, other: int, lanes: FloatsOut) -> float:
    """Places of one neighbour of each lane in the lane's tangent frame; the nearest one's reach.

    ``course``: (6, P) as `Neighbourhoods` lays it out. ``first``: Place of lane 0. ``other``: Of
    its neighbour. ``lanes``: (8 `LANES`,) x, y, normal, chain and largest distance so far of each
    point, which grows to `BEYOND` where the chain ends or turns; output: distance along the tangent
    and along the normal.
    """
    x = course[X, other : other + LANES]
    y = course[Y, other : other + LANES]
    nx = course[NORMAL_X, other : other + LANES]
    ny = course[NORMAL_Y, other : other + LANES]
    chain = course[CHAIN, other : other + LANES]
    nearest = BEYOND
    for k in range(LANES):
        dx = x[k] - lanes[k]
        dy = y[k] - lanes[LANES + k]
        own_x = lanes[2 * LANES + k]
        own_y = lanes[3 * LANES + k]
        along = dy * own_x - dx * own_y
        lanes[6 * LANES + k] = along
        lanes[7 * LANES + k] = dx * own_x + dy * own_y
        reach = max(lanes[5 * LANES + k], abs(along))
        is_turned = abs(nx[k] * own_x + ny[k] * own_y) < MOST_TURNED_COSINE
        is_other = (chain[k] != lanes[4 * LANES + k]) | (chain[k] < 0.0)
        reach = BEYOND if is_turned | is_other else reach
        lanes[5 * LANES + k] = reach
        nearest = min(nearest, reach)
    return nearest


@compiled(fastmath=True)
def add_neighbours(
    weight: Floats, lanes: Floats, inner: float, outer: float, moments: FloatsOut
) -> None:
    """Add the neighbours that lie farther than ``inner`` and not beyond ``outer``.

    ``weight``: (`LANES`,) theirs. ``lanes``: Of `reach_neighbours`. ``moments``: (9 `LANES`,).
    """
    for k in range(LANES):
        reach = lanes[5 * LANES + k]
        w = weight[k] if (reach > inner) & (reach <= outer) else 0.0
        s = lanes[6 * LANES + k]
        d = lanes[7 * LANES + k]
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
        moments[8 * LANES + k] += 1.0 if w > 0.0 else 0.0


@compiled(fastmath=True)
def gather_moments(course: Table, windows_px: Floats, is_asked: Ints, moments: FloatsOut) -> None:
    """Moments of the neighbours of each point, ring by ring of the windows.

    Neighbours are taken in the tangent frame of a point while they lie on its chain, within reach
    along the tangent and not turned by more than about 50 degrees. The point itself counts in the
    first ring.

    ``course``: (6, P) as `Neighbourhoods` lays it out. ``windows_px``: (K,) half widths along the
    tangent, increasing. ``is_asked``: (P / `LANES`,) 0 for blocks whose moments stay as they are.
    ``moments``: (P K 9,) output, by block, ring, moment and lane.
    """
    n_windows = windows_px.shape[0]
    places = course.shape[1]
    of_ring = MOMENTS * LANES
    largest = windows_px[n_windows - 1]
    lanes = np.zeros(8 * LANES)
    for block in range(1, places // LANES - 1):
        if is_asked[block] == 0:
            continue
        first = block * LANES
        own = moments[block * n_windows * of_ring : (block + 1) * n_windows * of_ring]
        own[:] = 0.0
        for k in range(LANES):
            weight = course[WEIGHT, first + k]
            own[k] = weight
            own[COUNT * LANES + k] = 1.0 if weight > 0.0 else 0.0
            for row in range(4):
                lanes[row * LANES + k] = course[row, first + k]
            lanes[4 * LANES + k] = course[CHAIN, first + k]
        for direction in (-1, 1):
            lanes[5 * LANES : 6 * LANES] = 0.0
            other = first + direction
            ring = 0
            while 0 <= other <= places - LANES:
                nearest = reach_neighbours(course, first, other, lanes)
                if nearest > largest:
                    break
                while nearest > windows_px[ring]:
                    ring += 1
                farthest = 0.0
                for k in range(LANES):
                    reach = lanes[5 * LANES + k]
                    farthest = max(farthest, reach if reach <= largest else 0.0)
                weights = course[WEIGHT, other : other + LANES]
                at = ring
                inner = windows_px[ring - 1] if ring > 0 else -1.0
                while True:
                    outer = windows_px[at]
                    add_neighbours(
                        weights, lanes, inner, outer, own[at * of_ring : (at + 1) * of_ring]
                    )
                    if farthest <= outer:
                        break
                    inner = outer
                    at += 1
                other += direction


LOWER, UPPER, IS_OPEN, INFLATED, CHOSEN = (MOMENTS + SMOOTH_ROWS + k for k in range(5))
STATE_ROWS = CHOSEN + MOMENTS


@compiled(fastmath=True)
def widen(
    moments: Floats, reach: float, inflation: float, confidence: float, state: FloatsOut
) -> None:
    """Fit parabolas to one more ring, and take those that agree with the narrower ones.

    ``moments``: (9 `LANES`,) of the ring. ``reach``, ``inflation``, ``confidence``: As for
    `choose_windows`. ``state``: (31 `LANES`,) moments so far, results, interval and chosen moments.
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
        is_told = state[COUNT * LANES + k] >= LEAST_POINTS
        is_told &= determinant > LEAST_DETERMINANT * s0 * s2 * s4
        is_told &= is_open > 0.0
        share = 1.0 / (determinant if is_told else 1.0)
        value = (c00 * d0 + c01 * d1 + c02 * d2) * share
        variance = c00 * share * inflation
        sigma = math.sqrt(variance if is_told else 0.0)
        lower = state[LOWER * LANES + k]
        upper = state[UPPER * LANES + k]
        lower = max(lower, value - confidence * sigma) if is_told else lower
        upper = min(upper, value + confidence * sigma) if is_told else upper
        state[LOWER * LANES + k] = lower
        state[UPPER * LANES + k] = upper
        is_taken = is_told & (lower <= upper)
        state[IS_OPEN * LANES + k] = 0.0 if is_told & (lower > upper) else is_open
        at = (MOMENTS + SHIFT) * LANES + k
        state[at] = value if is_taken else state[at]
        at = (MOMENTS + SLOPE) * LANES + k
        state[at] = (c01 * d0 + c11 * d1 + c12 * d2) * share if is_taken else state[at]
        at = (MOMENTS + BEND) * LANES + k
        state[at] = 2.0 * (c02 * d0 + c12 * d1 + c22 * d2) * share if is_taken else state[at]
        at = (MOMENTS + BEND_SIGMA) * LANES + k
        square = 4.0 * c22 * share * inflation
        state[at] = math.sqrt(square) if is_taken else state[at]
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
def predict(weight: Floats, state: FloatsOut) -> None:
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
        is_told = state[(MOMENTS + WINDOW) * LANES + k] > 0.0
        is_told &= determinant > LEAST_DETERMINANT * s0 * s2 * s4
        share = 1.0 / (determinant if is_told else 1.0)
        value = c00 * state[(CHOSEN + 5) * LANES + k]
        value += c01 * state[(CHOSEN + 6) * LANES + k]
        value += c02 * state[(CHOSEN + 7) * LANES + k]
        variance = c00 * share * state[INFLATED * LANES + k]
        state[(MOMENTS + PREDICTED) * LANES + k] = value * share if is_told else 0.0
        sigma = math.sqrt(variance if is_told else 0.0)
        state[(MOMENTS + PREDICTED_SIGMA) * LANES + k] = sigma


@compiled()
def choose_windows(
    course: Table,
    moments: Floats,
    scale: float,
    sigma_px: Floats,
    windows_px: Floats,
    inflation: Floats,
    confidence: float,
    is_asked: Ints,
    result: TableOut,
) -> None:
    """Smooth every point along its chain by a local quadratic in its own tangent frame.

    Windows grow while their estimates agree within the noise (intersection of confidence
    intervals): a bend stops the growth before its bias exceeds the noise.

    ``course``: (6, P) as `Neighbourhoods` lays it out. ``moments``: Of `gather_moments`, with the
    same windows.
    ``scale``: Variance of the points over what their weights say. ``sigma_px``: (N,) standard
    deviation along the normal. ``inflation``: (K,) factor on the variance of each window because
    neighbours' noise is correlated. ``confidence``: Half width of the confidence intervals in
    sigmas. ``is_asked``: (P / `LANES`,) 0 for blocks whose results stay as they are. ``result``:
    (8, N) output: shift along the normal, slope of the line against the
    tangent, its second derivative (curvature) and that one's sigma, sigma of the shift, half window
    (0: not smoothed), prediction of the point's shift by its neighbours alone, and that
    prediction's sigma (0: there is none).
    """
    n = sigma_px.shape[0]
    n_windows = windows_px.shape[0]
    of_ring = MOMENTS * LANES
    state = np.zeros(STATE_ROWS * LANES)
    for first in range(0, n, LANES):
        block = first // LANES + 1
        if is_asked[block] == 0:
            continue
        last = min(n - first, LANES)
        state[:] = 0.0
        state[LOWER * LANES : (LOWER + 1) * LANES] = -BEYOND
        state[UPPER * LANES : (UPPER + 1) * LANES] = BEYOND
        state[IS_OPEN * LANES : (IS_OPEN + 1) * LANES] = 1.0
        for k in range(last):
            state[(MOMENTS + SMOOTH_SIGMA) * LANES + k] = sigma_px[first + k]
        for k in range(n_windows):
            at = (block * n_windows + k) * of_ring
            ring = moments[at : at + of_ring]
            widen(ring, windows_px[k], inflation[k] * scale, confidence, state)
        predict(course[WEIGHT, block * LANES : (block + 1) * LANES], state)
        for row in range(SMOOTH_ROWS):
            at = (MOMENTS + row) * LANES
            result[row, first : first + last] = state[at : at + last]
