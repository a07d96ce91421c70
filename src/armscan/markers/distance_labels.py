# SPDX-License-Identifier: Apache-2.0
"""Ordered distances to the other markers: a label that no rigid motion changes (4.3.1, (1)-(4))."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.records.markers import MarkerSet


@dataclass(frozen=True, slots=True, eq=False)
class LabelledMarkers:
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

    points_mm: FloatArray
    sigma_mm: FloatArray
    distance_mm: FloatArray
    labels_mm: FloatArray

    def __len__(self) -> int:
        """Count of markers."""
        return len(self.points_mm)


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
    return LabelledMarkers(points_mm, sigma_mm, distance, np.sort(others, axis=1))


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


@dataclass(frozen=True, slots=True, eq=False)
class LabelVotes:
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

    count: IntArray
    weight: FloatArray
    n_agreeing: int


def vote(first: LabelledMarkers, second: LabelledMarkers, sigmas: float) -> LabelVotes:
    """Compare every label of one set with every label of the other.

    Two distances agree if they differ by less than ``sigmas`` standard deviations of their
    difference; that of a distance is taken from its two ends, along their worst directions.
    """
    n, m = len(first), len(second)
    count, weight = np.zeros((n, m), dtype=np.int64), np.zeros((n, m))
    if n < 2 or m < 2:
        return LabelVotes(count, weight, 0)
    owner, other = np.nonzero(~np.eye(m, dtype=bool))
    distances = second.distance_mm[owner, other]
    order = np.argsort(distances, kind="stable")
    ordered, owner = distances[order], owner[order]
    worst = 2.0 * float(second.sigma_mm.max()) ** 2
    hits = 0
    for i in range(n):
        others = np.flatnonzero(np.arange(n) != i)
        limit = sigmas * np.sqrt(first.sigma_mm[i] ** 2 + first.sigma_mm[others] ** 2 + worst)
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
    return LabelVotes(count, weight, hits)
