# SPDX-License-Identifier: Apache-2.0
"""Chessboards through a fisheye, rendered by OpenCV's model: every corner, and what is off."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.records.exposure import Exposure
from armscan.vision.targets.chessboard import MAX_SCATTER
from armscan.vision.targets.crossings import fit_lattice
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.target import Charuco, Chessboard, TargetView
from rigs.fisheye import see_through_fisheye

SIZE_PX = (960, 720)
LENS = np.array([270.0, 270.0, 478.0, 362.0, 0.01, -0.004, 0.0, 0.0, 0.0])
BOARD = Chessboard(8, 6, 30.0)
FRONTAL: Pose[Sensor, Board] = Pose(np.eye(3), np.array([-105.0, -75.0, 62.0]))
"""Its outermost corners lie 64 degrees from the axis."""
TILTED: Pose[Sensor, Board] = Pose.from_vectors([0.1, -0.6, 0.3], [-60.0, -120.0, 120.0])
BESIDE: Pose[Sensor, Board] = Pose.from_vectors([-0.166, -0.235, 0.225], [-56.0, -66.8, 53.0])
"""The search misses a third of its corners, for cells shrink to a tenth towards the right."""


def squares(a: FloatArray, b: FloatArray) -> FloatArray:
    """Levels of the print at columns and rows of squares, from the first inner corner."""
    square = np.where((np.floor(a) + np.floor(b)) % 2 == 0, 40.0, 210.0)
    is_print = (a > -1.0) & (a < BOARD.columns) & (b > -1.0) & (b < BOARD.rows)
    return np.where(is_print, square, 230.0)


def photograph(
    pose: Pose[Sensor, Board],
    rng: np.random.Generator,
    print_at: Callable[[FloatArray, FloatArray], FloatArray] = squares,
) -> np.ndarray:
    """Levels of the board on a light wall: 36 rays a pixel, blur and noise."""
    fine, (width, height) = 6, SIZE_PX
    v, u = np.mgrid[: height * fine, : width * fine]
    pixels = (np.stack([u.ravel(), v.ravel()], axis=1) + 0.5) / fine - 0.5
    matrix = np.array([[LENS[0], 0, LENS[2]], [0, LENS[1], LENS[3]], [0, 0, 1.0]])
    terms = np.array([LENS[4], LENS[5], LENS[8], 0.0])
    away = np.hypot(*((pixels - LENS[2:4]) / LENS[:2]).T)
    is_seen = away < 1.4
    xy = cv2.fisheye.undistortPoints(pixels[is_seen][:, None], matrix, terms)[:, 0]
    # the ray from the camera's centre meets the board's plane z = 0
    rays = np.column_stack([xy, np.ones(len(xy))]) @ pose.rotation
    centre = -pose.rotation.T @ pose.translation_mm
    at = centre + rays * (-centre[2] / rays[:, 2])[:, None]
    a, b = at[:, 0] / BOARD.square_mm, at[:, 1] / BOARD.square_mm
    levels = np.full(len(pixels), 20.0)
    levels[is_seen] = print_at(a, b)
    image = levels.reshape(height, fine, width, fine).mean(axis=(1, 3))
    image = gaussian_filter(image, 0.7) + rng.normal(0.0, 1.5, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("pose", [FRONTAL, TILTED, BESIDE], ids=["frontal", "tilted", "beside"])
def test_corners_are_found_up_to_the_outermost_without_bias(pose: Pose[Sensor, Board]) -> None:
    """Straight edges would put them 0.03 to 0.08 px too far inward, ten sigmas and more."""
    view = detect_target(Exposure(photograph(pose, np.random.default_rng(1)), "wide.png"), BOARD)
    assert isinstance(view, TargetView)
    assert len(view) > 0.93 * BOARD.columns * BOARD.rows
    truth = see_through_fisheye(LENS, BOARD, pose)
    # the half-turned numbering of an even board is as good
    errors = [view.points_px - each[view.point_index] for each in (truth, truth[::-1])]
    error = min(errors, key=lambda each: float(np.abs(each).max()))
    outward = view.points_px - LENS[2:4]
    away = np.hypot(*outward.T)
    sigma = np.sqrt(0.5 * np.trace(view.covariance_px2, axis1=1, axis2=2))
    inward = -(error * outward).sum(axis=1) / away
    assert abs(np.average(inward, weights=sigma**-2.0)) < 0.004
    # 36 rays a pixel err by 0.003 px themselves
    assert np.mean((error / np.hypot(sigma, 0.003)[:, None]) ** 2) < 2.0
    assert away.max() > np.hypot(*(truth - LENS[2:4]).T).max() - 25.0


CHARUCO = Charuco(9, 7, 30.0, 22.0, "DICT_5X5_100", "new")
FINE = 120
"""Samples of its print along a square."""


def charuco_squares(a: FloatArray, b: FloatArray) -> FloatArray:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    size = (CHARUCO.columns, CHARUCO.rows)
    board = cv2.aruco.CharucoBoard(size, CHARUCO.square_mm, CHARUCO.marker_mm, dictionary)
    drawn = board.generateImage((size[0] * FINE, size[1] * FINE), marginSize=0)
    u, v = ((x + 1.0) * FINE for x in (a, b))
    inside = (u >= 0) & (v >= 0) & (u < drawn.shape[1]) & (v < drawn.shape[0])
    at = np.where(inside, v, 0).astype(np.int64), np.where(inside, u, 0).astype(np.int64)
    return np.where(inside, 40.0 + 170.0 * (drawn[at] > 127), 230.0)


def test_charuco_corners_have_no_bias_either() -> None:
    """Their fits end before the markers, so straight edges lay less far off: 0.02 to 0.04 px."""
    image = photograph(TILTED, np.random.default_rng(2), charuco_squares)
    view = detect_target(Exposure(image, "wide.png"), CHARUCO)
    assert isinstance(view, TargetView)
    assert len(view) > 40
    # the same corners as the chessboard's: one square in from the print's own
    truth = see_through_fisheye(LENS, BOARD, TILTED)
    error = view.points_px - truth[view.point_index]
    outward = view.points_px - LENS[2:4]
    inward = -(error * outward).sum(axis=1) / np.hypot(*outward.T)
    sigma = np.sqrt(0.5 * np.trace(view.covariance_px2, axis1=1, axis2=2))
    assert abs(np.average(inward, weights=sigma**-2.0)) < 0.004
    # samples of the print err by 0.005 px
    assert np.mean((error / np.hypot(sigma, 0.005)[:, None]) ** 2) < 2.0


def test_an_image_gives_the_same_corners_to_the_bit() -> None:
    """Though its arrays lie elsewhere: results are compared by their hash."""
    image = photograph(TILTED, np.random.default_rng(1))
    kept = []
    first = detect_target(Exposure(image, "a.png"), BOARD)
    assert isinstance(first, TargetView)
    for k in range(6):
        kept.append(np.zeros(997 * k + 13))
        again = detect_target(Exposure(image.copy(), "a.png"), BOARD)
        assert isinstance(again, TargetView)
        assert again.points_px.tobytes() == first.points_px.tobytes()
        assert again.covariance_px2.tobytes() == first.covariance_px2.tobytes()


def test_no_board_in_texture_ends_in_a_refusal() -> None:
    """A handful of crossings fits any lattice; its curvature may be anything."""
    for seed in range(6):
        noise = gaussian_filter(np.random.default_rng(seed).normal(0.0, 1.0, (240, 320)), 1.5)
        image = np.clip(128.0 + 200.0 * noise, 0, 255).astype(np.uint8)
        for columns, rows in ((4, 3), (3, 3), (5, 4)):
            found = detect_target(Exposure(image, "moss.png"), Chessboard(columns, rows, 30.0))
            assert isinstance(found, FitFailure)


def corners(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    seen = see_through_fisheye(LENS, BOARD, FRONTAL)
    return BOARD.points_board_mm[:, :2] / BOARD.square_mm, seen + rng.normal(0.0, 0.05, seen.shape)


def test_a_bent_lattice_has_no_corner_off_it_but_those_that_are() -> None:
    board, points = corners(np.random.default_rng(2))
    sigma, tolerance = np.full(len(board), 0.05), 0.5
    lattice = fit_lattice(board, points, sigma, tolerance, SIZE_PX)
    assert lattice is not None
    assert not lattice.is_off.any()
    assert lattice.scatter_px < 0.2
    moved = points.copy()
    moved[[0, 20]] += [3.0, -2.0]
    lattice = fit_lattice(board, moved, sigma, tolerance, SIZE_PX)
    assert lattice is not None
    assert np.flatnonzero(lattice.is_off).tolist() == [0, 20]


def test_a_misprint_is_none_that_a_fisheye_explains() -> None:
    """One column twice as wide: such a board stays refused."""
    board, _ = corners(np.random.default_rng(3))
    wide = board.copy()
    wide[:, 0] += wide[:, 0] >= 4
    seen = wide * 40.0 + [300.0, 200.0] + 0.05 * np.random.default_rng(4).normal(size=wide.shape)
    lattice = fit_lattice(board, seen, np.full(len(board), 0.05), 0.5, SIZE_PX)
    assert lattice is not None
    assert lattice.scatter_px > MAX_SCATTER * 40.0 or lattice.is_off.mean() > 0.2
