# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import (
    CameraFit,
    CameraOptions,
    largest_angle_deg,
    measure_coverage,
)
from armscan.calibration.cameras.robust import excess_variance_px2
from armscan.calibration.cameras.start import estimate_board_pose
from armscan.geometry.estimate import Estimate
from armscan.report.camera import camera_quantities
from armscan.vision.targets.target import TargetView
from rigs.camera_scene import CAMERA, Scene, make_views, normalised_error
from rigs.plain_scanner import plain_camera

ALL_FIVE = CameraOptions(distortion="k1k2p1p2k3", n_folds=0)


def solved(views: list[TargetView], options: CameraOptions | None = None) -> CameraFit:
    fit = calibrate_camera(views, options)
    assert isinstance(fit, CameraFit), fit
    return fit


STRONG = replace(CAMERA, distortion=np.array([-0.12, 0.1, 6e-4, -4e-4, 0.4]))


def test_good_coverage_frees_all_five() -> None:
    fit = solved(make_views(Scene(camera=STRONG, n_views=20, reach=0.28), 1)[0])
    assert fit.free_parameters[4:] == ("k1", "k2", "p1", "p2", "k3")
    assert fit.model_reason == "all five coefficients: the views tell k1 k2 p1 p2 k3"
    held_out = fit.cross_validation
    assert held_out is not None
    assert held_out.n_folds == 5
    # Unseen points scatter by their noise and by the camera's uncertainty, which is small here.
    assert held_out.rms_in_sample_px == pytest.approx(fit.rms_px)
    assert held_out.rms_in_sample_px < held_out.rms_px < 1.05 * held_out.rms_in_sample_px
    assert held_out.sources == tuple(view.source for view in fit.used_views)


def test_three_views_have_no_hold_out_test() -> None:
    fit = solved(make_views(Scene(n_views=3), 2)[0])
    assert "all five" in fit.model_reason
    assert fit.cross_validation is None
    assert any("only 3 views" in warning for warning in fit.warnings)


def test_hold_out_by_hand() -> None:
    views, _ = make_views(Scene(n_views=6), 3)
    options = replace(ALL_FIVE, n_folds=3)
    held_out = solved(views, options).cross_validation
    assert held_out is not None
    fold = solved([view for index, view in enumerate(views) if index % 3 != 1], ALL_FIVE)
    for index in (1, 4):
        pose = estimate_board_pose(views[index], fold.camera)
        assert isinstance(pose, Estimate)
        rms = np.sqrt(np.mean(np.sum(pose.residuals**2, axis=1)))
        assert held_out.view_rms_px[index] == pytest.approx(rms, rel=1e-4)


def test_bow_of_the_board_is_found_and_judged() -> None:
    bowed = Scene(bow_mm=(0.4, -0.25))
    options = replace(ALL_FIVE, solve_warp=True)
    errors = []
    for seed in range(20):
        fit = solved(make_views(bowed, seed)[0], options)
        assert fit.warp is not None
        assert fit.warp.is_significant
        error = fit.warp.bow_mm - bowed.bow_mm
        errors.append(error @ np.linalg.solve(fit.warp.covariance_mm2, error))
    assert abs(np.mean(errors) - 2.0) < 3.0 * np.sqrt(4.0 / 20.0)
    assert any("bowed" in warning and "is solved along" in warning for warning in fit.warnings)
    assert abs(fit.camera.fx_px - CAMERA.fx_px) < 4.0 * fit.sigma[0]


@pytest.mark.parametrize(("share", "is_warned_of"), [(5e-4, False), (2e-3, True)])
def test_a_small_bow_is_solved_without_a_warning(share: float, is_warned_of: bool) -> None:
    """A board off the shelf is no fault; a card that bends by 1/500 of its length is one."""
    side_mm = float(np.ptp(make_views(Scene(), 0)[0][0].points_board_mm, axis=0).max())
    scene = Scene(n_views=12, noise_px=0.03, bow_mm=(share * side_mm, 0.0))
    fit = solved(make_views(scene, 1)[0], ALL_FIVE)
    assert fit.warp is not None and fit.warp.is_significant
    assert fit.warp.bow_mm[0] == pytest.approx(scene.bow_mm[0], abs=5.0 * fit.warp.sigma_mm[0])
    assert any("board is bowed" in warning for warning in fit.warnings) == is_warned_of
    told = {quantity.key: quantity.value for quantity in camera_quantities(fit, 12)}
    assert told["board.bow_mm"] == fit.warp.bow_mm.tolist()


def test_a_bow_hides_no_coefficient_of_the_lens() -> None:
    """A bow passes for p1 and p2, and for their absence."""
    distortion = np.array([-0.12, 0.1, 1.2e-3, 1e-3, 0.0])
    camera, errors = replace(CAMERA, distortion=distortion), []
    for seed, bow_mm in enumerate([(0.15, -0.1), (0.5, 0.4), (1.5, -1.0)]):
        scene = Scene(camera=camera, noise_px=0.1, bow_mm=bow_mm)
        fit = solved(make_views(scene, seed)[0])
        assert "p1 p2" in fit.model_reason.split(";")[0]
        truth, found = camera.parameters[:4], fit.camera.parameters[:4]
        errors.append(normalised_error(truth, found, fit.covariance[:4, :4]))
    assert np.mean(errors) < 4.0 + 4.0 * np.sqrt(8.0 / len(errors))


def test_bowed_boards_do_not_spoil_the_camera_unasked() -> None:
    """Bows from none to plain ones: what is stated holds for all of them alike."""
    errors, found = [], 0
    for seed in range(24):
        scene = Scene(n_views=8, bow_mm=(0.006 * (seed % 4), -0.003 * (seed % 3)))
        fit = solved(make_views(scene, seed)[0], ALL_FIVE)
        errors.append(normalised_error(CAMERA.parameters, fit.camera.parameters, fit.covariance))
        found += fit.warp is not None
    assert 4 <= found <= 20
    assert abs(np.mean(errors) - 9.0) < 3.5 * np.sqrt(18.0 / 24.0)


def test_flat_board_is_rarely_called_bowed() -> None:
    options = replace(ALL_FIVE, solve_warp=True)
    p_values = []
    for seed in range(40):
        warp = solved(make_views(Scene(n_views=6), seed)[0], options).warp
        assert warp is not None
        p_values.append(warp.p_value)
    # Uniform on a flat board: mean 1/2 with sigma 1 / sqrt(12 n).
    assert abs(np.mean(p_values) - 0.5) < 3.0 / np.sqrt(12.0 * 40.0)


def test_excess_scatter_is_added_only_where_it_shows() -> None:
    rng = np.random.default_rng(4)
    n = 2000
    claimed = np.tile(0.01**2 * np.eye(2), (n, 1, 1))
    quiet = 0.01 * rng.normal(size=(n, 2))
    loud = np.hypot(0.01, 0.15) * rng.normal(size=(n, 2))
    for residuals, expected in ((quiet, 0.0), (loud, 0.15), (0.5 * quiet, 0.0)):
        chi2 = float(np.sum(residuals**2)) / 0.01**2
        variance = excess_variance_px2(residuals, claimed, chi2, 2 * n)
        assert np.sqrt(variance) == pytest.approx(expected, rel=4.0 / np.sqrt(4.0 * n), abs=1e-9)


def test_common_scatter_levels_the_weights() -> None:
    """A detector that claims 0.01 px for some points and 0.1 px for others, truth 0.2 px."""
    views, _ = make_views(Scene(noise_px=0.2), 5)
    rng = np.random.default_rng(5)
    uneven = []
    for view in views:
        sigma = np.where(rng.random(len(view)) < 0.3, 0.01, 0.1)
        covariance = sigma[:, None, None] ** 2 * np.eye(2)
        uneven.append(replace(view, covariance_px2=covariance))
    fit, equal = solved(uneven, ALL_FIVE), solved(views, ALL_FIVE)
    assert fit.noise_scale > 3.0
    assert fit.sigma_point_px == pytest.approx(0.2, rel=0.1)
    assert fit.sigma == pytest.approx(equal.sigma, rel=0.15)


def test_coverage_by_hand() -> None:
    points = np.array([[5.0, 5.0], [5.0, 5.2], [95.0, 45.0], [55.0, 25.0]])
    tilt = np.deg2rad(30.0)
    normals = np.array([[0.0, 0.0, 1.0], [0.0, np.sin(tilt), np.cos(tilt)]])
    coverage = measure_coverage(points, normals, 100, 50)
    assert coverage.counts.shape == (5, 10)
    assert coverage.counts.sum() == 4
    assert coverage.counts[0, 0] == 2
    assert coverage.fraction == pytest.approx(3 / 50)
    assert coverage.covered_px.tolist() == [5.0, 5.0, 95.0, 45.0]
    assert set(coverage.empty) == {
        "top centre",
        "top right",
        "middle left",
        "middle right",
        "bottom left",
        "bottom centre",
    }
    assert coverage.tilts_deg == pytest.approx([0.0, 30.0])
    assert coverage.tilt_directions_deg[1] == pytest.approx(90.0)
    assert largest_angle_deg(normals) == pytest.approx(30.0)


def test_empty_parts_and_small_tilts_are_warned_of() -> None:
    scene = Scene(n_views=8, distance_mm=700.0, reach=0.03, max_tilt_deg=14.0)
    warnings = " ".join(solved(make_views(scene, 6)[0], ALL_FIVE).warnings)
    assert "no target points in the" in warnings
    assert "tilt it by 20 to 45" in warnings


@pytest.mark.parametrize(("fy_px", "is_told"), [(2300.0, False), (2310.0, False), (3066.0, True)])
def test_stretched_images_are_warned_of(fy_px: float, *, is_told: bool) -> None:
    lens = replace(CAMERA, fy_px=fy_px)
    fit = solved(make_views(Scene(camera=lens), 4)[0], ALL_FIVE)
    assert any("square" in warning for warning in fit.warnings) == is_told


def test_views_of_one_place_are_told_in_one_sentence() -> None:
    views, _ = make_views(Scene(), 5)
    again = [replace(view, source=f"again-{view.source}") for view in views[:5]]
    told = [w for w in solved([*views, *again], ALL_FIVE).warnings if "repeat" in w]
    assert len(told) == 1
    assert told[0].startswith("5 views")


def test_a_lens_seen_in_its_middle_that_folds_over_says_so() -> None:
    """Strong barrel distortion. With k1 alone, as the views ask for, seven of eight fold over;
    beside usual sizes four do.
    """
    lens = plain_camera(520.0, (319.5, 239.5), (640, 480), [-0.3, 0.11, 0, 0, 0])
    scene = Scene(camera=lens, n_views=8, noise_px=0.2, distance_mm=450.0, reach=0.1)
    folded = 0
    for seed in range(8):
        fit = solved(make_views(scene, seed)[0])
        if len(fit.camera.folded_border()):
            folded += 1
            assert any("no inverse" in warning for warning in fit.warnings)
    assert folded <= 4
