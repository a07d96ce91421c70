# SPDX-License-Identifier: Apache-2.0
"""Starting values on a plate: the linear solution, descents from rotations all over the sphere
of rotations, and the candidates that agree with the stripes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.observations import PlateNodes, PlateState, place_nodes
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.rotations import nearest_rotation
from armscan.geometry.shapes import Plane

_SQRT_2 = float(np.sqrt(2.0))
_PSI = 1.533751168755204288118041
"""Positive root of psi^4 = psi + 4."""
N_TURN = 3

BaseTransform = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""From K rotations (K, 3, 3) and K further unknowns (K, M) to residuals (K, N) and their
derivatives (K, N, 3 + M) by a turn on the left and by these unknowns."""


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


def descend_all(
    place: BaseTransform,
    rotations: FloatArray,
    others: FloatArray,
    n_steps: int,
    scale: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Damped Gauss-Newton from many starts at once.

    Parameters
    ----------
    place
        Residuals and slopes of many states.
    rotations, others
        (K, 3, 3) and (K, M) to start from.
    n_steps
        Steps of each.
    scale
        (3 + M,) what each unknown is multiplied with so that all move the residuals alike.

    Returns
    -------
    rotations, others, cost
        (K, 3, 3), (K, M), and the sums of squared residuals (K,).
    """
    residual, slopes = place(rotations, others)
    cost = (residual**2).sum(axis=1)
    damping = np.full(len(rotations), 1e-3)
    diagonal = np.eye(len(scale))
    for _ in range(n_steps):
        scaled = slopes * scale
        matrix = scaled.transpose(0, 2, 1) @ scaled
        mean = np.einsum("kii->k", matrix) / len(scale)
        matrix += (damping * mean + 1e-12)[:, None, None] * diagonal
        gradient = np.einsum("kni,kn->ki", scaled, residual)
        step = -np.linalg.solve(matrix, gradient[:, :, None])[:, :, 0] * scale
        tried = Rotation.from_rotvec(step[:, :N_TURN]).as_matrix() @ rotations
        moved = others + step[:, N_TURN:]
        tried_residual, tried_slopes = place(tried, moved)
        tried_cost = (tried_residual**2).sum(axis=1)
        better = tried_cost < cost
        rotations = np.where(better[:, None, None], tried, rotations)
        others = np.where(better[:, None], moved, others)
        residual = np.where(better[:, None], tried_residual, residual)
        slopes = np.where(better[:, None, None], tried_slopes, slopes)
        cost = np.where(better, tried_cost, cost)
        damping = np.clip(np.where(better, 0.1 * damping, 10.0 * damping), 1e-12, 1e6)
    u, _, vt = np.linalg.svd(rotations)
    return np.asarray(u @ vt), others, cost


def distinct(rotations: FloatArray, cost: FloatArray, apart_rad: float, count: int) -> IntArray:
    """Numbers of the ``count`` least costly of (K, 3, 3) rotations that differ from each other."""
    kept: list[int] = []
    for k in np.argsort(cost):
        traces = np.einsum("nij,ij->n", rotations[kept], rotations[k])
        if (traces < 1.0 + 2.0 * np.cos(apart_rad)).all():
            kept.append(int(k))
        if len(kept) == count:
            break
    return np.array(kept, dtype=np.int64)


FLAT_RATIO = 0.02
"""Spread of the points off their best plane over that within it, below which they have no more
than nine unknowns to offer: a bow is not a third dimension."""
RANK_RATIO = 1e-3


def linear_hand_eye(
    nodes: PlateNodes, plate: Plane, *, is_offset_free: bool = False
) -> Pose[Tool, Sensor] | None:
    """Solve eq. 2.72 for the unknowns that the points determine.

    With ``is_offset_free`` the plate may lie anywhere along its normal, one more unknown.
    Returns None where the postures leave one of the nine (or twelve) unknowns open; the six of
    eq. 2.69 may still be determined then.
    """
    centre = nodes.points_mm.mean(axis=0)
    _, spread, axes = np.linalg.svd(nodes.points_mm - centre, full_matrices=False)
    if spread[1] <= RANK_RATIO * spread[0]:
        return None
    n_axes = 2 if spread[2] < FLAT_RATIO * spread[1] else 3
    scale = float(spread[0]) / np.sqrt(len(nodes))
    local = np.column_stack([(nodes.points_mm - centre) @ axes[:n_axes].T / scale,
                             np.ones(len(nodes))])  # fmt: skip
    normals, constants = plate_in_tool(nodes, plate)
    rows = (local[:, :, None] * normals[:, None, :]).reshape(len(nodes), -1)
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


def plate_in_tool(nodes: PlateNodes, plate: Plane) -> tuple[FloatArray, FloatArray]:
    """(N, 3) normals and (N,) constants of the plate in Tool: eqs. 2.57 and 2.58."""
    rotations = nodes.rotations[nodes.stripe]
    normals = np.einsum("nij,i->nj", rotations, plate.normal)
    heights = nodes.translations_mm[nodes.stripe] @ plate.normal
    return normals, heights - float(plate.normal @ plate.point_mm)


N_SUBSETS = 120
SUBSET_SIZE = 6
LEAST_FOR_SUBSETS = 8
"""With fewer postures no majority of them can tell a wrong one."""
N_ROTATIONS = 240
MOST_STRIPES = 60
"""Of a long scan, so many stripes are searched with, evenly spread."""
N_FIRST = 8
"""Steps of every start; the best of them go on."""
N_GO_ON = 40
N_LAST = 40
N_DESCENTS = 25
N_MINIMA = 12
SAME_RAD = float(np.radians(1.0))
RIVAL_RATIO = 3.0
RIVAL_MM = 0.02
"""Minima that leave less than this, or than `RIVAL_RATIO` times the least, may be the right one."""
MIXED = 0.05
"""Share of the stripes that wrong poses may put on another side of the plate than the rest."""
GROSS_RATIO = 8.0
GROSS_MM = 0.05
"""A posture is wrong if its distance from the plate exceeds both this and `GROSS_RATIO` times the
median of all."""


FAR_MM = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where the refinement begins.

    Parameters
    ----------
    tool_from_sensor
        The start.
    linear
        The linear solution, where it exists.
    rms_mm
        (n postures,) distance of each posture's points from the plate; NaN where it has none.
    is_wrong
        (n postures,) True for postures that the others contradict.
    rivals
        Other minima that leave little more, least first.
    """

    tool_from_sensor: Pose[Tool, Sensor]
    linear: Pose[Tool, Sensor] | None
    rms_mm: FloatArray
    is_wrong: BoolArray
    rivals: tuple[Pose[Tool, Sensor], ...] = ()

    @property
    def typical_mm(self) -> float:
        """Median over postures of their distance from the plate."""
        return float(np.nanmedian(self.rms_mm))


def find_start(nodes: PlateNodes, plate: Plane) -> Start:
    """Find the hand-eye with the least median distance of the postures from the plate.

    Of all minima of the sum of squares: those that descents from all over the rotations end in,
    that of the linear solution, and, where a posture is wrong, those of subsets of the postures.
    """
    linear = linear_hand_eye(nodes, plate)
    candidates = list(minima_from_everywhere(nodes, plate))
    if linear is not None:
        candidates.append(_descend(nodes, plate, linear))
    used = nodes.used_postures
    is_many = len(used) >= LEAST_FOR_SUBSETS
    if is_many and _has_wrong(_rms(nodes, plate, candidates[0])):
        candidates += _from_subsets(nodes, plate, used)
    candidates, costs = _possible(nodes, plate, candidates, is_robust=is_many)
    best = candidates[int(np.argmin(costs))]
    wrong = np.zeros(len(nodes.postures), dtype=np.bool_)
    for _ in range(3 if is_many else 0):
        rms = _rms(nodes, plate, best)
        wrong = rms > max(GROSS_MM, GROSS_RATIO * float(np.nanmedian(rms)))
        best = _descend(nodes.select(~wrong[nodes.posture]), plate, best)
    rms = _rms(nodes, plate, best)
    if is_many:
        wrong = rms > max(GROSS_MM, GROSS_RATIO * float(np.nanmedian(rms)))
    return Start(best, linear, rms, wrong, _rivals(candidates, costs, best))


def _possible(
    nodes: PlateNodes, plate: Plane, candidates: list[Pose[Tool, Sensor]], *, is_robust: bool
) -> tuple[list[Pose[Tool, Sensor]], FloatArray]:
    """Hand-eyes that a camera can have, and the typical distance (mm) that each leaves.

    A camera does not pass through the plate. Where all stripes pass one point of the sheet, a
    hand-eye turned by half a turn explains them as well as the true one, but puts the camera now
    before the plate and now behind it. One that stays behind counts only where none before the
    plate will do: the plate's normal may have the wrong sign.
    """
    rms = np.array([_rms(nodes, plate, pose) for pose in candidates])
    costs = np.nanmedian(rms, axis=1) if is_robust else np.sqrt(np.nanmean(rms**2, axis=1))
    behind = _share_behind(nodes, plate, np.array([pose.translation_mm for pose in candidates]))
    limit = _limit_mm(costs)
    for kept in (behind <= MIXED, (behind <= MIXED) | (behind >= 1.0 - MIXED)):
        if (costs[kept] <= limit).any():
            return [candidates[k] for k in np.flatnonzero(kept)], costs[kept]
    return candidates, costs


def _limit_mm(costs: FloatArray) -> float:
    return max(RIVAL_RATIO * float(costs.min()), RIVAL_MM)


def _rivals(
    candidates: list[Pose[Tool, Sensor]], costs: FloatArray, best: Pose[Tool, Sensor]
) -> tuple[Pose[Tool, Sensor], ...]:
    limit = _limit_mm(costs)
    rotations = np.array([best.rotation] + [pose.rotation for pose in candidates])
    first = np.concatenate([[-1.0], np.where(costs <= limit, costs, np.inf)])
    kept = distinct(rotations, first, SAME_RAD, N_MINIMA)
    return tuple(candidates[k - 1] for k in kept if k > 0 and np.isfinite(first[k]))


def minima_from_everywhere(nodes: PlateNodes, plate: Plane) -> tuple[Pose[Tool, Sensor], ...]:
    """Distinct minima of the plain sum of squares, least first."""
    nodes = few_stripes(thinned(nodes))
    rotations = rotations_all_over(N_ROTATIONS)
    normals, constants = plate_in_tool(nodes, plate)
    turned = np.einsum("kij,nj->kni", rotations, nodes.points_mm)
    heights = np.einsum("kni,ni->kn", turned, normals) + constants
    shifts = np.asarray(-heights @ np.linalg.pinv(normals, rcond=1e-6).T)
    place, scale = _placing(nodes, plate), _scale(nodes)
    rotations, shifts, cost = descend_all(place, rotations, shifts, N_FIRST, scale)
    best = np.argsort(cost)[:N_GO_ON]
    rotations, shifts, cost = descend_all(place, rotations[best], shifts[best], N_LAST, scale)
    kept = distinct(rotations, cost, SAME_RAD, N_MINIMA)
    return tuple(Pose(rotations[k], shifts[k]) for k in kept)


def _share_behind(nodes: PlateNodes, plate: Plane, shifts: FloatArray) -> FloatArray:
    """(K,) share of the stripes for which a hand-eye puts the camera behind the plate."""
    cameras = np.einsum("sij,kj->ksi", nodes.rotations, shifts) + nodes.translations_mm
    return np.asarray(((cameras - plate.point_mm) @ plate.normal < 0.0).mean(axis=1))


def few_stripes(nodes: PlateNodes) -> PlateNodes:
    """At most `MOST_STRIPES` stripes, evenly spread."""
    used = np.unique(nodes.stripe)
    if len(used) <= MOST_STRIPES:
        return nodes
    chosen = used[np.linspace(0, len(used) - 1, MOST_STRIPES).round().astype(np.int64)]
    return nodes.select(np.isin(nodes.stripe, chosen))


def posture_rms(nodes: PlateNodes, residual_mm: FloatArray) -> FloatArray:
    """Root mean square residual of each posture, NaN for those without nodes."""
    n = len(nodes.postures)
    counts = np.bincount(nodes.posture, minlength=n).astype(np.float64)
    counts[counts == 0.0] = np.nan
    return np.sqrt(np.bincount(nodes.posture, weights=residual_mm**2, minlength=n) / counts)


def _rms(nodes: PlateNodes, plate: Plane, pose: Pose[Tool, Sensor]) -> FloatArray:
    placed = place_nodes(nodes, plate, PlateState(pose, np.zeros(3)))
    return posture_rms(nodes, placed.residual_mm)


def _has_wrong(rms: FloatArray) -> bool:
    """True where a posture stands out, or all are far: a grossly wrong one moves all others."""
    largest, typical = float(np.nanmax(rms)), float(np.nanmedian(rms))
    return largest > max(GROSS_MM, min(0.5 * GROSS_RATIO * typical, FAR_MM))


def _from_subsets(nodes: PlateNodes, plate: Plane, used: IntArray) -> list[Pose[Tool, Sensor]]:
    """Solutions of random subsets of postures, the best few of them refined."""
    nodes = thinned(nodes)
    random = np.random.default_rng(0)
    found: list[tuple[float, Pose[Tool, Sensor]]] = []
    for _ in range(N_SUBSETS):
        chosen = random.choice(used, SUBSET_SIZE, replace=False)
        subset = nodes.select(np.isin(nodes.posture, chosen))
        pose = linear_hand_eye(subset, plate)
        if pose is not None:
            pose = _descend(subset, plate, pose, 4)
            found.append((float(np.nanmedian(_rms(nodes, plate, pose))), pose))
    found.sort(key=lambda item: item[0])
    return [pose for _, pose in found[:3]]


def thinned(nodes: PlateNodes) -> PlateNodes:
    """First, middle and last node of every stripe."""
    piece = np.unique(np.column_stack([nodes.stripe, nodes.sheet]), axis=0, return_inverse=True)[1]
    kept = np.zeros(len(nodes), dtype=np.bool_)
    for number in range(int(piece.max()) + 1):
        own = np.flatnonzero(piece == number)
        kept[own[[0, len(own) // 2, -1]]] = True
    return nodes.select(kept)


def _descend(
    nodes: PlateNodes, plate: Plane, pose: Pose[Tool, Sensor], n_steps: int = N_DESCENTS
) -> Pose[Tool, Sensor]:
    """Plain least squares of eq. 2.76 over six parameters."""
    rotations, shifts, _ = descend_all(
        _placing(nodes, plate),
        pose.rotation[None],
        pose.translation_mm[None],
        n_steps,
        _scale(nodes),
    )
    return Pose(rotations[0], shifts[0])


def _scale(nodes: PlateNodes) -> FloatArray:
    size = float(np.sqrt((nodes.points_mm**2).sum(axis=1).mean()))
    return np.array([1.0 / size] * 3 + [1.0] * 3)


def _placing(nodes: PlateNodes, plate: Plane) -> BaseTransform:
    """Distances from the plate for many hand-eyes at once, with their derivatives."""
    normals, constants = plate_in_tool(nodes, plate)

    def place(rotations: FloatArray, shifts: FloatArray) -> tuple[FloatArray, FloatArray]:
        turned = np.einsum("kij,nj->kni", rotations, nodes.points_mm)
        residual = np.einsum("kni,ni->kn", turned, normals) + shifts @ normals.T + constants
        slopes = np.concatenate(
            [np.cross(turned, normals[None]), np.broadcast_to(normals, turned.shape)], axis=2
        )
        return residual, slopes

    return place
