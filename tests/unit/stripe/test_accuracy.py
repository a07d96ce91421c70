# SPDX-License-Identifier: Apache-2.0
"""Noise, bias, completeness and sigma of extracted stripes against the rendered truth."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from armscan.records.exposure import Exposure
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.image import StripeOptions
from rigs.stripe_image import (
    NO_NOISE,
    CircleCurve,
    SimulatedStripe,
    StraightCurve,
    StripeNoise,
    StripeScene,
    WaveCurve,
)
from rigs.stripe_scenes import line, score

NOISE_LIMIT_PX = 0.045
BIAS_LIMIT_PX = 0.01
LOCKING_LIMIT_PX = 0.004
SEEDS = range(6)
RAW = StripeOptions(smoothing_px=0.0)


@pytest.mark.parametrize("angle_deg", [0.7, 23.0, 44.6, 66.0, 90.4, 113.0, 135.5, 158.0])
def test_noise_bias_and_completeness_at_any_slope(angle_deg: float) -> None:
    width, height = 320, 240
    c, s = abs(np.cos(np.radians(angle_deg))), abs(np.sin(np.radians(angle_deg)))
    inside = 2.0 * min(112.0 / max(s, 1e-9), 152.0 / max(c, 1e-9))
    result = score(StripeScene((line(angle_deg),), width, height), SEEDS, length_px=inside)
    # neighbours share their smoothing window, so the mean's own noise is that of about n / 17
    mean_noise = 3.5 * result.rms_px / np.sqrt(len(result.error_px) / 17.0)
    assert result.rms_px < NOISE_LIMIT_PX
    assert abs(result.error_px.mean()) < BIAS_LIMIT_PX + mean_noise
    assert result.false == 0
    assert result.completeness > 0.995


@pytest.mark.parametrize("angle_deg", [0.5, 30.0, 45.0, 88.5, 120.0, 150.0])
def test_no_bias_and_no_pixel_locking_without_noise(angle_deg: float) -> None:
    # 14 bits: at exactly 45 degrees every column has the same phase and the same rounding error
    scene = StripeScene((line(angle_deg),), 320, 240, noise=NO_NOISE, bits=14)
    result = score(scene, range(1))
    assert abs(result.error_px.mean()) < 0.001
    assert result.error_px.std() < LOCKING_LIMIT_PX


@pytest.mark.parametrize("sigma_px", [0.8, 1.5, 5.0, 8.0])
def test_width_is_found_and_sigma_is_honest(sigma_px: float) -> None:
    result = score(StripeScene((line(12.0, sigma_px=sigma_px),), 320, 240), SEEDS)
    widths = np.concatenate([p.width_px for p in result.profiles])
    # a pixel is a box, of variance 1/12
    assert np.median(widths) == pytest.approx(np.sqrt(sigma_px**2 + 1.0 / 12.0), rel=0.04)
    assert result.normalised.std() == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize(
    "noise",
    [StripeNoise(), StripeNoise(speckle=0.0), StripeNoise(grain_px=1.0), StripeNoise(read=3.0)],
)
@pytest.mark.parametrize("options", [StripeOptions(), RAW])
def test_normalised_errors_have_unit_variance(noise: StripeNoise, options: StripeOptions) -> None:
    stripes = tuple(
        SimulatedStripe(StraightCurve(300.0, 40.3 + 60.0 * k, 3.0 + k)) for k in range(4)
    )
    result = score(StripeScene(stripes, 600, 290, noise=noise), range(4), options)
    assert result.normalised.std() == pytest.approx(1.0, abs=0.15)


def test_fit_reaches_the_cramer_rao_bound() -> None:
    sigma, peak, background = 3.0, 150.0, 4.0
    result = score(StripeScene((line(0.4),), 320, 240), range(8), RAW)
    phases = np.linspace(-0.5, 0.5, 11)[:, None]
    u = (np.arange(-20, 21) - phases) / sigma
    m = peak * np.exp(-0.5 * u * u)
    variance = (0.2 * m) ** 2 + (m + background) / 10.0 + 1.0 + 1.0 / 12.0
    bound = 1.0 / ((m * u / sigma) ** 2 / variance).sum(axis=1).mean()
    assert bound / result.error_px.var() > 0.85


@pytest.mark.parametrize("radius_px", [100.0, 60.0])
def test_circle_is_one_closed_unbiased_segment(radius_px: float) -> None:
    stripe = SimulatedStripe(CircleCurve(120.3, 120.2, radius_px))
    clean = score(StripeScene((stripe,), 240, 240, noise=NO_NOISE), range(1))
    assert abs(clean.error_px.mean()) < 0.003
    assert clean.error_px.std() < 0.012
    noisy = score(StripeScene((stripe,), 240, 240), range(3))
    assert noisy.rms_px < NOISE_LIMIT_PX
    assert abs(noisy.error_px.mean()) < BIAS_LIMIT_PX
    assert all(p.segment[p.is_accepted].max() == 0 for p in noisy.profiles)


@pytest.mark.parametrize("angle_deg", [45.0, 135.0, 0.0, 90.0])
def test_normals_of_a_segment_point_to_one_side(angle_deg: float) -> None:
    """Also where a line runs as a single normal's sign would turn: residuals keep their side."""
    straight = score(StripeScene((line(angle_deg),), 320, 240), range(2))
    ring = SimulatedStripe(CircleCurve(120.3, 120.2, 100.0))
    for profile in (*straight.profiles, *score(StripeScene((ring,), 240, 240), range(1)).profiles):
        is_same = profile.segment[1:] == profile.segment[:-1]
        cosine = np.einsum("ni,ni->n", profile.normals_px[1:], profile.normals_px[:-1])
        assert is_same.sum() > 200
        assert cosine[is_same].min() > 0.8


def test_waves_are_not_smoothed_away() -> None:
    wave = WaveCurve(0.0, 120.0, 10.0, amplitude_px=10.0, period_px=120.0)
    clean = score(StripeScene((SimulatedStripe(wave),), 320, 240, noise=NO_NOISE), range(1))
    crest_bias = 3.0**2 / (2.0 * wave.crest_radius_px)
    assert clean.rms_px < 0.1 * crest_bias


def test_saturated_line_is_fitted_on_its_flanks() -> None:
    result = score(StripeScene((line(20.0, peak=700.0),), 320, 240), SEEDS)
    assert result.rms_px < NOISE_LIMIT_PX
    assert abs(result.error_px.mean()) < BIAS_LIMIT_PX


@pytest.mark.parametrize("sigma_px", [0.3, 0.4, 0.5, 0.6])
@pytest.mark.parametrize("peak", [120.0, 220.0, 500.0])
def test_line_thinner_than_its_pixels_is_complete(sigma_px: float, peak: float) -> None:
    """Of 500 one or two pixels are clipped: two are left beside them for centre, height, width.

    What neighbours err alike by changes its sign along the curve, so that such lines err by less
    than they claim.
    """
    rng = np.random.default_rng(1)
    row, column = np.mgrid[:480, :640]
    centre = 240.0 + 30.0 * np.sin(column / 90.0)
    edges = (ndtr((row + side - centre) / sigma_px) for side in (0.5, -0.5))
    light = peak * np.sqrt(2.0 * np.pi) * sigma_px * np.subtract(*edges)
    image = np.clip(15.0 + light + rng.normal(0.0, 1.5, light.shape), 0.0, 255.0)
    profile = extract_stripes(Exposure(image.round().astype(np.uint8), "thin"))
    good = profile.select(profile.is_accepted)
    x, y = good.points_px.T
    error = y - 240.0 - 30.0 * np.sin(x / 90.0)
    assert len(good) > 630
    assert 0.4 < np.sqrt(np.mean((error / good.sigma_px) ** 2)) < 1.5
    assert np.sqrt((error**2).mean()) < NOISE_LIMIT_PX


@pytest.mark.parametrize("sigma_px", [0.5, 0.6, 0.8])
def test_thin_level_line_is_not_pulled_by_its_own_sampling(sigma_px: float) -> None:
    """All profiles of a level line are sampled alike: what they have in common is no skew of it."""
    rng = np.random.default_rng(2)
    row = np.mgrid[:60, :400][0]
    for centre in 30.0 + np.arange(0.0, 1.0, 0.1):
        edges = (ndtr((row + side - centre) / sigma_px) for side in (0.5, -0.5))
        light = 180.0 * np.sqrt(2.0 * np.pi) * sigma_px * np.subtract(*edges)
        image = np.clip(15.0 + light + rng.normal(0.0, 1.0, light.shape), 0.0, 255.0)
        profile = extract_stripes(Exposure(image.round().astype(np.uint8), "level"))
        good = profile.points_px[profile.is_accepted]
        assert len(good) > 200
        assert abs(good[:, 1].mean() - centre) < BIAS_LIMIT_PX


@pytest.mark.parametrize(
    ("most_px", "own_px"), [(3.0, 1.1), (3.0, 1.2), (6.0, 2.4), (1.5, 3.75), (2.5, 6.3), (2.5, 7.5)]
)
def test_lines_of_other_widths_than_most_are_complete_and_honest(
    most_px: float, own_px: float
) -> None:
    """Three lines of one width tell the typical one; the fourth has its own."""
    curves = [StraightCurve(300.0, 40.0 + 60.0 * k, 3.0 + k) for k in range(4)]
    stripes = [SimulatedStripe(c, sigma_px=most_px, peak=300.0) for c in curves[:3]]
    stripes.append(SimulatedStripe(curves[3], sigma_px=own_px, peak=150.0))
    scene = StripeScene(tuple(stripes), 600, 300)
    result = score(scene, range(3))
    errors, squares = [], []
    for profile in result.profiles:
        good = profile.select(profile.is_accepted)
        distance, which, _ = scene.errors(good.points_px)
        errors.append(distance[which == 3])
        squares.append((distance / good.sigma_px)[which == 3] ** 2)
    error = np.concatenate(errors)
    assert len(error) > 0.98 * 3 * 600
    # a fit has some 0.2 grey levels of speckle in each of its pixels: see the bound above
    assert np.sqrt((error**2).mean()) < 0.015 * max(own_px, 3.0)
    assert np.sqrt(np.concatenate(squares).mean()) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("slope", [0.002, 0.01])
def test_what_is_taken_for_a_width_is_not_smoothed_away(slope: float) -> None:
    """Of a level clipped line neighbours err alike by a width that is not the typical one."""
    squares = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        row, column = np.mgrid[:120, :640]
        centre = 60.0 + rng.uniform() + slope * column
        edges = (ndtr((row + side - centre) / 0.3) for side in (0.5, -0.5))
        light = 500.0 * np.sqrt(2.0 * np.pi) * 0.3 * np.subtract(*edges)
        image = np.clip(15.0 + light + rng.normal(0.0, 1.5, light.shape), 0.0, 255.0)
        profile = extract_stripes(Exposure(image.round().astype(np.uint8), "level"))
        good = profile.select(profile.is_accepted)
        x, y = good.points_px.T
        squares.append(((y - centre[0, 0] - slope * x) / good.sigma_px) ** 2)
    assert len(np.concatenate(squares)) > 2000
    assert np.sqrt(np.concatenate(squares).mean()) < 3.5


@pytest.mark.parametrize("sigma_px", [1.5, 4.0])
@pytest.mark.parametrize("noise", [4.0, 10.0])
def test_line_of_three_times_the_noise_of_a_pixel_is_found(sigma_px: float, noise: float) -> None:
    scene = StripeScene(
        (line(20.0, sigma_px=sigma_px, peak=3.0 * noise),), 320, 240, noise=StripeNoise(read=noise)
    )
    result = score(scene, SEEDS, length_px=300.0 / np.cos(np.radians(20.0)))
    assert result.completeness > 0.99
    assert result.false == 0
    assert result.normalised.std() == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("grain_px", [0.0, 1.0])
@pytest.mark.parametrize("noise", [0.3, 3.0, 25.0])
def test_noise_alone_shows_no_line(noise: float, grain_px: float) -> None:
    for seed in range(4):
        grain = np.random.default_rng(seed).normal(size=(480, 640))
        if grain_px > 0.0:
            grain = gaussian_filter(grain, grain_px)
        image = np.clip(60.0 + noise / grain.std() * grain, 0.0, 255.0)
        profile = extract_stripes(Exposure(image.round().astype(np.uint8), "noise"))
        assert not profile.is_accepted.any()


@pytest.mark.parametrize("period_px", [0.0, 8.0, 16.0, 32.0, 60.0])
@pytest.mark.parametrize("height", [2.0, 4.0])
def test_rows_that_a_lamp_or_the_sensor_brightens_are_no_lines(
    period_px: float, height: float
) -> None:
    """Beside noise of 4: of each row by itself (period 0), or in waves down the image."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        rows = rng.normal(0.0, height, 480)
        if period_px > 0.0:
            rows = height * np.sin(2.0 * np.pi * np.arange(480) / period_px)
        image = 60.0 + rng.normal(0.0, 4.0, (480, 640)) + rows[:, None]
        profile = extract_stripes(Exposure(image.round().astype(np.uint8), "rows"))
        assert not profile.is_accepted.any()


@pytest.mark.parametrize(("most_px", "own_px", "apart_px"), [(2.5, 7.0, 36.0), (3.0, 6.0, 36.0)])
def test_a_wide_line_does_not_take_its_neighbour_for_background(
    most_px: float, own_px: float, apart_px: float
) -> None:
    curves = [StraightCurve(320.0, y, 1.5) for y in (40.0, 90.0, 150.0)]
    stripes = [SimulatedStripe(curve, sigma_px=most_px, peak=150.0) for curve in curves]
    wide = StraightCurve(320.0, 150.0 + apart_px, 1.5)
    stripes.append(SimulatedStripe(wide, sigma_px=own_px, peak=150.0))
    scene = StripeScene(tuple(stripes), 640, 260)
    result = score(scene, range(2))
    squares = []
    for profile in result.profiles:
        good = profile.select(profile.is_accepted)
        distance, which, _ = scene.errors(good.points_px)
        squares.append((distance / good.sigma_px)[which == 3] ** 2)
    assert len(np.concatenate(squares)) > 1200
    assert np.sqrt(np.concatenate(squares).mean()) < 1.5


def test_weak_line_is_complete() -> None:
    scene = StripeScene((line(20.0, peak=15.0),), 320, 240)
    result = score(scene, SEEDS, length_px=300.0 / np.cos(np.radians(20.0)))
    assert result.completeness > 0.995
    assert result.false == 0
