# SPDX-License-Identifier: Apache-2.0
"""The thesis's algebraic plane (eq. 2.44 with the inverse that the print lacks)."""

import numpy as np

from armscan.calibration.sheets.checks import algebraic_plane

PLANE = np.array([0.6, 0.0, 0.8, -100.0])
NOISE_MM = 5.0
N_POINTS = 4000


def points(noise_mm: float) -> np.ndarray:
    rng = np.random.default_rng(2)
    along = rng.uniform(-30.0, 30.0, (N_POINTS, 2)) @ [[0.0, 1.0, 0.0], [0.8, 0.0, -0.6]]
    return along + (100.0 + noise_mm * rng.normal(size=(N_POINTS, 1))) * PLANE[:3]


def test_points_of_a_plane_give_its_unit_normal_and_distance() -> None:
    np.testing.assert_allclose(algebraic_plane(points(0.0)), PLANE, atol=1e-9)


def test_it_is_the_solution_of_the_normal_equations() -> None:
    xyz = points(NOISE_MM)
    a, b, c = np.linalg.inv(xyz.T @ xyz) @ xyz.sum(axis=0)
    scale = np.sqrt(a * a + b * b + c * c)
    np.testing.assert_allclose(algebraic_plane(xyz), np.array([a, b, c, -1.0]) / scale, rtol=1e-9)


def test_it_draws_the_plane_away_from_the_camera() -> None:
    """By hand: 1 / |abc| grows from d to d + noise^2 / d, here by 0.25 mm; 4 sigma of its mean."""
    moved = -algebraic_plane(points(NOISE_MM))[3] - 100.0
    assert abs(moved - NOISE_MM**2 / 100.0) < 4.0 * NOISE_MM / np.sqrt(N_POINTS)
    assert moved - (points(NOISE_MM) @ PLANE[:3]).mean() + 100.0 > 0.2
