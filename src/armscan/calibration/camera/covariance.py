# SPDX-License-Identifier: Apache-2.0
"""Covariance of the camera and of all poses from the block normal equations."""

from __future__ import annotations

import numpy as np

from armscan.calibration.camera.adjustment import NormalEquations
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure

SINGULAR_CONDITION = 1e13


def reduced_normal_matrix(equations: NormalEquations) -> FloatArray:
    """(F, F) normal matrix of the shared unknowns after the poses are eliminated."""
    carried = equations.cross @ np.linalg.inv(equations.pose)
    return np.asarray(
        equations.shared - np.sum(carried @ equations.cross.transpose(0, 2, 1), axis=0)
    )


def condition_number(matrix: FloatArray) -> float:
    """Condition of a symmetric matrix scaled to unit diagonal; infinite if not positive."""
    diagonal = np.diag(matrix)
    if not np.isfinite(matrix).all() or not diagonal.min() > 0.0:
        return float("inf")
    scale = 1.0 / np.sqrt(diagonal)
    values = np.linalg.eigvalsh(matrix * np.outer(scale, scale))
    return float(values[-1] / values[0]) if values[0] > 0.0 else float("inf")


def joint_covariance(
    equations: NormalEquations, basis: FloatArray
) -> tuple[FloatArray, float] | FitFailure:
    """Invert the normal equations.

    Parameters
    ----------
    equations
        At the minimum.
    basis
        (S, F) from `free_basis`.

    Returns
    -------
    covariance
        (S + 6 V, S + 6 V) of the shared unknowns and the poses, for points whose covariance is
        what the detector says; scale it by sigma0 squared.
    condition
        Of the reduced normal matrix, see `condition_number`.

    or why the unknowns are not determined.
    """
    reduced = reduced_normal_matrix(equations)
    condition = condition_number(reduced)
    if not condition < SINGULAR_CONDITION:
        return FitFailure(
            f"the views do not determine all camera parameters (condition {condition:.1e})",
            "add views in which the board is tilted differently and reaches the image's corners, "
            "or free fewer distortion coefficients",
        )
    scale = 1.0 / np.sqrt(np.diag(reduced))
    free = np.linalg.inv(reduced * np.outer(scale, scale)) * np.outer(scale, scale)
    s, n = len(basis), len(equations.pose)
    inverse = np.linalg.inv(equations.pose)
    # The poses follow the shared unknowns by -V^-1 W' (implicit function).
    followed = -inverse @ equations.cross.transpose(0, 2, 1)
    lever = np.concatenate([basis, followed.reshape(6 * n, -1)])
    covariance = lever @ free @ lever.T
    for v in range(n):
        rows = slice(s + 6 * v, s + 6 * v + 6)
        covariance[rows, rows] += inverse[v]
    return 0.5 * (covariance + covariance.T), condition
