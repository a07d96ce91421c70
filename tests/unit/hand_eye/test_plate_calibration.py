# SPDX-License-Identifier: Apache-2.0
"""The hand-eye on a plate: exact data, SciPy's optimum, leaving out, coupling to the sensor."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate
from armscan.calibration.hand_eye.estimate import Problem, estimate, minimise_distances
from armscan.calibration.hand_eye.observations import (
    HandEyeOptions,
    PlateReference,
    PosedStripe,
    condense_plate,
    straight_stripes,
)
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.hand_eye.search import linear_hand_eye
from armscan.calibration.hand_eye.surface import LEVER_MM, PlateSurface
from armscan.geometry.arrays import FloatArray
from rigs.plate_rig import SILENT, TOOL_FROM_SENSOR, PlateRig, RigNoise, good_postures

NOISE = RigNoise()
GIVEN = HandEyeOptions(
    arm_position_mm=float(np.hypot(NOISE.posture_mm, NOISE.exposure_mm)),
    arm_rotation_rad=float(np.hypot(NOISE.posture_rad, NOISE.exposure_rad)),
    plate_flatness_mm=NOISE.flatness_mm,
    stripe_noise_factor=1.0,
)


def _rig(count: int = 12, seed: int = 1, noise: RigNoise = NOISE) -> PlateRig:
    return PlateRig(good_postures(count, np.random.default_rng(seed)), noise)


def _fitted(
    stripes: list[PosedStripe], plate: PlateReference, options: HandEyeOptions = GIVEN
) -> HandEyeFit:
    fit = calibrate_on_plate(stripes, plate, options)
    assert isinstance(fit, HandEyeFit)
    return fit


def _error(fit: HandEyeFit) -> FloatArray:
    return fit.calibration.tool_from_sensor.step_from(TOOL_FROM_SENSOR)


@pytest.mark.parametrize("count", [5, 6, 12])
def test_exact_stripes_give_the_exact_hand_eye(count: int) -> None:
    fit = _fitted(*_rig(count, noise=SILENT).draw(0), HandEyeOptions())
    assert np.abs(_error(fit)).max() < 1e-9
    assert fit.calibration.rms_mm < 1e-9


@pytest.mark.parametrize("seed", [1, 2])
def test_no_parameter_is_known_worse_than_what_is_called_known_least(seed: int) -> None:
    """It is the worst direction of the stated covariance, in which the scatter's doubt is."""
    rig = _rig(6, seed=seed)
    fit = _fitted(*rig.draw(seed), HandEyeOptions(plate_flatness_mm=NOISE.flatness_mm))
    known = fit.calibration.diagnostics
    assert known is not None and known.is_noise_estimated and not known.is_arm_given
    for label, text in fit.reference:
        assert label[0].isupper() and " rad" not in text
    told = re.search(r"known to (\S+) mm", known.weakest)
    assert told is not None
    scale = np.array([LEVER_MM] * 3 + [1.0] * 3)
    stated = np.sqrt(np.diag(fit.calibration.covariance)) * scale
    worst = np.linalg.eigvalsh(fit.calibration.covariance * np.outer(scale, scale))[-1]
    assert float(told[1]) >= 0.995 * stated.max()
    assert float(told[1]) == pytest.approx(np.sqrt(worst), rel=0.01)


def test_a_bowed_sheet_spoils_the_start_but_not_the_result() -> None:
    """The start takes the sheet for a plane; the refinement takes the points as they are."""
    rig = replace(_rig(noise=SILENT), bow_mm=0.2)
    stripes, plate = rig.draw(0)
    fit = _fitted(stripes, plate, HandEyeOptions())
    assert 1e-4 < np.abs(fit.start.step_from(TOOL_FROM_SENSOR)).max() < 1.0
    assert np.abs(_error(fit)).max() < 1e-6


def test_two_crossed_sheets_are_used_together() -> None:
    """Points of two sheets are not in one plane: all 12 unknowns of eq. 2.73 are determined."""
    rig = _rig(6, noise=SILENT)
    stripes, plate = rig.draw(0)
    turned = replace(rig, sheet_turn_rad=0.5).draw(0)[0]
    both = [
        replace(
            one,
            points_mm=np.concatenate([one.points_mm, two.points_mm]),
            noise_mm=np.concatenate([one.noise_mm, two.noise_mm]),
            sheet=np.repeat([0, 1], [len(one), len(two)]),
        )
        for one, two in zip(stripes, turned, strict=True)
    ]
    nodes = condense_plate(both, straight_stripes(both), 8)
    start = linear_hand_eye(nodes, plate.plane)
    assert start is not None
    assert np.abs(start.step_from(TOOL_FROM_SENSOR)).max() < 1e-8
    assert np.abs(_error(_fitted(both, plate))).max() < 1e-8


def test_the_refinement_stops_where_scipy_does() -> None:
    """Independent oracle: whitened residuals handed to SciPy from another start.

    The solution is beside it by what the points' errors in the derivatives pull the least sum by.
    """
    stripes, plate = _rig().draw(4)
    nodes = condense_plate(stripes, straight_stripes(stripes), 12)
    problem = Problem(nodes, PlateSurface(plate), GIVEN)
    fit = estimate(problem, problem.start(TOOL_FROM_SENSOR))
    assert fit is not None
    covariance = fit.scatter + fit.known
    root = np.linalg.cholesky(covariance)
    least = minimise_distances(problem, fit.state, covariance)
    assert least is not None

    def whitened(step: FloatArray) -> FloatArray:
        residual = problem.place(problem.start(TOOL_FROM_SENSOR.retract(step))).residual_mm
        return np.asarray(solve_triangular(root, residual, lower=True))

    start = np.array([2e-3, -1e-3, 3e-3, 0.2, -0.3, 0.1])
    scale = np.array([1e-3] * 3 + [0.1] * 3)
    found = least_squares(whitened, start, x_scale=scale, method="lm", xtol=1e-14, ftol=1e-14)
    sigma = np.sqrt(np.diag(fit.linear.covariance))
    ours = least.state.tool_from_sensor.step_from(TOOL_FROM_SENSOR)
    assert np.abs((found.x - ours) / sigma).max() < 1e-3
    assert least.chi2 == pytest.approx(2.0 * found.cost, rel=1e-9)
    given = fit.state.tool_from_sensor.step_from(TOOL_FROM_SENSOR)
    assert np.abs((found.x - given) / sigma).max() < 1e-3
    differ = fit.linear.covariance - np.linalg.inv(found.jac.T @ found.jac)
    assert np.abs(differ / np.outer(sigma, sigma)).max() < 1e-3


def test_leaving_a_posture_out_is_predicted_without_solving_again() -> None:
    stripes, plate = _rig().draw(5)
    whole = _fitted(stripes, plate)
    name = whole.postures[3].posture
    rest = _fitted([s for s in stripes if s.posture != name], plate)
    change = rest.calibration.tool_from_sensor.step_from(whole.calibration.tool_from_sensor)
    stated = whole.postures[3]
    assert stated.left_out_rotation_deg == pytest.approx(
        np.degrees(np.linalg.norm(change[:3])), rel=0.02
    )
    assert stated.left_out_translation_mm == pytest.approx(np.linalg.norm(change[3:]), rel=0.02)


def test_the_coupling_is_what_a_changed_sensor_does() -> None:
    """Derivative of the solution by the sensor's parameters, against solving with moved points."""
    stripes, plate = _rig().draw(6)
    by_shift = [
        replace(s, dpoint_dsensor=np.stack([np.tile(v, (len(s), 1)) for v in np.eye(3)], axis=2))
        for s in stripes
    ]
    fit = _fitted(by_shift, plate)
    coupling = fit.calibration.dhand_eye_dsensor
    assert coupling is not None
    for k, step in enumerate(1e-3 * np.eye(3)):
        moved = _fitted([replace(s, points_mm=s.points_mm + step) for s in stripes], plate)
        change = moved.calibration.tool_from_sensor.step_from(fit.calibration.tool_from_sensor)
        np.testing.assert_allclose(coupling[:, k] * 1e-3, change, atol=2e-6)


def test_errors_of_the_sensor_are_weighted_but_not_stated() -> None:
    """A sensor that may be shifted makes the hand-eye no less certain: it shifts against it."""
    stripes, plate = _rig().draw(6)
    by_shift = [
        replace(s, dpoint_dsensor=np.stack([np.tile(v, (len(s), 1)) for v in np.eye(3)], axis=2))
        for s in stripes
    ]
    exact = _fitted(by_shift, plate)
    fit = calibrate_on_plate(by_shift, plate, GIVEN, sensor_covariance=0.01 * np.eye(3))
    assert isinstance(fit, HandEyeFit)
    sigma = np.sqrt(np.diag(exact.calibration.covariance))
    np.testing.assert_allclose(np.sqrt(np.diag(fit.calibration.covariance)), sigma, rtol=1e-3)
    assert np.abs(_error(fit) - _error(exact)).max() < 1e-2 * sigma.max()


def test_a_plate_solved_along_needs_no_probing() -> None:
    """With the plane free the offset of the given one does not matter."""
    stripes, plate = _rig(noise=SILENT).draw(0)
    plane = replace(plate.plane, point_mm=plate.plane.point_mm + 0.4 * plate.plane.normal)
    fit = _fitted(stripes, replace(plate, plane=plane), HandEyeOptions(solve_plate=True))
    assert np.abs(_error(fit)).max() < 1e-8
    found = fit.calibration.plate
    assert found is not None
    assert abs(float(found.distance_mm(plate.plane.point_mm[None])[0])) < 1e-8


def test_tilts_of_postures_are_those_of_the_rig() -> None:
    postures = good_postures(6, np.random.default_rng(3))
    drawn = PlateRig(postures, points_per_stripe=40).draw(1)
    fit = calibrate_on_plate(*drawn, HandEyeOptions(arm_position_mm=0.006))
    assert isinstance(fit, HandEyeFit)
    told = [posture.tilt_deg for posture in fit.postures]
    assert told == pytest.approx(np.degrees(postures.tilt), abs=0.2)
