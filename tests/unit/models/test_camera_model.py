# SPDX-License-Identifier: Apache-2.0
import time

import cv2
import numpy as np
import pytest

from armscan.errors import InputError
from armscan.models.camera import PARAMETER_NAMES, CameraModel
from rigs.plain_scanner import plain_camera

CAMERA = plain_camera(
    (1430.0, 1425.0), (478.0, 642.0), (960, 1280), [-0.2, 0.08, 6e-4, -4e-4, 0.01]
)
TELE_PX_OF_DOUBLE = 1e-9
"""Rounding of a pixel coordinate after a few dozen operations at 2000 px."""


def points_in_view(n: int = 200, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    z = rng.uniform(100.0, 400.0, n)
    return np.column_stack([z * rng.uniform(-0.3, 0.3, n), z * rng.uniform(-0.4, 0.4, n), z])


def test_projection_is_that_of_opencv() -> None:
    points = points_in_view()
    oracle = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.matrix, CAMERA.distortion)[
        0
    ].reshape(-1, 2)
    assert np.abs(CAMERA.project(points) - oracle).max() < TELE_PX_OF_DOUBLE
    assert np.abs(CAMERA.project_with_jacobian(points)[0] - oracle).max() < TELE_PX_OF_DOUBLE


def test_pixel_zero_is_the_centre_of_the_first_pixel() -> None:
    centred = plain_camera(100.0, (0.0, 0.0), (10, 8))
    assert centred.project(np.array([[0.0, 0.0, 5.0]])).tolist() == [[0.0, 0.0]]
    edges = np.array([[-0.5, -0.5], [-0.51, 0.0], [9.5, 7.5], [9.51, 0.0], [0.0, 7.51]])
    assert centred.is_inside(edges).tolist() == [True, False, True, False, False]


def test_jacobians_match_central_differences() -> None:
    points = points_in_view(40)
    _, by_point, by_parameters = CAMERA.project_with_jacobian(points)
    for axis in range(3):
        shift = 1e-4 * np.eye(3)[axis]
        numeric = (CAMERA.project(points + shift) - CAMERA.project(points - shift)) / 2e-4
        assert np.abs(by_point[:, :, axis] - numeric).max() < 1e-7
    for index in range(len(PARAMETER_NAMES)):
        step = 1e-5 * max(1.0, abs(CAMERA.parameters[index]))
        shift = step * np.eye(9)[index]
        plus = CameraModel.from_parameters(CAMERA.parameters + shift, 960, 1280).project(points)
        minus = CameraModel.from_parameters(CAMERA.parameters - shift, 960, 1280).project(points)
        scale = np.abs(by_parameters[:, :, index]).max()
        error = np.abs(by_parameters[:, :, index] - (plus - minus) / (2 * step)).max()
        assert error < 1e-7 * max(scale, 1.0), PARAMETER_NAMES[index]


def test_pixel_to_ray_to_pixel_returns() -> None:
    u, v = np.meshgrid(np.linspace(0, 959, 25), np.linspace(0, 1279, 25))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    xy, is_valid = CAMERA.undistort(pixels)
    rays = np.column_stack([xy, np.ones(len(xy))])
    assert is_valid.all()
    assert np.abs(CAMERA.project(250.0 * rays) - pixels).max() < TELE_PX_OF_DOUBLE
    oracle = (
        cv2.undistortPointsIter(
            pixels[:, None],
            CAMERA.matrix,
            CAMERA.distortion,
            np.eye(3),
            np.eye(3),
            (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12),
        )
        if hasattr(cv2, "undistortPointsIter")
        else cv2.undistortPoints(pixels[:, None], CAMERA.matrix, CAMERA.distortion)
    )
    # OpenCV stops its fixed-point iteration at about 1e-8 of the focal length.
    assert np.abs(xy - oracle.reshape(-1, 2)).max() < 1e-6


def test_undistortion_jacobians_match_central_differences() -> None:
    rng = np.random.default_rng(3)
    pixels = rng.uniform([50, 50], [900, 1200], (30, 2))
    _, _, by_pixel, by_parameters = CAMERA.undistort_with_jacobian(pixels)
    for axis in range(2):
        shift = 1e-3 * np.eye(2)[axis]
        numeric = (CAMERA.undistort(pixels + shift)[0] - CAMERA.undistort(pixels - shift)[0]) / 2e-3
        assert np.abs(by_pixel[:, :, axis] - numeric).max() < 1e-9
    for index in range(9):
        step = 1e-5 * max(1.0, abs(CAMERA.parameters[index]))
        shift = step * np.eye(9)[index]
        plus = CameraModel.from_parameters(CAMERA.parameters + shift, 960, 1280)
        minus = CameraModel.from_parameters(CAMERA.parameters - shift, 960, 1280)
        numeric = (plus.undistort(pixels)[0] - minus.undistort(pixels)[0]) / (2 * step)
        assert np.abs(by_parameters[:, :, index] - numeric).max() < 1e-8, PARAMETER_NAMES[index]


def test_points_behind_the_camera_have_no_pixel() -> None:
    points = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.isnan(CAMERA.project(points)).any(axis=1).tolist() == [True, True, False]


def test_fold_inside_the_image_is_found() -> None:
    folding = plain_camera(500.0, (319.5, 239.5), (640, 480), [-0.6, 0, 0, 0, 0])
    border = folding.folded_border()
    assert len(border) > 0
    assert np.abs(border - [319.5, 239.5]).max() > 200
    assert len(CAMERA.folded_border()) == 0


def test_inversion_costs_about_a_microsecond_a_point() -> None:
    """By processor time, with room for a busy machine: a slow path would cost ten times as much."""
    pixels = np.random.default_rng(0).uniform([0, 0], [960, 1280], (50_000, 2))
    best = np.inf
    for _ in range(3):
        start = time.process_time()
        CAMERA.undistort(pixels)
        best = min(best, (time.process_time() - start) / len(pixels))
    assert best < 4e-6


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fx_px": -1.0}, "positive"),
        ({"cy_px": np.nan}, "finite"),
        ({"distortion": np.zeros(4)}, "shape"),
        ({"width_px": 0}, "not an image"),
    ],
)
def test_impossible_cameras_are_refused(change: dict[str, object], words: str) -> None:
    good: dict[str, object] = {
        "fx_px": 100.0,
        "fy_px": 100.0,
        "cx_px": 5.0,
        "cy_px": 5.0,
        "distortion": np.zeros(5),
        "width_px": 10,
        "height_px": 10,
    }
    with pytest.raises(InputError, match=words):
        CameraModel(**{**good, **change})  # type: ignore[arg-type]
