# SPDX-License-Identifier: Apache-2.0
"""Stripe pixels to Sensor points: the ray of a pixel meets the board's plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.frames import Board, Sensor
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import skew
from armscan.models.camera import CameraModel
from armscan.vision.targets.view import TargetView

GRAZING = 1e-6
"""Rays within this sine of the board's plane do not meet it."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardPoints:
    """Points of a board's plane behind (N, 2) pixels, with derivatives.

    Parameters
    ----------
    points_mm
        (N, 3) in the Sensor frame; NaN where there is none.
    is_valid
        (N,) False where the lens model has no inverse or the ray misses the plane.
    dpoint_dq
        (N, 3, 2) by the pixel, mm/px.
    dpoint_dpose
        (N, 3, 6) by the rotation-vector increment (rad, Sensor frame, from the left) and the
        translation (mm) of ``sensor_from_board``.
    dpoint_dcamera
        (N, 3, 9) by the camera's parameters, the pose being held; (N, 3, P) by those of all
        cameras of a head.
    """

    points_mm: FloatArray
    is_valid: BoolArray
    dpoint_dq: FloatArray
    dpoint_dpose: FloatArray
    dpoint_dcamera: FloatArray


def meet_board(
    q_px: FloatArray, sensor_from_board: Pose[Sensor, Board], camera: CameraModel
) -> BoardPoints:
    """Intersect the rays of (N, 2) full-sensor pixels with the board's plane ``z = 0``.

    The ray is ``(x, y, 1)`` of eq. 2.14 and the plane takes the place of the light sheet in
    eq. 2.21.
    """
    xy, is_valid, dxy_dq, dxy_dcamera = camera.undistort_with_jacobian(q_px)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    normal = sensor_from_board.rotation[:, 2]
    slope = rays @ normal
    is_valid = is_valid & (np.abs(slope) > GRAZING * np.linalg.norm(rays, axis=1))
    slope = np.where(is_valid, slope, 1.0)
    depth = float(normal @ sensor_from_board.translation_mm) / slope
    is_valid = is_valid & (depth > 0.0)
    points = np.where(is_valid[:, None], rays * depth[:, None], np.nan)
    dpoint_dxy = rays[:, :, None] * (-depth / slope)[:, None, None] * normal[None, None, :2]
    dpoint_dxy[:, 0, 0] += depth
    dpoint_dxy[:, 1, 1] += depth
    lever = sensor_from_board.translation_mm - points
    ddepth_dpose = np.zeros((len(xy), 6))
    ddepth_dpose[:, :3] = np.cross(normal, lever)
    ddepth_dpose[:, 3:] = normal
    dpoint_dpose = rays[:, :, None] * (ddepth_dpose / slope[:, None])[:, None, :]
    return BoardPoints(
        points, is_valid, dpoint_dxy @ dxy_dq, dpoint_dpose, dpoint_dxy @ dxy_dcamera
    )


def pose_by_camera(
    view: TargetView, sensor_from_board: Pose[Sensor, Board], camera: CameraModel
) -> FloatArray:
    """(6, 9) derivative of the board's pose, as estimated from ``view``, by the camera.

    The pose minimises the weighted reprojection error, so at the optimum a change of the camera
    moves it by ``-(Jp' W Jp)^-1 Jp' W Jc`` (Gauss-Newton form of the implicit function theorem).
    """
    rotated = view.points_board_mm @ sensor_from_board.rotation.T
    _, dq_dpoint, dq_dcamera = camera.project_with_jacobian(
        rotated + sensor_from_board.translation_mm
    )
    dq_dpose = np.concatenate([-dq_dpoint @ skew(rotated), dq_dpoint], axis=2)
    weight = np.linalg.inv(view.covariance_px2)
    weighted = np.einsum("nki,nkl->nil", dq_dpose, weight)
    normal = np.einsum("nik,nkj->ij", weighted, dq_dpose)
    return np.asarray(-np.linalg.solve(normal, np.einsum("nik,nkj->ij", weighted, dq_dcamera)))
