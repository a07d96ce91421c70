# SPDX-License-Identifier: Apache-2.0
"""Two cameras together: the truth within the stated covariance, and OpenCV's answer."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import stats

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.calibrate_stereo import calibrate_stereo
from armscan.calibration.cameras.distortion import typical_coefficients
from armscan.calibration.cameras.pairs import StereoOptions, StereoPair, views_of
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.calibration.cameras.stereo_result import StereoFit
from armscan.errors import InputError, OptionError
from armscan.geometry.estimate import FitFailure
from armscan.geometry.rotations import rotation_from_vector, vector_from_rotation
from armscan.models.calibration import CameraCalibration
from armscan.models.camera import CameraModel
from armscan.models.two_views import IntrinsicsUse, TwoViews
from armscan.report.stereo import stereo_quantities
from rigs.fisheye import as_fisheye
from rigs.stereo_rig import (
    CONVERGING,
    GRID,
    LEFT,
    RIGHT,
    StereoScene,
    held,
    increments,
    make_pairs,
    normalised_stereo_error,
)

ALL_FREE = CameraOptions(distortion="k1k2p1p2k3", n_folds=0)
OPTIONS = StereoOptions(ALL_FREE, n_folds=0)
N_RUNS = 4


def solved(
    pairs: list[StereoPair],
    scene: StereoScene,
    options: StereoOptions = OPTIONS,
    given: tuple[CameraCalibration, CameraCalibration] | None = None,
) -> StereoFit:
    fit = calibrate_stereo(pairs, scene.target, options, given)
    assert isinstance(fit, StereoFit), fit
    return fit


def single(scene: StereoScene, side: int, seed: int) -> CameraCalibration:
    """A camera calibrated by itself, from other images."""
    fit = calibrate_camera(views_of(make_pairs(scene, seed)[0], side), ALL_FREE)
    assert isinstance(fit, CameraFit)
    return held(fit.camera, fit.covariance)


def test_without_noise_the_truth_is_found() -> None:
    scene = StereoScene(n_pairs=6, noise_px=(0.0, 0.0))
    fit = solved(make_pairs(scene, 0)[0], scene)
    assert fit.rms_px < 1e-8
    assert np.abs(increments(scene.views, fit.views) / np.maximum(1.0, fit.parameters)).max() < 1e-6
    assert fit.epipolar_rms_px < 1e-8


def test_sigmas_of_the_rotation_vector_are_its_own() -> None:
    """Those of an increment of the rotation were told."""
    scene = StereoScene(n_pairs=6)
    fit = solved(make_pairs(scene, 0)[0], scene)
    turn, step = fit.views.right_from_left.rotation, 1e-6
    moved = [
        vector_from_rotation(rotation_from_vector(row) @ turn)
        for row in np.concatenate([step * np.eye(3), -step * np.eye(3)])
    ]
    jacobian = (np.array(moved[:3]) - np.array(moved[3:])).T / (2.0 * step)
    own = np.sqrt(np.diag(jacobian @ fit.covariance[-6:-3, -6:-3] @ jacobian.T))
    told = {one.label: one.sigma for one in stereo_quantities(fit)}
    turns = [told[f"rotation {axis}"] for axis in "xyz"]
    assert turns == pytest.approx(np.degrees(own).tolist(), rel=1e-6)
    assert float(np.abs(own / fit.sigma[-6:-3] - 1.0).max()) > 0.02


@pytest.mark.parametrize(
    "scene",
    [
        StereoScene(),
        StereoScene(noise_px=(0.03, 0.15)),
        StereoScene(missed_mm=0.02),
    ],
    ids=["noise", "unequal noise", "target error"],
)
def test_the_covariance_holds_the_truth(scene: StereoScene) -> None:
    """Mean of the normalised error over 24 parameters; ``benchmarks/stereo_coverage.py`` has more.

    Noise that is taken to be equal in both cameras, or target errors taken for noise of each view,
    raise the mean far beyond the limit.
    """
    errors = [
        normalised_stereo_error(scene.views, solved(make_pairs(scene, seed)[0], scene))
        for seed in range(N_RUNS)
    ]
    low, high = stats.chi2.ppf([0.0005, 0.9995], 24 * N_RUNS) / N_RUNS
    assert low < float(np.mean(errors)) < high


def test_a_usual_size_counts_once_where_the_targets_points_are_off() -> None:
    """Their variance is taken out of that of unit weight after the solution: k3, which these views
    do not tell, was stated to be known four times better than to its usual size.
    """
    scene = StereoScene(n_pairs=8, noise_px=(0.02, 0.02), claimed_px=0.02, missed_mm=0.05)
    options = StereoOptions(CameraOptions(n_folds=0), n_folds=0)
    fit = calibrate_stereo(make_pairs(scene, 0)[0], scene.target, options)
    assert isinstance(fit, StereoFit)
    for camera, sigma in ((fit.views.left, fit.sigma[8]), (fit.views.right, fit.sigma[17])):
        (usual,) = typical_coefficients(camera, ("k3",))
        assert 0.6 * usual < sigma < 1.1 * usual


def test_agrees_with_opencv_on_the_same_points() -> None:
    """Equal noise: both minimise the same sum, OpenCV without outliers or levels."""
    scene = StereoScene(n_pairs=8)
    pairs = [p for p in make_pairs(scene, 3)[0] if all(len(v) == 99 for v in p.views if v)]
    fit = solved(pairs, scene)
    boards = [scene.target.points_board_mm.astype(np.float32)] * len(pairs)
    images = [[v.points_px.astype(np.float32) for v in views_of(pairs, side)] for side in (0, 1)]
    found = cv2.stereoCalibrate(
        boards,
        images[0],
        images[1],
        LEFT.matrix,
        LEFT.distortion.copy(),
        RIGHT.matrix,
        RIGHT.distortion.copy(),
        (2048, 1536),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-12),
    )
    rms, left, left_k, right, right_k, rotation, translation = found[:7]
    theirs = np.concatenate(
        [
            [left[0, 0], left[1, 1], left[0, 2], left[1, 2], *left_k.ravel()[:5]],
            [right[0, 0], right[1, 1], right[0, 2], right[1, 2], *right_k.ravel()[:5]],
            cv2.Rodrigues(rotation)[0].ravel(),
            translation.ravel(),
        ]
    )
    # Single-precision points and noise levels that are estimated move both by far less than sigma.
    assert np.abs((theirs - fit.parameters) / fit.sigma).max() < 0.15
    # OpenCV counts both cameras' points under one root.
    assert fit.rms_px == pytest.approx(rms, rel=0.01)


def test_views_of_one_camera_count_for_it() -> None:
    scene = StereoScene(n_pairs=9)
    pairs = make_pairs(scene, 5)[0]
    lonely = [StereoPair(pair.left, None) for pair in pairs[:5]] + pairs[5:]
    without = solved(pairs[5:], scene)
    fit = solved(lonely, scene)
    assert len(fit.related) == 4
    assert fit.left.n_views == 9
    assert fit.right.n_views == 4
    assert fit.sigma[0] < 0.8 * without.sigma[0]
    assert normalised_stereo_error(scene.views, fit) < stats.chi2.ppf(0.9995, 24)
    assert sum("did not see the target" in warning for warning in fit.warnings) == 5


@pytest.mark.parametrize("use", ["prior", "fixed"])
def test_given_cameras_as_prior_and_held(use: IntrinsicsUse) -> None:
    scene = StereoScene(n_pairs=6)
    options = replace(OPTIONS, intrinsics=use)
    errors = []
    for seed in range(4):
        given = single(scene, 0, 100 + seed), single(scene, 1, 200 + seed)
        fit = solved(make_pairs(scene, seed)[0], scene, options, given)
        errors.append(normalised_stereo_error(scene.views, fit))
        if use == "fixed":
            assert np.array_equal(fit.views.left.parameters, given[0].camera.parameters)
            assert np.array_equal(fit.covariance[:9, :9], given[0].covariance)
        else:
            assert fit.sigma[0] < np.sqrt(given[0].covariance[0, 0])
    low, high = stats.chi2.ppf([0.0005, 0.9995], 24 * len(errors)) / len(errors)
    assert low < float(np.mean(errors)) < high


def test_held_cameras_without_covariance_leave_their_rows_empty() -> None:
    scene = StereoScene(n_pairs=5)
    given = held(LEFT), held(RIGHT)
    pairs = make_pairs(scene, 0)[0]
    fit = solved(pairs, scene, replace(OPTIONS, intrinsics="fixed"), given)
    assert not fit.covariance[:18].any()
    apart = increments(scene.views, fit.views)[18:]
    error = apart @ np.linalg.solve(fit.covariance[18:, 18:], apart)
    assert error < stats.chi2.ppf(0.9995, 6)
    with pytest.raises(OptionError, match="brings no covariance"):
        calibrate_stereo(pairs, scene.target, replace(OPTIONS, intrinsics="prior"), given)


def test_swapped_calibrations_are_noticed() -> None:
    scene = StereoScene(n_pairs=5)
    given = held(RIGHT), held(LEFT)
    options = replace(OPTIONS, intrinsics="fixed")
    fit = calibrate_stereo(make_pairs(scene, 0)[0], scene.target, options, given)
    assert isinstance(fit, FitFailure)
    assert "left images fit the calibration given for the right camera" in fit.reason
    assert "swap" in fit.remedy


def test_a_calibration_of_another_size_is_refused() -> None:
    scene = StereoScene(n_pairs=5)
    other = CameraModel.from_parameters(LEFT.parameters, 1024, 768)
    given = held(other), held(RIGHT)
    options = replace(OPTIONS, intrinsics="fixed")
    with pytest.raises(InputError, match="1024x768"):
        calibrate_stereo(make_pairs(scene, 0)[0], scene.target, options, given)


def test_swapped_lists_are_named() -> None:
    scene = StereoScene(n_pairs=5)
    swapped = [StereoPair(pair.right, pair.left) for pair in make_pairs(scene, 0)[0]]
    fit = solved(swapped, scene)
    centre = CONVERGING.translation_mm
    assert any("LEFT of the left one" in warning for warning in fit.warnings)
    assert np.abs(fit.views.right_from_left.inverse().translation_mm - centre).max() < 1.0


@pytest.mark.parametrize("right", [1.003, 0.997], ids=["both agree", "they do not"])
def test_a_stretched_print_is_told_where_both_cameras_say_so(right: float) -> None:
    """Of one print they cannot say different things: that would be the lenses."""
    left_scene, right_scene = (
        StereoScene(target=replace(GRID, stretch=stretch)) for stretch in (1.003, right)
    )
    pairs = []
    for left, other in zip(
        make_pairs(left_scene, 3)[0], make_pairs(right_scene, 3)[0], strict=True
    ):
        seen = [
            None if v is None else replace(v, points_board_mm=GRID.points_board_mm[v.point_index])
            for v in (left.left, other.right)
        ]
        pairs.append(StereoPair(*seen))
    told = [w for w in solved(pairs, StereoScene()).warnings if "the print seems" in w]
    assert bool(told) is (right > 1.0)
    assert all("0.30 % longer" in text for text in told)


def test_hold_out_predicts_pairs_that_were_not_used() -> None:
    """With 24 unknowns from 99 points a view, unseen pairs fit nearly as the noise allows."""
    scene = StereoScene(n_pairs=8)
    fit = solved(make_pairs(scene, 2)[0], scene, replace(OPTIONS, n_folds=4))
    assert fit.hold_out is not None
    noise = 0.05 * np.sqrt(2.0)
    assert fit.hold_out.rms_in_sample_px < fit.hold_out.rms_px < 1.1 * noise
    assert fit.hold_out.rms_px > 0.9 * noise


def test_outliers_are_left_out_and_counted() -> None:
    scene = StereoScene(n_pairs=6)
    pairs = make_pairs(scene, 0)[0]
    spoilt = pairs[2].right
    assert spoilt is not None
    points = spoilt.points_px.copy()
    points[[4, 50]] += [3.0, -2.0]
    pairs[2] = StereoPair(pairs[2].left, replace(spoilt, points_px=points))
    fit = solved(pairs, scene)
    found = fit.pairs[2].right
    assert found is not None
    assert np.flatnonzero(found.is_outlier).tolist() == [4, 50]
    assert any("right camera: 2 points lie too far out" in warning for warning in fit.warnings)
    assert normalised_stereo_error(scene.views, fit) < stats.chi2.ppf(0.9995, 24)


def test_a_point_without_a_ray_is_left_out_of_the_epipolar_distances() -> None:
    """A corner of a wide lens's image lies beyond what its distortion can invert."""
    wide = replace(LEFT, distortion=np.array([-0.6, 0.0, 0.0, 0.0, 0.0]))
    scene = StereoScene(views=TwoViews(wide, RIGHT, CONVERGING), distance_mm=230.0)
    pairs = make_pairs(scene, 0)[0]
    centre = np.array([wide.cx_px, wide.cy_px])
    outward = [pair.left.points_px - centre for pair in pairs if pair.left is not None]
    farthest = [np.hypot(*rays.T).max() for rays in outward]
    k = int(np.argmax(farthest))
    left, at = pairs[k].left, np.hypot(*outward[k].T).argmax()
    assert left is not None
    points = left.points_px.copy()
    points[at] = centre + outward[k][at] * (1.02 * fold_px(wide) / farthest[k])
    assert not wide.undistort(points)[1].all()
    pairs[k] = replace(pairs[k], left=replace(left, points_px=points))
    fit = solved(pairs, scene)
    matched = fit.pairs[k].matched
    assert matched is not None
    assert len(matched.depth_mm) == len(points) - 1
    assert fit.epipolar_rms_px < 0.2


def fold_px(camera: CameraModel) -> float:
    """Radius in the image at which a lens of ``k1`` alone, negative, folds over: its derivative's
    zero.
    """
    k1 = float(camera.distortion[0])
    radius = (-1.0 / (3.0 * k1)) ** 0.5
    return camera.fx_px * radius * (1.0 + k1 * radius**2)


def test_two_fisheyes_without_noise_are_found() -> None:
    views = TwoViews(as_fisheye(LEFT), as_fisheye(RIGHT), CONVERGING)
    scene = StereoScene(views, n_pairs=6, noise_px=(0.0, 0.0))
    options = StereoOptions(CameraOptions(distortion="fisheye", n_folds=0), n_folds=0)
    fit = solved(make_pairs(scene, 0)[0], scene, options)
    assert (fit.views.left.lens, fit.views.right.lens) == ("fisheye", "fisheye")
    assert np.abs(increments(fit.views, views)).max() < 1e-4
    assert fit.epipolar_rms_px < 1e-6


def test_a_pinhole_beside_a_fisheye_keeps_each_its_lens() -> None:
    """Both given and held: the relative pose alone is solved, each point by its own camera."""
    views = TwoViews(LEFT, as_fisheye(RIGHT), CONVERGING)
    scene = StereoScene(views, n_pairs=6, noise_px=(0.0, 0.0))
    given = tuple(held(camera, np.zeros((9, 9))) for camera in (views.left, views.right))
    options = replace(OPTIONS, intrinsics="fixed")
    fit = solved(make_pairs(scene, 1)[0], scene, options, (given[0], given[1]))
    assert (fit.views.left.lens, fit.views.right.lens) == ("pinhole", "fisheye")
    pose, true = fit.views.right_from_left, CONVERGING
    np.testing.assert_allclose(pose.translation_mm, true.translation_mm, atol=1e-4)
    np.testing.assert_allclose(pose.rotation, true.rotation, atol=1e-7)
