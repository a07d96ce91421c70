# SPDX-License-Identifier: Apache-2.0
"""The pose of a board on which the laser is on: its light pulls the points that it crosses."""

from __future__ import annotations

import numpy as np

from armscan.calibration.cameras.start import estimate_board_pose
from armscan.calibration.sheets.board_points import pose_lit_board
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.models.camera import CameraModel
from armscan.simulation.objects.boards import CirclePattern
from armscan.vision.targets.circle_grid import correct_centres
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.target import CircleGrid, TargetView
from rigs.target_scenes import camera, exposure, model, render, with_laser_line

TARGET = CircleGrid(9, 7, 3.75)
DISTANCE_MM = 80.0
AZIMUTH_DEG, TILT_DEG = 60.0, 25.0


def lit_view(peak: float, seed: int) -> tuple[TargetView, FloatArray, CameraModel]:
    """The view of a board under a wide line of this peak, and the true places of its points, px."""
    rendered = render(
        CirclePattern(9, 7, 3.75, 1.8),
        DISTANCE_MM,
        tilt_deg=TILT_DEG,
        azimuth_deg=AZIMUTH_DEG,
        render_camera=camera(distorted=True),
    )
    through = rendered.marks_px.mean(axis=0) + np.random.default_rng(seed).uniform(-20, 20, 2)
    lit = with_laser_line(rendered.image, through, 1.3, 6.0, peak)
    view = detect_target(exposure(lit, seed), TARGET)
    assert isinstance(view, TargetView), view
    corrected = correct_centres(view, model(distorted=True))
    return corrected, rendered.marks_px[view.point_index], model(distorted=True)


def off_px(
    pose: Estimate[Pose[Sensor, Board]], view: TargetView, truth_px: FloatArray, lens: CameraModel
) -> float:
    """By how much the pose puts the board's points elsewhere than they are, rms, px."""
    error = lens.project(pose.value.apply(view.points_board_mm)) - truth_px
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def test_a_wide_bright_line_does_not_pull_the_board() -> None:
    """Poses are as good as without line: 6 numbers from 63 discs of 0.006 px an axis."""
    plain, lit = [], []
    for seed in range(4):
        view, truth, lens = lit_view(peak=300.0, seed=seed)
        pose, found = estimate_board_pose(view, lens), pose_lit_board(view, lens)
        assert not isinstance(pose, FitFailure)
        assert not isinstance(found, FitFailure)
        plain.append(off_px(pose, view, truth, lens))
        lit.append(off_px(found[1], view, truth, lens))
    expected = 0.006 * np.sqrt(2.0 * 6.0 / 63.0)
    assert np.mean(plain) > 4.0 * expected
    assert np.mean(lit) < 1.3 * expected


def test_without_a_line_little_is_widened() -> None:
    view, _, lens = lit_view(peak=0.0, seed=1)
    lit = pose_lit_board(view, lens)
    assert not isinstance(lit, FitFailure)
    changed = np.any(lit[0].covariance_px2 != view.covariance_px2, axis=(1, 2))
    assert changed.sum() <= 2
    plain = estimate_board_pose(view, lens)
    assert not isinstance(plain, FitFailure)
    sigma_mm = np.sqrt(np.diag(plain.covariance)[3:])
    shift = np.abs(lit[1].value.translation_mm - plain.value.translation_mm)
    assert np.all(shift < sigma_mm)
