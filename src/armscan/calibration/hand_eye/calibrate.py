# SPDX-License-Identifier: Apache-2.0
"""Hand-eye calibration on a plate and on a sphere, from stripes with poses to result or refusal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armscan.calibration.hand_eye.alternatives import (
    BETTER,
    find_free_plane,
    find_mirror,
    other_readings,
)
from armscan.calibration.hand_eye.checks import (
    ALIKE_DEG,
    LIKELIER,
    MOST_OPEN_MM,
    VARY_POSTURES,
    CheckedFit,
    agreement_warnings,
    common_to_postures,
    conditioning_warnings,
    estimate_and_check,
    explain_misfit,
    influence_warnings,
    likeliest_start,
    point_warnings,
    principal_turns_deg,
    refuse_few_postures,
    refuse_hardly_determined,
    refuse_underdetermined,
    scatter_warnings,
)
from armscan.calibration.hand_eye.estimate import (
    HandEyeSolution,
    JointCovariance,
    LeftOut,
    Problem,
    conditioning_at,
    estimate_robustly,
    joint_covariance,
    leave_each_out,
    minimise_distances,
)
from armscan.calibration.hand_eye.observations import (
    CircleSection,
    HandEyeOptions,
    PlateReference,
    PosedStripe,
    check_diameter,
    check_postures,
    condense_plate,
    condense_sphere,
    find_sections,
    straight_stripes,
)
from armscan.calibration.hand_eye.result import (
    HandEyeFit,
    diameter_asked,
    hand_eye_calibration,
    plate_facts,
    posture_results,
    refuse_diameter,
    sphere_facts,
    sphere_warnings,
    stripe_residuals,
)
from armscan.calibration.hand_eye.search import (
    APART_ON_SPHERE_RAD,
    Start,
    find_start,
    minima_on_sphere,
    turn_between_rad,
)
from armscan.calibration.hand_eye.surface import (
    N_HAND_EYE,
    Conditioning,
    HandEyeState,
    PlateSurface,
    SphereSurface,
)
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose, Sensor, Tool

START_PIECES, START_POINTS = 6, 48
"""Of each stripe on a sphere, for the search; the estimate takes all."""
ALIKE_COST = 9.0
"""Minima whose sum of squares is not larger by more than this factor are compared in earnest."""
LEAST_RESIDUAL_MM = 1e-4
LIKELY_DIAMETER = 0.2
"""Part of the diameter by which it may have been mistaken."""
NAMED_STRIPES = 3
MOST_READ = 24
"""Stripes on a sphere, evenly spread, that other readings of the poses are tried on."""
TURN_ERROR_DEG, TURN_OVER_ERROR = 0.3, 5.0
"""A tool of which no posture turns by more than so many times what arms and robots err by, unless
that is given, about a second axis may not turn at all."""
UNDERDETERMINED_PART, UNDERDETERMINED_MM = 0.2, 2.0
"""A combination known less well than this part of the diameter and than this is not determined."""
TURN_THE_TOOL = (
    "scan the sphere from 8 or more postures that turn about at least two axes, each cutting it "
    "at another height"
)
SCAN_MORE = (
    "scan from more postures, which turn further and whose stripes cross the sphere at other "
    "heights, or take a larger sphere"
)
_OPEN = FitFailure("the postures do not determine hand-eye and sphere together", TURN_THE_TOOL)


def calibrate_on_plate(
    stripes: Sequence[PosedStripe],
    plate: PlateReference,
    options: HandEyeOptions | None = None,
    *,
    sensor_covariance: FloatArray | None = None,
) -> HandEyeFit | FitFailure:
    """Find where the sensor sits on the arm's last link (2.3.3.2).

    The linear start solves eq. 2.72 for the unknowns that one light sheet determines. The
    refinement minimises eq. 2.76 over the six parameters of eq. 2.69 and 2.70, weighted by the
    covariance of all residuals: pose errors common to a posture, smooth flatness of the plate,
    stripe noise and the uncertainty of the probed plane. Scatter that is not given is estimated.

    Parameters
    ----------
    stripes
        One entry an exposure; equal postures were taken without moving the arm.
    plate
        The plate in Base.
    options
        Defaults if None.
    sensor_covariance
        (P, P) of the sensor's parameters, in the order of the stripes' ``dpoint_dsensor``: its
        errors bend all stripes alike, and are not taken for something that moved. The hand-eye
        returned belongs to the sensor as the stripes move it within this covariance
        (`HandEyeFit.sensor_step`); ``dhand_eye_dsensor`` carries on what it may still err by. None
        takes it as exact.

    Returns
    -------
    HandEyeFit
        The hand-eye with its covariance and evidence, or why there is none.

    Raises
    ------
    InputError
        If one posture's name stands for different poses.
    """
    options = options or HandEyeOptions()
    check_postures(stripes, options)
    kept, surface = straight_stripes(stripes), PlateSurface(plate)
    observations = replace(
        condense_plate(stripes, kept, options.per_stripe or surface.per_stripe),
        sensor_covariance=sensor_covariance,
    )
    problem = Problem(observations, surface, options)
    few = refuse_few_postures(problem, VARY_POSTURES)
    if few is not None:
        return few
    start = find_start(observations, surface)
    cause = common_to_postures(observations, surface.plane)
    refusal = _refuse_start(problem, surface, start, cause)
    if refusal is not None:
        also = "".join(f"; {warning}" for warning in point_warnings(stripes, kept))
        return FitFailure(refusal.reason + also, refusal.remedy)
    likeliest = likeliest_start(problem, start, cause)
    if isinstance(likeliest, FitFailure):
        return likeliest
    mirror = find_mirror(problem, surface, likeliest)
    if mirror is not None:
        return mirror
    checked = estimate_and_check(problem, surface, likeliest, cause)
    if isinstance(checked, FitFailure):
        return checked
    return _fit_on_plate(stripes, kept, surface, likeliest, checked, cause=cause)


def _refuse_start(
    problem: Problem, plate: PlateSurface, start: Start, cause: str
) -> FitFailure | None:
    state = problem.start(start.tool_from_sensor)
    refusal = refuse_underdetermined(conditioning_at(problem, state), cause, VARY_POSTURES)
    limit_mm = problem.far_mm(problem.place(state))
    if refusal is not None or start.typical_mm <= limit_mm:
        return refusal
    free = find_free_plane(problem, plate) if problem.options.solve_plate else None
    if free is not None and free[2] <= limit_mm:
        return None  # the plane that was given is a start only
    return explain_misfit(problem, plate, start)


def _fit_on_plate(
    stripes: Sequence[PosedStripe],
    kept: tuple[BoolArray, ...],
    plate: PlateSurface,
    start: Start,
    checked: CheckedFit,
    *,
    cause: str,
) -> HandEyeFit | FitFailure:
    fit = checked.fit
    conditioning, left = _conditioning(fit), leave_each_out(fit)
    refused = refuse_hardly_determined(conditioning, MOST_OPEN_MM, cause, VARY_POSTURES)
    if refused is not None:
        return refused
    rows, joint = [np.flatnonzero(mark) for mark in kept], joint_covariance(fit)
    conditioning = conditioning.under(joint.hand_eye + checked.widening)
    found = _evidence(
        checked,
        joint,
        conditioning,
        left,
        stripes=list(zip(stripes, rows, strict=True)),
        start=start.linear or start.tool_from_sensor,
    )
    warnings = (
        *checked.warnings,
        *conditioning_warnings(conditioning, len(found.postures), cause),
        *agreement_warnings(fit, plate),
        *scatter_warnings(fit),
        *influence_warnings(fit.problem.observations.postures, left, joint.given_sensor),
        *point_warnings(stripes, kept),
    )
    return replace(found, reference=plate_facts(checked, plate), warnings=warnings)


def _conditioning(fit: HandEyeSolution) -> Conditioning:
    return conditioning_at(fit.problem.about_common_centre, fit.state, fit.noise.sigmas)


def _evidence(
    checked: CheckedFit,
    joint: JointCovariance,
    conditioning: Conditioning,
    left: dict[int, LeftOut],
    *,
    stripes: Sequence[tuple[PosedStripe, IntArray]],
    start: Pose[Tool, Sensor],
) -> HandEyeFit:
    """The result without words; ``stripes`` with the rows of their points that were used."""
    residuals = stripe_residuals(stripes, checked.fit)
    postures = posture_results(checked.fit, residuals, left)
    calibration = hand_eye_calibration(
        checked, joint, conditioning, stripes=residuals, postures=postures
    )
    return HandEyeFit(
        calibration=calibration,
        start=start,
        stripes=residuals,
        postures=postures,
        reference=(),
        sensor_step=checked.fit.state.sensor,
        sensor_covariance=joint.sensor,
    )


def calibrate_on_sphere(
    stripes: Sequence[PosedStripe],
    diameter_mm: float,
    options: HandEyeOptions | None = None,
    *,
    sensor_covariance: FloatArray | None = None,
) -> HandEyeFit | FitFailure:
    """Find the hand-eye from stripes on a sphere that does not move, from whatever postures.

    Eq. 2.46 places every stripe point in Base; its distance from the sphere's surface is the
    residual. Hand-eye and centre are unknown. Neither the section circle nor postures that only
    shift are needed, and no side of the sheet has to be told.

    Parameters
    ----------
    stripes
        Exposures with the arm's pose; points off the sphere are rejected.
    diameter_mm
        Of the sphere.
    options
        Defaults if None.
    sensor_covariance
        As of `calibrate_on_plate`.

    Returns
    -------
    HandEyeFit
        With method "sphere"; covariance from the scatter of the arm's pose (common to a posture)
        and of the stripe, both estimated from the residuals unless given.

    Raises
    ------
    InputError
        If one posture's name stands for different poses.
    OptionError
        If the diameter is none.
    """
    options = options or HandEyeOptions()
    check_diameter(diameter_mm)
    check_postures(stripes, options)
    surface = SphereSurface(0.5 * diameter_mm)
    sections, left_out = find_sections(stripes, surface.radius_mm)
    refused = _refuse_sections(sections, left_out, diameter_mm)
    if refused is not None:
        return refused
    thinned = tuple(section.thinned(START_POINTS) for section in sections)
    few = Problem(condense_sphere(thinned, START_PIECES), surface, options).about_common_centre
    refused = refuse_few_postures(few, TURN_THE_TOOL)
    if refused is not None:
        return refused
    starts = _search(few, thinned)
    if isinstance(starts, FitFailure):
        return starts
    observations = replace(
        condense_sphere(sections, options.per_stripe or surface.per_stripe),
        sensor_covariance=sensor_covariance,
    )
    best = _likeliest(Problem(observations, surface, options), starts)
    if isinstance(best, FitFailure):
        return best
    return _fit_on_sphere(sections, left_out, *best)


def _refuse_sections(
    sections: Sequence[CircleSection], left_out: Sequence[str], diameter_mm: float
) -> FitFailure | None:
    """Refuse where most stripes do not show the sphere."""
    if not sections and not left_out:
        return FitFailure("no exposure has a stripe on the sphere", TURN_THE_TOOL)
    if len(left_out) <= len(sections):
        return None
    return FitFailure(
        f"{len(left_out)} stripes show no section of a sphere of {diameter_mm:g} mm diameter, "
        f"{len(sections)} do: {'; '.join(left_out[:NAMED_STRIPES])}",
        "check the sphere's diameter, and that the stripes lie on the sphere",
    )


def _search(
    few: Problem, sections: Sequence[CircleSection]
) -> tuple[HandEyeState, ...] | FitFailure:
    """Distinct minima of the plain sum of squares that are nearly the least, best first."""
    n, radius_mm = len(few.observations), float(few.surface.start[3])
    fixed_radius = np.arange(N_HAND_EYE + 3)
    ends = []
    for start in minima_on_sphere(sections, radius_mm):
        found = minimise_distances(few, start, np.eye(n), fixed_radius)
        if found is not None:
            ends.append((found.chi2, found.state))
    ends.sort(key=lambda end: end[0])
    limit = ALIKE_COST * (ends[0][0] + n * LEAST_RESIDUAL_MM**2)
    kept: list[HandEyeState] = []
    for cost, state in ends:
        if cost <= limit and all(_is_apart(state, one) for one in kept):
            found = minimise_distances(few, state, np.eye(n))
            kept.append(state if found is None else found.state)
    refused = _refuse_far(few, kept[0])
    if refused is not None:
        refused = _misread(few, sections, refused, _typical_mm(few, kept[0]))
    else:
        # All that the points scatter counts as the arm's here; the estimate tells how much is.
        most_mm = max(UNDERDETERMINED_PART * 2.0 * radius_mm, MOST_OPEN_MM)
        refused = _refuse_open(few, conditioning_at(few, kept[0]), most_mm)
    return tuple(kept) if refused is None else refused


def _is_apart(one: HandEyeState, other: HandEyeState) -> bool:
    turn_rad = turn_between_rad(one.tool_from_sensor, other.tool_from_sensor)
    return turn_rad > APART_ON_SPHERE_RAD


def _refuse_open(problem: Problem, conditioning: Conditioning, most_mm: float) -> FitFailure | None:
    """Refuse postures that leave a combination of the unknowns open, or known worse than that.

    What the arm errs in turning is no turn: of a tool that never turned it would tell a hand-eye.
    """
    cause, remedy = ": the tool hardly turns, or about one axis only", TURN_THE_TOOL
    about_second_deg = principal_turns_deg(problem.observations)[:, 1]
    given_rad = problem.options.arm_rotation_rad
    error_deg = TURN_ERROR_DEG if given_rad is None else float(np.degrees(given_rad))
    if np.abs(about_second_deg).max() < TURN_OVER_ERROR * error_deg:
        return FitFailure(f"the postures do not determine the hand-eye{cause}", remedy)
    if np.sqrt((about_second_deg**2).mean()) > ALIKE_DEG:
        cause, remedy = (
            ", though the tool turns: the scatter of arm and stripes or the sensor leaves it open",
            SCAN_MORE,
        )
    return refuse_hardly_determined(conditioning, most_mm, cause, remedy)


def _refuse_far(problem: Problem, state: HandEyeState) -> FitFailure | None:
    """Refuse points that stay away from any sphere; say whether another diameter would do."""
    problem = problem.about_common_centre
    limit_mm = problem.far_mm(problem.place(state))
    typical_mm = _typical_mm(problem, state)
    if not typical_mm > limit_mm:
        return None
    diameter_mm = 2.0 * float(state.surface[3])
    reason = (
        f"no hand-eye puts the points on one sphere of {diameter_mm:g} mm diameter: "
        f"they stay {typical_mm:.2f} mm away (median)"
    )
    plain, columns = np.eye(len(problem.observations)), np.arange(N_HAND_EYE + 4)
    freed = minimise_distances(problem, state, plain, columns)
    if freed is not None and _typical_mm(problem, freed.state) < min(0.5 * typical_mm, limit_mm):
        better_mm = 2.0 * float(freed.state.surface[3])
        if abs(better_mm / diameter_mm - 1.0) < LIKELY_DIAMETER:
            reason += f"; {better_mm:.1f} mm would fit"
    return FitFailure(
        reason,
        "check the convention of the arm's angles, the order of poses and profiles, the "
        "sphere's diameter, and that the sphere did not move",
    )


def _misread(
    few: Problem, sections: Sequence[CircleSection], refused: FitFailure, typical_mm: float
) -> FitFailure:
    """The refusal, with another way to read the poses that would do if there is one."""
    given = [section.stripe.base_from_tool for section in sections]
    rotations = np.array([pose.rotation for pose in given])
    translations = np.array([pose.translation_mm for pose in given])
    radius_mm = float(few.surface.start[3])
    some = np.unique(np.linspace(0, len(sections) - 1, MOST_READ).round().astype(int))
    for words, remedy, turns, shifts in other_readings(rotations, translations):
        read = [
            replace(one, stripe=replace(one.stripe, base_from_tool=Pose(turns[k], shifts[k])))
            for k, one in ((k, sections[k]) for k in some.tolist())
        ]
        problem = replace(few, observations=condense_sphere(read, START_PIECES))
        found = [(_typical_mm(problem, each), each) for each in minima_on_sphere(read, radius_mm)]
        left_mm, state = min(found, key=lambda one: one[0])
        if left_mm < BETTER * typical_mm and left_mm <= problem.far_mm(problem.place(state)):
            return FitFailure(f"{refused.reason}; {words} would leave {left_mm:.3f} mm", remedy)
    return refused


def _typical_mm(problem: Problem, state: HandEyeState) -> float:
    return float(np.median(np.abs(problem.place(state).residual_mm)))


def _likeliest(
    problem: Problem, starts: Sequence[HandEyeState]
) -> tuple[HandEyeState, HandEyeSolution] | FitFailure:
    """The likeliest of the solutions, refused where another one is nearly as likely."""
    found = [(start, estimate_robustly(problem, start)) for start in starts]
    solved = [(start, one) for start, one in found if one is not None]
    if not solved:
        return _OPEN
    solved.sort(key=lambda pair: -pair[1].linear.log_likelihood)
    start, best = solved[0]
    refused = _refuse_far(problem, best.state)
    if refused is None:
        diameter_mm = 2.0 * float(start.surface[3])
        most_mm = max(UNDERDETERMINED_PART * diameter_mm, UNDERDETERMINED_MM)
        refused = _refuse_open(problem, _conditioning(best), min(most_mm, MOST_OPEN_MM))
    if refused is not None:
        return refused
    for _, other in solved[1:]:
        lost = best.linear.log_likelihood - other.linear.log_likelihood
        if lost < LIKELIER and _is_apart(best.state, other.state):
            return FitFailure(
                "two quite different hand-eyes explain the stripes equally well: seen from the "
                "sensor, the sphere's centre moved within one plane only",
                "vary the stand-off too: nearer and farther by 15 % and more",
            )
    return start, best


def _fit_on_sphere(
    sections: Sequence[CircleSection],
    left_out: Sequence[str],
    start: HandEyeState,
    fit: HandEyeSolution,
) -> HandEyeFit | FitFailure:
    asked = diameter_asked(fit)
    refused = None if asked is None else refuse_diameter(asked, fit)
    if refused is not None:
        return refused
    rows: dict[int, tuple[PosedStripe, IntArray]] = {}
    for section in sections:
        stripe, before = rows.get(id(section.stripe), (section.stripe, np.zeros(0, np.int64)))
        rows[id(stripe)] = (stripe, np.concatenate([before, section.rows]))
    left, joint = leave_each_out(fit), joint_covariance(fit)
    conditioning = _conditioning(fit).under(joint.hand_eye)
    found = _evidence(
        CheckedFit(fit),
        joint,
        conditioning,
        left,
        stripes=list(rows.values()),
        start=start.tool_from_sensor,
    )
    warnings = (
        *left_out,
        *conditioning_warnings(conditioning, len(found.postures), ""),
        *scatter_warnings(fit),
        *sphere_warnings(fit, sections, found.postures, asked),
    )
    return replace(found, reference=sphere_facts(fit, joint, asked), warnings=warnings)
