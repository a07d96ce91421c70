# SPDX-License-Identifier: Apache-2.0
"""The posterior of names along a stretch, against the sum over all ways of naming it."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.reconstruction.label_cross import SWITCH, smoothed_posterior


def by_enumeration(log_likelihood: FloatArray) -> FloatArray:
    """(P, H) probabilities, every sequence of names weighed by hand."""
    n, h = log_likelihood.shape
    total = np.zeros((n, h))
    for names in product(range(h), repeat=n):
        weight = np.exp(sum(log_likelihood[p, name] for p, name in enumerate(names)))
        for before, after in pairwise(names):
            weight *= 1.0 - SWITCH if before == after else SWITCH / (h - 1)
        for p, name in enumerate(names):
            total[p, name] += weight
    return np.asarray(total / total.sum(axis=1, keepdims=True))


@pytest.mark.parametrize("h", [2, 3])
def test_it_is_the_sum_over_all_sequences(h: int) -> None:
    likelihood = 4.0 * np.random.default_rng(h).standard_normal((5, h))
    found = smoothed_posterior(likelihood, np.zeros(5, np.int64))
    assert np.exp(found) == pytest.approx(by_enumeration(likelihood), rel=1e-9)


def test_stretches_do_not_tell_each_other() -> None:
    likelihood = np.array([[9.0, 0.0], [9.0, 0.0], [0.0, 0.0]])
    alone = smoothed_posterior(likelihood, np.array([0, 0, 1]))
    assert np.exp(alone[2]) == pytest.approx([0.5, 0.5])
    joined = smoothed_posterior(likelihood, np.array([0, 0, 0]))
    assert joined[2, 0] - joined[2, 1] > 6.0


def test_one_hypothesis_is_certain() -> None:
    assert smoothed_posterior(np.array([[-3.0], [-8.0]]), np.zeros(2, np.int64)).max() == 0.0
