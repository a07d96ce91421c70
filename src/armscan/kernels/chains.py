# SPDX-License-Identifier: Apache-2.0
"""Chains of ridge points: links, distance to other lines, likeliest sheets, smoothing."""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import (
    COLUMN,
    ROW,
    Floats,
    FloatsOut,
    Ints,
    IntsOut,
    MapOut,
    Table,
    TableOut,
    compiled,
)

REACH_PX = 2.9
"""One missing point on a diagonal leaves a distance of 2.83 px."""
SAME_PX = 1.0
"""Column points lie at most 1.54 px apart where row points may overlap them."""
LEAST_COSINE = 0.77
NONE = -1


@compiled()
def place_points(points: Table, owner: MapOut, is_kept: IntsOut) -> None:
    """Enter points into a map of pixels, dropping row points that repeat a column point.

    ``points``: (N, 6) from `refine_candidates`. ``owner``: (H, W) int32 zeros; receives one
    more than the index of the point in each pixel. ``is_kept``: (N,) output, 1 or 0.
    """
    height, width = owner.shape
    for side in range(2):
        for i in range(points.shape[0]):
            if int(points[i, 5]) != side:
                continue
            x = int(points[i, 0] + 0.5)
            y = int(points[i, 1] + 0.5)
            is_kept[i] = 1
            if side == ROW:
                for v in range(max(y - 1, 0), min(y + 2, height)):
                    for u in range(max(x - 1, 0), min(x + 2, width)):
                        j = owner[v, u] - 1
                        if j >= 0 and points[j, 5] != ROW:
                            distance = math.hypot(
                                points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
                            )
                            if distance < SAME_PX:
                                is_kept[i] = 0
            if is_kept[i] == 1 and owner[y, x] == 0:
                owner[y, x] = i + 1
            else:
                is_kept[i] = 0


@compiled()
def find_neighbours(points: Table, owner: MapOut, ahead: IntsOut, behind: IntsOut) -> None:
    """Best continuation of each point to both sides along its tangent.

    ``points``: (N, 6) from `refine_candidates`. ``owner``: (H, W) map from `place_points`.
    ``ahead``, ``behind``: (N,) output: index of the neighbour, or -1. The tangent is the normal
    turned by a quarter.
    """
    height, width = owner.shape
    for i in range(points.shape[0]):
        x = int(points[i, 0] + 0.5)
        y = int(points[i, 1] + 0.5)
        if owner[y, x] != i + 1:
            continue
        nx = points[i, 2]
        ny = points[i, 3]
        best_ahead = best_behind = 1e9
        for v in range(max(y - 3, 0), min(y + 4, height)):
            for u in range(max(x - 3, 0), min(x + 4, width)):
                j = owner[v, u] - 1
                if j < 0 or j == i:
                    continue
                dx = points[j, 0] - points[i, 0]
                dy = points[j, 1] - points[i, 1]
                along = dy * nx - dx * ny
                across = abs(dx * nx + dy * ny)
                if dx * dx + dy * dy > REACH_PX * REACH_PX or across > 0.6 * abs(along) + 0.4:
                    continue
                if abs(nx * points[j, 2] + ny * points[j, 3]) < LEAST_COSINE:
                    continue
                cost = abs(along) + 2.0 * across
                if along > 0.2 and cost < best_ahead:
                    best_ahead = cost
                    ahead[i] = j
                elif along < -0.2 and cost < best_behind:
                    best_behind = cost
                    behind[i] = j


@compiled()
def walk_chains(ahead: IntsOut, behind: IntsOut, order: IntsOut, chain: IntsOut) -> int:
    """Order the points along their chains, ends first, then loops; lone points are left out.

    ``ahead``, ``behind``: (N,) from `find_neighbours`; links that are not mutual are cut here.
    ``order``, ``chain``: (N,) output: index of the k-th point, and the number of its chain.

    Returns count of points in chains.
    """
    n = ahead.shape[0]
    for i in range(n):
        for side in range(2):
            j = ahead[i] if side == 0 else behind[i]
            if j >= 0 and ahead[j] != i and behind[j] != i:
                if side == 0:
                    ahead[i] = NONE
                else:
                    behind[i] = NONE
    is_used = np.zeros(n, np.uint8)
    count = 0
    number = 0
    for want_loops in range(2):
        for start in range(n):
            is_end = (ahead[start] < 0) != (behind[start] < 0)
            is_loop = ahead[start] >= 0 and behind[start] >= 0
            if is_used[start] or not (is_end or (want_loops == 1 and is_loop)):
                continue
            previous = NONE
            i = start
            while i >= 0 and not is_used[i]:
                is_used[i] = 1
                order[count] = i
                chain[count] = number
                count += 1
                following = ahead[i]
                if following < 0 or following == previous:
                    following = behind[i]
                if following == previous:
                    following = NONE
                previous = i
                i = following
            number += 1
    return count


OWN_SPAN = 3.0
"""Along its own chain a point is another line's only after this many times the reach."""


@compiled()
def find_other_lines(
    points: Table,
    chain: Ints,
    start: Ints,
    stop: Ints,
    is_line: Ints,
    height: int,
    width: int,
    reach: float,
    distance: TableOut,
) -> None:
    """Find the nearest point of another line, or of a far part of the same, on both sides.

    Points are sorted into square cells; a cell that holds only a point's own part of its chain is
    passed over, so that the cost is in crossings alone.

    ``points``: (N, 6) ridge points, ordered along chains. ``chain``: (N,) chain numbers. ``start``,
    ``stop``: (N,) first index, and index after the last, of each point's chain; the two ends of a
    chain count as neighbours, because it may be a loop. ``is_line``: (N,) 0 for points that do not
    count as a line to others. ``height``, ``width``: Size of the image. ``reach``: Largest distance
    that matters, and the side of a cell. ``distance``: (N, 2) output: distance to the nearest other
    line on the side of smaller and of larger coordinate along the point's column or row; infinite
    where there is none within reach.
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


@compiled()
def best_states(scores: Table, change_cost: Floats, state: IntsOut) -> None:
    """Sequence of states with the greatest sum of scores less the costs of its changes.

    ``scores``: (N, S) log-likelihood of each state at each place. ``change_cost``: (N,) cost of
    another state at a place than at the one before; 0 at the first of a stripe. ``state``: (N,)
    output.
    """
    n, s = scores.shape
    if n == 0:
        return
    total = np.zeros((n, s))
    before = np.zeros((n, s), np.int64)
    for k in range(s):
        total[0, k] = scores[0, k]
    for i in range(1, n):
        top = 0
        for k in range(1, s):
            if total[i - 1, k] > total[i - 1, top]:
                top = k
        for k in range(s):
            changed = total[i - 1, top] - change_cost[i]
            if total[i - 1, k] >= changed:
                total[i, k] = total[i - 1, k] + scores[i, k]
                before[i, k] = k
            else:
                total[i, k] = changed + scores[i, k]
                before[i, k] = top
    last = 0
    for k in range(1, s):
        if total[n - 1, k] > total[n - 1, last]:
            last = k
    for i in range(n - 1, -1, -1):
        state[i] = last
        last = before[i, last]


SHIFT, SLOPE, BEND, BEND_SIGMA, SMOOTH_SIGMA, WINDOW, PREDICTED, PREDICTED_SIGMA = range(8)
SMOOTH_COLUMNS = 8
"""Columns of a smoothing result."""
LEAST_POINTS = 5
MOST_TURNED_COSINE = 0.6
COUNT = 8
"""Place of the count of points among the moments."""


@compiled()
def solve_quadratic(moments: Floats, solved: FloatsOut) -> bool:
    """Fit a weighted parabola; False if it is not determined.

    ``moments``: (9,) sums of w, w s, w s^2, w s^3, w s^4, w d, w s d, w s^2 d, and the count of
    points. ``solved``: (5,) output: value, slope and second derivative at 0, then the variances of
    the value and of the second derivative.
    """
    s0, s1, s2, s3, s4 = moments[0], moments[1], moments[2], moments[3], moments[4]
    c00 = s2 * s4 - s3 * s3
    c01 = s2 * s3 - s1 * s4
    c02 = s1 * s3 - s2 * s2
    determinant = s0 * c00 + s1 * c01 + s2 * c02
    if not determinant > 1e-9 * s0 * s2 * s4:
        return False
    c11 = s0 * s4 - s2 * s2
    c12 = s1 * s2 - s0 * s3
    share = 1.0 / determinant
    c22 = s0 * s2 - s1 * s1
    solved[0] = (c00 * moments[5] + c01 * moments[6] + c02 * moments[7]) * share
    solved[1] = (c01 * moments[5] + c11 * moments[6] + c12 * moments[7]) * share
    solved[2] = 2.0 * (c02 * moments[5] + c12 * moments[6] + c22 * moments[7]) * share
    solved[3] = c00 * share
    solved[4] = 4.0 * c22 * share
    return True


@compiled()
def gather(
    points: Table,
    normals: Table,
    weight: Floats,
    chain: Ints,
    i: int,
    j: int,
    direction: int,
    reach: float,
    moments: FloatsOut,
) -> int:
    """Add the neighbours of point ``i`` from place ``j`` on to the moments; return where it ended.

    Neighbours are taken in the tangent frame of point ``i`` while they lie on its chain, within
    ``reach`` along the tangent and not turned by more than about 50 degrees.
    """
    nx = normals[i, 0]
    ny = normals[i, 1]
    m0 = m1 = m2 = m3 = m4 = d0 = d1 = d2 = count = 0.0
    while 0 <= j < points.shape[0] and chain[j] == chain[i]:
        dx = points[j, 0] - points[i, 0]
        dy = points[j, 1] - points[i, 1]
        s = dy * nx - dx * ny
        if abs(s) > reach or abs(normals[j, 0] * nx + normals[j, 1] * ny) < MOST_TURNED_COSINE:
            break
        w = weight[j]
        if w > 0.0:
            d = dx * nx + dy * ny
            ws = w * s
            wss = ws * s
            m0 += w
            m1 += ws
            m2 += wss
            m3 += wss * s
            m4 += wss * s * s
            d0 += w * d
            d1 += ws * d
            d2 += wss * d
            count += 1.0
        j += direction
    moments[0] += m0
    moments[1] += m1
    moments[2] += m2
    moments[3] += m3
    moments[4] += m4
    moments[5] += d0
    moments[6] += d1
    moments[7] += d2
    moments[COUNT] += count
    return j


@compiled()
def smooth_chains(
    points: Table,
    normals: Table,
    sigma_px: Floats,
    weight: Floats,
    chain: Ints,
    windows_px: Floats,
    inflation: Floats,
    confidence: float,
    result: TableOut,
) -> None:
    """Smooth every point along its chain by a local quadratic in its own tangent frame.

    Windows grow while their estimates agree within the noise (intersection of confidence
    intervals): a bend stops the growth before its bias exceeds the noise.

    ``points``, ``normals``: (N, 2) centres and unit normals, ordered along the chains.
    ``sigma_px``: (N,) standard deviation along the normal. ``weight``: (N,) its inverse square, or
    0 for points that must not pull their neighbours. ``chain``: (N,) chain number of each point; a
    chain is consecutive. ``windows_px``: (K,) half widths along the tangent, increasing.
    ``inflation``: (K,) factor on
    the variance of each window because neighbours' noise is correlated. ``confidence``: Half width
    of the confidence intervals in sigmas. ``result``: (N, 8) output: shift along the normal, slope
    of the line against the tangent, its second derivative (curvature) and that one's sigma, sigma
    of the shift, half window (0: not smoothed), prediction of the point's shift by its neighbours
    alone, and that prediction's sigma (0: there is none).
    """
    n = points.shape[0]
    moments = np.zeros(9)
    others = np.zeros(9)
    solved = np.zeros(5)
    for i in range(n):
        moments[:] = 0.0
        if weight[i] > 0.0:
            moments[0] = weight[i]
            moments[COUNT] = 1.0
        for k in range(result.shape[1]):
            result[i, k] = 0.0
        result[i, SMOOTH_SIGMA] = sigma_px[i]
        lower = -1e9
        upper = 1e9
        inflated = 1.0
        down = i - 1
        up = i + 1
        for k in range(windows_px.shape[0]):
            reach = windows_px[k]
            down = gather(points, normals, weight, chain, i, down, -1, reach, moments)
            up = gather(points, normals, weight, chain, i, up, 1, reach, moments)
            if moments[COUNT] < LEAST_POINTS:
                continue
            if not solve_quadratic(moments, solved):
                continue
            value = solved[0]
            sigma = math.sqrt(solved[3] * inflation[k])
            lower = max(lower, value - confidence * sigma)
            upper = min(upper, value + confidence * sigma)
            if lower > upper:
                break
            result[i, SHIFT] = value
            result[i, SLOPE] = solved[1]
            result[i, BEND] = solved[2]
            result[i, BEND_SIGMA] = math.sqrt(solved[4] * inflation[k])
            result[i, SMOOTH_SIGMA] = sigma
            result[i, WINDOW] = reach
            inflated = inflation[k]
            others[:] = moments
        if result[i, WINDOW] > 0.0:
            others[0] -= weight[i]
            if solve_quadratic(others, solved):
                result[i, PREDICTED] = solved[0]
                result[i, PREDICTED_SIGMA] = math.sqrt(solved[3] * inflated)
