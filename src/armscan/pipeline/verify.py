# SPDX-License-Identifier: Apache-2.0
"""Check a scanner on a standard: a scan of a ball or of a probed plate against what is known of it,
and its exposures against each other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import BoolArray, Box, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.inspection.conformity import (
    COVERAGE,
    Check,
    StandardDistances,
    Verdict,
    check_consistency,
    check_contradictions,
    check_exposures_off,
    check_size,
    check_spread,
    worst,
)
from armscan.inspection.plane import (
    OFFSET_OF_PLANE,
    inspect_plane,
    linearised_plane,
    with_reference_errors,
)
from armscan.inspection.results import MeasuredLength, PlaneInspection, SphereInspection
from armscan.inspection.selection import InspectionOptions
from armscan.inspection.sphere import DIAMETER_OF_SPHERE, inspect_sphere, linearised_sphere
from armscan.inspection.uncertainty import FitLinearised, influence_along
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.scan import ScanReconstruction
from armscan.pipeline.truth import distance_by_arm, distance_by_calibration, distance_by_plate
from armscan.records.cloud import PointCloud

NO_POSES = (
    "a cloud does not tell how an error of the hand-eye acts on it, so errors are taken as "
    "independent between blocks of exposures; give the recording for a sharper check"
)
FEW_EXPOSURES = "too few exposures to see whether they agree"
FUSED_EXPOSURES = (
    "the cloud is fused and no longer tells its exposures apart, so that whether they agree is not "
    "seen; verify the recording, or the cloud from before it was fused"
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

    def __post_init__(self) -> None:
        limit, u_mm = self.mpe_mm, self.reference_u_mm
        if limit is not None and not 0.0 < limit < math.inf:
            raise OptionError(
                f"the limit is {limit:g} mm", where="--mpe", remedy="give more than 0 mm"
            )
        if not 0.0 <= u_mm < math.inf:
            raise OptionError(
                f"the uncertainty of the standard is {u_mm:g} mm",
                where="--uncertainty",
                remedy="give 0 mm or more",
            )


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
    region: Box | None = None,
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
    u_radius = options.reference_u_mm / COVERAGE / 2.0
    standard = _Standard(
        distance_mm=fit.residuals_mm + found.sphere.radius_mm - diameter_mm / 2.0,
        by_place=-fit.directions,
        by_standard=np.full((len(used), 1), -u_radius),
    )
    return _judged(
        _Evidence(measured, used, fit, DIAMETER_OF_SPHERE, found.diameter, standard, region),
        found,
        ("diameter", "fitted minus nominal diameter (P_Size.Sph.All of ISO 10360-8)"),
        found.diameter.value_mm - diameter_mm,
        options,
    )


def verify_on_plate(
    measured: Measured,
    plate: PlateReference,
    options: VerifyOptions | None = None,
    *,
    region: Box | None = None,
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
    points = cloud.points_mm[used]
    standard = _Standard(
        distance_mm=plate.plane.distance_mm(points),
        by_place=np.zeros((len(used), 0)),
        by_standard=distance_by_plate(plate, points),
    )
    told, u, unknown = found, options.reference_u_mm, ("the plate's own uncertainty is not known",)
    if (covariance := plate.covariance_with_tip) is not None:
        # not in the offset of the check, whose U holds it beside what the scan scatters by
        told = with_reference_errors(found, covariance)
        u = max(u, COVERAGE * told.reference_sigma_mm)
    return _judged(
        _Evidence(
            measured,
            used,
            linearised_plane(found.plane, points),
            OFFSET_OF_PLANE,
            offset,
            standard,
            region,
        ),
        told,
        ("height", "of the scanned plane over the probed one, at the middle of the points"),
        offset.value_mm,
        replace(options, reference_u_mm=u),
        warnings=() if covariance is not None else unknown,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Standard:
    """Distances (N,) from the standard and what they depend on besides the calibration."""

    distance_mm: FloatArray
    by_place: FloatArray
    by_standard: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    """What the checks look at: the fit and its points, the length that follows from it with its
    derivatives ``slope`` (P,) by the fit's parameters, the standard, the region.
    """

    measured: Measured
    used: IntArray
    fit: FitLinearised
    slope: FloatArray
    length: MeasuredLength
    standard: _Standard
    region: Box | None

    @property
    def within(self) -> BoolArray:
        """(N,) points in the region that was asked for."""
        points = self.measured.cloud.points_mm
        return np.ones(len(points), np.bool_) if self.region is None else self.region.holds(points)


def _judged(
    evidence: _Evidence,
    found: SphereInspection | PlaneInspection,
    names: tuple[str, str],
    error_mm: float,
    options: VerifyOptions,
    *,
    warnings: tuple[str, ...] = (),
) -> Verification:
    cloud, used, fit = evidence.measured.cloud, evidence.used, evidence.fit
    scan, scanner = evidence.measured.scan, evidence.measured.scanner
    exposure = cloud.exposure[used]
    variance = np.einsum("ni,nij,nj->n", fit.directions, cloud.covariance_mm2[used], fit.directions)
    sigma_mm = evidence.length.sigma_propagated_mm
    consistency = None
    if scan is not None and scanner is not None:
        directions = np.zeros((len(cloud), 3))
        directions[used] = fit.directions
        effect = distance_by_calibration(scan, scanner, directions)[used]
        gradient = effect.T @ influence_along(fit.jacobian, evidence.slope)
        sigma_mm = math.sqrt(max(0.0, float(gradient @ scanner.covariance @ gradient)))
        s = evidence.standard
        tools_mm = scan.poses.translations_mm[np.array(scan.image_rows)[exposure]]
        arm = scanner.hand_eye.arm_noise
        others = np.hstack(
            [s.by_standard, distance_by_arm(cloud, used, fit.directions, tools_mm, arm)]
        )
        consistency = check_consistency(
            StandardDistances(
                s.distance_mm,
                effect,
                scanner.covariance,
                s.by_place,
                others,
                exposure,
                float(np.sqrt(np.mean(fit.residuals_mm**2))),
            )
        )
    else:
        warnings = (*warnings, NO_POSES)
    size = check_size(
        *names,
        error_mm,
        sigma_mm,
        _scan_sigma_mm(evidence.length),
        reference_u_mm=options.reference_u_mm,
        mpe_mm=options.mpe_mm,
    )
    spread = check_spread(fit.residuals_mm, variance, exposure)
    off = check_exposures_off(cloud, found, evidence.within)
    sound = None if scan is None else check_contradictions(scan.contradictions)
    checks = tuple(c for c in (size, consistency, spread, off, sound) if c is not None)
    if spread is None or (scan is not None and consistency is None):
        warnings = (*warnings, FUSED_EXPOSURES if cloud.is_fused else FEW_EXPOSURES)
    if not variance.any():
        warnings = (*warnings, "the cloud carries no standard deviations to compare with")
    return Verification(checks, worst(tuple(c.verdict for c in checks)), found, warnings)


def _scan_sigma_mm(length: MeasuredLength) -> float:
    """What the scan's own scatter adds; its propagated sigma where that cannot be seen."""
    if math.isfinite(length.sigma_scatter_mm):
        return length.sigma_scatter_mm
    return length.sigma_propagated_mm
