# SPDX-License-Identifier: Apache-2.0
"""Where stripes are cut, which points stand for them, and the most likely sheets along them."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.kernels.chains import best_states
from armscan.reconstruction.segments import LIGHT_POINTS, cut_segments, take_samples
from armscan.records.profile import Profile
from rigs.sheet_rig import make_profile


def line(points: FloatArray) -> Profile:
    tangent = np.gradient(points, axis=0)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    return make_profile("line", [(points, normal / np.linalg.norm(normal, axis=1)[:, None])], 0.07)


def course(bend: FloatArray) -> FloatArray:
    x = np.arange(len(bend), dtype=np.float64)
    noise = np.random.default_rng(1).normal(0.0, 0.07, len(bend))
    return np.stack([x, bend + noise], axis=1)


def test_a_straight_and_a_round_line_stay_whole() -> None:
    x = np.arange(200.0)
    for bend in (0.3 * x, 120.0 - np.sqrt(130.0**2 - (x - 100.0) ** 2)):
        assert cut_segments(line(course(bend))).number.max() == 0


@pytest.mark.parametrize("jump", [1.2, -2.0])
def test_a_step_cuts_where_it_is(jump: float) -> None:
    pieces = cut_segments(line(course(np.where(np.arange(200.0) < 90, 0.0, jump))))
    assert pieces.number.max() == 1
    assert abs(int((pieces.number == 0).sum()) - 90) <= 2


def test_a_kink_cuts_where_it_is() -> None:
    x = np.arange(200.0)
    pieces = cut_segments(line(course(np.where(x < 90, 0.0, 0.6 * (x - 90)))))
    assert pieces.number.max() == 1
    assert abs(int((pieces.number == 0).sum()) - 90) <= 2


def test_a_gap_cuts() -> None:
    whole = line(course(np.zeros(100)))
    pieces = cut_segments(whole.select(np.abs(np.arange(100) - 50) > 5))
    assert pieces.number.max() == 1


def test_sparse_points_are_a_line_too_and_a_gap_is_one_by_their_spacing() -> None:
    sparse = line(9.0 * course(np.zeros(100)) * [1.0, 0.0])
    assert cut_segments(sparse).number.max() == 0
    assert cut_segments(sparse.select(np.abs(np.arange(100) - 50) > 5)).number.max() == 1


def test_noise_is_no_step() -> None:
    noise = np.random.default_rng(2).normal(0.0, 0.35, 2000)
    points = np.stack([np.arange(2000.0), noise], axis=1)
    normals = np.tile([0.0, 1.0], (2000, 1))
    noisy = make_profile("noisy", [(points, normals)], 0.35)
    assert cut_segments(noisy).number.max() <= 1


def speckled(light: FloatArray, rng: np.random.Generator) -> Profile:
    """A straight line of this brightness, with speckle of 20 % that three neighbours share."""
    white = rng.normal(0.0, 0.2 * np.sqrt(3.0), len(light) + 2)
    speckle = np.convolve(white, np.full(3, 1.0 / 3.0), mode="valid")
    return replace(line(course(np.zeros(len(light)))), intensity=light * np.exp(speckle))


def test_a_line_that_goes_on_as_a_brighter_one_is_two() -> None:
    """Of 100 draws: two lines that meet in place and direction, one 1.7 times as bright."""
    rng, found, others = np.random.default_rng(6), 0, 0
    for _ in range(100):
        profile = speckled(np.where(np.arange(1500) < 710, 60.0, 102.0), rng)
        assert cut_segments(profile).number.max() == 0
        number = cut_segments(profile, at_light=True).number
        # a third of the points that are compared: speckle moves the largest change
        is_there = np.abs(np.flatnonzero(np.diff(number)) + 1 - 710) <= LIGHT_POINTS // 3
        found, others = found + int(is_there.any()), others + int((~is_there).sum())
    assert found >= 90
    # beyond 3.5 sigmas by chance at one of some 150 independent places: one in 14 lines
    assert others <= 20


def test_speckle_and_a_slow_change_of_brightness_are_no_other_line() -> None:
    rng = np.random.default_rng(7)
    counts = [
        cut_segments(speckled(60.0 * np.exp(np.linspace(0.0, slope, 400)), rng), at_light=True)
        for slope in np.repeat([0.0, 1.0], 100)
    ]
    assert np.mean([pieces.number.max() for pieces in counts]) < 0.1


def test_samples_stand_for_every_point_of_their_own_piece() -> None:
    whole = line(course(np.zeros(100)))
    pieces = cut_segments(whole.select(np.abs(np.arange(100) - 92) > 3))
    samples = take_samples(pieces, 6)
    assert (pieces.number[samples.at[samples.nearest]] == pieces.number).all()
    assert samples.weight.sum() == pytest.approx(len(pieces.row) / 6)
    assert (pieces.number[samples.at] == 1).sum() >= 4


def test_best_states_equal_those_of_a_search_over_all_sequences() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        scores = rng.normal(0.0, 2.0, (6, 3))
        cost = np.array([0.0, *rng.choice([0.0, 1.0, 5.0], 5)])
        found = np.zeros(6, dtype=np.int64)
        best_states(scores, cost, found)

        def value(states: tuple[int, ...], scores=scores, cost=cost) -> float:
            changes = np.flatnonzero(np.diff(states)) + 1
            return float(scores[np.arange(6), states].sum() - cost[changes].sum())

        best = max(value(states) for states in product(range(3), repeat=6))
        assert value(tuple(found.tolist())) == pytest.approx(best)
