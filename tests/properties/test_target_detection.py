# SPDX-License-Identifier: Apache-2.0
"""What must not change the answer: sensor window, polarity, bit depth, colour, a quarter turn."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.records.exposure import Exposure, SensorWindow
from armscan.simulation.objects.boards import CirclePattern
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.target import Chessboard, CircleGrid, Target, TargetView
from rigs.flat_prints import ChessboardPattern
from rigs.slow_renderer import add_noise
from rigs.target_scenes import render

CIRCLES = CircleGrid(5, 3, 3.75, is_asymmetric=True)
BOARD = Chessboard(7, 4, 3.0)
EXACT_PX = 1e-6
ROUNDING_PX = 0.02
"""Rounding to 8 bits is noise of 0.3 levels: a tenth of a centre's sigma at noise 2."""


def image_of(target: Target) -> np.ndarray:
    if isinstance(target, CircleGrid):
        pattern = CirclePattern(5, 3, 3.75, 3.0, is_asymmetric=True)
        rendered = render(pattern, 90.0, tilt_deg=30.0, azimuth_deg=40.0, roll_deg=20.0)
    else:
        board = ChessboardPattern(7, 4, 3.0)
        rendered = render(board, 75.0, tilt_deg=30.0, azimuth_deg=40.0, roll_deg=20.0)
    return rendered.image


@pytest.fixture(scope="module", params=[CIRCLES, BOARD], ids=["circles", "chessboard"])
def scene(request: pytest.FixtureRequest) -> tuple[Target, np.ndarray, TargetView]:
    target = request.param
    image = add_noise(image_of(target), np.random.default_rng(1), sigma=1.0)
    return target, image, found(target, Exposure(image, "whole"))


def found(target: Target, exposure: Exposure) -> TargetView:
    view = detect_target(exposure, target)
    assert isinstance(view, TargetView), view
    return view


def test_a_sensor_window_gives_full_sensor_pixels(
    scene: tuple[Target, np.ndarray, TargetView],
) -> None:
    target, image, whole = scene
    part = image[40:, 60:]
    view = found(target, Exposure(part, "part", window=SensorWindow(60, 40)))
    np.testing.assert_allclose(view.points_px, whole.points_px, atol=ROUNDING_PX)
    np.testing.assert_allclose(view.covariance_px2, whole.covariance_px2, rtol=0.2, atol=1e-6)
    if view.edges is not None and whole.edges is not None:
        assert len(view.edges.circle) == pytest.approx(len(whole.edges.circle), rel=0.02)


def test_a_quarter_turn_of_the_image_turns_the_points(
    scene: tuple[Target, np.ndarray, TargetView],
) -> None:
    target, image, whole = scene
    view = found(target, Exposure(np.rot90(image).copy(), "turned"))
    back = np.column_stack([image.shape[1] - 1 - view.points_px[:, 1], view.points_px[:, 0]])
    shared, a, b = np.intersect1d(view.point_index, whole.point_index, return_indices=True)
    assert len(shared) == len(whole)
    np.testing.assert_allclose(back[a], whole.points_px[b], atol=ROUNDING_PX)


def test_deeper_images_of_the_same_scene(scene: tuple[Target, np.ndarray, TargetView]) -> None:
    target, image, whole = scene
    for bits in (10, 12, 16):
        deep = image.astype(np.uint16) << (bits - 8)
        view = found(target, Exposure(deep, "deep", bits_used=bits))
        np.testing.assert_allclose(view.points_px, whole.points_px, atol=ROUNDING_PX)
        np.testing.assert_allclose(view.covariance_px2, whole.covariance_px2, rtol=0.2, atol=1e-6)


def test_a_colour_image_of_a_grey_scene(scene: tuple[Target, np.ndarray, TargetView]) -> None:
    target, image, whole = scene
    view = found(target, Exposure(np.repeat(image[..., None], 3, axis=2), "colour"))
    np.testing.assert_allclose(view.points_px, whole.points_px, atol=EXACT_PX)


def test_the_negative_of_a_circle_grid_has_the_same_centres() -> None:
    image = add_noise(image_of(CIRCLES), np.random.default_rng(1), sigma=1.0)
    positive = found(CIRCLES, Exposure(image, "dark on light"))
    negative = found(CIRCLES, Exposure(255 - image, "light on dark"))
    np.testing.assert_allclose(negative.points_px, positive.points_px, atol=ROUNDING_PX)
