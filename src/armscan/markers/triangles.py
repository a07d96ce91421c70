# SPDX-License-Identifier: Apache-2.0
"""Triangles of markers, and where a congruent one stands in another set."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.markers.distance_labels import LabelledMarkers, LabelVotes

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


def base_triangles(
    first: LabelledMarkers, votes: LabelVotes, max_triangles: int, least_votes: int
) -> IntArray:
    """(T, 3) triangles of markers that may be common, well shaped ones if there are any.

    All of them if there are no more than ``max_triangles``; else a draw that prefers markers whose
    label weighs much somewhere in the other set. The draw depends on the labels only, so neither
    on the order of the markers nor on where they stand.
    """
    usable = np.flatnonzero((votes.count >= least_votes).any(axis=1))
    if len(usable) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    # an order that any numbering and any place of the markers gives
    usable = usable[np.argsort(first.labels_mm[usable].sum(axis=1), kind="stable")]
    n_all = len(usable) * (len(usable) - 1) * (len(usable) - 2) // 6
    if n_all <= max_triangles:
        chosen = np.array(list(combinations(usable.tolist(), 3)), dtype=np.int64)
    else:
        best = votes.weight[usable].max(axis=1)
        likely = best / best.sum() + 1.0 / len(best)
        chosen = usable[_drawn(likely / likely.sum(), DRAWS * max_triangles)]
    height = triangle_heights(first, chosen)
    lowest = LEAST_HEIGHT_SIGMAS * float(first.sigma_mm.max())
    extent = float(first.distance_mm.max())
    broad = 0.0 if len(first) <= FEW_MARKERS else BROAD * extent
    for limit in (max(lowest, broad), lowest):
        if (height > limit).any():
            return chosen[height > limit][:max_triangles]
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
        sigmas: float,
    ) -> None:
        self._first, self._second = first, second
        self._admissible = admissible
        self._sigmas = sigmas
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
        return self._sigmas * float(
            np.sqrt(sigma[i] ** 2 + sigma[j] ** 2 + 2.0 * self._sigma_mm**2)
        )


def chunks(triangles: IntArray, size: int) -> Iterator[IntArray]:
    """Triangles in portions."""
    for start in range(0, len(triangles), size):
        yield triangles[start : start + size]


def _drawn(likely: FloatArray, count: int) -> IntArray:
    """(T, 3) different triples of different indices, each index as likely as said."""
    generator = np.random.default_rng(0)
    triples = generator.choice(len(likely), size=(count, 3), p=likely)
    triples = np.sort(triples, axis=1)
    triples = triples[(triples[:, 0] < triples[:, 1]) & (triples[:, 1] < triples[:, 2])]
    _, place = np.unique(triples, axis=0, return_index=True)
    return np.asarray(triples[np.sort(place)], dtype=np.int64)
