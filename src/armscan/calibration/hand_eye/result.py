# SPDX-License-Identifier: Apache-2.0
"""Result of a hand-eye calibration: calibration with joint covariance, residuals of stripes and
postures, diagnostics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from armscan.calibration.hand_eye.estimate import (
    CheckedFit,
    LeftOut,
    PlateFit,
    covariance_over_noise,
    estimate_noise,
    plane_after,
)
from armscan.calibration.hand_eye.observations import (
    HandEyeOptions,
    PlateNodes,
    PlateReference,
    PosedStripe,
    residual_by_sensor,
    sensor_covariance,
    shifted_plane,
)
from armscan.calibration.hand_eye.solve import (
    Conditioning,
    arm_noise,
    solve_linear,
    total_covariance,
)
from armscan.calibration.hand_eye.sphere_estimate import (
    RADIUS_COLUMN,
    SCALE_COLUMN,
    LeftOutPosture,
    SphereNodes,
    SphereSolution,
    SphereState,
    leave_out,
)
from armscan.calibration.hand_eye.sphere_estimate import (
    residual_by_sensor as sphere_estimate_residual_by_sensor,
)
from armscan.geometry.arrays import BoolArray, FloatArray, frozen_floats
from armscan.geometry.poses import Points, Pose, Sensor, Tool
from armscan.geometry.shapes import Plane
from armscan.models.calibration import HandEyeCalibration, HandEyeDiagnostics


@dataclass(frozen=True, slots=True, eq=False)
class StripeResidual:
    """What one exposure left over.

    Parameters
    ----------
    source, posture
        Names of the exposure and of its posture.
    points_base_mm
        (N, 3) points placed with the result.
    residual_mm
        (N,) signed distance from the reference.
    """

    source: str
    posture: str
    points_base_mm: FloatArray
    residual_mm: FloatArray

    def __post_init__(self) -> None:
        points = frozen_floats(self.points_base_mm, (None, 3), "points_base_mm")
        object.__setattr__(self, "points_base_mm", points)
        residual = frozen_floats(self.residual_mm, (len(points),), "residual_mm")
        object.__setattr__(self, "residual_mm", residual)


@dataclass(frozen=True, slots=True)
class PostureResult:
    """One posture of the arm.

    Parameters
    ----------
    posture
        Its name.
    n_exposures, n_points
        What was used.
    mean_mm, rms_mm
        Mean and root mean square distance of its points from the reference.
    normalised_mean
        The mean over the standard deviation that the noise model gives it after the fit, which
        follows a part of the errors.
    tilt_deg, azimuth_deg
        Of the sensor's optical axis against the plate's normal, and about it; NaN for a sphere.
    stand_off_mm
        Distance of the points from the camera.
    left_out_rotation_deg, left_out_translation_mm
        Change of the hand-eye if this posture is left out.
    left_out_normalised
        Size of the residuals of the posture when it took no part, over their predicted standard
        deviation; 1 is usual.
    """

    posture: str
    n_exposures: int
    n_points: int
    mean_mm: float
    rms_mm: float
    normalised_mean: float
    tilt_deg: float
    azimuth_deg: float
    stand_off_mm: float
    left_out_rotation_deg: float
    left_out_translation_mm: float
    left_out_normalised: float


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeFit:
    """A hand-eye calibration and its evidence.

    Parameters
    ----------
    calibration
        The result.
    start
        Where the refinement started: the linear solution.
    stripes, postures
        What each exposure and each posture left over.
    singular_values
        (6,) of the scaled and whitened system, largest first.
    reference
        What the reference was and how far the data agree with it, as (label, value) for a reader.
    warnings
        What is weak, in words.
    """

    calibration: HandEyeCalibration
    start: Pose[Tool, Sensor]
    stripes: tuple[StripeResidual, ...]
    postures: tuple[PostureResult, ...]
    singular_values: FloatArray
    reference: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        values = frozen_floats(self.singular_values, (None,), "singular_values")
        object.__setattr__(self, "singular_values", values)


FINITE_CONDITION = 1e12


def stripe_residuals(
    stripes: Sequence[PosedStripe],
    kept: Sequence[BoolArray],
    tool_from_sensor: Pose[Tool, Sensor],
    plane: Plane,
) -> tuple[StripeResidual, ...]:
    """Place the kept points of every stripe and compare them with the plane."""
    result = []
    for stripe, mark in zip(stripes, kept, strict=True):
        points: Points[Sensor] = Points(stripe.points_mm[mark])
        placed = (stripe.base_from_tool @ tool_from_sensor @ points).xyz_mm
        result.append(
            StripeResidual(stripe.source, stripe.posture, placed, plane.distance_mm(placed))
        )
    return tuple(result)


def posture_results(
    nodes: PlateNodes,
    fit: PlateFit,
    residuals: Sequence[StripeResidual],
    left_out: dict[int, LeftOut],
    plane: Plane,
) -> tuple[PostureResult, ...]:
    """Summarise every posture that took part; ``plane`` is the one that the residuals are from."""
    pose = fit.refined.state.tool_from_sensor
    spread = fitted_covariance(nodes, fit)
    results = []
    for number, left in left_out.items():
        own = nodes.posture == number
        name = nodes.postures[number]
        mine = [residual for residual in residuals if residual.posture == name]
        distances = np.concatenate([residual.residual_mm for residual in mine])
        share = own / own.sum()
        sigma_mm = float(np.sqrt(max(share @ spread @ share, 1e-18)))
        axis = nodes.rotations[nodes.stripe[own][0]] @ pose.rotation[:, 2]
        local = plane.axes @ axis
        results.append(
            PostureResult(
                name,
                len(mine),
                len(distances),
                float(distances.mean()),
                float(np.sqrt((distances**2).mean())),
                float(distances.mean()) / sigma_mm,
                float(np.degrees(np.arccos(np.clip(abs(local[2]), 0.0, 1.0)))),
                float(np.degrees(np.arctan2(local[1], local[0]))),
                float(np.linalg.norm(nodes.points_mm[own], axis=1).mean()),
                float(np.degrees(np.linalg.norm(left.change[:3]))),
                float(np.linalg.norm(left.change[3:6])),
                left.normalised,
            )
        )
    return tuple(results)


def fitted_covariance(nodes: PlateNodes, fit: PlateFit) -> FloatArray:
    """(N, N) covariance of the residuals from the plane that scan and probing give together.

    The hand-eye and the plane follow the errors that they can explain. With ``P`` of
    `LinearSolution` and ``D`` the covariance of the scatter alone, these residuals are ``D P e``.
    The errors ``e`` are those that the fit weighed, and the sensor's, which was held.
    """
    scatter = total_covariance(fit.components, fit.noise.sigmas)
    left = scatter @ fit.linear.projected
    spread = left @ scatter
    by_sensor = sensor_covariance(nodes, fit.refined.placed)
    return np.asarray(spread if by_sensor is None else spread + left @ by_sensor @ left.T)


def hand_eye_calibration(
    checked: CheckedFit,
    stored: PlateFit,
    plate: PlateReference,
    options: HandEyeOptions,
    *,
    conditioning: Conditioning,
    residuals: Sequence[StripeResidual],
    postures: Sequence[PostureResult],
) -> HandEyeCalibration:
    """The document's part: hand-eye, covariance, coupling to the sensor, noise.

    ``stored`` is the hand-eye of the sensor as it is (`hold_sensor`); whether all is as given is
    told by ``checked``, where the sensor may err.
    """
    fit = checked.fit
    by_sensor = residual_by_sensor(checked.nodes, stored.refined.placed)
    coupling = None if by_sensor is None else -stored.linear.gain[:6] @ by_sensor
    used = {posture.posture for posture in postures}
    distances = np.concatenate([r.residual_mm for r in residuals if r.posture in used])
    return HandEyeCalibration(
        tool_from_sensor=stored.refined.state.tool_from_sensor,
        covariance=stored.covariance[:6, :6] + checked.widening,
        sensor_coupling=coupling,
        arm_noise=arm_noise(fit.components, fit.noise.sigmas),
        rms_mm=float(np.sqrt((distances**2).mean())),
        n_postures=len(postures),
        n_exposures=sum(posture.n_exposures for posture in postures),
        n_points=sum(posture.n_points for posture in postures),
        plate=shifted_plane(plate.plane, plane_after(stored, plate)),
        diagnostics=HandEyeDiagnostics(
            method="plate",
            rank=conditioning.rank,
            condition=min(conditioning.condition, FINITE_CONDITION),
            weakest=conditioning.weakest,
            plate_flatness_mm=sigma_of(fit, "flatness"),
            flatness_length_mm=options.flatness_length_mm,
            is_noise_estimated=any(component.is_estimated for component in fit.components),
            left_out_rotation_deg=max(posture.left_out_rotation_deg for posture in postures),
            left_out_translation_mm=max(posture.left_out_translation_mm for posture in postures),
            chi2_probability=float(chi2_distribution.sf(fit.refined.chi2, fit.degrees_of_freedom)),
        ),
    )


def sigma_of(fit: PlateFit, name: str) -> float:
    """Standard deviation of one cause of scatter."""
    for component, sigma in zip(fit.components, fit.noise.sigmas, strict=True):
        if component.name == name:
            return float(sigma)
    return 0.0


def reference_facts(
    plate: PlateReference, options: HandEyeOptions, fit: PlateFit, plane_check: str
) -> tuple[tuple[str, str], ...]:
    """What the plate was, and what was taken for scatter, as (label, value).

    ``plane_check`` is what the stripes alone say of the probed plane.
    """
    a, b, c, d = plate.plane.coefficients
    facts = [("plate", f"{a:.6f} x {_signed(b)} y {_signed(c)} z {_signed(d, 4)} = 0 in Base (mm)")]
    if plate.n_points:
        rms = "" if plate.rms_mm is None else f", {plate.rms_mm:.4f} mm rms from it"
        facts.append(("probed", f"{plate.n_points} points{rms}"))
    if options.solve_plate:
        facts.append(("plane", "solved along, without regard to the probing"))
    elif plate.covariance is None and plate.n_points:
        facts.append(("plane", "taken as exact: the probed plate's uncertainty is not known"))
    elif plate.covariance is None:
        facts.append(("plane", "taken as exact: only A, B, C, D were given"))
    else:
        facts.append(("plane", "as probed, weighted by its uncertainty"))
    if plane_check:
        facts.append(("plane, checked", plane_check))
    for component, sigma in zip(fit.components, fit.noise.sigmas, strict=True):
        unit = {"stripe": "times its own sigma"}.get(component.name, "mm")
        if component.name.endswith("rotation"):
            unit = "rad"
        origin = "estimated" if component.is_estimated else "given"
        facts.append((f"scatter: {component.name}", f"{sigma:.3g} {unit} ({origin})"))
    return tuple(facts)


def _signed(value: float, digits: int = 6) -> str:
    return f"{'-' if value < 0.0 else '+'} {abs(value):.{digits}f}"


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
    by_sensor = sphere_estimate_residual_by_sensor(nodes, solution.placed)
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
