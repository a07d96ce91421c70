# SPDX-License-Identifier: Apache-2.0
"""Whether a measured error is within its limit, when the error itself is uncertain."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, IntArray

Verdict = Literal["still valid", "not valid", "inconclusive"]

COVERAGE = 2.0
"""Expanded uncertainty over standard uncertainty, k of about 95 %."""

LIMIT_SIGMAS = 3.0
"""Default limit over the standard deviation that the calibration predicts."""

MIN_EXPOSURE_POINTS = 20
MIN_EXPOSURES = 4

RULE = (
    "passed if |E| is at most MPE - U, failed if |E| is above MPE + U, else inconclusive; E is the "
    "error, MPE its limit and U the expanded uncertainty (k = 2) of the test itself"
)


@dataclass(frozen=True, slots=True)
class Check:
    """One error against its limit.

    Parameters
    ----------
    name, definition
        What was tested, in a few words and exactly.
    unit
        Of the numbers: mm, or sigma.
    error
        E.
    predicted
        Standard deviation of E that the calibration's covariance predicts.
    limit, limit_rule
        MPE and where it comes from.
    uncertainty, uncertainty_rule
        U and what it holds.
    verdict
        By `RULE`.
    """

    name: str
    definition: str
    unit: str
    error: float
    predicted: float
    limit: float
    limit_rule: str
    uncertainty: float
    uncertainty_rule: str
    verdict: Verdict


def judge(error: float, limit: float, uncertainty: float) -> Verdict:
    """Apply `RULE`; what is not known is inconclusive."""
    if not (math.isfinite(error) and math.isfinite(limit) and math.isfinite(uncertainty)):
        return "inconclusive"
    if abs(error) <= limit - uncertainty:
        return "still valid"
    return "not valid" if abs(error) > limit + uncertainty else "inconclusive"


def worst(verdicts: tuple[Verdict, ...]) -> Verdict:
    """One failure fails all; without any, one open question leaves all open."""
    order: tuple[Verdict, ...] = ("not valid", "inconclusive", "still valid")
    return next(verdict for verdict in order if verdict in verdicts)


def check_size(
    name: str,
    definition: str,
    error_mm: float,
    sigma_calibration_mm: float,
    sigma_scan_mm: float,
    *,
    reference_u_mm: float = 0.0,
    mpe_mm: float | None = None,
) -> Check:
    """Check a size or a place.

    Parameters
    ----------
    name, definition
        What it is.
    error_mm
        Measured minus nominal.
    sigma_calibration_mm
        Standard deviation that the calibration's covariance predicts.
    sigma_scan_mm
        Standard deviation that the scan adds by its own scatter.
    reference_u_mm
        Expanded uncertainty (k = 2) of the nominal value.
    mpe_mm
        Limit; if None it follows from ``sigma_calibration_mm``, so that a calibration that is as
        good as it says passes.
    """
    if mpe_mm is not None and not mpe_mm > 0.0:
        raise InputError(f"a limit of {mpe_mm} mm", remedy="give a positive --mpe")
    u = math.hypot(reference_u_mm, COVERAGE * sigma_scan_mm)
    if mpe_mm is None:
        limit = LIMIT_SIGMAS * sigma_calibration_mm + u
        rule = f"{LIMIT_SIGMAS:g} standard deviations that the calibration predicts, plus U"
    else:
        limit, rule = mpe_mm, "given"
    return Check(
        name=name,
        definition=definition,
        unit="mm",
        error=error_mm,
        predicted=sigma_calibration_mm,
        limit=limit,
        limit_rule=rule,
        uncertainty=u,
        uncertainty_rule="the reference's expanded uncertainty and twice the standard deviation "
        "that this scan's own scatter causes",
        verdict=judge(error_mm, limit, u),
    )


def check_contradictions(found: tuple[str, ...]) -> Check:
    """Whether arm, clock and images contradict each other, whatever the standard says.

    Parameters
    ----------
    found
        Each contradiction in words.
    """
    return Check(
        name="contradictions",
        definition="places at which the arm's track, the clock or passes of this scan contradict "
        "each other" + (": " + "; ".join(found) if found else ""),
        unit="",
        error=float(len(found)),
        predicted=0.0,
        limit=0.0,
        limit_rule="none may be there: the calibration may be right, but the measurement is not",
        uncertainty=0.0,
        uncertainty_rule="none: a count",
        verdict=judge(float(len(found)), 0.0, 0.0),
    )


def check_spread(
    residuals_mm: FloatArray, variance_mm2: FloatArray, exposure: IntArray
) -> Check | None:
    """Whether exposures disagree more than the points' covariances let them.

    A hand-eye that has moved puts exposures from different sides at different places, often
    without changing a ball's fitted diameter.

    Parameters
    ----------
    residuals_mm
        (N,) distances from the fitted surface.
    variance_mm2
        (N,) predicted variance of each along that distance.
    exposure
        (N,) number of its exposure.

    Returns
    -------
    Check
        Of the root mean square of the exposures' mean residuals, or None for too few exposures.
    """
    number = np.unique(exposure, return_inverse=True)[1]
    count = np.bincount(number)
    enough = count >= MIN_EXPOSURE_POINTS
    if int(enough.sum()) < MIN_EXPOSURES:
        return None
    mean = (np.bincount(number, residuals_mm) / count)[enough]
    variance = (np.bincount(number, variance_mm2) / count)[enough]
    error, predicted = float(np.sqrt(np.mean(mean**2))), float(np.sqrt(variance.mean()))
    limit = LIMIT_SIGMAS * predicted
    return Check(
        name="disagreement of exposures",
        definition="root mean square, over exposures, of the mean distance of their points from "
        "the fitted surface",
        unit="mm",
        error=error,
        predicted=predicted,
        limit=limit,
        limit_rule=f"{LIMIT_SIGMAS:g} standard deviations that the points' covariances predict",
        uncertainty=0.0,
        uncertainty_rule="none: no nominal value takes part",
        verdict=judge(error, limit, 0.0),
    )
