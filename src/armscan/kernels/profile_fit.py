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


@compiled()
def start_amplitude(profile: Table, n: int, offset: float, sigma: float) -> float:
    """Unweighted height of a Gaussian ``offset`` pixels from the profile's first pixel."""
    top = norm = 0.0
    for k in range(n):
        u = (k - offset) / sigma
        g = math.exp(-0.5 * u * u) * profile[2, k] * profile[3, k]
        top += g * profile[0, k]
        norm += g * g
    return top / norm if norm > 0.0 else 0.0


@compiled(error_model="numpy")
def accumulate(
    profile: Table,
    n: int,
    state: Floats,
    section: Floats,
    noise: Floats,
    sums: FloatsOut,
) -> None:
    """Weighted sums of one Gauss-Newton step.

    The line is ``A exp(-u^2 / 2) (1 + c3 (u^3 - 3 u) + c4 (u^4 - 6 u^2 + 3))`` with ``u`` the
    distance from the centre over sigma: a Gram-Charlier series, whose centre of gravity is u = 0.
    What is seen of it is that times the ground's reflectance.

    ``profile``: (4, >= n) grey level less background, background, 1 where the pixel counts, and
    reflectance.
    ``n``: Pixels of the profile. ``state``: (3,) centre from the first pixel, amplitude, sigma.
    ``section``: (2,) ``c3, c4``.
    ``noise``: (3,) ``C^2``, ``1 / gain``, ``read^2``. ``sums``: (13,) output: normal matrix of
    (centre, log amplitude, log sigma) as 00 01 02 11 12 22, its right-hand side, then the residual
    against the skew term, the skew term's norm, its product with the centre's derivative, and the
    same product for a term ``u^3``.
    """
    # sums in an array would wait for memory at every pixel
    a00 = a01 = a02 = a11 = a12 = a22 = b0 = b1 = b2 = 0.0
    skew = skew_norm = skew_centre = cubic = 0.0
    # m(k + 1) = m(k) ratio(k) and ratio(k + 1) = ratio(k) change: no exponential per pixel
    step = 1.0 / state[2]
    u = (-1.0 - state[0]) * step
    bell = state[1] * math.exp(-0.5 * u * u)
    c3, c4 = section[0], section[1]
    ratio = math.exp(-(u + 0.5 * step) * step)
    change = math.exp(-step * step)
    for k in range(n):
        u += step
        bell *= ratio
        ratio *= change
        third = u * (u * u - 3.0)
        shape = 1.0 + c3 * third + c4 * (u * u * (u * u - 6.0) + 3.0)
        seen = bell * profile[3, k]
        m = seen * max(shape, 0.0)
        falling = seen * (u * shape - 3.0 * c3 * (u * u - 1.0) - 4.0 * c4 * third)
        variance = noise[0] * m * m + noise[1] * max(m + profile[1, k], 0.0) + noise[2]
        w = profile[2, k] / variance
        r = profile[0, k] - m
        j0 = falling * step
        j2 = falling * u
        q = seen * third
        a00 += w * j0 * j0
        a01 += w * j0 * m
        a02 += w * j0 * j2
        a11 += w * m * m
        a12 += w * m * j2
        a22 += w * j2 * j2
        b0 += w * r * j0
        b1 += w * r * m
        b2 += w * r * j2
        skew += w * r * q
        skew_norm += w * q * q
        skew_centre += w * q * j0
        cubic += w * j0 * seen * u * u * u
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = a00, a01, a02, a11, a12, a22
    sums[6], sums[7], sums[8] = b0, b1, b2
    sums[9], sums[10], sums[11], sums[12] = skew, skew_norm, skew_centre, cubic


@compiled()
def solve_step(sums: Floats, steps: FloatsOut) -> float:
    """Solve the normal equations into ``steps`` (3,); return the centre's variance, or 0."""
    h00, h01, h02, h11, h12, h22 = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    b0, b1, b2 = sums[6], sums[7], sums[8]
    c00 = h11 * h22 - h12 * h12
    c01 = h02 * h12 - h01 * h22
    c02 = h01 * h12 - h02 * h11
    determinant = h00 * c00 + h01 * c01 + h02 * c02
    if not determinant > 0.0:
        return 0.0
    c11 = h00 * h22 - h02 * h02
    c12 = h01 * h02 - h00 * h12
    c22 = h00 * h11 - h01 * h01
    steps[0] = (c00 * b0 + c01 * b1 + c02 * b2) / determinant
    steps[1] = (c01 * b0 + c11 * b1 + c12 * b2) / determinant
    steps[2] = (c02 * b0 + c12 * b1 + c22 * b2) / determinant
    return float(c00 / determinant)


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
    profile = np.zeros((4, max(height, width)))
    state = np.zeros(3)
    steps = np.zeros(3)
    sums = np.zeros(13)
    shape = np.zeros(2)
    has_clipped = clipped.shape[0] == height and clipped.shape[1] == width
    for i in range(points.shape[0]):
        is_column = int(points[i, 5]) == COLUMN
        shape[0] = section[0] if is_column else section[2]
        shape[1] = section[1] if is_column else section[3]
        start = points[i, 1] if is_column else points[i, 0]
        line = int(points[i, 0] if is_column else points[i, 1])
        size = height if is_column else width
        half = max(reach[i] * sigma_px[i], 2.0)
        first = max(math.ceil(start - half), 0)
        last = min(math.floor(start + half), size - 1)
        n_clipped = 0
        if has_clipped:
            for k in range(first, last + 1):
                n_clipped += clipped[k, line] if is_column else clipped[line, k]
            grow = (n_clipped + 1) // 2
            first = max(first - grow, 0)
            last = min(last + grow, size - 1)
        n = last - first + 1
        read_profile(
            image, clipped, reflectance, points[i], sides[i], sigma_px[i], first, n, profile
        )
        if result[i, VARIANCE] > 0.0:
            state[0] = result[i, CENTRE] - first
            state[1] = result[i, AMPLITUDE]
            state[2] = result[i, SIGMA]
        else:
            state[0] = start - first
            state[1] = start_amplitude(profile, n, state[0], sigma_px[i])
            state[2] = sigma_px[i]
        result[i, VARIANCE] = 0.0
        result[i, CLIPPED] = n_clipped
        if state[1] <= 0.0 or n - n_clipped < LEAST_PIXELS:
            continue
        is_done = False
        for round_ in range(ITERATIONS):
            accumulate(profile, n, state, shape, noise, sums)
            variance = solve_step(sums, steps)
            if variance <= 0.0:
                break
            if is_done or round_ == ITERATIONS - 1:
                result[i, CENTRE] = first + state[0]
                result[i, AMPLITUDE] = state[1]
                result[i, SIGMA] = state[2]
                result[i, VARIANCE] = variance
                result[i, SKEW] = sums[9] - sums[11] / sums[0] * sums[6]
                result[i, SKEW_NORM] = max(sums[10] - sums[11] * sums[11] / sums[0], 0.0)
                result[i, BEND_GAIN] = sums[12] / (sums[0] * state[2])
                break
            is_done = abs(steps[0]) < 2e-3 * state[2] and abs(steps[2]) < 0.02
            state[0] += min(max(steps[0], -0.5 * state[2]), 0.5 * state[2])
            state[1] *= math.exp(min(max(steps[1], -0.5), 0.5))
            state[2] *= math.exp(min(max(steps[2], -0.25), 0.25))
            drift = abs(first + state[0] - start)
            is_near = drift < 2.0 * sigma_px[i] + 1.0
            if not is_near or not 0.4 < state[2] / sigma_px[i] < 2.5 + 0.5 / sigma_px[i]:
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
