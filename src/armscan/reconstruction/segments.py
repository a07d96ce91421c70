# SPDX-License-Identifier: Apache-2.0
"""Unbroken segments of stripes: within one, neighbouring points lie on one line of light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.records.profile import Profile

GAP_PX = 6.0
"""Accepted neighbours farther apart are not linked: a crossing or another line lies between."""
KINK_POINTS = 8
"""Points on either side from which direction and place at a kink are extrapolated."""
KINK_RAD = np.radians(20.0)
JUMP_PX = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """Accepted points of a profile with the unbroken piece of each.

    Parameters
    ----------
    row
        (A,) index of each accepted point in the profile.
    piece
        (A,) number of its piece, counted from 0 without gaps; a piece lies in one segment.
    segment
        (A,) its segment.
    """

    row: IntArray
    piece: IntArray
    segment: IntArray


def cut_stripes(profile: Profile) -> Pieces:
    """Cut the segments where they may pass from one line to another.

    A chain of points may follow another line beyond a crossing, where points are flagged, and
    where two lines happen to end at one another, which leaves a kink or a small step.

    Parameters
    ----------
    profile
        Stripe points in the order of their segments.
    """
    row = np.flatnonzero(profile.is_accepted)
    points, normals = profile.points_px[row], profile.normals_px[row]
    segment = profile.segment[row]
    if not len(row):
        return Pieces(row, row, segment)
    apart = np.hypot(*np.diff(points, axis=0).T) > GAP_PX
    is_start = np.concatenate([[True], apart | (np.diff(segment) != 0)])
    is_start |= _is_kink(points, normals, np.cumsum(is_start))
    return Pieces(row, np.cumsum(is_start) - 1, segment)


def _is_kink(points: FloatArray, normals: FloatArray, piece: IntArray) -> BoolArray:
    """(A,) True for the first point beyond a kink or a step of its piece."""
    m, n = KINK_POINTS, len(points)
    found = np.zeros(n, dtype=np.bool_)
    if n < 2 * m:
        return found
    index = np.arange(m, dtype=np.float64)
    design = np.stack([np.ones(m), index - (m - 0.5)], axis=1)
    ahead = np.linalg.pinv(design)
    windows = np.lib.stride_tricks.sliding_window_view(points, m, axis=0)
    before, after = windows[: n - 2 * m + 1] @ ahead.T, windows[m:, :, ::-1] @ ahead.T
    middle = slice(m, n - m + 1)
    inside = piece[: n - 2 * m + 1] == piece[2 * m - 1 :]
    step = np.abs(np.sum((after[:, :, 0] - before[:, :, 0]) * normals[middle], axis=1))
    here, there = before[:, :, 1], -after[:, :, 1]
    cross = here[:, 0] * there[:, 1] - here[:, 1] * there[:, 0]
    turn = np.abs(np.arctan2(cross, np.sum(here * there, axis=1)))
    size = np.where(inside, np.maximum(turn / KINK_RAD, step / JUMP_PX), 0.0)
    found[middle] = _peaks(size, m)
    return found


def _peaks(size: FloatArray, reach: int) -> BoolArray:
    """(M,) True where the size exceeds 1 and no neighbour within reach exceeds it."""
    padded = np.pad(size, reach)
    largest = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1)
    return np.asarray((size > 1.0) & (size >= largest))


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Points that stand for their neighbours.

    Parameters
    ----------
    at
        (S,) index into the arrays of `Pieces`.
    weight
        (S,) points that a sample stands for, as a part of the usual number.
    nearest
        (A,) the sample that stands for each accepted point; -1 where its piece has none.
    """

    at: IntArray
    weight: FloatArray
    nearest: IntArray


def take_samples(pieces: Pieces, every: int) -> Samples:
    """Every so many points of each piece, more densely on short ones.

    Parameters
    ----------
    pieces
        Accepted points.
    every
        Points between samples of a long piece.
    """
    if not len(pieces.row):
        return Samples(pieces.row, np.zeros(0), pieces.row)
    start = np.flatnonzero(np.concatenate([[True], np.diff(pieces.piece) != 0]))
    length = np.diff(np.append(start, len(pieces.row)))
    step = np.clip(length // 4, 1, every)[pieces.piece]
    place = np.arange(len(pieces.row)) - start[pieces.piece]
    cell = np.minimum(place // step, np.maximum(length[pieces.piece] // step - 1, 0))
    key = pieces.piece * (len(pieces.row) + 1) + cell
    is_first = np.concatenate([[True], np.diff(key) != 0])
    nearest = np.cumsum(is_first) - 1
    first = np.flatnonzero(is_first)
    count = np.diff(np.append(first, len(pieces.row)))
    return Samples(first + count // 2, count / every, nearest)
