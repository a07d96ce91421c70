# SPDX-License-Identifier: Apache-2.0
"""Hand-eyes of postures that hardly tilt: what the points' own errors may not do to them.

All points of a light sheet lie in it, whatever they err by. A hand-eye that turns it into the plate
has all of them on the plate.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.hand_eye import estimate as estimator
from armscan.calibration.hand_eye.estimate import (
    HandEyeSolution,
    Problem,
    estimate,
    joint_covariance,
    minimise_distances,
)
from armscan.calibration.hand_eye.observations import (
    CondensedObservations,
    HandEyeOptions,
    PlateReference,
    PosedStripe,
    condense_plate,
    straight_stripes,
)
from armscan.calibration.hand_eye.surface import PlateSurface, smooth_along_stripes
from armscan.geometry.arrays import FloatArray
from rigs.plate_rig import TOOL_FROM_SENSOR, PlateRig, Postures, RigNoise

SETTLED_SIGMAS = 0.01


def drawn(
    seed: int,
    tilt_deg: float,
    count: int,
    *,
    stripe_mm: float,
    arm_mm: float,
    half_stripe_mm: float,
    span_mm: float,
    n_points: int = 24,
) -> tuple[list[PosedStripe], PlateReference]:
    """Short noisy stripes from postures that tilt by up to an angle."""
    rng = np.random.default_rng(seed)
    postures = Postures(
        np.radians(rng.uniform(0.0, tilt_deg, count)),
        rng.uniform(0.0, 2.0 * np.pi, count),
        rng.uniform(-3.0, 3.0, count),
        141.0 + rng.uniform(-span_mm, span_mm, count),
        rng.uniform(-80.0, 80.0, (count, 2)),
    )
    noise = RigNoise(arm_mm, arm_mm / 100.0, 0.3 * arm_mm, 0.003 * arm_mm, 0.003, stripe_mm, 0.005)
    rig = PlateRig(postures, noise, points_per_stripe=n_points, half_stripe_mm=half_stripe_mm)
    return rig.draw(seed)


def problem_of(
    stripes: list[PosedStripe], plate: PlateReference, options: HandEyeOptions | None = None
) -> Problem:
    condensed = condense_plate(stripes, straight_stripes(stripes), 12)
    return Problem(condensed, PlateSurface(plate), options or HandEyeOptions())


def solved(problem: Problem) -> HandEyeSolution:
    found = estimate(problem, problem.start(TOOL_FROM_SENSOR))
    assert found is not None
    return found


def short(seed: int, tilt_deg: float) -> Problem:
    """Seven postures, stripes of 8 mm that scatter by 0.1 mm."""
    given = {"stripe_mm": 0.1, "arm_mm": 0.1, "half_stripe_mm": 4.0, "span_mm": 5.0}
    return problem_of(*drawn(seed, tilt_deg, 7, **given))


def open_sigmas(solution: HandEyeSolution) -> float:
    """Of the step that is left, jointly."""
    step, covariance = solution.linear.step, solution.linear.covariance
    return float(np.sqrt(step @ np.linalg.solve(covariance, step)))


@pytest.mark.parametrize("seed", [1000, 1015, 1018, 1020, 1024, 1036, 1044])
@pytest.mark.parametrize("tilt_deg", [2.0, 3.0])
def test_stripes_do_not_lose_their_scatter_to_the_arm(seed: int, tilt_deg: float) -> None:
    """With the scatter estimated at the least sum of squares 1018, 1024 and 1044 had stripes of a
    thousandth of theirs and an arm of 0.5 mm and more, 1000 and 1015 no minimum. The steps' end was
    asked for parameter by parameter: 0.7 sigma of all together were left of 1036. Undamped, the
    steps of 1020 alternate.
    """
    found = solved(short(seed, tilt_deg))
    assert found.is_settled
    assert open_sigmas(found) < SETTLED_SIGMAS
    assert 0.7 < found.sigma_of("stripe") < 1.4
    assert found.sigma_of("arm") < 0.5


def test_points_do_not_pull_the_hand_eye() -> None:
    """Ten postures of up to 3 degrees, the scatter given: squares of the error over its covariance.

    They are 6 on the average if the covariance is right, give or take 0.5; of the least sum of
    squares they are a third more.
    """
    options = HandEyeOptions(
        arm_position_mm=0.05 * float(np.hypot(1.0, 0.3)),
        arm_rotation_rad=0.0005 * float(np.hypot(1.0, 0.3)),
        plate_flatness_mm=0.003,
        stripe_noise_factor=1.0,
    )
    squares = []
    for seed in range(50):
        problem = problem_of(
            *drawn(seed, 3.0, 10, stripe_mm=0.08, arm_mm=0.05, half_stripe_mm=8.0, span_mm=5.0),
            options,
        )
        found = solved(problem)
        least = minimise_distances(problem, found.state, found.scatter + found.known)
        assert least is not None
        inverse = np.linalg.inv(joint_covariance(found).hand_eye)
        errors = [
            state.tool_from_sensor.step_from(TOOL_FROM_SENSOR)
            for state in (found.state, least.state)
        ]
        squares.append([error @ inverse @ error for error in errors])
    ours, pulled = np.mean(squares, axis=0)
    assert ours < 7.5
    assert pulled > 1.2 * ours


def with_scale(stripes: list[PosedStripe]) -> list[PosedStripe]:
    """A sensor that errs by one number: its scale."""
    return [replace(one, dpoint_dsensor=one.points_mm[:, :, None]) for one in stripes]


def test_the_sensor_is_moved_to_where_the_distances_ask_for_it() -> None:
    """``-S B' P e``, the most likely error of a sensor with covariance S, at the end of the steps.

    P e from the covariance as it stands, by dense matrices.
    """
    given = {"stripe_mm": 0.06, "arm_mm": 0.05, "half_stripe_mm": 8.0, "span_mm": 8.0}
    stripes, plate = drawn(3, 8.0, 9, **given)
    problem = problem_of(with_scale(stripes), plate)
    known = np.array([[1e-4]])
    problem = replace(problem, observations=replace(problem.observations, sensor_covariance=known))
    found = solved(problem)
    by_sensor = found.placed.by_sensor
    assert by_sensor is not None and found.state.sensor is not None
    inverse = np.linalg.inv(found.scatter + found.known)
    smooth = found.jacobian
    weighed = inverse @ smooth
    projected = inverse - weighed @ np.linalg.solve(smooth.T @ weighed, weighed.T)
    likeliest = -known @ by_sensor.T @ projected @ found.placed.residual_mm
    assert abs(float(likeliest[0])) > 1e-4
    np.testing.assert_allclose(found.state.sensor, likeliest, atol=1e-3 * np.sqrt(known[0, 0]))


def test_steps_that_come_to_no_end_leave_the_least_sum_and_say_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(estimator, "PULL_STEPS", 1)
    problem = short(1036, 3.0)
    found = solved(problem)
    assert not found.is_settled
    least = minimise_distances(problem, found.state, found.scatter + found.known)
    assert least is not None
    moved = least.state.tool_from_sensor.step_from(found.state.tool_from_sensor)
    assert np.abs(moved / np.sqrt(np.diag(found.linear.covariance)[:6])).max() < 1e-3


def one_line(count: int) -> CondensedObservations:
    """The first observations of one of the lines of the rig."""
    condensed = short(1000, 3.0).observations
    return condensed.select(np.arange(len(condensed)) < count)


@pytest.mark.parametrize(("count", "kept"), [(3, 2 / 3), (4, 2 / 4), (5, 3 / 5), (12, 3 / 12)])
def test_a_line_keeps_the_errors_of_two_or_three_numbers(count: int, kept: float) -> None:
    """A straight line's two below five observations, else a parabola's three, which are kept."""
    line = one_line(count)
    smoothing = smooth_along_stripes(line, np.eye(count))
    assert np.trace(smoothing) / count == pytest.approx(kept, abs=1e-9)
    along = np.linalg.norm(line.points_mm - line.points_mm[0], axis=1)
    shapes = np.column_stack([np.ones(count), along, along**2][: 2 + (count >= 5)])
    np.testing.assert_allclose(smoothing @ shapes, shapes, atol=1e-9 * shapes.max())


def test_two_sheets_of_an_exposure_are_two_lines() -> None:
    whole: CondensedObservations = short(1000, 3.0).observations
    sheet = (whole.stripe % 2).astype(whole.sheet.dtype)
    pairs = replace(whole, stripe=whole.stripe // 2, sheet=sheet)
    values: FloatArray = np.random.default_rng(3).normal(size=(len(whole), 4))
    np.testing.assert_allclose(
        smooth_along_stripes(pairs, values), smooth_along_stripes(whole, values), atol=1e-12
    )
