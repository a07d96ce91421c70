# SPDX-License-Identifier: Apache-2.0
"""Alignments of two marker sets by congruent triangles and votes; options and results of a
match.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from armscan.errors import OptionError
from armscan.geometry.arrays import (
    ArrayRecord,
    BoolArray,
    FloatArray,
    IntArray,
    RowRecord,
    floats,
    ints,
)
from armscan.geometry.poses import Frame, Pose
from armscan.geometry.registration import closed_form_pose, spread_mm
from armscan.records.points import MarkerSet

LEAST_TO_CHECK = 4
"""Three markers fit wherever their triangle occurs, its mirror image included; a fourth checks."""


DISTANCE_SIGMAS = 4.0
"""Two distances agree within this many standard deviations of their difference: of true pairs one
in 16,000 is lost."""
POSITION_SIGMAS = 4.5
"""A marker agrees with an alignment within this many standard deviations."""
FALSE_ALARMS = 1e-4
"""Expected count of alignments, in sets without anything in common, that would explain as many
markers: above it a match is taken for chance."""
RIVAL_SHARE = 0.5
"""A second alignment that explains this share of the best one's markers makes it not unique."""
MAX_TRIANGLES = 400
"""Triangles of markers that are looked for in the other set; all where there are no more."""


@dataclass(frozen=True, slots=True)
class MarkerMatchOptions:
    """How many markers two sets must share: ``least_common``, 4 at least."""

    least_common: int = LEAST_TO_CHECK

    def __post_init__(self) -> None:
        if self.least_common < LEAST_TO_CHECK:
            raise OptionError(
                f"{self.least_common} common markers leave no check",
                where="least_common",
                remedy=f"ask for {LEAST_TO_CHECK} or more",
            )


class Alignment(RowRecord):
    """A rigid motion that carries markers of the second set onto markers of the first.

    ``pairs`` (K, 2) are indices into both sets, each once, ordered by the first; the motion is
    unweighted (`armscan.geometry.registration` gives the weighted one).
    """

    pairs: IntArray = ints("N", 2)
    first_from_second: Pose[Frame, Frame]

    def __post_init__(self) -> None:
        object.__setattr__(self, "pairs", self.pairs[self.pairs[:, 0].argsort()])
        super().__post_init__()


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """The one alignment that explains the markers, and how many the best other one explains."""

    alignment: Alignment
    n_rival: int


@dataclass(frozen=True, slots=True, eq=False)
class NotUnique:
    """More than one alignment explains the markers; none is chosen. Falsy."""

    reason: str
    remedy: str
    rivals: tuple[Alignment, ...]

    def __bool__(self) -> bool:
        """Return False: this is no match."""
        return False


@dataclass(frozen=True, slots=True)
class NoMatch:
    """No alignment explains enough markers; ``n_best`` at most. Falsy."""

    reason: str
    remedy: str
    n_best: int = 0

    def __bool__(self) -> bool:
        """Return False: this is no match."""
        return False


MatchResult: TypeAlias = Matched | NotUnique | NoMatch


class LabelledMarkers(RowRecord):
    """Markers with their mutual distances.

    Parameters
    ----------
    points_mm
        (N, 3).
    sigma_mm
        (N,) standard deviation of a marker along its worst direction.
    distance_mm
        (N, N) distances.
    labels_mm
        (N, N - 1) distances of each marker to all others, the shortest first: its label V.
    """

    points_mm: FloatArray = floats("N", 3)
    sigma_mm: FloatArray = floats("N")
    distance_mm: FloatArray = floats("N", "N")
    labels_mm: FloatArray = floats("N", None)


def label_markers(markers: MarkerSet) -> LabelledMarkers:
    """Give each marker its label: steps (1) to (3) of 4.3.1."""
    sigma = np.zeros(0)
    if len(markers):
        sigma = np.sqrt(np.linalg.eigvalsh(markers.covariance_mm2)[:, -1])
    return label_points(markers.points_mm, sigma)


def label_points(points_mm: FloatArray, sigma_mm: FloatArray) -> LabelledMarkers:
    """Give each of (N, 3) points its label; ``sigma_mm`` (N,) as in `LabelledMarkers`."""
    distance = np.linalg.norm(points_mm[:, None] - points_mm[None], axis=2)
    n = len(points_mm)
    others = distance[~np.eye(n, dtype=bool)].reshape(n, max(n - 1, 0))
    return LabelledMarkers(
        points_mm=points_mm,
        sigma_mm=sigma_mm,
        distance_mm=distance,
        labels_mm=np.sort(others, axis=1),
    )


def paired_count(label_a_mm: FloatArray, label_b_mm: FloatArray, limit_mm: float) -> int:
    """Count C of distances of two labels that pair, one to one, within a limit: step (4).

    Both labels ascend; each distance is used once, which the thesis's wording leaves open.
    """
    count = i = j = 0
    while i < len(label_a_mm) and j < len(label_b_mm):
        difference = float(label_a_mm[i] - label_b_mm[j])
        if abs(difference) < limit_mm:
            count, i, j = count + 1, i + 1, j + 1
        elif difference > 0.0:
            j += 1
        else:
            i += 1
    return count


class LabelVotes(ArrayRecord):
    """How well the labels of two sets agree.

    Parameters
    ----------
    count
        (N, M) distances of marker i of the first set that have at least one equal among those of
        marker k of the second: an upper bound of the markers that agree with the pair (i, k).
    weight
        (N, M) the same, each distance weighed by how rarely it pairs by chance (natural units of
        information).
    n_agreeing
        Pairs of distances that agree, each counted from both its ends in either set: four times.
    """

    count: IntArray = ints("N", "M")
    weight: FloatArray = floats("N", "M")
    n_agreeing: int


def vote(first: LabelledMarkers, second: LabelledMarkers) -> LabelVotes:
    """Compare every label of one set with every label of the other.

    Two distances agree if they differ by less than `DISTANCE_SIGMAS` standard deviations of their
    difference; that of a distance is taken from its two ends, along their worst directions.
    """
    n, m = len(first), len(second)
    count, weight = np.zeros((n, m), dtype=np.int64), np.zeros((n, m))
    if n < 2 or m < 2:
        return LabelVotes(count=count, weight=weight, n_agreeing=0)
    owner, other = np.nonzero(~np.eye(m, dtype=bool))
    distances = second.distance_mm[owner, other]
    order = np.argsort(distances, kind="stable")
    ordered, owner = distances[order], owner[order]
    worst = 2.0 * float(second.sigma_mm.max()) ** 2
    hits = 0
    for i in range(n):
        others = np.flatnonzero(np.arange(n) != i)
        limit = DISTANCE_SIGMAS * np.sqrt(
            first.sigma_mm[i] ** 2 + first.sigma_mm[others] ** 2 + worst
        )
        label = first.distance_mm[i, others]
        low = np.searchsorted(ordered, label - limit)
        high = np.searchsorted(ordered, label + limit)
        size = high - low
        hits += int(size.sum())
        # (label, owner) of every agreeing distance, each owner once a label
        place = np.arange(int(size.sum())) - np.repeat(np.cumsum(size) - size, size)
        agrees = np.zeros((n - 1, m), dtype=bool)
        agrees[np.repeat(np.arange(n - 1), size), owner[np.repeat(low, size) + place]] = True
        share = agrees.sum(axis=1) / m
        count[i] = agrees.sum(axis=0)
        weight[i] = -np.log(np.clip(share, 1.0 / m, 1.0 - 0.5 / m)) @ agrees
    return LabelVotes(count=count, weight=weight, n_agreeing=hits)


LEAST_HEIGHT_SIGMAS = 15.0
"""A triangle lower than this many standard deviations of a marker fixes no turn."""
BROAD = 0.03
"""Heights above this share of the whole set's extent: the alignment errs elsewhere by no more than
some thirty times what a marker does. Flatter triangles are used only where there are no others, or
few markers, so that each triangle counts."""
FEW_MARKERS = 12
MAX_COPIES = 48
"""Congruent triangles of one triangle that are looked at; only repeated patterns have more."""
DRAWS = 20


def base_triangles(first: LabelledMarkers, votes: LabelVotes, least_votes: int) -> IntArray:
    """(T, 3) triangles of markers that may be common, well shaped ones if there are any.

    All of them if there are no more than `MAX_TRIANGLES`; else a draw that prefers markers whose
    label weighs much somewhere in the other set. The draw depends on the labels only, so neither
    on the order of the markers nor on where they stand.
    """
    usable = np.flatnonzero((votes.count >= least_votes).any(axis=1))
    if len(usable) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    # an order that any numbering and any place of the markers gives
    usable = usable[np.argsort(first.labels_mm[usable].sum(axis=1), kind="stable")]
    n_all = len(usable) * (len(usable) - 1) * (len(usable) - 2) // 6
    if n_all <= MAX_TRIANGLES:
        chosen = np.array(list(combinations(usable.tolist(), 3)), dtype=np.int64)
    else:
        best = votes.weight[usable].max(axis=1)
        likely = best / best.sum() + 1.0 / len(best)
        chosen = usable[_drawn(likely / likely.sum(), DRAWS * MAX_TRIANGLES)]
    height = triangle_heights(first, chosen)
    lowest = LEAST_HEIGHT_SIGMAS * float(first.sigma_mm.max())
    extent = float(first.distance_mm.max())
    broad = 0.0 if len(first) <= FEW_MARKERS else BROAD * extent
    for limit in (max(lowest, broad), lowest):
        if (height > limit).any():
            return chosen[height > limit][:MAX_TRIANGLES]
    return chosen[:0]


def triangle_heights(markers: LabelledMarkers, triangles: IntArray) -> FloatArray:
    """(T,) least height of (T, 3) triangles, in mm."""
    a, b, c = (markers.points_mm[triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.max([np.linalg.norm(side, axis=1) for side in (b - a, c - a, c - b)], axis=0)
    return np.asarray(area / np.maximum(longest, 1e-12))


class CongruentTriangles:
    """Finds the triangles of the second set that are congruent to one of the first."""

    def __init__(
        self,
        first: LabelledMarkers,
        second: LabelledMarkers,
        admissible: BoolArray,
    ) -> None:
        self._first, self._second = first, second
        self._admissible = admissible
        self._sigma_mm = float(second.sigma_mm.max())
        tails, heads = np.nonzero(~np.eye(len(second), dtype=bool))
        lengths = second.distance_mm[tails, heads]
        order = np.argsort(lengths, kind="stable")
        self._tails, self._heads = tails[order], heads[order]
        self._lengths = lengths[order]

    def of(self, triangle: IntArray) -> IntArray:
        """(H, 3) markers of the second set whose mutual distances are those of ``triangle``."""
        i, j, m = (int(index) for index in triangle)
        d = self._first.distance_mm
        # the longest side is the rarest
        i, j, m = max(((i, j, m), (j, m, i), (m, i, j)), key=lambda t: d[t[0], t[1]])
        limit = self._limit(i, j)
        low, high = np.searchsorted(self._lengths, [d[i, j] - limit, d[i, j] + limit])
        k, n = self._tails[low:high], self._heads[low:high]
        keep = self._admissible[i, k] & self._admissible[j, n]
        k, n = k[keep], n[keep]
        fits = np.abs(self._second.distance_mm[k] - d[i, m]) < self._limit(i, m)
        fits &= np.abs(self._second.distance_mm[n] - d[j, m]) < self._limit(j, m)
        fits &= self._admissible[m][None, :]
        row, third = np.nonzero(fits)
        found = np.stack([k[row], n[row], third], axis=1)
        places = [(i, j, m).index(int(index)) for index in triangle]
        step = max(1, -(-len(found) // MAX_COPIES))
        return np.asarray(found[::step][:, places], dtype=np.int64)

    def _limit(self, i: int, j: int) -> float:
        sigma = self._first.sigma_mm
        return DISTANCE_SIGMAS * float(
            np.sqrt(sigma[i] ** 2 + sigma[j] ** 2 + 2.0 * self._sigma_mm**2)
        )


def _drawn(likely: FloatArray, count: int) -> IntArray:
    """(T, 3) different triples of different indices, each index as likely as said."""
    generator = np.random.default_rng(0)
    triples = generator.choice(len(likely), size=(count, 3), p=likely)
    triples = np.sort(triples, axis=1)
    triples = triples[(triples[:, 0] < triples[:, 1]) & (triples[:, 1] < triples[:, 2])]
    _, place = np.unique(triples, axis=0, return_index=True)
    return np.asarray(triples[np.sort(place)], dtype=np.int64)


REFINEMENTS = 6
SAME_PLACE_GATES = 3.0
"""Two alignments are one if they carry every marker that they explain to within so many gates."""


class MarkerPlacement:
    """Carries the second set onto the first and says which markers agree.

    A marker agrees within `POSITION_SIGMAS` standard deviations of the difference, those of the
    alignment included.
    """

    def __init__(self, first: LabelledMarkers, second: LabelledMarkers) -> None:
        self.first, self.second = first, second
        self._tree = cKDTree(first.points_mm)
        self._sigma_mm = float(np.hypot(first.sigma_mm.max(), second.sigma_mm.max()))

    @property
    def gate_mm(self) -> float:
        """Distance within which two markers agree under a perfect alignment."""
        return POSITION_SIGMAS * self._sigma_mm

    def poses(self, corners: IntArray, copies: IntArray) -> tuple[FloatArray, FloatArray]:
        """Rotations (H, 3, 3) and translations (H, 3) from triangles (H, 3) in both sets.

        Proper rotations only (eq. 2.50 with its determinant): a mirror image is none.
        """
        target, source = self.first.points_mm[corners], self.second.points_mm[copies]
        middle_a, middle_b = target.mean(axis=1), source.mean(axis=1)
        h = np.swapaxes(source - middle_b[:, None], 1, 2) @ (target - middle_a[:, None])
        u, _, vt = np.linalg.svd(h)
        v, ut = np.swapaxes(vt, 1, 2), np.swapaxes(u, 1, 2)
        v[:, :, 2] *= np.linalg.det(v @ ut)[:, None]
        rotation = v @ ut
        return rotation, middle_a - np.einsum("hij,hj->hi", rotation, middle_b)

    def counts(self, rotation: FloatArray, translation: FloatArray, copies: IntArray) -> IntArray:
        """(H,) markers that each of H alignments explains, generously: see `refined`."""
        moved = self.second.points_mm @ np.swapaxes(rotation, 1, 2) + translation[:, None]
        reach = self._reach_mm(self.second.points_mm[copies])
        limit = float(reach.max(initial=0.0))
        distance, nearest = self._nearest(moved, limit)
        found = distance < reach
        n = len(self.first)
        hit = np.zeros((len(rotation), n + 1), dtype=bool)
        rows = np.nonzero(found)[0]
        hit[rows, nearest[found]] = True
        return np.asarray(hit[:, :n].sum(axis=1), dtype=np.int64)

    def refined(self, rotation: FloatArray, translation: FloatArray, copy: IntArray) -> Alignment:
        """The alignment that a triangle leads to: pairs and motion in turn until they agree."""
        pose: Pose[Frame, Frame] = Pose(rotation, translation)
        reach = self._reach_mm(self.second.points_mm[copy][None])[0]
        pairs = self._mutual(pose, reach)
        for _ in range(REFINEMENTS):
            if len(pairs) < 3:
                break
            target, source = self.first.points_mm[pairs[:, 0]], self.second.points_mm[pairs[:, 1]]
            variance = (
                self.first.sigma_mm[pairs[:, 0]] ** 2 + self.second.sigma_mm[pairs[:, 1]] ** 2
            )
            pose = closed_form_pose(target, source, 1.0 / variance)
            again = self._mutual(pose, self._reach_mm(source[None])[0])
            if np.array_equal(again, pairs):
                break
            pairs = again
        return Alignment(pairs=pairs, first_from_second=pose)

    def are_same(self, one: Alignment, other: Alignment) -> bool:
        """True if both carry all markers that they explain to the same places, or one is a part."""
        if _is_subset(one.pairs, other.pairs) or _is_subset(other.pairs, one.pairs):
            return True
        of_both = np.union1d(one.pairs[:, 1], other.pairs[:, 1])
        points = self.second.points_mm[of_both]
        a, b = one.first_from_second, other.first_from_second
        apart = a.apply(points) - b.apply(points)
        limit = SAME_PLACE_GATES * self.gate_mm
        return bool(np.linalg.norm(apart, axis=1).max(initial=0.0) < limit)

    def _mutual(self, pose: Pose[Frame, Frame], reach_mm: FloatArray) -> IntArray:
        """(K, 2) pairs of markers that are nearest to each other, within ``reach_mm`` (M,)."""
        moved = pose.apply(self.second.points_mm)
        distance, nearest = self._nearest(moved, np.inf)
        back = np.asarray(cKDTree(moved).query(self.first.points_mm[nearest])[1])
        kept = (distance < reach_mm) & (back == np.arange(len(moved)))
        pairs = np.stack([nearest[kept], np.flatnonzero(kept)], axis=1)
        return np.asarray(pairs[np.argsort(pairs[:, 0])], dtype=np.int64)

    def _nearest(self, points_mm: FloatArray, limit_mm: float) -> tuple[FloatArray, IntArray]:
        """Distance to the nearest marker of the first set, and its index; N beyond the limit."""
        distance, nearest = self._tree.query(points_mm, distance_upper_bound=limit_mm)
        return np.asarray(distance), np.asarray(nearest, dtype=np.int64)

    def _reach_mm(self, used_mm: FloatArray) -> FloatArray:
        """(H, M) gates of all markers of the second set under alignments through (H, K, 3) points.

        A marker's own noise, and a bound of the alignment's: its shift, and its turn about the
        points' middle, which the extent across their longest axis determines.
        """
        middle = used_mm.mean(axis=1, keepdims=True)
        squares = np.linalg.svd(used_mm - middle, compute_uv=False) ** 2
        across = np.maximum(squares[:, 1] + squares[:, 2], 1e-12)
        lever = ((self.second.points_mm[None] - middle) ** 2).sum(axis=2)
        share = 1.0 / used_mm.shape[1] + lever / across[:, None]
        return np.asarray(self.gate_mm * np.sqrt(1.0 + share))


def agree_with_known(corners: IntArray, copies: IntArray, known: list[Alignment]) -> BoolArray:
    """(H,) True where a triangle's three pairs all belong to one known alignment."""
    found = np.zeros(len(corners), dtype=bool)
    for alignment in known:
        size = int(max(corners.max(initial=0), alignment.pairs[:, 0].max(initial=0))) + 1
        partner = np.full(size, -1, dtype=np.int64)
        partner[alignment.pairs[:, 0]] = alignment.pairs[:, 1]
        found |= (partner[corners] == copies).all(axis=1)
    return found


def keeps_side(first: LabelledMarkers, translation: FloatArray, flat_below_mm: float) -> BoolArray:
    """(H,) whether a flat set is seen from one side in both frames, both of them a sensor's.

    A flat set and its mirror image differ by half a turn only. A camera stands in the origin of
    its frame and sees markers from their front, so half a turn that would show it their back is
    none. True throughout where the set is not flat, or an origin lies in its plane: that is the
    frame of a drawing or of the plate itself.
    """
    points = first.points_mm
    if spread_mm(points)[2] > flat_below_mm:
        return np.ones(len(translation), dtype=bool)
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    here = float(normal @ middle)
    there = (middle - translation) @ normal
    in_plane = np.minimum(abs(here), np.abs(there)) <= flat_below_mm
    return np.asarray((here * there > 0.0) | in_plane)


def _is_subset(part: IntArray, whole: IntArray) -> bool:
    return {(int(i), int(k)) for i, k in part} <= {(int(i), int(k)) for i, k in whole}


CHUNK = 40
MAX_ALIGNMENTS = 20_000
"""Alignments that are scored before the search ends; only repeated patterns have as many."""
ENOUGH_TRIANGLES = 20.0
"""The search ends when so many triangles of any alignment worth naming should have been drawn."""
FLAT_SHARE = 0.05


def find_alignments(
    placing: MarkerPlacement,
    votes: LabelVotes,
    *,
    are_seen: bool = False,
    known: tuple[Alignment, ...] = (),
) -> list[Alignment]:
    """Different alignments, the best first; at least the two best are complete.

    With ``are_seen`` both sets are in the frame of a sensor that saw them from its origin; those
    ``known`` are not looked for.
    """
    a, b = placing.first, placing.second
    # among few markers three that agree are looked for too: they may be a rival of four
    least_votes = LEAST_TO_CHECK - (2 if len(a) <= FEW_MARKERS else 1)
    admissible = votes.count >= least_votes
    triangles = base_triangles(a, votes, least_votes)
    finder = CongruentTriangles(a, b, admissible)
    flat_mm = FLAT_SHARE * float(spread_mm(a.points_mm)[1])
    most = min(int(admissible.any(axis=1).sum()), int(admissible.any(axis=0).sum()))
    found = list(known)
    n_seen = n_scored = 0
    for start in range(0, len(triangles), CHUNK):
        portion = triangles[start : start + CHUNK]
        copies = [finder.of(triangle) for triangle in portion]
        corners = np.repeat(portion, [len(item) for item in copies], axis=0)
        matches = np.concatenate(copies)
        new = ~agree_with_known(corners, matches, found)
        corners, matches = corners[new], matches[new]
        rotation, translation = placing.poses(corners, matches)
        if are_seen:
            seen = keeps_side(a, translation, flat_mm)
            corners, matches = corners[seen], matches[seen]
            rotation, translation = rotation[seen], translation[seen]
        counts = placing.counts(rotation, translation, matches)
        for k in np.argsort(-counts, kind="stable"):
            second_best = len(found[1]) if len(found) > 1 else 2
            if counts[k] <= second_best:
                break
            if not agree_with_known(corners[k : k + 1], matches[k : k + 1], found).any():
                _add(placing, found, placing.refined(rotation[k], translation[k], matches[k]))
        n_seen, n_scored = n_seen + len(portion), n_scored + len(matches)
        is_settled = len(found) > 1 and len(found[1]) >= max(RIVAL_SHARE * most, 4)
        share = RIVAL_SHARE * len(found[0]) / len(a) if found else 0.0
        if is_settled or n_scored > MAX_ALIGNMENTS or n_seen * share**3 > ENOUGH_TRIANGLES:
            break
    return found


def _add(placing: MarkerPlacement, known: list[Alignment], alignment: Alignment) -> None:
    """Keep an alignment unless a better one is the same; best first."""
    if len(alignment) < 3:
        return
    for k, other in enumerate(known):
        if placing.are_same(alignment, other):
            if len(alignment) > len(other):
                known[k] = alignment
            break
    else:
        known.append(alignment)
    known.sort(key=len, reverse=True)
