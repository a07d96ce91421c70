# SPDX-License-Identifier: Apache-2.0
"""The thesis's fourth method: Hessian of the smoothed image at every pixel (eq. 2.41)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import FloatArray
from armscan.kernels.stripe_hessian import gaussian_taps
from armscan.vision.stripe.centres import StripeCentres, above_background
from armscan.vision.stripe.level import ImageLevel
from armscan.vision.stripe.ridge import hessian_sigma, least_bend

HALF_PIXEL = 0.5


def hessian_centres(
    image: NDArray[np.float32], level: ImageLevel, line_sigma_px: float
) -> StripeCentres:
    """Points where the Taylor polynomial across the line peaks inside its own pixel.

    The image is convolved with the derivatives of a Gaussian (eq. 2.41; Steger 1998); the
    eigenvector of the eigenvalue of largest curvature is the normal.

    Parameters
    ----------
    image
        (H, W) float32.
    level
        Background and threshold; pixels below it are not looked at.
    line_sigma_px
        Typical sigma of the lines, also that of the Gaussian.
    """
    scale = hessian_sigma(line_sigma_px)
    gx, gy, gxx, gxy, gyy = derivative_images(image, scale)
    normals, bend = _principal(gxx, gxy, gyy)
    lit = above_background(image, level) > level.rise
    lit &= bend > least_bend(level.rise, line_sigma_px, scale)
    y, x = np.nonzero(lit)
    n, b = normals[y, x], bend[y, x]
    step = (gx[y, x] * n[:, 0] + gy[y, x] * n[:, 1]) / b
    offset = step[:, None] * n
    inside = (np.abs(offset) <= HALF_PIXEL).all(axis=1)
    points = np.stack([x, y], axis=1)[inside] + offset[inside]
    return StripeCentres(points, n[inside])


def derivative_images(
    image: NDArray[np.float32], scale_px: float
) -> tuple[NDArray[np.float32], ...]:
    """Images d/dx, d/dy, d2/dx2, d2/dxdy, d2/dy2 of the image smoothed at ``scale_px``."""
    g0, g1, g2 = gaussian_taps(scale_px)
    pairs = ((g1, g0), (g0, g1), (g2, g0), (g1, g1), (g0, g2))
    border = cv2.BORDER_REPLICATE
    return tuple(
        np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, a, b, borderType=border), dtype=np.float32)
        for a, b in pairs
    )


def ridge_normals(
    image: NDArray[np.float32], points: FloatArray, line_sigma_px: float
) -> FloatArray:
    """Unit normals (N, 2) of the ridge at the pixels nearest to points (N, 2)."""
    _, _, gxx, gxy, gyy = derivative_images(image, hessian_sigma(line_sigma_px))
    x, y = np.rint(points).astype(np.int64).T
    normals, _ = _principal(gxx[y, x], gxy[y, x], gyy[y, x])
    return normals


def _principal(
    gxx: NDArray[np.float32], gxy: NDArray[np.float32], gyy: NDArray[np.float32]
) -> tuple[FloatArray, FloatArray]:
    """Normals (..., 2) and negative second derivative (...) along them."""
    half = 0.5 * (gxx - gyy).astype(np.float64)
    root = np.hypot(half, gxy)
    is_steep = half < 0.0
    nx = np.where(is_steep, root - half, -gxy)
    ny = np.where(is_steep, -gxy, root + half)
    length = np.hypot(nx, ny)
    flat = length <= 0.0
    length = np.where(flat, 1.0, length)
    normals = np.stack([np.where(flat, 1.0, nx / length), ny / length], axis=-1)
    return normals, root - 0.5 * (gxx + gyy)
