# SPDX-License-Identifier: Apache-2.0
"""A point from left stripe, right stripe and sheet: derivatives, covariance, and who wins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.geometry.rotations import rotation_from_vector
from armscan.kernels.fusing import N_PARAMETERS, carry_fused
from armscan.kernels.placing import propagate_points
from armscan.models.calibration import ScannerCalibration, SensorCalibration
from armscan.models.camera import Lens
from armscan.models.two_views import TwoViews
from armscan.reconstruction import place
from armscan.reconstruction import points as points_module
from armscan.reconstruction.epipolar import RightStripes, find_crossings, project_on_sheets
from armscan.reconstruction.place import errors_of_calibration
from armscan.reconstruction.points import fuse_points, triangulate_right
from armscan.reconstruction.triangulate import (
    StripePoints,
    differentiated,
    lens_numbers,
    noise_size_mm,
    sensor_columns,
    sensor_covariance,
    shape_mm,
    sheet_numbers,
)
from armscan.records.cloud import PointsSeen
from rigs import placing_rig
from rigs.fisheye import fisheye_sensor
from rigs.sheet_rig import PROVENANCE, make_profile
from rigs.stereo_head import StereoHead

SHEET = 5
SIGMA_PX = 0.07
STEPS = np.array(
    [1e-2, 1e-2, 1e-2, 1e-2, 1e-4, 1e-3, 1e-6, 1e-6, 1e-2]
    + [1e-4] * 8
    + [1e-2, 1e-2, 1e-2, 1e-2, 1e-4, 1e-3, 1e-6, 1e-6, 1e-2]
    + [1e-6] * 3
    + [1e-4] * 3
)


@cache
def head() -> StereoHead:
    return StereoHead.thesis()


def pixels() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Left pixels, their normals, and the right pixels of points on the middle sheet."""
    left = np.array([[1400.0, 900.0], [1600.0, 1030.0], [1250.0, 1180.0], [1500.0, 1100.0]])
    normals = np.tile(np.array([0.68, 0.73]) / np.hypot(0.68, 0.73), (len(left), 1))
    found = project_on_sheets(left, np.full(len(left), SHEET), head().calibration())
    assert found.is_met.all()
    return left, normals, found.q_px


def fused(
    sensor: SensorCalibration,
    left_px: FloatArray,
    right_px: FloatArray,
    *,
    right_sigma_px: float = SIGMA_PX,
) -> StripePoints:
    _, normals, _ = pixels()
    right_normals = np.tile([np.sqrt(0.5), np.sqrt(0.5)], (len(left_px), 1))
    right = RightStripes.of(make_profile("right", [(right_px, right_normals)], right_sigma_px))
    there = project_on_sheets(left_px, np.full(len(left_px), SHEET), sensor)
    n = len(left_px)
    beside = find_crossings(there, normals, np.full(n, SIGMA_PX), right, sensor, reach_px=30.0)
    assert (beside.at == np.arange(n)).all()
    assert (beside.row == np.arange(n)).all()
    return fuse_points(
        there,
        beside,
        np.column_stack([normals, np.full(n, SIGMA_PX)]),
        np.full(n, right_sigma_px),
        sensor=sensor,
        missed_px=beside.residual_px,
        rows=np.arange(n),
        crossing=np.arange(n),
    )


def test_a_pair_without_points_has_none() -> None:
    sensor, (left, normals, _) = head().calibration(), pixels()
    there = project_on_sheets(left, np.full(len(left), SHEET), sensor)
    right = RightStripes.of(make_profile("right", [(left + 1000.0, normals)], SIGMA_PX))
    beside = find_crossings(
        there, normals, np.full(len(left), SIGMA_PX), right, sensor, reach_px=3.0
    )
    assert len(beside.at) == len(beside.by_errors) == 0
    none = np.zeros(0, dtype=np.int64)
    points = fuse_points(
        there,
        beside,
        np.column_stack([normals, np.full(len(left), SIGMA_PX)]),
        np.zeros(0),
        sensor=sensor,
        missed_px=beside.residual_px,
        rows=none,
        crossing=none,
    )
    assert points.points_mm.shape == (0, 3)
    assert noise_size_mm(points.noise_mm).shape == (0,)


def parameter_error(column: int, size: float) -> FloatArray:
    error = np.zeros(len(head().covariance))
    error[sensor_columns(head().calibration(), SHEET)[column]] = size
    return error


@pytest.mark.parametrize("column", range(32))
def test_derivative_by_each_parameter_equals_differences(column: int) -> None:
    left, _, right = pixels()
    here = fused(head().calibration(), left, right)
    step = STEPS[column]
    up = fused(head().calibration(parameter_error(column, step)), left, right).points_mm
    down = fused(head().calibration(parameter_error(column, -step)), left, right).points_mm
    expected = (up - down) / (2.0 * step)
    size = np.abs(expected).max() + 1e-6 / step
    assert np.abs(here.by_sensor[:, :, column] - expected).max() < 2e-3 * size


def _seen_by(
    sensor: SensorCalibration, places: Sequence[tuple[int, FloatArray, FloatArray]]
) -> FloatArray:
    """(N, 3) points that a sensor fuses of left and right pixels, each on its sheet."""
    found = []
    for sheet, left_px, right_px in places:
        along = head().sheets[sheet].axes[0]
        there = project_on_sheets(left_px[None], np.array([sheet]), head().calibration())
        views, ahead = head().views, there.points_mm + along
        in_left = views.left.project(ahead) - left_px
        in_right = views.right.project(views.right_from_left.apply(ahead)) - right_px
        across = [np.array([[-d[1], d[0]]]) / np.hypot(*d) for d in (in_left[0], in_right[0])]
        right = RightStripes.of(make_profile("right", [(right_px[None], across[1])], SIGMA_PX))
        one, sigma = np.zeros(1, dtype=np.int64), np.full(1, SIGMA_PX)
        there = project_on_sheets(left_px[None], np.array([sheet]), sensor)
        beside = find_crossings(there, across[0], sigma, right, sensor, reach_px=30.0)
        points = fuse_points(
            there,
            beside,
            np.column_stack([across[0], sigma]),
            sigma,
            sensor=sensor,
            missed_px=beside.residual_px,
            rows=one,
            crossing=one,
        )
        found.append(points.points_mm[0])
    return np.array(found)


@pytest.mark.parametrize(("is_cut", "atol"), [(False, 0.002), (True, 0.03)])
def test_what_two_cameras_err_is_alike_in_points_of_two_sheets(
    monkeypatch: pytest.MonkeyPatch, *, is_cut: bool, atol: float
) -> None:
    """Covariances of each point, between points, and of their differences, by differences.

    The hand-eye errs 20 times as much as the sensor: differences tell whether that hides it.
    """
    monkeypatch.setattr(points_module, "USUAL_SIGMA_PX", SIGMA_PX)
    if not is_cut:
        monkeypatch.setattr(place, "LEAST_MODE", 1e-9)
        monkeypatch.setattr(place, "MOST_MODES", 1000)
    sensor = head().calibration()
    known = replace(placing_rig.scanner().hand_eye, dhand_eye_dsensor=None)
    scanner = ScannerCalibration(sensor, known, PROVENANCE)
    places, beside = [], {2: [-5.0, 4.0], 5: [0.0, -3.0], 8: [6.0, 2.0]}
    for sheet, place_mm in beside.items():
        there = head().sheets[sheet]
        left = head().views.left.project((there.origin_mm + place_mm @ there.axes[:2])[None])
        seen = project_on_sheets(left, np.array([sheet]), sensor)
        assert head().views.right.is_inside(seen.q_px).all()
        places.append((sheet, left[0], seen.q_px[0]))
    points, moves = _seen_by(sensor, places), []
    for column, sigma in enumerate(np.sqrt(np.diag(sensor.covariance))):
        step = np.zeros(len(sensor.covariance))
        step[column] = 0.1 * sigma
        up, down = (_seen_by(head().calibration(sign * step), places) for sign in (1.0, -1.0))
        moves.append((up - down).ravel() / (0.2 * sigma))
    by_sensor = np.stack(moves, axis=1)
    turn = placing_rig.TOOL_FROM_SENSOR.rotation
    by_hand_eye = (turn.T @ placing_rig.TOOL_FROM_SENSOR.jacobian(points)).reshape(9, 6)
    expected = by_sensor @ sensor.covariance @ by_sensor.T
    expected += by_hand_eye @ known.covariance @ by_hand_eye.T
    errors = errors_of_calibration(scanner, np.eye(3)[None])
    assert errors is not None
    none = np.zeros(3, dtype=np.int64)
    at_points = PointsSeen(
        points_mm=points, seen_from_mm=np.zeros((3, 3)), exposure=none, sheet=np.array(list(beside))
    )
    along = [errors.moves_along_mm(at_points, np.tile(axis, (3, 1))) for axis in np.eye(3)]
    told = np.stack(along, axis=2).reshape(-1, 9).T
    assert told.shape[1] == place.MOST_MODES or not is_cut
    size = np.sqrt(np.diag(expected))
    both = np.outer(size, size)
    np.testing.assert_allclose(told @ told.T / both, expected / both, atol=atol)
    apart = points[2] - points[0]
    along = apart / np.linalg.norm(apart)
    higher, length = (np.concatenate([-way, 0.0 * way, way]) for way in (np.eye(3)[2], along))
    for difference in (higher, length):
        sigma = np.sqrt(difference @ expected @ difference)
        assert np.linalg.norm(difference @ told) == pytest.approx(
            sigma, rel=0.15 if is_cut else 0.03
        )


@pytest.mark.parametrize(("n_columns", "n_alike"), [(3072, 11), (1700, 10), (1, 0)])
def test_a_sheet_that_both_cameras_hardly_see_errs_as_the_first_camera_tells(
    n_columns: int, n_alike: int
) -> None:
    """A right image cut off at some column: the other sheets keep what both cameras tell."""
    sensor = head().calibration()
    assert sensor.second is not None
    right = replace(sensor.second.camera.camera, width_px=n_columns)
    second = replace(sensor.second, camera=replace(sensor.second.camera, camera=right))
    known = replace(placing_rig.scanner().hand_eye, dhand_eye_dsensor=None)
    scanner = ScannerCalibration(replace(sensor, second=second), known, PROVENANCE)
    errors = errors_of_calibration(scanner, np.eye(3)[None])
    assert errors is not None
    whole = errors_of_calibration(ScannerCalibration(sensor, known, PROVENANCE), np.eye(3)[None])
    assert whole is not None
    # moves along the depth, in the middle of each sheet: two cameras know it better than one
    middle, usual = (np.linalg.norm(one.modes_mm[:, 0, 2], axis=1) for one in (errors, whole))
    assert int((np.abs(middle / usual - 1.0) < 0.015).sum()) == n_alike
    assert (middle > 0.98 * usual).all()


def test_noises_are_the_moves_by_one_sigma_of_each_stripe() -> None:
    sensor = head().calibration()
    left, normals, right = pixels()
    here = fused(sensor, left, right)
    by_left = fused(sensor, left + SIGMA_PX * normals, right).points_mm - here.points_mm
    across = SIGMA_PX * np.sqrt(0.5)
    by_right = fused(sensor, left, right + across).points_mm - here.points_mm
    by_sheet = here.by_sensor[:, :, 11] * shape_mm(sensor, SHEET)
    for column, moved in enumerate((by_left, by_right, by_sheet)):
        size = np.abs(moved).max()
        found = here.shape_mm if column == 2 else here.noise_mm[:, :, column]
        same, turned = np.abs(found - moved).max(), np.abs(found + moved).max()
        # the sheet's own shape has no sign
        assert (min(same, turned) if column == 2 else same) < 0.01 * size


def predicted(found: StripePoints, sensor: SensorCalibration) -> FloatArray:
    joint = sensor_covariance(sensor, SHEET)
    by_sensor = found.by_sensor
    return np.asarray(found.own_covariance_mm2 + by_sensor @ joint @ by_sensor.transpose(0, 2, 1))


def test_covariance_holds_and_the_fused_point_beats_each_camera_alone() -> None:
    true_sensor = head().calibration()
    left, normals, right = pixels()
    truth = fused(true_sensor, left, right).points_mm
    rng = np.random.default_rng(5)
    n, n_draws = len(left), 250
    blind, scores = [], []
    errors = {"fused": [], "left": [], "right": []}
    right_normals = np.tile([np.sqrt(0.5), np.sqrt(0.5)], (n, 1))
    for _ in range(n_draws):
        sensor = head().drawn_calibration(rng)
        q_left = left + SIGMA_PX * rng.standard_normal((n, 1)) * normals
        q_right = right + SIGMA_PX * rng.standard_normal((n, 1)) * right_normals
        found = fused(sensor, q_left, q_right)
        covariance = predicted(found, sensor)
        error = found.points_mm - truth
        scores.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error))
        there = project_on_sheets(q_left, np.full(n, SHEET), sensor)
        other = triangulate_right(
            make_profile("right", [(q_right, right_normals)], SIGMA_PX),
            np.arange(n),
            np.full(n, SHEET),
            sensor,
        )
        errors["fused"].append(error[:, 2])
        errors["left"].append(there.points_mm[:, 2] - truth[:, 2])
        errors["right"].append(other.points_mm[:, 2] - truth[:, 2])
        blind.append(covariance[:, 2, 2])
    mean = np.mean(scores, axis=0)
    # the mean of 250 chi-squares of three degrees of freedom
    assert np.abs(mean - 3.0).max() < 4.0 * np.sqrt(6.0 / n_draws)
    rms = {name: np.sqrt(np.mean(np.square(e), axis=0)) for name, e in errors.items()}
    assert (rms["fused"] < rms["left"]).all()
    assert (rms["fused"] < rms["right"]).all()
    ratio = rms["fused"] / np.sqrt(np.mean(blind, axis=0))
    print(f"mean normalised error of 3: {mean}, depth rms over predicted: {ratio}")
    assert np.abs(ratio - 1.0).max() < 4.0 / np.sqrt(2.0 * n_draws)


def with_rms(sensor: SensorCalibration, rms_mm: float) -> SensorCalibration:
    sheets = tuple(replace(sheet, rms_mm=rms_mm) for sheet in sensor.sheets)
    return replace(sensor, sheets=sheets)


def test_a_sheet_of_no_weight_leaves_the_two_cameras_alone() -> None:
    left, _, right = pixels()
    truth = fused(head().calibration(), left, right).points_mm
    moved = head().calibration(parameter_error(11, 0.02))
    by_cameras = fused(with_rms(moved, 1e4), left, right).points_mm
    by_sheet = project_on_sheets(left, np.full(len(left), SHEET), moved).points_mm
    assert np.abs(by_sheet - truth).max() > 0.02
    assert np.abs(by_cameras - truth).max() < 2e-5


def test_a_right_stripe_of_no_weight_leaves_the_left_camera_on_its_sheet() -> None:
    left, _, right = pixels()
    sensor = head().calibration()
    found = fused(sensor, left, right + 0.3, right_sigma_px=1e5).points_mm
    alone = project_on_sheets(left, np.full(len(left), SHEET), sensor).points_mm
    assert np.abs(found - alone).max() < 1e-6


def test_the_left_pixel_along_the_stripe_is_kept() -> None:
    left, normals, right = pixels()
    sensor = head().calibration()
    found = fused(sensor, left, right + np.array([0.2, -0.1])).points_mm
    moved = sensor.camera.camera.project(found) - left
    along = moved[:, 0] * -normals[:, 1] + moved[:, 1] * normals[:, 0]
    assert np.abs(along).max() < 1e-3
    assert np.abs(moved).max() > 1e-3


@pytest.mark.parametrize("column", range(9, 32))
def test_right_alone_derivatives_equal_differences(column: int) -> None:
    _, _, right = pixels()
    normals = np.tile([np.sqrt(0.5), np.sqrt(0.5)], (len(right), 1))
    profile = make_profile("right", [(right, normals)], SIGMA_PX)
    rows, sheet = np.arange(len(right)), np.full(len(right), SHEET)
    step = STEPS[column]

    def at(size: float) -> FloatArray:
        sensor = head().calibration(parameter_error(column, size))
        return triangulate_right(profile, rows, sheet, sensor).points_mm

    here = triangulate_right(profile, rows, sheet, head().calibration())
    expected = (at(step) - at(-step)) / (2.0 * step)
    size = np.abs(expected).max() + 1e-6 / step
    assert np.abs(here.by_sensor[:, :, column] - expected).max() < 2e-3 * size


def test_right_alone_meets_the_point_that_it_is_the_picture_of() -> None:
    left, _, right = pixels()
    sensor = head().calibration()
    normals = np.tile([np.sqrt(0.5), np.sqrt(0.5)], (len(right), 1))
    profile = make_profile("right", [(right, normals)], SIGMA_PX)
    found = triangulate_right(profile, np.arange(len(right)), np.full(len(right), SHEET), sensor)
    back = TwoViews.of_sensor(sensor).left.project(found.points_mm)
    assert np.abs(back - left).max() < 1e-4


def test_fusing_solves_the_weighted_equations_with_the_place_along_the_stripe_held() -> None:
    """The kernel against Lagrange's equations, solved point by point with NumPy."""
    sensor = head().drawn_calibration(np.random.default_rng(2))
    left, normals, right = pixels()
    right = right + np.array([[0.1, 0.0], [-0.2, 0.1], [0.0, 0.3], [0.05, -0.1]])
    found = fused(sensor, left, right, right_sigma_px=0.11)
    there = project_on_sheets(left, np.full(len(left), SHEET), sensor)
    across_right = np.full(2, np.sqrt(0.5))
    _, by_point, by_camera = sensor.camera.camera.project_with_jacobian(there.points_mm)
    _, gradient, by_sheet = sensor.sheets[SHEET].sheet.height_with_jacobian(there.points_mm)
    _, by_right, by_second = TwoViews.of_sensor(sensor).project_right_with_jacobian(there.points_mm)
    sigma = np.array([SIGMA_PX, 0.11, max(shape_mm(sensor, SHEET), 1e-6)])
    joint = sensor_covariance(sensor, SHEET)
    for i, normal in enumerate(normals):
        along = np.array([-normal[1], normal[0]])
        wanted = np.vstack(
            [
                along @ by_point[i],
                normal @ by_point[i],
                across_right @ by_right[i],
                gradient[i],
            ]
        )
        by_sensor = np.zeros((4, 32))
        by_sensor[0, :9], by_sensor[1, :9] = along @ by_camera[i], normal @ by_camera[i]
        by_sensor[2, 17:] = across_right @ by_second[i]
        by_sensor[3, 9:17] = by_sheet[i]
        weight = np.linalg.inv(by_sensor[1:] @ joint @ by_sensor[1:].T + np.diag(sigma**2))
        whole = np.zeros((4, 4))
        whole[:3, :3] = wanted[1:].T @ weight @ wanted[1:]
        whole[3, :3] = whole[:3, 3] = wanted[0]
        right_side = np.zeros((4, 4))
        right_side[3, 0], right_side[:3, 1:] = 1.0, wanted[1:].T @ weight
        gain = np.linalg.solve(whole, right_side)[:3]
        missed = across_right @ (there.q_px[i] - right[i])
        scale = np.abs(gain).max()
        at = there.points_mm[i] - gain[:, 2] * missed
        np.testing.assert_allclose(found.points_mm[i], at, atol=1e-9)
        np.testing.assert_allclose(found.noise_mm[i], gain[:, 1:3] * sigma[:2], atol=1e-8 * scale)
        np.testing.assert_allclose(found.shape_mm[i], gain[:, 3] * sigma[2], atol=1e-8 * scale)
        expected = -gain @ by_sensor
        size = np.abs(expected).max(axis=0)
        assert np.all(np.abs(found.by_sensor[i] - expected) <= 1e-7 * size + 1e-12)


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_a_point_without_a_right_stripe_is_that_of_the_left_camera_alone(lens: Lens) -> None:
    """One kernel for both: against the derivatives of a point on its sheet."""
    sensor = head().drawn_calibration(np.random.default_rng(3))
    sensor = fisheye_sensor(sensor) if lens == "fisheye" else sensor
    left, normals, right = pixels()
    n, sigma = len(left), np.array([0.05, 0.07, 0.09, 0.11])
    there = project_on_sheets(left, np.full(n, SHEET), sensor)
    stripes = RightStripes.of(make_profile("right", [(right, normals)], SIGMA_PX))
    beside = find_crossings(there, normals, sigma, stripes, sensor, reach_px=30.0)
    rows = np.array([3, 0, 2])
    found = fuse_points(
        there,
        beside,
        np.column_stack([normals, sigma]),
        np.full(n, SIGMA_PX),
        sensor=sensor,
        missed_px=beside.residual_px,
        rows=rows,
        crossing=np.array([-1, 0, -1]),
    )
    alone, sheet = np.array([0, 2]), sensor.sheets[SHEET].sheet
    points = there.points_mm[rows[alone]]
    by_px, by_sensor = differentiated(
        points, np.full(2, SHEET), lens_numbers(sensor), sheet_numbers(sensor)
    )
    np.testing.assert_array_equal(found.points_mm[alone], points)
    across = np.einsum("nij,nj->ni", by_px, normals[rows[alone]]) * sigma[rows[alone], None]
    np.testing.assert_allclose(found.noise_mm[alone, :, 0], across, rtol=1e-9, atol=1e-12)
    assert not found.noise_mm[alone, :, 1].any()
    _, gradient, _ = sheet.height_with_jacobian(points)
    slide = shape_mm(sensor, SHEET) / np.sum(gradient * points, axis=1)
    np.testing.assert_allclose(found.shape_mm[alone], points * slide[:, None], rtol=1e-9)
    size = np.abs(by_sensor).max(axis=(0, 1))
    assert (np.abs(found.by_sensor[alone, :, :17] - by_sensor) <= 1e-9 * size).all()
    assert not found.by_sensor[alone, :, 17:].any()
    assert found.noise_mm[1, :, 1].any()
    assert (found.sheet == SHEET).all()


def test_placing_by_the_product_is_placing_by_the_whole_derivatives() -> None:
    """More points than go through the kernel together, of two sheets in turn, in any pose."""
    rng = np.random.default_rng(6)
    n, n_sheets = 300, 2
    points, shape = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    stripe = StripePoints(
        row=np.arange(n),
        points_mm=points,
        noise_mm=rng.normal(size=(n, 3, 2)),
        shape_mm=shape,
        gain=rng.normal(size=(n, 3, 4)),
        by_distance=rng.normal(size=(n, N_PARAMETERS)),
        sheet=rng.integers(0, n_sheets, n),
    )
    assert stripe.gain is not None
    assert stripe.by_distance is not None
    errors = np.triu(rng.normal(size=(n_sheets, 38, 38)))
    turn, shift = rotation_from_vector(np.array([0.3, -0.8, 0.5])), np.array([10.0, -20.0, 5.0])
    carried = np.concatenate(
        [np.column_stack([turn, shift]), rng.uniform(0.0, 1.0, (3, 3))], axis=None
    )
    placed, covariance = np.zeros((n, 3)), np.zeros((n, 3, 3))
    carry_fused(
        points,
        stripe.noise_mm.reshape(n, 6),
        shape,
        stripe.gain.reshape(n, 12),
        stripe.by_distance,
        stripe.sheet,
        errors.reshape(-1, 38),
        carried,
        placed.reshape(-1),
        covariance.reshape(-1),
    )
    expected_at, expected = np.zeros((n, 3)), np.zeros((n, 3, 3))
    for k in range(n_sheets):
        propagate_points(
            points,
            stripe.noise_mm.reshape(n, 6),
            shape,
            stripe.by_sensor.reshape(n, 96),
            np.ascontiguousarray(errors[k].T),
            np.column_stack([turn, shift]),
            carried[12:].reshape(3, 3),
            np.flatnonzero(stripe.sheet == k),
            expected_at,
            expected.reshape(n, 9),
        )
    np.testing.assert_allclose(placed, expected_at, rtol=1e-12)
    np.testing.assert_allclose(covariance, expected, rtol=1e-9, atol=1e-9)
