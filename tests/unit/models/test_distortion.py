# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from armscan.models.camera import distort, distorted_xy, fold_radius, undistort

LENSES = {
    "none": [0.0, 0.0, 0.0, 0.0, 0.0],
    "barrel": [-0.29, 0.11, 1e-3, -4e-4, -0.006],
    "pincushion": [0.15, 0.02, -5e-4, 3e-4, 0.01],
    "tangential": [-0.05, 0.0, 0.01, -0.02, 0.0],
}
STEP = 1e-6


def field(radius: float) -> np.ndarray:
    side = np.linspace(-1.0, 1.0, 9) * radius / np.sqrt(2.0)
    return np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("name", LENSES)
def test_forward_model_is_that_of_opencv(name: str) -> None:
    k, xy = np.array(LENSES[name]), field(0.7)
    rays = np.column_stack([xy, np.ones(len(xy))])
    oracle = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), k)[0].reshape(-1, 2)
    assert np.abs(distort(xy, k)[0] - oracle).max() < 1e-14
    assert np.array_equal(distorted_xy(xy, k), distort(xy, k)[0])


@pytest.mark.parametrize("name", LENSES)
def test_gradients_match_central_differences(name: str) -> None:
    k, xy = np.array(LENSES[name]), field(0.7)
    _, by_xy, by_k = distort(xy, k)
    for axis in range(2):
        shift = STEP * np.eye(2)[axis]
        numeric = (distorted_xy(xy + shift, k) - distorted_xy(xy - shift, k)) / (2 * STEP)
        assert np.abs(by_xy[:, :, axis] - numeric).max() < 1e-9
    for index in range(5):
        shift = STEP * np.eye(5)[index]
        numeric = (distorted_xy(xy, k + shift) - distorted_xy(xy, k - shift)) / (2 * STEP)
        assert np.abs(by_k[:, :, index] - numeric).max() < 1e-9


@pytest.mark.parametrize("name", LENSES)
def test_inverse_returns_to_the_ideal_point(name: str) -> None:
    k, xy = np.array(LENSES[name]), field(0.6)
    back, is_valid = undistort(distorted_xy(xy, k), k)
    assert is_valid.all()
    assert np.abs(back - xy).max() < 1e-13


def test_fold_radius_by_hand() -> None:
    # d/dr (r + k1 r^3) = 0 at r = 1 / sqrt(-3 k1)
    assert fold_radius(np.array([-0.3, 0.0, 0.0, 0.0, 0.0])) == pytest.approx(1 / np.sqrt(0.9))
    assert fold_radius(np.array([0.3, 0.0, 0.0, 0.0, 0.0])) == np.inf
    assert fold_radius(np.zeros(5)) == np.inf
    # 1 + 3 k1 s + 5 k2 s^2 with two roots: the smaller one is the fold
    k1, k2 = -0.5, 0.06
    roots = np.roots([5 * k2, 3 * k1, 1.0])
    assert fold_radius(np.array([k1, k2, 0, 0, 0])) == pytest.approx(np.sqrt(roots.min()))


def test_pixels_that_no_direction_reaches_are_flagged() -> None:
    k = np.array([-0.3, 0.0, 0.0, 0.0, 0.0])
    highest = 1 / np.sqrt(0.9) * (1.0 - 0.3 / 0.9)
    radii = np.array([0.2, 0.5, 0.98, 1.02, 1.5, 3.0]) * highest
    _, is_valid = undistort(np.column_stack([radii, 0.0 * radii]), k)
    assert is_valid.tolist() == [True, True, True, False, False, False]


def test_outer_branch_is_never_returned_as_valid() -> None:
    # The radius grows again beyond the fold: a pixel out there has an inverse, on a branch
    # that no lens has.
    k = np.array([-0.5, 0.08, 0.0, 0.0, 0.0])
    limit = fold_radius(k)
    radii = np.linspace(0.0, 4.0, 400)
    back, is_valid = undistort(np.column_stack([radii, 0.0 * radii]), k)
    assert np.isfinite(back).all()
    assert np.all(np.hypot(*back[is_valid].T) < limit)
    assert is_valid[0]
    assert not is_valid[-1]


def test_empty_and_nan_input() -> None:
    empty, is_valid = undistort(np.zeros((0, 2)), np.zeros(5))
    assert empty.shape == (0, 2)
    assert is_valid.shape == (0,)
    _, is_valid = undistort(np.array([[np.nan, 0.0], [0.1, 0.2]]), np.array(LENSES["barrel"]))
    assert is_valid.tolist() == [False, True]
