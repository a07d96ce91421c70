# SPDX-License-Identifier: Apache-2.0
"""Checks of a hand-eye on a plate: other likely solutions, varied postures, refusals, warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from armscan.calibration.hand_eye.alternatives import (
    BETTER,
    FIND_WHAT_MOVED,
    PROBE_AGAIN,
    find_free_plane,
    find_mirror,
    find_reading,
    offset_in_words,
)
from armscan.calibration.hand_eye.estimate import LeftOut, PlateFit, fit_plate
from armscan.calibration.hand_eye.observations import (
    HandEyeOptions,
    PlateNodes,
    PlateReference,
    PlateState,
    PosedStripe,
    place_nodes,
)
from armscan.calibration.hand_eye.result import sigma_of
from armscan.calibration.hand_eye.search import (
    GROSS_MM,
    GROSS_RATIO,
    Start,
    few_stripes,
    find_start,
    posture_rms,
    thinned,
)
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.shapes import Plane

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


LIKELIER = 6.0
"""Logarithm of the likelihood ratio from which one minimum is preferred to another: 400 to 1."""
MOST_RIVALS = 4
APART_DEG = 1.0


def settle_alternatives(
    nodes: PlateNodes, plate: PlateReference, start: Start, options: HandEyeOptions, cause: str
) -> Start | FitFailure:
    """Take the likeliest of the start and its rivals; refuse where another one is as likely.

    Parameters
    ----------
    nodes, plate, options
        Data, reference and noise model.
    start
        With minima that leave little more.
    cause
        What the postures have in common, in words.
    """
    if not start.rivals:
        return start
    few = few_stripes(thinned(nodes.select(~start.is_wrong[nodes.posture])))
    found = []
    for pose in (start.tool_from_sensor, *start.rivals[:MOST_RIVALS]):
        fit = fit_plate(few, plate, PlateState(pose, np.zeros(3)), options)
        if isinstance(fit, PlateFit):
            found.append((fit.linear.log_likelihood, pose, fit.refined.state.tool_from_sensor))
    if not found:
        return start
    found.sort(key=lambda one: -one[0])
    likely, best, end = found[0]
    for other, _, other_end in found[1:]:
        if likely - other < LIKELIER and _apart_deg(end, other_end) > APART_DEG:
            return FitFailure(
                f"{len(nodes.used_postures)} postures leave different hand-eyes that explain the "
                f"stripes equally well, {_in_words(end, other_end)} apart{cause}",
                f"add postures: {REMEDY}",
            )
    return replace(start, tool_from_sensor=best)


def _apart_deg(one: Pose[Tool, Sensor], other: Pose[Tool, Sensor]) -> float:
    cosine = 0.5 * (float((one.rotation * other.rotation).sum()) - 1.0)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _in_words(one: Pose[Tool, Sensor], other: Pose[Tool, Sensor]) -> str:
    shift = float(np.linalg.norm(one.translation_mm - other.translation_mm))
    return f"{_apart_deg(one, other):.1f} deg and {shift:.1f} mm"


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
