# SPDX-License-Identifier: Apache-2.0
"""Unbroken segments of stripes: within one, neighbouring points lie on one line of light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.least_squares import robust_sigma
from armscan.kernels.chains import compare_light, cut_at_largest
from armscan.kernels.naming import find_steps, number_segments, take_every
from armscan.records.profile import Profile, StripeFlag

GAP_PX, GAP_STEPS = 6.0, 3.0
"""Accepted neighbours farther apart than this, and than so many of the profile's usual steps from
point to point, are not linked: a crossing or another line lies between."""
KINK_POINTS = 8
"""Points on either side from which direction and place at a kink are extrapolated."""
KINK_RAD = np.radians(20.0)
JUMP_PX, JUMP_SIGMAS = 0.6, 4.0
"""A line steps where it is off by more than both, the second in sigmas of its points."""
LIGHT_POINTS = 24
"""Points on either side of which the brightness is compared."""
LIGHT_STEP, LIGHT_SIGMAS = float(np.log(1.2)), 3.5
"""A line becomes another one's where its brightness changes by more than both, the second in usual
changes of it, which speckle makes."""
FAINTEST = 1.0
"""Grey level below which lines are equally dark."""
PIECE_PX, SAMPLE_PX = 24.0, 8.0
"""Lengths of pieces that are judged by themselves, and between samples on them."""


@dataclass(frozen=True, slots=True, eq=False)
class StripeSegments:
    """Accepted points of a profile with the unbroken segment of each.

    Parameters
    ----------
    row
        (A,) index of each accepted point in the profile.
    number
        (A,) number of its segment, counted from 0 without gaps; it lies in one chain of the profile
        (`Profile.segment`).
    """

    row: IntArray
    number: IntArray


def cut_segments(profile: Profile, *, at_light: bool = False) -> StripeSegments:
    """Cut the chains of a profile where they may pass from one line to another.

    That is where they end; at gaps; where rejected points near another line lie between, because
    a chain may follow the other line beyond a crossing; and where two lines happen to end at one
    another, which leaves a kink or a small step.

    Parameters
    ----------
    profile
        Stripe points in the order of their chains.
    at_light
        Also where the line becomes brighter or darker at once. At the edge of a thing the line on
        it may happen to go on as another line on what lies behind, too smoothly for a kink or a
        step; that the two are equally bright is another chance.
    """
    row = np.flatnonzero(profile.is_accepted)
    if not len(row):
        return StripeSegments(row, row)
    points, n = profile.points_px, len(row)
    step, is_cut, number = np.zeros(n), np.zeros(n, np.uint8), np.zeros(n, np.int64)
    find_steps(points, row, profile.segment, _is_beside(profile).view(np.uint8), step, is_cut)
    linked = step[is_cut == 0]
    usual = float(np.median(linked)) if len(linked) else 0.0
    is_cut[step > max(GAP_PX, GAP_STEPS * usual)] = 1
    if at_light:
        _cut_at_light(np.log(np.maximum(profile.intensity[row], FAINTEST)), is_cut)
    jump_px = max(JUMP_PX, JUMP_SIGMAS * float(np.median(profile.sigma_px[row])))
    normals = profile.normals_px
    if n < len(points):
        points, normals = points.take(row, axis=0), normals.take(row, axis=0)
    number_segments(points, normals, is_cut, KINK_POINTS, float(KINK_RAD), jump_px, number)
    return StripeSegments(row, number)


def _cut_at_light(light: FloatArray, is_cut: NDArray[np.uint8]) -> None:
    """Mark in ``is_cut`` (A,) where the logarithm of the brightness (A,) changes at once."""
    change = np.zeros(len(light))
    compare_light(light, is_cut, LIGHT_POINTS, change)
    told = change[change >= 0.0]
    if len(told):
        limit = max(LIGHT_STEP, LIGHT_SIGMAS * robust_sigma(told))
        cut_at_largest(change, limit, LIGHT_POINTS, is_cut)


def _is_beside(profile: Profile) -> BoolArray:
    """(N,) True for points with another line beside them."""
    return np.asarray((profile.flags & int(StripeFlag.NEIGHBOUR)) != 0)


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Points that stand for their neighbours.

    Parameters
    ----------
    at
        (S,) index into the arrays of `StripeSegments`.
    weight
        (S,) points that a sample stands for, as a part of the usual number.
    nearest
        (A,) the sample that stands for each accepted point.
    """

    at: IntArray
    weight: FloatArray
    nearest: IntArray


def take_samples(segments: StripeSegments, every: int) -> Samples:
    """Every so many points of each long segment, more densely on short ones."""
    n = len(segments.row)
    at, nearest = np.zeros((2, n), np.int64)
    weight = np.zeros(n)
    count = take_every(segments.number, every, at, weight, nearest)
    return Samples(at[:count], weight[:count], nearest)


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """Short pieces of segments, and the points by which these are judged.

    Parameters
    ----------
    of_point
        (N,) piece of each point of the profile; -1 for points that the extraction rejected.
    segment
        (P,) segment of each piece, not decreasing.
    sample
        (S,) points that are looked at, about every 8 px; each piece has at least one.
    of_sample
        (S,) their pieces, not decreasing.
    direction
        (P, 2) unit vectors along the pieces.
    is_joined
        (P,) True where the piece goes on from the one before: in its segment, or in the same chain
        beyond a kink or a gap with no other line beside it.
    """

    of_point: IntArray
    segment: IntArray
    sample: IntArray
    of_sample: IntArray
    direction: FloatArray
    is_joined: BoolArray

    def __len__(self) -> int:
        """Count of pieces."""
        return len(self.segment)

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
    """Cut the segments of a profile every 24 px."""
    segments = cut_segments(profile)
    rows, number = segments.row, segments.number
    of_point = np.full(len(profile), -1)
    if not len(rows):
        return Pieces(of_point, rows, rows, rows, np.zeros((0, 2)), rows.astype(np.bool_))
    points = profile.points_px[rows]
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    arc_px = np.concatenate([[0.0], np.cumsum(step)])
    along = arc_px - arc_px[np.flatnonzero(np.diff(number, prepend=-1))][number]
    piece = _renumbered(number, np.floor(along / PIECE_PX))
    of_point[rows] = piece
    sample = np.flatnonzero(np.diff(_renumbered(piece, np.floor(along / SAMPLE_PX)), prepend=-1))
    starts = np.flatnonzero(np.diff(piece, prepend=-1))
    n_beside = np.cumsum(_is_beside(profile))[rows]
    is_apart = (np.diff(profile.segment[rows]) != 0) | (np.diff(n_beside) > 0)
    return Pieces(
        of_point=of_point,
        segment=number[starts],
        sample=rows[sample],
        of_sample=piece[sample],
        direction=_directions(points, piece),
        is_joined=np.concatenate([[False], ~is_apart])[starts],
    )


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
