# SPDX-License-Identifier: Apache-2.0
"""Two cameras: projection, epipolar distances and triangulation, against OpenCV, SciPy and hand."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import CameraRight, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector
from armscan.models.camera import CameraModel
from armscan.models.two_views import (
    N_CAMERA,
    TwoViews,
    epipolar_distances_px,
    sampson_distances_px,
    triangulate_points,
)
from armscan.thesis.two_cameras import triangulate_directly
from rigs.plain_scanner import plain_camera
from rigs.stereo_rig import CONVERGING, LEFT, RIGHT, project_right

VIEWS = TwoViews(LEFT, RIGHT, CONVERGING)
SIGMA_PX = 0.1
COVARIANCE = SIGMA_PX**2 * np.eye(2)


def points(n: int = 40, seed: int = 0) -> FloatArray:
    """Points in the middle of what both cameras see."""
    rng = np.random.default_rng(seed)
    return np.array([0.0, 0.0, 275.0]) + rng.uniform(-40.0, 40.0, (n, 3))


def nudged(views: TwoViews, number: int, step: float) -> TwoViews:
    """The cameras with one of the 24 parameters moved."""
    change = np.zeros(24)
    change[number] = step
    left, right = (
        CameraModel.from_parameters(
            camera.parameters + change[k : k + N_CAMERA], camera.width_px, camera.height_px
        )
        for camera, k in ((views.left, 0), (views.right, N_CAMERA))
    )
    pose = views.right_from_left
    return TwoViews(
        left,
        right,
        Pose(
            rotation_from_vector(change[18:21]) @ pose.rotation, pose.translation_mm + change[21:]
        ),
    )


def step_of(number: int) -> float:
    """A step that moves pixels by about 1e-3."""
    return (*2 * (*(4 * [1e-3]), *(5 * [1e-5])), *(3 * [1e-6]), *(3 * [1e-4]))[number]


def test_the_right_projection_is_opencvs() -> None:
    found, by_point, _ = VIEWS.project_right_with_jacobian(points())
    turn = CONVERGING.rotation_vector_rad
    expected, jacobian = cv2.projectPoints(
        points(), turn, CONVERGING.translation_mm, RIGHT.matrix, RIGHT.distortion
    )
    assert np.abs(found - expected.reshape(-1, 2)).max() < 1e-9
    assert np.abs(found - project_right(VIEWS, points())).max() < 1e-11
    # OpenCV's derivative by the translation is that by the point in the right camera's frame.
    by_translation = jacobian.reshape(-1, 2, jacobian.shape[1])[:, :, 3:6]
    assert np.abs(by_point - by_translation @ CONVERGING.rotation).max() < 1e-8


@pytest.mark.parametrize("number", range(9, 24))
def test_jacobian_of_the_right_projection_by_parameters(number: int) -> None:
    _, _, by_second = VIEWS.project_right_with_jacobian(points())
    step = step_of(number)
    plus, minus = (project_right(nudged(VIEWS, number, sign * step), points()) for sign in (1, -1))
    expected = (plus - minus) / (2.0 * step)
    assert np.abs(by_second[:, :, number - 9] - expected).max() < 1e-6 * np.abs(expected).max()


def test_epipolar_constraint_in_pixels_free_of_distortion() -> None:
    no_lens = [
        CameraModel.from_parameters(
            [*camera.parameters[:4], *np.zeros(5)], camera.width_px, camera.height_px
        )
        for camera in (LEFT, RIGHT)
    ]
    views = TwoViews(no_lens[0], no_lens[1], CONVERGING)
    left, right = no_lens[0].project(points()), project_right(views, points())
    ones = np.ones((len(left), 1))
    a, b = np.hstack([left, ones]), np.hstack([right, ones])
    inverse_left, inverse_right = (np.linalg.inv(camera.matrix) for camera in no_lens)
    fundamental = inverse_right.T @ views.essential @ inverse_left
    scale = np.linalg.norm(fundamental) * np.linalg.norm(a) * np.linalg.norm(b)
    assert np.abs(np.sum(b * (a @ fundamental.T), axis=1)).max() < 1e-12 * scale
    # Without a lens the distance is that of a point from a straight line: by hand.
    moved = right + np.array([0.3, -0.4])
    line = a @ fundamental.T
    by_hand = np.sum(np.hstack([moved, ones]) * line, axis=1) / np.hypot(line[:, 0], line[:, 1])
    found = epipolar_distances_px(views, left, moved)[1]
    sign = np.sign(np.sum(found * by_hand))
    assert np.abs(found - sign * by_hand).max() < 1e-9


def test_parallel_cameras_differ_in_height_alone() -> None:
    """With equal cameras side by side the epipolar lines are rows of the image."""
    camera = plain_camera(1000.0, (320.0, 240.0), (640, 480))
    beside: Pose[CameraRight, Sensor] = Pose(np.eye(3), np.array([-50.0, 0.0, 0.0]))
    left, right = np.array([[300.0, 200.0]]), np.array([[220.0, 203.0]])
    in_left, in_right = epipolar_distances_px(TwoViews(camera, camera, beside), left, right)
    assert abs(in_left[0]) == pytest.approx(3.0)
    assert in_right[0] == pytest.approx(in_left[0])
    assert sampson_distances_px(in_left, in_right)[0] == pytest.approx(in_left[0] / np.sqrt(2.0))


def test_distances_are_those_from_the_bent_line() -> None:
    """Walk along the image of the left ray in the right image: the distance stays that stepped."""
    left = LEFT.project(points(5))
    rays = points(5)
    along = [project_right(VIEWS, rays * (1.0 + k)) for k in (0.0, 1e-4)]
    direction = along[1] - along[0]
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    across = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    for offset in (0.5, -0.2):
        found = epipolar_distances_px(VIEWS, left, along[0] + offset * across)[1]
        assert np.abs(np.abs(found) - abs(offset)).max() < 2e-4
    far = project_right(VIEWS, rays * 1.1)
    assert np.abs(epipolar_distances_px(VIEWS, left, far)[1]).max() < 1e-9


def test_swapping_the_cameras_keeps_the_sign() -> None:
    left = LEFT.project(points())
    right = project_right(VIEWS, points()) + np.array([0.2, 0.3])
    back = CONVERGING.inverse()
    swapped = TwoViews(RIGHT, LEFT, Pose(back.rotation, back.translation_mm))
    a, b = epipolar_distances_px(VIEWS, left, right)
    c, d = epipolar_distances_px(swapped, right, left)
    assert np.abs(a - d).max() < 1e-9
    assert np.abs(b - c).max() < 1e-9


def test_noise_gives_sampson_distances_of_its_own_size() -> None:
    n = 4000
    rng = np.random.default_rng(1)
    left = LEFT.project(points(n)) + SIGMA_PX * rng.normal(size=(n, 2))
    right = project_right(VIEWS, points(n)) + SIGMA_PX * rng.normal(size=(n, 2))
    distances = sampson_distances_px(*epipolar_distances_px(VIEWS, left, right))
    assert abs(distances.std() / SIGMA_PX - 1.0) < 4.0 / np.sqrt(2.0 * n)
    chi2 = triangulate_points(VIEWS, left, right, COVARIANCE, COVARIANCE).chi2
    assert np.abs((distances / SIGMA_PX) ** 2 - chi2).max() < 1e-3


def test_the_closed_form_is_equation_4_7_as_printed() -> None:
    """Cameras without lens and principal point: the thesis's symbols by hand."""
    f_l, f_r = 1200.0, 1300.0
    left, right = (plain_camera(f, (0.0, 0.0), (640, 480)) for f in (f_l, f_r))
    views = TwoViews(left, right, CONVERGING)
    truth = points(6)
    (u_l, v_l), u_r = left.project(truth).T, project_right(views, truth)[:, 0]
    r1, r2, r3, _, _, _, r7, r8, r9 = CONVERGING.rotation.ravel()
    t_x, _, t_z = CONVERGING.translation_mm
    z = (
        f_l
        * (f_r * t_x - u_r * t_z)
        / (u_r * (r7 * u_l + r8 * v_l + r9 * f_l) - f_r * (r1 * u_l + r2 * v_l + r3 * f_l))
    )
    by_hand = np.stack([z * u_l / f_l, z * v_l / f_l, z], axis=1)
    assert np.abs(by_hand - truth).max() < 1e-9
    found = triangulate_directly(views, left.project(truth), project_right(views, truth))
    assert np.abs(found - by_hand).max() < 1e-9


def test_points_without_noise_are_found_again_as_opencv_finds_them() -> None:
    truth = points()
    left, right = LEFT.project(truth), project_right(VIEWS, truth)
    ideal = [camera.undistort(q)[0] for camera, q in ((LEFT, left), (RIGHT, right))]
    matrices = [np.eye(3, 4), CONVERGING.matrix[:3]]
    found = cv2.triangulatePoints(matrices[0], matrices[1], ideal[0].T, ideal[1].T)
    opencv = (found[:3] / found[3]).T
    ours = triangulate_points(VIEWS, left, right, COVARIANCE, COVARIANCE)
    assert np.abs(triangulate_directly(VIEWS, left, right) - opencv).max() < 1e-7
    assert np.abs(ours.points_sensor_mm - opencv).max() < 1e-7
    assert ours.is_valid.all()


def test_the_optimal_point_is_the_least_squares_one() -> None:
    rng = np.random.default_rng(2)
    truth = points(5)
    left = LEFT.project(truth) + 0.5 * rng.normal(size=(5, 2))
    right = project_right(VIEWS, truth) + 0.5 * rng.normal(size=(5, 2))
    covariance_left = np.array([[0.04, 0.01], [0.01, 0.09]])
    root = np.linalg.cholesky(np.linalg.inv(covariance_left)).T
    found = triangulate_points(VIEWS, left, right, covariance_left, COVARIANCE)
    for k in range(5):

        def residuals(point: FloatArray, k: int = k) -> FloatArray:
            in_left = root @ (LEFT.project(point[None])[0] - left[k])
            in_right = (project_right(VIEWS, point[None])[0] - right[k]) / SIGMA_PX
            return np.concatenate([in_left, in_right])

        best = least_squares(residuals, truth[k], xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert np.abs(found.points_sensor_mm[k] - best.x).max() < 1e-5
        assert found.chi2[k] == pytest.approx(2.0 * best.cost, rel=1e-6)


def test_covariance_of_points_holds_the_scatter() -> None:
    n = 6000
    truth = np.tile(points(1), (n, 1))
    rng = np.random.default_rng(3)
    left = LEFT.project(truth) + SIGMA_PX * rng.normal(size=(n, 2))
    right = project_right(VIEWS, truth) + SIGMA_PX * rng.normal(size=(n, 2))
    found = triangulate_points(VIEWS, left, right, COVARIANCE, COVARIANCE)
    scatter = np.cov(found.points_sensor_mm.T)
    ratio = np.linalg.eigvals(np.linalg.solve(found.noise_mm2.mean(axis=0), scatter)).real
    # Eigenvalues of a sample covariance scatter by about 2 sqrt(3 / n) around 1.
    assert np.abs(ratio - 1.0).max() < 2.0 * 2.0 * np.sqrt(3.0 / n)
    assert abs(found.chi2.mean() - 1.0) < 4.0 * np.sqrt(2.0 / n)


@pytest.mark.parametrize("number", range(24))
def test_points_follow_the_parameters(number: int) -> None:
    left, right = LEFT.project(points(6)), project_right(VIEWS, points(6))

    def found(views: TwoViews) -> FloatArray:
        return triangulate_points(views, left, right, COVARIANCE, COVARIANCE).points_sensor_mm

    step = step_of(number)
    expected = (found(nudged(VIEWS, number, step)) - found(nudged(VIEWS, number, -step))) / (
        2.0 * step
    )
    derivative = triangulate_points(VIEWS, left, right, COVARIANCE, COVARIANCE).dpoint_dparameters
    assert np.abs(derivative[:, :, number] - expected).max() < 1e-4 * np.abs(expected).max()


def test_rays_that_do_not_meet_ahead_give_no_point() -> None:
    camera = plain_camera(1000.0, (320.0, 240.0), (640, 480))
    beside: Pose[CameraRight, Sensor] = Pose(np.eye(3), np.array([-50.0, 0.0, 0.0]))
    views = TwoViews(camera, camera, beside)
    left = np.array([[300.0, 200.0], [300.0, 200.0], [300.0, 200.0]])
    right = np.array([[280.0, 200.0], [300.0, 200.0], [340.0, 200.0]])
    found = triangulate_points(views, left, right, COVARIANCE, COVARIANCE)
    assert found.is_valid.tolist() == [True, False, False]
    assert np.isnan(found.points_sensor_mm[1:]).all()
    assert found.points_sensor_mm[0, 2] == pytest.approx(1000.0 * 50.0 / 20.0)
    direct = triangulate_directly(views, left, right)
    assert direct[0, 2] == pytest.approx(2500.0)
    assert np.isnan(direct[1:]).all()
