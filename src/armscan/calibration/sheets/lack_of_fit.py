# SPDX-License-Identifier: Apache-2.0
"""Does the sheet's model explain the stripes? F test against the noise along each stripe, the
scatter between boards, and the outliers of a fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from armscan.calibration.sheets.result import LackOfFit, SheetOptions
from armscan.calibration.sheets.solve import (
    CommonErrors,
    SheetObservations,
    SheetSolution,
    solve_sheets,
    square_root,
)
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.models.light_sheet import LightSheet

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


SHAPES = 3
"""Offset, slope and curvature of a stripe; a board's pose makes the first two."""
LEAST_POINTS = 8
"""With fewer points left of it a stripe has no shape."""
FACTORS = np.geomspace(1.0, 100.0, 81)


@dataclass(frozen=True, slots=True)
class BoardScatter:
    """Likeliest scatter of the boards under a model of the sheet.

    Parameters
    ----------
    factor
        Standard deviations of the boards' poses over what is claimed for them, at least 1.
    log_likelihood
        Of the stripes' shapes at this factor, up to a constant that all models share.
    """

    factor: float
    log_likelihood: float


def board_scatter(
    observations: SheetObservations,
    solution: SheetSolution,
    errors: CommonErrors,
    noise: StripeNoise,
) -> BoardScatter:
    """Estimate by restricted likelihood how much the boards of one sheet scatter.

    Parameters
    ----------
    observations
        Points of one sheet.
    solution
        A model fitted to them, with the cameras free.
    errors
        Claimed covariance of boards and cameras.
    noise
        Of the points along the stripes.
    """
    _, residual, _, by_point = observations.residuals_px(solution.sheets)
    by_pose = np.einsum("ni,nij->nj", by_point, observations.by_pose)
    by_camera = np.einsum("ni,nij->nj", by_point, observations.by_camera)
    moved = solution.common[len(solution.common) - errors.n_camera :]
    residual = residual + by_camera @ (square_root(errors.camera_covariance) @ moved)
    numbers, counts = np.unique(observations.stripe, return_counts=True)
    stripes = numbers[counts >= LEAST_POINTS]
    n = SHAPES * len(stripes)
    lost = np.sqrt(n / max(n - solution.n_parameters, 1.0))
    log_likelihood = np.zeros(len(FACTORS))
    for stripe in stripes:
        own = observations.stripe == stripe
        shape, covariance = _shape(observations.select(own), lost * residual[own], noise)
        root = square_root(errors.pose_covariances[int(observations.board[own][0])])
        follow = shape.gain @ by_pose[own] @ root
        log_likelihood += _log_likelihood(shape.terms, covariance, follow)
    best = int(np.argmax(log_likelihood))
    return BoardScatter(float(FACTORS[best]), float(log_likelihood[best]))


@dataclass(frozen=True, slots=True, eq=False)
class _Shape:
    """(3,) shape terms of a stripe's residuals, and (3, N) how they follow these."""

    terms: FloatArray
    gain: FloatArray


def _shape(
    stripe: SheetObservations, residual_px: FloatArray, noise: StripeNoise
) -> tuple[_Shape, FloatArray]:
    along = (stripe.points_mm - stripe.points_mm[0]) @ (stripe.points_mm[-1] - stripe.points_mm[0])
    t = 2.0 * (along - along.min()) / max(float(np.ptp(along)), 1e-12) - 1.0
    design = np.polynomial.legendre.legvander(t, SHAPES - 1)
    weighted = design / (stripe.sigma_px * noise.sigma_factor)[:, None] ** 2
    covariance = np.asarray(np.linalg.inv(weighted.T @ design), dtype=np.float64)
    gain = covariance @ weighted.T
    return _Shape(gain @ residual_px, gain), covariance


def _log_likelihood(terms: FloatArray, noise: FloatArray, follow: FloatArray) -> FloatArray:
    """Of one stripe's shape for every factor of the boards' scatter."""
    total = noise + FACTORS[:, None, None] ** 2 * (follow @ follow.T)
    _, log_determinant = np.linalg.slogdet(total)
    solved = np.linalg.solve(total, np.broadcast_to(terms[:, None], (len(FACTORS), len(terms), 1)))
    return np.asarray(-0.5 * (log_determinant + solved[:, :, 0] @ terms))


MIN_BOARDS = 4
"""With fewer, two boards are left of which each explains the other."""


def find_outlier_view(
    observations: SheetObservations,
    sheet: LightSheet,
    errors: CommonErrors,
    options: SheetOptions,
) -> int | None:
    """Number of an image without whose board a plane explains all others, or None.

    Parameters
    ----------
    observations
        Points of one sheet that a plane does not explain.
    sheet
        Where the fits start.
    errors
        Covariance of boards and camera.
    options
        For the limit of the lack-of-fit test.
    """
    alone = observations.as_one_sheet()
    boards = np.unique(alone.board)
    if len(boards) < MIN_BOARDS:
        return None
    noise = stripe_noise(alone, alone.residuals_px([sheet])[1])
    whole = solve_sheets(alone, [sheet], errors, [False], sigma_factor=noise.sigma_factor)
    if isinstance(whole, FitFailure):
        return None
    p_values = [_probability_without(int(board), alone, whole, noise) for board in boards]
    best = int(np.argmax(p_values))
    if p_values[best] < options.lack_of_fit_p:
        return None
    return int(alone.image[alone.board == boards[best]][0])


def _probability_without(
    board: int, observations: SheetObservations, whole: SheetSolution, noise: StripeNoise
) -> float:
    """Of the lack of fit of all other boards, by one step from the plane of all."""
    linear = whole.linear
    normal = linear.system.solve(linear.weight, 0, without_board=board)
    if normal is None:
        return 0.0
    rest = observations.board != board
    remaining = (linear.system.residual_px + linear.system.times(normal.step))[rest]
    common = normal.step[normal.n_sheet :]
    chi2 = float((linear.weight[rest] * remaining**2).sum() + common @ common)
    share = replace(noise, degrees_of_freedom=noise.degrees_of_freedom * float(rest.mean()))
    return lack_of_fit(observations.select(rest), replace(whole, chi2=chi2), share).p_value
