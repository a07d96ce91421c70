# SPDX-License-Identifier: Apache-2.0
"""Bow of the board, solved along with the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from armscan.calibration.camera.adjustment import adjust
from armscan.calibration.camera.observations import SHARED_NAMES, WARP_NAMES
from armscan.calibration.camera.result import BoardWarp
from armscan.calibration.camera.robust import Solution
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure

_FIRST = SHARED_NAMES.index(WARP_NAMES[0])
WARP_ROWS = slice(_FIRST, _FIRST + len(WARP_NAMES))


def with_warp(flat: Solution, max_steps: int) -> Solution | FitFailure:
    """Free the two bow parameters, starting from the flat solution and over the same points."""
    columns = np.zeros((len(SHARED_NAMES), len(WARP_NAMES)))
    columns[WARP_ROWS] = np.eye(len(WARP_NAMES))
    basis = np.concatenate([flat.basis, columns], axis=1)
    result = adjust(flat.observations, flat.state, basis, flat.weights, max_steps)
    if isinstance(result, FitFailure):
        return result
    return replace(
        flat,
        state=result.state,
        basis=basis,
        equations=result.equations,
        is_converged=result.is_converged,
    )


def judge_warp(flat: Solution, bowed: Solution, covariance: FloatArray) -> BoardWarp:
    """Test the bow by the decrease of chi2 (F test with two parameters).

    Parameters
    ----------
    flat, bowed
        The solutions without and with bow.
    covariance
        (11 + 6 V, 11 + 6 V) scaled joint covariance of the bowed solution.
    """
    n_parameters = len(WARP_NAMES)
    decrease = max(flat.equations.chi2 - bowed.equations.chi2, 0.0)
    statistic = decrease / n_parameters / bowed.variance_factor
    p_value = float(stats.f.sf(statistic, n_parameters, max(bowed.degrees_of_freedom, 1)))
    bow = bowed.state.shared[WARP_ROWS]
    return BoardWarp(bow, covariance[WARP_ROWS, WARP_ROWS], float(statistic), p_value)
