# SPDX-License-Identifier: Apache-2.0
"""Which markers of many views are the same: pairs of views matched, pairs of markers chained."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from armscan.geometry.arrays import IntArray
from armscan.markers.match_3d import match_markers
from armscan.markers.match_result import Matched, MatchOptions, NotUnique
from armscan.records.markers import MarkerSet

Node = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """Markers that two views share.

    Parameters
    ----------
    first, second
        Indices of the views.
    pairs
        (K, 2) indices of markers in either.
    """

    first: int
    second: int
    pairs: IntArray

    def __len__(self) -> int:
        """Count of markers shared."""
        return len(self.pairs)


@dataclass(frozen=True, slots=True, eq=False)
class ViewLinks:
    """What matching each view with each other gave.

    Parameters
    ----------
    links
        Pairs of views that match, the strongest first.
    not_unique
        Of a view, why a match with another was not unique; the last such reason.
    n_best
        Of each view, the most markers that agree with any view it does not match.
    """

    links: tuple[Link, ...]
    not_unique: dict[int, str]
    n_best: tuple[int, ...]


def link_views(
    views: Sequence[MarkerSet],
    options: MatchOptions | None = None,
    advance: Callable[[int, int], None] | None = None,
) -> ViewLinks:
    """Match every view with every other.

    Parameters
    ----------
    views
        Markers of each view in its own frame.
    options
        How to match.
    advance
        Called with how many pairs are done, and of how many.
    """
    links: list[Link] = []
    not_unique: dict[int, str] = {}
    n_best = [0] * len(views)
    pairs = list(combinations(range(len(views)), 2))
    for done, (i, k) in enumerate(pairs, start=1):
        result = match_markers(views[i], views[k], options)
        if isinstance(result, Matched):
            links.append(Link(i, k, result.alignment.pairs))
        elif isinstance(result, NotUnique):
            not_unique[i] = not_unique[k] = result.reason
        else:
            n_best[i], n_best[k] = max(n_best[i], result.n_best), max(n_best[k], result.n_best)
        if advance is not None:
            advance(done, len(pairs))
    links.sort(key=len, reverse=True)
    return ViewLinks(tuple(links), not_unique, tuple(n_best))


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Markers of the part, each with its sightings.

    Parameters
    ----------
    of_view
        For each view, (N,) number of the part's marker that each of its markers is.
    n_markers
        Count of different markers.
    n_contradictions
        Pairs that were dropped because they would make two markers of one view the same.
    """

    of_view: tuple[IntArray, ...]
    n_markers: int
    n_contradictions: int


def chain_markers(views: Sequence[MarkerSet], links: Sequence[Link]) -> Tracks:
    """Number the part's markers: what links call the same is one; strong links go first."""
    root: dict[Node, Node] = {
        (view, k): (view, k) for view, markers in enumerate(views) for k in range(len(markers))
    }
    seen_by: dict[Node, set[int]] = {node: {node[0]} for node in root}

    def found(node: Node) -> Node:
        while root[node] != node:
            root[node] = root[root[node]]
            node = root[node]
        return node

    n_contradictions = 0
    for link in links:
        for i, k in link.pairs.tolist():
            one, other = found((link.first, i)), found((link.second, k))
            if one == other:
                continue
            if seen_by[one] & seen_by[other]:
                n_contradictions += 1
                continue
            root[other] = one
            seen_by[one] |= seen_by.pop(other)
    number: dict[Node, int] = {}
    of_view = tuple(
        np.array(
            [number.setdefault(found((view, k)), len(number)) for k in range(len(markers))],
            dtype=np.int64,
        )
        for view, markers in enumerate(views)
    )
    return Tracks(of_view, len(number), n_contradictions)
