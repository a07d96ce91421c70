# SPDX-License-Identifier: Apache-2.0
"""Hand-eye of a camera before a flat target: certainty, numbering, wrong poses, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest

from armscan.calibration.hand_eye import on_board
from armscan.calibration.hand_eye.alternatives import other_readings
from armscan.calibration.hand_eye.board_looks import BoardLook, board_poses, find_board_start
from armscan.calibration.hand_eye.board_result import BoardHandEyeFit
from armscan.calibration.hand_eye.observations import HandEyeOptions
from armscan.calibration.hand_eye.on_board import (
    _chance,
    _Problem,
    _solve,
    calibrate_on_board,
)
from armscan.calibration.sheets.board_points import BoardBow
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import (
    EulerConvention,
    euler_from_rotations,
    rotations_from_euler,
)
from armscan.vision.targets.detect import numberings, renumbered
from armscan.vision.targets.target import parse_target
from rigs.board_postures import TRUE_CAMERA, BoardRig, board_rig, misread
from rigs.calibration_documents import sensor_calibration


def solved(rig: BoardRig) -> BoardHandEyeFit:
    fit = calibrate_on_board(rig.looks, rig.camera)
    assert isinstance(fit, BoardHandEyeFit), fit
    return fit


def error(fit: BoardHandEyeFit, rig: BoardRig) -> FloatArray:
    """(6,) step from the hand-eye found to the true one."""
    found, true = fit.calibration.tool_from_sensor, rig.tool_from_sensor
    turn = Rotation.from_matrix(true.rotation @ found.rotation.T).as_rotvec()
    return np.concatenate([turn, true.translation_mm - found.translation_mm])


SETTLED = 0.01
"""Of a standard deviation: solutions end within a thousandth."""


def apart(fit: BoardHandEyeFit, other: BoardHandEyeFit) -> float:
    """The largest difference of two hand-eyes over its standard deviation."""
    one, two = fit.calibration.tool_from_sensor, other.calibration.tool_from_sensor
    turn = Rotation.from_matrix(one.rotation @ two.rotation.T).as_rotvec()
    step = np.concatenate([turn, one.translation_mm - two.translation_mm])
    return float(np.abs(step / np.sqrt(np.diag(covariance(fit)))).max())


def covariance(fit: BoardHandEyeFit) -> FloatArray:
    follow = fit.calibration.dhand_eye_dsensor
    assert follow is not None
    return np.asarray(fit.calibration.covariance + follow @ fit.camera_covariance @ follow.T)


@pytest.fixture(scope="module")
def drawn() -> list[tuple[BoardRig, BoardHandEyeFit]]:
    """Arms of 0.02 to 0.5 mm with levers of 50 to 400 mm, before 8 to 15 postures each."""
    found = []
    for seed in range(36):
        generator = np.random.default_rng(1000 + seed)
        rig = board_rig(
            seed,
            int(generator.integers(8, 16)),
            arm_mm=float(np.exp(generator.uniform(np.log(0.02), np.log(0.5)))),
            lever_mm=float(np.exp(generator.uniform(np.log(50.0), np.log(400.0)))),
        )
        found.append((rig, solved(rig)))
    return found


def test_errors_are_as_large_as_stated(drawn: list[tuple[BoardRig, BoardHandEyeFit]]) -> None:
    """Two-sided: a variance doubled or times 0.6 falls out of what 36 draws of six leave."""
    squares = []
    for rig, fit in drawn:
        off = error(fit, rig)
        squares.append(float(off @ np.linalg.solve(covariance(fit), off)))
    low, high = chi2.ppf([0.001, 0.999], 6 * len(drawn)) / len(drawn)
    assert low < np.mean(squares) < high
    assert not low < 2.0 * np.mean(squares) < high
    assert not low < 0.5 * np.mean(squares) < high
    held = [
        square < chi2.ppf(0.95, 6) * fit.calibration.diagnostics.region_factor
        for square, (_, fit) in zip(squares, drawn, strict=True)
        if fit.calibration.diagnostics is not None
    ]
    assert np.mean(held) > 0.87


def test_right_postures_are_kept_and_sizes_agree(
    drawn: list[tuple[BoardRig, BoardHandEyeFit]],
) -> None:
    assert sum(len(fit.not_used) for _, fit in drawn) <= 1
    sizes = [(fit.asked.scale - 1.0) / fit.asked.sigma for _, fit in drawn]
    assert 0.7 < np.sqrt(np.mean(np.square(sizes))) < 1.3


def test_chances_of_right_postures_are_even() -> None:
    """What a posture is off the others, as a chance, is uniform, however few the others are."""
    chances = []
    for seed in range(20):
        rig = board_rig(seed, 6, arm_mm=0.2)
        start = find_board_start(rig.looks)
        assert not isinstance(start, FitFailure)
        problem = _Problem.of(rig.looks, start, rig.camera, HandEyeOptions(), None)
        for name in problem.postures:
            others = _solve(problem.without([name]))
            assert not isinstance(others, FitFailure)
            chances.append(_chance(problem, name, others)[0])
    assert kstest(chances, "uniform").pvalue > 0.01
    squares = chi2.isf(chances, 6)
    assert kstest(chi2.sf(1.5 * squares, 6), "uniform").pvalue < 1e-3
    assert kstest(chi2.sf(squares / 1.5, 6), "uniform").pvalue < 1e-3


def test_the_moved_camera_is_nearer_to_the_true_one(
    drawn: list[tuple[BoardRig, BoardHandEyeFit]],
) -> None:
    """Whatever the camera errs by that the arm sees is put right, and its covariance says so."""
    squares, before = [], []
    for _, fit in drawn:
        off = (TRUE_CAMERA - fit.camera.parameters)[:4]
        squares.append(off**2 / np.diag(fit.camera_covariance)[:4])
        before.append(np.diag(fit.camera_covariance)[:4] / np.diag(fit.before.covariance)[:4])
    assert np.mean(before) < 0.9
    assert 0.7 < np.mean(squares) < 1.4


def test_derivatives_are_those_of_differences() -> None:
    rig = board_rig(3, 5)
    start = find_board_start(rig.looks)
    assert not isinstance(start, FitFailure)
    problem = _Problem.of(rig.looks, start, rig.camera, HandEyeOptions(), None)
    problem = problem.moved(np.full(12 + len(problem.units), 1e-3))
    system = problem.system()
    for column in range(system.jacobian.shape[1] - 1):
        step = np.zeros(system.jacobian.shape[1] - 1)
        step[column] = 1e-5
        there, back = problem.moved(step).system(), problem.moved(-step).system()
        slope = (there.residual - back.residual) / 2e-5
        # the misclosures, hundredths of rad, are taken as small
        np.testing.assert_allclose(
            system.jacobian[:, column], slope, atol=5e-3 * max(1.0, np.abs(slope).max())
        )


def test_the_scatter_of_the_arm_does_what_it_is_said_to() -> None:
    """A pose that is off by a shift, and by a turn about Tool, moves the misclosures so."""
    rig = board_rig(4, 5)
    start = find_board_start(rig.looks)
    assert not isinstance(start, FitFailure)
    problem = _Problem.of(rig.looks, start, rig.camera, HandEyeOptions(), None)
    system = problem.system()
    for axis in range(3):
        unit = 1e-5 * np.eye(3)[axis]
        for kind, step in ((0, np.append(np.zeros(3), unit)), (1, np.append(unit, np.zeros(3)))):
            moved = [
                replace(one, base_from_tool=one.base_from_tool.retract(step)) for one in rig.looks
            ]
            off = replace(problem, looks=tuple(moved)).system().residual - system.residual
            np.testing.assert_allclose(off / 1e-5, system.by_arm[kind][:, axis], atol=2e-2)


def test_views_of_a_symmetric_target_may_be_numbered_from_either_end() -> None:
    straight = solved(board_rig(5, target="chessboard:9x7:25"))
    turned = solved(board_rig(5, target="chessboard:9x7:25", turned=True))
    assert apart(turned, straight) < SETTLED
    np.testing.assert_allclose(
        turned.calibration.arm_noise.position_mm,
        straight.calibration.arm_noise.position_mm,
        rtol=1e-3,
    )
    assert not turned.not_used


@pytest.mark.parametrize("row", [0, 7])
def test_a_wrong_pose_is_named_and_left_out(row: int) -> None:
    rig = board_rig(6, arm_mm=0.1)
    wrong = solved(misread(rig, row, 3.0))
    assert [source for source, _ in wrong.not_used] == [f"{row}.png"]
    assert any(text.startswith(f"{row}.png contradicts the others by") for text in wrong.warnings)
    clean = calibrate_on_board([o for k, o in enumerate(rig.looks) if k != row], rig.camera)
    assert isinstance(clean, BoardHandEyeFit)
    assert apart(wrong, clean) < SETTLED


def test_a_third_of_wrong_poses_is_refused() -> None:
    rig = board_rig(7)
    for row in (1, 4, 6, 9):
        rig = misread(rig, row, 15.0 + row)
    fit = calibrate_on_board(rig.looks, rig.camera)
    assert isinstance(fit, FitFailure)
    assert "4 of 12 postures contradict the others (1.png, 4.png, 6.png, 9.png ...)" in fit.reason


def test_wrong_poses_do_not_hide_each_other() -> None:
    fit = solved(misread(misread(misread(board_rig(7), 1, 9.0), 4, 10.0), 9, 11.0))
    assert [source for source, _ in fit.not_used] == ["1.png", "4.png", "9.png"]
    assert fit.calibration.arm_noise.position_mm < 0.3


def test_a_target_of_another_size_is_refused_and_told() -> None:
    rig = board_rig(8, scale=1.03)
    fit = calibrate_on_board(rig.looks, rig.camera)
    assert isinstance(fit, FitFailure)
    asked = float(fit.reason.split("a target of ")[1].split()[0])
    assert asked == pytest.approx(1.03, abs=0.003)
    told = calibrate_on_board(rig.looks, rig.camera, target=parse_target("chessboard:9x6:25"))
    assert isinstance(told, FitFailure)
    assert f"(--target chessboard:9x6:{25.0 * asked:.4g} would suit)" in told.remedy


@pytest.mark.parametrize("scale", [0.5, 0.7])
def test_a_size_that_is_said_too_large_is_not_blamed_on_the_postures(scale: float) -> None:
    rig = board_rig(15, scale=scale)
    fit = calibrate_on_board(rig.looks, rig.camera)
    assert isinstance(fit, FitFailure)
    assert "times the stated size" in fit.reason and "determine" not in fit.reason
    told = fit.reason.split("a target of ")[1].split()[0]
    assert float(told) == pytest.approx(scale, rel=0.01)


@pytest.mark.parametrize("scale", [0.1, 25.4])
def test_a_target_in_another_unit_is_told(scale: float) -> None:
    rig = board_rig(8)
    looks = [
        replace(one, base_from_tool=Pose(one.base_from_tool.rotation, place))
        for one in rig.looks
        for place in [scale * one.base_from_tool.translation_mm]
    ]
    fit = calibrate_on_board(looks, rig.camera)
    assert isinstance(fit, FitFailure)
    told, _, left = fit.reason.split("a target of ")[1].partition(" times the stated size would ")
    assert float(told) == pytest.approx(scale, rel=5e-3)
    assert left.startswith("leave 0.") or scale > 1.0


def test_turns_about_one_axis_are_refused() -> None:
    fit = calibrate_on_board(board_rig(9, one_axis=True).looks, board_rig(9).camera)
    assert isinstance(fit, FitFailure)
    assert "about one axis only" in fit.reason
    assert "two of its axes" in fit.remedy


def test_a_camera_without_uncertainty_is_taken_as_exact_and_told() -> None:
    rig = board_rig(14)
    bare = replace(rig.camera, covariance=np.zeros((9, 9)), has_covariance=False)
    fit = calibrate_on_board(rig.looks, bare)
    assert isinstance(fit, BoardHandEyeFit)
    np.testing.assert_array_equal(fit.camera_step, np.zeros(9))
    assert "came without covariance" in fit.warnings[0]


def test_of_many_looks_some_are_taken_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = board_rig(4, 15)
    monkeypatch.setattr(on_board, "MAX_LOOKS", 8)
    fit = solved(rig)
    expected = [rig.looks[k].poses[0].view.source for k in (0, 2, 4, 6, 8, 10, 12, 14)]
    assert [posture.source for posture in fit.postures] == expected
    assert any("8 of 15 looks" in text for text in fit.warnings)


def test_an_arm_that_scatters_much_is_warned_of() -> None:
    much, little = (solved(board_rig(5, 14, arm_mm=size, lever_mm=400.0)) for size in (1.5, 0.1))
    assert any("much even for a robot" in text for text in much.warnings)
    assert not any("much even for a robot" in text for text in little.warnings)


def test_a_bow_is_taken_out_of_the_pose_of_a_view() -> None:
    """A known bow leaves the poses where a flat target would have put them."""
    corners = parse_target("chessboard:9x6:25").points_board_mm[:, :2]
    bow = BoardBow(
        bow_mm=np.array([2.0, -1.0]),
        covariance_mm2=np.zeros((2, 2)),
        by_cameras=np.zeros((2, 9)),
        low_mm=corners.min(axis=0),
        high_mm=corners.max(axis=0),
    )
    flat = board_rig(6, 5)
    with_bow = board_rig(6, 5, bow=bow, true_bow_mm=(2.0, -1.0))
    without = board_rig(6, 5, true_bow_mm=(2.0, -1.0))
    for one, other, blind in zip(flat.looks, with_bow.looks, without.looks, strict=True):
        sigma_mm = np.sqrt(np.diag(one.poses[0].covariance)[3:])
        place = one.poses[0].sensor_from_board.translation_mm
        step, wrong = (
            np.abs(look.poses[0].sensor_from_board.translation_mm - place) / sigma_mm
            for look in (other, blind)
        )
        assert step.max() < 0.5
        assert wrong.max() > 2.0


def test_a_quarter_turn_swaps_the_bows_of_a_view() -> None:
    """Numbered from another side before or after, a view follows them alike."""
    target, rig = parse_target("circle-grid:6x6:30"), board_rig(4, 3, target="circle-grid:6x6:30")
    view, ends = rig.looks[0].poses[0].view, (np.zeros(2), np.full(2, 150.0))
    bow = BoardBow(np.full(2, 0.3), np.eye(2), np.zeros((2, 9)), *ends)
    poses = board_poses(view, target, rig.camera.camera, bow)
    assert not isinstance(poses, FitFailure)
    for numbering, pose in zip(numberings(target), poses[:: len(poses) // 4], strict=True):
        again = board_poses(renumbered(view, target, numbering), target, rig.camera.camera, bow)
        assert not isinstance(again, FitFailure)
        assert pose.by_common == pytest.approx(again[0].by_common, rel=1e-4, abs=1e-6)
    assert np.abs(poses[0].by_common[:, 9] - poses[0].by_common[:, 10]).max() > 1e-3


def test_three_postures_are_too_few() -> None:
    rig = board_rig(10, 4)
    assert isinstance(calibrate_on_board(rig.looks, rig.camera), BoardHandEyeFit)
    fit = calibrate_on_board(rig.looks[:3], rig.camera)
    assert isinstance(fit, FitFailure)
    assert fit.reason.startswith("3 postures with the target and the arm's pose are too few")


def as_read(
    rig: BoardRig, read: EulerConvention, meant: EulerConvention
) -> tuple[list[BoardLook], FloatArray, FloatArray]:
    """The looks of a table that was written in one convention and is read in another."""
    rotations = np.array([look.base_from_tool.rotation for look in rig.looks])
    places = np.array([look.base_from_tool.translation_mm for look in rig.looks])
    misread = rotations_from_euler(euler_from_rotations(rotations, meant), read)
    looks = [
        replace(look, base_from_tool=Pose(turn, place))
        for look, turn, place in zip(rig.looks, misread, places, strict=True)
    ]
    return looks, misread, places


@pytest.mark.parametrize(
    ("read", "meant"),
    [
        ("extrinsic-xyz", "intrinsic-zyx"),
        ("intrinsic-zyx", "extrinsic-xyz"),
        ("extrinsic-xyz", "intrinsic-xyz"),
        ("intrinsic-zxz", "intrinsic-zyx"),
        ("intrinsic-xyz", "intrinsic-zxz"),
    ],
)
def test_the_convention_that_is_told_is_the_right_one(
    read: EulerConvention, meant: EulerConvention
) -> None:
    rig = board_rig(11, arm_mm=0.3)
    looks, turns, places = as_read(rig, read, meant)
    told = calibrate_on_board(looks, rig.camera, readings=other_readings(turns, places, read))
    assert isinstance(told, FitFailure)
    assert f"were read as {read}, reading them as {meant} would leave " in told.reason
    assert told.remedy.startswith(f"give the rotation convention {meant}")


@pytest.mark.parametrize(("turned", "order"), [(-1, "qx,qy,qz,qw"), (1, "qw,qx,qy,qz")])
def test_the_order_of_quaternions_is_told(turned: int, order: str) -> None:
    rig = board_rig(11, arm_mm=0.3)
    looks = []
    for one in rig.looks:
        pose = one.base_from_tool
        numbers = Rotation.from_matrix(pose.rotation).as_quat(scalar_first=True)
        read = Rotation.from_quat(np.roll(numbers, turned), scalar_first=True)
        looks.append(replace(one, base_from_tool=Pose(read.as_matrix(), pose.translation_mm)))
    told = calibrate_on_board(looks, rig.camera)
    assert isinstance(told, FitFailure)
    assert f"as {order} would leave 0." in told.reason
    assert told.remedy.startswith(f"name their columns {order}")


def test_radians_of_another_convention_are_told() -> None:
    rig = board_rig(11, arm_mm=0.3)
    looks = []
    for one in rig.looks:
        pose = one.base_from_tool
        angles = euler_from_rotations(pose.rotation[None], "extrinsic-xyz")
        (read,) = rotations_from_euler(np.radians(angles), "intrinsic-xyz")
        looks.append(replace(one, base_from_tool=Pose(read, pose.translation_mm)))
    turns = np.array([look.base_from_tool.rotation for look in looks])
    places = np.array([look.base_from_tool.translation_mm for look in looks])
    readings = other_readings(turns, places, "intrinsic-xyz")
    told = calibrate_on_board(looks, rig.camera, readings=readings)
    assert isinstance(told, FitFailure)
    assert "reading the angles (extrinsic-xyz) as radians would leave 0." in told.reason
    assert told.remedy.endswith("give the rotation convention extrinsic-xyz")


def test_inverse_poses_are_told_with_what_they_may_be() -> None:
    rig = board_rig(11, arm_mm=0.3)
    looks = [replace(one, base_from_tool=inverse(one.base_from_tool)) for one in rig.looks]
    told = calibrate_on_board(looks, rig.camera)
    assert isinstance(told, FitFailure)
    assert "as tool_from_base would leave 0." in told.reason
    assert "a camera at rest before a target that the arm holds" in told.remedy


def inverse(pose: Pose[Base, Tool]) -> Pose[Base, Tool]:
    return Pose(pose.rotation.T, -pose.rotation.T @ pose.translation_mm)


def test_images_of_one_posture_do_not_vouch_for_its_pose() -> None:
    """Of three images each, with noise of their own, those of a thrown posture go together."""
    rig = board_rig(16, images=3)
    for row in (12, 13, 14):
        rig = misread(rig, row, 3.0)
    fit = solved(rig)
    assert [source for source, _ in fit.not_used] == ["12.png", "13.png", "14.png"]
    assert fit.calibration.n_postures == 11


def test_more_images_of_a_posture_tell_nothing_more_of_the_arm() -> None:
    """Errors are as large as stated where postures have three images that share the arm's error."""
    squares = []
    for seed in range(300, 312):
        rig = board_rig(seed, 9, images=3, arm_mm=0.3)
        fit = solved(rig)
        off = error(fit, rig)
        squares.append(float(off @ np.linalg.solve(covariance(fit), off)))
    low, high = chi2.ppf([0.001, 0.999], 6 * len(squares)) / len(squares)
    assert low < np.mean(squares) < high
    assert not np.mean(squares) * 3.0 < high  # as it would be if each image counted


def test_the_scanner_moves_with_the_camera() -> None:
    """What the sheets share with the camera follows it, by the sensor's covariance."""
    rig = board_rig(17)
    fit = solved(rig)
    sensor = sensor_calibration()
    generator = np.random.default_rng(0)
    n = len(sensor.parameter_names)
    mix = np.eye(n) + 0.1 * generator.normal(size=(n, n))
    whole = mix @ np.diag(np.full(n, 1e-4)) @ mix.T
    scale = np.sqrt(np.diag(rig.camera.covariance)[:4] / np.diag(whole)[:4])
    whole[:4] *= scale[:, None]
    whole[:, :4] *= scale
    sensor = replace(sensor, covariance=whole)
    scanner = fit.scanner(sensor, rig.camera.provenance)
    moved = scanner.sensor
    assert moved is not None
    by_camera = whole[:, :9] @ np.linalg.inv(whole[:9, :9])
    after = whole + by_camera @ (fit.camera_covariance - whole[:9, :9]) @ by_camera.T
    np.testing.assert_allclose(moved.covariance, after, rtol=1e-6, atol=1e-12)
    step = by_camera @ fit.camera_step
    np.testing.assert_allclose(
        moved.camera.camera.parameters - sensor.camera.camera.parameters, step[:9], atol=1e-9
    )
    assert moved.sheets[0].sheet != sensor.sheets[0].sheet


def test_nothing_is_told_of_poses_that_fit_in_no_way() -> None:
    rig = board_rig(12)
    mixed = [
        replace(look, base_from_tool=other.base_from_tool)
        for look, other in zip(rig.looks, rig.looks[5:] + rig.looks[:5], strict=True)
    ]
    failure = calibrate_on_board(mixed, rig.camera)
    assert isinstance(failure, FitFailure)
    assert "would leave" not in failure.reason


def test_a_given_scatter_is_taken_and_tested() -> None:
    rig = board_rig(13, arm_mm=0.1, lever_mm=100.0)
    given = HandEyeOptions(arm_position_mm=0.1, arm_rotation_rad=1e-3)
    fit = calibrate_on_board(rig.looks, rig.camera, given)
    assert isinstance(fit, BoardHandEyeFit)
    assert fit.calibration.arm_noise.position_mm == 0.1
    assert fit.calibration.diagnostics is not None
    assert not fit.calibration.diagnostics.is_noise_estimated
    assert 1e-3 < fit.calibration.diagnostics.chi2_probability < 0.999
    tight = HandEyeOptions(arm_position_mm=0.02, arm_rotation_rad=1e-4)
    wrong = calibrate_on_board(rig.looks, rig.camera, tight)
    assert isinstance(wrong, BoardHandEyeFit)
    assert wrong.calibration.diagnostics is not None
    assert wrong.calibration.diagnostics.chi2_probability < 1e-6
