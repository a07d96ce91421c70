# SPDX-License-Identifier: Apache-2.0
"""ChArUco boards: OpenCV reads the markers, the corners are measured on raw pixels."""

from __future__ import annotations

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure
from armscan.vision.targets.definition import Charuco
from armscan.vision.targets.grey import grey_channels, to_grey8
from armscan.vision.targets.options import TargetOptions
from armscan.vision.targets.saddle import WINDOW_FRACTION, fit_saddles
from armscan.vision.targets.view import TargetView

MIN_CORNERS = 6
"""Fewer corners make no view: four fix a homography and leave nothing to judge it by."""
_CLEARANCE = 0.85


def detect_charuco(
    exposure: Exposure, target: Charuco, options: TargetOptions
) -> TargetView | FitFailure:
    """Find a ChArUco board, whole or in part; the markers number its corners."""
    detector = cv2.aruco.CharucoDetector(_board(target))
    n_markers = 0
    n_corners = 0
    for grey in grey_channels(exposure):
        corners, ids, _, marker_ids = detector.detectBoard(to_grey8(grey, exposure.full_scale))
        n_markers = max(n_markers, 0 if marker_ids is None else len(marker_ids))
        if ids is None or len(ids) < MIN_CORNERS:
            continue
        index = np.asarray(ids, dtype=np.int64).ravel()
        rough_px = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        steps = _steps(target, index, rough_px)
        if steps is None:
            continue
        refined, covariance, is_good = fit_saddles(grey, rough_px, *steps)
        n_corners = max(n_corners, int(is_good.sum()))
        if n_corners < MIN_CORNERS:
            continue
        binning = exposure.window.binning
        return TargetView(
            source=exposure.source,
            width_px=exposure.window.x_px + exposure.width_px * binning,
            height_px=exposure.window.y_px + exposure.height_px * binning,
            point_index=index[is_good],
            points_px=exposure.window.to_full_sensor(refined[is_good]),
            covariance_px2=covariance[is_good] * binning**2,
            points_board_mm=target.points_board_mm[index[is_good]],
        )
    return _failure(exposure, target, n_markers, n_corners)


def _board(target: Charuco) -> cv2.aruco.CharucoBoard:
    code = getattr(cv2.aruco, target.dictionary)
    dictionary = cv2.aruco.getPredefinedDictionary(code)
    size = (target.columns, target.rows)
    return cv2.aruco.CharucoBoard(size, target.square_mm, target.marker_mm, dictionary)


def _steps(
    target: Charuco, index: IntArray, rough_px: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Way (N, 2) along x and y in which nothing but the two edges of a corner is seen."""
    board: FloatArray = target.points_board_mm[index, :2]
    found, _ = cv2.findHomography(board, rough_px, cv2.RANSAC, 3.0)
    if found is None:
        return None
    homography = np.asarray(found, dtype=np.float64)
    gap_mm = (target.square_mm - target.marker_mm) / np.sqrt(2.0)
    length_mm = min(target.square_mm, _CLEARANCE * gap_mm / WINDOW_FRACTION)
    centre = _mapped(homography, board)
    along_x = _mapped(homography, board + np.array([length_mm, 0.0])) - centre
    along_y = _mapped(homography, board + np.array([0.0, length_mm])) - centre
    return along_x, along_y


def _mapped(homography: FloatArray, points: FloatArray) -> FloatArray:
    h = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return np.asarray(h[:, :2] / h[:, 2:])


def _failure(exposure: Exposure, target: Charuco, n_markers: int, n_corners: int) -> FitFailure:
    if n_markers == 0:
        return FitFailure(
            f"{exposure.source}: no marker of {target.dictionary} in view",
            "check the dictionary's name, and that the print is neither mirrored nor blurred",
        )
    return FitFailure(
        f"{exposure.source}: {n_markers} markers of {target.dictionary} and {n_corners} corners "
        f"were read, at least {MIN_CORNERS} corners are needed",
        "check columns, rows and lengths of the board, and show more of it",
    )
