# SPDX-License-Identifier: Apache-2.0
"""Runs of lit pixels down the columns of an image, the chains that they form, and what holds along
these: means, slopes, local quadratics.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from armscan.kernels.arrays import (
    Bytes,
    BytesOut,
    Floats,
    FloatsOut,
    Image,
    Ints,
    IntsOut,
    MapOut,
    Mask,
    Table,
    TableOut,
    compiled,
)
from armscan.kernels.stripe.ridge import IS_PLAIN, VALLEY_RATIO

CELL_PX = 64
"""Pixels of a row that are compared at once, and the side of a cell of the background."""
LIMIT_ROWS = 4
"""Rows for which one threshold holds."""
DARK = 255
"""Threshold of eight bits that no pixel exceeds."""


def _above(typing: Any, raw: Any, first: Any, limit: Any, column: Any) -> tuple[Any, Any]:
    """One bit for each of `CELL_PX` pixels from a place on: brighter than its column's threshold.

    ``first``: Place of the first pixel in the image. ``column``: Its column. Both must be followed
    by as many.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        row = ir.VectorType(ir.IntType(8), CELL_PX)

        def load(k: int) -> Any:
            data = context.make_array(signature.args[k])(context, builder, args[k]).data
            where = builder.bitcast(builder.gep(data, [args[k + 1]]), row.as_pointer())
            return builder.load(where, align=1)

        return builder.bitcast(builder.icmp_unsigned(">", load(0), load(2)), ir.IntType(64))

    return types.uint64(raw, types.intp, limit, types.intp), generate


def _above_slowly(raw: Mask, first: int, limit: Bytes, column: int) -> Any:
    """The same where compilation is switched off."""
    own = raw.reshape(raw.size)[first : first + CELL_PX]
    is_above = own > limit[column : column + CELL_PX]
    return np.packbits(is_above, bitorder="little").view(np.uint64)[0]


def _lowest(typing: Any, bits: Any) -> tuple[Any, Any]:
    """Place of the lowest bit that is set."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.uint64), generate


def _lowest_slowly(bits: Any) -> int:
    """The same where compilation is switched off."""
    return (int(bits) & -int(bits)).bit_length() - 1


pixels_above: Any = _above_slowly if IS_PLAIN else intrinsic(_above)
lowest_bit: Any = _lowest_slowly if IS_PLAIN else intrinsic(_lowest)


@compiled()
def set_limits(
    background: Image, is_lit_cell: Mask, y: int, rise: float, unit: float, limit: BytesOut
) -> None:
    """Threshold of each column of lit cells in a row; elsewhere it stays.

    ``background``: (rows, columns) level at the middles of cells, linear in between. ``y``: Row.
    ``rise``: Height above it. ``unit``: Of the image, over that of these. ``limit``: (W,) output.
    """
    rows, columns = background.shape
    v = min(max((y + 0.5) / CELL_PX - 0.5, 0.0), rows - 1.0)
    upper = int(v)
    lower = min(upper + 1, rows - 1)
    share = v - upper
    for c in range(columns):
        if is_lit_cell[y // CELL_PX, c] == 0:
            continue
        before, after = max(c - 1, 0), min(c + 1, columns - 1)
        left = background[upper, before]
        left += share * (background[lower, before] - left)
        middle = background[upper, c] + share * (background[lower, c] - background[upper, c])
        right = background[upper, after]
        right += share * (background[lower, after] - right)
        first = c * CELL_PX
        for x in range(first, min(first + CELL_PX, limit.shape[0])):
            u = (x - first + 0.5) / CELL_PX - 0.5
            level = middle + (u * (right - middle) if u > 0.0 else u * (middle - left))
            limit[x] = np.uint8(min(max((level + rise) * unit, 0.0), 254.0))


@compiled()
def find_column_runs(
    raw: Mask, background: Image, is_lit_cell: Mask, rise: float, unit: float, runs: MapOut
) -> int:
    """Runs of pixels down the columns that are brighter than the background by ``rise``.

    ``raw``: (H, W >= 64) of eight bits. ``background``, ``rise``, ``unit``: As for `set_limits`.
    ``is_lit_cell``: (rows, columns) 0 for cells that are passed over unread. ``runs``: (capacity,
    3) int32 output: column, first and last row, in the order of their last rows.

    Returns count of runs; more than the capacity if the output was too short.
    """
    height, width = raw.shape
    n_cells = is_lit_cell.shape[1]
    limit = np.full(width, DARK, np.uint8)
    open_, one, none = np.zeros(n_cells, np.uint64), np.uint64(1), np.uint64(0)
    start = np.zeros(n_cells * CELL_PX, np.int32)
    count = 0
    for y in range(height + 1):
        if y < height and y % LIMIT_ROWS == 0:
            set_limits(background, is_lit_cell, y, rise, unit, limit)
        for c in range(n_cells):
            lit = none
            if y < height and is_lit_cell[y // CELL_PX, c] != 0:
                # the last cell is read together with pixels of the one before
                first = min(c * CELL_PX, width - CELL_PX)
                lit = pixels_above(raw, y * width + first, limit, first)
                lit = lit >> np.uint64(c * CELL_PX - first)
            if lit == open_[c]:
                continue
            begun, ended = lit & ~open_[c], open_[c] & ~lit
            open_[c] = lit
            while begun != none:
                start[c * CELL_PX + lowest_bit(begun)] = y
                begun &= begun - one
            while ended != none:
                x = c * CELL_PX + lowest_bit(ended)
                ended &= ended - one
                if count < runs.shape[0]:
                    runs[count, 0] = x
                    runs[count, 1] = start[x]
                    runs[count, 2] = y - 1
                count += 1
    return count


@compiled()
def sort_by_column(runs: MapOut, order: IntsOut, first: IntsOut) -> None:
    """Order of the runs (N, 3) by column, then from top to bottom.

    ``order``: (N,) output. ``first``: (W + 1,) output: place in it of each column's first run.
    """
    first[:] = 0
    width = first.shape[0] - 1
    for i in range(runs.shape[0]):
        first[runs[i, 0] + 1] += 1
    for x in range(width):
        first[x + 1] += first[x]
    at = first.copy()
    for i in range(runs.shape[0]):
        x = runs[i, 0]
        order[at[x]] = i
        at[x] += 1


BACK = 5
"""Columns before a run in which the last point of its chain may lie."""
SLOPE_SHARE = 0.25
"""Of a new step in the slope that a chain is followed by."""
OFF_SHARE, OFF_PX = 0.25, 2.0
"""How far the middle of a run may lie from where its chain leads: a share of its length, and px."""
NONE = -1


@compiled()
def link_columns(
    runs: MapOut, order: Ints, first: Ints, longest_px: int, chain: IntsOut, size: IntsOut
) -> int:
    """Number the chains of runs that follow each other from column to column.

    A run goes on with the chain whose last one, up to `BACK` columns before, overlaps with it and
    leads nearest to its middle.

    ``runs``: (N, 3). ``order``, ``first``: Of `sort_by_column`. ``longest_px``: Longer ones are no
    cross-sections of a line. ``chain``: (N,) output, in the order by column; -1 of these. ``size``:
    (N,) output: points of each chain.

    Returns count of chains.
    """
    n = order.shape[0]
    slope, is_taken = np.zeros(n), np.zeros(n, np.uint8)
    number = 0
    size[:] = 0
    for x in range(first.shape[0] - 1):
        for k in range(first[x], first[x + 1]):
            low, high = runs[order[k], 1], runs[order[k], 2]
            chain[k] = NONE
            if high - low >= longest_px or high == low:
                continue
            middle = 0.5 * (low + high)
            best, least, own = NONE, OFF_SHARE * (high - low) + OFF_PX, 0.0
            for back in range(1, min(BACK, x) + 1):
                for m in range(first[x - back], first[x - back + 1]):
                    if chain[m] < 0 or is_taken[m] != 0:
                        continue
                    j = order[m]
                    if runs[j, 1] > high + back or runs[j, 2] < low - back:
                        continue
                    step = (middle - 0.5 * (runs[j, 1] + runs[j, 2])) / back
                    off = abs(step - slope[m]) * back
                    if off < least:
                        best, least, own = m, off, step
                if best >= 0:
                    break
            if best >= 0:
                is_taken[best] = 1
                chain[k] = chain[best]
                slope[k] = slope[best] + SLOPE_SHARE * (own - slope[best])
            else:
                chain[k] = number
                number += 1
            size[chain[k]] += 1
    return number


POINT_COLUMN, POINT_LOW, POINT_HIGH, POINT_BELOW, POINT_ABOVE, POINT_CHAIN = range(6)
POINT_COLUMNS = 6
"""Of a point: column, first and last row of its run, rows to the next run on the side of smaller
and of larger rows (1: they touch), and number of its chain."""
FREE_PX = 100000
OTHER_SHARE = 0.25
"""Of a run's length: shorter ones beside it are its own speckle, not another line."""


@compiled()
def gather_chains(
    runs: MapOut, order: Ints, chain: Ints, size: Ints, least: int, points: MapOut, start: IntsOut
) -> int:
    """Points of the chains of at least so many, chain after chain.

    ``runs``, ``order``, ``chain``, ``size``: Of `link_columns`. ``points``: (N, 6) output.
    ``start``: (C + 1,) output: where each chain of those kept begins, and one more than the last.

    Returns count of chains that are kept.
    """
    at = np.full(size.shape[0], NONE, np.int64)
    n_kept = total = 0
    for c in range(size.shape[0]):
        if size[c] >= least:
            at[c] = total
            start[n_kept] = total
            total += size[c]
            n_kept += 1
    start[n_kept] = total
    for k in range(order.shape[0]):
        c = chain[k]
        if c < 0 or at[c] < 0:
            continue
        i = order[k]
        own = points[at[c]]
        at[c] += 1
        own[POINT_COLUMN], own[POINT_LOW], own[POINT_HIGH] = runs[i, 0], runs[i, 1], runs[i, 2]
        own[POINT_BELOW] = own[POINT_ABOVE] = FREE_PX
        own[POINT_CHAIN] = c
        least_px = OTHER_SHARE * (runs[i, 2] - runs[i, 1] + 1)
        for way in (-1, 1):
            m = k + way
            while 0 <= m < order.shape[0] and runs[order[m], 0] == runs[i, 0]:
                j = order[m]
                if runs[j, 2] - runs[j, 1] + 1 >= least_px:
                    if way < 0:
                        own[POINT_BELOW] = runs[i, 1] - runs[j, 2]
                    else:
                        own[POINT_ABOVE] = runs[j, 1] - runs[i, 2]
                    break
                m += way
    return n_kept


RUN_LENGTH, RUN_HEIGHT, RUN_DIPS = range(3)
RUN_ROWS = 3
HEIGHT_HALF = 1
"""Pixels to both sides of a run's middle of which the height is taken."""


DIP_STEP = 8
"""Every so many points are asked whether their run dips: lines that run into each other do so
over more of them."""


@compiled()
def measure_runs(
    raw: Mask,
    image: Image,
    unit: float,
    background: Image,
    rise: float,
    points: MapOut,
    base: FloatsOut,
    measured: TableOut,
) -> None:
    """Length and height of the runs of points, whether they dip, and the background at each.

    A run dips where the three-pixel mean falls below `VALLEY_RATIO` of the peaks on both sides; of
    every `DIP_STEP` points one is asked, and its neighbours are told the same.

    ``raw``, ``image``, ``unit``: As for `look_across`. ``background``: As for `set_limits`.
    ``rise``: Height by which a peak stands out of a dip. ``points``: (N, 6). ``base``: (N,) output.
    ``measured``: (3, N) output.
    """
    rows, columns = background.shape
    has_bytes, share = raw.shape[0] > 1, 1.0 / unit
    height = raw.shape[0] if has_bytes else image.shape[0]
    measured[RUN_DIPS, :] = 0.0
    for i in range(points.shape[0]):
        x, low, high = points[i, POINT_COLUMN], points[i, POINT_LOW], points[i, POINT_HIGH]
        middle = (low + high) // 2
        v = min(max((middle + 0.5) / CELL_PX - 0.5, 0.0), rows - 1.0)
        u = min(max((x + 0.5) / CELL_PX - 0.5, 0.0), columns - 1.0)
        r, c = int(v), int(u)
        below, right = min(r + 1, rows - 1), min(c + 1, columns - 1)
        upper = background[r, c] + (u - c) * (background[r, right] - background[r, c])
        lower = background[below, c] + (u - c) * (background[below, right] - background[below, c])
        base[i] = upper + (v - r) * (lower - upper)
        measured[RUN_LENGTH, i] = high - low + 1
        top, bottom = max(middle - HEIGHT_HALF, 0), min(middle + HEIGHT_HALF, height - 1)
        total = 0.0
        for y in range(top, bottom + 1):
            total += share * raw[y, x] if has_bytes else image[y, x]
        measured[RUN_HEIGHT, i] = total / (bottom - top + 1) - base[i]
        if i % DIP_STEP != 0:
            continue
        before = own = peak = least = 0.0
        for y in range(max(low - 1, 0), min(high + 1, height - 1) + 1):
            after = (share * raw[y, x] if has_bytes else image[y, x]) - base[i]
            mean = (before + own + after) / 3.0
            before, own = own, after
            if mean >= peak:
                peak, least = mean, mean
            least = min(least, mean)
            if least < VALLEY_RATIO * peak and mean > 2.0 * least + rise:
                for m in range(max(i - DIP_STEP + 1, 0), min(i + DIP_STEP, points.shape[0])):
                    if points[m, POINT_CHAIN] == points[i, POINT_CHAIN]:
                        measured[RUN_DIPS, m] = 1.0
                break


@compiled(error_model="numpy")
def mean_along(values: Table, weight: Table, start: Ints, half: int, mean: TableOut) -> None:
    """Weighted means over the neighbours within ``half`` places of the same chain.

    ``values``, ``weight``: (M, N); values of weight 0 may be NaN. ``start``: (C + 1,) of
    `gather_chains`. ``mean``: (M, N) output, NaN where the weights sum to 0.
    """
    for row in range(values.shape[0]):
        own, weights = values[row], weight[row]
        for c in range(start.shape[0] - 1):
            first, stop = start[c], start[c + 1]
            total = norm = 0.0
            for i in range(first, min(first + half, stop)):
                total += weights[i] * own[i] if weights[i] > 0.0 else 0.0
                norm += weights[i]
            for i in range(first, stop):
                ahead, behind = i + half, i - half - 1
                if ahead < stop:
                    total += weights[ahead] * own[ahead] if weights[ahead] > 0.0 else 0.0
                    norm += weights[ahead]
                if behind >= first:
                    total -= weights[behind] * own[behind] if weights[behind] > 0.0 else 0.0
                    norm -= weights[behind]
                mean[row, i] = total / norm if norm > 1e-9 else np.nan


@compiled(error_model="numpy")
def slopes_along(centre: Floats, points: MapOut, start: Ints, half: int, slope: FloatsOut) -> None:
    """Rows a column (N,) by which chains run, over ``half`` places to both sides.

    ``centre``: (N,). ``points``: (N, 6). ``start``: (C + 1,) of `gather_chains`.
    """
    for c in range(start.shape[0] - 1):
        for i in range(start[c], start[c + 1]):
            low, high = max(i - half, start[c]), min(i + half, start[c + 1] - 1)
            run = points[high, POINT_COLUMN] - points[low, POINT_COLUMN]
            slope[i] = (centre[high] - centre[low]) / run if run > 0 else 0.0


@compiled()
def cut_stretches(points: MapOut, is_used: Bytes, rows: IntsOut, start: IntsOut) -> int:
    """Rows of the points that are used, and where stretches of neighbouring columns begin.

    ``points``: (N, 6). ``is_used``: (N,). ``rows``: (N,) output, of which as many count as are
    used. ``start``: (N + 1,) output, one more than there are stretches.

    Returns count of stretches.
    """
    n = count = 0
    for i in range(points.shape[0]):
        if is_used[i] == 0:
            continue
        is_next = n > 0 and rows[n - 1] == i - 1
        if is_next:
            is_next = points[i, POINT_COLUMN] == points[i - 1, POINT_COLUMN] + 1
            is_next &= points[i, POINT_CHAIN] == points[i - 1, POINT_CHAIN]
        if not is_next:
            start[count] = n
            count += 1
        rows[n] = i
        n += 1
    start[count] = n
    return count


@compiled(error_model="numpy")
def score_middles(
    centre: Floats, variance: Floats, start: Ints, weights: Floats, score: FloatsOut
) -> int:
    """How many sigmas (N,) centres lie off what their neighbours alone say.

    ``centre``, ``variance``, ``start``: As for `smooth_stretches`. ``weights``: (half + 1,) of a
    local quadratic, from the middle on. ``score``: (N,) output; -1 where a stretch ends too near.
    Returns count of the others.
    """
    half = weights.shape[0] - 1
    share = 1.0 - weights[0]
    total = 0.0
    for way in range(1, half + 1):
        total += 2.0 * weights[way] * weights[way]
    count = 0
    score[:] = -1.0
    for s in range(start.shape[0] - 1):
        for i in range(start[s] + half, start[s + 1] - half):
            others = 0.0
            for way in range(1, half + 1):
                others += weights[way] * (centre[i + way] + centre[i - way])
            spread = variance[i] * (1.0 + total / (share * share))
            score[i] = abs(centre[i] - others / share) / math.sqrt(spread)
            count += 1
    return count


SMOOTHED, SLOPE, BEND, SMOOTH_VARIANCE = range(4)
TANGENT_HALF = 8
"""Places to both sides by which the slope and the bend of a line are told."""
_SPAN = 2.0 * TANGENT_HALF + 1.0
BEND_VARIANCE = 720.0 / (_SPAN * (_SPAN**2 - 1.0) * (_SPAN**2 - 4.0))
"""Of such a bend, over the variance of a centre."""
SMOOTH_ROWS = 4
"""Of smoothed stretches: centre, its slope and second derivative by the column, and variance."""


@compiled(error_model="numpy", fastmath=True)
def add_shifted(
    values: Floats,
    first: int,
    stop: int,
    way: int,
    weight: float,
    even: float,
    total: FloatsOut,
) -> None:
    """Add ``weight`` times both neighbours at a distance to each of some totals.

    ``even``: 1, or -1 where the one before is taken off the one after.
    """
    ahead, behind = values[first + way : stop + way], values[first - way : stop - way]
    own = total[first:stop]
    for k in range(own.shape[0]):
        own[k] += weight * (ahead[k] + even * behind[k])


@compiled(error_model="numpy")
def smooth_stretches(
    centre: Floats,
    variance: Floats,
    start: Ints,
    halves: Ints,
    weights: Table,
    inflation: Floats,
    confidence: float,
    result: TableOut,
) -> None:
    """Local quadratics over columns that follow each other, as wide as their estimates agree.

    The window grows while the intervals of ``confidence`` sigmas about the estimates of all smaller
    ones have a place in common (Katkovnik 1999). Where a stretch ends nearer than a window reaches,
    that window is left out.

    ``centre``, ``variance``: (N,) of points; stretches are consecutive. ``start``: (S + 1,) where
    each stretch begins. ``halves``: (K,) half windows, increasing. ``weights``: (K, H + 1) of the
    quadratic's value, from the middle on. ``inflation``: (K,) variance that the estimate has over
    that of points which err on their own. ``result``: (4, N) output.
    """
    n_windows, n = halves.shape[0], centre.shape[0]
    total, spread, sums = np.zeros((n_windows, n)), np.zeros((n_windows, n)), np.zeros((2, n))
    middle = TANGENT_HALF * (TANGENT_HALF + 1.0) / 3.0
    for s in range(start.shape[0] - 1):
        for k in range(n_windows):
            half = halves[k]
            first, stop = start[s] + half, start[s + 1] - half
            if stop <= first:
                break
            for i in range(first, stop):
                total[k, i] = weights[k, 0] * centre[i]
                spread[k, i] = weights[k, 0] * weights[k, 0] * variance[i]
            for way in range(1, half + 1):
                share = weights[k, way]
                add_shifted(centre, first, stop, way, share, 1.0, total[k])
                add_shifted(variance, first, stop, way, share * share, 1.0, spread[k])
        first, stop = start[s] + TANGENT_HALF, start[s + 1] - TANGENT_HALF
        for way in range(1, TANGENT_HALF + 1):
            if stop > first:
                add_shifted(centre, first, stop, way, float(way), -1.0, sums[0])
                add_shifted(centre, first, stop, way, way * way - middle, 1.0, sums[1])
    norm = middle * (2.0 * TANGENT_HALF + 1.0)
    bend_norm = middle * middle
    for way in range(1, TANGENT_HALF + 1):
        bend_norm += 2.0 * (way * way - middle) ** 2
    for s in range(start.shape[0] - 1):
        first, stop = start[s], start[s + 1]
        for i in range(first, stop):
            room = min(i - first, stop - 1 - i)
            best, own = centre[i], variance[i]
            low, high = -np.inf, np.inf
            for k in range(n_windows):
                if halves[k] > room:
                    break
                square = spread[k, i] * inflation[k]
                reach = confidence * math.sqrt(square)
                low, high = max(low, total[k, i] - reach), min(high, total[k, i] + reach)
                if low > high:
                    break
                best, own = total[k, i], square
            result[SMOOTHED, i] = best
            result[SMOOTH_VARIANCE, i] = own
            if room >= TANGENT_HALF:
                result[SLOPE, i] = sums[0, i] / norm
                result[BEND, i] = 2.0 * (sums[1, i] - middle * centre[i]) / bend_norm
            else:
                slope = lever = 0.0
                low_end, high_end = max(i - TANGENT_HALF, first), min(i + TANGENT_HALF, stop - 1)
                place = 0.5 * (low_end + high_end)
                for m in range(low_end, high_end + 1):
                    slope += (m - place) * centre[m]
                    lever += (m - place) ** 2
                result[SLOPE, i] = slope / lever if lever > 0.0 else 0.0
