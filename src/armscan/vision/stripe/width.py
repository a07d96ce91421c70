# SPDX-License-Identifier: Apache-2.0
"""Typical width of the lines in an image, found before anything else is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from armscan.geometry.arrays import FloatArray
from armscan.kernels.stripe_hessian import gaussian_taps, refine_candidates
from armscan.vision.stripe.chains import strong_median
from armscan.vision.stripe.level import ImageLevel

SCALES_PX = (3.0, 8.0)
RIDGE_POWER = 1.5
"""Of the scale, by which second derivatives of ridges are compared (Lindeberg 1998): lines of sigma
above 5 px are sought at the wider scale."""
SAMPLE = 3000
MEASURED = 300
STRONG_SHARE = 0.4
REACH_PX = 30.0
STEP_PX = 0.5
FWHM_PER_SIGMA = 2.3548
SIGMA_LIMITS_PX = (0.7, 10.0)
FALLBACK_PX = 2.0
ALONG_PX = (-2.0, 0.0, 2.0)
LOPSIDED = 1.8


def find_line_sigma(image: NDArray[np.float32], runs: FloatArray, level: ImageLevel) -> float:
    """Median sigma of the brighter lines from their full width at half height, in px.

    Parameters
    ----------
    image
        (H, W) float32.
    runs
        (N, 3) candidates; a sample of them is measured across the local ridge direction.
    level
        Background and threshold.
    """
    points = _strongest(image, runs)
    if not len(points):
        return FALLBACK_PX
    points = points[:: max(len(points) // MEASURED, 1)]
    profiles = _across(image, points)
    half_widths, heights = _half_widths(profiles)
    bright = heights >= max(STRONG_SHARE * strong_median(heights), level.rise)
    bright &= half_widths < REACH_PX
    if not bright.any():
        return FALLBACK_PX
    fwhm = 2.0 * float(np.median(half_widths[bright]))
    blur = STEP_PX**2 / 3.0
    sigma = np.sqrt(max((fwhm / FWHM_PER_SIGMA) ** 2 - blur, 0.0))
    return float(np.clip(sigma, *SIGMA_LIMITS_PX))


def _strongest(image: NDArray[np.float32], runs: FloatArray) -> FloatArray:
    """(N, 6) ridge points of the stronger lines, at the scale that suits them better.

    A wide line that saturates is flat where a narrow filter looks, and what little is narrow beside
    it would be taken for the line.
    """
    sample = np.ascontiguousarray(runs[:: max(len(runs) // SAMPLE, 1)])
    best, best_strength = np.zeros((0, 6)), 0.0
    for scale in SCALES_PX:
        points = np.zeros((len(sample), 6))
        n = refine_candidates(image, sample, len(sample), gaussian_taps(scale), 0.0, points)
        strength = scale**RIDGE_POWER * strong_median(points[:n, 4])
        if strength > best_strength:
            best, best_strength = points[:n], strength
    return best[best[:, 4] >= STRONG_SHARE * strong_median(best[:, 4])]


def _across(image: NDArray[np.float32], points: FloatArray) -> FloatArray:
    """Profiles (N, K) across the ridges, averaged over a few places along them."""
    t = np.arange(-REACH_PX, REACH_PX + STEP_PX, STEP_PX)
    total = np.zeros((len(points), len(t)))
    for along in ALONG_PX:
        x = points[:, :1] + points[:, 2:3] * t - points[:, 3:4] * along
        y = points[:, 1:2] + points[:, 3:4] * t + points[:, 2:3] * along
        total += map_coordinates(image, [y, x], order=1, mode="nearest")
    return total / len(ALONG_PX)


def _half_widths(profiles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean distance (N,) from the centre to half height, and height (N,).

    The height counts from the higher of the two feet, and is 0 where one side is much wider than
    the other: an edge between two areas is no line.
    """
    middle = profiles.shape[1] // 2
    near = profiles[:, middle - 2 : middle + 3].mean(axis=1)
    foot = np.maximum(profiles[:, :middle].min(axis=1), profiles[:, middle:].min(axis=1))
    height = near - foot
    level = foot + 0.5 * height
    sides = [_first_below(side, level) for side in (profiles[:, middle:], profiles[:, middle::-1])]
    narrow, wide = np.minimum(*sides), np.maximum(*sides)
    is_line = wide < LOPSIDED * narrow + STEP_PX
    return 0.5 * (narrow + wide), np.where(is_line, height, 0.0)


def _first_below(side: FloatArray, level: FloatArray) -> FloatArray:
    """Distance (N,) at which each profile (N, K), read outwards, first falls below its level."""
    rows = np.arange(len(side))
    below = side < level[:, None]
    first = np.where(below.any(axis=1), np.argmax(below, axis=1), side.shape[1] - 1)
    first = np.maximum(first, 1)
    inner, outer = side[rows, first - 1], side[rows, first]
    fraction = np.clip((inner - level) / np.maximum(inner - outer, 1e-6), 0.0, 1.0)
    return np.asarray((first - 1 + fraction) * STEP_PX)
