# SPDX-License-Identifier: Apache-2.0
"""Which corners lie where the others say?

A flat board seen through any lens is a homography followed by a smooth field: a polynomial of
third degree over the image holds distortion and a bow. A corner that a light stripe or a shadow
pulled lies off it by many times the scatter of the rest.
"""

from __future__ import annotations

import cv2
import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray

_OUTLIER_SIGMAS = 6.0
_TUKEY = 4.7
_HOMOGRAPHIES, _ROUNDS = 3, 6
_TRUSTED = 0.1
"""Least weight with which a point helps to fix the homography."""
_POINTS_PER_TERM = 3.0
"""Fewest points per term of the polynomial; fewer let it follow a single corner."""


def off_lattice(
    board: FloatArray, points_px: FloatArray, least_sigma_px: FloatArray, tolerance_px: float
) -> tuple[BoolArray, float]:
    """Tell which of N corners are off the lattice that the others make.

    Parameters
    ----------
    board
        (N, 2) places on the board, any unit.
    points_px
        (N, 2) image points.
    least_sigma_px
        (N,) their standard deviations; the scatter found is not taken to be smaller.
    tolerance_px
        What a print's own errors may be; corners that are off by less stay.

    Returns
    -------
    is_off
        (N,) True for corners to leave out.
    scatter_px
        Robust standard deviation, per axis, of the rest; infinite if there is no homography.
    """
    weights = np.ones(len(board))
    size = scatter = np.full(len(board), np.inf)
    for _ in range(_HOMOGRAPHIES):
        trusted = weights > _TRUSTED
        if trusted.sum() < 4:
            break
        homography, _ = cv2.findHomography(board[trusted], points_px[trusted], 0)
        if homography is None:
            break
        image = np.column_stack([board, np.ones(len(board))]) @ np.asarray(homography).T
        mapped = np.asarray(image[:, :2] / image[:, 2:], dtype=np.float64)
        field = _terms(mapped)
        for _ in range(_ROUNDS):
            size = np.hypot(*_without_itself(field, points_px - mapped, weights).T)
            # The median length of a two-dimensional normal is 1.18 sigma.
            scatter = np.maximum(np.median(size) / 1.1774, least_sigma_px)
            weights = np.clip(1.0 - (size / (_TUKEY * 1.5 * scatter)) ** 2, 1e-3, None) ** 2
    is_off = size > np.maximum(_OUTLIER_SIGMAS * scatter, tolerance_px)
    return is_off, float(np.median(size) / 1.1774)


def _without_itself(field: FloatArray, residual: FloatArray, weights: FloatArray) -> FloatArray:
    """Distance (N, 2) of each point from the smooth field through the others."""
    root = np.sqrt(weights)[:, None]
    q, _ = np.linalg.qr(field * root)
    smooth = q @ (q.T @ (residual * root)) / root
    leverage = np.einsum("np,np->n", q, q)
    return np.asarray((residual - smooth) / np.maximum(1.0 - leverage, 0.05)[:, None])


def _terms(image: FloatArray) -> FloatArray:
    """Polynomial terms (N, P) over the image, as many as the points can bear."""
    middle = 0.5 * (image.min(axis=0) + image.max(axis=0))
    x, y = ((image - middle) / np.maximum(0.5 * np.ptp(image, axis=0), 1e-9)).T
    terms = [np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
    for count in (10, 6, 3):
        if len(image) >= _POINTS_PER_TERM * count:
            return np.stack(terms[:count], axis=-1)
    return np.stack(terms[:1], axis=-1)
