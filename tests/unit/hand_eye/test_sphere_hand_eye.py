# SPDX-License-Identifier: Apache-2.0
"""Hand-eye on a sphere in one least squares: truth, derivatives, scatter, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from armscan.calibration.hand_eye.calibrate import calibrate_on_sphere
from armscan.calibration.hand_eye.observations import (
    HandEyeOptions,
    PosedStripe,
    condense_sphere,
    find_sections,
)
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.hand_eye.surface import HandEyeState, SphereSurface, place
from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import (
    EulerConvention,
    euler_from_rotations,
    rotation_from_vector,
    rotations_from_euler,
    vector_from_rotation,
)
from rigs.sphere_rig import (
    CENTRE_MM,
    DIAMETER_MM,
    HAND_EYE,
    POINT_NOISE_MM,
    SHEET_NORMAL,
    SphereRig,
    turned_poses,
    with_wrong_sensor,
)

SEED = 5
POSE_NOISE_MM = 0.02
QUICK = HandEyeOptions(per_stripe=10)
SPHERE = SphereSurface(0.5 * DIAMETER_MM)


def error_of(fit: HandEyeFit) -> FloatArray:
    """(6,) found minus true, in HAND_EYE_PARAMETER_NAMES."""
    found = fit.calibration.tool_from_sensor
    turn = vector_from_rotation(found.rotation @ HAND_EYE.rotation.T)
    return np.concatenate([turn, found.translation_mm - HAND_EYE.translation_mm])


def solved(result: HandEyeFit | FitFailure) -> HandEyeFit:
    assert isinstance(result, HandEyeFit), result
    return result


@pytest.mark.parametrize("n_sheets", [1, 2])
def test_exact_points_give_the_hand_eye_back(n_sheets: int) -> None:
    other = rotation_from_vector(np.array([0.0, 0.0, 0.5])) @ SHEET_NORMAL
    rig = SphereRig(normals=(SHEET_NORMAL, other)[:n_sheets])
    stripes = rig.stripes(turned_poses(rig, 9), np.random.default_rng(SEED))
    fit = solved(calibrate_on_sphere(stripes, DIAMETER_MM, QUICK))
    assert np.abs(error_of(fit)[:3]).max() < 1e-7
    assert np.abs(error_of(fit)[3:]).max() < 1e-5
    assert fit.calibration.rms_mm < 1e-6
    assert fit.calibration.diagnostics is not None
    assert fit.calibration.diagnostics.method == "sphere"
    assert fit.calibration.n_exposures == fit.calibration.n_postures == 9


def test_slopes_are_the_derivatives() -> None:
    """Where the stripes lie on the sphere: elsewhere each has a centre of its own."""
    rig = SphereRig()
    stripes = rig.stripes(turned_poses(rig, 4), np.random.default_rng(SEED))
    sections, _ = find_sections(stripes, 0.5 * DIAMETER_MM)
    nodes = condense_sphere(sections, 8)
    state = HandEyeState(HAND_EYE, np.array([*CENTRE_MM, 0.5 * DIAMETER_MM]))
    placed = place(nodes, SPHERE, state)
    for column in range(placed.jacobian.shape[1]):
        step = np.zeros(placed.jacobian.shape[1])
        step[column] = 1e-5
        ahead = place(nodes, SPHERE, state.retract(step)).residual_mm
        behind = place(nodes, SPHERE, state.retract(-step)).residual_mm
        slope = (ahead - behind) / 2e-5
        scale = max(1.0, np.abs(slope).max())
        np.testing.assert_allclose(placed.jacobian[:, column] / scale, slope / scale, atol=1e-6)


def test_pose_slopes_are_the_derivatives_by_the_arms_pose() -> None:
    rig = SphereRig()
    stripe = rig.stripes(turned_poses(rig, 1), np.random.default_rng(SEED))[0]
    state = HandEyeState(HAND_EYE, np.array([*CENTRE_MM, 0.5 * DIAMETER_MM]))

    def residual(moved: Pose) -> tuple[FloatArray, FloatArray, FloatArray]:
        changed = replace(stripe, base_from_tool=moved)
        sections, _ = find_sections([changed], 25.0)
        nodes = condense_sphere(sections, 6)
        placed = place(nodes, SPHERE, state)
        return placed.residual_mm, placed.dresidual_dpose, placed.points_base_mm.mean(axis=0)

    start = stripe.base_from_tool
    _, slopes, middle = residual(start)
    centres = start.translation_mm, middle
    for k in range(3):
        small = 1e-5 * np.eye(3)[k]
        turn = rotation_from_vector(small)
        shifted = [Pose(start.rotation, start.translation_mm + s * small) for s in (1, -1)]
        ahead, behind = (residual(pose)[0] for pose in shifted)
        np.testing.assert_allclose(slopes[:, k], (ahead - behind) / 2e-5, atol=1e-6)
        for n, centre in enumerate(centres):
            turned = [
                Pose(r @ start.rotation, r @ (start.translation_mm - centre) + centre)
                for r in (turn, turn.T)
            ]
            ahead, behind = (residual(pose)[0] for pose in turned)
            expected = (ahead - behind) / 2e-5
            np.testing.assert_allclose(slopes[:, 3 + 3 * n + k], expected, atol=1e-4)


def test_a_stripe_that_was_thrown_is_seen_from_its_own_centre() -> None:
    """Its distances are linear in the shift then; from the common centre they are not.

    By hand: d = s n, but for s t (s t) / (2 r) of the part s t along the sphere: 0.8 mm are 0.013
    mm on 25 mm of radius, ten times what is left here.
    """
    rig = SphereRig()
    stripe = rig.stripes(turned_poses(rig, 1), np.random.default_rng(SEED))[0]
    shift = np.array([0.5, -0.5, 0.4])
    pose = stripe.base_from_tool
    thrown = replace(stripe, base_from_tool=Pose(pose.rotation, pose.translation_mm + shift))
    nodes = condense_sphere(find_sections([thrown], 25.0)[0], 12)
    state = HandEyeState(HAND_EYE, np.array([*CENTRE_MM, 0.5 * DIAMETER_MM]))
    placed = place(nodes, SPHERE, state)
    outward = (placed.points_base_mm - shift - CENTRE_MM) / (0.5 * DIAMETER_MM)
    expected = nodes.mean(outward @ shift)
    np.testing.assert_allclose(placed.residual_mm, expected, atol=1.3e-3)
    plain = np.linalg.norm(placed.points_base_mm - CENTRE_MM, axis=1) - 0.5 * DIAMETER_MM
    assert np.abs(nodes.mean(plain) - expected).max() > 5e-3


def test_the_gradient_is_that_of_a_least_squares_with_a_shift_of_each_stripe() -> None:
    """J' C^-1 e, half a millimetre off the sphere, beside a minimum over shifts, by differences."""
    noise_mm, throw_mm = 0.005, 0.5
    rig = SphereRig(pose_noise_mm=throw_mm)
    stripes = rig.stripes(turned_poses(rig, 4), np.random.default_rng(SEED))
    nodes = condense_sphere(find_sections(stripes, 0.5 * DIAMETER_MM)[0], 40)
    start = HandEyeState(HAND_EYE, np.array([650.3, -170.0, 35.5, 0.5 * DIAMETER_MM]))

    def cost(state: HandEyeState) -> float:
        points = place(nodes, SPHERE, state).points_base_mm
        total = 0.0
        for k in range(4):
            own = points[nodes.of_points(nodes.stripe) == k]

            def left(shift: FloatArray, own: FloatArray = own) -> FloatArray:
                away = np.linalg.norm(own - state.surface[:3] - shift, axis=1) - state.surface[3]
                weight = np.sqrt(40.0 / len(own)) / noise_mm
                return np.concatenate([weight * away, shift / throw_mm])

            total += least_squares(left, np.zeros(3), xtol=1e-12, ftol=1e-12).cost
        return total

    placed = place(nodes, SPHERE, start)
    shifts = placed.dresidual_dpose[:, :3]
    alike = nodes.stripe[:, None] == nodes.stripe[None, :]
    covariance = noise_mm**2 * np.eye(len(nodes)) + throw_mm**2 * alike * (shifts @ shifts.T)
    found = placed.jacobian[:, :9].T @ np.linalg.solve(covariance, placed.residual_mm)
    expected = np.zeros(9)
    for column in range(9):
        step = np.zeros(placed.jacobian.shape[1])
        step[column] = 1e-5 if column < 3 else 1e-3
        ahead, behind = cost(start.retract(step)), cost(start.retract(-step))
        expected[column] = (ahead - behind) / (2.0 * step[column])
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.01 * np.abs(expected[3:]).max())


def test_what_is_new_in_every_exposure_is_told_from_the_posture() -> None:
    """Two exposures of each posture: their own part of the pose, which no form of a stripe is.

    12 postures tell both scatters to a seventh of each; errors over their covariance.
    """
    sigma_mm, share = 0.08, 0.5
    common = SphereRig(pose_noise_mm=sigma_mm)
    own = SphereRig(pose_noise_mm=share * sigma_mm, point_noise_mm=0.005, n_points=60)
    generator, squares, found = np.random.default_rng(SEED), [], []
    for _ in range(4):
        stripes = []
        for k, pose in enumerate(turned_poses(own, 12)):
            reported = common.stripes([pose], generator)[0].base_from_tool
            for number in range(2):
                one = own.stripes([pose], generator)[0]
                moved = one.base_from_tool @ pose.inverse() @ reported
                name = f"p{k}"
                stripes.append(
                    replace(one, source=f"{name}-{number}", posture=name, base_from_tool=moved)
                )
        fit = solved(calibrate_on_sphere(stripes, DIAMETER_MM, QUICK))
        error = error_of(fit)
        squares.append(error @ np.linalg.solve(fit.calibration.covariance, error))
        noise = fit.calibration.arm_noise
        found.append([noise.position_mm, noise.exposure_position_mm])
    assert np.mean(squares) < chi2.ppf(0.9995, 24) / 4
    expected = [sigma_mm, share * sigma_mm]
    assert np.mean(found, axis=0) == pytest.approx(expected, rel=4.0 / 7.0 / 2.0)


def test_errors_scatter_as_predicted() -> None:
    """Pose noise common to a posture is estimated; errors over their covariance are chi-squared."""
    rig = SphereRig(pose_noise_mm=POSE_NOISE_MM, point_noise_mm=POINT_NOISE_MM, n_points=60)
    poses = turned_poses(rig, 12)
    generator = np.random.default_rng(SEED)
    n_runs = 8
    normalised, arms = [], []
    for _ in range(n_runs):
        fit = solved(calibrate_on_sphere(rig.stripes(poses, generator), DIAMETER_MM, QUICK))
        error = error_of(fit)
        normalised.append(error @ np.linalg.solve(fit.calibration.covariance, error))
        arms.append(fit.calibration.arm_noise.position_mm)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * n_runs) / n_runs
    assert low < np.mean(normalised) < 1.15 * high
    # 12 x 3 - 9 = 27 numbers tell the arm's noise: 14 % a run
    assert np.mean(arms) == pytest.approx(POSE_NOISE_MM, rel=4.0 * 0.14 / np.sqrt(n_runs))


def test_the_sensors_error_counts_once() -> None:
    """Common to all postures, it is told by the coupling alone: the arm's scatter stays its own.

    A coarse sensor on a fair arm. Total covariance and posture means against their predictions;
    the arm's scatter, of 12 postures in each run, is known to 6 % after five.
    """
    rig = SphereRig(pose_noise_mm=POSE_NOISE_MM, point_noise_mm=POINT_NOISE_MM, n_points=60)
    poses = turned_poses(rig, 12)
    generator = np.random.default_rng(SEED)
    sigma = np.array([0.08, 0.08, 0.08, 1.2e-3, 1.2e-3])
    known = np.diag(sigma**2)
    n_runs = 5
    squares, arms, means = [], [], []
    for _ in range(n_runs):
        wrong = sigma * generator.normal(size=5)
        stripes = with_wrong_sensor(rig.stripes(poses, generator), wrong)
        fit = solved(calibrate_on_sphere(stripes, DIAMETER_MM, QUICK, sensor_covariance=known))
        coupling = fit.calibration.dhand_eye_dsensor
        assert coupling is not None
        total = fit.calibration.covariance + coupling @ known @ coupling.T
        squares.append(float(error_of(fit) @ np.linalg.solve(total, error_of(fit))))
        arms.append(fit.calibration.arm_noise.position_mm)
        means += [posture.normalised_mean for posture in fit.postures]
    low, high = chi2.ppf([0.005, 0.995], 6 * n_runs)
    assert low < sum(squares) < high
    assert abs(np.mean(arms) / POSE_NOISE_MM - 1.0) < 4.0 * 0.14 / np.sqrt(n_runs)
    assert 0.5 < np.mean(np.square(means)) < 1.6


def test_a_posture_that_contradicts_is_named_and_hardly_spoils_the_rest() -> None:
    rig = SphereRig(pose_noise_mm=POSE_NOISE_MM, point_noise_mm=POINT_NOISE_MM)
    stripes = rig.stripes(turned_poses(rig, 14), np.random.default_rng(SEED))
    wrong = stripes[4].base_from_tool
    moved = Pose(wrong.rotation, wrong.translation_mm + np.array([0.4, -0.3, 0.3]))
    stripes[4] = replace(stripes[4], base_from_tool=moved)
    fit = solved(calibrate_on_sphere(stripes, DIAMETER_MM, QUICK))
    named = [text for text in fit.warnings if "contradicts the others" in text]
    assert len(named) == 1
    assert named[0].startswith("posture p4 ")
    error = error_of(fit)
    assert error @ np.linalg.solve(fit.calibration.covariance, error) < chi2.ppf(0.9999, 6)
    assert fit.calibration.arm_noise.position_mm < 2.0 * POSE_NOISE_MM


def test_leaving_a_posture_out_is_solving_without_it() -> None:
    rig = SphereRig(pose_noise_mm=POSE_NOISE_MM, point_noise_mm=POINT_NOISE_MM)
    stripes = rig.stripes(turned_poses(rig, 8), np.random.default_rng(SEED))
    options = replace(QUICK, arm_position_mm=POSE_NOISE_MM, posture_sigmas=1e6)
    every = solved(calibrate_on_sphere(stripes, DIAMETER_MM, options))
    less = solved(calibrate_on_sphere(stripes[1:], DIAMETER_MM, options))
    change = error_of(less) - error_of(every)
    told = every.postures[0]
    moved = float(np.linalg.norm(change[3:]))
    assert told.left_out_translation_mm == pytest.approx(moved, rel=0.1)
    turned = float(np.degrees(np.linalg.norm(change[:3])))
    assert told.left_out_rotation_deg == pytest.approx(turned, rel=0.1)


def test_an_error_of_the_sensor_moves_the_hand_eye_against_it() -> None:
    """Points shifted by d in the Sensor frame are made good by t - R d."""
    rig = SphereRig()
    stripes = rig.stripes(turned_poses(rig, 8), np.random.default_rng(SEED))
    shifts = np.broadcast_to(np.eye(3), (rig.n_points, 3, 3))
    stripes = [replace(stripe, dpoint_dsensor=shifts) for stripe in stripes]
    fit = solved(calibrate_on_sphere(stripes, DIAMETER_MM, QUICK))
    coupling = fit.calibration.dhand_eye_dsensor
    assert coupling is not None
    np.testing.assert_allclose(coupling[:3], 0.0, atol=1e-6)
    np.testing.assert_allclose(coupling[3:], -HAND_EYE.rotation, atol=1e-4)


def test_diameter_and_scale_are_solved_along() -> None:
    rig = SphereRig(point_noise_mm=0.001)
    stripes = rig.stripes(turned_poses(rig, 10), np.random.default_rng(SEED))
    options = replace(QUICK, solve_diameter=True)
    fit = solved(calibrate_on_sphere(stripes, DIAMETER_MM + 0.5, options))
    text = dict(fit.reference)["Sphere's diameter, solved along"]
    assert float(text.split()[0]) == pytest.approx(DIAMETER_MM, abs=0.005)
    larger = [replace(stripe, points_mm=1.002 * stripe.points_mm) for stripe in stripes]
    scaled = solved(calibrate_on_sphere(larger, DIAMETER_MM, replace(QUICK, solve_scale=True)))
    scale = dict(scaled.reference)["Scale of the sensor's points"]
    assert float(scale.split(",")[0]) == pytest.approx(1.0 / 1.002, abs=2e-4)


def test_a_wrong_diameter_is_noticed() -> None:
    rig = SphereRig(pose_noise_mm=POSE_NOISE_MM, point_noise_mm=POINT_NOISE_MM)
    stripes = rig.stripes(turned_poses(rig, 12), np.random.default_rng(SEED))
    fit = solved(calibrate_on_sphere(stripes, DIAMETER_MM + 0.4, QUICK))
    (warning,) = (text for text in fit.warnings if "the points ask for" in text)
    asked = float(warning.split("diameter of ")[1].split(" mm")[0])
    assert asked == pytest.approx(DIAMETER_MM, abs=0.05)
    fit = solved(calibrate_on_sphere(stripes, DIAMETER_MM, QUICK))
    assert not any("ask for" in text for text in fit.warnings)
    wrong = calibrate_on_sphere(stripes, DIAMETER_MM + 1.0, QUICK)
    assert isinstance(wrong, FitFailure)
    assert "the points ask for a diameter of 50.0" in wrong.reason
    freed = replace(QUICK, solve_diameter=True)
    fit = solved(calibrate_on_sphere(stripes, DIAMETER_MM + 1.0, freed))
    assert ("Sphere's diameter, solved along", "50.0") in [(k, v[:4]) for k, v in fit.reference]
    assert not any("ask for" in text for text in fit.warnings)
    small = calibrate_on_sphere(stripes, 0.6 * DIAMETER_MM, QUICK)
    assert isinstance(small, FitFailure)
    assert "no section of a sphere of 30 mm" in small.reason


def test_postures_that_do_not_determine_the_hand_eye_are_refused() -> None:
    rig = SphereRig(pose_noise_mm=POSE_NOISE_MM, point_noise_mm=POINT_NOISE_MM)
    generator = np.random.default_rng(SEED)
    about_one_axis = [
        rig.base_from_tool(np.array([turn, 0.0, 0.0]), height, 0.0)
        for turn, height in zip(np.linspace(-0.6, 0.6, 10), np.resize([4, 9, 14], 10), strict=True)
    ]
    still = [rig.base_from_tool(np.zeros(3), 4.0 + k, 2.0 * k) for k in range(8)]
    for poses in (about_one_axis, still):
        failure = calibrate_on_sphere(rig.stripes(poses, generator), DIAMETER_MM, QUICK)
        assert isinstance(failure, FitFailure)
        assert "hardly turns, or about one axis only" in failure.reason
    few = calibrate_on_sphere(rig.stripes(still[:2], generator), DIAMETER_MM, QUICK)
    assert isinstance(few, FitFailure)
    assert "2 postures" in few.reason


def test_a_constant_stand_off_leaves_two_hand_eyes() -> None:
    """Half a turn about the stripe, with the sphere on the other side of the sheet."""
    rig = SphereRig(pose_noise_mm=POSE_NOISE_MM, point_noise_mm=POINT_NOISE_MM)
    poses = turned_poses(rig, 12, depth_mm=0.0)
    failure = calibrate_on_sphere(
        rig.stripes(poses, np.random.default_rng(SEED)), DIAMETER_MM, QUICK
    )
    assert isinstance(failure, FitFailure)
    assert "two quite different hand-eyes" in failure.reason
    assert "vary the stand-off" in failure.remedy


def reposed(stripes: list[PosedStripe], poses: list[Pose[Base, Tool]]) -> list[PosedStripe]:
    return [
        replace(stripe, base_from_tool=pose) for stripe, pose in zip(stripes, poses, strict=True)
    ]


@pytest.mark.parametrize("seed", range(3))
def test_postures_in_a_wrong_order_are_refused_and_no_reading_is_blamed(seed: int) -> None:
    rig, rng = SphereRig(), np.random.default_rng(SEED + seed)
    stripes = rig.stripes(turned_poses(rig, 10), rng)
    poses = [stripes[k].base_from_tool for k in rng.permutation(10)]
    failure = calibrate_on_sphere(reposed(stripes, poses), DIAMETER_MM, QUICK)
    assert isinstance(failure, FitFailure)
    assert "would leave" not in failure.reason
    assert "convention of the arm's angles" in failure.remedy


def test_poses_of_the_next_exposure_are_named() -> None:
    rig = SphereRig()
    stripes = rig.stripes(turned_poses(rig, 10), np.random.default_rng(SEED))
    poses = [stripe.base_from_tool for stripe in stripes]
    failure = calibrate_on_sphere(reposed(stripes, poses[1:] + poses[:1]), DIAMETER_MM, QUICK)
    assert isinstance(failure, FitFailure)
    assert "giving each exposure the pose of the one before it would leave 0.0" in failure.reason
    assert "no pose is missing" in failure.remedy


@pytest.mark.parametrize(
    ("true", "read", "words", "advice"),
    [
        (
            "intrinsic-zxz",
            "extrinsic-xyz",
            "were read as extrinsic-xyz, reading them as intrinsic-zxz would leave 0.0",
            'rotation = "intrinsic-zxz"',
        ),
        (
            "extrinsic-xyz",
            "intrinsic-zxz",
            "were read as intrinsic-zxz, reading them as extrinsic-xyz would leave 0.0",
            'rotation = "extrinsic-xyz"',
        ),
        ("extrinsic-xyz", "intrinsic-zyx", "angles in the other order", "if intrinsic-zyx was"),
        ("intrinsic-zyx", "extrinsic-xyz", "angles in the other order", "convention intrinsic-zyx"),
    ],
)
def test_a_misread_convention_is_named(
    true: EulerConvention, read: EulerConvention, words: str, advice: str
) -> None:
    """Angles of the middle turn have both signs: of intrinsic-zxz one is written in two ways."""
    rig = SphereRig()
    stripes = rig.stripes(turned_poses(rig, 10), np.random.default_rng(SEED))
    angles = euler_from_rotations(np.array([s.base_from_tool.rotation for s in stripes]), true)
    poses = [
        Pose[Base, Tool](turn, stripe.base_from_tool.translation_mm)
        for turn, stripe in zip(rotations_from_euler(angles, read), stripes, strict=True)
    ]
    failure = calibrate_on_sphere(reposed(stripes, poses), DIAMETER_MM, QUICK)
    assert isinstance(failure, FitFailure)
    assert words in failure.reason
    assert advice in failure.remedy


def test_bad_input() -> None:
    rig = SphereRig()
    stripes = rig.stripes(turned_poses(rig, 4), np.random.default_rng(SEED))
    twice = [replace(stripe, posture="same") for stripe in stripes]
    with pytest.raises(InputError, match=r"'same' has different poses.* from p0 to p1"):
        calibrate_on_sphere(twice, DIAMETER_MM)
    with pytest.raises(OptionError, match="diameter in mm"):
        calibrate_on_sphere(stripes, 0.05)
    with pytest.raises(OptionError, match=r"below 0\.1 rad"):
        HandEyeOptions(arm_rotation_rad=1.0)
    with pytest.raises(OptionError, match="per_stripe is 2"):
        HandEyeOptions(per_stripe=2)
