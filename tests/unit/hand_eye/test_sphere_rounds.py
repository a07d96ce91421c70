# SPDX-License-Identifier: Apache-2.0
"""Rounds of scatter and solution on a sphere: swings settle, and none runs away.

A sphere of 50 mm seen from few postures with a sensor that is known to some tenths of a millimetre
to millimetres only: its error explains what moves all points off the sphere. The first four swung,
of 350 drawn so.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.hand_eye.estimate import HandEyeSolution, Problem, estimate
from armscan.calibration.hand_eye.observations import (
    HandEyeOptions,
    condense_sphere,
    find_sections,
)
from armscan.calibration.hand_eye.surface import HandEyeState, SphereSurface
from rigs.sphere_rig import CENTRE_MM, DIAMETER_MM, HAND_EYE, SphereRig, with_wrong_sensor

SENSOR = np.array([0.3, 0.3, 0.3, 5e-3, 5e-3])
RADIUS_MM = 0.5 * DIAMETER_MM


def drawn(seed: int, weakest: tuple[float, float]) -> Problem:
    """Arm, postures and sensor of a seed; the sensor known to a multiple of `SENSOR`."""
    rng = np.random.default_rng([9, seed])
    n = int(rng.integers(5, 9))
    arm_mm = float(np.exp(rng.uniform(np.log(0.005), np.log(0.2))))
    turned = rng.uniform(0.15, 0.6)
    lever_mm = float(rng.uniform(30.0, 300.0))
    rig = SphereRig(arm_mm, point_noise_mm=0.005, n_points=60, lever_mm=lever_mm)
    poses = [
        rig.base_from_tool(
            rng.uniform(-turned, turned, 3),
            float(rng.uniform(3.0, 16.0)) * float(rng.choice([-1, 1])),
            float(rng.uniform(-8.0, 8.0)),
            float(rng.uniform(-14.0, 14.0)),
        )
        for _ in range(n)
    ]
    sigma = SENSOR * float(np.exp(rng.uniform(*np.log(weakest))))
    wrong = sigma * rng.normal(size=5)
    stripes = with_wrong_sensor(rig.stripes(poses, rng), wrong)
    nodes = condense_sphere(find_sections(stripes, RADIUS_MM)[0], 10)
    nodes = replace(nodes, sensor_covariance=np.diag(sigma**2))
    return Problem(nodes, SphereSurface(RADIUS_MM), HandEyeOptions())


def solved(problem: Problem) -> HandEyeSolution:
    found = estimate(problem, HandEyeState(HAND_EYE, np.array([*CENTRE_MM, RADIUS_MM])))
    assert found is not None
    return found


@pytest.mark.parametrize("seed", [76, 90, 158, 186])
def test_scatter_and_solution_that_swing_settle_in_the_middle(seed: int) -> None:
    """They swung by more than 2 % of a scatter after twelve rounds.

    Settled is said of the scatter: a dozen rounds from there move the hand-eye by 0.2 of its sigmas
    and less, but by 0.5 with seeds 90 and 158 (by 0.6 to 2.7 in 5 of 71 draws from seed 60).
    """
    problem = drawn(seed, (0.03, 3.0))
    first = solved(problem)
    assert first.is_settled
    again = estimate(problem, first.state, first.noise.sigmas)
    assert again is not None
    moved = again.state.tool_from_sensor.step_from(first.state.tool_from_sensor)
    sigma = np.sqrt(np.diag(first.linear.covariance)[:6])
    assert np.abs(moved / sigma).max() < 0.6


def test_a_sensor_that_is_hardly_known_does_not_lead_a_small_sphere_away() -> None:
    """What it errs by moves the points by a part of the sphere's radius, and is solved for.

    Taken into the covariance, as linearised where the sensor is stored, it let the rounds run away:
    17 of these 40 settled, and their normalised squares had a mean of 83. Six are expected.
    """
    solutions = [solved(drawn(seed, (0.3, 12.0))) for seed in range(270, 310)]
    assert sum(one.is_settled for one in solutions) > 36
    squares = []
    for one in solutions:
        error = one.state.tool_from_sensor.step_from(HAND_EYE)
        squares.append(float(error @ np.linalg.solve(one.linear.covariance[:6, :6], error)))
    assert 3.5 < float(np.median(squares)) < 9.0
    assert float(np.mean(squares)) < 12.0
