# SPDX-License-Identifier: Apache-2.0
"""What changes when one posture takes no part, without solving again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from armscan.calibration.hand_eye.least_squares import LinearSolution
from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.geometry.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """One posture predicted by the others.

    Parameters
    ----------
    change
        (K,) change of the solution when the posture is left out.
    normalised
        Root mean square of its predicted residuals over their standard deviation.
    probability
        Of a shift and slope of its stripe as large as these, if its pose errs as the others do.
    shift_mm
        Mean distance of its points from where the others predict them.
    """

    change: FloatArray
    normalised: float
    probability: float
    shift_mm: float


def leave_out(
    residual_mm: FloatArray, solution: LinearSolution, own: IntArray, along_mm: FloatArray
) -> LeftOut:
    """Leave the nodes ``own`` (M,) out of a generalised least-squares solution.

    Leaving observations out is giving each of them an unknown of its own: with P of
    `LinearSolution` the prediction error of the block is ``P_kk^-1 (P e)_k`` and has covariance
    ``P_kk^-1``. What the others tell of the plate's flatness there is taken into account.

    Parameters
    ----------
    residual_mm
        (N,) residuals at the minimum.
    solution
        Linearised there.
    own
        Nodes of the posture.
    along_mm
        (M,) place of these nodes along the stripe.
    """
    block = solution.projected[np.ix_(own, own)]
    explained = (solution.projected @ residual_mm)[own]
    values, vectors = np.linalg.eigh(block)
    used = values > 1e-10 * values[-1]
    inverse = (vectors[:, used] / values[used]) @ vectors[:, used].T
    predicted = inverse @ explained
    shape = np.column_stack([np.ones(len(own)), along_mm - along_mm.mean()])
    score = shape.T @ explained
    weight = shape.T @ block @ shape
    statistic = float(score @ np.linalg.pinv(weight, rcond=1e-10) @ score)
    return LeftOut(
        solution.gain[:, own] @ predicted,
        float(np.sqrt(max(float(explained @ predicted), 0.0) / max(int(used.sum()), 1))),
        float(chi2_distribution.sf(statistic, 2)),
        float(predicted.mean()),
    )


def leave_each_out(
    nodes: PlateNodes, residual_mm: FloatArray, solution: LinearSolution
) -> dict[int, LeftOut]:
    """Leave out every posture in turn; keys are posture numbers."""
    result = {}
    for posture in nodes.used_postures:
        own = np.flatnonzero(nodes.posture == posture)
        points = nodes.points_mm[own] - nodes.points_mm[own].mean(axis=0)
        _, _, axes = np.linalg.svd(points, full_matrices=False)
        result[int(posture)] = leave_out(residual_mm, solution, own, points @ axes[0])
    return result
