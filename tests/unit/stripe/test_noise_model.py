# SPDX-License-Identifier: Apache-2.0
"""The noise model of a line's pixels, from residuals as fits leave them."""

from typing import Any

import numpy as np
import pytest

import armscan.vision.stripe.fit
from armscan.geometry.arrays import FloatArray
from armscan.kernels.stripe.profile_fit import CENTRE, FIT_COLUMNS, fit_profiles, read_sides
from armscan.kernels.stripe.section import weigh_section
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.stripe.fit import estimate_noise, start_noise
from rigs.stripe_image import StripeNoise, StripeScene
from rigs.stripe_scenes import line

PEAK = 75.0
CONTRAST2, PER_GAIN, READ2 = 0.01, 0.2, 4.0


def bright_pixels(rng: np.random.Generator) -> FloatArray:
    """Levels, light and residuals across a line of speckle, shot noise and read noise."""
    u = np.tile(np.linspace(-4.0, 4.0, 17), 150)
    level = PEAK * np.exp(-0.5 * u * u)
    sigma = np.sqrt(CONTRAST2 * level**2 + PER_GAIN * level + READ2)
    return np.stack([level, level, rng.normal(0.0, sigma)])


def variance_at_peak(pixels: FloatArray) -> float:
    terms = start_noise(1.0)
    for _ in range(2):
        terms = estimate_noise(pixels, pixels.shape[1], PEAK, terms)
    return float(terms @ [PEAK**2, PEAK, 1.0])


@pytest.mark.parametrize("seed", range(5))
def test_faint_lines_of_little_noise_leave_bright_ones_theirs(seed: int) -> None:
    # Print edges that photographs shifted by part of a pixel leave are many and faint, and of
    # another noise than the laser's speckle.
    rng = np.random.default_rng(seed)
    bright = bright_pixels(rng)
    level = rng.uniform(0.13, 0.22, 2000) * PEAK
    faint = np.stack([level, level, rng.normal(0.0, 0.3, 2000)])
    truth = CONTRAST2 * PEAK**2 + PER_GAIN * PEAK + READ2
    assert variance_at_peak(bright) == pytest.approx(truth, rel=0.3)
    assert variance_at_peak(np.hstack([bright, faint])) == pytest.approx(truth, rel=0.3)


@pytest.mark.parametrize("sigma_px", [0.6, 1.0, 2.5])
def test_the_noise_of_a_line_is_told_whatever_its_width(
    sigma_px: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Of five pixels across a narrow line a fit of three parameters follows most.
    found = []

    def note(*given: Any) -> FloatArray:
        found.append(estimate_noise(*given))
        return found[-1]

    monkeypatch.setattr(armscan.vision.stripe.fit, "estimate_noise", note)
    noise = StripeNoise(speckle=0.1)
    for seed in range(6):
        scene = StripeScene((line(8.0, sigma_px=sigma_px, peak=150.0),), 480, 300, noise=noise)
        profile = extract_stripes(scene.expose(seed))
        assert profile.is_accepted.mean() > 0.95
        level = np.array([0.3, 1.0]) * 150.0
        terms = np.stack([level**2, level, np.ones(2)])
        found[-1] = found[-1] @ terms / (np.array([0.1**2, 0.1, 1.0 + 1.0 / 12.0]) @ terms)
    ratio = np.array([one for one in found if one.shape == (2,)])
    assert np.median(ratio, axis=0) == pytest.approx([1.0, 1.0], abs=0.15)


@pytest.mark.parametrize("line_sigma", [0.8, 2.5])
def test_residuals_are_widened_by_what_the_fit_took_of_each_pixel(line_sigma: float) -> None:
    """Against the hat matrix of weighted least squares in NumPy."""
    rng, noise = np.random.default_rng(3), np.array([0.01, 0.1, 1.0])
    u = (np.arange(41) - 20.3) / line_sigma
    light = 100.0 * np.exp(-0.5 * u * u)
    image = (5.0 + light + rng.normal(0.0, 2.0, 41)).astype(np.float32)[None, :]
    points = np.array([[20.0, 0.0, 1.0, 0.0, 0.0, 1.0]])
    fits = np.array([[20.3, 100.0, line_sigma, 0.1, 0.0, 1.0, 0.0, 0.0]])
    none, even = np.zeros((1, 1), np.uint8), np.ones((1, 1), np.float32)
    pixels = np.zeros((3, 31))
    beside = np.full(1, line_sigma), np.full((1, 2), 5.0)
    given = (image, none, even, points, *beside, fits, noise, np.zeros(4))
    n = weigh_section(*given, 15, np.zeros((0, 8)), pixels)
    near = np.abs(u) < 2.7
    weight = 1.0 / np.sqrt(noise[0] * light**2 + noise[1] * (light + 5.0) + noise[2])[near]
    slopes = (light * np.stack([np.ones(41), u, u * u]))[:, near].T * weight[:, None]
    left = 1.0 - np.diag(slopes @ np.linalg.pinv(slopes))
    expected = ((image[0] - 5.0 - light)[near] / np.sqrt(np.maximum(left, 1e-9)))[left > 0.2]
    assert (left < 0.2).any() == (line_sigma < 1.0)
    is_line = pixels[0, :n] > 100.0 * np.exp(-0.5 * 2.7**2)
    assert pixels[2, :n][is_line] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("line_sigma", "start_sigma", "slope"), [(0.7, 0.7, 3.0), (2.0, 3.5, 1.0), (3.0, 3.0, 0.5)]
)
def test_ground_that_brightens_to_one_side_moves_nothing(
    line_sigma: float, start_sigma: float, slope: float
) -> None:
    """The same ramp under the fit, which begins with whatever width, and under what it leaves."""
    rng, n, noise = np.random.default_rng(4), 400, np.array([0.0, 0.0, 0.49])
    centre = 30.0 + rng.uniform(-0.5, 0.5, (n, 1))
    u = (np.arange(61) - centre) / line_sigma
    level = 100.0 + slope * (np.arange(61) - 30.0) + 150.0 * np.exp(-0.5 * u * u)
    image = (level + rng.normal(0.0, 0.7, level.shape)).astype(np.float32)
    points = np.zeros((n, 6))
    points[:, 0], points[:, 1], points[:, 2], points[:, 5] = centre[:, 0], np.arange(n), 1.0, 1.0
    sigma, none, raw = np.full(n, start_sigma), np.zeros((1, 1), np.uint8), np.zeros((n, 4))
    read_sides(image, points, sigma, raw)
    sides, fits = np.tile(raw[:, ::2].mean(axis=0), (n, 1)), np.zeros((n, FIT_COLUMNS))
    # places of the pixels of a side differ from row to row by up to half a pixel
    sides += slope * (centre - centre.mean())
    even = np.ones((1, 1), np.float32)
    given = (image, none, even, points, sigma, sides)
    fit_profiles(*given, noise, np.zeros(4), np.full(n, 2.7), fits)
    off = fits[:, CENTRE] - centre[:, 0]
    assert abs(off.mean()) < 4.0 * off.std() / np.sqrt(n)
    pixels = np.zeros((3, n * 31))
    count = weigh_section(*given, fits, noise, np.zeros(4), 15, np.zeros((0, 8)), pixels)
    own, _, left = pixels[:, :count]
    beside = np.abs(own) < 3.0
    for chosen in (beside, ~beside):
        assert np.std(left[chosen]) == pytest.approx(0.7, rel=0.1)
