# SPDX-License-Identifier: Apache-2.0
"""Errors of the hand-eye on a plate against what is stated, and against the bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtri
from scipy.stats import chi2
from scipy.stats.qmc import Sobol

from armscan.calibration.hand_eye.alternatives import find_alternatives
from armscan.calibration.hand_eye.calibrate import calibrate_on_plate
from armscan.calibration.hand_eye.estimate import Problem, estimate
from armscan.calibration.hand_eye.noise import (
    NoiseComponent,
    estimate_noise,
    solve_linear,
)
from armscan.calibration.hand_eye.observations import (
    TIP_SHARE,
    HandEyeOptions,
    condense_plate,
    straight_stripes,
)
from armscan.calibration.hand_eye.probed_plate import ProbingOptions, fit_probed_plate
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.hand_eye.surface import PlateSurface
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import N_DRAWS, normal_draws
from armscan.records.points import ProbedPoints
from rigs.plate_bound import cramer_rao, plain_least_squares, scored_densely
from rigs.plate_rig import TOOL_FROM_SENSOR, PlateRig, RigNoise, good_postures

NOISE = RigNoise()
N_RUNS = 30
GIVEN = HandEyeOptions(
    arm_position_mm=float(np.hypot(NOISE.posture_mm, NOISE.exposure_mm)),
    arm_rotation_rad=float(np.hypot(NOISE.posture_rad, NOISE.exposure_rad)),
    plate_flatness_mm=NOISE.flatness_mm,
    stripe_noise_factor=1.0,
)


def _runs(rig: PlateRig, options: HandEyeOptions, first: int) -> tuple[FloatArray, FloatArray]:
    """Errors (N_RUNS, 6) and their normalised squares."""
    errors, squares = [], []
    for seed in range(first, first + N_RUNS):
        fit = calibrate_on_plate(*rig.draw(seed), options)
        assert isinstance(fit, HandEyeFit)
        error = fit.calibration.tool_from_sensor.step_from(TOOL_FROM_SENSOR)
        errors.append(error)
        squares.append(float(error @ np.linalg.solve(fit.calibration.covariance, error)))
    return np.array(errors), np.array(squares)


def test_a_scale_is_not_pulled_down_by_the_noise_that_it_shrinks() -> None:
    """A sound sensor, whose scale this arm tells to 2 %: 1.8 sigmas too large in the mean once."""
    postures = good_postures(8, np.random.default_rng(7))
    options = HandEyeOptions(
        arm_position_mm=0.4,
        arm_rotation_rad=0.002,
        plate_flatness_mm=0.002,
        stripe_noise_factor=1.0,
    )
    rig = PlateRig(postures, RigNoise(0.4, 0.002, 0.0, 0.0, 0.002, 0.01))
    sigmas = []
    for seed in range(16):
        stripes, plate = rig.draw(seed)
        kept, surface = straight_stripes(stripes), PlateSurface(plate)
        problem = Problem(condense_plate(stripes, kept, surface.per_stripe), surface, options)
        fit = estimate(problem, problem.start(TOOL_FROM_SENSOR))
        assert fit is not None
        (scale,) = [one for one in find_alternatives(fit) if one.name == "scale"]
        sigmas.append(float(scale.values[0] / np.sqrt(scale.covariance[0, 0])))
    assert abs(np.mean(sigmas)) < 3.0 / np.sqrt(len(sigmas))
    assert 0.5 < np.std(sigmas) < 1.6


def test_errors_reach_the_bound_and_the_stated_covariance() -> None:
    """Ratio to the Cramer-Rao bound <= 1.15; limits are those of 30 runs at 99.9 %."""
    rig = PlateRig(good_postures(12, np.random.default_rng(3)))
    errors, squares = _runs(rig, GIVEN, 100)
    bound = cramer_rao(rig)
    against_bound = np.einsum("ri,ij,rj->r", errors, np.linalg.inv(bound), errors).sum()
    assert against_bound < 1.15**2 * chi2.ppf(0.999, 6 * N_RUNS)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * N_RUNS)
    assert low < squares.sum() < high
    plain, stated = plain_least_squares(*rig.draw(100))
    assert plain @ np.linalg.solve(stated, plain) > 10.0 * chi2.ppf(0.95, 6)


def test_estimated_scatter_is_right() -> None:
    """Within a factor of 2; of six postures the region is wider than the usual one, which is told.

    What the covariance says is judged in `test_stated_certainty`.
    """
    for n_postures, region in ((12, (1.02, 1.3)), (6, (1.2, 2.5))):
        rig = PlateRig(good_postures(n_postures, np.random.default_rng(3)))
        fit = calibrate_on_plate(*rig.draw(1))
        assert isinstance(fit, HandEyeFit)
        diagnostics = fit.calibration.diagnostics
        assert diagnostics is not None and diagnostics.is_noise_estimated
        assert region[0] < diagnostics.region_factor < region[1]
        arm_mm = float(np.hypot(NOISE.posture_mm, NOISE.exposure_mm))
        assert 0.5 * arm_mm < fit.calibration.arm_noise.position_mm < 2.0 * arm_mm


def test_the_means_of_the_postures_scatter_as_predicted() -> None:
    """Coarse probing and a coarse sensor, of which plane and hand-eye follow the most.

    The boxes of the page are the standard deviation of the means that stand in them. The fit leaves
    at least 6 of a run's 12 means: 48 numbers in 8 runs, a ratio of variances to 0.2.
    """
    rng = np.random.default_rng(7)
    postures = good_postures(12, np.random.default_rng(3))
    rig = PlateRig(postures, replace(NOISE, probing_mm=0.05), points_per_stripe=60)
    sigma = np.array([0.05, 0.05, 0.05])
    means, ratios = [], []
    for seed in range(8):
        stripes, plate = rig.draw(seed)
        wrong = sigma * rng.normal(size=3)
        moved = [
            replace(
                s,
                points_mm=s.points_mm + wrong,
                dpoint_dsensor=np.tile(np.eye(3), (len(s), 1, 1)),
            )
            for s in stripes
        ]
        fit = calibrate_on_plate(moved, plate, GIVEN, sensor_covariance=np.diag(sigma**2))
        assert isinstance(fit, HandEyeFit)
        means.append([posture.mean_mm for posture in fit.postures])
        ratios.append([posture.normalised_mean for posture in fit.postures])
    assert 0.5 < np.mean(np.square(ratios)) < 1.6
    predicted = np.array(means) / np.array(ratios)
    assert predicted.std(axis=0).max() < 0.05 * predicted.mean()
    assert 0.5 < np.mean(np.square(means)) / np.mean(np.square(predicted)) < 1.6


def test_a_worse_arm_is_noticed() -> None:
    """All errors five times as large: the stated covariance grows with them."""
    postures = good_postures(12, np.random.default_rng(3))
    sigmas = []
    for factor in (1.0, 5.0):
        fit = calibrate_on_plate(*PlateRig(postures, NOISE.scaled(factor)).draw(2))
        assert isinstance(fit, HandEyeFit)
        sigmas.append(np.sqrt(np.diag(fit.calibration.covariance)))
    ratio = sigmas[1] / sigmas[0]
    assert (ratio > 2.5).all() and (ratio < 7.0).all()


def test_several_exposures_tell_their_own_part_from_the_postures() -> None:
    noise = replace(NOISE, exposure_mm=0.01)
    rig = PlateRig(good_postures(12, np.random.default_rng(3)), noise, exposures_per_posture=3)
    fit = calibrate_on_plate(*rig.draw(1))
    assert isinstance(fit, HandEyeFit)
    assert 0.006 < fit.calibration.arm_noise.exposure_position_mm < 0.016
    assert fit.calibration.n_postures == 12 and fit.calibration.n_exposures == 36


def test_a_tip_is_known_as_from_twenty_touches() -> None:
    """Its centre by least squares from touches all around a sphere, 400 drawn calibrations.

    Along any one direction it errs by 0.4 of a touch (2 % by chance), and the plate as scanned may
    lie aside of the plate as probed by that much, beside what the touches leave open.
    """
    rng, errors = np.random.default_rng(15), []
    for _ in range(400):
        way = rng.normal(size=(20, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        errors.append(np.linalg.lstsq(way, rng.normal(size=20), rcond=None)[0])
    by_one_touch = float(np.sqrt(np.mean(np.square(errors))))
    assert by_one_touch == pytest.approx(TIP_SHARE, rel=0.1)
    plate = PlateRig(good_postures(6, rng)).draw(1)[1]
    known, touch_mm = plate.covariance, plate.touch_sigma_mm
    assert known is not None and touch_mm is not None
    assert touch_mm == pytest.approx(0.0061, rel=0.3), "64 touches of 5.3 um on a plate of 3 um"
    prior = PlateSurface(plate).prior(HandEyeOptions())
    assert prior is not None
    expected = known + np.diag([0.0, 0.0, (by_one_touch * touch_mm) ** 2])
    np.testing.assert_allclose(prior, expected, rtol=0.2)
    exact = replace(plate, covariance=None)
    assert PlateSurface(exact).prior(HandEyeOptions()) is None
    assert PlateSurface(plate).prior(HandEyeOptions(solve_plate=True)) is None


def test_a_probed_plate_lies_as_far_off_as_is_stated_with_the_tip() -> None:
    """Drawn 400 times: a tip from 20 touches of a sphere, then 20 touches of a plate at Z = -3 mm.

    The touches alone state half of how far the plate lies off; 5 % by chance.
    """
    rng, errors, alone, stated = np.random.default_rng(21), [], [], []
    sigma_mm = ProbingOptions().touch_sigma_mm
    for _ in range(400):
        way = rng.normal(size=(20, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        tip = np.linalg.lstsq(way, sigma_mm * rng.normal(size=20), rcond=None)[0]
        height = tip[2] + sigma_mm * rng.normal(size=20)
        points = np.column_stack([rng.uniform(-100.0, 100.0, (20, 2)), height])
        probed = fit_probed_plate(ProbedPoints(points, 6.0), np.array([0.0, 0.0, 300.0]))
        assert not isinstance(probed, FitFailure)
        plate = probed.reference
        assert plate.covariance is not None
        assert plate.covariance_with_tip is not None
        errors.append((plate.plane.point_mm[2] + 3.0) ** 2)
        alone.append(plate.covariance[2, 2])
        stated.append(plate.covariance_with_tip[2, 2])
    rms = np.sqrt(np.mean(errors))
    assert rms == pytest.approx(np.sqrt(np.mean(stated)), rel=0.1)
    assert rms > 1.7 * np.sqrt(np.mean(alone))


@pytest.mark.parametrize(
    ("n_touches", "least", "most"), [(3, 1.0, 1.0), (4, 0.8, 1.3), (20, 0.9, 1.1)]
)
def test_a_tip_shifts_few_touches_as_much_as_many(
    n_touches: int, least: float, most: float
) -> None:
    """Three touches have no residuals; the arm and the tip that made them err all the same.

    Medians of 40 plates whose touches scatter as is expected of one, over 0.4 of that.
    """
    rng, found = np.random.default_rng(4), []
    sigma_mm = ProbingOptions().touch_sigma_mm
    for _ in range(40):
        place = rng.uniform(-100.0, 100.0, (n_touches, 2))
        points = np.column_stack([place, sigma_mm * rng.normal(size=n_touches)])
        probed = fit_probed_plate(ProbedPoints(points, 6.0), np.array([0.0, 0.0, 300.0]))
        if isinstance(probed, FitFailure):
            continue  # three that lie nearly on one line
        known, prior = probed.reference.covariance, PlateSurface(probed.reference).prior(GIVEN)
        assert known is not None and prior is not None
        found.append(float(np.sqrt(prior[2, 2] - known[2, 2])) / (TIP_SHARE * sigma_mm))
    assert len(found) > 30
    assert 0.999 * least < np.median(found) < 1.001 * most


def test_restricted_likelihood_of_repeats_is_the_sample_variance() -> None:
    """One mean, independent noise: REML gives the sum of squares over n - 1 (hand computed)."""
    residual = np.random.default_rng(0).normal(size=30) * 0.02
    component = NoiseComponent("noise", np.eye(30), 0.01, True, 1e3)
    found = estimate_noise(residual, np.ones((30, 1)), (component,), np.zeros((30, 30)))
    np.testing.assert_allclose(found.sigmas[0], residual.std(ddof=1), rtol=1e-3)
    np.testing.assert_allclose(found.log_covariance[0, 0], 1.0 / (2.0 * 29.0), rtol=1e-3)


def test_the_likelihood_is_highest_at_the_estimate() -> None:
    """Score and likelihood belong together: no neighbour in any direction is more likely."""
    rng = np.random.default_rng(1)
    group = np.repeat(np.arange(10), 4)
    same = (group[:, None] == group[None, :]).astype(np.float64)
    residual = 0.03 * rng.normal(size=10)[group] + 0.01 * rng.normal(size=40)
    slopes = np.column_stack([np.ones(40), rng.normal(size=40)])
    components = (
        NoiseComponent("group", same, 0.01, True, 1e3),
        NoiseComponent("own", np.eye(40), 0.02, True, 1e3),
    )
    found = estimate_noise(residual, slopes, components, np.zeros((40, 40)))

    def likelihood(sigmas: FloatArray) -> float:
        total = sigmas[0] ** 2 * same + sigmas[1] ** 2 * np.eye(40)
        solution = solve_linear(residual, slopes, total)
        assert solution is not None
        return solution.log_likelihood

    best = likelihood(found.sigmas)
    for step in (np.array([0.02, 0.0]), np.array([0.0, 0.02])):
        for sign in (-1.0, 1.0):
            assert likelihood(found.sigmas * np.exp(sign * step)) < best


@pytest.mark.parametrize("seed", range(4))
def test_groups_of_observations_give_what_full_matrices_give(seed: int) -> None:
    """Own to each posture, to each sheet across postures, smooth over all, and to each point.

    A product by groups that forgot one, or put it elsewhere, would change the scores.
    """
    rng = np.random.default_rng(seed)
    n = 48
    posture, sheet = np.repeat(np.arange(8), 6), rng.permutation(np.arange(n) % 3)
    lever, place = rng.normal(size=n), rng.uniform(0.0, 100.0, n)
    smooth = np.exp(-0.5 * ((place[:, None] - place) / 30.0) ** 2)
    components = (
        NoiseComponent("arm", (posture[:, None] == posture).astype(float), 0.02, True, 1.5),
        NoiseComponent(
            "turn", (posture[:, None] == posture) * np.outer(lever, lever), 0.01, True, 1.5
        ),
        NoiseComponent("sheet", (sheet[:, None] == sheet) * smooth, 0.01, True, 1.0),
        NoiseComponent("flatness", smooth, 0.01, True, 1.5),
        NoiseComponent("stripe", np.diag(rng.uniform(0.5, 2.0, n)), 0.004, True, 1.0),
    )
    total = sum(one.sigma**2 * one.covariance for one in components)
    residual = np.linalg.cholesky(total) @ rng.normal(size=n)
    slopes = np.column_stack([np.ones(n), rng.normal(size=(n, 3))])
    found = estimate_noise(residual, slopes, components, np.zeros((n, n)))
    sigmas, log_covariance = scored_densely(residual, slopes, components, np.zeros((n, n)))
    np.testing.assert_allclose(found.sigmas, sigmas, rtol=1e-9)
    np.testing.assert_allclose(found.log_covariance, log_covariance, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("n", range(1, 10))
def test_draws_are_those_of_scrambled_sobol_points(n: int) -> None:
    points = Sobol(n, rng=np.random.default_rng(0)).random(N_DRAWS)
    np.testing.assert_array_equal(normal_draws(n), ndtri(points))
