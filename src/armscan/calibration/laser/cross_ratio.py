# SPDX-License-Identifier: Apache-2.0
"""The thesis's way from the stripe to board points: the cross ratio is invariant (2.3.2.2)."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.fitting import Line, fit_line
from armscan.models.camera import CameraModel
from armscan.vision.targets.view import TargetView

MIN_COLLINEAR = 3
MIN_CROSSING_SINE = 0.5
"""Rows that the stripe crosses at less than 30 degrees give no sharp point."""


def cross_ratio_points(view: TargetView, stripe_px: FloatArray, camera: CameraModel) -> FloatArray:
    """Points where a straight stripe crosses rows and columns of target points.

    In the undistorted image the stripe's line meets the line of a row. Four collinear points keep
    their cross ratio, so the known points of the row give the board coordinate of the crossing;
    three suffice, more are used by least squares of the row's projective map.

    Parameters
    ----------
    view
        The target; rows and columns are points with equal y, or equal x, on the board.
    stripe_px
        (K, 2) points of one straight stripe, full-sensor pixels.
    camera
        For undistortion.

    Returns
    -------
    (C, 2) crossings in the Board frame, mm.
    """
    stripe_xy, is_valid = camera.undistort(stripe_px)
    stripe = fit_line(stripe_xy[is_valid]) if is_valid.sum() >= 2 else FitFailure("no stripe")
    points_xy, is_known = camera.undistort(view.points_px)
    if isinstance(stripe, FitFailure):
        return np.zeros((0, 2))
    board = view.points_board_mm
    found = []
    for along in (0, 1):
        level = np.round(board[:, 1 - along], 9)
        for value in np.unique(level[is_known]):
            row = is_known & (level == value)
            coordinate = _crossing(points_xy[row], board[row, along], stripe)
            if coordinate is not None:
                crossing = np.full(2, value)
                crossing[along] = coordinate
                found.append(crossing)
    return np.array(found).reshape(-1, 2)


def projective_coordinate(image: FloatArray, board_mm: FloatArray, at: float) -> float:
    """Board coordinate at the image coordinate ``at`` on a line of K >= 3 known points.

    Parameters
    ----------
    image, board_mm
        (K,) coordinates along the line in the image and on the board.
    at
        Image coordinate of the point sought.

    Returns
    -------
    The coordinate at which the cross ratio with any three of the points equals that in the image;
    for K > 3 by least squares.
    """
    centre, reach = float(image.mean()), float(np.ptp(image))
    t = (image - centre) / reach
    middle, size = float(board_mm.mean()), float(np.ptp(board_mm))
    s = (board_mm - middle) / size
    # s = (h0 t + h1) / (h2 t + 1)
    design = np.stack([t, np.ones_like(t), -t * s], axis=1)
    h = np.linalg.lstsq(design, s, rcond=None)[0]
    here = (at - centre) / reach
    return float(middle + size * (h[0] * here + h[1]) / (h[2] * here + 1.0))


def _crossing(row_xy: FloatArray, row_mm: FloatArray, stripe: Line) -> float | None:
    """Board coordinate where the stripe crosses a row, or None where it does not."""
    if len(row_xy) < MIN_COLLINEAR:
        return None
    line = fit_line(row_xy)
    if isinstance(line, FitFailure):
        return None
    sine = line.direction[0] * stripe.direction[1] - line.direction[1] * stripe.direction[0]
    if abs(sine) < MIN_CROSSING_SINE:
        return None
    offset = stripe.point - line.point
    at = (offset[0] * stripe.direction[1] - offset[1] * stripe.direction[0]) / sine
    along = line.along(row_xy)
    if not along.min() <= at <= along.max():
        return None
    return projective_coordinate(along, row_mm, float(at))
