# SPDX-License-Identifier: Apache-2.0
"""What the fitted sections of a stripe have in common: their shape, and the noise they leave."""

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
    Table,
    TableOut,
    compiled,
)
from armscan.kernels.stripe.profile_fit import (
    AMPLITUDE,
    CENTRE,
    COUNTS,
    FARTHEST_SQUARE,
    GROUND_LEVEL,
    LANES,
    LEVEL,
    PROFILE_ROWS,
    REACH_SIGMAS,
    REFLECTANCE,
    SIGMA,
    SKEW,
    SKEW_NORM,
    VARIANCE,
    exponential,
    side_span,
)

NORMAL_00, NORMAL_01, NORMAL_11, SCORE_0, SCORE_1, HAS_CORE, BLACK_NORMAL, BLACK_SCORE = range(8)
SECTION_COLUMNS = 8
"""Columns of what one profile says of what all have in common: section, and black of the ground."""
SIDE_FROM, SIDE_TO = 3.4, 4.2
"""Sigmas between which pixels beside the line tell the noise of the background."""
CORE_SIGMAS = 1.3
"""Profiles that are clipped farther out say nothing of the section: their flanks alone are left."""
LEAST_SHARE = 0.2
"""Of the noise's variance in a residual: of less, the fit's own faults are what is seen."""
LEAST_DETERMINANT = 1e-12
MAD_TO_SIGMA = 1.4826022185056018
LEAST_GROUND = 1e-6
"""Reflectance by which nothing is divided that is smaller."""


N_SUMS = 26
AT_CENTRE, STEP, AT_AMPLITUDE, THIRD, FOURTH, SUMS = range(6)
LANE_ROWS = SUMS + N_SUMS
NOT_SEEN = -1.0
"""Own grey level of pixels that tell nothing."""
REACH2, FROM2, TO2, CORE2 = REACH_SIGMAS**2, SIDE_FROM**2, SIDE_TO**2, CORE_SIGMAS**2


@compiled(fastmath=True, error_model="numpy")
def leave_pixel(pixels: Floats, pixel: int, lanes: Floats, left: FloatsOut) -> None:
    """What the fit leaves of one pixel of each lane.

    ``pixels``, ``pixel``, ``lanes``: As for `add_pixel`. ``left``: (3 `LANES`,) output: the line's
    own grey level, the same with the background, the residual.
    """
    for k in range(LANES):
        u = (pixel - lanes[AT_CENTRE * LANES + k]) * lanes[STEP * LANES + k]
        uu = u * u
        is_seen = (uu < REACH2) | ((uu > FROM2) & (uu < TO2))
        shape = 1.0 + lanes[THIRD * LANES + k] * (u * (uu - 3.0))
        shape += lanes[FOURTH * LANES + k] * (uu * (uu - 6.0) + 3.0)
        m = exponential(-0.5 * min(uu, FARTHEST_SQUARE)) * lanes[AT_AMPLITUDE * LANES + k]
        m *= pixels[REFLECTANCE * LANES + k] * max(shape, 0.0)
        left[k] = m if is_seen & (pixels[COUNTS * LANES + k] > 0.0) else NOT_SEEN
        left[LANES + k] = m + pixels[GROUND_LEVEL * LANES + k]
        left[2 * LANES + k] = pixels[LEVEL * LANES + k] - m


@compiled(fastmath=True, error_model="numpy")
def add_pixel(pixels: Floats, pixel: int, noise: Floats, lanes: FloatsOut) -> None:
    """Add one pixel of each lane to the sums over its profile.

    ``pixels``: (4 `LANES`,) grey level less background, background, 1 where the pixel is not
    clipped (`NOT_SEEN` beyond the profile), and reflectance. ``pixel``: Its place in the profiles.
    ``noise``: (3,). ``lanes``: (31 `LANES`,) centre, 1 over sigma, amplitude and section of each
    lane, then sums: weighted products of the derivatives by centre, amplitude and width (00 01 02
    11 12 22), of each with the terms of third (6 7 8) and fourth order (9 10 11), of these terms
    (12 13 14), of the residual with all five (15 to 19), and count of clipped pixels beyond the
    core.
    """
    square, linear, constant = noise[0], noise[1], noise[2]
    for k in range(LANES):
        c3, c4 = lanes[THIRD * LANES + k], lanes[FOURTH * LANES + k]
        counts = pixels[COUNTS * LANES + k]
        u = (pixel - lanes[AT_CENTRE * LANES + k]) * lanes[STEP * LANES + k]
        uu = u * u
        is_line = (uu < REACH2) & (counts >= 0.0)
        bell = exponential(-0.5 * min(uu, FARTHEST_SQUARE)) * pixels[REFLECTANCE * LANES + k]
        bell *= lanes[AT_AMPLITUDE * LANES + k]
        third = u * (uu - 3.0)
        fourth = uu * (uu - 6.0) + 3.0
        shape = 1.0 + c3 * third + c4 * fourth
        m = bell * max(shape, 0.0)
        behind = pixels[GROUND_LEVEL * LANES + k]
        r = pixels[LEVEL * LANES + k] - m
        w = 1.0 / (square * m * m + linear * max(m + behind, 0.0) + constant)
        w = w if is_line & (counts > 0.0) else 0.0
        j0 = bell * (u * shape - 3.0 * c3 * (uu - 1.0) - 4.0 * c4 * third)
        j2 = j0 * u
        third *= bell
        fourth *= bell
        w0, w1, w2, w3, w4, wr = w * j0, w * m, w * j2, w * third, w * fourth, w * r
        lanes[SUMS * LANES + k] += w0 * j0
        lanes[(SUMS + 1) * LANES + k] += w0 * m
        lanes[(SUMS + 2) * LANES + k] += w0 * j2
        lanes[(SUMS + 3) * LANES + k] += w1 * m
        lanes[(SUMS + 4) * LANES + k] += w1 * j2
        lanes[(SUMS + 5) * LANES + k] += w2 * j2
        lanes[(SUMS + 6) * LANES + k] += w0 * third
        lanes[(SUMS + 7) * LANES + k] += w1 * third
        lanes[(SUMS + 8) * LANES + k] += w2 * third
        lanes[(SUMS + 9) * LANES + k] += w0 * fourth
        lanes[(SUMS + 10) * LANES + k] += w1 * fourth
        lanes[(SUMS + 11) * LANES + k] += w2 * fourth
        lanes[(SUMS + 12) * LANES + k] += w3 * third
        lanes[(SUMS + 13) * LANES + k] += w3 * fourth
        lanes[(SUMS + 14) * LANES + k] += w4 * fourth
        lanes[(SUMS + 15) * LANES + k] += wr * j0
        lanes[(SUMS + 16) * LANES + k] += wr * m
        lanes[(SUMS + 17) * LANES + k] += wr * j2
        lanes[(SUMS + 18) * LANES + k] += wr * third
        lanes[(SUMS + 19) * LANES + k] += wr * fourth
        is_cut = is_line & (counts == 0.0) & (uu > CORE2)
        lanes[(SUMS + 20) * LANES + k] += 1.0 if is_cut else 0.0


@compiled(fastmath=True, error_model="numpy")
def add_black(pixels: Floats, pixel: int, noise: Floats, lanes: FloatsOut) -> None:
    """Add one pixel of each lane to what tells whether the reflectance is too large everywhere.

    As for `add_pixel`; of the light that would add: sums 21 to 25, its products with the
    derivatives by centre, amplitude and width, with itself and with the residual.
    """
    square, linear, constant = noise[0], noise[1], noise[2]
    for k in range(LANES):
        c3, c4 = lanes[THIRD * LANES + k], lanes[FOURTH * LANES + k]
        u = (pixel - lanes[AT_CENTRE * LANES + k]) * lanes[STEP * LANES + k]
        uu = u * u
        is_line = (uu < REACH2) & (pixels[COUNTS * LANES + k] > 0.0)
        bell = exponential(-0.5 * min(uu, FARTHEST_SQUARE)) * pixels[REFLECTANCE * LANES + k]
        bell *= lanes[AT_AMPLITUDE * LANES + k]
        third = u * (uu - 3.0)
        shape = 1.0 + c3 * third + c4 * (uu * (uu - 6.0) + 3.0)
        m = bell * max(shape, 0.0)
        r = pixels[LEVEL * LANES + k] - m
        light = max(m + pixels[GROUND_LEVEL * LANES + k], 0.0)
        w = 1.0 / (square * m * m + linear * light + constant)
        w = w if is_line else 0.0
        j0 = bell * (u * shape - 3.0 * c3 * (uu - 1.0) - 4.0 * c4 * third)
        more = -m / max(pixels[REFLECTANCE * LANES + k], LEAST_GROUND)
        lanes[(SUMS + 21) * LANES + k] += w * j0 * more
        lanes[(SUMS + 22) * LANES + k] += w * m * more
        lanes[(SUMS + 23) * LANES + k] += w * j0 * u * more
        lanes[(SUMS + 24) * LANES + k] += w * more * more
        lanes[(SUMS + 25) * LANES + k] += w * r * more


@compiled()
def read_profile(
    image: Image,
    clipped: Mask,
    reflectance: Image,
    point: Floats,
    side: Floats,
    span_px: float,
    first: int,
    n: int,
    lane: FloatsOut,
) -> None:
    """Copy ``n`` pixels from ``first`` on of a point's column or row, less their background.

    ``span_px``: Distance between the two sides.
    ``lane``: From the lane's first number on: pixels as for `add_pixel`. The others: One point's of
    `weigh_section`.
    """
    is_column = int(point[5]) == COLUMN
    start = point[1] if is_column else point[0]
    line = int(point[0] if is_column else point[1])
    has_clipped = clipped.shape[0] == image.shape[0] and clipped.shape[1] == image.shape[1]
    has_ground = reflectance.shape[0] == image.shape[0] and reflectance.shape[1] == image.shape[1]
    middle = 0.5 * (side[0] + side[1])
    ramp = (side[1] - side[0]) / span_px
    for k in range(n):
        at = first + k
        own = k * PROFILE_ROWS * LANES
        ground = 1.0
        if has_ground:
            ground = float(reflectance[at, line] if is_column else reflectance[line, at])
        behind = (middle + ramp * (at - start)) * ground
        counts = 1.0
        if has_clipped and (clipped[at, line] if is_column else clipped[line, at]):
            counts = 0.0
        lane[own + LEVEL * LANES] = (image[at, line] if is_column else image[line, at]) - behind
        lane[own + GROUND_LEVEL * LANES] = behind
        lane[own + COUNTS * LANES] = counts
        lane[own + REFLECTANCE * LANES] = ground


@compiled(error_model="numpy")
def leave_fitted(sums: Floats, said: FloatsOut) -> None:
    """Normal matrix and right-hand side of what the fitted parameters do not take up of the terms.

    ``sums``: (26,) of `add_pixel`. ``said``: (8,) output; zeros where the parameters themselves
    are not determined.
    """
    said[:] = 0.0
    inverse = np.zeros(6)
    if not invert(sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], inverse):
        return
    for term in range(3):
        at = 21 if term == 2 else 6 + 3 * term
        x, y, z = sums[at], sums[at + 1], sums[at + 2]
        t0 = inverse[0] * x + inverse[1] * y + inverse[2] * z
        t1 = inverse[1] * x + inverse[3] * y + inverse[4] * z
        t2 = inverse[2] * x + inverse[4] * y + inverse[5] * z
        taken = t0 * sums[15] + t1 * sums[16] + t2 * sums[17]
        own = t0 * x + t1 * y + t2 * z
        if term == 0:
            said[NORMAL_00], said[SCORE_0] = sums[12] - own, sums[18] - taken
            said[NORMAL_01] = sums[13] - t0 * sums[9] - t1 * sums[10] - t2 * sums[11]
        elif term == 1:
            said[NORMAL_11], said[SCORE_1] = sums[14] - own, sums[19] - taken
        else:
            said[BLACK_NORMAL], said[BLACK_SCORE] = sums[24] - own, sums[25] - taken
    said[HAS_CORE] = 1.0 if sums[20] == 0.0 else 0.0


@compiled(error_model="numpy")
def invert(a: float, b: float, c: float, d: float, e: float, f: float, inverse: FloatsOut) -> bool:
    """Inverse of the symmetric matrix ``((a, b, c), (b, d, e), (c, e, f))``, in the same order.

    Returns False, and leaves ``inverse`` (6,), where there is none.
    """
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * c00 + b * c01 + c * c02
    if not determinant > LEAST_DETERMINANT * a * d * f:
        return False
    inverse[0], inverse[1], inverse[2] = c00, c01, c02
    inverse[3], inverse[4], inverse[5] = a * f - c * c, b * c - a * e, a * d - b * b
    inverse /= determinant
    return True


@compiled(error_model="numpy")
def keep_left(
    left: Floats, size: int, lanes: Floats, k: int, noise: Floats, pixels: TableOut, count: int
) -> int:
    """Append what the fit leaves of one lane's ``size`` pixels to ``pixels``; the new count.

    A fit follows each pixel by its leverage: of the noise's variance ``1 - leverage`` is left in
    the residual, which is widened by that. Of the peak of a line that is half a pixel wide
    nothing is left: such pixels do not tell the noise.
    """
    centre, step = lanes[AT_CENTRE * LANES + k], lanes[STEP * LANES + k]
    inverse, sums = np.zeros(6), np.zeros(5)
    for at in range(size):
        m, u = left[3 * at * LANES + k], (at - centre) * step
        if m == NOT_SEEN or not abs(u) < REACH_SIGMAS:
            continue
        light = max(left[(3 * at + 1) * LANES + k], 0.0)
        w = m * m / (noise[0] * m * m + noise[1] * light + noise[2])
        power = w
        for order in range(5):
            sums[order] += power
            power *= u
    is_fitted = invert(sums[0], sums[1], sums[2], sums[2], sums[3], sums[4], inverse)
    for at in range(size):
        m, u = left[3 * at * LANES + k], (at - centre) * step
        if m == NOT_SEEN:
            continue
        share = 1.0
        if abs(u) < REACH_SIGMAS:
            if not is_fitted:
                continue
            light = max(left[(3 * at + 1) * LANES + k], 0.0)
            w = m * m / (noise[0] * m * m + noise[1] * light + noise[2])
            taken = inverse[0] + 2.0 * u * inverse[1] + u * u * (2.0 * inverse[2] + inverse[3])
            taken += u * u * u * (2.0 * inverse[4] + u * inverse[5])
            share = 1.0 - w * taken
            if share < LEAST_SHARE:
                continue
        pixels[0, count] = m
        pixels[1, count] = left[(3 * at + 1) * LANES + k]
        pixels[2, count] = left[(3 * at + 2) * LANES + k] / math.sqrt(share)
        count += 1
    return count


@compiled(error_model="numpy")
def weigh_section(
    image: Image,
    clipped: Mask,
    reflectance: Image,
    points: Table,
    sigma_px: Floats,
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

    ``image``, ``clipped``, ``reflectance``, ``points``, ``sigma_px``, ``sides``, ``noise``,
    ``section``: As for `fit_profiles`, which gave ``fits`` (N, 9). ``reach``: Pixels looked at on
    both sides. ``said``: (N, 8) output: normal matrix of the two terms as 00 01 11, their
    right-hand side, 1 where no pixel beyond the core is clipped, and both for what the reflectance
    is too large by; (0, 8) if not asked for. ``pixels``: (3, >= N (2 reach + 1)) output: the line's
    own grey level, the same with the background, and the residual, widened by what the fit took of
    it under ``noise``, of pixels of the lines and of those beside them; (3, 0) if not asked for.

    Returns count of pixels.
    """
    height, width = image.shape
    size = 2 * reach + 1
    seen = np.zeros(size * PROFILE_ROWS * LANES)
    left = np.zeros(size * 3 * LANES)
    lanes = np.zeros(LANE_ROWS * LANES)
    has_ground = reflectance.size > 1
    sums = np.zeros(N_SUMS)
    count = 0
    for block in range(0, points.shape[0], LANES):
        n_lanes = min(LANES, points.shape[0] - block)
        seen[:] = NOT_SEEN
        lanes[:] = 0.0
        low, high = size, 0
        for k in range(n_lanes):
            i = block + k
            is_column = int(points[i, 5]) == COLUMN
            start = points[i, 1] if is_column else points[i, 0]
            first = max(int(np.rint(start)) - reach, 0)
            n = min(int(np.rint(start)) + reach + 1, height if is_column else width) - first
            sigma, span, lane = fits[i, SIGMA], side_span(sigma_px[i]), seen[k:]
            read_profile(image, clipped, reflectance, points[i], sides[i], span, first, n, lane)
            lanes[AT_CENTRE * LANES + k] = fits[i, CENTRE] - first
            lanes[STEP * LANES + k] = 1.0 / fits[i, SIGMA]
            lanes[AT_AMPLITUDE * LANES + k] = fits[i, AMPLITUDE]
            low = min(low, math.floor(fits[i, CENTRE] - first - REACH_SIGMAS * sigma))
            high = max(high, math.ceil(fits[i, CENTRE] - first + REACH_SIGMAS * sigma))
            lanes[THIRD * LANES + k] = section[0] if is_column else section[2]
            lanes[FOURTH * LANES + k] = section[1] if is_column else section[3]
        for at in range(size):
            own = seen[at * PROFILE_ROWS * LANES : (at + 1) * PROFILE_ROWS * LANES]
            if said.shape[0] > 0 and low <= at <= high:
                add_pixel(own, at, noise, lanes)
                if has_ground:
                    add_black(own, at, noise, lanes)
            if pixels.shape[1] > 0:
                leave_pixel(own, at, lanes, left[3 * at * LANES : 3 * (at + 1) * LANES])
        for k in range(n_lanes):
            if said.shape[0] > 0:
                for m in range(N_SUMS):
                    sums[m] = lanes[(SUMS + m) * LANES + k]
                leave_fitted(sums, said[block + k])
            if pixels.shape[1] > 0:
                count = keep_left(left, size, lanes, k, noise, pixels, count)
    return count


BIN_MEANS = 4
"""Columns of what is told of the residuals at one grey level."""
CLIPPED_RESIDUAL = 3.5


@compiled()
def bin_residuals(pixels: Table, n: int, edges: Floats, bins: TableOut) -> None:
    """What the residuals are at each of the line's own grey levels.

    ``pixels``: (3, >= n) of `weigh_section`, ``n`` of which count. ``edges``: (B + 1,) increasing
    levels. ``bins``: (B, 4)
    output: count, means of the level's square and of all light (not below 0), and mean square of
    the residuals, those beyond `CLIPPED_RESIDUAL` robust sigmas taken as so large.
    """
    n_bins = bins.shape[0]
    bins[:] = 0.0
    begin = np.zeros(n_bins + 1, np.int64)
    place = np.full(n, -1, np.int64)
    for k in range(n):
        if not edges[0] <= pixels[0, k] < edges[n_bins]:
            continue
        b = 0
        while pixels[0, k] >= edges[b + 1]:
            b += 1
        place[k] = b
        begin[b + 1] += 1
        bins[b, 1] += pixels[0, k] * pixels[0, k]
        bins[b, 2] += max(pixels[1, k], 0.0)
    for b in range(n_bins):
        bins[b, 0] = begin[b + 1]
        begin[b + 1] += begin[b]
    size = np.zeros(begin[n_bins])
    stop = begin[:-1].copy()
    for k in range(n):
        if place[k] >= 0:
            size[stop[place[k]]] = abs(pixels[2, k])
            stop[place[k]] += 1
    for b in range(n_bins):
        count = int(bins[b, 0])
        if count == 0:
            continue
        own = size[begin[b] : begin[b + 1]]
        limit = CLIPPED_RESIDUAL * MAD_TO_SIGMA * np.median(own)
        total = 0.0
        for i in range(count):
            total += min(own[i], limit) ** 2
        bins[b, 1] /= count
        bins[b, 2] /= count
        bins[b, 3] = total / count


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


SIGNIFICANT = 5.0
BACKGROUND_STEP, STEP_BY_CLIPPED = 0.2, 0.5
"""Steps from which a point is rejected, as shares of the line's amplitude: of any line, and of one
that is clipped at most of the neighbours, which smaller ones widen instead."""
PULL_PER_STEP = 0.7
"""Sigmas of the line by which a step as high as it moves a clipped one: print beside lines of
strangers' photographs moves them by 0.3 to 0.6 (rms)."""
NEIGHBOUR_SIGMAS = 4.5
"""Another line within this many sigmas pulls the centre."""
SHAPE_HALF = 4
"""Neighbours over which the profile's shape is averaged, and clipped ones are counted."""
LEAST_SKEW = 0.1
"""Smallest third-order part of a profile that counts as leaning."""
SKEW_PX = 0.3
"""The part in px that counts on narrow lines, which few pixels describe."""
MARK_X, MARK_Y, MARK_SIGMA, MARK_WIDTH, MARK_MEAN_WIDTH, MARK_LEAN, MARK_SINE, MARK_PULL = range(8)
MARK_COLUMNS = 8


@compiled()
def is_any_set(mask: Mask, x: int, y: int) -> bool:
    """True where one of the 3 x 3 pixels around a pixel is set, or the nearest in the mask."""
    height, width = mask.shape
    for v in range(y - 1, y + 2):
        for u in range(x - 1, x + 2):
            if mask[min(max(v, 0), height - 1), min(max(u, 0), width - 1)] > 0:
                return True
    return False


@compiled(error_model="numpy")
def place_centres(points: Table, fits: Table, marks: TableOut) -> None:
    """Fitted centre x, y, its sigma along the normal, sigma of the line, and sine of the slant.

    As for `mark_points`; the slant is the angle between the fitted column or row and the normal.
    """
    for i in range(points.shape[0]):
        is_column = int(points[i, 5]) == COLUMN
        across = abs(points[i, 3] if is_column else points[i, 2])
        marks[i, MARK_X] = points[i, 0] if is_column else fits[i, CENTRE]
        marks[i, MARK_Y] = fits[i, CENTRE] if is_column else points[i, 1]
        marks[i, MARK_SIGMA] = math.sqrt(fits[i, VARIANCE]) * across
        marks[i, MARK_WIDTH] = fits[i, SIGMA] * across
        marks[i, MARK_SINE] = math.sqrt(max(1.0 - across * across, 0.0))


@compiled(error_model="numpy")
def mark_points(
    points: Table,
    fits: Table,
    sides: Table,
    side_sigma: Floats,
    neighbour: Table,
    chain: Ints,
    saturated: Mask,
    bits: Ints,
    marks: TableOut,
    flags: IntsOut,
) -> None:
    """Centres of fitted profiles, and what is doubtful about each alone.

    A step of height d beside a line of amplitude A and sigma s moves every method by about s d / A,
    a third-order part ``c m (u^3 - 3 u)`` beside the Gaussian ``m`` by about 0.6 c s.

    ``points``: (N, 6) ridge points, ordered along chains. ``fits``: (N, 9) of `fit_profiles`.
    ``sides``: (N, 2), ``side_sigma``: (N,) background on both sides and sigma of its difference.
    ``neighbour``: (N, 2) distance to other lines. ``chain``: (N,) numbers. ``saturated``: (H, W) 1
    where the laser's channel is; (1, 1) zero if it is nowhere. ``bits``: (5,) that of a
    clipped centre, of a step of the background, of a profile that leans, of a line beside it, and
    of a step that only widens.
    ``marks``: (N, 8) output: fitted centre x, y, sigma along the normal, sigma of the line, its
    mean over the neighbours, how surely the profiles lean there, sine of the slant, and what a step
    beside a clipped line may move it by, px.
    ``flags``: (N,) output, in which the bits are set.
    """
    n = points.shape[0]
    place_centres(points, fits, marks)
    for i in range(n if saturated.size > 1 else 0):
        if is_any_set(saturated, int(np.rint(marks[i, MARK_X])), int(np.rint(marks[i, MARK_Y]))):
            flags[i] |= bits[0]
    first = stop = 0
    for i in range(n):
        if i == stop:
            first = i
            while stop < n and chain[stop] == chain[first]:
                stop += 1
        width = marks[i, MARK_WIDTH]
        lean = norm = mean = 0.0
        n_clipped = 0
        low, high = max(i - SHAPE_HALF, first), min(i + SHAPE_HALF + 1, stop)
        for k in range(low, high):
            lean += fits[k, SKEW]
            norm += fits[k, SKEW_NORM]
            mean += marks[k, MARK_WIDTH]
            n_clipped += 1 if flags[k] & bits[0] else 0
        marks[i, MARK_PULL] = 0.0
        step = abs(sides[i, 1] - sides[i, 0])
        if step > SIGNIFICANT * side_sigma[i]:
            share = step / fits[i, AMPLITUDE]
            is_clipped = 2 * n_clipped > high - low
            if share > (STEP_BY_CLIPPED if is_clipped else BACKGROUND_STEP):
                flags[i] |= bits[1]
            elif is_clipped:
                marks[i, MARK_PULL] = PULL_PER_STEP * share * width
                flags[i] |= bits[4] if share > BACKGROUND_STEP else 0
        norm = max(norm, 1e-12)
        marks[i, MARK_MEAN_WIDTH] = mean / (high - low)
        marks[i, MARK_LEAN] = lean / math.sqrt(norm)
        is_certain = abs(lean) > SIGNIFICANT * math.sqrt(norm)
        if is_certain and abs(lean) > max(LEAST_SKEW, SKEW_PX / width) * norm:
            flags[i] |= bits[2]
        if min(neighbour[i, 0], neighbour[i, 1]) < NEIGHBOUR_SIGMAS * width:
            flags[i] |= bits[3]


FLANKS_PER_LEAN = 1.0
"""Sigmas of the line by which the flanks of a saturated one lie beside the centre, for each unit of
its section's third-order term: what sections leave that are no Gram-Charlier series."""
EDGE_BLUR_PX2 = 1.0
"""Over the line's sigma, what an edge of the ground under the line leaves at its worst place: the
lens blurs what the ground reflects, not the light on it alone. Of a blur of 1 px."""
MOST_PULL = 0.5
"""Of the line's sigma: an edge under a line takes up to half of its light."""


@compiled(error_model="numpy")
def widen_sigmas(
    points: Table,
    section: Floats,
    width: Floats,
    ground: Table,
    on_flanks: Ints,
    pull: Floats,
    sigma: FloatsOut,
) -> None:
    """Add to sigmas what lies beside the centre: of flanks that lean, steps, edges of the ground.

    ``points``: (N, 6) ridge points. ``section``: (4,) as for `fit_profiles`. ``width``: (N,) sigma
    of the line. ``ground``: (N, 2) mean reflectance under the line, and how much it differs there.
    ``on_flanks``: (N,) not 0 where the profile was fitted on its flanks. ``pull``: (N,) of
    `mark_points`. ``sigma``: (N,) of the centre, input and output.
    """
    for i in range(points.shape[0]):
        lean = section[0] if int(points[i, 5]) == COLUMN else section[2]
        by_section = FLANKS_PER_LEAN * abs(lean) * width[i]
        edge = EDGE_BLUR_PX2 / width[i]
        by_edge = min(math.sqrt(by_section * by_section + edge * edge), MOST_PULL * width[i])
        beside = max(by_section if on_flanks[i] != 0 else 0.0, by_edge * ground[i, 1])
        sigma[i] = math.sqrt(sigma[i] * sigma[i] + beside * beside + pull[i] * pull[i])
