# SPDX-License-Identifier: Apache-2.0
"""Hand-eye calibration on a plate and on a sphere, from stripes with poses to result or
refusal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armscan.calibration.hand_eye.alternatives import (
    find_alternatives,
    find_contradiction,
    find_mirror,
    plane_in_words,
)
from armscan.calibration.hand_eye.checks import (
    REMEDY,
    agreement_warnings,
    common_to_postures,
    explain_misfit,
    influence_warnings,
    point_warnings,
    refuse_scatter,
    settle_alternatives,
)
from armscan.calibration.hand_eye.estimate import (
    CheckedFit,
    PlateFit,
    fit_plate,
    fit_without_wrong_postures,
    hand_eye_information,
    hold_sensor,
    leave_each_out,
    plane_after,
)
from armscan.calibration.hand_eye.observations import (
    HandEyeOptions,
    PlateNodes,
    PlateReference,
    PlateState,
    PosedStripe,
    check_postures,
    condense,
    place_nodes,
    shifted_plane,
    straight_stripes,
)
from armscan.calibration.hand_eye.result import (
    HandEyeFit,
    hand_eye_calibration,
    posture_results,
    reference_facts,
    sigma_of,
    sphere_fit,
    stripe_residuals,
)
from armscan.calibration.hand_eye.search import Start, find_start
from armscan.calibration.hand_eye.solve import (
    LEAST_POSTURES,
    Conditioning,
    LinearSolution,
    conditioning_warnings,
    describe_conditioning,
    design,
    noise_components,
    refuse_few_postures,
    refuse_open_hand_eye,
    total_covariance,
)
from armscan.calibration.hand_eye.sphere_estimate import (
    RADIUS_COLUMN,
    SphereNodes,
    SphereSolution,
    SphereState,
    descend,
    free_columns,
    is_apart,
    place_on_sphere,
    refine_with_noise,
    solve_at,
    sphere_nodes,
    start_candidates,
    with_weights,
)
from armscan.calibration.hand_eye.sphere_estimate import hold_sensor as sphere_estimate_hold_sensor
from armscan.calibration.hand_eye.sphere_sections import (
    DEFAULT_OPTIONS,
    Section,
    SphereOptions,
    check_diameter,
    find_sections,
)
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.estimate import FitFailure

AS_WELL = 1.5
"""What moved explains all postures if it leaves no more than this times the scatter of the arm that
is left without the postures that look wrong."""


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
        (P, P) of the sensor's parameters, in the order of the stripes' ``by_sensor``: its errors
        bend all stripes alike, and are not taken for something that moved. The hand-eye returned,
        and its covariance, are for the sensor as it is; ``sensor_coupling`` carries its errors on.
        None takes it as exact.

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
    check_postures(stripes, options.exposure_position_mm, options.exposure_rotation_rad)
    kept = straight_stripes(stripes, options)
    nodes = replace(
        condense(stripes, kept, options.nodes_per_stripe), sensor_covariance=sensor_covariance
    )
    few = refuse_few_postures(len(nodes.used_postures))
    if few is not None:
        return few
    start = find_start(nodes, plate.plane)
    refusal = _refuse_start(nodes, plate, start, options)
    if refusal is not None:
        also = "".join(f"; {warning}" for warning in point_warnings(stripes, kept, options))
        return FitFailure(refusal.reason + also, refusal.remedy)
    settled = settle_alternatives(
        nodes, plate, start, options, common_to_postures(nodes, plate.plane)
    )
    if isinstance(settled, FitFailure):
        return settled
    mirror = find_mirror(nodes, plate, settled, options)
    if mirror is not None:
        return mirror
    checked = _checked(nodes, plate, settled, options)
    if isinstance(checked, FitFailure):
        return checked
    return _result(stripes, kept, plate, options, start=settled, checked=checked)


def _checked(
    nodes: PlateNodes, plate: PlateReference, start: Start, options: HandEyeOptions
) -> CheckedFit | FitFailure:
    """Refine, leave wrong postures out, and look for something that moved or is not as given.

    A plate that moved makes postures look wrong, and wrong postures may look like a plate that
    moved. If what moved explains all postures about as well as leaving some out explains the rest,
    it is believed.
    """
    state = PlateState(start.tool_from_sensor, np.zeros(3))
    right = nodes.select(~start.is_wrong[nodes.posture])
    first = fit_plate(right, plate, state, options)
    if isinstance(first, FitFailure):
        return first
    checked = fit_without_wrong_postures(nodes, plate, start, first, options)
    usual_mm = sigma_of(first if isinstance(checked, FitFailure) else checked.fit, "arm")
    trials = [(right, first)]
    if start.is_wrong.any():
        whole = fit_plate(nodes, plate, state, options)
        trials += [(nodes, whole)] if isinstance(whole, PlateFit) else []
    for tried, fit in trials:
        found = find_alternatives(tried, plate, fit, options)
        moved = find_contradiction(found, tried, plate, fit)
        is_all = isinstance(checked, CheckedFit) and fit is checked.fit
        if moved is None or not moved.is_refused:
            continue
        if is_all or moved.arm_mm < AS_WELL * usual_mm:
            return moved.failure
    if isinstance(checked, FitFailure):
        return checked
    found = find_alternatives(checked.nodes, plate, checked.fit, options)
    moved = find_contradiction(found, checked.nodes, plate, checked.fit)
    checked = replace(checked, plane_check=plane_in_words(found))
    if moved is None:
        refusal = refuse_scatter(checked.fit, options)
        return checked if refusal is None else refusal
    if moved.is_refused:
        return moved.failure
    return replace(checked, widening=moved.widening, warnings=(*checked.warnings, moved.reason))


def _refuse_start(
    nodes: PlateNodes, plate: PlateReference, start: Start, options: HandEyeOptions
) -> FitFailure | None:
    state = PlateState(start.tool_from_sensor, np.zeros(3))
    placed = place_nodes(nodes, plate.plane, state)
    components = noise_components(nodes, placed, plate.plane, options)
    total = total_covariance(components, np.array([c.sigma for c in components]))
    slopes = design(placed, options.solve_plate)
    conditioning = describe_conditioning(hand_eye_information(slopes, total))
    cause = common_to_postures(nodes, plate.plane)
    refusal = refuse_open_hand_eye(conditioning, cause, REMEDY)
    if refusal is not None:
        return refusal
    if not start.typical_mm <= options.max_rms_mm:
        return explain_misfit(nodes, plate, start, options)
    return None


def _result(
    stripes: Sequence[PosedStripe],
    kept: tuple[BoolArray, ...],
    plate: PlateReference,
    options: HandEyeOptions,
    *,
    start: Start,
    checked: CheckedFit,
) -> HandEyeFit | FitFailure:
    """Checks let the sensor err within its covariance; what is stored belongs to the sensor."""
    fit, nodes = checked.fit, checked.nodes
    stored = hold_sensor(nodes, plate, fit, options)
    if isinstance(stored, FitFailure):
        return stored
    conditioning = describe_conditioning(hand_eye_information(fit.slopes, fit.total))
    plane = shifted_plane(plate.plane, plane_after(stored, plate))
    residuals = stripe_residuals(stripes, kept, stored.refined.state.tool_from_sensor, plane)
    left = leave_each_out(nodes, fit.refined.placed.residual_mm, fit.linear)
    postures = posture_results(nodes, stored, residuals, left, plane)
    cause = common_to_postures(nodes, plate.plane)
    return HandEyeFit(
        hand_eye_calibration(
            checked,
            stored,
            plate,
            options,
            conditioning=conditioning,
            residuals=residuals,
            postures=postures,
        ),
        start.linear or start.tool_from_sensor,
        residuals,
        postures,
        conditioning.singular_values,
        reference_facts(plate, options, fit, checked.plane_check),
        (
            *checked.warnings,
            *conditioning_warnings(conditioning, len(postures), cause),
            *agreement_warnings(nodes, plate, stored, options),
            *influence_warnings(nodes, left, fit.covariance[:6, :6]),
            *point_warnings(stripes, kept, options),
        ),
    )


START_NODES = 6
START_POINTS = 48
"""Of each stripe, for the search; the refinement takes all."""
RIVAL_COST = 9.0
"""Minima whose sum of squares is not larger by more than this factor are compared in earnest."""
LIKELIER = 6.0
"""Logarithm of the likelihood ratio from which one solution is preferred to another."""
LEAST_RESIDUAL_MM = 1e-4
LIKELY_DIAMETER = 0.2
"""Part of the diameter by which it may have been mistaken."""
NAMED_STRIPES = 3
LOOSE_PART = 0.2
"""A combination known less well than this part of the diameter is not determined."""
ROBUST_ROUNDS = 10
POSTURES_REMEDY = (
    "scan the sphere from 8 or more postures that turn about at least two axes, each cutting it "
    "at another height"
)
_OPEN = FitFailure("the postures do not determine hand-eye and sphere together", POSTURES_REMEDY)


def calibrate_on_sphere(
    stripes: Sequence[PosedStripe],
    diameter_mm: float,
    options: SphereOptions = DEFAULT_OPTIONS,
    *,
    sensor_covariance: FloatArray | None = None,
) -> HandEyeFit | FitFailure:
    """Find the hand-eye from stripes on a sphere that does not move.

    Parameters
    ----------
    stripes
        Exposures with the arm's pose; points off the sphere are rejected.
    diameter_mm
        Of the sphere.
    options
        Rejection, noise, and what is solved along.
    sensor_covariance
        As of `armscan.calibration.hand_eye.calibrate.calibrate_on_plate`.

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
    check_diameter(diameter_mm)
    check_postures(stripes)
    radius = 0.5 * diameter_mm
    sections, left_out = find_sections(stripes, radius, options)
    n_postures = len({section.stripe.posture for section in sections})
    refused = _refuse_sections(len(sections), left_out, diameter_mm)
    few = refuse_few_postures(n_postures)
    if refused is None and few is not None:
        refused = FitFailure(few.reason, POSTURES_REMEDY)
    if refused is not None:
        return refused
    thinned = tuple(section.thinned(START_POINTS) for section in sections)
    starts = _search(thinned, radius, options)
    if isinstance(starts, FitFailure):
        return starts
    nodes = sphere_nodes(sections, options.nodes_per_stripe, sensor_covariance)
    best = _best(nodes, starts, options)
    if isinstance(best, FitFailure):
        return best
    start, checked = best
    stored = sphere_estimate_hold_sensor(nodes, checked)
    if stored is None:
        return _OPEN
    conditioning = _conditioning(checked.linear)
    warnings = (*left_out, *conditioning_warnings(conditioning, n_postures, ""))
    given = replace(start, radius_mm=radius)
    return sphere_fit(nodes, checked, stored, conditioning, start=given, warnings=warnings)


def _refuse_sections(
    n_sections: int, left_out: tuple[str, ...], diameter_mm: float
) -> FitFailure | None:
    """Refuse where most stripes do not show the sphere."""
    if len(left_out) <= n_sections:
        return None
    return FitFailure(
        f"{len(left_out)} stripes show no section of a sphere of {diameter_mm:g} mm diameter, "
        f"{n_sections} do: {'; '.join(left_out[:NAMED_STRIPES])}",
        "check the sphere's diameter, and that the stripes lie on the sphere",
    )


def _refuse_postures(linear: LinearSolution | None, diameter_mm: float) -> FitFailure | None:
    """Refuse postures that leave a combination of the unknowns open or nearly so."""
    cause = ": the tool hardly turns, or about one axis only"
    if linear is None:
        return FitFailure(f"the postures do not determine the hand-eye{cause}", POSTURES_REMEDY)
    conditioning = _conditioning(linear)
    refused = refuse_open_hand_eye(conditioning, cause, POSTURES_REMEDY)
    if refused is None and conditioning.singular_values[-1] * LOOSE_PART * diameter_mm < 1.0:
        return FitFailure(
            f"the postures hardly determine the hand-eye{cause} (least known: "
            f"{conditioning.weakest})",
            POSTURES_REMEDY,
        )
    return refused


def _search(
    sections: tuple[Section, ...], radius_mm: float, options: SphereOptions
) -> tuple[SphereState, ...] | FitFailure:
    """Distinct minima of the plain sum of squares that are nearly the least, best first."""
    nodes = sphere_nodes(sections, START_NODES)
    plain = np.eye(len(nodes))
    ends = []
    for start in start_candidates(sections, radius_mm):
        state, cost, _ = descend(nodes, start, plain, np.arange(RADIUS_COLUMN))
        ends.append((cost, state))
    ends.sort(key=lambda pair: pair[0])
    limit = RIVAL_COST * (ends[0][0] + len(nodes) * LEAST_RESIDUAL_MM**2)
    kept: list[SphereState] = []
    for cost, state in ends:
        if cost <= limit and all(is_apart(state, one) for one in kept):
            kept.append(descend(nodes, state, plain, free_columns(options))[0])
    if _typical_mm(nodes, kept[0]) > options.max_rms_mm:
        return _refuse_misfit(nodes, kept[0], options)
    refused = _refuse_postures(solve_at(nodes, kept[0], options), 2.0 * radius_mm)
    return tuple(kept) if refused is None else refused


def _typical_mm(nodes: SphereNodes, state: SphereState) -> float:
    return float(np.median(np.abs(place_on_sphere(nodes, state).residual_mm)))


def _refuse_misfit(nodes: SphereNodes, state: SphereState, options: SphereOptions) -> FitFailure:
    """Say how far the points stay from any sphere, and whether another diameter would do."""
    typical = _typical_mm(nodes, state)
    reason = (
        f"no hand-eye puts the points on one sphere of {2.0 * state.radius_mm:g} mm diameter: "
        f"they stay {typical:.2f} mm away (median)"
    )
    freed, _, _ = descend(nodes, state, np.eye(len(nodes)), np.arange(RADIUS_COLUMN + 1))
    is_better = _typical_mm(nodes, freed) < min(0.5 * typical, options.max_rms_mm)
    if is_better and abs(freed.radius_mm / state.radius_mm - 1.0) < LIKELY_DIAMETER:
        reason += f"; {2.0 * freed.radius_mm:.1f} mm would fit"
    return FitFailure(
        reason,
        "check the convention of the arm's angles, the order of poses and profiles, the "
        "sphere's diameter, and that the sphere did not move",
    )


def _best(
    nodes: SphereNodes, starts: tuple[SphereState, ...], options: SphereOptions
) -> tuple[SphereState, SphereSolution] | FitFailure:
    """The likeliest of the refined minima, refused where another one is nearly as likely."""
    found = [(start, _refine(nodes, start, options)) for start in starts]
    solved = [(start, one) for start, one in found if one is not None]
    if not solved:
        return _OPEN
    solved.sort(key=lambda pair: -pair[1].linear.log_likelihood)
    best = solved[0]
    if _typical_mm(nodes, best[1].state) > options.max_rms_mm:
        return _refuse_misfit(nodes, best[1].state, options)
    refused = _refuse_postures(best[1].linear, 2.0 * best[0].radius_mm)
    if refused is not None:
        return refused
    for _, other in solved[1:]:
        lost = best[1].linear.log_likelihood - other.linear.log_likelihood
        if lost < LIKELIER and is_apart(best[1].state, other.state):
            return FitFailure(
                "two quite different hand-eyes explain the stripes equally well: seen from the "
                "sensor, the sphere's centre moved within one plane only",
                "vary the stand-off too: nearer and farther by 15 % and more",
            )
    return best


def _conditioning(linear: LinearSolution) -> Conditioning:
    return describe_conditioning(np.asarray(np.linalg.inv(linear.covariance[:6, :6])))


def _refine(
    nodes: SphereNodes, start: SphereState, options: SphereOptions
) -> SphereSolution | None:
    """Refine; postures whose pose errs far more than the others' lose weight."""
    weights = np.ones(len(nodes.postures))
    solution = refine_with_noise(nodes, start, options, weights)
    for _ in range(ROBUST_ROUNDS):
        if solution is None or len(nodes.postures) <= LEAST_POSTURES:
            return solution
        updated = with_weights(nodes, solution, options.posture_sigma)
        if float(np.abs(updated - weights).max()) < 0.02:
            break
        weights = updated
        solution = refine_with_noise(nodes, solution.state, options, weights)
    return solution
