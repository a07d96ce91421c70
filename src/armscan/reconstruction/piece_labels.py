# SPDX-License-Identifier: Apache-2.0
"""Names along a stripe: neighbours on one stretch nearly always share theirs."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray

SWITCH = 1e-3
"""Probability that the sheet changes between two pieces of a stretch unnoticed."""


def smoothed_posterior(log_likelihood: FloatArray, stretch: IntArray) -> FloatArray:
    """Posterior log-probability of each hypothesis for each piece, by forward and backward passes.

    Parameters
    ----------
    log_likelihood
        (P, H) of each piece under each hypothesis.
    stretch
        (P,) stretch of each piece, not decreasing; stretches are independent.

    Returns
    -------
    FloatArray
        (P, H) logarithms of the posterior probabilities.
    """
    n, h = log_likelihood.shape
    if h == 1 or not n:
        return np.zeros((n, h))
    step = np.full((h, h), np.log(SWITCH / (h - 1)))
    np.fill_diagonal(step, np.log1p(-SWITCH))
    ahead, behind = log_likelihood.copy(), np.zeros((n, h))
    for p in range(1, n):
        if stretch[p] == stretch[p - 1]:
            ahead[p] += _summed(ahead[p - 1][:, None] + step)
    for p in range(n - 2, -1, -1):
        if stretch[p] == stretch[p + 1]:
            behind[p] = _summed((behind[p + 1] + log_likelihood[p + 1])[:, None] + step)
    total = ahead + behind
    return np.asarray(total - np.logaddexp.reduce(total, axis=1, keepdims=True))


def _summed(terms: FloatArray) -> FloatArray:
    return np.asarray(np.logaddexp.reduce(terms, axis=0))
