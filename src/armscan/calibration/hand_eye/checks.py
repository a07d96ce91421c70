# SPDX-License-Identifier: Apache-2.0
"""Do reference, poses and stripes belong together? What is wrong, in words a person can act on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import comb
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from armscan.calibration.hand_eye.alternatives import (
    BETTER,
    FIND_WHAT_MOVED,
    PROBE_AGAIN,
    UNCHECKED_PLANE,
    Alternative,
    find_alternatives,
    find_contradiction,
    find_free_plane,
    find_mirror,
    find_reading,
    offset_in_words,
    plane_in_words,
)
from armscan.calibration.hand_eye.estimate import (
    HandEyeSolution,
    LeftOut,
    Problem,
    conditioning_at,
    estimate,
    leave_each_out,
)
from armscan.calibration.hand_eye.observations import (
    MIN_POINTS,
    CondensedObservations,
    PosedStripe,
)
from armscan.calibration.hand_eye.search import (
    GROSS_MM,
    GROSS_RATIO,
    Start,
    camera_heights_mm,
    evenly_spread,
    find_start,
    posture_rms_at,
    thinned,
    turn_between_rad,
)
from armscan.calibration.hand_eye.surface import N_HAND_EYE, Conditioning, PlateSurface
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.shapes import Plane

MAX_CONDITION = 100.0
GOOD_POSTURES = 6
LEAST_FREEDOM, LEAST_TO_ESTIMATE = 2, 4
"""Numbers beyond the unknowns: for telling hand-eyes apart, and for the arm's scatter, too."""
TOLD_BY_STRIPE, TOLD_BY_AREA, TOLD_BY_SECTION = 2, 3, 3
"""Numbers of a posture: shift and slope; shift and two slopes; the centre of a section circle."""
AS_AREA = 0.2
"""Second extent over the first from which stripes of a posture show two slopes of the plate."""
LIKELIER = 6.0
"""Logarithm of the likelihood ratio from which one minimum is preferred to another: 400 to 1."""
SURELY_LIKELIER = 20.0
"""And from which three points of each stripe are enough: they hardly tell flatness and noise of the
stripes from the arm, which moved the logarithm by 0.6 to 2.2 in three cases looked into."""
MOST_ALTERNATIVES = 4
APART_DEG = 1.0
ALIKE_DEG, SMALL_DEG = 3.0, 8.0
"""Tilts that count as none, and as small."""
FLAT_RATIO = 0.15
"""Extent of the normals off their plane over that within it, below which they are in one plane."""
SAME_STAND_OFF = 0.03
"""Standard deviation of the stand-off over its mean, below which it counts as constant."""
VARY_POSTURES = (
    "tilt the head by 30 to 45 degrees in two or more directions, turn it about its own axis, and "
    "vary the distance by 15 %"
)
LARGE_ARM_MM = 0.1
MOST_ARM_MM = 0.25
"""An estimated scatter that is surely (two sigma) larger is no arm's. Robots reach 0.15."""
FAR_ARM_MM = 1.0
"""Nor is one that is larger than this, however badly it is known."""
MOST_OPEN_MM = 10.0
"""A hand-eye in which something is known worse measures nothing; as a turn it is six degrees, at
which a linearised covariance ends, too."""
UNKNOWN_ARM = 0.6
"""Standard deviation of the logarithm of the arm's scatter from which it is hardly known: a factor
of 1.8."""
REJECTED_SHARE = 0.2
MAX_MOVE_SIGMA = 5.0
LEAST_TO_SPLIT = 8
GROSS_TILT_DEG, GROSS_OFFSET_MM = 3.0, 10.0
"""A plate that seems to lie further off than this was hardly probed wrongly: poses that are read
wrongly are asked for first."""
FREE_PLANE_SHARE = 0.2
"""A plane left free is to blame where it leaves less than this part of the distances."""
MAX_WRONG_SHARE = 0.34
LEAST_LEFT = 6
SUSPECT_PROBABILITY = 0.2
WRONG_PROBABILITY = 1e-3
"""Probability, over all choices of as many postures, of a shift and slope like those of the posture
where the scatter is only as well known as the others show it."""
AS_WELL = 1.5
"""What moved is believed if it leaves the arm less scatter than this many times what leaving
postures out does."""
NO_SOLUTION = FitFailure(
    "the refinement found no minimum: the noise model or the data are degenerate",
    "check the standard deviations given, and the poses",
)


def refuse_underdetermined(
    conditioning: Conditioning, cause: str, remedy: str
) -> FitFailure | None:
    """Refuse a system of rank below six; ``cause`` says what the postures have in common."""
    if conditioning.rank == N_HAND_EYE:
        return None
    return FitFailure(
        f"the postures determine only {conditioning.rank} of the hand-eye's 6 parameters{cause} "
        f"(least known: {conditioning.weakest})",
        remedy,
    )


def refuse_hardly_determined(
    conditioning: Conditioning, most_mm: float, cause: str, remedy: str
) -> FitFailure | None:
    """Refuse what leaves a combination of the unknowns open, or known worse than ``most_mm``.

    Turns are counted as everywhere in `Conditioning`.
    """
    refused = refuse_underdetermined(conditioning, cause, remedy)
    if refused is None and conditioning.singular_values[-1] * most_mm < 1.0:
        return FitFailure(
            f"the postures hardly determine the hand-eye{cause} (limit {most_mm:.3g} mm; least "
            f"known: {conditioning.weakest})",
            remedy,
        )
    return refused


def refuse_few_postures(problem: Problem, remedy: str) -> FitFailure | None:
    """Refuse postures that do not tell hand-eyes apart, or not how much the arm scatters.

    A stripe tells a shift and a slope of its posture's pose, stripes over an area a shift and two
    slopes, a section of a sphere three shifts. As many numbers as unknowns are met exactly by
    several hand-eyes, right and wrong. Two more than unknowns tell these apart, but no scatter:
    four more are needed, unless it is given (``arm_position_mm``; the other scatters do not count).
    """
    told = _told_by_postures(problem)
    n_told, n_unknown = sum(told), len(problem.columns)
    n_if_given, n_needed = n_unknown + LEAST_FREEDOM, n_unknown + LEAST_TO_ESTIMATE
    is_given = problem.options.arm_position_mm is not None
    if n_told >= (n_if_given if is_given else n_needed):
        return None
    each = min(told, default=TOLD_BY_STRIPE)
    least, least_if_given = (
        len(told) + -(-max(n - n_told, 0) // each) for n in (n_needed, n_if_given)
    )
    why, count = f"need {n_needed}, to fit one hand-eye only and show the arm's scatter", least
    if is_given:
        why, count = f"need {n_if_given}, to fit one hand-eye only", least_if_given
    also = ""
    if not is_given and least_if_given < least:
        also = f" ({least_if_given} if the arm's scatter is given, --arm-position-mm)"
    return FitFailure(
        f"{len(told)} posture{'s are' if len(told) != 1 else ' is'} too few: "
        f"{_told_in_words(problem, each)}, {n_told} in all; {_unknowns_in_words(problem)} {why}",
        f"scan from {count} postures at least{also}, better 12; {remedy}",
    )


def _told_in_words(problem: Problem, each: int) -> str:
    if not isinstance(problem.surface, PlateSurface):
        return "a section of the sphere tells three numbers of a posture, where its centre lies"
    if each == TOLD_BY_AREA:
        return "crossed stripes tell three numbers of a posture, the plate's distance and two tilts"
    return "points along a line tell two numbers of a posture, the plate's distance and one tilt"


def _unknowns_in_words(problem: Problem) -> str:
    n_all, has_scale = len(problem.columns), problem.options.solve_scale
    n_other = n_all - N_HAND_EYE - has_scale
    surface = "plate" if isinstance(problem.surface, PlateSurface) else "sphere"
    words = [f"{N_HAND_EYE} of the hand-eye"]
    words += [f"{n_other} of the {surface}"] * (n_other > 0) + ["the scale"] * has_scale
    return f"{n_all} unknowns ({', '.join(words)})" if len(words) > 1 else f"{n_all} unknowns"


def _told_by_postures(problem: Problem) -> list[int]:
    """How many numbers each posture tells of its pose."""
    observations = problem.observations
    if not isinstance(problem.surface, PlateSurface):
        return [TOLD_BY_SECTION] * len(observations.used_postures)
    told = []
    for posture in observations.used_postures:
        points = observations.points_mm[observations.of_points(observations.posture) == posture]
        extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        is_area = extent[1] > AS_AREA * extent[0]
        told.append(TOLD_BY_AREA if is_area else TOLD_BY_STRIPE)
    return told


def conditioning_warnings(
    conditioning: Conditioning, n_postures: int, cause: str
) -> tuple[str, ...]:
    """What is weak about the postures of a solved hand-eye."""
    warnings = []
    if n_postures < GOOD_POSTURES:
        warnings.append(
            f"{n_postures} postures only: a wrong one would not be noticed, and the hand-eye is "
            f"several times less certain than from 12; use at least {GOOD_POSTURES}, better 12"
        )
    if conditioning.condition > MAX_CONDITION:
        warnings.append(
            f"the hand-eye is badly determined (condition {conditioning.condition:.0f}, good is "
            f"below {MAX_CONDITION:.0f}){cause}; least known: {conditioning.weakest}"
        )
    elif cause:
        warnings.append(
            f"the postures are less varied than they should be{cause}; least known: "
            f"{conditioning.weakest}"
        )
    return tuple(warnings)


def principal_turns_deg(observations: CondensedObservations) -> FloatArray:
    """(P, 3) turns of postures from their mean, about the axes of their spread, widest first."""
    stripes = observations.stripe[np.unique(observations.posture, return_index=True)[1]]
    rotations = observations.rotations[stripes]
    turns = Rotation.from_matrix(rotations[0].T @ rotations).as_rotvec()
    turns -= turns.mean(axis=0)
    return np.asarray(np.degrees(turns @ np.linalg.svd(turns)[2].T))


def common_to_postures(observations: CondensedObservations, plane: Plane) -> str:
    """Say what keeps the postures from being independent; empty if nothing does.

    The plate's normals in Tool decide: without turning, or turning about the normal only, they
    are all alike; with tilts in one azimuth only they lie in a plane through the origin.
    """
    used = observations.used_postures
    first = [int(np.flatnonzero(observations.posture == k)[0]) for k in used]
    rotations = observations.rotations[observations.stripe[first]]
    normals = np.einsum("pij,i->pj", rotations, plane.normal)
    extent = np.linalg.svd(normals - normals.mean(axis=0), compute_uv=False) / np.sqrt(len(normals))
    through_origin = np.linalg.svd(normals, compute_uv=False) / np.sqrt(len(normals))
    tilt_deg = float(np.degrees(np.hypot(extent[0], extent[1])))
    causes = []
    if tilt_deg < ALIKE_DEG:
        cosine = 0.5 * (np.einsum("pij,ij->p", rotations, rotations[0]) - 1.0)
        turn_deg = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max())
        causes.append(
            "the arm never turned, it only shifted"
            if turn_deg < ALIKE_DEG
            else "the arm turned about the plate's normal only"
        )
    elif tilt_deg < SMALL_DEG:
        causes.append(f"the head was hardly tilted (by {tilt_deg:.0f} deg, root mean square)")
    elif through_origin[2] < FLAT_RATIO * extent[0]:
        causes.append("the head was tilted in one azimuth plane only")
    points, posture = observations.points_mm, observations.posture
    middles = np.array([points[posture == k].mean(axis=0) for k in used])
    stand_off = np.linalg.norm(middles, axis=1)
    if float(stand_off.std()) < SAME_STAND_OFF * float(stand_off.mean()):
        causes.append(f"the stand-off was always about {stand_off.mean():.0f} mm")
    return ": " + ", and ".join(causes) if causes else ""


def likeliest_start(problem: Problem, start: Start, cause: str) -> Start | FitFailure:
    """Take the likeliest of the start and its alternatives; refuse where another is as likely.

    ``cause`` says what the postures have in common.
    """
    if not start.alternatives:
        return start
    kept = problem.without(start.is_wrong).observations
    poses = (start.tool_from_sensor, *start.alternatives[:MOST_ALTERNATIVES])
    few, whole = thinned(kept), evenly_spread(kept)
    found = _by_likelihood(replace(problem, observations=few), poses)
    if not found:
        return start
    close = [one.end for one in found if found[0].likelihood - one.likelihood < SURELY_LIKELIER]
    if len(close) > 1 and len(whole.stripe) > len(few.stripe):
        asked = replace(problem, observations=whole)
        found = _by_likelihood(asked, close, is_all_asked=True) or found
    best = found[0]
    if len(found) > 1 and best.likelihood - found[1].likelihood < LIKELIER:
        other = found[1].end
        apart_deg = np.degrees(turn_between_rad(best.end, other))
        shift_mm = float(np.linalg.norm(best.end.translation_mm - other.translation_mm))
        return FitFailure(
            f"{len(problem.observations.used_postures)} postures leave different hand-eyes "
            f"that explain the stripes equally well, {apart_deg:.1f} deg and {shift_mm:.1f} mm "
            f"apart{cause}",
            f"add postures: {VARY_POSTURES}",
        )
    return replace(start, tool_from_sensor=best.start)


class _Candidate(NamedTuple):
    """A hand-eye, where the estimate from it ends, and the logarithm of its likelihood there."""

    likelihood: float
    start: Pose[Tool, Sensor]
    end: Pose[Tool, Sensor]


def _by_likelihood(
    problem: Problem, poses: Sequence[Pose[Tool, Sensor]], *, is_all_asked: bool = False
) -> list[_Candidate]:
    """Different ends of the estimates from several hand-eyes, the likeliest first.

    None of them if one finds no minimum and ``is_all_asked``.
    """
    fits = [(pose, estimate(problem, problem.start(pose))) for pose in poses]
    if is_all_asked and any(fit is None for _, fit in fits):
        return []
    found = [
        _Candidate(fit.log_likelihood, pose, fit.state.tool_from_sensor)
        for pose, fit in fits
        if fit is not None
    ]
    kept: list[_Candidate] = []
    for one in sorted(found, key=lambda one: -one.likelihood):
        if all(np.degrees(turn_between_rad(one.end, other.end)) > APART_DEG for other in kept):
            kept.append(one)
    return kept


def explain_misfit(problem: Problem, plate: PlateSurface, start: Start) -> FitFailure:
    """Say why no hand-eye fits: another plane, another reading of the poses, or neither."""
    observations = problem.observations
    limit_mm = problem.far_mm(problem.place(problem.start(start.tool_from_sensor)))
    typical_mm = start.typical_mm
    fact = (
        f"no hand-eye fits: the stripes of the typical posture lie {typical_mm:.2f} mm from "
        f"the plate, more than {limit_mm:.3g} mm"
    )
    refusal = find_mirror(problem, plate, start, smaller=BETTER)
    if refusal is None:
        refusal = _split(observations, plate, typical_mm, fact)
    if refusal is not None:
        return refusal
    free = find_free_plane(problem, plate)
    if free is None:
        fact += "; another plane could not be tried, the postures do not determine it"
    is_plate = free is not None and free[2] < FREE_PLANE_SHARE * typical_mm
    if free is not None and is_plate:
        offset_mm, tilt_deg, free_mm = free
        if abs(offset_mm) > GROSS_OFFSET_MM or tilt_deg > GROSS_TILT_DEG:
            most_mm = min(free_mm, limit_mm)
            misread = find_reading(observations, plate, fact, typical_mm, most_mm=most_mm)
            if misread is not None:
                return misread
            is_plate = free_mm <= limit_mm
        if is_plate:
            where = offset_in_words(offset_mm, tilt_deg, plate.reference)
            return FitFailure(
                f"{fact}; with the plate's plane left free it is {free_mm:.3f} mm, and the "
                f"plane then lies {where}",
                PROBE_AGAIN,
            )
    misread = find_reading(observations, plate, fact, typical_mm, most_mm=limit_mm)
    if misread is not None:
        return misread
    return FitFailure(
        fact,
        "check the rotation convention of the poses, that every exposure has its own pose, that "
        "the plate was neither moved nor exchanged between probing and scanning, and that the "
        "sensor's calibration is this one",
    )


def _split(
    observations: CondensedObservations, plate: PlateSurface, typical_mm: float, fact: str
) -> FitFailure | None:
    """Refuse postures of which the first and the last each agree, but not with each other."""
    used, names = observations.used_postures, observations.postures
    if len(used) < LEAST_TO_SPLIT:
        return None
    for order, which in ((used, "the former"), (used[::-1], "the latter")):
        first_half = np.isin(observations.posture, order[: len(order) // 2])
        half = find_start(observations.select(first_half), plate)
        if half.typical_mm > BETTER * typical_mm:
            continue
        rms = posture_rms_at(observations, plate, half.tool_from_sensor)[order]
        far = np.flatnonzero(rms > max(GROSS_RATIO * half.typical_mm, GROSS_MM))
        if not len(far) or not (rms[far[0] :] > GROSS_MM).all():
            continue
        first, second = sorted((int(order[far[0] - 1]), int(order[far[0]])))
        return FitFailure(
            f"{fact}; the postures up to {names[first]} and those from {names[second]} on do not "
            f"agree with each other: with the hand-eye of {which} ({half.typical_mm:.3f} mm) the "
            f"others lie {float(np.median(rms[far[0] :])):.2f} mm from the plate",
            FIND_WHAT_MOVED,
        )
    return None


@dataclass(frozen=True, slots=True, eq=False)
class CheckedFit:
    """A solution in which the sensor may err within its covariance, and what is weak about it.

    ``widening`` (6, 6) is added to the hand-eye's covariance for what contradicts it a little;
    ``plane_check`` is what the stripes alone say of the plate.
    """

    fit: HandEyeSolution
    warnings: tuple[str, ...] = ()
    widening: FloatArray = field(default_factory=lambda: np.zeros((N_HAND_EYE, N_HAND_EYE)))
    plane_check: str = ""


def estimate_and_check(
    problem: Problem, plate: PlateSurface, start: Start, cause: str
) -> CheckedFit | FitFailure:
    """Estimate, leave wrong postures out, and look for something that moved or is not as given.

    A plate that moved makes postures look wrong, and wrong postures may look like a plate that
    moved. If what moved explains all postures about as well as leaving some out explains the rest,
    it is believed.
    """
    first = _first_fit(problem, start, cause)
    if isinstance(first, FitFailure):
        return first
    checked = _without_wrong_postures(problem, start, first)
    usual_mm = (first if isinstance(checked, FitFailure) else checked.fit).arm_mm
    trials = [first]
    if start.is_wrong.any():
        whole = estimate(problem, problem.start(start.tool_from_sensor))
        trials += [] if whole is None else [whole]
    found: tuple[Alternative, ...] | None = None
    for fit in trials:
        alternatives = find_alternatives(fit)
        moved = find_contradiction(alternatives, fit, plate.reference)
        is_all = isinstance(checked, CheckedFit) and fit is checked.fit
        found = alternatives if is_all else found
        if moved is None or not moved.is_refused:
            continue
        if is_all or moved.arm_mm < AS_WELL * usual_mm:
            return moved.failure
    if isinstance(checked, FitFailure):
        return checked
    if found is None:
        found = find_alternatives(checked.fit)
    moved = find_contradiction(found, checked.fit, plate.reference)
    checked = _with_plane_check(checked, problem, found)
    if moved is None:
        refusal = refuse_scatter(checked.fit)
        return checked if refusal is None else refusal
    if moved.is_refused:
        return moved.failure
    warnings = (*checked.warnings, moved.failure.reason)
    return replace(checked, widening=moved.widening, warnings=warnings)


def _first_fit(problem: Problem, start: Start, cause: str) -> HandEyeSolution | FitFailure:
    """Refused where a usual arm leaves it open: that would be laid on the plate or the sensor."""
    first = estimate(problem.without(start.is_wrong), problem.start(start.tool_from_sensor))
    if first is None:
        return NO_SOLUTION
    usual = conditioning_at(first.problem, first.state)
    refusal = refuse_hardly_determined(usual, MOST_OPEN_MM, cause, VARY_POSTURES)
    return first if refusal is None else refusal


def _with_plane_check(
    checked: CheckedFit, problem: Problem, found: Sequence[Alternative]
) -> CheckedFit:
    """Say what the stripes alone say of the plate, and warn if that is nothing."""
    if problem.options.solve_plate:
        return checked
    words = plane_in_words(found)
    if words != UNCHECKED_PLANE:
        return replace(checked, plane_check=words)
    warning = f"the probed plane was {words}"
    return replace(checked, plane_check=words, warnings=(*checked.warnings, warning))


def _without_wrong_postures(
    problem: Problem, start: Start, first: HandEyeSolution
) -> CheckedFit | FitFailure:
    """Leave out postures whose pose is wrong.

    Those that seem gross at the start come back where the others do not contradict them. Of the
    rest, the posture that the others predict worst is left out for trial; if the scatter of the
    others then makes its distance all but impossible, it stays out, and the next one is tried.
    ``first`` is the fit without the gross ones.
    """
    wrong, fit = _with_doubted_postures(problem, start, first)
    while True:
        refusal = _refuse_many(problem.observations, wrong)
        if refusal is not None:
            return refusal
        suspect = _suspect(fit)
        if suspect is None or len(fit.problem.observations.used_postures) <= LEAST_LEFT:
            break
        trial = wrong.copy()
        trial[suspect] = True
        without = estimate(problem.without(trial), fit.state)
        if without is None:
            break
        chances = _chances(problem.without(wrong), without, int(trial.sum()))
        if chances.get(suspect, 1.0) >= WRONG_PROBABILITY:
            break
        wrong, fit = trial, without
    return CheckedFit(fit, _left_out_in_words(problem.observations, wrong, start))


def _suspect(fit: HandEyeSolution) -> int | None:
    left = leave_each_out(fit)
    worst = min(left, key=lambda number: left[number].probability)
    return worst if left[worst].probability * len(left) < SUSPECT_PROBABILITY else None


def _with_doubted_postures(
    problem: Problem, start: Start, first: HandEyeSolution
) -> tuple[BoolArray, HandEyeSolution]:
    """Take back, one by one, gross postures that the others do not contradict.

    The start fits few numbers with six unknowns: most postures of a few lie close to it, whatever
    they scatter, and the rest then seems gross.
    """
    wrong, fit = start.is_wrong.copy(), first
    while wrong.any():
        chances = {}
        for posture in np.flatnonzero(wrong).tolist():
            trial = wrong.copy()
            trial[posture] = False
            among = _chances(problem.without(trial), fit, int(wrong.sum()))
            chances[posture] = among.get(posture, 0.0)
        likeliest = max(chances, key=lambda posture: chances[posture])
        if chances[likeliest] < WRONG_PROBABILITY:
            break
        trial = wrong.copy()
        trial[likeliest] = False
        found = estimate(problem.without(trial), fit.state)
        if found is None:
            break
        wrong, fit = trial, found
    return wrong, fit


def _chances(problem: Problem, others: HandEyeSolution, n_chosen: int) -> dict[int, float]:
    """Probability of each posture of a problem by the scatter that ``others`` of it show.

    Scatter that was estimated from few postures is badly known, and it is least where the
    farthest were left out: Fisher's distribution stands for the normal one's chi-square, and the
    search over all choices of ``n_chosen`` postures counts. Empty where there is no solution.
    """
    judged = estimate(problem, others.state, others.noise.sigmas, hold_noise=True)
    if judged is None:
        return {}
    n_others = len(others.problem.observations.used_postures)
    freedom = max(TOLD_BY_STRIPE * n_others - len(problem.columns), 1)
    choices = comb(n_others + n_chosen, n_chosen)
    is_given = problem.options.arm_position_mm is not None
    return {
        posture: choices
        * (
            left.probability
            if is_given
            else float(fdtrc(TOLD_BY_STRIPE, freedom, left.pose_sigmas**2))
        )
        for posture, left in leave_each_out(judged).items()
    }


def _refuse_many(observations: CondensedObservations, wrong: BoolArray) -> FitFailure | None:
    used = observations.used_postures
    n_wrong = int(wrong[used].sum())
    if n_wrong <= MAX_WRONG_SHARE * len(used):
        return None
    names = ", ".join(observations.postures[k] for k in np.flatnonzero(wrong)[:8])
    return FitFailure(
        f"{n_wrong} of {len(used)} postures contradict the others ({names})",
        "check that every exposure has its own pose (none missing, doubled or swapped) and that "
        "the plate did not move",
    )


def _left_out_in_words(
    observations: CondensedObservations, wrong: BoolArray, start: Start
) -> tuple[str, ...]:
    """Name the postures that were left out."""
    names, warnings = observations.postures, []
    gross = np.flatnonzero(wrong & start.is_wrong)
    mild = np.flatnonzero(wrong & ~start.is_wrong)
    if len(gross):
        named = ", ".join(f"{names[k]} ({start.rms_mm[k]:.2f} mm)" for k in gross)
        warnings.append(
            f"left out {len(gross)} postures whose stripes lie far from where the others "
            f"put the plate: {named}; a missing, doubled or swapped pose looks like this"
        )
    if len(mild):
        named = ", ".join(f"{names[k]} ({start.rms_mm[k]:.3f} mm)" for k in mild)
        warnings.append(
            f"left out {len(mild)} postures that fit the others worse than their scatter "
            f"allows: {named}; the arm may have moved during the exposure, or the plate was dirty"
        )
    return tuple(warnings)


def refuse_scatter(fit: HandEyeSolution) -> FitFailure | None:
    """Refuse residuals that no arm explains; none where the arm's scatter was given."""
    arm_mm, sigma_log = fit.arm_mm, fit.log_arm_mm
    is_given = fit.problem.options.arm_position_mm is not None
    is_likely = arm_mm * np.exp(-2.0 * sigma_log) < MOST_ARM_MM and arm_mm < FAR_ARM_MM
    if is_given or is_likely:
        return None
    return FitFailure(
        f"the arm would have to scatter by {arm_mm:.2f} mm an axis to explain the stripes: no "
        f"measuring arm and hardly a robot does (limit {MOST_ARM_MM:g} mm)",
        "check that plate, poses, sensor and stripes belong together; where the arm is that bad, "
        "say so with --arm-position-mm",
    )


def agreement_warnings(fit: HandEyeSolution, plate: PlateSurface) -> tuple[str, ...]:
    """Warn of a plate seen from behind, and of an arm that scatters much."""
    warnings = []
    pose, observations = fit.state.tool_from_sensor, fit.problem.observations
    if float(np.median(camera_heights_mm(observations, plate.plane, pose))) < 0.0:
        warnings.append(
            "the plate's normal points away from the scanner: it was probed from the side that "
            "was not scanned, or its sign is arbitrary; a tip compensated to the wrong side "
            "shifts the plane by its diameter"
        )
    if not fit.is_settled:
        warnings.append(
            "the refinement had not settled when its steps ran out: the hand-eye may be off by "
            "more than stated"
        )
    arm_mm = fit.arm_mm
    if arm_mm > LARGE_ARM_MM and fit.problem.options.arm_position_mm is None:
        warnings.append(
            f"the arm's poses seem to scatter by {arm_mm:.2f} mm: much for a measuring arm; a bad "
            "sensor calibration or a plate that moved looks the same"
        )
    return tuple(warnings)


def scatter_warnings(fit: HandEyeSolution) -> tuple[str, ...]:
    """Warn where the stripes hardly tell how much the arm scatters."""
    is_given = fit.problem.options.arm_position_mm is not None
    if fit.log_arm_mm < UNKNOWN_ARM or is_given:
        return ()
    return (
        f"{len(fit.problem.observations.used_postures)} postures hardly tell how much the arm "
        f"scatters: the stated sigmas rest on an expected {fit.components[0].sigma:.3f} mm an "
        "axis; scan from more postures, or give --arm-position-mm",
    )


def influence_warnings(
    postures: Sequence[str], left_out: Mapping[int, LeftOut], covariance: FloatArray
) -> tuple[str, ...]:
    """Name the postures without which the hand-eye would move further than its sigma allows.

    ``left_out`` is what changes without each posture, by its number in ``postures``; ``covariance``
    (6, 6) or more is that of the hand-eye, in the order of the changes.
    """
    sigma = np.sqrt(np.diag(covariance)[:N_HAND_EYE])
    moves = {
        k: float(np.max(np.abs(left.change[:N_HAND_EYE]) / sigma)) for k, left in left_out.items()
    }
    far = sorted((k for k in moves if moves[k] > MAX_MOVE_SIGMA), key=lambda k: -moves[k])
    return tuple(
        f"without posture {postures[k]} the hand-eye would move by {moves[k]:.0f} of its "
        "stated sigmas: it rests on this posture; check its pose and exposures, or take more like "
        "it"
        for k in far[:3]
    )


def point_warnings(stripes: Sequence[PosedStripe], kept: Sequence[BoolArray]) -> tuple[str, ...]:
    """Count what did not lie on a straight stripe, and name exposures without any."""
    total = sum(len(mark) for mark in kept)
    left_out = total - sum(int(mark.sum()) for mark in kept)
    warnings = []
    if left_out > REJECTED_SHARE * total:
        warnings.append(
            f"{left_out} of {total} points are not on straight stripes and were left out: the "
            "stripes leave the plate, or it is not flat, or the sensor is badly calibrated"
        )
    empty = [one.source for one, mark in zip(stripes, kept, strict=True) if not bool(mark.any())]
    if empty:
        warnings.append(
            f"{len(empty)} exposures without a straight stripe of {MIN_POINTS} points: "
            f"{', '.join(empty[:6])}"
        )
    return tuple(warnings)
