# SPDX-License-Identifier: Apache-2.0
"""Where the centres of a grid's circles are imaged, from their edge points.

The centre of the ellipse is not the image of the circle's centre (0.1 px at 45 degrees for a
circle of 69 px). The image of the centre is the pole of the plane's vanishing line in the conic:
with the homography H from board to image, line ``l = H^-T (0, 0, 1)'``, centre ``Q^-1 l``. H itself
comes from the centres, hence a few rounds.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.models.camera import CameraModel
from armscan.vision.targets.ellipse import Ellipses, fit_ellipses
from armscan.vision.targets.view import CircleEdges, TargetView

ROUNDS = 3
_MIN_CIRCLES = 4


def correct_centres(view: TargetView, camera: CameraModel | None = None) -> TargetView:
    """Recompute the circles' centres from their edge points.

    Parameters
    ----------
    view
        A view of a circle grid, with edges.
    camera
        Intrinsics: edge points are undistorted before ellipses are fitted, and the centres mapped
        back. None takes the pixels as they are, which leaves a bias where the lens distorts.

    Returns
    -------
    The view with new ``points_px`` and ``covariance_px2``.

    Raises
    ------
    InputError
        If the view has no edges, or an edge lies where the camera model cannot be inverted.
    """
    if view.edges is None:
        raise InputError(
            "the view has no circle edges", where=view.source, remedy="use a circle grid"
        )
    if camera is None:
        centres, covariance = _centres(view, view.edges.points_px, 1.0 / view.edges.sigma_px**2)
        return replace(view, points_px=centres, covariance_px2=covariance)
    ideal, weights = _undistorted(view.source, view.edges, camera)
    centres, covariance = _centres(view, ideal, weights)
    points, jacobian = _distorted(centres, camera)
    covariance = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    return replace(view, points_px=points, covariance_px2=covariance)


def centres_of_circles(
    ellipses: Ellipses, points_board_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Images of the centres of coplanar circles, and their covariance.

    Parameters
    ----------
    ellipses
        N conics, free of distortion.
    points_board_mm
        (N, 2) or (N, 3) centres on the board.

    Returns
    -------
    centres_px, covariance_px2
        (N, 2) and (N, 2, 2); with fewer than four circles those of the ellipses.
    """
    centres, covariance = ellipses.centres()
    board = np.asarray(points_board_mm, dtype=np.float64)[:, :2]
    for _ in range(ROUNDS if len(centres) >= _MIN_CIRCLES else 0):
        homography, _ = cv2.findHomography(board, centres)
        if homography is None:
            break
        line = np.linalg.inv(homography).T @ np.array([0.0, 0.0, 1.0])
        centres, covariance = ellipses.pole(line / line[2])
    return centres, covariance


def _centres(
    view: TargetView, points: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    edges = view.edges
    if edges is None:
        raise InputError("the view has no circle edges", where=view.source)
    n = len(view)
    count = np.bincount(edges.circle, minlength=n)
    order = np.argsort(edges.circle, kind="stable")
    row = edges.circle[order]
    place = np.arange(len(row)) - (np.cumsum(count) - count)[row]
    padded = np.zeros((n, max(int(count.max(initial=0)), 1), 2))
    padded_weights = np.zeros(padded.shape[:2])
    padded[row, place] = points[order]
    padded_weights[row, place] = weights[order]
    return centres_of_circles(fit_ellipses(padded, padded_weights), view.points_board_mm)


def _undistorted(
    source: str, edges: CircleEdges, camera: CameraModel
) -> tuple[FloatArray, FloatArray]:
    """Edge points in pixels of the same camera without distortion, and weights there."""
    xy, is_valid, dxy_dq, _ = camera.undistort_with_jacobian(edges.points_px)
    if not is_valid.all():
        raise InputError(
            f"{int((~is_valid).sum())} edge points lie where the camera's distortion folds over",
            where=source,
            remedy="leave this view out, or calibrate with fewer distortion terms",
        )
    focal = np.array([camera.fx_px, camera.fy_px])
    ideal = xy * focal + [camera.cx_px, camera.cy_px]
    stretch = np.sqrt(np.abs(np.linalg.det(dxy_dq * focal[:, None])))
    return ideal, 1.0 / (edges.sigma_px * stretch) ** 2


def _distorted(ideal_px: FloatArray, camera: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) of points given without distortion, and the derivative (N, 2, 2)."""
    focal = np.array([camera.fx_px, camera.fy_px])
    xy = (ideal_px - [camera.cx_px, camera.cy_px]) / focal
    rays = np.column_stack([xy, np.ones(len(xy))])
    points, dq_dray, _ = camera.project_with_jacobian(rays)
    return points, dq_dray[:, :, :2] / focal
