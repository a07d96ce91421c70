# SPDX-License-Identifier: Apache-2.0
"""Given calibrations are set beside the images, whatever shape the board has."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.calibrate_stereo import calibrate_stereo
from armscan.calibration.cameras.pairs import StereoOptions, prepare_cameras, views_of
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.calibration.cameras.stereo_result import StereoFit
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import CameraCalibration
from armscan.models.camera import CameraModel
from armscan.models.two_views import TwoViews
from armscan.pipeline.truth import camera_errors
from rigs.camera_scene import CAMERA, Scene, make_views
from rigs.sheet_rig import PROVENANCE
from rigs.stereo_rig import (
    CONVERGING,
    LEFT,
    RIGHT,
    StereoScene,
    held,
    increments,
    make_pairs,
)
from rigs.true_scanner import certain_camera

TRUE = certain_camera(CAMERA, PROVENANCE)
SQUARE = StereoScene(
    TwoViews(replace(LEFT, fy_px=LEFT.fx_px), replace(RIGHT, fy_px=RIGHT.fx_px), CONVERGING),
    n_pairs=6,
)
"""Two cameras of square pixels."""
FX_FY = [[0, 1], [9, 10]]


@pytest.mark.parametrize("bow_mm", [(0.0, 0.0), (0.3, -0.2), (1.0, 0.6)])
def test_the_true_cameras_are_taken_though_the_board_is_bent(bow_mm: tuple[float, float]) -> None:
    """Its bow is solved with a camera of their own, and not with the given one."""
    views, _ = make_views(Scene(n_views=10, bow_mm=bow_mm), 1)
    found = prepare_cameras((views, views), StereoOptions(), (TRUE, TRUE))
    assert not isinstance(found, FitFailure), found


def test_cameras_of_another_focus_are_refused() -> None:
    views, _ = make_views(Scene(n_views=10, bow_mm=(0.3, -0.2)), 1)
    values = CAMERA.parameters * np.where(np.arange(len(CAMERA.parameters)) < 2, 1.1, 1.0)
    moved = CameraModel.from_parameters(values, CAMERA.width_px, CAMERA.height_px)
    found = prepare_cameras(
        (views, views), StereoOptions(), (certain_camera(moved, PROVENANCE),) * 2
    )
    assert isinstance(found, FitFailure)
    assert "do not fit the calibration given" in found.reason


@cache
def of_square_pixels(side: int, seed: int) -> CameraCalibration:
    """A camera calibrated by itself, from other images, as ``--fix aspect`` does."""
    options = CameraOptions(distortion="k1k2p1p2k3", n_folds=0, is_aspect_fixed=True)
    fit = calibrate_camera(views_of(make_pairs(SQUARE, seed)[0], side), options)
    assert isinstance(fit, CameraFit)
    return held(fit.camera, fit.covariance)


def rounded(camera: CameraCalibration) -> CameraCalibration:
    """Its covariance differs in the last digits."""
    covariance = camera.covariance.copy()
    covariance[1, 1] *= 1.0 + 1e-13
    return replace(camera, covariance=covariance)


def squared_over_own(error: FloatArray, covariance: FloatArray, is_same: list[int]) -> float:
    """``e' C^-1 e`` without parameters that are the same as others."""
    own = np.setdiff1d(np.arange(len(error)), is_same)
    sigma = np.sqrt(np.diag(covariance))[own]
    scaled = error[own] / sigma
    return float(
        scaled @ np.linalg.solve(covariance[np.ix_(own, own)] / np.outer(sigma, sigma), scaled)
    )


@pytest.mark.parametrize("is_rounded", [False, True])
def test_cameras_of_square_pixels_keep_them_as_a_prior(*, is_rounded: bool) -> None:
    """Nothing that they know is lost or made up: the truth lies within what is stated.

    fx and fy of such a camera err as one, exactly or up to a document's rounding.
    """
    errors, options = [], StereoOptions(CameraOptions(n_folds=0), intrinsics="prior", n_folds=0)
    for seed in range(4):
        left, right = (of_square_pixels(side, 100 * (side + 1) + seed) for side in (0, 1))
        given = (rounded(left), rounded(right)) if is_rounded else (left, right)
        fit = calibrate_stereo(make_pairs(SQUARE, seed)[0], SQUARE.target, options, given)
        assert isinstance(fit, StereoFit), fit
        for fx, fy in FX_FY:
            assert fit.parameters[fy] == pytest.approx(fit.parameters[fx], rel=1e-12)
            np.testing.assert_allclose(fit.covariance[fy], fit.covariance[fx], rtol=1e-9)
        assert fit.sigma[0] < 0.9 * np.sqrt(given[0].covariance[0, 0]), "the pairs tell more"
        error = increments(SQUARE.views, fit.views)
        errors.append(squared_over_own(error, fit.covariance, [fy for _, fy in FX_FY]))
    low, high = stats.chi2.ppf([0.0005, 0.9995], 22 * len(errors)) / len(errors)
    assert low < float(np.mean(errors)) < high


def test_a_camera_of_square_pixels_is_compared_with_another_and_with_the_truth() -> None:
    """Both solved with fx = fy: their common focal length counts once."""
    camera = of_square_pixels(0, 7)
    views = [views_of(make_pairs(SQUARE, 3)[0], side) for side in (0, 1)]
    options = StereoOptions(CameraOptions("k1k2p1p2k3", n_folds=0, is_aspect_fixed=True))
    found = prepare_cameras(views, options, (camera, of_square_pixels(1, 8)))
    assert not isinstance(found, FitFailure), found
    low, high = stats.chi2.ppf([0.0005, 0.9995], 8)
    assert low < 8 * found[0].given_level < high
    told = camera_errors(camera, SQUARE.views.left.parameters)
    assert told.n_parameters == 8
    error = camera.camera.parameters - SQUARE.views.left.parameters
    assert told.normalised**2 == pytest.approx(squared_over_own(error, camera.covariance, [1]))
    assert low < told.normalised**2 < high


def test_a_held_camera_without_covariance_is_named() -> None:
    """What is stated of the pair does not hold its errors; the other camera's are in it."""
    known = np.diag([1.0, 1.0, 1.0, 1.0, 1e-4, 1e-4, 1e-6, 1e-6, 1e-4]) ** 2
    options = StereoOptions(CameraOptions("k1k2", n_folds=0), intrinsics="fixed", n_folds=0)
    for given, named in (
        ((held(SQUARE.views.left, known), held(SQUARE.views.right)), ["right"]),
        ((held(SQUARE.views.left), held(SQUARE.views.right)), ["left", "right"]),
        ((held(SQUARE.views.left, known), held(SQUARE.views.right, known)), []),
    ):
        fit = calibrate_stereo(make_pairs(SQUARE, 1)[0], SQUARE.target, options, given)
        assert isinstance(fit, StereoFit), fit
        told = [text for text in fit.warnings if "came without covariance" in text]
        assert told == [
            f"the {side} camera came without covariance: the pair's sigmas leave its errors out"
            for side in named
        ]
