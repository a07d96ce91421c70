# SPDX-License-Identifier: Apache-2.0
"""Do plate, poses and stripes belong together? What is wrong, in words a person can act on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from armscan.calibration.hand_eye.contradictions import FIND_WHAT_MOVED, PROBE_AGAIN
from armscan.calibration.hand_eye.left_out import LeftOut
from armscan.calibration.hand_eye.mirrors import find_mirror
from armscan.calibration.hand_eye.observations import PlateReference, PosedStripe
from armscan.calibration.hand_eye.options import HandEyeOptions
from armscan.calibration.hand_eye.plate_fit import PlateFit
from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_residuals import PlateState, place_nodes
from armscan.calibration.hand_eye.plate_result import sigma_of
from armscan.calibration.hand_eye.plate_search import (
    GROSS_MM,
    GROSS_RATIO,
    Start,
    find_start,
    posture_rms,
)
from armscan.calibration.hand_eye.pose_hypotheses import BETTER, find_reading
from armscan.calibration.hand_eye.probed_side import find_free_plane, offset_in_words
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure

LARGE_ARM_MM = 0.1
REJECTED_SHARE = 0.2
MAX_MOVE_SIGMA = 5.0
MOST_ARM_MM = 0.25
"""An estimated scatter that is surely (two sigma) larger is no arm's. Robots reach 0.15."""
LEAST_TO_SPLIT = 8
GROSS_TILT_DEG = 3.0
GROSS_OFFSET_MM = 10.0
"""A plate that seems to lie further off than this was hardly probed wrongly: poses that are read
wrongly are asked for first."""


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
    mirror = find_mirror(nodes, plate, start, options, smaller=BETTER)
    if mirror is not None:
        return mirror
    change = _split(nodes, plate, start, fact)
    if change is not None:
        return change
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
    misread = _misread(nodes, plate, fact, start.typical_mm, options.max_rms_mm)
    if misread is not None:
        return misread
    return FitFailure(
        fact,
        "check the rotation convention of the poses, that every exposure has its own pose, that "
        "the plate was neither moved nor exchanged between probing and scanning, and that the "
        "sensor's calibration is this one",
    )


def _split(nodes: PlateNodes, plate: PlateReference, start: Start, fact: str) -> FitFailure | None:
    """Refuse postures of which the first and the last each agree, but not with each other."""
    used = np.sort(nodes.used_postures)
    if len(used) < LEAST_TO_SPLIT:
        return None
    most_mm = BETTER * start.typical_mm
    for order in (used, used[::-1]):
        half = find_start(
            nodes.select(np.isin(nodes.posture, order[: len(order) // 2])), plate.plane
        )
        if half.typical_mm > most_mm:
            continue
        state = PlateState(half.tool_from_sensor, np.zeros(3))
        rms = posture_rms(nodes, place_nodes(nodes, plate.plane, state).residual_mm)[order]
        far = np.flatnonzero(rms > max(GROSS_RATIO * half.typical_mm, GROSS_MM))
        if not len(far) or not (rms[far[0] :] > GROSS_MM).all():
            continue
        before, after = nodes.postures[order[far[0] - 1]], nodes.postures[order[far[0]]]
        first, second = (before, after) if order is used else (after, before)
        return FitFailure(
            f"{fact}; the postures up to {first} and those from {second} on do not agree with each "
            f"other: with the hand-eye of {'the former' if order is used else 'the latter'} "
            f"({half.typical_mm:.3f} mm) the others lie {float(np.median(rms[far[0] :])):.2f} mm "
            "from the plate",
            FIND_WHAT_MOVED,
        )
    return None


def refuse_scatter(fit: PlateFit, options: HandEyeOptions) -> FitFailure | None:
    """Refuse residuals that no arm explains; none where the arm's scatter was given."""
    arm_mm = sigma_of(fit, "arm")
    names = [component.name for component in fit.components]
    sigma_log = float(np.sqrt(fit.noise.log_covariance[names.index("arm"), names.index("arm")]))
    if options.arm_position_mm is not None or arm_mm * np.exp(-2.0 * sigma_log) < MOST_ARM_MM:
        return None
    return FitFailure(
        f"the arm would have to scatter by {arm_mm:.2f} mm an axis to explain the stripes: no "
        f"measuring arm and hardly a robot does (limit {MOST_ARM_MM:g} mm)",
        "check that plate, poses, sensor and stripes belong together; where the arm is that bad, "
        "say so with --arm-position-mm",
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
    if not fit.refined.is_settled:
        warnings.append(
            "the refinement had not settled when its steps ran out: the hand-eye may be off by "
            "more than stated"
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
