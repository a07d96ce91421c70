# SPDX-License-Identifier: Apache-2.0
"""The posterior of names along a stretch, against the sum over all ways of naming it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Pose, Sensor
from armscan.models.calibration import SensorCalibration
from armscan.models.light_sheet import LightSheet
from armscan.reconstruction.label_cross import CrossLabeller
from armscan.reconstruction.segments import (
    SWITCH,
    SWITCH_AT_KINK,
    LoneLines,
    Pieces,
    smoothed_posterior,
    switch_probability,
)
from rigs.cross_rig import sensor
from rigs.sheet_rig import make_profile


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


SOURCE_MM, FLOOR_MM, PITCH_MM, STEP_MM = np.array([0.0, -80.0, 10.0]), 140.0, 6.0, 0.6
LIKE_THE_NEXT_MM = 9.07
"""Height at which a line shows where the next one would on the floor, to 0.05 mm of depth."""


def five_lines() -> SensorCalibration:
    """Sheets through one source whose lines run along x, 6 mm apart on the floor."""
    crossed, sheets = sensor(), []
    for k in range(5):
        foot = np.array([0.0, PITCH_MM * (k - 2), FLOOR_MM])
        down = (foot - SOURCE_MM) / np.linalg.norm(foot - SOURCE_MM)
        axes = np.stack([[1.0, 0.0, 0.0], down, np.cross([1.0, 0.0, 0.0], down)])
        sheet = LightSheet(origin_mm=foot, axes=axes, scale_mm=20.0, bow_mm=np.zeros(5))
        sheets.append(replace(crossed.sheets[0], name=f"L{k}", sheet=sheet))
    return replace(crossed, sheets=tuple(sheets), covariance=np.zeros((49, 49)))


def lit(head: SensorCalibration, k: int, x_mm: float) -> list[FloatArray]:
    """Points (N, 3) of a line, in the sensor at x, on the floor and on a block that begins at x = 0
    and is as high as to pass for the next line's floor.
    """
    sheet = head.sheets[k].sheet
    rays = np.array([0.0, *sheet.axes[1, 1:]]) + np.linspace(-0.15, 0.15, 450)[:, None] * [1, 0, 0]
    top, floor = (
        SOURCE_MM + (depth - SOURCE_MM[2]) / rays[:, 2:] * rays
        for depth in (FLOOR_MM - LIKE_THE_NEXT_MM, FLOOR_MM)
    )
    on_top, over = (points[:, 0] + x_mm > 0.0 for points in (top, floor))
    return [points for points in (floor[~on_top & ~over], top[on_top]) if len(points)]


def test_a_source_of_several_lines_is_not_waited_for_until_one_is_alone() -> None:
    """None of its lines ever is: it was asked for alone to the end of the pass."""
    head = five_lines()
    names = ("L0", "L1", "fan.1", "fan.2", "fan.3")
    sheets = [replace(sheet, name=name) for sheet, name in zip(head.sheets, names, strict=True)]
    labeller = CrossLabeller(replace(head, sheets=tuple(sheets)))
    asked = []
    for t in range(3):
        on = labeller.next_lasers()
        asked.append(on)
        pixels = head.camera.camera.project(lit(head, ("L0", "L1", "fan").index(on[0]), -30.0)[0])
        profile = make_profile(f"{t}", [(pixels, np.tile([0.0, 1.0], (len(pixels), 1)))], 0.05)
        pose: Pose[Base, Sensor] = Pose(np.eye(3), np.array([STEP_MM * t, 0.0, 0.0]))
        labeller.label([profile], on, pose, 1 + 12_500_000 * t)
    assert asked == [("L0",), ("L1",), ("L0", "L1", "fan")]


def swept(
    labeller: CrossLabeller,
    head: SensorCalibration,
    lasers: Callable[[int], tuple[str, ...]],
    shows: Callable[[int, int], list[FloatArray]],
    n: int,
) -> tuple[int, int, int]:
    """Points with a wrong name, with any, and all, of ``n`` exposures to the block; lines that are
    on show what ``shows`` says of exposure and line.
    """
    rng, names = np.random.default_rng(4), [sheet.name for sheet in head.sheets]
    n_wrong = n_named = n_points = 0
    for t in range(n):
        on = lasers(t)
        lines = [(k, q) for k in range(5) if names[k] in (on or names) for q in shows(t, k)]
        pixels = [head.camera.camera.project(points) for _, points in lines]
        drawn = [
            (q + 0.05 * rng.standard_normal(q.shape), np.tile([0.0, 1.0], (len(q), 1)))
            for q in pixels
        ]
        pose: Pose[Base, Sensor] = Pose(np.eye(3), np.array([STEP_MM * (t - 45), 0.0, 0.0]))
        profile = make_profile(f"{t}", drawn or [(np.zeros((0, 2)),) * 2], 0.05)
        (found,) = labeller.label([profile], on, pose, 1 + 12_500_000 * t).profiles
        truth = np.concatenate(
            [np.zeros(0), *(np.full(len(q), k) for (k, _), q in zip(lines, pixels, strict=True))]
        )
        n_wrong += int(((found.sheet >= 0) & (found.sheet != truth)).sum())
        n_named, n_points = n_named + int((found.sheet >= 0).sum()), n_points + len(truth)
    return n_wrong, n_named, n_points


@pytest.mark.parametrize("is_asked", [True, False])
def test_many_lines_are_not_named_one_further_where_a_block_is_as_high(is_asked: bool) -> None:
    """To the past alone the floor goes on below the block: 5 and 7 % of the names were wrong, with
    each line alone where it is asked for, and each once at first.
    """
    head = five_lines()
    labeller, names = CrossLabeller(head), [sheet.name for sheet in head.sheets]
    n_wrong, n_named, n_points = swept(
        labeller,
        head,
        lambda t: labeller.next_lasers() if is_asked else tuple(names[t : t + 1]),
        lambda t, k: lit(head, k, STEP_MM * (t - 45)),
        36,
    )
    assert n_wrong == 0
    assert n_named > 0.8 * n_points


@pytest.mark.parametrize(("unseen", "in_air", "named"), [(4, 0, 0.45), (2, 0, 0.35), (-1, 7, 0.9)])
def test_a_line_that_misses_the_part_may_be_any(unseen: int, in_air: int, named: float) -> None:
    """It may come into view at any time, where another goes: what single lasers do not show is
    left out. In the air no line shows anything, and that tells of none.
    """
    head = five_lines()
    labeller = CrossLabeller(head)
    asked = []

    def lasers(t: int) -> tuple[str, ...]:
        asked.append(labeller.next_lasers())
        return asked[-1]

    n_wrong, n_named, n_points = swept(
        labeller,
        head,
        lasers,
        lambda t, k: [] if k == unseen or t < in_air else lit(head, k, -60.0),
        40,
    )
    assert n_wrong == 0
    assert n_named > named * n_points
    assert sum(len(on) == 1 for on in asked[in_air:]) < (30 if unseen >= 0 else 10)


def test_a_line_that_was_seen_once_is_never_held_to_be_absent() -> None:
    """A laser that is asked for while its line lies in a gap comes back, and took other names."""
    lone = LoneLines(("a", "b"))
    for k in (0, 1):
        lone.learn((k,), np.full(50, k))
    lone.learn((0,), np.full(50, -1))
    assert (lone.shown, lone.absent) == ({0, 1}, set())


def test_exposures_seconds_apart_light_every_laser_in_its_turn() -> None:
    """Each is a pass by itself: the first two lasers took turns, and no other was ever lit."""
    lone = LoneLines(("a", "b", "c", "fan", "fan"))
    lit_alone = []
    for _ in range(8):
        lone.reset()
        due = lone.due[:1] or ("all",)
        lit_alone.append(due[0])
        k = "abc".find(due[0][0]) if due != ("all",) else -1
        lone.learn((k,) if k >= 0 else (0, 1, 2, 3, 4), np.full(50, max(k, 0)))
    assert lit_alone[:4] == ["a", "b", "c", "a"]
    assert set(lit_alone) == {"a", "b", "c"}
