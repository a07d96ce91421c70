# SPDX-License-Identifier: Apache-2.0
"""Scans joined by markers: views of a handheld scanner, an arm that moved, clouds carried."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc

from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.poses import Base, Pose
from armscan.geometry.registration import (
    PointPairs,
    carried_covariance_mm2,
    misfits,
    register_points,
)
from armscan.geometry.rotations import skew
from armscan.markers.alignments import MarkerMatchOptions, Matched
from armscan.markers.join_views import (
    LEAST_TO_PLACE,
    UNLIKELY,
    JoinedViews,
    join_views,
    least_moved,
    most_left_out,
)
from armscan.markers.match_3d import match_markers
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.records.cloud import CloudFrame, PointCloud
from armscan.records.points import CommonErrors, MarkerSet
from armscan.storage.points import ASSUMED_SIGMA_MM, MarkerList
from armscan.thesis.two_cameras import match_after_thesis

MOVED_LEVEL = 1e-3
"""Chance that any marker of a list in which none moved is called moved."""
MOVED_WITHIN_MM = 5.0
"""Two markers without partner that lie this near to each other are one that moved."""
MOST_TOO_SMALL = 10.0
"""Residuals so many times what the covariances let expect are no scatter: nothing is believed."""
BY_ID, UNCHECKED = -1, -2
"""In place of a count of rivals: ids said which markers are common, or nothing was checked."""
THESIS_SIGMAS = 8.0
"""Limit of the eight steps for distances: a distance errs by up to 4 sigmas at either end."""


@dataclass(frozen=True, slots=True)
class RegisterOptions:
    """How scans are joined.

    Parameters
    ----------
    match
        How markers are matched.
    sigma_mm
        Standard deviation an axis of markers whose list gives no covariance.
    is_by_id
        Take markers with the same ``id`` in both lists as the same, instead of matching them.
    is_by_thesis
        Pair markers by the eight steps of section 4.3.1, which check nothing afterwards.
    """

    match: MarkerMatchOptions = field(default_factory=MarkerMatchOptions)
    sigma_mm: float = ASSUMED_SIGMA_MM
    is_by_id: bool = False
    is_by_thesis: bool = False

    def __post_init__(self) -> None:
        if not 0.0 < self.sigma_mm < 100.0:
            raise OptionError(
                f"a standard deviation of {self.sigma_mm} mm",
                where="--sigma-mm",
                remedy="give what one marker's position scatters by, as 0.02",
            )


@dataclass(frozen=True, slots=True, eq=False)
class MovedMarker:
    """A marker that is not where the others say.

    Parameters
    ----------
    old_id, new_id
        Its numbers in the two lists.
    offset_mm
        (3,) by how much it moved, in the old frame.
    """

    old_id: int
    new_id: int
    offset_mm: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PlaceRegistration:
    """An arm's new place in the frame of its old one.

    Parameters
    ----------
    fit
        ``old_from_new`` with covariance; its residuals are those of the pairs used.
    pairs
        (K, 2) indices of common markers, old and new.
    residual_mm
        (K, 3) old minus carried new, in the old frame, of all pairs.
    is_used
        (K,) False where the marker moved.
    moved
        Markers that moved, whether they were matched or not.
    only_old, only_new
        Numbers of markers without partner.
    n_rival
        Markers that the next best alignment explains; or `BY_ID` or `UNCHECKED`.
    """

    fit: Estimate[Pose[Base, Base]]
    pairs: IntArray
    residual_mm: FloatArray
    is_used: BoolArray
    moved: tuple[MovedMarker, ...]
    only_old: tuple[int, ...]
    only_new: tuple[int, ...]
    n_rival: int

    @property
    def chi2_probability(self) -> float:
        """Chance of residuals as large as these if the covariances are right."""
        return float(chdtrc(self.fit.degrees_of_freedom, self.fit.chi2))


def register_place(
    old: MarkerList, new: MarkerList, options: RegisterOptions | None = None
) -> PlaceRegistration:
    """Find the arm's new place from markers measured at the old and at the new one.

    Raises
    ------
    EstimationError
        If the markers do not determine it, or in more than one way.
    OptionError
        If ids are asked for that a list does not give.
    """
    options = options or RegisterOptions()
    a, b = old.markers, new.markers
    pairs, n_rival = _common(old, new, options)
    fit, is_used, moved = _without_moved(a, b, pairs)
    near, apart = pairs[:0], np.zeros((0, 3))
    # ids say that markers without partner are not the same
    while not options.is_by_id:
        near, apart = _nearest(a, b, pairs, fit)
        are_gone = _have_moved(a, b, near, apart, fit)
        if are_gone.all():
            break
        pairs = np.concatenate([pairs, near[~are_gone]])
        fit, is_used, moved = _without_moved(a, b, pairs)
    fit = _with_common_errors(a, b, pairs[is_used], fit)
    strays = [
        MovedMarker(int(a.ids[i]), int(b.ids[k]), offset)
        for (i, k), offset in zip(near, apart, strict=True)
    ]
    everything = _pairs(a, b, pairs)
    carried = fit.value.apply(everything.points_b_mm)
    return PlaceRegistration(
        fit,
        pairs,
        everything.points_a_mm - carried,
        is_used,
        (*moved, *strays),
        tuple(np.delete(a.ids, np.append(pairs[:, 0], near[:, 0])).tolist()),
        tuple(np.delete(b.ids, np.append(pairs[:, 1], near[:, 1])).tolist()),
        n_rival,
    )


def register_views(
    views: Sequence[MarkerSet],
    options: RegisterOptions | None = None,
    progress: Progress = silent,
) -> JoinedViews:
    """Join views that share markers in the frame of the first one.

    Raises
    ------
    EstimationError
        If no view can be joined to the first.
    """
    options = options or RegisterOptions()

    def advance(done: int, total: int) -> None:
        progress(ProgressEvent("matching views", done, total))

    joined = join_views(views, options.match, advance)
    if isinstance(joined, FitFailure):
        raise EstimationError(joined.reason, where=views[0].source, remedy=joined.remedy)
    return joined


def _common(old: MarkerList, new: MarkerList, options: RegisterOptions) -> tuple[IntArray, int]:
    if options.is_by_id:
        return _same_ids(old, new), BY_ID
    if options.is_by_thesis:
        pairs = match_after_thesis(old.markers, new.markers, THESIS_SIGMAS * options.sigma_mm)
        if len(pairs) < LEAST_TO_PLACE:
            raise EstimationError(
                f"the eight steps pair {len(pairs)} markers, {LEAST_TO_PLACE} are needed",
                where=f"{old.path} and {new.path}",
                remedy="leave --method thesis out",
            )
        return pairs, UNCHECKED
    found = match_markers(old.markers, new.markers, options.match)
    if not isinstance(found, Matched):
        remedy = found.remedy
        if old.has_ids and new.has_ids:
            remedy += "; or give --by-id if equal ids are the same marker"
        raise EstimationError(found.reason, where=f"{old.path} and {new.path}", remedy=remedy)
    return found.alignment.pairs, found.n_rival


def _same_ids(old: MarkerList, new: MarkerList) -> IntArray:
    for item in (old, new):
        if not item.has_ids:
            raise OptionError(
                "the list has no column id",
                where=f"--by-id, {item.path}",
                remedy="number the markers in both lists, or leave --by-id out",
            )
    _, k_old, k_new = np.intersect1d(old.markers.ids, new.markers.ids, return_indices=True)
    return np.stack([k_old, k_new], axis=1).astype(np.int64)


def _pairs(old: MarkerSet, new: MarkerSet, pairs: IntArray) -> PointPairs:
    i, k = pairs[:, 0], pairs[:, 1]
    return PointPairs(
        points_a_mm=old.points_mm[i],
        points_b_mm=new.points_mm[k],
        covariance_a_mm2=old.covariance_mm2[i],
        covariance_b_mm2=new.covariance_mm2[k],
    )


def _where(old: MarkerSet, new: MarkerSet) -> str:
    return f"{old.source} and {new.source}"


def _without_moved(
    old: MarkerSet, new: MarkerSet, pairs: IntArray
) -> tuple[Estimate[Pose[Base, Base]], BoolArray, list[MovedMarker]]:
    """Register without the markers that moved, `most_left_out` at most.

    Markers are left out, the worst first; those up to the last one that is off by more than the
    scatter of the others have moved (Rosner's test, in which no outlier hides another). If all
    scatter alike, none has. Residuals that are still unlikely enlarge the covariance.
    """
    left, n_moved = np.arange(len(pairs)), 0
    first: Estimate[Pose[Base, Base]] | FitFailure = register_points(_pairs(old, new, pairs))
    if isinstance(first, FitFailure):
        raise EstimationError(first.reason, where=_where(old, new), remedy=first.remedy)
    fit = kept = first
    out: list[tuple[int, MovedMarker]] = []
    while True:
        misfit = misfits(_pairs(old, new, pairs[left]), fit)
        worst = misfit.moved(MOVED_LEVEL)
        if worst is None or len(out) == most_left_out(len(pairs)):
            break
        i, k = pairs[left[worst]]
        offset = MovedMarker(int(old.ids[i]), int(new.ids[k]), -misfit.offset_mm[worst])
        out.append((int(left[worst]), offset))
        left = np.delete(left, worst)
        again: Estimate[Pose[Base, Base]] | FitFailure = register_points(
            _pairs(old, new, pairs[left])
        )
        if isinstance(again, FitFailure):
            break
        fit = again
        if misfit.chi2[worst] > least_moved(fit.chi2, fit.degrees_of_freedom, len(pairs)):
            kept, n_moved = fit, len(out)
    if len(pairs) == LEAST_TO_PLACE and worst is not None:
        i, k = pairs[worst]
        raise _no_fit(
            old,
            new,
            f"marker {old.ids[i]} (new {new.ids[k]}) does not fit the others, and {len(pairs)} "
            "common markers are too few to tell which moved",
        )
    is_used = np.ones(len(pairs), dtype=bool)
    is_used[[index for index, _ in out[:n_moved]]] = False
    return _enlarged(old, new, kept), is_used, [item for _, item in out[:n_moved]]


def _enlarged(
    old: MarkerSet, new: MarkerSet, fit: Estimate[Pose[Base, Base]]
) -> Estimate[Pose[Base, Base]]:
    """The fit, with the covariance that its residuals show if they are unlikely as stated."""
    if chdtrc(fit.degrees_of_freedom, fit.chi2) >= UNLIKELY:
        return fit
    scale, n = fit.chi2 / fit.degrees_of_freedom, len(fit.residuals)
    if n < LEAST_TO_PLACE or scale > MOST_TOO_SMALL**2:
        raise _no_fit(
            old,
            new,
            f"the {n} common markers do not fit each other: the residuals are {scale**0.5:.2g} "
            "times what the covariances let expect",
        )
    # the scatter is estimated too: errors are Student's, and this is their second moment
    freedom = fit.degrees_of_freedom
    return replace(fit, covariance=freedom / (freedom - 2.0) * scale * fit.covariance)


def _passed_on(
    old: MarkerSet, new: MarkerSet, pairs: IntArray, pose: Pose[Base, Base]
) -> FloatArray:
    """(K, 6, 6 G) by how much the errors that old markers have in common turn and shift the pose.

    Those of one marker each; their sum is what they do together.
    """
    data, common = _pairs(old, new, pairs), old.common
    if common is None:
        return np.zeros((len(pairs), 6, 0))
    weights = np.linalg.inv(data.covariance_a_mm2 + pose.rotate_covariance(data.covariance_b_mm2))
    jacobian = pose.jacobian(data.points_b_mm)
    gain = np.swapaxes(jacobian, 1, 2) @ weights
    normal = (gain @ jacobian).sum(axis=0)
    by_errors = common.jacobian(old.ids[pairs[:, 0]], data.points_a_mm)
    return np.asarray(np.linalg.solve(normal, gain @ by_errors))


def _with_common_errors(
    old: MarkerSet, new: MarkerSet, pairs: IntArray, fit: Estimate[Pose[Base, Base]]
) -> Estimate[Pose[Base, Base]]:
    """The fit, with a covariance that knows that errors of old markers do not average out."""
    if old.common is None:
        return fit
    each, errors = _passed_on(old, new, pairs, fit.value), old.common.covariance
    together = each.sum(axis=0)
    # as independent ones they are in it already
    counted = (each @ errors @ np.swapaxes(each, 1, 2)).sum(axis=0)
    return replace(fit, covariance=fit.covariance + together @ errors @ together.T - counted)


def _no_fit(old: MarkerSet, new: MarkerSet, reason: str) -> EstimationError:
    return EstimationError(
        reason,
        where=_where(old, new),
        remedy="measure more markers, take those out that moved, or state larger uncertainties",
    )


def _nearest(
    old: MarkerSet, new: MarkerSet, pairs: IntArray, fit: Estimate[Pose[Base, Base]]
) -> tuple[IntArray, FloatArray]:
    """Markers without partner that are one that moved a little, or was not matched.

    Their (K, 2) indices, and (K, 3) by how much the new one is off the old one.
    """
    lonely_old = np.setdiff1d(np.arange(len(old)), pairs[:, 0])
    lonely_new = np.setdiff1d(np.arange(len(new)), pairs[:, 1])
    carried = fit.value.apply(new.points_mm[lonely_new])
    apart = carried[None] - old.points_mm[lonely_old][:, None]
    distance = np.linalg.norm(apart, axis=2)
    near: list[tuple[int, int]] = []
    while distance.size and float(distance.min()) < MOVED_WITHIN_MM:
        i, k = (int(index) for index in np.unravel_index(np.argmin(distance), distance.shape))
        near.append((i, k))
        distance[i], distance[:, k] = np.inf, np.inf
    rows, columns = np.array(near, dtype=np.int64).reshape(-1, 2).T
    return np.stack([lonely_old[rows], lonely_new[columns]], axis=1), apart[rows, columns]


def _have_moved(
    old: MarkerSet, new: MarkerSet, near: IntArray, apart: FloatArray, fit: Estimate[Any]
) -> BoolArray:
    """(K,) whether markers are off by more than those of the fit scatter."""
    covariance = old.covariance_mm2[near[:, 0]] + carried_covariance_mm2(
        new.points_mm[near[:, 1]], new.covariance_mm2[near[:, 1]], fit.value, fit.covariance
    )
    square = np.einsum("ki,kij,kj->k", apart, np.linalg.inv(covariance), apart)
    n = len(fit.residuals) + len(near)
    return np.asarray(square > least_moved(fit.chi2, fit.degrees_of_freedom, n))


def carry_cloud(
    cloud: PointCloud, a_from_b: Pose[Any, Any], covariance: FloatArray, frame: CloudFrame
) -> PointCloud:
    """Carry a cloud to the frame ``A``.

    Parameters
    ----------
    cloud
        Points in ``B``.
    a_from_b
        The registration.
    covariance
        (6, 6) of `armscan.geometry.registration.REGISTRATION_PARAMETERS`.
    frame
        Name of ``A``.

    Returns
    -------
    PointCloud
        Points' covariances are turned and get the registration's part, which is common to all
        points; a cloud of another program, with none, keeps none. ``sigma_noise_mm``, the
        stripes' own noise, stays.
    """
    points = cloud.points_mm @ a_from_b.rotation.T + a_from_b.translation_mm
    own = cloud.covariance_mm2
    is_known = bool(np.any(own))
    seen, errors = cloud.seen_from_mm, cloud.calibration_errors
    return replace(
        cloud,
        frame=frame,
        points_mm=points,
        covariance_mm2=(
            carried_covariance_mm2(cloud.points_mm, own, a_from_b, covariance) if is_known else own
        ),
        normals=None if cloud.normals is None else cloud.normals @ a_from_b.rotation.T,
        seen_from_mm=None if seen is None else seen @ a_from_b.rotation.T + a_from_b.translation_mm,
        calibration_errors=None if errors is None else errors.turned(a_from_b.rotation),
    )


@dataclass(frozen=True, slots=True, eq=False)
class MarkerResiduals:
    """How far markers lie from where the other scans say.

    Parameters
    ----------
    scans
        K names of the scans that saw them.
    ids, common_ids
        (K,) their numbers in the scan and in the common frame.
    residual_mm
        (K, 3), in the common frame.
    expected_mm
        (K,) root of the trace of the covariance that a residual should have.
    is_used
        (K,) False where a marker moved or does not fit.
    """

    scans: tuple[str, ...]
    ids: IntArray
    common_ids: IntArray
    residual_mm: FloatArray
    expected_mm: FloatArray
    is_used: BoolArray

    @property
    def length_mm(self) -> FloatArray:
        """(K,) lengths of the residuals."""
        return np.asarray(np.linalg.norm(self.residual_mm, axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class ViewNumbers:
    """What the residuals of joined views come to.

    Parameters
    ----------
    placed
        Names of the views in the order in which they were placed.
    ids
        (K,) number of each sighting's marker in its view.
    n_seen
        (M,) sightings of each marker.
    shared
        Sightings of markers that another view saw too: only these have a residual.
    n_shared, rms_mm
        (V,) number and root mean square of a view's residuals that were used.
    """

    placed: tuple[str, ...]
    ids: IntArray
    n_seen: IntArray
    shared: MarkerResiduals
    n_shared: IntArray
    rms_mm: FloatArray

    @classmethod
    def of(
        cls, joined: JoinedViews, lists: Sequence[MarkerList], names: Sequence[str]
    ) -> ViewNumbers:
        """Take them from joined views."""
        seen, found = joined.sightings, joined.map
        placed = tuple(names[view] for view in joined.placed)
        in_view = np.concatenate([np.arange(len(item)) for item in joined.marker_of])
        of_view = zip(seen.view.tolist(), in_view, strict=True)
        ids = np.array([lists[joined.placed[view]].markers.ids[k] for view, k in of_view])
        n_seen = np.bincount(seen.marker, minlength=len(found.markers_mm))
        is_shared = n_seen[seen.marker] > 1
        # a residual is its sighting's noise, less what the fit takes up
        share = found.degrees_of_freedom / max(3 * int(is_shared.sum()), 1)
        trace = np.trace(seen.covariance_mm2, axis1=1, axis2=2)
        expected = np.sqrt(trace * min(max(share, 0.0), 1.0))
        used = is_shared & found.is_used
        squares = (found.residual_mm[used] ** 2).sum(axis=1)
        n_shared = np.bincount(seen.view[used], minlength=len(placed))
        total = np.bincount(seen.view[used], squares, minlength=len(placed))
        shared = MarkerResiduals(
            scans=tuple(placed[view] for view in seen.view[is_shared]),
            ids=ids[is_shared],
            common_ids=seen.marker[is_shared] + 1,
            residual_mm=found.residual_mm[is_shared],
            expected_mm=expected[is_shared],
            is_used=found.is_used[is_shared],
        )
        rms = np.sqrt(total / np.maximum(n_shared, 1.0))
        return cls(placed, ids, n_seen, shared, n_shared, rms)


def joint_markers(old: MarkerList, new: MarkerList, place: PlaceRegistration) -> MarkerSet:
    """The old markers, and behind them those that only the new place saw, in the old frame.

    A marker that moved keeps its number and has its new place.
    """
    pose = place.fit.value
    carried = pose.apply(new.markers.points_mm)
    covariance = carried_covariance_mm2(
        new.markers.points_mm, new.markers.covariance_mm2, pose, place.fit.covariance
    )
    points, covariances = old.markers.points_mm.copy(), old.markers.covariance_mm2.copy()
    for item in place.moved:
        i = np.flatnonzero(old.markers.ids == item.old_id)
        k = np.flatnonzero(new.markers.ids == item.new_id)
        points[i], covariances[i] = carried[k], covariance[k]
    added = np.isin(new.markers.ids, place.only_new)
    last = int(old.markers.ids.max())
    new_ids = last + 1 + np.arange(int(added.sum()))
    return MarkerSet(
        ids=np.concatenate([old.markers.ids, new_ids]),
        points_mm=np.concatenate([points, carried[added]]),
        covariance_mm2=np.concatenate([covariances, covariance[added]]),
        frame=old.markers.frame,
        common=_joint_errors(old, new, place, new_ids),
    )


def _joint_errors(
    old: MarkerList, new: MarkerList, place: PlaceRegistration, new_ids: IntArray
) -> CommonErrors | None:
    """What the errors of old markers, and of those carried now, have in common."""
    known, pose = old.markers.common, place.fit.value
    gone = {item.old_id for item in place.moved}
    carried = (*sorted(gone), *new_ids.tolist())
    if not carried:
        return known
    about_origin = np.eye(6)
    about_origin[3:, :3] = skew(pose.translation_mm)
    own = about_origin @ place.fit.covariance @ about_origin.T
    if known is None:
        return CommonErrors(groups=(carried,), covariance=own)
    each = _passed_on(old.markers, new.markers, place.pairs[place.is_used], pose)
    across = about_origin @ each.sum(axis=0) @ known.covariance
    return CommonErrors(
        groups=(*(tuple(n for n in one if n not in gone) for one in known.groups), carried),
        covariance=np.block([[known.covariance, across.T], [across, own]]),
    )


def added_sigma_mm(points_mm: FloatArray, place: PlaceRegistration) -> float:
    """Root mean square uncertainty that the registration adds to (N, 3) points of the new frame."""
    none = np.zeros((len(points_mm), 3, 3))
    added = carried_covariance_mm2(points_mm, none, place.fit.value, place.fit.covariance)
    return float(np.sqrt(np.trace(added, axis1=1, axis2=2).mean()))


def place_residuals(old: MarkerList, new: MarkerList, place: PlaceRegistration) -> MarkerResiduals:
    """Of the matched markers."""
    i, k = place.pairs.T
    covariance = old.markers.covariance_mm2[i] + new.markers.covariance_mm2[k]
    freedom = place.fit.degrees_of_freedom
    share = max(freedom, 0) / (freedom + 6)
    return MarkerResiduals(
        scans=(new.path.stem,) * len(i),
        ids=new.markers.ids[k],
        common_ids=old.markers.ids[i],
        residual_mm=place.residual_mm,
        expected_mm=np.sqrt(np.trace(covariance, axis1=1, axis2=2) * share),
        is_used=place.is_used,
    )


def with_strays(
    found: MarkerResiduals, old: MarkerList, place: PlaceRegistration
) -> MarkerResiduals:
    """The residuals, and those of markers that moved too far to be matched."""
    strays = [item for item in place.moved if item.old_id not in set(found.common_ids.tolist())]
    if not strays:
        return found
    n = len(strays)
    return MarkerResiduals(
        scans=found.scans + found.scans[:1] * n,
        ids=np.append(found.ids, [item.new_id for item in strays]),
        common_ids=np.append(found.common_ids, [item.old_id for item in strays]),
        residual_mm=np.concatenate([found.residual_mm, [-item.offset_mm for item in strays]]),
        expected_mm=np.append(found.expected_mm, np.full(n, found.expected_mm.mean())),
        is_used=np.append(found.is_used, np.zeros(n, dtype=bool)),
    )
