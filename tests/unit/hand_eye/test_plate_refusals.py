# SPDX-License-Identifier: Apache-2.0
"""Postures, poses, planes and points that are wrong: refused or warned of in words that help."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.hand_eye.alternatives import freedom_of
from armscan.calibration.hand_eye.calibrate import calibrate_on_plate
from armscan.calibration.hand_eye.checks import influence_warnings
from armscan.calibration.hand_eye.estimate import LeftOut
from armscan.calibration.hand_eye.noise import (
    NoiseComponent,
    NoiseEstimate,
    total_covariance,
)
from armscan.calibration.hand_eye.observations import (
    HandEyeOptions,
    PlateReference,
    PosedStripe,
)
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.errors import OptionError
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import (
    EulerConvention,
    euler_from_rotations,
    rotation_from_vector,
    rotations_from_euler,
)
from armscan.geometry.shapes import Plane
from rigs.instrument_arm import run_hand_eye
from rigs.instrument_stages import Outcome, run_camera, run_sheets
from rigs.instruments import draw_instrument
from rigs.plate_rig import (
    PLATE_NORMAL,
    SILENT,
    TOOL_FROM_SENSOR,
    PlateRig,
    Postures,
    RigNoise,
    good_postures,
)
from rigs.sheet_rig import PROVENANCE

N = 12
ARM_MM = 0.0053
CHI2_999 = 22.46
"""Of six degrees of freedom."""
Repose = Callable[[Pose[Base, Tool]], Pose[Base, Tool]]


def _scan() -> tuple[list[PosedStripe], PlateReference]:
    return PlateRig(good_postures(N, np.random.default_rng(1))).draw(1)


def _reposed(stripes: list[PosedStripe], change: Repose) -> list[PosedStripe]:
    return [replace(s, base_from_tool=change(s.base_from_tool)) for s in stripes]


def _raised(plate: PlateReference, by_mm: float) -> PlateReference:
    point = plate.plane.point_mm + by_mm * plate.plane.normal
    return replace(plate, plane=Plane(point, plate.plane.axes))


def _error_mm(fit: HandEyeFit | FitFailure) -> float:
    assert isinstance(fit, HandEyeFit)
    found = fit.calibration.tool_from_sensor.step_from(TOOL_FROM_SENSOR)
    return float(np.linalg.norm(found[3:]))


def _postures(tilt_deg: np.ndarray, azimuth: np.ndarray, roll: np.ndarray) -> Postures:
    place = np.random.default_rng(2).uniform(-80.0, 80.0, (N, 2))
    return Postures(np.radians(tilt_deg), azimuth, roll, np.full(N, 140.0), place)


ROUND = 2.0 * np.pi * np.arange(N) / N
SWING = np.linspace(-40.0, 40.0, N)


@pytest.mark.parametrize(
    ("postures", "cause"),
    [
        (_postures(np.full(N, 20.0), np.ones(N), np.zeros(N)), "never turned"),
        (_postures(np.zeros(N), np.zeros(N), ROUND), "about the plate's normal only"),
    ],
)
def test_postures_that_leave_parameters_open_are_refused(postures: Postures, cause: str) -> None:
    """FINDINGS 5: without turning against the plate the system has rank 2 or 3."""
    fit = calibrate_on_plate(*PlateRig(postures).draw(0))
    assert isinstance(fit, FitFailure)
    assert cause in fit.reason and "of the hand-eye's 6 parameters" in fit.reason
    assert "tilt the head" in fit.remedy


def test_one_azimuth_plane_is_solved_and_warned_of() -> None:
    """The nine linear unknowns are not determined at a fixed stand-off, the six are."""
    rig = PlateRig(_postures(SWING, np.zeros(N), np.zeros(N)), SILENT)
    fit = calibrate_on_plate(*rig.draw(0))
    assert _error_mm(fit) < 1e-6
    assert isinstance(fit, HandEyeFit)
    assert any("one azimuth plane only" in w and "stand-off" in w for w in fit.warnings)


def test_two_azimuth_planes_are_better_conditioned_than_one() -> None:
    one = calibrate_on_plate(*PlateRig(_postures(SWING, np.zeros(N), np.zeros(N))).draw(0))
    azimuth = np.repeat([0.0, np.pi / 2.0], N // 2)
    two = calibrate_on_plate(*PlateRig(_postures(SWING, azimuth, np.zeros(N))).draw(0))
    assert isinstance(one, HandEyeFit) and isinstance(two, HandEyeFit)
    conditions = [fit.calibration.diagnostics for fit in (one, two)]
    assert conditions[0] is not None and conditions[1] is not None
    assert conditions[0].condition > 3.0 * conditions[1].condition


@pytest.mark.parametrize(("count", "is_refused"), [(2, True), (5, False)])
def test_few_postures_are_refused_or_warned_of(count: int, is_refused: bool) -> None:
    rig = PlateRig(good_postures(count, np.random.default_rng(4)))
    fit = calibrate_on_plate(*rig.draw(0))
    assert isinstance(fit, FitFailure) is is_refused
    words = fit.reason if isinstance(fit, FitFailure) else " ".join(fit.warnings)
    assert f"{count} postures" in words


def _euler(pose: Pose[Base, Tool]) -> Pose[Base, Tool]:
    angles = euler_from_rotations(pose.rotation[None], "intrinsic-xyz")
    return Pose(rotations_from_euler(angles, "extrinsic-xyz")[0], pose.translation_mm)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_euler, "reading them as intrinsic-xyz would leave 0.00"),
        (lambda pose: Pose(pose.rotation, 1e-3 * pose.translation_mm), "translations in metres"),
        (lambda pose: pose.inverse(), "taking the poses as tool_from_base"),
    ],
)
def test_misread_poses_are_refused_with_the_reading_that_fits(change: Repose, words: str) -> None:
    stripes, plate = _scan()
    fit = calibrate_on_plate(_reposed(stripes, change), plate)
    assert isinstance(fit, FitFailure)
    assert "no hand-eye fits" in fit.reason and words in fit.reason and fit.remedy


@pytest.mark.parametrize("read", ["intrinsic-xyz", "extrinsic-xyz"])
def test_a_misread_convention_is_named_before_the_plate_is_blamed(read: EulerConvention) -> None:
    """The plane left free takes up 90 % of it, tilted and shifted as no plate is probed."""
    stripes, plate = PlateRig(good_postures(8, np.random.default_rng(1))).draw(1)

    def change(pose: Pose[Base, Tool]) -> Pose[Base, Tool]:
        angles = euler_from_rotations(pose.rotation[None], "intrinsic-zxz")
        return Pose(rotations_from_euler(angles, read)[0], pose.translation_mm)

    fit = calibrate_on_plate(_reposed(stripes, change), plate)
    assert isinstance(fit, FitFailure)
    assert f"read as {read}, reading them as intrinsic-zxz would leave 0.00" in fit.reason
    assert 'rotation = "intrinsic-zxz"' in fit.remedy and "probe" not in fit.remedy


def test_a_posture_that_the_hand_eye_rests_on_is_named() -> None:
    """Sigmas of 0.01: a move by 6 of them in one parameter is named, one by 4 is not."""
    names = [f"posture{k:02d}" for k in range(N)]
    left = {
        k: LeftOut(change=size * np.eye(9)[4], normalised=1.0, pose_sigmas=1.0, probability=1.0)
        for k, size in ((3, 0.04), (11, -0.06))
    }
    (warning,) = influence_warnings(names, left, 1e-4 * np.eye(6))
    assert "without posture posture11" in warning and "by 6 of its stated sigmas" in warning


def test_poses_shifted_by_one_exposure_are_recognised() -> None:
    stripes, plate = _scan()
    poses = [s.base_from_tool for s in stripes]
    shifted = [
        replace(s, base_from_tool=pose)
        for s, pose in zip(stripes, poses[1:] + poses[:1], strict=True)
    ]
    fit = calibrate_on_plate(shifted, plate)
    assert isinstance(fit, FitFailure)
    assert "the pose of the one before it" in fit.reason


def test_swapped_poses_are_named_and_left_out() -> None:
    stripes, plate = _scan()
    swapped = list(stripes)
    swapped[3] = replace(stripes[3], base_from_tool=stripes[7].base_from_tool)
    swapped[7] = replace(stripes[7], base_from_tool=stripes[3].base_from_tool)
    fit = calibrate_on_plate(swapped, plate)
    assert _error_mm(fit) < 5.0 * ARM_MM
    assert isinstance(fit, HandEyeFit)
    named = next(w for w in fit.warnings if "left out 2 postures" in w)
    assert "posture03" in named and "posture07" in named
    assert fit.calibration.n_postures == N - 2


def test_a_slightly_wrong_pose_is_left_out_too() -> None:
    """Eight sigmas of the arm: far too little for the start, plain against the others' scatter."""
    stripes, plate = _scan()
    pose = stripes[4].base_from_tool
    raised = pose.translation_mm + 8.0 * ARM_MM * PLATE_NORMAL
    moved: Pose[Base, Tool] = Pose(pose.rotation, raised)
    wrong = [*stripes[:4], replace(stripes[4], base_from_tool=moved), *stripes[5:]]
    fit = calibrate_on_plate(wrong, plate)
    assert isinstance(fit, HandEyeFit)
    assert any("posture04" in w and "worse than their scatter" in w for w in fit.warnings)


def test_good_data_are_not_warned_of() -> None:
    fit = calibrate_on_plate(*_scan())
    assert isinstance(fit, HandEyeFit)
    assert fit.warnings == ()


@pytest.mark.parametrize(
    ("offset_mm", "what"), [(6.0, "the tip's diameter"), (3.0, "the tip's radius")]
)
def test_a_plate_probed_on_the_wrong_side_is_refused(offset_mm: float, what: str) -> None:
    stripes, plate = _scan()
    fit = calibrate_on_plate(stripes, replace(_raised(plate, offset_mm), tip_diameter_mm=6.0))
    assert isinstance(fit, FitFailure)
    assert what in fit.reason and "below the probed one" in fit.reason
    assert "armscan probe --side" in fit.remedy


@pytest.mark.parametrize("by_mm", [0.15, 0.5, -0.5])
def test_a_plate_that_moved_after_probing_is_refused_with_its_distance(by_mm: float) -> None:
    stripes, plate = _scan()
    fit = calibrate_on_plate(stripes, _raised(plate, by_mm))
    assert isinstance(fit, FitFailure)
    assert "disagree" in fit.reason and "--solve-plate" in fit.remedy
    distance = float(fit.reason.split("lies ")[1].split(" mm")[0])
    assert distance == pytest.approx(abs(by_mm), abs=0.06)
    assert ("below" in fit.reason) == (by_mm > 0.0)


@pytest.mark.parametrize("by_mm", [0.5, 5.0])
def test_a_moved_plate_that_is_solved_along_is_held_by_the_stated_covariance(by_mm: float) -> None:
    """The plane that is given is a start only, and what is shown is the one that was found."""
    stripes, plate = _scan()
    fit = calibrate_on_plate(stripes, _raised(plate, by_mm), HandEyeOptions(solve_plate=True))
    assert isinstance(fit, HandEyeFit)
    given = np.array(plate.plane.coefficients)
    shown = dict(fit.reference)["Plate"].replace("- ", "-").replace("+ ", "+").split()
    assert [float(shown[k]) for k in (0, 2, 4, 6)] == pytest.approx(given, abs=0.2)
    error = fit.calibration.tool_from_sensor.step_from(TOOL_FROM_SENSOR)
    assert error @ np.linalg.solve(fit.calibration.covariance, error) < CHI2_999


@pytest.mark.parametrize("tilt_deg", [0.05, 0.2, 0.5])
def test_a_tilted_plate_is_named(tilt_deg: float) -> None:
    """Below a twentieth of a millimetre it is said and held by the sigmas, above it is refused."""
    stripes, plate = _scan()
    turn = rotation_from_vector(np.array([np.radians(tilt_deg), 0.0, 0.0]))
    tilted = Plane(plate.plane.point_mm, plate.plane.axes @ turn.T)
    fit = calibrate_on_plate(stripes, replace(plate, plane=tilted))
    words = fit.reason if isinstance(fit, FitFailure) else " ".join(fit.warnings)
    assert "probed plane and scan disagree" in words
    assert float(words.split("tilted by ")[1].split(" deg")[0]) == pytest.approx(tilt_deg, rel=0.2)
    if isinstance(fit, HandEyeFit):
        error = fit.calibration.tool_from_sensor.step_from(TOOL_FROM_SENSOR)
        assert error @ np.linalg.solve(fit.calibration.covariance, error) < CHI2_999
    else:
        assert tilt_deg > 0.1


@pytest.mark.parametrize(("shift_mm", "first"), [(0.1, 6), (1.0, 6), (1.0, 8), (4.0, 6)])
def test_an_arm_that_was_referenced_anew_is_refused_with_the_posture(
    shift_mm: float, first: int
) -> None:
    stripes, plate = _scan()
    shift = shift_mm * PLATE_NORMAL
    late = [
        s
        if k < first
        else replace(
            s,
            base_from_tool=Pose(s.base_from_tool.rotation, s.base_from_tool.translation_mm + shift),
        )
        for k, s in enumerate(stripes)
    ]
    fit = calibrate_on_plate(late, plate)
    assert isinstance(fit, FitFailure)
    assert f"up to posture{first - 1:02d} and those from posture{first:02d} on" in fit.reason


def test_a_sensor_of_the_wrong_scale_is_refused_with_its_scale() -> None:
    """A light sheet 1 mm from where it was calibrated: points 1.09 % farther out."""
    stripes, plate = _scan()
    larger = [replace(s, points_mm=1.0109 * s.points_mm) for s in stripes]
    fit = calibrate_on_plate(larger, plate)
    assert isinstance(fit, FitFailure)
    assert "sensor's calibration" in fit.reason
    assert float(fit.reason.split("large by ")[1].split(" %")[0]) == pytest.approx(1.08, abs=0.1)


def _mirrored(pose: Pose[Base, Tool], axis: int) -> Pose[Base, Tool]:
    mirror = np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))
    return Pose(mirror @ pose.rotation @ mirror, mirror @ pose.translation_mm)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_left_handed_poses_are_refused_by_name(axis: int) -> None:
    stripes, plate = PlateRig(good_postures(N, np.random.default_rng(1)), form_mm=0.2).draw(1)
    fit = calibrate_on_plate(_reposed(stripes, lambda pose: _mirrored(pose, axis)), plate)
    assert isinstance(fit, FitFailure)
    assert "left-handed" in fit.reason and f"{'xyz'[axis]} pointing the other way" in fit.reason


def test_left_handed_poses_and_plate_are_told_by_the_sheets_bow() -> None:
    rig = PlateRig(good_postures(N, np.random.default_rng(1)), form_mm=0.2)
    stripes, plate = rig.draw(1)
    mirror = np.diag([1.0, -1.0, 1.0])
    axes = plate.plane.axes @ mirror * np.array([[-1.0], [1.0], [1.0]])
    there = replace(plate, plane=Plane(mirror @ plate.plane.point_mm, axes))
    fit = calibrate_on_plate(_reposed(stripes, lambda pose: _mirrored(pose, 1)), there)
    assert isinstance(fit, FitFailure)
    assert "poses and plate were left-handed" in fit.reason


@pytest.mark.parametrize(("axis", "name"), [(0, "left and right"), (1, "top and bottom")])
def test_mirrored_images_are_refused_by_name(axis: int, name: str) -> None:
    """Their middle is not the camera's: it is sought along."""
    rig = PlateRig(good_postures(N, np.random.default_rng(1)), form_mm=0.2)
    stripes, plate = rig.draw(1)
    reversed_ = []
    for stripe in stripes:
        points = stripe.points_mm.copy()
        points[:, axis] = 0.01 * points[:, 2] - points[:, axis]
        reversed_.append(replace(stripe, points_mm=rig.on_sheet(points)))
    fit = calibrate_on_plate(reversed_, plate)
    assert isinstance(fit, FitFailure)
    assert f"if {name} of the images were exchanged" in fit.reason


def test_a_scatter_that_no_arm_has_is_refused_unless_it_was_given() -> None:
    """The limit on the rms, raised, does not let it pass either."""
    noise = RigNoise(posture_mm=0.6, posture_rad=0.6 / 265.0)
    stripes, plate = PlateRig(good_postures(24, np.random.default_rng(1)), noise).draw(1)
    fit = calibrate_on_plate(stripes, plate, HandEyeOptions(max_rms_mm=2.0))
    assert isinstance(fit, FitFailure)
    assert "--arm-position-mm" in fit.remedy
    given = HandEyeOptions(max_rms_mm=2.0, arm_position_mm=0.6)
    assert isinstance(calibrate_on_plate(stripes, plate, given), HandEyeFit)


def test_words_about_the_plane_follow_its_test() -> None:
    """One fact states how well the stripes alone confirm the plane, whatever the outcome."""
    stripes, plate = _scan()
    clean = calibrate_on_plate(stripes, plate)
    turn = rotation_from_vector(np.array([np.radians(0.03), 0.0, 0.0]))
    tilted = replace(plate, plane=Plane(plate.plane.point_mm, plate.plane.axes @ turn.T))
    off = calibrate_on_plate(stripes, tilted)
    assert isinstance(clean, HandEyeFit) and isinstance(off, HandEyeFit)
    assert "agree with it" in dict(clean.reference)["Plane, checked"]
    assert "contradict it" in dict(off.reference)["Plane, checked"]


def test_a_plate_without_covariance_is_not_said_to_be_coefficients() -> None:
    stripes, plate = _scan()
    said = {}
    for n_points in (0, plate.n_points):
        fit = calibrate_on_plate(stripes, replace(plate, covariance=None, n_points=n_points))
        assert isinstance(fit, HandEyeFit)
        said[n_points] = dict(fit.reference)["Plane"]
    assert "only A, B, C, D were given" in said[0]
    assert "probed plate's uncertainty is not known" in said[plate.n_points]


def test_a_plate_seen_from_behind_is_warned_of() -> None:
    stripes, plate = _scan()
    turned = Plane(plate.plane.point_mm, plate.plane.axes * np.array([[1.0], [-1.0], [-1.0]]))
    fit = calibrate_on_plate(stripes, replace(plate, plane=turned))
    assert isinstance(fit, HandEyeFit)
    assert any("points away from the scanner" in w for w in fit.warnings)


def test_points_beyond_the_plate_are_left_out_and_counted() -> None:
    """A third of every stripe lies on the table, 12 mm under the plate."""
    stripes, plate = _scan()
    spoiled = []
    for stripe in stripes:
        points = stripe.points_mm.copy()
        points[:50] += 12.0 * np.array([0.0, 0.68, 0.73])
        spoiled.append(replace(stripe, points_mm=points))
    fit = calibrate_on_plate(spoiled, plate)
    assert _error_mm(fit) < 6.0 * ARM_MM
    assert isinstance(fit, HandEyeFit)
    assert fit.calibration.n_points == pytest.approx(N * 100, abs=2 * N)
    assert any("are not on straight stripes" in w for w in fit.warnings)


@pytest.mark.parametrize(
    "option",
    [{"arm_rotation_rad": 0.5}, {"plate_flatness_mm": -1.0}, {"per_stripe": 1}],
)
def test_impossible_options_are_refused(option: dict[str, float]) -> None:
    with pytest.raises(OptionError):
        HandEyeOptions(**option)


def test_a_refusal_also_says_that_the_stripes_are_not_straight() -> None:
    """Bowed stripes of a bad sensor are named beside whatever else is wrong."""
    stripes, plate = PlateRig(
        _postures(np.full(N, 20.0), np.ones(N), np.zeros(N)), points_per_stripe=150
    ).draw(0)
    along = np.linspace(-1.0, 1.0, 150)
    bowed = [
        replace(s, points_mm=s.points_mm + np.outer(4.0 * np.abs(along), [0.0, 0.68, 0.73]))
        for s in stripes
    ]
    fit = calibrate_on_plate(bowed, plate)
    assert isinstance(fit, FitFailure)
    assert "are not on straight stripes" in fit.reason


def test_stripes_that_shrink_to_a_point_contradict_no_sensor() -> None:
    """A sound head of 30 mm field on an arm of 0.12 mm, refused for a sheet shifted by 57 mm.

    Shifted on to the camera, the sheet left no scatter at all: likelier than any other explanation.
    """
    outcome = _drawn_hand_eye(3139)
    assert outcome.result == "right"
    assert not any("sensor's calibration" in warning for warning in outcome.warnings)


def _drawn_hand_eye(seed: int) -> Outcome:
    made = draw_instrument(seed)
    camera = run_camera(made)
    sheets = run_sheets(made, camera.calibration, camera.information)
    assert sheets.fit is not None
    sensor = sheets.fit.to_calibration(PROVENANCE)
    n_lines = min(2 if made.is_crossed else 1, len(sheets.names))
    lights = {k: made.lights[sheets.names[k]] for k in range(n_lines)}
    return run_hand_eye(made, sensor, lights, on_sphere=False)


@pytest.mark.parametrize("seed", [5500057, 4500211])
def test_scatter_that_few_numbers_tell_contradicts_no_sensor(seed: int) -> None:
    """Sound heads that were refused for points 1.9 % too large, at ten and five sigmas.

    The sigmas rested on the arm's shift, which 3 and 7 numbers tell of the 5 and 11 that were
    counted.
    """
    assert _drawn_hand_eye(seed).result == "right"


@pytest.mark.parametrize("seed", [6100122, 6100165])
def test_hand_eyes_are_compared_by_all_that_the_stripes_show(seed: int) -> None:
    """Hardly tilted heads; another hand-eye, 50 and 18 degrees off, is 3,300 and 1,380 times less
    likely. By three points of each stripe it was 360 and 170 times, and both were refused.
    """
    assert _drawn_hand_eye(seed).result == "right"


def test_an_unknown_is_judged_by_the_numbers_that_tell_its_own_scatter() -> None:
    """A variance of n numbers has a logarithm of variance 2 / n, that of its sigma a quarter.

    Two causes in shares a and b of n and m numbers: (a + b)^2 / (a^2 / n + b^2 / m)
    (Satterthwaite). A scatter that is given has no end of them.
    """
    one, other = np.diag([1.0, 1.0, 0.0, 0.0]), np.diag([0.0, 0.0, 1.0, 1.0])
    components = (NoiseComponent("arm", one, 2.0), NoiseComponent("flatness", other, 3.0))
    sigmas, n, m = np.array([2.0, 3.0]), 5.0, 8.0
    noise = NoiseEstimate(sigmas, np.diag([0.5 / n, 0.5 / m]))
    total = total_covariance(components, sigmas)

    def freedom(gain: list[list[float]], known: NoiseEstimate = noise) -> float:
        rows = np.array(gain)
        return freedom_of(components, known, rows, rows @ total @ rows.T)

    assert freedom([[1.0, 0.5, 0.0, 0.0]]) == pytest.approx(n)
    assert freedom([[0.0, 0.0, 0.3, 0.1]]) == pytest.approx(m)
    shared = (4.0 + 9.0) ** 2 / (4.0**2 / n + 9.0**2 / m)
    assert freedom([[1.0, 0.0, 1.0, 0.0]]) == pytest.approx(shared)
    assert freedom([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]) == pytest.approx(n)
    alike = NoiseEstimate(sigmas, np.array([[0.5 / n, 0.03], [0.03, 0.5 / m]]))
    spread = 4.0**2 / n + 9.0**2 / m + 4.0 * 4.0 * 9.0 * 0.03
    assert freedom([[1.0, 0.0, 1.0, 0.0]], alike) == pytest.approx((4.0 + 9.0) ** 2 / spread)
    given = NoiseEstimate(sigmas, np.zeros((2, 2)))
    assert freedom([[1.0, 0.0, 0.0, 0.0]], given) > 1e9

    def of_both(n: float, m: float) -> float:
        each = NoiseEstimate(sigmas, np.diag([0.5 / n, 0.5 / m]))
        return freedom([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]], each)

    # means of F statistics of 5 and 8 numbers: 5/3 + 8/6 = 3 = 2 f / (f - 2) of f = 6
    assert of_both(5.0, 8.0) == pytest.approx(6.0)
    # one that has no mean tells no more beside others that have
    assert of_both(1.5, 3.9) == pytest.approx(1.5)
    assert of_both(1.99, 3.99) == pytest.approx(1.99)
