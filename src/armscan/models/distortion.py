# SPDX-License-Identifier: Apache-2.0
"""Radial and tangential lens distortion, with derivatives.

Coefficients are ordered ``k1 k2 p1 p2 k3`` as in OpenCV and in the thesis's printed vectors.
"""

from __future__ import annotations

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray

NEWTON_STEPS = 20
NEWTON_TOLERANCE = 1e-13


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
    k1, k2, p1, p2, k3 = coefficients
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    dradial_dr2 = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)
    distorted = np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=1,
    )
    dd_dxy = np.zeros((len(xy), 2, 2))
    dd_dxy[:, 0, 0] = radial + 2.0 * x * x * dradial_dr2 + 2.0 * p1 * y + 6.0 * p2 * x
    dd_dxy[:, 1, 1] = radial + 2.0 * y * y * dradial_dr2 + 6.0 * p1 * y + 2.0 * p2 * x
    cross = 2.0 * x * y * dradial_dr2 + 2.0 * p1 * x + 2.0 * p2 * y
    dd_dxy[:, 0, 1] = cross
    dd_dxy[:, 1, 0] = cross
    dd_dcoefficients = np.zeros((len(xy), 2, 5))
    powers = np.stack([r2, r2 * r2, r2 * r2 * r2], axis=1)
    dd_dcoefficients[:, :, [0, 1, 4]] = xy[:, :, None] * powers[:, None, :]
    dd_dcoefficients[:, 0, 2] = dd_dcoefficients[:, 1, 3] = 2.0 * x * y
    dd_dcoefficients[:, 0, 3] = r2 + 2.0 * x * x
    dd_dcoefficients[:, 1, 2] = r2 + 2.0 * y * y
    return distorted, dd_dxy, dd_dcoefficients


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
        (N, 2) ideal coordinates.
    is_valid
        (N,) False where the model folds over, so that no inverse exists on the inner branch.
    """
    xy = distorted.copy()
    is_valid = np.ones(len(xy), dtype=np.bool_)
    for _ in range(NEWTON_STEPS):
        predicted, jacobian, _ = distort(xy, coefficients)
        error = predicted - distorted
        det = np.linalg.det(jacobian)
        is_valid &= det > 0.0
        safe = np.where(det > 0.0, det, 1.0)
        step = (
            np.stack(
                [
                    jacobian[:, 1, 1] * error[:, 0] - jacobian[:, 0, 1] * error[:, 1],
                    jacobian[:, 0, 0] * error[:, 1] - jacobian[:, 1, 0] * error[:, 0],
                ],
                axis=1,
            )
            / safe[:, None]
        )
        xy = np.where(is_valid[:, None], xy - step, xy)
        if not step.size or float(np.abs(step).max(initial=0.0, where=is_valid[:, None])) < (
            NEWTON_TOLERANCE
        ):
            break
    else:
        is_valid &= np.abs(step).max(axis=1) < 1e-9
    return xy, is_valid


def check_coefficients(coefficients: FloatArray) -> None:
    """Raise `InputError` if ``coefficients`` are not five finite numbers."""
    if coefficients.shape != (5,) or not np.isfinite(coefficients).all():
        raise InputError("distortion must be the five finite numbers k1 k2 p1 p2 k3")
