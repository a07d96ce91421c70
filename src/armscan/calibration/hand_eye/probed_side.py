# SPDX-License-Identifier: Apache-2.0
"""The plate's plane as the scan alone sees it, and what its distance from the probed one means."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.calibration.hand_eye.least_squares import refine
from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_residuals import PlateState, place_nodes
from armscan.calibration.hand_eye.plate_search import posture_rms
from armscan.calibration.hand_eye.plate_start import linear_hand_eye
from armscan.geometry.fitting import Plane

ALIKE = 0.1
"""An offset within this part of the tip's diameter or radius is taken for it."""


@dataclass(frozen=True, slots=True)
class FreePlane:
    """A plane solved along with the hand-eye.

    Parameters
    ----------
    offset_mm
        Its place on the probed plane's normal, where the stripes lie.
    tilt_deg
        Angle between the two planes.
    typical_mm
        Median over postures of their distance from it.
    """

    offset_mm: float
    tilt_deg: float
    typical_mm: float


def find_free_plane(nodes: PlateNodes, plate: Plane) -> FreePlane | None:
    """Solve hand-eye and plane together; None where the postures do not determine both."""
    start = linear_hand_eye(nodes, plate, is_offset_free=True)
    if start is None:
        return None
    state = PlateState(start, np.zeros(3))
    refined = refine(nodes, plate, state, np.eye(len(nodes)), solve_plate=True)
    placed = place_nodes(nodes, plate, refined.state)
    tilts, middle = refined.state.plane, -placed.by_plane.mean(axis=0)
    return FreePlane(
        float(middle @ tilts),
        float(np.degrees(np.arctan(np.hypot(tilts[0], tilts[1])))),
        float(np.nanmedian(posture_rms(nodes, placed.residual_mm))),
    )


def offset_in_words(offset_mm: float, tilt_deg: float, plate: PlateReference) -> str:
    """Say where a plane lies relative to the probed one, and what that looks like."""
    side = "above" if offset_mm > 0.0 else "below"
    words = f"{abs(offset_mm):.3f} mm {side} the probed one, tilted by {tilt_deg:.3f} deg"
    diameter = plate.tip_diameter_mm
    if diameter > 0.0 and abs(abs(offset_mm) - diameter) < ALIKE * diameter:
        return (
            f"{words}; that is the tip's diameter ({diameter:g} mm): the tip was compensated "
            "to the wrong side of the plate, which `armscan probe --side` sets right"
        )
    if diameter > 0.0 and abs(abs(offset_mm) - 0.5 * diameter) < ALIKE * diameter:
        return (
            f"{words}; that is the tip's radius ({0.5 * diameter:g} mm): the tip was not "
            "compensated for, or twice"
        )
    return words
