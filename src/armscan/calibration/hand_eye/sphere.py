# SPDX-License-Identifier: Apache-2.0
"""Hand-eye from a sphere in one least squares, from whatever postures there are.

Eq. 2.46 places every stripe point in Base; its distance from the sphere's surface is the residual.
Hand-eye and centre are unknown. Neither the section circle nor postures that only shift are
needed, and no side of the sheet has to be told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armscan.calibration.hand_eye.conditioning import (
    LEAST_POSTURES,
    Conditioning,
    conditioning_warnings,
    describe_conditioning,
    refuse_few_postures,
    refuse_open_hand_eye,
)
from armscan.calibration.hand_eye.least_squares import LinearSolution
from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.calibration.hand_eye.posture_names import check_postures
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.hand_eye.sphere_evidence import sphere_fit
from armscan.calibration.hand_eye.sphere_options import (
    DEFAULT_OPTIONS,
    SphereOptions,
    check_diameter,
)
from armscan.calibration.hand_eye.sphere_refine import (
    SphereSolution,
    descend,
    free_columns,
    hold_sensor,
    refine_with_noise,
    solve_at,
    with_weights,
)
from armscan.calibration.hand_eye.sphere_residuals import (
    RADIUS_COLUMN,
    SphereNodes,
    SphereState,
    place_on_sphere,
    sphere_nodes,
)
from armscan.calibration.hand_eye.sphere_sections import Section, find_sections
from armscan.calibration.hand_eye.sphere_start import is_apart, start_candidates
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure

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
        As of `armscan.calibration.hand_eye.plate.calibrate_on_plate`.

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
    stored = hold_sensor(nodes, checked)
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
