# SPDX-License-Identifier: Apache-2.0
"""Errors of the target itself: they are the same in every view, so more views do not average them.

The rule: residuals are carried back to the board. If those of one target point agree from view to
view, more than independent noise would by four of its standard deviations, the mean product over
pairs of views is the variance by which the points miss their places. Its effect on the solution is
added to the covariance, and what is left of the scatter counts as independent.
"""

from __future__ import annotations

from collections.abc import Sequence
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


@dataclass(frozen=True, slots=True, eq=False)
class BoardResiduals:
    """Residuals of N points kept, and what a move of a point on its board does to them.

    Parameters
    ----------
    board_mm
        (N, 3) places on the board: equal places are one point of the target.
    residuals_px
        (N, 2) observed minus predicted.
    by_board
        (N, 2, 2) derivative of the prediction by the point's place along the board's axes.
    by_shared, by_pose
        (N, 2, S) and (N, 2, 6) derivative by the shared unknowns and by the pose of its board.
    information
        (N, 2, 2) inverse covariance of the points.
    board
        (N,) number of the pose in the order of the unknowns.
    view
        (N,) number of the view: two cameras have two views of one board.
    """

    board_mm: FloatArray
    residuals_px: FloatArray
    by_board: FloatArray
    by_shared: FloatArray
    by_pose: FloatArray
    information: FloatArray
    board: IntArray
    view: IntArray

    @property
    def point(self) -> IntArray:
        """(N,) number of the target's point."""
        places = np.rint(self.board_mm[:, :2] / SAME_POINT_MM).astype(np.int64)
        return np.unique(places, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)

    @staticmethod
    def joined(parts: Sequence[BoardResiduals]) -> BoardResiduals:
        """All of several cameras' points."""
        names = BoardResiduals.__slots__
        return BoardResiduals(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in names)
        )


def board_residuals(solution: Solution) -> BoardResiduals | None:
    """The points kept of one camera's solution; None if that is impossible."""
    observations, state = solution.observations, solution.state
    prediction = predict(observations, state)
    if prediction is None:
        return None
    predicted, by_shared, by_pose = prediction
    kept = np.flatnonzero(solution.weights > 0.0)
    view = np.asarray(observations.view_of_point)[kept]
    whitening = observations.whitening[kept]
    return BoardResiduals(
        observations.board_mm[kept],
        (observations.points_px - predicted)[kept],
        by_pose[kept][:, :, 3:] @ state.rotations[view][:, :, :2],
        by_shared[kept],
        by_pose[kept],
        whitening.transpose(0, 2, 1) @ whitening,
        view,
        view,
    )


def estimate_target_error(found: BoardResiduals | None) -> TargetError:
    """Find how far target points miss their places, from how residuals agree between views."""
    if found is None or len(np.unique(found.view)) < FEWEST_VIEWS:
        return TargetError(0.0, 1.0)
    residuals, by_board, point = found.residuals_px, found.by_board, found.point
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
    unit_covariance: FloatArray,
    variance_factor: float,
    error: TargetError,
    found: BoardResiduals | None,
) -> FloatArray:
    """Covariance (S + 6 V, S + 6 V) of shared unknowns and poses with the target's own errors.

    Parameters
    ----------
    unit_covariance
        From `armscan.calibration.camera.covariance.joint_covariance`.
    variance_factor
        sigma0 squared of the solution.
    error
        Of the target.
    found
        The residuals that showed it.
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
