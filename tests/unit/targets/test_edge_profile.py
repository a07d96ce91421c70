# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from armscan.vision.targets.circle_edges import fit_profiles
from armscan.vision.targets.ellipse import BandPixels, Rims, band_pixels

NOISE = 2.0
SHIFT_PX = 0.3
BLUR_PX = 1.3


def band(
    rng: np.random.Generator, n_circles: int, pixels_each: int, reach_px: float = 6.0
) -> BandPixels:
    distance = rng.uniform(-reach_px, reach_px, n_circles * pixels_each)
    angle = rng.uniform(-np.pi, np.pi, n_circles * pixels_each)
    levels = 40.0 + 160.0 * ndtr((distance - SHIFT_PX) / BLUR_PX)
    levels += NOISE * rng.standard_normal(len(levels))
    return BandPixels(levels, np.repeat(np.arange(n_circles), pixels_each), distance, angle)


def test_profile_parameters_and_their_sigma() -> None:
    n_circles, n_sectors = 30, 20
    pixels = band(np.random.default_rng(1), n_circles, 1600)
    fit = fit_profiles(pixels, n_sectors, np.ones(n_circles))
    n = n_circles * n_sectors
    normalised = (fit.shift_px - SHIFT_PX) / fit.sigma_px
    assert abs(normalised.mean()) < 4.0 / np.sqrt(n)
    assert np.mean(normalised**2) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / n))
    np.testing.assert_allclose(fit.blur_px, BLUR_PX, rtol=0.05)
    assert fit.noise.mean() == pytest.approx(NOISE, rel=0.02)
    np.testing.assert_allclose(np.median(fit.contrast), 160.0, rtol=0.01)


def test_known_levels_sharpen_narrow_sectors_only() -> None:
    rng = np.random.default_rng(2)
    few, many = band(rng, 10, 8 * 12, reach_px=2.0), band(rng, 10, 8 * 400)
    gains = []
    for pixels in (few, many):
        first = fit_profiles(pixels, 8, np.ones(10))
        second = fit_profiles(pixels, 8, first.blur_px, first)
        known = np.isfinite(first.sigma_px)
        gains.append(np.median(second.sigma_px[known] / first.sigma_px[known]))
    assert gains[0] < 0.97
    assert gains[1] == pytest.approx(1.0, abs=0.02)


def test_distance_to_an_ellipse_is_that_of_a_dense_polygon() -> None:
    centre, half = np.array([[40.3, 30.8]]), np.array([[12.0, 25.0]])
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    rims = Rims(centre, half, turn[None])
    v, u = np.mgrid[:80, :90]
    image = (1000.0 * v + u).astype(np.float64)
    pixels = band_pixels(image, rims, np.array([4.0]), np.zeros((1, 2)))
    at = np.stack([pixels.levels % 1000.0, pixels.levels // 1000.0], axis=-1)
    rim, normals, curvature = rims.points(np.linspace(0, 2 * np.pi, 20_000, endpoint=False))
    gap = np.linalg.norm(at[:, None] - rim[0, ::10][None], axis=2)
    # chords of a polygon of 2000 corners: 0.08 px long, so 0.04 px at the rim and 1e-3 px at 2 px
    np.testing.assert_allclose(np.abs(pixels.distance_px), gap.min(axis=1), atol=0.07)
    far = np.abs(pixels.distance_px) > 2.0
    np.testing.assert_allclose(np.abs(pixels.distance_px)[far], gap[far].min(axis=1), atol=2e-3)
    inside = (((at - centre[0]) @ turn / half[0]) ** 2).sum(axis=1) < 1.0
    assert ((pixels.distance_px < 0.0) == inside).all()
    step = np.diff(rim[0], axis=0)
    turning = np.diff(np.unwrap(np.arctan2(step[:, 1], step[:, 0])))
    np.testing.assert_allclose(
        turning / np.linalg.norm(step[1:], axis=1), curvature[0, 1:-1], rtol=2e-3
    )
    # every pixel of the band was collected
    expected = np.abs(
        np.linalg.norm(np.stack([u, v], -1)[..., None, :] - rim[0, ::100], axis=-1).min(axis=-1)
    )
    assert len(pixels.levels) == pytest.approx((expected <= 4.0).sum(), rel=0.02)
    np.testing.assert_allclose((np.linalg.norm(normals, axis=-1)), 1.0)


def test_illumination_slope_is_divided_out() -> None:
    rims = Rims(np.array([[40.0, 30.0]]), np.array([[12.0, 12.0]]), np.eye(2)[None])
    v, u = np.mgrid[:60, :80]
    image = 100.0 * (1.0 + 0.004 * (u - 40.0) - 0.002 * (v - 30.0))
    pixels = band_pixels(image, rims, np.array([4.0]), np.array([[0.004, -0.002]]))
    np.testing.assert_allclose(pixels.levels, 100.0)
