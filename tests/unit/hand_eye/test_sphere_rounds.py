# SPDX-License-Identifier: Apache-2.0
"""Rounds of scatter and solution on a sphere: swings settle, rounds that run away are taken back.

A sphere of 50 mm seen from few postures with a sensor that is known to some tenths of a millimetre
to millimetres only: its error explains what moves all points off the sphere. Of 350 drawn so, the
ones here swing or run away.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.hand_eye import estimate as estimate_module
from armscan.calibration.hand_eye.estimate import HandEyeSolution, Problem, estimate
from armscan.calibration.hand_eye.observations import (
    HandEyeOptions,
    condense_sphere,
    find_sections,
)
from armscan.calibration.hand_eye.surface import HandEyeState, SphereSurface, hand_eye_difference
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
    moved = hand_eye_difference(again.state.tool_from_sensor, first.state.tool_from_sensor)
    sigma = np.sqrt(np.diag(first.linear.covariance)[:6])
    assert np.abs(moved / sigma).max() < 0.6


@pytest.mark.parametrize("seed", [284, 305])
def test_a_round_that_is_less_likely_is_taken_back(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the rounds end e^15 less likely and about twice as far off; the doubt stays.

    Likelier is not always nearer: of 52 draws that are taken back (seeds 200 to 353) 32 lie nearer
    for it, 20 further off. These two are clear cases of what it is for.
    """
    problem = drawn(seed, (0.3, 12.0))
    kept = solved(problem)
    assert not kept.is_settled
    monkeypatch.setattr(estimate_module, "LESS_LIKELY", np.inf)
    led_away = solved(problem)
    assert led_away.noise.log_posterior < kept.noise.log_posterior - 10.0
    off, further_off = (
        np.linalg.norm(hand_eye_difference(one.state.tool_from_sensor, HAND_EYE)[3:])
        for one in (kept, led_away)
    )
    assert off < 0.7 * further_off
