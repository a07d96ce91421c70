# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure
from armscan.simulation.objects.boards import CirclePattern
from armscan.vision.targets.circle_edges import measure_circles
from armscan.vision.targets.circle_grid import correct_centres
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.target import CircleGrid, TargetView
from rigs.flat_prints import Lighting, RenderedTarget
from rigs.target_scenes import camera, exposure, model, nees, render

TARGET = CircleGrid(6, 5, 3.75)
PATTERN = CirclePattern(6, 5, 3.75, 1.875)
DISTANCE_MM = 54.3
"""Circles 69 px across at f = 2000 px."""


def errors(view: TargetView, rendered: RenderedTarget) -> np.ndarray:
    return view.points_px - rendered.marks_px[view.point_index]


def detected(rendered: RenderedTarget, target: CircleGrid = TARGET, seed: int = 0) -> TargetView:
    view = detect_target(exposure(rendered.image, seed), target)
    assert isinstance(view, TargetView), view
    return view


@pytest.mark.parametrize(
    ("azimuth_deg", "blur_px", "gradient", "is_light"),
    [(20.0, 1.0, 0.0, False), (75.0, 0.7, 0.5, True), (140.0, 2.0, 0.0, False)],
)
def test_centres_at_45_degrees_reach_the_target_figures(
    azimuth_deg: float, blur_px: float, gradient: float, is_light: bool
) -> None:
    """0.006 px rms per axis and 0.002 px bias, noise 2, lens distorted, intrinsics known."""
    pattern = CirclePattern(6, 5, 3.75, 1.875, is_light_on_dark=is_light)
    rendered = render(
        pattern,
        DISTANCE_MM,
        tilt_deg=45.0,
        azimuth_deg=azimuth_deg,
        roll_deg=10.0,
        render_camera=camera(blur_px, distorted=True),
        lighting=Lighting(gradient=gradient),
    )
    error, covariance = [], []
    for seed in range(4):
        view = correct_centres(detected(rendered, seed=seed), model(distorted=True))
        assert len(view) == 30
        error.append(errors(view, rendered))
        covariance.append(view.covariance_px2)
    every = np.concatenate(error)
    n = len(every)
    sigma = np.sqrt(np.mean(every**2, axis=0))
    # sigma grows with the blur: 0.006 px belongs to a blur of 1 px and even light
    assert sigma.max() < 0.006 * (1.5 if blur_px > 1.5 or gradient else 1.0)
    assert (np.abs(every.mean(axis=0)) < 0.002).all()
    mean = nees(every, np.concatenate(covariance)).mean() / 2.0
    assert 1.0 - 4.0 / np.sqrt(n) < mean < 1.0 + 4.0 / np.sqrt(n)


def test_eccentricity_is_corrected_and_would_show() -> None:
    rendered = render(PATTERN, DISTANCE_MM, tilt_deg=45.0, azimuth_deg=30.0)
    view = detected(rendered)
    assert view.edges is not None
    radius = 34.5
    shapes = np.repeat(radius**2 * np.eye(2)[None], 30, axis=0)
    circles = measure_circles(exposure(rendered.image).image, view.points_px, shapes, 5.0)
    uncorrected = circles.ellipses.centres()[0][circles.is_good]
    bias = (uncorrected - rendered.marks_px[view.point_index][circles.is_good]).mean(axis=0)
    assert np.hypot(*bias) > 0.1
    assert np.abs(errors(view, rendered).mean(axis=0)).max() < 0.004


def test_blur_and_radius_are_measured() -> None:
    for blur_px in (0.8, 1.5):
        rendered = render(PATTERN, DISTANCE_MM, render_camera=camera(blur_px))
        shapes = np.repeat(33.0**2 * np.eye(2)[None], 30, axis=0)
        circles = measure_circles(rendered.image, rendered.marks_px + 0.8, shapes, 5.0)
        np.testing.assert_allclose(
            circles.blur_px, np.hypot(blur_px, np.sqrt(1.0 / 12.0)), rtol=0.02
        )
        np.testing.assert_allclose(circles.ellipses.axes()[0], 2000.0 * 0.9375 / 54.3, atol=3e-3)


def test_a_bite_out_of_a_circle_is_rejected() -> None:
    rendered = render(PATTERN, DISTANCE_MM, tilt_deg=20.0)
    image = rendered.image.copy()
    u, v = np.rint(rendered.marks_px[14]).astype(int)
    image[v + 30 : v + 46, u - 8 : u + 8] = 120.0
    view = detect_target(exposure(image), TARGET)
    assert isinstance(view, TargetView)
    row = np.flatnonzero(view.point_index == 14)
    error = errors(view, rendered)[row]
    assert np.linalg.norm(error) < 0.05
    sigma = np.sqrt(np.trace(view.covariance_px2, axis1=1, axis2=2))
    assert sigma[row[0]] > 1.2 * np.median(sigma)


@pytest.mark.parametrize("diameter_px", [9.0, 18.0, 190.0])
def test_any_size_of_circle(diameter_px: float) -> None:
    columns, rows, pitch_mm = (4, 3, 2.4) if diameter_px > 100 else (6, 5, 3.75)
    distance_mm = 2000.0 * 1.875 / diameter_px
    pattern = CirclePattern(columns, rows, pitch_mm, 1.875)
    rendered = render(pattern, distance_mm, tilt_deg=15.0, azimuth_deg=40.0)
    view = detected(rendered, CircleGrid(columns, rows, pitch_mm))
    assert len(view) == columns * rows
    # the sigma of a centre falls with the square root of the perimeter
    expected = 0.0045 * np.sqrt(69.0 / diameter_px)
    assert np.sqrt(np.mean(errors(view, rendered) ** 2)) < 3.0 * expected


@pytest.mark.parametrize("is_light", [False, True])
@pytest.mark.parametrize("roll_deg", [0.0, 100.0, 200.0])
def test_asymmetric_grid_keeps_its_origin_at_any_roll(is_light: bool, roll_deg: float) -> None:
    pattern = CirclePattern(3, 7, 3.0, 2.4, is_asymmetric=True, is_light_on_dark=is_light)
    rendered = render(pattern, 75.0, tilt_deg=35.0, azimuth_deg=60.0, roll_deg=roll_deg)
    view = detected(rendered, CircleGrid(3, 7, 3.0, is_asymmetric=True))
    assert len(view) == 21
    assert not view.is_ambiguous
    assert np.abs(errors(view, rendered)).max() < 0.05


def test_symmetric_grid_is_flagged_and_numbered_to_the_right() -> None:
    rendered = render(PATTERN, DISTANCE_MM, tilt_deg=20.0, roll_deg=170.0)
    view = detected(rendered)
    assert view.is_ambiguous
    np.testing.assert_allclose(view.points_px, rendered.marks_px[::-1][view.point_index], atol=0.05)


def test_asymmetric_grid_with_an_even_count_of_rows_is_ambiguous() -> None:
    pattern = CirclePattern(3, 6, 3.0, 2.4, is_asymmetric=True)
    rendered = render(pattern, 75.0, tilt_deg=20.0)
    view = detected(rendered, CircleGrid(3, 6, 3.0, is_asymmetric=True))
    assert view.is_ambiguous
    np.testing.assert_allclose(view.points_px, rendered.marks_px, atol=0.05)


@pytest.mark.parametrize("target", [CircleGrid(5, 5, 3.75), CircleGrid(7, 5, 3.75)])
def test_a_wrong_count_fails_and_says_what_was_seen(target: CircleGrid) -> None:
    rendered = render(PATTERN, DISTANCE_MM, tilt_deg=20.0)
    failure = detect_target(exposure(rendered.image), target)
    assert isinstance(failure, FitFailure)
    assert "6 x 5" in failure.reason
    assert "30 circles" in failure.reason


def test_a_grid_partly_out_of_view_fails() -> None:
    rendered = render(PATTERN, DISTANCE_MM, tilt_deg=20.0)
    left = int(rendered.marks_px[:, 0].min()) + 60
    failure = detect_target(exposure(rendered.image[:, left:]), TARGET)
    assert isinstance(failure, FitFailure)
    assert "whole grid" in failure.remedy


@pytest.mark.parametrize("shape", [(300, 400), (20, 20), (300, 400, 3)])
def test_a_blank_image_fails(shape: tuple[int, ...]) -> None:
    failure = detect_target(Exposure(np.full(shape, 90, np.uint8), "blank"), TARGET)
    assert isinstance(failure, FitFailure)
    assert "blank" in failure.reason


def test_noise_and_saturation_fail() -> None:
    rng = np.random.default_rng(5)
    for image in (rng.integers(0, 256, (400, 500)), np.full((400, 500), 255)):
        failure = detect_target(Exposure(image.astype(np.uint8), "noise"), TARGET)
        assert isinstance(failure, FitFailure)


def test_centres_cannot_be_corrected_without_edges() -> None:
    view = detected(render(PATTERN, DISTANCE_MM))
    bare = TargetView(
        source="x",
        width_px=view.width_px,
        height_px=view.height_px,
        point_index=view.point_index,
        points_px=view.points_px,
        covariance_px2=view.covariance_px2,
        points_board_mm=view.points_board_mm,
    )
    with pytest.raises(InputError, match="no circle edges"):
        correct_centres(bare)
