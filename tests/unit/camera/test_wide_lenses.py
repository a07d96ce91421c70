# SPDX-License-Identifier: Apache-2.0
"""What is said of a lens that is wider than the model, and of views that fit badly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions, focal_reasons
from armscan.calibration.cameras.start import intrinsics_from_homographies, view_homography
from armscan.geometry.estimate import FitFailure
from armscan.vision.targets.target import Chessboard, TargetView
from rigs.camera_scene import CAMERA, Scene, make_views, normalised_error
from rigs.plain_scanner import plain_camera

FOCAL_PX, MIDDLE_PX = 600.0, 1024.0
PINHOLE = plain_camera((FOCAL_PX,) * 2, (MIDDLE_PX,) * 2, (2048, 2048), [0.0] * 5)


def by_angle(view: TargetView, rng: np.random.Generator) -> TargetView:
    """The view as a lens takes it that maps angles to radii, 0.05 px of noise beside it."""
    tangents = (view.points_px - MIDDLE_PX) / FOCAL_PX
    tangent = np.hypot(*tangents.T)
    shrunk = np.arctan(tangent) / np.maximum(tangent, 1e-9)
    points = MIDDLE_PX + FOCAL_PX * tangents * shrunk[:, None]
    return replace(view, points_px=points + rng.normal(0.0, 0.05, points.shape))


def far_out(views: list[TargetView]) -> list[str]:
    fit = calibrate_camera(views, CameraOptions(n_folds=0))
    assert isinstance(fit, CameraFit)
    return [text for text in fit.warnings if "too far out" in text]


def test_a_lens_wider_than_the_model_is_named() -> None:
    """66 degrees to each side: the outermost points are left out."""
    views, _ = make_views(Scene(PINHOLE, n_views=14, noise_px=0.0, distance_mm=100.0, reach=0.3), 1)
    rng = np.random.default_rng(1)
    (warning,) = far_out([by_angle(view, rng) for view in views])
    assert "wider than its coefficients" in warning and "--distortion fisheye" in warning


@pytest.mark.parametrize("seed", [10, 30])
def test_lines_bent_by_much_keep_no_camera_from_its_start(seed: int) -> None:
    """38 degrees to each side and a barrel of a quarter: the closed form finds nothing."""
    barrel = plain_camera(
        (416.0,) * 2, (320.7, 239.3), (640, 480), [-0.32, 0.045, 1e-4, 2e-4, 0.0086]
    )
    noise_px = 0.08
    scene = Scene(barrel, Chessboard(9, 6, 25.0), 10, noise_px, 217.0, 40.0, 0.35)
    views, _ = make_views(scene, seed)
    homographies = [view_homography(view) for view in views]
    good = [each for each in homographies if not isinstance(each, FitFailure)]
    assert isinstance(intrinsics_from_homographies(good, 640, 480), FitFailure)
    fit = calibrate_camera(views)
    assert isinstance(fit, CameraFit)
    assert fit.camera.lens == "pinhole"
    assert fit.rms_px == pytest.approx(np.sqrt(2.0) * noise_px, rel=0.1)
    error = normalised_error(
        barrel.parameters[:4], fit.camera.parameters[:4], fit.covariance[:4, :4]
    )
    assert error < chi2.isf(6e-5, 4)


def test_points_that_are_off_here_and_there_do_not_blame_the_lens() -> None:
    views, _ = make_views(Scene(n_views=12), 3)
    rng = np.random.default_rng(3)
    for k in range(8):
        points = views[k].points_px.copy()
        points[rng.integers(len(points))] += 6.0
        views[k] = replace(views[k], points_px=points)
    (warning,) = far_out(views)
    assert warning.startswith("8 points")
    assert "lens" not in warning


def test_an_unknown_focal_length_names_views_that_fit_badly() -> None:
    sigma_px = 0.04 * CAMERA.fx_px
    (alone,) = focal_reasons(CAMERA, sigma_px, sigma_px)
    (beside,) = focal_reasons(CAMERA, sigma_px, sigma_px, 3)
    assert "4.0 %" in alone and "auto-leave-out" not in alone
    assert "much worse there are 3: try --auto-leave-out" in beside
    assert not focal_reasons(CAMERA, 1.0, 1.0, 3)
