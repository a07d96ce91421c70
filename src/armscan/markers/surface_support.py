# SPDX-License-Identifier: Apache-2.0
"""Whether a candidate pair lies where its neighbours say that the surface is."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.markers.epipolar_candidates import CandidatePairs
from armscan.markers.homography_ransac import find_homography, transfer_px
from armscan.markers.matching_options import MatchingOptions
from armscan.records.markers import RingImages

MIN_ON_PLANE = 6
"""Fewest pairs on a plane: two more than always agree."""
_FARTHEST_PER_MM = 1e-6
"""Inverse depth of a kilometre: what a plane expects beyond is not a marker's place."""
MAX_NEIGHBOURS = 8
MIN_NEIGHBOURS = 3
"""Neighbours that a plane through them needs."""
_MIN_OF_ONE_SIZE, _SHARE_OF_ONE_SIZE = 5, 0.7
"""Seeds needed to say that markers are of one size, and the share of them that must be."""
_RIVAL_FACTOR = 2.5
"""A pair this much further from its neighbours' plane than is allowed still speaks against
another pair with one of its rings."""


def on_planes(
    pairs: CandidatePairs,
    seeds: CandidatePairs,
    left: RingImages,
    right: RingImages,
    options: MatchingOptions,
) -> tuple[BoolArray, int]:
    """Which pairs agree with a homography on which many seeds agree (eqs. 4.28 to 4.30).

    The homography with the most seeds is found, its seeds are set aside, and so on, since a part
    may have several flat faces.

    Parameters
    ----------
    pairs
        K candidates.
    seeds
        Pairs that are the only candidates of both their rings.
    left, right
        Rings in the two images.
    options
        ``plane_px`` is T.

    Returns
    -------
    is_on_plane
        (K,).
    n_planes
        Count of homographies found.
    """
    from_px, to_px = left.centres_px[pairs.left], right.centres_px[pairs.right]
    seed_from, seed_to = left.centres_px[seeds.left], right.centres_px[seeds.right]
    found = np.zeros(len(pairs), np.bool_)
    free = np.ones(len(seeds), np.bool_)
    n_planes = 0
    while True:
        fit = find_homography(
            seed_from[free], seed_to[free], options.plane_px, min_inliers=MIN_ON_PLANE
        )
        if isinstance(fit, FitFailure):
            return found, n_planes
        n_planes += 1
        distance = np.linalg.norm(transfer_px(fit.matrix, from_px) - to_px, axis=1)
        found |= distance <= options.plane_px
        free[np.flatnonzero(free)[fit.is_inlier]] = False


def depth_misfits(pairs: CandidatePairs, seeds: CandidatePairs, left: RingImages) -> FloatArray:
    """How far pairs lie from the plane through their nearest seeds, where a part is curved.

    With calibrated cameras the homography of a plane has three unknowns instead of the eight of
    eq. 4.28: the inverse depth is linear in the ideal image coordinates. So few can be had from the
    nearest neighbours, and continued to the marker, where eight cannot. The plane is the one
    through three neighbours with the least median distance in depth of the others.

    Parameters
    ----------
    pairs
        K candidates.
    seeds
        Pairs to take neighbours from; those that share a ring with the candidate are left out.
    left
        Rings in the left image.

    Returns
    -------
    (K,) difference in depth over the median distance to the neighbours; infinite where there are
    too few neighbours.
    """
    found = np.full(len(pairs), np.inf)
    places = left.centres_px[seeds.left]
    for k in range(len(pairs)):
        others = np.flatnonzero((seeds.left != pairs.left[k]) & (seeds.right != pairs.right[k]))
        away = np.linalg.norm(places[others] - left.centres_px[pairs.left[k]], axis=1)
        chosen = others[np.argsort(away, kind="stable")[:MAX_NEIGHBOURS]]
        if len(chosen) >= MIN_NEIGHBOURS:
            found[k] = _misfit(pairs.points_mm[k], seeds.points_mm[chosen])
    return found


def _misfit(point_mm: FloatArray, neighbours_mm: FloatArray) -> float:
    n = len(neighbours_mm)
    design = np.column_stack([neighbours_mm[:, :2] / neighbours_mm[:, 2:], np.ones(n)])
    inverse = 1.0 / neighbours_mm[:, 2]
    triples = np.array(list(combinations(range(n), MIN_NEIGHBOURS)), np.int64)
    triples = triples[_is_spread(design[triples])]
    if not len(triples):
        return float("inf")
    planes = np.linalg.solve(design[triples], inverse[triples][..., None])[..., 0]
    depth = 1.0 / np.maximum(planes @ design.T, _FARTHEST_PER_MM)
    plane = planes[int(np.median(np.abs(depth - neighbours_mm[:, 2]), axis=1).argmin())]
    own = np.append(point_mm[:2] / point_mm[2], 1.0)
    expected = 1.0 / max(float(plane @ own), _FARTHEST_PER_MM)
    distance = float(np.median(np.linalg.norm(neighbours_mm - expected * own, axis=1)))
    return abs(expected - float(point_mm[2])) / distance


def _is_spread(corners: FloatArray) -> BoolArray:
    """(T,) True where three rays (T, 3, 3) are not nearly in one plane."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    longest = np.maximum((first**2).sum(axis=1), (second**2).sum(axis=1))
    return np.asarray(area > 0.1 * longest)


def ranks(
    pairs: CandidatePairs,
    seeds: CandidatePairs,
    left: RingImages,
    right: RingImages,
    options: MatchingOptions,
) -> tuple[IntArray, int]:
    """How well each pair is supported, and the count of planes.

    Returns
    -------
    rank
        (K,) 3 on a plane of many seeds; 2 near its neighbours' plane, or as large as most markers;
        1 not far from its neighbours' plane; 0 else.
    n_planes
        Count of homographies found.
    """
    is_on_plane, n_planes = on_planes(pairs, seeds, left, right, options)
    misfit = depth_misfits(pairs, seeds, left)
    rank = (misfit < options.depth_tolerance).astype(np.int64)
    rank += misfit < _RIVAL_FACTOR * options.depth_tolerance
    rank[_is_of_their_size(pairs, seeds, options)] = 2
    rank[is_on_plane] = 3
    return rank, n_planes


def _is_of_their_size(
    pairs: CandidatePairs, seeds: CandidatePairs, options: MatchingOptions
) -> BoolArray:
    """Which pairs show the diameter that most seeds show: a wrong depth changes it likewise.

    With few seeds the diameter given takes the place of theirs, if there is one.
    """
    expected = options.diameter_mm
    if len(seeds) >= _MIN_OF_ONE_SIZE:
        middle = float(np.median(seeds.diameter_mm))
        alike = np.abs(np.log(seeds.diameter_mm / middle)) < options.same_size
        expected = middle if alike.mean() >= _SHARE_OF_ONE_SIZE else None
    if expected is None:
        return np.zeros(len(pairs), np.bool_)
    return np.asarray(np.abs(np.log(pairs.diameter_mm / expected)) < options.same_size)


def only_supported(pairs: CandidatePairs, rank: IntArray, best: IntArray) -> IntArray:
    """Rows of the pairs of rank 2 or 3 both of whose rings have no rival.

    A rival is another pair with one of the two rings whose rank is lower by one at most, or was
    with other seeds.

    Parameters
    ----------
    pairs
        K candidates.
    rank, best
        (K,) ranks, and the highest that each pair had with any seeds so far.
    """
    rows = []
    for k in np.flatnonzero(rank >= 2):
        shares = (pairs.left == pairs.left[k]) | (pairs.right == pairs.right[k])
        shares[k] = False
        if not (best[shares] >= rank[k] - 1).any():
            rows.append(k)
    return np.array(rows, dtype=np.int64)


def only_candidates(pairs: CandidatePairs) -> IntArray:
    """Rows of the pairs whose two rings have no other candidate."""
    if not len(pairs):
        return np.zeros(0, np.int64)
    by_left, by_right = np.bincount(pairs.left), np.bincount(pairs.right)
    return np.flatnonzero((by_left[pairs.left] == 1) & (by_right[pairs.right] == 1))
