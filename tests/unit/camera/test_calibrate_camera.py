# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import stats

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.vision.targets.target import TargetView
from rigs.camera_scene import CAMERA, GRID, Scene, make_views, normalised_error

ALL_FIVE = CameraOptions(distortion="k1k2p1p2k3", n_folds=0)


def solved(views: list[TargetView], options: CameraOptions = ALL_FIVE) -> CameraFit:
    fit = calibrate_camera(views, options)
    assert isinstance(fit, CameraFit), fit
    return fit


def test_minimum_is_that_of_opencv() -> None:
    views, _ = make_views(Scene(noise_px=0.2), seed=1)
    fit = solved(views)
    rms, matrix, distortion, _, _ = cv2.calibrateCamera(
        [view.points_board_mm.astype(np.float32) for view in views],
        [view.points_px.astype(np.float32) for view in views],
        (CAMERA.width_px, CAMERA.height_px),
        np.eye(3),
        np.zeros(5),
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-15),
    )
    theirs = np.array(
        [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion.ravel()[:5]]
    )
    # OpenCV reads float32 points: 1e-4 px of rounding against 0.2 px of noise.
    assert fit.rms_px == pytest.approx(rms, rel=1e-4)
    assert np.abs((fit.camera.parameters - theirs) / fit.sigma).max() < 0.02


def test_covariance_region_of_200_runs_has_its_probability() -> None:
    limit = stats.chi2.ppf(0.95, 9)
    errors = []
    for seed in range(200):
        views, _ = make_views(Scene(), seed)
        fit = solved(views)
        errors.append(normalised_error(CAMERA.parameters, fit.camera.parameters, fit.covariance))
    inside = int(np.sum(np.array(errors) <= limit))
    # 99 % of correct programs lie in this range; and the mean is 9 with sigma sqrt(18 / 200).
    assert 182 <= inside <= 197
    assert abs(np.mean(errors) - 9.0) < 3.0 * np.sqrt(18.0 / 200.0)


def test_poses_and_their_covariances() -> None:
    errors = []
    for seed in range(12):
        views, poses = make_views(Scene(), seed)
        for found, truth in zip(solved(views).used_views, poses, strict=True):
            turn = found.sensor_from_board.rotation @ truth.rotation.T
            error = np.append(
                cv2.Rodrigues(turn)[0].ravel(),
                found.sensor_from_board.translation_mm - truth.translation_mm,
            )
            errors.append(normalised_error(np.zeros(6), error, found.pose_covariance))
    # Poses of one run share the camera's error: take the runs, not the poses, as the sample.
    per_run = np.array(errors).reshape(12, -1).mean(axis=1)
    assert abs(per_run.mean() - 6.0) < 3.0 * per_run.std() / np.sqrt(12.0)
    assert 3.0 < per_run.mean() < 9.0


def test_noise_is_found_whatever_the_detector_claims() -> None:
    views, _ = make_views(Scene(noise_px=0.08), seed=3)
    claimed = [replace(view, covariance_px2=9.0 * view.covariance_px2) for view in views]
    honest, timid = solved(views), solved(claimed)
    n = honest.degrees_of_freedom
    assert honest.sigma_point_px == pytest.approx(0.08, rel=4.0 / np.sqrt(2.0 * n))
    assert honest.rms_px == pytest.approx(0.08 * np.sqrt(2.0), rel=0.05)
    blurred = np.array(views[0].covariance_px2)
    blurred[:2] *= 1e6
    told = solved([replace(views[0], covariance_px2=blurred), *views[1:]])
    assert told.sigma_point_px == pytest.approx(0.08, rel=4.0 / np.sqrt(2.0 * n)), "not two corners"
    assert honest.noise_scale == pytest.approx(3.0 * timid.noise_scale, rel=1e-3)
    assert timid.sigma == pytest.approx(honest.sigma, rel=1e-3)


def test_precise_points_count_more() -> None:
    rng = np.random.default_rng(4)
    views, _ = make_views(Scene(noise_px=0.02), seed=4)
    blurred = []
    for index, view in enumerate(views):
        if index % 2:
            noise = 0.5 * rng.normal(size=view.points_px.shape)
            covariance = view.covariance_px2 + 0.25 * np.eye(2)
            noisy = view.points_px + noise
            blurred.append(replace(view, points_px=noisy, covariance_px2=covariance))
        else:
            blurred.append(view)
    weighted = solved(blurred)
    equal = solved(
        [
            replace(v, covariance_px2=0.04 * np.ones(len(v))[:, None, None] * np.eye(2))
            for v in blurred
        ]
    )
    # Half the views with 25 times the noise add almost nothing; without weights they ruin it.
    assert weighted.sigma[0] < 0.3 * equal.sigma[0]
    assert abs(weighted.camera.fx_px - CAMERA.fx_px) < 4.0 * weighted.sigma[0]


def test_noise_free_views_give_the_truth_back() -> None:
    views, _ = make_views(Scene(noise_px=0.0), seed=5)
    fit = solved(views)
    assert fit.rms_px < 1e-6
    assert np.abs(fit.camera.parameters - CAMERA.parameters).max() < 1e-4


def test_wrong_size_in_mm_scales_poses_only() -> None:
    views, _ = make_views(Scene(), seed=6)
    doubled = [replace(view, points_board_mm=2.0 * view.points_board_mm) for view in views]
    fit, scaled = solved(views), solved(doubled)
    assert np.abs((fit.camera.parameters - scaled.camera.parameters) / fit.sigma).max() < 1e-3
    assert scaled.views[0].distance_mm == pytest.approx(2.0 * fit.views[0].distance_mm, rel=1e-6)


def test_numbering_from_the_opposite_corner_is_harmless() -> None:
    views, _ = make_views(Scene(reach=0.05), seed=7)
    full = [view for view in views if len(view) == len(GRID.points_board_mm)]
    assert len(full) > 5
    turned = [
        replace(view, points_px=view.points_px[::-1]) if index % 2 else view
        for index, view in enumerate(full)
    ]
    fit, other = solved(full), solved(turned)
    assert np.abs((fit.camera.parameters - other.camera.parameters) / fit.sigma).max() < 1e-3


def test_result_does_not_depend_on_the_order_of_views_and_points() -> None:
    views, _ = make_views(Scene(), seed=8)
    rng = np.random.default_rng(8)
    shuffled = []
    for view in reversed(views):
        order = rng.permutation(len(view))
        shuffled.append(
            replace(
                view,
                point_index=view.point_index[order],
                points_px=view.points_px[order],
                covariance_px2=view.covariance_px2[order],
                points_board_mm=view.points_board_mm[order],
            )
        )
    fit, other = solved(views), solved(shuffled)
    assert np.abs((fit.camera.parameters - other.camera.parameters) / fit.sigma).max() < 1e-3


def test_fixed_parameters_are_held_with_zero_covariance() -> None:
    square = replace(CAMERA, fy_px=CAMERA.fx_px, cx_px=1023.5, cy_px=767.5)
    views, _ = make_views(Scene(camera=square), seed=9)
    options = CameraOptions(
        distortion="k1k2", n_folds=0, is_aspect_fixed=True, is_principal_point_fixed=True
    )
    fit = solved(views, options)
    assert fit.camera.fx_px == fit.camera.fy_px
    assert (fit.camera.cx_px, fit.camera.cy_px) == (1023.5, 767.5)
    assert fit.camera.distortion[2:].tolist() == [0.0, 0.0, 0.0]
    assert fit.free_parameters == ("fx_px", "k1", "k2")
    assert fit.sigma[0] == pytest.approx(fit.sigma[1])
    assert not fit.covariance[[2, 3, 6, 7, 8]].any()


def test_joint_covariance_holds_camera_and_poses() -> None:
    views, _ = make_views(Scene(n_views=5), seed=10)
    fit = solved(views)
    assert fit.joint_covariance.shape == (9 + 30, 9 + 30)
    assert np.array_equal(fit.joint_covariance[:9, :9], fit.covariance)
    for number, view in enumerate(fit.used_views):
        rows = slice(9 + 6 * number, 15 + 6 * number)
        assert np.array_equal(fit.joint_covariance[rows, rows], view.pose_covariance)
