# SPDX-License-Identifier: Apache-2.0
"""Errors of the target itself: they are the same in every view, so more views do not average them.

The rule: residuals are carried back to the board. If those of one target point agree from view to
view, more than independent noise would by four of its standard deviations, the mean product over
pairs of views is the variance by which the points miss their places. Its effect on the solution is
added to the covariance, and what is left of the scatter counts as independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.camera.adjustment import predict
from armscan.calibration.camera.robust import Solution
from armscan.geometry.arrays import FloatArray, IntArray

SIGNIFICANT_SIGMAS = 4.0
FEWEST_VIEWS = 4
LEAST_INDEPENDENT = 0.05
SAME_POINT_MM = 1e-6


@dataclass(frozen=True, slots=True)
class TargetError:
    """How far the target's points miss their places.

    Parameters
    ----------
    sigma_mm
        Standard deviation along each axis of the board; 0 where views show none.
    independent_share
        Part of the residuals' variance that is new in every view.
    """

    sigma_mm: float
    independent_share: float


def estimate_target_error(solution: Solution) -> TargetError:
    """Find how far target points miss their places, from how residuals agree between views."""
    by_board, residuals, point = _on_board(solution)
    if solution.observations.n_views < FEWEST_VIEWS:
        return TargetError(0.0, 1.0)
    missed = np.linalg.solve(by_board, residuals[:, :, None])[:, :, 0]
    count = np.bincount(point)
    total = np.stack([np.bincount(point, missed[:, k]) for k in range(2)], axis=1)
    squares = np.bincount(point, np.sum(missed**2, axis=1))
    products = float(np.sum(total**2) - squares.sum())
    pairs = float(np.sum(count * (count - 1)))
    scatter = float(squares.sum()) / (2.0 * len(point))
    if not products > SIGNIFICANT_SIGMAS * 2.0 * scatter * np.sqrt(pairs):
        return TargetError(0.0, 1.0)
    variance = products / (2.0 * pairs)
    explained = variance * float(np.mean(np.sum(by_board**2, axis=(1, 2))))
    share = 1.0 - explained / float(np.mean(np.sum(residuals**2, axis=1)))
    return TargetError(float(np.sqrt(variance)), max(share, LEAST_INDEPENDENT))


def covariance_with_target_error(
    solution: Solution, unit_covariance: FloatArray, error: TargetError
) -> FloatArray:
    """Covariance (S + 6 V, S + 6 V) of shared unknowns and poses with the target's own errors.

    Parameters
    ----------
    solution
        At the minimum.
    unit_covariance
        From `armscan.calibration.camera.covariance.joint_covariance`.
    error
        Of the target.
    """
    covariance = error.independent_share * solution.variance_factor * unit_covariance
    if error.sigma_mm == 0.0:
        return covariance
    pull = _pull_of_points(solution, len(unit_covariance))
    moved = np.tensordot(unit_covariance, pull, axes=(1, 1))
    return np.asarray(covariance + error.sigma_mm**2 * np.einsum("ipk,jpk->ij", moved, moved))


def _pull_of_points(solution: Solution, size: int) -> FloatArray:
    """(P, S + 6 V, 2) right-hand side that a unit error of each target point causes."""
    observations, state = solution.observations, solution.state
    by_board, _, point = _on_board(solution)
    kept = np.flatnonzero(solution.weights > 0.0)
    prediction = predict(observations, state)
    if prediction is None:
        return np.zeros((0, size, 2))
    _, by_shared, by_pose = prediction
    whitening = observations.whitening[kept]
    weighted = whitening.transpose(0, 2, 1) @ whitening @ by_board
    shared = by_shared[kept].transpose(0, 2, 1) @ weighted
    pose = by_pose[kept].transpose(0, 2, 1) @ weighted
    n_shared = by_shared.shape[2]
    pull = np.zeros((int(point.max()) + 1, size, 2))
    np.add.at(pull[:, :n_shared], point, shared)
    first = n_shared + 6 * np.asarray(observations.view_of_point)[kept]
    for k in range(6):
        np.add.at(pull, (point, first + k), pose[:, k])
    return pull


def _on_board(solution: Solution) -> tuple[FloatArray, FloatArray, IntArray]:
    """Derivative (N, 2, 2) of kept points by their place on the board, residuals, point number."""
    observations, state = solution.observations, solution.state
    kept = solution.weights > 0.0
    prediction = predict(observations, state)
    if prediction is None:
        return np.zeros((0, 2, 2)), np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
    predicted, _, by_pose = prediction
    axes = state.rotations[observations.view_of_point][:, :, :2]
    by_board = (by_pose[:, :, 3:] @ axes)[kept]
    places = np.rint(observations.board_mm[kept, :2] / SAME_POINT_MM).astype(np.int64)
    number = np.unique(places, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)
    return by_board, (observations.points_px - predicted)[kept], number
