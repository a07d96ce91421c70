# SPDX-License-Identifier: Apache-2.0
"""The daily check: is a scanner still as its calibration says?"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.errors import EstimationError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.inspection.cleaning import Region
from armscan.inspection.options import InspectionOptions
from armscan.inspection.plane import inspect_plane, linearised_plane
from armscan.inspection.results import MeasuredLength, PlaneInspection, SphereInspection
from armscan.inspection.sphere import inspect_sphere, linearised_sphere
from armscan.inspection.uncertainty import FitLinearised, influence
from armscan.inspection.verdict import Check, Verdict, check_size, check_spread, worst
from armscan.models.scanner import ScannerCalibration
from armscan.pipeline.scan_result import ScanReconstruction
from armscan.reconstruction.place import place_with_jacobian
from armscan.reconstruction.result import PointFate
from armscan.reconstruction.triangulate import sensor_columns, triangulate_stripe
from armscan.records.cloud import PointCloud

NO_POSES = (
    "a cloud does not tell how an error of the hand-eye acts on it, so errors are taken as "
    "independent from exposure to exposure; give the recording for a sharper check"
)


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """What is checked: a cloud, and where it came from if that is known.

    Parameters
    ----------
    cloud
        Points in Base.
    scan, scanner
        The scan and the calibration that made them; None for a cloud from a file.
    """

    cloud: PointCloud
    scan: ScanReconstruction | None = None
    scanner: ScannerCalibration | None = None


@dataclass(frozen=True, slots=True)
class VerifyOptions:
    """How a check is judged.

    Parameters
    ----------
    mpe_mm
        Limit of the size's or place's error; None to derive it from the calibration.
    reference_u_mm
        Expanded uncertainty (k = 2) of the ball's diameter.
    """

    mpe_mm: float | None = None
    reference_u_mm: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Verification:
    """A check with its evidence.

    Parameters
    ----------
    checks
        Each with its own verdict.
    verdict
        The worst of them.
    found
        What was measured.
    warnings
        What is weak, in words.
    """

    checks: tuple[Check, ...]
    verdict: Verdict
    found: SphereInspection | PlaneInspection
    warnings: tuple[str, ...]


def verify_on_ball(
    measured: Measured,
    diameter_mm: float,
    options: VerifyOptions | None = None,
    *,
    region: Region | None = None,
    inspection: InspectionOptions | None = None,
) -> Verification:
    """Check the diameter of a ball, and whether exposures agree on it.

    Raises
    ------
    EstimationError
        If there is no such ball.
    """
    options = options or VerifyOptions()
    cloud = measured.cloud
    found = inspect_sphere(cloud, diameter_mm, region=region, options=inspection)
    if isinstance(found, FitFailure):
        raise EstimationError(found.reason, remedy=found.remedy)
    used = found.rows[found.is_fitted]
    fit = linearised_sphere(found.sphere, cloud.points_mm[used])
    sigma = _calibration_sigma_mm(measured, used, fit, found.diameter)
    size = check_size(
        "diameter, fitted minus nominal (P_Size.Sph.All of ISO 10360-8)",
        found.diameter.value_mm - diameter_mm,
        sigma,
        _scan_sigma_mm(found.diameter),
        reference_u_mm=options.reference_u_mm,
        mpe_mm=options.mpe_mm,
    )
    return _judged(measured, size, fit, used, found)


def verify_on_plate(
    measured: Measured,
    plate: PlateReference,
    options: VerifyOptions | None = None,
    *,
    region: Region | None = None,
    inspection: InspectionOptions | None = None,
) -> Verification:
    """Check the place of a probed plate, and whether exposures agree on it.

    Raises
    ------
    EstimationError
        If there are no points on the plate.
    """
    options = options or VerifyOptions()
    cloud = measured.cloud
    text = "the probed plate's plane"
    found = inspect_plane(
        cloud, plate.plane, reference_text=text, region=region, options=inspection
    )
    if isinstance(found, FitFailure):
        raise EstimationError(found.reason, remedy=found.remedy)
    offset = found.offset or MeasuredLength(math.nan, math.nan, math.nan)
    used = found.rows[found.is_fitted]
    fit = linearised_plane(found.plane, cloud.points_mm[used])
    place = check_size(
        "height of the scanned plane over the probed one, at the middle of the points",
        offset.value_mm,
        _calibration_sigma_mm(measured, used, fit, offset),
        _scan_sigma_mm(offset),
        reference_u_mm=max(options.reference_u_mm, 2.0 * _plate_sigma_mm(plate, found)),
        mpe_mm=options.mpe_mm,
    )
    unknown = () if plate.covariance is not None else ("the plate's own uncertainty is not known",)
    return _judged(measured, place, fit, used, found, warnings=unknown)


def _judged(
    measured: Measured,
    first: Check,
    fit: FitLinearised,
    used: IntArray,
    found: SphereInspection | PlaneInspection,
    *,
    warnings: tuple[str, ...] = (),
) -> Verification:
    cloud = measured.cloud
    variance = np.einsum("ni,nij,nj->n", fit.directions, cloud.covariance_mm2[used], fit.directions)
    spread = check_spread(fit.residuals_mm, variance, cloud.exposure[used])
    checks = (first,) if spread is None else (first, spread)
    if spread is None:
        warnings = (*warnings, "too few exposures to see whether they agree")
    if measured.scan is None:
        warnings = (*warnings, NO_POSES)
    if not variance.any():
        warnings = (*warnings, "the cloud carries no standard deviations to compare with")
    verdict = worst(tuple(check.verdict for check in checks))
    return Verification(checks, verdict, found, warnings)


def _scan_sigma_mm(length: MeasuredLength) -> float:
    """What the scan's own scatter adds; its propagated sigma where that cannot be seen."""
    if math.isfinite(length.sigma_scatter_mm):
        return length.sigma_scatter_mm
    return length.sigma_propagated_mm


def _plate_sigma_mm(plate: PlateReference, found: PlaneInspection) -> float:
    """Standard deviation of the probed plane's height at the middle of the scanned points."""
    if plate.covariance is None:
        return 0.0
    away = (found.plane.point_mm - plate.plane.point_mm) @ plate.plane.axes.T
    lever = np.array([away[0], away[1], 1.0])
    return math.sqrt(max(0.0, float(lever @ plate.covariance @ lever)))


def _calibration_sigma_mm(
    measured: Measured, used: IntArray, fit: FitLinearised, length: MeasuredLength
) -> float:
    """Standard deviation of a fitted length by the calibration alone, as its document says."""
    if measured.scan is None or measured.scanner is None:
        return length.sigma_propagated_mm
    pulls = np.zeros((len(measured.cloud), 3))
    pulls[used] = influence(fit)
    return calibration_sigma_mm(measured.scan, measured.scanner, pulls)


def calibration_sigma_mm(
    scan: ScanReconstruction, scanner: ScannerCalibration, pulls: FloatArray
) -> float:
    """Standard deviation of a length by the joint covariance of sensor and hand-eye.

    Parameters
    ----------
    scan
        Points of the whole scan, none cut off by a working volume.
    scanner
        The calibration that made them.
    pulls
        (N, 3) derivative of the length by each point of ``scan.cloud``.

    Raises
    ------
    EstimationError
        If the scanner has no camera, or points of the scan were cut off.
    """
    sensor = scanner.sensor
    if sensor is None:
        raise EstimationError("this scanner has no camera", remedy="verify a cloud instead")
    n = len(sensor.parameter_names)
    gradient = np.zeros(n + 6)
    order = np.argsort(scan.cloud.exposure, kind="stable")
    ends = np.searchsorted(scan.cloud.exposure[order], np.arange(len(scan.images) + 1))
    for k, image in enumerate(scan.images):
        own = pulls[order[ends[k] : ends[k + 1]]]
        if not own.any():
            continue
        sheets = np.where(image.fate == int(PointFate.MEASURED), image.sheet, -1)
        stripe = triangulate_stripe(image.profile, sheets, sensor)
        if len(stripe.row) != len(own):
            raise EstimationError("points of the scan were cut off before the check")
        pose = scan.poses.pose(scan.image_rows[k])
        placed = place_with_jacobian(stripe.points_mm, pose, scanner.hand_eye.tool_from_sensor)
        turned = own @ placed.by_sensor_point
        for sheet in np.unique(stripe.sheet):
            on = stripe.sheet == sheet
            gradient[sensor_columns(sensor, int(sheet))] += np.einsum(
                "ni,nip->p", turned[on], stripe.by_sensor[on]
            )
        gradient[n:] += np.einsum("ni,nip->p", own, placed.by_hand_eye)
    return math.sqrt(max(0.0, float(gradient @ scanner.covariance @ gradient)))
