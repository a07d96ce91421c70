# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import ndtr

from armscan.kernels.target_edges import (
    collect_band,
    direction_angle,
    fit_sectors,
    order_by_sector,
)
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


def nearest(own: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance to an ellipse's rim and parametric angle of the nearest point, by trigonometry."""
    (p, q), (x, y) = half, own.T
    angle = np.arctan2(p * y, q * x)
    for _ in range(30):
        c, s = np.cos(angle), np.sin(angle)
        slope = (q**2 - p**2) * s * c + p * x * s - q * y * c
        bend = (q**2 - p**2) * (c**2 - s**2) + p * x * c + q * y * s
        angle = angle - np.clip(slope / np.maximum(bend, 0.1 * p**2), -0.3, 0.3)
    c, s = np.cos(angle), np.sin(angle)
    speed = np.hypot(q * c, p * s)
    return ((x - p * c) * q * c + (y - q * s) * p * s) / speed, angle


def test_a_band_holds_every_pixel_near_a_rim_with_its_place() -> None:
    rng = np.random.default_rng(4)
    rows, columns = 90, 120
    turns = rng.uniform(0.0, np.pi, 6)
    directions = np.array([[[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]] for t in turns])
    short = rng.uniform(6.0, 12.0, 6)
    half = np.column_stack([short, short * [1.0, 1.001, 1.3, 2.0, 3.0, 3.9]])
    centres = rng.uniform(0.0, 1.0, (6, 2)) * [columns, rows]
    width, slope = rng.uniform(1.0, 3.0, 6), rng.uniform(-0.01, 0.01, (6, 2))
    turned = directions.transpose(0, 2, 1).reshape(6, 4)
    rims = np.column_stack([centres, half, turned, slope])
    # an ellipse that is no place in the image gives nothing
    rims = np.concatenate([rims, np.full((1, 10), np.nan)])
    place, ellipse = np.zeros((2, 6 * rows * columns), np.int64)
    found = np.zeros((3, 6 * rows * columns))
    n = collect_band(rims, np.append(width, 2.0), columns, rows, place, ellipse, found)
    v, u = np.mgrid[:rows, :columns]
    pixels = np.column_stack([u.ravel(), v.ravel()])
    first = 0
    for k in range(6):
        distance, angle = nearest((pixels - centres[k]) @ directions[k], half[k])
        # where the nearest point is unique: nearer than the smallest radius of curvature
        near = np.abs(distance) <= width[k]
        last = first + int(near.sum())
        np.testing.assert_array_equal(place[first:last], np.flatnonzero(near))
        assert (ellipse[first:last] == k).all()
        np.testing.assert_allclose(found[0, first:last], distance[near], atol=1e-10)
        apart = found[1, first:last] - angle[near]
        np.testing.assert_allclose(np.exp(1j * apart), 1.0, atol=1e-7)
        light = 1.0 + (pixels - centres[k]) @ slope[k]
        np.testing.assert_allclose(found[2, first:last], light[near], rtol=1e-13)
        first = last
    assert n == first


def test_angles_of_directions() -> None:
    angle = np.concatenate([np.linspace(-np.pi, np.pi, 4001)[1:], np.arange(-3, 5) * np.pi / 4])
    got = [direction_angle(c, s) for c, s in zip(np.cos(angle), np.sin(angle), strict=True)]
    np.testing.assert_allclose(got, np.arctan2(np.sin(angle), np.cos(angle)), atol=2.1e-8)


def ordered(pixels: BandPixels, n_circles: int, n_sectors: int) -> tuple[np.ndarray, np.ndarray]:
    starts = np.zeros(n_circles * n_sectors + 1, np.int64)
    values = np.zeros((2, len(pixels.levels)))
    arguments = pixels.levels, pixels.distance_px, pixels.angle_rad, pixels.ellipse
    order_by_sector(*arguments, n_sectors, starts, values)
    return starts, values


def test_pixels_are_ordered_by_circle_and_sector() -> None:
    pixels = band(np.random.default_rng(5), 4, 300)
    sector = np.floor(np.mod(pixels.angle_rad / (2.0 * np.pi), 1.0) * 7).astype(int)
    number = pixels.ellipse * 7 + sector
    order = np.argsort(number, kind="stable")
    starts, values = ordered(pixels, 4, 7)
    np.testing.assert_array_equal(starts, np.append(0, np.cumsum(np.bincount(number))))
    np.testing.assert_array_equal(values, np.stack([pixels.levels, pixels.distance_px])[:, order])


@pytest.mark.parametrize("weight", [0.0, 25.0])
def test_sectors_are_those_of_a_general_solver(weight: float) -> None:
    """SciPy's solver over all unknowns of a circle at once, with the exact error function."""
    n_sectors = 6
    pixels = band(np.random.default_rng(6), 2, 240, reach_px=4.0)
    starts, values = ordered(pixels, 2, n_sectors)
    expected = np.array([[42.0, 195.0, weight]] * 2)
    blur, fits = np.ones(2), np.zeros((2 * n_sectors, 5))
    fit_sectors(values, starts, expected, 0.29, 40, blur, fits)
    for i in range(2):
        first = starts[i * n_sectors : (i + 1) * n_sectors + 1]
        level, distance = values[:, first[0] : first[-1]]
        sector = np.repeat(np.arange(n_sectors), np.diff(first))

        def residuals(
            x: np.ndarray,
            level: np.ndarray = level,
            distance: np.ndarray = distance,
            sector: np.ndarray = sector,
        ) -> np.ndarray:
            inner, outer, shift = x[:-1].reshape(n_sectors, 3)[sector].T
            predicted = inner + (outer - inner) * ndtr((distance - shift) / x[-1])
            levels = x[:-1].reshape(n_sectors, 3)[:, :2]
            prior = np.sqrt(weight) * (levels - expected[0, :2])
            return np.concatenate([level - predicted, prior.ravel()])

        start = np.append(np.tile([40.0, 200.0, 0.3], n_sectors), 1.3)
        oracle = least_squares(residuals, start, jac="3-point", xtol=1e-13, ftol=1e-13, gtol=1e-13)
        mine = fits[i * n_sectors : (i + 1) * n_sectors]
        theirs = oracle.x[:-1].reshape(n_sectors, 3)
        np.testing.assert_allclose(mine[:, :2], theirs[:, :2], atol=1e-4)
        np.testing.assert_allclose(mine[:, 2], theirs[:, 2], atol=1e-6)
        assert blur[i] == pytest.approx(oracle.x[-1], abs=1e-6)
        normal = oracle.jac.T @ oracle.jac
        own = [slice(3 * k, 3 * k + 3) for k in range(n_sectors)]
        variance = [np.linalg.inv(normal[rows, rows])[2, 2] for rows in own]
        np.testing.assert_allclose(mine[:, 3], variance, rtol=1e-5)
        square = np.bincount(sector, oracle.fun[: len(sector)] ** 2)
        np.testing.assert_allclose(mine[:, 4], square, rtol=1e-6)
