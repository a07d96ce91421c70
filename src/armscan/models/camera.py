# SPDX-License-Identifier: Apache-2.0
"""Pinhole camera with radial and tangential distortion (eqs. 2.11 to 2.18), and fisheye lenses.

Coefficients are ordered ``k1 k2 p1 p2 k3`` as in OpenCV and in the thesis's printed vectors.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from armscan.errors import InputError
from armscan.geometry.arrays import (
    ArrayRecord,
    BoolArray,
    FloatArray,
    floats,
    frozen_floats,
    homogeneous,
)

NEWTON_STEPS = 20
NEWTON_TOLERANCE = 1e-9
"""Step at which the iteration ends; it converges quadratically, so that less error is left."""


Lens = Literal["pinhole", "fisheye"]
"""A radius r = tan(theta) in ideal coordinates is seen at
``r (1 + k1 r^2 + k2 r^4 + k3 r^6)`` by a pinhole with distortion, and at
``theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6)`` by a fisheye, which has no p1, p2: the first
three terms of Kannala and Brandt (2006), as OpenCV's fisheye model with k4 = 0."""
BORDER_PIXELS = 24
"""Tested along each side of the image for a distortion that folds over."""
WIDEST_RAD = np.deg2rad(88.0)
"""Angle from the axis beyond which a ray has no use as X/Z, Y/Z."""
TANGENTIAL = ("p1", "p2")
"""Coefficients that a fisheye has not."""
FISHEYE_FOCALS = np.geomspace(0.15, 1.5, 16)
"""Focal lengths of fisheyes that are tried, over the image's longer side."""
NEAR_AXIS = 1e-12
"""Square of a radius below which a fisheye's terms are those of its series."""


def distorted_xy(xy: FloatArray, coefficients: FloatArray, lens: Lens = "pinhole") -> FloatArray:
    """Distort (N, 2) ideal normalised coordinates, without derivatives (see `distort`)."""
    x, y = _forward(xy[:, 0], xy[:, 1], coefficients, lens)[:2]
    return np.stack([x, y], axis=1)


def distort(
    xy: FloatArray, coefficients: FloatArray, lens: Lens = "pinhole"
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distort ideal normalised image coordinates (eqs. 2.16 and 2.17).

    Parameters
    ----------
    xy
        (N, 2) ideal coordinates ``X/Z, Y/Z``.
    coefficients
        (5,) ``k1 k2 p1 p2 k3``.
    lens
        What the radial terms are powers of, see `Lens`.

    Returns
    -------
    distorted
        (N, 2) distorted coordinates.
    dd_dxy
        (N, 2, 2) derivative by the ideal coordinates.
    dd_dcoefficients
        (N, 2, 5) derivative by the coefficients; by a fisheye's p1, p2, which are zero, as if they
        acted on the angle: what a decentred lens would do.
    """
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    distorted = np.zeros((len(xy), 2))
    dd_dxy = np.zeros((len(xy), 2, 2))
    distorted[:, 0], distorted[:, 1], dd_dxy[:, 0, 0], cross, dd_dxy[:, 1, 1] = _forward(
        x, y, coefficients, lens
    )
    dd_dxy[:, 0, 1] = cross
    dd_dxy[:, 1, 0] = cross
    dd_dcoefficients = np.zeros((len(xy), 2, 5))
    scale, q = _radial_base(r2, lens)
    powers = np.stack([scale * q, scale * q * q, scale * q * q * q], axis=1)
    dd_dcoefficients[:, :, [0, 1, 4]] = xy[:, :, None] * powers[:, None, :]
    u, v = scale * x, scale * y
    dd_dcoefficients[:, 0, 2] = dd_dcoefficients[:, 1, 3] = 2.0 * u * v
    dd_dcoefficients[:, 0, 3] = q + 2.0 * u * u
    dd_dcoefficients[:, 1, 2] = q + 2.0 * v * v
    return distorted, dd_dxy, dd_dcoefficients


def _radial_base(r2: FloatArray, lens: Lens) -> tuple[FloatArray, FloatArray]:
    """Factor of the radius, and the square that a lens's radial terms are powers of."""
    if lens == "pinhole":
        return np.ones_like(r2), r2
    r = np.sqrt(np.maximum(r2, NEAR_AXIS))
    theta = np.arctan(r)
    return np.where(r2 < NEAR_AXIS, 1.0, theta / r), np.where(r2 < NEAR_AXIS, r2, theta * theta)


def _forward(
    x: FloatArray, y: FloatArray, coefficients: FloatArray, lens: Lens
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Distorted x and y, and the derivatives xx, xy = yx, yy: the Jacobian is symmetric."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    scale, q = _radial_base(r2, lens)
    radial = scale * (1.0 + q * (k1 + q * (k2 + q * k3)))
    if lens == "pinhole":
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))
    else:
        growth = (1.0 + q * (3.0 * k1 + q * (5.0 * k2 + q * 7.0 * k3))) / (1.0 + r2)
        slope = np.where(
            r2 < NEAR_AXIS, 2.0 * (k1 - 1.0 / 3.0), (growth - radial) / np.maximum(r2, NEAR_AXIS)
        )
    xy2 = 2.0 * x * y
    return (
        x * radial + p1 * xy2 + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + p2 * xy2,
        radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
        x * y * slope + 2.0 * (p1 * x + p2 * y),
        radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
    )


def fold_radius(coefficients: FloatArray, lens: Lens = "pinhole") -> float:
    """Ideal radius X/Z at which radial distortion stops growing; infinite if it always grows.

    Beyond it the model maps two directions to one pixel (it folds over): neither projection nor
    its inverse mean anything there. A fisheye's is finite: rays end at `WIDEST_RAD`.
    """
    k1, k2, _, _, k3 = coefficients
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
    squares = roots.real[(np.abs(roots.imag) < 1e-12 * np.abs(roots)) & (roots.real > 0.0)]
    largest = float(np.sqrt(squares.min())) if len(squares) else float("inf")
    return largest if lens == "pinhole" else float(np.tan(min(largest, WIDEST_RAD)))


def undistort(
    distorted: FloatArray, coefficients: FloatArray, lens: Lens = "pinhole"
) -> tuple[FloatArray, BoolArray]:
    """Invert eq. 2.17 by Newton's method for (N, 2) distorted normalised coordinates.

    The second value (N,) is False where the model folds over, so that no inverse exists on the
    inner branch; the first is finite there, and of no meaning.
    """
    u, v = distorted[:, 0], distorted[:, 1]
    x, y = u.copy(), v.copy()
    limit = fold_radius(coefficients, lens)
    is_valid = np.isfinite(u) & np.isfinite(v)
    size = np.zeros(len(x))
    for _ in range(NEWTON_STEPS):
        px, py, xx, xy, yy = _forward(x, y, coefficients, lens)
        det = xx * yy - xy * xy
        is_valid &= (det > 0.0) & (xx > 0.0)
        scale = np.where(is_valid, 1.0 / np.where(is_valid, det, 1.0), 0.0)
        ex, ey = np.where(is_valid, px - u, 0.0), np.where(is_valid, py - v, 0.0)
        step_x, step_y = scale * (yy * ex - xy * ey), scale * (xx * ey - xy * ex)
        x, y = x - step_x, y - step_y
        size = np.maximum(np.abs(step_x), np.abs(step_y))
        if size.max(initial=0.0) < NEWTON_TOLERANCE:
            break
    is_valid &= (size < NEWTON_TOLERANCE) & (x * x + y * y < limit * limit)
    return np.stack([x, y], axis=1), is_valid


PARAMETER_NAMES = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
"""Order of the camera's parameters in every covariance and Jacobian."""


class CameraModel(ArrayRecord):
    """Intrinsics of the full sensor.

    Parameters
    ----------
    fx_px, fy_px, cx_px, cy_px
        Focal lengths and principal point; pixel (0, 0) is the centre of the top-left pixel.
    distortion
        (5,) ``k1 k2 p1 p2 k3``.
    width_px, height_px
        Size of the full sensor.
    lens
        Whether the distortion is that of a pinhole or of a fisheye, see `Lens`.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: FloatArray = floats(5)
    width_px: int
    height_px: int
    lens: Lens = "pinhole"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
            object.__setattr__(self, name, float(getattr(self, name)))
        numbers = [self.fx_px, self.fy_px, self.cx_px, self.cy_px]
        if not np.isfinite(numbers).all() or min(self.fx_px, self.fy_px) <= 0.0:
            raise InputError("camera needs positive, finite focal lengths and a finite centre")
        if self.width_px < 1 or self.height_px < 1:
            raise InputError(f"camera size {self.width_px} x {self.height_px} px is not an image")
        if self.lens not in get_args(Lens):
            raise InputError(f"{self.lens!r} is no kind of lens: {', '.join(get_args(Lens))}")
        if self.lens == "fisheye" and np.any(self.distortion[2:4] != 0.0):
            raise InputError("a fisheye lens has no tangential distortion here: p1 and p2 are 0")

    @staticmethod
    def from_parameters(
        parameters: ArrayLike, width_px: int, height_px: int, lens: Lens = "pinhole"
    ) -> CameraModel:
        """Build a camera from (9,) parameters in the order of `PARAMETER_NAMES`."""
        p = frozen_floats(parameters, (9,), "camera parameters")
        return CameraModel(
            fx_px=p[0],
            fy_px=p[1],
            cx_px=p[2],
            cy_px=p[3],
            distortion=p[4:],
            width_px=width_px,
            height_px=height_px,
            lens=lens,
        )

    def moved_to(self, parameters: ArrayLike) -> CameraModel:
        """The same kind of camera with other (9,) parameters."""
        return self.from_parameters(parameters, self.width_px, self.height_px, self.lens)

    @property
    def parameters(self) -> FloatArray:
        """(9,) parameters in the order of `PARAMETER_NAMES`."""
        return np.array([self.fx_px, self.fy_px, self.cx_px, self.cy_px, *self.distortion])

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Those of `PARAMETER_NAMES` that its lens has: a fisheye has no p1, p2."""
        absent = TANGENTIAL if self.lens == "fisheye" else ()
        return tuple(name for name in PARAMETER_NAMES if name not in absent)

    @property
    def numbers(self) -> FloatArray:
        """(11,) parameters, `fold_radius`, and 1 for a fisheye: what kernels ask for."""
        fold = fold_radius(self.distortion, self.lens)
        return np.append(self.parameters, [fold, float(self.lens == "fisheye")])

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
        distorted = distorted_xy(points[:, :2] / z[:, None], self.distortion, self.lens)
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
        distorted, dd_dxy, dd_dk = distort(xy, self.distortion, self.lens)
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
        """Map pixels (N, 2) to ideal normalised coordinates ``X/Z, Y/Z`` (eq. 2.14).

        The second value (N,) is False where the distortion model has no inverse.
        """
        q = np.asarray(q_px, dtype=np.float64)
        distorted = (q - [self.cx_px, self.cy_px]) / [self.fx_px, self.fy_px]
        return undistort(distorted, self.distortion, self.lens)

    def folded_border(self) -> FloatArray:
        """(K, 2) pixels on the image's border for which the distortion has no inverse.

        None of a fisheye whose terms grow up to `WIDEST_RAD`: it sees nothing beyond.
        """
        if fold_radius(self.distortion, self.lens) == np.tan(WIDEST_RAD):
            return np.zeros((0, 2))
        right, bottom = self.width_px - 1.0, self.height_px - 1.0
        u, v = (np.linspace(0.0, end, BORDER_PIXELS) for end in (right, bottom))
        none = np.zeros(BORDER_PIXELS)
        sides = ((u, none), (u, none + bottom), (none, v), (none + right, v))
        border = np.concatenate([np.column_stack(side) for side in sides])
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
        rays = homogeneous(xy)
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
