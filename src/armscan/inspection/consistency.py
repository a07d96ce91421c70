# SPDX-License-Identifier: Apache-2.0
"""Whether a scan of a standard wants another calibration than the one that made it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.inspection.uncertainty import exposure_blocks
from armscan.inspection.verdict import Check, judge

MAX_BLOCKS = 24
MIN_BLOCKS = 10
LEAST_EFFECT = 0.1
"""A combination of parameters takes part if one standard deviation of it moves the points by this
part of their scatter. Weaker ones would be told from the points' own noise alone: it moves the
derivatives as well."""
CONFIDENCE = 0.9973
"""Probability that a valid calibration passes; 3 standard deviations in one dimension."""


@dataclass(frozen=True, slots=True, eq=False)
class StandardDistances:
    """Distances of scanned points from a standard of known size, and what they depend on.

    Parameters
    ----------
    distance_mm
        (N,) signed.
    by_calibration
        (N, P) derivative by the calibration's parameters, the hand-eye's six last.
    covariance
        (P, P) of these.
    by_place
        (N, Q) derivative by the standard's place, which is not known; Q may be 0.
    by_others
        (N, R) derivative by other independent errors, each times its standard deviation: the
        standard's own, and the arm's, which neighbouring exposures share.
    exposure
        (N,) number of each point's exposure, in order of time.
    scatter_mm
        Root mean square distance of the points from the surface that fits them best.
    """

    distance_mm: FloatArray
    by_calibration: FloatArray
    covariance: FloatArray
    by_place: FloatArray
    by_others: FloatArray
    exposure: IntArray
    scatter_mm: float


def check_consistency(data: StandardDistances) -> Check | None:
    """Estimate the hand-eye's correction from the scan and compare it with its covariance.

    The correction's expected covariance is what the calibration says of itself (an error of the
    sensor counts too, as far as it looks like one of the hand-eye) plus what the scan's scatter
    adds, taken from blocks of neighbouring exposures. The error is the correction's size in units
    of that covariance (Mahalanobis distance).

    Returns
    -------
    Check
        None if there are too few exposures, or if nothing that the calibration leaves open shows
        in this scan.
    """
    scaled = _scaled_hand_eye(data)
    block, n_blocks = exposure_blocks(data.exposure, MAX_BLOCKS)
    if scaled is None or n_blocks < MIN_BLOCKS:
        return None
    place = np.linalg.qr(data.by_place)[0] if data.by_place.shape[1] else data.by_place
    free = scaled - place @ (place.T @ scaled)
    left, size, _ = np.linalg.svd(free, full_matrices=False)
    centred = data.distance_mm - place @ (place.T @ data.distance_mm)
    kept = size > LEAST_EFFECT * data.scatter_mm * math.sqrt(len(centred))
    if not kept.any():
        return None
    estimator = (left[:, kept] / size[kept]).T
    correction = estimator @ data.distance_mm
    remaining = centred - left[:, kept] @ (left[:, kept].T @ centred)
    expected = _expected(data, estimator) + _scatter(estimator, remaining, block, n_blocks)
    square = float(correction @ np.linalg.solve(expected, correction))
    freedom = int(kept.sum())
    error, limit = math.sqrt(max(square, 0.0)), math.sqrt(float(chi2.ppf(CONFIDENCE, freedom)))
    return Check(
        name="hand-eye correction",
        definition="correction of the hand-eye that would fit this scan to the standard best, over "
        "its expected standard deviation (Mahalanobis distance)",
        unit="sigma",
        error=error,
        predicted=math.sqrt(freedom),
        limit=limit,
        limit_rule=f"{100.0 * CONFIDENCE:.2f} % of valid calibrations stay below it, for "
        f"{freedom} parameters that the scan determines",
        uncertainty=0.0,
        uncertainty_rule="none: the scan's scatter is in the expected covariance",
        verdict=judge(error, limit, 0.0),
    )


def _scaled_hand_eye(data: StandardDistances) -> FloatArray | None:
    """(N, 6) derivative by independent errors of the hand-eye of one standard deviation each."""
    values, vectors = np.linalg.eigh(data.covariance[-6:, -6:])
    if not values[-1] > 0.0:
        return None
    # in physical units radians would vanish beside millimetres
    sigma = np.sqrt(np.diag(data.covariance)[-6:])
    unit = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(data.covariance[-6:, -6:] / np.outer(unit, unit))
    factor = unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    scaled = data.by_calibration[:, -6:] @ factor
    return np.asarray(scaled) if scaled.any() else None


def _expected(data: StandardDistances, estimator: FloatArray) -> FloatArray:
    by_calibration = estimator @ data.by_calibration
    by_others = estimator @ data.by_others
    return np.asarray(by_calibration @ data.covariance @ by_calibration.T + by_others @ by_others.T)


def _scatter(
    estimator: FloatArray, remaining: FloatArray, block: IntArray, n_blocks: int
) -> FloatArray:
    """Covariance of the correction from what blocks of exposures leave over (sandwich)."""
    shares = np.stack([np.bincount(block, row * remaining, n_blocks) for row in estimator], axis=1)
    freedom = max(1, n_blocks - estimator.shape[0])
    return np.asarray(shares.T @ shares * n_blocks / freedom)
