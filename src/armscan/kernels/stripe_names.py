# SPDX-License-Identifier: Apache-2.0
"""The most likely sheets along a stripe (Viterbi's algorithm)."""

from __future__ import annotations

import numpy as np
from numba import njit, types

from armscan.kernels.arrays import FLOATS_IN, INTS_OUT, TABLE_IN, Float64Array, Int64Array


@njit(types.void(TABLE_IN, FLOATS_IN, INTS_OUT), cache=True, nogil=True)
def best_states(scores: Float64Array, change_cost: Float64Array, state: Int64Array) -> None:
    """Sequence of states with the greatest sum of scores less the costs of its changes.

    Parameters
    ----------
    scores
        (N, S) log-likelihood of each state at each place.
    change_cost
        (N,) cost of another state at a place than at the one before; 0 at the first of a stripe.
    state
        (N,) output.
    """
    n, s = scores.shape
    if n == 0:
        return
    total = np.zeros((n, s))
    before = np.zeros((n, s), np.int64)
    for k in range(s):
        total[0, k] = scores[0, k]
    for i in range(1, n):
        top = 0
        for k in range(1, s):
            if total[i - 1, k] > total[i - 1, top]:
                top = k
        for k in range(s):
            changed = total[i - 1, top] - change_cost[i]
            if total[i - 1, k] >= changed:
                total[i, k] = total[i - 1, k] + scores[i, k]
                before[i, k] = k
            else:
                total[i, k] = changed + scores[i, k]
                before[i, k] = top
    last = 0
    for k in range(1, s):
        if total[n - 1, k] > total[n - 1, last]:
            last = k
    for i in range(n - 1, -1, -1):
        state[i] = last
        last = before[i, last]
