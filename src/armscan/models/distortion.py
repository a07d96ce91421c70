# SPDX-License-Identifier: Apache-2.0
"""Radial and tangential lens distortion, with derivatives.

Coefficients are ordered ``k1 k2 p1 p2 k3`` as in OpenCV and in the thesis's printed vectors.
"""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray

NEWTON_STEPS = 20
NEWTON_TOLERANCE = 1e-9
"""Step at which the iteration ends; it converges quadratically, so that less error is left."""


def distorted_xy(xy: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Distort (N, 2) ideal normalised coordinates, without derivatives (see `distort`)."""
    x, y = _forward(xy[:, 0], xy[:, 1], coefficients)[:2]
    return np.stack([x, y], axis=1)


def distort(xy: FloatArray, coefficients: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distort ideal normalised image coordinates (eqs. 2.16 and 2.17).

    Parameters
    ----------
    xy
        (N, 2) ideal coordinates ``X/Z, Y/Z``.
    coefficients
        (5,) ``k1 k2 p1 p2 k3``.

    Returns
    -------
    distorted
        (N, 2) distorted coordinates.
    dd_dxy
        (N, 2, 2) derivative by the ideal coordinates.
    dd_dcoefficients
        (N, 2, 5) derivative by the coefficients.
    """
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    distorted = np.zeros((len(xy), 2))
    dd_dxy = np.zeros((len(xy), 2, 2))
    distorted[:, 0], distorted[:, 1], dd_dxy[:, 0, 0], cross, dd_dxy[:, 1, 1] = _forward(
        x, y, coefficients
    )
    dd_dxy[:, 0, 1] = cross
    dd_dxy[:, 1, 0] = cross
    dd_dcoefficients = np.zeros((len(xy), 2, 5))
    powers = np.stack([r2, r2 * r2, r2 * r2 * r2], axis=1)
    dd_dcoefficients[:, :, [0, 1, 4]] = xy[:, :, None] * powers[:, None, :]
    dd_dcoefficients[:, 0, 2] = dd_dcoefficients[:, 1, 3] = 2.0 * x * y
    dd_dcoefficients[:, 0, 3] = r2 + 2.0 * x * x
    dd_dcoefficients[:, 1, 2] = r2 + 2.0 * y * y
    return distorted, dd_dxy, dd_dcoefficients


def _forward(
    x: FloatArray, y: FloatArray, coefficients: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Distorted x and y, and the derivatives xx, xy = yx, yy: the Jacobian is symmetric."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))
    xy2 = 2.0 * x * y
    return (
        x * radial + p1 * xy2 + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + p2 * xy2,
        radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
        x * y * slope + 2.0 * (p1 * x + p2 * y),
        radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
    )


def fold_radius(coefficients: FloatArray) -> float:
    """Ideal radius X/Z at which radial distortion stops growing; infinite if it always grows.

    Beyond it the model maps two directions to one pixel (it folds over): neither projection nor
    its inverse mean anything there.
    """
    k1, k2, _, _, k3 = coefficients
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
    squares = roots.real[(np.abs(roots.imag) < 1e-12 * np.abs(roots)) & (roots.real > 0.0)]
    return float(np.sqrt(squares.min())) if len(squares) else float("inf")


def undistort(distorted: FloatArray, coefficients: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Invert eq. 2.17 by Newton's method.

    Parameters
    ----------
    distorted
        (N, 2) distorted normalised coordinates.
    coefficients
        (5,) ``k1 k2 p1 p2 k3``.

    Returns
    -------
    xy
        (N, 2) ideal coordinates; where not valid, of no meaning but finite.
    is_valid
        (N,) False where the model folds over, so that no inverse exists on the inner branch.
    """
    u, v = distorted[:, 0], distorted[:, 1]
    x, y = u.copy(), v.copy()
    limit = fold_radius(coefficients)
    is_valid = np.isfinite(u) & np.isfinite(v)
    size = np.zeros(len(x))
    for _ in range(NEWTON_STEPS):
        px, py, xx, xy, yy = _forward(x, y, coefficients)
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
