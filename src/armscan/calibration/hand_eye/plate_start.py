# SPDX-License-Identifier: Apache-2.0
"""Linear start of the hand-eye from stripes on a plate, in the sheet's own coordinates.

Points of one sheet are ``p = c + u a + v b`` on the sheet's best plane, so that eq. 2.72 becomes
linear in the nine unknowns ``R a``, ``R b`` and ``R c + t``; the third column of the rotation is
the cross product of the first two. Points of several sheets that do not lie in one plane determine
all 12 unknowns of eq. 2.73. A bow of the sheet is neglected here; the refinement takes the points
as they are.
"""

from __future__ import annotations

import numpy as np

from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.geometry.arrays import FloatArray
from armscan.geometry.fitting import Plane
from armscan.geometry.frames import Sensor, Tool
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import nearest_rotation

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
