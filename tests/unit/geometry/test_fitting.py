# SPDX-License-Identifier: Apache-2.0
"""Lines and planes by total least squares."""

import numpy as np

from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import Line, fit_line, fit_plane

SEED = 3


def test_line_through_two_points_by_hand() -> None:
    line = fit_line(np.array([[1.0, 1.0], [4.0, 5.0]]))
    assert line
    np.testing.assert_allclose(np.abs(line.direction), [0.6, 0.8], rtol=1e-12)
    np.testing.assert_allclose(line.point, [2.5, 3.0], rtol=1e-12)


def test_distance_of_a_plane_line_is_positive_on_its_left() -> None:
    line = Line(np.zeros(2), np.array([1.0, 0.0]))
    np.testing.assert_allclose(line.distance(np.array([[5.0, 2.0], [1.0, -3.0]])), [2.0, -3.0])


def test_distance_in_space_by_hand() -> None:
    line = Line(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(line.distance(np.array([[3.0, 4.0, 9.0]])), [5.0])


def test_weighted_line_follows_the_heavy_points() -> None:
    points = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [1.0, 5.0]])
    line = fit_line(points, np.array([1.0, 1.0, 1.0, 1e-12]))
    assert line
    np.testing.assert_allclose(line.distance(points[:3]), 0.0, atol=1e-10)


def test_line_of_coincident_points_is_refused() -> None:
    assert isinstance(fit_line(np.ones((4, 3))), FitFailure)
    assert isinstance(fit_line(np.zeros((1, 2))), FitFailure)


def test_plane_minimises_distances_not_heights() -> None:
    """The smallest singular vector: SVD of the same points by hand, a steep plane."""
    rng = np.random.default_rng(SEED)
    points = rng.normal(size=(60, 3)) * [5.0, 3.0, 0.2] @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    fit = fit_plane(points)
    assert fit
    scatter = np.cov(points.T)
    smallest = np.linalg.eigh(scatter)[1][:, 0]
    assert abs(abs(smallest @ fit.value.normal) - 1.0) < 1e-12
    a, b, c, d = fit.value.coefficients
    np.testing.assert_allclose(points @ [a, b, c] + d, fit.residuals, atol=1e-12)
    np.testing.assert_allclose(np.cross(*fit.value.axes[:2]), fit.value.normal, atol=1e-12)


def test_plane_covariance_is_that_of_repeats() -> None:
    """Mean of the squared normalised error over 400 repeats is 3 +- 4 sigma."""
    rng = np.random.default_rng(SEED)
    flat = np.column_stack([rng.uniform(-20, 20, 40), rng.uniform(-5, 5, 40), np.zeros(40)])
    squares = []
    for _ in range(400):
        fit = fit_plane(flat + rng.normal(0.0, 0.05, flat.shape) * [0.0, 0.0, 1.0])
        assert fit
        plane = fit.value
        height = -(plane.point_mm @ plane.normal) / plane.normal[2] + 0.0
        tilt = plane.normal[:2] / plane.normal[2]
        # The truth z = 0 seen from the fitted plane: offset at its centroid, tilts along its axes.
        error = np.array([tilt @ plane.axes[0, :2], tilt @ plane.axes[1, :2], plane.point_mm[2]])
        assert abs(height + plane.point_mm @ [*tilt, 1.0]) < 1e-9
        squares.append(error @ np.linalg.solve(fit.covariance, error))
    # With 37 degrees of freedom for the noise the quantity is 3 F(3, 37): mean 3 * 37 / 35.
    expected, spread = 3.0 * 37.0 / 35.0, np.std(squares) / np.sqrt(400)
    assert abs(np.mean(squares) - expected) < 4.0 * spread


def test_plane_of_points_on_a_line_is_refused() -> None:
    assert isinstance(fit_plane(np.outer(np.arange(9.0), [1.0, 2.0, 3.0])), FitFailure)
    assert isinstance(fit_plane(np.zeros((2, 3))), FitFailure)
