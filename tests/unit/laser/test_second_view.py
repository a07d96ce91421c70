# SPDX-License-Identifier: Apache-2.0
"""Boards and stripes of the second camera: points, derivatives, the pose from both views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armscan.calibration.cameras.start import estimate_board_pose
from armscan.calibration.sheets.board_points import (
    HeadCameras,
    intersect_board_of,
    place_board,
    poses_chi2,
)
from armscan.calibration.sheets.result import PlacedBoard
from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector, vector_from_rotation
from armscan.jobs.sheets import _read_scan
from armscan.vision.targets.target import TargetView
from rigs.drawn_arm import draw_postures
from rigs.fan_rig import STEREO_SIGMA, FanRig, fan_rig
from rigs.recording_folders import lab_folder
from rigs.sheet_rig import placed, project

POSE: Pose[Sensor, Board] = placed(8.0, 28.0, 140.0, (18.75, 15.0))
RIG = fan_rig(0, 1)
STEP = np.concatenate(
    [np.tile([1e-2, 1e-2, 1e-2, 1e-2, 1e-5, 1e-4, 1e-6, 1e-6, 1e-3], 2), [1e-5] * 3, [1e-3] * 3]
)


def moved(pose: Pose[Sensor, Board], step: FloatArray) -> Pose[Sensor, Board]:
    return Pose(rotation_from_vector(step[:3]) @ pose.rotation, pose.translation_mm + step[3:])


def right_pixels() -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) of the target in the right image, by OpenCV, and its points in Sensor."""
    board = RIG._camera_rig(POSE, 1).board_points_mm()
    pose = RIG.right_from_left @ POSE
    q = project(RIG.right, Pose(pose.rotation, pose.translation_mm), board)
    return q, board @ POSE.rotation.T + POSE.translation_mm


def test_right_pixels_meet_the_board_in_the_sensors_frame() -> None:
    q, points = right_pixels()
    met = intersect_board_of(q, 1, POSE, HeadCameras.of(RIG.stereo()))
    assert met.is_valid.all()
    np.testing.assert_allclose(met.points_mm, points, atol=1e-9)


def test_derivatives_by_all_parameters_are_those_of_differences() -> None:
    q, _ = right_pixels()
    met = intersect_board_of(q, 1, POSE, HeadCameras.of(RIG.stereo()))
    for j in range(24):
        error = np.zeros(24)
        error[j] = STEP[j]
        ahead, behind = (
            intersect_board_of(q, 1, POSE, HeadCameras.of(RIG.stereo(s * error))).points_mm
            for s in (1.0, -1.0)
        )
        slope = (ahead - behind) / (2.0 * STEP[j])
        np.testing.assert_allclose(
            met.dpoint_dcamera[:, :, j], slope, atol=1e-4 * np.abs(slope).max() + 1e-9
        )
    assert not met.dpoint_dcamera[:, :, :9].any(), "the left camera does not see this image"
    for j in range(6):
        step = np.zeros(6)
        step[j] = 1e-5
        ahead, behind = (
            intersect_board_of(q, 1, moved(POSE, s * step), HeadCameras.of(RIG.stereo())).points_mm
            for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(
            met.dpoint_dpose[:, :, j], (ahead - behind) / 2e-5, rtol=1e-4, atol=1e-6
        )


def views(rig: FanRig, seed: int) -> list[TargetView]:
    rng = np.random.default_rng(seed)
    return [rig._camera_rig(POSE, camera).view(0, rng) for camera in (0, 1)]


def placed_by(rig: FanRig, seen: list[TargetView], error: FloatArray | None = None) -> PlacedBoard:
    cameras = HeadCameras.of(rig.stereo(error))
    own = []
    for camera, view in enumerate(seen):
        pose = estimate_board_pose(view, cameras.model(camera))
        assert pose
        own.append((camera, view, pose))
    return place_board(own, cameras)


def test_the_pose_follows_the_cameras_as_its_derivative_says() -> None:
    seen = views(RIG, 1)
    base = placed_by(RIG, seen)
    for j in range(24):
        error = np.zeros(24)
        error[j] = 0.3 * STEREO_SIGMA[j]
        ahead, behind = (placed_by(RIG, seen, s * error).sensor_from_board for s in (1.0, -1.0))
        slope = np.concatenate(
            [
                vector_from_rotation(ahead.rotation @ behind.rotation.T),
                ahead.translation_mm - behind.translation_mm,
            ]
        ) / (2.0 * error[j])
        # Gauss-Newton form of the derivative: what it leaves out is of the size of the residuals.
        np.testing.assert_allclose(base.by_cameras[:, j], slope, atol=0.05 * np.abs(slope).max())


def test_two_views_place_the_board_within_their_covariance() -> None:
    """Normalised errors over 60 boards, the cameras exact: 6 on average, and less than one view."""
    squares, alone, both = [], 0.0, 0.0
    for seed in range(60):
        seen = views(RIG, seed)
        board = placed_by(RIG, seen)
        found = board.sensor_from_board
        error = np.concatenate(
            [
                vector_from_rotation(found.rotation @ POSE.rotation.T),
                found.translation_mm - POSE.translation_mm,
            ]
        )
        squares.append(float(error @ np.linalg.solve(board.covariance, error)))
        alone += float(np.trace(placed_by(RIG, seen[:1]).covariance[3:, 3:]))
        both += float(np.trace(board.covariance[3:, 3:]))
    # The mean of 60 values of chi2 with 6 degrees of freedom has sigma sqrt(12 / 60) = 0.45.
    assert abs(np.mean(squares) - 6.0) < 3.5 * 0.45
    assert both < 0.6 * alone


def test_cameras_that_saw_different_places_are_told() -> None:
    cameras = HeadCameras.of(RIG.stereo())
    seen = views(RIG, 2)
    first, second = (estimate_board_pose(v, cameras.model(c)) for c, v in enumerate(seen))
    assert not isinstance(first, FitFailure)
    assert not isinstance(second, FitFailure)
    left, right = (0, seen[0], first), (1, seen[1], second)
    assert poses_chi2(left, right, cameras) < 40.0
    other = moved(POSE, np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    view = RIG._camera_rig(other, 1).view(0, np.random.default_rng(3))
    pose = estimate_board_pose(view, cameras.model(1))
    assert pose
    assert poses_chi2(left, (1, view, pose), cameras) > 1e4


def test_an_image_of_a_camera_that_is_not_calibrated_is_refused() -> None:
    with pytest.raises(InputError, match="camera 1"):
        HeadCameras.of(RIG.stereo().left).model(1)


def test_a_recording_of_one_camera_is_told_where_the_calibration_is_of_two(tmp_path: Path) -> None:
    folder = tmp_path / "scan"
    draw_postures(folder)
    assert any("camera 0 alone" in text for text in _read_scan(folder, (), is_stereo=True).warnings)
    assert not _read_scan(folder, (), is_stereo=False).warnings


def test_an_image_of_unknown_lasers_is_no_dark_partner(tmp_path: Path) -> None:
    table = """index,t_ns,camera,file,lasers,view,flags
0,1000,0,images/0.png,A,v,
1,2000,0,images/1.png,,v,laser-unknown
"""
    read = _read_scan(lab_folder(tmp_path, exposures=table), (), is_stereo=False)
    assert [(lit.source, dark) for lit, dark in read.pairs] == [("images/0.png", None)]
    said = "1 of 2 images are left out: it is not known what lasers were on"
    assert said in read.warnings and len(read.exposures) == len(read.paths) == 1
