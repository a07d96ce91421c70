# SPDX-License-Identifier: Apache-2.0
"""How well a fitted length is known, when the points of an exposure err together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.inspection.results import MeasuredLength
from armscan.records.cloud import PointCloud

MIN_BLOCKS = 4
"""Fewest exposures whose differences say anything about their scatter."""

COARSE_BLOCKS = (12, 6)
"""Consecutive exposures are also taken together in these counts of blocks, as neighbours err alike:
an arm by its posture over a whole stroke, a calibration by the direction from which it looks."""


@dataclass(frozen=True, slots=True, eq=False)
class FitLinearised:
    """A least-squares fit about its optimum.

    Parameters
    ----------
    jacobian
        (N, P) derivative of each point's residual by the parameters.
    directions
        (N, 3) unit vector along which each point's error changes its residual.
    residuals_mm
        (N,) at the optimum.
    length_by_parameters
        (P,) derivative of the length that is asked for.
    """

    jacobian: FloatArray
    directions: FloatArray
    residuals_mm: FloatArray
    length_by_parameters: FloatArray


def measured_length(
    value_mm: float, fit: FitLinearised, cloud: PointCloud, rows: IntArray
) -> MeasuredLength:
    """A length with both of its standard deviations.

    Parameters
    ----------
    value_mm
        The length.
    fit
        What it follows from.
    cloud
        Source of covariances and exposures.
    rows
        (N,) rows in the cloud of the points of the fit.
    """
    numbers = cloud.exposure[rows]
    n = len(np.unique(numbers))
    groups = [exposure_blocks(numbers, n)]
    groups += [exposure_blocks(numbers, most) for most in COARSE_BLOCKS if n >= 2 * most]
    scatter = [_jackknife_mm(fit, block, count) for block, count in groups]
    propagated = [_propagated_mm(fit, cloud, rows, block, count) for block, count in groups]
    return MeasuredLength(value_mm, _largest(scatter), _largest(propagated))


def _largest(sigmas: list[float]) -> float:
    return max((sigma for sigma in sigmas if math.isfinite(sigma)), default=math.nan)


def exposure_blocks(exposure: IntArray, most: int) -> tuple[IntArray, int]:
    """(N,) number of the block of neighbouring exposures that each point is in, and their count."""
    number = np.unique(exposure, return_inverse=True)[1].astype(np.int64)
    n = int(number.max()) + 1 if len(number) else 0
    blocks = min(n, most)
    return (number * blocks // n if n else number), blocks


def influence_along(fit: FitLinearised) -> FloatArray:
    """(N,) derivative of the length by each point's error along its direction, up to one sign."""
    information = fit.jacobian.T @ fit.jacobian
    return np.asarray(fit.jacobian @ np.linalg.solve(information, fit.length_by_parameters))


def _jackknife_mm(fit: FitLinearised, block: IntArray, n_blocks: int) -> float:
    """Delete-a-block jackknife of the length, linearised about the optimum."""
    if n_blocks < MIN_BLOCKS:
        return math.nan
    p = fit.jacobian.shape[1]
    normal = np.zeros((n_blocks, p, p))
    right = np.zeros((n_blocks, p))
    for i in range(p):
        right[:, i] = np.bincount(block, fit.jacobian[:, i] * fit.residuals_mm, n_blocks)
        for j in range(p):
            normal[:, i, j] = np.bincount(block, fit.jacobian[:, i] * fit.jacobian[:, j], n_blocks)
    remaining = normal.sum(axis=0) - normal
    if not np.all(np.linalg.cond(remaining) < 1e12):
        return math.nan
    change = np.linalg.solve(remaining, right[:, :, None])[:, :, 0] @ fit.length_by_parameters
    spread = change - change.mean()
    return float(np.sqrt((n_blocks - 1) / n_blocks * (spread @ spread)))


def _propagated_mm(
    fit: FitLinearised, cloud: PointCloud, rows: IntArray, block: IntArray, n: int
) -> float:
    """Each block is shifted as a whole by an error of its points' mean covariance.

    The stripes' own noise is taken out of that covariance and counted point by point, each with the
    correlation length that neighbours along the stripe share; a cloud that does not tell it is
    taken as independent from point to point. What a length does with a point's error changes
    slowly along a stripe, so that the sum over neighbours' correlations is what counts. NaN for a
    single block: an error of the sensor stretches the one exposure, and a shift cannot tell.
    """
    if n < 2 or not cloud.covariance_mm2[rows].any():
        return math.nan
    covariance, axis, share = without_noise(cloud, rows)
    influence = influence_along(fit)
    by_point = influence[:, None] * fit.directions
    pull = np.stack([np.bincount(block, by_point[:, k], n) for k in range(3)], axis=1)
    count = np.bincount(block, minlength=n)
    noise = cloud.sigma_noise_mm[rows] ** 2
    if cloud.noise_length is not None:
        noise = noise * cloud.noise_length[rows]
    along = share * np.einsum("ni,ni->n", axis, fit.directions) ** 2 + 1.0 - share
    variance = float((influence**2 * along) @ noise)
    for i in range(3):
        for j in range(3):
            mean = np.bincount(block, covariance[:, i, j], n) / count
            variance += float((pull[:, i] * mean) @ pull[:, j])
    return math.sqrt(max(variance, 0.0))


def without_noise(cloud: PointCloud, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Covariances (N, 3, 3) of points less their own noise, as far as a cloud tells.

    It keeps the noise's length, not its direction. The longest axis stands for that: its variance
    is never below the noise's, so that none becomes negative; it is the right one where noise
    prevails, and where it does not the noise matters little. Also returned are that axis (N, 3) and
    the noise's share of the variance along it (N,): how far the axis is to be trusted.
    """
    covariance = cloud.covariance_mm2[rows]
    values, vectors = np.linalg.eigh(covariance)
    axis, noise = vectors[:, :, 2], cloud.sigma_noise_mm[rows]
    own = noise[:, None] * axis
    share = np.clip(noise**2 / np.maximum(values[:, 2], np.finfo(np.float64).tiny), 0.0, 1.0)
    return np.asarray(covariance - own[:, :, None] * own[:, None, :]), axis, share
