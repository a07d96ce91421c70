# SPDX-License-Identifier: Apache-2.0
"""Least-squares features against reference sets of 50 digits, and against differences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from armscan.errors import FileFormatError
from armscan.geometry.estimate import FitFailure
from armscan.geometry.features import (
    SHAPE_KINDS,
    Shape,
    ShapeKind,
    across,
    fit_shape,
    linearise,
    moved,
    parameter_names,
)
from rigs.reference_features import reference_set
from rigs.reference_sets import read_reference_pair, shape_error

LENGTH_MM, ANGLE_RAD = 1e-8, 1e-9
"""What a fit may be off a certified one, for arcs of 30 degrees and more."""


@pytest.mark.parametrize("kind", SHAPE_KINDS)
@pytest.mark.parametrize("arc_deg", [360.0, 90.0, 30.0])
def test_fits_are_the_certified_ones(tmp_path: Path, kind: ShapeKind, arc_deg: float) -> None:
    """Features of 1 to 500 mm up to 1000 mm away with form errors; read back from their files."""
    for seed in range(2):
        made = reference_set(kind, seed, arc_deg=arc_deg, n=24)
        made.write(tmp_path, f"{kind}{seed}")
        pair = read_reference_pair(tmp_path / f"{kind}{seed}.ds", kind)
        np.testing.assert_array_equal(pair.points_mm, made.points_mm)
        fit = fit_shape(kind, pair.points_mm)
        assert not isinstance(fit, FitFailure)
        error = shape_error(fit.value, pair.shape)
        assert max(error.place_mm, error.size_mm) < LENGTH_MM
        assert max(error.direction_rad, error.angle_rad) < ANGLE_RAD
        # form errors are there: a fit that returned its start would not be noticed without them
        assert float(np.abs(fit.residuals).max()) > 1e-3


def some_shape(kind: ShapeKind) -> Shape:
    is_round = kind not in ("plane", "line")
    return Shape(
        kind=kind,
        point_mm=np.array([3.0, -2.0, 5.0]),
        axes=across(np.array([0.3, -0.5, 0.8])),
        radius_mm=7.0 if is_round else 0.0,
        half_angle_rad=0.4 if kind == "cone" else 0.0,
    )


@pytest.mark.parametrize("kind", SHAPE_KINDS)
@pytest.mark.parametrize("with_plane", [False, True])
def test_jacobians_are_the_differences(kind: ShapeKind, with_plane: bool) -> None:
    shape = some_shape(kind)
    points = shape.point_mm + np.random.default_rng(4).normal(size=(9, 3)) * 8.0
    found = linearise(shape, points, with_plane=with_plane)
    step = 1e-6
    for k in range(found.jacobian.shape[1]):
        by = np.eye(found.jacobian.shape[1])[k] * step
        ahead, behind = (moved(shape, sign * by, with_plane=with_plane) for sign in (1, -1))
        change = (
            linearise(ahead, points, with_plane=with_plane).off_mm
            - linearise(behind, points, with_plane=with_plane).off_mm
        )
        np.testing.assert_allclose(found.jacobian[:, k], change / (2 * step), atol=1e-6)
    for axis in range(3):
        by = np.eye(3)[axis] * step
        change = (
            linearise(shape, points + by, with_plane=with_plane).off_mm
            - linearise(shape, points - by, with_plane=with_plane).off_mm
        )
        np.testing.assert_allclose(found.directions[:, axis], change / (2 * step), atol=1e-6)


def test_a_noisy_cone_is_the_minimum_that_scipy_finds() -> None:
    shape, rng = some_shape("cone"), np.random.default_rng(7)
    turn, along = rng.uniform(0, 2.0, 300), rng.uniform(-5, 8, 300)
    wide = shape.radius_mm + along * np.tan(shape.half_angle_rad)
    local = np.stack([wide * np.cos(turn), wide * np.sin(turn), along], axis=1)
    points = shape.point_mm + local @ shape.axes + rng.normal(0, 0.05, (300, 3))

    def off(state: np.ndarray) -> np.ndarray:
        axis = np.array([state[3], state[4], 1.0]) / np.sqrt(1 + state[3] ** 2 + state[4] ** 2)
        offset = points - [state[0], state[1], shape.point_mm[2]]
        height = offset @ axis
        radial = np.linalg.norm(offset - height[:, None] * axis, axis=1)
        return (radial - state[2]) * np.cos(state[5]) - height * np.sin(state[5])

    axis = shape.direction / shape.direction[2]
    start = [*shape.point_mm[:2], shape.radius_mm, axis[0], axis[1], shape.half_angle_rad]
    oracle = least_squares(off, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    fit = fit_shape("cone", points)
    assert not isinstance(fit, FitFailure)
    assert fit.residuals @ fit.residuals == pytest.approx(2 * oracle.cost, rel=1e-12)
    assert fit.value.half_angle_rad == pytest.approx(oracle.x[5], abs=1e-7)
    names = parameter_names("cone")
    sigma = float(np.sqrt(fit.covariance[-1, -1]))
    information = oracle.jac.T @ oracle.jac * (len(points) - len(names)) / (2 * oracle.cost)
    assert sigma == pytest.approx(float(np.sqrt(np.linalg.inv(information)[5, 5])), rel=1e-4)


def test_what_the_points_do_not_determine_is_refused() -> None:
    rng = np.random.default_rng(1)
    flat = np.concatenate([rng.normal(size=(50, 2)), np.zeros((50, 1))], axis=1)
    for kind in ("cylinder", "sphere"):
        assert isinstance(fit_shape(kind, flat + rng.normal(0, 0.01, flat.shape)), FitFailure)
    assert isinstance(fit_shape("circle", np.zeros((5, 3))), FitFailure)
    assert isinstance(fit_shape("cylinder", flat[:4]), FitFailure)


def test_a_pair_that_is_none_is_refused(tmp_path: Path) -> None:
    made = reference_set("sphere", 0, n=8)
    made.write(tmp_path, "ball")
    with pytest.raises(FileFormatError, match="4 numbers where a cone has 8"):
        read_reference_pair(tmp_path / "ball.ds", "cone")
    (tmp_path / "ball.fit").write_text("1\n2\nthree\n4\n")
    with pytest.raises(FileFormatError, match="rows of numbers"):
        read_reference_pair(tmp_path / "ball.ds", "sphere")
    (tmp_path / "ball.fit").unlink()
    with pytest.raises(FileFormatError, match="no such file"):
        read_reference_pair(tmp_path / "ball.ds", "sphere")
