# SPDX-License-Identifier: Apache-2.0
"""Do plate, poses and stripes belong together? What is wrong, in words a person can act on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from armscan.calibration.hand_eye.conditioning import GOOD_POSTURES
from armscan.calibration.hand_eye.left_out import LeftOut
from armscan.calibration.hand_eye.observations import PlateReference, PosedStripe
from armscan.calibration.hand_eye.options import HandEyeOptions
from armscan.calibration.hand_eye.plate_fit import PlateFit, fit_plate
from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_result import sigma_of
from armscan.calibration.hand_eye.plate_search import Start
from armscan.calibration.hand_eye.pose_hypotheses import find_reading
from armscan.calibration.hand_eye.probed_side import find_free_plane, offset_in_words
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure

DISAGREEING = 1e-3
MIN_DISAGREEMENT_MM = 0.02
LARGE_ARM_MM = 0.1
REJECTED_SHARE = 0.2
MAX_MOVE_SIGMA = 5.0
GROSS_TILT_DEG = 3.0
GROSS_OFFSET_MM = 10.0
"""A plate that seems to lie further off than this was hardly probed wrongly: poses that are read
wrongly are asked for first."""
PROBE_AGAIN = (
    "where the tip was compensated to the wrong side, run `armscan probe --side` with the side "
    "that was touched; else probe the plate again, from the side that is scanned and after its "
    "last move, or solve the plate along"
)


def explain_misfit(
    nodes: PlateNodes, plate: PlateReference, start: Start, options: HandEyeOptions
) -> FitFailure:
    """Say why no hand-eye fits: another plane, another reading of the poses, or neither."""
    fact = (
        f"no hand-eye fits: the stripes of the typical posture lie {start.typical_mm:.2f} mm from "
        f"the plate, more than {options.max_rms_mm:g} mm"
    )
    free = find_free_plane(nodes, plate.plane)
    is_plate = free is not None and free.typical_mm < 0.2 * start.typical_mm
    if free is not None and is_plate and _is_gross(free.offset_mm, free.tilt_deg):
        best_mm = min(free.typical_mm, options.max_rms_mm)
        misread = _misread(nodes, plate, fact, start.typical_mm, best_mm)
        if misread is not None:
            return misread
        is_plate = free.typical_mm <= options.max_rms_mm
    if free is not None and is_plate:
        return FitFailure(
            f"{fact}; with the plate's plane left free it is {free.typical_mm:.3f} mm, and the "
            f"plane then lies {offset_in_words(free.offset_mm, free.tilt_deg, plate)}",
            PROBE_AGAIN,
        )
    misread = _misread(nodes, plate, fact, start.typical_mm, np.inf)
    if misread is not None:
        return misread
    return FitFailure(
        fact,
        "check the rotation convention of the poses, that every exposure has its own pose, that "
        "the plate was neither moved nor exchanged between probing and scanning, and that the "
        "sensor's calibration is this one",
    )


def _is_gross(offset_mm: float, tilt_deg: float) -> bool:
    return abs(offset_mm) > GROSS_OFFSET_MM or tilt_deg > GROSS_TILT_DEG


def _misread(
    nodes: PlateNodes, plate: PlateReference, fact: str, typical_mm: float, most_mm: float
) -> FitFailure | None:
    """Refuse in favour of another reading of the poses; None if there is none."""
    reading = find_reading(nodes, plate.plane, typical_mm, most_mm=most_mm)
    if reading is None:
        return None
    return FitFailure(
        f"{fact}; {reading.words} would leave {reading.typical_mm:.3f} mm", reading.remedy
    )


def refuse_other_plane(
    nodes: PlateNodes, plate: PlateReference, fit: PlateFit, options: HandEyeOptions
) -> FitFailure | tuple[str, ...]:
    """Compare the probed plane with the one that the scan alone gives: refuse, or warn of it."""
    state = fit.refined.state
    if options.solve_plate or len(nodes.used_postures) < GOOD_POSTURES:
        return ()
    free = fit_plate(nodes, plate, state, replace(options, solve_plate=True))
    if isinstance(free, FitFailure):
        return ()
    prior = np.zeros((3, 3)) if plate.covariance is None else plate.covariance
    difference, spread = free.refined.state.plane, free.covariance[6:, 6:] + prior
    statistic = float(difference @ np.linalg.solve(spread, difference))
    probability = float(chi2_distribution.sf(statistic, 3))
    middle = -fit.refined.placed.by_plane.mean(axis=0)
    offset_mm = float(middle @ difference)
    sigma_mm = float(np.sqrt(middle @ spread @ middle))
    if probability > DISAGREEING or abs(offset_mm) < MIN_DISAGREEMENT_MM:
        return ()
    tilt_deg = float(np.degrees(np.hypot(difference[0], difference[1])))
    fact = (
        f"probed plane and scan disagree (probability {probability:.1g}): the plane solved along "
        f"lies {offset_in_words(offset_mm, tilt_deg, plate)} (+- {sigma_mm:.3f} mm)"
    )
    return FitFailure(fact, PROBE_AGAIN) if abs(offset_mm) > options.max_rms_mm else (fact,)


def agreement_warnings(
    nodes: PlateNodes, plate: PlateReference, fit: PlateFit, options: HandEyeOptions
) -> tuple[str, ...]:
    """Warn of a plate seen from behind, and of an arm that scatters much."""
    warnings = []
    pose = fit.refined.state.tool_from_sensor
    cameras = nodes.rotations @ pose.translation_mm + nodes.translations_mm
    if float(np.median(plate.plane.distance_mm(cameras))) < 0.0:
        warnings.append(
            "the plate's normal points away from the scanner: it was probed from the side that "
            "was not scanned, or its sign is arbitrary; a tip compensated to the wrong side "
            "shifts the plane by its diameter"
        )
    arm_mm = sigma_of(fit, "arm")
    if arm_mm > LARGE_ARM_MM and options.arm_position_mm is None:
        warnings.append(
            f"the arm's poses seem to scatter by {arm_mm:.2f} mm: much for a measuring arm; a bad "
            "sensor calibration or a plate that moved looks the same"
        )
    return tuple(warnings)


def influence_warnings(
    nodes: PlateNodes, left_out: Mapping[int, LeftOut], covariance: FloatArray
) -> tuple[str, ...]:
    """Name the postures without which the hand-eye would move further than its sigma allows.

    Parameters
    ----------
    nodes
        With the names of the postures.
    left_out
        What changes without each posture, by its number.
    covariance
        (6, 6) of the hand-eye, in the order of the changes' first six.
    """
    sigma = np.sqrt(np.diag(covariance)[:6])
    moves = {k: float(np.max(np.abs(left.change[:6]) / sigma)) for k, left in left_out.items()}
    far = sorted((k for k in moves if moves[k] > MAX_MOVE_SIGMA), key=lambda k: -moves[k])
    return tuple(
        f"without posture {nodes.postures[k]} the hand-eye would move by {moves[k]:.0f} of its "
        "stated sigmas: it rests on this posture; check its pose and stripes, or scan more like it"
        for k in far[:3]
    )


def point_warnings(
    stripes: Sequence[PosedStripe], kept: Sequence[BoolArray], options: HandEyeOptions
) -> tuple[str, ...]:
    """Count what did not lie on a straight stripe, and name exposures without any."""
    total = sum(len(mark) for mark in kept)
    left_out = total - sum(int(mark.sum()) for mark in kept)
    warnings = []
    if left_out > REJECTED_SHARE * total:
        warnings.append(
            f"{left_out} of {total} points are not on straight stripes and were left out: the "
            "stripes leave the plate, or it is not flat, or the sensor is badly calibrated"
        )
    empty = [
        stripe.source for stripe, mark in zip(stripes, kept, strict=True) if not bool(mark.any())
    ]
    if empty:
        warnings.append(
            f"{len(empty)} exposures without a straight stripe of {options.min_points} points: "
            f"{', '.join(empty[:6])}"
        )
    return tuple(warnings)
