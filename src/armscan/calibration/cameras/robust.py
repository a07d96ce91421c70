# SPDX-License-Identifier: Apache-2.0
"""What disturbs a bundle adjustment: the noise of the target's points, outliers, what the print
misses and the bend of the board.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from armscan.calibration.cameras.adjustment import (
    SHARED_NAMES,
    WARP_NAMES,
    NormalEquations,
    Observations,
    State,
    adjust,
    moved,
    predict,
    predict_px,
)
from armscan.calibration.cameras.print_errors import (
    NO_ERROR,
    SIGNIFICANT_SIGMAS,
    BoardResiduals,
    PrintError,
    TargetError,
)
from armscan.calibration.cameras.result import BOW_P, BoardWarp
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure


def excess_variance_px2(
    residuals: FloatArray, covariances: FloatArray, chi2: float, degrees_of_freedom: int
) -> float:
    """Variance per axis, in px^2, to be added to covariances (N, 2, 2) that the detector claims.

    It is 0 unless chi2, of residuals (N, 2) in px over these covariances, is larger than its
    expectation by four of its standard deviations.
    """
    if degrees_of_freedom < 1:
        return 0.0
    expected_spread = np.sqrt(2.0 / degrees_of_freedom)
    if chi2 / degrees_of_freedom < 1.0 + SIGNIFICANT_SIGMAS * expected_spread:
        return 0.0
    scatter = float(np.sum(residuals**2)) / degrees_of_freedom
    claimed = 0.5 * float(np.mean(np.trace(covariances, axis1=1, axis2=2)))
    return max(scatter - claimed, 0.0)


def claimed_covariances(observations: Observations) -> FloatArray:
    """(N, 2, 2) covariances in px^2 that the whitening stands for."""
    whitening = observations.whitening
    return np.asarray(np.linalg.inv(whitening.transpose(0, 2, 1) @ whitening))


def with_excess(observations: Observations, variance_px2: float) -> Observations:
    """The observations with a variance added to every point and axis."""
    covariances = claimed_covariances(observations) + variance_px2 * np.eye(2)
    return replace(observations, whitening=np.linalg.inv(np.linalg.cholesky(covariances)))


MEDIAN_OF_CHI2_2 = 2.0 * float(np.log(2.0))
"""Median of a chi-squared variable with two degrees of freedom."""

FALSE_ALARM = 1e-3
"""A point or a pair of views is an outlier if Gaussian noise would yield one so far out, among all
of a calibration, once in a thousand calibrations."""

WRONG_LEVEL = 100.0
"""A view or a pair whose squared residuals are a hundred times those of the typical one is not
noisy but wrong: numbered wrongly, or moved during the exposure."""

MISFIT_LEVEL = 9.0
"""A view or a pair is a misfit if its residuals are three times as large as in the typical one:
lenses and boards are never quite as modelled, so that more than noise sets them apart."""

MISFIT_OUTLIERS = 0.25
"""...or if more than this share of its points are outliers."""

SUSPECT_LEVEL = 4.0
CAUCHY_SCALE = 2.4
ROBUST_ROUNDS = 8
FIRST_STEPS = 15
STEPS_PER_ROUND = 4
WEIGHTS_STABLE = 0.02
NO_SAY = 1e-6
"""Weight of points that must not pull: not zero, so that every pose stays determined."""

REJECTION_ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A minimum of eq. 2.39 over the points kept.

    Parameters
    ----------
    observations
        What was adjusted, with the weights that were in force.
    basis
        Which of them were free, see `free_basis`.
    weights
        (N,) 1 for points kept and 0 for outliers.
    view_levels
        (V,) robust chi2 per coordinate of each view over that of the typical view.
    outlier_shares
        (V,) share of each view's points that lie too far out for the typical view's noise.
    """

    observations: Observations
    state: State
    basis: FloatArray
    equations: NormalEquations
    weights: FloatArray
    view_levels: FloatArray
    outlier_shares: FloatArray
    is_converged: bool
    print_error: PrintError = NO_ERROR

    @property
    def degrees_of_freedom(self) -> int:
        """Coordinates used minus unknowns."""
        n_unknown = int(self.basis.shape[1]) + 6 * len(self.state.rotations)
        return 2 * int(self.weights.sum()) - n_unknown - round(self.print_error.n_told)

    @property
    def chi2(self) -> float:
        """That of the points; what is known beforehand has its own."""
        return self.equations.chi2 - float(self.observations.known @ self.state.shared**2)

    @property
    def variance_factor(self) -> float:
        """sigma0 squared: chi2 of the points over the degrees of freedom."""
        return self.chi2 / max(self.degrees_of_freedom, 1)

    def board_residuals(self) -> BoardResiduals | None:
        """The points kept; None if the state is impossible."""
        observations, state = self.observations, self.state
        prediction = predict(observations, state)
        if prediction is None:
            return None
        predicted, by_shared, by_pose = prediction
        kept = np.flatnonzero(self.weights > 0.0)
        view = np.asarray(observations.view_of_point)[kept]
        whitening = observations.whitening[kept]
        return BoardResiduals(
            observations.point[kept],
            observations.missed_mm[kept],
            (observations.points_px - predicted)[kept],
            by_pose[kept][:, :, 3:] @ state.rotations[view][:, :, :2],
            by_shared[kept],
            by_pose[kept],
            whitening.transpose(0, 2, 1) @ whitening,
            view,
            view,
            observations.target_mm,
        )

    def with_places(
        self, missed_mm: FloatArray, step: FloatArray, max_steps: int
    ) -> Solution | FitFailure:
        """The minimum for points that miss their places by (P, 2), about a step (F + 6 V,) away."""
        seen = replace(self.observations, missed_mm=missed_mm[self.observations.point])
        shared, poses = np.split(step, [self.basis.shape[1]])
        start = moved(self.state, self.basis, shared, poses.reshape(-1, 6))
        found = adjust(seen, start, self.basis, self.weights, max_steps)
        if isinstance(found, FitFailure):
            return found
        return replace(
            self,
            observations=seen,
            state=found.state,
            equations=found.system,
            is_converged=found.is_settled,
        )

    def with_print_error(self, error: PrintError) -> Solution:
        """The same with another weight of the print's places."""
        return replace(self, print_error=error)


def residuals_px(observations: Observations, state: State) -> FloatArray:
    """(N, 2) observed minus predicted; infinite for an impossible state."""
    predicted = predict_px(observations, state)
    if predicted is None:
        return np.full_like(observations.points_px, np.inf)
    return observations.points_px - predicted


def chi2_of_points(observations: Observations, state: State) -> FloatArray:
    """(N,) squared residual of each point over its detector's covariance."""
    residual = residuals_px(observations, state)
    white = (observations.whitening @ residual[:, :, None])[:, :, 0]
    return np.asarray(np.sum(white**2, axis=1))


def solve_robustly(
    observations: Observations,
    start: State,
    basis: FloatArray,
    trusted: BoolArray,
    max_steps: int,
) -> Solution | FitFailure:
    """Solve, look for outliers, and solve again without them where there are any."""
    if trusted.all():
        result = adjust(observations, start, basis, max_steps=max_steps)
        if isinstance(result, FitFailure):
            return result
        chi2 = chi2_of_points(observations, result.state)
        levels, outlier = judge(observations, chi2)
        if not outlier.any() and levels.max() < SUSPECT_LEVEL:
            return Solution(
                observations,
                result.state,
                basis,
                result.system,
                np.ones(len(chi2)),
                levels,
                0.0 * levels,
                result.is_settled,
            )
    state = _reweighted(observations, start, basis, trusted)
    if isinstance(state, FitFailure):
        return state
    chi2 = chi2_of_points(observations, state)
    levels, outlier = judge(observations, chi2)
    shares = _outlier_shares(observations, chi2)
    for _ in range(REJECTION_ROUNDS):
        weights = np.where(outlier, 0.0, 1.0)
        kept = adjust(observations, state, basis, weights, max_steps)
        if isinstance(kept, FitFailure):
            return kept
        state, equations, is_converged = kept.state, kept.system, kept.is_settled
        _, again = judge(observations, chi2_of_points(observations, state))
        if np.array_equal(again, outlier):
            break
        outlier = again
    return Solution(observations, state, basis, equations, weights, levels, shares, is_converged)


def _reweighted(
    observations: Observations, state: State, basis: FloatArray, trusted: BoolArray
) -> State | FitFailure:
    """Iterate with Cauchy weights at the level of the typical view."""
    weights = np.where(trusted[observations.view_of_point], 1.0, NO_SAY)
    for round_number in range(ROBUST_ROUNDS):
        steps = STEPS_PER_ROUND if round_number else FIRST_STEPS
        result = adjust(observations, state, basis, weights, steps)
        if isinstance(result, FitFailure):
            return result
        state = result.state
        chi2 = chi2_of_points(observations, state)
        typical = _typical(_view_levels(observations, chi2))
        before = weights
        weights = np.maximum(1.0 / (1.0 + chi2 / (CAUCHY_SCALE**2 * typical)), NO_SAY)
        if float(np.abs(weights - before).max()) < WEIGHTS_STABLE:
            break
    return state


SAME_FIT = 1e-6
"""Part of the cost by which two solutions of one minimum differ at most."""


def better_fit(
    first: Solution | FitFailure, second: Solution | FitFailure
) -> Solution | FitFailure:
    """Of two solutions over the same points the one that all of them fit better; else the first.

    By Cauchy's cost at the level of the typical view of the better one, so that neither outliers
    nor which of them were left out decide, and by what is known beforehand.
    """
    if isinstance(second, FitFailure):
        return first
    if isinstance(first, FitFailure):
        return second
    squares = [chi2_of_points(each.observations, each.state) for each in (first, second)]
    typical = min(_typical(_view_levels(first.observations, chi2)) for chi2 in squares)
    one = CAUCHY_SCALE**2 * typical
    cost = [
        float(np.log1p(chi2 / one).sum() + each.observations.known @ each.state.shared**2 / one)
        for each, chi2 in zip((first, second), squares, strict=True)
    ]
    return second if cost[1] < (1.0 - SAME_FIT) * cost[0] else first


def judge(observations: Observations, chi2: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Relative level (V,) of each view and which points (N,) are outliers against their own view.

    Every view must have a point; ``chi2`` is (N,) as from `chi2_of_points`.
    """
    absolute = _view_levels(observations, chi2)
    typical = _typical(absolute)
    own = np.maximum(absolute, typical)[observations.view_of_point]
    outlier = np.asarray(chi2 > _limit(len(chi2)) * own)
    for v in range(observations.n_views):
        rows = observations.rows(v)
        # Too few points left for a pose: then the view is judged as a whole, not by its points.
        if (~outlier[rows]).sum() < max(6, 0.5 * len(outlier[rows])):
            outlier[rows] = False
    return absolute / typical, outlier


def _view_levels(observations: Observations, chi2: FloatArray) -> FloatArray:
    """Median chi2 of each view's points, over what noise as told would give."""
    ordered = chi2[np.lexsort((chi2, observations.view_of_point))]
    first, counts = np.array(observations.starts[:-1]), np.diff(observations.starts)
    middle = ordered[first + (counts - 1) // 2] + ordered[first + counts // 2]
    return np.asarray(0.5 * middle / MEDIAN_OF_CHI2_2)


def _outlier_shares(observations: Observations, chi2: FloatArray) -> FloatArray:
    limit = _limit(len(chi2)) * _typical(_view_levels(observations, chi2))
    shares = [
        float(np.mean(chi2[observations.rows(v)] > limit)) for v in range(observations.n_views)
    ]
    return np.array(shares)


def _limit(n_points: int) -> float:
    """Value that chi2 with two degrees of freedom exceeds in `FALSE_ALARM` of n-point samples."""
    return 2.0 * float(np.log(n_points / FALSE_ALARM))


def _typical(levels: FloatArray) -> float:
    return max(float(np.median(levels)), 1e-12)


def added_variance_px2(observations: Observations, solution: Solution) -> float:
    """Variance to add to the detector's covariances, by the rule of `excess_variance_px2`."""
    kept = solution.weights > 0.0
    return excess_variance_px2(
        residuals_px(observations, solution.state)[kept],
        claimed_covariances(observations)[kept],
        float(chi2_of_points(observations, solution.state)[kept].sum()),
        solution.degrees_of_freedom,
    )


def covariance_with_target_error(
    unit_covariance: FloatArray,
    variance_factor: float,
    error: TargetError,
    found: BoardResiduals | None,
) -> FloatArray:
    """Covariance (S + 6 V, S + 6 V) of shared unknowns and poses with the target's own errors.

    ``unit_covariance`` is that of `armscan.calibration.cameras.adjustment.joint_covariance`,
    ``variance_factor`` the solution's sigma0 squared.
    """
    covariance = error.independent_share * variance_factor * unit_covariance
    if error.sigma_mm == 0.0 or found is None:
        return covariance
    pull = _pull_of_points(found, len(unit_covariance))
    moved = np.tensordot(unit_covariance, pull, axes=(1, 1))
    return np.asarray(covariance + error.sigma_mm**2 * np.einsum("ipk,jpk->ij", moved, moved))


def _pull_of_points(found: BoardResiduals, size: int) -> FloatArray:
    """(P, S + 6 V, 2) right-hand side that a unit error of each target point causes."""
    point = found.point
    weighted = found.information @ found.by_board
    shared = found.by_shared.transpose(0, 2, 1) @ weighted
    pose = found.by_pose.transpose(0, 2, 1) @ weighted
    n_shared = found.by_shared.shape[2]
    pull = np.zeros((int(point.max()) + 1, size, 2))
    np.add.at(pull[:, :n_shared], point, shared)
    first = n_shared + 6 * found.board
    for k in range(6):
        np.add.at(pull, (point, first + k), pose[:, k])
    return pull


_FIRST = SHARED_NAMES.index(WARP_NAMES[0])
WARP_ROWS = slice(_FIRST, _FIRST + len(WARP_NAMES))


def with_board_warp(flat: Solution, max_steps: int) -> Solution | FitFailure:
    """Free the two bow parameters, starting from the flat solution and over the same points."""
    columns = np.zeros((len(SHARED_NAMES), len(WARP_NAMES)))
    columns[WARP_ROWS] = np.eye(len(WARP_NAMES))
    basis = np.concatenate([flat.basis, columns], axis=1)
    result = adjust(flat.observations, flat.state, basis, flat.weights, max_steps)
    if isinstance(result, FitFailure):
        return result
    return replace(
        flat,
        state=result.state,
        basis=basis,
        equations=result.system,
        is_converged=result.is_settled,
    )


@dataclass(frozen=True, slots=True)
class BowTest:
    """F test of a board's bow by the decrease of chi2, with two parameters."""

    f_statistic: float
    p_value: float

    @staticmethod
    def of(flat: Solution, bowed: Solution) -> BowTest:
        """Compare the solutions without and with bow."""
        n_parameters = len(WARP_NAMES)
        decrease = max(flat.equations.chi2 - bowed.equations.chi2, 0.0)
        statistic = decrease / n_parameters / bowed.variance_factor
        freedom = max(bowed.degrees_of_freedom, 1)
        return BowTest(float(statistic), float(fdtrc(n_parameters, freedom, statistic)))

    @property
    def is_significant(self) -> bool:
        """True if a flat board would show such a bow less than once in a hundred times."""
        return self.p_value < BOW_P


def with_significant_bow(
    flat: Solution, max_steps: int, *, is_wanted: bool = False
) -> tuple[Solution, BowTest | None] | FitFailure:
    """Free the bow of the board and keep it so where it is wanted, or significant.

    With the bow's test, or the flat solution and None; a failure if a bow that is wanted has none.
    """
    bowed = with_board_warp(flat, max_steps)
    if isinstance(bowed, FitFailure):
        return bowed if is_wanted else (flat, None)
    test = BowTest.of(flat, bowed)
    return (bowed, test) if is_wanted or test.is_significant else (flat, None)


def board_warp(bowed: Solution, test: BowTest, covariance: FloatArray) -> BoardWarp:
    """The bow of a solution in which it was free.

    ``covariance`` (11 + 6 V, 11 + 6 V) is its scaled joint covariance.
    """
    return BoardWarp(
        bow_mm=bowed.state.shared[WARP_ROWS],
        covariance_mm2=covariance[WARP_ROWS, WARP_ROWS],
        f_statistic=test.f_statistic,
        p_value=test.p_value,
    )
