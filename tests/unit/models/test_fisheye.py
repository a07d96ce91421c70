# SPDX-License-Identifier: Apache-2.0
"""Cameras with a fisheye lens: by OpenCV's model, by differences, there and back, its limits."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.models.camera import WIDEST_RAD, CameraModel, fold_radius
from rigs.fisheye import TANGENTIAL

CAMERA = CameraModel.from_parameters(
    [231.0, 229.0, 472.0, 305.0, 0.021, -0.012, 0.0, 0.0, 0.004], 960, 600, "fisheye"
)


def directions(rng: np.random.Generator, largest_deg: float, n: int = 400) -> FloatArray:
    """(N, 3) points up to so far from the axis, some of them next to it."""
    theta = np.deg2rad(largest_deg) * rng.random(n)
    theta[:20] = np.geomspace(1e-9, 1e-4, 20)
    around, far = rng.uniform(0.0, 2.0 * np.pi, n), rng.uniform(50.0, 900.0, n)
    ray = np.stack([np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)])
    return np.asarray(far[:, None] * ray.T)


def test_projection_is_that_of_opencv() -> None:
    points = directions(np.random.default_rng(1), 88.0)
    k1, k2, _, _, k3 = CAMERA.distortion
    seen, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), CAMERA.matrix, np.array([k1, k2, k3, 0.0])
    )
    np.testing.assert_allclose(CAMERA.project(points), seen[:, 0], atol=1e-9)


def test_derivatives_are_differences() -> None:
    points = directions(np.random.default_rng(2), 80.0)
    _, by_point, by_parameters = CAMERA.project_with_jacobian(points)
    for k in range(3):
        step = 1e-4 * np.eye(3)[k]
        numeric = (CAMERA.project(points + step) - CAMERA.project(points - step)) / 2e-4
        np.testing.assert_allclose(by_point[:, :, k], numeric, atol=1e-6)
    for k in set(range(9)) - set(TANGENTIAL):
        step = 1e-4 * np.eye(9)[k]
        plus, minus = (CAMERA.moved_to(CAMERA.parameters + s) for s in (step, -step))
        numeric = (plus.project(points) - minus.project(points)) / 2e-4
        np.testing.assert_allclose(by_parameters[:, :, k], numeric, atol=1e-6)


def test_pixels_lead_back_to_their_rays() -> None:
    points = directions(np.random.default_rng(3), 87.0)
    xy, is_valid = CAMERA.undistort(CAMERA.project(points))
    assert is_valid.all()
    ideal = points[:, :2] / points[:, 2:]
    assert np.all(np.abs(xy - ideal) < 1e-9 * (1.0 + np.sum(ideal**2, axis=1))[:, None])


def test_what_lies_beyond_the_lens_has_no_ray() -> None:
    """Beyond 88 degrees; and where r' = 1 + 3 k1 theta^2 is zero, at theta = 1 by hand."""
    assert fold_radius(CAMERA.distortion, "fisheye") == pytest.approx(np.tan(WIDEST_RAD))
    folding = np.array([-1.0 / 3.0, 0.0, 0.0, 0.0, 0.0])
    assert fold_radius(folding, "fisheye") == pytest.approx(np.tan(1.0))
    camera = CameraModel.from_parameters([300, 300, 499.5, 499.5, *folding], 1000, 1000, "fisheye")
    largest = 300.0 * (1.0 - 1.0 / 3.0)
    places = np.array([[499.5 + largest - 1.0, 499.5], [499.5 + largest + 1.0, 499.5]])
    assert camera.undistort(places)[1].tolist() == [True, False]


def test_a_fisheye_has_no_tangential_distortion() -> None:
    with pytest.raises(InputError, match="p1 and p2 are 0"):
        CAMERA.moved_to([*CAMERA.parameters[:6], 1e-3, 0.0, 0.0])
    with pytest.raises(InputError, match="no kind of lens"):
        CameraModel.from_parameters(CAMERA.parameters, 960, 600, "mirror")  # type: ignore[arg-type]
    assert CAMERA.parameter_names == ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3")


def test_only_a_lens_that_folds_has_a_folded_border() -> None:
    """The image's corners lie 113 degrees out: no ray, and nothing wrong with the lens."""
    assert not CAMERA.undistort(np.array([[0.0, 0.0]]))[1][0]
    assert not len(CAMERA.folded_border())
    folding = CAMERA.moved_to([*CAMERA.parameters[:4], -0.3, 0.0, 0.0, 0.0, 0.0])
    assert len(folding.folded_border()) == 96
