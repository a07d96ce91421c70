# SPDX-License-Identifier: Apache-2.0
"""Start of the hand-eye on a sphere, from section centres and without any demand on the postures.

For a known rotation, translation and centre in Base follow linearly from eq. 2.46; for these, the
rotation follows from corresponding directions. The two in turn, from rotations spread over all
orientations and for either side of the sheet, lead to a few candidates.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.sphere_residuals import SphereNodes, SphereState
from armscan.calibration.hand_eye.sphere_two_step import sphere_centres
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import nearest_rotation

ROUNDS = 12
N_CANDIDATES = 6
APART_RAD = 0.05


def start_candidates(nodes: SphereNodes, radius_mm: float) -> tuple[SphereState, ...]:
    """Up to six states to refine, likeliest first."""
    poses = [section.stripe.base_from_tool for section in nodes.sections]
    rotations = np.array([pose.rotation for pose in poses])
    origins = np.array([pose.translation_mm for pose in poses])
    found: list[tuple[float, SphereState]] = []
    for side in (1, -1, 0):
        centres = sphere_centres(nodes.sections, radius_mm, side)
        for start in Rotation.create_group("O").as_matrix():
            found.append(_alternate(start, centres, rotations, origins, radius_mm))
    found.sort(key=lambda pair: pair[0])
    kept: list[SphereState] = []
    for _, state in found:
        if all(is_apart(state, one) for one in kept):
            kept.append(state)
        if len(kept) == N_CANDIDATES:
            break
    return tuple(kept)


def _alternate(
    rotation: FloatArray,
    centres: FloatArray,
    rotations: FloatArray,
    origins: FloatArray,
    radius_mm: float,
) -> tuple[float, SphereState]:
    """Solve translation and rotation in turn; the misfit of the centres (mm^2) and the state."""
    rows = np.concatenate([rotations, np.broadcast_to(-np.eye(3), rotations.shape)], axis=2)
    inverse = np.linalg.pinv(rows.reshape(-1, 6), rcond=1e-4)
    for _ in range(ROUNDS):
        turned = centres @ rotation.T
        placed = np.einsum("nij,nj->ni", rotations, turned) + origins
        solution = inverse @ -placed.reshape(-1)
        shift, middle = solution[:3], solution[3:]
        target = np.einsum("nij,ni->nj", rotations, middle - origins) - shift
        rotation = nearest_rotation(target.T @ centres)
    misfit = target - centres @ rotation.T
    state = SphereState(Pose(rotation, shift), middle, radius_mm)
    return float((misfit**2).sum()), state


def is_apart(one: SphereState, other: SphereState) -> bool:
    """True for states whose sensors are turned differently."""
    turn = one.tool_from_sensor.rotation.T @ other.tool_from_sensor.rotation
    return float(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))) > APART_RAD
