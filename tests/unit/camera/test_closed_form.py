# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from armscan.calibration.cameras.start import (
    _refine,
    constraint_rows,
    estimate_homography,
    intrinsics_from_homographies,
    linear_distortion,
    map_points,
    pose_from_homography,
)
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector
from armscan.models.camera import CameraModel
from rigs.camera_scene import CAMERA, Scene, make_views
from rigs.plain_scanner import plain_camera

PINHOLE = plain_camera((2300.0, 2310.0), (1010.0, 770.0), (2048, 1536))
EXACT = Scene(camera=PINHOLE, noise_px=0.0)


def board_homography(pose: Pose[Sensor, Board], camera: CameraModel = PINHOLE) -> np.ndarray:
    """By definition: H = A [r1 r2 t]."""
    return camera.matrix @ np.column_stack([pose.rotation[:, :2], pose.translation_mm])


def test_homography_of_exact_points_is_the_definition() -> None:
    views, poses = make_views(EXACT, seed=1)
    for view, pose in zip(views, poses, strict=True):
        found = estimate_homography(view.points_board_mm[:, :2], view.points_px)
        assert not isinstance(found, FitFailure)
        truth = board_homography(pose)
        assert np.abs(found - truth / np.linalg.norm(truth)).max() < 1e-12


def test_homography_of_noisy_points_is_the_least_squares_one() -> None:
    views, _ = make_views(Scene(camera=PINHOLE, noise_px=0.5), seed=2)
    board, image = views[0].points_board_mm[:, :2], views[0].points_px
    found = estimate_homography(board, image)
    assert not isinstance(found, FitFailure)
    oracle = cv2.findHomography(board, image, 0)[0]
    ours = np.sum((map_points(found, board) - image) ** 2)
    theirs = np.sum((map_points(oracle, board) - image) ** 2)
    assert ours <= theirs * (1.0 + 1e-9)


def test_homography_refuses_lines_and_too_few_points() -> None:
    line = np.column_stack([np.arange(6.0), np.zeros(6)])
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.5], [0.2, 0.7]])
    assert isinstance(estimate_homography(line, square), FitFailure)
    assert isinstance(estimate_homography(square, line), FitFailure)
    assert isinstance(estimate_homography(square[:3], square[:3]), FitFailure)
    exact = estimate_homography(square[:4], square[:4])
    assert not isinstance(exact, FitFailure)
    assert exact / exact[2, 2] == pytest.approx(np.eye(3), abs=1e-12)


def test_constraints_hold_for_the_true_camera() -> None:
    # Equation 2.34 as corrected; the printed row v12 - v22 does not vanish.
    inverse = np.linalg.inv(PINHOLE.matrix)
    image_of_conic = inverse.T @ inverse
    b = image_of_conic[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    pose = make_views(EXACT, seed=3)[1][0]
    rows = constraint_rows(board_homography(pose))
    scale = np.abs(rows) @ np.abs(b)
    assert np.abs(rows @ b).max() < 1e-12 * scale.max()
    h = board_homography(pose)
    printed = rows[0] - _v(h[:, 1], h[:, 1])
    assert abs(printed @ b) > 1e-3 * (np.abs(printed) @ np.abs(b))


def _v(a: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Coefficients of a' B c by b, from the definition."""
    full = np.outer(a, c)
    both = full + full.T
    return np.array([full[0, 0], both[0, 1], full[1, 1], both[0, 2], both[1, 2], full[2, 2]])


def test_closed_form_finds_the_pinhole_camera_and_poses() -> None:
    _, poses = make_views(EXACT, seed=4)
    homographies = [board_homography(pose) for pose in poses]
    matrix = intrinsics_from_homographies(homographies, 2048, 1536)
    assert not isinstance(matrix, FitFailure)
    assert np.abs(matrix - PINHOLE.matrix).max() < 1e-6
    for homography, pose in zip(homographies, poses, strict=True):
        found = pose_from_homography(-3.0 * homography, matrix)
        assert np.abs(found.rotation - pose.rotation).max() < 1e-9
        assert np.abs(found.translation_mm - pose.translation_mm).max() < 1e-6


def test_closed_form_of_frontal_boards_is_refused() -> None:
    frontal: list[Pose[Sensor, Board]] = [
        Pose(rotation_from_vector(np.array([0.0, 0.0, spin])), np.array([-60.0, -50.0, z]))
        for spin, z in [(0.0, 300.0), (0.5, 350.0), (1.0, 260.0)]
    ]
    homographies = [board_homography(pose) for pose in frontal]
    found = intrinsics_from_homographies(homographies, 2048, 1536)
    assert isinstance(found, FitFailure)
    assert "tilt the board" in found.remedy


def test_linear_distortion_is_exact_for_known_ideal_points() -> None:
    rng = np.random.default_rng(5)
    ideal = rng.uniform(-0.4, 0.4, (60, 2))
    truth = np.array([-0.2, 0.1, 1e-3, -2e-3, 0.0])
    rays = np.column_stack([ideal, np.ones(60)])
    observed = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), truth)[0]
    found = linear_distortion(ideal, observed.reshape(-1, 2), (0, 1, 2, 3))
    assert np.abs(found - truth).max() < 1e-12
    assert not linear_distortion(ideal, ideal, ()).any()


def test_closed_form_start_survives_real_distortion() -> None:
    # With distortion the closed form is only a start, yet within some percent.
    views, _ = make_views(Scene(camera=CAMERA), seed=6)
    homographies = [estimate_homography(v.points_board_mm[:, :2], v.points_px) for v in views]
    good = [h for h in homographies if not isinstance(h, FitFailure)]
    matrix = intrinsics_from_homographies(good, 2048, 1536)
    assert not isinstance(matrix, FitFailure)
    assert abs(matrix[0, 0] / CAMERA.fx_px - 1.0) < 0.05


def test_a_point_at_infinity_ends_the_refinement() -> None:
    """A row of the board at no distance from the camera: LAPACK never came back from the step."""
    board = np.stack(np.meshgrid(np.arange(-2.0, 3.0), np.arange(-2.0, 3.0)), -1).reshape(-1, 2)
    at_infinity = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    with np.errstate(divide="ignore", invalid="ignore"):
        found = _refine(at_infinity, board, board)
    np.testing.assert_array_equal(found, at_infinity)
