# SPDX-License-Identifier: Apache-2.0
"""The latency from a reversing stand-off over a plate, at feature level; truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from armscan.calibration import latency
from armscan.calibration.latency import (
    LatencyFit,
    calibrate_latency,
    look_at_plate,
    plate_looks,
)
from armscan.calibration.residual_noise import (
    NoiseCovariance,
    ResidualNoise,
    likeliest_noise,
    score_sigma,
)
from armscan.errors import InputError
from armscan.geometry.estimate import FitFailure
from rigs.latency import LatencyCase, draw

EXACT = LatencyCase(
    seconds=4.0, arm_hz=2000.0, arm_mm=0.0, arm_turn_rad=0.0, waves_mm=0.0, flatness_mm=0.0,
    stripe_mm=1e-6, hand_eye_mm=0.0, scale=0.0,
)  # fmt: skip


def fitted(case, seed, *, is_shared=True) -> tuple[LatencyFit, float]:
    looks, arm, hand_eye, truth = draw(case, seed)
    fit = calibrate_latency(looks, arm, hand_eye, is_shared=is_shared)
    assert isinstance(fit, LatencyFit), fit
    return fit, truth


@pytest.mark.parametrize("latency_ns", [-140_000_000, 0, 55_500_001])
def test_exact_without_noise(latency_ns):
    """What is left is the chord between samples 0.5 ms apart: 1e3 mm/s^2 (0.5 ms)^2 / 8."""
    fit, truth = fitted(replace(EXACT, latency_ns=latency_ns), 3)
    assert abs(fit.latency_ns - truth) < 500
    assert abs(fit.drift) < 1e-6
    assert np.abs(fit.estimate.residuals).max() < 1e-4


@pytest.mark.parametrize("seed", range(1, 6))
def test_within_its_sigma_and_sigma_as_small_as_asked(seed):
    fit, truth = fitted(LatencyCase(), seed)
    assert abs(fit.latency_ns - truth) < 3.5 * fit.sigma_ns
    assert fit.sigma_ns < 35_000
    assert abs(fit.drift) < 4.0 * fit.sigma_drift


def test_doubled_or_halved_sigmas_would_show():
    """Chi-square of 30 fixed draws: 0.5 and 2 times the sigma fall out, 1 stays in."""
    case = LatencyCase(seconds=6.0, camera_hz=40.0, waves_mm=0.003)
    pairs = [fitted(case, seed) for seed in range(500, 530)]
    ratios = np.array([(fit.latency_ns - truth) / fit.sigma_ns for fit, truth in pairs])
    assert 30 * 0.4 < (ratios**2).sum() < 30 * 1.8


def test_separate_clocks_give_offset_and_drift_together():
    case = LatencyCase(drift=120e-6, separate_ns=4 * 10**14, arm_hz=333.0)
    fit, truth = fitted(case, 5, is_shared=False)
    assert abs(fit.latency_ns - truth) < 3.5 * fit.sigma_ns
    assert abs(fit.drift - 120e-6) < 3.5 * fit.sigma_drift
    assert fit.sigma_drift < 15e-6
    assert fit.estimate.parameter_names[:2] == ("latency_ns", "drift")


def test_shared_clocks_that_drift_are_warned_of():
    fit, _ = fitted(LatencyCase(drift=150e-6), 6)
    assert any("drift by" in text for text in fit.warnings)


def oracle(looks, arm, hand_eye, start_ns):
    """SciPy alone: cubic splines of the track, plane and time by Levenberg-Marquardt."""
    seconds = 1e-9 * (arm.t_ns - looks.t_ns[0])
    place = CubicSpline(seconds, arm.translations_mm)
    turn = Rotation.from_matrix(arm.rotations)
    vector = CubicSpline(seconds, (turn[0].inv() * turn).as_rotvec())
    tool = hand_eye.apply(looks.centre_mm)
    t = 1e-9 * (looks.t_ns - looks.t_ns[0])

    def placed(latency_ms):
        at = t + 1e-3 * latency_ms
        return (turn[0] * Rotation.from_rotvec(vector(at))).apply(tool) + place(at)

    middle = placed(1e-6 * start_ns)
    normal = np.linalg.svd(middle - middle.mean(axis=0))[2][2]
    along = np.linalg.svd(normal[None])[2][1:]

    def heights(p):
        points = placed(p[0]) - middle.mean(axis=0)
        return points @ (normal + p[1:3] @ along) - p[3]

    found = least_squares(heights, [1e-6 * start_ns, 0.0, 0.0, 0.0], x_scale=[1, 0.01, 0.01, 0.1])
    return 1e6 * found.x[0]


def test_agrees_with_an_independent_solution():
    """White noise alone: SciPy's plain least squares is then right, and as good."""
    case = LatencyCase(
        waves_mm=0.0, flatness_mm=0.0, hand_eye_mm=0.0, scale=0.0, rocking_deg=0.5, arm_hz=500.0
    )
    for seed in (11, 12, 13):
        looks, arm, hand_eye, truth = draw(case, seed)
        fit = calibrate_latency(looks, arm, hand_eye)
        assert isinstance(fit, LatencyFit)
        other = oracle(looks, arm, hand_eye, truth + 2e6)
        assert abs(other - truth) < 4.0 * fit.sigma_ns
        assert abs(fit.latency_ns - other) < 1.5 * fit.sigma_ns


def test_commensurate_rates_do_not_pull_towards_the_middle_between_samples():
    """Every exposure lies equally far from a sample: noise alone would prefer half a step."""
    case = LatencyCase(arm_hz=80.0, arm_mm=0.03, waves_mm=0.0, latency_ns=-1_000_000)
    ratios = []
    for seed in range(40, 46):
        fit, truth = fitted(case, seed)
        ratios.append((fit.latency_ns - truth) / fit.sigma_ns)
        assert fit.sigma_ns < 80_000
    assert abs(np.mean(ratios)) < 3.0 / np.sqrt(len(ratios))


def test_exposures_of_something_else_are_left_out():
    fit, truth = fitted(LatencyCase(outliers=0.08), 21)
    assert abs(fit.latency_ns - truth) < 3.5 * fit.sigma_ns
    assert 30 < fit.n_left_out < 150


@pytest.mark.parametrize(
    ("case", "said"),
    [
        (LatencyCase(speed_mm_s=1.0, aside_mm_s=30.0), "mm/s rms"),
        (LatencyCase(speed_mm_s=3.0), "mm/s rms"),
        (LatencyCase(reversing_hz=0.03, speed_mm_s=8.0, rocking_deg=0.3), "reversed"),
        (LatencyCase(seconds=0.5), "60 are needed"),
        (LatencyCase(arm_mm=1.0, arm_turn_rad=1e-2, camera_hz=30.0), "sigma of"),
    ],
    ids=["tangential", "too slow", "hardly reversing", "too short", "too noisy"],
)
def test_a_motion_that_tells_nothing_is_refused_with_the_numbers(case, said):
    looks, arm, hand_eye, _ = draw(replace(case, latency_ns=0), 31)
    failure = calibrate_latency(looks, arm, hand_eye)
    assert isinstance(failure, FitFailure)
    assert said in failure.reason or "as flat with" in failure.reason
    assert any(character.isdigit() for character in failure.reason)


@pytest.mark.parametrize(
    ("case", "said"),
    [(LatencyCase(reversing_hz=0.03, speed_mm_s=8.0, rocking_deg=0.3), "reversed"),
     (LatencyCase(), "did not settle within 1 steps")],
)  # fmt: skip
def test_what_does_not_settle_says_first_what_the_motion_lacks(case, said, monkeypatch):
    monkeypatch.setattr(latency, "STEPS", 1)
    monkeypatch.setattr(latency, "SECOND_BEST", 0.0)
    monkeypatch.setattr(latency, "SETTLED_NS", 0.0)
    looks, arm, hand_eye, _ = draw(replace(case, latency_ns=20_000_000), 31)
    failure = calibrate_latency(looks, arm, hand_eye)
    assert isinstance(failure, FitFailure)
    assert said in failure.reason


def test_constant_speed_tells_nothing():
    """A plate that is shifted explains it as well: the head only comes nearer."""
    looks, arm, hand_eye, _ = draw(replace(EXACT, speed_mm_s=0.0, arm_mm=0.005), 8)
    normal = np.array([0.0, 0.0, 1.0])
    speed = 5.0
    moved = replace(
        arm,
        translations_mm=arm.translations_mm
        + speed * 1e-9 * (arm.t_ns - arm.t_ns[0])[:, None] * (arm.rotations[0] @ normal),
    )
    failure = calibrate_latency(looks, moved, hand_eye)
    assert isinstance(failure, FitFailure)


def test_an_arm_elsewhere_in_time_is_refused():
    looks, arm, hand_eye, _ = draw(LatencyCase(seconds=3.0), 9)
    far = replace(arm, t_ns=arm.t_ns + 10**12)
    failure = calibrate_latency(looks, far, hand_eye)
    assert isinstance(failure, FitFailure) and "within the arm's track" in failure.reason


@pytest.mark.parametrize("latency_ns", [-330_000_000, 310_000_000])
def test_a_latency_beyond_what_is_searched_is_not_taken_for_its_end(latency_ns):
    looks, arm, hand_eye, _ = draw(replace(EXACT, latency_ns=latency_ns), 3)
    failure = calibrate_latency(looks, arm, hand_eye)
    assert isinstance(failure, FitFailure), failure.latency_ns


def test_separate_clocks_are_not_searched_for_hours():
    looks, arm, hand_eye, _ = draw(LatencyCase(seconds=3.0), 9)
    t_ns = arm.t_ns.copy()
    t_ns[-1] += 3_600_000_000_000
    long = replace(arm, t_ns=t_ns)
    failure = calibrate_latency(looks, long, hand_eye, is_shared=False)
    assert isinstance(failure, FitFailure) and "too long to be searched" in failure.reason


def test_times_that_do_not_increase_are_no_looks():
    looks, arm, hand_eye, _ = draw(LatencyCase(seconds=3.0), 9)
    twice = replace(looks, t_ns=np.full(len(looks), 5, dtype=np.int64))
    with pytest.raises(InputError, match="do not increase"):
        calibrate_latency(twice, arm, hand_eye)


def test_a_stripe_is_summarised_by_centre_and_spread():
    rng = np.random.default_rng(1)
    along = np.linspace(-15, 15, 200)
    line = np.array([1.0, 2.0, 140.0]) + along[:, None] * [0.6, 0.0, 0.8]
    points = line + rng.normal(0, 0.01, line.shape)
    points[:6] += [0.0, 3.0, 0.0]
    found = look_at_plate(points)
    assert found is not None
    centre, axes = found
    kept = points[6:]
    assert np.allclose(centre, kept.mean(axis=0), atol=2e-3)
    assert np.linalg.norm(axes[0]) == pytest.approx(along[6:].std(), rel=1e-3)
    assert np.array_equal(axes[1], np.zeros(3))
    assert look_at_plate(points[:10]) is None
    assert len(plate_looks([5, 3, 4], [points, points, points[:3]])) == 2


def test_noise_covariance_against_the_dense_one():
    rng = np.random.default_rng(2)
    seconds = np.sort(rng.uniform(0, 3, 60))
    noise = ResidualNoise(0.3, 0.7, 0.4)
    dense = 0.09 * np.eye(60) + 0.49 * np.exp(-np.abs(seconds[:, None] - seconds) / 0.4)
    quick = NoiseCovariance(noise, seconds)
    values = rng.normal(size=(60, 3))
    assert np.allclose(quick.solve(values), np.linalg.solve(dense, values), rtol=1e-8)
    assert quick.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-10)


def test_the_likeliest_noise_is_that_of_the_draw():
    rng = np.random.default_rng(3)
    seconds = np.arange(1500) / 80
    dense = np.exp(-np.abs(seconds[:, None] - seconds) / 0.5)
    slow = np.linalg.cholesky(0.01**2 * dense + 1e-12 * np.eye(1500)) @ rng.normal(size=1500)
    found = likeliest_noise(
        slow + rng.normal(0, 0.006, 1500), np.column_stack([np.ones(1500), seconds]), seconds
    )
    assert found.white_mm == pytest.approx(0.006, rel=0.1)
    assert found.slow_mm == pytest.approx(0.01, rel=0.4)
    assert 0.2 < found.fades_s < 1.2


def test_scores_that_correlate_scatter_more():
    rng = np.random.default_rng(4)
    white = rng.normal(size=4000)
    assert score_sigma(white, 1) == pytest.approx(np.sqrt(4000), rel=0.05)
    # a moving sum of 8 has a sum 8 times as large
    assert score_sigma(np.convolve(white, np.ones(8), "valid"), 60) == pytest.approx(
        8 * np.sqrt(4000), rel=0.15
    )


def test_the_drift_of_shared_clocks_is_told_with_sign_and_size():
    fit, _ = fitted(LatencyCase(drift=150e-6, seconds=6.0, camera_hz=40.0), 6)
    assert abs(fit.drift - 150e-6) < 4.0 * fit.sigma_drift < 100e-6


def test_sigma_of_a_drift_is_the_latencys_over_the_spread_of_times():
    """Of a line through points of equal weight; what the arm errs alike makes it somewhat wider."""
    case = LatencyCase(
        drift=120e-6, separate_ns=4 * 10**14, arm_hz=333.0, seconds=6.0, camera_hz=40.0
    )
    fit, _ = fitted(case, 5, is_shared=False)
    assert 0.7 < fit.sigma_drift / (fit.sigma_ns / np.std(fit.t_ns)) < 1.5
