# SPDX-License-Identifier: Apache-2.0
"""Kernels of the stripe's section: its fit at each point, and what all sections have in common."""

from __future__ import annotations

import math

import numpy as np

from armscan.kernels.arrays import (
    COLUMN,
    Floats,
    FloatsOut,
    Image,
    Mask,
    Table,
    TableOut,
    compiled,
)

REACH_SIGMAS = 2.7
"""Half width of the fitted profile; pixels farther out hardly know the centre."""
SIDE_NEAR = 3.3
SIDE_FAR = 5.3
"""The background is read between these multiples of sigma on both sides."""
SIDE_SPAN = SIDE_NEAR + SIDE_FAR
ITERATIONS = 12
LEAST_PIXELS = 5
CENTRE, AMPLITUDE, SIGMA, VARIANCE, SKEW, SKEW_NORM, CLIPPED, BEND_GAIN = range(8)
FIT_COLUMNS = 8
"""Columns of a fit result."""


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
        far = max(SIDE_FAR * sigma_px[i], near + 2.0)
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


LANES = 16
"""Points that are fitted together, so that the loops over them are vectorised."""
EXPONENT_HALVINGS = 12


@compiled()
def exponential(x: float) -> float:
    """``exp(x)`` to 1e-12 of itself for -700 < x < 100: a series, squared, which is vectorised."""
    y = x / 2**EXPONENT_HALVINGS
    series = 1.0 + y / 8.0 * (1.0 + y / 9.0 * (1.0 + y / 10.0))
    series = 1.0 + y / 5.0 * (1.0 + y / 6.0 * (1.0 + y / 7.0 * series))
    series = 1.0 + y * (1.0 + y / 2.0 * (1.0 + y / 3.0 * (1.0 + y / 4.0 * series)))
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


IN_CENTRE, IN_AMPLITUDE, IN_SIGMA, THIRD, FOURTH, PLACE, STEP, BELL, RATIO = range(9)
CHANGE, IS_OPEN, IS_DONE, START, START_SIGMA, SUMS = range(9, 15)
N_SUMS = 13
"""Normal matrix of (centre, log amplitude, log sigma) as 00 01 02 11 12 22, its right-hand side,
then the residual against the skew term, the skew term's norm, its product with the centre's
derivative, and the same product for a term ``u^3``."""
LANE_ROWS = SUMS + N_SUMS
LEVEL, GROUND_LEVEL, COUNTS, REFLECTANCE = range(4)
PROFILE_ROWS = 4
"""Of each pixel: grey level less background, background, 1 where it counts, and reflectance."""


@compiled(fastmath=True, error_model="numpy")
def begin_sums(lanes: FloatsOut) -> None:
    """Make the lanes ready for the first pixel of another step."""
    for k in range(LANES):
        step = 1.0 / lanes[IN_SIGMA * LANES + k]
        u = (-1.0 - lanes[IN_CENTRE * LANES + k]) * step
        lanes[STEP * LANES + k] = step
        lanes[PLACE * LANES + k] = u
        bell = exponential(-0.5 * u * u)
        lanes[BELL * LANES + k] = lanes[IN_AMPLITUDE * LANES + k] * bell
        # m(k + 1) = m(k) ratio(k) and ratio(k + 1) = ratio(k) change: no exponential per pixel
        lanes[RATIO * LANES + k] = exponential(-(u + 0.5 * step) * step)
        lanes[CHANGE * LANES + k] = exponential(-step * step)
    lanes[SUMS * LANES :] = 0.0


@compiled(fastmath=True, error_model="numpy")
def accumulate(pixel: Floats, noise: Floats, lanes: FloatsOut) -> None:
    """Add one pixel of each lane to the weighted sums of a Gauss-Newton step.

    The line is ``A exp(-u^2 / 2) (1 + c3 (u^3 - 3 u) + c4 (u^4 - 6 u^2 + 3))`` with ``u`` the
    distance from the centre over sigma: a Gram-Charlier series, whose centre of gravity is u = 0.
    What is seen of it is that times the ground's reflectance.

    ``pixel``: (4 `LANES`,) grey level less background, background, 1 where the pixel counts, and
    reflectance. ``noise``: (3,) ``C^2``, ``1 / gain``, ``read^2``. ``lanes``: (28 `LANES`,).
    """
    square, linear, constant = noise[0], noise[1], noise[2]
    for k in range(LANES):
        step = lanes[STEP * LANES + k]
        u = lanes[PLACE * LANES + k] + step
        bell = lanes[BELL * LANES + k] * lanes[RATIO * LANES + k]
        lanes[PLACE * LANES + k] = u
        lanes[BELL * LANES + k] = bell
        lanes[RATIO * LANES + k] *= lanes[CHANGE * LANES + k]
        c3 = lanes[THIRD * LANES + k]
        c4 = lanes[FOURTH * LANES + k]
        uu = u * u
        third = u * (uu - 3.0)
        shape = 1.0 + c3 * third + c4 * (uu * (uu - 6.0) + 3.0)
        seen = bell * pixel[REFLECTANCE * LANES + k]
        m = seen * max(shape, 0.0)
        falling = seen * (u * shape - 3.0 * c3 * (uu - 1.0) - 4.0 * c4 * third)
        light = max(m + pixel[GROUND_LEVEL * LANES + k], 0.0)
        w = pixel[COUNTS * LANES + k] / (square * m * m + linear * light + constant)
        r = pixel[LEVEL * LANES + k] - m
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
def take_steps(is_last: bool, lanes: FloatsOut, variance: FloatsOut) -> int:
    """Solve the normal equations of the open lanes and move those that are not done.

    ``variance``: (`LANES`,) output: the centre's, of lanes that end here; 0 of those that fail or
    go on. Returns count of lanes that go on.
    """
    go_on = 0
    for k in range(LANES):
        h00 = lanes[SUMS * LANES + k]
        h01 = lanes[(SUMS + 1) * LANES + k]
        h02 = lanes[(SUMS + 2) * LANES + k]
        h11 = lanes[(SUMS + 3) * LANES + k]
        h12 = lanes[(SUMS + 4) * LANES + k]
        h22 = lanes[(SUMS + 5) * LANES + k]
        b0 = lanes[(SUMS + 6) * LANES + k]
        b1 = lanes[(SUMS + 7) * LANES + k]
        b2 = lanes[(SUMS + 8) * LANES + k]
        c00 = h11 * h22 - h12 * h12
        c01 = h02 * h12 - h01 * h22
        c02 = h01 * h12 - h02 * h11
        determinant = h00 * c00 + h01 * c01 + h02 * c02
        c11 = h00 * h22 - h02 * h02
        c12 = h01 * h02 - h00 * h12
        c22 = h00 * h11 - h01 * h01
        is_sound = (lanes[IS_OPEN * LANES + k] > 0.0) & (determinant > 0.0) & (c00 > 0.0)
        share = 1.0 / (determinant if is_sound else 1.0)
        step0 = (c00 * b0 + c01 * b1 + c02 * b2) * share
        step1 = (c01 * b0 + c11 * b1 + c12 * b2) * share
        step2 = (c02 * b0 + c12 * b1 + c22 * b2) * share
        sigma = lanes[IN_SIGMA * LANES + k]
        is_end = is_sound & (is_last | (lanes[IS_DONE * LANES + k] > 0.0))
        variance[k] = c00 * share if is_end else 0.0
        is_small = (abs(step0) < 2e-3 * sigma) & (abs(step2) < 0.02)
        lanes[IS_DONE * LANES + k] = 1.0 if is_small else 0.0
        half = 0.5 * sigma
        centre = lanes[IN_CENTRE * LANES + k] + min(max(step0, -half), half)
        own = lanes[START_SIGMA * LANES + k]
        wider = sigma * exponential(min(max(step2, -0.25), 0.25))
        is_near = abs(centre - lanes[START * LANES + k]) < 2.0 * own + 1.0
        is_near &= (wider > 0.4 * own) & (wider < 2.5 * own + 0.5)
        is_moved = is_sound & is_near & (not is_end)
        amplitude = lanes[IN_AMPLITUDE * LANES + k]
        higher = amplitude * exponential(min(max(step1, -0.5), 0.5))
        lanes[IN_CENTRE * LANES + k] = centre if is_moved else lanes[IN_CENTRE * LANES + k]
        lanes[IN_AMPLITUDE * LANES + k] = higher if is_moved else amplitude
        lanes[IN_SIGMA * LANES + k] = wider if is_moved else sigma
        lanes[IS_OPEN * LANES + k] = 1.0 if is_moved else 0.0
        go_on += 1 if is_moved else 0
    return go_on


@compiled()
def read_profile(
    image: Image,
    clipped: Mask,
    reflectance: Image,
    point: Floats,
    side: Floats,
    sigma: float,
    first: int,
    n: int,
    profile: TableOut,
) -> None:
    """Copy ``n`` pixels from ``first`` on of a point's column or row, less their background.

    ``profile``: (4, >= n) output: grey level less background, background, 1 where the pixel is not
    clipped, and reflectance. The others: One point's of `fit_profiles`.
    """
    is_column = int(point[5]) == COLUMN
    start = point[1] if is_column else point[0]
    line = int(point[0] if is_column else point[1])
    has_clipped = clipped.shape[0] == image.shape[0] and clipped.shape[1] == image.shape[1]
    has_ground = reflectance.shape[0] == image.shape[0] and reflectance.shape[1] == image.shape[1]
    middle = 0.5 * (side[0] + side[1])
    ramp = (side[1] - side[0]) / (SIDE_SPAN * sigma)
    for k in range(n):
        at = first + k
        value = image[at, line] if is_column else image[line, at]
        profile[3, k] = 1.0
        if has_ground:
            profile[3, k] = reflectance[at, line] if is_column else reflectance[line, at]
        profile[1, k] = (middle + ramp * (at - start)) * profile[3, k]
        profile[0, k] = value - profile[1, k]
        profile[2, k] = 1.0
        if has_clipped and (clipped[at, line] if is_column else clipped[line, at]):
            profile[2, k] = 0.0


@compiled(error_model="numpy")
def take_lane(
    profile: Table, n: int, start: float, sigma: float, capacity: int, pixels: FloatsOut
) -> float:
    """Copy a profile into a lane; unweighted height of a Gaussian at ``start``.

    ``profile``: (4, >= n) of `read_profile`. ``pixels``: (4 `LANES` `capacity`,) from the lane on,
    output: by pixel and row; those from ``n`` to ``capacity`` do not count.
    """
    top = norm = 0.0
    step = 1.0 / sigma
    u = (-1.0 - start) * step
    bell = math.exp(-0.5 * u * u)
    ratio = math.exp(-(u + 0.5 * step) * step)
    change = math.exp(-step * step)
    for k in range(n):
        at = k * PROFILE_ROWS * LANES
        for row in range(PROFILE_ROWS):
            pixels[at + row * LANES] = profile[row, k]
        bell *= ratio
        ratio *= change
        g = bell * profile[COUNTS, k] * profile[REFLECTANCE, k]
        top += g * profile[LEVEL, k]
        norm += g * g
    for k in range(n, capacity):
        at = k * PROFILE_ROWS * LANES
        for row in range(PROFILE_ROWS):
            pixels[at + row * LANES] = 0.0
    return top / norm if norm > 0.0 else 0.0


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
def keep_lane(lanes: Floats, k: int, first: int, variance: float, result: FloatsOut) -> None:
    """Write one lane's fit as a row of `fit_profiles`."""
    sums = lanes[SUMS * LANES + k :: LANES]
    sigma = lanes[IN_SIGMA * LANES + k]
    result[CENTRE] = first + lanes[IN_CENTRE * LANES + k]
    result[AMPLITUDE] = lanes[IN_AMPLITUDE * LANES + k]
    result[SIGMA] = sigma
    result[VARIANCE] = variance
    result[SKEW] = sums[9] - sums[11] / sums[0] * sums[6]
    result[SKEW_NORM] = max(sums[10] - sums[11] * sums[11] / sums[0], 0.0)
    result[BEND_GAIN] = sums[12] / (sums[0] * sigma)


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
    half width of the fitted window in sigmas. ``result``: (N, 8) input: results for nearly the same
    noise and section, from which the steps begin, or zeros; output: centre, amplitude, sigma,
    variance of the centre (0: the fit failed), score of a skew beyond the section's, its norm,
    count of clipped pixels, and by how much a term ``u^3`` in the profile's exponent moves the
    centre, in sigmas (for the correction on bent lines).
    """
    height, width = image.shape
    has_clipped = clipped.shape[0] == height and clipped.shape[1] == width
    profile = np.zeros((PROFILE_ROWS, max(height, width)))
    pixels = np.zeros(0)
    lanes = np.zeros(LANE_ROWS * LANES)
    variance = np.zeros(LANES)
    first = np.zeros(LANES, np.int64)
    count = np.zeros(LANES, np.int64)
    for block in range(0, points.shape[0], LANES):
        n_lanes = min(LANES, points.shape[0] - block)
        capacity = 0
        for k in range(n_lanes):
            i = block + k
            is_column = int(points[i, 5]) == COLUMN
            start = points[i, 1] if is_column else points[i, 0]
            last = (height if is_column else width) - 1
            half = max(reach[i] * sigma_px[i], 2.0)
            first[k] = max(math.ceil(start - half), 0)
            stop = min(math.floor(start + half), last)
            result[i, CLIPPED] = 0.0
            if has_clipped:
                n_clipped = count_clipped(clipped, points[i], first[k], stop)
                grow = (n_clipped + 1) // 2
                first[k] = max(first[k] - grow, 0)
                stop = min(stop + grow, last)
                result[i, CLIPPED] = n_clipped
            count[k] = stop - first[k] + 1
            capacity = max(capacity, count[k])
        if pixels.shape[0] < capacity * PROFILE_ROWS * LANES:
            pixels = np.zeros(capacity * PROFILE_ROWS * LANES)
        lanes[:] = 0.0
        lanes[IN_SIGMA * LANES : THIRD * LANES] = 1.0
        lanes[START_SIGMA * LANES : SUMS * LANES] = 1.0
        for k in range(n_lanes):
            i = block + k
            read_profile(
                image,
                clipped,
                reflectance,
                points[i],
                sides[i],
                sigma_px[i],
                first[k],
                count[k],
                profile,
            )
            is_column = int(points[i, 5]) == COLUMN
            start = (points[i, 1] if is_column else points[i, 0]) - first[k]
            amplitude = take_lane(profile, count[k], start, sigma_px[i], capacity, pixels[k:])
            is_begun = result[i, VARIANCE] > 0.0
            lanes[IN_CENTRE * LANES + k] = result[i, CENTRE] - first[k] if is_begun else start
            lanes[IN_AMPLITUDE * LANES + k] = result[i, AMPLITUDE] if is_begun else amplitude
            lanes[IN_SIGMA * LANES + k] = result[i, SIGMA] if is_begun else sigma_px[i]
            lanes[THIRD * LANES + k] = section[0] if is_column else section[2]
            lanes[FOURTH * LANES + k] = section[1] if is_column else section[3]
            lanes[START * LANES + k] = start
            lanes[START_SIGMA * LANES + k] = sigma_px[i]
            is_open = lanes[IN_AMPLITUDE * LANES + k] > 0.0
            is_open &= count[k] - result[i, CLIPPED] >= LEAST_PIXELS
            lanes[IS_OPEN * LANES + k] = 1.0 if is_open else 0.0
            result[i, VARIANCE] = 0.0
        for round_ in range(ITERATIONS):
            begin_sums(lanes)
            for at in range(capacity):
                own = at * PROFILE_ROWS * LANES
                accumulate(pixels[own : own + PROFILE_ROWS * LANES], noise, lanes)
            go_on = take_steps(round_ == ITERATIONS - 1, lanes, variance)
            for k in range(n_lanes):
                if variance[k] > 0.0:
                    keep_lane(lanes, k, first[k], variance[k], result[block + k])
            if go_on == 0:
                break


NORMAL_00, NORMAL_01, NORMAL_11, SCORE_0, SCORE_1, HAS_CORE, BLACK_NORMAL, BLACK_SCORE = range(8)
SECTION_COLUMNS = 8
"""Columns of what one profile says of what all have in common: section, and black of the ground."""
SIDE_FROM, SIDE_TO = 3.4, 4.2
"""Sigmas between which pixels beside the line tell the noise of the background."""
CORE_SIGMAS = 1.3
"""Profiles that are clipped farther out say nothing of the section: their flanks alone are left."""
FIT_PARAMETERS = 3.0
LEAST_DETERMINANT = 1e-12
MAD_TO_SIGMA = 1.4826022185056018


@compiled(error_model="numpy")
def section_sums(
    profile: Table,
    n: int,
    first: int,
    fit: Floats,
    section: Floats,
    noise: Floats,
    sums: FloatsOut,
    pixels: TableOut,
    count: int,
) -> int:
    """Sums over one profile, and its pixels' residuals.

    ``profile``: (4, >= n) from `read_profile`, beginning at pixel ``first``. ``fit``: (8,) of
    `fit_profiles`. ``section``: (2,). ``noise``: (3,). ``sums``: (26,) output: weighted products of
    the derivatives by centre, amplitude and width (00 01 02 11 12 22), of each with the terms of
    third (6 7 8) and fourth order (9 10 11), of these terms (12 13 14), of the residual with all
    five (15 to 19), 1 where no pixel beyond the core is clipped, and of the light that too large a
    reflectance would add the products with the three (21 22 23), itself and the residual.
    ``pixels``: (3, capacity)
    output from ``count`` on: the line's own grey level, the same with the background, the residual.

    Returns the new count.
    """
    a00 = a01 = a02 = a11 = a12 = a22 = b0 = b1 = b2 = b3 = b4 = 0.0
    p0 = p1 = p2 = q0 = q1 = q2 = t33 = t34 = t44 = 0.0
    g0 = g1 = g2 = tgg = bg = 0.0
    has_core = 1.0
    begun = stop = -1
    for k in range(n):
        u = (first + k - fit[CENTRE]) / fit[SIGMA]
        is_line = abs(u) < REACH_SIGMAS
        if not is_line and not SIDE_FROM < abs(u) < SIDE_TO:
            continue
        bell = fit[AMPLITUDE] * math.exp(-0.5 * u * u) * profile[3, k]
        third = u * (u * u - 3.0)
        fourth = u * u * (u * u - 6.0) + 3.0
        shape = 1.0 + section[0] * third + section[1] * fourth
        m = bell * max(shape, 0.0)
        r = profile[0, k] - m
        pixels[0, count] = m
        pixels[1, count] = m + profile[1, k]
        pixels[2, count] = r
        count += 1
        if not is_line:
            continue
        begun = count - 1 if begun < 0 else begun
        stop = count
        if profile[2, k] == 0.0:
            has_core = has_core if abs(u) <= CORE_SIGMAS else 0.0
            continue
        w = 1.0 / (noise[0] * m * m + noise[1] * max(m + profile[1, k], 0.0) + noise[2])
        j0 = bell * (u * shape - 3.0 * section[0] * (u * u - 1.0) - 4.0 * section[1] * third)
        j2 = j0 * u
        third *= bell
        fourth *= bell
        a00 += w * j0 * j0
        a01 += w * j0 * m
        a02 += w * j0 * j2
        a11 += w * m * m
        a12 += w * m * j2
        a22 += w * j2 * j2
        p0 += w * j0 * third
        p1 += w * m * third
        p2 += w * j2 * third
        q0 += w * j0 * fourth
        q1 += w * m * fourth
        q2 += w * j2 * fourth
        t33 += w * third * third
        t34 += w * third * fourth
        t44 += w * fourth * fourth
        b0 += w * r * j0
        b1 += w * r * m
        b2 += w * r * j2
        b3 += w * r * third
        b4 += w * r * fourth
        light = -m / profile[3, k]
        g0 += w * j0 * light
        g1 += w * m * light
        g2 += w * j2 * light
        tgg += w * light * light
        bg += w * r * light
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = a00, a01, a02, a11, a12, a22
    sums[6], sums[7], sums[8], sums[9], sums[10], sums[11] = p0, p1, p2, q0, q1, q2
    sums[12], sums[13], sums[14] = t33, t34, t44
    sums[15], sums[16], sums[17], sums[18], sums[19], sums[20] = b0, b1, b2, b3, b4, has_core
    sums[21], sums[22], sums[23], sums[24], sums[25] = g0, g1, g2, tgg, bg
    freedom = math.sqrt((stop - begun) / max(stop - begun - FIT_PARAMETERS, 1.0))
    for k in range(max(begun, 0), stop):
        pixels[2, k] *= freedom
    return count


@compiled(error_model="numpy")
def leave_fitted(sums: Floats, said: FloatsOut) -> None:
    """Normal matrix and right-hand side of what the fitted parameters do not take up of the terms.

    ``sums``: (26,) of `section_sums`. ``said``: (8,) output; zeros where the parameters themselves
    are not determined.
    """
    said[:] = 0.0
    a, b, c, d, e, f = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * c00 + b * c01 + c * c02
    if not determinant > LEAST_DETERMINANT * a * d * f:
        return
    c11, c12, c22 = a * f - c * c, b * c - a * e, a * d - b * b
    for term in range(3):
        at = 21 if term == 2 else 6 + 3 * term
        x, y, z = sums[at], sums[at + 1], sums[at + 2]
        t0 = (c00 * x + c01 * y + c02 * z) / determinant
        t1 = (c01 * x + c11 * y + c12 * z) / determinant
        t2 = (c02 * x + c12 * y + c22 * z) / determinant
        taken = t0 * sums[15] + t1 * sums[16] + t2 * sums[17]
        own = t0 * x + t1 * y + t2 * z
        if term == 0:
            said[NORMAL_00], said[SCORE_0] = sums[12] - own, sums[18] - taken
            said[NORMAL_01] = sums[13] - t0 * sums[9] - t1 * sums[10] - t2 * sums[11]
        elif term == 1:
            said[NORMAL_11], said[SCORE_1] = sums[14] - own, sums[19] - taken
        else:
            said[BLACK_NORMAL], said[BLACK_SCORE] = sums[24] - own, sums[25] - taken
    said[HAS_CORE] = sums[20]


@compiled(error_model="numpy")
def weigh_section(
    image: Image,
    clipped: Mask,
    reflectance: Image,
    points: Table,
    sides: Table,
    fits: Table,
    noise: Floats,
    section: Floats,
    reach: int,
    said: TableOut,
    pixels: TableOut,
) -> int:
    """What fitted profiles leave: for the terms of their common section, and for the noise.

    Of the terms of third and fourth order of `accumulate`, only what centre, amplitude and width
    do not take up counts.

    ``image``, ``clipped``, ``reflectance``, ``points``, ``sides``, ``noise``, ``section``: As for
    `fit_profiles`, which gave ``fits`` (N, 8). ``reach``: Pixels looked at on both sides. ``said``:
    (N, 8) output: normal matrix of the two terms as 00 01 11, their right-hand side, 1 where no
    pixel beyond the core is clipped, and both for what the reflectance is too large by.
    ``pixels``: (3, >= N (2 reach + 1)) output: the line's own grey level, the same with the
    background, and the residual, widened by the freedom that the fit took, of every pixel of the
    lines and of those beside them.

    Returns count of pixels.
    """
    height, width = image.shape
    profile = np.zeros((4, 2 * reach + 1))
    sums = np.zeros(26)
    count = 0
    for i in range(points.shape[0]):
        is_column = int(points[i, 5]) == COLUMN
        start = points[i, 1] if is_column else points[i, 0]
        first = max(int(np.rint(start)) - reach, 0)
        stop = min(int(np.rint(start)) + reach + 1, height if is_column else width)
        n = stop - first
        read_profile(
            image, clipped, reflectance, points[i], sides[i], fits[i, SIGMA], first, n, profile
        )
        own = section[:2] if is_column else section[2:]
        count = section_sums(profile, n, first, fits[i], own, noise, sums, pixels, count)
        leave_fitted(sums, said[i])
    return count


BIN_MEANS = 4
"""Columns of what is told of the residuals at one grey level."""
CLIPPED_RESIDUAL = 3.5


@compiled()
def bin_residuals(pixels: Table, edges: Floats, bins: TableOut) -> None:
    """What the residuals are at each of the line's own grey levels.

    ``pixels``: (3, M) of `weigh_section`. ``edges``: (B + 1,) increasing levels. ``bins``: (B, 4)
    output: count, means of the level's square and of all light (not below 0), and mean square of
    the residuals, those beyond `CLIPPED_RESIDUAL` robust sigmas taken as so large.
    """
    n_bins = bins.shape[0]
    bins[:] = 0.0
    place = np.full(pixels.shape[1], -1, np.int64)
    for k in range(pixels.shape[1]):
        if not edges[0] <= pixels[0, k] < edges[n_bins]:
            continue
        b = 0
        while pixels[0, k] >= edges[b + 1]:
            b += 1
        place[k] = b
        bins[b, 0] += 1.0
        bins[b, 1] += pixels[0, k] * pixels[0, k]
        bins[b, 2] += max(pixels[1, k], 0.0)
    for b in range(n_bins):
        n = int(bins[b, 0])
        if n == 0:
            continue
        size = np.zeros(n)
        i = 0
        for k in range(pixels.shape[1]):
            if place[k] == b:
                size[i] = abs(pixels[2, k])
                i += 1
        limit = CLIPPED_RESIDUAL * MAD_TO_SIGMA * np.median(size)
        total = 0.0
        for i in range(n):
            total += min(size[i], limit) ** 2
        bins[b, 1] /= n
        bins[b, 2] /= n
        bins[b, 3] = total / n


@compiled()
def common_terms(said: Table, rounds: int, clipped_score: float, terms: FloatsOut) -> None:
    """Terms (2,) that profiles share, robustly: a score counts little beyond the median's scatter.

    ``said``: (N, 8) of `weigh_section`. ``rounds``: Of weighing. ``clipped_score``: Of one profile,
    in scatters, beyond which it counts the less. ``terms``: (2,) output.
    """
    n = said.shape[0]
    ratio = np.zeros((2, n))
    limit = np.full(2, np.inf)
    terms[:] = 0.0
    for _ in range(rounds):
        a = b = c = d = e = f = 0.0
        for i in range(n):
            k0 = min(1.0, limit[0] / max(abs(ratio[0, i]), 1e-12))
            k1 = min(1.0, limit[1] / max(abs(ratio[1, i]), 1e-12))
            a += k0 * said[i, NORMAL_00]
            b += k0 * said[i, NORMAL_01]
            c += k1 * said[i, NORMAL_01]
            d += k1 * said[i, NORMAL_11]
            e += k0 * said[i, SCORE_0]
            f += k1 * said[i, SCORE_1]
        determinant = a * d - b * c
        if not abs(determinant) > LEAST_DETERMINANT * a * d:
            return
        terms[0] = (d * e - b * f) / determinant
        terms[1] = (a * f - c * e) / determinant
        for i in range(n):
            left = said[i, SCORE_0] - said[i, NORMAL_00] * terms[0] - said[i, NORMAL_01] * terms[1]
            right = said[i, SCORE_1] - said[i, NORMAL_01] * terms[0] - said[i, NORMAL_11] * terms[1]
            ratio[0, i] = left / math.sqrt(max(said[i, NORMAL_00], 1e-12))
            ratio[1, i] = right / math.sqrt(max(said[i, NORMAL_11], 1e-12))
        for term in range(2):
            limit[term] = clipped_score * max(MAD_TO_SIGMA * np.median(np.abs(ratio[term])), 1.0)
