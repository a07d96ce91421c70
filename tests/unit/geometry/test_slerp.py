# SPDX-License-Identifier: Apache-2.0
"""Turning evenly from one rotation to another: what must hold for any pair."""

from __future__ import annotations

import numpy as np

from armscan.geometry.rotations import rotation_from_vector, slerp, vector_from_rotation

N = 50
RNG = np.random.default_rng(0)
START, END, OTHER = (
    np.array([rotation_from_vector(v) for v in RNG.normal(0.0, 1.0, (N, 3))]) for _ in range(3)
)
PART = RNG.uniform(0.0, 1.0, N)


def test_ends_are_met() -> None:
    np.testing.assert_allclose(slerp(START, END, np.zeros(N)), START, atol=1e-14)
    np.testing.assert_allclose(slerp(START, END, np.ones(N)), END, atol=1e-13)


def test_the_angle_grows_evenly_and_takes_the_short_way() -> None:
    way = slerp(START, END, PART)
    for k in range(N):
        whole = vector_from_rotation(START[k].T @ END[k])
        np.testing.assert_allclose(
            vector_from_rotation(START[k].T @ way[k]), PART[k] * whole, atol=1e-12
        )


def test_it_does_not_depend_on_direction_or_frame() -> None:
    way = slerp(START, END, PART)
    np.testing.assert_allclose(slerp(END, START, 1.0 - PART), way, atol=1e-13)
    np.testing.assert_allclose(slerp(OTHER @ START, OTHER @ END, PART), OTHER @ way, atol=1e-13)
    np.testing.assert_allclose(slerp(START @ OTHER, END @ OTHER, PART), way @ OTHER, atol=1e-13)


def test_nothing_to_turn() -> None:
    assert slerp(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros(0)).shape == (0, 3, 3)
