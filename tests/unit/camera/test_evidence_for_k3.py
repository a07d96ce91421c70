# SPDX-License-Identifier: Apache-2.0
"""A wide lens with a small k3: without k3 the points that show it look like outliers."""

import numpy as np

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector
from armscan.vision.targets.target import Chessboard, TargetView
from rigs.camera_scene import Scene, view_of
from rigs.plain_scanner import plain_camera

LENS = plain_camera((620.0, 618.14), (665.6, 376.0), (1280, 800), [-0.3, 0.11, 7e-4, -4e-4, -0.004])
SCENE = Scene(camera=LENS, target=Chessboard(10, 7, 20.0), noise_px=0.1)
SEED = 6


def near_board(rng: np.random.Generator) -> Pose[Sensor, Board]:
    """Tilted by 16 to 40 degrees, so near that it fills half the image's width or all of it."""
    azimuth, tilt = rng.uniform(0.0, 2.0 * np.pi), np.deg2rad(rng.uniform(16.0, 40.0))
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    spin = np.array([0.0, 0.0, rng.uniform(-0.6, 0.6)])
    rotation = rotation_from_vector(tilt * axis) @ rotation_from_vector(spin)
    z = 96.875 * rng.uniform(1.0, 1.9)
    sight = rng.uniform(-0.25, 0.25, 2) * [1280.0 / 620.0, 800.0 / 620.0]
    middle = np.array([*(sight * z), z])
    return Pose(rotation, middle - rotation @ SCENE.target.points_board_mm.mean(axis=0))


def whole_views(seed: int) -> list[TargetView]:
    places, noise = np.random.default_rng(144), np.random.default_rng(seed)
    views: list[TargetView] = []
    while len(views) < 9:
        pose = near_board(places)
        points = SCENE.target.points_board_mm @ pose.rotation.T + pose.translation_mm
        if LENS.is_inside(LENS.project(points)).all():
            views.append(view_of(SCENE, pose, noise, f"view{len(views)}.png"))
    return views


def test_points_that_only_a_smaller_model_rejects_still_count() -> None:
    views = whole_views(SEED)
    smaller = calibrate_camera(views, CameraOptions(distortion="k1k2p1p2"))
    fit = calibrate_camera(views)
    assert isinstance(smaller, CameraFit)
    assert isinstance(fit, CameraFit)
    assert smaller.n_points < fit.n_points
    assert fit.cross_validation is not None
    assert smaller.cross_validation is not None
    assert smaller.cross_validation.rms_px < fit.cross_validation.rms_px / 1.01
    assert fit.n_points == 9 * 70
    assert "k3" in fit.free_parameters
    assert np.abs((fit.camera.parameters - LENS.parameters) / fit.sigma).max() < 4.0
