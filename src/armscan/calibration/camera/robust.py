# SPDX-License-Identifier: Apache-2.0
"""Adjustment that survives wrong points and wrong views, and says which they are.

The final solution is plain least squares over the points kept, so that its covariance is right.
Robust weights only serve to find what does not belong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.camera.adjustment import NormalEquations, adjust, predict
from armscan.calibration.camera.observations import Observations, State
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure

MEDIAN_OF_CHI2_2 = 2.0 * float(np.log(2.0))
"""Median of a chi-squared variable with two degrees of freedom."""

FALSE_ALARM = 1e-3
"""A point is an outlier if Gaussian noise would yield one so far out, among all the points of a
calibration, once in a thousand calibrations."""

MISFIT_LEVEL = 9.0
"""A view is a misfit if its residuals are three times as large as in the typical view."""

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
    state
        The unknowns.
    basis
        Which of them were free, see `free_basis`.
    equations
        Normal equations at the minimum, points kept only.
    weights
        (N,) 1 for points kept and 0 for outliers.
    view_levels
        (V,) robust chi2 per coordinate of each view over that of the typical view.
    outlier_shares
        (V,) share of each view's points that lie too far out for the typical view's noise.
    is_converged
        False if the adjustment was stopped before the minimum.
    """

    observations: Observations
    state: State
    basis: FloatArray
    equations: NormalEquations
    weights: FloatArray
    view_levels: FloatArray
    outlier_shares: FloatArray
    is_converged: bool

    @property
    def degrees_of_freedom(self) -> int:
        """Coordinates used minus unknowns."""
        n_views = len(self.state.rotations)
        n_coordinates = 2 * int(self.weights.sum())
        return n_coordinates - int(self.basis.shape[1]) - 6 * n_views

    @property
    def variance_factor(self) -> float:
        """sigma0 squared: chi2 over the degrees of freedom."""
        return self.equations.chi2 / max(self.degrees_of_freedom, 1)


def residuals_px(observations: Observations, state: State) -> FloatArray:
    """(N, 2) observed minus predicted; infinite for an impossible state."""
    prediction = predict(observations, state)
    if prediction is None:
        return np.full_like(observations.points_px, np.inf)
    return observations.points_px - prediction[0]


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
    """Solve, look for outliers, and solve again without them where there are any.

    Parameters
    ----------
    observations
        The image points.
    start, trusted
        From `armscan.calibration.camera.starting_values.starting_state`.
    basis
        From `free_basis`.
    max_steps
        Most iterations of each adjustment.
    """
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
                result.equations,
                np.ones(len(chi2)),
                levels,
                0.0 * levels,
                result.is_converged,
            )
    state = _reweighted(observations, start, basis, trusted)
    chi2 = chi2_of_points(observations, state)
    levels, outlier = judge(observations, chi2)
    shares = _outlier_shares(observations, chi2)
    for _ in range(REJECTION_ROUNDS):
        weights = np.where(outlier, 0.0, 1.0)
        kept = adjust(observations, state, basis, weights, max_steps)
        if isinstance(kept, FitFailure):
            return kept
        state, equations, is_converged = kept.state, kept.equations, kept.is_converged
        _, again = judge(observations, chi2_of_points(observations, state))
        if np.array_equal(again, outlier):
            break
        outlier = again
    return Solution(observations, state, basis, equations, weights, levels, shares, is_converged)


def _reweighted(
    observations: Observations, state: State, basis: FloatArray, trusted: BoolArray
) -> State:
    """Iterate with Cauchy weights at the level of the typical view."""
    weights = np.where(trusted[observations.view_of_point], 1.0, NO_SAY)
    for round_number in range(ROBUST_ROUNDS):
        steps = STEPS_PER_ROUND if round_number else FIRST_STEPS
        result = adjust(observations, state, basis, weights, steps)
        if isinstance(result, FitFailure):
            return state
        state = result.state
        chi2 = chi2_of_points(observations, state)
        typical = _typical(_view_levels(observations, chi2))
        before = weights
        weights = np.maximum(1.0 / (1.0 + chi2 / (CAUCHY_SCALE**2 * typical)), NO_SAY)
        if float(np.abs(weights - before).max()) < WEIGHTS_STABLE:
            break
    return state


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
    medians = [float(np.median(chi2[observations.rows(v)])) for v in range(observations.n_views)]
    return np.array(medians) / MEDIAN_OF_CHI2_2


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
