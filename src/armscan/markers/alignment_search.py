# SPDX-License-Identifier: Apache-2.0
"""The search for all rigid alignments of two sets of markers that explain many of them."""

from __future__ import annotations

import numpy as np

from armscan.geometry.registration import spread_mm
from armscan.markers.alignments import MarkerPlacing, agree_with_known, keeps_side
from armscan.markers.distance_labels import LabelVotes
from armscan.markers.match_result import LEAST_TO_CHECK, Alignment, MatchOptions
from armscan.markers.triangles import FEW_MARKERS, CongruentTriangles, base_triangles, chunks

CHUNK = 40
MAX_ALIGNMENTS = 20_000
"""Alignments that are scored before the search ends; only repeated patterns have as many."""
ENOUGH_TRIANGLES = 20.0
"""The search ends when so many triangles of any alignment worth naming should have been drawn."""
FLAT_SHARE = 0.05


def find_alignments(
    placing: MarkerPlacing,
    votes: LabelVotes,
    options: MatchOptions,
    *,
    are_seen: bool = False,
    known: tuple[Alignment, ...] = (),
) -> list[Alignment]:
    """Different alignments, the best first; at least the two best are complete.

    Parameters
    ----------
    placing, votes, options
        The two sets, how their labels agree, and the limits.
    are_seen
        Both sets are in the frame of a sensor that saw them from its origin.
    known
        Alignments that are not to be looked for.
    """
    a, b = placing.first, placing.second
    # among few markers three that agree are looked for too: they may be a rival of four
    least_votes = LEAST_TO_CHECK - (2 if len(a) <= FEW_MARKERS else 1)
    admissible = votes.count >= least_votes
    triangles = base_triangles(a, votes, options.max_triangles, least_votes)
    finder = CongruentTriangles(a, b, admissible, options.distance_sigmas)
    flat_mm = FLAT_SHARE * float(spread_mm(a.points_mm)[1])
    most = min(int(admissible.any(axis=1).sum()), int(admissible.any(axis=0).sum()))
    found = list(known)
    n_seen = n_scored = 0
    for portion in chunks(triangles, CHUNK):
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
        is_settled = len(found) > 1 and len(found[1]) >= max(options.rival_share * most, 4)
        share = options.rival_share * len(found[0]) / len(a) if found else 0.0
        if is_settled or n_scored > MAX_ALIGNMENTS or n_seen * share**3 > ENOUGH_TRIANGLES:
            break
    return found


def _add(placing: MarkerPlacing, known: list[Alignment], alignment: Alignment) -> None:
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
