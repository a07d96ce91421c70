# SPDX-License-Identifier: Apache-2.0
"""Where one camera is to the other, from one board that both see (eqs. 4.12 to 4.16)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.calibration.camera.adjustment import adjust
from armscan.calibration.camera.board_pose import estimate_board_poses
from armscan.calibration.camera.covariance import SINGULAR_CONDITION, condition_number
from armscan.calibration.camera.cross_validation import NO_SHARED
from armscan.calibration.camera.observations import State, gather
from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.estimate import FitFailure
from armscan.geometry.frames import Board, CameraRight, Sensor
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import skew
from armscan.models.camera import CameraModel
from armscan.vision.targets.view import TargetView


@dataclass(frozen=True, slots=True, eq=False)
class BoardSeen:
    """A pose of a board that one view allows.

    Parameters
    ----------
    camera_from_board
        The pose; the Sensor frame stands for that of the camera, left or right.
    covariance
        (6, 6) of rotation-vector increment (rad, in the camera's frame, on the left) and
        translation (mm), due to the points' noise alone.
    """

    camera_from_board: Pose[Sensor, Board]
    covariance: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", frozen_floats(self.covariance, (6, 6), "covariance"))


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """``right_from_left`` with its covariance (6, 6), conventions as in `BoardSeen`."""

    right_from_left: Pose[CameraRight, Sensor]
    covariance: FloatArray


def boards_seen(view: TargetView, camera: CameraModel) -> tuple[BoardSeen, ...] | FitFailure:
    """The pose of a board; also the mirrored one where the view does not refute it."""
    found = estimate_board_poses(view, camera)
    if isinstance(found, FitFailure):
        return found
    return tuple(BoardSeen(pose.value, pose.covariance) for pose in found)


def board_near(
    view: TargetView, camera: CameraModel, near: Pose[Sensor, Board]
) -> BoardSeen | FitFailure:
    """The pose of a board by one view alone, from a pose that is nearly right."""
    shared = np.append(camera.parameters, np.zeros(2))
    result = adjust(gather([view]), State.from_poses(shared, [near]), NO_SHARED)
    if isinstance(result, FitFailure):
        return result
    if not condition_number(result.equations.pose[0]) < SINGULAR_CONDITION:
        return FitFailure("the points do not determine a pose", "show more of the board")
    level = result.equations.chi2 / max(2 * len(view) - 6, 1)
    return BoardSeen(result.state.pose(0), level * np.linalg.inv(result.equations.pose[0]))


def relative_pose(
    left: BoardSeen, right: BoardSeen, new_from_found: Pose[Board, Board]
) -> RelativePose:
    """Eliminate the board (eqs. 4.14 to 4.16) from what both cameras see of it.

    Parameters
    ----------
    left, right
        The board in each camera.
    new_from_found
        How the right view's numbers are to be turned first.
    """
    renumbered = right.camera_from_board @ new_from_found.inverse()
    right_from_board: Pose[CameraRight, Board] = Pose(
        renumbered.rotation, renumbered.translation_mm
    )
    pose = right_from_board @ left.camera_from_board.inverse()
    arm = skew(pose.rotation @ left.camera_from_board.translation_mm)
    by_right, by_left = np.eye(6), np.zeros((6, 6))
    by_right[3:, :3] = arm
    by_left[:3, :3] = by_left[3:, 3:] = -pose.rotation
    by_left[3:, :3] = -arm @ pose.rotation
    # Numbers turned about the board's middle leave the image points, and so the noise of the pose
    # in the camera, as they are; its translation refers to another corner of the board.
    moved = np.eye(6)
    moved[3:, :3] = -skew(renumbered.translation_mm - right.camera_from_board.translation_mm)
    by_right = by_right @ moved
    covariance = by_left @ left.covariance @ by_left.T + by_right @ right.covariance @ by_right.T
    return RelativePose(pose, 0.5 * (covariance + covariance.T))


def differences(
    rotations: FloatArray, translations_mm: FloatArray, reference: Pose[CameraRight, Sensor]
) -> FloatArray:
    """(N, 6) increments, rad and mm, that take ``reference`` to each of N poses."""
    turns = Rotation.from_matrix(rotations @ reference.rotation.T).as_rotvec()
    return np.concatenate([turns, translations_mm - reference.translation_mm], axis=1)
