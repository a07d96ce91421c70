# SPDX-License-Identifier: Apache-2.0
"""Support of ring pairs by the neighbouring pairs: homographies of planes by random samples,
depth of the surroundings.
"""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

from armscan.geometry.arrays import (
    ArrayRecord,
    BoolArray,
    FloatArray,
    IntArray,
    apply_homography,
    bools,
    floats,
    homogeneous,
)
from armscan.geometry.estimate import FitFailure
from armscan.markers.candidates import CandidatePairs, RingMatchOptions
from armscan.records.points import RingImages

SAMPLE = 4
"""Pairs that a homography needs: eight unknowns, two equations a pair."""
MAX_SAMPLES = 500
"""Samples tried where there are more than this many: with half of the pairs wrong, 500 samples
miss a pure one with a probability of 1e-14."""
MIN_TRIANGLE_SHARE = 0.01
"""Three points of a sample that span less than this share of the points' mean square spread are
taken for collinear."""
_REFITS = 5


class HomographyConsensus(ArrayRecord):
    """A homography and the pairs that agree with it.

    Parameters
    ----------
    matrix
        (3, 3) H of eq. 4.28: ``(x', y', 1) ~ H (x, y, 1)``; scaled to norm 1.
    is_inlier
        (N,) True for the pairs that lie within the threshold.
    rms_px
        Root mean square distance of their right points from where H maps the left ones. Four
        pairs fit exactly: 0 says nothing then.
    """

    matrix: FloatArray = floats(3, 3)
    is_inlier: BoolArray = bools(None)
    rms_px: float


def fit_homography(left_px: FloatArray, right_px: FloatArray) -> FloatArray | FitFailure:
    """Least-squares homography (3, 3) of norm 1 (eqs. 4.29 and 4.30, denominators multiplied out).

    From four (N, 2) points or more, row by row of one marker. Both images are shifted to their mean
    and scaled to unit spread first, without which the equations are badly conditioned.
    """
    if len(left_px) < SAMPLE:
        return FitFailure(
            f"{len(left_px)} pairs, a homography needs {SAMPLE}",
            "show more markers to both cameras",
        )
    to_left, to_right = _normaliser(left_px), _normaliser(right_px)
    equations = _equations(apply_homography(to_left, left_px), apply_homography(to_right, right_px))
    _, singular, rows = np.linalg.svd(equations)
    if singular[7] < 1e-9 * singular[0]:
        return FitFailure(
            "the pairs determine no homography", "use markers that do not lie on one line"
        )
    matrix = np.linalg.inv(to_right) @ rows[-1].reshape(3, 3) @ to_left
    return np.asarray(matrix / np.linalg.norm(matrix))


def find_homography(
    left_px: FloatArray,
    right_px: FloatArray,
    threshold_px: float,
    *,
    min_inliers: int = SAMPLE + 1,
) -> HomographyConsensus | FitFailure:
    """Find the homography with which most pairs agree: the six steps of section 4.3.1.

    Points (N, 2) are row by row of what may be one marker. ``threshold_px`` is T: the largest
    distance of a right point from where H maps its left one; four pairs always agree. All samples
    are tried where they are few.
    """
    n = len(left_px)
    if n < max(min_inliers, SAMPLE):
        return FitFailure(
            f"{n} pairs, {max(min_inliers, SAMPLE)} are needed", "show more markers to both cameras"
        )
    samples = _samples(n)
    samples = samples[_is_spread(left_px, samples) & _is_spread(right_px, samples)]
    if not len(samples):
        return FitFailure("the pairs lie on one line", "place markers off that line too")
    counts = _count_inliers(left_px, right_px, samples, threshold_px)
    inlier = np.zeros(n, np.bool_)
    inlier[samples[int(counts.argmax())]] = True
    return _refined(left_px, right_px, inlier, threshold_px, min_inliers)


def _refined(
    left_px: FloatArray,
    right_px: FloatArray,
    inlier: BoolArray,
    threshold_px: float,
    min_inliers: int,
) -> HomographyConsensus | FitFailure:
    """Fit to all that agree, look again who agrees, until nothing changes (step 6)."""
    for _ in range(_REFITS):
        fitted = fit_homography(left_px[inlier], right_px[inlier])
        if isinstance(fitted, FitFailure):
            return fitted
        matrix = fitted
        distance = np.linalg.norm(apply_homography(matrix, left_px) - right_px, axis=1)
        before, inlier = inlier, np.asarray(distance <= threshold_px)
        count = int(inlier.sum())
        if count < max(min_inliers, SAMPLE):
            return FitFailure(
                f"{count} of {len(inlier)} pairs agree on a homography, {min_inliers} are needed",
                "the markers may not lie on a plane",
            )
        if np.array_equal(before, inlier):
            break
    rms = float(np.sqrt(np.mean(distance[inlier] ** 2)))
    return HomographyConsensus(matrix=matrix, is_inlier=inlier, rms_px=rms)


def _samples(n: int) -> IntArray:
    """Rows (S, 4) of pairs: all combinations where they are few, random ones otherwise."""
    if comb(n, SAMPLE) <= MAX_SAMPLES:
        return np.array(list(combinations(range(n), SAMPLE)), dtype=np.int64)
    rng = np.random.default_rng(0)
    return np.asarray(rng.random((MAX_SAMPLES, n)).argsort(axis=1)[:, :SAMPLE])


def _is_spread(points_px: FloatArray, samples: IntArray) -> BoolArray:
    """(S,) True where no three of the four points are nearly collinear."""
    spread = float(points_px.var(axis=0).sum())
    found = np.ones(len(samples), np.bool_)
    for triple in combinations(range(SAMPLE), 3):
        a, b, c = (points_px[samples[:, k]] for k in triple)
        first, second = b - a, c - a
        area = 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
        found &= area > MIN_TRIANGLE_SHARE * spread
    return found


def _count_inliers(
    left_px: FloatArray, right_px: FloatArray, samples: IntArray, threshold_px: float
) -> IntArray:
    to_left, to_right = _normaliser(left_px), _normaliser(right_px)
    left, right = apply_homography(to_left, left_px), apply_homography(to_right, right_px)
    threshold = threshold_px * to_right[0, 0]
    equations = _equations(left[samples], right[samples])
    # The last row of V' spans the null space of the eight equations.
    matrices = np.linalg.svd(equations)[2][:, -1].reshape(-1, 3, 3)
    own = homogeneous(left)
    mapped = np.einsum("sij,nj->sni", matrices, own)
    weight = np.where(np.abs(mapped[..., 2:]) > 1e-12, mapped[..., 2:], 1e-12)
    distance = np.linalg.norm(mapped[..., :2] / weight - right, axis=2)
    return np.asarray((distance <= threshold).sum(axis=1))


def _equations(left: FloatArray, right: FloatArray) -> FloatArray:
    """Coefficients (..., 2 N, 9) of h11 ... h33 in eqs. 4.29 and 4.30."""
    x, y = left[..., 0], left[..., 1]
    zero, one = np.zeros_like(x), np.ones_like(x)
    plain = np.stack([x, y, one], axis=-1)
    none = np.stack([zero, zero, zero], axis=-1)
    in_x = np.concatenate([plain, none, -right[..., :1] * plain], axis=-1)
    in_y = np.concatenate([none, plain, -right[..., 1:] * plain], axis=-1)
    return np.concatenate([in_x, in_y], axis=-2)


def _normaliser(points_px: FloatArray) -> FloatArray:
    """Similarity (3, 3) that shifts points to their mean and scales them to unit spread."""
    mean = points_px.mean(axis=0)
    scale = 1.0 / max(float(np.sqrt(points_px.var(axis=0).sum())), 1e-12)
    return np.array([[scale, 0.0, -scale * mean[0]], [0.0, scale, -scale * mean[1]], [0, 0, 1.0]])


PLANE_PX = 2.0
"""T of the homography's consensus: markers on one plane agree to this."""
DEPTH_TOLERANCE = 0.15
"""Largest distance in depth of a marker from the plane through its neighbours, as a fraction of the
distance to them; for parts that curve."""
SAME_SIZE = 0.015
"""Markers whose diameters differ by less than this fraction are of one make; where most are, a pair
of that size is believed without neighbours."""
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
) -> tuple[BoolArray, int]:
    """Which pairs (K,) agree with a homography on which many seeds agree, and how many there are.

    The homography with the most seeds is found (eqs. 4.28 to 4.30), its seeds are set aside, and so
    on, since a part may have several flat faces.
    """
    from_px, to_px = left.centres_px[pairs.left], right.centres_px[pairs.right]
    seed_from, seed_to = left.centres_px[seeds.left], right.centres_px[seeds.right]
    found = np.zeros(len(pairs), np.bool_)
    free = np.ones(len(seeds), np.bool_)
    n_planes = 0
    while True:
        fit = find_homography(seed_from[free], seed_to[free], PLANE_PX, min_inliers=MIN_ON_PLANE)
        if isinstance(fit, FitFailure):
            return found, n_planes
        n_planes += 1
        distance = np.linalg.norm(apply_homography(fit.matrix, from_px) - to_px, axis=1)
        found |= distance <= PLANE_PX
        free[np.flatnonzero(free)[fit.is_inlier]] = False


def depth_misfits(pairs: CandidatePairs, seeds: CandidatePairs, left: RingImages) -> FloatArray:
    """How far (K,) pairs lie from the plane through their nearest seeds, where a part is curved.

    With calibrated cameras the homography of a plane has three unknowns instead of the eight of eq.
    4.28: the inverse depth is linear in the ideal image coordinates. So few can be had from the
    nearest neighbours, those that share a ring left out, and continued to the marker, where eight
    cannot. The plane is the one through three neighbours with the least median distance in depth of
    the others; the misfit is the difference in depth over that, infinite where neighbours are too
    few.
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
    design = homogeneous(neighbours_mm[:, :2] / neighbours_mm[:, 2:])
    inverse = 1.0 / neighbours_mm[:, 2]
    triples = np.array(list(combinations(range(n), MIN_NEIGHBOURS)), np.int64)
    triples = triples[_are_spread(design[triples])]
    if not len(triples):
        return float("inf")
    planes = np.linalg.solve(design[triples], inverse[triples][..., None])[..., 0]
    depth = 1.0 / np.maximum(planes @ design.T, _FARTHEST_PER_MM)
    plane = planes[int(np.median(np.abs(depth - neighbours_mm[:, 2]), axis=1).argmin())]
    own = np.append(point_mm[:2] / point_mm[2], 1.0)
    expected = 1.0 / max(float(plane @ own), _FARTHEST_PER_MM)
    distance = float(np.median(np.linalg.norm(neighbours_mm - expected * own, axis=1)))
    return abs(expected - float(point_mm[2])) / distance


def _are_spread(corners: FloatArray) -> BoolArray:
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
    options: RingMatchOptions,
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
    is_on_plane, n_planes = on_planes(pairs, seeds, left, right)
    misfit = depth_misfits(pairs, seeds, left)
    rank = (misfit < DEPTH_TOLERANCE).astype(np.int64)
    rank += misfit < _RIVAL_FACTOR * DEPTH_TOLERANCE
    rank[_is_of_their_size(pairs, seeds, options)] = 2
    rank[is_on_plane] = 3
    return rank, n_planes


def _is_of_their_size(
    pairs: CandidatePairs, seeds: CandidatePairs, options: RingMatchOptions
) -> BoolArray:
    """Which pairs show the diameter that most seeds show: a wrong depth changes it likewise.

    With few seeds the diameter given takes the place of theirs, if there is one.
    """
    expected = options.diameter_mm
    if len(seeds) >= _MIN_OF_ONE_SIZE:
        middle = float(np.median(seeds.diameter_mm))
        alike = np.abs(np.log(seeds.diameter_mm / middle)) < SAME_SIZE
        expected = middle if alike.mean() >= _SHARE_OF_ONE_SIZE else None
    if expected is None:
        return np.zeros(len(pairs), np.bool_)
    return np.asarray(np.abs(np.log(pairs.diameter_mm / expected)) < SAME_SIZE)


def only_supported(pairs: CandidatePairs, rank: IntArray, best: IntArray) -> IntArray:
    """Rows of the pairs of rank 2 or 3 both of whose rings have no rival.

    A rival is another pair with one of the two rings whose rank is lower by one at most, or was
    with other seeds.

    ``best`` (K,) is the highest rank that each pair had with any seeds so far.
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
