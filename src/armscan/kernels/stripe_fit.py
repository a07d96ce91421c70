# SPDX-License-Identifier: Apache-2.0
"""Noise-weighted fit of a Gaussian profile (eq. 2.40) to one column or row per point."""

from __future__ import annotations

import math

from numba import njit, types

from armscan.kernels.arrays import (
    COLUMN,
    FLOATS_IN,
    IMAGE_IN,
    MASK_IN,
    TABLE_IN,
    TABLE_OUT,
    Float32Array,
    Float64Array,
    MaskArray,
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
"""Columns of a fit result."""


@njit(types.void(IMAGE_IN, TABLE_IN, FLOATS_IN, TABLE_OUT), cache=True, nogil=True)
def read_sides(
    image: Float32Array, points: Float64Array, sigma_px: Float64Array, sides: Float64Array
) -> None:
    """Mean grey level beside the line, on the side of smaller and of larger coordinate.

    Parameters
    ----------
    image
        (H, W) grey levels.
    points
        (N, 6) from `refine_candidates`.
    sigma_px
        (N,) line sigma along the point's column or row.
    sides
        (N, 4) output: mean and pixel count of the lower side, then of the upper side; a side that
        lies outside the image has count 0.
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


@njit(
    types.void(IMAGE_IN, MASK_IN, TABLE_IN, FLOATS_IN, TABLE_IN, FLOATS_IN, FLOATS_IN, TABLE_OUT),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def fit_profiles(
    image: Float32Array,
    clipped: MaskArray,
    points: Float64Array,
    sigma_px: Float64Array,
    sides: Float64Array,
    noise: Float64Array,
    reach: Float64Array,
    result: Float64Array,
) -> None:
    """Fit centre, amplitude and width by Gauss-Newton steps with weights from the noise model.

    The variance of a pixel is ``C^2 m^2 + (m + background) / gain + read^2`` with ``m`` the line's
    own grey level. Clipped pixels are left out and the window grows by their width, so that a
    saturated line is fitted on its flanks.

    Parameters
    ----------
    image, points
        As for `read_sides`.
    clipped
        (H, W) 1 where a pixel is saturated; (1, 1) if none is.
    sigma_px
        (N,) start value of the sigma along the column or row.
    sides
        (N, 2) background on the lower and upper side; interpolated linearly across the line.
    noise
        (3,) ``C^2``, ``1 / gain``, ``read^2``.
    reach
        (N,) half width of the fitted window in sigmas.
    result
        (N, 8) output: centre, amplitude, sigma, variance of the centre (0: the fit failed), skew
        score, its norm, count of clipped pixels, and by how much a term ``u^3`` in the profile's
        exponent moves the centre, in sigmas (for the correction on bent lines).
    """
    height, width = image.shape
    has_clipped = clipped.shape[0] == height and clipped.shape[1] == width
    for i in range(points.shape[0]):
        is_column = int(points[i, 5]) == COLUMN
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
        middle = 0.5 * (sides[i, 0] + sides[i, 1])
        ramp = (sides[i, 1] - sides[i, 0]) / (SIDE_SPAN * sigma_px[i])
        centre = start
        sigma = sigma_px[i]
        top = 0.0
        norm = 0.0
        for k in range(first, last + 1):
            if has_clipped and (clipped[k, line] if is_column else clipped[line, k]):
                continue
            u = (k - centre) / sigma
            g = math.exp(-0.5 * u * u)
            value = image[k, line] if is_column else image[line, k]
            top += g * (value - middle - ramp * (k - start))
            norm += g * g
        amplitude = top / norm if norm > 0.0 else 0.0
        result[i, VARIANCE] = 0.0
        result[i, CLIPPED] = n_clipped
        if amplitude <= 0.0 or last - first + 1 - n_clipped < LEAST_PIXELS:
            continue
        is_done = False
        for round_ in range(ITERATIONS):
            h00 = h01 = h02 = h11 = h12 = h22 = 0.0
            b0 = b1 = b2 = 0.0
            q_residual = q_norm = q_centre = cubic = 0.0
            # m(k + 1) = m(k) ratio(k) and ratio(k + 1) = ratio(k) change: no exponential per pixel
            step = 1.0 / sigma
            u = (first - 1 - centre) * step
            m = amplitude * math.exp(-0.5 * u * u)
            ratio = math.exp(-(u + 0.5 * step) * step)
            change = math.exp(-step * step)
            for k in range(first, last + 1):
                u += step
                m *= ratio
                ratio *= change
                if has_clipped and (clipped[k, line] if is_column else clipped[line, k]):
                    continue
                value = image[k, line] if is_column else image[line, k]
                background = middle + ramp * (k - start)
                variance = noise[0] * m * m + noise[1] * max(m + background, 0.0) + noise[2]
                w = 1.0 / variance
                r = value - background - m
                j0 = m * u * step
                j2 = m * u * u
                q = m * u * (u * u - 3.0)
                h00 += w * j0 * j0
                h01 += w * j0 * m
                h02 += w * j0 * j2
                h11 += w * m * m
                h12 += w * m * j2
                h22 += w * j2 * j2
                b0 += w * r * j0
                b1 += w * r * m
                b2 += w * r * j2
                q_residual += w * r * q
                q_norm += w * q * q
                q_centre += w * q * j0
                cubic += w * j0 * m * u * u * u
            c00 = h11 * h22 - h12 * h12
            c01 = h02 * h12 - h01 * h22
            c02 = h01 * h12 - h02 * h11
            determinant = h00 * c00 + h01 * c01 + h02 * c02
            if not determinant > 0.0:
                break
            c11 = h00 * h22 - h02 * h02
            c12 = h01 * h02 - h00 * h12
            c22 = h00 * h11 - h01 * h01
            if is_done or round_ == ITERATIONS - 1:
                result[i, CENTRE] = centre
                result[i, AMPLITUDE] = amplitude
                result[i, SIGMA] = sigma
                result[i, VARIANCE] = c00 / determinant
                result[i, SKEW] = q_residual - q_centre / h00 * b0
                result[i, SKEW_NORM] = max(q_norm - q_centre * q_centre / h00, 0.0)
                result[i, BEND_GAIN] = cubic / (h00 * sigma)
                break
            d0 = (c00 * b0 + c01 * b1 + c02 * b2) / determinant
            d1 = (c01 * b0 + c11 * b1 + c12 * b2) / determinant
            d2 = (c02 * b0 + c12 * b1 + c22 * b2) / determinant
            centre += min(max(d0, -0.5 * sigma), 0.5 * sigma)
            amplitude *= math.exp(min(max(d1, -0.5), 0.5))
            sigma *= math.exp(min(max(d2, -0.25), 0.25))
            if not (abs(centre - start) < 2.0 * sigma_px[i] + 1.0) or not (
                0.4 * sigma_px[i] < sigma < 2.5 * sigma_px[i] + 0.5
            ):
                break
            is_done = abs(d0) < 2e-3 * sigma and abs(d2) < 0.02
