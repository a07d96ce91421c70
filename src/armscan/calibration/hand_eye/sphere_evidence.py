# SPDX-License-Identifier: Apache-2.0
"""Evidence of a hand-eye from a sphere: postures, residuals, what is weak."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from armscan.calibration.hand_eye.conditioning import Conditioning
from armscan.calibration.hand_eye.least_squares import solve_linear
from armscan.calibration.hand_eye.noise_model import arm_noise, total_covariance
from armscan.calibration.hand_eye.result import HandEyeFit, PostureResult, StripeResidual
from armscan.calibration.hand_eye.sphere_refine import LeftOutPosture, SphereSolution, leave_out
from armscan.calibration.hand_eye.sphere_residuals import (
    RADIUS_COLUMN,
    SCALE_COLUMN,
    SphereNodes,
    SphereState,
    residual_by_sensor,
)
from armscan.calibration.hand_eye.variance_components import covariance_over_noise, estimate_noise
from armscan.geometry.arrays import FloatArray
from armscan.models.scanner import HandEyeCalibration, HandEyeDiagnostics

OUTLYING = 3.0
"""A posture whose pose errs by this many standard deviations is named."""
WRONG_DIAMETER = 4.0
"""A diameter given that lies this many standard deviations off what the points ask for is named."""
REJECTED_SHARE = 0.015
"""A stripe that loses more than this part of its points is named."""
SHORT_ARC = 0.6
"""A stripe whose arc is shorter than this part of the usual one is named."""


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    """What is stored, ``solution``, and what it was ``checked`` by, where the sensor may err.

    ``covariance`` (F, F) of all unknowns, and without the sensor's part (`own_covariance`).
    """

    nodes: SphereNodes
    checked: SphereSolution
    solution: SphereSolution
    covariance: FloatArray
    own_covariance: FloatArray
    postures: tuple[PostureResult, ...]


def sphere_fit(
    nodes: SphereNodes,
    checked: SphereSolution,
    solution: SphereSolution,
    conditioning: Conditioning,
    *,
    start: SphereState,
    warnings: tuple[str, ...],
) -> HandEyeFit:
    """Gather what a reader and a scanner document need.

    Parameters
    ----------
    nodes
        Data.
    checked
        Minimum with noise model, where the sensor may err within its covariance.
    solution
        The one to be stored, of the sensor as it is (`hold_sensor`).
    conditioning
        How well the hand-eye is determined.
    start
        Where the refinement started, with the sphere's radius as given.
    warnings
        What was noticed before.
    """
    residual = checked.placed.residual_mm
    # What the sensor's errors leave in the residuals is the coupling's part, not the scatter's.
    own = residual - checked.by_sensor @ checked.linear.projected @ residual
    own_covariance = covariance_over_noise(
        own, solution.slopes, solution.components, np.zeros_like(solution.total), solution.noise
    )
    gain = solution.linear.gain
    covariance = own_covariance + gain @ solution.by_sensor @ gain.T
    postures = tuple(
        _posture(nodes, solution, k, leave_out(nodes, checked, k))
        for k in range(len(nodes.postures))
    )
    evidence = _Evidence(nodes, checked, solution, covariance, own_covariance, postures)
    return HandEyeFit(
        _calibration(evidence, conditioning),
        start.tool_from_sensor,
        _stripes(nodes, solution),
        postures,
        conditioning.singular_values,
        _reference(evidence, 2.0 * start.radius_mm),
        (*warnings, *_warnings(evidence)),
    )


def _calibration(evidence: _Evidence, conditioning: Conditioning) -> HandEyeCalibration:
    nodes, checked, solution = evidence.nodes, evidence.checked, evidence.solution
    residual = checked.placed.residual_mm
    chi2 = float(residual @ checked.linear.projected @ residual)
    freedom = len(nodes) - len(solution.free)
    diagnostics = HandEyeDiagnostics(
        method="sphere",
        rank=conditioning.rank,
        condition=conditioning.condition,
        weakest=conditioning.weakest,
        plate_flatness_mm=0.0,
        flatness_length_mm=0.0,
        is_noise_estimated=solution.components[0].is_estimated,
        left_out_rotation_deg=max(one.left_out_rotation_deg for one in evidence.postures),
        left_out_translation_mm=max(one.left_out_translation_mm for one in evidence.postures),
        chi2_probability=float(chi2_distribution.sf(chi2, freedom)),
    )
    points = solution.placed.point_residual_mm
    return HandEyeCalibration(
        tool_from_sensor=solution.state.tool_from_sensor,
        covariance=evidence.own_covariance[:6, :6],
        sensor_coupling=_coupling(nodes, solution),
        arm_noise=arm_noise(solution.components, solution.noise.sigmas),
        rms_mm=float(np.sqrt(np.mean(points**2))),
        n_postures=len(nodes.postures),
        n_exposures=len({section.stripe.source for section in nodes.sections}),
        n_points=len(points),
        diagnostics=diagnostics,
    )


def _coupling(nodes: SphereNodes, solution: SphereSolution) -> FloatArray | None:
    """(6, P) derivative of the hand-eye by the sensor's parameters, where the points carry it."""
    by_sensor = residual_by_sensor(nodes, solution.placed)
    return None if by_sensor is None else -solution.linear.gain[:6] @ by_sensor


def _posture(
    nodes: SphereNodes, solution: SphereSolution, posture: int, left_out: LeftOutPosture
) -> PostureResult:
    own = np.flatnonzero(nodes.posture == posture)
    points = np.flatnonzero(np.repeat(nodes.posture, nodes.count) == posture)
    residual = solution.placed.point_residual_mm[points]
    share = nodes.count[own] / nodes.count[own].sum()
    left = share @ solution.total[own] @ solution.linear.projected
    mean_sigma = float(np.sqrt(max(left @ (solution.total + solution.by_sensor) @ left, 1e-18)))
    sources = {nodes.sections[k].stripe.source for k in nodes.section[own]}
    return PostureResult(
        posture=nodes.postures[posture],
        n_exposures=len(sources),
        n_points=len(points),
        mean_mm=float(residual.mean()),
        rms_mm=float(np.sqrt(np.mean(residual**2))),
        normalised_mean=float(residual.mean()) / mean_sigma,
        tilt_deg=float("nan"),
        azimuth_deg=float("nan"),
        stand_off_mm=float(np.linalg.norm(nodes.points_mm[points], axis=1).mean()),
        left_out_rotation_deg=float(np.degrees(np.linalg.norm(left_out.change[:3]))),
        left_out_translation_mm=float(np.linalg.norm(left_out.change[3:6])),
        left_out_normalised=left_out.pose_sigmas,
    )


def _stripes(nodes: SphereNodes, solution: SphereSolution) -> tuple[StripeResidual, ...]:
    placed = solution.placed
    found = []
    for k, section in enumerate(nodes.sections):
        own = nodes.point_section == k
        found.append(
            StripeResidual(
                section.stripe.source,
                section.stripe.posture,
                placed.points_base_mm[own],
                placed.point_residual_mm[own],
            )
        )
    return tuple(found)


def _reference(evidence: _Evidence, diameter_mm: float) -> tuple[tuple[str, str], ...]:
    solution = evidence.solution
    state, sigma = solution.state, np.sqrt(np.diag(evidence.covariance))
    x, y, z = state.centre_mm
    rows = [
        ("Sphere's diameter, given", f"{diameter_mm:g} mm"),
        ("Sphere's centre in Base", f"{x:.3f}, {y:.3f}, {z:.3f} mm"),
        ("Its standard deviation", ", ".join(f"{one:.3f}" for one in sigma[6:9]) + " mm"),
    ]
    found, uncertainty = diameter_asked(evidence.checked)
    if RADIUS_COLUMN not in solution.free:
        text = f"{found:.3f} mm, standard deviation {uncertainty:.3f} mm"
        rows.append(("Diameter that the points ask for", text))
    extra = dict(zip(solution.free.tolist(), sigma, strict=True))
    if RADIUS_COLUMN in extra:
        spread = 2.0 * extra[RADIUS_COLUMN]
        text = f"{2.0 * state.radius_mm:.3f} mm, standard deviation {spread:.3f} mm"
        rows.append(("Sphere's diameter, solved along", text))
    if SCALE_COLUMN in extra:
        text = f"{state.scale:.6f}, standard deviation {extra[SCALE_COLUMN]:.6f}"
        rows.append(("Scale of the sensor's points", text))
    return tuple(rows)


def diameter_asked(solution: SphereSolution) -> tuple[float, float]:
    """Diameter that the points themselves ask for, and its standard deviation, both in mm.

    The scatter is estimated anew: as long as the diameter is held, a wrong one counts as form of
    the stripes, and is hidden by it.
    """
    columns = np.union1d(solution.free, [RADIUS_COLUMN])
    residual, slopes = solution.placed.residual_mm, solution.placed.slopes[:, columns]
    components, by_sensor = solution.components, solution.by_sensor
    noise = estimate_noise(residual, slopes, components, by_sensor, solution.noise.sigmas)
    total = total_covariance(components, noise.sigmas) + by_sensor
    freed = solve_linear(residual, slopes, total)
    if freed is None:
        return 2.0 * solution.state.radius_mm, float("inf")
    k = int(np.flatnonzero(columns == RADIUS_COLUMN)[0])
    found = 2.0 * (solution.state.radius_mm + float(freed.step[k]))
    return found, 2.0 * float(np.sqrt(freed.covariance[k, k]))


def _warnings(evidence: _Evidence) -> tuple[str, ...]:
    nodes, solution = evidence.nodes, evidence.solution
    found = []
    for result, weight in zip(evidence.postures, solution.posture_weights, strict=True):
        if result.left_out_normalised > OUTLYING:
            found.append(
                f"posture {result.posture} contradicts the others: its pose errs by "
                f"{result.left_out_normalised:.1f} standard deviations (weight {weight:.2f})"
            )
    for section in nodes.sections:
        n = len(section.rows) + section.n_rejected
        if section.n_rejected > REJECTED_SHARE * n:
            found.append(
                f"{section.stripe.source}: {section.n_rejected} of {n} points lie off its section "
                "of the sphere and are left out"
            )
    arcs = np.array([section.arc_deg for section in nodes.sections])
    for section, arc in zip(nodes.sections, arcs, strict=True):
        if arc < SHORT_ARC * float(np.median(arcs)):
            found.append(
                f"{section.stripe.source} is weak: its arc of {arc:.0f} degrees is short, "
                f"{np.median(arcs):.0f} are usual"
            )
    asked, uncertainty = diameter_asked(evidence.checked)
    given = 2.0 * solution.state.radius_mm
    if abs(asked - given) > WRONG_DIAMETER * uncertainty:
        found.append(
            f"the points ask for a sphere of {asked:.2f} mm diameter (standard deviation "
            f"{uncertainty:.2f} mm), not {given:g} mm: check the diameter and the sensor's scale"
        )
    if not solution.is_settled:
        found.append("the refinement had not settled when its steps ran out")
    return tuple(found)
