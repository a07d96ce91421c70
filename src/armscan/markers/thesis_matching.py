# SPDX-License-Identifier: Apache-2.0
"""The thesis's eight steps of 3-D matching (4.3.1), as written: the baseline."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.markers.distance_labels import LabelledMarkers, label_markers, paired_count
from armscan.records.markers import MarkerSet


def match_after_thesis(first: MarkerSet, second: MarkerSet, limit_mm: float) -> IntArray:
    """Match markers by the eight steps of 4.3.1.

    A first pair is found by the labels alone (steps (1)-(5)); every other marker is then matched
    by its distance to that pair alone (steps (6)-(8)), so two markers at equal distances from it
    are confused. Nothing is checked afterwards. Known failures: equal distances, a wrong first
    pair, markers that only one set holds.

    Parameters
    ----------
    first, second
        The sets.
    limit_mm
        The threshold T.

    Returns
    -------
    pairs
        (K, 2) indices into first and second, each index once ("uniqueness"); empty if no label
        has a unique best partner.
    """
    a, b = label_markers(first), label_markers(second)
    start = _first_pair(a, b, limit_mm)
    return np.zeros((0, 2), dtype=np.int64) if start is None else _grown(a, b, start, limit_mm)


def _first_pair(a: LabelledMarkers, b: LabelledMarkers, limit_mm: float) -> tuple[int, int] | None:
    """Steps (4) and (5): the first marker whose greatest count of paired distances is unique."""
    for i, label in enumerate(a.labels_mm):
        counts = np.array([paired_count(label, other, limit_mm) for other in b.labels_mm])
        best = np.flatnonzero(counts == counts.max(initial=0))
        if len(best) == 1 and counts[best[0]] > 0:
            return i, int(best[0])
    return None


def _grown(
    a: LabelledMarkers, b: LabelledMarkers, start: tuple[int, int], limit_mm: float
) -> IntArray:
    """Steps (6) to (8): markers at an equal distance from the first pair."""
    pairs = [start]
    taken = {start[1]}
    reach: FloatArray = b.distance_mm[start[1]]
    for i, distance in enumerate(a.distance_mm[start[0]]):
        if i == start[0]:
            continue
        difference = np.abs(reach - distance)
        difference[list(taken)] = np.inf
        k = int(np.argmin(difference))
        if difference[k] < limit_mm:
            pairs.append((i, k))
            taken.add(k)
    return np.array(pairs, dtype=np.int64)
