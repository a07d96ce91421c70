# SPDX-License-Identifier: Apache-2.0
"""Rigid registration: against SciPy, against its own covariance, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.poses import Frame, Pose
from armscan.geometry.registration import (
    PointPairs,
    carried_covariance_mm2,
    closed_form_pose,
    misfits,
    register_points,
    spread_mm,
)
from armscan.geometry.rotations import rotation_from_vector, vector_from_rotation

SIZE = np.array([120.0, 90.0, 40.0])


def some_pose(generator: np.random.Generator) -> Pose[Frame, Frame]:
    return Pose(rotation_from_vector(generator.normal(size=3)), generator.normal(size=3) * 400.0)


def covariances(generator: np.random.Generator, n: int) -> FloatArray:
    """Long in one direction, as a stereo head measures: 0.01 to 0.06 mm."""
    axes = np.linalg.qr(generator.normal(size=(n, 3, 3)))[0]
    sigma = np.sort(generator.uniform(0.01, 0.06, (n, 3)), axis=1)
    return np.asarray((axes * sigma[:, None] ** 2) @ np.swapaxes(axes, 1, 2))


def noisy(
    generator: np.random.Generator, points: FloatArray, pose: Pose[Frame, Frame]
) -> PointPairs:
    n = len(points)
    c_a, c_b = covariances(generator, n), covariances(generator, n)
    a = points @ pose.rotation.T + pose.translation_mm
    e_a = np.einsum("nij,nj->ni", np.linalg.cholesky(c_a), generator.normal(size=(n, 3)))
    e_b = np.einsum("nij,nj->ni", np.linalg.cholesky(c_b), generator.normal(size=(n, 3)))
    return PointPairs(
        points_a_mm=a + e_a, points_b_mm=points + e_b, covariance_a_mm2=c_a, covariance_b_mm2=c_b
    )


def fitted(pairs: PointPairs) -> Estimate[Pose[Frame, Frame]]:
    fit: Estimate[Pose[Frame, Frame]] | FitFailure = register_points(pairs)
    assert isinstance(fit, Estimate)
    return fit


def error(pose: Pose[Frame, Frame], truth: Pose[Frame, Frame]) -> FloatArray:
    turn = vector_from_rotation(truth.rotation @ pose.rotation.T)
    return np.concatenate([turn, truth.translation_mm - pose.translation_mm])


def test_points_without_noise_give_the_motion_exactly() -> None:
    generator = np.random.default_rng(0)
    points, pose = generator.normal(size=(5, 3)) * SIZE, some_pose(generator)
    moved = points @ pose.rotation.T + pose.translation_mm
    c = covariances(generator, 5)
    np.testing.assert_allclose(
        fitted(
            PointPairs(
                points_a_mm=moved, points_b_mm=points, covariance_a_mm2=c, covariance_b_mm2=c
            )
        ).value.matrix,
        pose.matrix,
        atol=1e-9,
    )


def test_equal_weights_agree_with_scipy() -> None:
    generator = np.random.default_rng(1)
    points, pose = generator.normal(size=(7, 3)) * SIZE, some_pose(generator)
    pairs = noisy(generator, points, pose)
    unit = np.tile(1e-4 * np.eye(3), (7, 1, 1))
    found = fitted(
        PointPairs(
            points_a_mm=pairs.points_a_mm,
            points_b_mm=pairs.points_b_mm,
            covariance_a_mm2=unit,
            covariance_b_mm2=unit,
        )
    ).value
    a = pairs.points_a_mm - pairs.points_a_mm.mean(axis=0)
    b = pairs.points_b_mm - pairs.points_b_mm.mean(axis=0)
    expected, _ = Rotation.align_vectors(a, b)
    np.testing.assert_allclose(found.rotation, expected.as_matrix(), atol=1e-9)
    middle = pairs.points_a_mm.mean(axis=0) - found.rotation @ pairs.points_b_mm.mean(axis=0)
    np.testing.assert_allclose(found.translation_mm, middle, atol=1e-8)
    closed: Pose[Frame, Frame] = closed_form_pose(pairs.points_a_mm, pairs.points_b_mm)
    np.testing.assert_allclose(closed.matrix, found.matrix, atol=1e-8)


def test_full_covariances_agree_with_a_general_solver() -> None:
    """The same sum of squares, minimised by SciPy with numeric derivatives."""
    generator = np.random.default_rng(2)
    points, pose = generator.normal(size=(6, 3)) * SIZE, some_pose(generator)
    pairs = noisy(generator, points, pose)
    found = fitted(pairs)
    total = pairs.covariance_a_mm2 + (
        found.value.rotation @ pairs.covariance_b_mm2 @ found.value.rotation.T
    )
    white = np.linalg.inv(np.linalg.cholesky(total))

    def residuals(x: FloatArray) -> FloatArray:
        rotation = Rotation.from_rotvec(x[:3]).as_matrix()
        r = pairs.points_a_mm - pairs.points_b_mm @ rotation.T - 1e3 * x[3:]
        return np.einsum("nij,nj->ni", white, r).ravel()

    start = np.concatenate([pose.rotation_vector_rad, pose.translation_mm / 1e3])
    solved = least_squares(residuals, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert found.chi2 == pytest.approx(2.0 * solved.cost, rel=1e-7)
    expected = Rotation.from_rotvec(solved.x[:3]).as_matrix()
    # a thousandth of the turn's standard deviation
    limit = 1e-3 * float(found.sigma[:3].max())
    np.testing.assert_allclose(found.value.rotation, expected, atol=limit)


def test_errors_are_as_large_as_the_covariance_says() -> None:
    """Normalised errors are chi-square of six degrees: their mean of 300 is 6 +- 0.2 (sigma)."""
    generator = np.random.default_rng(3)
    values, squares = [], []
    for _ in range(300):
        points, pose = generator.normal(size=(6, 3)) * SIZE, some_pose(generator)
        fit = fitted(noisy(generator, points, pose))
        e = error(fit.value, pose)
        values.append(float(e @ np.linalg.solve(fit.covariance, e)))
        squares.append(fit.chi2)
    assert abs(np.mean(values) - 6.0) < 3.3 * np.sqrt(12.0 / 300)
    assert abs(np.mean(squares) - 12.0) < 3.3 * np.sqrt(24.0 / 300)
    inside = int((np.array(values) < chi2.ppf(0.95, 6)).sum())
    assert 275 <= inside <= 294


def test_moving_either_list_moves_the_answer_with_it() -> None:
    """Group axioms: (x a)_from_(y b) = x a_from_b y^-1, and back again."""
    generator = np.random.default_rng(4)
    points = generator.normal(size=(8, 3)) * SIZE
    pairs = noisy(generator, points, some_pose(generator))
    x, y = some_pose(generator), some_pose(generator)
    moved = PointPairs(
        points_a_mm=pairs.points_a_mm @ x.rotation.T + x.translation_mm,
        points_b_mm=pairs.points_b_mm @ y.rotation.T + y.translation_mm,
        covariance_a_mm2=x.rotation @ pairs.covariance_a_mm2 @ x.rotation.T,
        covariance_b_mm2=y.rotation @ pairs.covariance_b_mm2 @ y.rotation.T,
    )
    expected = x @ fitted(pairs).value @ y.inverse()
    np.testing.assert_allclose(fitted(moved).value.matrix, expected.matrix, atol=1e-7)
    back = PointPairs(
        points_a_mm=pairs.points_b_mm,
        points_b_mm=pairs.points_a_mm,
        covariance_a_mm2=pairs.covariance_b_mm2,
        covariance_b_mm2=pairs.covariance_a_mm2,
    )
    limit = 1e-3 * float(fitted(pairs).sigma[:3].min())
    turn = fitted(back).value.rotation @ fitted(pairs).value.rotation
    np.testing.assert_allclose(turn, np.eye(3), atol=limit)


def test_points_in_a_plane_are_turned_and_not_mirrored() -> None:
    """Where eq. 2.50 as printed gives det R = -1."""
    generator = np.random.default_rng(5)
    flat = generator.normal(size=(6, 3)) * [100.0, 80.0, 0.0]
    for _ in range(20):
        pose = some_pose(generator)
        found: Pose[Frame, Frame] = closed_form_pose(
            flat @ pose.rotation.T + pose.translation_mm, flat
        )
        np.testing.assert_allclose(found.matrix, pose.matrix, atol=1e-9)


def test_deleted_residuals_are_those_of_a_fit_without_the_point() -> None:
    generator = np.random.default_rng(6)
    points = generator.normal(size=(7, 3)) * SIZE
    pairs = noisy(generator, points, some_pose(generator))
    found = misfits(pairs, fitted(pairs))
    for k in range(7):
        kept = np.arange(7) != k
        rest = PointPairs(
            points_a_mm=pairs.points_a_mm[kept],
            points_b_mm=pairs.points_b_mm[kept],
            covariance_a_mm2=pairs.covariance_a_mm2[kept],
            covariance_b_mm2=pairs.covariance_b_mm2[kept],
        )
        pose = fitted(rest).value
        away = pairs.points_a_mm[k] - pose.rotation @ pairs.points_b_mm[k] - pose.translation_mm
        # second order in residuals of 0.05 mm over 100 mm
        np.testing.assert_allclose(found.offset_mm[k], away, atol=2e-4)


def test_a_point_that_moved_is_named_and_others_are_not() -> None:
    generator = np.random.default_rng(7)
    n_false = 0
    for _ in range(100):
        points = generator.normal(size=(8, 3)) * SIZE
        pairs = noisy(generator, points, some_pose(generator))
        n_false += misfits(pairs, fitted(pairs)).moved(0.05) is not None
        shifted = np.array(pairs.points_a_mm)
        shifted[3] += [0.5, -0.4, 0.3]
        moved = PointPairs(
            points_a_mm=shifted,
            points_b_mm=pairs.points_b_mm,
            covariance_a_mm2=pairs.covariance_a_mm2,
            covariance_b_mm2=pairs.covariance_b_mm2,
        )
        assert misfits(moved, fitted(moved)).moved(1e-3) == 3
    # five in a hundred are expected, fifteen would be a wrong test
    assert n_false < 14


def test_what_does_not_determine_a_motion_is_refused_with_the_reason() -> None:
    c = np.tile(4e-4 * np.eye(3), (6, 1, 1))
    line = np.outer(np.linspace(0.0, 200.0, 6), [0.6, 0.8, 0.0])
    failure = register_points(
        PointPairs(points_a_mm=line, points_b_mm=line, covariance_a_mm2=c, covariance_b_mm2=c)
    )
    assert isinstance(failure, FitFailure)
    assert "on a line" in failure.reason
    two = register_points(
        PointPairs(
            points_a_mm=line[:2],
            points_b_mm=line[:2],
            covariance_a_mm2=c[:2],
            covariance_b_mm2=c[:2],
        )
    )
    assert isinstance(two, FitFailure)
    assert "three points" in two.reason
    corner = np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0], [0.0, 50.0, 0.0]])
    assert isinstance(
        register_points(
            PointPairs(
                points_a_mm=corner,
                points_b_mm=corner,
                covariance_a_mm2=c[:3],
                covariance_b_mm2=c[:3],
            )
        ),
        Estimate,
    )
    with pytest.raises(InputError, match="not positive definite"):
        register_points(
            PointPairs(
                points_a_mm=corner,
                points_b_mm=corner,
                covariance_a_mm2=0.0 * c[:3],
                covariance_b_mm2=0.0 * c[:3],
            )
        )


def test_a_rough_point_among_good_ones_makes_no_line_of_them() -> None:
    """Five that span a triangle hold the turn; where they lie on a line, it holds none."""
    good = np.array([[0, 0, 0], [100, 0, 0], [0, 80, 0], [100, 80, 10], [50, 40, 20]], np.float64)
    line = good[0] + np.outer(np.linspace(0.0, 1.0, 5), good[1])
    own = np.array([1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 25.0])[:, None, None] * np.eye(3)
    for points, is_found in ((good, True), (line, False)):
        both = np.concatenate([points, [[20.0, 70.0, 5.0]]])
        pairs = PointPairs(
            points_a_mm=both, points_b_mm=both,
            covariance_a_mm2=own, covariance_b_mm2=np.zeros_like(own),
        )  # fmt: skip
        assert isinstance(register_points(pairs), Estimate) == is_found


def test_the_covariance_of_a_carried_point_is_that_of_many_registrations() -> None:
    generator = np.random.default_rng(8)
    points, pose = generator.normal(size=(5, 3)) * SIZE, some_pose(generator)
    far = np.array([[300.0, -200.0, 100.0]])
    truth = far @ pose.rotation.T + pose.translation_mm
    values = []
    for _ in range(300):
        fit = fitted(noisy(generator, points, pose))
        added = carried_covariance_mm2(far, np.zeros((1, 3, 3)), fit.value, fit.covariance)[0]
        away = (far @ fit.value.rotation.T + fit.value.translation_mm - truth)[0]
        values.append(float(away @ np.linalg.solve(added, away)))
    assert abs(np.mean(values) - 3.0) < 3.3 * np.sqrt(6.0 / 300)


def test_the_spread_is_the_standard_deviation_along_the_main_axes() -> None:
    box = np.array([(x, y, z) for x in (-3.0, 3.0) for y in (-2.0, 2.0) for z in (-1.0, 1.0)])
    np.testing.assert_allclose(spread_mm(box), [3.0, 2.0, 1.0])
