# SPDX-License-Identifier: Apache-2.0
"""Does something other than scatter explain the stripes? Refuse, or say it and widen the sigmas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.calibration.hand_eye.alternatives import Alternative
from armscan.calibration.hand_eye.observations import PlateReference
from armscan.calibration.hand_eye.plate_fit import PlateFit
from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.probed_side import offset_in_words
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure

SUSPICIOUS = 2e-3
"""An alternative is named if unknowns as large as its are less probable than this."""
UNLIKELY = 3e-4
"""And it may be a reason to refuse below this."""
ARM_ACCURACY_MM = 0.05
"""What measuring arms err by from place to place without anything being wrong: what moves the
stripes by less is said, and held by the stated covariance; more is refused."""
MOST_SIGMAS = 3.0
"""A hand-eye that an alternative would move by more of its sigmas is refused."""
PROBE_AGAIN = (
    "where the tip was compensated to the wrong side, run `armscan probe --side` with the side "
    "that was touched; else probe the plate again, from the side that is scanned and after its "
    "last move, or solve the plate along (--solve-plate)"
)
FIND_WHAT_MOVED = (
    "find out what moved there (a plate that slid, an arm that was referenced anew), and scan all "
    "postures again without it, or only those before or after it"
)


@dataclass(frozen=True, slots=True, eq=False)
class Contradiction:
    """An alternative that is believed.

    Parameters
    ----------
    kind
        As of `armscan.calibration.hand_eye.alternatives.Alternative`.
    reason, remedy
        In words.
    is_refused
        True if the hand-eye must not be used.
    widening
        (6, 6) to be added to the hand-eye's covariance, so that it holds what it would change by.
    arm_mm
        Scatter of the arm that the alternative leaves.
    """

    kind: str
    reason: str
    remedy: str
    is_refused: bool
    widening: FloatArray
    arm_mm: float

    @property
    def failure(self) -> FitFailure:
        """As a refusal."""
        return FitFailure(self.reason, self.remedy)


def find_contradiction(
    found: Sequence[Alternative], nodes: PlateNodes, plate: PlateReference, fit: PlateFit
) -> Contradiction | None:
    """The likeliest alternative that the stripes ask for; None if all is as given.

    Parameters
    ----------
    found
        What `armscan.calibration.hand_eye.alternatives.find_alternatives` gave.
    nodes, plate, fit
        Data and reference, and the refined hand-eye.
    """
    believed = [one for one in found if one.probability < SUSPICIOUS]
    if not believed:
        return None
    best = believed[0]
    change = best.hand_eye_change
    sigma = np.sqrt(np.minimum(np.diag(fit.covariance)[:6], np.diag(best.hand_eye_covariance)))
    is_refused = (
        best.probability < UNLIKELY
        and best.size_mm > ARM_ACCURACY_MM
        and float(np.abs(change / sigma).max()) > MOST_SIGMAS
    )
    reason, remedy = _in_words(best, nodes, plate, fit)
    return Contradiction(
        best.name, reason, remedy, is_refused, np.outer(change, change), best.arm_mm
    )


def plane_in_words(found: Sequence[Alternative]) -> str:
    """How the stripes alone see the probed plane; empty where they cannot tell."""
    checks = {one.name: one for one in found}
    if "plate" not in checks or "offset" not in checks:
        return ""
    by_offset = checks["offset"]
    shift_mm, sigma_mm = float(by_offset.values[0]), float(np.sqrt(by_offset.covariance[0, 0]))
    probability = min(checks["plate"].probability, by_offset.probability)
    agrees = "contradict it" if probability < SUSPICIOUS else "agree with it"
    return (
        f"the stripes {agrees} (p = {probability:.2g}): by themselves they put it "
        f"{shift_mm:+.3f} ± {sigma_mm:.3f} mm along its normal; a plate that moved by less than "
        f"{3.0 * sigma_mm:.2f} mm after probing may go unnoticed"
    )


def _in_words(
    one: Alternative, nodes: PlateNodes, plate: PlateReference, fit: PlateFit
) -> tuple[str, str]:
    """What is contradicted and by how much, and what to do."""
    chance = f"(probability {one.probability:.1g})"
    if one.name in ("plate", "offset"):
        plane = one.values if one.name == "plate" else np.array([0.0, 0.0, *one.values])
        where = offset_in_words(*_offset_and_tilt(plane, fit), plate)
        return (
            f"probed plane and scan disagree {chance}: the plane solved along lies {where}",
            PROBE_AGAIN,
        )
    if one.name == "change":
        offset_mm, tilt_deg = _offset_and_tilt(one.values, fit)
        first = int(np.flatnonzero(nodes.used_postures == one.place)[0])
        last = nodes.postures[nodes.used_postures[first - 1]]
        return (
            f"the postures up to {last} and those from {nodes.postures[one.place]} on each agree "
            f"among themselves, but not with each other {chance}: between them the plate or the "
            f"arm's base moved by {abs(offset_mm):.3f} mm and tilted by {tilt_deg:.3f} deg",
            FIND_WHAT_MOVED,
        )
    sheet = "" if one.name == "scale" else f" {one.place + 1}"
    what = (
        f"the sensor's points are too {'small' if one.values[0] > 0.0 else 'large'} by "
        f"{100.0 * abs(float(one.values[0])):.3f} %"
        if one.name == "scale"
        else f"light sheet{sheet} lies elsewhere than calibrated"
    )
    return (
        f"the stripes contradict the sensor's calibration {chance}: {what}, which moves them by "
        f"{one.size_mm:.3f} mm",
        "calibrate the sensor again: its camera or its light sheet has changed, or the calibration "
        "is another sensor's",
    )


def _offset_and_tilt(plane: FloatArray, fit: PlateFit) -> tuple[float, float]:
    """Offset (mm) where the stripes lie and tilt (deg) of a plane's two tilts and offset."""
    middle = -fit.refined.placed.by_plane.mean(axis=0)
    return float(middle @ plane), float(np.degrees(np.arctan(np.hypot(plane[0], plane[1]))))
