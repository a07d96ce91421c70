# SPDX-License-Identifier: Apache-2.0
"""Evidence of a hand-eye calibration on a plate, put together for a report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from armscan.calibration.hand_eye.conditioning import Conditioning
from armscan.calibration.hand_eye.left_out import LeftOut
from armscan.calibration.hand_eye.noise_model import arm_noise, total_covariance
from armscan.calibration.hand_eye.observations import PlateReference, PosedStripe
from armscan.calibration.hand_eye.options import HandEyeOptions
from armscan.calibration.hand_eye.plate_fit import PlateFit, plane_after
from armscan.calibration.hand_eye.plate_nodes import PlateNodes
from armscan.calibration.hand_eye.plate_outliers import CheckedFit
from armscan.calibration.hand_eye.plate_residuals import (
    residual_by_sensor,
    sensor_covariance,
    shifted_plane,
)
from armscan.calibration.hand_eye.result import PostureResult, StripeResidual
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.fitting import Plane
from armscan.geometry.frames import Sensor, Tool
from armscan.geometry.poses import Points, Pose
from armscan.models.scanner import HandEyeCalibration, HandEyeDiagnostics

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
        stored.refined.state.tool_from_sensor,
        stored.covariance[:6, :6] + checked.widening,
        coupling,
        arm_noise(fit.components, fit.noise.sigmas),
        float(np.sqrt((distances**2).mean())),
        len(postures),
        sum(posture.n_exposures for posture in postures),
        sum(posture.n_points for posture in postures),
        shifted_plane(plate.plane, plane_after(stored, plate)),
        HandEyeDiagnostics(
            "plate",
            conditioning.rank,
            min(conditioning.condition, FINITE_CONDITION),
            conditioning.weakest,
            sigma_of(fit, "flatness"),
            options.flatness_length_mm,
            any(component.is_estimated for component in fit.components),
            max(posture.left_out_rotation_deg for posture in postures),
            max(posture.left_out_translation_mm for posture in postures),
            float(chi2_distribution.sf(fit.refined.chi2, fit.degrees_of_freedom)),
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
