# SPDX-License-Identifier: Apache-2.0
"""The fit of two edges that bend: against an image that is drawn, SciPy, and differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.special import erf

from armscan.geometry.arrays import FloatArray
from armscan.kernels.target_edges import CROSSING, crossing_sums
from armscan.vision.targets.crossings import fit_lattice
from armscan.vision.targets.saddle import fit_saddles

BENDS = np.array([0.004, -0.003])
CORNER = np.array([0.37, -0.21, 0.2, 1.9, 1.1, 120.0, 60.0, 0.4, -0.3])


def window(reach: int = 12) -> FloatArray:
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    inside = np.hypot(u, v) <= reach
    return np.stack([u[inside], v[inside]], axis=-1).astype(np.float64)


def level_of(corner: FloatArray, offsets: FloatArray) -> FloatArray:
    """As told: each edge a parabola through the corner, its curvature towards its normal."""
    u, v, first, second, blur, mean, contrast, along_u, along_v = corner
    d = offsets - [u, v]
    product = np.ones(len(offsets))
    for angle, bend in zip((first, second), BENDS, strict=True):
        normal, way = [np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]
        away = d @ normal - 0.5 * bend * (d @ way) ** 2
        product *= erf(away / (np.sqrt(2.0) * blur))
    return np.asarray(mean + contrast * product + along_u * d[:, 0] + along_v * d[:, 1])


def sums_of(corner: FloatArray, offsets: FloatArray, levels: FloatArray) -> tuple:
    normal, gradient = np.zeros((CROSSING, CROSSING)), np.zeros(CROSSING)
    pixels = np.ascontiguousarray(np.vstack([offsets.T, levels]))
    residuals = np.zeros(len(levels))
    square = crossing_sums(pixels, len(levels), corner, BENDS, residuals, normal, gradient)
    return square, residuals, np.tril(normal) + np.tril(normal, -1).T, gradient


def test_normal_equations_are_those_of_differences() -> None:
    offsets = window()
    levels = level_of(CORNER, offsets) + np.random.default_rng(1).normal(0.0, 3.0, len(offsets))
    corner = CORNER + np.array([0.1, -0.05, 0.02, -0.03, 0.1, 2.0, 3.0, 0.1, 0.1])
    square, residuals, normal, gradient = sums_of(corner, offsets, levels)
    np.testing.assert_allclose(residuals, levels - level_of(corner, offsets), atol=1e-7)
    assert square == pytest.approx(float(residuals @ residuals))
    steps = 1e-5 * np.eye(CROSSING)
    jacobian = np.stack(
        [(level_of(corner + h, offsets) - level_of(corner - h, offsets)) / 2e-5 for h in steps]
    )
    np.testing.assert_allclose(normal, jacobian @ jacobian.T, rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(gradient, jacobian @ residuals, rtol=1e-5, atol=1e-3)


def drawn(rng: np.random.Generator, noise: float) -> FloatArray:
    v, u = np.mgrid[:61, :61]
    offsets = np.stack([u.ravel(), v.ravel()], axis=-1) - 30.0
    return level_of(CORNER, offsets).reshape(61, 61) + rng.normal(0.0, noise, (61, 61))


def fitted(image: FloatArray, curvature: FloatArray | None) -> tuple[FloatArray, float]:
    """The corner from the middle, and its sigma; ways along x and y as the edges are drawn."""
    # the first normal is that of the way along y, the second that of the way along x
    along_y = 30.0 * np.array([[np.sin(CORNER[2]), -np.cos(CORNER[2])]])
    along_x = 30.0 * np.array([[np.sin(CORNER[3]), -np.cos(CORNER[3])]])
    saddles = fit_saddles(image, np.array([[30.0, 30.0]]), along_x, along_y, curvature)
    assert saddles.is_good.all()
    return saddles.points_px[0] - 30.0, float(saddles.sigma_px[0])


def test_bent_edges_are_fitted_without_bias_and_as_scipy_does() -> None:
    """A straight fit lies beside by many sigmas; the curvature's sign and axes are those told."""
    curvature = BENDS[None, ::-1]
    errors, straight = [], []
    for seed in range(20):
        image = drawn(np.random.default_rng(seed), 2.0)
        point, sigma = fitted(image, curvature)
        errors.append((point - CORNER[:2]) / sigma)
        other, sigma = fitted(image, None)
        straight.append((other - CORNER[:2]) / sigma)
    assert np.mean(np.square(errors)) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 40.0))
    assert np.abs(np.mean(straight, axis=0)).max() > 2.0


def test_the_fit_is_that_of_scipy() -> None:
    """Noise of a tenth of a level, so that no pixel is taken for a stray one."""
    image, offsets = drawn(np.random.default_rng(5), 0.1), window()
    radius = 0.42 * 30.0 * abs(np.sin(CORNER[3] - CORNER[2]))
    offsets = offsets[np.hypot(*offsets.T) <= radius]
    at = (offsets + 30.0).astype(np.int64)
    levels = image[at[:, 1], at[:, 0]]
    least = least_squares(
        lambda p: levels - level_of(p, offsets), CORNER + 0.05, x_scale="jac", xtol=1e-12
    )
    point, _ = fitted(image, BENDS[None, ::-1])
    # steps of less than 1e-4 px end it
    np.testing.assert_allclose(point, least.x[:2], atol=3e-4)


def test_lattice_knows_how_its_lines_bend() -> None:
    """Pincushion by OpenCV's polynomial; the truth by differences of that. None without a lens."""
    board = np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0)), axis=-1).reshape(-1, 2)

    def see(places: FloatArray, k1: float) -> FloatArray:
        plane = (places - [4.0, 3.0]) * 0.11
        depth = 1.0 + 0.2 * plane[:, :1] - 0.1 * plane[:, 1:]
        xy = plane / depth
        return np.asarray(900.0 * xy * (1.0 + k1 * (xy**2).sum(axis=1, keepdims=True)) + 640.0)

    rng = np.random.default_rng(3)
    for k1 in (-0.25, 0.0):
        points = see(board, k1) + rng.normal(0.0, 0.02, board.shape)
        lattice = fit_lattice(board, points, np.full(len(board), 0.02), 1.0, (1280, 1280))
        assert lattice is not None
        found = lattice.curvature(board)
        step, truth = 1e-3, np.zeros_like(found)
        for axis in range(2):
            h = step * np.eye(2)[axis]
            before, at, after = (see(board + k * h, k1) for k in (-1.0, 0.0, 1.0))
            slope, bend = (after - before) / (2 * step), (after - 2 * at + before) / step**2
            turn = slope[:, 0] * bend[:, 1] - slope[:, 1] * bend[:, 0]
            truth[:, axis] = turn / np.hypot(*slope.T) ** 3
        # arcs of 18 px radius; 0.02 px of noise and the polynomial's end may hide a hundredth
        np.testing.assert_allclose(162.0 * found, 162.0 * truth, atol=0.01)
        assert (np.abs(162.0 * truth).max() > 0.05) == (k1 != 0.0)
