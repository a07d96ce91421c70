# SPDX-License-Identifier: Apache-2.0
"""Points from two images: the thesis's closed form (eq. 4.7) and least squares in both images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.models.two_views import N_CAMERA, N_SECOND, TwoViews

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
    by_parameters
        (N, 3, 24) derivative by the cameras' parameters at fixed pixels, in the order of
        `armscan.models.stereo.STEREO_PARAMETER_NAMES`.
    chi2
        (N,) squared residuals over the pixels' covariances: one degree of freedom, the distance
        from the epipolar constraint.
    is_valid
        (N,) False where a pixel cannot be undistorted, the rays are parallel, or they meet behind
        a camera.
    """

    points_sensor_mm: FloatArray
    noise_mm2: FloatArray
    by_parameters: FloatArray
    chi2: FloatArray
    is_valid: BoolArray


def triangulate_directly(views: TwoViews, left_px: FloatArray, right_px: FloatArray) -> FloatArray:
    """Points by the closed form of eq. 4.7.

    It uses both coordinates of the left pixel and the first one of the right; what the second one
    says against them is not looked at. Ideal normalised coordinates take the place of
    ``u / f``, so that the two focal lengths of a camera may differ and the lens may distort.

    Parameters
    ----------
    views
        The cameras.
    left_px, right_px
        (N, 2) pixels as taken, row by row of one point.

    Returns
    -------
    points_sensor_mm
        (N, 3); NaN where a pixel cannot be undistorted, the point lies behind the left camera, or
        the epipolar line runs along v in the right image, so that its u says nothing.
    """
    left, left_ok = views.left.undistort(left_px)
    right, right_ok = views.right.undistort(right_px)
    rotation = views.right_from_left.rotation
    translation = views.right_from_left.translation_mm
    rays = np.concatenate([left, np.ones((len(left), 1))], axis=1)
    turned = rays @ rotation.T
    u = right[:, 0]
    below = u * turned[:, 2] - turned[:, 0]
    above = translation[0] - u * translation[2]
    is_known = left_ok & right_ok & (np.abs(below) > PARALLEL_SINE)
    depth = np.where(is_known, above / np.where(is_known, below, 1.0), np.nan)
    depth = np.where(depth > 0.0, depth, np.nan)
    return np.asarray(depth[:, None] * rays)


def triangulate_points(
    views: TwoViews,
    left_px: FloatArray,
    right_px: FloatArray,
    left_covariance_px2: FloatArray,
    right_covariance_px2: FloatArray,
) -> TriangulatedPoints:
    """Points with the least squared residuals in both images, weighted by the pixels' covariances.

    Gauss-Newton from the point midway between the two rays.

    Parameters
    ----------
    views
        The cameras.
    left_px, right_px
        (N, 2) pixels as taken, row by row of one point.
    left_covariance_px2, right_covariance_px2
        (N, 2, 2) covariances of the pixels, or (2, 2) for all: ``sigma_px**2 * np.eye(2)``.
    """
    n = len(left_px)
    observed = np.concatenate([left_px, right_px], axis=1)
    weight = np.zeros((n, 4, 4))
    weight[:, :2, :2] = np.linalg.inv(left_covariance_px2)
    weight[:, 2:, 2:] = np.linalg.inv(right_covariance_px2)
    start, is_valid = _midway(views, left_px, right_px)
    points = np.where(is_valid[:, None], start, [0.0, 0.0, 1.0])
    for _ in range(GAUSS_NEWTON_STEPS):
        residual, by_point, _ = _residuals(views, points, observed)
        is_valid &= np.isfinite(residual).all(axis=1)
        normal, right_side = _normal(residual, by_point, weight, is_valid)
        step = np.linalg.solve(normal, right_side)[:, :, 0]
        points = points + np.where(is_valid[:, None], step, 0.0)
        if np.all(np.abs(step) <= CONVERGED_MM_PER_MM * np.abs(points).max(axis=1)[:, None]):
            break
    residual, by_point, by_parameters = _residuals(views, points, observed)
    is_valid &= np.isfinite(residual).all(axis=1)
    normal, _ = _normal(residual, by_point, weight, is_valid)
    noise = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    # The point follows the parameters so that the weighted residual stays at its minimum.
    carried = -noise @ by_point.transpose(0, 2, 1) @ weight @ by_parameters
    chi2 = (residual[:, None, :] @ weight @ residual[:, :, None])[:, 0, 0]
    gap = ~is_valid
    points, chi2 = np.where(gap[:, None], np.nan, points), np.where(gap, np.nan, chi2)
    noise[gap], carried[gap] = np.nan, np.nan
    return TriangulatedPoints(points, noise, carried, np.asarray(chi2), is_valid)


def _midway(
    views: TwoViews, left_px: FloatArray, right_px: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Points (N, 3) midway between the rays, and which are ahead of both cameras."""
    left, left_ok = views.left.undistort(left_px)
    right, right_ok = views.right.undistort(right_px)
    sensor_from_right = views.right_from_left.inverse()
    ones = np.ones((len(left), 1))
    a = np.concatenate([left, ones], axis=1)
    b = np.concatenate([right, ones], axis=1) @ sensor_from_right.rotation.T
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
    left, left_by_point, left_by_camera = views.left.project_with_jacobian(points)
    right, right_by_point, right_by_second = views.project_right_with_jacobian(points)
    by_parameters = np.zeros((len(points), 4, N_CAMERA + N_SECOND))
    by_parameters[:, :2, :N_CAMERA] = left_by_camera
    by_parameters[:, 2:, N_CAMERA:] = right_by_second
    residual = observed - np.concatenate([left, right], axis=1)
    return residual, np.concatenate([left_by_point, right_by_point], axis=1), by_parameters


def _normal(
    residual: FloatArray, by_point: FloatArray, weight: FloatArray, is_valid: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Normal matrices (N, 3, 3) and right-hand sides (N, 3, 1); the identity where not valid."""
    weighted = by_point.transpose(0, 2, 1) @ weight
    normal = np.where(is_valid[:, None, None], weighted @ by_point, np.eye(3))
    right_side = np.where(is_valid[:, None, None], weighted @ residual[:, :, None], 0.0)
    return normal, right_side
