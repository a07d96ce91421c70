# SPDX-License-Identifier: Apache-2.0
"""Find a target in an exposure; ChArUco boards; targets that look the same after a turn."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray, apply_homography
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Board, Pose
from armscan.records.exposure import Exposure
from armscan.vision.targets.chessboard import detect_chessboard
from armscan.vision.targets.circle_grid import detect_circle_grid
from armscan.vision.targets.saddle import WINDOW_FRACTION, fit_saddles, grey_channels, to_grey8
from armscan.vision.targets.target import Charuco, Chessboard, CircleGrid, Target, TargetView

MIN_CORNERS = 6
"""Fewer corners make no view: four fix a homography and leave nothing to judge it by."""
_CLEARANCE = 0.85


def detect_charuco(exposure: Exposure, target: Charuco) -> TargetView | FitFailure:
    """Find a ChArUco board, whole or in part; the markers number its corners."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, target.dictionary))
    size = (target.columns, target.rows)
    board = cv2.aruco.CharucoBoard(size, target.square_mm, target.marker_mm, dictionary)
    detector = cv2.aruco.CharucoDetector(board)
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
        found, number = refined[is_good], index[is_good]
        return TargetView.of_image(exposure, target, number, found, covariance[is_good])
    return _failure(exposure, target, n_markers, n_corners)


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
    centre = apply_homography(homography, board)
    along_x = apply_homography(homography, board + np.array([length_mm, 0.0])) - centre
    along_y = apply_homography(homography, board + np.array([0.0, length_mm])) - centre
    return along_x, along_y


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


SMALLEST_IMAGE_PX = 32


def detect_target(exposure: Exposure, target: Target) -> TargetView | FitFailure:
    """Find a target and measure its points (section 2.3.1.1).

    Parameters
    ----------
    exposure
        Grey or colour, 8 to 16 bit, any sensor window.
    target
        What to look for.

    Returns
    -------
    The points in full-sensor pixels with their covariance, or the reason why there are none.
    """
    if min(exposure.width_px, exposure.height_px) < SMALLEST_IMAGE_PX:
        return FitFailure(
            f"{exposure.source}: an image of {exposure.width_px} x {exposure.height_px} px is too "
            "small to show a target",
            "give the full image",
        )
    if isinstance(target, CircleGrid):
        return detect_circle_grid(exposure, target)
    if isinstance(target, Chessboard):
        return detect_chessboard(exposure, target)
    return detect_charuco(exposure, target)


@dataclass(frozen=True, slots=True, eq=False)
class Numbering:
    """Another numbering of a target's points.

    ``quarter_turns``: How far the target is turned, 0 to 3. ``new_index``: (N,) number that each of
    the target's points bears now. ``new_from_found``: Maps places on the board as it was found
    numbered to places by the new numbers.
    """

    quarter_turns: int
    new_index: IntArray
    new_from_found: Pose[Board, Board]


def numberings(target: Target) -> tuple[Numbering, ...]:
    """All numberings that no view can tell apart, the one as found first."""
    points = target.points_board_mm
    found = Numbering(0, np.arange(len(points)), Pose(np.eye(3), np.zeros(3)))
    return (found, *(_turned(target, turns) for turns in target.symmetric_turns))


def renumbered(view: TargetView, target: Target, numbering: Numbering) -> TargetView:
    """The view of ``target`` with other numbers; the image points stay, in their order."""
    if numbering.quarter_turns == 0:
        return view
    index = numbering.new_index[view.point_index]
    return replace(view, point_index=index, points_board_mm=target.points_board_mm[index])


def _turned(target: Target, quarter_turns: int) -> Numbering:
    points = target.points_board_mm
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rotation = np.linalg.matrix_power(quarter, quarter_turns)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    shift = middle - rotation @ middle
    pose: Pose[Board, Board] = Pose(rotation, shift)
    apart = np.abs(pose.apply(points)[:, None, :] - points[None, :, :]).max(axis=2)
    return Numbering(quarter_turns, np.argmin(apart, axis=1), pose)
