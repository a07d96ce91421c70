# SPDX-License-Identifier: Apache-2.0
"""Typical width of the lines in an image, found before anything else is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from armscan.geometry.arrays import FloatArray
from armscan.kernels.stripe_hessian import gaussian_taps, refine_candidates
from armscan.vision.stripe.level import ImageLevel

SCALE_PX = 3.0
SAMPLE = 400
REACH_PX = 30.0
STEP_PX = 0.5
FWHM_PER_SIGMA = 2.3548
SIGMA_LIMITS_PX = (0.7, 10.0)
FALLBACK_PX = 2.0
ALONG_PX = (-3.0, 0.0, 3.0)


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
    sample = np.ascontiguousarray(runs[:: max(len(runs) // SAMPLE, 1)])
    points = np.zeros((len(sample), 6))
    n = refine_candidates(image, sample, len(sample), gaussian_taps(SCALE_PX), 0.0, points)
    if n == 0:
        return FALLBACK_PX
    points = points[:n]
    profiles = _across(image, points)
    half_widths, heights = _half_widths(profiles)
    bright = heights >= max(0.5 * float(np.quantile(heights, 0.8)), level.rise)
    bright &= half_widths < REACH_PX
    if not bright.any():
        return FALLBACK_PX
    fwhm = 2.0 * float(np.median(half_widths[bright]))
    blur = STEP_PX**2 / 3.0
    sigma = np.sqrt(max((fwhm / FWHM_PER_SIGMA) ** 2 - blur, 0.0))
    return float(np.clip(sigma, *SIGMA_LIMITS_PX))


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
    """Distance (N,) from the centre to half height, mean of both sides, and height (N,)."""
    middle = profiles.shape[1] // 2
    near = profiles[:, middle - 2 : middle + 3].mean(axis=1)
    lowest = np.minimum(profiles[:, :middle].min(axis=1), profiles[:, middle:].min(axis=1))
    height = near - lowest
    level = lowest + 0.5 * height
    widths = np.zeros(len(profiles))
    rows = np.arange(len(profiles))
    for side in (profiles[:, middle:], profiles[:, middle::-1]):
        below = side < level[:, None]
        first = np.where(below.any(axis=1), np.argmax(below, axis=1), side.shape[1] - 1)
        first = np.maximum(first, 1)
        inner, outer = side[rows, first - 1], side[rows, first]
        fraction = np.clip((inner - level) / np.maximum(inner - outer, 1e-6), 0.0, 1.0)
        widths += 0.5 * (first - 1 + fraction) * STEP_PX
    return widths, height
