# SPDX-License-Identifier: Apache-2.0
"""Views of markers joined to one map: links of views, chains of markers, a common adjustment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from armscan.geometry.arrays import (
    FloatArray,
    IntArray,
    RowRecord,
    ints,
)
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.poses import Part, Pose, Sensor
from armscan.geometry.registration import PointPairs, carried_covariance_mm2, register_points
from armscan.markers.alignments import MarkerMatchOptions, Matched, NotUnique
from armscan.markers.joint_map import JointMap, MarkerObservations, adjust_jointly
from armscan.markers.match_3d import match_markers
from armscan.records.points import MarkerSet

Node = tuple[int, int]


class Link(RowRecord):
    """Markers that two views share: ``pairs`` (K, 2) of their indices."""

    first: int
    second: int
    pairs: IntArray = ints("N", 2)


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
    options: MarkerMatchOptions | None = None,
    advance: Callable[[int, int], None] | None = None,
) -> ViewLinks:
    """Match every view, in its own frame, with every other.

    ``advance`` is called with how many pairs are done, and of how many.
    """
    links: list[Link] = []
    not_unique: dict[int, str] = {}
    n_best = [0] * len(views)
    pairs = list(combinations(range(len(views)), 2))
    for done, (i, k) in enumerate(pairs, start=1):
        result = match_markers(views[i], views[k], options)
        if isinstance(result, Matched):
            links.append(Link(first=i, second=k, pairs=result.alignment.pairs))
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
    """Markers of the part: (N,) number of each of a view's markers.

    Pairs that would make two markers of one view the same are dropped and counted.
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


LEAST_TO_PLACE = 4


@dataclass(frozen=True, slots=True, eq=False)
class LeftView:
    """A view that could not be joined: its index, why, and what to do."""

    view: int
    reason: str
    remedy: str


@dataclass(frozen=True, slots=True, eq=False)
class JoinedViews:
    """Views in the frame of the first one.

    Parameters
    ----------
    placed
        Indices of the views that were joined, in the order in which they were placed.
    map
        Poses and markers, in the order of ``placed``.
    marker_of
        For each placed view, (N,) number of the map's marker that each of its markers is.
    sightings
        What was adjusted; ``view`` counts in ``placed``.
    chain
        Poses of the placed views by the chain alone, before all was solved together.
    n_links
        Pairs of views that match.
    n_contradictions
        Pairs of markers that contradicted stronger ones.
    """

    placed: tuple[int, ...]
    map: JointMap
    marker_of: tuple[IntArray, ...]
    sightings: MarkerObservations
    left: tuple[LeftView, ...]
    chain: tuple[Pose[Part, Sensor], ...]
    n_links: int
    n_contradictions: int

    def sigma_mm(self, views: Sequence[MarkerSet]) -> FloatArray:
        """(V,) root mean square uncertainty of position that the poses add to a view's markers.

        Zero for the first view, whose frame is the map's.
        """
        result = []
        for k, view in enumerate(self.placed):
            points = views[view].points_mm
            added = carried_covariance_mm2(
                points,
                np.zeros((len(points), 3, 3)),
                self.map.part_from_view[k],
                self.map.pose_covariance[k],
            )
            result.append(float(np.sqrt(np.trace(added, axis1=1, axis2=2).mean())))
        return np.array(result)

    def shift_mm(self, views: Sequence[MarkerSet]) -> FloatArray:
        """(V,) root mean square distance by which solving together moved a view's markers."""
        result = []
        for k, view in enumerate(self.placed):
            points = views[view].points_mm
            apart = self.chain[k].apply(points) - self.map.part_from_view[k].apply(points)
            result.append(float(np.sqrt((apart**2).sum(axis=1).mean())))
        return np.array(result)


def join_views(
    views: Sequence[MarkerSet],
    options: MarkerMatchOptions | None = None,
    advance: Callable[[int, int], None] | None = None,
) -> JoinedViews | FitFailure:
    """Join views that share markers; the first view's frame is the common one.

    Every view is matched with every other, so that a walk around a part closes by itself. Views
    are placed one after the other where they share most, then all poses and markers are solved
    together.

    ``advance`` is called with how many pairs of views are matched, and of how many.
    """
    if len(views) < 2:
        return FitFailure("one view cannot be joined to anything", "give two or more views")
    links = link_views(views, options, advance)
    tracks = chain_markers(views, links.links)
    placed, chain, markers = _chained(views, tracks)
    left = tuple(_left_view(k, views, links) for k in range(len(views)) if k not in placed)
    if len(placed) < 2:
        return FitFailure(f"no view can be joined to the first: {left[0].reason}", left[0].remedy)
    numbers = np.unique(np.concatenate([tracks.of_view[view] for view in placed]))
    marker_of = tuple(np.searchsorted(numbers, tracks.of_view[view]) for view in placed)
    sightings = MarkerObservations(
        view=np.repeat(np.arange(len(placed)), [len(item) for item in marker_of]),
        marker=np.concatenate(marker_of),
        point_mm=np.concatenate([views[view].points_mm for view in placed]),
        covariance_mm2=np.concatenate([views[view].covariance_mm2 for view in placed]),
    )
    joint = adjust_jointly(sightings, chain, markers[numbers])
    return JoinedViews(
        placed,
        joint,
        marker_of,
        sightings,
        left,
        chain,
        len(links.links),
        tracks.n_contradictions,
    )


class _GrowingMap:
    """Markers known so far: weighted means of their carried sightings."""

    def __init__(self, n_markers: int) -> None:
        self._information = np.zeros((n_markers, 3, 3))
        self._weighted = np.zeros((n_markers, 3))
        self.is_known = np.zeros(n_markers, dtype=bool)

    def add(self, view: MarkerSet, numbers: IntArray, pose: Pose[Part, Sensor]) -> None:
        points = pose.apply(view.points_mm)
        inverse = np.linalg.inv(pose.rotate_covariance(view.covariance_mm2))
        self._information[numbers] += inverse
        self._weighted[numbers] += np.einsum("nij,nj->ni", inverse, points)
        self.is_known[numbers] = True

    def covariance(self, numbers: IntArray) -> FloatArray:
        return np.asarray(np.linalg.inv(self._information[numbers]), dtype=np.float64)

    def points(self, numbers: IntArray) -> FloatArray:
        return np.asarray(
            np.einsum("nij,nj->ni", self.covariance(numbers), self._weighted[numbers])
        )


def _chained(
    views: Sequence[MarkerSet], tracks: Tracks
) -> tuple[tuple[int, ...], tuple[Pose[Part, Sensor], ...], FloatArray]:
    """Place views one by one, that with most known markers first.

    Returns the views, their poses, and (M, 3) the markers, zero where no placed view saw them.
    """
    known = _GrowingMap(tracks.n_markers)
    identity: Pose[Part, Sensor] = Pose(np.eye(3), np.zeros(3))
    known.add(views[0], tracks.of_view[0], identity)
    placed, poses = [0], [identity]
    refused: set[int] = set()
    while True:
        waiting = [k for k in range(len(views)) if k not in placed and k not in refused]
        if not waiting:
            break
        shared = [int(known.is_known[tracks.of_view[k]].sum()) for k in waiting]
        view = waiting[int(np.argmax(shared))]
        if max(shared) < LEAST_TO_PLACE:
            break
        pose = _placed(views[view], tracks.of_view[view], known)
        if pose is None:
            refused.add(view)
            continue
        known.add(views[view], tracks.of_view[view], pose)
        placed.append(view)
        poses.append(pose)
        refused.clear()
    markers = np.zeros((tracks.n_markers, 3))
    numbers = np.flatnonzero(known.is_known)
    markers[numbers] = known.points(numbers)
    return tuple(placed), tuple(poses), markers


def _placed(view: MarkerSet, numbers: IntArray, known: _GrowingMap) -> Pose[Part, Sensor] | None:
    common = known.is_known[numbers]
    fit: Estimate[Pose[Part, Sensor]] | FitFailure = register_points(
        PointPairs(
            points_a_mm=known.points(numbers[common]),
            points_b_mm=view.points_mm[common],
            covariance_a_mm2=known.covariance(numbers[common]),
            covariance_b_mm2=view.covariance_mm2[common],
        )
    )
    return None if isinstance(fit, FitFailure) else fit.value


def _left_view(view: int, views: Sequence[MarkerSet], links: ViewLinks) -> LeftView:
    if view in links.not_unique and not any(view in (a.first, a.second) for a in links.links):
        return LeftView(
            view, links.not_unique[view], "move or add markers so that no two distances are equal"
        )
    if any(view in (link.first, link.second) for link in links.links):
        return LeftView(
            view,
            "it matches other views, but none that is joined to the first",
            "add a view between them",
        )
    agreeing = links.n_best[view]
    most = f"no more than {agreeing} of its" if agreeing else f"none of its {len(views[view])}"
    return LeftView(
        view,
        f"{most} markers agree with another view",
        "let neighbouring views share six or more markers",
    )
