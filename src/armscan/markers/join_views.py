# SPDX-License-Identifier: Apache-2.0
"""Views of markers joined to one map: links of views, chains of markers, and all of them in one
least squares, the bundle adjustment of points in space.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.special import chdtrc, chdtri, fdtri

from armscan.geometry.arrays import (
    ArrayRecord,
    BoolArray,
    FloatArray,
    IntArray,
    RowRecord,
    bools,
    floats,
    ints,
)
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.poses import Part, Pose, Sensor
from armscan.geometry.registration import (
    LEAST_SPREAD_SIGMAS,
    PointPairs,
    carried_covariance_mm2,
    register_points,
    spread_mm,
)
from armscan.geometry.rotations import skew
from armscan.markers.alignments import MarkerMatchOptions, Matched, NotUnique
from armscan.markers.match_3d import match_markers
from armscan.records.points import MarkerSet

MAX_ROUNDS = 30
SETTLED = 1e-10
NOTED_GAIN = 1e-2
"""Fall of chi2 at the last step, a sighting, from which on a map counts as not settled."""
OUTLIER_LEVEL = 1e-3
"""Chance that any observation of a whole map without a moved marker is left out."""
UNLIKELY = 1e-3
"""Chance of residuals below which the covariances that are given are taken for too small."""
STATED_FREEDOM = 6
"""What is stated of the scatter of markers counts as so many observations that show it."""
SCALE_SETTLED = 0.1
"""Share by which a view's variances still change when they are settled."""
LEAST_TO_PLACE = 4


def most_left_out(n_common: int) -> int:
    """Of so many common markers, how many may have moved: half, if four others stay."""
    return max(min(n_common // 2, n_common - LEAST_TO_PLACE), 0)


def least_moved(squares: float, freedom: float, n: int) -> float:
    """Square of what one of ``n`` markers is off, in units of its covariance, if it has moved.

    The others say by their own scatter how much it may be off, if they scatter more than is stated:
    their ``squares`` are those of residuals of so many degrees of ``freedom``.
    """
    freedom += STATED_FREEDOM
    scale = max((squares + STATED_FREEDOM) / freedom, 1.0)
    return 3.0 * scale * float(fdtri(3, freedom, 1.0 - OUTLIER_LEVEL / n))


class MarkerObservations(RowRecord):
    """Which view saw which marker where.

    Parameters
    ----------
    view, marker
        (K,) indices.
    point_mm, covariance_mm2
        (K, 3) and (K, 3, 3) in the frame of the view.
    """

    view: IntArray = ints("N")
    marker: IntArray = ints("N")
    point_mm: FloatArray = floats("N", 3)
    covariance_mm2: FloatArray = floats("N", 3, 3)


class JointMap(ArrayRecord):
    """Views and markers in the frame of the first view.

    Parameters
    ----------
    part_from_view
        A pose for each view; the first is the identity and defines the frame.
    pose_covariance
        (V, 6, 6) in the order of `armscan.geometry.registration.REGISTRATION_PARAMETERS`; zero for
        the first view.
    markers_mm, marker_covariance_mm2
        (M, 3) and (M, 3, 3).
    residual_mm
        (K, 3) carried sighting minus marker, in the frame of the map.
    is_used
        (K,) False where a sighting did not fit and was left out: its marker moved, or was mistaken.
    factor
        (V,) by which each view's sightings scatter more than their covariances say; the map counts
        with covariances so enlarged.
    chi2, degrees_of_freedom
        Of the sightings used, with the covariances as given.
    is_settled
        False if the adjustment was stopped before the minimum.
    """

    part_from_view: tuple[Pose[Part, Sensor], ...]
    pose_covariance: FloatArray = floats("V", 6, 6)
    markers_mm: FloatArray = floats("M", 3)
    marker_covariance_mm2: FloatArray = floats("M", 3, 3)
    residual_mm: FloatArray = floats("K", 3)
    is_used: BoolArray = bools("K")
    factor: FloatArray = floats("V")
    chi2: float
    degrees_of_freedom: int
    is_settled: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Misfit:
    """Of K sightings: their views, squares of what they are off where the others put their markers,
    squares of their residuals, and what these should be; all in units of the covariances.
    """

    view: IntArray
    score: FloatArray
    squares: FloatArray
    expected: FloatArray

    def worst(self, ignored: BoolArray) -> int | None:
        """The sighting that fits worst, if the chance of it is below `OUTLIER_LEVEL`.

        ``ignored`` (V,) says of which views none is looked at.
        """
        score = np.where(ignored[self.view], 0.0, self.score)
        k = int(np.argmax(score))
        return k if score[k] > float(chdtri(3, OUTLIER_LEVEL / len(score))) else None

    def by_view(self, n_views: int) -> tuple[FloatArray, FloatArray]:
        """(V,) sums of the squares of a view's residuals; (V,) what they should be."""
        squares, expected = np.zeros(n_views), np.zeros(n_views)
        np.add.at(squares, self.view, self.squares)
        np.add.at(expected, self.view, self.expected)
        return squares, expected


def _fix_a_pose(seen: MarkerObservations) -> bool:
    """Whether sightings of one view spread in two directions."""
    noise = float(np.sqrt(np.linalg.eigvalsh(seen.covariance_mm2).max()))
    return bool(spread_mm(seen.point_mm)[1] > LEAST_SPREAD_SIGMAS * noise)


def adjust_jointly(
    sightings: MarkerObservations, start: Sequence[Pose[Part, Sensor]], markers_mm: FloatArray
) -> JointMap:
    """Solve all poses but the first and all markers; leave out sightings that do not fit.

    Parameters
    ----------
    sightings
        Every marker is seen at least once.
    start
        A pose for each view, from the chain.
    markers_mm
        (M, 3) start of the markers.

    Returns
    -------
    JointMap
        The worst sighting is left out, and all solved again, until every one fits at
        `OUTLIER_LEVEL`; a marker needs two other sightings for that. Of one view `most_left_out` of
        the markers it shares are: a view of which more do not fit, or whose others still scatter
        more than given, keeps them all, with its covariances enlarged by what the residuals show.
    """
    problem, is_used, scale, is_settled = _weighed(
        sightings, _Problem(sightings, tuple(start), np.array(markers_mm))
    )
    poses, covariance, own = problem.covariances()
    residual = replace(problem, sightings=sightings).residuals()
    used = sightings.select(is_used)
    freedom = 3 * len(used) - 6 * (len(start) - 1) - 3 * len(covariance)
    rest = problem.squares() / max(freedom, 1)
    if chdtrc(max(freedom, 1), problem.squares()) >= UNLIKELY:
        rest = 1.0
    return JointMap(
        part_from_view=problem.poses,
        pose_covariance=rest * poses,
        markers_mm=problem.markers_mm,
        marker_covariance_mm2=rest * own,
        residual_mm=residual,
        is_used=is_used,
        factor=np.sqrt(rest * scale),
        chi2=replace(problem, sightings=used).squares(),
        degrees_of_freedom=freedom,
        is_settled=is_settled,
    )


def _weighed(
    sightings: MarkerObservations, problem: _Problem
) -> tuple[_Problem, BoolArray, FloatArray, bool]:
    """Solve with the sightings that fit, and covariances as the residuals of each view show them.

    Also returns which sightings are used (K,), by what each view's covariances are multiplied (V,),
    and whether the last solution settled.
    """
    n_views, view = len(problem.poses), sightings.view
    is_shared = np.bincount(sightings.marker)[sightings.marker] > 1
    n_shared = np.bincount(view[is_shared], minlength=n_views).tolist()
    is_used = np.ones(len(sightings), dtype=bool)
    has_moved, k, one, score = ~is_used, 0, 0, 0.0
    scatters, scale, n_scaled = np.zeros(n_views, dtype=bool), np.ones(n_views), 0
    while True:
        enlarged = scale[view][:, None, None] * sightings.covariance_mm2
        seen = replace(sightings, covariance_mm2=enlarged).select(is_used)
        problem, is_settled = replace(problem, sightings=seen).solved()
        misfit = problem.misfit()
        squares, expected = misfit.by_view(n_views)
        if score > 0.0:
            limit = least_moved(float(squares[one]), float(expected[one]), n_shared[one])
            has_moved[k], score = score > limit, 0.0
        ratio = np.where(expected > 1.0, squares / np.maximum(expected, 1.0), 1.0)
        next_scale = np.where(scatters, np.maximum(scale * ratio, 1.0), scale)
        is_near = np.abs(next_scale / scale - 1.0) < SCALE_SETTLED
        if n_scaled < MAX_ROUNDS * n_views and not is_near.all():
            scale, n_scaled = next_scale, n_scaled + 1
            continue
        before = scatters.copy()
        worst = misfit.worst(scatters)
        if worst is not None:
            k = int(np.flatnonzero(is_used)[worst])
            one = int(view[k])
            others = is_used & is_shared & (view == one)
            others[k] = False
            n_left_out = int((~is_used & (view == one)).sum())
            if n_left_out < most_left_out(n_shared[one]) and _fix_a_pose(sightings.select(others)):
                is_used[k], score = False, float(misfit.score[worst])
                continue
            scatters[one] = True
        else:
            scatters[view[~is_used]] = True
            scatters[view[~is_used & has_moved]] = False
            new = (ratio > 1.0) & (chdtrc(expected, squares) < UNLIKELY / n_views) & ~scatters
            # alike ones together: of two views alone nothing tells which scatters
            scatters |= new & (ratio >= 0.5 * np.max(ratio, where=new, initial=0.0))
        if np.array_equal(scatters, before):
            return problem, is_used, scale, is_settled
        # what did not fit such a view was perhaps no fault of the others
        is_used[:] = True


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations in blocks: poses (V, 6, 6), markers (M, 3, 3), and what couples them."""

    poses: FloatArray
    markers: FloatArray
    coupling: FloatArray
    right_poses: FloatArray
    right_markers: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    sightings: MarkerObservations
    poses: tuple[Pose[Part, Sensor], ...]
    markers_mm: FloatArray

    def turned(self) -> FloatArray:
        """(K, 3) sightings turned into the frame of the map, not shifted."""
        rotation = np.stack([pose.rotation for pose in self.poses])[self.sightings.view]
        return np.asarray(np.einsum("kij,kj->ki", rotation, self.sightings.point_mm))

    def residuals(self) -> FloatArray:
        """(K, 3) carried sighting minus marker."""
        shift = np.stack([pose.translation_mm for pose in self.poses])[self.sightings.view]
        return np.asarray(self.turned() + shift - self.markers_mm[self.sightings.marker])

    def weights(self) -> FloatArray:
        """(K, 3, 3) inverse covariances in the frame of the map."""
        rotation = np.stack([pose.rotation for pose in self.poses])[self.sightings.view]
        inverse = np.linalg.inv(self.sightings.covariance_mm2)
        return np.asarray(rotation @ inverse @ np.swapaxes(rotation, 1, 2))

    def jacobian(self) -> FloatArray:
        """(K, 3, 6) derivative of a residual by its view's pose."""
        turned = self.turned()
        identity = np.broadcast_to(np.eye(3), (len(turned), 3, 3))
        return np.concatenate([-skew(turned), identity], axis=2)

    def squares(self) -> float:
        residual = self.residuals()
        return float(np.einsum("ki,kij,kj->", residual, self.weights(), residual))

    def normal(self) -> _Normal:
        seen, n_views, n_markers = self.sightings, len(self.poses), len(self.markers_mm)
        weights, jacobian, residual = self.weights(), self.jacobian(), self.residuals()
        by_pose = np.einsum("kji,kjl->kil", jacobian, weights)
        result = _Normal(
            np.zeros((n_views, 6, 6)),
            np.zeros((n_markers, 3, 3)),
            np.zeros((n_views, 6, n_markers, 3)),
            np.zeros((n_views, 6)),
            np.zeros((n_markers, 3)),
        )
        np.add.at(result.poses, seen.view, by_pose @ jacobian)
        np.add.at(result.markers, seen.marker, weights)
        # views and markers first, so that both indices stand side by side
        np.add.at(result.coupling.transpose(0, 2, 1, 3), (seen.view, seen.marker), -by_pose)
        np.add.at(result.right_poses, seen.view, -np.einsum("kij,kj->ki", by_pose, residual))
        np.add.at(result.right_markers, seen.marker, np.einsum("kij,kj->ki", weights, residual))
        return result

    def solved(self) -> tuple[_Problem, bool]:
        """Gauss-Newton with the markers eliminated block by block (Schur complement).

        Also returns whether it settled.
        """
        problem = self
        n = 6 * (len(self.poses) - 1)
        for _ in range(MAX_ROUNDS):
            normal = problem.normal()
            spread, reduced = _reduced(normal)
            right = normal.right_poses[1:].ravel() - np.einsum(
                "pmi,mi->p", spread, normal.right_markers
            )
            step = np.linalg.solve(reduced, right) if n else np.zeros(0)
            coupling = normal.coupling[1:].reshape(n, *normal.coupling.shape[2:])
            left = normal.right_markers - np.einsum("pmi,p->mi", coupling, step)
            shift = np.linalg.solve(normal.markers, left[:, :, None])[:, :, 0]
            problem = problem.moved(step.reshape(-1, 6), shift)
            gain = float(step @ right) + float((shift * normal.right_markers).sum())
            if abs(gain) < SETTLED * max(1.0, len(problem.sightings)):
                break
        return problem, abs(gain) < NOTED_GAIN * max(1.0, len(problem.sightings))

    def moved(self, steps: FloatArray, shift_mm: FloatArray) -> _Problem:
        """The problem after a step of the poses (V - 1, 6) and the markers (M, 3)."""
        poses = [pose.retract(step) for pose, step in zip(self.poses[1:], steps, strict=True)]
        return replace(self, poses=(self.poses[0], *poses), markers_mm=self.markers_mm + shift_mm)

    def covariances(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Poses (V, 6, 6); markers given the poses (M, 3, 3); markers in all (M, 3, 3)."""
        normal = self.normal()
        spread, reduced = _reduced(normal)
        joint = np.linalg.inv(reduced) if reduced.size else reduced
        n = len(self.poses)
        poses = np.zeros((n, 6, 6))
        for k in range(1, n):
            part = slice(6 * (k - 1), 6 * k)
            poses[k] = joint[part, part]
        given = np.linalg.inv(normal.markers)
        own = given + np.einsum("pmi,pq,qmj->mij", spread, joint, spread)
        return poses, np.asarray(given, dtype=np.float64), np.asarray(own)

    def misfit(self) -> _Misfit:
        """How well each sighting fits the others."""
        seen = self.sightings
        residual, weights, jacobian = self.residuals(), self.weights(), self.jacobian()
        normal = self.normal()
        spread, reduced = _reduced(normal)
        joint = np.linalg.inv(reduced) if reduced.size else reduced
        given = np.linalg.inv(normal.markers)[seen.marker]
        # derivative of a carried sighting minus its marker by all poses, markers following
        total = np.moveaxis(spread[:, seen.marker], 0, 2).copy()
        for k, view in enumerate(seen.view):
            if view:
                total[k, :, 6 * (view - 1) : 6 * view] += jacobian[k]
        own = np.linalg.inv(weights) - given - total @ joint @ np.swapaxes(total, 1, 2)
        values, vectors = np.linalg.eigh(np.swapaxes(weights, 1, 2) @ own @ weights)
        scale = np.trace(weights, axis1=1, axis2=2) / 3.0
        along = np.einsum("kij,ki->kj", vectors, np.einsum("kij,kj->ki", weights, residual))
        redundancy = values / scale[:, None]
        squares = np.einsum("ki,kij,kj->k", residual, weights, residual)
        share = np.einsum("kij,kji->k", weights, own)
        score = np.where(redundancy > 1e-3, along**2 / np.maximum(values, 1e-300), 0.0).sum(axis=1)
        n_seen = np.bincount(seen.marker, minlength=len(self.markers_mm))[seen.marker]
        score[n_seen < 3] = 0.0
        return _Misfit(seen.view, score, squares, share)


def _reduced(normal: _Normal) -> tuple[FloatArray, FloatArray]:
    """``W H_mm^-1`` (P, M, 3) and the reduced normal matrix (P, P) of all poses but the first."""
    n, m = 6 * (len(normal.poses) - 1), len(normal.markers)
    coupling = normal.coupling[1:].reshape(n, m, 3)
    spread = np.einsum("pmi,mij->pmj", coupling, np.linalg.inv(normal.markers))
    reduced = -np.einsum("pmi,qmi->pq", spread, coupling)
    for k in range(n // 6):
        part = slice(6 * k, 6 * (k + 1))
        reduced[part, part] += normal.poses[k + 1]
    return spread, reduced


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
