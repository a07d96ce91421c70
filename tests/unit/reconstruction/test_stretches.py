# SPDX-License-Identifier: Apache-2.0
"""A profile is cut where its sheet may change, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.reconstruction.segments import PIECE_PX, SAMPLE_PX, Pieces, cut_pieces
from armscan.records.profile import Profile, StripeFlag


def profile_of(
    points: FloatArray, flags: IntArray | None = None, segment: IntArray | None = None
) -> Profile:
    n = len(points)
    tangent = np.gradient(points, axis=0)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    zero = np.zeros(n, np.int64)
    return Profile(
        source="made by hand",
        points_px=points,
        normals_px=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        sigma_px=np.full(n, 0.1),
        width_px=np.full(n, 3.0),
        intensity=np.full(n, 100.0),
        flags=zero if flags is None else flags,
        segment=zero if segment is None else segment,
    )


def line(n: int, angle_deg: float = 50.0, start: tuple[float, float] = (100.0, 80.0)) -> FloatArray:
    angle = np.radians(angle_deg)
    return np.asarray(start) + 1.4 * np.arange(n)[:, None] * [np.cos(angle), np.sin(angle)]


def segments(pieces: Pieces) -> int:
    return int(pieces.segment.max()) + 1


def test_a_straight_chain_is_one_stretch_of_equal_pieces() -> None:
    pieces = cut_pieces(profile_of(line(200)))
    length = 1.4 * 199
    assert segments(pieces) == 1
    assert len(pieces) == int(length // PIECE_PX) + 1
    assert len(pieces.sample) == int(length // SAMPLE_PX) + 1
    assert pieces.size.sum() == 200
    whole = pieces.direction[pieces.size > 10]
    assert np.abs(whole @ [np.cos(np.radians(50.0)), np.sin(np.radians(50.0))]) == pytest.approx(1)


def test_other_chains_and_gaps_are_cut() -> None:
    points = line(120)
    chains = cut_pieces(profile_of(points, segment=np.repeat([0, 1], 60)))
    assert segments(chains) == 2
    assert (~chains.is_joined).sum() == 2
    gap = np.delete(points, np.arange(50, 55), axis=0)
    assert segments(cut_pieces(profile_of(gap))) == 2


def test_only_rejections_near_another_line_cut_a_chain() -> None:
    points = line(120)
    for flag, expected in ((StripeFlag.OUTLIER, 1), (StripeFlag.NEIGHBOUR, 2)):
        flags = np.zeros(120, np.int64)
        flags[60] = int(flag)
        pieces = cut_pieces(profile_of(points, flags))
        assert segments(pieces) == expected
        assert (~pieces.is_joined).sum() == expected
        assert pieces.of_point[60] == -1


def test_a_chain_that_turns_onto_the_other_line_is_cut_at_the_corner() -> None:
    first = line(60, -50.0)
    second = line(60, 55.0, (float(first[-1, 0]), float(first[-1, 1])))[1:]
    pieces = cut_pieces(profile_of(np.concatenate([first, second])))
    assert segments(pieces) == 2
    # a corner where no other line was seen joins: it mostly is an edge of the surface
    assert pieces.is_joined.tolist() == [False] + [True] * (len(pieces) - 1)
    last_of_first = np.flatnonzero(pieces.segment[pieces.of_point] == 0).max()
    assert abs(last_of_first - 59) <= 2


def test_bends_of_surfaces_are_no_corners() -> None:
    angle = np.arange(0.0, 2.0, 1.4 / 60.0)
    circle = 300.0 + 60.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert segments(cut_pieces(profile_of(circle))) == 1


def test_means_are_taken_over_the_samples_of_each_piece() -> None:
    pieces = cut_pieces(profile_of(line(100), segment=np.repeat([0, 1], 50)))
    values = np.arange(len(pieces.sample), dtype=np.float64)
    expected = [values[pieces.of_sample == p].mean() for p in range(len(pieces))]
    assert pieces.mean(values) == pytest.approx(expected)
    both = pieces.mean(np.stack([values, -values], axis=1))
    assert both[:, 1] == pytest.approx([-value for value in expected])


def test_a_profile_without_accepted_points_has_no_pieces() -> None:
    flags = np.full(30, int(StripeFlag.SHORT_SEGMENT))
    pieces = cut_pieces(profile_of(line(30), flags))
    assert len(pieces) == 0
    assert (pieces.of_point == -1).all()
