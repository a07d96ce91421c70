# SPDX-License-Identifier: Apache-2.0
"""Starting values and weights of the joint adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.calibration.stereo.joint import N_INTRINSICS, N_SHARED, Prior, StereoState
from armscan.calibration.stereo.pairs import StereoPair
from armscan.calibration.stereo.relate import Cameras, RelatedPair, Relation
from armscan.calibration.stereo.solve import PointWeights
from armscan.errors import OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Board, CameraRight, Sensor
from armscan.geometry.poses import Pose
from armscan.models.calibration import CameraCalibration
from armscan.models.camera import PARAMETER_NAMES


@dataclass(frozen=True, slots=True, eq=False)
class Boards:
    """The boards of an adjustment.

    Parameters
    ----------
    seen_by
        Views of each board; those of a pair that was taken apart are boards of their own.
    left_board, right_board
        Number of the board of each pair's left and right view; -1 where it has none.
    poses
        ``sensor_from_board`` of each, to start from.
    """

    seen_by: tuple[StereoPair, ...]
    left_board: tuple[int, ...]
    right_board: tuple[int, ...]
    poses: tuple[Pose[Sensor, Board], ...]


def boards_of(relation: Relation) -> Boards:
    """One board for each related pair, and one for each other view."""
    seen_by: list[StereoPair] = []
    poses: list[Pose[Sensor, Board]] = []
    left: list[int] = []
    right: list[int] = []
    for pair in relation.pairs:
        numbers = [-1, -1]
        if pair.pair is not None and pair.start is not None:
            numbers = [len(seen_by)] * 2
            seen_by.append(pair.pair)
            poses.append(pair.start)
        elif pair.pair is not None:
            for side, view in enumerate(pair.pair.views):
                if view is not None:
                    numbers[side] = len(seen_by)
                    seen_by.append(StereoPair(view, None) if side == 0 else StereoPair(None, view))
                    poses.append(_alone(pair, side, relation.right_from_left))
        left.append(numbers[0])
        right.append(numbers[1])
    return Boards(tuple(seen_by), tuple(left), tuple(right), tuple(poses))


def _alone(
    pair: RelatedPair, side: int, right_from_left: Pose[CameraRight, Sensor]
) -> Pose[Sensor, Board]:
    seen = pair.seen[side][0].camera_from_board
    if side == 0:
        return seen
    right_from_board: Pose[CameraRight, Board] = Pose(seen.rotation, seen.translation_mm)
    return right_from_left.inverse() @ right_from_board


def starting_state(
    boards: Boards, cameras: Cameras, right_from_left: Pose[CameraRight, Sensor]
) -> StereoState:
    """Cameras by themselves, the agreed relative pose, boards as the left camera sees them."""
    return StereoState(
        np.concatenate([camera.camera.parameters for camera in cameras]),
        right_from_left,
        np.array([pose.rotation for pose in boards.poses]),
        np.array([pose.translation_mm for pose in boards.poses]),
    )


def starting_weights(boards: Sequence[StereoPair], cameras: Cameras) -> PointWeights:
    """0 for points that are outliers in their camera by itself, else 1."""
    weights = []
    for side, camera in enumerate(cameras):
        views = [view for board in boards if (view := board.views[side]) is not None]
        outliers = np.concatenate([camera.outliers[view.source] for view in views])
        weights.append(np.where(outliers, 0.0, 1.0))
    return weights[0], weights[1]


def joint_basis(cameras: Cameras) -> FloatArray:
    """(24, F) of the free shared unknowns: those of each camera, and the relative pose."""
    left, right = (camera.basis for camera in cameras)
    n_left, n_right = left.shape[1], right.shape[1]
    basis = np.zeros((N_SHARED, n_left + n_right + 6))
    basis[: len(left), :n_left] = left
    basis[len(left) : N_INTRINSICS, n_left : n_left + n_right] = right
    basis[N_INTRINSICS:, n_left + n_right :] = np.eye(6)
    return basis


def prior_of(given: tuple[CameraCalibration, CameraCalibration]) -> Prior:
    """The given calibrations as observations of the intrinsics.

    Raises
    ------
    OptionError
        If one brings no covariance.
    """
    information = np.zeros((N_INTRINSICS, N_INTRINSICS))
    n_known = 0
    for side, calibration in enumerate(given):
        known = np.flatnonzero(np.diag(calibration.covariance) > 0.0)
        if not calibration.has_covariance or not len(known):
            raise OptionError(
                f"the {('left', 'right')[side]} camera's calibration brings no covariance",
                remedy="hold it (--intrinsics fixed), or calibrate the camera with armscan",
            )
        rows = known + side * len(PARAMETER_NAMES)
        information[np.ix_(rows, rows)] = _inverse(calibration.covariance[np.ix_(known, known)])
        n_known += len(known)
    values = np.concatenate([calibration.camera.parameters for calibration in given])
    return Prior(values, information, n_known)


def held_covariance(given: tuple[CameraCalibration, CameraCalibration]) -> FloatArray | None:
    """(18, 18) covariance of held intrinsics; None if neither brings one."""
    if not any(calibration.has_covariance for calibration in given):
        return None
    n = len(PARAMETER_NAMES)
    held = np.zeros((N_INTRINSICS, N_INTRINSICS))
    held[:n, :n], held[n:, n:] = given[0].covariance, given[1].covariance
    return held


def _inverse(matrix: FloatArray) -> FloatArray:
    """Scaled to unit diagonal first: focal lengths and k3 differ by many orders."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    return np.asarray(np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale))
