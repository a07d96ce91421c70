# SPDX-License-Identifier: Apache-2.0
"""Chains of ridge points: links, distance to other lines, steps of light, likeliest sheets."""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import (
    COLUMN,
    ROW,
    Bytes,
    BytesOut,
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
def span_of(points: Table, span: IntsOut) -> None:
    """Least x and y of points (N, >= 2), and columns and rows from there on: ``span`` (4,)."""
    low_x = low_y = np.inf
    high_x = high_y = 0.0
    for i in range(points.shape[0]):
        low_x, high_x = min(low_x, points[i, 0]), max(high_x, points[i, 0])
        low_y, high_y = min(low_y, points[i, 1]), max(high_y, points[i, 1])
    is_any = points.shape[0] > 0
    span[0] = math.floor(low_x) if is_any else 0
    span[1] = math.floor(low_y) if is_any else 0
    span[2] = int(high_x) - span[0] + 2
    span[3] = int(high_y) - span[1] + 2


@compiled()
def place_points(points: Table, left: int, top: int, owner: MapOut) -> None:
    """Enter points into a map of pixels, dropping row points that repeat a column point.

    ``points``: (N, 6) from `refine_candidates`. ``left``, ``top``: Pixel of the map's corner.
    ``owner``: (H, W) int32 zeros; receives one more than the index of the point in each pixel.
    """
    height, width = owner.shape
    for side in range(2):
        for i in range(points.shape[0]):
            if int(points[i, 5]) != side:
                continue
            x = int(points[i, 0] - left + 0.5)
            y = int(points[i, 1] - top + 0.5)
            is_kept = owner[y, x] == 0
            if side == ROW:
                for v in range(max(y - 1, 0), min(y + 2, height)):
                    for u in range(max(x - 1, 0), min(x + 2, width)):
                        j = owner[v, u] - 1
                        if j >= 0 and points[j, 5] != ROW:
                            distance = math.hypot(
                                points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
                            )
                            is_kept &= distance >= SAME_PX
            if is_kept:
                owner[y, x] = i + 1


@compiled()
def find_neighbours(
    points: Table, left: int, top: int, owner: MapOut, ahead: IntsOut, behind: IntsOut
) -> None:
    """Best continuation of each point to both sides along its tangent.

    ``points``: (N, 6) from `refine_candidates`. ``left``, ``top``, ``owner``: Of `place_points`.
    ``ahead``, ``behind``: (N,) output: index of the neighbour, or -1. The tangent is the normal
    turned by a quarter.
    """
    height, width = owner.shape
    for i in range(points.shape[0]):
        x = int(points[i, 0] - left + 0.5)
        y = int(points[i, 1] - top + 0.5)
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
def measure_chains(
    points: Table, chain: Ints, start: IntsOut, stop: IntsOut, length_px: FloatsOut
) -> None:
    """First index, index after the last, and arc length of each point's chain: (N,) each.

    ``points``: (N, >= 2) x, y. ``chain``: (N,) numbers; a chain's points are consecutive.
    """
    n = points.shape[0]
    first = 0
    while first < n:
        last = first
        length = 0.0
        while last + 1 < n and chain[last + 1] == chain[first]:
            dx = points[last + 1, 0] - points[last, 0]
            dy = points[last + 1, 1] - points[last, 1]
            length += math.sqrt(dx * dx + dy * dy)
            last += 1
        start[first : last + 1] = first
        stop[first : last + 1] = last + 1
        length_px[first : last + 1] = length
        first = last + 1


@compiled()
def set_between(flags: Bytes, chain: Ints, span: Floats, closed: BytesOut) -> None:
    """Set 1 also between two points of a chain with 1 that lie no farther apart than ``span`` (N,).

    ``flags``: (N,). ``chain``: (N,) numbers; a chain's points are consecutive. ``closed``: (N,) of
    the same flags, input and output.
    """
    last = NONE
    for i in range(flags.shape[0]):
        if flags[i] == 0:
            continue
        if last != NONE and chain[last] == chain[i]:
            for k in range(last + 1, i):
                if i - last <= span[k]:
                    closed[k] = 1
        last = i


@compiled()
def compare_light(light: Floats, is_cut: Bytes, reach: int, change: FloatsOut) -> None:
    """Difference of the means of ``reach`` points before each point and from it on.

    ``light``: (A,). ``is_cut``: (A,) 1 for the first point of each chain. ``change``: (A,) output;
    -1 where the chain begins or ends nearer.
    """
    n, since = light.shape[0], 0
    change[:] = -1.0
    before = after = 0.0
    for i in range(n):
        # of the points i - 2 reach + 1 to i, the later half and the earlier one
        since = 1 if is_cut[i] != 0 else since + 1
        after += light[i]
        if i >= reach:
            after -= light[i - reach]
            before += light[i - reach]
        if i >= 2 * reach:
            before -= light[i - 2 * reach]
        if since >= 2 * reach:
            change[i - reach + 1] = abs(after - before) / reach


@compiled()
def cut_at_largest(change: Floats, limit: float, reach: int, is_cut: BytesOut) -> None:
    """Cut where a change (A,) is beyond the limit and the largest within ``reach`` points."""
    n = change.shape[0]
    for i in range(n):
        if not change[i] > limit:
            continue
        is_largest = True
        for k in range(max(i - reach, 0), min(i + reach + 1, n)):
            is_largest = is_largest and change[i] >= change[k]
        if is_largest:
            is_cut[i] = 1


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


@compiled()
def sum_windows(values: Table, chain: Ints, half: int, sums: TableOut) -> None:
    """Sums over the neighbours within ``half`` places on the same chain.

    ``values``: (M, N). ``chain``: (N,) numbers; a chain's points are consecutive. ``sums``: (M, N)
    output.
    """
    m, n = values.shape
    running = np.zeros(n + 1)
    for row in range(m):
        first = 0
        while first < n:
            stop = first
            running[first] = 0.0
            while stop < n and chain[stop] == chain[first]:
                running[stop + 1] = running[stop] + values[row, stop]
                stop += 1
            for i in range(first, stop):
                sums[row, i] = running[min(i + half + 1, stop)] - running[max(i - half, first)]
            first = stop


@compiled()
def middle_of_squares(values: FloatsOut) -> float:
    """Least of some values (N,) up to which they have half of the sum of all squares.

    The values are brought into another order.
    """
    total = below = 0.0
    for i in range(values.shape[0]):
        total += values[i] * values[i]
    first, last = 0, values.shape[0] - 1
    while first < last:
        low, high = min(values[first], values[last]), max(values[first], values[last])
        pivot = min(max(values[(first + last) // 2], low), high)
        # smaller ones first, then its equals
        left, right, i, smaller, alike = first, last, first, 0.0, 0.0
        while i <= right:
            own = values[i]
            if own < pivot:
                smaller += own * own
                values[i], values[left] = values[left], own
                left += 1
                i += 1
            elif own > pivot:
                values[i], values[right] = values[right], own
                right -= 1
            else:
                alike += own * own
                i += 1
        if below + smaller >= 0.5 * total:
            last = left - 1
        elif below + smaller + alike >= 0.5 * total:
            return float(pivot)
        else:
            below += smaller + alike
            first = right + 1
    return float(values[min(first, values.shape[0] - 1)])
