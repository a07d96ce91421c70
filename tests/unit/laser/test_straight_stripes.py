# SPDX-License-Identifier: Apache-2.0
"""Stripe points on a board, sorted into straight stripes."""

import numpy as np

from armscan.calibration.sheets.stripes_on_board import MIN_SPAN, find_straight_stripes
from armscan.geometry.arrays import FloatArray

SIGMA_MM = 0.02
BOARD_MM = (60.0, 40.0)


def line(start: tuple[float, float], end: tuple[float, float], n: int, seed: int) -> FloatArray:
    t = np.linspace(0.0, 1.0, n)[:, None]
    noise = np.random.default_rng(seed).normal(0.0, SIGMA_MM, (n, 2))
    return np.asarray(np.array(start) * (1 - t) + np.array(end) * t + noise)


def find(points: FloatArray, segment: FloatArray, n_lines: int = 0) -> list[set[int]]:
    stripes = find_straight_stripes(
        points,
        np.full(len(points), SIGMA_MM),
        segment.astype(np.int64),
        shortest_mm=MIN_SPAN * min(BOARD_MM),
        n_lines=n_lines,
    )
    return [set(rows.tolist()) for rows in stripes]


def test_two_broken_crossing_lines_and_scattered_points() -> None:
    """Each line is cut into segments, as on a chessboard; 15 reflections lie about."""
    a, b = line((5, 0), (25, 40), 150, 1), line((40, 0), (15, 40), 120, 2)
    stray = np.random.default_rng(3).uniform([0, 0], BOARD_MM, (15, 2))
    points = np.concatenate([a, b, stray])
    segment = np.arange(len(points)) // 12
    found = find(points, segment)
    assert len(found) == 2
    assert len(found[0] & set(range(150))) >= 147
    assert len(found[1] & set(range(150, 270))) >= 117
    assert len((found[0] | found[1]) & set(range(270, 285))) <= 1


def test_outliers_beside_a_line_are_left_out_and_make_no_second_line() -> None:
    points = line((5, 5), (55, 30), 200, 4)
    lifted = slice(40, 70)
    points[lifted, 1] += 0.5
    found = find(points, np.zeros(len(points)))
    assert len(found) == 1
    assert not found[0] & set(range(40, 70))
    assert len(found[0]) >= 165


def test_a_gentle_curve_is_kept_whole() -> None:
    """0.3 mm of bow over 50 mm is 15 sigma of the noise, and still a stripe."""
    points = line((5, 5), (55, 5), 200, 5)
    points[:, 1] += 0.3 * np.linspace(-1, 1, 200) ** 2
    found = find(points, np.zeros(len(points)))
    assert len(found) == 1
    assert len(found[0]) >= 196


def test_known_count_keeps_the_best_supported_lines() -> None:
    points = np.concatenate([line((5, 0), (5, 40), 150, 6), line((30, 0), (30, 40), 60, 7)])
    found = find(points, np.arange(len(points)) // 10, n_lines=1)
    assert len(found) == 1
    assert len(found[0] & set(range(150))) >= 147


def test_a_blob_or_too_few_points_are_no_stripe() -> None:
    blob = np.random.default_rng(8).normal([30, 20], 0.5, (100, 2))
    assert find(blob, np.zeros(100)) == []
    assert find(line((0, 0), (50, 0), 15, 9), np.zeros(15)) == []
    assert find(np.zeros((0, 2)), np.zeros(0)) == []
