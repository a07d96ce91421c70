# SPDX-License-Identifier: Apache-2.0
"""What a hand-eye calibration returns: the hand-eye with its covariance, and all evidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from armscan.calibration.hand_eye.checks import CheckedFit
from armscan.calibration.hand_eye.estimate import (
    HandEyeSolution,
    JointCovariance,
    LeftOut,
    minimise_distances,
)
from armscan.calibration.hand_eye.noise import (
    TURNS,
    arm_noise,
    covariance_over_noise,
    estimate_noise,
    solve_linear,
    total_covariance,
)
from armscan.calibration.hand_eye.observations import CircleSection, PosedStripe
from armscan.calibration.hand_eye.surface import N_HAND_EYE, Conditioning, PlateSurface
from armscan.errors import InputError
from armscan.geometry.arrays import ArrayRecord, FloatArray, IntArray, RowRecord, floats
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.rotations import (
    euler_from_rotations,
    nearest_rotation,
    rotation_from_vector,
)
from armscan.geometry.shapes import Plane
from armscan.models.calibration import (
    HandEyeCalibration,
    HandEyeDiagnostics,
    Provenance,
    ScannerCalibration,
    SensorCalibration,
)

FINITE_CONDITION = 1e12
ANGLE_STEP_RAD = 1e-6
RADIUS_COLUMN, SCALE_COLUMN = N_HAND_EYE + 3, N_HAND_EYE + 4
"""Of a step on a sphere."""
OUTLYING = 3.0
"""A posture whose pose errs by this many standard deviations is named."""
WRONG_DIAMETER, NO_DIAMETER = 4.0, 10.0
"""A diameter given that lies this many standard deviations off what the points ask for is named,
the scatters being as estimated; that lies so many off is refused, if it is off by
`NO_DIAMETER_PART` of it and by `WRONG_DIAMETER` of what is stated, too."""
NO_DIAMETER_PART = 0.01
REJECTED_SHARE = 0.015
"""A stripe that loses more than this part of its points is named."""
SHORT_ARC = 0.6
"""A stripe whose arc is shorter than this part of the usual one is named."""


_DEGREES = ("°", float(np.degrees(1.0)))
SCATTER_NAMES = {
    "arm": ("arm's shift of a posture", " mm", 1.0),
    f"arm {TURNS[0]}": ("arm's turn about Tool of a posture", *_DEGREES),
    f"arm {TURNS[1]}": ("arm's turn about the scan point of a posture", *_DEGREES),
    "exposure": ("arm's shift of an exposure", " mm", 1.0),
    f"exposure {TURNS[0]}": ("arm's turn about Tool of an exposure", *_DEGREES),
    f"exposure {TURNS[1]}": ("arm's turn about the scan point of an exposure", *_DEGREES),
    "flatness": ("plate's flatness", " mm", 1.0),
    "sheet shape": ("shape of the sheets", " mm", 1.0),
    "stripe": ("noise of the stripes", " times its own sigma", 1.0),
}
"""Causes of scatter on a plate as people read them: name, unit, and that unit's number of one."""


class StripeResidual(RowRecord):
    """Points (N, 3) of one exposure placed with the result, and their distances (N,) left over."""

    source: str
    posture: str
    points_base_mm: FloatArray = floats("N", 3)
    residual_mm: FloatArray = floats("N")


@dataclass(frozen=True, slots=True, kw_only=True)
class PostureResult:
    """One posture of the arm.

    Parameters
    ----------
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
        deviation; on a sphere, of the error of its pose. 1 is usual.
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


class HandEyeFit(ArrayRecord):
    """A hand-eye calibration and its evidence.

    Parameters
    ----------
    start
        Where the refinement started: on a plate the linear solution.
    reference
        What the reference was and how far the data agree with it, as (label, value) for a reader.
    sensor_step, sensor_covariance
        (P,) by what the stripes move the sensor's parameters, and (P, P) their covariance after it;
        None where the sensor was taken as exact. The calibration belongs to the moved sensor.
    """

    calibration: HandEyeCalibration
    start: Pose[Tool, Sensor]
    stripes: tuple[StripeResidual, ...]
    postures: tuple[PostureResult, ...]
    reference: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...] = ()
    sensor_step: FloatArray | None = floats("P", default=None)
    sensor_covariance: FloatArray | None = floats("P", "P", default=None)

    def sensor_after(self, sensor: SensorCalibration) -> SensorCalibration:
        """The sensor to which the hand-eye belongs."""
        if self.sensor_step is None or self.sensor_covariance is None:
            return sensor
        return sensor.updated(self.sensor_step, self.sensor_covariance)

    def scanner(
        self, sensor: SensorCalibration | None, provenance: Provenance
    ) -> ScannerCalibration:
        """Hand-eye and sensor, of ``sensor`` as it was given; None where points were delivered."""
        moved = None if sensor is None else self.sensor_after(sensor)
        return ScannerCalibration(moved, self.calibration, provenance)

    @property
    def beside_given_sensor(self) -> HandEyeCalibration:
        """The hand-eye that belongs to the sensor as it was given."""
        follow = self.calibration.dhand_eye_dsensor
        if self.sensor_step is None or follow is None:
            return self.calibration
        pose = self.calibration.tool_from_sensor.retract(-follow @ self.sensor_step)
        return replace(self.calibration, tool_from_sensor=pose)


def hand_eye_calibration(
    checked: CheckedFit,
    joint: JointCovariance,
    conditioning: Conditioning,
    *,
    stripes: Sequence[StripeResidual],
    postures: Sequence[PostureResult],
) -> HandEyeCalibration:
    """The document's part: hand-eye, covariance, coupling to the sensor, noise."""
    fit = checked.fit
    used = {posture.posture for posture in postures}
    distances = np.concatenate([one.residual_mm for one in stripes if one.posture in used])
    components, plane = fit.components, plane_after(fit)
    is_estimated = [component.is_estimated for component in components]
    diagnostics = HandEyeDiagnostics(
        method=fit.problem.surface.method,
        rank=conditioning.rank,
        condition=min(conditioning.condition, FINITE_CONDITION),
        weakest=conditioning.weakest,
        plate_flatness_mm=fit.sigma_of("flatness"),
        flatness_length_mm=0.0 if plane is None else fit.problem.options.flatness_length_mm,
        # On a sphere the form of the stripes is always estimated; what counts is the arm.
        is_noise_estimated=is_estimated[0] if plane is None else any(is_estimated),
        left_out_rotation_deg=max(one.left_out_rotation_deg for one in postures),
        left_out_translation_mm=max(one.left_out_translation_mm for one in postures),
        chi2_probability=fit.probability,
        region_factor=joint.region_factor,
        is_arm_given=not is_estimated[0],
    )
    return HandEyeCalibration(
        tool_from_sensor=fit.state.tool_from_sensor,
        covariance=joint.given_sensor + checked.widening,
        dhand_eye_dsensor=joint.dhand_eye_dsensor,
        arm_noise=arm_noise(components, fit.noise.sigmas),
        rms_mm=float(np.sqrt((distances**2).mean())),
        n_postures=len(postures),
        n_exposures=sum(posture.n_exposures for posture in postures),
        n_points=sum(posture.n_points for posture in postures),
        plate=plane,
        diagnostics=diagnostics,
    )


def plane_after(fit: HandEyeSolution) -> Plane | None:
    """The plate as scan and probing together give it; None for a sphere."""
    surface = fit.problem.surface
    return surface.plane_at(fit.surface_after) if isinstance(surface, PlateSurface) else None


def stripe_residuals(
    stripes: Sequence[tuple[PosedStripe, IntArray]], fit: HandEyeSolution
) -> tuple[StripeResidual, ...]:
    """Place the used points (rows) of every exposure and compare them with the reference."""
    surface, parameters, result = fit.problem.surface, fit.surface_after, []
    for stripe, rows in stripes:
        base_from_sensor = stripe.base_from_tool @ fit.state.tool_from_sensor
        points_mm = stripe.beside(fit.state.sensor).points_mm[rows]
        placed = base_from_sensor.apply(fit.state.scale * points_mm)
        result.append(
            StripeResidual(
                source=stripe.source,
                posture=stripe.posture,
                points_base_mm=placed,
                residual_mm=surface.distance(placed, parameters)[0],
            )
        )
    return tuple(result)


def posture_results(
    fit: HandEyeSolution, stripes: Sequence[StripeResidual], left_out: dict[int, LeftOut]
) -> tuple[PostureResult, ...]:
    """Summarise every posture that took part.

    Hand-eye, surface and sensor follow the errors that they can explain. With ``P`` of
    `LinearSolution` and ``D`` the covariance of the scatter alone, the residuals that are left are
    ``D P e``.
    """
    observations, plane = fit.problem.observations, plane_after(fit)
    errors = fit.scatter + fit.known
    results = []
    for number, left in left_out.items():
        rows = observations.posture == number
        name = observations.postures[number]
        of_posture = [stripe for stripe in stripes if stripe.posture == name]
        distances = np.concatenate([stripe.residual_mm for stripe in of_posture])
        share = rows * observations.count / observations.count[rows].sum()
        remaining = share @ fit.scatter @ fit.linear.projected
        sigma_mm = float(np.sqrt(max(remaining @ errors @ remaining, 1e-18)))
        tilt_deg = azimuth_deg = float("nan")
        if plane is not None:
            rotation = observations.rotations[observations.stripe[rows][0]]
            axis = plane.axes @ rotation @ fit.state.tool_from_sensor.rotation[:, 2]
            tilt_deg = float(np.degrees(np.arccos(np.clip(abs(axis[2]), 0.0, 1.0))))
            azimuth_deg = float(np.degrees(np.arctan2(axis[1], axis[0])))
        points = observations.points_mm[observations.of_points(observations.posture) == number]
        results.append(
            PostureResult(
                posture=name,
                n_exposures=len(np.unique(observations.exposure[rows])),
                n_points=len(distances),
                mean_mm=float(distances.mean()),
                rms_mm=float(np.sqrt((distances**2).mean())),
                normalised_mean=float(distances.mean()) / sigma_mm,
                tilt_deg=tilt_deg,
                azimuth_deg=azimuth_deg,
                stand_off_mm=float(np.linalg.norm(points, axis=1).mean()),
                left_out_rotation_deg=float(np.degrees(np.linalg.norm(left.change[:3]))),
                left_out_translation_mm=float(np.linalg.norm(left.change[3:6])),
                left_out_normalised=left.pose_sigmas if plane is None else left.normalised,
            )
        )
    return tuple(results)


def plate_facts(checked: CheckedFit, plate: PlateSurface) -> tuple[tuple[str, str], ...]:
    """What the plate was, and what was taken for scatter, as (label, value)."""
    reference, fit = plate.reference, checked.fit
    is_solved = fit.problem.options.solve_plate
    a, b, c, d = (plane_after(fit) or plate.plane if is_solved else plate.plane).coefficients
    facts = [("Plate", f"{a:.6f} x {_signed(b)} y {_signed(c)} z {_signed(d, 4)} = 0 in Base (mm)")]
    if reference.n_points:
        rms = "" if reference.rms_mm is None else f", {reference.rms_mm:.4f} mm rms from it"
        facts.append(("Probed", f"{reference.n_points} points{rms}"))
    if is_solved:
        facts.append(("Plane", "solved along, without regard to the probing"))
    elif reference.covariance is None and reference.n_points:
        facts.append(("Plane", "taken as exact: the probed plate's uncertainty is not known"))
    elif reference.covariance is None:
        facts.append(("Plane", "taken as exact: only A, B, C, D were given"))
    else:
        facts.append(("Plane", "as probed, weighted by its uncertainty and the tip's"))
    if checked.plane_check:
        facts.append(("Plane, checked", checked.plane_check))
    moved = _sensor_in_words(fit)
    if moved:
        facts.append(("Sensor, moved", moved))
    for component, sigma in zip(fit.components, fit.noise.sigmas, strict=True):
        label, unit, factor = SCATTER_NAMES[component.name]
        origin = "estimated" if component.is_estimated else "given"
        facts.append((f"Scatter, {label}", f"{factor * sigma:.3g}{unit} ({origin})"))
    return tuple(facts)


def _sensor_in_words(fit: HandEyeSolution) -> str:
    """By how much the stripes move the sensor's points; empty where it was taken as exact."""
    observations, step = fit.problem.observations, fit.state.sensor
    by_sensor, covariance = observations.dpoint_dsensor, observations.sensor_covariance
    if step is None or by_sensor is None or covariance is None or not covariance.any():
        return ""
    moved_mm = float(np.sqrt(((by_sensor @ step) ** 2).sum(axis=1).mean()))
    stated = np.einsum("nip,pq,niq->n", by_sensor, covariance, by_sensor, optimize=True)
    return (
        f"its points by {moved_mm:.3f} mm (rms), where its calibration states "
        f"{float(np.sqrt(stated.mean())):.3f} mm"
    )


def _signed(value: float, digits: int = 6) -> str:
    return f"{'-' if value < 0.0 else '+'} {abs(value):.{digits}f}"


@dataclass(frozen=True, slots=True)
class AskedDiameter:
    """Diameter that the points themselves ask for, as if it were solved along.

    ``sigma_mm``: The scatters not taken as known. ``if_known_mm``: As they are estimated.
    """

    diameter_mm: float
    sigma_mm: float
    if_known_mm: float

    def __str__(self) -> str:
        """In words."""
        return (
            f"{self.diameter_mm:.3f} mm, standard deviation {self.sigma_mm:.3f} mm "
            f"({self.if_known_mm:.3f} mm if all scatters are as estimated)"
        )


def sphere_facts(
    fit: HandEyeSolution, joint: JointCovariance, asked: AskedDiameter | None
) -> tuple[tuple[str, str], ...]:
    """What the sphere was, as (label, value)."""
    diameter_mm = 2.0 * float(fit.problem.surface.start[3])
    deviations = np.sqrt(np.diag(joint.unknowns))
    sigma = dict(zip(fit.problem.columns.tolist(), deviations, strict=True))
    x, y, z, radius_mm = fit.state.surface
    rows = [
        ("Sphere's diameter, given", f"{diameter_mm:g} mm"),
        ("Sphere's centre in Base", f"{x:.3f}, {y:.3f}, {z:.3f} mm"),
        ("Its standard deviation", ", ".join(f"{sigma[k]:.3f}" for k in range(6, 9)) + " mm"),
    ]
    if asked is not None:
        rows.append(("Diameter that the points ask for", str(asked)))
    else:
        deviation = 2.0 * sigma[RADIUS_COLUMN]
        text = f"{2.0 * radius_mm:.3f} mm, standard deviation {deviation:.3f} mm"
        rows.append(("Sphere's diameter, solved along", text))
    moved = _sensor_in_words(fit)
    if moved:
        rows.append(("Sensor, moved", moved))
    if SCALE_COLUMN in sigma:
        text = f"{fit.state.scale:.6f}, standard deviation {sigma[SCALE_COLUMN]:.6f}"
        rows.append(("Scale of the sensor's points", text))
    return tuple(rows)


def diameter_asked(fit: HandEyeSolution) -> AskedDiameter | None:
    """Solve the diameter along; None where it is anyway.

    The scatter is estimated anew: as long as the diameter is held, a wrong one counts as form of
    the stripes, and is hidden by it.
    """
    if fit.problem.options.solve_diameter:
        return None
    columns = np.union1d(fit.problem.columns, [RADIUS_COLUMN])
    residual, jacobian = fit.placed.residual_mm, fit.placed.jacobian[:, columns]
    noise = estimate_noise(residual, jacobian, fit.components, fit.known, fit.noise.sigmas)
    scatter = total_covariance(fit.components, noise.sigmas)
    freed = minimise_distances(fit.problem, fit.state, scatter, columns)
    if freed is None:
        return AskedDiameter(2.0 * float(fit.state.surface[3]), float("inf"), float("inf"))
    placed = fit.problem.place(freed.state)
    known, jacobian = fit.problem.sensor_covariance(placed), placed.jacobian[:, columns]
    diameter_mm = 2.0 * float(freed.state.surface[3])
    linear = solve_linear(placed.residual_mm, jacobian, scatter + known)
    if linear is None:
        return AskedDiameter(diameter_mm, float("inf"), float("inf"))
    whole = covariance_over_noise(placed.residual_mm, jacobian, fit.components, known, noise)
    k = int(np.flatnonzero(columns == RADIUS_COLUMN)[0])
    sigma_mm, if_known_mm = (
        2.0 * float(np.sqrt(matrix[k, k])) for matrix in (whole.matrix, linear.covariance)
    )
    return AskedDiameter(diameter_mm, sigma_mm, if_known_mm)


def refuse_diameter(asked: AskedDiameter, fit: HandEyeSolution) -> FitFailure | None:
    """Refuse a sphere of which the points say that it has quite another diameter."""
    given_mm = 2.0 * float(fit.problem.surface.start[3])
    off_mm = abs(asked.diameter_mm - given_mm)
    least_mm = max(NO_DIAMETER * asked.if_known_mm, WRONG_DIAMETER * asked.sigma_mm)
    if off_mm < max(NO_DIAMETER_PART * given_mm, least_mm):
        return None
    return FitFailure(
        f"the points ask for a diameter of {asked}, not of {given_mm:g} mm",
        "check the sphere's diameter, and that the sensor's calibration is this one: its points "
        "may be too large or too small; where neither can be known better, solve the diameter "
        "along (--solve-diameter)",
    )


def sphere_warnings(
    fit: HandEyeSolution,
    sections: Sequence[CircleSection],
    postures: Sequence[PostureResult],
    asked: AskedDiameter | None,
) -> tuple[str, ...]:
    """What is weak about postures, stripes and diameter."""
    found, weights = [], fit.problem.weights
    for k, posture in enumerate(postures):
        if posture.left_out_normalised > OUTLYING:
            weight = 1.0 if weights is None else weights[k]
            found.append(
                f"posture {posture.posture} contradicts the others: its pose errs by "
                f"{posture.left_out_normalised:.1f} standard deviations (weight {weight:.2f})"
            )
    for section in sections:
        n = len(section.rows) + section.n_rejected
        if section.n_rejected > REJECTED_SHARE * n:
            found.append(
                f"{section.stripe.source}: {section.n_rejected} of {n} points lie off its section "
                "of the sphere and are left out"
            )
    usual_deg = float(np.median([section.arc_deg for section in sections]))
    for section in sections:
        if section.arc_deg < SHORT_ARC * usual_deg:
            found.append(
                f"{section.stripe.source} is weak: its arc of {section.arc_deg:.0f} degrees is "
                f"short, {usual_deg:.0f} are usual"
            )
    given_mm = 2.0 * float(fit.problem.surface.start[3])
    if asked and abs(asked.diameter_mm - given_mm) > WRONG_DIAMETER * asked.if_known_mm:
        found.append(
            f"the points ask for a diameter of {asked}, not of {given_mm:g} mm: check the diameter "
            "and the sensor's scale"
        )
    if not fit.is_settled:
        found.append("the refinement had not settled when its steps ran out")
    return tuple(found)


REPEAT_NAMES = ("theta_deg", "gamma_deg", "phi_deg", "x_mm", "y_mm", "z_mm")
"""Order of all (6,) and (K, 6) arrays here: angles of eq. 2.69, then the translation in Tool."""
CONFIDENCE = 0.95
GIMBAL_SINE = 0.9999


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RepeatStudy:
    """K hand-eyes of one head, calibrated anew each time.

    Parameters
    ----------
    values
        (K, 6) angles and translation of each.
    mean
        Mean rotation (the rotation nearest to the mean matrix) and mean translation.
    std
        (6,) standard deviation of one calibration, with K - 1 in the denominator.
    predicted
        (6,) root of the mean predicted variance; None where covariances are not known.
    ratio_range
        Range in which ``std / predicted`` falls in 95 % of studies of K calibrations, if the
        prediction is right.
    """

    values: FloatArray
    mean: Pose[Tool, Sensor]
    std: FloatArray
    predicted: FloatArray | None
    ratio_range: tuple[float, float]

    @property
    def mean_values(self) -> FloatArray:
        """(6,) angles of the mean rotation in degrees, and mean translation in mm."""
        return _values(self.mean)

    @property
    def ratio(self) -> FloatArray | None:
        """(6,) observed over predicted standard deviation; None without prediction."""
        return None if self.predicted is None else self.std / self.predicted

    @property
    def unlike_predicted(self) -> tuple[str, ...]:
        """Names of the parameters whose scatter falls out of the range."""
        ratio = self.ratio
        if ratio is None:
            return ()
        low, high = self.ratio_range
        return tuple(
            name
            for name, one in zip(REPEAT_NAMES, ratio.tolist(), strict=True)
            if not low <= one <= high
        )


def study_repeats(
    calibrations: Sequence[HandEyeCalibration], sensor_covariance: FloatArray | None = None
) -> RepeatStudy | FitFailure:
    """Compare the scatter of repeated calibrations with the standard deviations they state.

    ``sensor_covariance`` (P, P) is that of the one sensor that all were calibrated with. What its
    error does to all alike is left out; how differently it moves them, as their postures differ, is
    a part of the scatter. None takes it as exact.
    """
    poses = [one.tool_from_sensor for one in calibrations]
    covariances = [one.covariance for one in calibrations]
    follow = [one.dhand_eye_dsensor for one in calibrations if one.dhand_eye_dsensor is not None]
    n = len(calibrations)
    if sensor_covariance is not None and len(follow) == n > 1:
        apart = np.array(follow) - np.mean(follow, axis=0)
        unlike = n / (n - 1) * (apart @ sensor_covariance @ apart.transpose(0, 2, 1))
        covariances = [own + more for own, more in zip(covariances, unlike, strict=True)]
    return study_poses(poses, covariances)


def study_poses(
    poses: Sequence[Pose[Tool, Sensor]], covariances: Sequence[FloatArray] | None = None
) -> RepeatStudy | FitFailure:
    """As `study_repeats`, from hand-eyes alone.

    Parameters
    ----------
    poses
        ``tool_from_sensor`` of each calibration.
    covariances
        (6, 6) of each in the order of
        `armscan.models.calibration.HAND_EYE_PARAMETER_NAMES`, or None.

    Raises
    ------
    InputError
        If the counts differ.
    """
    n = len(poses)
    if covariances is not None and len(covariances) != n:
        raise InputError(f"{len(covariances)} covariances for {n} hand-eyes")
    if n < 2:
        return FitFailure(f"{n} calibration has no scatter", "calibrate two times or more")
    rotation = nearest_rotation(np.sum([pose.rotation for pose in poses], axis=0))
    shift = np.mean([pose.translation_mm for pose in poses], axis=0)
    mean: Pose[Tool, Sensor] = Pose(rotation, shift)
    if abs(rotation[0, 2]) > GIMBAL_SINE:
        return FitFailure(
            "the angles of eq. 2.69 are not unique: gamma is 90 degrees",
            "compare rotation vectors instead",
        )
    centre = _values(mean)
    values = np.array([_values(pose) for pose in poses])
    values[:, :3] = centre[:3] + (values[:, :3] - centre[:3] + 180.0) % 360.0 - 180.0
    predicted = None
    if covariances is not None:
        spread = [
            angle_covariance(pose.rotation, covariance)
            for pose, covariance in zip(poses, covariances, strict=True)
        ]
        predicted = np.sqrt(np.diag(np.mean(spread, axis=0)))
    low, high = np.sqrt(chdtri(n - 1, [0.5 + 0.5 * CONFIDENCE, 0.5 - 0.5 * CONFIDENCE]) / (n - 1))
    std = values.std(axis=0, ddof=1)
    return RepeatStudy(
        values=values,
        mean=mean,
        std=std,
        predicted=predicted,
        ratio_range=(float(low), float(high)),
    )


def angle_covariance(rotation: FloatArray, covariance: FloatArray) -> FloatArray:
    """(6, 6) covariance of `REPEAT_NAMES` from that of the hand-eye's parameters.

    With R = Rx(theta) Ry(gamma) Rz(phi) of eq. 2.69, turns of the three angles act about x, about
    the turned y and about the twice turned z.

    Parameters
    ----------
    rotation
        (3, 3) of ``tool_from_sensor``; gamma not 90 degrees.
    covariance
        (6, 6) in the order of `armscan.models.calibration.HAND_EYE_PARAMETER_NAMES`.
    """
    theta = float(np.radians(_values(Pose(rotation, np.zeros(3)))[0]))
    turned_y = np.array([0.0, np.cos(theta), np.sin(theta)])
    axes = np.column_stack([[1.0, 0.0, 0.0], turned_y, rotation[:, 2]])
    by_parameters = np.eye(6)
    by_parameters[:3, :3] = np.degrees(np.linalg.inv(axes))
    return np.asarray(by_parameters @ covariance @ by_parameters.T)


def _values(pose: Pose[Tool, Sensor]) -> FloatArray:
    angles = np.degrees(euler_from_rotations(pose.rotation, "intrinsic-xyz")[0])
    return np.concatenate([angles, pose.translation_mm])


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeNumbers:
    """A hand-eye as people read it.

    Parameters
    ----------
    euler_deg, euler_sigma_deg
        (3,) angles of eq. 2.69, ``R = Rx(theta) Ry(gamma) Rz(phi)``, and standard deviations.
    translation_mm, translation_sigma_mm
        (3,) origin of Sensor in Tool.
    rotation_sigma_deg
        Root mean square standard deviation of a rotation about an axis of Tool.
    size_sigma_mm
        Root mean square standard deviation of a component of the translation.
    """

    euler_deg: FloatArray
    euler_sigma_deg: FloatArray
    translation_mm: FloatArray
    translation_sigma_mm: FloatArray
    rotation_sigma_deg: float
    size_sigma_mm: float


def hand_eye_numbers(hand_eye: HandEyeCalibration, covariance: FloatArray) -> HandEyeNumbers:
    """Numbers of a hand-eye under a covariance (6, 6), in the order of its own."""
    rotation = hand_eye.tool_from_sensor.rotation
    steps = np.stack([rotation_from_vector(ANGLE_STEP_RAD * axis) @ rotation for axis in np.eye(3)])
    angles = euler_from_rotations(rotation[None], "intrinsic-xyz")[0]
    difference = euler_from_rotations(steps, "intrinsic-xyz") - angles
    wrapped = (difference + np.pi) % (2.0 * np.pi) - np.pi
    deuler_drotation = wrapped.T / ANGLE_STEP_RAD
    euler_variance = np.diag(deuler_drotation @ covariance[:3, :3] @ deuler_drotation.T)
    variance = np.diag(covariance)
    return HandEyeNumbers(
        euler_deg=np.degrees(angles),
        euler_sigma_deg=np.degrees(np.sqrt(euler_variance)),
        translation_mm=np.asarray(hand_eye.tool_from_sensor.translation_mm),
        translation_sigma_mm=np.sqrt(variance[3:]),
        rotation_sigma_deg=float(np.degrees(np.sqrt(variance[:3].mean()))),
        size_sigma_mm=float(np.sqrt(variance[3:].mean())),
    )
