# SPDX-License-Identifier: Apache-2.0
"""A start for the refinement that a few wrong stripes do not spoil, from any set of postures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_residuals import PlateState, place_nodes
from armscan.calibration.hand_eye.plate_start import linear_hand_eye, plate_in_tool
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.fitting import Plane
from armscan.geometry.frames import Sensor, Tool
from armscan.geometry.poses import Pose

N_SUBSETS = 120
SUBSET_SIZE = 6
LEAST_FOR_SUBSETS = 8
"""With fewer postures no majority of them can tell a wrong one."""
N_ROTATIONS = 240
N_DESCENTS = 25
SAME_DEG = 1.0
IMPOSSIBLE_MM = 1e3
"""Counted against a hand-eye that puts the camera behind the plate."""
GROSS_RATIO = 8.0
GROSS_MM = 0.05
"""A posture is wrong if its distance from the plate exceeds both this and `GROSS_RATIO` times the
median of all."""


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
    n_rivals
        Distinct hand-eyes that explain the data about as well.
    """

    tool_from_sensor: Pose[Tool, Sensor]
    linear: Pose[Tool, Sensor] | None
    rms_mm: FloatArray
    is_wrong: BoolArray
    n_rivals: int = 0

    @property
    def typical_mm(self) -> float:
        """Median over postures of their distance from the plate."""
        return float(np.nanmedian(self.rms_mm))


def find_start(nodes: PlateNodes, plate: Plane) -> Start:
    """Find the hand-eye with the least median distance of the postures from the plate."""
    linear = linear_hand_eye(nodes, plate)
    candidates = [] if linear is None else [_descend(nodes, plate, linear)]
    n_rivals = 0
    used = nodes.used_postures
    is_many = len(used) >= LEAST_FOR_SUBSETS
    if is_many and (linear is None or _has_wrong(_rms(nodes, plate, candidates[0]))):
        candidates += _from_subsets(nodes, plate, used)
    if not candidates:
        candidates, n_rivals = _from_everywhere(nodes, plate)
    costs = [float(np.nanmedian(_rms(nodes, plate, pose))) for pose in candidates]
    best = candidates[int(np.argmin(costs))]
    if not is_many:
        return Start(
            best, linear, _rms(nodes, plate, best), np.zeros(len(nodes.postures), bool), n_rivals
        )
    for _ in range(3):
        rms = _rms(nodes, plate, best)
        wrong = rms > max(GROSS_MM, GROSS_RATIO * float(np.nanmedian(rms)))
        best = _descend(nodes.select(~wrong[nodes.posture]), plate, best)
    rms = _rms(nodes, plate, best)
    wrong = rms > max(GROSS_MM, GROSS_RATIO * float(np.nanmedian(rms)))
    return Start(best, linear, rms, wrong, n_rivals)


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
    largest, typical = float(np.nanmax(rms)), float(np.nanmedian(rms))
    return largest > max(GROSS_MM, 0.5 * GROSS_RATIO * typical)


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
    rotations, translations = _descend_all(
        nodes, plate, pose.rotation[None], pose.translation_mm[None], n_steps
    )
    return Pose(rotations[0], translations[0])


def _from_everywhere(nodes: PlateNodes, plate: Plane) -> tuple[list[Pose[Tool, Sensor]], int]:
    """Descend from rotations all over; also count distinct solutions that are about as good."""
    nodes = thinned(nodes)
    rotations = Rotation.random(N_ROTATIONS, rng=np.random.default_rng(0)).as_matrix()
    normals, constants = plate_in_tool(nodes, plate)
    turned = np.einsum("kij,nj->kni", rotations, nodes.points_mm)
    heights = np.einsum("kni,ni->kn", turned, normals) + constants
    translations = -heights @ np.linalg.pinv(normals, rcond=1e-6).T
    rotations, translations = _descend_all(nodes, plate, rotations, translations, N_DESCENTS)
    rms = np.sqrt((_residuals(nodes, plate, rotations, translations) ** 2).mean(axis=1))
    rms += IMPOSSIBLE_MM * _views_from_behind(nodes, plate, rotations, translations)
    order = np.argsort(rms)
    best = rotations[order[0]]
    n_rivals, seen = 0, [best]
    for k in order[rms[order] <= max(3.0 * rms[order[0]], 0.02)]:
        if all(_apart_deg(rotations[k], other) > SAME_DEG for other in seen):
            seen.append(rotations[k])
            n_rivals += 1
    pose: Pose[Tool, Sensor] = Pose(best, translations[order[0]])
    return [pose], n_rivals


def _views_from_behind(
    nodes: PlateNodes, plate: Plane, rotations: FloatArray, translations: FloatArray
) -> FloatArray:
    """(K,) share of the stripes for which a hand-eye puts the camera behind the plate.

    Where all stripes pass one point of the sheet, a hand-eye turned by half a turn explains them
    as well as the true one, but puts the camera now before the plate and now behind it.
    """
    cameras = np.einsum("sij,kj->ksi", nodes.rotations, translations) + nodes.translations_mm
    heights = (cameras - plate.point_mm) @ plate.normal
    return np.asarray((heights < 0.0).mean(axis=1))


def _apart_deg(rotation: FloatArray, other: FloatArray) -> float:
    cosine = 0.5 * (float((rotation * other).sum()) - 1.0)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _residuals(
    nodes: PlateNodes, plate: Plane, rotations: FloatArray, translations: FloatArray
) -> FloatArray:
    """(K, N) residuals of K hand-eyes."""
    normals, constants = plate_in_tool(nodes, plate)
    in_tool = np.einsum("kij,nj->kni", rotations, nodes.points_mm) + translations[:, None]
    return np.asarray(np.einsum("kni,ni->kn", in_tool, normals) + constants)


def _descend_all(
    nodes: PlateNodes,
    plate: Plane,
    rotations: FloatArray,
    translations: FloatArray,
    n_steps: int,
) -> tuple[FloatArray, FloatArray]:
    """Damped Gauss-Newton from many starts at once: (K, 3, 3) and (K, 3)."""
    normals, constants = plate_in_tool(nodes, plate)
    size = np.sqrt((nodes.points_mm**2).sum(axis=1).mean())
    scale = np.array([1.0 / size] * 3 + [1.0] * 3)
    damping = np.full(len(rotations), 1e-3)
    cost = (_residuals(nodes, plate, rotations, translations) ** 2).sum(axis=1)
    for _ in range(n_steps):
        turned = np.einsum("kij,nj->kni", rotations, nodes.points_mm)
        residual = np.einsum("kni,ni->kn", turned + translations[:, None], normals) + constants
        slopes = np.concatenate(
            [np.cross(turned, normals[None]), np.broadcast_to(normals, turned.shape)], axis=2
        )
        slopes = slopes * scale
        matrix = slopes.transpose(0, 2, 1) @ slopes
        mean = np.einsum("kii->k", matrix) / 6.0
        matrix += (damping * mean + 1e-12)[:, None, None] * np.eye(6)
        gradient = np.einsum("kni,kn->ki", slopes, residual)
        step = -np.linalg.solve(matrix, gradient[:, :, None])[:, :, 0] * scale
        turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
        tried_rotations, tried = turn @ rotations, translations + step[:, 3:]
        value = (_residuals(nodes, plate, tried_rotations, tried) ** 2).sum(axis=1)
        better = value < cost
        rotations = np.where(better[:, None, None], tried_rotations, rotations)
        translations = np.where(better[:, None], tried, translations)
        cost = np.where(better, value, cost)
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
    u, _, vt = np.linalg.svd(rotations)
    return np.asarray(u @ vt), translations
