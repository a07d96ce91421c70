# SPDX-License-Identifier: Apache-2.0
"""Smoothing of many points together, against a fit of each point alone."""

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.kernels.stripe.smoothing import (
    BEND,
    LEAST_POINTS,
    MOST_TURNED_COSINE,
    PREDICTED,
    PREDICTED_SIGMA,
    SHIFT,
    SLOPE,
    SMOOTH_SIGMA,
    WINDOW,
)
from armscan.vision.stripe.smooth import CONFIDENCE, Neighbourhoods, Polyline, smooth

WINDOWS = np.array([3.2, 5.0, 7.7, 12.0])
INFLATION = np.array([1.0, 1.1, 1.3, 1.6])


def wavy(seed: int) -> Polyline:
    """Three chains: a long wave, a tight circle that closes, and one too short to be smoothed."""
    rng = np.random.default_rng(seed)
    x, turn = np.arange(150.0), np.linspace(0.0, 2.0 * np.pi, 60)
    courses = [
        np.stack([x, 20.0 + 6.0 * np.sin(x / 9.0)], axis=1),
        np.stack([80.0 + 9.0 * np.cos(turn), 80.0 + 9.0 * np.sin(turn)], axis=1),
        np.stack([np.arange(4.0), np.full(4, 50.0)], axis=1),
    ]
    tangents = [np.gradient(one, axis=0) for one in courses]
    along = np.concatenate(tangents)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normals = np.stack([along[:, 1], -along[:, 0]], axis=1)
    sigma = rng.uniform(0.05, 0.1, len(along))
    points = np.concatenate(courses) + (sigma * rng.normal(size=len(along)))[:, None] * normals
    chain = np.repeat([0, 1, 3], [150, 60, 4])
    return Polyline(points, normals, sigma, chain, rng.uniform(size=len(along)) > 0.1)


def neighbours(course: Polyline, i: int, reach: float) -> list[int]:
    """Twin: the points from one on to both sides, until one is too far, turned or another's."""
    nx, ny = course.normals[i]
    found = [i]
    for direction in (-1, 1):
        j = i + direction
        while 0 <= j < len(course) and course.chain[j] == course.chain[i]:
            dx, dy = course.points[j] - course.points[i]
            is_turned = abs(course.normals[j] @ course.normals[i]) < MOST_TURNED_COSINE
            if abs(dy * nx - dx * ny) > reach or is_turned:
                break
            found.append(j)
            j += direction
    return [j for j in found if course.is_used[j]]


def parabola(course: Polyline, i: int, rows: list[int]) -> tuple[FloatArray, FloatArray]:
    """Coefficients (3,) of the weighted fit in the tangent frame of a point, and covariance."""
    away = course.points[rows] - course.points[i]
    s = away @ np.array([-course.normals[i, 1], course.normals[i, 0]])
    fit, covariance = np.polyfit(
        s, away @ course.normals[i], 2, w=1.0 / course.sigma[rows], cov="unscaled"
    )
    return fit[::-1], covariance[::-1, ::-1]


def test_each_point_is_that_of_a_fit_of_its_own() -> None:
    course = wavy(0)
    scale = 1.7
    result = Neighbourhoods(course, WINDOWS).fit_parabolas(INFLATION, course.sigma, scale)
    taken = []
    for i in range(len(course)):
        lower, upper, window, rows = -np.inf, np.inf, 0.0, []
        expected, sigma, inflated = np.zeros(3), course.sigma[i], 1.0
        for reach, inflation in zip(WINDOWS, INFLATION, strict=True):
            near = neighbours(course, i, reach)
            if len(near) < LEAST_POINTS:
                continue
            fit, covariance = parabola(course, i, near)
            spread = np.sqrt(covariance[0, 0] * inflation * scale)
            lower = max(lower, fit[0] - CONFIDENCE * spread)
            upper = min(upper, fit[0] + CONFIDENCE * spread)
            if lower > upper:
                break
            expected, sigma, window, rows, inflated = fit, spread, reach, near, inflation
        taken.append(window)
        assert result[WINDOW, i] == np.float32(window)
        # single precision: what a fit of points on one side of theirs cancels leaves 4 digits
        assert result[SHIFT, i] == pytest.approx(expected[0], abs=1e-3 * sigma)
        assert result[SLOPE, i] == pytest.approx(expected[1], rel=1e-4, abs=1e-5)
        assert result[BEND, i] == pytest.approx(2.0 * expected[2], rel=1e-3, abs=1e-5)
        assert result[SMOOTH_SIGMA, i] == pytest.approx(sigma, rel=1e-4)
        others = [j for j in rows if j != i]
        if len(others) > LEAST_POINTS:
            fit, covariance = parabola(course, i, others)
            spread = np.sqrt(covariance[0, 0] * inflated * scale)
            assert result[PREDICTED, i] == pytest.approx(fit[0], abs=1e-3 * spread)
            assert result[PREDICTED_SIGMA, i] == pytest.approx(spread, rel=1e-4)
    assert set(taken) >= {0.0, 7.7, 12.0}, "windows stop growing at bends"


def test_points_that_are_left_out_are_as_if_they_had_never_counted() -> None:
    course = wavy(1)
    dropped = np.array([3, 31, 32, 100, 170])
    around = Neighbourhoods(course, WINDOWS)
    around.leave_out(dropped)
    is_used = course.is_used.copy()
    is_used[dropped] = False
    fewer = Polyline(course.points, course.normals, course.sigma, course.chain, is_used)
    anew = Neighbourhoods(fewer, WINDOWS).fit_parabolas(INFLATION, course.sigma)
    before = Neighbourhoods(course, WINDOWS).fit_parabolas(INFLATION, course.sigma)
    assert np.array_equal(around.fit_parabolas(INFLATION, course.sigma), anew)
    assert not np.array_equal(before, anew)


def test_points_that_are_asked_are_as_if_all_were() -> None:
    course, windows = wavy(3), np.array([4.0, 8.0])
    asked = np.arange(len(course)) % 97 == 0
    ones = np.ones(2)
    found = Neighbourhoods(course, windows, asked).fit_parabolas(ones, course.sigma)
    every = Neighbourhoods(course, windows).fit_parabolas(ones, course.sigma)
    assert (every[WINDOW, asked] > 0.0).any()
    np.testing.assert_array_equal(found[:, asked], every[:, asked])


def test_no_more_is_smoothed_than_was_asked_for() -> None:
    """The sigma of white noise in a half window w falls as the root of 9/4 over its points."""
    rng, n, turn = np.random.default_rng(5), 3000, 0.1
    along, normal = np.array([1.0, np.tan(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    off = rng.normal(0.0, 0.05, n)
    points = np.arange(float(n))[:, None] * along + off[:, None] * normal
    course = Polyline(
        points, np.tile(normal, (n, 1)), np.full(n, 0.05), np.zeros(n, np.int64), np.ones(n) > 0
    )
    stated = []
    for largest_px in (1.0, 4.5, 12.5):
        found = smooth(course, largest_px)
        stated.append(float(np.median(found.sigma)))
        assert np.std(found.points @ normal) == pytest.approx(stated[-1], rel=0.1)
        n_points = 1 + 2 * int(max(largest_px, 3.2) * np.cos(turn))
        expected = 0.05 * np.sqrt(9.0 / 4.0 / n_points)
        assert stated[-1] == pytest.approx(expected, rel=0.15)
    assert stated[0] > stated[1] > stated[2]
