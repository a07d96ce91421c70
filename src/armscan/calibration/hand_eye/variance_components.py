# SPDX-License-Identifier: Apache-2.0
"""Standard deviations of arm, flatness and stripe from the residuals themselves.

Restricted maximum likelihood: the likelihood of those combinations of the residuals that no
hand-eye can change, so that the fitted parameters do not make the scatter look too small. A dozen
postures say little about each cause of scatter, so the logarithm of every standard deviation is
held near its typical value by a wide normal distribution (a factor of 2.7, see `noise_model`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2

from armscan.calibration.hand_eye.least_squares import LinearSolution, solve_linear
from armscan.calibration.hand_eye.noise_model import NoiseComponent, total_covariance
from armscan.calibration.hand_eye.plate_residuals import N_HAND_EYE
from armscan.geometry.arrays import FloatArray, IntArray

REGION = 0.95
MAX_ROUNDS = 30
SETTLED = 1e-3
LONGEST_STEP = 1.0
MAX_LOG = 7.0
"""A standard deviation leaves its typical value by a factor of 1100 at most."""


@dataclass(frozen=True, slots=True, eq=False)
class NoiseEstimate:
    """Standard deviations of the causes of scatter.

    Parameters
    ----------
    sigmas
        (C,) of each component, given ones included.
    log_covariance
        (C, C) of their logarithms; zero for given ones.
    """

    sigmas: FloatArray
    log_covariance: FloatArray


def estimate_noise(
    residual: FloatArray,
    slopes: FloatArray,
    components: tuple[NoiseComponent, ...],
    fixed: FloatArray,
    start: FloatArray | None = None,
) -> NoiseEstimate:
    """Maximise the restricted likelihood by scoring.

    Parameters
    ----------
    residual, slopes
        (N,) and (N, K) at the minimum.
    components
        Causes of scatter.
    fixed
        (N, N) covariance that is added and not estimated (the probed plane).
    start
        (C,) standard deviations to begin with; those of the components if None.
    """
    typical = np.array([component.sigma for component in components])
    free = np.flatnonzero([c.is_estimated for c in components]).astype(np.int64)
    sigmas = typical.copy() if start is None else start.copy()
    spread = np.zeros((len(components), len(components)))
    if len(free) == 0:
        return NoiseEstimate(sigmas, spread)
    widths = np.array([components[k].log_width for k in free])
    reach = np.log(sigmas[free] / typical[free])
    posterior, solution = _posterior(residual, slopes, components, fixed, sigmas)
    posterior -= 0.5 * float(((reach / widths) ** 2).sum())
    information = np.diag(1.0 / widths**2)
    for _ in range(MAX_ROUNDS):
        if solution is None:
            break
        score, information = _score(residual, solution, components, sigmas, free)
        score -= reach / widths**2
        information += np.diag(1.0 / widths**2)
        step = np.linalg.solve(information, score)
        step *= min(1.0, LONGEST_STEP / float(np.abs(step).max()))
        for _ in range(6):
            trial = np.clip(reach + step, -MAX_LOG, MAX_LOG)
            tried = sigmas.copy()
            tried[free] = typical[free] * np.exp(trial)
            value, at_trial = _posterior(residual, slopes, components, fixed, tried)
            value -= 0.5 * float(((trial / widths) ** 2).sum())
            if value >= posterior - 1e-9:
                break
            step *= 0.3
        else:
            break
        reach, sigmas, posterior, solution = trial, tried, value, at_trial
        if float(np.abs(step).max()) < SETTLED:
            break
    spread[np.ix_(free, free)] = np.linalg.inv(information)
    return NoiseEstimate(sigmas, spread)


def _posterior(
    residual: FloatArray,
    slopes: FloatArray,
    components: tuple[NoiseComponent, ...],
    fixed: FloatArray,
    sigmas: FloatArray,
) -> tuple[float, LinearSolution | None]:
    solution = solve_linear(residual, slopes, total_covariance(components, sigmas) + fixed)
    return (-np.inf if solution is None else solution.log_likelihood), solution


def _score(
    residual: FloatArray,
    solution: LinearSolution,
    components: tuple[NoiseComponent, ...],
    sigmas: FloatArray,
    free: IntArray,
) -> tuple[FloatArray, FloatArray]:
    """Derivative of the restricted log-likelihood by log sigma, and its expected curvature."""
    explained = solution.projected @ residual
    products = [2.0 * sigmas[k] ** 2 * solution.projected @ components[k].covariance for k in free]
    score = np.array(
        [
            sigmas[k] ** 2 * float(explained @ components[k].covariance @ explained)
            - 0.5 * float(np.trace(product))
            for k, product in zip(free, products, strict=True)
        ]
    )
    information = np.array(
        [[0.5 * float((one * other.T).sum()) for other in products] for one in products]
    )
    return score, information


def covariance_over_noise(
    residual: FloatArray,
    slopes: FloatArray,
    components: tuple[NoiseComponent, ...],
    fixed: FloatArray,
    estimate: NoiseEstimate,
) -> FloatArray:
    """(K, K) covariance of the solution with the estimated scatter not taken as known.

    The mean covariance over the spread of the standard deviations, plus the spread of the
    solutions that they lead to, by two sigma points along each axis of ``log_covariance``. Errors
    of uncertain scatter have longer tails than a normal distribution of the same covariance; it is
    widened until the usual 95 % region of the hand-eye holds 95 % of them.
    """
    values, axes = np.linalg.eigh(estimate.log_covariance)
    used = np.flatnonzero(values > 1e-12)
    centre = solve_linear(residual, slopes, total_covariance(components, estimate.sigmas) + fixed)
    if centre is None or len(used) == 0:
        return np.zeros((slopes.shape[1],) * 2) if centre is None else centre.covariance
    covariances, steps = [], []
    for k in used:
        for sign in (-1.0, 1.0):
            reach = sign * np.sqrt(len(used) * values[k]) * axes[:, k]
            sigmas = estimate.sigmas * np.exp(reach)
            solution = solve_linear(residual, slopes, total_covariance(components, sigmas) + fixed)
            if solution is not None:
                covariances.append(solution.covariance)
                steps.append(solution.step - centre.step)
    if not steps:
        return centre.covariance
    own, moved = np.array(covariances), np.array(steps)
    mixed = own.mean(axis=0) + moved.T @ moved / len(moved)
    return np.asarray(_widening(mixed, own + moved[:, :, None] * moved[:, None, :]) * mixed)


def _widening(mixed: FloatArray, parts: FloatArray) -> float:
    """Factor on a covariance that makes its joint 95 % region hold 95 % of a mixture (M, K, K).

    Within one part the quadratic form is a weighted sum of chi-squares, taken as one chi-square of
    equal mean and variance (Satterthwaite).
    """
    block = slice(0, N_HAND_EYE)
    shapes = np.linalg.solve(mixed[block, block], parts[:, block, block])
    mean = np.einsum("mii->m", shapes)
    square = np.einsum("mij,mji->m", shapes, shapes)
    limit = float(chi2.ppf(REGION, N_HAND_EYE))

    def excess(factor: float) -> float:
        held = chi2.cdf(factor * limit * mean / square, mean**2 / square)
        return float(np.mean(held)) - REGION

    return 1.0 if excess(1.0) >= 0.0 else float(brentq(excess, 1.0, 100.0))
