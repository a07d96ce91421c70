# SPDX-License-Identifier: Apache-2.0
"""Least squares over any state: one Levenberg-Marquardt loop, whitening and robust scales.

A state may be anything (poses, sheets, a vector); a step is a vector of its tangent space, and
``retract(state, step)`` is the state after it. Residuals are whitened: of unit variance and
independent, so that ``chi2`` is their sum of squares.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Generic, TypeVar

import numpy as np
from scipy.linalg import eigh, solve_triangular
from scipy.special import ndtri

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray

S = TypeVar("S")
L = TypeVar("L")

MAX_STEPS = 100
SETTLED = 1e-12
"""Part of chi2 by which a step must lower it; less is the end of the search."""
FIRST_DAMPING = 1e-4
LEAST_DAMPING, MOST_DAMPING = 1e-15, 1e12

MAD_TO_SIGMA = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution: 1 / Phi^-1(3/4)."""
HUBER_LIMIT = 1.345
"""Huber's limit in standard deviations: 95 % efficiency for normal noise (Huber 1981)."""


LEAST_P = 1e-300
"""Below it distributions' tails leave double precision."""


def p_text(p_value: float) -> str:
    """A test's p value for a sentence: no data are impossible, so that it is never 0."""
    return f"p < {LEAST_P:.0e}" if p_value < LEAST_P else f"p = {p_value:.2g}"


def robust_sigma(residuals: FloatArray) -> float:
    """Standard deviation of residuals about zero from their median size; 0 where there are none."""
    size = np.abs(residuals).ravel()
    half = len(size) // 2
    if not len(size) or np.isnan(size.sum()):
        return np.nan if len(size) else 0.0
    ordered = np.partition(size, half)
    below = ordered[half] if len(size) % 2 else ordered[:half].max()
    return MAD_TO_SIGMA * float(0.5 * (below + ordered[half]))


def huber_weights(residuals: FloatArray, limit: float = HUBER_LIMIT) -> FloatArray:
    """Huber's weights of residuals in standard deviations: 1, beyond the limit limit / size."""
    return np.asarray(limit / np.maximum(np.abs(residuals), limit))


def eigen(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ascending eigenvalues (N,) of a symmetric matrix (N, N), and its eigenvectors as columns.

    NumPy divides and conquers, which in some builds of its library fails to converge on well
    conditioned matrices of more than 25 rows; then it is done by QR steps.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix holds what is no number.
    """
    try:
        return np.linalg.eigh(matrix)
    except np.linalg.LinAlgError:
        if not np.isfinite(matrix).all():
            raise
        return eigh(matrix, driver="ev")


def pseudo_inverse(matrix: FloatArray, share: float) -> FloatArray:
    """Inverse (N, N) of a symmetric matrix in the space of its eigenvalues that count.

    Those of a size up to ``share`` of the largest one's do not.
    """
    values, vectors = eigen(matrix)
    size = np.abs(values)
    kept = size > share * size.max(initial=0.0)
    return np.asarray((vectors[:, kept] / values[kept]) @ vectors[:, kept].T)


def scaled_inverse(covariance: FloatArray) -> FloatArray:
    """Pseudo-inverse (P, P) of a covariance of parameters of different units.

    It is found in units that make the diagonal one, so that no parameter is lost for its unit.
    """
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)
    units = np.outer(unit, unit)
    return np.asarray(pseudo_inverse(covariance / units, 1e-12) / units)


def square_root(covariance: FloatArray, name: str = "the covariance") -> FloatArray:
    """(P, R) matrix L with ``L L' = covariance`` (P, P), also for one without full rank R.

    It is found in units that make the diagonal one, so that no parameter is lost for its unit.

    Raises
    ------
    InputError
        If the covariance has a negative eigenvalue beyond rounding.
    """
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)
    values, vectors = eigen(covariance / np.outer(unit, unit))
    largest = max(float(values[-1]), 0.0) if len(values) else 0.0
    if len(values) and float(values[0]) < -1e-6 * max(largest, 1.0):
        raise InputError(f"{name} is not positive semi-definite")
    kept = values > 1e-15 * largest
    # not by ``unit``: of parameters that are held, rounding of the vectors would stay
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


class Whitening:
    """Turns residuals of a covariance (N, N) into independent ones of unit variance.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the covariance is not positive definite.
    """

    def __init__(self, covariance: FloatArray) -> None:
        self._root = np.linalg.cholesky(covariance)

    def __call__(self, values: FloatArray) -> FloatArray:
        """Whitened residuals (N,), or the rows of a Jacobian (N, K)."""
        return np.asarray(solve_triangular(self._root, values, lower=True))


@dataclass(frozen=True, eq=False, kw_only=True)
class DenseSystem:
    """Whitened residuals (N,) and their Jacobian (N, K) by the step at a state."""

    residuals: FloatArray
    jacobian: FloatArray

    @property
    def chi2(self) -> float:
        """Sum of squared residuals."""
        return float(self.residuals @ self.residuals)

    def step(self, damping: float) -> FloatArray:
        """(K,) step; directions that no residual notices are left alone."""
        scale = np.linalg.norm(self.jacobian, axis=0)
        scale[scale == 0.0] = 1.0
        n = len(scale)
        stacked = np.vstack([self.jacobian / scale, np.sqrt(damping) * np.eye(n)])
        target = np.concatenate([-self.residuals, np.zeros(n)])
        return np.asarray(np.linalg.lstsq(stacked, target, rcond=1e-12)[0] / scale)

    def promised(self, step: FloatArray) -> float:
        """Decrease of chi2 that the linear model promises of a step."""
        ahead = self.residuals + self.jacobian @ step
        return self.chi2 - float(ahead @ ahead)

    @property
    def covariance(self) -> FloatArray | None:
        """(K, K) covariance of the step, ``(J' J)^-1``; None where the Jacobian lacks rank."""
        scale = np.linalg.norm(self.jacobian, axis=0)
        if not bool((scale > 0.0).all()):
            return None
        _, values, axes = np.linalg.svd(self.jacobian / scale, full_matrices=False)
        if len(values) < len(scale) or values[-1] <= 1e-12 * values[0]:
            return None
        root = axes.T / values / scale[:, None]
        return np.asarray(root @ root.T)


@dataclass(frozen=True, eq=False, kw_only=True)
class Minimum(Generic[S, L]):
    """Where a search ended; ``is_settled`` is False if the steps ran out."""

    state: S
    system: L
    chi2: float
    is_settled: bool


def levenberg_marquardt(
    start: S,
    linearise: Callable[[S], tuple[FloatArray, FloatArray] | None],
    retract: Callable[[S, FloatArray], S],
    *,
    settled: float = SETTLED,
    max_steps: int = MAX_STEPS,
) -> Minimum[S, DenseSystem] | None:
    """Minimise the sum of squared residuals over a state.

    Parameters
    ----------
    start
        Where to begin.
    linearise
        Whitened residuals (N,) at a state and their derivative (N, K) by a step from it, or None
        where the state is impossible.
    retract
        The state after a step (K,).
    settled
        Part of chi2 by which a step must lower it.
    max_steps
        Most evaluations.

    Returns
    -------
    Minimum
        None if the start is impossible.
    """

    def evaluate(state: S) -> tuple[float, DenseSystem] | None:
        found = linearise(state)
        if found is None:
            return None
        system = DenseSystem(residuals=found[0], jacobian=found[1])
        return system.chi2, system

    def propose(state: S, system: DenseSystem, damping: float) -> tuple[S, float]:
        step = system.step(damping)
        return retract(state, step), system.promised(step)

    return minimise(start, evaluate, propose, settled=settled, max_steps=max_steps)


def minimise(
    start: S,
    evaluate: Callable[[S], tuple[float, L] | None],
    propose: Callable[[S, L, float], tuple[S, float] | None],
    *,
    settled: float = SETTLED,
    max_steps: int = MAX_STEPS,
) -> Minimum[S, L] | None:
    """Levenberg-Marquardt's loop for systems that are not dense (see `levenberg_marquardt`).

    ``evaluate`` gives chi2 at a state and whatever ``propose`` needs of it, or None where it is
    impossible; ``propose``, for a damping relative to the diagonal, the state after the damped step
    and the decrease of chi2 that the linear model promises, or None.
    """
    found = evaluate(start)
    if found is None:
        return None
    state, (chi2, system), damping = start, found, FIRST_DAMPING
    for _ in range(max_steps):
        proposal = propose(state, system, damping)
        trial = evaluate(proposal[0]) if proposal is not None else None
        if proposal is None or trial is None or not trial[0] <= chi2:
            hidden = proposal is not None and proposal[1] <= settled * chi2
            if hidden or damping > MOST_DAMPING:
                return Minimum(state=state, system=system, chi2=chi2, is_settled=True)
            damping = max(10.0 * damping, 1e-6)
            continue
        gain = chi2 - trial[0]
        state, (chi2, system), damping = proposal[0], trial, max(0.1 * damping, LEAST_DAMPING)
        if gain <= settled * chi2 or chi2 == 0.0:
            return Minimum(state=state, system=system, chi2=chi2, is_settled=True)
    return Minimum(state=state, system=system, chi2=chi2, is_settled=False)


N_DRAWS = 128
SOBOL_BITS = 30
SOBOL_DIRECTIONS = (
    (1, 1, 1, 1, 1, 1, 1), (1, 3, 5, 15, 17, 51, 85), (1, 3, 3, 9, 29, 23, 71),
    (1, 3, 1, 5, 31, 29, 81), (1, 1, 1, 11, 31, 55, 61), (1, 1, 3, 3, 25, 9, 43),
    (1, 3, 5, 13, 11, 37, 31), (1, 1, 5, 5, 17, 9, 9), (1, 1, 5, 5, 5, 53, 53),
)  # fmt: skip
"""Of up to nine dimensions (Joe and Kuo 2008), for `N_DRAWS` draws."""


@cache
def normal_draws(n: int) -> FloatArray:
    """(N_DRAWS, n) evenly spread draws of a standard normal distribution, n up to nine.

    Sobol's sequence, scrambled, to the last bit as ``scipy.stats.qmc.Sobol`` has it, whose import
    takes longer than the draws' use. Digits are binary, the highest first.
    """
    random, number = np.random.default_rng(0).spawn(1)[0], np.arange(N_DRAWS)
    shift = random.integers(2, size=(n, SOBOL_BITS), dtype=np.uint32)[:, None, ::-1]
    mixing = random.integers(2, size=(n, SOBOL_BITS, SOBOL_BITS), dtype=np.uint32)
    mixing = np.tril(mixing, -1) + np.eye(SOBOL_BITS, dtype=np.uint32)
    place = np.arange(SOBOL_BITS)
    directions = np.array(SOBOL_DIRECTIONS[:n])
    column = np.arange(directions.shape[1])
    digits = (directions[:, :, None] << place) >> column[:, None] & 1
    chosen = ((number ^ number >> 1)[:, None] >> column) & 1
    mixed = (chosen @ digits @ mixing.transpose(0, 2, 1) + shift) % 2
    return np.asarray(ndtri((mixed @ 0.5 ** (place + 1.0)).T))
