# SPDX-License-Identifier: Apache-2.0
"""A target whose points miss their places: the same in every view, so views do not average it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.print_errors import agreeing_numberings
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.pipeline.cameras import CameraRun, calibrate_camera_from_views
from armscan.vision.targets.detect import numberings, renumbered
from armscan.vision.targets.target import CircleGrid, TargetView
from rigs.camera_scene import Scene, make_views, normalised_error

OPTIONS = CameraOptions(distortion="k1k2p1p2k3", n_folds=0)
N_RUNS = 40


def mean_normalised_error(scene: Scene) -> float:
    errors = []
    for seed in range(N_RUNS):
        fit = calibrate_camera(make_views(scene, seed)[0], OPTIONS)
        assert isinstance(fit, CameraFit)
        errors.append(
            normalised_error(scene.camera.parameters, fit.camera.parameters, fit.covariance)
        )
    return float(np.mean(errors))


@pytest.mark.parametrize("missed_mm", [0.0, 0.005, 0.03])
def test_the_covariance_holds_the_targets_own_errors(missed_mm: float) -> None:
    """Taken for noise of each view, 0.03 mm would make the mean about 100 instead of 9."""
    low, high = stats.chi2.ppf([0.0005, 0.9995], 9 * N_RUNS) / N_RUNS
    assert low < mean_normalised_error(Scene(missed_mm=missed_mm)) < high


def turned_at_random(
    views: list[TargetView], target: CircleGrid, seed: int
) -> tuple[list[TargetView], np.ndarray]:
    known = numberings(target)
    turns = np.random.default_rng([seed, 2]).integers(0, len(known), len(views))
    return [renumbered(v, target, known[k]) for v, k in zip(views, turns, strict=True)], turns


@pytest.mark.parametrize("target", [CircleGrid(11, 9, 15.0), CircleGrid(10, 10, 15.0)], ids=str)
def test_numbers_that_start_at_any_corner_state_the_same(target: CircleGrid) -> None:
    """Detectors number views by how the board lies in the image, not by the board."""
    for seed in range(4):
        scene = Scene(target=target, missed_mm=0.01)
        views, _ = make_views(scene, seed)
        mixed, turns = turned_at_random(views, target, seed)
        assert len(set(turns.tolist())) > 1
        alike, again, plain = (
            calibrate_camera_from_views(given, OPTIONS, target=known)
            for given, known in ((views, target), (mixed, target), (mixed, None))
        )
        assert isinstance(alike, CameraRun)
        assert isinstance(again, CameraRun)
        assert isinstance(plain, CameraRun)
        np.testing.assert_allclose(again.fit.sigma, alike.fit.sigma, rtol=1e-5)
        assert again.fit.target_error_mm == pytest.approx(alike.fit.target_error_mm, rel=1e-5)
        assert alike.fit.target_error_mm == pytest.approx(0.01, rel=0.25)
        assert plain.fit.target_error_mm < 0.9 * alike.fit.target_error_mm


def test_outliers_do_not_hide_how_views_are_numbered() -> None:
    target, rng = CircleGrid(11, 9, 15.0), np.random.default_rng(7)
    views, _ = make_views(Scene(target=target, missed_mm=0.01), 1)
    spoilt = []
    for view in views:
        points = view.points_px.copy()
        points[rng.choice(len(view), 4, replace=False)] += 40.0
        spoilt.append(replace(view, points_px=points))
    mixed, _ = turned_at_random(spoilt, target, 1)
    alike, again = (
        calibrate_camera_from_views(given, OPTIONS, target=target) for given in (spoilt, mixed)
    )
    assert isinstance(alike, CameraRun)
    assert isinstance(again, CameraRun)
    np.testing.assert_allclose(again.fit.sigma, alike.fit.sigma, rtol=1e-4)


def test_views_left_out_stay_out_and_too_few_tell_nothing() -> None:
    target = CircleGrid(11, 9, 15.0)
    views, _ = make_views(Scene(target=target, missed_mm=0.01), 1)
    mixed, _ = turned_at_random(views, target, 1)
    options = replace(OPTIONS, leave_out=(views[3].source, views[7].source))
    run = calibrate_camera_from_views(mixed, options, target=target)
    assert isinstance(run, CameraRun)
    plain = calibrate_camera_from_views(mixed, options)
    assert isinstance(plain, CameraRun)
    assert run.fit.target_error_mm > 1.1 * plain.fit.target_error_mm, "numbered anew"
    assert [v.source for v in run.fit.views if not v.is_used] == list(options.leave_out)
    places, missed = [target.points_board_mm] * 3, np.ones((len(target.points_board_mm), 2))
    turned = numberings(target)[1].new_index
    assert agreeing_numberings(places, [missed, missed[turned], missed], numberings(target)) is None


@pytest.mark.parametrize("n_views", [4, 8, 20])
@pytest.mark.parametrize("target", [CircleGrid(4, 3, 15.0), CircleGrid(6, 6, 15.0)], ids=str)
def test_noise_numbers_no_view_anew(target: CircleGrid, n_views: int) -> None:
    """The best of all choices makes noise agree, by some sigmas."""
    rng, known = np.random.default_rng(n_views), numberings(target)
    places = [target.points_board_mm] * n_views
    for _ in range(200):
        missed = [rng.normal(size=(len(target.points_board_mm), 2)) for _ in places]
        assert agreeing_numberings(places, missed, known) is None
