# SPDX-License-Identifier: Apache-2.0
"""Circles and spheres against hand-computed ones, SciPy and the scatter of repeats."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import fit_circle, fit_sphere

SEED = 7
CENTRE = np.array([310.0, -120.0, 45.0])
RADIUS_MM = 17.48
NOISE_MM = 0.02


def cap(generator: np.random.Generator, n: int, half_angle_deg: float) -> FloatArray:
    """Noisy points on a cap of a sphere about a slanted axis."""
    cosine = generator.uniform(np.cos(np.radians(half_angle_deg)), 1.0, n)
    turn = generator.uniform(0.0, 2.0 * np.pi, n)
    sine = np.sqrt(1.0 - cosine**2)
    local = np.column_stack([sine * np.cos(turn), sine * np.sin(turn), cosine])
    axis = np.linalg.qr(np.array([[1.0, 2.0, 2.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]).T)[0]
    reach = RADIUS_MM + generator.normal(0.0, NOISE_MM, n)
    return np.asarray(CENTRE + (local @ axis.T) * reach[:, None])


def oracle(points: FloatArray, start: FloatArray) -> FloatArray:
    dimensions = points.shape[1]
    solved = least_squares(
        lambda p: np.linalg.norm(points - p[:dimensions], axis=1) - p[dimensions],
        start,
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    return np.asarray(solved.x)


def test_sphere_through_four_points_by_hand() -> None:
    points = np.array([[3.0, 0.0, 1.0], [0.0, 3.0, 1.0], [-3.0, 0.0, 1.0], [0.0, 0.0, 4.0]])
    fit = fit_sphere(points)
    assert fit
    np.testing.assert_allclose(fit.value.centre_mm, [0.0, 0.0, 1.0], atol=1e-9)
    assert fit.value.radius_mm == pytest.approx(3.0, abs=1e-9)
    assert fit.degrees_of_freedom == 0
    np.testing.assert_allclose(fit.value.distance_mm(np.array([[0.0, 0.0, 5.0]])), [1.0])


@pytest.mark.parametrize("half_angle_deg", [170.0, 60.0, 20.0])
def test_sphere_agrees_with_scipy_on_partial_caps(half_angle_deg: float) -> None:
    points = cap(np.random.default_rng(SEED), 300, half_angle_deg)
    fit = fit_sphere(points)
    assert fit
    wanted = oracle(points, np.array([*CENTRE, RADIUS_MM]))
    found = np.array([*fit.value.centre_mm, fit.value.radius_mm])
    np.testing.assert_allclose(found, wanted, atol=1e-5 * NOISE_MM / 0.02)
    np.testing.assert_allclose(fit.residuals, fit.value.distance_mm(points), atol=1e-9)


def test_covariance_is_the_scatter_of_repeats() -> None:
    generator = np.random.default_rng(SEED)
    found, normalised = [], []
    for _ in range(200):
        fit = fit_sphere(cap(generator, 60, 50.0))
        assert fit
        error = np.array([*(fit.value.centre_mm - CENTRE), fit.value.radius_mm - RADIUS_MM])
        normalised.append(error @ np.linalg.solve(fit.covariance, error))
        found.append(error)
    # the noise is estimated with 56 degrees of freedom, so the mean of 4 F(4, 56) is 4.15
    assert np.mean(normalised) == pytest.approx(4.15, abs=4.0 * np.sqrt(8.0 / 200) * 1.1)


def test_rejection_ignores_a_floor_of_two_fifths() -> None:
    generator = np.random.default_rng(SEED)
    good = cap(generator, 300, 60.0)
    floor = np.column_stack([generator.uniform(250, 370, (200, 2)), np.full(200, 30.0)])
    fit = fit_sphere(np.vstack([floor, good]), outlier_sigmas=4.0)
    clean = fit_sphere(good)
    assert fit
    assert clean
    assert abs(fit.value.radius_mm - clean.value.radius_mm) < clean.sigma[3]
    assert 300 - 6 <= fit.degrees_of_freedom + 4 <= 300 + 6
    assert fit.residuals.shape == (500,)


def test_one_section_does_not_make_a_sphere() -> None:
    turn = np.linspace(0.0, 3.0, 100)
    flat = np.column_stack([10.0 * np.cos(turn), 10.0 * np.sin(turn), np.full(100, 2.0)])
    noisy = flat + np.random.default_rng(SEED).normal(0.0, NOISE_MM, flat.shape)
    for points in (flat, noisy):
        fit = fit_sphere(points)
        assert isinstance(fit, FitFailure)
        assert "plane" in fit.reason + fit.remedy


def test_refusals() -> None:
    with pytest.raises(InputError, match="not finite"):
        fit_sphere(np.full((5, 3), np.nan))
    with pytest.raises(OptionError, match="rejection"):
        fit_circle(np.eye(2), outlier_sigmas=0.0)
    few = fit_sphere(np.eye(3))
    assert isinstance(few, FitFailure)
    assert few.reason == "a sphere needs 4 points, got 3"
    assert isinstance(fit_sphere(np.ones((5, 3))), FitFailure)
    line = np.outer(np.arange(10.0), [1.0, 2.0, 3.0])
    assert isinstance(fit_sphere(line), FitFailure)
    assert isinstance(fit_sphere(line, outlier_sigmas=3.0), FitFailure)
    assert isinstance(fit_circle(line[:, :2]), FitFailure)


def test_circle_by_hand_and_against_scipy_on_a_short_arc() -> None:
    exact = fit_circle(np.array([[5.0, 2.0], [2.0, 5.0], [-1.0, 2.0]]))
    assert exact
    np.testing.assert_allclose(
        [*exact.value.centre_mm, exact.value.radius_mm], [2, 2, 3], atol=1e-9
    )
    turn = np.linspace(0.3, 0.9, 200)
    generator = np.random.default_rng(SEED)
    reach = 40.0 + generator.normal(0.0, 0.01, 200)
    points = np.column_stack([reach * np.cos(turn) - 7.0, reach * np.sin(turn) + 90.0])
    fit = fit_circle(points)
    assert fit
    wanted = oracle(points, np.array([-7.0, 90.0, 40.0]))
    found = [*fit.value.centre_mm, fit.value.radius_mm]
    np.testing.assert_allclose(found, wanted, atol=1e-4 * fit.sigma.max())
