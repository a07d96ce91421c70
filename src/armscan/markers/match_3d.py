# SPDX-License-Identifier: Apache-2.0
"""Matching two sets of markers in space by their distances, with a test that the match is
unique.

Labels vote (4.3.1), congruent triangles give alignments, markers within the noise of their
positions count for them, and two questions are asked of the best: would chance explain as many
(Moisan and Stival 2004, a contrario), and does another alignment explain nearly as many?
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import gammaln
from scipy.stats import binom

from armscan.geometry.poses import Pose
from armscan.geometry.registration import spread_mm
from armscan.markers.alignments import (
    FALSE_ALARMS,
    LEAST_TO_CHECK,
    RIVAL_SHARE,
    Alignment,
    LabelledMarkers,
    LabelVotes,
    MarkerMatchOptions,
    MarkerPlacement,
    Matched,
    MatchResult,
    NoMatch,
    NotUnique,
    find_alignments,
    label_markers,
    label_points,
    vote,
)
from armscan.records.points import MarkerSet

CLEAR_LEAD = 2
"""Markers that the best alignment must explain more than any other."""
MIRROR_LEAD = 1.5
"""Times as many markers that a mirror image must explain."""
LINE_SIGMAS = 15.0
UNIFORM = float(np.sqrt(12.0))
"""Extent of a uniform distribution over its standard deviation."""
ENOUGH_MARKERS = "give six or more common markers at unequal distances"


def match_markers(
    first: MarkerSet, second: MarkerSet, options: MarkerMatchOptions | None = None
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
    options = options or MarkerMatchOptions()
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
    votes = vote(a, b)
    placing = MarkerPlacement(a, b)
    are_seen = first.frame == second.frame == "Sensor"
    found = find_alignments(placing, votes, are_seen=are_seen)
    result = _judged(placing, votes, found, options)
    if isinstance(result, Matched):
        return _unless_symmetric(result, placing)
    mirrored = _mirrored(a, b, len(found[0]) if found else 0)
    return result if mirrored is None else mirrored


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


def _judged(
    placing: MarkerPlacement, votes: LabelVotes, found: list[Alignment], options: MarkerMatchOptions
) -> MatchResult:
    if not found:
        return NoMatch("no three markers have the same distances in both sets", ENOUGH_MARKERS)
    n, rival = len(found[0]), len(found[1]) if len(found) > 1 else 0
    n_a, n_b = len(placing.first), len(placing.second)
    has_rival = rival > max(RIVAL_SHARE * n, 3.0) or (
        n >= LEAST_TO_CHECK and n - rival < CLEAR_LEAD
    )
    chance = log10_false_alarms(placing.first, placing.second, votes, n, placing.gate_mm)
    if chance > np.log10(FALSE_ALARMS) and not (has_rival and 2 * n >= min(n_a, n_b)):
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
    return Matched(found[0], rival)


def _mirrored(first: LabelledMarkers, second: LabelledMarkers, n_best: int) -> NoMatch | None:
    """Notice sets of which one is the other's mirror image; None if they are not."""
    if spread_mm(second.points_mm)[2] < LINE_SIGMAS * float(second.sigma_mm.max()):
        # in a plane the mirror image is the same set turned over
        return None
    mirror = label_points(second.points_mm * np.array([1.0, 1.0, -1.0]), second.sigma_mm)
    found = find_alignments(MarkerPlacement(first, mirror), vote(first, mirror))
    n = len(found[0]) if found else 0
    if n <= LEAST_TO_CHECK or n < MIRROR_LEAD * n_best:
        return None
    return NoMatch(
        f"one list is the mirror image of the other: {n} markers agree so, {n_best} as they are",
        "look whether an axis of one list is reversed",
        n_best,
    )


def _ambiguity(
    placing: MarkerPlacement, best: Alignment, n_rival: int, *, has_rival: bool
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
    return Alignment(
        pairs=alignment.pairs[:, ::-1], first_from_second=alignment.first_from_second.inverse()
    )


def _unless_symmetric(result: Matched, placing: MarkerPlacement) -> Matched | NotUnique:
    """Refuse a match on a part that fits on itself in another way.

    The two views may show different halves of a symmetric part: then the right alignment explains
    few markers, and no rival warns of the wrong one. All markers of both views together do.
    """
    first, second = placing.first, placing.second
    pose = result.alignment.first_from_second
    lonely = np.setdiff1d(np.arange(len(second)), result.alignment.pairs[:, 1])
    carried = pose.apply(second.points_mm[lonely])
    points = np.concatenate([first.points_mm, carried])
    sigma = np.concatenate([first.sigma_mm, second.sigma_mm[lonely]])
    both = label_points(points, sigma)
    everything = np.tile(np.arange(len(points))[:, None], (1, 2))
    itself = Alignment(pairs=everything, first_from_second=Pose(np.eye(3), np.zeros(3)))
    onto_itself = MarkerPlacement(both, both)
    votes = vote(both, both)
    found = find_alignments(onto_itself, votes, known=(itself,))
    n = len(found[1]) if len(found) > 1 else 0
    if n <= max(RIVAL_SHARE * len(points), 3.0):
        return result
    return NotUnique(
        f"{n} of all {len(points)} markers seen fit on themselves in another way: the part is "
        "symmetric",
        "add a marker where it breaks the symmetry",
        (result.alignment,),
    )


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


def _rests_on_one(placing: MarkerPlacement, best: Alignment) -> bool:
    points = placing.first.points_mm[best.pairs[:, 0]]
    least = LINE_SIGMAS * float(placing.first.sigma_mm.max())
    return any(spread_mm(np.delete(points, k, axis=0))[1] < least for k in range(len(points)))


def _log_choose_3(n: int) -> float:
    return float(gammaln(n + 1) - gammaln(n - 2) - np.log(6.0))
