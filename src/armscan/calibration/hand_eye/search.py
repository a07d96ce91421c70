# SPDX-License-Identifier: Apache-2.0
"""Starts of the hand-eye from everywhere: none near the solution has to be guessed.

For a given rotation of the sensor, what else is unknown (the shift, a sphere's centre) follows from
linear equations. Rotations that cover all orientations evenly, each completed so and descended from
by a few damped Gauss-Newton steps, end in all minima of any size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.observations import CircleSection, CondensedObservations
from armscan.calibration.hand_eye.surface import (
    HandEyeState,
    PlateSurface,
    ReferenceSurface,
    SphereSurface,
)
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, homogeneous
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.rotations import nearest_rotation
from armscan.geometry.shapes import Plane

_SQRT_2 = float(np.sqrt(2.0))
_PSI = 1.533751168755204288118041
"""Positive root of psi^4 = psi + 4."""
N_ON_PLATE, N_ON_SPHERE = 240, 200
"""Rotations to start from; on a sphere each thrice, for the sides of the sheets."""
N_STEPS_ON_PLATE, N_APART, N_FURTHER = 88, 40, 200
"""Steps of every start: where postures are nearly parallel, most of those that are best after a few
are on their way down one long valley, and another minimum would be lost. And how many different
ends go on by how many more, for some are in that valley still."""
N_FIRST, N_LAST, N_GO_ON_SPHERE = 8, 40, 60
"""On a sphere: steps of every start, of the best of them, and how many these are."""
N_DESCENT = 25
N_MINIMA = 12
SAME_RAD = float(np.radians(1.0))
APART_ON_SPHERE_RAD = 0.05
MOST_STRIPES = 60
"""Of a long scan, so many stripes are searched with, evenly spread."""
N_SUBSETS, SUBSET_SIZE = 120, 6
LEAST_FOR_SUBSETS = 8
"""With fewer postures no majority of them can tell a wrong one."""
ALIKE_RATIO, ALIKE_MM = 3.0, 0.02
"""Minima that leave less than this, or than so many times the least, may be the right one."""
MIXED = 0.05
"""Share of the stripes that wrong poses may put on another side of the plate than the rest."""
GROSS_RATIO, GROSS_MM = 8.0, 0.05
"""A posture is wrong if its distance from the plate exceeds both the latter and so many times the
median of all."""
FAR_MM = 1.0
FLAT_RATIO = 0.02
"""Extent of the points off their best plane over that within it, below which they have no more
than nine unknowns to offer: a bow is not a third dimension."""
RANK_RATIO = 1e-3
POINTS_OF_SECTION = 7
OPEN_RATIO = 1e-4
"""Singular values of the linear equations below this part of the largest are taken as zero."""

STILL = 1e-9
"""A step that moves residuals by less than about so many mm is none."""
_TURNS = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
     [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], dtype=np.float64,
)  # fmt: skip
"""(3, 3, 3) derivative of a rotation at none, by its vector."""

ManyPlaced = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""From K rotations (K, 3, 3) and K further unknowns (K, U) to residuals (K, N) and their
derivatives (K, N, 3 + U) by a turn on the left and by these unknowns: shift, then surface."""


def rotations_all_over(count: int) -> FloatArray:
    """(count, 3, 3) rotations that cover all orientations evenly.

    Super-Fibonacci spirals: Alexa, "Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of
    SO(3)", CVPR 2022.
    """
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    alpha, beta = 2.0 * np.pi * s / _SQRT_2, 2.0 * np.pi * s / _PSI
    quaternions = np.column_stack(
        [inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)]
    )
    return np.asarray(Rotation.from_quat(quaternions).as_matrix())


def many_placed(
    points_mm: FloatArray,
    rotations: FloatArray,
    translations_mm: FloatArray,
    surface: ReferenceSurface,
) -> ManyPlaced:
    """Distances of points (N, 3) in Sensor from the surface for many states at once.

    ``base_from_tool`` of each is (N, 3, 3) and (N, 3). Of the surface's parameters the first are
    unknown, as many as there are further unknowns.
    """

    def place(turns: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
        turned = points_mm @ turns.transpose(0, 2, 1)
        in_tool = turned + others[:, None, :3]
        base = np.einsum("nij,knj->kni", rotations, in_tool) + translations_mm
        n_free = others.shape[1] - 3
        held = np.broadcast_to(surface.start[n_free:], (len(turns), len(surface.start) - n_free))
        parameters = np.concatenate([others[:, 3:], held], axis=1)
        residual, normals, by_surface = surface.distance(base, parameters)
        in_tool_normals = np.einsum("nij,kni->knj", rotations, normals)
        by_turn = np.cross(turned, in_tool_normals)
        return residual, np.concatenate(
            [by_turn, in_tool_normals, by_surface[..., :n_free]], axis=2
        )

    return place


def placed_on_plate(
    points_mm: FloatArray, normals: FloatArray, constants: FloatArray
) -> ManyPlaced:
    """As `many_placed` on a plate, for less: sums of squares are those of the distances.

    A distance is linear in the 12 entries of rotation and shift. However many there are, 13
    combinations of them, the rows of a QR factor, have their sum of squares for every state.

    Parameters
    ----------
    points_mm
        (N, 3) in the Sensor frame, or (K, N, 3) of each of the K states its own.
    normals, constants
        (N, 3) and (N,) of the plate in Tool (`plate_in_tool`), or (K, N, 3) and (K, N).
    """
    rows = (normals[..., :, None] * points_mm[..., None, :]).reshape(*points_mm.shape[:-1], 9)
    table = np.concatenate([rows, normals, constants[..., None]], axis=-1)
    factor = np.asarray(np.linalg.qr(table, mode="r"))
    by_rotation, by_shift = factor[..., :9], factor[..., 9:12]

    def place(turns: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
        entries = np.concatenate([turns.reshape(-1, 9), others, np.ones((len(turns), 1))], axis=1)
        turned = np.einsum("aij,kjl->kila", _TURNS, turns).reshape(-1, 9, 3)
        by_turn = by_rotation @ turned
        return (
            (factor @ entries[:, :, None])[..., 0],
            np.concatenate([by_turn, np.broadcast_to(by_shift, by_turn.shape)], axis=2),
        )

    return place


def unit_steps(points_mm: FloatArray, n_others: int) -> FloatArray:
    """(3 + U,) steps of turn, shift and surface that move the residuals alike."""
    size = float(np.sqrt((points_mm**2).sum(axis=1).mean()))
    return np.array([1.0 / size] * 3 + [1.0] * n_others)


def descend_all(
    place: ManyPlaced,
    rotations: FloatArray,
    others: FloatArray,
    n_steps: int,
    scale: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Damped Gauss-Newton from many starts at once: rotations (K, 3, 3) and others (K, U).

    ``scale`` (3 + U,) is of `unit_steps`, or (K, 3 + U). Returns both after the steps, and the sums
    of squared residuals (K,).
    """
    residual, jacobian = place(rotations, others)
    cost = (residual**2).sum(axis=1)
    damping = np.full(len(rotations), 1e-3)
    n_unknown = scale.shape[-1]
    diagonal = np.eye(n_unknown)
    for _ in range(n_steps):
        scaled = jacobian * scale[..., None, :]
        matrix = scaled.transpose(0, 2, 1) @ scaled
        mean = np.einsum("kii->k", matrix) / n_unknown
        matrix += (damping * mean + 1e-12)[:, None, None] * diagonal
        gradient = np.einsum("kni,kn->ki", scaled, residual)
        step = -np.linalg.solve(matrix, gradient[:, :, None])[:, :, 0]
        if float(np.abs(step).max()) < STILL:
            break
        step *= scale
        tried = Rotation.from_rotvec(step[:, :3]).as_matrix() @ rotations
        moved = others + step[:, 3:]
        tried_residual, tried_jacobian = place(tried, moved)
        tried_cost = (tried_residual**2).sum(axis=1)
        better = tried_cost < cost
        rotations = np.where(better[:, None, None], tried, rotations)
        others = np.where(better[:, None], moved, others)
        residual = np.where(better[:, None], tried_residual, residual)
        jacobian = np.where(better[:, None, None], tried_jacobian, jacobian)
        cost = np.where(better, tried_cost, cost)
        damping = np.clip(np.where(better, 0.1 * damping, 10.0 * damping), 1e-12, 1e6)
    u, _, vt = np.linalg.svd(rotations)
    return np.asarray(u @ vt), others, cost


def distinct(rotations: FloatArray, cost: FloatArray, apart_rad: float, count: int) -> IntArray:
    """Numbers of the ``count`` least costly of (K, 3, 3) rotations that differ from each other."""
    kept: list[int] = []
    for k in np.argsort(cost, kind="stable"):
        traces = np.einsum("nij,ij->n", rotations[kept], rotations[k])
        if (traces < 1.0 + 2.0 * np.cos(apart_rad)).all():
            kept.append(int(k))
        if len(kept) == count:
            break
    return np.array(kept, dtype=np.int64)


def turn_between_rad(one: Pose[Tool, Sensor], other: Pose[Tool, Sensor]) -> float:
    """Angle between two hand-eyes."""
    cosine = 0.5 * (float((one.rotation * other.rotation).sum()) - 1.0)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where the estimate on a plate begins.

    Beside the start: the linear solution, where it exists; (n postures,) distance of each posture's
    points from the plate, NaN where it has none, and whether the others contradict it; other minima
    that leave little more, least first.
    """

    tool_from_sensor: Pose[Tool, Sensor]
    linear: Pose[Tool, Sensor] | None
    rms_mm: FloatArray
    is_wrong: BoolArray
    alternatives: tuple[Pose[Tool, Sensor], ...] = ()

    @property
    def typical_mm(self) -> float:
        """Median over postures of their distance from the plate."""
        return float(np.nanmedian(self.rms_mm))


def find_start(observations: CondensedObservations, plate: PlateSurface) -> Start:
    """Find the hand-eye with the least median distance of the postures from the plate.

    Of all minima of the sum of squares: those that descents from all over the rotations end in,
    that of the linear solution, and, where a posture is wrong, those of subsets of the postures.
    """
    linear = linear_hand_eye(observations, plate.plane)
    candidates = list(minima_on_plate(observations, plate))
    if linear is not None:
        candidates.append(_descend(observations, plate, linear))
    used = observations.used_postures
    is_many = len(used) >= LEAST_FOR_SUBSETS
    if is_many and _has_wrong(posture_rms_at(observations, plate, candidates[0])):
        candidates += _from_subsets(observations, plate, used)
    candidates, costs = _possible(observations, plate, candidates, is_robust=is_many)
    best = candidates[int(np.argmin(costs))]
    wrong = np.zeros(len(observations.postures), dtype=np.bool_)
    for _ in range(3 if is_many else 0):
        wrong = _are_gross(posture_rms_at(observations, plate, best))
        best = _descend(observations.select(~wrong[observations.posture]), plate, best)
    rms = posture_rms_at(observations, plate, best)
    if is_many:
        wrong = _are_gross(rms)
    return Start(
        tool_from_sensor=best,
        linear=linear,
        rms_mm=rms,
        is_wrong=wrong,
        alternatives=_alternatives(candidates, costs, best),
    )


def _possible(
    observations: CondensedObservations,
    plate: PlateSurface,
    candidates: list[Pose[Tool, Sensor]],
    *,
    is_robust: bool,
) -> tuple[list[Pose[Tool, Sensor]], FloatArray]:
    """Hand-eyes that a camera can have, and the typical distance (mm) that each leaves.

    A camera does not pass through the plate. Where all stripes pass one point of the sheet, a
    hand-eye turned by half a turn explains them as well as the true one, but puts the camera now
    before the plate and now behind it. One that stays behind counts only where none before the
    plate will do: the plate's normal may have the wrong sign.
    """
    rms = np.array([posture_rms_at(observations, plate, pose) for pose in candidates])
    costs = np.nanmedian(rms, axis=1) if is_robust else np.sqrt(np.nanmean(rms**2, axis=1))
    heights = [camera_heights_mm(observations, plate.plane, pose) for pose in candidates]
    behind = np.array([(height < 0.0).mean() for height in heights])
    limit = _limit_mm(costs)
    for kept in (behind <= MIXED, (behind <= MIXED) | (behind >= 1.0 - MIXED)):
        if (costs[kept] <= limit).any():
            return [candidates[k] for k in np.flatnonzero(kept)], costs[kept]
    return candidates, costs


def camera_heights_mm(
    observations: CondensedObservations, plane: Plane, pose: Pose[Tool, Sensor]
) -> FloatArray:
    """(S,) distance of the camera from the plate in each exposure."""
    places = observations.rotations @ pose.translation_mm + observations.translations_mm
    return plane.distance_mm(places)


def _limit_mm(costs: FloatArray) -> float:
    return max(ALIKE_RATIO * float(costs.min()), ALIKE_MM)


def _alternatives(
    candidates: list[Pose[Tool, Sensor]], costs: FloatArray, best: Pose[Tool, Sensor]
) -> tuple[Pose[Tool, Sensor], ...]:
    rotations = np.array([best.rotation] + [pose.rotation for pose in candidates])
    first = np.concatenate([[-1.0], np.where(costs <= _limit_mm(costs), costs, np.inf)])
    kept = distinct(rotations, first, SAME_RAD, N_MINIMA)
    return tuple(candidates[k - 1] for k in kept if k > 0 and np.isfinite(first[k]))


def minima_on_plate(
    observations: CondensedObservations, plate: PlateSurface
) -> tuple[Pose[Tool, Sensor], ...]:
    """Distinct minima of the plain sum of squares, least first."""
    few = thinned(observations)
    rotations = rotations_all_over(N_ON_PLATE)
    normals, constants = plate_in_tool(few, plate.plane)
    turned = np.einsum("kij,nj->kni", rotations, few.points_mm)
    heights = np.einsum("kni,ni->kn", turned, normals) + constants
    shifts = np.asarray(-heights @ np.linalg.pinv(normals, rcond=1e-6).T)
    scale = unit_steps(few.points_mm, 3)
    place = placed_on_plate(few.points_mm, normals, constants)
    rotations, shifts, cost = descend_all(place, rotations, shifts, N_STEPS_ON_PLATE, scale)
    apart = distinct(rotations, cost, SAME_RAD, N_APART)
    rotations, shifts, cost = descend_all(place, rotations[apart], shifts[apart], N_FURTHER, scale)
    kept = distinct(rotations, cost, SAME_RAD, N_MINIMA)
    return tuple(Pose(rotations[k], shifts[k]) for k in kept)


def posture_rms(observations: CondensedObservations, residual_mm: FloatArray) -> FloatArray:
    """Root mean square residual of each posture, NaN for those without observations."""
    posture, n = observations.posture, len(observations.postures)
    counts = np.bincount(posture, minlength=n).astype(np.float64)
    counts[counts == 0.0] = np.nan
    return np.sqrt(np.bincount(posture, weights=residual_mm**2, minlength=n) / counts)


def posture_rms_at(
    observations: CondensedObservations, plate: PlateSurface, pose: Pose[Tool, Sensor]
) -> FloatArray:
    """(n postures,) distance of each posture's points from the plate with a hand-eye."""
    normals, constants = plate_in_tool(observations, plate.plane)
    heights = np.einsum("ni,ni->n", pose.apply(observations.points_mm), normals) + constants
    return posture_rms(observations, heights)


def _are_gross(rms: FloatArray) -> BoolArray:
    return np.asarray(rms > max(GROSS_MM, GROSS_RATIO * float(np.nanmedian(rms))))


def _has_wrong(rms: FloatArray) -> bool:
    """True where a posture stands out, or all are far: a grossly wrong one moves all others."""
    largest, typical = float(np.nanmax(rms)), float(np.nanmedian(rms))
    return largest > max(GROSS_MM, min(0.5 * GROSS_RATIO * typical, FAR_MM))


def _from_subsets(
    observations: CondensedObservations, plate: PlateSurface, used: IntArray
) -> list[Pose[Tool, Sensor]]:
    """Solutions of random subsets of postures, the best few of them.

    All descend at once: rows of a subset that has fewer than another are repeated without weight.
    """
    few, random = three_a_stripe(observations), np.random.default_rng(0)
    normals, constants = plate_in_tool(few, plate.plane)
    starts: list[Pose[Tool, Sensor]] = []
    subsets: list[IntArray] = []
    for _ in range(N_SUBSETS):
        rows = np.flatnonzero(np.isin(few.posture, random.choice(used, SUBSET_SIZE, replace=False)))
        pose = _linear(few.points_mm[rows], normals[rows], constants[rows])
        if pose is not None:
            starts.append(pose)
            subsets.append(rows)
    if not starts:
        return []
    counts = np.array([len(rows) for rows in subsets])
    width = int(counts.max())
    kept = np.arange(width) < counts[:, None]
    filled = np.array([np.resize(rows, width) for rows in subsets])
    rotations, shifts, _ = descend_all(
        placed_on_plate(
            few.points_mm[filled], normals[filled] * kept[..., None], constants[filled] * kept
        ),
        np.array([pose.rotation for pose in starts]),
        np.array([pose.translation_mm for pose in starts]),
        4,
        np.array([unit_steps(few.points_mm[rows], 3) for rows in subsets]),
    )
    found: list[Pose[Tool, Sensor]] = [Pose(*one) for one in zip(rotations, shifts, strict=True)]
    typical = [np.nanmedian(posture_rms_at(few, plate, pose)) for pose in found]
    return [found[k] for k in np.argsort(typical, kind="stable")[:3]]


def thinned(observations: CondensedObservations) -> CondensedObservations:
    """Three observations a stripe of `evenly_spread` exposures."""
    return evenly_spread(three_a_stripe(observations))


def evenly_spread(observations: CondensedObservations) -> CondensedObservations:
    """All observations of at most `MOST_STRIPES` exposures, evenly spread."""
    used = np.unique(observations.stripe)
    if len(used) <= MOST_STRIPES:
        return observations
    chosen = used[np.linspace(0, len(used) - 1, MOST_STRIPES).round().astype(np.int64)]
    return observations.select(np.isin(observations.stripe, chosen))


def three_a_stripe(observations: CondensedObservations) -> CondensedObservations:
    """First, middle and last observation of every stripe."""
    labels = np.column_stack([observations.stripe, observations.sheet])
    line = np.unique(labels, axis=0, return_inverse=True)[1]
    kept = np.zeros(len(observations), dtype=np.bool_)
    for number in range(int(line.max()) + 1):
        rows = np.flatnonzero(line == number)
        kept[rows[[0, len(rows) // 2, -1]]] = True
    return observations.select(kept)


def _descend(
    observations: CondensedObservations,
    plate: PlateSurface,
    pose: Pose[Tool, Sensor],
) -> Pose[Tool, Sensor]:
    """Plain least squares of eq. 2.76 over six parameters."""
    rotations, shifts, _ = descend_all(
        placed_on_plate(observations.points_mm, *plate_in_tool(observations, plate.plane)),
        pose.rotation[None],
        pose.translation_mm[None],
        N_DESCENT,
        unit_steps(observations.points_mm, 3),
    )
    return Pose(rotations[0], shifts[0])


def linear_hand_eye(
    observations: CondensedObservations, plane: Plane, *, is_offset_free: bool = False
) -> Pose[Tool, Sensor] | None:
    """Solve eq. 2.72 for the unknowns that the points determine, in the sheet's own coordinates.

    Points of one sheet are ``p = c + u a + v b`` on the sheet's best plane, so that eq. 2.72
    becomes linear in the nine unknowns ``R a``, ``R b`` and ``R c + t``; the third column of the
    rotation is the cross product of the first two. Points of several sheets that do not lie in one
    plane determine all 12 unknowns of eq. 2.73. A bow of the sheet is neglected here.

    With ``is_offset_free`` the plate may lie anywhere along its normal, one more unknown. Returns
    None where the postures leave one of the nine (or twelve) unknowns open; the six of eq. 2.69 may
    still be determined then.
    """
    return _linear(
        observations.points_mm,
        *plate_in_tool(observations, plane),
        is_offset_free=is_offset_free,
    )


def _linear(
    points: FloatArray, normals: FloatArray, constants: FloatArray, *, is_offset_free: bool = False
) -> Pose[Tool, Sensor] | None:
    """`linear_hand_eye` of points (M, 3) and what `plate_in_tool` gives of them."""
    centre = points.mean(axis=0)
    _, extent, axes = np.linalg.svd(points - centre, full_matrices=False)
    if extent[1] <= RANK_RATIO * extent[0]:
        return None
    n_axes = 2 if extent[2] < FLAT_RATIO * extent[1] else 3
    scale = float(extent[0]) / np.sqrt(len(points))
    local = homogeneous((points - centre) @ axes[:n_axes].T / scale)
    rows = (local[:, :, None] * normals[:, None, :]).reshape(len(points), -1)
    if is_offset_free:
        rows = np.column_stack([rows, np.ones(len(rows))])
    unknowns, _, rank, singular = np.linalg.lstsq(rows, -constants, rcond=None)
    if rank < rows.shape[1] or singular[-1] < RANK_RATIO * singular[0]:
        return None
    columns = unknowns[: 3 * n_axes + 3].reshape(n_axes + 1, 3).T
    turned = columns[:, :n_axes] / scale
    triad = axes.T
    if n_axes == 2:
        turned = np.column_stack([turned, np.cross(turned[:, 0], turned[:, 1])])
        triad = np.column_stack([axes[0], axes[1], np.cross(axes[0], axes[1])])
    rotation = nearest_rotation(turned @ triad.T)
    return Pose(rotation, columns[:, n_axes] - rotation @ centre)


def plate_in_tool(
    observations: CondensedObservations, plane: Plane
) -> tuple[FloatArray, FloatArray]:
    """(M, 3) normals and (M,) constants of the plate in Tool: eqs. 2.57 and 2.58."""
    rotations = observations.rotations[observations.stripe]
    normals = np.einsum("nij,i->nj", rotations, plane.normal)
    heights = observations.translations_mm[observations.stripe] @ plane.normal
    return normals, heights - float(plane.normal @ plane.point_mm)


def minima_on_sphere(
    sections: Sequence[CircleSection], radius_mm: float
) -> tuple[HandEyeState, ...]:
    """Up to twelve distinct minima of the plain sum of squares, least first.

    For a known rotation, translation and centre in Base follow linearly from where the sections'
    centres lie within their sheets. On which side of its sheet a section's sphere is, it does not
    tell: all on one side, all on the other, and each where the linear solution puts it are tried.
    """
    place, points = place_sections(sections, radius_mm)
    every = rotations_all_over(N_ON_SPHERE)
    circles = _Circles.of(sections, radius_mm)
    others = np.concatenate([circles.complete(every, side) for side in (1, -1, 0)])
    rotations, scale = np.tile(every, (3, 1, 1)), unit_steps(points, 6)
    rotations, others, cost = descend_all(place, rotations, others, N_FIRST, scale)
    best = np.argsort(cost)[:N_GO_ON_SPHERE]
    rotations, others, cost = descend_all(place, rotations[best], others[best], N_LAST, scale)
    kept = distinct(rotations, cost, APART_ON_SPHERE_RAD, N_MINIMA)
    return tuple(
        HandEyeState(Pose(rotations[k], others[k, :3]), np.array([*others[k, 3:], radius_mm]))
        for k in kept
    )


def place_sections(
    sections: Sequence[CircleSection], radius_mm: float
) -> tuple[ManyPlaced, FloatArray]:
    """`many_placed` of a few points of each section, and all their points."""
    picked = []
    for section in sections:
        rows = np.linspace(0, len(section.rows) - 1, POINTS_OF_SECTION).round().astype(int)
        picked.append(section.points_mm[rows])
    poses = [one.stripe.base_from_tool for one in sections for _ in range(POINTS_OF_SECTION)]
    place = many_placed(
        np.concatenate(picked),
        np.array([pose.rotation for pose in poses]),
        np.array([pose.translation_mm for pose in poses]),
        SphereSurface(radius_mm),
    )
    return place, np.concatenate([section.points_mm for section in sections])


@dataclass(frozen=True, slots=True, eq=False)
class _Circles:
    """Section circles (S,): centre, normal of the sheet, height of the sphere's centre over it."""

    centres: FloatArray
    normals: FloatArray
    heights: FloatArray
    rotations: FloatArray
    origins: FloatArray

    @staticmethod
    def of(sections: Sequence[CircleSection], radius_mm: float) -> _Circles:
        poses = [section.stripe.base_from_tool for section in sections]
        return _Circles(
            centres=np.array([one.centre_mm for one in sections]),
            normals=np.array([one.normal for one in sections]),
            heights=np.array([one.height_mm(radius_mm) for one in sections]),
            rotations=np.array([pose.rotation for pose in poses]),
            origins=np.array([pose.translation_mm for pose in poses]),
        )

    def complete(self, rotations: FloatArray, side: int) -> FloatArray:
        """(K, 6) translation and centre that suit (K, 3, 3) rotations.

        The centre in Sensor is ``R' (R_k' (c - T_k) - t)``. With ``side`` 0 only its place within
        the sheet counts at first.
        """
        if side:
            return self._solved(rotations, side * self.heights, 1.0)
        flat = self._solved(rotations, np.zeros(len(self.heights)), 0.0)
        towards = flat[:, None, 3:] - self.origins
        in_tool = np.einsum("sji,ksj->ksi", self.rotations, towards) - flat[:, None, :3]
        in_sensor = np.einsum("kji,ksj->ksi", rotations, in_tool)
        above = np.einsum("ksi,si->ks", in_sensor - self.centres, self.normals)
        return self._solved(rotations, np.where(above < 0.0, -1.0, 1.0) * self.heights, 1.0)

    def _solved(self, rotations: FloatArray, heights: FloatArray, weight: float) -> FloatArray:
        """Least squares for ``R_k' c - t = R q + R_k' T_k``, across the sheets with a weight."""
        n = len(rotations)
        heights = np.broadcast_to(heights, (n, len(self.centres)))
        centres = self.centres + heights[..., None] * self.normals
        weights = np.eye(3) - (1.0 - weight) * self.normals[:, :, None] * self.normals[:, None, :]
        back = self.rotations.transpose(0, 2, 1)
        rows = np.concatenate([np.broadcast_to(-np.eye(3), back.shape), back], axis=2)
        # In Sensor, where the weights are: R' (R_k' c - t) = q + R' R_k' T_k.
        turned = np.einsum("sab,kcb,scd->ksad", weights, rotations, rows)
        constant = np.einsum("sij,sj->si", back, self.origins)
        right = centres + np.einsum("kji,sj->ksi", rotations, constant)
        right = np.einsum("sab,ksb->ksa", weights, right)
        inverse = np.linalg.pinv(turned.reshape(n, -1, 6), rcond=OPEN_RATIO)
        return np.asarray(np.einsum("kun,kn->ku", inverse, right.reshape(n, -1)))
