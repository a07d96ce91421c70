# SPDX-License-Identifier: Apache-2.0
"""What lies under a line, told from the print's repetition, against the rendering without line."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from armscan.calibration.cameras.start import estimate_board_pose
from armscan.geometry.arrays import BoolArray, FloatArray, ImageArray
from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure, SensorWindow
from armscan.simulation.objects.boards import CirclePattern, FlatPattern
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import StripeOptions
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.repeated_print import predict_print
from armscan.vision.targets.target import Chessboard, CircleGrid, Target, TargetView, parse_target
from rigs.flat_prints import ChessboardPattern, Lighting
from rigs.target_scenes import (
    NOISE,
    camera,
    exposure,
    line_distance,
    model,
    render,
    with_laser_line,
)

LINE_PX = 2.0
QUANTISATION = 1.0 / 12.0
"""Variance of a rounded level."""


def predicted(lit: Exposure, target: Target) -> Exposure | None:
    view = detect_target(lit, target)
    assert isinstance(view, TargetView), view
    pose = estimate_board_pose(view, model(distorted=True))
    assert not isinstance(pose, FitFailure)
    return predict_print(lit, view, target, pose.value, model(distorted=True))


def between_points(marks_px: FloatArray, image: ImageArray) -> BoolArray:
    """Pixels (H, W) within the hull of the target's points, in an image that begins at (0, 0)."""
    inside = np.zeros(image.shape, np.uint8)
    hull = cv2.convexHull(marks_px.astype(np.float32))
    cv2.fillConvexPoly(inside, hull.round().astype(np.int32), 1)
    return inside > 0


@pytest.mark.parametrize(
    ("target", "pattern", "distance_mm"),
    [
        (CircleGrid(9, 7, 3.75), CirclePattern(9, 7, 3.75, 1.2), 80.0),
        (CircleGrid(9, 7, 3.75), CirclePattern(9, 7, 3.75, 1.2, is_light_on_dark=True), 80.0),
        (Chessboard(9, 6, 4.0), ChessboardPattern(9, 6, 4.0), 90.0),
    ],
    ids=["dark discs", "light discs", "squares"],
)
@pytest.mark.parametrize("corner", [(0, 0), (120, 60)])
def test_what_lies_under_the_line_is_told_to_the_noise(
    target: Target, pattern: FlatPattern, distance_mm: float, corner: tuple[int, int]
) -> None:
    """Lens distorted, board tilted, lamp to one side; the laser pulls centres that it crosses."""
    rendered = render(
        pattern,
        distance_mm,
        tilt_deg=30.0,
        azimuth_deg=50.0,
        roll_deg=10.0,
        render_camera=camera(distorted=True),
        lighting=Lighting(gradient=0.3, gradient_azimuth_rad=1.0),
    )
    through = rendered.marks_px.mean(axis=0) + 3.0
    with_line = with_laser_line(rendered.image, through, 0.4, LINE_PX, peak=60.0)
    x, y = corner
    lit = exposure(with_line[y:, x:], seed=3, window=SensorWindow(x, y))
    found = predicted(lit, target)
    assert found is not None
    along, away = line_distance(rendered.image.shape, through, 0.4)
    reach = 0.35 * float(np.ptp(rendered.marks_px, axis=0).max())
    core = ((np.abs(away) < 2.0 * LINE_PX) & (np.abs(along) < reach))[y:, x:]
    error = (found.image.astype(np.float64) - rendered.image[y:, x:])[core]
    assert core.sum() > 2000
    # The median of dozens of cells is quieter than one pixel, also where edges are resampled.
    assert np.sqrt(np.mean(error**2)) < np.sqrt(NOISE**2 + QUANTISATION)
    assert abs(error.mean()) < 0.2 * NOISE
    inside = between_points(rendered.marks_px, rendered.image)
    beside = ((np.abs(away) > 8.0 * LINE_PX) & inside)[y:, x:]
    left = (found.image.astype(np.float64) - lit.image)[beside]
    assert np.sqrt(np.mean(left**2)) < 1.5 * NOISE


def test_misprinted_discs_are_found_where_they_are() -> None:
    """Discs that miss their places by 0.5 px: what is left at their rims tells the sign."""
    missed = np.random.default_rng(8).normal(0.0, 0.02, (63, 2))
    pattern = CirclePattern(
        9, 7, 3.75, 1.8, misplaced_mm=tuple((float(x), float(y)) for x, y in missed)
    )
    rendered = render(pattern, 80.0, tilt_deg=20.0, render_camera=camera(distorted=True))
    lit = exposure(rendered.image, seed=5)
    found = predicted(lit, CircleGrid(9, 7, 3.75))
    assert found is not None
    own = between_points(rendered.marks_px, rendered.image)
    error = (found.image.astype(np.float64) - rendered.image)[own]
    assert np.sqrt(np.mean(error**2)) < NOISE


@pytest.mark.parametrize("distance_mm", [80.0, 240.0])
def test_lines_and_their_sigma_are_as_good_as_with_an_image_without_laser(
    distance_mm: float,
) -> None:
    """Also where the target fills little of the image; what is beyond its cells shows no line."""
    pattern = CirclePattern(9, 7, 3.75, 1.2)
    rendered = render(pattern, distance_mm, tilt_deg=20.0, render_camera=camera(distorted=True))
    through = rendered.marks_px.mean(axis=0) + 2.0
    lit = exposure(with_laser_line(rendered.image, through, 0.4, LINE_PX, peak=45.0), seed=3)
    told, dark = predicted(lit, CircleGrid(9, 7, 3.75)), exposure(rendered.image, seed=4)
    assert told is not None
    found, between = [], between_points(rendered.marks_px, lit.image)
    for background in (told, dark):
        profile = extract_stripes(lit, StripeOptions(), background)
        q = profile.points_px[profile.is_accepted]
        at = q.round().astype(int)
        is_between = between[at[:, 1], at[:, 0]]
        away = (q - through) @ np.array([-np.sin(0.4), np.cos(0.4)])
        near = (np.abs(away) < 4.0 * LINE_PX) & is_between
        sigma = profile.sigma_px[profile.is_accepted][near]
        off = away[near]
        found.append((len(off), np.sqrt(np.mean((off / sigma) ** 2)), np.sqrt(np.mean(off**2))))
    (n_told, in_sigmas, off_told), (n_dark, in_sigmas_dark, off_dark) = found
    assert n_told > 0.95 * n_dark
    assert in_sigmas < 1.2 * in_sigmas_dark
    # What is left of the rims, resampled twice, is in it.
    assert off_told < 1.6 * off_dark


def test_an_asymmetric_grid_is_told_in_all_its_cells() -> None:
    """Its cells are diamonds: squares about the points leave a sixth of the print out."""
    pattern = CirclePattern(5, 10, 4.0, 2.6, is_asymmetric=True)
    rendered = render(pattern, 130.0, tilt_deg=20.0, render_camera=camera(distorted=True))
    through = rendered.marks_px.mean(axis=0)
    with_line = with_laser_line(rendered.image, through, 0.1, LINE_PX, peak=60.0)
    lit = exposure(with_line, seed=3)
    found = predicted(lit, CircleGrid(5, 10, 4.0, is_asymmetric=True))
    assert found is not None
    inside = between_points(rendered.marks_px, rendered.image)
    error = (found.image.astype(np.float64) - rendered.image)[inside]
    assert np.sqrt(np.mean(error**2)) < np.sqrt(NOISE**2 + QUANTISATION)
    assert np.quantile(np.abs(error), 0.999) < 4.0 * NOISE


def test_a_hand_over_some_discs_is_not_replaced() -> None:
    """Cells that do not look like the print get none: what is smooth there is taken away."""
    rendered = render(CirclePattern(9, 7, 3.75, 1.2), 80.0, render_camera=camera(distorted=True))
    marks = rendered.marks_px.reshape(7, 9, 2)
    image = rendered.image.copy()
    left, top = (marks[2, 2] - 35.0).astype(int)
    right, bottom = (marks[3, 3] + 35.0).astype(int)
    whole = exposure(image)
    view = detect_target(whole, CircleGrid(9, 7, 3.75))
    assert isinstance(view, TargetView)
    pose = estimate_board_pose(view, model(distorted=True))
    assert not isinstance(pose, FitFailure)
    image[top:bottom, left:right] = 90.0
    lit = exposure(image, seed=1)
    given = (view, CircleGrid(9, 7, 3.75), pose.value, model(distorted=True))
    found = predict_print(lit, *given)
    assert found is not None
    x, y = marks[2, 2].astype(int)
    own = np.s_[y - 8 : y + 8, x - 8 : x + 8]
    assert abs(float(found.image[own].mean()) - 90.0) < 30.0
    assert abs(float(found.image[own].mean()) - float(rendered.image[own].mean())) > 30.0


def test_a_board_of_markers_does_not_repeat() -> None:
    rendered = render(CirclePattern(9, 7, 3.75, 1.2), 80.0, render_camera=camera(distorted=True))
    lit = exposure(rendered.image)
    view = detect_target(lit, CircleGrid(9, 7, 3.75))
    assert isinstance(view, TargetView)
    pose = estimate_board_pose(view, model(distorted=True))
    assert not isinstance(pose, FitFailure)
    charuco = parse_target("charuco:10x7:4:3:DICT_4X4_50")
    assert predict_print(lit, view, charuco, pose.value, model(distorted=True)) is None
