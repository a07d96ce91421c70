# SPDX-License-Identifier: Apache-2.0
"""Conformity with a stated limit (ISO 14253): decision rule, checks of consistency between
exposures, points off the standard.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree
from scipy.special import chdtri

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.inspection.results import PlaneInspection, SphereInspection
from armscan.inspection.selection import KEPT_BAND_MM
from armscan.inspection.sphere import inspect_sphere
from armscan.inspection.uncertainty import exposure_blocks
from armscan.records.cloud import PointCloud

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
    predicted
        Standard deviation of E that the calibration's covariance predicts.
    limit, limit_rule
        MPE and where it comes from.
    uncertainty, uncertainty_rule
        U and what it holds.
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

    ``sigma_calibration_mm``: standard deviation that the calibration's covariance predicts.
    ``sigma_scan_mm``: standard deviation that the scan adds by its own scatter. ``reference_u_mm``:
    expanded uncertainty (k = 2) of the nominal value. ``mpe_mm``: limit; if None it follows from
    ``sigma_calibration_mm``, so that a calibration that is as good as it says passes.
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
    """Whether arm, clock and images contradict each other, whatever the standard says."""
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
    error, limit = math.sqrt(max(square, 0.0)), math.sqrt(float(chdtri(freedom, 1.0 - CONFIDENCE)))
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


SIDE_RAD = 0.15
"""A point is over the ball's scanned side if a fitted point lies in its direction within this."""
BALL_SHARE = 0.5
"""Points within this part of the ball's radius from its surface ought to lie on it."""
PLATE_MM = 10.0
"""And points within the plate's scanned outline up to so far above or below it."""
OFF_SIGMAS = 5.0
"""An exposure is off if the median distance of those points exceeds this many times what their
covariances predict of it, and the band within which a fit leaves nothing out."""
LIMIT_PERCENT = 5.0
"""Exposures that may be off: dust, a cable before the standard."""


@dataclass(frozen=True, slots=True, eq=False)
class _Near:
    """Points that ought to lie on the standard: rows in the cloud, distances, directions."""

    rows: IntArray
    distance_mm: FloatArray
    outward: FloatArray


def check_exposures_off(
    cloud: PointCloud,
    found: SphereInspection | PlaneInspection,
    within: BoolArray,
) -> Check | None:
    """Count exposures that show the standard somewhere else than the fit has it.

    Parameters
    ----------
    cloud
        All points.
    found
        The fit.
    within
        (N,) points in the region that was asked for.

    Returns
    -------
    Check
        Of the share of exposures that are off, in percent of those that ought to show the standard;
        None if fewer than four do.
    """
    if isinstance(found, SphereInspection):
        name, near = "ball", _near_ball(cloud, found, within)
    else:
        name, near = "plate", _near_plate(cloud, found, within)
    exposure = cloud.exposure[near.rows]
    covariance = cloud.covariance_mm2[near.rows]
    variance = np.einsum("ni,nij,nj->n", near.outward, covariance, near.outward)
    judged, off = set(), set()
    for number in np.unique(exposure).tolist():
        own = exposure == number
        if int(own.sum()) < MIN_EXPOSURE_POINTS:
            continue
        judged.add(number)
        limit = max(KEPT_BAND_MM, OFF_SIGMAS * float(np.sqrt(np.mean(variance[own]))))
        if abs(float(np.median(near.distance_mm[own]))) > limit:
            off.add(number)
    if isinstance(found, SphereInspection):
        elsewhere = _second_ball(cloud, found, within & ~np.isin(cloud.exposure, list(judged)))
        judged, off = judged | elsewhere, off | elsewhere
    if len(judged) < 4:
        return None
    share = 100.0 * len(off) / len(judged)
    return Check(
        name=f"exposures off the {name}",
        definition=f"share of the {len(judged)} exposures with points near the {name}'s scanned "
        "side, of which more than half lie off it, or which show it in another place",
        unit="%",
        error=share,
        predicted=0.0,
        limit=LIMIT_PERCENT,
        limit_rule="something may stand in the way once; a valid scanner shows the standard in one "
        "place",
        uncertainty=0.0,
        uncertainty_rule="none: a count",
        verdict=judge(share, LIMIT_PERCENT, 0.0),
    )


def _near_ball(cloud: PointCloud, found: SphereInspection, within: BoolArray) -> _Near:
    offset = cloud.points_mm - found.sphere.centre_mm
    size = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    outward, distance = offset / size[:, None], size - found.sphere.radius_mm
    rows = np.flatnonzero(within & (np.abs(distance) <= BALL_SHARE * found.sphere.radius_mm))
    side = cKDTree(outward[found.rows[found.is_fitted]])
    apart = side.query(outward[rows], distance_upper_bound=SIDE_RAD)[0]
    rows = rows[np.isfinite(apart)]
    return _Near(rows, distance[rows], outward[rows])


def _near_plate(cloud: PointCloud, found: PlaneInspection, within: BoolArray) -> _Near:
    local = (cloud.points_mm - found.plane.point_mm) @ found.plane.axes.T
    rows = np.flatnonzero(within & (np.abs(local[:, 2]) <= PLATE_MM))
    try:
        fitted = local[found.rows[found.is_fitted], :2]
        outline = Delaunay(fitted[:: max(1, len(fitted) // 20_000)])
    except QhullError:
        rows = rows[:0]
    else:
        rows = rows[outline.find_simplex(local[rows, :2]) >= 0]
    return _Near(rows, local[rows, 2], np.broadcast_to(found.plane.normal, (len(rows), 3)))


def _second_ball(cloud: PointCloud, found: SphereInspection, rest: BoolArray) -> set[int]:
    """Exposures without points near the ball that show another one of its size."""
    rows = np.flatnonzero(rest)
    if len(rows) < 10 * MIN_EXPOSURE_POINTS:
        return set()
    try:
        other = inspect_sphere(cloud.select(rows), found.nominal_diameter_mm)
    except InputError:
        # a speck, which would be taken for a cloud in metres
        return set()
    if isinstance(other, FitFailure):
        return set()
    used = np.zeros(len(rows), dtype=np.bool_)
    used[other.rows[other.is_fitted]] = True
    count = np.bincount(cloud.exposure[rows], used)
    shown = np.flatnonzero(count >= MIN_EXPOSURE_POINTS)
    return set(shown.tolist()) if len(shown) >= 2 else set()
