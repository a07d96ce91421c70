# SPDX-License-Identifier: Apache-2.0
"""Two cameras: projection, epipolar constraint, points from both, and their calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import ArrayRecord, BoolArray, FloatArray, floats, homogeneous
from armscan.geometry.poses import CameraRight, Pose, Sensor
from armscan.geometry.rotations import skew
from armscan.models.calibration import (
    RIGHT_POSE_PARAMETER_NAMES,
    SECOND_PARAMETER_NAMES,
    CameraCalibration,
    Provenance,
    SensorCalibration,
)
from armscan.models.camera import PARAMETER_NAMES, CameraModel

N_CAMERA = len(PARAMETER_NAMES)
N_SECOND = len(SECOND_PARAMETER_NAMES)
"""What a second camera adds: its own parameters, then rotation and translation of its pose."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoViews:
    """A left and a right camera, and the left one's frame, Sensor, in the right (eqs. 4.3-4.5)."""

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
        return self.right_from_left.apply(points_sensor_mm)

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
        q, dq_dright, dq_dcamera = self.right.project_with_jacobian(pose.apply(points_sensor_mm))
        dq_dpose = dq_dright @ pose.jacobian(points_sensor_mm)
        return q, dq_dright @ pose.rotation, np.concatenate([dq_dcamera, dq_dpose], axis=2)

    @property
    def essential(self) -> FloatArray:
        """(3, 3) matrix E with ``x_r' E x_l = 0`` for ideal normalised coordinates of a point.

        It is ``[T]x R`` with the pose's R and T, so that its unit is mm.
        """
        pose = self.right_from_left
        return np.asarray(skew(pose.translation_mm) @ pose.rotation)


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
    left, left_ok, left_dxy_dq, _ = views.left.undistort_with_jacobian(left_px)
    right, right_ok, right_dxy_dq, _ = views.right.undistort_with_jacobian(right_px)
    essential = views.essential
    line_right = homogeneous(left) @ essential.T
    line_left = homogeneous(right) @ essential
    value = np.sum(homogeneous(right) * line_right, axis=1)
    is_valid = left_ok & right_ok
    return (
        _over_gradient(value, line_left, left_dxy_dq, is_valid),
        _over_gradient(value, line_right, right_dxy_dq, is_valid),
    )


def sampson_distances_px(in_left_px: FloatArray, in_right_px: FloatArray) -> FloatArray:
    """(N,) signed distance from the epipolar constraint when both points may move.

    It is the least length by which the two points together, in the four-dimensional space of both
    pixels, have to move until their rays meet (Sampson's distance); with noise of sigma an axis in
    both images its standard deviation is sigma.
    """
    sign = np.where(in_left_px < 0.0, -1.0, 1.0)
    product = np.abs(in_left_px * in_right_px)
    length = np.hypot(in_left_px, in_right_px)
    return np.asarray(sign * product / np.where(length > 0.0, length, 1.0))


def _over_gradient(
    value: FloatArray, line: FloatArray, dxy_dq: FloatArray, is_valid: BoolArray
) -> FloatArray:
    gradient = (line[:, None, :2] @ dxy_dq)[:, 0]
    length = np.linalg.norm(gradient, axis=1)
    is_known = is_valid & (length > 0.0)
    return np.asarray(np.where(is_known, value / np.where(is_known, length, 1.0), np.nan))


GAUSS_NEWTON_STEPS = 20
CONVERGED_MM_PER_MM = 1e-12
"""Relative step at which the iteration ends; it converges quadratically for small residuals."""

PARALLEL_SINE = 1e-9
"""Rays that differ by less than this angle meet nowhere that is known."""


@dataclass(frozen=True, slots=True, eq=False)
class TriangulatedPoints:
    """Points from two images, with what is uncertain in them.

    Parameters
    ----------
    points_sensor_mm
        (N, 3) in the Sensor frame; NaN where not valid.
    noise_mm2
        (N, 3, 3) covariance due to the pixels' noise alone.
    dpoint_dparameters
        (N, 3, 24) derivative by the cameras' parameters at fixed pixels, in the order of
        `armscan.models.two_views.STEREO_PARAMETER_NAMES`.
    chi2
        (N,) squared residuals over the pixels' covariances: one degree of freedom, the distance
        from the epipolar constraint.
    is_valid
        (N,) False where a pixel cannot be undistorted, the rays are parallel, or they meet behind
        a camera.
    """

    points_sensor_mm: FloatArray
    noise_mm2: FloatArray
    dpoint_dparameters: FloatArray
    chi2: FloatArray
    is_valid: BoolArray


def triangulate_points(
    views: TwoViews,
    left_px: FloatArray,
    right_px: FloatArray,
    left_covariance_px2: FloatArray,
    right_covariance_px2: FloatArray,
) -> TriangulatedPoints:
    """Points with the least squared residuals in both images, weighted by the pixels' covariances.

    Gauss-Newton from the point midway between the two rays.

    Pixels (N, 2) are as taken, row by row of one point; their covariances are (N, 2, 2), or (2, 2)
    for all: ``sigma_px**2 * np.eye(2)``.
    """
    n = len(left_px)
    observed = np.concatenate([left_px, right_px], axis=1)
    weight = np.zeros((n, 4, 4))
    weight[:, :2, :2] = np.linalg.inv(left_covariance_px2)
    weight[:, 2:, 2:] = np.linalg.inv(right_covariance_px2)
    start, is_valid = _midway(views, left_px, right_px)
    points = np.where(is_valid[:, None], start, [0.0, 0.0, 1.0])
    for _ in range(GAUSS_NEWTON_STEPS):
        residual, dq_dpoint, _ = _residuals(views, points, observed)
        is_valid &= np.isfinite(residual).all(axis=1)
        normal, right_side = _normal(residual, dq_dpoint, weight, is_valid)
        step = np.linalg.solve(normal, right_side)[:, :, 0]
        points = points + np.where(is_valid[:, None], step, 0.0)
        if np.all(np.abs(step) <= CONVERGED_MM_PER_MM * np.abs(points).max(axis=1)[:, None]):
            break
    residual, dq_dpoint, dq_dparameters = _residuals(views, points, observed)
    is_valid &= np.isfinite(residual).all(axis=1)
    normal, _ = _normal(residual, dq_dpoint, weight, is_valid)
    noise = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    # The point follows the parameters so that the weighted residual stays at its minimum.
    carried = -noise @ dq_dpoint.transpose(0, 2, 1) @ weight @ dq_dparameters
    chi2 = (residual[:, None, :] @ weight @ residual[:, :, None])[:, 0, 0]
    gap = ~is_valid
    points, chi2 = np.where(gap[:, None], np.nan, points), np.where(gap, np.nan, chi2)
    noise[gap], carried[gap] = np.nan, np.nan
    return TriangulatedPoints(
        points_sensor_mm=points,
        noise_mm2=noise,
        dpoint_dparameters=carried,
        chi2=np.asarray(chi2),
        is_valid=is_valid,
    )


def _midway(
    views: TwoViews, left_px: FloatArray, right_px: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Points (N, 3) midway between the rays, and which are ahead of both cameras."""
    left, left_ok = views.left.undistort(left_px)
    right, right_ok = views.right.undistort(right_px)
    sensor_from_right = views.right_from_left.inverse()
    a = homogeneous(left)
    b = sensor_from_right.rotate(homogeneous(right))
    origin = sensor_from_right.translation_mm
    across = np.cross(a, b)
    squares = np.sum(across**2, axis=1)
    lengths = np.sum(a**2, axis=1) * np.sum(b**2, axis=1)
    is_crossing = squares > PARALLEL_SINE**2 * lengths
    below = np.where(is_crossing, squares, 1.0)
    along_a = np.sum(np.cross(origin, b) * across, axis=1) / below
    along_b = np.sum(np.cross(origin, a) * across, axis=1) / below
    points = 0.5 * (along_a[:, None] * a + origin + along_b[:, None] * b)
    is_ahead = (points[:, 2] > 0.0) & (views.points_right_mm(points)[:, 2] > 0.0)
    return points, np.asarray(left_ok & right_ok & is_crossing & is_ahead)


def _residuals(
    views: TwoViews, points: FloatArray, observed: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Observed minus predicted (N, 4); prediction by point (N, 4, 3), by parameters (N, 4, 24)."""
    left, dleft_dpoint, dleft_dcamera = views.left.project_with_jacobian(points)
    right, dright_dpoint, dright_dsecond = views.project_right_with_jacobian(points)
    dq_dparameters = np.zeros((len(points), 4, N_CAMERA + N_SECOND))
    dq_dparameters[:, :2, :N_CAMERA] = dleft_dcamera
    dq_dparameters[:, 2:, N_CAMERA:] = dright_dsecond
    residual = observed - np.concatenate([left, right], axis=1)
    return residual, np.concatenate([dleft_dpoint, dright_dpoint], axis=1), dq_dparameters


def _normal(
    residual: FloatArray, dq_dpoint: FloatArray, weight: FloatArray, is_valid: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Normal matrices (N, 3, 3) and right-hand sides (N, 3, 1); the identity where not valid."""
    weighted = dq_dpoint.transpose(0, 2, 1) @ weight
    normal = np.where(is_valid[:, None, None], weighted @ dq_dpoint, np.eye(3))
    right_side = np.where(is_valid[:, None, None], weighted @ residual[:, :, None], 0.0)
    return normal, right_side


STEREO_PARAMETER_NAMES = (
    *(f"left.{name}" for name in PARAMETER_NAMES),
    *(f"right.{name}" for name in PARAMETER_NAMES),
    *(f"right.{name}" for name in RIGHT_POSE_PARAMETER_NAMES),
)
"""Order of a stereo calibration's covariance."""

IntrinsicsUse = Literal["free", "prior", "fixed"]
"""What calibrations of single cameras are for: nothing, observations beside the images, held."""


@dataclass(frozen=True, slots=True)
class StereoDiagnostics:
    """Evidence of a stereo calibration.

    Parameters
    ----------
    epipolar_rms_px
        Root mean square distance of matched points from each other's epipolar lines (eq. 4.26).
    epipolar_mean_px
        Their signed mean: a bias that no scatter explains.
    left_out
        Images of pairs that do not tell where the cameras are to each other, with the reason.
    intrinsics
        What given calibrations of the cameras were for: ``free`` (none), ``prior`` or ``fixed``.
    hold_out_rms_px
        Reprojection error on pairs that were not used to solve; None without such a test.
    typical_level
        Squared distance of the typical pair's own ``right_from_left`` from the others' over its
        covariance and six degrees of freedom: about 1 where noise is all there is.
    target_error_mm
        By how much the target's points miss their places, one standard deviation an axis.
    """

    epipolar_rms_px: float
    epipolar_mean_px: float
    left_out: tuple[tuple[str, str], ...] = ()
    intrinsics: IntrinsicsUse = "free"
    hold_out_rms_px: float | None = None
    typical_level: float = 1.0
    target_error_mm: float = 0.0


class StereoCalibration(ArrayRecord):
    """A left and a right camera that see one target at one instant.

    Parameters
    ----------
    left, right
        The cameras; each one's own ``covariance`` is its block of the joint one.
    right_from_left
        Pose of the left camera, which is the Sensor frame, in the right camera's (eqs. 4.15 and
        4.16: ``R_LR``, ``T_LR``).
    covariance
        (24, 24) in the order of `STEREO_PARAMETER_NAMES`.
    rms_px
        Root mean square over all points of both cameras of the residual vector's length.
    n_pairs, n_points
        What was used; a point that both cameras see counts once.
    provenance
        How it came to be.
    diagnostics
        Evidence for a reader; None where there is none.
    """

    left: CameraCalibration
    right: CameraCalibration
    right_from_left: Pose[CameraRight, Sensor]
    covariance: FloatArray = floats(24, 24)
    rms_px: float
    n_pairs: int
    n_points: int
    provenance: Provenance
    diagnostics: StereoDiagnostics | None = None
