# SPDX-License-Identifier: Apache-2.0
"""A cloud laid on datums of its part, one after the other: three faces, or fitted features.

Each datum gives rows: distances that the alignment makes zero, their derivative by a step of the
pose, and by how much each follows the error of each point that the datum was measured by. Datums
are met in their order, each with the motions that the ones before left (ISO 5459, datum systems).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from armscan.geometry.arrays import BoolArray, Box, FloatArray, IntArray
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.features import Shape, ShapeKind, fit_shape, linearise
from armscan.geometry.poses import Cad, Part, Pose
from armscan.inspection.cad.alignment import (
    MOST_POINTS,
    ROUNDS,
    SETTLED_MM,
    Alignment,
    AlignMethod,
    DatumUse,
    about_origin,
    align_best,
    align_none,
    free_text,
    measured,
    middle_and_radius,
    named_motions,
    stated_covariance,
)
from armscan.inspection.cad.comparison import ALONG_FACE
from armscan.inspection.cad.distance import PartSurface, SurfaceDistance
from armscan.inspection.cad.part import PartModel
from armscan.inspection.cad.point_errors import PointErrors
from armscan.inspection.cad.reference_points import ReferencePoints, align_points
from armscan.inspection.cad.search import (
    fit_step,
    moved,
    robust_scale,
    scale_mismatch,
    spread_rows,
    tukey_weights,
)
from armscan.inspection.search import SAME_SIDE
from armscan.inspection.selection import MIN_POINTS, fit_robustly
from armscan.records.cloud import PointCloud

LEAST_SEEN = 0.01
"""Part of a scan's points that a datum has at least: strays of the faces beside lie on any face."""
DATUM_HOLDS = 0.02
"""A datum holds a motion that moves its points by this part of their way along their normals (rms):
a face that leans by a degree on what is left holds nothing of it."""
FACE_KINDS: tuple[ShapeKind, ...] = ("plane", "cylinder", "cone", "sphere")
"""In this order: two rims of a cone lie on a sphere too, the rims of a sphere on no cone."""
EXACT = 1e-5
"""Corners of a face lie this near to its surface, over the part's diagonal: files round to that."""
GIVEN_BAND_MM = 1.0
"""A datum that is no face of the model: points this near to it, after the best fit, are its own."""
PASSES, SAME_PLACE_MM = 3, 1e-4
"""Choices of the points of each feature, and a move after which they are not chosen again."""
LEAST_EFFECT = 1e-6
"""Motions of a face that change its distances by less, over those that change them most, do not."""
DIFFERENCE = 1e-5
"""Step, in mm and rad, by which a place is differentiated by the pose."""
N_PLACE = {"plane": 3, "line": 4, "circle": 5, "sphere": 3, "cylinder": 4, "cone": 5}
"""How many of a kind's first parameters say where it is; a cone's radius says how far along."""
TURNS_OF: dict[ShapeKind, tuple[int, ...]] = {
    "plane": (1, 2), "line": (2, 3), "circle": (3, 4), "sphere": (), "cylinder": (2, 3),
    "cone": (2, 3),
}  # fmt: skip
"""And which of these are turns."""


@dataclass(frozen=True, slots=True, eq=False)
class DatumFeature:
    """A feature of the part that an alignment rests on: where it should be, in Cad; its size is
    free.

    ``face`` is the model's, -1 for none; then only points inside ``region``, in Cad, are its own.
    """

    name: str
    shape: Shape
    face: int = -1
    region: Box | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Datums:
    """What an alignment rests on: by ``321`` three numbers of faces, by ``features`` these in their
    order, by ``points`` and ``markers`` reference points.
    """

    faces: tuple[int, ...] = ()
    features: tuple[DatumFeature, ...] = ()
    points: ReferencePoints | None = None


class _Rows(NamedTuple):
    """What one datum says at a pose.

    ``off_mm``: (R,) distances to be made zero, weighted so that the sum of squares of those after
    the first ``n_turns`` is the mean square over the datum's points; the first ones are of its
    direction alone, wherever it is, and are met before; ``jacobian``: (R, 6) by a step of the
    pose; ``by_source``: (R, S) by the error of each source; ``source``, ``normals``,
    ``residual_mm``: (S,) row of the cloud, (S, 3) direction of its error in Cad, (S,) how far it is
    off; ``middle_mm``, ``reach_mm``: where the datum's points are, and how far they spread.
    """

    name: str
    off_mm: FloatArray
    jacobian: FloatArray
    by_source: FloatArray
    source: IntArray
    normals: FloatArray
    residual_mm: FloatArray
    middle_mm: FloatArray
    reach_mm: float
    n_turns: int = 0


class _Step(NamedTuple):
    """(6,) step that meets the datums, (6, S) how it follows the sources' errors, sign reversed,
    (6, K) motions left, and of each datum the (6, H) motions that it took.
    """

    step: FloatArray
    influence: FloatArray
    left: FloatArray
    taken: tuple[FloatArray, ...]


def align(
    surface: PartSurface,
    cloud: PointCloud,
    method: AlignMethod,
    datums: Datums,
    errors_known: bool,
) -> Alignment | FitFailure:
    """Lay a cloud on its part: by the best fit, from there on its datums, or on reference points.

    ``surface``, ``cloud``, ``errors_known`` as of `align_best`.

    Returns
    -------
    FitFailure
        If the cloud is of another part, a datum is not seen or holds nothing, or reference points
        leave a motion free.
    """
    mismatch = scale_mismatch(surface, cloud.points_mm)
    if mismatch is not None:
        return mismatch
    if method == "none":
        return align_none(cloud)
    if datums.points is not None:
        return align_points(cloud, datums.points)
    best = align_best(surface, cloud, errors_known)
    if method == "best" or isinstance(best, FitFailure):
        return best
    if method == "features":
        return align_features(surface, cloud, datums.features, best, errors_known)
    return _align_seen(surface, cloud, datums.faces, best, errors_known)


def _align_seen(
    surface: PartSurface,
    cloud: PointCloud,
    faces: Sequence[int],
    best: Alignment,
    errors_known: bool,
) -> Alignment | FitFailure:
    """As `align_datums`, from the pose that shows the datums, of those that fit equally well.

    Of a symmetric part the datums tell which is meant. The best fit stays if it shows them all, or
    none of the others does.
    """
    poses = [best.cad_from_part, *(one.cad_from_part for one in best.rivals if one.is_equal)]
    rows = spread_rows(cloud.points_mm, MOST_POINTS)
    seen = []
    for pose in poses:
        triangle = measured(surface, cloud, pose, rows).triangle
        face = surface.part.face[triangle[triangle >= 0]]
        seen.append(min(float((face == one).sum()) / len(rows) for one in faces))
    most = 0 if seen[0] >= LEAST_SEEN or max(seen) < LEAST_SEEN else int(np.argmax(seen))
    start = replace(best, cad_from_part=poses[most])
    found = align_datums(surface, cloud, faces, start, errors_known)
    if isinstance(found, FitFailure) and len(poses) > 1:
        others = f"; it is not better in {len(poses) - 1} other poses that fit as well"
        return replace(found, reason=found.reason + others)
    return found


def align_datums(
    surface: PartSurface,
    cloud: PointCloud,
    faces: Sequence[int],
    start: Alignment,
    errors_known: bool = True,
) -> Alignment | FitFailure:
    """Lay a cloud on three faces, one after the other (3-2-1).

    The first face takes as many motions as it holds, three for a plane; the second and the third
    what the ones before left. A face is met by all its points on the model's own surface.
    """
    at = _Placing.of(surface, cloud, errors_known)
    pose = start.cad_from_part
    for _ in range(ROUNDS):
        found, placed = at.measured(pose), at.placed(pose)
        centre, _ = middle_and_radius(placed)
        rows: list[_Rows] = []
        for number in faces:
            one = _face_rows(at, number, found, placed, centre)
            if isinstance(one, FitFailure):
                return one
            rows.append(one)
        step = _stepwise(rows, centre)
        result = at.result("321", pose, rows, step)
        pose = moved(pose, step.step, centre)
        if np.abs(step.step[3:]).max() < SETTLED_MM:
            break
    return replace(result, cad_from_part=pose, rivals=start.rivals)


def align_features(
    surface: PartSurface,
    cloud: PointCloud,
    features: Sequence[DatumFeature],
    start: Alignment,
    errors_known: bool = True,
) -> Alignment | FitFailure:
    """Lay a cloud on features, one after the other, as a drawing's datum system A | B | C says.

    Each feature is fitted to its points (Gauss, as ISO 5459:2011 allows in place of its default of
    a surface that touches from outside); the first is brought onto its nominal place, the next as
    far as the ones before left it, its direction before its place (ISO 5459 constrains a later
    datum in orientation, not in location), by least squares over its points. Sizes hold nothing:
    a bore that is too large stays where its axis is.

    Returns
    -------
    FitFailure
        If a feature is not seen, or one holds nothing that those before it leave.
    """
    at = _Placing.of(surface, cloud, errors_known)
    pose = start.cad_from_part
    for _ in range(PASSES):
        before, found = at.placed(pose), at.measured(pose)
        fitted: list[_Fitted] = []
        for feature in features:
            one = _fitted(at, feature, found, pose)
            if isinstance(one, FitFailure):
                return one
            fitted.append(one)
        for _ in range(ROUNDS):
            centre, _ = middle_and_radius(at.placed(pose))
            rows = [one.rows(pose, centre) for one in fitted]
            step = _stepwise(rows, centre)
            if np.abs(step.step).max() < SETTLED_MM:
                break
            pose = moved(pose, step.step, centre)
        if np.abs(at.placed(pose) - before).max() < SAME_PLACE_MM:
            break
    idle = next((k for k, one in enumerate(step.taken) if one.shape[1] == 0), None)
    if idle is not None:
        _, radius = middle_and_radius(at.placed(pose))
        text = free_text(named_motions(step.left, centre, radius), ", ") or "no motion"
        return FitFailure(
            f"the datum {features[idle].name} holds nothing that the datums before it leave; "
            f"all together leave {text} free",
            "leave it out, or give a datum that stands otherwise",
        )
    return replace(at.result("features", pose, rows, step), rivals=start.rivals)


def datum_face(number: int, part: PartModel) -> DatumFeature | FitFailure:
    """A face of the model as a datum: the plane, cylinder, sphere or cone of its corners."""
    name = part.face_names[number]
    points = part.vertices_mm[np.unique(part.triangles[part.face == number])]
    limit = EXACT * part.diagonal_mm
    for kind in FACE_KINDS:
        fit = fit_shape(kind, points)
        if isinstance(fit, Estimate) and float(np.abs(fit.residuals).max()) <= limit:
            return DatumFeature(name, _outwards(fit.value, part, number), number)
    return FitFailure(
        f"the face {name} is no plane, cylinder, sphere or cone",
        "name another face, or say where a feature should be, as plane:at=1,2,3:axis=0,0,1 or "
        "cylinder:at=1,2,3:axis=0,0,1:diameter=8",
    )


def _outwards(shape: Shape, part: PartModel, number: int) -> Shape:
    """The same, a plane's normal to the outside of the part."""
    if shape.kind != "plane":
        return shape
    return shape.turned_to(part.normals[part.face == number].mean(axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class _Placing:
    """A cloud over a part; (M,) rows of it, spread evenly, stand for all."""

    surface: PartSurface
    cloud: PointCloud
    errors_known: bool
    rows: IntArray

    @staticmethod
    def of(surface: PartSurface, cloud: PointCloud, errors_known: bool) -> _Placing:
        rows = spread_rows(cloud.points_mm, MOST_POINTS)
        return _Placing(surface, cloud, errors_known, rows)

    def placed(self, pose: Pose[Cad, Part]) -> FloatArray:
        return pose.apply(self.cloud.points_mm[self.rows])

    def measured(self, pose: Pose[Cad, Part]) -> SurfaceDistance:
        return measured(self.surface, self.cloud, pose, self.rows)

    def result(
        self, method: AlignMethod, pose: Pose[Cad, Part], datums: Sequence[_Rows], step: _Step
    ) -> Alignment:
        """What is known of the alignment."""
        centre, radius = middle_and_radius(self.placed(pose))
        source = self.rows[np.concatenate([one.source for one in datums])]
        normals = np.concatenate([one.normals for one in datums])
        residual = np.concatenate([one.residual_mm for one in datums])
        errors = None
        if self.errors_known:
            share = len(self.rows) / max(len(self.cloud), 1)
            errors = PointErrors.of(self.cloud, pose, normals, source, kept_share=share)
        held = 6 - step.left.shape[1]
        placed = pose.apply(self.cloud.points_mm[source])
        covariance, rule = stated_covariance(errors, step.influence, placed, residual, held)
        # a point with two directions, of a line or circle, is no row of its own
        is_single = len(np.unique(source)) == len(source)
        kept = slice(None) if is_single else slice(0, 0)
        return Alignment(
            method=method,
            cad_from_part=pose,
            centre_mm=centre,
            step_covariance=covariance,
            covariance=about_origin(covariance, centre),
            rows=source[kept],
            influence=step.influence[:, kept],
            normals=normals[kept],
            n_used=len(np.unique(source)),
            rms_mm=float(np.sqrt(np.mean(residual**2))),
            sigma_rule=rule,
            free=named_motions(step.left, centre, radius),
            datums=self._uses(datums, step, errors, centre, radius),
        )

    def _uses(
        self,
        datums: Sequence[_Rows],
        step: _Step,
        errors: PointErrors | None,
        centre: FloatArray,
        radius: float,
    ) -> tuple[DatumUse, ...]:
        found, first = [], 0
        total = sum(len(one.source) for one in datums)
        for one, taken in zip(datums, step.taken, strict=True):
            last = first + len(one.source)
            sigma = math.nan
            if errors is not None:
                whole = one.by_source[one.n_turns :]
                own = np.zeros((len(whole), total))
                own[:, first:last] = whole
                sigma = math.sqrt(max(float(np.trace(errors.covariance(own))), 0.0))
            motions = named_motions(taken, centre, radius)
            left = float(np.linalg.norm(one.off_mm[one.n_turns :]))
            points = len(np.unique(one.source))
            found.append(DatumUse(one.name, points, motions, left, sigma))
            first = last
        return tuple(found)


def _stepwise(datums: Sequence[_Rows], centre_mm: FloatArray) -> _Step:
    """Meet datums one after the other; each takes the motions that it holds of those left."""
    n_sources = sum(len(one.source) for one in datums)
    step, left = np.zeros(6), np.eye(6)
    influence, taken_by, first = np.zeros((6, n_sources)), [], 0
    for one in datums:
        last = first + len(one.source)
        taken_by_one = [np.zeros((6, 0))]
        for rows in (slice(0, one.n_turns), slice(one.n_turns, None)):
            by_step = one.jacobian[rows]
            if not len(by_step) or left.shape[1] == 0:
                continue
            held, left = _held(one, by_step, left, centre_mm)
            taken_by_one.append(held)
            gain = np.linalg.pinv(by_step @ held)
            own = -by_step @ influence
            own[:, first:last] += one.by_source[rows]
            step = step - held @ (gain @ (one.off_mm[rows] + by_step @ step))
            influence = influence + held @ (gain @ own)
        taken_by.append(np.concatenate(taken_by_one, axis=1))
        first = last
    return _Step(step, influence, left, tuple(taken_by))


def _held(
    one: _Rows, by_step: FloatArray, left: FloatArray, centre_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(6, H) motions of those left that a datum's rows (R, 6) hold, and the others.

    They are measured by how far they carry the datum's own points, however small it is.
    """
    offset = one.middle_mm - centre_mm
    carried = np.concatenate([left[:3] * one.reach_mm, left[3:] + np.cross(left[:3].T, offset).T])
    basis = left @ np.linalg.inv(np.linalg.qr(carried)[1])
    effect = by_step @ basis
    values, vectors = np.linalg.eigh(effect.T @ effect)
    ways, taken = basis @ vectors, values > DATUM_HOLDS**2
    return ways[:, taken], ways[:, ~taken]


def _face_rows(
    at: _Placing,
    number: int,
    found: SurfaceDistance,
    placed: FloatArray,
    centre: FloatArray,
) -> _Rows | FitFailure:
    """Every point of a face is a row of its own."""
    part = at.surface.part
    own = np.flatnonzero((found.triangle >= 0) & (part.face[found.triangle] == number))
    if len(own) < 3:
        return _unseen(part.face_names[number], len(own))
    d = found.signed_mm[own]
    off = d - np.median(d)
    weights = tukey_weights(off, max(robust_scale(off), SETTLED_MM))
    kept = weights > 0.0
    own, d, weights = own[kept], d[kept], weights[kept]
    normals = part.normals[found.triangle[own]]
    root = np.sqrt(weights / weights.sum())
    jacobian = fit_step(placed[own], normals, weights, centre)[0] * root[:, None]
    # of all distances, what a motion changes: as many rows as the face holds motions
    middle, reach = middle_and_radius(placed[own])
    unit = np.repeat([1.0 / max(reach, SETTLED_MM), 1.0], 3)
    u, size, _ = np.linalg.svd(jacobian * unit, full_matrices=False)
    u = u[:, size > LEAST_EFFECT * size[0]]
    return _Rows(
        name=part.face_names[number],
        off_mm=u.T @ (d * root),
        jacobian=u.T @ jacobian,
        by_source=u.T * root,
        source=own,
        normals=normals,
        residual_mm=d,
        middle_mm=middle,
        reach_mm=max(reach, SETTLED_MM),
    )


def _unseen(name: str, count: int) -> FitFailure:
    return FitFailure(
        f"only {count} points lie on the datum {name}", "give a face or feature that was scanned"
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    """A datum feature as its points have it.

    Parameters
    ----------
    shape
        Fitted, in the cloud's frame.
    source
        (S,) which of the rows were fitted, of lines and circles twice.
    directions, residual_mm
        (S, 3) along which each errs, towards the model's outside, in the cloud's frame; (S,) how
        far each lies off the shape, that way.
    root, turn_root
        (K, K) whose product with its transpose is the normal matrix of the place, sizes free, over
        the count of points; (T, T) the same of the turns, all else free.
    turns
        (T,) which of the place's parameters are turns.
    by_source
        (K, S) of the place's parameters by the sources' errors.
    middle_mm, reach_mm
        Of its points, in the cloud's frame.
    """

    feature: DatumFeature
    shape: Shape
    source: IntArray
    directions: FloatArray
    residual_mm: FloatArray
    root: FloatArray
    turn_root: FloatArray
    turns: IntArray
    by_source: FloatArray
    middle_mm: FloatArray
    reach_mm: float

    def rows(self, pose: Pose[Cad, Part], centre: FloatArray) -> _Rows:
        """How far it is from its nominal place, weighted by what its points say of that."""

        def off(at: Pose[Cad, Part]) -> FloatArray:
            way = _way(_placed(self.shape, at), self.feature.shape)
            return np.concatenate([self.turn_root.T @ way[self.turns], self.root.T @ way])

        steps = np.eye(6) * DIFFERENCE
        slopes = [off(moved(pose, one, centre)) - off(moved(pose, -one, centre)) for one in steps]
        return _Rows(
            name=self.feature.name,
            off_mm=off(pose),
            jacobian=np.stack(slopes, axis=1) / (2.0 * DIFFERENCE),
            # where the fit moves, so much less of the way is left
            by_source=-np.concatenate(
                [self.turn_root.T @ self.by_source[self.turns], self.root.T @ self.by_source]
            ),
            source=self.source,
            normals=pose.rotate(self.directions),
            residual_mm=self.residual_mm,
            middle_mm=pose.apply(self.middle_mm[None])[0],
            reach_mm=self.reach_mm,
            n_turns=len(self.turns),
        )


def _placed(shape: Shape, pose: Pose[Cad, Part] | Pose[Part, Cad]) -> Shape:
    return replace(
        shape, point_mm=pose.apply(shape.point_mm[None])[0], axes=pose.rotate(shape.axes)
    )


def _way(shape: Shape, nominal: Shape) -> FloatArray:
    """(K,) small motions, in the shape's own axes, that carry it onto its nominal place."""
    towards = nominal.turned_to(shape.direction)
    turn = shape.axes @ np.cross(shape.direction, towards.direction)
    offset = nominal.point_mm - shape.point_mm
    if nominal.kind == "plane":
        offset = float(offset @ nominal.direction) * nominal.direction
    elif nominal.kind in ("line", "cylinder", "cone"):
        offset = offset - float(offset @ nominal.direction) * nominal.direction
    shift = shape.axes @ offset
    if nominal.kind == "plane":
        return np.array([shift[2], turn[0], turn[1]])
    if nominal.kind == "sphere":
        return np.asarray(shift)
    if nominal.kind == "circle":
        return np.concatenate([shift, turn[:2]])
    way = np.concatenate([shift[:2], turn[:2]])
    if nominal.kind == "cone":
        # how wide the nominal cone is where the fitted one's points are
        along = float((shape.point_mm - nominal.point_mm) @ nominal.direction)
        wide = nominal.radius_mm + along * math.tan(nominal.half_angle_rad)
        way = np.append(way, wide - shape.radius_mm)
    return way


def _fitted(
    at: _Placing, feature: DatumFeature, found: SurfaceDistance, pose: Pose[Cad, Part]
) -> _Fitted | FitFailure:
    """Fit a datum feature to its points, where a pose puts them."""
    own = np.flatnonzero(_belonging(at, feature, found, pose))
    if len(own) < MIN_POINTS:
        return _unseen(feature.name, len(own))
    points = at.cloud.points_mm[at.rows[own]]
    start = _placed(feature.shape, pose.inverse())
    fit = fit_robustly(points, start, partial(fit_shape, start.kind, start=start))
    if isinstance(fit, FitFailure):
        return FitFailure(f"the datum {feature.name}: {fit.reason}", fit.remedy)
    shape, kept = fit
    if not kept.any():
        return _unseen(feature.name, 0)
    shape, own, points = shape.turned_to(start.direction), own[kept], points[kept]
    linear = linearise(shape, points, with_plane=True)
    source = own[linear.point]
    sign = np.where(
        np.einsum("ni,ni->n", pose.rotate(linear.directions), found.normals[source]) < 0.0,
        -1.0, 1.0,
    )  # fmt: skip
    k = N_PLACE[shape.kind]
    normal = linear.jacobian.T @ linear.jacobian
    place = _without(normal, np.arange(k)) / len(points)
    turns = np.array(TURNS_OF[shape.kind], dtype=np.int64)
    gain = -np.linalg.solve(normal, linear.jacobian.T)[:k]
    middle, reach = middle_and_radius(points)
    return _Fitted(
        feature=feature,
        shape=shape,
        source=source,
        directions=linear.directions * sign[:, None],
        residual_mm=linear.off_mm * sign,
        root=np.asarray(np.linalg.cholesky(place)),
        turn_root=np.asarray(np.linalg.cholesky(_without(place, turns))),
        turns=turns,
        by_source=np.asarray(gain * sign),
        middle_mm=middle,
        reach_mm=reach,
    )


def _without(normal: FloatArray, kept: IntArray) -> FloatArray:
    """(K, K) normal matrix of the parameters kept, all others free."""
    other = np.setdiff1d(np.arange(len(normal)), kept)
    both = normal[np.ix_(kept, other)]
    rest = np.linalg.solve(normal[np.ix_(other, other)], both.T) if len(other) else both.T
    return np.asarray(normal[np.ix_(kept, kept)] - both @ rest)


def _belonging(
    at: _Placing, feature: DatumFeature, found: SurfaceDistance, pose: Pose[Cad, Part]
) -> BoolArray:
    """(M,) which of the rows are points of a datum feature."""
    part, seen = at.surface.part, found.triangle >= 0
    if feature.face >= 0:
        along = np.abs(np.einsum("nk,nk->n", part.normals[found.triangle], found.normals))
        own = seen & (part.face[found.triangle] == feature.face) & (along >= ALONG_FACE)
        if not own.any():
            return np.asarray(own)
        d = found.signed_mm - np.median(found.signed_mm[own])
        scale = max(robust_scale(d[own]), SETTLED_MM)
        return np.asarray(own & (tukey_weights(d, scale) > 0.0))
    placed = at.placed(pose)
    own = np.abs(feature.shape.distance_mm(placed)) <= GIVEN_BAND_MM
    if feature.region is not None:
        own &= feature.region.holds(placed)
    if at.cloud.normals is not None and feature.shape.kind not in ("line", "circle"):
        facing = pose.rotate(at.cloud.normals[at.rows])
        outward = feature.shape.outward(placed)
        own &= np.abs(np.einsum("ni,ni->n", facing, outward)) >= SAME_SIDE
    return np.asarray(own)
