# SPDX-License-Identifier: Apache-2.0
"""Stripe centres column by column: weighted sums across lines, and quadratics along them.

Sixteen neighbouring columns of a chain are looked at together: their pixels lie beside each other
in every row of the image, so that a row is read as a whole. Lines that run rather up and down are
found on the transposed image.
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
    Floats,
    FloatsOut,
    Image,
    Ints,
    IntsOut,
    MapOut,
    Mask,
    Row,
    RowOut,
    Table,
    TableOut,
    compiled,
)
from armscan.kernels.stripe.column_runs import (
    POINT_CHAIN,
    POINT_COLUMN,
    POINT_HIGH,
    POINT_LOW,
)
from armscan.kernels.stripe.ridge import IS_PLAIN

LANES = 16
"""Columns that are looked at together."""


def _widen(typing: Any, raw: Any, first: Any, factor: Any, levels: Any) -> tuple[Any, Any]:
    """Write `LANES` bytes of an image from a place on as numbers, times a factor.

    One by one, the passes would wait for them to be written.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        single = ir.FloatType()
        bytes_, row = ir.VectorType(ir.IntType(8), LANES), ir.VectorType(single, LANES)
        whole = ir.VectorType(ir.IntType(32), LANES)
        source, out = (
            context.make_array(signature.args[k])(context, builder, args[k]).data for k in (0, 3)
        )
        where = builder.bitcast(builder.gep(source, [args[1]]), bytes_.as_pointer())
        # signed: what is unsigned has no instruction of its own
        numbers = builder.sitofp(builder.zext(builder.load(where, align=1), whole), row)
        undefined = ir.Constant(row, ir.Undefined)
        at = ir.Constant(ir.IntType(32), 0)
        factors = builder.shuffle_vector(
            builder.insert_element(undefined, args[2], at),
            undefined,
            ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES),
        )
        target = builder.bitcast(out, row.as_pointer())
        builder.store(builder.fmul(numbers, factors), target, align=4)
        return context.get_dummy_value()

    return types.void(raw, types.intp, types.float32, levels), generate


def _widen_slowly(raw: Mask, first: int, factor: np.float32, levels: RowOut) -> None:
    """The same where compilation is switched off."""
    levels[:LANES] = raw.reshape(raw.size)[first : first + LANES] * factor


widen_bytes: Any = _widen_slowly if IS_PLAIN else intrinsic(_widen)

FARTHEST_SQUARE = np.float32(40.0)


@compiled(fastmath=True, is_inlined=True)
def bell_at(square: np.float32) -> np.float32:
    """``exp(-square / 2)`` to 2e-3 of itself within `LINE_SIGMAS`: a series, squared four times."""
    y = min(square, FARTHEST_SQUARE) * np.float32(-1.0 / 32.0)
    series = np.float32(0.5) + y * np.float32(1.0 / 6.0)
    power = np.float32(1.0) + y * (np.float32(1.0) + y * series)
    power2 = power * power
    power4 = power2 * power2
    power8 = power4 * power4
    return np.float32(power8 * power8)


SIDE_FROM, SIDE_TO = 3.4, 4.7
"""Sigmas between which the background beside the line is read."""
LINE_SIGMAS = 2.7
"""To which a line's own pixels count."""
AMPLITUDE, CENTRE, SIGMA, LOW_SIDE, HIGH_SIDE, N_SIDES = range(6)
FIRST_ROWS = 6
"""Results of the first pass; the last one is how many pixels the smaller side had."""
VARIANCE, LEAN, LEAN_NORM, BEND_GAIN, N_CLIPPED = range(3, 8)
SECOND_ROWS = 8
"""Results of the second pass; amplitude, centre and sigma as of the first."""
N_FIRST_SUMS, N_SECOND_SUMS = 9, 10


@compiled()
def count_lanes(points: MapOut, first: int) -> int:
    """How many points from one on lie in columns that follow each other, to `LANES`."""
    n = 1
    while n < LANES and first + n < points.shape[0]:
        if points[first + n, POINT_COLUMN] != points[first, POINT_COLUMN] + n:
            break
        if points[first + n, POINT_CHAIN] != points[first, POINT_CHAIN]:
            break
        n += 1
    return n


# branches within what is inlined would count references anew at every row of pixels
@compiled(is_inlined=True)
def copy_levels(image: Image, y: int, x: int, levels: RowOut) -> None:
    """Grey levels of `LANES` pixels of a row of an image (H, W) from a column on."""
    row = image[y, x : x + LANES]
    for k in range(LANES):
        levels[k] = row[k]


@compiled(fastmath=True, error_model="numpy", is_inlined=True)
def add_moments(levels: Row, y: np.float32, lanes: Row, sums: RowOut) -> None:
    """Add a row's pixels to the moments of what rises above the background under a bell.

    ``lanes``: (3 `LANES`,) centre, 1 over sigma, background. ``sums``: (9 `LANES`,) bell times
    height, that times u and u^2, bell, bell times u^2; pixels and heights on the lower side, then
    on the upper side.
    """
    near, far = np.float32(SIDE_FROM), np.float32(SIDE_TO)
    one, zero = np.float32(1.0), np.float32(0.0)
    for k in range(LANES):
        u = (y - lanes[k]) * lanes[LANES + k]
        uu = u * u
        bell = bell_at(uu)
        height = levels[k] - lanes[2 * LANES + k]
        own = bell * height
        sums[k] += own
        sums[LANES + k] += own * u
        sums[2 * LANES + k] += own * uu
        sums[3 * LANES + k] += bell
        sums[4 * LANES + k] += bell * uu
        low = one if (u < -near) & (u > -far) else zero
        high = one if (u > near) & (u < far) else zero
        sums[5 * LANES + k] += low
        sums[6 * LANES + k] += low * height
        sums[7 * LANES + k] += high
        sums[8 * LANES + k] += high * height


MOST_WIDER = 4.0
"""Of a line's variance over that of the bell it is looked at through."""


@compiled(error_model="numpy")
def keep_moments(
    sums: Row, lane: int, centre: float, sigma: float, base: float, i: int, result: TableOut
) -> None:
    """A line's amplitude, centre and sigma from its moments under a bell.

    A Gaussian times the bell has the variance 1 / (1 / V + 1 / W), and its mean lies as far from
    the bell's middle as V / (V + W) of the line's centre: so the first steps of an iteration to the
    centre are left out. What the bell's own moments are over the pixels is in ``sums``.
    """
    own, norm = float(sums[lane]), float(sums[3 * LANES + lane])
    result[:, i] = 0.0
    if own > 0.0 and norm > 0.0:
        mean = sums[LANES + lane] / own
        seen = sums[2 * LANES + lane] / own - mean * mean
        bell = sums[4 * LANES + lane] / norm
        line = seen * bell / max(bell - seen, bell / (1.0 + MOST_WIDER))
        line = max(line, 1.0 / MOST_WIDER)
        result[CENTRE, i] = centre + sigma * mean * (bell + line) / bell
        result[SIGMA, i] = sigma * math.sqrt(line)
        result[AMPLITUDE, i] = own / (norm * math.sqrt(line / (bell + line)))
    n_low, n_high = sums[5 * LANES + lane], sums[7 * LANES + lane]
    result[LOW_SIDE, i] = base + sums[6 * LANES + lane] / n_low if n_low > 0.0 else np.nan
    result[HIGH_SIDE, i] = base + sums[8 * LANES + lane] / n_high if n_high > 0.0 else np.nan
    result[N_SIDES, i] = min(n_low, n_high)


@compiled()
def look_across(
    raw: Mask,
    image: Image,
    unit: float,
    points: MapOut,
    sigma: Floats,
    base: Floats,
    result: TableOut,
) -> None:
    """First pass: amplitude, centre, sigma and the background on both sides of each point.

    ``raw``: (H, W) of eight bits, to be divided by ``unit``; (1, 1) if ``image`` (H, W) holds the
    levels. ``points``: (N, 6). ``sigma``, ``base``: (N,) expected sigma along the column, and
    background. ``result``: (6, N) output.
    """
    has_bytes, share = raw.shape[0] > 1, np.float32(1.0 / unit)
    height, width = raw.shape if has_bytes else image.shape
    levels, lanes = np.zeros(LANES, np.float32), np.zeros(3 * LANES, np.float32)
    sums = np.zeros(N_FIRST_SUMS * LANES, np.float32)
    first = 0
    while first < points.shape[0]:
        n = count_lanes(points, first)
        # lanes beyond the chain's end are looked at, too, and lie in the image
        left = min(points[first, POINT_COLUMN], width - LANES)
        shift = points[first, POINT_COLUMN] - left
        low, high = np.inf, 0.0
        for k in range(n):
            i = first + k
            middle = 0.5 * (points[i, POINT_LOW] + points[i, POINT_HIGH])
            low = min(low, middle - SIDE_TO * sigma[i])
            high = max(high, middle + SIDE_TO * sigma[i])
        top, bottom = max(math.floor(low), 0), min(math.ceil(high), height - 1)
        for lane in range(LANES):
            i = min(max(first + lane - shift, first), first + n - 1)
            middle = 0.5 * (points[i, POINT_LOW] + points[i, POINT_HIGH])
            lanes[lane] = np.float32(middle - top)
            lanes[LANES + lane] = np.float32(1.0 / sigma[i])
            lanes[2 * LANES + lane] = np.float32(base[i])
        sums[:] = np.float32(0.0)
        for y in range(top, bottom + 1):
            if has_bytes:
                widen_bytes(raw, y * width + left, share, levels)
            else:
                copy_levels(image, y, left, levels)
            add_moments(levels, np.float32(y - top), lanes, sums)
        for k in range(n):
            i = first + k
            middle = 0.5 * (points[i, POINT_LOW] + points[i, POINT_HIGH])
            keep_moments(sums, k + shift, middle, sigma[i], base[i], i, result)
        first += n


@compiled(is_inlined=True)
def count_unclipped(clipped: Mask, y: int, x: int, counts: RowOut) -> None:
    """1 or 0 for each of `LANES` pixels of a row of a mask (H, W) of those that saturated."""
    one, zero = np.float32(1.0), np.float32(0.0)
    own = clipped[y, x : x + LANES]
    for k in range(LANES):
        counts[k] = zero if own[k] > 0 else one


@compiled(is_inlined=True)
def count_below(levels: Row, clip: np.float32, counts: RowOut) -> None:
    """1 or 0 for each of `LANES` levels, of which those from ``clip`` on saturated."""
    one, zero = np.float32(1.0), np.float32(0.0)
    for k in range(LANES):
        counts[k] = one if levels[k] < clip else zero


@compiled(fastmath=True, error_model="numpy", is_inlined=True)
def add_weighted(
    levels: Row, counts: Row, y: np.float32, noise: Row, lanes: Row, sums: RowOut
) -> None:
    """Add a row's pixels to the weighted sums of a Gauss-Newton step of centre and amplitude.

    ``noise``: (3,) ``C^2``, ``1 / gain``, ``read^2``. ``lanes``: (5 `LANES`,) centre, 1 over sigma,
    amplitude, background at the centre, its rise a row. ``sums``: (10 `LANES`,) products of the
    derivatives by centre and log amplitude as 00 01 11, their right-hand side, residual times the
    skew term ``u (u^2 - 3)``, that term times the centre's derivative, its norm, the centre's
    derivative times ``u^3``, clipped pixels.
    """
    square, linear, constant = noise[0], noise[1], noise[2]
    one, zero, three = np.float32(1.0), np.float32(0.0), np.float32(3.0)
    reach = np.float32(LINE_SIGMAS * LINE_SIGMAS)
    for k in range(LANES):
        d = y - lanes[k]
        u = d * lanes[LANES + k]
        uu = u * u
        m = lanes[2 * LANES + k] * bell_at(uu)
        behind = lanes[3 * LANES + k] + d * lanes[4 * LANES + k]
        r = levels[k] - behind - m
        is_line = one if uu < reach else zero
        w = is_line * counts[k] / (square * m * m + linear * max(m + behind, zero) + constant)
        j = m * u
        wj = w * j
        wm = w * m
        wq = wj * (uu - three)
        sums[k] += wj * j
        sums[LANES + k] += wj * m
        sums[2 * LANES + k] += wm * m
        sums[3 * LANES + k] += wj * r
        sums[4 * LANES + k] += wm * r
        sums[5 * LANES + k] += wq * r
        sums[6 * LANES + k] += wq * j
        sums[7 * LANES + k] += wq * j * (uu - three)
        sums[8 * LANES + k] += wj * m * uu * u
        sums[9 * LANES + k] += is_line * (one - counts[k])


MOST_STEP = 0.7
"""Of a line's sigma, by which the second pass moves a centre at most: farther off it failed."""


@compiled(error_model="numpy")
def keep_step(sums: Row, lane: int, given: Table, i: int, result: TableOut) -> None:
    """Take the step of one lane to point ``i``; variance 0 where it fails.

    ``given``, ``result``: As for `fit_columns`.
    """
    h00, h01 = float(sums[lane]), float(sums[LANES + lane])
    h11, b0 = float(sums[2 * LANES + lane]), float(sums[3 * LANES + lane])
    b1, q0 = float(sums[4 * LANES + lane]), float(sums[6 * LANES + lane])
    determinant = h00 * h11 - h01 * h01
    result[:, i] = 0.0
    sigma = given[SIGMA, i]
    result[AMPLITUDE, i], result[CENTRE, i], result[SIGMA, i] = (
        given[AMPLITUDE, i],
        given[CENTRE, i],
        sigma,
    )
    result[N_CLIPPED, i] = sums[9 * LANES + lane]
    if not determinant > 0.0:
        return
    step = (h11 * b0 - h01 * b1) / determinant
    if not abs(step) < MOST_STEP:
        return
    grown = (h00 * b1 - h01 * b0) / determinant
    result[CENTRE, i] = given[CENTRE, i] + sigma * step
    result[AMPLITUDE, i] = given[AMPLITUDE, i] * (1.0 + min(max(grown, -0.5), 1.0))
    result[VARIANCE, i] = sigma * sigma * h11 / determinant
    result[LEAN, i] = sums[5 * LANES + lane] - q0 / h00 * b0
    result[LEAN_NORM, i] = max(sums[7 * LANES + lane] - q0 * q0 / h00, 0.0)
    result[BEND_GAIN, i] = sums[8 * LANES + lane] / h00


@compiled()
def fit_columns(
    raw: Mask,
    image: Image,
    unit: float,
    clipped: Mask,
    clip: float,
    points: MapOut,
    given: Table,
    noise: Row,
    result: TableOut,
) -> None:
    """Second pass: a Gauss-Newton step of centre and amplitude, weighted by the noise.

    ``raw``, ``image``, ``unit``: As for `look_across`. ``clipped``: (H, W) 1 where the camera
    saturated; (1, 1) if a level of ``clip`` says so. ``points``: (N, 6). ``given``: (6, N) of
    `look_across`, its sigma and sides averaged along the line. ``noise``: (3,) as for
    `add_weighted`. ``result``: (8, N) output: amplitude, centre, sigma, variance of the centre (0:
    the step failed), score of a skew, its norm, by how much a term ``u^3`` in the profile's
    exponent moves the centre in sigmas, count of clipped pixels.
    """
    has_bytes, has_mask = raw.shape[0] > 1, clipped.shape[0] > 1
    height, width = raw.shape if has_bytes else image.shape
    share, limit = np.float32(1.0 / unit), np.float32(clip)
    levels, counts = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
    lanes = np.zeros(5 * LANES, np.float32)
    sums = np.zeros(N_SECOND_SUMS * LANES, np.float32)
    first = 0
    while first < points.shape[0]:
        n = count_lanes(points, first)
        left = min(points[first, POINT_COLUMN], width - LANES)
        shift = points[first, POINT_COLUMN] - left
        low, high = np.inf, 0.0
        for i in range(first, first + n):
            low = min(low, given[CENTRE, i] - LINE_SIGMAS * given[SIGMA, i])
            high = max(high, given[CENTRE, i] + LINE_SIGMAS * given[SIGMA, i])
        top, bottom = max(math.floor(low), 0), min(math.ceil(high), height - 1)
        for lane in range(LANES):
            i = min(max(first + lane - shift, first), first + n - 1)
            sides = given[HIGH_SIDE, i] - given[LOW_SIDE, i]
            lanes[lane] = np.float32(given[CENTRE, i] - top)
            lanes[LANES + lane] = np.float32(1.0 / given[SIGMA, i])
            lanes[2 * LANES + lane] = np.float32(given[AMPLITUDE, i])
            lanes[3 * LANES + lane] = np.float32(given[LOW_SIDE, i] + 0.5 * sides)
            apart = (SIDE_FROM + SIDE_TO) * given[SIGMA, i]
            lanes[4 * LANES + lane] = np.float32(sides / apart)
        sums[:] = np.float32(0.0)
        for y in range(top, bottom + 1):
            if has_bytes:
                widen_bytes(raw, y * width + left, share, levels)
            else:
                copy_levels(image, y, left, levels)
            if has_mask:
                count_unclipped(clipped, y, left, counts)
            else:
                count_below(levels, limit, counts)
            add_weighted(levels, counts, np.float32(y - top), noise, lanes, sums)
        for k in range(n):
            keep_step(sums, k + shift, given, first + k, result)
        first += n


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
def slopes_along(centre: Floats, points: MapOut, start: Ints, half: int, slope: FloatsOut) -> None:
    """Rows a column (N,) by which chains run, over ``half`` places to both sides.

    ``centre``: (N,). ``points``: (N, 6). ``start``: (C + 1,) of `gather_chains`.
    """
    for c in range(start.shape[0] - 1):
        for i in range(start[c], start[c + 1]):
            low, high = max(i - half, start[c]), min(i + half, start[c + 1] - 1)
            run = points[high, POINT_COLUMN] - points[low, POINT_COLUMN]
            slope[i] = (centre[high] - centre[low]) / run if run > 0 else 0.0


STEEPEST = 1.05
"""Slope beyond which a line is left to the rows, or to the columns."""
BORDER_SIGMAS, BORDER_PX = 1.0, 3.0
"""Ends of a line that lie nearer to the image's border are cut by nothing else."""
CUT_PX = 1.0
"""The blur of what cuts a line off."""


@compiled()
def mark_ends(
    fits: Table,
    points: MapOut,
    slope: Floats,
    start: Ints,
    height: int,
    width: int,
    bit: int,
    flags: IntsOut,
) -> None:
    """Set a bit in the flags (N,) of points whose column reaches past the end of their line.

    What cuts a line at right angles takes a part of the columns that are nearer to the end than
    their reach times the slope. ``fits``: (8, N) of `fit_columns`. ``points``, ``start``: Of
    `gather_chains`. ``slope``: (N,). ``height``, ``width``: Size of the image.
    """
    for c in range(start.shape[0] - 1):
        first, last = start[c], start[c + 1] - 1
        for end, way in ((first, 1), (last, -1)):
            if abs(slope[end]) > STEEPEST:
                continue
            x, y, sigma = points[end, POINT_COLUMN], fits[CENTRE, end], fits[SIGMA, end]
            room = min(x, width - 1 - x, y, height - 1 - y)
            if room < BORDER_SIGMAS * sigma + BORDER_PX:
                continue
            i = end
            while first <= i <= last:
                away = abs(points[i, POINT_COLUMN] - x)
                if away >= (LINE_SIGMAS * fits[SIGMA, i] + CUT_PX) * abs(slope[i]):
                    break
                flags[i] |= bit
                i += way


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
