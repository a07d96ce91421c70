# SPDX-License-Identifier: Apache-2.0
"""Standard deviations of fitted lengths against repeated simulated measurements."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.features import fit_shape
from armscan.geometry.shapes import Plane, fit_sphere
from armscan.inspection.features import Fitted, inspect_points, together
from armscan.inspection.plane import inspect_plane
from armscan.inspection.results import MeasuredLength
from armscan.inspection.search import WantedFeature
from armscan.inspection.sphere import DIAMETER_OF_SPHERE, inspect_sphere, linearised_sphere
from armscan.inspection.step import inspect_step
from armscan.inspection.uncertainty import _unstated_mm2, measured_length
from armscan.records.cloud import FIELD_POWERS, CalibrationErrors, PointCloud
from armscan.report.inspection.shapes import sigma_facts
from armscan.vision.stripe.smooth import Polyline, smooth
from rigs.inspection_clouds import RADIUS_MM, ball_stripes, block_stripes, cloud_of

ARM_MM = 0.008
NOISE_MM = 0.004
MM_PER_PX = 0.05
N_RUNS = 40
SPREAD_LIMIT = 1.0 + 3.3 / math.sqrt(2 * N_RUNS)
"""Ratio of a standard deviation from 40 runs to the true one: 99.9 % below (normal errors)."""


def ball_diameter(seed: int, arm_mm: float = ARM_MM, noise_mm: float = NOISE_MM) -> MeasuredLength:
    """Exposures err as a whole by the arm, points by the stripe's noise."""
    rng = np.random.default_rng(seed)
    outward = ball_stripes(16, 30)
    exposure = np.repeat(np.arange(16), 30)
    points = RADIUS_MM * outward + rng.normal(0.0, arm_mm, (16, 3))[exposure]
    points += outward * rng.normal(0.0, noise_mm, (len(points), 1))
    cloud = cloud_of(points, exposure, sigma_mm=arm_mm, noise_mm=noise_mm, noise_along=outward)
    found = inspect_sphere(cloud, 2 * RADIUS_MM)
    assert not isinstance(found, FitFailure)
    return found.diameter


def test_the_diameters_sigma_is_its_scatter_over_repeats() -> None:
    """Taking points for independent would make it 5 times too small.

    Blocks of neighbouring exposures are taken to err alike as well, which these do not: the sigma
    may be larger for it, up to the square root of a block's length, never smaller.
    """
    found = [ball_diameter(seed) for seed in range(N_RUNS)]
    scatter = float(np.std([item.value_mm for item in found], ddof=1))
    propagated = float(np.mean([item.sigma_propagated_mm for item in found]))
    jackknife = float(np.sqrt(np.mean([item.sigma_scatter_mm**2 for item in found])))
    longest_block = 16 / 6
    assert 1.0 / (SPREAD_LIMIT * math.sqrt(longest_block)) < scatter / propagated < SPREAD_LIMIT
    # a jackknife is biased upwards, the more so the fewer the exposures
    assert 0.6 / SPREAD_LIMIT < scatter / jackknife < SPREAD_LIMIT
    assert found[0].sigma_mm == found[0].sigma_propagated_mm


def test_the_stripes_noise_averages_out_and_is_counted_once() -> None:
    """Taken also for an error of the whole exposure it would make sigma three times too large."""
    found = [ball_diameter(seed, arm_mm=0.001, noise_mm=0.02) for seed in range(12)]
    scatter = float(np.std([item.value_mm for item in found], ddof=1))
    propagated = float(np.mean([item.sigma_propagated_mm for item in found]))
    limit = 1.0 + 3.3 / math.sqrt(2 * 12)
    assert 1.0 / limit < scatter / propagated < limit


def test_what_an_exposure_errs_on_both_faces_leaves_the_height_alone() -> None:
    """An exposure that crosses both faces shifts both: the height's sigma is far below its own."""
    clean, exposure = block_stripes(20.0, 20, 200)
    heights = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points = clean + rng.normal(0.0, 0.02, (20, 3))[exposure]
        points[:, 2] += rng.normal(0.0, NOISE_MM, len(points))
        up = np.array([0.0, 0.0, 1.0])
        cloud = cloud_of(points, exposure, sigma_mm=0.02, noise_mm=NOISE_MM, noise_along=up)
        found = inspect_step(cloud, 20.0)
        assert not isinstance(found, FitFailure)
        heights.append(found.height)
    scatter = float(np.std([item.value_mm for item in heights], ddof=1))
    propagated = float(np.mean([item.sigma_propagated_mm for item in heights]))
    limit = 1.0 + 3.3 / math.sqrt(2 * 20)
    assert 1.0 / limit < scatter / propagated < limit


def test_exposures_of_a_whole_stroke_that_err_alike_are_not_counted_as_many() -> None:
    """48 exposures in 6 strokes that err alike: the sigma is that of 6, not of 48 or 12."""
    outward, exposure = ball_stripes(48, 12), np.repeat(np.arange(48), 12)
    found = []
    for seed in range(20):
        alike = np.repeat(np.random.default_rng(seed).normal(0.0, ARM_MM, (6, 3)), 8, axis=0)
        cloud = cloud_of(RADIUS_MM * outward + alike[exposure], exposure, sigma_mm=ARM_MM)
        ball = inspect_sphere(cloud, 2 * RADIUS_MM)
        assert not isinstance(ball, FitFailure)
        found.append(ball.diameter)
    scatter = float(np.std([item.value_mm for item in found], ddof=1))
    limit = 1.0 + 3.3 / math.sqrt(2 * 20)
    assert 1.0 / limit < scatter / found[0].sigma_propagated_mm < limit


def test_one_exposure_states_no_sigma() -> None:
    """An error of the sensor stretches it, which a shift of the whole cannot tell."""
    points = RADIUS_MM * ball_stripes(12, 30)
    found = inspect_sphere(cloud_of(points, np.zeros(len(points), dtype=np.int64)), 2 * RADIUS_MM)
    assert not isinstance(found, FitFailure)
    assert math.isnan(found.diameter.sigma_mm)


def test_a_cloud_without_exposures_or_covariances_has_no_sigma() -> None:
    points = RADIUS_MM * ball_stripes(16, 30)
    found = inspect_sphere(cloud_of(points, sigma_mm=0.0), 2 * RADIUS_MM)
    assert not isinstance(found, FitFailure)
    assert math.isnan(found.diameter.sigma_mm)


def test_neighbouring_exposures_that_err_alike_are_not_counted_as_many() -> None:
    """48 exposures in 12 runs of 4 that err alike: taken singly, sigma would be half of it."""
    outward, exposure = ball_stripes(48, 12), np.repeat(np.arange(48), 12)
    found = []
    for seed in range(20):
        alike = np.repeat(np.random.default_rng(seed).normal(0.0, ARM_MM, (12, 3)), 4, axis=0)
        cloud = cloud_of(RADIUS_MM * outward + alike[exposure], exposure, sigma_mm=ARM_MM)
        ball = inspect_sphere(cloud, 2 * RADIUS_MM)
        assert not isinstance(ball, FitFailure)
        found.append(ball.diameter)
    scatter = float(np.std([item.value_mm for item in found], ddof=1))
    limit = 1.0 + 3.3 / math.sqrt(2 * 20)
    propagated = found[0].sigma_propagated_mm
    assert 1.0 / limit < scatter / propagated < limit
    jackknife = float(np.sqrt(np.mean([item.sigma_scatter_mm**2 for item in found])))
    assert 0.75 / limit < scatter / jackknife < limit


def test_strokes_that_each_see_all_of_a_ball_and_err_as_a_whole_leave_its_size_alone() -> None:
    """Taken for new in each exposure, as the worst case, sigma would be three times too large."""
    outward, exposure = ball_stripes(48, 12), np.repeat(np.arange(48), 12)
    stroke = exposure % 6
    number = stroke * 12 + exposure // 6
    found = []
    for seed in range(N_RUNS):
        rng = np.random.default_rng(seed)
        points = RADIUS_MM * outward + rng.normal(0.0, ARM_MM, (6, 3))[stroke]
        points += outward * rng.normal(0.0, NOISE_MM / 4.0, (len(points), 1))
        cloud = cloud_of(
            points, number, sigma_mm=ARM_MM, noise_mm=NOISE_MM / 4.0, noise_along=outward
        )
        ball = inspect_sphere(cloud, 2 * RADIUS_MM)
        assert not isinstance(ball, FitFailure)
        found.append(ball.diameter)
    scatter = float(np.std([item.value_mm for item in found], ddof=1))
    stated = float(np.sqrt(np.mean([item.sigma_mm**2 for item in found])))
    assert 1.0 / SPREAD_LIMIT < scatter / stated < SPREAD_LIMIT
    # the jackknife takes them for new, so that the larger of the two would be twice too large
    larger = float(np.sqrt(np.mean([item.sigma_scatter_mm**2 for item in found])))
    assert larger > SPREAD_LIMIT * scatter
    assert any("largest of three" in item.line for item in sigma_facts(found[0], "diameter"))


def test_exposures_that_disagree_by_more_than_the_cloud_says_have_a_larger_sigma() -> None:
    """Five times more: taken at its word, the cloud would hold the truth in a third of the runs."""
    found = []
    for seed in range(N_RUNS):
        rng = np.random.default_rng(seed)
        outward, exposure = ball_stripes(16, 30), np.repeat(np.arange(16), 30)
        points = RADIUS_MM * outward + rng.normal(0.0, 5.0 * ARM_MM, (16, 3))[exposure]
        points += outward * rng.normal(0.0, NOISE_MM, (len(points), 1))
        cloud = cloud_of(points, exposure, sigma_mm=ARM_MM, noise_mm=NOISE_MM, noise_along=outward)
        ball = inspect_sphere(cloud, 2 * RADIUS_MM)
        assert not isinstance(ball, FitFailure)
        found.append(ball.diameter)
    held = sum(abs(one.value_mm - 2 * RADIUS_MM) <= 2.0 * one.sigma_mm for one in found)
    assert held >= 33  # of 40 at 95 %: fewer once in a thousand times


@pytest.mark.parametrize("stated_mm", [0.0001, 0.0005])
def test_exposures_that_err_a_hundred_times_as_much_as_the_cloud_says(stated_mm: float) -> None:
    """A mount that slipped, or a clock that lags: no calibration states what they make."""
    found = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        outward = ball_stripes(16, 30)
        exposure = np.repeat(np.arange(16), 30)
        points = RADIUS_MM * outward + rng.normal(0.0, 100 * stated_mm, (16, 3))[exposure]
        points += outward * rng.normal(0.0, 0.004, (len(points), 1))
        cloud = cloud_of(points, exposure, sigma_mm=stated_mm, noise_mm=0.004, noise_along=outward)
        one = inspect_sphere(cloud, 2 * RADIUS_MM)
        assert not isinstance(one, FitFailure)
        found.append(one.diameter)
    scatter = float(np.std([one.value_mm for one in found], ddof=1))
    told = float(np.sqrt(np.mean([one.sigma_mm**2 for one in found])))
    assert 0.5 < scatter / told < 1.0 + 3.3 / math.sqrt(2 * 12)


def test_too_few_exposures_say_nothing_of_their_scatter() -> None:
    points = RADIUS_MM * ball_stripes(12, 30)
    exposure = np.repeat(np.arange(12) * 3 // 12, 30)
    found = inspect_sphere(cloud_of(points, exposure), 2 * RADIUS_MM)
    assert not isinstance(found, FitFailure)
    assert math.isnan(found.diameter.sigma_scatter_mm)
    assert math.isfinite(found.diameter.sigma_mm)


def few_stripes(n: int, seed: int, sigma_mm: float) -> PointCloud:
    """Stripes across a flat face in sheets that lean by 30 degrees, all in one orientation."""
    rng = np.random.default_rng(seed)
    along = np.array([0.0, 0.5, math.sqrt(0.75)])
    clean = [[x, 4.0 * k, 0.0] for k in range(n) for x in np.linspace(-15.0, 15.0, 150)]
    exposure = np.repeat(np.arange(n), 150)
    points = np.array(clean) + rng.normal(0.0, sigma_mm, (n, 3))[exposure]
    points += rng.normal(0.0, 2.0 * sigma_mm, (len(points), 1)) * along
    ways = np.tile(along, (len(points), 1))
    return cloud_of(points, exposure, sigma_mm=0.005, noise_mm=0.01, noise_along=ways)


@pytest.mark.parametrize("n", [2, 3, 4])
def test_few_stripes_of_one_orientation_tell_how_well_a_flat_face_is_known(n: int) -> None:
    """The fit takes up all that they err: what is left is not linear, and tells of no motion."""
    wanted = WantedFeature("plane")
    found = [inspect_points(few_stripes(n, seed, 0.005), wanted, "given") for seed in range(12)]
    tilts, sigmas = [], []
    for one in found:
        assert not isinstance(one, FitFailure)
        tilts.append(math.hypot(*one.shape.direction[:2]))
        sigmas.append(one.direction_sigma_rad)
    ratio = np.sqrt(np.mean(np.square(tilts)) / np.mean(np.square(sigmas)))
    assert 1.0 / (1.0 + 3.3 / math.sqrt(2 * 12)) < ratio < 1.0 + 3.3 / math.sqrt(2 * 12)


def test_exact_stripes_of_one_orientation_have_the_sigma_that_is_stated() -> None:
    found = inspect_points(few_stripes(2, 0, 0.0), WantedFeature("plane"), "given")
    assert not isinstance(found, FitFailure)
    # both shift by 5 um against each other, 4 mm apart
    assert found.direction_sigma_rad == pytest.approx(0.005 * math.sqrt(2.0) / 4.0, rel=0.5)


def seen_by_a_sensor(seed: int, *, is_told: bool) -> MeasuredLength:
    """A ball whose 16 exposures look straight at it, by a calibration that sees too near or far."""
    rng = np.random.default_rng(seed)
    outward, exposure = ball_stripes(16, 30), np.repeat(np.arange(16), 30)
    towards = np.array([outward[exposure == k].mean(axis=0) for k in range(16)])
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    too_far = 2.0 * ARM_MM * rng.standard_normal()
    points = RADIUS_MM * outward + rng.normal(0.0, ARM_MM / 4.0, (16, 3))[exposure]
    points -= too_far * towards[exposure]
    cloud = cloud_of(points, exposure, sigma_mm=ARM_MM / 4.0, noise_mm=NOISE_MM / 4.0)
    by_calibration = 2.0 * ARM_MM * towards[exposure]
    across = np.cross(towards, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across, axis=1)[:, None]
    turns = np.stack([np.cross(across, -towards), across, -towards], axis=2)
    modes = np.zeros((1, len(FIELD_POWERS), 3, 1))
    modes[0, 0, 2] = 2.0 * ARM_MM
    errors = CalibrationErrors(
        turns=turns, middle=np.zeros((1, 2)), half_width=np.ones((1, 2)), modes_mm=modes, arm_mm=0.0
    )
    cloud = replace(
        cloud,
        covariance_mm2=cloud.covariance_mm2 + by_calibration[:, :, None] * by_calibration[:, None],
        seen_from_mm=150.0 * towards,
        calibration_errors=errors if is_told else None,
    )
    ball = inspect_sphere(cloud, 2 * RADIUS_MM)
    assert not isinstance(ball, FitFailure)
    return ball.diameter


def test_a_calibration_that_sees_too_near_makes_a_ball_too_large() -> None:
    """It errs alike in all exposures, and each looks elsewhere: no two of them disagree.

    Taken for errors of exposures, as of a cloud that does not tell, sigma is half as large.
    """
    found = [seen_by_a_sensor(seed, is_told=True) for seed in range(N_RUNS)]
    scatter = float(np.std([one.value_mm for one in found], ddof=1))
    stated = float(np.sqrt(np.mean([one.sigma_mm**2 for one in found])))
    assert 1.0 / SPREAD_LIMIT < scatter / stated < SPREAD_LIMIT
    assert seen_by_a_sensor(0, is_told=False).sigma_mm < 0.6 * stated


def test_many_exposures_that_err_each_for_itself_do_not_look_as_if_they_turned() -> None:
    """60 exposures, every other one of another ball: the distance is known as 30 of each tell it.

    Neighbours taken together as one motion would seem to turn, and sigma be twice too large.
    """
    outward, exposure = ball_stripes(30, 16), np.repeat(np.arange(30), 16)
    apart = np.array([40.0, 0.0, 0.0])
    clean = np.concatenate([RADIUS_MM * outward, RADIUS_MM * outward + apart])
    number = np.concatenate([2 * exposure, 2 * exposure + 1])
    along = np.concatenate([outward, outward])
    half = len(outward)
    found = []
    for seed in range(N_RUNS):
        rng = np.random.default_rng(seed)
        points = clean + rng.normal(0.0, ARM_MM, (60, 3))[number]
        points += along * rng.normal(0.0, NOISE_MM / 4.0, (len(points), 1))
        cloud = cloud_of(
            points, number, sigma_mm=ARM_MM, noise_mm=NOISE_MM / 4.0, noise_along=along
        )
        fits = []
        for rows in (np.arange(half), np.arange(half, 2 * half)):
            one = fit_shape("sphere", points[rows])
            assert not isinstance(one, FitFailure)
            fits.append(Fitted(one.value, cloud, rows))
        found.append(
            together(
                (fits[0], fits[1]),
                lambda two: float(np.linalg.norm(two[1].point_mm - two[0].point_mm)),
            )
        )
    scatter = float(np.std([one.value_mm for one in found], ddof=1))
    stated = float(np.sqrt(np.mean([one.sigma_mm**2 for one in found])))
    assert 1.0 / SPREAD_LIMIT < scatter / stated < SPREAD_LIMIT


def smoothed_stripe(
    height_mm: FloatArray, chain: IntArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Heights, their sigma and correlation length after the real smoothing of white noise."""
    n, sigma = len(height_mm), NOISE_MM / MM_PER_PX
    points = np.stack([np.arange(n, dtype=float), height_mm / MM_PER_PX], axis=1)
    points[:, 1] += rng.normal(0.0, sigma, n)
    course = Polyline(
        points,
        np.tile([0.0, 1.0], (n, 1)),
        np.full(n, sigma),
        chain,
        np.ones(n, dtype=np.bool_),
    )
    found = smooth(course, 12.0)
    length = np.maximum((found.sigma_sum / found.sigma) ** 2, 1.0)
    return found.points[:, 1] * MM_PER_PX, found.sigma * MM_PER_PX, length


def smoothed_cloud(kind: str, seed: int) -> PointCloud:
    """Ten stripes, 1 mm apart, over a plane, a step of 5 mm or a ball; the noise acts along z."""
    rng = np.random.default_rng(seed)
    x = np.linspace(-10.0, 10.0, 400)
    points, sigma, length = [], [], []
    for k in range(10):
        y = k - 4.5
        is_upper = (x > 0.0) & (kind == "step")
        height = np.sqrt(RADIUS_MM**2 - x * x - y * y) if kind == "ball" else 5.0 * is_upper
        z, own, alike = smoothed_stripe(height, is_upper.astype(np.int64), rng)
        points.append(np.stack([x, np.full_like(x, y), z], axis=1))
        sigma.append(own)
        length.append(alike)
    noise = np.concatenate(sigma)
    up = noise[:, None] * np.array([0.0, 0.0, 1.0])
    return replace(
        cloud_of(np.concatenate(points), np.repeat(np.arange(10), len(x))),
        covariance_mm2=up[:, :, None] * up[:, None, :],
        sigma_noise_mm=noise,
        noise_length=np.concatenate(length),
    )


def length_of(kind: str, cloud: PointCloud) -> MeasuredLength:
    if kind == "plane":
        flat = inspect_plane(cloud, Plane(np.zeros(3), np.eye(3)))
        assert not isinstance(flat, FitFailure)
        assert flat.offset is not None
        return flat.offset
    if kind == "step":
        step = inspect_step(cloud, 5.0)
        assert not isinstance(step, FitFailure)
        return step.height
    ball = fit_sphere(cloud.points_mm)
    assert not isinstance(ball, FitFailure)
    linear = linearised_sphere(ball.value, cloud.points_mm)
    diameter = 2.0 * ball.value.radius_mm
    return measured_length(diameter, DIAMETER_OF_SPHERE, linear, cloud, np.arange(len(cloud)))


@pytest.mark.parametrize("kind", ["plane", "step", "ball"])
def test_noise_that_the_smoothing_left_counts_as_it_scatters(kind: str) -> None:
    """Real smoothing of white noise: summed as if independent, sigma would be 3 times too small."""
    found = [length_of(kind, smoothed_cloud(kind, seed)) for seed in range(N_RUNS)]
    scatter = float(np.std([item.value_mm for item in found], ddof=1))
    stated = float(np.mean([item.sigma_propagated_mm for item in found]))
    assert 1.0 / SPREAD_LIMIT < scatter / stated < SPREAD_LIMIT
    bare = length_of(kind, replace(smoothed_cloud(kind, 0), noise_length=None))
    assert stated > 2.5 * bare.sigma_propagated_mm


@pytest.mark.parametrize("stated_part", [1.0, 0.3, 0.0])
def test_points_that_scatter_by_more_than_the_cloud_says_have_a_larger_sigma(
    stated_part: float,
) -> None:
    """A rough surface: both sigma and U of a height were as small as what the calibration says.

    Where it says what they do, nothing changes.
    """
    points, exposure = block_stripes(20.0)
    up = np.array([0.0, 0.0, 1.0])
    found = []
    for seed in range(N_RUNS):
        noise = np.random.default_rng(seed).normal(0.0, 0.02, (len(points), 1))
        told_mm = stated_part * 0.02
        cloud = cloud_of(
            points + up * noise, exposure, sigma_mm=1e-4, noise_mm=told_mm, noise_along=up
        )
        result = inspect_step(cloud, 20.0)
        assert not isinstance(result, FitFailure)
        found.append(result.height)
    scatter = float(np.std([item.value_mm for item in found], ddof=1))
    stated = float(np.mean([item.sigma_mm for item in found]))
    assert 1.0 / SPREAD_LIMIT < scatter / stated < SPREAD_LIMIT


def test_points_of_unlike_noise_that_is_stated_rightly_widen_nothing() -> None:
    """Every fourth is four times as noisy: medians of all differences tell more than is stated."""
    points, exposure = block_stripes(20.0)
    up, rng = np.array([0.0, 0.0, 1.0]), np.random.default_rng(4)
    told_mm = np.where(rng.random(len(points)) < 0.25, 0.04, 0.01)
    noise = told_mm[:, None] * rng.standard_normal((len(points), 1))
    sheet = np.zeros(len(points), dtype=np.int64)
    cloud = replace(cloud_of(points + up * noise, exposure, sigma_mm=1e-4), sheet=sheet)
    assert _unstated_mm2(noise[:, 0], cloud, np.arange(len(points)), told_mm**2) == 0.0
    assert _unstated_mm2(3.0 * noise[:, 0], cloud, np.arange(len(points)), told_mm**2) > 0.0


def test_what_the_arm_errs_alike_at_all_postures_is_in_sigma() -> None:
    """As the fitted ball grows by where all points are moved along one axis of the head each."""
    arm_mm, outward, exposure = 0.016, ball_stripes(16, 30), np.repeat(np.arange(16), 30)
    towards = np.array([outward[exposure == k].mean(axis=0) for k in range(16)])
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    across = np.cross(towards, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across, axis=1)[:, None]
    turns = np.stack([np.cross(across, -towards), across, -towards], axis=2)
    errors = CalibrationErrors(
        turns=turns,
        middle=np.zeros((1, 2)),
        half_width=np.ones((1, 2)),
        modes_mm=np.zeros((1, len(FIELD_POWERS), 3, 1)),
        arm_mm=arm_mm,
    )
    points = RADIUS_MM * outward
    plain = cloud_of(points, exposure, sigma_mm=1e-4, noise_mm=1e-4, noise_along=outward)
    cloud = replace(plain, seen_from_mm=150.0 * towards, calibration_errors=errors)
    grown = []
    for k in range(3):
        moved = fit_sphere(points + arm_mm * turns[exposure][:, :, k])
        assert not isinstance(moved, FitFailure)
        grown.append(2.0 * (moved.value.radius_mm - RADIUS_MM))
    found = inspect_sphere(cloud, 2 * RADIUS_MM)
    assert not isinstance(found, FitFailure)
    assert found.diameter.sigma_mm == pytest.approx(np.linalg.norm(grown), rel=0.05)
