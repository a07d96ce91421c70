# SPDX-License-Identifier: Apache-2.0
"""Stripe centres column by column: weighted sums across lines, and what becomes of their results.

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
    BytesOut,
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
    BEND,
    BEND_VARIANCE,
    POINT_ABOVE,
    POINT_BELOW,
    POINT_CHAIN,
    POINT_COLUMN,
    POINT_HIGH,
    POINT_LOW,
    SLOPE,
    SMOOTH_VARIANCE,
    SMOOTHED,
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


@compiled(error_model="numpy", is_inlined=True)
def weigh_moments(sums: Row, given: Floats, told: FloatsOut) -> None:
    """Amplitude, centre and sigma of `LANES` lines from their moments under a bell.

    A Gaussian times the bell has the variance 1 / (1 / V + 1 / W), and its mean lies as far from
    the bell's middle as V / (V + W) of the line's centre: so the first steps of an iteration to the
    centre are left out. What the bell's own moments are over the pixels is in ``sums``.

    ``given``: (3 `LANES`,) middle, sigma and background of the bells. ``told``: (6 `LANES`,)
    output, rows of `FIRST_ROWS`.
    """
    one = np.float32(1.0)
    for k in range(LANES):
        is_lit = (sums[k] > 0.0) & (sums[3 * LANES + k] > 0.0)
        own = sums[k] if is_lit else one
        norm = sums[3 * LANES + k] if is_lit else one
        mean = sums[LANES + k] / own
        seen = sums[2 * LANES + k] / own - mean * mean
        bell = sums[4 * LANES + k] / norm if is_lit else one
        line = seen * bell / max(bell - seen, bell / (1.0 + MOST_WIDER))
        line = max(line, 1.0 / MOST_WIDER)
        centre = given[k] + given[LANES + k] * mean * (bell + line) / bell
        height = own / (norm * math.sqrt(line / (bell + line)))
        told[AMPLITUDE * LANES + k] = height if is_lit else 0.0
        told[CENTRE * LANES + k] = centre if is_lit else 0.0
        told[SIGMA * LANES + k] = given[LANES + k] * math.sqrt(line) if is_lit else 0.0
    for k in range(LANES):
        base = given[2 * LANES + k]
        n_low, n_high = sums[5 * LANES + k], sums[7 * LANES + k]
        low_side = base + sums[6 * LANES + k] / max(n_low, one)
        high_side = base + sums[8 * LANES + k] / max(n_high, one)
        told[LOW_SIDE * LANES + k] = low_side if n_low > 0.0 else np.nan
        told[HIGH_SIDE * LANES + k] = high_side if n_high > 0.0 else np.nan
        told[N_SIDES * LANES + k] = min(n_low, n_high)


@compiled(is_inlined=True)
def keep_lanes(told: Floats, shift: int, n: int, first: int, result: TableOut) -> None:
    """Take the numbers (R `LANES`,) of ``n`` lanes from one on to points of a table (R, N)."""
    for row in range(result.shape[0]):
        for k in range(n):
            result[row, first + k] = told[row * LANES + shift + k]


@compiled(error_model="numpy")
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
    given, told = np.zeros(3 * LANES), np.zeros(FIRST_ROWS * LANES)
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
            given[lane] = 0.5 * (points[i, POINT_LOW] + points[i, POINT_HIGH])
            given[LANES + lane], given[2 * LANES + lane] = sigma[i], base[i]
        for lane in range(LANES):
            lanes[lane] = np.float32(given[lane] - top)
            lanes[LANES + lane] = np.float32(1.0 / given[LANES + lane])
            lanes[2 * LANES + lane] = np.float32(given[2 * LANES + lane])
        sums[:] = np.float32(0.0)
        for y in range(top, bottom + 1):
            if has_bytes:
                widen_bytes(raw, y * width + left, share, levels)
            else:
                copy_levels(image, y, left, levels)
            add_moments(levels, np.float32(y - top), lanes, sums)
        weigh_moments(sums, given, told)
        keep_lanes(told, shift, n, first, result)
        first += n


@compiled(error_model="numpy")
def weigh_sides(
    first: Table, points: MapOut, sigma: Floats, clear_sigmas: float, weight: TableOut
) -> None:
    """Weights (3, N) by which width and sides of `look_across` are averaged along the line.

    ``first``: (6, N) of `look_across`. ``points``: (N, 6). ``sigma``: (N,) of the line, of which
    so many must be free before another run, or a side has no weight.
    """
    for i in range(points.shape[0]):
        height = max(first[AMPLITUDE, i], 0.0)
        room = clear_sigmas * sigma[i]
        has_sides = first[N_SIDES, i] > 0.0
        weight[0, i] = height * height
        weight[1, i] = 1.0 if has_sides and points[i, POINT_BELOW] > room else 0.0
        weight[2, i] = 1.0 if has_sides and points[i, POINT_ABOVE] > room else 0.0


@compiled(error_model="numpy")
def keep_means(
    mean: Table,
    points: MapOut,
    sigma: Floats,
    base: Floats,
    height: Floats,
    limits: Floats,
    first: TableOut,
) -> None:
    """Replace width and sides of points by what they are along the line, and what was not found.

    A side that another line lights up takes the value of the other one.

    ``mean``: (3, N) of sigma and sides, NaN where none counts. ``points``: (N, 6). ``sigma``,
    ``base``, ``height``: (N,) expected sigma, background, and height of the runs. ``limits``: (3,)
    least and largest sigma, and how far in sigmas a centre may lie from its run's middle.
    ``first``: (6, N) of `look_across`, changed.
    """
    for i in range(points.shape[0]):
        own, low_side, high_side = mean[0, i], mean[1, i], mean[2, i]
        is_told = math.isfinite(own)
        first[SIGMA, i] = min(max(own, limits[0]), limits[1]) if is_told else sigma[i]
        other = base[i] if math.isnan(high_side) else high_side
        low_side = other if math.isnan(low_side) else low_side
        first[LOW_SIDE, i] = low_side
        first[HIGH_SIDE, i] = low_side if math.isnan(high_side) else high_side
        middle = 0.5 * (points[i, POINT_LOW] + points[i, POINT_HIGH])
        is_off = abs(first[CENTRE, i] - middle) > limits[2] * sigma[i]
        if is_off or first[AMPLITUDE, i] <= 0.0:
            first[AMPLITUDE, i], first[CENTRE, i] = max(height[i], 1.0), middle


@compiled(is_inlined=True)
def count_unclipped(clipped: Mask, y: int, x: int, counts: RowOut) -> None:
    """1 or 0 for each of `LANES` pixels of a row of a mask (H, W) of those that saturated."""
    one, zero = np.float32(1.0), np.float32(0.0)
    own = clipped[y, x : x + LANES]
    for k in range(LANES):
        counts[k] = zero if own[k] > 0 else one


@compiled(fastmath=True, error_model="numpy", is_inlined=True)
def add_weighted(
    levels: Row,
    counts: Row,
    clip: np.float32,
    y: np.float32,
    noise: Row,
    lanes: Row,
    sums: RowOut,
) -> None:
    """Add a row's pixels to the weighted sums of a Gauss-Newton step of centre and amplitude.

    ``counts``: (`LANES`,) 0 for pixels that saturated, else 1. ``clip``: Level from which pixels
    did so, too: asked apart, it would be written one by one, and reading the row would wait.
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
        count = counts[k] if levels[k] < clip else zero
        w = is_line * count / (square * m * m + linear * max(m + behind, zero) + constant)
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
        sums[9 * LANES + k] += is_line * (one - count)


MOST_STEP = 0.7
"""Of a line's sigma, by which the second pass moves a centre at most: farther off it failed."""


@compiled(error_model="numpy", is_inlined=True)
def take_step(sums: Row, given: Floats, told: FloatsOut) -> None:
    """Steps of `LANES` lines; variance 0 where one fails.

    ``given``: (5 `LANES`,) amplitude, centre, sigma and sides. ``told``: (8 `LANES`,) output, rows
    of `SECOND_ROWS`.
    """
    one = np.float32(1.0)
    for k in range(LANES):
        h00, h01 = sums[k], sums[LANES + k]
        h11, b0 = sums[2 * LANES + k], sums[3 * LANES + k]
        b1, q0 = sums[4 * LANES + k], sums[6 * LANES + k]
        height, centre, sigma = given[k], given[LANES + k], given[2 * LANES + k]
        product = h00 * h11 - h01 * h01
        is_definite = product > 0.0
        determinant, own = product if is_definite else one, h00 if is_definite else one
        step = (h11 * b0 - h01 * b1) / determinant
        is_sound = is_definite & (abs(step) < MOST_STEP)
        grown = (h00 * b1 - h01 * b0) / determinant
        grown = height * (1.0 + min(max(grown, -0.5), 1.0))
        lean = sums[5 * LANES + k] - q0 / own * b0
        norm = max(sums[7 * LANES + k] - q0 * q0 / own, 0.0)
        told[AMPLITUDE * LANES + k] = grown if is_sound else height
        told[CENTRE * LANES + k] = centre + sigma * step if is_sound else centre
        told[SIGMA * LANES + k] = sigma
        told[VARIANCE * LANES + k] = sigma * sigma * h11 / determinant if is_sound else 0.0
        told[LEAN * LANES + k] = lean if is_sound else 0.0
        told[LEAN_NORM * LANES + k] = norm if is_sound else 0.0
        told[BEND_GAIN * LANES + k] = sums[8 * LANES + k] / own if is_sound else 0.0
        told[N_CLIPPED * LANES + k] = sums[9 * LANES + k]


@compiled(error_model="numpy")
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
    levels, counts = np.zeros(LANES, np.float32), np.ones(LANES, np.float32)
    lanes = np.zeros(5 * LANES, np.float32)
    sums = np.zeros(N_SECOND_SUMS * LANES, np.float32)
    own, told = np.zeros(5 * LANES), np.zeros(SECOND_ROWS * LANES)
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
            for row in range(N_SIDES):
                own[row * LANES + lane] = given[row, i]
        for lane in range(LANES):
            low_side, sigma = own[LOW_SIDE * LANES + lane], own[SIGMA * LANES + lane]
            sides = own[HIGH_SIDE * LANES + lane] - low_side
            lanes[lane] = np.float32(own[CENTRE * LANES + lane] - top)
            lanes[LANES + lane] = np.float32(1.0 / sigma)
            lanes[2 * LANES + lane] = np.float32(own[AMPLITUDE * LANES + lane])
            lanes[3 * LANES + lane] = np.float32(low_side + 0.5 * sides)
            lanes[4 * LANES + lane] = np.float32(sides / ((SIDE_FROM + SIDE_TO) * sigma))
        sums[:] = np.float32(0.0)
        for y in range(top, bottom + 1):
            if has_bytes:
                widen_bytes(raw, y * width + left, share, levels)
            else:
                copy_levels(image, y, left, levels)
            if has_mask:
                count_unclipped(clipped, y, left, counts)
            add_weighted(levels, counts, limit, np.float32(y - top), noise, lanes, sums)
        take_step(sums, own, told)
        keep_lanes(told, shift, n, first, result)
        first += n


@compiled(error_model="numpy")
def mark_near(
    fits: Table,
    points: MapOut,
    steep: Floats,
    length: Floats,
    dips: Bytes,
    limits: Floats,
    near: BytesOut,
) -> int:
    """Mark points that another line is so near to that it pulls the centre, or runs into this one.

    ``fits``: (8, N) of `fit_columns`. ``points``: (N, 6). ``steep``, ``length``: (N,) length of the
    line a column, and longest run of a line alone. ``dips``: (N,) of `measure_runs`. ``limits``:
    (4,) sigmas that other runs must be away, least height of lines that noise does not part,
    typical sigma across lines, and how many times as wide one may be. ``near``: (N,) output.
    Returns count of them.
    """
    count = 0
    for i in range(points.shape[0]):
        sigma = fits[SIGMA, i]
        own = points[i, POINT_HIGH] - points[i, POINT_LOW] + 1.0
        gap = min(points[i, POINT_BELOW], points[i, POINT_ABOVE])
        # runs of faint lines fall apart by noise
        is_beside = (gap <= sigma) | (gap + own < limits[0] * sigma)
        is_beside &= fits[AMPLITUDE, i] > limits[1]
        is_wide = (own > length[i]) | (sigma > limits[3] * (limits[2] * steep[i]))
        is_near = is_beside | is_wide | (dips[i] > 0)
        near[i] = is_near
        count += 1 if is_near else 0
    return count


@compiled(error_model="numpy")
def flag_points(
    fits: Table,
    first: Table,
    leans: Table,
    near: Bytes,
    limits: Floats,
    bits: Ints,
    flags: IntsOut,
) -> None:
    """Set the flags (N,) of each point by itself.

    ``fits``: (8, N) of `fit_columns`. ``first``: (6, N) of the first pass. ``leans``: (2, N) sums
    along the line of the skew's score and norm. ``near``: (N,) of `mark_near`. ``limits``: (5,)
    step of the background over the amplitude, skew that all sections have in common, least skew,
    the same times sigma, and how many sigmas are significant. ``bits``: (4,) of saturated, step,
    neighbour, skew.
    """
    for i in range(flags.shape[0]):
        step = abs(first[HIGH_SIDE, i] - first[LOW_SIDE, i])
        norm = max(leans[1, i], 1e-12)
        lean = abs(leans[0, i] - norm * limits[1])
        least = max(limits[2], limits[3] / fits[SIGMA, i]) * norm
        own = bits[0] if fits[N_CLIPPED, i] > 0.0 else 0
        own |= bits[1] if step > limits[0] * fits[AMPLITUDE, i] else 0
        own |= bits[2] if near[i] > 0 else 0
        own |= bits[3] if (lean > limits[4] * math.sqrt(norm)) & (lean > least) else 0
        flags[i] = own


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


@compiled(error_model="numpy")
def keep_smoothed(
    rows: Ints,
    smoothed: Table,
    variance: Floats,
    alike: float,
    fits: TableOut,
    slope: FloatsOut,
    sigma: FloatsOut,
    noise_length: FloatsOut,
) -> None:
    """Take over what `smooth_stretches` gave, and take out the pull of bends (see `find_pulls`).

    Bends are shrunk towards zero by their own noise, so that straight lines are not disturbed.

    ``rows``: (M,) points that were smoothed. ``smoothed``: (4, M). ``variance``: (M,) of centres.
    ``alike``: Neighbours that err as one. ``fits``: (8, N) of `fit_columns`, ``slope``, ``sigma``,
    ``noise_length``: (N,), changed.
    """
    for k in range(rows.shape[0]):
        i = rows[k]
        bend, steep = smoothed[BEND, k], smoothed[SLOPE, k] * smoothed[SLOPE, k]
        square = max(bend * bend, 1e-30)
        certain = max(1.0 - variance[k] * BEND_VARIANCE / square, 0.0)
        gain = fits[BEND_GAIN, i] * (fits[SIGMA, i] * fits[SIGMA, i])
        flat = 1.0 + steep
        pull = 0.5 * gain * certain * bend * steep / (flat * flat)
        fits[CENTRE, i] = smoothed[SMOOTHED, k] - pull
        slope[i] = smoothed[SLOPE, k]
        sigma[i] = math.sqrt(smoothed[SMOOTH_VARIANCE, k])
        noise_length[i] = max(variance[k] * alike / smoothed[SMOOTH_VARIANCE, k], 1.0)


@compiled(error_model="numpy")
def write_points(
    rows: Ints,
    points: MapOut,
    fits: Table,
    slope: Floats,
    sigma: Floats,
    down: int,
    scales: Floats,
    places: TableOut,
    normals: TableOut,
    measures: TableOut,
    segment: IntsOut,
) -> None:
    """Points of a profile from centres in columns.

    ``rows``: (M,) points that are kept. ``points``: (N, 6). ``fits``: (8, N) of `fit_columns`.
    ``slope``, ``sigma``: (N,). ``down``: Axis of the image along which centres were sought, 1 for
    columns. ``scales``: (4,) least sigma, binning, grey levels a level, and columns that may lack
    within a segment. ``places``, ``normals``: (M, 2) output. ``measures``: (3, M) output: sigma,
    width and intensity. ``segment``: (M,) output.
    """
    number = 0
    for k in range(rows.shape[0]):
        i = rows[k]
        across = 1.0 / math.sqrt(1.0 + slope[i] * slope[i])
        places[k, 1 - down], places[k, down] = points[i, POINT_COLUMN], fits[CENTRE, i]
        normals[k, 1 - down], normals[k, down] = -slope[i] * across, across
        measures[0, k] = max(sigma[i] * across, scales[0]) * scales[1]
        measures[1, k] = fits[SIGMA, i] * across * scales[1]
        measures[2, k] = max(fits[AMPLITUDE, i], 0.0) * scales[2]
        if k > 0:
            before = rows[k - 1]
            is_new = points[i, POINT_CHAIN] != points[before, POINT_CHAIN]
            is_new |= points[i, POINT_COLUMN] - points[before, POINT_COLUMN] > scales[3]
            number += 1 if is_new else 0
        segment[k] = number
