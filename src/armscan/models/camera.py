# SPDX-License-Identifier: Apache-2.0
"""Pinhole camera with radial and tangential distortion (eqs. 2.11 to 2.18)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, frozen_floats
from armscan.models.distortion import distort, distorted_xy, undistort

PARAMETER_NAMES = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
"""Order of the camera's parameters in every covariance and Jacobian."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel:
    """Intrinsics of the full sensor.

    Parameters
    ----------
    fx_px, fy_px, cx_px, cy_px
        Focal lengths and principal point; pixel (0, 0) is the centre of the top-left pixel.
    distortion
        (5,) ``k1 k2 p1 p2 k3``.
    width_px, height_px
        Size of the full sensor.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: FloatArray
    width_px: int
    height_px: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "distortion", frozen_floats(self.distortion, (5,), "distortion"))
        for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
            object.__setattr__(self, name, float(getattr(self, name)))
        numbers = [self.fx_px, self.fy_px, self.cx_px, self.cy_px]
        if not np.isfinite(numbers).all() or min(self.fx_px, self.fy_px) <= 0.0:
            raise InputError("camera needs positive, finite focal lengths and a finite centre")
        if self.width_px < 1 or self.height_px < 1:
            raise InputError(f"camera size {self.width_px} x {self.height_px} px is not an image")

    @staticmethod
    def from_parameters(parameters: ArrayLike, width_px: int, height_px: int) -> CameraModel:
        """Build a camera from (9,) parameters in the order of `PARAMETER_NAMES`."""
        p = frozen_floats(parameters, (9,), "camera parameters")
        return CameraModel(p[0], p[1], p[2], p[3], p[4:], width_px, height_px)

    @property
    def parameters(self) -> FloatArray:
        """(9,) parameters in the order of `PARAMETER_NAMES`."""
        return np.array([self.fx_px, self.fy_px, self.cx_px, self.cy_px, *self.distortion])

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) intrinsic matrix of eq. 2.18."""
        return np.array(
            [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )

    def project(self, points_sensor_mm: FloatArray) -> FloatArray:
        """Project (N, 3) points in the camera's frame to (N, 2) pixels; NaN behind the camera."""
        points = np.asarray(points_sensor_mm, dtype=np.float64)
        z = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        distorted = distorted_xy(points[:, :2] / z[:, None], self.distortion)
        return np.asarray(distorted * [self.fx_px, self.fy_px] + [self.cx_px, self.cy_px])

    def project_with_jacobian(
        self, points_sensor_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Project points, with derivatives (eqs. 2.14 to 2.18).

        Parameters
        ----------
        points_sensor_mm
            (N, 3) points in the camera's frame.

        Returns
        -------
        q_px
            (N, 2) pixels; NaN where Z <= 0.
        dq_dpoint
            (N, 2, 3) derivative by the point, px/mm.
        dq_dparameters
            (N, 2, 9) derivative by the parameters in the order of `PARAMETER_NAMES`.
        """
        points = np.asarray(points_sensor_mm, dtype=np.float64)
        z = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        xy = points[:, :2] / z[:, None]
        distorted, dd_dxy, dd_dk = distort(xy, self.distortion)
        focal = np.array([self.fx_px, self.fy_px])
        q = distorted * focal + [self.cx_px, self.cy_px]
        dxy_dpoint = np.zeros((len(points), 2, 3))
        dxy_dpoint[:, 0, 0] = dxy_dpoint[:, 1, 1] = 1.0 / z
        dxy_dpoint[:, :, 2] = -xy / z[:, None]
        dq_dpoint = focal[:, None] * (dd_dxy @ dxy_dpoint)
        dq_dparameters = np.zeros((len(points), 2, 9))
        dq_dparameters[:, 0, 0] = distorted[:, 0]
        dq_dparameters[:, 1, 1] = distorted[:, 1]
        dq_dparameters[:, 0, 2] = dq_dparameters[:, 1, 3] = 1.0
        dq_dparameters[:, :, 4:] = focal[:, None] * dd_dk
        return q, dq_dpoint, dq_dparameters

    def undistort(self, q_px: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Map pixels to ideal normalised coordinates ``X/Z, Y/Z``.

        Parameters
        ----------
        q_px
            (N, 2) full-sensor pixels.

        Returns
        -------
        xy
            (N, 2) normalised coordinates (eq. 2.14).
        is_valid
            (N,) False where the distortion model has no inverse.
        """
        q = np.asarray(q_px, dtype=np.float64)
        distorted = (q - [self.cx_px, self.cy_px]) / [self.fx_px, self.fy_px]
        return undistort(distorted, self.distortion)

    def folded_border(self, n_steps: int = 24) -> FloatArray:
        """(K, 2) pixels on the image's border for which the distortion has no inverse.

        Parameters
        ----------
        n_steps
            Pixels tested along each side.
        """
        right, bottom = self.width_px - 1.0, self.height_px - 1.0
        u, v = np.linspace(0.0, right, n_steps), np.linspace(0.0, bottom, n_steps)
        border = np.concatenate(
            [
                np.column_stack([u, np.zeros(n_steps)]),
                np.column_stack([u, np.full(n_steps, bottom)]),
                np.column_stack([np.zeros(n_steps), v]),
                np.column_stack([np.full(n_steps, right), v]),
            ]
        )
        return np.asarray(border[~self.undistort(border)[1]])

    def undistort_with_jacobian(
        self, q_px: FloatArray
    ) -> tuple[FloatArray, BoolArray, FloatArray, FloatArray]:
        """Map pixels to normalised coordinates, with derivatives.

        Returns
        -------
        xy, is_valid
            As from `undistort`.
        dxy_dq
            (N, 2, 2) derivative by the pixel.
        dxy_dparameters
            (N, 2, 9) derivative by the camera's parameters at a fixed pixel.
        """
        xy, is_valid = self.undistort(q_px)
        rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        _, dq_dpoint, dq_dparameters = self.project_with_jacobian(rays)
        dq_dxy = dq_dpoint[:, :, :2].copy()
        dq_dxy[~is_valid] = np.eye(2)
        dxy_dq = np.asarray(np.linalg.inv(dq_dxy), dtype=np.float64)
        return xy, is_valid, dxy_dq, -dxy_dq @ dq_dparameters

    def is_inside(self, q_px: FloatArray, margin_px: float = 0.0) -> BoolArray:
        """(N,) True where a pixel lies on the sensor, at least ``margin_px`` from its border."""
        low = margin_px - 0.5
        return np.asarray(
            (q_px[:, 0] >= low)
            & (q_px[:, 1] >= low)
            & (q_px[:, 0] <= self.width_px - 1 - low)
            & (q_px[:, 1] <= self.height_px - 1 - low)
        )
