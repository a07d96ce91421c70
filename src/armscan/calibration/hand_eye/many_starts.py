# SPDX-License-Identifier: Apache-2.0
"""Descents from all over the rotations at once: no start near the solution has to be guessed.

For a given rotation of the sensor, what else is unknown (the shift, a sphere's centre) follows from
linear equations. Rotations that cover all orientations evenly, each completed so and refined by a
few damped Gauss-Newton steps, end in all minima of any size.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.geometry.arrays import FloatArray, IntArray

_SQRT_2 = float(np.sqrt(2.0))
_PSI = 1.533751168755204288118041
"""Positive root of psi^4 = psi + 4."""
N_TURN = 3

Placing = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""From K rotations (K, 3, 3) and K further unknowns (K, M) to residuals (K, N) and their
derivatives (K, N, 3 + M) by a turn on the left and by these unknowns."""


def rotations_all_over(count: int) -> FloatArray:
    """(count, 3, 3) rotations that cover all orientations evenly.

    Super-Fibonacci spirals: Alexa, "Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of
    SO(3)", CVPR 2022.
    """
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    alpha, beta = 2.0 * np.pi * s / _SQRT_2, 2.0 * np.pi * s / _PSI
    quaternions = np.column_stack(
        [inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)]
    )
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


def descend_all(
    place: Placing,
    rotations: FloatArray,
    others: FloatArray,
    n_steps: int,
    scale: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Damped Gauss-Newton from many starts at once.

    Parameters
    ----------
    place
        Residuals and slopes of many states.
    rotations, others
        (K, 3, 3) and (K, M) to start from.
    n_steps
        Steps of each.
    scale
        (3 + M,) what each unknown is multiplied with so that all move the residuals alike.

    Returns
    -------
    rotations, others, cost
        (K, 3, 3), (K, M), and the sums of squared residuals (K,).
    """
    residual, slopes = place(rotations, others)
    cost = (residual**2).sum(axis=1)
    damping = np.full(len(rotations), 1e-3)
    diagonal = np.eye(len(scale))
    for _ in range(n_steps):
        scaled = slopes * scale
        matrix = scaled.transpose(0, 2, 1) @ scaled
        mean = np.einsum("kii->k", matrix) / len(scale)
        matrix += (damping * mean + 1e-12)[:, None, None] * diagonal
        gradient = np.einsum("kni,kn->ki", scaled, residual)
        step = -np.linalg.solve(matrix, gradient[:, :, None])[:, :, 0] * scale
        tried = Rotation.from_rotvec(step[:, :N_TURN]).as_matrix() @ rotations
        moved = others + step[:, N_TURN:]
        tried_residual, tried_slopes = place(tried, moved)
        tried_cost = (tried_residual**2).sum(axis=1)
        better = tried_cost < cost
        rotations = np.where(better[:, None, None], tried, rotations)
        others = np.where(better[:, None], moved, others)
        residual = np.where(better[:, None], tried_residual, residual)
        slopes = np.where(better[:, None, None], tried_slopes, slopes)
        cost = np.where(better, tried_cost, cost)
        damping = np.clip(np.where(better, 0.1 * damping, 10.0 * damping), 1e-12, 1e6)
    u, _, vt = np.linalg.svd(rotations)
    return np.asarray(u @ vt), others, cost


def distinct(rotations: FloatArray, cost: FloatArray, apart_rad: float, count: int) -> IntArray:
    """Numbers of the ``count`` least costly of (K, 3, 3) rotations that differ from each other."""
    kept: list[int] = []
    for k in np.argsort(cost):
        traces = np.einsum("nij,ij->n", rotations[kept], rotations[k])
        if (traces < 1.0 + 2.0 * np.cos(apart_rad)).all():
            kept.append(int(k))
        if len(kept) == count:
            break
    return np.array(kept, dtype=np.int64)
