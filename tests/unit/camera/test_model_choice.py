# SPDX-License-Identifier: Apache-2.0
"""All coefficients beside the size that they have in usual lenses: what is solved, what is said of
it, and how far it errs on random lenses.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from armscan.calibration.cameras.adjustment import (
    Observations,
    State,
    adjust,
    basis_of,
    gather,
    joint_covariance,
    linearise,
)
from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.distortion import typical_coefficients
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.geometry.estimate import FitFailure
from armscan.models.camera import PARAMETER_NAMES, CameraModel
from armscan.vision.targets.target import Chessboard, TargetView
from rigs.camera_scene import CAMERA, GRID, Scene, make_views, normalised_error
from rigs.instrument_stages import run_camera
from rigs.instruments import draw_instrument
from rigs.plain_scanner import plain_camera

FREE = PARAMETER_NAMES


def solved_beside(known: np.ndarray) -> tuple[Observations, State, np.ndarray]:
    """Observations with what is known, their minimum, and its basis."""
    views, poses = make_views(Scene(n_views=5, noise_px=0.3, reach=0.1), 3)
    seen = replace(gather(views, "pinhole"), known=known)
    start = State.from_poses(np.r_[CAMERA.parameters, 0.0, 0.0], poses)
    basis = basis_of(FREE, is_aspect_fixed=False)
    found = adjust(seen, start, basis)
    assert not isinstance(found, FitFailure)
    return seen, found.state, basis


def test_what_is_known_pulls_as_the_points_do_at_the_minimum() -> None:
    """The gradient of chi2 + sum of known value^2 vanishes, and its curvature is in the inverse."""
    known = np.zeros(11)
    known[5:9] = 1.0 / typical_coefficients(CAMERA, PARAMETER_NAMES[5:]) ** 2
    seen, state, basis = solved_beside(known)
    points = linearise(replace(seen, known=0.0 * known), state, basis, np.ones(len(seen.points_px)))
    both = linearise(seen, state, basis, np.ones(len(seen.points_px)))
    assert points is not None
    assert both is not None
    pull = basis.T @ (known * state.shared)
    assert np.abs(pull[5:]).max() > 0.0
    off = (points.shared_gradient - pull) / np.sqrt(np.diag(points.shared))
    assert np.abs(off).max() < 1e-3
    np.testing.assert_allclose(both.chi2, points.chi2 + known @ state.shared**2)
    alone, beside = (joint_covariance(each, basis) for each in (points, both))
    assert not isinstance(alone, FitFailure)
    assert not isinstance(beside, FitFailure)
    smaller = np.diag(alone[0])[:9] - np.diag(beside[0])[:9]
    assert (smaller > 0.0).all()
    assert (np.diag(beside[0])[5:9] * known[5:9] < 1.0).all()


def test_a_usual_coefficient_moves_the_corner_by_a_part_of_the_one_before_it() -> None:
    for f, first in ((20000.0, 0.1), (2800.0, 0.209), (1500.0, 0.3)):
        camera = plain_camera((f, f), (1023.5, 767.5), (2048, 1536), [0, 0, 0, 0, 0])
        square = 0.25 * (2048**2 + 1536**2) / f**2
        k1, k2, p1, p2, k3 = typical_coefficients(camera, PARAMETER_NAMES[4:])
        assert k1 == np.inf
        assert k2 * square**2 == pytest.approx(0.3 * first, rel=0.02)
        assert k3 * square**3 == pytest.approx(0.09 * first, rel=0.02)
        assert p1 == p2 == 1e-3


def test_few_central_views_do_not_let_coefficients_run_and_say_what_they_rest_on() -> None:
    scene = Scene(n_views=4, noise_px=0.3, distance_mm=900.0, reach=0.05, max_tilt_deg=50.0)
    run = []
    for seed in range(6):
        views = make_views(scene, seed)[0]
        fit = calibrate_camera(views)
        free = calibrate_camera(views, CameraOptions(distortion="k1k2p1p2k3"))
        asked = calibrate_camera(views, CameraOptions(distortion="k1"))
        assert isinstance(fit, CameraFit)
        assert isinstance(free, CameraFit)
        assert isinstance(asked, CameraFit)
        usual = typical_coefficients(fit.camera, PARAMETER_NAMES[5:])
        assert (np.abs(fit.camera.parameters[5:]) < 3.0 * usual).all()
        assert (fit.sigma[5:] <= 1.1 * usual).all()
        assert "rest" in fit.model_reason
        assert "k3" in fit.model_reason.split(";")[1]
        assert (asked.sigma[5:] == 0.0).all()
        assert (fit.sigma[:4] >= 0.9 * asked.sigma[:4]).all()
        run.append(np.abs(free.camera.parameters[5:] / usual).max())
    assert np.median(run) > 3.0


def lens(rng: np.random.Generator) -> CameraModel:
    """A lens with all of the usual coefficients."""
    first, second = rng.uniform(-0.1, -0.02), rng.uniform(-0.5, 0.5)
    square = 0.25 * (1280**2 + 1024**2) / 1800.0**2
    return plain_camera(
        (1800.0, 1801.0),
        (650.0, 500.0),
        (1280, 1024),
        np.array([first / square, first * second / square**2, *rng.normal(0.0, 7e-4, 2), 0.0]),
    )


def bent(view: TargetView, rng: np.random.Generator, size_px: float) -> TargetView:
    """Residuals that neighbours share: a cubic error field over the view."""
    p = view.points_px - view.points_px.mean(axis=0)
    u, v = (p / np.abs(p).max(axis=0)).T
    terms = np.stack([u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], axis=1)
    field = terms @ rng.normal(size=(7, 2))
    return replace(view, points_px=view.points_px + size_px / np.sqrt(np.mean(field**2)) * field)


@pytest.mark.parametrize(("reach", "share", "is_bent"), [(0.03, 0.3, False), (0.28, 0.55, True)])
def test_errors_stay_within_sigma_where_the_board_covers_little_or_views_are_bent(
    *, reach: float, share: float, is_bent: bool
) -> None:
    """Fixed draws; mean of e' C^-1 e over 4 for fx, fy, cx, cy. With coefficients left at zero
    as if known it is 40 in the first case, without the design effect 9 in the second.
    """
    squares = []
    for seed in range(10):
        rng = np.random.default_rng([7, seed])
        camera = lens(rng)
        distance = 100.0 * camera.fx_px / (share * camera.width_px)
        views = make_views(
            Scene(camera, Chessboard(11, 8, 10.0), 12, 0.03, distance, 40.0, reach), 70 + seed
        )[0]
        if is_bent:
            views = [bent(view, rng, 0.03) for view in views]
        fit = calibrate_camera(views)
        assert isinstance(fit, CameraFit)
        truth, value = camera.parameters[:4], fit.camera.parameters[:4]
        squares.append(normalised_error(truth, value, fit.covariance[:4, :4]))
    low, high = stats.chi2.ppf([0.001, 0.999], 4 * len(squares)) / 4 / len(squares)
    assert low < np.mean(squares) / 4 < high, np.round(squares, 2)


@pytest.mark.parametrize(
    ("focal_px", "distortion"),
    [
        (520.0, [-0.2, 0.1, 0.01, 0.005, 0.0]),
        (333.0, [-0.4, 0.25, 0.0, 0.0, 0.0]),
        (450.0, [-0.35, 0.45, 0.0, 0.0, -0.3]),
    ],
    ids=["decentred", "wide", "bent"],
)
@pytest.mark.parametrize("n_views", [12, 5])
def test_lenses_beyond_the_usual_are_not_held_to_it(
    focal_px: float, distortion: list[float], n_views: int
) -> None:
    """What a size took away made residuals large and alike, and these its weight: focal lengths
    were off by up to 160 px of 333.
    """
    lens = plain_camera((focal_px,) * 2, (325.0, 236.0), (640, 480), distortion)
    distance_mm = 330.0 * focal_px / 520.0
    scene = Scene(lens, n_views=n_views, noise_px=0.15, distance_mm=distance_mm, reach=0.4)
    errors = []
    for seed in range(6):
        fit = calibrate_camera(make_views(scene, seed)[0], CameraOptions(n_folds=0))
        assert isinstance(fit, CameraFit)
        assert fit.camera.lens == "pinhole"
        error = (lens.parameters[:4], fit.camera.parameters[:4], fit.covariance[:4, :4])
        errors.append(normalised_error(*error))
    low, high = stats.chi2.ppf([0.0005, 0.9995], 4 * len(errors)) / len(errors)
    assert low < np.mean(errors) < high


def test_a_long_lens_that_bends_its_small_field_as_others_do_is_not_held_to_less() -> None:
    """By -2, 1.5 and -0.6 % at the corner, as photographic lenses of long focal length do. With
    sizes that fall with the square of the field the mean is 28.
    """
    square = 0.25 * (2448.0**2 + 2048.0**2) / 12000.0**2
    radial = np.array([-0.02, 0.015, -0.006]) / square ** np.arange(1, 4)
    distortion = [*radial[:2], 1e-3, -7e-4, radial[2]]
    lens = plain_camera((12000.0,) * 2, (1230.0, 1010.0), (2448, 2048), distortion)
    scene = Scene(lens, GRID, 8, 0.1, 1500.0, 45.0, 0.1)
    errors = []
    for seed in range(8):
        fit = calibrate_camera(make_views(scene, seed)[0], CameraOptions(n_folds=0))
        assert isinstance(fit, CameraFit)
        errors.append(normalised_error(lens.parameters, fit.camera.parameters, fit.covariance))
    low, high = stats.chi2.ppf([0.0005, 0.9995], 9 * len(errors)) / len(errors)
    assert low < np.mean(errors) < high


def test_beside_the_sizes_the_adjustment_starts_at_the_free_solution_too() -> None:
    """From both closed forms it ended at a focal length of 41 px (8988 px is true)."""
    assert run_camera(draw_instrument(8200198)).outcome.result == "right"


def test_a_point_at_the_limit_of_outliers_frees_nothing() -> None:
    """The free solution set it aside, the other kept it: chi2 was larger by its own 25, for which
    all coefficients were freed, and k3 was 76.
    """
    scene = Scene(n_views=6, noise_px=0.1, distance_mm=700.0, reach=0.05)
    views, _ = make_views(scene, 2)
    for sigmas in (4.96, 5.0, 5.04):
        points = views[2].points_px.copy()
        points[3] += sigmas * scene.noise_px * np.array([0.6, 0.8])
        moved = [*views[:2], replace(views[2], points_px=points), *views[3:]]
        fit = calibrate_camera(moved, CameraOptions(n_folds=0))
        assert isinstance(fit, CameraFit)
        (usual,) = typical_coefficients(fit.camera, ("k3",))
        assert abs(fit.camera.parameters[8]) < usual
        assert "k3 rests more" in fit.model_reason
