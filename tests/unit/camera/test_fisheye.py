# SPDX-License-Identifier: Apache-2.0
"""Fisheye lenses: found by themselves, with true sigmas, and only where there is one.

What the lens shows is OpenCV's fisheye model.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.models.camera import CameraModel
from armscan.vision.targets.target import Chessboard, TargetView
from rigs.camera_scene import Scene, make_views, normalised_error
from rigs.fisheye import fisheye_views
from rigs.plain_scanner import plain_camera

TRUTH = np.array([231.0, 229.5, 472.0, 305.0, 0.021, -0.012, 0.0, 0.0, 0.004])
SIZE_PX = (960, 600)
OWN = [0, 1, 2, 3, 4, 5, 8]
BOARD = Chessboard(9, 6, 24.0)
NOISE_PX = 0.08
WIDE = plain_camera((480.0, 481.0), (478.0, 302.0), SIZE_PX, [-0.21, 0.06, 4e-4, -3e-4, -0.007])


def drawn(seed: int) -> list[TargetView]:
    """Fourteen boards that reach up to 70 degrees from the axis."""
    return fisheye_views(TRUTH, SIZE_PX, BOARD, n_views=14, noise_px=NOISE_PX, seed=seed)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_fisheye_is_found_by_unseen_views(seed: int) -> None:
    fit = calibrate_camera(drawn(seed))
    assert isinstance(fit, CameraFit)
    assert fit.camera.lens == "fisheye"
    assert fit.free_parameters == fit.camera.parameter_names
    assert fit.rms_px == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.1)
    assert not any("too far out" in warning for warning in fit.warnings)
    pinhole = calibrate_camera(drawn(seed), CameraOptions(distortion="k1k2p1p2k3"))
    assert not isinstance(pinhole, CameraFit) or pinhole.rms_px > 3.0 * fit.rms_px


def test_sigmas_are_those_of_repeats() -> None:
    """Sum of 20 squares e' C^-1 e of seven parameters: 140 of chi2, +- 4 sigma."""
    total = 0.0
    for seed in range(100, 120):
        fit = calibrate_camera(drawn(seed), CameraOptions(distortion="fisheye"))
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
