# SPDX-License-Identifier: Apache-2.0
"""Places of a print solved beside the camera: against the whole normal equations, and truth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import stats

from armscan.calibration.cameras.adjustment import Observations, State, adjust, gather, moved
from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.print_errors import (
    PrintError,
    begin_print,
    eliminate_print,
    pull_of_places,
    settle_print,
    smooth_fields,
)
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.calibration.cameras.robust import Solution, residuals_px
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.vision.targets.target import TargetView
from rigs.camera_scene import CAMERA, GRID, Scene, board_pose, make_views, normalised_error, view_of

OPTIONS = CameraOptions(distortion="k1k2p1p2k3", n_folds=0, solve_print=True)
FREE = np.eye(11)[:, :9]


def plain_solution(scene: Scene, seed: int) -> Solution:
    """The adjustment that takes the print for right."""
    views, poses = make_views(scene, seed)
    seen = gather(views, "pinhole")
    start = State.from_poses(np.append(scene.camera.parameters, [0.0, 0.0]), poses)
    found = adjust(seen, start, FREE)
    assert not isinstance(found, FitFailure)
    ones, levels = np.ones(len(seen.points_px)), np.ones(len(views))
    return Solution(seen, found.state, FREE, found.system, ones, levels, 0.0 * levels, True)


def jacobian_of(solution: Solution) -> FloatArray:
    """Of all whitened residuals by the camera, the poses and every place, by differences."""
    seen, state = solution.observations, solution.state
    n_views, n_points = seen.n_views, len(seen.target_mm)

    def white(step: FloatArray) -> FloatArray:
        poses = step[9 : 9 + 6 * n_views].reshape(-1, 6)
        at = moved(state, FREE, step[:9], poses)
        places = step[9 + 6 * n_views :].reshape(-1, 2)
        there: Observations = replace(seen, missed_mm=seen.missed_mm + places[seen.point])
        left = residuals_px(there, at)
        return np.asarray((seen.whitening @ left[:, :, None])[:, :, 0].reshape(-1))

    size = 9 + 6 * n_views + 2 * n_points
    sizes = np.full(size, 1e-5)
    sizes[:4], sizes[9 + 6 * n_views :] = 1e-3, 1e-4
    columns = []
    for k in range(size):
        step = np.zeros(size)
        step[k] = sizes[k]
        columns.append((white(step) - white(-step)) / (2.0 * sizes[k]))
    return np.array(columns).T


def prior_of(error: PrintError, target_mm: FloatArray) -> FloatArray:
    """(2 P, 2 P) precision of the places, from their covariance as the type describes it."""
    fields = smooth_fields(target_mm).reshape(target_mm.size, -1)
    rough = np.eye(target_mm.size)
    smooth = fields @ fields.T
    covariance = rough - smooth + smooth / (1.0 - error.smooth_share)
    return np.asarray(error.weight * np.linalg.inv(covariance))


@pytest.mark.parametrize("share", [0.0, 0.97])
def test_eliminating_the_places_is_inverting_the_whole(share: float) -> None:
    """Covariance and step of camera and poses, the places' step, and the count of what is told."""
    plain = plain_solution(Scene(n_views=4, missed_mm=0.02, target=replace(GRID, columns=6)), 1)
    error = PrintError(0.02, plain.variance_factor / 0.02**2, share)
    solution = plain.with_print_error(error)
    found = solution.board_residuals()
    assert found is not None
    mine = eliminate_print(solution.equations, FREE, found, error)
    jacobian = jacobian_of(solution)
    n = len(mine.matrix)
    whole = jacobian.T @ jacobian
    whole[n:, n:] += prior_of(error, solution.observations.target_mm)
    scale = 1.0 / np.sqrt(np.diag(whole))
    inverse = np.linalg.inv(whole * np.outer(scale, scale)) * np.outer(scale, scale)
    sigma = np.sqrt(np.diag(inverse))
    np.testing.assert_allclose(
        mine.inverse() / np.outer(sigma[:n], sigma[:n]),
        inverse[:n, :n] / np.outer(sigma[:n], sigma[:n]),
        atol=2e-3,
    )
    white = (
        solution.observations.whitening
        @ residuals_px(solution.observations, solution.state)[:, :, None]
    )
    step = inverse @ (-jacobian.T @ white.reshape(-1))
    equations = solution.equations
    gradient = np.concatenate([equations.shared_gradient, equations.pose_gradient.reshape(-1)])
    unknowns, places = mine.steps(gradient, pull_of_places(found, error))
    np.testing.assert_allclose(unknowns / sigma[:n], step[:n] / sigma[:n], atol=5e-3)
    np.testing.assert_allclose(places.reshape(-1) / sigma[n:], step[n:] / sigma[n:], atol=5e-3)
    told = 2.0 * len(places) - np.sum(inverse[n:, n:] * prior_of(error, found.target_mm))
    assert sum(mine.n_told()) == pytest.approx(told, rel=1e-3)


def test_nothing_draws_at_places_that_are_settled() -> None:
    solution = begin_print(plain_solution(Scene(missed_mm=0.02), 2), 50, lambda _: 1.0)
    assert not isinstance(solution, FitFailure)
    found = solution.board_residuals()
    assert found is not None
    error = solution.print_error
    assert error.sigma_mm == pytest.approx(0.02, rel=0.15)
    left = pull_of_places(found, error) / np.sqrt(error.weight)
    assert np.abs(left).max() < 1e-2
    again = settle_print(solution, 50, is_held=True)
    assert not isinstance(again, FitFailure)
    np.testing.assert_allclose(
        again.observations.missed_mm, solution.observations.missed_mm, atol=1e-4
    )


def test_smooth_misses_are_what_views_tell_and_no_more() -> None:
    """No shift, turn or scale of the print, which poses take up; fewer of few points."""
    places = GRID.points_board_mm[:, :2]
    flat = smooth_fields(places).reshape(places.size, -1)
    assert flat.shape[1] == 16
    np.testing.assert_allclose(flat.T @ flat, np.eye(16), atol=1e-9)
    x, y = places.T
    for similar in (places, np.column_stack([-y, x]), np.ones_like(places)):
        assert np.abs(flat.T @ similar.reshape(-1)).max() < 1e-9 * np.abs(similar).max() * 100.0
    assert smooth_fields(places[:4]).shape[2] <= 4


def test_a_camera_before_a_bad_print_is_as_good_as_its_places_are_told() -> None:
    """A third of the error of OpenCV, which takes the print for right, on the same points."""
    ours, theirs = [], []
    for seed in range(12):
        views, _ = make_views(Scene(missed_mm=0.03, noise_px=0.03), seed)
        fit = calibrate_camera(views, OPTIONS)
        assert isinstance(fit, CameraFit)
        ours.append(fit.camera.parameters[:4] - CAMERA.parameters[:4])
        matrix = cv2.calibrateCamera(
            [view.points_board_mm.astype(np.float32) for view in views],
            [view.points_px.astype(np.float32) for view in views],
            (2048, 1536),
            np.eye(3),
            np.zeros(5),
        )[1]
        theirs.append(
            np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
            - CAMERA.parameters[:4]
        )
    ratio = np.sqrt(np.mean(np.square(ours), axis=0) / np.mean(np.square(theirs), axis=0))
    assert (ratio < 0.5).all(), ratio


def smooth_miss(kind: str, places: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(P, 2) in mm: paper fed too far, drawn out of square, or wavy."""
    middle = places - places.mean(axis=0)
    half = 0.5 * np.ptp(places, axis=0)
    if kind == "stretched":
        return np.column_stack([0.0 * middle[:, 1], 0.1 * middle[:, 1] / half[1]])
    if kind == "out of square":
        return np.column_stack([0.05 * middle[:, 1] / half[1], 0.0 * middle[:, 1]])
    missed = np.zeros_like(places)
    for _ in range(6):
        angle, length = rng.uniform(0.0, 2.0 * np.pi), 2.0 * half[0] * rng.uniform(0.4, 1.5)
        phase = middle @ [np.cos(angle), np.sin(angle)] * 2.0 * np.pi / length
        wave = np.sin(phase + rng.uniform(0.0, 2.0 * np.pi))
        missed += 0.01 * wave[:, None] * rng.normal(size=2)
    return missed


@pytest.mark.parametrize("kind", ["stretched", "out of square", "wavy"])
def test_the_covariance_holds_on_prints_that_err_smoothly(kind: str) -> None:
    """Chi2 over 9 was 48, 2.8 and 8 where such prints were taken for right."""
    errors = []
    for seed in range(16):
        scene, rng = Scene(), np.random.default_rng(seed)
        missed = smooth_miss(kind, GRID.points_board_mm[:, :2], np.random.default_rng([seed, 9]))
        views: list[TargetView] = []
        while len(views) < scene.n_views:
            name, height = f"{len(views):02d}.png", np.zeros(len(missed))
            seen = view_of(
                scene, board_pose(scene, rng), rng, name, np.column_stack([missed, height])
            )
            views += [seen] if len(seen) >= 0.5 * len(missed) else []
        fit = calibrate_camera(views, CameraOptions(n_folds=0, solve_print=True))
        assert isinstance(fit, CameraFit)
        truth, value = CAMERA.parameters, fit.camera.parameters
        errors.append(normalised_error(truth, value, fit.covariance))
    low, high = stats.chi2.ppf([0.0005, 0.9995], 9 * len(errors)) / len(errors)
    assert low < float(np.mean(errors)) < high, np.round(errors, 1)


def test_unseen_views_are_predicted_on_a_print_that_others_told() -> None:
    """The places that a view itself would tell are no part of what predicts it."""
    views, _ = make_views(Scene(missed_mm=0.03, noise_px=0.03), 3)
    fit = calibrate_camera(views, replace(OPTIONS, n_folds=5))
    assert isinstance(fit, CameraFit)
    assert fit.cross_validation is not None
    noise_px = 0.03 * np.sqrt(2.0)
    assert fit.rms_px < noise_px < fit.cross_validation.rms_px < 1.2 * noise_px


def test_a_bow_is_no_misprint_and_hides_none() -> None:
    """A board that bows by 2 mm: solved on a flat one, 0.04 mm was seen of a perfect print, and
    nothing of one that errs.
    """
    scene = Scene(bow_mm=(2.0, 1.0))
    for seed in range(3):
        right = calibrate_camera(make_views(scene, seed)[0], replace(OPTIONS, distortion="auto"))
        assert isinstance(right, CameraFit)
        assert not right.is_print_solved
        wrong = calibrate_camera(make_views(replace(scene, missed_mm=0.02), seed)[0], OPTIONS)
        assert isinstance(wrong, CameraFit)
        assert wrong.is_print_solved
        assert wrong.target_error_mm == pytest.approx(0.02, rel=0.2)
        assert wrong.warp is not None
        np.testing.assert_allclose(wrong.warp.bow_mm, scene.bow_mm, atol=0.05)


def test_a_print_is_solved_where_it_is_asked_for_alone() -> None:
    views, _ = make_views(Scene(missed_mm=0.03, noise_px=0.03), 1)
    plain = calibrate_camera(views, replace(OPTIONS, solve_print=False))
    asked = calibrate_camera(views, OPTIONS)
    assert isinstance(plain, CameraFit)
    assert isinstance(asked, CameraFit)
    assert not plain.is_print_solved
    assert plain.target_error_mm == pytest.approx(asked.target_error_mm, rel=0.1)
    assert plain.rms_px > 1.5 * asked.rms_px
    assert (plain.sigma[:4] > 1.5 * asked.sigma[:4]).all()


@pytest.mark.parametrize("is_asked", [False, True])
def test_a_point_that_no_view_keeps_tells_nothing(*, is_asked: bool) -> None:
    views, _ = make_views(Scene(missed_mm=0.02), 6)
    off = [
        replace(view, points_px=view.points_px + 3.0 * (view.point_index == 40)[:, None])
        for view in views
    ]
    fit = calibrate_camera(off, replace(OPTIONS, solve_print=is_asked))
    assert isinstance(fit, CameraFit)
    assert fit.target_error_mm == pytest.approx(0.02, rel=0.2)
    truth, value = CAMERA.parameters, fit.camera.parameters
    assert normalised_error(truth, value, fit.covariance) < 27.9
