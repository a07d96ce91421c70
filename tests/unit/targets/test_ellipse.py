# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import SensorWindow
from armscan.simulation.objects.boards import CirclePattern
from armscan.thesis.ellipse import (
    ellipse_centre,
    fit_ellipse_algebraic,
    thesis_centres,
    with_printed_centres,
)
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.ellipse import Ellipses, fit_ellipses
from armscan.vision.targets.target import CircleGrid, TargetView
from rigs.target_scenes import exposure, render

CENTRE = np.array([2811.3, 1450.8])
HALF = np.array([36.0, 24.0])
TURN = 0.6
SIGMA_PX = 0.03


def rim(n: int, start: float = 0.0, stop: float = 2.0 * np.pi) -> np.ndarray:
    t = np.linspace(start, stop, n, endpoint=False)
    turn = np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
    return CENTRE + (HALF * np.stack([np.cos(t), np.sin(t)], axis=-1)) @ turn.T


def normals(n: int) -> np.ndarray:
    t = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    turn = np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
    own = np.stack([HALF[1] * np.cos(t), HALF[0] * np.sin(t)], axis=-1)
    return (own / np.linalg.norm(own, axis=1)[:, None]) @ turn.T


def fit(points: np.ndarray, sigma: float = SIGMA_PX) -> Ellipses:
    return fit_ellipses(points[None], np.full((1, len(points)), sigma**-2.0))


def test_exact_points_give_the_exact_ellipse() -> None:
    ellipse = fit(rim(20))
    half, directions = ellipse.axes()
    np.testing.assert_allclose(ellipse.centres()[0][0], CENTRE, atol=1e-9)
    np.testing.assert_allclose(half[0], [24.0, 36.0], atol=1e-9)
    assert abs(directions[0, :, 1] @ [np.cos(TURN), np.sin(TURN)]) == pytest.approx(1.0)
    assert ellipse.is_ellipse[0]
    assert ellipse.chi2[0] < 1e-12


def test_a_third_of_the_rim_is_enough_when_exact() -> None:
    np.testing.assert_allclose(fit(rim(20, 0.0, 2.0)).centres()[0][0], CENTRE, atol=1e-6)


def test_points_without_weight_do_not_count() -> None:
    points = np.concatenate([rim(20), CENTRE + np.array([[0.0, 3.0], [50.0, 50.0]])])
    weights = np.r_[np.ones(20), 0.0, 0.0]
    ellipse = fit_ellipses(points[None], weights[None])
    np.testing.assert_allclose(ellipse.centres()[0][0], CENTRE, atol=1e-9)
    assert ellipse.degrees_of_freedom[0] == 15


def test_centre_covariance_is_that_of_repeated_fits() -> None:
    rng = np.random.default_rng(3)
    n, repeats = 40, 2000
    noise = SIGMA_PX * rng.standard_normal((repeats, n, 1)) * normals(n)
    ellipses = fit_ellipses(rim(n) + noise, np.full((repeats, n), SIGMA_PX**-2.0))
    centres, covariance = ellipses.centres()
    error = centres - CENTRE
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    assert nees.mean() / 2.0 == pytest.approx(1.0, abs=4.0 / np.sqrt(repeats))
    assert ellipses.chi2.mean() == pytest.approx(n - 5, abs=4.0 * np.sqrt(2.0 * n / repeats))
    np.testing.assert_allclose(np.cov(error.T), covariance.mean(axis=0), rtol=0.15, atol=2e-6)


def test_fits_and_covariance_are_those_of_a_general_solver() -> None:
    """SciPy's solver on the Sampson distances in pixels, from the true ellipse."""
    rng = np.random.default_rng(8)
    points = np.stack([rim(24), rim(24, 0.3, 4.0)])
    points += 0.3 * rng.standard_normal(points.shape)
    sigma = rng.uniform(0.2, 0.6, points.shape[:2])
    sigma[0, 5] = np.inf
    fits = fit_ellipses(points, sigma**-2.0)
    for k in range(2):
        own = (points[k] - fits.origin_px[k]) / fits.scale_px[k]

        def distances(
            terms: np.ndarray, own: np.ndarray = own, sigma: np.ndarray = sigma[k], k: int = k
        ) -> np.ndarray:
            a, b, c, d, e = terms
            conic = np.array([[a, b, d], [b, c, e], [d, e, -1.0]])
            along = np.column_stack([own, np.ones(len(own))]) @ conic
            value = (along[:, :2] * own).sum(axis=1) + along[:, 2]
            distance = 0.5 * value / np.hypot(along[:, 0], along[:, 1])
            return distance * fits.scale_px[k] / sigma

        start = fits.terms[k] * (1.0 + 0.01 * rng.standard_normal(5))
        oracle = least_squares(distances, start, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
        covariance = np.linalg.inv(oracle.jac.T @ oracle.jac)
        step = (fits.terms[k] - oracle.x) / np.sqrt(np.diag(covariance))
        # Gauss-Newton steps end when they are small; the solver's own end is a thousandth
        assert np.abs(step).max() < 1e-3
        np.testing.assert_allclose(fits.covariance[k], covariance, rtol=1e-3, atol=1e-12)
        assert fits.chi2[k] == pytest.approx(2.0 * oracle.cost, rel=1e-6)


def test_pole_of_the_vanishing_line_is_the_image_of_the_circles_centre() -> None:
    rotation = cv2.Rodrigues(np.array([0.6, 0.5, 0.1]))[0]
    matrix = np.array([[5150.0, 0, 1535.5], [0, 5150.0, 1023.5], [0, 0, 1]])
    homography = matrix @ np.column_stack([rotation[:, :2], [3.0, -2.0, 140.0]])
    t = np.linspace(0.0, 2.0 * np.pi, 30, endpoint=False)
    circle = np.column_stack([2.0 + 0.94 * np.cos(t), 1.0 + 0.94 * np.sin(t), np.ones(30)])
    image = circle @ homography.T
    ellipse = fit(image[:, :2] / image[:, 2:])
    truth = homography @ [2.0, 1.0, 1.0]
    line = np.linalg.inv(homography).T @ [0.0, 0.0, 1.0]
    pole, _ = ellipse.pole(line)
    np.testing.assert_allclose(pole[0], truth[:2] / truth[2], atol=1e-8)
    assert np.linalg.norm(ellipse.centres()[0][0] - pole[0]) > 0.05


def test_algebraic_fit_agrees_with_opencv() -> None:
    rng = np.random.default_rng(4)
    points = rim(60) + 0.2 * rng.standard_normal((60, 2))
    ours = fit_ellipse_algebraic(points)
    assert not isinstance(ours, FitFailure)
    shifted = (points - CENTRE).astype(np.float32)
    oracle = np.array(cv2.fitEllipse(shifted)[0]) + CENTRE
    # OpenCV minimises another algebraic distance: both scatter by 0.2 sqrt(2 / 60) px
    np.testing.assert_allclose(ellipse_centre(ours), oracle, atol=0.2 * np.sqrt(2.0 / 60))


def test_algebraic_fit_survives_an_ellipse_through_the_pixel_origin() -> None:
    points = rim(24) - rim(24)[5]
    coefficients = fit_ellipse_algebraic(points)
    assert not isinstance(coefficients, FitFailure)
    np.testing.assert_allclose(ellipse_centre(coefficients), CENTRE - rim(24)[5], atol=1e-8)
    u, v = points.T
    monomials = np.column_stack([u * u, u * v, v * v, u, v, np.ones(24)])
    np.testing.assert_allclose(monomials @ coefficients, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    "points",
    [
        rim(5),
        np.zeros((9, 2)),
        np.column_stack([np.arange(9.0), np.arange(9.0)]),
        np.column_stack([np.linspace(-3, 3, 9), 1.0 / np.r_[-4:0, 1, 2:6].astype(float)]),
    ],
)
def test_algebraic_fit_refuses_what_is_no_ellipse(points: np.ndarray) -> None:
    assert isinstance(fit_ellipse_algebraic(points), FitFailure)


def test_canny_centre_of_a_disc_is_right_to_a_fraction_of_a_pixel() -> None:
    image = np.full((120, 120), 200, np.uint8)
    cv2.circle(image, (60 * 16 + 5, 58 * 16 - 3), 30 * 16, 40, -1, cv2.LINE_AA, 4)
    centres = np.array([[60.0, 58.0], [20.0, 20.0]])
    shapes = np.array([np.eye(2) * 30.0**2, np.eye(2) * 4.0])
    found = thesis_centres(image, centres, shapes)
    np.testing.assert_allclose(found[0], [60.3125, 57.8125], atol=0.1)
    assert np.isnan(found[1]).all()


def test_a_view_with_printed_centres_keeps_its_numbers_and_loses_its_edges() -> None:
    """Eqs. 2.22 to 2.27 on each circle: within the pixel grid's pull of the rendered truth."""
    pattern = CirclePattern(9, 7, 10.0, 5.0)
    scene = render(pattern, 250.0, tilt_deg=20.0)
    seen = exposure(scene.image)
    view = detect_target(seen, CircleGrid(9, 7, 10.0))
    assert isinstance(view, TargetView)
    binned = exposure(scene.image, window=SensorWindow(binning=2))
    twice = detect_target(binned, CircleGrid(9, 7, 10.0))
    assert isinstance(twice, TargetView)
    assert len(with_printed_centres(twice, binned)) == len(twice)
    printed = with_printed_centres(view, seen)
    assert printed.edges is None
    assert len(printed) == len(view)
    np.testing.assert_array_equal(printed.point_index, view.point_index)
    assert 0.0 < np.abs(printed.points_px - view.points_px).max() < 0.5
