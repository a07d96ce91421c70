# SPDX-License-Identifier: Apache-2.0
"""The posterior of names along a stretch, against the sum over all ways of naming it."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.reconstruction.label_cross import (
    SWITCH,
    SWITCH_AT_KINK,
    smoothed_posterior,
    switch_probability,
)
from armscan.reconstruction.segments import Pieces


def by_enumeration(log_likelihood: FloatArray, switch: FloatArray) -> FloatArray:
    """(P, H) probabilities, every sequence of names weighed by hand."""
    n, h = log_likelihood.shape
    total = np.zeros((n, h))
    for names in product(range(h), repeat=n):
        weight = np.exp(sum(log_likelihood[p, name] for p, name in enumerate(names)))
        for (before, after), change in zip(pairwise(names), switch[1:], strict=True):
            weight *= 1.0 - change if before == after else change / (h - 1)
        for p, name in enumerate(names):
            total[p, name] += weight
    return np.asarray(total / total.sum(axis=1, keepdims=True))


@pytest.mark.parametrize("h", [2, 3])
def test_it_is_the_sum_over_all_sequences(h: int) -> None:
    likelihood = 4.0 * np.random.default_rng(h).standard_normal((5, h))
    switch = np.array([0.5, 0.001, 0.02, 0.4, 1.0 - 1.0 / h])
    found = smoothed_posterior(likelihood, switch)
    assert np.exp(found) == pytest.approx(by_enumeration(likelihood, switch), rel=1e-9)


def three_pieces(segment: list[int], is_joined: list[bool]) -> Pieces:
    index = np.arange(3)
    return Pieces(index, np.array(segment), index, index, np.zeros((3, 2)), np.array(is_joined))


def test_a_kink_tells_less_than_a_smooth_course_and_another_chain_nothing() -> None:
    likelihood = np.array([[9.0, 0.0], [9.0, 0.0], [0.0, 0.0]])
    found = {}
    for name, pieces in (
        ("smooth", three_pieces([0, 0, 0], [False, True, True])),
        ("kink", three_pieces([0, 0, 1], [False, True, True])),
        ("apart", three_pieces([0, 0, 1], [False, True, False])),
    ):
        last = smoothed_posterior(likelihood, switch_probability(pieces, 2))[2]
        found[name] = last[0] - last[1]
    # both pieces before are certain: the odds are those of staying
    assert found["smooth"] == pytest.approx(np.log(1.0 / SWITCH - 1.0), abs=0.01)
    assert found["kink"] == pytest.approx(np.log(1.0 / SWITCH_AT_KINK - 1.0), abs=0.01)
    assert found["apart"] == pytest.approx(0.0, abs=1e-12)


def test_one_hypothesis_is_certain() -> None:
    assert smoothed_posterior(np.array([[-3.0], [-8.0]]), np.full(2, SWITCH)).max() == 0.0
