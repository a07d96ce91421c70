# SPDX-License-Identifier: Apache-2.0
"""Rings of a left and a right image matched, and the markers' places (section 4.3.1)."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from enum import Enum

import numpy as np

from armscan.geometry.arrays import (
    ArrayRecord,
    BoolArray,
    FloatArray,
    IntArray,
    floats,
    ints,
)
from armscan.markers.candidates import CandidatePairs, RingMatchOptions, find_candidates
from armscan.markers.surface_support import only_candidates, only_supported, ranks
from armscan.models.two_views import TwoViews
from armscan.records.points import MarkerSet, RingImages

_ROUNDS = 2
"""The second round takes the first one's matches as seeds: more of them, and no false ones."""


class RingStatus(Enum):
    """What became of a ring of the left image."""

    MATCHED = "matched"
    NO_PARTNER = "no ring on its epipolar line"
    WRONG_SIZE = "the rings on its epipolar line are not of the diameter given"
    AMBIGUOUS = "several rings may be its partner"
    UNSUPPORTED = "its partner does not fit the surface that its neighbours show"
    OUT_OF_ORDER = "another pair on its epipolar line lies the other way round"


class StereoMatches(ArrayRecord):
    """Markers that both cameras saw.

    Parameters
    ----------
    left, right
        (M,) rows of the ring images.
    markers
        M markers in the Sensor frame; a marker's id is the row of its left ring.
    distance_px, sigma_px
        (M,) epipolar distances (eq. 4.26 in pixels) and their standard deviations.
    statuses
        What became of each ring of the left image.
    n_candidates
        Count of pairs within the epipolar threshold.
    n_planes
        Count of flat faces on which at least six markers agree.
    """

    left: IntArray = ints("M")
    right: IntArray = ints("M")
    markers: MarkerSet
    distance_px: FloatArray = floats("M")
    sigma_px: FloatArray = floats("M")
    statuses: tuple[RingStatus, ...]
    n_candidates: int
    n_planes: int

    @property
    def counts(self) -> dict[RingStatus, int]:
        """How many rings of the left image have each status."""
        found = Counter(self.statuses)
        return {status: found[status] for status in RingStatus}


def match_rings(
    left: RingImages,
    right: RingImages,
    views: TwoViews,
    calibration_covariance: FloatArray,
    options: RingMatchOptions | None = None,
) -> StereoMatches:
    """Match rings and triangulate the markers.

    1. Candidates satisfy the epipolar constraint (eq. 4.27), lie ahead, and are of one size.
    2. Pairs that are the only candidates of both their rings are seeds. They too may be wrong,
       when the true partner was not seen.
    3. A pair is supported if it agrees with a homography on which many seeds agree (eqs. 4.28 to
       4.30), or lies near the plane through its nearest seeds.
    4. A pair is matched if it is supported and no rival has either of its rings; a rival is
       supported as well or nearly so.
    5. Steps 3 and 4 once more, with the matches as seeds.
    6. Two pairs in one epipolar plane whose order differs between the images contradict each
       other on an opaque surface: both are dropped.

    Parameters
    ----------
    left, right
        Rings in the two images.
    views
        The cameras.
    calibration_covariance
        (24, 24) in the order of `armscan.models.two_views.STEREO_PARAMETER_NAMES`.
    options
        Thresholds.
    """
    options = RingMatchOptions() if options is None else options
    pairs = find_candidates(left, right, views, calibration_covariance, options)
    matched = only_candidates(pairs)
    rank = best = np.zeros(len(pairs), np.int64)
    n_planes = 0
    for _ in range(_ROUNDS):
        rank, n_planes = ranks(pairs, pairs.select(matched), left, right, options)
        best = np.maximum(best, rank)
        matched = only_supported(pairs, rank, best)
    crossed = _out_of_order(pairs.select(matched), left, views)
    kept = matched[~crossed]
    statuses = _statuses(len(left), pairs, np.asarray(rank >= 2), matched, crossed)
    if options.diameter_mm is not None and RingStatus.NO_PARTNER in statuses:
        of_any_size = replace(options, diameter_mm=None)
        others = find_candidates(left, right, views, calibration_covariance, of_any_size)
        statuses = _with_wrong_sizes(statuses, others)
    return _matches(left, pairs.select(kept), statuses, len(pairs), n_planes)


def _matches(
    left: RingImages,
    chosen: CandidatePairs,
    statuses: tuple[RingStatus, ...],
    n_candidates: int,
    n_planes: int,
) -> StereoMatches:
    markers = MarkerSet(
        ids=chosen.left,
        points_mm=chosen.points_mm,
        covariance_mm2=chosen.covariance_mm2,
        frame="Sensor",
        source=left.source,
    )
    return StereoMatches(
        left=chosen.left,
        right=chosen.right,
        markers=markers,
        distance_px=chosen.distance_px,
        sigma_px=chosen.sigma_px,
        statuses=statuses,
        n_candidates=n_candidates,
        n_planes=n_planes,
    )


def _statuses(
    n: int, pairs: CandidatePairs, supported: BoolArray, matched: IntArray, crossed: BoolArray
) -> tuple[RingStatus, ...]:
    statuses = [RingStatus.NO_PARTNER] * n
    for row in pairs.left:
        statuses[row] = RingStatus.UNSUPPORTED
    for row in pairs.left[supported]:
        statuses[row] = RingStatus.AMBIGUOUS
    for row, is_crossed in zip(pairs.left[matched], crossed, strict=True):
        statuses[row] = RingStatus.OUT_OF_ORDER if is_crossed else RingStatus.MATCHED
    return tuple(statuses)


def _with_wrong_sizes(
    statuses: tuple[RingStatus, ...], of_any_size: CandidatePairs
) -> tuple[RingStatus, ...]:
    """The statuses, where rings without a partner have one among pairs of any size."""
    have = set(of_any_size.left.tolist())
    return tuple(
        RingStatus.WRONG_SIZE if status is RingStatus.NO_PARTNER and k in have else status
        for k, status in enumerate(statuses)
    )


def _out_of_order(pairs: CandidatePairs, left: RingImages, views: TwoViews) -> BoolArray:
    """(K,) True where another pair of the same epipolar plane lies the other way round.

    Seen from each camera's centre a marker has an angle around the baseline, which names its
    epipolar plane, and an angle from the baseline. In one plane, the order of the second is the
    same from both centres while both markers are on the outside of one opaque body.
    """
    points = pairs.points_mm
    centre = views.right_from_left.inverse().translation_mm
    along = centre / np.linalg.norm(centre)
    side = np.cross(along, [0.0, 0.0, 1.0])
    side = side / np.linalg.norm(side)
    up = np.cross(side, along)
    around = np.arctan2(points @ side, points @ up)
    from_left = np.arctan2(np.hypot(points @ side, points @ up), points @ along)
    seen = points - centre
    from_right = np.arctan2(np.hypot(seen @ side, seen @ up), seen @ along)
    # Rings that overlap across the epipolar lines are in one plane.
    size = left.outer_half_px[pairs.left, 1] / views.left.fx_px
    is_one_plane = np.abs(around[:, None] - around) < np.maximum(size[:, None], size)
    product = (from_left[:, None] - from_left) * (from_right[:, None] - from_right)
    return np.asarray((is_one_plane & (product < 0.0)).any(axis=1))
