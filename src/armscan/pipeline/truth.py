# SPDX-License-Identifier: Apache-2.0
"""Errors against a known truth: cameras, light sheets, hand-eye, labels of stripes, and
distances from a surface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.devices.sources import SimulatedScan, TrueStripe, TwinScene, TwinTruth
from armscan.errors import EstimationError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.inspection.results import PlaneInspection, SphereInspection, StepInspection
from armscan.inspection.uncertainty import COARSE_BLOCKS, exposure_blocks
from armscan.models.calibration import (
    ArmNoise,
    CameraCalibration,
    ScannerCalibration,
    SensorCalibration,
    SheetCalibration,
    independent_parameters,
)
from armscan.pipeline.instants import group_instants
from armscan.pipeline.measure import measured_again
from armscan.pipeline.scan import ScanReconstruction
from armscan.reconstruction.labels import LabelledProfile, PointStatus
from armscan.reconstruction.place import place_with_jacobian
from armscan.reconstruction.triangulate import sensor_columns
from armscan.records.cloud import PointCloud

PART_REACH_MM = 1.0
"""Points of the part's scan further than this from its surface lie on what stands around it."""


@dataclass(frozen=True, slots=True)
class CameraErrors:
    """A calibrated camera against the true one.

    Parameters
    ----------
    focal_px, focal_sigma_px
        Error and stated sigma of fx.
    normalised, n_parameters
        Length of the error of all free parameters in their own sigmas, ``sqrt(e' C^-1 e)``, and
        their count.
    """

    focal_px: float
    focal_sigma_px: float
    normalised: float
    n_parameters: int


@dataclass(frozen=True, slots=True)
class SheetErrors:
    """A calibrated sheet against the true one, over the region of the boards.

    Parameters
    ----------
    angle_deg
        Between the two surfaces' directions in the middle.
    offset_mm
        Between them in the middle.
    rms_mm
        Root mean square distance over the true stripes.
    normalised
        Length of the error of the parameters in their own sigmas, ``sqrt(e' C^-1 e)``.
    n_parameters
        Count of parameters in it: 3 for a plane, 8 with a bow.
    """

    angle_deg: float
    offset_mm: float
    rms_mm: float
    normalised: float
    n_parameters: int


@dataclass(frozen=True, slots=True)
class HandEyeErrors:
    """A calibrated hand-eye against the true one.

    Parameters
    ----------
    rotation_deg, translation_mm
        Size of the rotation between them, and of the difference of their origins.
    normalised
        Length of the error of the six parameters in their own sigmas, the sensor's uncertainty
        included; 2.4 is usual.
    """

    rotation_deg: float
    translation_mm: float
    normalised: float


@dataclass(frozen=True, slots=True, eq=False)
class PartErrors:
    """Points of the free-form part against its true surface.

    Parameters
    ----------
    rows
        (N,) rows of the cloud within `PART_REACH_MM` of the true surface.
    distance_mm, normalised
        (N,) their signed distances from it, and these over the stated sigma along its normal.
    n_elsewhere
        Points further away.
    """

    rows: IntArray
    distance_mm: FloatArray
    normalised: FloatArray
    n_elsewhere: int

    @property
    def rms_mm(self) -> float:
        """Root mean square distance."""
        return float(np.sqrt(np.mean(self.distance_mm**2)))

    @property
    def normalised_rms(self) -> float:
        """The same over the stated sigmas; 1 is usual."""
        return float(np.sqrt(np.mean(self.normalised**2)))

    def fraction_within(self, limit_mm: float) -> float:
        """Share of the points within a distance of the true surface."""
        return float(np.mean(np.abs(self.distance_mm) <= limit_mm))


@dataclass(frozen=True, slots=True, eq=False)
class HeadDemo:
    """What a demo found of one head, and how far that is from the truth.

    Parameters
    ----------
    sensor, scanner
        As the commands calibrated them.
    scans
        Points in Base of every scene that was scanned by hand.
    plate, ball
        Inspections of the plate and of the ball.
    steps
        One inspection a gauge block, through the arm.
    still_step, still_normal
        A block in one exposure, in Sensor; and the normal (3,) of its faces there, from the
        arm's pose.
    part
        The free-form part.
    naming
        Names of stripes against the truth, by scene; empty for a head of one sheet.
    cameras, sheets, hand_eye
        Errors of the calibrations: a camera each, left first; a sheet each, in their order; where
        the sensor sits on the arm.
    """

    sensor: SensorCalibration
    scanner: ScannerCalibration
    scans: Mapping[TwinScene, ScanReconstruction]
    plate: PlaneInspection
    ball: SphereInspection
    steps: tuple[StepInspection, ...]
    still_step: StepInspection
    still_normal: FloatArray
    part: PartErrors
    naming: Mapping[TwinScene, NamingErrors]
    cameras: tuple[CameraErrors, ...]
    sheets: tuple[SheetErrors, ...]
    hand_eye: HandEyeErrors


def part_errors(
    cloud: PointCloud, truth: TwinTruth, base_from_cloud: Pose[Base, Any] | None = None
) -> PartErrors:
    """Distances of a cloud from the part's true surface.

    Parameters
    ----------
    cloud
        In Base, or in the frame that ``base_from_cloud`` brings there.
    truth
        The twin's.
    base_from_cloud
        None for Base.

    Raises
    ------
    EstimationError
        If no point lies on the part.
    """
    points, covariance = cloud.points_mm, cloud.covariance_mm2
    if base_from_cloud is not None:
        points = base_from_cloud.apply(points)
        covariance = base_from_cloud.rotate_covariance(covariance)
    distance = truth.part_distance_mm(points)
    rows = np.flatnonzero(np.abs(distance) <= PART_REACH_MM)
    if len(rows) == 0:
        raise EstimationError("no measured point lies on the part")
    normals = truth.part_normals(points[rows])
    variance = np.einsum("ni,nij,nj->n", normals, covariance[rows], normals)
    normalised = np.asarray(distance[rows] / np.sqrt(variance))
    return PartErrors(rows, distance[rows], normalised, len(cloud) - len(rows))


def calibration_errors(
    sensor: SensorCalibration, truth: TwinTruth
) -> tuple[tuple[CameraErrors, ...], tuple[SheetErrors, ...]]:
    """How far cameras and light sheets are from the twin's truth."""
    cameras = [camera_errors(sensor.camera, truth.camera_parameters)]
    if sensor.second is not None and truth.right_camera_parameters is not None:
        cameras.append(camera_errors(sensor.second.camera, truth.right_camera_parameters))
    sheets, names = [], true_names(sensor, truth.sheet_points_mm)
    for k, sheet in enumerate(sensor.sheets):
        of_sheet = sensor.sheet_parameter_slice(k)
        points = truth.sheet_points_mm[names[sheet.name]]
        low, high = sheet.depth_range_mm
        inside = points[(points[:, 2] >= low) & (points[:, 2] <= high)]
        sheets.append(sheet_errors(sheet, sensor.covariance[of_sheet, of_sheet], inside))
    return tuple(cameras), tuple(sheets)


def camera_errors(camera: CameraCalibration, true_parameters: FloatArray) -> CameraErrors:
    """Errors of a camera; the true parameters (9,) in the order of the camera's own.

    Where fy was held to fx, their common error counts once.
    """
    error = camera.camera.parameters - true_parameters
    is_free = np.zeros(len(error), dtype=np.bool_)
    is_free[independent_parameters(camera.covariance)] = True
    return CameraErrors(
        focal_px=float(error[0]),
        focal_sigma_px=float(np.sqrt(camera.covariance[0, 0])),
        normalised=normalised_length(error, camera.covariance, is_free),
        n_parameters=int(is_free.sum()),
    )


def sheet_errors(
    calibration: SheetCalibration, covariance: FloatArray, true_points_mm: FloatArray
) -> SheetErrors:
    """Fit the parameters' error to the heights of true points over the calibrated sheet.

    Parameters
    ----------
    calibration
        The sheet.
    covariance
        (8, 8) of its parameters.
    true_points_mm
        (N, 3) points of the true sheet, Sensor frame.
    """
    sheet = calibration.sheet
    height, _, dheight = sheet.height_with_jacobian(true_points_mm)
    is_free = np.asarray(np.diag(covariance) > 0.0)
    error = np.zeros(len(covariance))
    error[is_free] = np.linalg.lstsq(dheight[:, is_free], height, rcond=None)[0]
    plane = np.linalg.lstsq(dheight[:, :3], height, rcond=None)[0]
    return SheetErrors(
        angle_deg=float(np.degrees(np.hypot(plane[0], plane[1]) / sheet.scale_mm)),
        offset_mm=float(plane[2]),
        rms_mm=float(np.sqrt(np.mean(height**2))),
        normalised=normalised_length(error, covariance, is_free),
        n_parameters=int(is_free.sum()),
    )


def true_names(
    sensor: SensorCalibration, true_points_mm: Mapping[str, FloatArray]
) -> dict[str, str]:
    """The true sheet that each calibrated one is, by its name: the nearest of all.

    A calibration numbers the lines of a source as it finds them; a line that no target ever saw
    shifts the numbers of those after it.

    Raises
    ------
    EstimationError
        If no true sheet has a point at the depths in which a sheet was calibrated.
    """
    found = {}
    for calibrated in sensor.sheets:
        low, high = calibrated.depth_range_mm
        distance = {}
        for name, points in true_points_mm.items():
            inside = points[(points[:, 2] >= low) & (points[:, 2] <= high)]
            if len(inside):
                height = calibrated.sheet.height_with_jacobian(inside)[0]
                distance[name] = float(np.mean(height**2))
        if not distance:
            raise EstimationError(
                f"sheet {calibrated.name} was calibrated from {low:.1f} to {high:.1f} mm, where no "
                "true sheet has a point: which one it is cannot be told",
                remedy="calibrate it over a larger range of depths, from boards of this head",
            )
        found[calibrated.name] = min(distance, key=lambda name: distance[name])
    return found


def hand_eye_errors(scanner: ScannerCalibration, truth: Pose[Tool, Sensor]) -> HandEyeErrors:
    """Errors of the hand-eye of a scanner, in the form of its own parameters."""
    found = scanner.hand_eye.tool_from_sensor
    step = found.step_from(truth)
    covariance = np.asarray(scanner.covariance[-6:, -6:])
    is_free = np.asarray(np.diag(covariance) > 0.0)
    return HandEyeErrors(
        rotation_deg=float(np.degrees(np.linalg.norm(step[:3]))),
        translation_mm=float(np.linalg.norm(step[3:])),
        normalised=normalised_length(step, covariance, is_free),
    )


def normalised_length(error: FloatArray, covariance: FloatArray, is_free: BoolArray) -> float:
    """``sqrt(e' C^-1 e)`` over the free parameters."""
    chosen = np.ix_(is_free, is_free)
    return float(np.sqrt(error[is_free] @ np.linalg.solve(covariance[chosen], error[is_free])))


ON_STRIPE_PX = 2.0
"""An extracted point belongs to the nearest true stripe if that is nearer than this; else it is
stray light's."""
CROSSING_PX = 2.0
"""Where the true stripe of the name given is as near as this, both names are right."""
SEEN_MM = 0.25
"""A true point is seen by the other camera if that one has a true point so near."""
LEAST_POINTS = 20
"""A sheet counts as in view if so many accepted points of it are seen by all cameras."""


@dataclass(frozen=True, slots=True)
class NamingErrors:
    """Names of stripe points against the truth; counts over all instants of a scan.

    Parameters
    ----------
    n_instants
        Instants, with all their images.
    n_named
        Points that were measured and lie on a true stripe; one that two cameras see counts in both
        images.
    n_wrong
        Of these, with the name of another sheet.
    n_stray
        Points that were measured and lie on no true stripe.
    n_shared
        Accepted points on a true stripe that every camera of the head sees.
    n_shared_named
        Of these, measured.
    n_ambiguous, n_unexplained
        Accepted points that were dropped because several sheets, or none, explain them.
    n_stripes_in_view, n_stripes_named
        Sheets of which the left camera saw a stripe that every camera of the head sees, and those
        of them that gave a measured point; summed over the instants.
    """

    n_instants: int = 0
    n_named: int = 0
    n_wrong: int = 0
    n_stray: int = 0
    n_shared: int = 0
    n_shared_named: int = 0
    n_ambiguous: int = 0
    n_unexplained: int = 0
    n_stripes_in_view: int = 0
    n_stripes_named: int = 0

    def __add__(self, other: NamingErrors) -> NamingErrors:
        """Counts of both."""
        return NamingErrors(
            *(getattr(self, f.name) + getattr(other, f.name) for f in fields(NamingErrors))
        )

    @property
    def wrong_share(self) -> float:
        """Share of the measured points that bear a wrong name."""
        return self.n_wrong / max(self.n_named, 1)

    @property
    def named_share(self) -> float:
        """Share of the points that all cameras see that were named."""
        return self.n_shared_named / max(self.n_shared, 1)


def naming_errors(
    scan: ScanReconstruction, truth: SimulatedScan, true_names: Mapping[str, str]
) -> NamingErrors:
    """Compare the names of a scan with the truth of the same exposures.

    Parameters
    ----------
    scan
        What was measured; its rows bear the numbers that they have in the twin's scan.
    truth
        The scan as the twin has it.
    true_names
        The true name of each calibrated sheet, by the name that it was given.
    """
    image_of = dict(zip(scan.image_rows, scan.images, strict=True))
    rows = [exposure.row for exposure in scan.exposures]
    instants = [
        instant
        for instant in group_instants(rows, truth.name)
        if all(row in image_of for row in instant.rows)
    ]
    total = NamingErrors()
    for instant in instants:
        own = [rows[row] for row in instant.rows]
        true = [_lit(truth.true_stripes(row.index), row.lasers) for row in own]
        images = [image_of[row] for row in instant.rows]
        names = tuple(true_names[name] for name in scan.cloud.sheet_names)
        total += _of_instant(images, true, names)
    return total


def _lit(stripes: Sequence[TrueStripe], lasers: tuple[str, ...]) -> list[TrueStripe]:
    """Stripes of the sources that are on; all where the row names none."""
    return [s for s in stripes if not lasers or s.sheet.split(".")[0] in lasers]


def _of_instant(
    images: Sequence[LabelledProfile],
    true: Sequence[Sequence[TrueStripe]],
    names: tuple[str, ...],
) -> NamingErrors:
    total = NamingErrors(n_instants=1)
    in_view: set[str] = set()
    for k, (image, stripes) in enumerate(zip(images, true, strict=True)):
        others = [stripes for j, stripes in enumerate(true) if j != k]
        found, shared = _of_image(image, stripes, others, names)
        total += found
        if k == 0:
            in_view = {name for name, count in shared.items() if count >= LEAST_POINTS}
    seen = {names[k] for image in images for k in set(image.sheet[_measured(image)].tolist())}
    return total + NamingErrors(n_stripes_in_view=len(in_view), n_stripes_named=len(in_view & seen))


def _of_image(
    image: LabelledProfile,
    stripes: Sequence[TrueStripe],
    others: Sequence[Sequence[TrueStripe]],
    names: tuple[str, ...],
) -> tuple[NamingErrors, dict[str, int]]:
    """Names of one image, and how many points that all cameras see each sheet has in it."""
    points, measured = image.profile.points_px, _measured(image)
    distance, nearest = _distances(points, stripes)
    best = np.argmin(distance, axis=1) if len(stripes) else np.zeros(len(points), dtype=np.int64)
    on = distance.min(axis=1, initial=np.inf) < ON_STRIPE_PX
    own = _own_distance(image.sheet, distance, stripes, names)
    right_name = own < CROSSING_PX
    shared = on & image.profile.is_accepted & _seen_by_all(nearest, best, stripes, others)
    counts = {s.sheet: int((shared & (best == k)).sum()) for k, s in enumerate(stripes)}
    beyond = (image.status == PointStatus.OUT_OF_DEPTH) & (image.sheet < 0)
    errors = NamingErrors(
        n_named=int((measured & on).sum()),
        n_wrong=int((measured & on & ~right_name).sum()),
        n_stray=int((measured & ~on).sum()),
        n_shared=int(shared.sum()),
        n_shared_named=int((shared & measured).sum()),
        n_ambiguous=image.count(PointStatus.AMBIGUOUS),
        n_unexplained=image.count(PointStatus.STRAY) + int(beyond.sum()),
    )
    return errors, counts


def _measured(image: LabelledProfile) -> BoolArray:
    """(N,) points whose name counts: measured here or with the other camera's."""
    return np.isin(image.status, (int(PointStatus.MEASURED), int(PointStatus.SHARED)))


def _distances(points: FloatArray, stripes: Sequence[TrueStripe]) -> tuple[FloatArray, IntArray]:
    """(N, S) distances of points from stripes in px, and (N, S) their nearest points."""
    distance = np.full((len(points), len(stripes)), np.inf)
    nearest = np.zeros((len(points), len(stripes)), dtype=np.int64)
    for k, stripe in enumerate(stripes):
        if len(stripe.points_px) and len(points):
            distance[:, k], nearest[:, k] = cKDTree(stripe.points_px).query(points)
    return distance, nearest


def _own_distance(
    sheet: IntArray, distance: FloatArray, stripes: Sequence[TrueStripe], names: tuple[str, ...]
) -> FloatArray:
    """(N,) distance from the true stripe of the name that each point was given."""
    column: Mapping[str, int] = {stripe.sheet: k for k, stripe in enumerate(stripes)}
    own = np.full(len(sheet), np.inf)
    for k, name in enumerate(names):
        if name in column:
            given = sheet == k
            own[given] = distance[given, column[name]]
    return own


def _seen_by_all(
    nearest: IntArray,
    best: IntArray,
    stripes: Sequence[TrueStripe],
    others: Sequence[Sequence[TrueStripe]],
) -> BoolArray:
    """(N,) True where the true point also lies on the same sheet's stripe of every other camera."""
    seen = np.ones(len(best), dtype=np.bool_)
    for other in others:
        by_name = {stripe.sheet: stripe for stripe in other}
        for k, stripe in enumerate(stripes):
            given = np.flatnonzero(best == k)
            there = by_name.get(stripe.sheet)
            if there is None or not len(there.points_base_mm) or not len(stripe.points_base_mm):
                seen[given] = False
                continue
            at = stripe.points_base_mm[nearest[given, k]]
            seen[given] &= cKDTree(there.points_base_mm).query(at)[0] < SEEN_MM
    return seen


def distance_by_plate(plate: PlateReference, points_mm: FloatArray) -> FloatArray:
    """(N, 3) derivative of distances by independent errors of the probed plane, one sigma each."""
    covariance = plate.covariance_with_tip
    if covariance is None:
        return np.zeros((len(points_mm), 0))
    away = (points_mm - plate.plane.point_mm) @ plate.plane.axes.T
    lever = np.column_stack([away[:, 0], away[:, 1], np.ones(len(away))])
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(lever @ vectors * np.sqrt(np.maximum(values, 0.0)))


def distance_by_arm(
    cloud: PointCloud,
    rows: IntArray,
    directions: FloatArray,
    tools_mm: FloatArray,
    noise: ArmNoise,
) -> FloatArray:
    """(N, 9 B) derivative of distances by shifts and turns of the arm, one sigma each.

    ``tools_mm`` (N, 3) is where the origin of Tool was when each point was seen, in Base.

    Neighbouring exposures, B blocks of them, are taken to err alike: an arm's errors depend on its
    posture, which changes little from one to the next.
    """
    points = cloud.points_mm[rows]
    block, n_blocks = exposure_blocks(cloud.exposure[rows], COARSE_BLOCKS[0])
    count = np.bincount(block, minlength=n_blocks)[:, None]
    middle = np.stack([np.bincount(block, points[:, k], n_blocks) for k in range(3)], 1) / count
    sigmas = np.sqrt(noise.variances)
    found = np.zeros((len(points), n_blocks, 9))
    found[np.arange(len(points)), block] = np.column_stack(
        [
            sigmas[0] * directions,
            sigmas[1] * np.cross(points - middle[block], directions),
            sigmas[2] * np.cross(points - tools_mm, directions),
        ]
    )
    return found.reshape(len(points), -1)


def distance_by_calibration(
    scan: ScanReconstruction, scanner: ScannerCalibration, directions: FloatArray
) -> FloatArray:
    """Derivative of every point's distance by the calibration's parameters.

    Parameters
    ----------
    scan
        Points of the whole scan, none cut off by a working volume.
    scanner
        The calibration that made them.
    directions
        (N, 3) unit vector along which each point of ``scan.cloud`` is measured; points with zero
        are left out.

    Returns
    -------
    FloatArray
        (N, P + 6) in the order of ``scanner.covariance``.

    Raises
    ------
    EstimationError
        If the scanner has no camera, or points of the scan were cut off.
    """
    sensor = scanner.sensor
    if sensor is None:
        raise EstimationError("this scanner has no camera", remedy="verify a cloud instead")
    n = len(sensor.parameter_names)
    found = np.zeros((len(scan.cloud), n + 6))
    order = np.argsort(scan.cloud.exposure, kind="stable")
    ends = np.searchsorted(scan.cloud.exposure[order], np.arange(len(scan.images) + 1))
    of_row = dict(enumerate(one.row.lasers for one in scan.exposures))
    lasers = [of_row.get(row, ()) for row in scan.image_rows]
    for k, stripe in measured_again(scan.images, lasers, sensor):
        rows = order[ends[k] : ends[k + 1]]
        along = directions[rows]
        if not along.any():
            continue
        if len(stripe.row) != len(rows):
            raise EstimationError("points of the scan were cut off before the check")
        pose = scan.poses.pose(scan.image_rows[k])
        placed = place_with_jacobian(stripe.points_mm, pose, scanner.hand_eye.tool_from_sensor)
        by_sheet = np.einsum("ni,nip->np", along @ placed.by_sensor_point, stripe.by_sensor)
        for sheet in np.unique(stripe.sheet):
            on = stripe.sheet == sheet
            found[np.ix_(rows[on], sensor_columns(sensor, int(sheet)))] = by_sheet[on]
        found[rows, n:] = np.einsum("ni,nip->np", along, placed.by_hand_eye)
    return found
