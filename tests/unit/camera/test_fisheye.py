# SPDX-License-Identifier: Apache-2.0
"""Fisheye lenses: found by themselves, with true sigmas, and only where there is one.

What the lens shows is OpenCV's fisheye model.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.models.camera import CameraModel
from armscan.vision.targets.target import Chessboard, TargetView
from rigs.camera_scene import Scene, board_pose, make_views, normalised_error
from rigs.plain_scanner import plain_camera

TRUTH = np.array([231.0, 229.5, 472.0, 305.0, 0.021, -0.012, 0.0, 0.0, 0.004])
SIZE_PX = (960, 600)
OWN = [0, 1, 2, 3, 4, 5, 8]
BOARD = Chessboard(9, 6, 24.0)
NOISE_PX = 0.08
WIDE = plain_camera((480.0, 481.0), (478.0, 302.0), SIZE_PX, [-0.21, 0.06, 4e-4, -3e-4, -0.007])


def through_fisheye(pose: Pose[Sensor, Board]) -> np.ndarray:
    k1, k2, k3 = TRUTH[[4, 5, 8]]
    matrix = np.array([[TRUTH[0], 0, TRUTH[2]], [0, TRUTH[1], TRUTH[3]], [0, 0, 1.0]])
    points = BOARD.points_board_mm @ pose.rotation.T + pose.translation_mm
    coefficients = np.array([k1, k2, k3, 0.0])
    seen = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix, coefficients
    )[0][:, 0]
    return np.where(points[:, 2:] > 20.0, seen, -1e4)


def fisheye_views(seed: int, n_views: int = 14) -> list[TargetView]:
    """Boards that reach up to 70 degrees from the axis."""
    rng = np.random.default_rng(seed)
    like = plain_camera((231.0,) * 2, (479.5, 299.5), SIZE_PX, [0.0] * 5)
    scene = Scene(like, BOARD, distance_mm=130.0, reach=0.45)
    views: list[TargetView] = []
    while len(views) < n_views:
        seen = through_fisheye(board_pose(scene, rng))
        inside = np.flatnonzero(np.all((seen > 2.0) & (seen < np.array(SIZE_PX) - 3.0), axis=1))
        if len(inside) < 40:
            continue
        noise = NOISE_PX * rng.normal(size=(len(inside), 2))
        views.append(
            TargetView(
                source=f"view{len(views):02d}.png",
                width_px=SIZE_PX[0],
                height_px=SIZE_PX[1],
                point_index=inside,
                points_px=seen[inside] + noise,
                covariance_px2=np.tile(NOISE_PX**2 * np.eye(2), (len(inside), 1, 1)),
                points_board_mm=BOARD.points_board_mm[inside],
            )
        )
    return views


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_fisheye_is_found_by_unseen_views(seed: int) -> None:
    fit = calibrate_camera(fisheye_views(seed))
    assert isinstance(fit, CameraFit)
    assert fit.camera.lens == "fisheye"
    assert fit.free_parameters == fit.camera.parameter_names
    assert fit.rms_px == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.1)
    assert not any("too far out" in warning for warning in fit.warnings)
    pinhole = calibrate_camera(fisheye_views(seed), CameraOptions(distortion="k1k2p1p2k3"))
    assert not isinstance(pinhole, CameraFit) or pinhole.rms_px > 3.0 * fit.rms_px


def test_sigmas_are_those_of_repeats() -> None:
    """Sum of 20 squares e' C^-1 e of seven parameters: 140 of chi2, +- 4 sigma."""
    total = 0.0
    for seed in range(100, 120):
        fit = calibrate_camera(fisheye_views(seed), CameraOptions(distortion="fisheye"))
        assert isinstance(fit, CameraFit)
        assert not fit.covariance[[6, 7]].any()
        own = fit.covariance[np.ix_(OWN, OWN)]
        total += normalised_error(TRUTH[OWN], fit.camera.parameters[OWN], own)
    assert abs(total - 140.0) < 4.0 * np.sqrt(2.0 * 140.0)


@pytest.mark.parametrize("seed", [4, 5])
def test_a_wide_pinhole_stays_one(seed: int) -> None:
    """46 degrees to each side, by five coefficients: a fisheye would be wrong."""
    scene = Scene(WIDE, BOARD, n_views=14, noise_px=NOISE_PX, distance_mm=180.0, reach=0.4)
    fit = calibrate_camera(make_views(scene, seed)[0])
    assert isinstance(fit, CameraFit)
    assert fit.camera.lens == "pinhole"


def test_few_views_that_fit_alike_keep_the_pinhole() -> None:
    """A lens of 25 degrees to each side is described by either: no vote is taken."""
    narrow = CameraModel.from_parameters([1100.0, *WIDE.parameters[1:]], *SIZE_PX)
    narrow = replace(narrow, fy_px=1101.0)
    fit = calibrate_camera(make_views(Scene(narrow, BOARD, n_views=8, reach=0.3), 6)[0])
    assert isinstance(fit, CameraFit)
    assert fit.camera.lens == "pinhole"
