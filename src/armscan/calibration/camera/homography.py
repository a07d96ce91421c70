# SPDX-License-Identifier: Apache-2.0
"""Homography from a flat target to the image (eqs. 2.27 to 2.29)."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure

MIN_POINTS = 4
COLLINEAR_RATIO = 1e-3
"""Width over length of a point set below which it counts as a line."""

REFINEMENT_STEPS = 6


def estimate_homography(board_xy: FloatArray, image_xy: FloatArray) -> FloatArray | FitFailure:
    """Fit ``s m' = H M'`` (eq. 2.29): normalised linear solution, then least squares in the image.

    Parameters
    ----------
    board_xy
        (M, 2) points on the board, in any unit.
    image_xy
        (M, 2) image points, in pixels or normalised coordinates.

    Returns
    -------
    homography
        (3, 3), scaled to unit Frobenius norm, that maps the points to positive third coordinates;
        or why there is none.
    """
    if len(board_xy) < MIN_POINTS:
        return FitFailure(f"{len(board_xy)} points, a homography needs {MIN_POINTS}")
    if flatness(board_xy) < COLLINEAR_RATIO or flatness(image_xy) < COLLINEAR_RATIO:
        return FitFailure("the points lie on one line", "turn the board towards the camera")
    board_norm, image_norm = _normaliser(board_xy), _normaliser(image_xy)
    board = _apply(board_norm, board_xy)
    image = _apply(image_norm, image_xy)
    inner = _refine(_linear(board, image), board, image)
    homography = np.linalg.inv(image_norm) @ inner @ board_norm
    depth = homography[2, :2] @ board_xy.mean(axis=0) + homography[2, 2]
    homography = homography / np.linalg.norm(homography) * (1.0 if depth > 0.0 else -1.0)
    if not np.isfinite(homography).all():
        return FitFailure("the points do not fit a flat target")
    return np.asarray(homography)


def map_points(homography: FloatArray, xy: FloatArray) -> FloatArray:
    """Map (M, 2) points by a (3, 3) homography."""
    return _apply(homography, xy)


def flatness(xy: FloatArray) -> float:
    """Ratio of the smaller to the larger extent of (M, 2) points: 0 for points on a line."""
    singular = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
    return float(singular[1] / singular[0]) if singular[0] > 0.0 else 0.0


def _normaliser(xy: FloatArray) -> FloatArray:
    centre = xy.mean(axis=0)
    scale = float(np.sqrt(2.0 / np.mean(np.sum((xy - centre) ** 2, axis=1))))
    matrix = np.diag([scale, scale, 1.0])
    matrix[:2, 2] = -scale * centre
    return matrix


def _apply(homography: FloatArray, xy: FloatArray) -> FloatArray:
    mapped = xy @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def _linear(board: FloatArray, image: FloatArray) -> FloatArray:
    ones = np.ones(len(board))
    rows = np.stack([board[:, 0], board[:, 1], ones], axis=1)
    system = np.zeros((2 * len(board), 9))
    system[0::2, 0:3] = system[1::2, 3:6] = rows
    system[0::2, 6:] = -image[:, :1] * rows
    system[1::2, 6:] = -image[:, 1:] * rows
    normal = system.T @ system if len(board) > MIN_POINTS else None
    if normal is not None:
        return np.asarray(np.linalg.eigh(normal)[1][:, 0].reshape(3, 3))
    return np.asarray(np.linalg.svd(system)[2][-1].reshape(3, 3))


def _refine(homography: FloatArray, board: FloatArray, image: FloatArray) -> FloatArray:
    """Gauss-Newton on the image distances; the points are centred, so that h33 is not zero."""
    h = homography / homography[2, 2]
    rows = np.column_stack([board, np.ones(len(board))])
    best: FloatArray = h
    best_cost = float(np.sum((_apply(h, board) - image) ** 2))
    for _ in range(REFINEMENT_STEPS):
        mapped = rows @ h.T
        w = mapped[:, 2:]
        predicted = mapped[:, :2] / w
        jacobian = np.zeros((2 * len(board), 8))
        jacobian[0::2, 0:3] = jacobian[1::2, 3:6] = rows / w
        jacobian[0::2, 6:] = -predicted[:, :1] * board / w
        jacobian[1::2, 6:] = -predicted[:, 1:] * board / w
        error = (image - predicted).reshape(-1)
        step = np.linalg.lstsq(jacobian, error, rcond=None)[0]
        h = h + np.append(step, 0.0).reshape(3, 3)
        cost = float(np.sum((_apply(h, board) - image) ** 2))
        if not cost < best_cost:
            break
        converged = best_cost - cost < 1e-12 * best_cost
        best, best_cost = h, cost
        if converged:
            break
    return best
