# SPDX-License-Identifier: Apache-2.0
"""A profile cut into stretches that one sheet drew, and these into short pieces to be judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.records.profile import Profile, StripeFlag

GAP_PX = 6.0
"""Accepted points further apart belong to two stretches."""
ARM_POINTS = 8
"""The line's direction before and after a point is taken over this many points."""
CORNER_RAD = np.radians(35.0)
"""A sharper turn is a corner: what comes after it may be the other line."""
PIECE_PX = 24.0
SAMPLE_PX = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """Stretches of a profile, their pieces, and the points by which these are judged.

    Parameters
    ----------
    of_point
        (N,) piece of each point; -1 for points that the extraction rejected.
    stretch
        (P,) stretch of each piece, not decreasing.
    sample
        (S,) points that are looked at, about every 8 px; each piece has at least one.
    of_sample
        (S,) their pieces, not decreasing.
    direction
        (P, 2) unit vectors along the pieces.
    """

    of_point: IntArray
    stretch: IntArray
    sample: IntArray
    of_sample: IntArray
    direction: FloatArray

    def __len__(self) -> int:
        """Count of pieces."""
        return len(self.stretch)

    @property
    def size(self) -> IntArray:
        """(P,) count of points."""
        return np.bincount(self.of_point[self.of_point >= 0], minlength=len(self))

    def mean(self, values: FloatArray) -> FloatArray:
        """(P, ...) mean over the samples of each piece of values (S, ...)."""
        count = np.bincount(self.of_sample, minlength=len(self))
        total = np.zeros((len(self), *values.shape[1:]))
        np.add.at(total, self.of_sample, values)
        return np.asarray(total / count.reshape(-1, *([1] * (values.ndim - 1))))


def cut_pieces(profile: Profile) -> Pieces:
    """Cut a profile where its sheet may change, then every 24 px.

    The sheet may change from one chain to the next; where rejected points near another line lie
    between, because a chain may follow the other line beyond a crossing; at gaps; and at corners.

    Parameters
    ----------
    profile
        Stripe points of one exposure.
    """
    rows = np.flatnonzero(profile.is_accepted)
    of_point = np.full(len(profile), -1)
    if not len(rows):
        none = np.zeros(0, np.int64)
        return Pieces(of_point, none, none, none, np.zeros((0, 2)))
    points = profile.points_px[rows]
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    is_cut = np.diff(profile.segment[rows]) != 0
    near = np.cumsum((profile.flags & int(StripeFlag.NEIGHBOUR)) != 0)
    is_cut |= np.diff(near[rows]) > 0
    is_cut |= step > GAP_PX
    stretch = np.concatenate([[0], np.cumsum(is_cut)])
    stretch = np.concatenate([[0], np.cumsum(is_cut | _turns(points, stretch))])
    way = np.concatenate([[0.0], np.cumsum(step)])
    first = np.flatnonzero(np.diff(stretch, prepend=-1))
    along = way - way[first][stretch]
    piece = _renumbered(stretch, np.floor(along / PIECE_PX))
    of_point[rows] = piece
    sample = np.flatnonzero(np.diff(_renumbered(piece, np.floor(along / SAMPLE_PX)), prepend=-1))
    starts = np.flatnonzero(np.diff(piece, prepend=-1))
    return Pieces(
        of_point, stretch[starts], rows[sample], piece[sample], _directions(points, piece)
    )


def _turns(points: FloatArray, stretch: IntArray) -> BoolArray:
    """(N - 1,) True once in the middle of every corner of a stretch."""
    n, arm = len(points), ARM_POINTS
    is_turn = np.zeros(max(n - 1, 0), dtype=np.bool_)
    if n < 2 * arm + 1:
        return is_turn
    middle = np.arange(arm, n - arm)
    before, after = points[middle] - points[middle - arm], points[middle + arm] - points[middle]
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    angle = np.abs(np.arctan2(cross, (before * after).sum(axis=1)))
    is_corner = np.zeros(n + 1, dtype=np.bool_)
    is_whole = stretch[middle - arm] == stretch[middle + arm]
    is_corner[middle] = is_whole & (angle > CORNER_RAD)
    edges = np.flatnonzero(np.diff(is_corner.astype(np.int8), prepend=0))
    is_turn[(edges[::2] + edges[1::2]) // 2 - 1] = True
    return is_turn


def _renumbered(outer: IntArray, inner: FloatArray) -> IntArray:
    """Number runs of equal (outer, inner) from 0."""
    is_new = (np.diff(outer) != 0) | (np.diff(inner) != 0)
    return np.asarray(np.concatenate([[0], np.cumsum(is_new)]))


def _directions(points: FloatArray, piece: IntArray) -> FloatArray:
    """(P, 2) principal direction of the points of each piece."""
    n = int(piece[-1]) + 1
    count = np.bincount(piece, minlength=n)
    middle = np.stack([np.bincount(piece, points[:, k]) for k in range(2)], axis=1) / count[:, None]
    x, y = (points - middle[piece]).T
    xx, xy, yy = (np.bincount(piece, v, minlength=n) for v in (x * x, x * y, y * y))
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)
