# SPDX-License-Identifier: Apache-2.0
"""Does the sheet's model explain the stripes? F test against the noise along each stripe, the
scatter between boards, and the view without which a plane would do.

A board that is bent, or a lens that the camera's model does not follow, moves a board's stripe as a
whole: more than the covariance of its pose allows, and differently on every board. A bow of the
sheet moves them all by one law, and curves them. The likelihood of both readings tells them apart;
against the noise along the stripes alone, either would look certain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from armscan.calibration.sheets.result import LACK_OF_FIT_P
from armscan.calibration.sheets.solve import (
    CommonErrors,
    SheetObservations,
    SheetSolution,
    solve_sheets,
    square_matrix_root,
)
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import robust_sigma
from armscan.models.calibration import FTest
from armscan.models.light_sheet import LightSheet

SHAPE_DEGREE = 3
N_SHAPE = SHAPE_DEGREE + 1
MAX_LAG = 100
CORRELATION_ROUNDS = 20
MAX_TAKEN = 0.5
"""Largest share of the noise that the cubic is believed to take."""
BOARD_SHAPES = 3
"""Offset, slope and curvature of a stripe; a board's pose makes the first two."""
LEAST_POINTS = 8
"""With fewer points left of it a stripe has no shape."""
FACTORS = np.geomspace(1.0, 100.0, 81)
"""Scatter of the boards that is tried, in steps of 6 %."""
FEWEST_BOARDS = 4
"""For an outlier among them: with fewer, two are left of which each explains the other."""


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

    ``residual_px`` (N,) are residuals from the sheets; a smooth misfit does not matter.
    """
    rest = [
        _off_course(observations.select(of), residual_px[of]) for of in observations.each_stripe()
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
    for of in observations.each_stripe():
        factor[of] = robust_sigma(_off_course(observations.select(of), residual_px[of]))
    return np.where(factor > 0.0, factor, 1.0)


def _course(stripe: SheetObservations, degree: int) -> FloatArray:
    """(N, degree + 1) Legendre polynomials along one stripe."""
    along = (stripe.points_mm - stripe.points_mm[0]) @ (stripe.points_mm[-1] - stripe.points_mm[0])
    t = 2.0 * (along - along.min()) / max(float(np.ptp(along)), 1e-12) - 1.0
    return np.asarray(np.polynomial.legendre.legvander(t, degree))


def _off_course(stripe: SheetObservations, residual_px: FloatArray) -> FloatArray:
    """What one stripe's residuals leave of a cubic course, in the points' own sigmas."""
    design = _course(stripe, SHAPE_DEGREE) / stripe.sigma_px[:, None]
    normalised = residual_px / stripe.sigma_px
    return np.asarray(normalised - design @ np.linalg.lstsq(design, normalised, rcond=None)[0])


def _correlation(rest: list[FloatArray]) -> float:
    """Sum the correlations over the lags until they drown in their own noise.

    The cubic takes a share of the noise with it, which lowers every correlation by about that
    share; it depends on the sum itself, hence the rounds.
    """
    count = sum(len(left) for left in rest)
    power = sum(float(left @ left) for left in rest) / count
    lags: list[float] = []
    for lag in range(1, MAX_LAG + 1):
        pairs = [(left[:-lag], left[lag:]) for left in rest if len(left) > 4 * lag]
        n_pairs = sum(len(a) for a, _ in pairs)
        if n_pairs == 0 or power == 0.0:
            break
        rho = sum(float(a @ b) for a, b in pairs) / n_pairs / power
        if rho < 2.5 / np.sqrt(n_pairs):
            break
        lags.append(rho)
    correlation = 1.0
    for _ in range(CORRELATION_ROUNDS if lags else 0):
        taken = min(N_SHAPE * len(rest) * correlation / count, MAX_TAKEN)
        correlation = 1.0 + 2.0 * float((np.array(lags) * (1.0 - taken) + taken).sum())
    return min(correlation, MAX_TAKEN * count / (N_SHAPE * len(rest)))


def lack_of_fit(
    chi2: float,
    n_stripes: int,
    n_parameters: int,
    noise: StripeNoise,
    sigma_factor: float | None = None,
) -> FTest:
    """Test a solution that was weighted with ``noise.sigma_factor``, or with a larger one.

    Of each stripe the first four shape terms (offset, slope, curvature, twist) are compared with
    the model; what scatters around them is the noise. Board and camera errors are free within
    their covariance, and cost what that covariance says.
    """
    freedom = N_SHAPE * n_stripes - n_parameters
    if freedom <= 0:
        return FTest(f_ratio=0.0, degrees_of_freedom=0, p_value=1.0)
    share = (noise.sigma_factor / (sigma_factor or noise.sigma_factor)) ** 2
    ratio = max(chi2 - noise.effective_freedom * share, 0.0) / freedom
    p_value = float(stats.f.sf(ratio, freedom, max(noise.effective_freedom, 1.0)))
    return FTest(f_ratio=ratio, degrees_of_freedom=freedom, p_value=p_value)


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
    by_pose = np.einsum("ni,nij->nj", by_point, observations.dpoint_dpose)
    by_camera = np.einsum("ni,nij->nj", by_point, observations.dpoint_dcamera)
    moved = solution.common[len(solution.common) - errors.n_camera :]
    residual = residual + by_camera @ (square_matrix_root(errors.camera_covariance) @ moved)
    stripes = [of for of in observations.each_stripe() if of.sum() >= LEAST_POINTS]
    n = BOARD_SHAPES * len(stripes)
    lost = np.sqrt(n / max(n - solution.n_parameters, 1.0))
    log_likelihood = np.zeros(len(FACTORS))
    for of in stripes:
        stripe = observations.select(of)
        design = _course(stripe, BOARD_SHAPES - 1)
        weighted = design / (stripe.sigma_px * noise.sigma_factor)[:, None] ** 2
        covariance = np.asarray(np.linalg.inv(weighted.T @ design), dtype=np.float64)
        gain = covariance @ weighted.T
        root = square_matrix_root(errors.pose_covariances[int(stripe.board[0])])
        log_likelihood += _log_likelihood(
            gain @ (lost * residual[of]), covariance, gain @ by_pose[of] @ root
        )
    best = int(np.argmax(log_likelihood))
    return BoardScatter(float(FACTORS[best]), float(log_likelihood[best]))


def _log_likelihood(terms: FloatArray, noise: FloatArray, follow: FloatArray) -> FloatArray:
    """Of one stripe's shape for every factor of the boards' scatter."""
    total = noise + FACTORS[:, None, None] ** 2 * (follow @ follow.T)
    _, log_determinant = np.linalg.slogdet(total)
    solved = np.linalg.solve(total, np.broadcast_to(terms[:, None], (len(FACTORS), len(terms), 1)))
    return np.asarray(-0.5 * (log_determinant + solved[:, :, 0] @ terms))


def find_outlier_view(
    observations: SheetObservations, sheet: LightSheet, errors: CommonErrors
) -> int | None:
    """Number of an image without whose board a plane explains all others, or None.

    ``observations`` are points of one sheet that a plane does not explain; fits start at ``sheet``.
    """
    alone = observations.as_one_sheet()
    boards = np.unique(alone.board)
    if len(boards) < FEWEST_BOARDS:
        return None
    noise = stripe_noise(alone, alone.residuals_px([sheet])[1])
    whole = solve_sheets(alone, [sheet], errors, [False], sigma_factor=noise.sigma_factor)
    if isinstance(whole, FitFailure):
        return None
    p_values = [_probability_without(int(board), alone, whole, noise) for board in boards]
    best = int(np.argmax(p_values))
    if p_values[best] < LACK_OF_FIT_P:
        return None
    return int(alone.image[alone.board == boards[best]][0])


def _probability_without(
    board: int, observations: SheetObservations, whole: SheetSolution, noise: StripeNoise
) -> float:
    """Of the lack of fit of all other boards, by one step from the plane of all."""
    normal = whole.system.solve(whole.weight, 0, without_board=board)
    if normal is None:
        return 0.0
    rest = observations.board != board
    remaining = (whole.system.residual_px + whole.system.times(normal.step))[rest]
    common = normal.step[normal.n_sheet :]
    chi2 = float((whole.weight[rest] * remaining**2).sum() + common @ common)
    share = replace(noise, degrees_of_freedom=noise.degrees_of_freedom * float(rest.mean()))
    n_stripes = len(np.unique(observations.stripe[rest]))
    return lack_of_fit(chi2, n_stripes, whole.n_parameters, share).p_value
