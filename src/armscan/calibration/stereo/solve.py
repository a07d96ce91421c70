# SPDX-License-Identifier: Apache-2.0
"""The joint solution, with the noise of each camera and with outliers found on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.camera.adjustment import NormalEquations
from armscan.calibration.camera.noise import (
    claimed_covariances,
    excess_variance_px2,
    with_excess,
)
from armscan.calibration.camera.observations import Observations, gather
from armscan.calibration.camera.robust import chi2_of_points, judge, residuals_px
from armscan.calibration.stereo.joint import (
    JointObservations,
    JointProblem,
    StereoState,
    adjust_both,
)
from armscan.calibration.stereo.pairs import StereoPair, views_of
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.vision.targets.view import TargetView

ROUNDS = 4
LEVEL_STABLE = 0.01
"""The noise is known well enough when its variance changes by less than this part."""

PointWeights = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class JointSolution:
    """A minimum over the points kept.

    Parameters
    ----------
    boards
        What each of the U boards was seen by.
    problem
        What was minimised: each camera's covariances brought to the level of its residuals,
        weights 1 for points kept and 0 for outliers.
    state
        The unknowns.
    equations
        Normal equations at the minimum.
    noise_scales
        By how much the points of the left and of the right camera scatter more than their
        detector says.
    is_converged
        False if the adjustment was stopped before the minimum.
    """

    boards: tuple[StereoPair, ...]
    problem: JointProblem
    state: StereoState
    equations: NormalEquations
    noise_scales: tuple[float, float]
    is_converged: bool

    @property
    def observations(self) -> JointObservations:
        """What was adjusted."""
        return self.problem.observations

    @property
    def weights(self) -> PointWeights:
        """1 for points kept and 0 for outliers, left and right."""
        return self.problem.weights

    @property
    def degrees_of_freedom(self) -> int:
        """Coordinates used, and what is known beforehand, minus unknowns."""
        known = 0 if self.problem.prior is None else self.problem.prior.n_known
        n_unknown = int(self.problem.basis.shape[1]) + 6 * len(self.boards)
        return 2 * int(sum(weight.sum() for weight in self.weights)) + known - n_unknown

    @property
    def variance_factor(self) -> float:
        """sigma0 squared: chi2 over the degrees of freedom; near 1 by the noise's level."""
        return self.equations.chi2 / max(self.degrees_of_freedom, 1)

    def residuals_px(self) -> tuple[FloatArray, FloatArray]:
        """Observed minus predicted of all left and of all right points."""
        return both_residuals_px(self.observations, self.state)


def both_residuals_px(
    observations: JointObservations, state: StereoState
) -> tuple[FloatArray, FloatArray]:
    """Observed minus predicted of all left and of all right points."""
    return (
        residuals_px(observations.left, state.in_left()),
        residuals_px(observations.right, state.in_right()),
    )


def gather_both(boards: Sequence[StereoPair]) -> JointObservations:
    """Points of both cameras, board by board.

    Raises
    ------
    InputError
        If the images of one camera differ in size.
    """
    sides = []
    for side in (0, 1):
        blank = _without_points(views_of(boards, side)[0])
        sides.append(gather([view or blank for view in (board.views[side] for board in boards)]))
    return JointObservations(sides[0], sides[1])


def _without_points(view: TargetView) -> TargetView:
    return TargetView(
        "",
        view.width_px,
        view.height_px,
        np.zeros(0, dtype=np.int64),
        np.zeros((0, 2)),
        np.zeros((0, 2, 2)),
        np.zeros((0, 3)),
    )


def solve_both(
    boards: Sequence[StereoPair], problem: JointProblem, start: StereoState, max_steps: int
) -> JointSolution | FitFailure:
    """Solve; find each camera's noise and outliers; solve again until neither changes.

    Parameters
    ----------
    boards
        What each board was seen by.
    problem
        Their points, as detected; what is free; points known as outliers; what is known.
    start
        Starting values.
    max_steps
        Most iterations of each adjustment.
    """
    raw, state = problem.observations, start
    levels = np.ones(2)
    for _ in range(ROUNDS):
        result = adjust_both(problem, state, max_steps)
        if isinstance(result, FitFailure):
            return result
        state = result.state
        solution = JointSolution(
            tuple(boards),
            problem,
            state,
            result.equations,
            (float(np.sqrt(levels[0])), float(np.sqrt(levels[1]))),
            result.is_converged,
        )
        observations, found = _levelled(raw, solution)
        weights = _judged(observations, state)
        is_same = all(np.array_equal(a, b) for a, b in zip(weights, problem.weights, strict=True))
        if is_same and np.all(np.abs(found / levels - 1.0) < LEVEL_STABLE):
            break
        problem, levels = replace(problem, observations=observations, weights=weights), found
    return solution


def _levelled(
    raw: JointObservations, solution: JointSolution
) -> tuple[JointObservations, FloatArray]:
    """Covariances at the level of the residuals, and that level over the detector's, (2,)."""
    state = solution.state
    n_used = sum(float(weight.sum()) for weight in solution.weights)
    parts, levels = [], []
    for observations, weight, camera_state in (
        (raw.left, solution.weights[0], state.in_left()),
        (raw.right, solution.weights[1], state.in_right()),
    ):
        kept = weight > 0.0
        degrees = solution.degrees_of_freedom * float(weight.sum()) / n_used
        chi2 = float(chi2_of_points(observations, camera_state)[kept].sum())
        residuals = residuals_px(observations, camera_state)[kept]
        claimed = claimed_covariances(observations)[kept]
        excess = excess_variance_px2(residuals, claimed, chi2, int(degrees))
        level = chi2 / max(degrees, 1.0)
        parts.append(
            with_excess(observations, excess)
            if excess > 0.0
            else replace(observations, whitening=observations.whitening / np.sqrt(level))
        )
        levels.append(level)
    return JointObservations(parts[0], parts[1]), np.array(levels)


def _judged(observations: JointObservations, state: StereoState) -> PointWeights:
    """1 for points to keep and 0 for outliers."""
    weights = []
    for seen, camera_state in (
        (observations.left, state.in_left()),
        (observations.right, state.in_right()),
    ):
        chi2 = chi2_of_points(seen, camera_state)
        outlier: BoolArray = judge(_of_views_with_points(seen), chi2)[1]
        weights.append(np.where(outlier, 0.0, 1.0))
    return weights[0], weights[1]


def _of_views_with_points(observations: Observations) -> Observations:
    starts = tuple(int(start) for start in np.unique(observations.starts))
    return replace(observations, starts=starts)
