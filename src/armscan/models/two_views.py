# SPDX-License-Identifier: Apache-2.0
"""Two cameras and where they are to each other: projection and the epipolar constraint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.frames import CameraRight, Sensor
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import skew
from armscan.models.calibration import SECOND_PARAMETER_NAMES, SensorCalibration
from armscan.models.camera import PARAMETER_NAMES, CameraModel

N_CAMERA = len(PARAMETER_NAMES)
N_SECOND = len(SECOND_PARAMETER_NAMES)
"""What a second camera adds: its own parameters, then rotation and translation of its pose."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoViews:
    """A left and a right camera.

    Parameters
    ----------
    left, right
        The cameras.
    right_from_left
        Pose of the left camera, which is the Sensor frame, in the right camera's (eqs. 4.3 to 4.5;
        ``R_LR``, ``T_LR`` of eqs. 4.15 and 4.16).
    """

    left: CameraModel
    right: CameraModel
    right_from_left: Pose[CameraRight, Sensor]

    @staticmethod
    def of_sensor(sensor: SensorCalibration) -> TwoViews:
        """The two cameras of a stereo head's sensor.

        Raises
        ------
        InputError
            If the sensor has one camera.
        """
        if sensor.second is None:
            raise InputError(
                "the sensor has one camera", remedy="use the sensor of a head with two cameras"
            )
        return TwoViews(
            sensor.camera.camera, sensor.second.camera.camera, sensor.second.right_from_sensor
        )

    def points_right_mm(self, points_sensor_mm: FloatArray) -> FloatArray:
        """(N, 3) points of the Sensor frame in the right camera's (eqs. 4.3 and 4.17)."""
        pose = self.right_from_left
        return np.asarray(points_sensor_mm @ pose.rotation.T + pose.translation_mm)

    def project_right(self, points_sensor_mm: FloatArray) -> FloatArray:
        """Project (N, 3) points into the right image (eqs. 4.17 and 4.18); NaN behind it."""
        return self.right.project(self.points_right_mm(points_sensor_mm))

    def project_right_with_jacobian(
        self, points_sensor_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Project points into the right image, with derivatives (eqs. 4.17 and 4.18).

        Parameters
        ----------
        points_sensor_mm
            (N, 3) points in the Sensor frame.

        Returns
        -------
        q_px
            (N, 2) pixels of the right image; NaN behind the camera.
        dq_dpoint
            (N, 2, 3) derivative by the point in the Sensor frame, px/mm.
        dq_dsecond
            (N, 2, 15) derivative by what the second camera adds, in the order of
            `armscan.models.calibration.SECOND_PARAMETER_NAMES`. The left camera's parameters move
            nothing in the right image while the point stays.
        """
        pose = self.right_from_left
        turned = np.asarray(points_sensor_mm, dtype=np.float64) @ pose.rotation.T
        q, by_right_point, by_camera = self.right.project_with_jacobian(
            turned + pose.translation_mm
        )
        by_second = np.concatenate(
            [by_camera, -by_right_point @ skew(turned), by_right_point], axis=2
        )
        return q, by_right_point @ pose.rotation, by_second

    @property
    def essential(self) -> FloatArray:
        """(3, 3) matrix E with ``x_r' E x_l = 0`` for ideal normalised coordinates of a point.

        It is ``[T]x R`` with the pose's R and T, so that its unit is mm.
        """
        pose = self.right_from_left
        return np.asarray(skew(pose.translation_mm) @ pose.rotation)

    @property
    def fundamental(self) -> FloatArray:
        """(3, 3) matrix F of eq. 4.26, ``p_r' F p_l = 0``, for pixels free of distortion."""
        left, right = np.linalg.inv(self.left.matrix), np.linalg.inv(self.right.matrix)
        return np.asarray(right.T @ self.essential @ left)


def epipolar_distances_px(
    views: TwoViews, left_px: FloatArray, right_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Signed distances of matched points from each other's epipolar lines, in each image's pixels.

    A lens bends the epipolar line of eq. 4.26 to a curve. The distance given is that from the
    curve in the image as taken: the value of ``x_r' E x_l`` over the length of its gradient by the
    point's own pixel, correct to first order in the distance.

    Parameters
    ----------
    views
        The cameras.
    left_px, right_px
        (N, 2) pixels as taken, row by row of one point.

    Returns
    -------
    in_left_px, in_right_px
        (N,) distance of the left point from the right point's curve in the left image, and of the
        right point from the left point's curve in the right image. Both have the sign of
        ``x_r' E x_l``, which swapping the cameras leaves as it is. NaN where a pixel lies beyond
        the part of the image that the distortion model can invert, and in an epipole.
    """
    left, left_ok, left_by_px, _ = views.left.undistort_with_jacobian(left_px)
    right, right_ok, right_by_px, _ = views.right.undistort_with_jacobian(right_px)
    essential = views.essential
    line_right = _homogeneous(left) @ essential.T
    line_left = _homogeneous(right) @ essential
    value = np.sum(_homogeneous(right) * line_right, axis=1)
    is_valid = left_ok & right_ok
    return (
        _over_gradient(value, line_left, left_by_px, is_valid),
        _over_gradient(value, line_right, right_by_px, is_valid),
    )


def sampson_distances_px(in_left_px: FloatArray, in_right_px: FloatArray) -> FloatArray:
    """(N,) signed distance from the epipolar constraint when both points may move.

    It is the least length by which the two points together, in the four-dimensional space of both
    pixels, have to move until their rays meet (Sampson's distance); with noise of sigma an axis in
    both images its standard deviation is sigma.

    Parameters
    ----------
    in_left_px, in_right_px
        From `epipolar_distances_px`.
    """
    sign = np.where(in_left_px < 0.0, -1.0, 1.0)
    product = np.abs(in_left_px * in_right_px)
    length = np.hypot(in_left_px, in_right_px)
    return np.asarray(sign * product / np.where(length > 0.0, length, 1.0))


def _homogeneous(xy: FloatArray) -> FloatArray:
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=1)


def _over_gradient(
    value: FloatArray, line: FloatArray, by_px: FloatArray, is_valid: BoolArray
) -> FloatArray:
    gradient = (line[:, None, :2] @ by_px)[:, 0]
    length = np.linalg.norm(gradient, axis=1)
    is_known = is_valid & (length > 0.0)
    return np.asarray(np.where(is_known, value / np.where(is_known, length, 1.0), np.nan))
