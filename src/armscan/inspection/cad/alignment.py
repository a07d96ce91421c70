# SPDX-License-Identifier: Apache-2.0
"""A cloud laid on the model of its part: the best fit, and what is known of an alignment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from armscan.geometry.arrays import ArrayRecord, FloatArray, IntArray, floats, ints
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import pseudo_inverse
from armscan.geometry.poses import Cad, Part, Pose
from armscan.geometry.rotations import skew, vector_from_rotation
from armscan.inspection.cad.distance import PartSurface, SurfaceDistance
from armscan.inspection.cad.point_errors import PointErrors
from armscan.inspection.cad.search import (
    APART,
    PoseCandidate,
    across_mm,
    closer,
    fit_step,
    is_significant,
    moved,
    robust_scale,
    scale_mismatch,
    search_pose,
    spread_rows,
    tukey_weights,
    unit_mismatch,
)
from armscan.records.cloud import PointCloud

AlignMethod = Literal["best", "none", "321", "features", "points", "markers"]

MOST_POINTS = 50_000
"""Points that the last fit uses, spread evenly: more than a surface has independent places."""
ROUNDS = 30
SETTLED_MM = 1e-7
WEAK = 0.03
"""A motion whose mean squared effect on the distances is below this part of the strongest one's is
tried: does the cloud fit as well when it is moved that way? Facets of a turned part reach 0.003."""
TRIED = (0.03, -0.03)
"""How far it is moved, over the diagonal."""
STAYED = 0.5
"""And the part of that way at which it must stay when it is fitted again."""
FITTING = 0.6
"""Part of the points that must lie near the surface for a cloud to be of this part."""
NEAR = 0.01
"""What near means, over the diagonal: distances of a wrong part are larger."""
WELL_FITTING = 0.98
"""Below this part the mirrored model is tried as well."""
TYPICAL = 0.01
"""Typical (median) distance over the size of cloud or part, the smaller, beyond which it is another
part: what a face of a part made badly may have, and far more than points scatter."""
HOPELESS = 0.2
"""Below this part not even that: another part."""
SPANNED = math.cos(math.radians(0.5)) ** 2
"""Ways that leave a coordinate axis by less than half a degree are called after it."""
MIRRORED = 0.5
"""A mirrored cloud of which fewer than this part of the points lie off is the mirrored part's."""


@dataclass(frozen=True, slots=True, eq=False)
class FreeMotion:
    """A motion of the cloud over the part that its points do not hold.

    ``direction`` (3,) is the axis of a turn, through ``point_mm`` (3,), or the way of a shift, in
    Cad.
    """

    kind: Literal["turn", "shift"]
    direction: FloatArray
    point_mm: FloatArray

    @property
    def text(self) -> str:
        """In words."""
        way = _direction_text(self.direction)
        if self.kind == "shift":
            return f"a shift along {way}"
        place = ", ".join(f"{value + 0.0:.1f}" for value in self.point_mm)
        return f"a turn about {way} through ({place}) mm"


@dataclass(frozen=True, slots=True, eq=False)
class DatumUse:
    """What one datum did for an alignment.

    Parameters
    ----------
    name
        Of the datum.
    n_points
        By which it was measured.
    held
        Motions that it took; of a reference point none, as all hold together.
    left_mm
        How far it stays off its nominal place after the alignment: rms over its points, along
        their normals; of a reference point its distance.
    sigma_mm
        Standard deviation of that before the alignment: how well the datum itself is known; NaN
        where it is not.
    """

    name: str
    n_points: int
    held: tuple[FreeMotion, ...]
    left_mm: float
    sigma_mm: float


class Alignment(ArrayRecord):
    """Where a cloud lies on its part.

    Parameters
    ----------
    method
        How it was found.
    cad_from_part
        The pose.
    centre_mm
        (3,) of the points in Cad; `step_covariance` is about it.
    step_covariance
        (6, 6) of a turn vector in rad about the centre and a shift in mm, both in Cad; free
        motions have none.
    covariance
        (6, 6) the same about the origin of Cad, as `armscan.geometry.registration` orders it.
    rows, influence
        (M,) points that the fit used, and (6, M) by how much a step follows each one's distance;
        none where the alignment does not rest on points of the cloud one by one.
    normals
        (M, 3) directions in Cad along which these points' errors count, towards the outside.
    n_used
        How many points it rests on: of the cloud, or reference points.
    rms_mm
        Alignment rms: root mean square distance of these points, outliers not: from the model, of
        features from the fitted ones, of reference points from their nominal places.
    sigma_rule
        Where the covariance comes from, in words.
    free
        Motions that the points do not hold.
    rivals
        Other poses that fit as well or nearly as well.
    datums
        What it rests on, if not the whole surface.
    notes
        What else a person should know of it, in words.
    """

    method: AlignMethod
    cad_from_part: Pose[Cad, Part]
    centre_mm: FloatArray = floats(3)
    step_covariance: FloatArray = floats(6, 6)
    covariance: FloatArray = floats(6, 6)
    rows: IntArray = ints("M")
    influence: FloatArray = floats(6, "M")
    normals: FloatArray = floats("M", 3)
    n_used: int
    rms_mm: float
    sigma_rule: str
    free: tuple[FreeMotion, ...] = ()
    rivals: tuple[PoseCandidate, ...] = ()
    datums: tuple[DatumUse, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a person should know of it, in words."""
        found = list(self.notes)
        if self.free:
            found.append(
                "the points do not hold "
                + free_text(self.free)
                + ": deviations along these motions cannot be seen"
            )
        equal = sum(one.is_equal for one in self.rivals)
        if equal:
            found.append(
                f"other poses fit equally well ({equal} found): the part is symmetric, or the scan "
                "shows too little of it; faces may be taken for each other"
            )
        elif self.rivals:
            ratio = math.sqrt(self.rivals[0].cost)
            found.append(
                f"another pose fits nearly as well ({ratio:.2f} times the scatter): check that the "
                "right faces lie on each other"
            )
        return tuple(found)


def free_text(free: Sequence[FreeMotion], joint: str = " nor ") -> str:
    """Motions in words; three turns are every turn about a point."""
    turns = [motion for motion in free if motion.kind == "turn"]
    texts = [motion.text for motion in free]
    if len(turns) == 3:
        place = ", ".join(f"{value + 0.0:.1f}" for value in turns[0].point_mm)
        texts = [f"any turn about ({place}) mm"]
        texts += [motion.text for motion in free if motion.kind == "shift"]
    return joint.join(texts)


def held_text(held: Sequence[FreeMotion]) -> str:
    """Ways of motions in few words, as "turns about X, Y; shift along Z"; empty for none."""
    texts = []
    for kind, word in (("turn", "about"), ("shift", "along")):
        ways = np.array([one.direction for one in held if one.kind == kind]).reshape(-1, 3)
        if len(ways) == 0:
            continue
        span = np.linalg.pinv(ways) @ ways
        names = [name for k, name in enumerate("XYZ") if span[k, k] > SPANNED]
        if len(names) != len(ways):
            names = [_direction_text(one) for one in ways]
        plural = "s" if len(ways) > 1 else ""
        texts.append(f"{kind}{plural} {word} {', '.join(names)}")
    return "; ".join(texts)


def align_best(
    surface: PartSurface, cloud: PointCloud, errors_known: bool
) -> Alignment | FitFailure:
    """Lay a cloud on its part without a guess, then fit it as well as it can be.

    Robust point to surface: Gauss-Newton on the signed distances, weighted by the points' own
    covariances along the normal and by what else scatters, with Tukey's biweight.

    ``errors_known``: true if the cloud's covariances are to be used.

    Returns
    -------
    Alignment
        Of method ``best``.
    FitFailure
        If the cloud is of another part or of a mirrored one, in another unit, or too small.
    """
    failure = scale_mismatch(surface, cloud.points_mm)
    if failure is not None:
        return failure
    found = search_pose(surface, cloud.points_mm, cloud.normals)
    failure = unit_mismatch(surface, cloud, found[0])
    if failure is None:
        failure = _foreign(surface, cloud, found[0])
    if failure is not None:
        return failure
    best = fit_to_part(surface, cloud, found[0].cad_from_part, errors_known)
    rivals = tuple(one for one in found[1:] if not _along_free(best, one, cloud, surface))
    return replace(best, rivals=rivals)


def align_none(cloud: PointCloud) -> Alignment:
    """Take the cloud's frame for that of the part."""
    return Alignment(
        method="none",
        cad_from_part=Pose(np.eye(3), np.zeros(3)),
        centre_mm=cloud.points_mm.mean(axis=0) if len(cloud) else np.zeros(3),
        step_covariance=np.zeros((6, 6)),
        covariance=np.zeros((6, 6)),
        rows=np.zeros(0, dtype=np.int64),
        influence=np.zeros((6, 0)),
        normals=np.zeros((0, 3)),
        n_used=0,
        rms_mm=math.nan,
        sigma_rule="none: the cloud's frame is taken for that of the part, without error",
    )


def measured(
    surface: PartSurface, cloud: PointCloud, pose: Pose[Cad, Part], rows: IntArray | None = None
) -> SurfaceDistance:
    """Distances of a cloud's points, or of some rows, where a pose puts them."""
    chosen = slice(None) if rows is None else rows
    towards = None if cloud.normals is None else pose.rotate(cloud.normals[chosen])
    sight = None if towards is None else sight_of(cloud, pose, rows)
    return surface.distance(pose.apply(cloud.points_mm[chosen]), towards=towards, sight=sight)


def sight_of(
    cloud: PointCloud, pose: Pose[Cad, Part], rows: IntArray | None = None
) -> FloatArray | None:
    """(M, 3) unit directions in Cad to where points, or rows, were seen from; None if unknown."""
    if cloud.seen_from_mm is None or cloud.is_fused:
        return None
    chosen = slice(None) if rows is None else rows
    way = pose.rotate(cloud.seen_from_mm[cloud.exposure[chosen]] - cloud.points_mm[chosen])
    return np.asarray(way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12))


def _foreign(surface: PartSurface, cloud: PointCloud, best: PoseCandidate) -> FitFailure | None:
    """Notice a cloud of another part, or of the mirrored one."""
    rows = spread_rows(cloud.points_mm, MOST_POINTS)
    d = np.abs(measured(surface, cloud, best.cad_from_part, rows).signed_mm)
    noise = float(np.median(cloud.sigma_mm[rows]))
    near = max(NEAR * surface.diagonal_mm, 5.0 * noise)
    share = float((d <= near).mean())
    typical, size = float(np.median(d)), min(across_mm(cloud.points_mm), surface.diagonal_mm)
    is_off = typical > max(TYPICAL * size, 5.0 * noise)
    is_near = share >= WELL_FITTING and best.scale_mm <= max(0.25 * near, 3.0 * noise)
    if is_near and not is_off:
        return None
    if share > HOPELESS:
        failure = _mirrored(surface, cloud, rows, near, 1.0 - share)
        if failure is not None:
            return failure
    if is_off:
        return FitFailure(
            f"the cloud does not fit the model: its points lie {typical:.3g} mm off it (median), "
            f"wherever it is laid, and it measures {size:.4g} mm",
            "give the model of this part, and look at its unit and the cloud's",
        )
    if share >= FITTING:
        return None
    return FitFailure(
        f"the cloud does not fit the model: only {100 * share:.0f} % of its points come within "
        f"{near:.3g} mm, wherever it is laid",
        "give the model of this part, or cut table and fixtures away with --region",
    )


def _mirrored(
    surface: PartSurface, cloud: PointCloud, rows: IntArray, near: float, off: float
) -> FitFailure | None:
    """Notice a cloud that fits the mirrored model; ``off`` of its points lie off the model."""
    mirror = np.array([-1.0, 1.0, 1.0])
    normals = None if cloud.normals is None else cloud.normals * mirror
    turned = search_pose(surface, cloud.points_mm * mirror, normals)[0]
    mirrored = surface.distance(turned.cad_from_part.apply(cloud.points_mm[rows] * mirror))
    off_mirrored = float((np.abs(mirrored.signed_mm) > near).mean())
    if off_mirrored < MIRRORED * off and off - off_mirrored > 1.0 - WELL_FITTING:
        return FitFailure(
            f"the cloud fits the model's mirror image: {100 * off:.0f} % of its points lie farther "
            f"than {near:.3g} mm off the model, {100 * off_mirrored:.0f} % off its mirror image",
            "give the model of this hand of the part, or look whether the scan is mirrored",
        )
    return None


def fit_to_part(
    surface: PartSurface, cloud: PointCloud, pose: Pose[Cad, Part], errors_known: bool
) -> Alignment:
    """Fit a cloud that lies nearly right: the robust fit of `align_best` without its search.

    ``pose``: where the cloud lies, to a few hundredths of the part's size.
    """
    rows = spread_rows(cloud.points_mm, MOST_POINTS)
    normals = None if cloud.normals is None else cloud.normals[rows]
    pose = closer(surface, cloud.points_mm[rows], normals, pose, 3)
    basis, motions = _free_motions(surface, cloud, pose)
    for _ in range(ROUNDS):
        found = measured(surface, cloud, pose, rows)
        placed, d = pose.apply(cloud.points_mm[rows]), found.signed_mm
        centre, radius = middle_and_radius(placed)
        sigma = _fit_sigma(cloud, rows, pose, found)
        weights = tukey_weights(d / sigma, 1.0) / sigma**2
        jacobian, normal = fit_step(placed, found.normals, weights, centre)
        inverse = _inverse(normal, radius, basis)
        influence = inverse @ (jacobian * weights[:, None]).T
        step = -influence @ d
        pose = moved(pose, step, centre)
        if np.abs(step[3:]).max() + radius * np.abs(step[:3]).max() < SETTLED_MM:
            break
    used = weights > 0.0
    held = 6 - len(motions)
    errors = PointErrors.of(cloud, pose, found.normals, rows) if errors_known else None
    covariance, rule = stated_covariance(errors, influence, placed, d, held)
    return Alignment(
        method="best",
        cad_from_part=pose,
        centre_mm=centre,
        step_covariance=covariance,
        covariance=about_origin(covariance, centre),
        rows=rows[used],
        influence=influence[:, used],
        normals=found.normals[used],
        n_used=int(used.sum()),
        rms_mm=float(np.sqrt(np.mean(d[used] ** 2))),
        sigma_rule=rule,
        free=motions,
    )


def _fit_sigma(
    cloud: PointCloud, rows: IntArray, pose: Pose[Cad, Part], found: SurfaceDistance
) -> FloatArray:
    """(M,) standard deviation of each distance: the point's own, and what scatters beyond it."""
    covariance = pose.rotate_covariance(cloud.covariance_mm2[rows])
    own = np.einsum("ni,nij,nj->n", found.normals, covariance, found.normals)
    scale = max(robust_scale(found.signed_mm), SETTLED_MM)
    rest = max(scale**2 - float(np.median(own)), 0.0)
    return np.asarray(np.sqrt(np.maximum(own + rest, (0.1 * scale) ** 2)))


def middle_and_radius(placed: FloatArray) -> tuple[FloatArray, float]:
    """(3,) mean of points (N, 3), and their root mean square distance from it."""
    centre = placed.mean(axis=0)
    return centre, float(np.sqrt(np.mean(np.sum((placed - centre) ** 2, axis=1))))


def _inverse(normal: FloatArray, radius: float, basis: FloatArray) -> FloatArray:
    """(6, 6) inverse of the normal matrix in the motions that are held; basis (6, K), scaled."""
    unit = np.repeat([1.0 / radius, 1.0], 3)
    scaled = basis.T @ (normal * np.outer(unit, unit)) @ basis
    inside = basis @ pseudo_inverse(scaled, 1e-14) @ basis.T
    return np.asarray(inside * np.outer(unit, unit))


def about_origin(covariance: FloatArray, centre: FloatArray) -> FloatArray:
    """A step about a centre turned into one about the origin: the shift gains ``centre x turn``."""
    change = np.eye(6)
    change[3:, :3] = skew(centre[None])[0]
    return np.asarray(change @ covariance @ change.T)


def stated_covariance(
    errors: PointErrors | None,
    influence: FloatArray,
    placed: FloatArray,
    d: FloatArray,
    held: int,
) -> tuple[FloatArray, str]:
    """(6, 6) covariance of a step, and where it comes from, in words."""
    if errors is None:
        return _scatter_covariance(placed, influence, d, held), (
            "from the scatter of the distances between regions of the part: the cloud's standard "
            "deviations are not known, or not used"
        )
    return errors.covariance(influence), (
        "from the points' covariances: the stripes' noise point by point, the rest common to an "
        "exposure, or to a block of neighbouring ones (the larger)"
    )


def _scatter_covariance(
    placed: FloatArray, influence: FloatArray, d: FloatArray, held: int
) -> FloatArray:
    """Sandwich over regions of the part: what they disagree about, neighbours erring together."""
    low, extent = placed.min(axis=0), np.maximum(np.ptp(placed, axis=0), 1e-9)
    cells = np.minimum((6.0 * (placed - low) / extent).astype(np.int64), 5)
    block = np.unique(cells @ np.array([36, 6, 1]), return_inverse=True)[1]
    n = int(block.max()) + 1
    finite = np.where(np.isfinite(d), d, 0.0)
    sums = np.stack([np.bincount(block, row * finite, n) for row in influence])
    return np.asarray(sums @ sums.T * (n / max(1, n - held)))


def _free_motions(
    surface: PartSurface, cloud: PointCloud, pose: Pose[Cad, Part]
) -> tuple[FloatArray, tuple[FreeMotion, ...]]:
    """(6, K) basis of the motions that are held, scaled, and those that are not.

    A motion of little effect on the distances is made, one way and the other, and the fit repeated:
    if the cloud stays where it was put and fits as well, nothing holds it. One way is enough: a
    patch of a plate may lie at its rim.
    """
    rows = spread_rows(cloud.points_mm, 3000, seed=2)
    points = cloud.points_mm[rows]
    normals = None if cloud.normals is None else cloud.normals[rows]
    found = measured(surface, cloud, pose, rows)
    placed = pose.apply(points)
    centre, radius = middle_and_radius(placed)
    scale = max(robust_scale(found.signed_mm), 1e-7 * surface.diagonal_mm)
    weights = tukey_weights(found.signed_mm, scale)
    normal = fit_step(placed, found.normals, weights, centre)[1]
    unit = np.repeat([1.0 / radius, 1.0], 3)
    values, vectors = np.linalg.eigh(normal * np.outer(unit, unit))
    free = []
    for k in np.flatnonzero(values < WEAK * values[-1]).tolist():
        for way in TRIED:
            twist = vectors[:, k] * unit * way * surface.diagonal_mm
            put = screwed(pose, twist, centre)
            again = closer(surface, points, normals, put, 4)
            kept = np.linalg.norm(again.apply(points) - placed, axis=1).mean()
            wanted = np.linalg.norm(put.apply(points) - placed, axis=1).mean()
            d = measured(surface, cloud, again, rows).signed_mm
            if kept >= STAYED * wanted and not is_significant(d, found.signed_mm, scale):
                free.append(k)
                break
    held = np.setdiff1d(np.arange(6), free)
    return vectors[:, held], named_motions(vectors[:, free] * unit[:, None], centre, radius)


def screwed(pose: Pose[Cad, Part], twist: FloatArray, centre: FloatArray) -> Pose[Cad, Part]:
    """The pose after a screw motion (6,): a finite turn about an axis of its own, not a chord."""
    angle = float(np.linalg.norm(twist[:3]))
    if angle < 1e-12:
        return moved(pose, twist, centre)
    cross = skew(twist[None, :3])[0]
    bent = (
        np.eye(3)
        + (1.0 - math.cos(angle)) / angle**2 * cross
        + (angle - math.sin(angle)) / angle**3 * cross @ cross
    )
    return moved(pose, np.concatenate([twist[:3], bent @ twist[3:]]), centre)


def named_motions(free: FloatArray, centre: FloatArray, radius: float) -> tuple[FreeMotion, ...]:
    """Turns and shifts that span free motions (6, K): rows a turn vector and a shift at a centre.

    As many turns as the turn vectors span, each with its axis; what is left are shifts.
    """
    if free.shape[1] == 0:
        return ()
    basis = np.linalg.qr(free * np.repeat([radius, 1.0], 3)[:, None])[0]
    _, size, vt = np.linalg.svd(basis[:3])
    turns = int((size > 0.2).sum())
    motions = []
    combined = basis @ vt.T
    pure = combined[:, turns:]
    for k in range(turns):
        turn, shift = combined[:3, k] / radius, combined[3:, k]
        shift = shift - pure[3:] @ (pure[3:].T @ shift)
        axis = turn / np.linalg.norm(turn)
        point = centre + np.cross(turn, shift) / float(turn @ turn)
        motions.append(FreeMotion("turn", _upright(axis), point))
    for k in range(pure.shape[1]):
        way = pure[3:, k] / np.linalg.norm(pure[3:, k])
        motions.append(FreeMotion("shift", _upright(way), centre))
    return tuple(motions)


def _upright(direction: FloatArray) -> FloatArray:
    """The one of two opposite directions whose largest part is positive."""
    return direction if direction[np.argmax(np.abs(direction))] > 0.0 else -direction


def _direction_text(direction: FloatArray) -> str:
    for k, name in enumerate("XYZ"):
        if abs(float(direction[k])) > math.cos(math.radians(0.5)):
            return name
    return "(" + ", ".join(f"{value + 0.0:.3f}" for value in direction) + ")"


def _along_free(
    best: Alignment, other: PoseCandidate, cloud: PointCloud, surface: PartSurface
) -> bool:
    """Whether another pose is the best one, moved along what is free: no rival, the same family."""
    if not best.free:
        return False
    between = other.cad_from_part @ best.cad_from_part.inverse()
    centre, radius = best.centre_mm, surface.diagonal_mm / 2.0
    turn = vector_from_rotation(between.rotation)
    shift = between.apply(centre) - centre
    rows = np.concatenate([turn * radius, shift])
    spanned = []
    for motion in best.free:
        if motion.kind == "shift":
            spanned.append(np.concatenate([np.zeros(3), motion.direction]))
        else:
            spanned.append(np.concatenate([motion.direction, np.zeros(3)]))
            arm = np.cross(motion.direction, centre - motion.point_mm)
            across = np.cross(motion.direction, arm)
            # a finite turn carries the centre round the axis: both ways of that circle are allowed
            spanned += [np.concatenate([np.zeros(3), v]) for v in (arm, across) if v.any()]
    q = np.linalg.qr(np.array(spanned).T)[0]
    return float(np.linalg.norm(rows - q @ (q.T @ rows))) < APART * surface.diagonal_mm
