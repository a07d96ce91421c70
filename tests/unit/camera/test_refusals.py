# SPDX-License-Identifier: Apache-2.0
"""Cameras that make no sense are refused, ordinary ones are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import (
    LARGEST_FOCAL_SIGMA,
    CameraFit,
    CameraOptions,
    reasons_to_refuse,
)
from armscan.vision.targets.target import TargetView
from rigs.camera_scene import Scene, board_pose, make_views, view_of

OPTIONS = CameraOptions(distortion="k1k2", n_folds=4)


def solved(views: list[TargetView], options: CameraOptions = OPTIONS) -> CameraFit:
    fit = calibrate_camera(views, options)
    assert isinstance(fit, CameraFit), fit
    return fit


@pytest.mark.parametrize(
    "scene",
    [
        Scene(n_views=4, noise_px=0.3),
        Scene(n_views=6, noise_px=1.0),
        Scene(n_views=12, noise_px=0.05, missed_mm=0.2),
        Scene(n_views=8, bow_mm=(1.0, -0.5)),
    ],
    ids=["four views", "noisy", "a poor target", "a bowed board"],
)
def test_poor_sets_are_not_refused(scene: Scene) -> None:
    assert [reasons_to_refuse(solved(make_views(scene, seed)[0])) for seed in range(5)] == [()] * 5


def test_a_focal_length_that_is_known_too_badly_is_refused() -> None:
    """Few views of little tilt: what is refused errs as stated, what is not by a few percent."""
    scene = Scene(n_views=5, noise_px=1.5, max_tilt_deg=20.0, distance_mm=600.0)
    refused = 0
    for seed in range(10):
        fit = calibrate_camera(make_views(scene, seed)[0], OPTIONS)
        if not isinstance(fit, CameraFit):
            continue
        camera = fit.camera
        known_to = max(fit.sigma[0] / camera.fx_px, fit.sigma[1] / camera.fy_px)
        is_refused = any("focal length is known to" in text for text in reasons_to_refuse(fit))
        assert is_refused == (known_to > LARGEST_FOCAL_SIGMA)
        assert abs(camera.fx_px / scene.camera.fx_px - 1.0) < 4.0 * known_to
        refused += is_refused
    assert refused >= 5


def test_a_board_that_is_twisted_is_refused_although_the_focal_length_seems_known() -> None:
    """A twist of 12 mm is no bow; the residuals tell, and widen what is stated for f."""
    scene, rng = Scene(), np.random.default_rng(4)
    places = scene.target.points_board_mm
    unit = 2.0 * (places - places.mean(axis=0)) / np.ptp(places[:, :2], axis=0).max()
    twist = np.zeros_like(places)
    twist[:, 2] = 12.0 * unit[:, 0] * unit[:, 1]
    views = [view_of(scene, board_pose(scene, rng), rng, f"{k}.png", twist) for k in range(12)]
    fit = solved(views)
    assert fit.sigma[0] / fit.camera.fx_px / np.sqrt(fit.design_effect) < LARGEST_FOCAL_SIGMA
    assert fit.design_effect > 4.0
    assert any("alike" in text for text in fit.warnings)
    assert "px is the limit" in reasons_to_refuse(fit)[-1]


def test_repeated_views_take_one_line() -> None:
    views, _ = make_views(Scene(), 2)
    again = [replace(view, source=f"again{k}.png") for k, view in enumerate(views[:5])]
    about = [text for text in solved([*views, *again]).warnings if "again" in text]
    assert len(about) == 1
    assert "5 views repeat" in about[0]
    assert "again0.png" in about[0]
    assert "2 more" in about[0]


@pytest.mark.parametrize("stretch", [4.0 / 3.0, 1.02])
def test_a_target_stretched_along_one_side_is_told(stretch: float) -> None:
    """A pitch of 15 x 20 mm taken for 15 x 15: the camera's fy swallows it."""
    views, _ = make_views(Scene(max_tilt_deg=30.0), 3)
    stretched = [
        replace(view, points_board_mm=view.points_board_mm * [1.0, 1.0 / stretch, 1.0])
        for view in views
    ]
    assert not [text for text in solved(views).warnings if "fx is" in text]
    if stretch > 1.1:
        (said,) = [t for t in reasons_to_refuse(solved(stretched)) if "as far apart" in t]
        told = float(said.split(" times as far apart")[0].split()[-1])
        assert told == pytest.approx(1.34, abs=0.01), "pinholes: 1.333 is the truth"
        return
    warnings = solved(stretched).warnings
    assert any("% longer from row to row" in text for text in warnings)
