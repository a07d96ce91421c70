# SPDX-License-Identifier: Apache-2.0
"""Generalised least squares of the hand-eye: damped Gauss-Newton steps on whitened residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_residuals import PlacedNodes, PlateState, place_nodes
from armscan.geometry.arrays import FloatArray
from armscan.geometry.fitting import Plane

MAX_STEPS = 50
SETTLED = 1e-9
"""A step that lowers the objective by less than this part of it ends the search."""
LEVER_MM = 100.0
"""Turns are compared with shifts by what they move at this distance."""


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A minimum of the whitened objective.

    Parameters
    ----------
    state
        Hand-eye and plane.
    placed
        The nodes placed with it.
    chi2
        The objective: sum of squared whitened residuals.
    is_settled
        False if the steps ran out.
    """

    state: PlateState
    placed: PlacedNodes
    chi2: float
    is_settled: bool


def design(placed: PlacedNodes, solve_plate: bool) -> FloatArray:
    """(N, 6) derivative of the residuals by the hand-eye, or (N, 9) with the plane's."""
    if solve_plate:
        return np.concatenate([placed.by_hand_eye, placed.by_plane], axis=1)
    return placed.by_hand_eye


def refine(
    nodes: PlateNodes,
    plate: Plane,
    start: PlateState,
    covariance: FloatArray,
    *,
    solve_plate: bool = False,
) -> Refined:
    """Minimise ``e' C^-1 e`` over the hand-eye, and over the plane where it is free.

    Parameters
    ----------
    nodes, plate
        Data and the probed plane.
    start
        Where to begin.
    covariance
        (N, N) positive definite covariance of the residuals e, eq. 2.74.
    solve_plate
        Solve the plane along.
    """
    root = np.linalg.cholesky(covariance)
    state, damping = start, 0.0
    placed = place_nodes(nodes, plate, state)
    whitened = solve_triangular(root, placed.residual_mm, lower=True)
    chi2 = float(whitened @ whitened)
    for _ in range(MAX_STEPS):
        slope = solve_triangular(root, design(placed, solve_plate), lower=True)
        step = _damped_step(slope, whitened, damping)
        trial = state.stepped(step)
        moved = place_nodes(nodes, plate, trial)
        residual = solve_triangular(root, moved.residual_mm, lower=True)
        trial_chi2 = float(residual @ residual)
        if not trial_chi2 <= chi2:
            if chi2 - trial_chi2 >= -SETTLED * chi2:
                return Refined(state, placed, chi2, True)
            damping = max(10.0 * damping, 1e-6)
            continue
        gain = chi2 - trial_chi2
        state, placed, whitened, chi2 = trial, moved, residual, trial_chi2
        damping *= 0.1
        if gain <= SETTLED * chi2 + 1e-18:
            return Refined(state, placed, chi2, True)
    return Refined(state, placed, chi2, False)


def _damped_step(slope: FloatArray, whitened: FloatArray, damping: float) -> FloatArray:
    scale = np.linalg.norm(slope, axis=0)
    scale[scale == 0.0] = 1.0
    stacked = np.vstack([slope / scale, np.sqrt(damping) * np.eye(slope.shape[1])])
    target = np.concatenate([-whitened, np.zeros(slope.shape[1])])
    step, *_ = np.linalg.lstsq(stacked, target, rcond=1e-12)
    return np.asarray(step / scale)


@dataclass(frozen=True, slots=True, eq=False)
class LinearSolution:
    """Generalised least squares of ``e + A x = 0`` at a fixed linearisation.

    Parameters
    ----------
    step
        (K,) solution x.
    covariance
        (K, K) of x.
    inverse
        (N, N) inverse of the residuals' covariance.
    projected
        (N, N) ``P = C^-1 - C^-1 A cov A' C^-1``: zero along the columns of A.
    gain
        (K, N) ``G`` with ``x = -G e``.
    log_likelihood
        Restricted log-likelihood of the residuals, without constants.
    """

    step: FloatArray
    covariance: FloatArray
    inverse: FloatArray
    projected: FloatArray
    gain: FloatArray
    log_likelihood: float


def solve_linear(
    residual: FloatArray, slopes: FloatArray, covariance: FloatArray
) -> LinearSolution | None:
    """Solve ``residual + slopes x = 0`` (N,), (N, K) under (N, N) covariance.

    Returns None where the covariance or the normal matrix is not positive definite.
    """
    try:
        factor = cho_factor(covariance, lower=True)
        inverse = cho_solve(factor, np.eye(len(covariance)))
        carried = inverse @ slopes
        normal = slopes.T @ carried
        normal_factor = cho_factor(0.5 * (normal + normal.T), lower=True)
    except LinAlgError:
        return None
    spread = cho_solve(normal_factor, np.eye(slopes.shape[1]))
    gain = spread @ carried.T
    projected = inverse - carried @ gain
    determinants = np.log(np.diag(factor[0])).sum() + np.log(np.diag(normal_factor[0])).sum()
    quadratic = float(residual @ projected @ residual)
    return LinearSolution(
        -gain @ residual,
        0.5 * (spread + spread.T),
        inverse,
        0.5 * (projected + projected.T),
        gain,
        -0.5 * quadratic - float(determinants),
    )
