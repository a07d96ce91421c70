# SPDX-License-Identifier: Apache-2.0
"""Joint adjustment of two cameras and the boards that both see: parameters, robust solution,
covariance, and the error on pairs left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.cameras.adjustment import (
    NormalEquations,
    Observations,
    State,
    descend,
    gather,
    joint_covariance,
    normal_equations,
    predict,
    target_points,
)
from armscan.calibration.cameras.distortion import rms, subset
from armscan.calibration.cameras.pairs import MIN_PAIRS, StereoPair, views_of
from armscan.calibration.cameras.print_errors import (
    BoardResiduals,
    TargetError,
    estimate_target_error,
)
from armscan.calibration.cameras.result import CrossValidation
from armscan.calibration.cameras.robust import (
    chi2_of_points,
    claimed_covariances,
    covariance_with_target_error,
    excess_variance_px2,
    judge,
    residuals_px,
    with_excess,
)
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import Minimum
from armscan.geometry.poses import Board, CameraRight, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector, skew
from armscan.models.camera import Lens
from armscan.models.two_views import N_CAMERA, N_SECOND, TwoViews
from armscan.vision.targets.target import TargetView

N_SHARED = N_CAMERA + N_SECOND
N_INTRINSICS = 2 * N_CAMERA
_NO_BOW = np.zeros(2)


@dataclass(frozen=True, slots=True, eq=False)
class JointObservations:
    """Points of U boards in both cameras, empty where a camera did not see the board."""

    left: Observations
    right: Observations

    @property
    def n_boards(self) -> int:
        """Count of boards."""
        return self.left.n_views


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is known of the intrinsics beforehand.

    Parameters
    ----------
    values
        (18,) left, then right.
    information
        (18, 18) inverse covariance; rows of parameters of which nothing is known are zero.
    n_known
        Count of parameters that it informs.
    """

    values: FloatArray
    information: FloatArray
    n_known: int


@dataclass(frozen=True, slots=True, eq=False)
class StereoState:
    """Values of all unknowns.

    Parameters
    ----------
    intrinsics
        (18,) of the left, then of the right camera.
    right_from_left
        The relative pose.
    rotations, translations_mm
        (U, 3, 3) and (U, 3) of ``sensor_from_board``.
    """

    intrinsics: FloatArray
    right_from_left: Pose[CameraRight, Sensor]
    rotations: FloatArray
    translations_mm: FloatArray

    def views(self, observations: JointObservations) -> TwoViews:
        """The two cameras of this state."""
        left, right = self.intrinsics[:N_CAMERA], self.intrinsics[N_CAMERA:]
        return TwoViews(
            observations.left.camera(left), observations.right.camera(right), self.right_from_left
        )

    def pose(self, board: int) -> Pose[Sensor, Board]:
        """``sensor_from_board`` of one board."""
        return Pose(self.rotations[board], self.translations_mm[board])

    def in_left(self) -> State:
        """The left camera with the boards."""
        shared = np.concatenate([self.intrinsics[:N_CAMERA], _NO_BOW])
        return State(shared, self.rotations, self.translations_mm)

    def in_right(self) -> State:
        """The right camera with the boards in its frame."""
        pose = self.right_from_left
        return State(
            np.concatenate([self.intrinsics[N_CAMERA:], _NO_BOW]),
            np.asarray(pose.rotation @ self.rotations),
            np.asarray(self.translations_mm @ pose.rotation.T + pose.translation_mm),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """Prediction of one camera's N points, with derivatives.

    Parameters
    ----------
    points_px
        (N, 2).
    by_shared
        (N, 2, 24) in the order of `armscan.models.two_views.STEREO_PARAMETER_NAMES`.
    by_pose
        (N, 2, 6) by the board's pose in the Sensor frame.
    """

    points_px: FloatArray
    by_shared: FloatArray
    by_pose: FloatArray


def predict_left(observations: Observations, state: StereoState) -> Predicted | None:
    """Predict the left camera's points; None if the state is impossible."""
    prediction = predict(observations, state.in_left())
    if prediction is None:
        return None
    points, by_camera, by_pose = prediction
    by_shared = np.zeros((len(points), 2, N_SHARED))
    by_shared[:, :, :N_CAMERA] = by_camera[:, :, :N_CAMERA]
    return Predicted(points, by_shared, by_pose)


def predict_right(observations: Observations, state: StereoState) -> Predicted | None:
    """Predict the right camera's points; None if the state is impossible."""
    prediction = predict(observations, state.in_right())
    if prediction is None:
        return None
    points, by_camera, by_right_pose = prediction
    turn, shift = by_right_pose[:, :, :3], by_right_pose[:, :, 3:]
    rotation = state.right_from_left.rotation
    arms = skew(state.translations_mm @ rotation.T)[observations.view_of_point]
    by_shared = np.zeros((len(points), 2, N_SHARED))
    by_shared[:, :, N_CAMERA:N_INTRINSICS] = by_camera[:, :, :N_CAMERA]
    by_shared[:, :, N_INTRINSICS:] = np.concatenate([turn - shift @ arms, shift], axis=2)
    return Predicted(points, by_shared, np.concatenate([turn @ rotation, shift @ rotation], axis=2))


@dataclass(frozen=True, slots=True, eq=False)
class JointProblem:
    """What is to be minimised.

    Parameters
    ----------
    observations
        Points of both cameras.
    basis
        (24, F) directions of the shared unknowns that are free: a step is ``basis @ free_step``;
        (24, 0) solves the boards alone.
    weights
        Factors of chi2 of the left and of the right points, 0 to leave a point out.
    prior
        What is known of the intrinsics, or None.
    """

    observations: JointObservations
    basis: FloatArray
    weights: tuple[FloatArray, FloatArray]
    prior: Prior | None


def linearise_both(problem: JointProblem, state: StereoState) -> NormalEquations | None:
    """Normal equations of both cameras' points and of the prior; None if impossible."""
    observations, basis, prior = problem.observations, problem.basis, problem.prior
    if min(state.intrinsics[[0, 1, N_CAMERA, N_CAMERA + 1]]) <= 0.0:
        return None
    left = predict_left(observations.left, state)
    right = predict_right(observations.right, state)
    if left is None or right is None:
        return None
    total = None if prior is None else _prior_equations(prior, state, basis, observations.n_boards)
    for seen, predicted, weight in zip(
        (observations.left, observations.right), (left, right), problem.weights, strict=True
    ):
        part = normal_equations(
            seen, predicted.points_px, predicted.by_shared @ basis, predicted.by_pose, weight
        )
        total = part if total is None else _sum(total, part)
    return total


def _prior_equations(
    prior: Prior, state: StereoState, basis: FloatArray, n_boards: int
) -> NormalEquations:
    apart = prior.values - state.intrinsics
    rows = basis[:N_INTRINSICS]
    return NormalEquations(
        float(apart @ prior.information @ apart),
        rows.T @ prior.information @ rows,
        np.zeros((n_boards, basis.shape[1], 6)),
        np.zeros((n_boards, 6, 6)),
        rows.T @ prior.information @ apart,
        np.zeros((n_boards, 6)),
    )


def _sum(a: NormalEquations, b: NormalEquations) -> NormalEquations:
    return NormalEquations(
        a.chi2 + b.chi2,
        a.shared + b.shared,
        a.cross + b.cross,
        a.pose + b.pose,
        a.shared_gradient + b.shared_gradient,
        a.pose_gradient + b.pose_gradient,
    )


def retract_state(
    state: StereoState, basis: FloatArray, shared_step: FloatArray, pose_steps: FloatArray
) -> StereoState:
    """Apply a step."""
    step = basis @ shared_step
    turn, shift = step[N_INTRINSICS : N_INTRINSICS + 3], step[N_INTRINSICS + 3 :]
    pose = state.right_from_left
    turns = np.array([rotation_from_vector(each[:3]) for each in pose_steps])
    return StereoState(
        state.intrinsics + step[:N_INTRINSICS],
        Pose(rotation_from_vector(turn) @ pose.rotation, pose.translation_mm + shift),
        np.asarray(turns @ state.rotations),
        state.translations_mm + pose_steps[:, 3:],
    )


def adjust_both(
    problem: JointProblem, start: StereoState, max_steps: int
) -> Minimum[StereoState, NormalEquations] | FitFailure:
    """Minimise both cameras' squared residuals over all unknowns, weighted by covariance."""
    return descend(
        start,
        lambda state: linearise_both(problem, state),
        lambda state, shared_step, pose_steps: retract_state(
            state, problem.basis, shared_step, pose_steps
        ),
        max_steps,
    )


ROUNDS = 4
LEVEL_STABLE = 0.01
"""The noise is known well enough when its variance changes by less than this part."""

PointWeights = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class JointSolution:
    """A minimum over the points kept.

    Parameters
    ----------
    problem
        What was minimised: each camera's covariances brought to the level of its residuals,
        weights 1 for points kept and 0 for outliers.
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


def stack_pair_observations(
    boards: Sequence[StereoPair], lenses: tuple[Lens, Lens]
) -> JointObservations:
    """Points of both cameras, board by board.

    Raises
    ------
    InputError
        If the images of one camera differ in size.
    """
    sides = []
    for side in (0, 1):
        blank = _without_points(views_of(boards, side)[0])
        seen = [view or blank for view in (board.views[side] for board in boards)]
        sides.append(gather(seen, lenses[side]))
    return JointObservations(sides[0], sides[1])


def _without_points(view: TargetView) -> TargetView:
    return TargetView(
        source="",
        width_px=view.width_px,
        height_px=view.height_px,
        point_index=np.zeros(0, dtype=np.int64),
        points_px=np.zeros((0, 2)),
        covariance_px2=np.zeros((0, 2, 2)),
        points_board_mm=np.zeros((0, 3)),
    )


def solve_both(
    boards: Sequence[StereoPair], problem: JointProblem, start: StereoState, max_steps: int
) -> JointSolution | FitFailure:
    """Solve; find each camera's noise and outliers; solve again until neither changes.

    The problem's points are as detected; its weights name the outliers known before.
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
            result.system,
            (float(np.sqrt(levels[0])), float(np.sqrt(levels[1]))),
            result.is_settled,
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
        # of views that have points
        starts = tuple(int(start) for start in np.unique(seen.starts))
        outlier: BoolArray = judge(replace(seen, starts=starts), chi2)[1]
        weights.append(np.where(outlier, 0.0, 1.0))
    return weights[0], weights[1]


@dataclass(frozen=True, slots=True, eq=False)
class StereoCovariance:
    """What is uncertain in a joint solution.

    Parameters
    ----------
    matrix
        (24 + 6 U, 24 + 6 U) of the shared unknowns and of the boards' poses.
    condition
        Of the reduced normal matrix of the free shared unknowns, scaled to unit diagonal.
    """

    matrix: FloatArray
    condition: float
    target_error: TargetError


def stereo_covariance(
    solution: JointSolution, held: FloatArray | None, widening: float = 1.0
) -> StereoCovariance | FitFailure:
    """Invert the normal equations.

    ``held`` (18, 18) is the covariance of intrinsics that were held at given values, or None: what
    was solved follows them, so that their uncertainty is carried into it. ``widening`` is a factor
    on the variance of the points' noise, for residuals that are alike.
    """
    determined = joint_covariance(solution.equations, solution.problem.basis)
    if isinstance(determined, FitFailure):
        return determined
    unit, condition = determined
    found = _board_residuals(solution)
    error = estimate_target_error(found)
    matrix = covariance_with_target_error(unit, widening * solution.variance_factor, error, found)
    if held is not None:
        lever = _followed(solution, unit)
        if isinstance(lever, FitFailure):
            return lever
        matrix = matrix + lever @ held @ lever.T
    return StereoCovariance(0.5 * (matrix + matrix.T), condition, error)


def independent_share(solution: JointSolution) -> float:
    """What part of the residuals' variance is of the images, not of the target's points."""
    return estimate_target_error(_board_residuals(solution)).independent_share


def _board_residuals(solution: JointSolution) -> BoardResiduals | None:
    """Kept points of both cameras; left and right see a point of one board in two views."""
    state, observations = solution.state, solution.observations
    left = predict_left(observations.left, state)
    right = predict_right(observations.right, state)
    if left is None or right is None:
        return None
    parts = []
    left_mm, right_mm = observations.left.board_mm, observations.right.board_mm
    target, every = target_points(np.concatenate([left_mm, right_mm]))
    numbers = np.split(every, [len(left_mm)])
    for side, (seen, predicted) in enumerate(
        ((observations.left, left), (observations.right, right))
    ):
        kept = np.flatnonzero(solution.weights[side] > 0.0)
        board = np.asarray(seen.view_of_point)[kept]
        whitening = seen.whitening[kept]
        parts.append(
            BoardResiduals(
                numbers[side][kept],
                seen.missed_mm[kept],
                (seen.points_px - predicted.points_px)[kept],
                predicted.by_pose[kept][:, :, 3:] @ state.rotations[board][:, :, :2],
                predicted.by_shared[kept],
                predicted.by_pose[kept],
                whitening.transpose(0, 2, 1) @ whitening,
                board,
                2 * board + side,
                target,
            )
        )
    return BoardResiduals.joined(parts)


def _followed(solution: JointSolution, unit: FloatArray) -> FloatArray | FitFailure:
    """(24 + 6 U, 18) how all unknowns follow held intrinsics (implicit function)."""
    unbound = replace(solution.problem, basis=np.eye(N_SHARED), prior=None)
    equations = linearise_both(unbound, solution.state)
    if equations is None:
        return FitFailure(
            "how the cameras' places follow the given intrinsics cannot be told: at the solution a "
            "board lies behind a camera",
            "check that the given calibrations are of these cameras",
        )
    cross = equations.cross.transpose(0, 2, 1)[:, :, :N_INTRINSICS].reshape(-1, N_INTRINSICS)
    lever = -unit @ np.concatenate([equations.shared[:, :N_INTRINSICS], cross])
    lever[:N_INTRINSICS] += np.eye(N_INTRINSICS)
    return np.asarray(lever)


NO_SHARED = np.zeros((N_SHARED, 0))


def hold_out_pairs(solution: JointSolution, n_folds: int, max_steps: int) -> CrossValidation | None:
    """Hold out pairs fold by fold.

    Each fold's pairs are left out, cameras and relative pose are solved from the rest, and each
    held-out pair gets one board pose, fitted in both images. Views of one camera alone are never
    held out, and outliers count nowhere.

    Parameters
    ----------
    solution
        Of all pairs; it also is the folds' starting value.
    n_folds
        Wanted folds; at most one a pair.
    max_steps
        Most iterations of each adjustment.

    Returns
    -------
    result
        None if too few pairs would be left to solve from, or if a fold has no solution.
    """
    boards = solution.boards
    both = np.array([k for k, board in enumerate(boards) if board.is_seen_by_both], dtype=np.int64)
    folds = min(n_folds, len(both))
    if folds < 2 or len(both) - int(np.ceil(len(both) / folds)) < MIN_PAIRS:
        return None
    every = np.arange(len(boards))
    predicted: list[tuple[IntArray, FloatArray]] = []
    for fold in range(folds):
        test = both[np.arange(len(both)) % folds == fold]
        part = _held_out_residuals(solution, np.setdiff1d(every, test), test, max_steps)
        if part is None:
            return None
        predicted += [(test[k : k + 1], residuals) for k, residuals in enumerate(part)]
    in_sample = _per_board(
        solution.residuals_px(), solution.observations, solution.weights, both.tolist()
    )
    ordered = {int(board[0]): residuals for board, residuals in predicted}
    return CrossValidation(
        folds,
        rms(np.concatenate([ordered[int(k)] for k in both])),
        rms(np.concatenate(in_sample)),
        tuple(boards[k].name for k in both),
        tuple(rms(ordered[int(k)]) for k in both),
    )


def _held_out_residuals(
    solution: JointSolution, train: IntArray, test: IntArray, max_steps: int
) -> list[FloatArray] | None:
    """Residuals in both images of each board held out."""
    training = _subset(solution, train)
    trained = adjust_both(training, _of_boards(solution.state, train), max_steps)
    if isinstance(trained, FitFailure):
        return None
    start = _of_boards(solution.state, test)
    start = StereoState(
        trained.state.intrinsics,
        trained.state.right_from_left,
        start.rotations,
        start.translations_mm,
    )
    testing = replace(_subset(solution, test), basis=NO_SHARED, prior=None)
    posed = adjust_both(testing, start, max_steps)
    if isinstance(posed, FitFailure):
        return None
    residuals = both_residuals_px(testing.observations, posed.state)
    return _per_board(residuals, testing.observations, testing.weights, range(len(test)))


def _per_board(
    residuals: tuple[FloatArray, FloatArray],
    observations: JointObservations,
    weights: PointWeights,
    boards: Iterable[int],
) -> list[FloatArray]:
    """(K, 2) residuals of the points kept, left and right, of each board."""
    return [
        np.concatenate(
            [
                values[seen.rows(board)][weight[seen.rows(board)] > 0.0]
                for values, seen, weight in zip(
                    residuals, (observations.left, observations.right), weights, strict=True
                )
            ]
        )
        for board in boards
    ]


def _subset(solution: JointSolution, boards: IntArray) -> JointProblem:
    left, left_weights = subset(solution.observations.left, solution.weights[0], boards)
    right, right_weights = subset(solution.observations.right, solution.weights[1], boards)
    return replace(
        solution.problem,
        observations=JointObservations(left, right),
        weights=(left_weights, right_weights),
    )


def _of_boards(state: StereoState, boards: IntArray) -> StereoState:
    return StereoState(
        state.intrinsics,
        state.right_from_left,
        state.rotations[boards],
        state.translations_mm[boards],
    )
