# SPDX-License-Identifier: Apache-2.0
"""Markers matched in space: the thesis's eight steps beside the checked matching.

    python benchmarks/marker_matching.py [--runs 1000] [--seed 0] [--times]

Random markers on solid parts of 100 to 300 mm and on flat ones, 8 mm apart or more, seen twice with
0.02 mm noise an axis; of the part's markers either view misses 30 %, and has 20 % that are none of
the part's. A scene is wrong if one pair of it is. The eight steps get the same limit for distances,
four standard deviations (0.16 mm). Cases that cannot be unique follow: grids, lines, symmetry.
With ``--times``: milliseconds of one processor for one matching, the median of five scenes.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.markers.alignments import Matched
from armscan.markers.match_3d import match_markers
from armscan.thesis.two_cameras import match_after_thesis
from rigs.marker_scenes import NOISE_MM, TwoViews, marker_set, random_pose, two_views

LIMIT_MM = 8.0 * NOISE_MM
COMMON = ((8, 1), (12, 4), (6, 4), (5, 4), (4, 4), (3, 4))
"""Count of common markers, and which part of the runs is spent on it."""
SIZES = (20, 50, 100, 300)


def part(generator: np.random.Generator, *, is_flat: bool) -> FloatArray:
    length = generator.uniform(100.0, 300.0)
    across = length * generator.uniform(0.4, 1.0)
    return np.array([length, across, 0.0 if is_flat else length * generator.uniform(0.3, 1.0)])


def verdict(scene: TwoViews) -> str:
    found = match_markers(scene.a, scene.b)
    if not isinstance(found, Matched):
        return type(found).__name__
    return "wrong" if scene.n_wrong(found.alignment.pairs) else "right"


def thesis_verdict(scene: TwoViews) -> str:
    pairs = match_after_thesis(scene.a, scene.b, LIMIT_MM)
    if len(pairs) < 3:
        return "none"
    return "wrong" if scene.n_wrong(pairs) else "right"


def random_scenes(runs: int, seed: int) -> None:
    print("random scenes                 | checked matching                   | eight steps")
    print("common  part   runs   seen    | right  wrong  not unique  no match | right  wrong  none")
    for n_common, divisor in COMMON:
        for is_flat in (False, True):
            ours, thesis = Counter[str](), Counter[str]()
            n_seen = 0
            for run in range(max(runs // divisor, 1)):
                generator = np.random.default_rng([seed, n_common, is_flat, run])
                scene = two_views(generator, n_common, part(generator, is_flat=is_flat))
                n_seen = len(scene.a)
                ours[verdict(scene)] += 1
                thesis[thesis_verdict(scene)] += 1
            kind = "flat " if is_flat else "solid"
            print(
                f"{n_common:6d}  {kind} {max(runs // divisor, 1):5d}   {n_seen:2d}/{n_seen:2d}   |"
                f" {ours['right']:5d}  {ours['wrong']:5d}  {ours['NotUnique']:10d}  "
                f"{ours['NoMatch']:8d} | {thesis['right']:5d}  {thesis['wrong']:5d}  "
                f"{thesis['none']:4d}",
                flush=True,
            )


def grid(columns: int, rows: int) -> FloatArray:
    return np.array([(20.0 * i, 20.0 * k, 0.0) for i in range(columns) for k in range(rows)])


def line(generator: np.random.Generator) -> FloatArray:
    return np.outer(np.cumsum(generator.uniform(9.0, 30.0, 10)), [1.0, 0.0, 0.0])


def mirrored(generator: np.random.Generator) -> FloatArray:
    """Four random markers and their mirror images: a part with a left and a right half."""
    half = np.array([20.0, 0.0, 0.0]) + generator.uniform(0.0, 1.0, (4, 3)) * [80.0, 90.0, 0.0]
    return np.vstack([half, half * [-1.0, 1.0, 1.0]])


def ring(count: int) -> FloatArray:
    angle = 2.0 * np.pi * np.arange(count) / count
    return 60.0 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)


def ambiguous(runs: int, seed: int) -> None:
    cases: dict[str, Callable[[np.random.Generator], FloatArray]] = {
        "grid 5 x 5": lambda _: grid(5, 5),
        "grid 4 x 3": lambda _: grid(4, 3),
        "10 on a line": line,
        "flat, left = right": mirrored,
        "8 on a circle": lambda _: ring(8),
    }
    print(
        "\nnot unique by design, 30 % lost    | not unique  no match  right  wrong | 8 steps answer"
    )
    for name, points_of in cases.items():
        found, answers = Counter[str](), 0
        for run in range(runs):
            generator = np.random.default_rng([seed, run])
            points = points_of(generator)
            sets, seen_by = [], []
            for _ in range(2):
                kept = generator.permutation(len(points))[: -(-7 * len(points) // 10)]
                seen_by.append(np.sort(kept))
                pose = random_pose(generator)
                seen = points[seen_by[-1]] @ pose.rotation.T + pose.translation_mm
                sets.append(marker_set(seen + generator.normal(0.0, NOISE_MM, seen.shape)))
            result = match_markers(*sets)
            said = type(result).__name__
            if isinstance(result, Matched):
                pairs = result.alignment.pairs
                is_right = bool((seen_by[0][pairs[:, 0]] == seen_by[1][pairs[:, 1]]).all())
                said = "right" if is_right else "wrong"
            found[said] += 1
            answers += len(match_after_thesis(*sets, LIMIT_MM)) >= 3
        print(
            f"{name:34s} | {found['NotUnique']:10d}  {found['NoMatch']:8d}  {found['right']:5d}  "
            f"{found['wrong']:5d} |"
            f" {answers:6d}",
            flush=True,
        )


def times(seed: int) -> None:
    print("\nmarkers seen   checked ms   eight steps ms")
    for n in SIZES:
        ours, thesis = [], []
        for run in range(5):
            generator = np.random.default_rng([seed, n, run])
            size = np.array([400.0, 300.0, 120.0])
            scene = two_views(generator, round(0.7 * n / 1.2), size, gap_mm=7.0)
            ours.append(seconds(lambda s=scene: match_markers(s.a, s.b)))  # type: ignore[misc]
            thesis.append(
                seconds(lambda s=scene: match_after_thesis(s.a, s.b, LIMIT_MM))  # type: ignore[misc]
            )
        print(
            f"{n:12d}   {1e3 * np.median(ours):10.0f}   {1e3 * np.median(thesis):14.1f}", flush=True
        )


def seconds(work: Callable[[], IntArray | object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--times", action="store_true")
    given = parser.parse_args()
    if given.times:
        times(given.seed)
        return
    random_scenes(given.runs, given.seed)
    ambiguous(max(given.runs // 10, 1), given.seed)


if __name__ == "__main__":
    main()
