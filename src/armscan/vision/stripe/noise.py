# SPDX-License-Identifier: Apache-2.0
"""The noise model of a stripe's pixels, estimated from the residuals of profile fits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.kernels.stripe_fit import AMPLITUDE, CENTRE, REACH_SIGMAS, SIDE_SPAN, SIGMA, VARIANCE

START_CONTRAST2 = 0.03
START_PER_GAIN = 0.1
BIN_EDGES = np.array([0.0, 0.01, 0.03, 0.07, 0.13, 0.22, 0.33, 0.46, 0.6, 0.75, 0.9, 1.2])
LEAST_PER_BIN = 30
LEAST_VARIANCE = 0.02
MAD_TO_SIGMA = 1.4826
FIT_PARAMETERS = 3.0


def start_noise(background_noise: float) -> FloatArray:
    """A first guess (3,) of ``C^2``, ``1 / gain``, ``read^2`` from the background's noise."""
    return np.array([START_CONTRAST2, START_PER_GAIN, max(background_noise**2, LEAST_VARIANCE)])


def estimate_noise(
    image: NDArray[np.float32],
    points: FloatArray,
    sides: FloatArray,
    fits: FloatArray,
    fallback: FloatArray,
) -> FloatArray:
    """Fit ``v = C^2 m^2 + (m + background) / gain + read^2`` to squared residuals.

    The residuals are binned by the line's own grey level ``m``; each bin gives a robust variance,
    and non-negative least squares gives the three terms.

    Parameters
    ----------
    image
        (H, W) float32.
    points
        (N, 6) ridge points.
    sides
        (N, 2) background on both sides.
    fits
        (N, 8) from the profile fit with any sensible weights.
    fallback
        (3,) what to return if there are too few residuals.
    """
    good = fits[:, VARIANCE] > 0.0
    if good.sum() < LEAST_PER_BIN:
        return fallback
    level, total, residual = _residuals(image, points[good], sides[good], fits[good])
    peak = float(np.quantile(fits[good, AMPLITUDE], 0.9))
    bins = np.digitize(level / peak, BIN_EDGES)
    rows, variances, counts = [], [], []
    for b in range(1, len(BIN_EDGES)):
        inside = bins == b
        if inside.sum() < LEAST_PER_BIN:
            continue
        m = level[inside]
        rows.append([np.mean(m * m), np.mean(np.maximum(total[inside], 0.0)), 1.0])
        typical = float(np.median(np.abs(residual[inside]))) * MAD_TO_SIGMA
        clipped = np.minimum(residual[inside] ** 2, (3.5 * typical) ** 2)
        variances.append(max(float(clipped.mean()), LEAST_VARIANCE))
        counts.append(inside.sum())
    if len(rows) < 4:
        return fallback
    variance = np.array(variances)
    weight = np.sqrt(np.array(counts)) / variance
    terms, _ = nnls(np.array(rows) * weight[:, None], variance * weight)
    terms[2] = max(terms[2], LEAST_VARIANCE)
    return np.asarray(terms)


def _residuals(
    image: NDArray[np.float32], points: FloatArray, sides: FloatArray, fits: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Model level, model plus background, and residual of every pixel of the fitted profiles."""
    height, width = image.shape
    is_column = points[:, 5] == 0
    line = np.where(is_column, points[:, 0], points[:, 1]).astype(np.int64)
    start = np.where(is_column, points[:, 1], points[:, 0])
    sigma = fits[:, SIGMA]
    reach = int(np.ceil(np.quantile(sigma, 0.9) * SIDE_SPAN / 2.0))
    k: IntArray = np.rint(start).astype(np.int64)[:, None] + np.arange(-reach, reach + 1)
    size = np.asarray(np.where(is_column, height, width)).reshape(-1, 1)
    safe = np.clip(k, 0, size - 1)
    y = np.where(is_column[:, None], safe, line[:, None])
    x = np.where(is_column[:, None], line[:, None], safe)
    u = (k - fits[:, CENTRE][:, None]) / sigma[:, None]
    model = fits[:, AMPLITUDE][:, None] * np.exp(-0.5 * u * u)
    ramp = (sides[:, 1] - sides[:, 0]) / (SIDE_SPAN * sigma)
    background = sides.mean(axis=1)[:, None] + ramp[:, None] * (k - start[:, None])
    residual = image[y, x] - background - model
    pixels = (np.abs(u) < REACH_SIGMAS) & (k == safe)
    n = pixels.sum(axis=1, keepdims=True)
    freedom = np.sqrt(n / np.maximum(n - FIT_PARAMETERS, 1.0))
    is_side = (np.abs(u) > 3.4) & (np.abs(u) < 4.2) & (k == safe)
    residual = np.where(pixels, residual * freedom, residual)
    use = pixels | is_side
    return model[use], (model + background)[use], residual[use]
