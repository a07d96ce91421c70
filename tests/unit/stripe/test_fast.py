# SPDX-License-Identifier: Apache-2.0
"""The fast way to stripe centres: against the truth, against twins of its loops, at its limits."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from armscan.kernels.chains import middle_of_squares
from armscan.kernels.stripe import column_runs, columns
from armscan.records.exposure import Exposure, SensorWindow
from armscan.records.profile import Profile, StripeFlag
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import StripeOptions
from armscan.vision.stripe.ridge import measure_level
from armscan.vision.stripe.smooth import quadratic_weights
from rigs.stripe_image import (
    NO_NOISE,
    CircleCurve,
    SimulatedStripe,
    StraightCurve,
    StripeNoise,
    StripeScene,
)
from rigs.stripe_scenes import line, score

FAST = StripeOptions(method="fast")
RAW = StripeOptions(method="fast", smoothing_px=0.0)
NOISE_LIMIT_PX, BIAS_LIMIT_PX, LOCKING_LIMIT_PX = 0.045, 0.01, 0.004


@pytest.mark.parametrize("angle_deg", [0.7, 23.0, 44.6, 50.0, 66.0, 90.4, 113.0, 158.0])
def test_noise_bias_and_completeness_at_any_slope(angle_deg: float) -> None:
    c, s = abs(np.cos(np.radians(angle_deg))), abs(np.sin(np.radians(angle_deg)))
    inside = 2.0 * min(100.0 / max(s, 1e-9), 140.0 / max(c, 1e-9))
    scene = StripeScene((line(angle_deg),), 320, 240)
    result = score(scene, range(6), FAST, length_px=inside)
    mean_noise = 3.5 * result.rms_px / np.sqrt(len(result.error_px) / 17.0)
    assert result.rms_px < NOISE_LIMIT_PX
    assert abs(result.error_px.mean()) < BIAS_LIMIT_PX + mean_noise
    assert result.false == 0
    assert result.completeness > 0.99


@pytest.mark.parametrize("angle_deg", [0.5, 30.0, 88.5, 120.0])
def test_no_bias_and_no_pixel_locking_without_noise(angle_deg: float) -> None:
    scene = StripeScene((line(angle_deg),), 320, 240, noise=NO_NOISE, bits=14)
    result = score(scene, range(1), FAST)
    assert abs(result.error_px.mean()) < 0.001
    assert result.error_px.std() < LOCKING_LIMIT_PX


@pytest.mark.parametrize("noise", [StripeNoise(), StripeNoise(speckle=0.0), StripeNoise(read=3.0)])
@pytest.mark.parametrize("options", [FAST, RAW])
def test_normalised_errors_have_unit_variance(noise: StripeNoise, options: StripeOptions) -> None:
    stripes = tuple(
        SimulatedStripe(StraightCurve(300.0, 40.3 + 60.0 * k, 3.0 + k)) for k in range(4)
    )
    result = score(StripeScene(stripes, 600, 290, noise=noise), range(4), options)
    assert result.normalised.std() == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("sigma_px", [0.8, 1.5, 5.0, 8.0])
def test_width_is_found(sigma_px: float) -> None:
    result = score(StripeScene((line(12.0, sigma_px=sigma_px),), 320, 240), range(3), FAST)
    widths = np.concatenate([p.width_px for p in result.profiles])
    assert np.median(widths) == pytest.approx(np.sqrt(sigma_px**2 + 1.0 / 12.0), rel=0.06)


@pytest.mark.parametrize("angles", [(45.0, -45.0), (20.0, -20.0), (10.0, 30.0), (-50.0, 55.0)])
def test_nothing_false_beside_a_crossing(angles: tuple[float, float]) -> None:
    scene = StripeScene(tuple(line(angle) for angle in angles), 320, 240)
    result = score(scene, range(3), FAST)
    assert result.false == 0
    assert result.rms_px < 1.2 * NOISE_LIMIT_PX
    assert len(result.error_px) > 3 * 300


def test_lines_that_run_into_each_other_all_along_give_no_points() -> None:
    pair = tuple(SimulatedStripe(StraightCurve(160.0, y, 8.0)) for y in (100.0, 112.0))
    profile = extract_stripes(StripeScene(pair, 320, 240).expose(0), FAST)
    assert not profile.is_accepted.any()


def test_a_circle_is_found_by_columns_and_rows() -> None:
    scene = StripeScene((SimulatedStripe(CircleCurve(120.3, 120.2, 100.0)),), 240, 240)
    result = score(scene, range(3), FAST, length_px=2.0 * np.pi * 100.0)
    assert result.rms_px < NOISE_LIMIT_PX
    assert abs(result.error_px.mean()) < BIAS_LIMIT_PX
    assert result.completeness > 0.8
    assert result.false == 0


def sorted_points(profile: Profile, columns_: tuple[int, int]) -> np.ndarray:
    points = profile.points_px[profile.is_accepted][:, columns_]
    return points[np.lexsort(points.T)]


@pytest.mark.parametrize("angle_deg", [10.0, 70.0])
def test_rows_and_columns_exchanged_give_the_same_points(angle_deg: float) -> None:
    exposure = StripeScene((line(angle_deg),), 320, 240).expose(3)
    turned = Exposure(np.ascontiguousarray(exposure.image.T), "turned")
    here = sorted_points(extract_stripes(exposure, FAST), (0, 1))
    there = sorted_points(extract_stripes(turned, FAST), (1, 0))
    # the noise of an image is told along its rows: weights differ a little
    np.testing.assert_allclose(here, there, atol=2e-3)


def test_an_image_of_sixteen_bits_gives_the_points_of_its_bytes() -> None:
    exposure = StripeScene((line(10.0),), 320, 240).expose(3)
    deep = Exposure(exposure.image.astype(np.uint16), "deep", bits_used=8)
    a, b = (extract_stripes(one, FAST) for one in (exposure, deep))
    assert abs(len(a) - len(b)) <= 1
    near = np.abs(sorted_points(a, (0, 1))[:200] - sorted_points(b, (0, 1))[:200])
    # the runs are cut at whole levels in one and not in the other
    assert np.median(near) < 0.002


@pytest.mark.parametrize("bits", [8, 12])
def test_a_clipped_core_is_flagged(bits: int) -> None:
    """The lines that are clipped all along, and no others."""
    for peak, is_clipped in ((600.0, True), (150.0, False)):
        stripe = line(23.0, sigma_px=2.0, peak=peak)
        scene = StripeScene((stripe,), 320, 240, noise=StripeNoise(0.02), bits=bits)
        flags = extract_stripes(scene.expose(1), FAST).flags
        is_flagged = (flags & int(StripeFlag.SATURATED)) != 0
        assert len(flags) > 200
        assert np.mean(is_flagged == is_clipped) > 0.95


def test_points_are_those_of_the_full_sensor() -> None:
    window = SensorWindow(x_px=100, y_px=60, binning=2)
    plain = StripeScene((line(10.0),), 320, 240)
    moved = StripeScene((line(10.0),), 320, 240, window=window)
    a = extract_stripes(plain.expose(1), FAST)
    b = extract_stripes(moved.expose(1), FAST)
    np.testing.assert_allclose(b.points_px, window.to_full_sensor(a.points_px), atol=1e-9)
    np.testing.assert_allclose(b.sigma_px, 2.0 * a.sigma_px)


def test_images_without_lines_and_small_ones_are_taken() -> None:
    for shape in ((3, 3), (40, 30), (200, 63), (64, 64)):
        dark = extract_stripes(Exposure(np.full(shape, 5, np.uint8), "dark"), FAST)
        assert len(dark) == 0
    narrow = StripeScene((SimulatedStripe(StraightCurve(20.0, 60.0, 5.0)),), 40, 120).expose(0)
    assert extract_stripes(narrow, FAST).is_accepted.sum() > 30


def test_runs_are_those_of_a_plain_search() -> None:
    rng = np.random.default_rng(1)
    image = (rng.random((90, 150)) * 60.0).astype(np.uint8)
    image[30:40] += 150
    level = measure_level(image, 40.0)
    cells = np.ones_like(level.lit)
    runs = np.zeros((20000, 3), np.int32)
    flat = np.full_like(level.background, 30.0)
    n = column_runs.find_column_runs(image, flat, cells, 50.0, 1.0, runs)
    lit = np.pad(image > 80, ((1, 1), (0, 0))).astype(np.int8)
    expected = set()
    for x in range(image.shape[1]):
        edges = np.flatnonzero(np.diff(lit[:, x]))
        expected |= {(x, a, b - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)}
    assert {tuple(run) for run in runs[:n].tolist()} == expected
    assert n == len(expected)


def test_the_weighted_step_is_that_of_least_squares() -> None:
    """One Gauss-Newton step of centre and log amplitude, from where the first pass left them."""
    y = np.arange(60)
    sigma, noise = 3.0, np.array([0.03, 0.1, 1.0], np.float32)
    level = 8.0 + 140.0 * np.exp(-0.5 * ((y - 28.3) / sigma) ** 2)
    image = np.repeat(level.astype(np.float32)[:, None], 20, axis=1)
    points = np.zeros((1, column_runs.POINT_COLUMNS), np.int32)
    points[0, : column_runs.POINT_HIGH + 1] = 2, 22, 35
    given = np.zeros((columns.FIRST_ROWS, 1))
    given[:, 0] = 130.0, 28.0, sigma, 8.0, 8.0, 4.0
    result = np.zeros((columns.SECOND_ROWS, 1))
    no_bytes = np.zeros((1, 1), np.uint8)
    columns.fit_columns(no_bytes, image, 1.0, no_bytes, np.inf, points, given, noise, result)

    near = np.abs(y - 28.0) < columns.LINE_SIGMAS * sigma
    start = 130.0 * np.exp(-0.5 * ((y - 28.0) / sigma) ** 2)
    weight = 1.0 / np.sqrt(noise[0] * start**2 + noise[1] * (start + 8.0) + noise[2])

    def linear(p: np.ndarray) -> np.ndarray:
        model = start * (1.0 + p[0] * (y - 28.0) / sigma + p[1])
        return np.asarray(((level - 8.0 - model) * weight)[near])

    fit = least_squares(linear, np.zeros(2))
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)
    assert result[columns.CENTRE, 0] == pytest.approx(28.0 + sigma * fit.x[0], abs=2e-3)
    assert result[columns.VARIANCE, 0] == pytest.approx(sigma**2 * covariance[0, 0], rel=5e-3)


def test_means_along_chains_are_those_of_a_plain_sum() -> None:
    rng = np.random.default_rng(2)
    values, weight = rng.normal(size=(2, 40)), rng.random((2, 40)) + 0.1
    weight[0, 5:9], values[0, 5:9] = 0.0, np.nan
    start, mean = np.array([0, 17, 40]), np.zeros((2, 40))
    column_runs.mean_along(values, weight, start, 3, mean)
    for row in range(2):
        for i in range(40):
            first, stop = (0, 17) if i < 17 else (17, 40)
            own = slice(max(i - 3, first), min(i + 4, stop))
            w, v = weight[row, own], np.nan_to_num(values[row, own])
            assert mean[row, i] == pytest.approx((w * v).sum() / w.sum(), abs=1e-9)


def test_smoothing_is_a_local_quadratic_with_its_variance_slope_and_bend() -> None:
    x = np.arange(60.0)
    centre = 5.0 + 0.3 * x + 0.004 * x**2
    halves = np.array([3, 7])
    weights = np.zeros((2, 8))
    weights[0, :4], weights[1] = quadratic_weights(3)[3:], quadratic_weights(7)[7:]
    norm = (quadratic_weights(7) ** 2).sum()
    inflation = np.ones(2)
    result = np.zeros((column_runs.SMOOTH_ROWS, 60))
    given = (centre, np.full(60, 0.01), np.array([0, 60]), halves, weights, inflation)
    column_runs.smooth_stretches(*given, 2.2, result)
    np.testing.assert_allclose(result[column_runs.SMOOTHED], centre, atol=1e-9)
    inner = slice(column_runs.TANGENT_HALF, 60 - column_runs.TANGENT_HALF)
    np.testing.assert_allclose(
        result[column_runs.SLOPE, inner], (0.3 + 0.008 * x)[inner], atol=1e-9
    )
    np.testing.assert_allclose(result[column_runs.BEND, inner], 0.008, atol=1e-9)
    assert result[column_runs.SMOOTH_VARIANCE, 30] == pytest.approx(0.01 * norm)
    assert result[column_runs.SMOOTH_VARIANCE, 1] == pytest.approx(0.01)

    noisy = centre + np.random.default_rng(0).normal(0.0, 0.1, 60)
    column_runs.smooth_stretches(noisy, *given[1:], 100.0, result)
    fitted = np.polyval(np.polyfit(x[23:38], noisy[23:38], 2), 30.0)
    assert result[column_runs.SMOOTHED, 30] == pytest.approx(fitted, abs=1e-9)


def test_a_bend_is_known_as_well_as_it_is_said() -> None:
    rng = np.random.default_rng(3)
    half = column_runs.TANGENT_HALF
    x = np.arange(-half, half + 1.0)
    bends = [2.0 * np.polyfit(x, rng.normal(size=len(x)), 2)[0] for _ in range(3000)]
    assert np.var(bends) == pytest.approx(column_runs.BEND_VARIANCE, rel=0.1)


def test_faint_reflections_are_left_out() -> None:
    bright, faint = (
        SimulatedStripe(StraightCurve(160.0, y, 3.0), peak=peak)
        for y, peak in ((60.0, 200.0), (160.0, 14.0))
    )
    profile = extract_stripes(StripeScene((bright, faint), 320, 240).expose(0), FAST)
    found = profile.points_px[profile.is_accepted, 1]
    assert len(found) > 300
    assert (found < 100.0).all()


def test_points_beside_worse_ones_do_not_state_their_own_variance_alone() -> None:
    weights = np.zeros((1, 4))
    weights[0] = quadratic_weights(3)[3:]
    variance = np.where(np.arange(40) < 20, 0.01, 1.0)
    result = np.zeros((column_runs.SMOOTH_ROWS, 40))
    stretch = np.array([0, 40])
    column_runs.smooth_stretches(
        np.zeros(40), variance, stretch, np.array([3]), weights, np.ones(1), 2.2, result
    )
    full = quadratic_weights(3) ** 2
    for i in (10, 18, 19, 20, 30):
        expected = (full * variance[i - 3 : i + 4]).sum()
        assert result[column_runs.SMOOTH_VARIANCE, i] == pytest.approx(expected)


@pytest.mark.parametrize("is_turned", [False, True])
def test_the_border_of_a_narrow_image_ends_no_line(is_turned: bool) -> None:
    scene = StripeScene((SimulatedStripe(StraightCurve(24.0, 200.0, 27.0)),), 48, 400)
    exposure = scene.expose(1)
    if is_turned:
        exposure = Exposure(np.ascontiguousarray(exposure.image.T), "turned")
    profile = extract_stripes(exposure, FAST)
    assert profile.is_accepted.sum() == 48


def test_what_lacks_the_laser_colour_is_left_out() -> None:
    red = StripeScene((SimulatedStripe(StraightCurve(160.0, 70.0, 3.0)),), 320, 240)
    white = StripeScene((SimulatedStripe(StraightCurve(160.0, 170.0, 3.0)),), 320, 240)
    image = np.maximum(
        red.expose_red(1, overdrive=1.0).image,
        np.repeat(white.expose(2).image[:, :, None], 3, axis=2),
    )
    options = StripeOptions(method="fast", laser_colour="red")
    profile = extract_stripes(Exposure(image, "colour"), options)
    found = profile.points_px[profile.is_accepted, 1]
    assert len(found) > 280
    assert (found < 120.0).all()


def drawn(rows: int, n: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.5, 4.0, (rows, n))


def drawn_points(n: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    points = np.zeros((n, column_runs.POINT_COLUMNS), np.int32)
    points[:, column_runs.POINT_COLUMN] = np.cumsum(rng.integers(1, 9, n))
    points[:, column_runs.POINT_LOW] = rng.integers(10, 20, n)
    points[:, column_runs.POINT_HIGH] = points[:, column_runs.POINT_LOW] + rng.integers(2, 15, n)
    points[:, column_runs.POINT_BELOW] = rng.integers(1, 30, n)
    points[:, column_runs.POINT_ABOVE] = rng.integers(1, 30, n)
    points[:, column_runs.POINT_CHAIN] = np.arange(n) // 17
    return points


def test_sides_are_weighed_and_replaced_as_numpy_does() -> None:
    n = 200
    points, sigma, base = drawn_points(n), *drawn(2, n, 2)
    first = drawn(columns.FIRST_ROWS, n, 3)
    first[columns.N_SIDES, ::5] = 0.0
    first[columns.AMPLITUDE, ::7] = 0.0
    middle = 0.5 * (points[:, column_runs.POINT_LOW] + points[:, column_runs.POINT_HIGH])
    first[columns.CENTRE] = middle + np.linspace(-9.0, 9.0, n)
    weight = np.zeros((3, n))
    columns.weigh_sides(first, points, sigma, 3.0, weight)
    has_sides = first[columns.N_SIDES] > 0.0
    np.testing.assert_array_equal(weight[0], first[columns.AMPLITUDE] ** 2)
    for row, side in ((1, column_runs.POINT_BELOW), (2, column_runs.POINT_ABOVE)):
        np.testing.assert_array_equal(weight[row], has_sides & (points[:, side] > 3.0 * sigma))
    mean, height = drawn(3, n, 4), np.full(n, 7.0)
    mean[0, ::3] = mean[1, ::4] = mean[2, ::6] = np.nan
    found = first.copy()
    columns.keep_means(mean, points, sigma, base, height, np.array([1.0, 3.0, 2.0]), found)
    other = np.where(np.isnan(mean[2]), base, mean[2])
    low_side = np.where(np.isnan(mean[1]), other, mean[1])
    own = np.where(np.isfinite(mean[0]), np.clip(mean[0], 1.0, 3.0), sigma)
    np.testing.assert_array_equal(found[columns.SIGMA], own)
    np.testing.assert_array_equal(found[columns.LOW_SIDE], low_side)
    expected = np.where(np.isnan(mean[2]), low_side, mean[2])
    np.testing.assert_array_equal(found[columns.HIGH_SIDE], expected)
    is_lost = (np.abs(first[columns.CENTRE] - middle) > 2.0 * sigma) | (first[0] == 0.0)
    assert 0 < is_lost.sum() < n
    expected = np.where(is_lost, middle, first[columns.CENTRE])
    np.testing.assert_array_equal(found[columns.CENTRE], expected)
    np.testing.assert_array_equal(found[columns.AMPLITUDE], np.where(is_lost, 7.0, first[0]))


def test_near_lines_and_flags_are_those_of_numpy() -> None:
    n = 400
    points, fits, first = drawn_points(n), drawn(8, n, 5), drawn(6, n, 6)
    steep, longest = drawn(1, n, 7)[0], 3.0 * drawn(1, n, 8)[0]
    dips = (np.arange(n) % 11 == 0).astype(np.uint8)
    near = np.zeros(n, np.uint8)
    given = (fits, points, steep, longest, dips, np.array([6.0, 1.5, 1.1, 1.6]))
    count = columns.mark_near(*given, near)
    sigma = fits[columns.SIGMA]
    length = points[:, column_runs.POINT_HIGH] - points[:, column_runs.POINT_LOW] + 1.0
    sides = points[:, [column_runs.POINT_BELOW, column_runs.POINT_ABOVE]]
    gap = sides.min(axis=1)
    expected = ((gap <= sigma) | (gap + length < 6.0 * sigma)) & (fits[columns.AMPLITUDE] > 1.5)
    expected |= (length > longest) | (sigma > 1.6 * 1.1 * steep) | (dips > 0)
    np.testing.assert_array_equal(near, expected)
    assert 0 < count == expected.sum() < n
    fits[columns.N_CLIPPED, ::2] = 0.0
    leans, flags = 20.0 * drawn(2, n, 9), np.zeros(n, np.int64)
    limits, bits = np.array([0.4, 0.3, 0.5, 0.7, 2.0]), np.array([1, 2, 4, 8])
    columns.flag_points(fits, first, leans, near, limits, bits, flags)
    lean = np.abs(leans[0] - 0.3 * leans[1])
    step = np.abs(first[columns.HIGH_SIDE] - first[columns.LOW_SIDE])
    told = (
        fits[columns.N_CLIPPED] > 0.0,
        step > 0.4 * fits[columns.AMPLITUDE],
        near > 0,
        (lean > 2.0 * np.sqrt(leans[1])) & (lean > np.maximum(0.5, 0.7 / sigma) * leans[1]),
    )
    for bit, is_set in zip(bits, told, strict=True):
        assert 0 < is_set.sum() < n
        np.testing.assert_array_equal((flags & bit) > 0, is_set)


@pytest.mark.parametrize("down", [0, 1])
def test_smoothed_centres_become_points_as_in_numpy(down: int) -> None:
    n = 120
    rows = np.flatnonzero(np.arange(n) % 4 != 1)
    smoothed, fits, variance = drawn(4, len(rows), 10), drawn(8, n, 11), drawn(1, len(rows), 12)[0]
    found, slope, sigma, length = fits.copy(), *drawn(3, n, 13)
    columns.keep_smoothed(rows, smoothed, 0.1 * variance, 1.5, found, slope, sigma, length)
    bend, steep = smoothed[column_runs.BEND], smoothed[column_runs.SLOPE] ** 2
    certain = np.maximum(1.0 - 0.1 * variance * column_runs.BEND_VARIANCE / bend**2, 0.0)
    gain = (fits[columns.BEND_GAIN] * fits[columns.SIGMA] ** 2)[rows]
    pull = 0.5 * gain * certain * bend * steep / (1.0 + steep) ** 2
    expected = fits[columns.CENTRE].copy()
    expected[rows] = smoothed[column_runs.SMOOTHED] - pull
    np.testing.assert_allclose(found[columns.CENTRE], expected, rtol=1e-13)
    np.testing.assert_allclose(sigma[rows] ** 2, smoothed[column_runs.SMOOTH_VARIANCE])
    alike = np.maximum(0.15 * variance / smoothed[column_runs.SMOOTH_VARIANCE], 1.0)
    np.testing.assert_allclose(length[rows], alike)
    points = drawn_points(n)
    at, normals, measures = (
        np.zeros((len(rows), 2)),
        np.zeros((len(rows), 2)),
        drawn(3, len(rows), 1),
    )
    segment = np.zeros(len(rows), np.int64)
    scales = np.array([1.0, 2.0, 3.0, 5.0])
    given = (rows, points, found, slope, sigma, down, scales)
    columns.write_points(*given, at, normals, measures, segment)
    column, across = points[rows, column_runs.POINT_COLUMN], 1.0 / np.hypot(1.0, slope[rows])
    np.testing.assert_array_equal(at[:, 1 - down], column)
    np.testing.assert_array_equal(at[:, down], found[columns.CENTRE, rows])
    np.testing.assert_allclose(normals[:, 1 - down], -slope[rows] * across)
    np.testing.assert_allclose(normals[:, down], across)
    np.testing.assert_allclose(measures[0], 2.0 * np.maximum(sigma[rows] * across, 1.0))
    np.testing.assert_allclose(measures[1], 2.0 * found[columns.SIGMA, rows] * across)
    np.testing.assert_allclose(measures[2], 3.0 * found[columns.AMPLITUDE, rows])
    is_new = (np.diff(points[rows, column_runs.POINT_CHAIN]) != 0) | (np.diff(column) > 5)
    np.testing.assert_array_equal(np.diff(segment), is_new)


def test_the_middle_of_squares_is_that_of_sorted_values() -> None:
    rng = np.random.default_rng(14)
    for n in (1, 2, 3, 10, 501, 4000):
        for values in (rng.uniform(0.0, 9.0, n), rng.integers(0, 4, n) + 0.5, rng.pareto(2.0, n)):
            order = np.sort(values)
            weight = np.cumsum(order * order)
            expected = order[np.searchsorted(weight, 0.5 * weight[-1])]
            assert middle_of_squares(np.array(values)) == expected
