# SPDX-License-Identifier: Apache-2.0
"""The one solver against SciPy's, and its robust scales against their definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from scipy.stats import norm

from armscan.errors import InputError
from armscan.geometry import least_squares
from armscan.geometry.arrays import FloatArray
from armscan.geometry.least_squares import (
    HUBER_LIMIT,
    MAD_TO_SIGMA,
    Whitening,
    eigen,
    huber_weights,
    levenberg_marquardt,
    minimise,
    p_text,
    pseudo_inverse,
    robust_sigma,
    square_root,
)
from armscan.geometry.poses import Base, Pose, Sensor

RNG_SEED = 20260101


def decay(times: FloatArray, parameters: FloatArray) -> FloatArray:
    return np.asarray(parameters[0] * np.exp(-parameters[1] * times) + parameters[2])


def decay_jacobian(times: FloatArray, parameters: FloatArray) -> FloatArray:
    fall = np.exp(-parameters[1] * times)
    return np.column_stack([fall, -parameters[0] * times * fall, np.ones_like(times)])


@pytest.mark.parametrize("start", [(1.0, 1.0, 0.0), (20.0, 0.01, -5.0), (2.0, 2.0, 3.0)])
def test_it_ends_where_scipy_does(start: tuple[float, float, float]) -> None:
    times = np.linspace(0.0, 6.0, 60)
    noise = 0.05 * np.random.default_rng(RNG_SEED).standard_normal(60)
    levels = decay(times, np.array([5.0, 0.7, 1.0])) + noise
    fit = levenberg_marquardt(
        np.array(start),
        lambda p: (decay(times, p) - levels, decay_jacobian(times, p)),
        lambda p, step: p + step,
    )

    def misfit(p: FloatArray) -> FloatArray:
        return decay(times, p) - levels

    oracle = scipy.optimize.least_squares(
        misfit, [5.0, 0.7, 1.0], xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    assert fit is not None
    assert fit.is_settled
    np.testing.assert_allclose(fit.state, oracle.x, rtol=1e-6)
    np.testing.assert_allclose(fit.chi2, 2.0 * oracle.cost, rtol=1e-10)
    covariance = fit.system.covariance
    jacobian = np.asarray(oracle.jac)
    information_inverse = np.linalg.inv(jacobian.T @ jacobian)
    assert covariance is not None
    np.testing.assert_allclose(covariance, information_inverse, rtol=1e-4)


def test_it_moves_on_a_manifold() -> None:
    """A pose from points, from half a turn away: retracted, never re-orthonormalised."""
    rng = np.random.default_rng(RNG_SEED)
    truth: Pose[Base, Sensor] = Pose.from_vectors([0.4, -1.1, 2.2], [100.0, -50.0, 30.0])
    points = rng.uniform(-100.0, 100.0, (30, 3))
    seen = truth.apply(points)

    def linearise(pose: Pose[Base, Sensor]) -> tuple[FloatArray, FloatArray]:
        return (pose.apply(points) - seen).ravel(), pose.jacobian(points).reshape(-1, 6)

    start: Pose[Base, Sensor] = Pose(np.eye(3), np.zeros(3))
    fit = levenberg_marquardt(start, linearise, lambda pose, step: pose.retract(step))
    assert fit is not None
    np.testing.assert_allclose(fit.state.matrix, truth.matrix, atol=1e-9)


def test_an_impossible_trial_is_damped_and_an_impossible_start_is_none() -> None:
    def linearise(x: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        if x[0] <= 0.0:
            return None
        return np.log(x), 1.0 / x[:, None]

    fit = levenberg_marquardt(np.array([50.0]), linearise, lambda x, step: x + step)
    assert fit is not None
    np.testing.assert_allclose(fit.state, [1.0], rtol=1e-6)
    assert levenberg_marquardt(np.array([-1.0]), linearise, lambda x, step: x + step) is None


def test_a_direction_that_no_residual_notices_stays_and_has_no_covariance() -> None:
    fit = levenberg_marquardt(
        np.array([3.0, 7.0]),
        lambda p: (p[:1] - 1.0, np.array([[1.0, 0.0]])),
        lambda p, step: p + step,
    )
    assert fit is not None
    np.testing.assert_allclose(fit.state, [1.0, 7.0])
    assert fit.system.covariance is None


def test_steps_that_run_out_are_told() -> None:
    fit = levenberg_marquardt(
        np.array([1.0]), lambda p: (p**3, 3.0 * p[:, None] ** 2), lambda p, s: p + s, max_steps=3
    )
    assert fit is not None
    assert not fit.is_settled


def test_systems_that_are_not_dense_take_the_same_loop() -> None:
    """A diagonal system: chi2 and steps by hand."""
    target = np.arange(4.0)
    fit = minimise(
        np.zeros(4),
        lambda x: (float((x - target) @ (x - target)), x - target),
        lambda x, rest, damping: (x - rest / (1.0 + damping), float(rest @ rest)),
    )
    assert fit is not None
    np.testing.assert_allclose(fit.state, target, atol=1e-9)
    assert minimise(np.zeros(1), lambda x: (1.0, x), lambda x, rest, damping: None) is not None, (
        "no step at all is an end"
    )


def test_whitened_residuals_weigh_as_the_covariance_does() -> None:
    rng = np.random.default_rng(RNG_SEED)
    root = rng.standard_normal((5, 5)) + 3.0 * np.eye(5)
    covariance, residuals = root @ root.T, rng.standard_normal(5)
    whitening = Whitening(covariance)
    expected = residuals @ np.linalg.solve(covariance, residuals)
    np.testing.assert_allclose(np.sum(whitening(residuals) ** 2), expected)
    with pytest.raises(np.linalg.LinAlgError):
        Whitening(-covariance)


def test_square_root_of_a_covariance_without_full_rank() -> None:
    units = np.diag([1e-6, 1.0, 1e6])
    factor = units @ np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 2.0]])
    covariance = factor @ factor.T
    root = square_root(covariance)
    assert root.shape == (3, 2)
    np.testing.assert_allclose(root @ root.T, covariance, rtol=1e-12, atol=1e-12)
    assert square_root(np.zeros((2, 2))).shape == (2, 0)
    with pytest.raises(InputError, match="semi-definite"):
        square_root(np.diag([1.0, -1.0]))


def test_square_root_of_what_is_held_is_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever eigenvectors leave there: its inverse square was taken for a weight."""

    def rounded(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
        values, vectors = np.linalg.eigh(matrix)
        return values, vectors + 1e-17

    monkeypatch.setattr(least_squares, "eigen", rounded)
    covariance = np.zeros((5, 5))
    free = np.ix_([0, 2, 4], [0, 2, 4])
    covariance[free] = [[4.0, 1.0, 0.5], [1.0, 2.0, 0.3], [0.5, 0.3, 1.0]]
    root = square_root(covariance)
    assert (root[[1, 3]] == 0.0).all()
    np.testing.assert_allclose(root @ root.T, covariance, atol=1e-14)


def test_robust_constants_are_those_of_the_normal_distribution() -> None:
    np.testing.assert_allclose(MAD_TO_SIGMA, 1.0 / norm.ppf(0.75), rtol=3e-5)
    residuals = np.random.default_rng(RNG_SEED).normal(0.0, 2.0, 200_000)
    np.testing.assert_allclose(robust_sigma(residuals), 2.0, rtol=0.01)
    assert robust_sigma(np.zeros(0)) == 0.0
    inside = float(norm.cdf(HUBER_LIMIT) - norm.cdf(-HUBER_LIMIT))
    clipped = 2.0 * (HUBER_LIMIT**2 * norm.sf(HUBER_LIMIT))
    variance = inside - 2.0 * HUBER_LIMIT * norm.pdf(HUBER_LIMIT) + clipped
    np.testing.assert_allclose(inside**2 / variance, 0.95, atol=1e-3)
    np.testing.assert_allclose(huber_weights(np.array([-0.5, 1.345, -2.69])), [1.0, 1.0, 0.5])


def test_eigenvalues_come_also_where_divide_and_conquer_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Some builds of the library under NumPy do not converge on well conditioned matrices."""
    root = np.random.default_rng(RNG_SEED).standard_normal((40, 60))
    matrix = root @ root.T
    expected = scipy.linalg.eigvalsh(matrix)

    def fail(_matrix: FloatArray) -> None:
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    for _ in range(2):
        values, vectors = eigen(matrix)
        np.testing.assert_allclose(values, expected, rtol=1e-11)
        np.testing.assert_allclose((vectors * values) @ vectors.T, matrix, atol=1e-11 * values[-1])
        monkeypatch.setattr(np.linalg, "eigh", fail)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_pseudo_inverse_is_scipys(sign: float) -> None:
    root = np.random.default_rng(RNG_SEED).standard_normal((12, 5))
    matrix = sign * root @ root.T
    np.testing.assert_allclose(
        pseudo_inverse(matrix, 1e-10), scipy.linalg.pinvh(matrix, rtol=1e-10), atol=1e-12
    )


def test_no_data_are_impossible() -> None:
    """A tail that double precision cannot hold is told by what it is less than, a gap as one."""
    told = [p_text(p) for p in (1.0, 0.0301, 1.5e-13, 2e-300, 5e-324, 0.0, math.nan)]
    assert told == [
        "p = 1",
        "p = 0.03",
        "p = 1.5e-13",
        "p = 2e-300",
        *["p < 1e-300"] * 2,
        "p = nan",
    ]
