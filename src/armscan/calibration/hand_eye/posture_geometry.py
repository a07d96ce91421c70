# SPDX-License-Identifier: Apache-2.0
"""What the postures of a hand-eye calibration have in common, in words."""

from __future__ import annotations

import numpy as np

from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.geometry.arrays import FloatArray
from armscan.geometry.fitting import Plane

ALIKE_DEG = 3.0
SMALL_DEG = 8.0
FLAT_RATIO = 0.15
"""Spread of the normals off their plane over that within it, below which they are in one plane."""
SAME_STAND_OFF = 0.03
"""Standard deviation of the stand-off over its mean, below which it counts as constant."""
REMEDY = (
    "tilt the head by 30 to 45 degrees in two or more directions, turn it about its own axis, and "
    "vary the distance by 15 %"
)


def common_to_postures(nodes: PlateNodes, plate: Plane) -> str:
    """Say what keeps the postures from being independent; empty if nothing does.

    The plate's normals in Tool decide: without turning, or turning about the normal only, they
    are all alike; with tilts in one azimuth only they lie in a plane through the origin.
    """
    first = [int(np.flatnonzero(nodes.posture == k)[0]) for k in nodes.used_postures]
    rotations = nodes.rotations[nodes.stripe[first]]
    normals = np.einsum("pij,i->pj", rotations, plate.normal)
    spread = np.linalg.svd(normals - normals.mean(axis=0), compute_uv=False) / np.sqrt(len(normals))
    through_origin = np.linalg.svd(normals, compute_uv=False) / np.sqrt(len(normals))
    tilt_deg = float(np.degrees(np.hypot(spread[0], spread[1])))
    causes = []
    if tilt_deg < ALIKE_DEG:
        turn_deg = _largest_turn_deg(rotations)
        causes.append(
            "the arm never turned, it only shifted"
            if turn_deg < ALIKE_DEG
            else "the arm turned about the plate's normal only"
        )
    elif tilt_deg < SMALL_DEG:
        causes.append(f"the head was hardly tilted (by {tilt_deg:.0f} deg, root mean square)")
    elif through_origin[2] < FLAT_RATIO * spread[0]:
        causes.append("the head was tilted in one azimuth plane only")
    stand_off = np.array(
        [
            np.linalg.norm(nodes.points_mm[nodes.posture == k].mean(axis=0))
            for k in nodes.used_postures
        ]
    )
    if float(stand_off.std()) < SAME_STAND_OFF * float(stand_off.mean()):
        causes.append(f"the stand-off was always about {stand_off.mean():.0f} mm")
    return ": " + ", and ".join(causes) if causes else ""


def _largest_turn_deg(rotations: FloatArray) -> float:
    cosine = 0.5 * (np.einsum("pij,ij->p", rotations, rotations[0]) - 1.0)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max())
