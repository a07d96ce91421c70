# SPDX-License-Identifier: Apache-2.0
"""Boards and stripes seen by the second camera, in the Sensor frame, with all derivatives.

Parameters of the cameras are in the order of `armscan.models.stereo.STEREO_PARAMETER_NAMES`: left
9, right 9, pose 6.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.calibration.laser.cameras import HeadCameras
from armscan.calibration.laser.ray_board import BoardPoints, meet_board, pose_by_camera
from armscan.calibration.laser.result import PlacedBoard
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import Estimate
from armscan.geometry.frames import Board, CameraRight, Sensor
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import rotation_from_vector, skew, vector_from_rotation
from armscan.models.light_sheet import LightSheet
from armscan.vision.targets.view import TargetView

RIGHT_CAMERA = slice(9, 18)
RIGHT_POSE = slice(18, 24)


def meet_board_of(
    q_px: FloatArray, camera: int, sensor_from_board: Pose[Sensor, Board], cameras: HeadCameras
) -> BoardPoints:
    """Intersect the rays of (N, 2) pixels of one of the cameras with a board.

    As `meet_board`, with the points in the Sensor frame and derivatives by the parameters of all
    cameras.
    """
    if camera == 0:
        points = meet_board(q_px, sensor_from_board, cameras.left.camera)
        return BoardPoints(
            points.points_mm,
            points.is_valid,
            points.dpoint_dq,
            points.dpoint_dpose,
            cameras.by_parameters(points.dpoint_dcamera),
        )
    second = cameras.right()
    place = second.right_from_sensor
    turn, shift = place.rotation, place.translation_mm
    right_from_board: Pose[CameraRight, Board] = place @ sensor_from_board
    # The function knows one frame: to it, the right camera's is the sensor's.
    as_sensor: Pose[Sensor, Board] = Pose(
        right_from_board.rotation, right_from_board.translation_mm
    )
    seen = meet_board(q_px, as_sensor, second.camera.camera)
    back = turn.T
    follow = np.zeros((6, 6))
    follow[:3, :3] = np.eye(3)
    follow[3:, :3] = -skew(turn @ sensor_from_board.translation_mm)
    follow[3:, 3:] = np.eye(3)
    carried = np.concatenate(
        [skew(seen.points_mm - shift), np.tile(-np.eye(3), (len(q_px), 1, 1))], axis=2
    )
    by_cameras = np.zeros((len(q_px), 3, cameras.n_parameters))
    by_cameras[:, :, RIGHT_CAMERA] = back @ seen.dpoint_dcamera
    by_cameras[:, :, RIGHT_POSE] = back @ (seen.dpoint_dpose @ follow + carried)
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = turn
    return BoardPoints(
        (seen.points_mm - shift) @ turn,
        seen.is_valid,
        back @ seen.dpoint_dq,
        back @ seen.dpoint_dpose @ turned,
        by_cameras,
    )


def meet_sheet_of(
    q_px: FloatArray, camera: int, sheet: LightSheet, cameras: HeadCameras
) -> tuple[FloatArray, BoolArray]:
    """Points (N, 3) in Sensor where the rays of pixels (N, 2) of one camera meet a sheet.

    With the second value (N,), False where there is none; what reconstruction does with a stripe.
    """
    xy, has_ray = cameras.model(camera).undistort(q_px)
    if camera == 0:
        points, is_met = sheet.intersect(xy)
        return points, is_met & has_ray
    place = cameras.right().right_from_sensor
    points, is_met = sheet.in_frame(place.rotation, place.translation_mm).intersect(xy)
    return (points - place.translation_mm) @ place.rotation, is_met & has_ray


def place_board(
    seen: Sequence[tuple[int, TargetView, Estimate[Pose[Sensor, Board]]]], cameras: HeadCameras
) -> PlacedBoard:
    """Pose of a board in Sensor from what one or both cameras saw of it.

    Parameters
    ----------
    seen
        Camera, target, and the board's pose in that camera's own frame as
        `armscan.calibration.camera.board_pose.estimate_board_pose` gives it, one entry a camera.
    cameras
        The cameras.

    Returns
    -------
    PlacedBoard
        Mean of the poses weighted by their covariances, the cameras being held; the derivative
        tells how it follows the cameras' errors, which the two views do not share.
    """
    poses = [_in_sensor(camera, view, found, cameras) for camera, view, found in seen]
    first = poses[0]
    if len(poses) == 1:
        return first
    second = poses[1]
    information = [np.linalg.inv(pose.covariance) for pose in poses]
    covariance = np.linalg.inv(information[0] + information[1])
    gain = covariance @ information[1]
    a, b = first.sensor_from_board, second.sensor_from_board
    step = gain @ _apart(a, b)
    pose: Pose[Sensor, Board] = Pose(
        rotation_from_vector(step[:3]) @ a.rotation, a.translation_mm + step[3:]
    )
    follow = first.by_cameras + gain @ (second.by_cameras - first.by_cameras)
    return PlacedBoard(pose, 0.5 * (covariance + covariance.T), follow)


def _in_sensor(
    camera: int,
    view: TargetView,
    found: Estimate[Pose[Sensor, Board]],
    cameras: HeadCameras,
) -> PlacedBoard:
    own = pose_by_camera(view, found.value, cameras.model(camera))
    if camera == 0:
        return PlacedBoard(found.value, found.covariance, cameras.by_parameters(own))
    place = cameras.right().right_from_sensor
    back, offset = place.rotation.T, found.value.translation_mm - place.translation_mm
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = back
    follow = np.zeros((6, cameras.n_parameters))
    follow[:, RIGHT_CAMERA] = turned @ own
    follow[:3, 18:21] = -back
    follow[3:, 18:21] = back @ skew(offset)
    follow[3:, 21:24] = -back
    pose: Pose[Sensor, Board] = Pose(back @ found.value.rotation, back @ offset)
    return PlacedBoard(pose, turned @ found.covariance @ turned.T, follow)


def poses_chi2(
    left: tuple[int, TargetView, Estimate[Pose[Sensor, Board]]],
    right: tuple[int, TargetView, Estimate[Pose[Sensor, Board]]],
    cameras: HeadCameras,
) -> float:
    """How far two cameras disagree about a board: 6 on average, the cameras' errors included."""
    a, b = (_in_sensor(*item, cameras) for item in (left, right))
    follow = b.by_cameras - a.by_cameras
    covariance = a.covariance + b.covariance + follow @ cameras.covariance @ follow.T
    apart = _apart(a.sensor_from_board, b.sensor_from_board)
    return float(apart @ np.linalg.solve(covariance, apart))


def _apart(a: Pose[Sensor, Board], b: Pose[Sensor, Board]) -> FloatArray:
    """(6,) step from pose a to pose b: rotation vector from the left, then translation."""
    return np.concatenate(
        [vector_from_rotation(b.rotation @ a.rotation.T), b.translation_mm - a.translation_mm]
    )
