# SPDX-License-Identifier: Apache-2.0
"""Rays meet the board: values by OpenCV's projection, derivatives by differences."""

import numpy as np

from armscan.calibration.cameras.start import estimate_board_pose
from armscan.calibration.sheets.board_points import dpose_dcamera, intersect_board
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose
from armscan.geometry.rotations import rotation_from_vector
from armscan.models.camera import CameraModel
from rigs.sheet_rig import exact, placed, project, thesis_rig

RIG = exact(thesis_rig())
POSE = RIG.poses[3]
BOARD_MM = np.array([[0.0, 0.0, 0.0], [32.0, 5.0, 0.0], [10.0, 24.0, 0.0], [17.3, 11.1, 0.0]])
STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-6, 1e-6, 1e-7, 1e-7, 1e-6])


def shifted(pose: Pose, step: FloatArray) -> Pose:
    return Pose(rotation_from_vector(step[:3]) @ pose.rotation, pose.translation_mm + step[3:])


def moved(camera: CameraModel, step: FloatArray) -> CameraModel:
    return CameraModel.from_parameters(camera.parameters + step, camera.width_px, camera.height_px)


def test_points_come_back_from_their_opencv_projection() -> None:
    found = intersect_board(project(RIG.camera, POSE, BOARD_MM), POSE, RIG.camera)
    assert found.is_valid.all()
    np.testing.assert_allclose(
        found.points_mm, BOARD_MM @ POSE.rotation.T + POSE.translation_mm, atol=1e-9
    )


def test_derivatives_by_differences() -> None:
    q = project(RIG.camera, POSE, BOARD_MM)
    found = intersect_board(q, POSE, RIG.camera)
    for k in range(2):
        d = 1e-4 * np.eye(2)[k]
        up, down = (intersect_board(q + s * d, POSE, RIG.camera).points_mm for s in (1, -1))
        np.testing.assert_allclose(found.dpoint_dq[:, :, k], (up - down) / 2e-4, atol=1e-7)
    for k in range(6):
        d = 1e-6 * np.eye(6)[k]
        up, down = (intersect_board(q, shifted(POSE, s * d), RIG.camera).points_mm for s in (1, -1))
        np.testing.assert_allclose(
            found.dpoint_dpose[:, :, k], (up - down) / 2e-6, rtol=1e-6, atol=1e-6
        )
    for k in range(9):
        d = STEPS[k] * np.eye(9)[k]
        up, down = (intersect_board(q, POSE, moved(RIG.camera, s * d)).points_mm for s in (1, -1))
        np.testing.assert_allclose(
            found.dpoint_dcamera[:, :, k], (up - down) / (2 * STEPS[k]), rtol=1e-5, atol=1e-5
        )


def test_the_pose_follows_the_camera_as_the_estimator_does() -> None:
    view = RIG.view(3, np.random.default_rng(0))
    pose = estimate_board_pose(view, RIG.camera)
    assert pose
    predicted = dpose_dcamera(view, pose.value, RIG.camera)
    scale = np.array([1e-4] * 3 + [1e-2] * 3)
    for k, step in enumerate([0.5, 0.5, 0.5, 0.5, 1e-4, 1e-3, 1e-5, 1e-5, 1e-2]):
        ends = []
        for sign in (1, -1):
            other = estimate_board_pose(view, moved(RIG.camera, sign * step * np.eye(9)[k]))
            assert other
            turn = Pose(other.value.rotation @ pose.value.rotation.T, np.zeros(3))
            shift = other.value.translation_mm - pose.value.translation_mm
            ends.append(np.concatenate([turn.rotation_vector_rad, shift]))
        numeric = (ends[0] - ends[1]) / 2.0
        np.testing.assert_allclose(
            step * predicted[:, k] / scale, numeric / scale, rtol=0.01, atol=0.002
        )


def test_a_ray_along_the_board_and_a_board_behind_are_no_points() -> None:
    middle = np.array([[RIG.camera.cx_px, RIG.camera.cy_px]])
    edge_on = placed(90.0, 0.0, 140.0, (16.0, 12.0))
    behind = Pose(np.eye(3), np.array([0.0, 0.0, -100.0]))
    for pose in (Pose(edge_on.rotation, edge_on.translation_mm + np.array([0, 5.0, 0])), behind):
        found = intersect_board(middle, pose, RIG.camera)
        assert not found.is_valid.any()
        assert np.isnan(found.points_mm).all()
