# SPDX-License-Identifier: Apache-2.0
"""Covariance of both cameras and their relative pose, the target's own errors included."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.camera.covariance import joint_covariance
from armscan.calibration.camera.target_error import (
    BoardResiduals,
    TargetError,
    covariance_with_target_error,
    estimate_target_error,
)
from armscan.calibration.stereo.joint import (
    N_INTRINSICS,
    N_SHARED,
    linearise_both,
    predict_left,
    predict_right,
)
from armscan.calibration.stereo.solve import JointSolution
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure


@dataclass(frozen=True, slots=True, eq=False)
class StereoCovariance:
    """What is uncertain in a joint solution.

    Parameters
    ----------
    matrix
        (24 + 6 U, 24 + 6 U) of the shared unknowns and of the boards' poses.
    condition
        Of the reduced normal matrix of the free shared unknowns, scaled to unit diagonal.
    target_error
        How far the target's points miss their places.
    """

    matrix: FloatArray
    condition: float
    target_error: TargetError


def stereo_covariance(
    solution: JointSolution, held: FloatArray | None
) -> StereoCovariance | FitFailure:
    """Invert the normal equations.

    Parameters
    ----------
    solution
        At the minimum.
    held
        (18, 18) covariance of intrinsics that were held at given values, or None: what was solved
        follows them, so that their uncertainty is carried into it.
    """
    determined = joint_covariance(solution.equations, solution.problem.basis)
    if isinstance(determined, FitFailure):
        return determined
    unit, condition = determined
    found = _board_residuals(solution)
    error = estimate_target_error(found)
    matrix = covariance_with_target_error(unit, solution.variance_factor, error, found)
    if held is not None:
        lever = _followed(solution, unit)
        matrix = matrix + lever @ held @ lever.T
    return StereoCovariance(0.5 * (matrix + matrix.T), condition, error)


def _board_residuals(solution: JointSolution) -> BoardResiduals | None:
    """Kept points of both cameras; left and right see a point of one board in two views."""
    state, observations = solution.state, solution.observations
    left = predict_left(observations.left, state)
    right = predict_right(observations.right, state)
    if left is None or right is None:
        return None
    parts = []
    for side, (seen, predicted) in enumerate(
        ((observations.left, left), (observations.right, right))
    ):
        kept = np.flatnonzero(solution.weights[side] > 0.0)
        board = np.asarray(seen.view_of_point)[kept]
        whitening = seen.whitening[kept]
        parts.append(
            BoardResiduals(
                seen.board_mm[kept],
                (seen.points_px - predicted.points_px)[kept],
                predicted.by_pose[kept][:, :, 3:] @ state.rotations[board][:, :, :2],
                predicted.by_shared[kept],
                predicted.by_pose[kept],
                whitening.transpose(0, 2, 1) @ whitening,
                board,
                2 * board + side,
            )
        )
    return BoardResiduals.joined(parts)


def _followed(solution: JointSolution, unit: FloatArray) -> FloatArray:
    """(24 + 6 U, 18) how all unknowns follow held intrinsics (implicit function)."""
    unbound = replace(solution.problem, basis=np.eye(N_SHARED), prior=None)
    equations = linearise_both(unbound, solution.state)
    lever = np.zeros((len(unit), N_INTRINSICS))
    if equations is not None:
        cross = equations.cross.transpose(0, 2, 1)[:, :, :N_INTRINSICS].reshape(-1, N_INTRINSICS)
        lever = -unit @ np.concatenate([equations.shared[:, :N_INTRINSICS], cross])
    lever[:N_INTRINSICS] += np.eye(N_INTRINSICS)
    return lever
