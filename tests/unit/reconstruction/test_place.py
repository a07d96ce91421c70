# SPDX-License-Identifier: Apache-2.0
"""Points carried to Base: differences of every parameter, repeats with all errors, limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import Box, FloatArray
from armscan.geometry.poses import Points, Pose
from armscan.geometry.rotations import rotation_from_vector, skew
from armscan.kernels.placing import propagate_points
from armscan.models.calibration import ArmNoise, ScannerCalibration
from armscan.models.camera import CameraModel, Lens
from armscan.reconstruction import place
from armscan.reconstruction.place import (
    BaseTransform,
    arm_covariance,
    delivered_points,
    errors_of_calibration,
    place_with_jacobian,
    propagate_to_base,
)
from armscan.reconstruction.triangulate import (
    differentiated,
    intersect_sheets,
    lens_numbers,
    sheet_numbers,
    triangulate_stripe,
)
from armscan.records.cloud import PointsSeen
from armscan.records.profile import PointProfile
from rigs import placing_rig as rig
from rigs.fisheye import fisheye_sensor
from rigs.sheet_rig import thesis_rig

PLACES_PX = np.array([[1400.0, 600.0], [700.0, 820.0], [1000.0, 700.0]])
SHEET_OF = np.array([0, 1, 1])


def test_points_go_through_hand_eye_then_arm() -> None:
    points = np.random.default_rng(0).normal([0.0, 0.0, 140.0], 30.0, (5, 3))
    placed = place_with_jacobian(points, rig.BASE_FROM_TOOL, rig.TOOL_FROM_SENSOR)
    expected = rig.BASE_FROM_TOOL @ (rig.TOOL_FROM_SENSOR @ Points(points))
    np.testing.assert_allclose(placed.points_base_mm, expected.xyz_mm, atol=1e-11)


def test_derivatives_by_point_and_hand_eye() -> None:
    points = np.random.default_rng(1).normal([0.0, 0.0, 140.0], 30.0, (4, 3))
    placed = place_with_jacobian(points, rig.BASE_FROM_TOOL, rig.TOOL_FROM_SENSOR)

    def at(step: FloatArray, shift: FloatArray) -> FloatArray:
        moved = rig.stepped(rig.TOOL_FROM_SENSOR, step)
        return place_with_jacobian(points + shift, rig.BASE_FROM_TOOL, moved).points_base_mm

    for k in range(6):
        step = 1e-5 * np.eye(6)[k]
        difference = (at(step, np.zeros(3)) - at(-step, np.zeros(3))) / 2e-5
        np.testing.assert_allclose(placed.by_hand_eye[:, :, k], difference, atol=1e-6)
    for k in range(3):
        shift = 1e-3 * np.eye(3)[k]
        difference = (at(np.zeros(6), shift) - at(np.zeros(6), -shift)) / 2e-3
        np.testing.assert_allclose(
            np.tile(placed.by_sensor_point[:, k], (4, 1)), difference, atol=1e-9
        )


def scanner_before(lens: Lens) -> ScannerCalibration:
    scanner = rig.scanner()
    assert scanner.sensor is not None
    return replace(scanner, sensor=fisheye_sensor(scanner.sensor)) if lens == "fisheye" else scanner


def moves_by_differences(scanner: ScannerCalibration) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(3, 3, K), (3, 3, 6), (3, 3) of three points by sensor, hand-eye and noise, as defined.

    Sensor errors move the points AND, coupled, the hand-eye.
    """
    assert scanner.sensor is not None
    camera, pair = scanner.sensor.camera.camera, rig.sheets()
    joint = scanner.sensor.covariance
    sigma = np.sqrt(np.diag(joint))

    def at(sensor_step: FloatArray, hand_eye_step: FloatArray, shift_px: FloatArray) -> FloatArray:
        other = camera.moved_to(camera.parameters + sensor_step[:9])
        moved = (pair[0].updated(sensor_step[9:17]), pair[1].updated(sensor_step[17:]))
        points, _ = intersect_sheets(PLACES_PX + shift_px, SHEET_OF, rig.sensor_of(other, moved))
        hand_eye = rig.stepped(rig.TOOL_FROM_SENSOR, hand_eye_step + rig.coupling() @ sensor_step)
        return (rig.BASE_FROM_TOOL @ (hand_eye @ Points(points))).xyz_mm

    none, still, here = np.zeros(25), np.zeros(6), np.zeros(2)
    by_sensor = np.stack(
        [(at(s, still, here) - at(-s, still, here)) for s in np.diag(1e-3 * sigma)], axis=2
    ) / (2e-3 * np.where(sigma > 0.0, sigma, np.inf))
    by_hand_eye = (
        np.stack([(at(none, s, here) - at(none, -s, here)) for s in 1e-5 * np.eye(6)], axis=2)
        / 2e-5
    )
    step_px = 1e-3 * np.array([0.6, 0.8])
    noise = rig.SIGMA_PX * (at(none, still, step_px) - at(none, still, -step_px)) / 2e-3
    return by_sensor, by_hand_eye, noise


def covariance_by_differences(scanner: ScannerCalibration) -> FloatArray:
    """(3, 3, 3) of the same points."""
    by_sensor, by_hand_eye, noise = moves_by_differences(scanner)
    assert scanner.sensor is not None
    joint = scanner.sensor.covariance
    own = by_hand_eye @ scanner.hand_eye.covariance @ by_hand_eye.transpose(0, 2, 1)
    follow = by_sensor @ joint @ by_sensor.transpose(0, 2, 1)
    return np.asarray(own + follow + noise[:, :, None] * noise[:, None, :])


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_covariance_term_by_term_on_two_sheets(lens: Lens) -> None:
    """Each point takes the camera, its own sheet and the hand-eye, with the coupling's sign."""
    placing = BaseTransform.of(scanner_before(lens))
    assert placing.scanner.sensor is not None
    profile = rig.profile_at(PLACES_PX)
    stripe = triangulate_stripe(profile, SHEET_OF, placing.scanner.sensor)
    quiet = replace(
        placing,
        scanner=replace(
            placing.scanner,
            hand_eye=replace(
                placing.scanner.hand_eye, arm_noise=ArmNoise(position_mm=0.0, rotation_rad=0.0)
            ),
        ),
    )
    cloud = propagate_to_base(stripe, profile, rig.BASE_FROM_TOOL, quiet)
    # The coupling reaches the other sheet's parameters, which move this point through the
    # hand-eye alone: they belong to the joint covariance too.
    expected = covariance_by_differences(placing.scanner)
    size = np.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(cloud.covariance_mm2 / size, expected / size, atol=1e-5)
    loud = propagate_to_base(stripe, profile, rig.BASE_FROM_TOOL, placing)
    middle = (
        rig.BASE_FROM_TOOL @ (rig.TOOL_FROM_SENSOR @ Points(placing.scan_point_mm[None]))
    ).xyz_mm[0]
    np.testing.assert_allclose(
        loud.covariance_mm2 - cloud.covariance_mm2,
        arm_covariance(cloud.points_mm, middle, rig.BASE_FROM_TOOL.translation_mm, rig.ARM_NOISE),
        atol=1e-12,
    )
    assert cloud.frame == "Base"
    assert cloud.sheet.tolist() == SHEET_OF.tolist()


@pytest.mark.parametrize(("left_out", "atol"), [(1e-9, 0.02), (place.LEAST_MODE, 0.03)])
def test_what_a_calibration_errs_is_alike_in_points_of_two_sheets(
    left_out: float, atol: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Covariances of each point and between points, of the polynomials and by differences.

    Each sheet with errors of its own would leave the camera's and the hand-eye's out between them.
    """
    monkeypatch.setattr(place, "LEAST_MODE", left_out)
    scanner = rig.scanner()
    assert scanner.sensor is not None
    by_sensor, by_hand_eye, _ = moves_by_differences(scanner)
    root = np.linalg.cholesky(scanner.hand_eye.covariance)
    sensor_root = np.linalg.cholesky(scanner.sensor.covariance)
    expected = np.concatenate([by_hand_eye @ root, by_sensor @ sensor_root], axis=2).reshape(9, -1)
    pose = rig.BASE_FROM_TOOL @ rig.TOOL_FROM_SENSOR
    errors = errors_of_calibration(scanner, pose.rotation[None])
    assert errors is not None
    points = intersect_sheets(PLACES_PX, SHEET_OF, scanner.sensor, pose)[0]
    eye = np.tile(pose.translation_mm, (3, 1))
    seen = PointsSeen(
        points_mm=points, seen_from_mm=eye, exposure=np.zeros(3, dtype=np.int64), sheet=SHEET_OF
    )
    along = [errors.moves_along_mm(seen, np.tile(axis, (3, 1))) for axis in np.eye(3)]
    found = np.stack(along, axis=2).reshape(-1, 9).T
    size = np.sqrt(np.diag(expected @ expected.T))
    both = np.outer(size, size)
    # polynomials follow the errors to 2 %, and 0.3 % of their variance is left out: at a point more
    np.testing.assert_allclose(found @ found.T / both, expected @ expected.T / both, atol=atol)
    each = found.reshape(3, 3, -1)
    np.testing.assert_allclose(errors.covariance_mm2(seen), each @ each.transpose(0, 2, 1))


def test_covariance_is_that_of_repeats() -> None:
    """600 scanners drawn from their own documents: mean of e' C^-1 e is 3 +- 4 sigma.

    The arm's pose is drawn as a shift and two turns, about the scan point and the origin of Tool.
    """
    scanner = rig.scanner()
    assert scanner.sensor is not None
    placing = BaseTransform.of(scanner)
    camera, pair = thesis_rig().camera, rig.sheets()
    place, sheet = PLACES_PX[:1], SHEET_OF[:1]
    profile = rig.profile_at(place)
    cloud = propagate_to_base(
        triangulate_stripe(profile, sheet, scanner.sensor), profile, rig.BASE_FROM_TOOL, placing
    )
    middle = (
        rig.BASE_FROM_TOOL @ (rig.TOOL_FROM_SENSOR @ Points(placing.scan_point_mm[None]))
    ).xyz_mm[0]
    rng = np.random.default_rng(12)
    noise = rig.ARM_NOISE
    position = np.hypot(noise.position_mm, noise.exposure_position_mm)
    turn = np.hypot(noise.rotation_rad, noise.exposure_rotation_rad)
    about_tool = np.hypot(noise.tool_rotation_rad, noise.exposure_tool_rotation_rad)
    n_repeats, squares = 600, []
    draws = rng.multivariate_normal(np.zeros(31), scanner.covariance, n_repeats)
    for error in draws:
        other = CameraModel.from_parameters(camera.parameters + error[:9], 2048, 1536)
        moved = (pair[0].updated(error[9:17]), pair[1].updated(error[17:25]))
        noisy = place + rng.normal(0.0, rig.SIGMA_PX) * np.array([0.6, 0.8])
        points, _ = intersect_sheets(noisy, sheet, rig.sensor_of(other, moved))
        spin = rotation_from_vector(rng.normal(0.0, turn, 3))
        own = rotation_from_vector(rng.normal(0.0, about_tool, 3))
        arm = Pose(
            spin @ own @ rig.BASE_FROM_TOOL.rotation,
            spin @ (rig.BASE_FROM_TOOL.translation_mm - middle)
            + middle
            + rng.normal(0.0, position, 3),
        )
        found = arm @ (rig.stepped(rig.TOOL_FROM_SENSOR, error[25:]) @ Points(points))
        miss = (found.xyz_mm - cloud.points_mm)[0]
        squares.append(miss @ np.linalg.solve(cloud.covariance_mm2[0], miss))
    assert abs(np.mean(squares) - 3.0) < 4.0 * np.sqrt(6.0 / n_repeats)


def test_the_arm_turns_about_the_scan_point_and_about_tool() -> None:
    """By hand, 100 mm along x from the scan point, which lies 200 mm above the origin of Tool.

    A turn of sigma s moves a point at distance d from its axis by d s: nothing along the line to
    the centre, and both turns' parts add, across x and across the line from Tool.
    """
    noise = ArmNoise(
        position_mm=0.01,
        rotation_rad=1e-4,
        exposure_position_mm=0.02,
        exposure_rotation_rad=2e-4,
        tool_rotation_rad=3e-4,
        exposure_tool_rotation_rad=4e-4,
    )
    scan_point, tool = np.zeros(3), np.array([0.0, 0.0, -200.0])
    points = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0]])
    at, beside = arm_covariance(points, scan_point, tool, noise)
    across = 200.0**2 * 25e-8
    np.testing.assert_allclose(at, np.diag([5e-4 + across, 5e-4 + across, 5e-4]), atol=1e-18)
    near, far = 100.0**2 * 5e-8, 100.0**2 * 25e-8
    expected = np.diag([5e-4 + across, 5e-4 + near + across + far, 5e-4 + near + far])
    expected[0, 2] = expected[2, 0] = -100.0 * 200.0 * 25e-8
    np.testing.assert_allclose(beside, expected, atol=1e-18)


def test_points_that_a_sensor_delivered() -> None:
    """Without camera the hand-eye's covariance is all; the scan point is the points' middle."""
    hand_eye = replace(rig.scanner().hand_eye, dhand_eye_dsensor=None)
    placing = BaseTransform.of(replace(rig.scanner(), sensor=None, hand_eye=hand_eye))
    points = np.array([[0.0, -10.0, 100.0], [0.0, 10.0, 110.0]])
    noise = np.array([[0.0, 0.0, 0.02], [0.0, 0.01, 0.0]])[:, :, None]
    profile = PointProfile(source="profile", points_mm=points)
    stripe = replace(delivered_points(profile), noise_mm=noise)
    cloud = propagate_to_base(stripe, profile, rig.BASE_FROM_TOOL, placing)
    placed, covariance = cloud.points_mm, cloud.covariance_mm2
    by = place_with_jacobian(points, rig.BASE_FROM_TOOL, rig.TOOL_FROM_SENSOR)
    expected = by.by_hand_eye @ hand_eye.covariance @ by.by_hand_eye.transpose(0, 2, 1)
    tool = rig.BASE_FROM_TOOL.translation_mm
    expected += arm_covariance(placed, placed.mean(axis=0), tool, rig.ARM_NOISE)
    turned = noise[:, :, 0] @ by.by_sensor_point.T
    expected += turned[:, :, None] * turned[:, None, :]
    np.testing.assert_allclose(covariance, expected, atol=1e-12)
    with pytest.raises(InputError, match="camera"):
        propagate_to_base(stripe, profile, rig.BASE_FROM_TOOL, BaseTransform.of(rig.scanner()))


def test_combinations_known_a_thousand_times_better_are_kept() -> None:
    """Errors that cancel but for 1e-4 of their size: the factor must not cut them off."""
    mixing = np.linalg.qr(np.random.default_rng(3).normal(size=(6, 6)))[0]
    units = np.array([1e-4, 1e-4, 1e-4, 0.02, 0.02, 0.02])
    tight = mixing @ np.diag(np.geomspace(1e-8, 1.0, 6)) @ mixing.T * np.outer(units, units)
    hand_eye = replace(rig.scanner().hand_eye, dhand_eye_dsensor=None, covariance=tight)
    (factor,) = BaseTransform.of(replace(rig.scanner(), sensor=None, hand_eye=hand_eye)).factors
    combination = mixing[:, 0] / units
    variance = float(((combination @ factor) ** 2).sum())
    assert variance == pytest.approx(1e-8, rel=1e-3)


def test_a_covariance_that_is_none_is_refused() -> None:
    broken = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1.0])
    hand_eye = replace(rig.scanner().hand_eye, dhand_eye_dsensor=None, covariance=broken)
    with pytest.raises(InputError, match="positive semi-definite"):
        BaseTransform.of(replace(rig.scanner(), sensor=None, hand_eye=hand_eye))


def test_volume() -> None:
    box = Box.parse("0,10,-5,5,2,3", "--volume")
    inside = box.holds(np.array([[0.0, -5, 2], [10, 5, 3], [10.1, 0, 2.5], [5, 0, 1.9]]))
    assert inside.tolist() == [True, True, False, False]
    assert str(Box.parse(str(box), "--volume")) == str(box)
    for wrong in ("0,10,5,-5,2,3", "1,2,3", "a,b,c,d,e,f", "0,nan,0,1,0,1"):
        with pytest.raises(OptionError):
            Box.parse(wrong, "--volume")
    with pytest.raises(OptionError):
        Box(np.zeros(3), np.zeros(3))


def test_propagation_in_one_pass_is_that_of_the_whole_product() -> None:
    """Some columns are zero for some points, as where one camera of two saw nothing."""
    rng = np.random.default_rng(5)
    points, own, shape = (
        rng.normal(size=(40, 3)),
        rng.normal(size=(40, 3, 2)),
        rng.normal(size=(40, 3)),
    )
    by_sensor = rng.normal(size=(40, 3, 11))
    by_sensor[::3, :, 4:9] = 0.0
    by_sensor[1::3, 0] = 0.0
    factor, turn = (
        np.tril(rng.normal(size=(17, 13))),
        rotation_from_vector(np.array([0.3, -0.8, 0.5])),
    )
    shift, arm = np.array([10.0, -20.0, 5.0]), rng.uniform(0.0, 1.0, (3, 3))
    rows = np.arange(1, 40, 2)
    placed, covariance = np.zeros((40, 3)), np.zeros((40, 3, 3))
    propagate_points(
        points,
        own.reshape(40, 6),
        shape,
        by_sensor.reshape(40, 33),
        factor,
        np.column_stack([turn, shift]),
        arm,
        rows,
        placed,
        covariance.reshape(40, 9),
    )
    expected_at = points @ turn.T + shift
    np.testing.assert_allclose(placed[rows], expected_at[rows], rtol=1e-12)
    for i in rows:
        by_hand_eye = np.concatenate([-skew(points[i]), np.eye(3)], axis=1)
        moved = np.concatenate([by_sensor[i], by_hand_eye], axis=1) @ factor
        whole = moved @ moved.T + own[i] @ own[i].T + np.outer(shape[i], shape[i])
        expected = turn @ whole @ turn.T + arm[0, 0] * np.eye(3)
        for variance, about in zip(arm[0, 1:], arm[1:], strict=True):
            lever = skew(expected_at[i] - about)
            expected += variance * lever @ lever.T
        np.testing.assert_allclose(covariance[i], expected, rtol=1e-10)
    assert not covariance[::2].any()


def test_derivatives_made_on_the_way_give_the_covariance_of_derivatives_that_are_held() -> None:
    """Bent sheets whose light fans out, a lens that distorts, and points of both sheets mixed."""
    rng = np.random.default_rng(11)
    scanner = rig.scanner()
    sensor = scanner.sensor
    assert sensor is not None
    bent = [
        replace(
            one,
            sheet=replace(one.sheet, bow_mm=rng.normal(0.0, 0.1, 5), fan=rng.uniform(-0.3, 0.3, 2)),
        )
        for one in sensor.sheets
    ]
    lens = replace(sensor.camera.camera, distortion=np.array([-0.1, 0.15, 2e-3, -1e-3, 0.05]))
    camera = replace(sensor.camera, camera=lens)
    scanner = replace(scanner, sensor=replace(sensor, camera=camera, sheets=tuple(bent)))
    places = np.tile(PLACES_PX, (40, 1)) + rng.normal(0.0, 20.0, (40 * len(PLACES_PX), 2))
    sheet = np.tile(SHEET_OF, 40)
    profile = rig.profile_at(places)
    placing = BaseTransform.of(scanner)
    stripe = triangulate_stripe(profile, sheet, scanner.sensor)
    assert len(np.unique(stripe.sheet)) == len(bent)
    held = replace(stripe, dpoint_dsensor=stripe.by_sensor)
    made, known = (
        propagate_to_base(one, profile, rig.BASE_FROM_TOOL, placing) for one in (stripe, held)
    )
    np.testing.assert_allclose(made.points_mm, known.points_mm, rtol=1e-12)
    size = np.abs(known.covariance_mm2).max(axis=(1, 2), keepdims=True)
    assert np.all(np.abs(made.covariance_mm2 - known.covariance_mm2) <= 1e-9 * size)
    sensor = scanner.sensor
    points, is_met = intersect_sheets(places[stripe.row], sheet[stripe.row], sensor)
    assert is_met.all()
    np.testing.assert_allclose(points, stripe.points_mm, rtol=1e-12)
    by_px, _ = differentiated(points, stripe.sheet, lens_numbers(sensor), sheet_numbers(sensor))
    across = (profile.normals_px * profile.sigma_px[:, None])[stripe.row]
    expected = np.einsum("nij,nj->ni", by_px, across)
    np.testing.assert_allclose(stripe.noise_mm[:, :, 0], expected, rtol=1e-9, atol=1e-12)
