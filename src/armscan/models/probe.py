# SPDX-License-Identifier: Apache-2.0
"""The touch probe's tip: where its centre is, and where the surface is that it touched."""

from __future__ import annotations

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.poses import Pose, Probe, Tool
from armscan.records.recording import ArmTrack


def tool_from_probe(centre_tool_mm: FloatArray) -> Pose[Tool, Probe]:
    """Pose of the tip from the (3,) place of its centre in Tool; a ball has no orientation."""
    return Pose(np.eye(3), frozen_floats(centre_tool_mm, (3,), "tip centre in Tool (mm)"))


def tip_centres(arm: ArmTrack, tool_from_probe: Pose[Tool, Probe]) -> FloatArray:
    """(M, 3) centres of the tip in Base, one for each of the M known samples of a track.

    Raises
    ------
    InputError
        If no sample is known.
    """
    known = arm.is_known
    if not bool(known.any()):
        raise InputError("the arm gave no pose for any touch")
    offset = tool_from_probe.translation_mm
    return np.asarray(arm.rotations[known] @ offset + arm.translations_mm[known])


def compensate_tip(
    centres_mm: FloatArray, outward_normals: FloatArray, tip_diameter_mm: float
) -> FloatArray:
    """Points on the surface from the centres of the tip that touched it.

    Parameters
    ----------
    centres_mm
        (N, 3) centres of the tip.
    outward_normals
        (3,) or (N, 3) normals of the surface towards the tip; any length but zero.
    tip_diameter_mm
        Calibrated diameter; 0 leaves the points as they are.

    Returns
    -------
    FloatArray
        (N, 3) centres, half a diameter against the normals.

    Raises
    ------
    InputError
        If shapes do not fit, a normal is zero or the diameter is negative.
    """
    centres = frozen_floats(centres_mm, (None, 3), "tip centres (mm)")
    normals = np.atleast_2d(np.asarray(outward_normals, dtype=np.float64))
    if normals.shape not in ((1, 3), centres.shape):
        raise InputError(f"normals of shape {normals.shape} for {len(centres)} tip centres")
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    if not bool((lengths > 0.0).all()) or not np.isfinite(normals).all():
        raise InputError("a normal of the touched surface is zero or not finite")
    if not tip_diameter_mm >= 0.0:
        raise InputError(f"a tip of {tip_diameter_mm} mm diameter")
    return np.asarray(centres - 0.5 * tip_diameter_mm * normals / lengths)
