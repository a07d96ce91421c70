# SPDX-License-Identifier: Apache-2.0
"""The fit of the stripe's section at each point."""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import (
    COLUMN,
    Floats,
    FloatsOut,
    Image,
    Ints,
    IntsOut,
    Mask,
    Row,
    RowOut,
    Table,
    TableOut,
    compiled,
)

REACH_SIGMAS = 2.7
"""Half width of the fitted profile; pixels farther out hardly know the centre."""
SIDE_NEAR = 3.3
SIDE_FAR = 5.3
"""The background is read between these multiples of sigma on both sides."""
LEAST_SIDE_PX = 2.0
"""Width of a side, however narrow the line."""
ITERATIONS = 12
LEAST_PIXELS = 5
LEAST_HALF_PX = 2.5
"""Of the window, so that it holds as many pixels wherever the centre lies."""
CENTRE, AMPLITUDE, SIGMA, VARIANCE, SKEW, SKEW_NORM, CLIPPED, BEND_GAIN, ALIKE = range(9)
FIT_COLUMNS = 9
"""Columns of a fit result."""


WIDTH_WEIGHT = 4.0
"""Of the logarithm of a width over the typical one, which is known beforehand to a half: where
clipping or a thin line leaves two or three pixels, these tell a centre only beside a width."""
TYPICAL_WEIGHT = 1.0
"""Of the typical width itself: told at half height, that of clipped and thin lines is up to twice
too large, in all neighbours alike."""
FOOT_SIGMAS = 3.2
LEAST_REACH_SIGMAS = 1.4
"""The window shrinks beside another line, so that its foot stays outside."""
STEEPEST = 0.5
"""Least of the normal's component along the column or row by which a line's sigma is divided."""


@compiled(error_model="numpy")
def begin_fits(
    points: Table,
    chain: Ints,
    neighbour: Table,
    line_sigma_px: float,
    sigma_px: FloatsOut,
    reach: FloatsOut,
    run: IntsOut,
) -> None:
    """Where fits begin: the line's sigma along columns or rows, and the window that is free.

    ``points``: (N, 6) from `refine_candidates`. ``chain``: (N,) numbers. ``neighbour``: (N, 2)
    distance to other lines. ``line_sigma_px``: Typical sigma of lines. ``sigma_px``: (N,) output,
    along the point's column or row. ``reach``: (N,) output: half width of the window in sigmas.
    ``run``: (N,) output: number of the stretch of a chain that keeps the same axis, so that sides
    do not swap.
    """
    number = 0
    for i in range(points.shape[0]):
        across = abs(points[i, 3] if int(points[i, 5]) == COLUMN else points[i, 2])
        sigma_px[i] = line_sigma_px / max(across, STEEPEST)
        room = min(neighbour[i, 0], neighbour[i, 1]) / line_sigma_px - FOOT_SIGMAS
        reach[i] = min(max(room, LEAST_REACH_SIGMAS), REACH_SIGMAS)
        if i > 0 and (chain[i] != chain[i - 1] or points[i, 5] != points[i - 1, 5]):
            number += 1
        run[i] = number


@compiled()
def side_span(sigma_px: float) -> float:
    """Distance between the middles of the two sides that `read_sides` reads with a sigma."""
    return max((SIDE_NEAR + SIDE_FAR) * sigma_px, 2.0 * SIDE_NEAR * sigma_px + LEAST_SIDE_PX)


@compiled()
def read_sides(image: Image, points: Table, sigma_px: Floats, sides: TableOut) -> None:
    """Mean grey level beside the line, on the side of smaller and of larger coordinate.

    ``image``: (H, W) grey levels. ``points``: (N, 6) from `refine_candidates`. ``sigma_px``: (N,)
    line sigma along the point's column or row. ``sides``: (N, 4) output: mean and pixel count of
    the lower side, then of the upper side; a side that lies outside the image has count 0.
    """
    height, width = image.shape
    for i in range(points.shape[0]):
        is_column = int(points[i, 5]) == COLUMN
        centre = points[i, 1] if is_column else points[i, 0]
        line = int(points[i, 0] if is_column else points[i, 1])
        size = height if is_column else width
        near = SIDE_NEAR * sigma_px[i]
        far = max(SIDE_FAR * sigma_px[i], near + LEAST_SIDE_PX)
        for side in range(2):
            if side == 0:
                first = math.ceil(centre - far)
                last = math.floor(centre - near)
            else:
                first = math.ceil(centre + near)
                last = math.floor(centre + far)
            first = max(first, 0)
            last = min(last, size - 1)
            total = 0.0
            for k in range(first, last + 1):
                total += image[k, line] if is_column else image[line, k]
            n = max(last - first + 1, 0)
            sides[i, 2 * side] = total / n if n > 0 else 0.0
            sides[i, 2 * side + 1] = n


@compiled(error_model="numpy")
def average_sides(
    raw: Table,
    ground: Table,
    neighbour: Table,
    clear_px: float,
    chain: Ints,
    half: int,
    result: TableOut,
) -> None:
    """Background on both sides, averaged over the neighbours on a chain along the same axis.

    Both are of light on ground of reflectance 1. A side that another line lights up takes the value
    of the other side.

    ``raw``, ``ground``: (N, 4) of `read_sides`, of the image and of its reflectance. ``neighbour``:
    (N, 2) distance to other lines; nearer than ``clear_px`` they light a side up. ``chain``: (N,)
    numbers of places; sides swap where it changes. ``half``: Neighbours to both sides. ``result``:
    (N, 3) output: lower and upper side, and the sigma of their difference over a pixel's.
    """
    n = raw.shape[0]
    weight, light = np.zeros((2, n + 1)), np.zeros((2, n + 1))
    first = 0
    while first < n:
        stop = first
        while stop < n and chain[stop] == chain[first]:
            for side in range(2):
                count = raw[stop, 2 * side + 1]
                seen = ground[stop, 2 * side] if count > 0.0 else 1.0
                is_clear = neighbour[stop, side] > clear_px
                w = count * seen * seen if is_clear else 0.0
                weight[side, stop + 1] = w + (weight[side, stop] if stop > first else 0.0)
                own = w * raw[stop, 2 * side] / seen
                light[side, stop + 1] = own + (light[side, stop] if stop > first else 0.0)
            stop += 1
        weight[:, first] = 0.0
        light[:, first] = 0.0
        places = min(stop - first, 2 * half + 1)
        for i in range(first, stop):
            low, high = max(i - half, first), min(i + half + 1, stop)
            lowest, least, fewest, n_own = np.inf, np.inf, np.inf, 0
            for side in range(2):
                count = raw[i, 2 * side + 1]
                seen = ground[i, 2 * side] if count > 0.0 else 1.0
                least = min(least, seen)
                fewest = min(fewest, count)
                if count > 0.0:
                    lowest = min(lowest, raw[i, 2 * side] / seen)
                total = weight[side, high] - weight[side, low]
                if total > 0.0 and neighbour[i, side] > clear_px:
                    n_own += 1
                    result[i, side] = (light[side, high] - light[side, low]) / total
                else:
                    result[i, side] = np.nan
            for side in range(2):
                if n_own == 0:
                    result[i, side] = lowest if lowest < np.inf else 0.0
                elif np.isnan(result[i, side]):
                    result[i, side] = result[i, 1 - side]
            pixels = (fewest if n_own == 2 else 1.0) * places
            result[i, 2] = math.sqrt(2.0 / max(pixels, 1.0)) / least
        first = stop


LANES = 16
"""Points that are fitted together, so that the loops over them are vectorised."""
EXPONENT_HALVINGS = 12


@compiled()
def exponential(x: float) -> float:
    """``exp(x)`` to 1e-12 of itself for -700 < x < 100: a series, squared, which is vectorised."""
    y = x * (1.0 / 2**EXPONENT_HALVINGS)
    # products with constants: nothing is divided in a loop over many
    series = 1.0 + y * (1.0 / 8.0) * (1.0 + y * (1.0 / 9.0) * (1.0 + y * (1.0 / 10.0)))
    series = 1.0 + y * (1.0 / 6.0) * (1.0 + y * (1.0 / 7.0) * series)
    series = 1.0 + y * (1.0 / 4.0) * (1.0 + y * (1.0 / 5.0) * series)
    series = 1.0 + y * (1.0 + y * (1.0 / 2.0) * (1.0 + y * (1.0 / 3.0) * series))
    power2 = series * series
    power4 = power2 * power2
    power8 = power4 * power4
    power16 = power8 * power8
    power32 = power16 * power16
    power64 = power32 * power32
    power128 = power64 * power64
    power256 = power128 * power128
    power512 = power256 * power256
    power1024 = power512 * power512
    power2048 = power1024 * power1024
    return float(power2048 * power2048)


BELL_HALVINGS = 6
FARTHEST_SQUARE = 64.0
"""Farther out a bell is darkness, and its powers would be too small to be reckoned with."""


@compiled(fastmath=True)
def bell_at(square: np.float32) -> np.float32:
    """``exp(-square / 2)`` to 1e-6: a series, squared six times."""
    one = np.float32(1.0)
    y = min(square, np.float32(FARTHEST_SQUARE)) * np.float32(-0.5 / 2**BELL_HALVINGS)
    series = np.float32(1.0 / 2.0) + y * (np.float32(1.0 / 6.0) + y * np.float32(1.0 / 24.0))
    power = one + y * (one + y * series)
    power2 = power * power
    power4 = power2 * power2
    power8 = power4 * power4
    power16 = power8 * power8
    power32 = power16 * power16
    return np.float32(power32 * power32)


IN_CENTRE, IN_AMPLITUDE, IN_SIGMA, IS_OPEN, IS_DONE, START, START_SIGMA = range(7)
STATE_ROWS = 7
"""Of each lane: where its steps are and whether they go on, and where they began."""
AT_CENTRE, STEP, AT_AMPLITUDE, THIRD, FOURTH, SUMS = range(6)
N_SUMS = 13
"""Normal matrix of (centre, log amplitude, log sigma) as 00 01 02 11 12 22, its right-hand side,
then the residual against the skew term, the skew term's norm, its product with the centre's
derivative, and the same product for a term ``u^3``."""
LANE_ROWS = SUMS + N_SUMS
LEVEL, GROUND_LEVEL, COUNTS, REFLECTANCE = range(4)
PROFILE_ROWS = 4
"""Of each pixel: grey level less background, background, 1 where it counts, and reflectance."""


@compiled(fastmath=True, error_model="numpy", is_inlined=True)
def accumulate(pixels: Row, pixel: int, noise: Row, lanes: RowOut) -> None:
    """Add one pixel of each lane to the weighted sums of a Gauss-Newton step.

    The line is ``A exp(-u^2 / 2) (1 + c3 (u^3 - 3 u) + c4 (u^4 - 6 u^2 + 3))`` with ``u`` the
    distance from the centre over sigma: a Gram-Charlier series, whose centre of gravity is u = 0.
    What is seen of it is that times the ground's reflectance. In single precision: centres move by
    less than 1e-4 of their sigma.

    ``pixels``: (>= 4 `LANES`,) grey level less background, background, 1 where the pixel counts,
    and reflectance. ``pixel``: Its place in the lanes. ``noise``: (3,) ``C^2``, ``1 / gain``,
    ``read^2``. ``lanes``: (18 `LANES`,).
    """
    square, linear, constant = noise[0], noise[1], noise[2]
    zero, one, three = np.float32(0.0), np.float32(1.0), np.float32(3.0)
    four, six = np.float32(4.0), np.float32(6.0)
    for k in range(LANES):
        centre = lanes[AT_CENTRE * LANES + k]
        step = lanes[STEP * LANES + k]
        amplitude = lanes[AT_AMPLITUDE * LANES + k]
        c3 = lanes[THIRD * LANES + k]
        c4 = lanes[FOURTH * LANES + k]
        u = (np.float32(pixel) - centre) * step
        uu = u * u
        third = u * (uu - three)
        shape = one + c3 * third + c4 * (uu * (uu - six) + three)
        seen = amplitude * bell_at(uu) * pixels[REFLECTANCE * LANES + k]
        m = seen * max(shape, zero)
        falling = seen * (u * shape - three * c3 * (uu - one) - four * c4 * third)
        light = max(m + pixels[GROUND_LEVEL * LANES + k], zero)
        w = pixels[COUNTS * LANES + k] / (square * m * m + linear * light + constant)
        r = pixels[LEVEL * LANES + k] - m
        j0 = falling * step
        j2 = falling * u
        q = seen * third
        w0 = w * j0
        w1 = w * m
        w2 = w * j2
        wq = w * q
        lanes[SUMS * LANES + k] += w0 * j0
        lanes[(SUMS + 1) * LANES + k] += w0 * m
        lanes[(SUMS + 2) * LANES + k] += w0 * j2
        lanes[(SUMS + 3) * LANES + k] += w1 * m
        lanes[(SUMS + 4) * LANES + k] += w1 * j2
        lanes[(SUMS + 5) * LANES + k] += w2 * j2
        lanes[(SUMS + 6) * LANES + k] += w0 * r
        lanes[(SUMS + 7) * LANES + k] += w1 * r
        lanes[(SUMS + 8) * LANES + k] += w2 * r
        lanes[(SUMS + 9) * LANES + k] += wq * r
        lanes[(SUMS + 10) * LANES + k] += wq * q
        lanes[(SUMS + 11) * LANES + k] += w0 * q
        lanes[(SUMS + 12) * LANES + k] += w0 * seen * uu * u


@compiled(fastmath=True, error_model="numpy")
def take_steps(
    is_last: bool, lanes: Row, state: FloatsOut, variance: FloatsOut, alike: FloatsOut
) -> int:
    """Solve the normal equations of the open lanes and move those that are not done.

    What is known beforehand of a width, log(own / sigma) = 0, is one more row of them.

    ``lanes``: (18 `LANES`,) of `accumulate`. ``state``: (7 `LANES`,). ``variance``: (`LANES`,)
    output: the centre's, of lanes that end here; 0 of those that fail or go on. ``alike``:
    (`LANES`,) output: variance of what neighbours err alike by, for they were given one typical
    width, over that. Returns count of lanes that go on.
    """
    go_on = 0
    for k in range(LANES):
        h00 = float(lanes[SUMS * LANES + k])
        h01 = float(lanes[(SUMS + 1) * LANES + k])
        h02 = float(lanes[(SUMS + 2) * LANES + k])
        h11 = float(lanes[(SUMS + 3) * LANES + k])
        h12 = float(lanes[(SUMS + 4) * LANES + k])
        h22 = float(lanes[(SUMS + 5) * LANES + k])
        b0 = float(lanes[(SUMS + 6) * LANES + k])
        b1 = float(lanes[(SUMS + 7) * LANES + k])
        b2 = float(lanes[(SUMS + 8) * LANES + k])
        sigma = state[IN_SIGMA * LANES + k]
        own = state[START_SIGMA * LANES + k]
        h22 += WIDTH_WEIGHT
        b2 += WIDTH_WEIGHT * 2.0 * (own - sigma) / (own + sigma)
        c00 = h11 * h22 - h12 * h12
        c01 = h02 * h12 - h01 * h22
        c02 = h01 * h12 - h02 * h11
        determinant = h00 * c00 + h01 * c01 + h02 * c02
        c11 = h00 * h22 - h02 * h02
        c12 = h01 * h02 - h00 * h12
        c22 = h00 * h11 - h01 * h01
        is_sound = (state[IS_OPEN * LANES + k] > 0.0) & (determinant > 0.0) & (c00 > 0.0)
        share = 1.0 / (determinant if is_sound else 1.0)
        step0 = (c00 * b0 + c01 * b1 + c02 * b2) * share
        step1 = (c01 * b0 + c11 * b1 + c12 * b2) * share
        step2 = (c02 * b0 + c12 * b1 + c22 * b2) * share
        is_end = is_sound & (is_last | (state[IS_DONE * LANES + k] > 0.0))
        variance[k] = c00 * share if is_end else 0.0
        known = WIDTH_WEIGHT * c02
        alike[k] = known * known * share / (TYPICAL_WEIGHT * c00) if is_end else 0.0
        is_small = (abs(step0) < 2e-3 * sigma) & (abs(step2) < 0.02)
        state[IS_DONE * LANES + k] = 1.0 if is_small else 0.0
        half = 0.5 * sigma
        centre = state[IN_CENTRE * LANES + k] + min(max(step0, -half), half)
        wider = sigma * exponential(min(max(step2, -0.25), 0.25))
        is_near = abs(centre - state[START * LANES + k]) < 2.0 * own + 1.0
        is_near &= (wider > 0.4 * own) & (wider < 2.5 * own + 0.5)
        is_moved = is_sound & is_near & (not is_end)
        amplitude = state[IN_AMPLITUDE * LANES + k]
        higher = amplitude * exponential(min(max(step1, -0.5), 0.5))
        state[IN_CENTRE * LANES + k] = centre if is_moved else state[IN_CENTRE * LANES + k]
        state[IN_AMPLITUDE * LANES + k] = higher if is_moved else amplitude
        state[IN_SIGMA * LANES + k] = wider if is_moved else sigma
        state[IS_OPEN * LANES + k] = 1.0 if is_moved else 0.0
        go_on += 1 if is_moved else 0
    return go_on


@compiled(fastmath=True, error_model="numpy")
def sum_pixels(pixels: Row, n: int, noise: Row, state: Floats, lanes: RowOut) -> None:
    """Sums of a Gauss-Newton step over ``n`` pixels of each lane from where the steps are."""
    for k in range(LANES):
        lanes[AT_CENTRE * LANES + k] = np.float32(state[IN_CENTRE * LANES + k])
        lanes[STEP * LANES + k] = np.float32(1.0 / state[IN_SIGMA * LANES + k])
        lanes[AT_AMPLITUDE * LANES + k] = np.float32(state[IN_AMPLITUDE * LANES + k])
    lanes[SUMS * LANES :] = np.float32(0.0)
    for pixel in range(n):
        accumulate(pixels[pixel * PROFILE_ROWS * LANES :], pixel, noise, lanes)


@compiled(fastmath=True)
def add_height(pixels: Row, pixel: int, lanes: RowOut) -> None:
    """Add one pixel of each lane to what tells the height of a Gaussian of unit amplitude.

    As for `accumulate`; the first two of its sums are those of the level and of the Gaussian.
    """
    for k in range(LANES):
        u = (np.float32(pixel) - lanes[AT_CENTRE * LANES + k]) * lanes[STEP * LANES + k]
        g = bell_at(u * u) * pixels[COUNTS * LANES + k] * pixels[REFLECTANCE * LANES + k]
        lanes[SUMS * LANES + k] += g * pixels[LEVEL * LANES + k]
        lanes[(SUMS + 1) * LANES + k] += g * g


@compiled()
def first_heights(pixels: Row, n: int, state: FloatsOut, lanes: RowOut) -> None:
    """Unweighted heights of Gaussians where the lanes' steps begin: the amplitudes of ``state``."""
    for k in range(LANES):
        lanes[AT_CENTRE * LANES + k] = np.float32(state[START * LANES + k])
        lanes[STEP * LANES + k] = np.float32(1.0 / state[START_SIGMA * LANES + k])
    lanes[SUMS * LANES :] = np.float32(0.0)
    for pixel in range(n):
        add_height(pixels[pixel * PROFILE_ROWS * LANES :], pixel, lanes)
    for k in range(LANES):
        top, norm = lanes[SUMS * LANES + k], lanes[(SUMS + 1) * LANES + k]
        state[IN_AMPLITUDE * LANES + k] = float(top / norm) if norm > 0.0 else 0.0


BASE, STRIDE, N_PIXELS = range(3)
"""Where a lane's first pixel lies in the image, the way from one to the next, and how many."""
SLOPE, OFFSET = range(2)
"""Background of a lane: its rise from pixel to pixel, and its level at the first one."""


@compiled()
def gather_levels(
    image: Image, place: Ints, ground: Floats, reflectance: Image, n: int, pixels: RowOut
) -> None:
    """Copy ``n`` pixels of each lane; those beyond its own count do not count.

    ``place``: (3 `LANES`,) base, stride and count. ``ground``: (2 `LANES`,) slope and offset.
    ``pixels``: (4 n `LANES`,) output.
    """
    levels = image.reshape(image.size)
    grounds = reflectance.reshape(reflectance.size)
    has_ground = reflectance.size == image.size and reflectance.size > 1
    for at in range(n):
        own = pixels[at * PROFILE_ROWS * LANES : (at + 1) * PROFILE_ROWS * LANES]
        for k in range(LANES):
            is_own = at < place[N_PIXELS * LANES + k]
            from_ = place[k] + (at * place[STRIDE * LANES + k] if is_own else 0)
            behind = ground[OFFSET * LANES + k] + at * ground[SLOPE * LANES + k]
            own[LEVEL * LANES + k] = np.float32(levels[from_] - behind)
            own[GROUND_LEVEL * LANES + k] = np.float32(behind)
            own[COUNTS * LANES + k] = np.float32(1.0 if is_own else 0.0)
            own[REFLECTANCE * LANES + k] = np.float32(1.0)
        if has_ground:
            for k in range(LANES):
                is_own = at < place[N_PIXELS * LANES + k]
                from_ = place[k] + (at * place[STRIDE * LANES + k] if is_own else 0)
                behind = ground[OFFSET * LANES + k] + at * ground[SLOPE * LANES + k]
                behind *= grounds[from_]
                own[LEVEL * LANES + k] = np.float32(levels[from_] - behind)
                own[GROUND_LEVEL * LANES + k] = np.float32(behind)
                own[REFLECTANCE * LANES + k] = grounds[from_]


@compiled()
def leave_clipped(clipped: Mask, place: Ints, n: int, pixels: RowOut) -> None:
    """Let clipped pixels of the lanes not count; as for `gather_levels`."""
    masks = clipped.reshape(clipped.size)
    for at in range(n):
        for k in range(LANES):
            is_own = at < place[N_PIXELS * LANES + k]
            if is_own and masks[place[k] + at * place[STRIDE * LANES + k]] > 0:
                pixels[(at * PROFILE_ROWS + COUNTS) * LANES + k] = np.float32(0.0)


@compiled()
def count_clipped(clipped: Mask, point: Floats, first: int, last: int) -> int:
    """Clipped pixels from ``first`` to ``last`` of a point's column or row."""
    is_column = int(point[5]) == COLUMN
    line = int(point[0] if is_column else point[1])
    count = 0
    for k in range(first, last + 1):
        count += int(clipped[k, line] if is_column else clipped[line, k])
    return count


@compiled()
def keep_lane(
    lanes: Row,
    state: Floats,
    k: int,
    first: int,
    variance: float,
    alike: float,
    result: FloatsOut,
) -> None:
    """Write one lane's fit as a row of `fit_profiles`."""
    sigma = state[IN_SIGMA * LANES + k]
    h00 = float(lanes[SUMS * LANES + k])
    b0 = float(lanes[(SUMS + 6) * LANES + k])
    h0q = float(lanes[(SUMS + 11) * LANES + k])
    result[CENTRE] = first + state[IN_CENTRE * LANES + k]
    result[AMPLITUDE] = state[IN_AMPLITUDE * LANES + k]
    result[SIGMA] = sigma
    result[VARIANCE] = variance
    result[ALIKE] = alike
    result[SKEW] = lanes[(SUMS + 9) * LANES + k] - h0q / h00 * b0
    result[SKEW_NORM] = max(lanes[(SUMS + 10) * LANES + k] - h0q * h0q / h00, 0.0)
    result[BEND_GAIN] = lanes[(SUMS + 12) * LANES + k] / (h00 * sigma)


@compiled(error_model="numpy")
def fit_profiles(
    image: Image,
    clipped: Mask,
    reflectance: Image,
    points: Table,
    sigma_px: Floats,
    sides: Table,
    noise: Floats,
    section: Floats,
    reach: Floats,
    result: TableOut,
) -> None:
    """Fit centre, amplitude and width by Gauss-Newton steps with weights from the noise model.

    The variance of a pixel is ``C^2 m^2 + (m + background) / gain + read^2`` with ``m`` the line's
    own grey level. Clipped pixels are left out and the window grows by their width, so that a
    saturated line is fitted on its flanks.

    ``image``, ``points``: As for `read_sides`. ``clipped``: (H, W) 1 where a pixel is saturated;
    (1, 1) if none is. ``reflectance``: (H, W) of the ground, relative; (1, 1) where it is not known
    and taken to be even. ``sigma_px``: (N,) start value of the sigma along the column or row.
    ``sides``: (N, 2) background on the lower and upper side, on ground of reflectance 1;
    interpolated linearly across the line.
    ``noise``: (3,) ``C^2``, ``1 / gain``, ``read^2``. ``section``: (4,) shape of the line's section
    as for `accumulate`: of points fitted along columns, then of those along rows. ``reach``: (N,)
    half width of the fitted window in sigmas. ``result``: (N, 9) input: results for nearly the same
    noise and section, from which the steps begin, or zeros; output: centre, amplitude, sigma,
    variance of the centre (0: the fit failed), score of a skew beyond the section's, its norm,
    count of clipped pixels, by how much a term ``u^3`` in the profile's exponent moves the centre,
    in sigmas (for the correction on bent lines), and `take_steps`' share of what neighbours err
    alike by, which smoothing does not lessen.
    """
    height, width = image.shape
    has_clipped = clipped.shape[0] == height and clipped.shape[1] == width
    pixels = np.zeros(0, np.float32)
    lanes = np.zeros(LANE_ROWS * LANES, np.float32)
    state = np.zeros(STATE_ROWS * LANES)
    levels = noise.astype(np.float32)
    variance, alike = np.zeros(LANES), np.zeros(LANES)
    first = np.zeros(LANES, np.int64)
    place = np.zeros(3 * LANES, np.int64)
    ground = np.zeros(2 * LANES)
    for block in range(0, points.shape[0], LANES):
        n_lanes = min(LANES, points.shape[0] - block)
        capacity = 0
        place[:] = 0
        ground[:] = 0.0
        state[:] = 1.0
        for k in range(n_lanes):
            i = block + k
            is_column = int(points[i, 5]) == COLUMN
            start = points[i, 1] if is_column else points[i, 0]
            last = (height if is_column else width) - 1
            half = max(reach[i] * sigma_px[i], LEAST_HALF_PX)
            from_ = max(math.ceil(start - half), 0)
            stop = min(math.floor(start + half), last)
            result[i, CLIPPED] = 0.0
            if has_clipped:
                n_clipped = count_clipped(clipped, points[i], from_, stop)
                grow = (n_clipped + 1) // 2
                from_ = max(from_ - grow, 0)
                stop = min(stop + grow, last)
                result[i, CLIPPED] = n_clipped
            first[k] = from_
            line = int(points[i, 0] if is_column else points[i, 1])
            place[k] = from_ * width + line if is_column else line * width + from_
            place[STRIDE * LANES + k] = width if is_column else 1
            place[N_PIXELS * LANES + k] = stop - from_ + 1
            capacity = max(capacity, stop - from_ + 1)
            ramp = (sides[i, 1] - sides[i, 0]) / side_span(sigma_px[i])
            ground[SLOPE * LANES + k] = ramp
            ground[OFFSET * LANES + k] = 0.5 * (sides[i, 0] + sides[i, 1]) + ramp * (from_ - start)
            state[START * LANES + k] = start - from_
            state[START_SIGMA * LANES + k] = sigma_px[i]
            lanes[THIRD * LANES + k] = np.float32(section[0] if is_column else section[2])
            lanes[FOURTH * LANES + k] = np.float32(section[1] if is_column else section[3])
        if pixels.shape[0] < capacity * PROFILE_ROWS * LANES:
            pixels = np.zeros(capacity * PROFILE_ROWS * LANES, np.float32)
        gather_levels(image, place, ground, reflectance, capacity, pixels)
        if has_clipped:
            leave_clipped(clipped, place, capacity, pixels)
        first_heights(pixels, capacity, state, lanes)
        for k in range(LANES):
            i = min(block + k, points.shape[0] - 1)
            is_begun = result[i, VARIANCE] > 0.0
            is_open = state[IN_AMPLITUDE * LANES + k] > 0.0
            is_open &= place[N_PIXELS * LANES + k] - result[i, CLIPPED] >= LEAST_PIXELS
            state[IS_OPEN * LANES + k] = 1.0 if is_open else 0.0
            state[IS_DONE * LANES + k] = 0.0
            if is_begun:
                state[IN_CENTRE * LANES + k] = result[i, CENTRE] - first[k]
                state[IN_AMPLITUDE * LANES + k] = result[i, AMPLITUDE]
                state[IN_SIGMA * LANES + k] = result[i, SIGMA]
            else:
                state[IN_CENTRE * LANES + k] = state[START * LANES + k]
                state[IN_SIGMA * LANES + k] = state[START_SIGMA * LANES + k]
        for k in range(n_lanes):
            result[block + k, VARIANCE] = 0.0
        for round_ in range(ITERATIONS):
            sum_pixels(pixels, capacity, levels, state, lanes)
            go_on = take_steps(round_ == ITERATIONS - 1, lanes, state, variance, alike)
            for k in range(n_lanes):
                if variance[k] > 0.0:
                    own = result[block + k]
                    keep_lane(lanes, state, k, first[k], variance[k], alike[k], own)
            if go_on == 0:
                break
