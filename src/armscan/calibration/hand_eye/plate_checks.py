# SPDX-License-Identifier: Apache-2.0
"""Do plate, poses and stripes belong together? What is wrong, in words a person can act on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from armscan.calibration.hand_eye.conditioning import GOOD_POSTURES
from armscan.calibration.hand_eye.observations import PlateReference, PosedStripe
from armscan.calibration.hand_eye.options import HandEyeOptions
from armscan.calibration.hand_eye.plate_fit import PlateFit, fit_plate
from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_result import sigma_of
from armscan.calibration.hand_eye.plate_search import Start
from armscan.calibration.hand_eye.pose_hypotheses import find_reading
from armscan.calibration.hand_eye.probed_side import find_free_plane, offset_in_words
from armscan.geometry.arrays import BoolArray
from armscan.geometry.estimate import FitFailure

DISAGREEING = 1e-3
MIN_DISAGREEMENT_MM = 0.02
LARGE_ARM_MM = 0.1
REJECTED_SHARE = 0.2
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
    if free is not None and free.typical_mm < 0.2 * start.typical_mm:
        return FitFailure(
            f"{fact}; with the plate's plane left free it is {free.typical_mm:.3f} mm, and the "
            f"plane then lies {offset_in_words(free.offset_mm, free.tilt_deg, plate)}",
            PROBE_AGAIN,
        )
    reading = find_reading(nodes, plate.plane, start.typical_mm)
    if reading is not None:
        return FitFailure(
            f"{fact}; {reading.words} would leave {reading.typical_mm:.3f} mm", reading.remedy
        )
    return FitFailure(
        fact,
        "check the rotation convention of the poses, that every exposure has its own pose, that "
        "the plate was neither moved nor exchanged between probing and scanning, and that the "
        "sensor's calibration is this one",
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
