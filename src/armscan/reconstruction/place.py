# SPDX-License-Identifier: Apache-2.0
"""Points from Sensor to Base through the hand-eye and the arm's pose, with full covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Base, Sensor, Tool
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import skew
from armscan.models.scanner import ArmNoise, ScannerCalibration
from armscan.reconstruction.triangulate import StripePoints, noise_size_mm, sensor_columns
from armscan.records.cloud import PointCloud
from armscan.records.profile import Profile


@dataclass(frozen=True, slots=True, eq=False)
class PlacedJacobian:
    """Points in Base with the derivatives that their covariance needs.

    Parameters
    ----------
    points_base_mm
        (N, 3).
    by_sensor_point
        (3, 3) by the point in the Sensor frame: one rotation for all points.
    by_hand_eye
        (N, 3, 6) by `armscan.models.scanner.HAND_EYE_PARAMETER_NAMES`.
    """

    points_base_mm: FloatArray
    by_sensor_point: FloatArray
    by_hand_eye: FloatArray


def place_with_jacobian(
    points_sensor_mm: FloatArray,
    base_from_tool: Pose[Base, Tool],
    tool_from_sensor: Pose[Tool, Sensor],
) -> PlacedJacobian:
    """Map (N, 3) points from Sensor to Base and differentiate (eq. 2.53)."""
    turned = points_sensor_mm @ tool_from_sensor.rotation.T
    in_tool = turned + tool_from_sensor.translation_mm
    by_hand_eye = np.concatenate(
        [-skew(turned), np.broadcast_to(np.eye(3), (len(turned), 3, 3))], axis=2
    )
    return PlacedJacobian(
        in_tool @ base_from_tool.rotation.T + base_from_tool.translation_mm,
        base_from_tool.rotation @ tool_from_sensor.rotation,
        base_from_tool.rotation @ by_hand_eye,
    )


def scan_point_mm(scanner: ScannerCalibration) -> FloatArray | None:
    """(3,) middle of the working range in Sensor, about which the arm's noise is given.

    The mean of the light sheets' origins; None for a sensor that delivers points itself.
    """
    if scanner.sensor is None:
        return None
    return np.asarray(np.mean([s.sheet.origin_mm for s in scanner.sensor.sheets], axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class Placing:
    """What placing needs of a scanner, computed once for all exposures.

    Parameters
    ----------
    scanner
        The calibration.
    factors
        One (Q + 6, K) matrix F a sheet with ``F F'`` the joint covariance of what its points
        depend on (`sensor_columns`) and of the hand-eye; (6, K) where the sensor delivers points.
    scan_point_mm
        (3,) in Sensor; None to take the mean of each exposure's points.
    """

    scanner: ScannerCalibration
    factors: tuple[FloatArray, ...]
    scan_point_mm: FloatArray | None


def prepare_placing(scanner: ScannerCalibration) -> Placing:
    """Factor the scanner's joint covariance sheet by sheet.

    Raises
    ------
    InputError
        If the covariance is not positive semi-definite.
    """
    joint = scanner.covariance
    if scanner.sensor is None:
        return Placing(scanner, (_factor(joint),), None)
    n = len(scanner.sensor.parameter_names)
    hand_eye = np.arange(n, n + 6)
    factors = []
    for k in range(len(scanner.sensor.sheets)):
        places = np.concatenate([sensor_columns(scanner.sensor, k), hand_eye])
        factors.append(_factor(joint[np.ix_(places, places)]))
    return Placing(scanner, tuple(factors), scan_point_mm(scanner))


def _factor(covariance: FloatArray) -> FloatArray:
    """F with F F' = covariance, in units that make its diagonal one, so that none is lost."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    if len(values) and float(values[0]) < -1e-6 * max(float(values[-1]), 1.0):
        raise InputError(
            "the scanner's covariance is not positive semi-definite",
            remedy="calibrate again: the document was changed or is damaged",
        )
    kept = values > 1e-15 * max(float(values[-1]), 0.0)
    return np.asarray(unit[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def place_stripe(
    stripe: StripePoints, profile: Profile, base_from_tool: Pose[Base, Tool], placing: Placing
) -> PointCloud:
    """Place the points of one exposure in Base.

    Parameters
    ----------
    stripe
        Points in Sensor with what their errors come from.
    profile
        The stripe points that they were triangulated from.
    base_from_tool
        The arm's pose at that exposure.
    placing
        Of the scanner whose sensor triangulated the points.

    Returns
    -------
    PointCloud
        In Base. The covariance holds the stripe's noise, that of sensor and hand-eye together
        (an error of the sensor that the hand-eye follows largely cancels), and the arm's: the
        part common to a posture and the part new in every exposure.

    Raises
    ------
    InputError
        If the scanner has no sensor.
    """
    scanner = placing.scanner
    if scanner.sensor is None:
        raise InputError("this scanner has no camera", remedy="place its profiles instead")
    placed = place_with_jacobian(
        stripe.points_mm, base_from_tool, scanner.hand_eye.tool_from_sensor
    )
    by_sensor = placed.by_sensor_point @ stripe.by_sensor
    by_all = np.concatenate([by_sensor, placed.by_hand_eye], axis=2)
    covariance = np.zeros((len(stripe.row), 3, 3))
    for k, factor in enumerate(placing.factors):
        own = np.flatnonzero(stripe.sheet == k)
        covariance[own] = _propagated(by_all[own], factor)
    covariance += _pose_and_noise(placed, stripe.noise_mm, base_from_tool, placing)
    return PointCloud(
        "Base",
        placed.points_base_mm,
        0.5 * (covariance + covariance.transpose(0, 2, 1)),
        noise_size_mm(stripe.noise_mm),
        stripe.sheet,
        tuple(sheet.name for sheet in scanner.sensor.sheets),
        np.zeros(len(stripe.row), dtype=np.int64),
        (profile.source,),
        profile.segment[stripe.row],
        profile.intensity[stripe.row],
    )


def place_delivered_points(
    points_sensor_mm: FloatArray,
    noise_mm: FloatArray,
    base_from_tool: Pose[Base, Tool],
    placing: Placing,
) -> tuple[FloatArray, FloatArray]:
    """Place points that the sensor itself delivered.

    Parameters
    ----------
    points_sensor_mm
        (N, 3).
    noise_mm
        (N, 3, J) one standard deviation of each of a point's own noises, as the vector in which it
        acts.
    base_from_tool, placing
        As for `place_stripe`.

    Returns
    -------
    points_base_mm, covariance_mm2
        (N, 3) and (N, 3, 3).

    Raises
    ------
    InputError
        If the scanner has a camera: its points depend on the camera's parameters too.
    """
    if placing.scanner.sensor is not None:
        raise InputError("this scanner has a camera", remedy="place its stripes instead")
    placed = place_with_jacobian(
        points_sensor_mm, base_from_tool, placing.scanner.hand_eye.tool_from_sensor
    )
    covariance = _propagated(placed.by_hand_eye, placing.factors[0])
    covariance += _pose_and_noise(placed, noise_mm, base_from_tool, placing)
    return placed.points_base_mm, 0.5 * (covariance + covariance.transpose(0, 2, 1))


def arm_covariance(
    points_base_mm: FloatArray, scan_point_base_mm: FloatArray, noise: ArmNoise
) -> FloatArray:
    """(N, 3, 3) what the arm's scatter adds: shifts, and turns about the scan point."""
    position = noise.position_mm**2 + noise.exposure_position_mm**2
    rotation = noise.rotation_rad**2 + noise.exposure_rotation_rad**2
    lever = points_base_mm - scan_point_base_mm
    square = np.einsum("ni,ni->n", lever, lever)
    turned = square[:, None, None] * np.eye(3) - lever[:, :, None] * lever[:, None, :]
    return np.asarray(position * np.eye(3) + rotation * turned)


def _propagated(jacobian: FloatArray, factor: FloatArray) -> FloatArray:
    """(N, 3, 3) J F F' J' of (N, 3, P) derivatives."""
    n_points, _, n_parameters = jacobian.shape
    moved = jacobian.reshape(3 * n_points, n_parameters) @ factor
    moved = moved.reshape(n_points, 3, factor.shape[1])
    return np.asarray(moved @ moved.transpose(0, 2, 1))


def _pose_and_noise(
    placed: PlacedJacobian, noise_mm: FloatArray, base_from_tool: Pose[Base, Tool], placing: Placing
) -> FloatArray:
    """(N, 3, 3) of the points' own noise and of the arm."""
    hand_eye = placing.scanner.hand_eye
    if placing.scan_point_mm is None:
        middle = placed.points_base_mm.mean(axis=0) if len(noise_mm) else np.zeros(3)
    else:
        in_tool = (
            hand_eye.tool_from_sensor.rotation @ placing.scan_point_mm
            + hand_eye.tool_from_sensor.translation_mm
        )
        middle = base_from_tool.rotation @ in_tool + base_from_tool.translation_mm
    noise = placed.by_sensor_point @ noise_mm
    covariance = arm_covariance(placed.points_base_mm, middle, hand_eye.arm_noise)
    return np.asarray(covariance + noise @ noise.transpose(0, 2, 1))
