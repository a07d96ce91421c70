# SPDX-License-Identifier: Apache-2.0
"""Noise along the stripes, and whether a sheet's model explains the stripes' shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from armscan.calibration.laser.observations import SheetObservations
from armscan.calibration.laser.result import LackOfFit
from armscan.calibration.laser.solve import SheetSolution
from armscan.geometry.arrays import FloatArray

SHAPE_DEGREE = 3
N_SHAPE = SHAPE_DEGREE + 1
MAX_LAG = 100
CORRELATION_ROUNDS = 20
MAX_TAKEN = 0.5
"""Largest share of the noise that the cubic is believed to take."""


@dataclass(frozen=True, slots=True)
class StripeNoise:
    """Scatter of the points around a smooth course of each stripe.

    Parameters
    ----------
    factor
        Standard deviation over what the stripes' sigmas claim.
    correlation_points
        Variance of a mean over that of independent points: 1 + 2 sum of the correlations.
    degrees_of_freedom
        Of ``factor``, counted in points: each shape term of a stripe takes the noise of as many
        points as count as one.
    """

    factor: float
    correlation_points: float
    degrees_of_freedom: float

    @property
    def sigma_factor(self) -> float:
        """By which a sigma must be multiplied so that points count as independent."""
        return self.factor * float(np.sqrt(self.correlation_points))

    @property
    def effective_freedom(self) -> float:
        """Degrees of freedom counted in independent points."""
        return self.degrees_of_freedom / self.correlation_points


def stripe_noise(observations: SheetObservations, residual_px: FloatArray) -> StripeNoise:
    """Estimate the noise of the stripes from their scatter around a cubic course.

    Parameters
    ----------
    observations
        The points, ordered along each stripe.
    residual_px
        (N,) residuals from the sheets; a smooth misfit does not matter.
    """
    rest = [
        _off_course(observations.select(own), residual_px[own])
        for own in (observations.stripe == stripe for stripe in np.unique(observations.stripe))
    ]
    squares = sum(float(left @ left) for left in rest)
    correlation = _correlation(rest)
    count = sum(len(left) for left in rest)
    freedom = max(count - N_SHAPE * len(rest) * correlation, 1.0)
    return StripeNoise(float(np.sqrt(squares / freedom)), correlation, freedom)


def scatter_by_stripe(observations: SheetObservations, residual_px: FloatArray) -> FloatArray:
    """(N,) scatter of each point's stripe over what its sigmas claim, by the median.

    The stripes of one calibration lie on boards of different brightness and slant, and their
    claims may be wrong by different factors. A stripe that claims too little would outweigh all
    others.
    """
    factor = np.ones(len(observations))
    for stripe in np.unique(observations.stripe):
        own = observations.stripe == stripe
        left = _off_course(observations.select(own), residual_px[own])
        factor[own] = 1.4826 * float(np.median(np.abs(left)))
    return np.where(factor > 0.0, factor, 1.0)


def _off_course(stripe: SheetObservations, residual_px: FloatArray) -> FloatArray:
    """What one stripe's residuals leave of a cubic course, in the points' own sigmas."""
    along = (stripe.points_mm - stripe.points_mm[0]) @ (stripe.points_mm[-1] - stripe.points_mm[0])
    t = 2.0 * (along - along.min()) / max(float(np.ptp(along)), 1e-12) - 1.0
    design = np.polynomial.legendre.legvander(t, SHAPE_DEGREE) / stripe.sigma_px[:, None]
    normalised = residual_px / stripe.sigma_px
    left = normalised - design @ np.linalg.lstsq(design, normalised, rcond=None)[0]
    return np.asarray(left)


def _correlation(rest: list[FloatArray]) -> float:
    """Sum the correlations over the lags until they drown in their own noise.

    The cubic takes a share of the noise with it, which lowers every correlation by about that
    share; it depends on the sum itself, hence the rounds.
    """
    count = sum(len(left) for left in rest)
    lags = _lag_correlations(rest)
    correlation = 1.0
    for _ in range(CORRELATION_ROUNDS if len(lags) else 0):
        taken = min(N_SHAPE * len(rest) * correlation / count, MAX_TAKEN)
        correlation = 1.0 + 2.0 * float((lags * (1.0 - taken) + taken).sum())
    return min(correlation, MAX_TAKEN * count / (N_SHAPE * len(rest)))


def _lag_correlations(rest: list[FloatArray]) -> FloatArray:
    power = sum(float(left @ left) for left in rest) / sum(len(left) for left in rest)
    found: list[float] = []
    for lag in range(1, MAX_LAG + 1):
        pairs = [(left[:-lag], left[lag:]) for left in rest if len(left) > 4 * lag]
        count = sum(len(a) for a, _ in pairs)
        if count == 0 or power == 0.0:
            break
        rho = sum(float(a @ b) for a, b in pairs) / count / power
        if rho < 2.5 / np.sqrt(count):
            break
        found.append(rho)
    return np.array(found)


def lack_of_fit(
    observations: SheetObservations,
    solution: SheetSolution,
    noise: StripeNoise,
    sigma_factor: float | None = None,
) -> LackOfFit:
    """Test a solution that was weighted with ``noise.sigma_factor``, or with a larger one.

    Of each stripe the first four shape terms (offset, slope, curvature, twist) are compared with
    the model; what scatters around them is the noise. Board and camera errors are free within
    their covariance, and cost what that covariance says.
    """
    n_stripes = len(np.unique(observations.stripe))
    freedom = N_SHAPE * n_stripes - solution.n_parameters
    if freedom <= 0:
        return LackOfFit(0.0, 0, 1.0)
    share = (noise.sigma_factor / (sigma_factor or noise.sigma_factor)) ** 2
    squares = max(solution.chi2 - noise.effective_freedom * share, 0.0)
    ratio = squares / freedom
    p_value = float(stats.f.sf(ratio, freedom, max(noise.effective_freedom, 1.0)))
    return LackOfFit(ratio, freedom, p_value)
