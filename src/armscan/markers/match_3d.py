# SPDX-License-Identifier: Apache-2.0
"""Matching two sets of markers in space by their distances, with a test that the match is unique.

Labels vote (4.3.1), congruent triangles give alignments, markers within the noise of their
positions count for them, and two questions are asked of the best: would chance explain as many
(Moisan and Stival 2004, a contrario), and does another alignment explain nearly as many?
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import gammaln
from scipy.stats import binom

from armscan.geometry.registration import spread_mm
from armscan.markers.alignments import MarkerPlacing, agree_with_known, keeps_side
from armscan.markers.distance_labels import LabelledMarkers, LabelVotes, label_markers, vote
from armscan.markers.match_result import (
    LEAST_TO_CHECK,
    Alignment,
    Matched,
    MatchOptions,
    MatchResult,
    NoMatch,
    NotUnique,
)
from armscan.markers.triangles import CongruentTriangles, base_triangles, chunks
from armscan.records.markers import MarkerSet

CHUNK = 40
CLEAR_LEAD = 2
"""Markers that the best alignment must explain more than any other."""
MAX_ALIGNMENTS = 20_000
"""Alignments that are scored before the search ends; only repeated patterns have as many."""
FEW_MARKERS = 12
ENOUGH_TRIANGLES = 20.0
"""The search ends when so many triangles of any alignment worth naming should have been drawn."""
LINE_SIGMAS = 15.0
FLAT_SHARE = 0.05
UNIFORM = float(np.sqrt(12.0))
"""Extent of a uniform distribution over its standard deviation."""
ENOUGH_MARKERS = "give six or more common markers at unequal distances"


def match_markers(
    first: MarkerSet, second: MarkerSet, options: MatchOptions | None = None
) -> MatchResult:
    """Find which markers of two sets are the same, and the rigid motion between the sets.

    Markers may be missing from either set. Mirror images are refused, and for flat sets of two
    Sensor frames so are views from behind.

    Returns
    -------
    Matched
        One alignment explains the markers, and no other nearly as many.
    NotUnique
        Fewer than four markers, markers on a line, equal distances, grids and other patterns that
        fit in more ways.
    NoMatch
        Nothing in common, or no more than chance would show.
    """
    options = options or MatchOptions()
    if (n := min(len(first), len(second))) < LEAST_TO_CHECK:
        return NotUnique(
            f"a set holds {n} markers, and fewer than {LEAST_TO_CHECK} fit in more than one way",
            ENOUGH_MARKERS,
            (),
        )
    if len(first) > len(second):
        # triangles of the smaller set are the likelier to be common
        return _swapped(match_markers(second, first, options))
    a, b = label_markers(first), label_markers(second)
    on_line = _on_a_line(a, b)
    if on_line is not None:
        return on_line
    votes = vote(a, b, options.distance_sigmas)
    placing = MarkerPlacing(a, b, options.position_sigmas)
    are_seen = first.frame == second.frame == "Sensor"
    found = _search(placing, votes, options, are_seen=are_seen)
    return _judged(placing, votes, found, options)


def log10_false_alarms(
    first: LabelledMarkers, second: LabelledMarkers, votes: LabelVotes, n: int, gate_mm: float
) -> float:
    """Logarithm of the count of alignments that would explain ``n`` markers by chance.

    Pairs of congruent triangles that chance gives, times the chance that n - 3 of the other
    markers find a partner in a scene as dense as this.
    """
    n_a, n_b = len(first), len(second)
    total = n_a * (n_a - 1) * n_b * (n_b - 1)
    by_chance = max(votes.n_agreeing - 2 * n * (n - 1), 0) / total
    narrowest = gate_mm / float(first.distance_mm.max())
    log_triangles = (
        _log_choose_3(n_a)
        + _log_choose_3(n_b)
        + np.log(6.0)
        + 3.0 * np.log(max(by_chance, narrowest))
    )
    extent = np.maximum(UNIFORM * spread_mm(first.points_mm), 2.0 * gate_mm)
    hit = min(n_a * float(np.prod(np.minimum(2.0 * gate_mm / extent, 1.0))), 1.0)
    return float((log_triangles + binom.logsf(n - 4, n_b - 3, hit)) / np.log(10.0))


def _search(
    placing: MarkerPlacing, votes: LabelVotes, options: MatchOptions, *, are_seen: bool
) -> list[Alignment]:
    """Different alignments, the best first; at least the two best are complete."""
    a, b = placing.first, placing.second
    # among few markers three that agree are looked for too: they may be a rival of four
    least_votes = LEAST_TO_CHECK - (2 if len(a) <= FEW_MARKERS else 1)
    admissible = votes.count >= least_votes
    triangles = base_triangles(a, votes, options.max_triangles, least_votes)
    finder = CongruentTriangles(a, b, admissible, options.distance_sigmas)
    flat_mm = FLAT_SHARE * float(spread_mm(a.points_mm)[1])
    most = min(int(admissible.any(axis=1).sum()), int(admissible.any(axis=0).sum()))
    known: list[Alignment] = []
    n_seen = n_scored = 0
    for portion in chunks(triangles, CHUNK):
        copies = [finder.of(triangle) for triangle in portion]
        corners = np.repeat(portion, [len(item) for item in copies], axis=0)
        matches = np.concatenate(copies)
        new = ~agree_with_known(corners, matches, known)
        corners, matches = corners[new], matches[new]
        rotation, translation = placing.poses(corners, matches)
        if are_seen:
            seen = keeps_side(a, translation, flat_mm)
            corners, matches = corners[seen], matches[seen]
            rotation, translation = rotation[seen], translation[seen]
        counts = placing.counts(rotation, translation, matches)
        for k in np.argsort(-counts, kind="stable"):
            second_best = len(known[1]) if len(known) > 1 else 2
            if counts[k] <= second_best:
                break
            if not agree_with_known(corners[k : k + 1], matches[k : k + 1], known).any():
                _add(placing, known, placing.refined(rotation[k], translation[k], matches[k]))
        n_seen, n_scored = n_seen + len(portion), n_scored + len(matches)
        is_settled = len(known) > 1 and len(known[1]) >= max(options.rival_share * most, 4)
        share = options.rival_share * len(known[0]) / len(a) if known else 0.0
        if is_settled or n_scored > MAX_ALIGNMENTS or n_seen * share**3 > ENOUGH_TRIANGLES:
            break
    return known


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


def _judged(
    placing: MarkerPlacing, votes: LabelVotes, found: list[Alignment], options: MatchOptions
) -> MatchResult:
    if not found:
        return NoMatch("no three markers have the same distances in both sets", ENOUGH_MARKERS)
    n, rival = len(found[0]), len(found[1]) if len(found) > 1 else 0
    n_a, n_b = len(placing.first), len(placing.second)
    has_rival = rival > max(options.rival_share * n, 3.0) or (
        n >= LEAST_TO_CHECK and n - rival < CLEAR_LEAD
    )
    chance = log10_false_alarms(placing.first, placing.second, votes, n, placing.gate_mm)
    if chance > np.log10(options.false_alarms) and not (has_rival and 2 * n >= min(n_a, n_b)):
        return NoMatch(
            f"{n} of {n_a} and {n_b} markers agree, which chance would show as well",
            "measure the markers more closely, or more common ones",
            n,
        )
    if why := _ambiguity(placing, found[0], rival, has_rival=has_rival):
        return NotUnique(*why, tuple(found[:2]))
    if n < options.least_common:
        fact = f"{n} markers agree, and {options.least_common} are asked for"
        return NoMatch(fact, ENOUGH_MARKERS, n)
    return Matched(found[0], rival, chance)


def _ambiguity(
    placing: MarkerPlacing, best: Alignment, n_rival: int, *, has_rival: bool
) -> tuple[str, str] | None:
    """Why the best alignment is not the only one, and what to do; None if it is."""
    n = len(best)
    if n < LEAST_TO_CHECK:
        return (
            f"no more than {n} markers agree, which is too few to tell one way from another",
            ENOUGH_MARKERS,
        )
    if has_rival:
        return (
            f"one way explains {n} markers and another {n_rival}: the markers stand at equal "
            "distances",
            "move some markers so that no two distances are equal",
        )
    if _rests_on_one(placing, best):
        return (
            f"all but one of the {n} common markers lie on a line, and the turn about it rests on "
            "that one",
            "add markers off the line",
        )
    return None


def _swapped(result: MatchResult) -> MatchResult:
    """The same with the first and the second set exchanged."""
    if isinstance(result, Matched):
        return replace(result, alignment=_inverse(result.alignment))
    if isinstance(result, NotUnique):
        return replace(result, rivals=tuple(_inverse(item) for item in result.rivals))
    return result


def _inverse(alignment: Alignment) -> Alignment:
    return Alignment(alignment.pairs[:, ::-1], alignment.first_from_second.inverse())


def _on_a_line(first: LabelledMarkers, second: LabelledMarkers) -> NotUnique | None:
    for markers in (first, second):
        across = float(spread_mm(markers.points_mm)[1])
        if across < LINE_SIGMAS * float(markers.sigma_mm.max()):
            return NotUnique(
                f"all markers lie on a line, within {across:.2g} mm: any turn about it fits",
                "add markers off the line",
                (),
            )
    return None


def _rests_on_one(placing: MarkerPlacing, best: Alignment) -> bool:
    points = placing.first.points_mm[best.pairs[:, 0]]
    least = LINE_SIGMAS * float(placing.first.sigma_mm.max())
    return any(spread_mm(np.delete(points, k, axis=0))[1] < least for k in range(len(points)))


def _log_choose_3(n: int) -> float:
    return float(gammaln(n + 1) - gammaln(n - 2) - np.log(6.0))
