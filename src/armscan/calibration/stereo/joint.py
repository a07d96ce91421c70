# SPDX-License-Identifier: Apache-2.0
"""Adjustment of both cameras, their relative pose and all boards together.

Every point is predicted by the camera's own model (`armscan.calibration.camera.adjustment`); a
board's pose in the right camera is that in the left one carried over by ``right_from_left``
(eqs. 4.13 and 4.14), so that a board that both see has one pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.camera.adjustment import (
    Adjustment,
    NormalEquations,
    descend,
    normal_equations,
    predict,
)
from armscan.calibration.camera.observations import Observations, State
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.frames import Board, CameraRight, Sensor
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import rotation_from_vector, skew
from armscan.models.camera import CameraModel
from armscan.models.two_views import N_CAMERA, N_SECOND, TwoViews

N_SHARED = N_CAMERA + N_SECOND
N_INTRINSICS = 2 * N_CAMERA
_NO_BOW = np.zeros(2)


@dataclass(frozen=True, slots=True, eq=False)
class JointObservations:
    """Points of U boards in both cameras.

    Parameters
    ----------
    left, right
        Points of each camera; both have U views, empty where the camera did not see the board.
    """

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
        left, right = observations.left, observations.right
        return TwoViews(
            CameraModel.from_parameters(self.intrinsics[:N_CAMERA], left.width_px, left.height_px),
            CameraModel.from_parameters(
                self.intrinsics[N_CAMERA:], right.width_px, right.height_px
            ),
            self.right_from_left,
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
        (N, 2, 24) in the order of `armscan.models.stereo.STEREO_PARAMETER_NAMES`.
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


def moved_state(
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
) -> Adjustment[StereoState] | FitFailure:
    """Minimise both cameras' squared residuals over all unknowns, weighted by covariance.

    Parameters
    ----------
    problem
        What is to be minimised.
    start
        Starting values.
    max_steps
        Most iterations.
    """
    return descend(
        start,
        lambda state: linearise_both(problem, state),
        lambda state, shared_step, pose_steps: moved_state(
            state, problem.basis, shared_step, pose_steps
        ),
        max_steps,
    )
