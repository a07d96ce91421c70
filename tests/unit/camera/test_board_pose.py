# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.cameras.start import (
    AMBIGUOUS_CHI2,
    board_pose_candidates,
    estimate_board_pose,
    mirrored_pose,
)
from armscan.errors import InputError
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector, vector_from_rotation
from armscan.vision.targets.target import Chessboard
from rigs.camera_scene import CAMERA, GRID, Scene, board_pose, normalised_error, view_of
from rigs.plain_scanner import plain_camera

TELE = plain_camera(9000.0, (1023.5, 767.5), (2048, 1536))
SMALL = Chessboard(5, 4, 4.0)


def pose_error(found: Pose[Sensor, Board], truth: Pose[Sensor, Board]) -> np.ndarray:
    """Rotation increment on the left (rad), translation (mm): the covariance's convention."""
    turn = vector_from_rotation(found.rotation @ truth.rotation.T)
    return np.append(turn, found.translation_mm - truth.translation_mm)


def tilted(tilt_deg: float, distance_mm: float) -> Pose[Sensor, Board]:
    rotation = rotation_from_vector(np.deg2rad(tilt_deg) * np.array([0.6, 0.8, 0.0]))
    middle = np.array([3.0, -2.0, distance_mm])
    return Pose(rotation, middle - rotation @ SMALL.points_board_mm.mean(axis=0))


def test_exact_points_give_the_pose() -> None:
    rng = np.random.default_rng(1)
    scene = Scene(noise_px=0.0)
    for _ in range(5):
        truth = board_pose(scene, rng)
        found = estimate_board_pose(view_of(scene, truth, rng, "a"), CAMERA)
        assert isinstance(found, Estimate)
        assert np.abs(pose_error(found.value, truth)[:3]).max() < 1e-9
        assert np.abs(pose_error(found.value, truth)[3:]).max() < 1e-6


def test_covariance_is_that_of_repeats() -> None:
    rng = np.random.default_rng(2)
    truth = board_pose(Scene(), rng)
    errors = []
    for _ in range(300):
        found = estimate_board_pose(view_of(Scene(), truth, rng, "a"), CAMERA)
        assert isinstance(found, Estimate)
        error = pose_error(found.value, truth)
        errors.append(normalised_error(np.zeros(6), error, found.covariance))
        assert found.degrees_of_freedom == found.residuals.size - 6
    assert abs(np.mean(errors) - 6.0) < 3.0 * np.sqrt(12.0 / 300.0)


def test_mirrored_pose_mirrors_the_normal_at_the_line_of_sight() -> None:
    pose = tilted(30.0, 400.0)
    centre = SMALL.points_board_mm.mean(axis=0)
    other = mirrored_pose(pose, centre)
    seen, mirrored = (p.rotation @ centre + p.translation_mm for p in (pose, other))
    assert np.abs(seen - mirrored).max() < 1e-9
    sight = seen / np.linalg.norm(seen)
    normal, turned = pose.rotation[:, 2], other.rotation[:, 2]
    assert normal @ sight == pytest.approx(turned @ sight)
    assert np.abs(turned - (2.0 * (normal @ sight) * sight - normal)).max() < 1e-9
    back = mirrored_pose(other, centre)
    assert np.abs(back.rotation - pose.rotation).max() < 1e-9


def test_the_second_pose_is_judged_by_the_noise_that_is_there() -> None:
    """A detector that claims too much noise must not make a clear view ambiguous."""
    rng = np.random.default_rng(4)
    scene = Scene(camera=TELE, target=SMALL, noise_px=0.02)
    view = view_of(scene, tilted(25.0, 400.0), rng, "a")
    candidates = board_pose_candidates(view, TELE)
    assert isinstance(candidates, tuple)
    gap = candidates[1].chi2 - candidates[0].chi2
    assert gap > 2.0 * AMBIGUOUS_CHI2
    timid = replace(view, covariance_px2=gap / (0.5 * AMBIGUOUS_CHI2) * view.covariance_px2)
    assert isinstance(estimate_board_pose(timid, TELE), Estimate)


def test_both_poses_of_a_distant_board_are_found() -> None:
    rng = np.random.default_rng(4)
    scene = Scene(camera=TELE, target=SMALL, noise_px=0.02)
    truth = tilted(25.0, 400.0)
    view = view_of(scene, truth, rng, "a")
    candidates = board_pose_candidates(view, TELE)
    assert isinstance(candidates, tuple)
    assert len(candidates) == 2
    good, bad = candidates
    assert good.chi2 < bad.chi2
    assert np.abs(pose_error(good.sensor_from_board, truth)[:3]).max() < 0.01
    assert np.abs(pose_error(bad.sensor_from_board, truth)[:3]).max() > np.deg2rad(20.0)
    # Whichever of the two the homography starts from, the better one is returned.
    found = estimate_board_pose(view, TELE)
    assert isinstance(found, Estimate)
    assert np.array_equal(found.value.rotation, good.sensor_from_board.rotation)


def test_poses_that_cannot_be_told_apart_are_refused() -> None:
    rng = np.random.default_rng(5)
    scene = Scene(camera=TELE, target=SMALL, noise_px=1.0)
    failure = estimate_board_pose(view_of(scene, tilted(8.0, 400.0), rng, "a"), TELE)
    assert isinstance(failure, FitFailure)
    assert "two poses" in failure.reason
    assert failure.remedy


def test_wrong_pose_is_rarely_returned_near_the_limit() -> None:
    rng = np.random.default_rng(6)
    scene = Scene(camera=TELE, target=SMALL, noise_px=0.3)
    truth = tilted(15.0, 400.0)
    answers = [estimate_board_pose(view_of(scene, truth, rng, "a"), TELE) for _ in range(60)]
    wrong = [
        answer
        for answer in answers
        if isinstance(answer, Estimate)
        and np.linalg.norm(pose_error(answer.value, truth)[:3]) > np.deg2rad(12.0)
    ]
    assert len(wrong) <= 1


def test_frontal_board_has_one_pose() -> None:
    scene = Scene(noise_px=0.02)
    rotation = np.eye(3)
    middle = np.array([0.0, 0.0, 300.0]) - GRID.points_board_mm.mean(axis=0)
    view = view_of(scene, Pose(rotation, middle), np.random.default_rng(7), "a")
    assert isinstance(estimate_board_pose(view, CAMERA), Estimate)


def test_bowed_board_is_modelled() -> None:
    scene = Scene(bow_mm=(0.8, -0.5), noise_px=0.01)
    truth = board_pose(scene, np.random.default_rng(8))
    view = view_of(scene, truth, np.random.default_rng(8), "a")
    if len(view) < len(GRID.points_board_mm):
        pytest.fail("the scene must show the whole board")
    bowed = estimate_board_pose(view, CAMERA, bow_mm=np.array([0.8, -0.5]))
    flat = estimate_board_pose(view, CAMERA)
    assert isinstance(bowed, Estimate)
    assert isinstance(flat, Estimate)
    assert np.sum(bowed.residuals**2) < 0.1 * np.sum(flat.residuals**2)


def test_bad_input_is_refused() -> None:
    view = view_of(
        Scene(),
        board_pose(Scene(), np.random.default_rng(9)),
        np.random.default_rng(9),
        "photo.png",
    )
    with pytest.raises(InputError, match=r"photo\.png: the image is 1024x768 px"):
        estimate_board_pose(replace(view, width_px=1024, height_px=768), CAMERA)
    line = np.flatnonzero(view.points_board_mm[:, 1] == view.points_board_mm[0, 1])
    row = replace(
        view,
        point_index=view.point_index[line],
        points_px=view.points_px[line],
        covariance_px2=view.covariance_px2[line],
        points_board_mm=view.points_board_mm[line],
    )
    assert isinstance(estimate_board_pose(row, CAMERA), FitFailure)
