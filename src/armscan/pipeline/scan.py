# SPDX-License-Identifier: Apache-2.0
"""A scan measured: every exposure placed in Base or counted with its reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from armscan.devices.sources import ScanSource
from armscan.errors import EstimationError, InputError
from armscan.geometry.arrays import Box, FloatArray
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.models.calibration import ScannerCalibration, SensorCalibration
from armscan.pipeline.instants import PARTNER_MISSING, Instant, ScanInstants
from armscan.pipeline.measure import (
    MeasureOptions,
    cameras_of,
    labeller_for,
    measure_instants,
    measurement_warnings,
    nothing_measured,
    summarised,
)
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.scan_doubts import ScanDoubt, doubt_scan
from armscan.reconstruction.labels import LabelledProfile, PointStatus
from armscan.reconstruction.place import (
    DELIVERED,
    BaseTransform,
    choose_radius_mm,
    cut_cloud,
    delivered_points,
    estimate_normals,
    merge_clouds,
    propagate_to_base,
)
from armscan.reconstruction.points import MeasuredProfile
from armscan.reconstruction.sync import (
    ExposurePoses,
    PoseStatus,
    exposure_poses,
    stripes_at_equal_poses,
)
from armscan.records.cloud import PointCloud
from armscan.records.profile import PointProfile
from armscan.records.recording import ExposureRow
from armscan.storage.detection_cache import DetectionCache

STAGE = "scan"
MANY_WITHOUT_NORMAL = 0.1
"""A larger share of points without normal is warned of."""
LISTED = 4


class ExposureStatus(Enum):
    """What became of one exposure of a scan; the value is what a report shows."""

    PLACED = "placed in Base"
    NO_POSE = "without pose"
    LASER_OFF = "laser off"
    UNREADABLE = "image cannot be read"
    NO_PARTNER = PARTNER_MISSING
    EQUAL_POSE = "left out: the pose of another exposure, but another stripe"


@dataclass(frozen=True, slots=True)
class ScanExposure:
    """One exposure of a scan.

    Parameters
    ----------
    row
        What the recording says of it.
    status
        What became of it.
    reason
        Why it was not placed; empty if it was.
    n_stripe_points
        Points that looked like a stripe.
    n_measured
        Of these, measured.
    n_outside_volume
        Of the measured, outside the working volume in Base; the rest is in the cloud.
    """

    row: ExposureRow
    status: ExposureStatus
    reason: str = ""
    n_stripe_points: int = 0
    n_measured: int = 0
    n_outside_volume: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class ScanReconstruction:
    """Measured points in Base and the evidence of each exposure.

    Parameters
    ----------
    cloud
        Points in Base. ``normals`` are (0, 0, 0) where there is no tangent plane, None if not
        asked for.
    images
        Stripe points of the exposures that were placed, in order of time; ``cloud.exposure``
        points into it.
    image_rows
        Row of the recording that each of ``images`` is.
    exposures
        One entry a row of the recording.
    poses
        Of every row; how poses were found.
    warnings
        What is weak, in words.
    doubt
        How far the passes of the scan agree.
    """

    cloud: PointCloud
    images: tuple[LabelledProfile, ...]
    image_rows: tuple[int, ...]
    exposures: tuple[ScanExposure, ...]
    poses: ExposurePoses
    warnings: tuple[str, ...] = ()
    doubt: ScanDoubt = field(default_factory=lambda: ScanDoubt(None))

    @property
    def contradictions(self) -> tuple[str, ...]:
        """What shows that arm, clock, images and calibration do not belong together, in words."""
        hung = self.count(ExposureStatus.EQUAL_POSE)
        found = [fault.words for fault in self.poses.track_faults]
        if hung:
            found.append(f"{hung} exposures bear the pose of another one but show another stripe")
        return (*found, *self.doubt.warnings)

    @property
    def without_pose(self) -> tuple[tuple[str, str], ...]:
        """(source, reason) of the exposures with the laser on that have no pose."""
        found = self.of(ExposureStatus.NO_POSE, ExposureStatus.EQUAL_POSE)
        return tuple((exposure.row.source, exposure.reason) for exposure in found)

    @property
    def unreadable(self) -> tuple[tuple[str, str], ...]:
        """(source, reason) of the exposures whose image could not be read."""
        found = self.of(ExposureStatus.UNREADABLE)
        return tuple((exposure.row.source, exposure.reason) for exposure in found)

    def count(self, status: ExposureStatus) -> int:
        """Count of exposures of this status."""
        return len(self.of(status))

    def of(self, *states: ExposureStatus) -> tuple[ScanExposure, ...]:
        """The exposures of these states."""
        return tuple(one for one in self.exposures if one.status in states)


@dataclass(frozen=True, slots=True)
class ScanOptions:
    """How a scan becomes a cloud in Base.

    Parameters
    ----------
    measure
        Stripe extraction, the depths accepted in Sensor, the sheet.
    volume
        Part of Base that is measured; None for all of it.
    has_normals
        Estimate the surface's normals.
    """

    measure: MeasureOptions = field(default_factory=MeasureOptions)
    volume: Box | None = None
    has_normals: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """What one exposure gave: its stripe, its points in Base, their depths, those cut away."""

    labelled: LabelledProfile
    cloud: PointCloud
    depths_mm: tuple[FloatArray, ...]
    n_outside_volume: int


def measure_scan(
    source: ScanSource,
    scanner: ScannerCalibration,
    options: ScanOptions | None = None,
    *,
    progress: Progress = silent,
    cache: DetectionCache | None = None,
) -> ScanReconstruction:
    """Measure the stripes of every exposure that has a pose and place them in Base.

    Instants are read one after another and dropped once measured; an image that cannot be read
    is counted and named, and so is its partner of the same instant, or an image of one camera of
    which the other has none. Where rows name lasers, rows without any serve as background of the
    exposures of their view.

    Parameters
    ----------
    source
        The scan.
    scanner
        Sensor, hand-eye and latency.
    options
        Defaults if None.
    progress
        Told of every exposure.
    cache
        Keeps the stripes of every exposure for another run; None to keep none.

    Raises
    ------
    InputError
        If the scanner has no camera, the scan no arm or not as many cameras as the scanner, or an
        image is not of the scanner's sensor.
    EstimationError
        If no exposure has a pose, the sheet of a stripe is ambiguous, or nothing was measured.
    """
    options = options or ScanOptions()
    sensor = scanner.sensor
    if sensor is None:
        raise InputError(
            "the scanner's document has no camera and light sheet", remedy="give one with a sensor"
        )
    poses = exposure_poses(source.rows, source.arm, source.session.clock, scanner.latency_ns)
    scan = ScanInstants(source, len(cameras_of(sensor)))
    wanted = [one for one in scan.lit if poses.has_pose[list(one.rows)].all()]
    transform = BaseTransform.of(scanner)
    labeller = labeller_for(sensor, options.measure, is_scan=True)
    placed: dict[int, _Placed] = {}
    weak: list[str] = []
    instants = scan.read(wanted, STAGE, progress, sensor_poses(poses, scanner))
    for one in measure_instants(
        instants, labeller, sensor, options.measure, is_pass=True, cache=cache
    ):
        rows = one.images.instant.rows
        for row, measured in zip(rows, one.profiles, strict=True):
            placed[row] = _place(measured, poses.pose(rows[0]), transform, options.volume)
            weak += measured.warnings
    hung = _hung(placed, wanted, poses)
    kept = {row: one for row, one in placed.items() if row not in hung}
    exposures = _exposures(source, scan, poses, kept, hung)
    cloud, extra = _joined(kept, exposures, poses, transform, options, progress=progress)
    images = tuple(one.labelled for one in kept.values())
    first_row = {row: instant.rows[0] for instant in wanted for row in instant.rows}
    doubt = doubt_scan(
        source,
        scanner,
        poses,
        cloud=cloud,
        images=images,
        pose_rows=tuple(first_row[row] for row in kept),
    )
    depths = [
        np.concatenate([one.depths_mm[k] for one in kept.values()])
        for k in range(len(sensor.sheets))
    ]
    return ScanReconstruction(
        cloud=replace(cloud, is_simulated=source.is_simulated, forced=scanner.provenance.forced),
        images=images,
        image_rows=tuple(kept),
        exposures=exposures,
        poses=poses,
        warnings=(
            *_scan_warnings(exposures, poses),
            *measurement_warnings(images, depths, sensor),
            *extra,
            *doubt.warnings,
            *_unknown_lasers(source, sensor, options.measure),
            *summarised(weak),
        ),
        doubt=doubt,
    )


def sensor_poses(
    poses: ExposurePoses, scanner: ScannerCalibration
) -> Callable[[Instant], Pose[Base, Sensor] | None]:
    """Where the sensor was at each instant of a scan; None where the arm's pose is not known."""

    def pose(instant: Instant) -> Pose[Base, Sensor] | None:
        row = instant.rows[0]
        if not poses.has_pose[row]:
            return None
        return poses.pose(row) @ scanner.hand_eye.tool_from_sensor

    return pose


def _place(
    measured: MeasuredProfile,
    base_from_tool: Pose[Base, Tool],
    transform: BaseTransform,
    volume: Box | None,
) -> _Placed:
    """Place the measured points of one exposure in Base and cut those outside a volume."""
    points, labelled = measured.points, measured.labelled
    cloud = propagate_to_base(points, labelled.profile, base_from_tool, transform)
    n_sheets = len(transform.factors)
    depths = tuple(points.points_mm[points.sheet == k, 2] for k in range(n_sheets))
    inside = cloud if volume is None else cut_cloud(cloud, volume)
    return _Placed(labelled, inside, depths, len(cloud) - len(inside))


def _hung(
    placed: dict[int, _Placed], instants: Sequence[Instant], poses: ExposurePoses
) -> dict[int, float]:
    """Rows whose pose stood still, and how far in mm their stripes lie from an earlier one's.

    The cameras of one instant share its pose and see parts of one stripe: they count as one.
    """
    measured = {one.rows[0]: one.rows for one in instants if one.rows[0] in placed}
    clouds = {
        first: merge_clouds([placed[row].cloud for row in rows]) for first, rows in measured.items()
    }
    apart = stripes_at_equal_poses(clouds, poses)
    return {row: apart[first] for first in apart for row in measured[first]}


def _unknown_lasers(
    source: ScanSource, sensor: SensorCalibration, options: MeasureOptions
) -> tuple[str, ...]:
    """Lasers that exposures name but the calibration has no sheet of."""
    sheets = [sheet.name for sheet in sensor.sheets]
    known = {*sheets, *(name.partition(".")[0] for name in sheets)}
    named = {laser for row in source.rows for laser in row.lasers}
    if options.sheet or not named - known:
        return ()
    lasers, names = ", ".join(sorted(named - known)), ", ".join(sheets)
    return (
        f"exposures name the laser {lasers}, of which the calibration has no sheet: their stripes "
        f"were measured as if they were of {names}; name the sheet with --sheet if that is so",
    )


def _exposures(
    source: ScanSource,
    scan: ScanInstants,
    poses: ExposurePoses,
    placed: dict[int, _Placed],
    hung: dict[int, float],
) -> tuple[ScanExposure, ...]:
    """What became of every row."""
    records = []
    for k, row in enumerate(source.rows):
        if k in placed:
            one = placed[k]
            records.append(
                ScanExposure(
                    row,
                    ExposureStatus.PLACED,
                    n_stripe_points=len(one.labelled.profile),
                    n_measured=one.labelled.count(PointStatus.MEASURED),
                    n_outside_volume=one.n_outside_volume,
                )
            )
            continue
        status, reason = ExposureStatus.NO_POSE, PoseStatus(int(poses.status[k])).label
        if k in scan.unreadable:
            status, reason = ExposureStatus.UNREADABLE, scan.unreadable[k]
        elif k in hung:
            status = ExposureStatus.EQUAL_POSE
            reason = f"the pose of an earlier one, but its stripe lies {hung[k]:.2g} mm away"
        elif not scan.is_lit[k]:
            status, reason = ExposureStatus.LASER_OFF, "no laser was on"
        elif k in scan.without_partner:
            status, reason = ExposureStatus.NO_PARTNER, PARTNER_MISSING
        elif poses.has_pose[k]:
            reason = "the other camera's image has none"
        records.append(ScanExposure(row, status, reason))
    return tuple(records)


def _joined(
    placed: dict[int, _Placed],
    exposures: Sequence[ScanExposure],
    poses: ExposurePoses,
    transform: BaseTransform,
    options: ScanOptions,
    *,
    progress: Progress,
) -> tuple[PointCloud, tuple[str, ...]]:
    """All points in one cloud with normals towards the sensor, and what is weak about these."""
    if not placed:
        unreadable = [e.reason for e in exposures if e.status is ExposureStatus.UNREADABLE]
        why = "; ".join(unreadable) or "no laser"
        raise EstimationError(f"no exposure with a pose could be measured: {why}")
    cloud = merge_clouds([one.cloud for one in placed.values()])
    if len(cloud) == 0:
        n_outside = sum(one.n_outside_volume for one in placed.values())
        if n_outside:
            raise EstimationError(
                f"all {n_outside} measured points lie outside the volume {options.volume}",
                remedy="give limits in mm in the arm's base frame, or none",
            )
        images = [one.labelled for one in placed.values()]
        raise nothing_measured(images, is_by_thesis=options.measure.is_by_thesis)
    if not options.has_normals:
        return cloud, ()
    return _with_normals(cloud, list(placed), poses, transform, progress)


def _with_normals(
    cloud: PointCloud,
    rows: list[int],
    poses: ExposurePoses,
    transform: BaseTransform,
    progress: Progress,
) -> tuple[PointCloud, tuple[str, ...]]:
    """The cloud with normals towards the sensor of each exposure, and what is weak about these."""
    eye = transform.scanner.hand_eye.tool_from_sensor.translation_mm
    cameras = poses.rotations[rows] @ eye + poses.translations_mm[rows]
    radius_mm = choose_radius_mm(cloud.points_mm, cloud.exposure)
    normals = estimate_normals(
        cloud.points_mm,
        cameras[cloud.exposure],
        radius_mm,
        told=lambda n_done: progress(ProgressEvent("normals", n_done, len(cloud))),
    )
    share = float((~normals.any(axis=1)).mean())
    warnings: tuple[str, ...] = ()
    if share > MANY_WITHOUT_NORMAL:
        warnings = (
            f"{100.0 * share:.0f} % of the points have no normal: within {radius_mm:.1f} mm "
            "they lie on single lines, or on no plane",
        )
    return replace(cloud, normals=normals, seen_from_mm=cameras), warnings


def check_poses(profiles: Sequence[PointProfile], poses: Sequence[Pose[Base, Tool]]) -> None:
    """Raise `InputError` unless there is one pose for each profile."""
    if len(profiles) != len(poses):
        raise InputError(
            f"{len(profiles)} profiles but {len(poses)} poses",
            remedy="give one pose for each profile, in the same order",
        )


def place_profiles(
    profiles: Sequence[PointProfile],
    poses: Sequence[Pose[Base, Tool]],
    scanner: ScannerCalibration,
    volume: Box | None = None,
) -> ScanReconstruction:
    """Place what a sensor that delivers profiles saw in Base, with covariance and normals.

    Parameters
    ----------
    profiles
        In the Sensor frame, one for each pose.
    poses
        ``base_from_tool`` of each.
    scanner
        Its hand-eye; without a camera.
    volume
        Part of Base that is kept; None for all of it.

    Raises
    ------
    InputError
        If the counts differ, or the scanner has a camera.
    EstimationError
        If no point lies in the volume.
    """
    check_poses(profiles, poses)
    transform = BaseTransform.of(scanner)
    found = ExposurePoses(
        rotations=np.array([pose.rotation for pose in poses]),
        translations_mm=np.array([pose.translation_mm for pose in poses]),
        status=np.zeros(len(poses), dtype=np.int64),
        sample=np.arange(len(poses)),
        source="given",
    )
    clouds = [
        propagate_to_base(delivered_points(profile), profile, pose, transform)
        for profile, pose in zip(profiles, poses, strict=True)
    ]
    hung = stripes_at_equal_poses(dict(enumerate(clouds)), found)
    exposures = []
    for k, (profile, cloud) in enumerate(zip(profiles, clouds, strict=True)):
        row = ExposureRow(index=k, t_ns=k, camera=0, source=profile.source, lasers=(DELIVERED,))
        clouds[k] = inside = cloud if volume is None else cut_cloud(cloud, volume)
        record = ScanExposure(
            row,
            ExposureStatus.PLACED,
            n_stripe_points=len(profile),
            n_measured=len(profile),
            n_outside_volume=len(cloud) - len(inside),
        )
        if k in hung:
            reason = f"the pose of an earlier one, but its stripe lies {hung[k]:.2g} mm away"
            record = ScanExposure(row, ExposureStatus.EQUAL_POSE, reason)
        exposures.append(record)
    kept = [k for k in range(len(clouds)) if k not in hung]
    merged = merge_clouds([clouds[k] for k in kept])
    if len(merged) == 0:
        raise EstimationError(
            f"no point lies in the volume {volume}",
            remedy="give limits in mm in the arm's base frame, or none",
        )
    merged, extra = _with_normals(merged, kept, found, transform, silent)
    return ScanReconstruction(
        cloud=replace(merged, forced=scanner.provenance.forced),
        images=(),
        image_rows=tuple(kept),
        exposures=tuple(exposures),
        poses=found,
        warnings=(*_scan_warnings(exposures, found), *extra),
    )


def _scan_warnings(exposures: Sequence[ScanExposure], poses: ExposurePoses) -> tuple[str, ...]:
    """What a person should know of the exposures that are not in the cloud."""
    n = len(exposures)
    of = {status: [e for e in exposures if e.status is status] for status in ExposureStatus}
    warnings = list(poses.warnings)
    if without := of[ExposureStatus.NO_POSE]:
        counts = Counter(exposure.reason for exposure in without)
        reasons = ", ".join(f"{count} {reason}" for reason, count in counts.items())
        warnings.append(f"{len(without)} of {n} exposures have no pose: {reasons}")
    if broken := of[ExposureStatus.UNREADABLE]:
        named = "; ".join(exposure.reason.rstrip(".") for exposure in broken[:LISTED])
        warnings.append(f"{len(broken)} of {n} images cannot be read: {named}")
    if alone := of[ExposureStatus.NO_PARTNER]:
        named = ", ".join(exposure.row.source for exposure in alone[:LISTED])
        warnings.append(f"{len(alone)} of {n} images were not used, {PARTNER_MISSING}: {named}")
    if hung := of[ExposureStatus.EQUAL_POSE]:
        warnings.append(
            f"{len(hung)} of {n} exposures were left out: {hung[0].reason}: the arm's pose hung or "
            "was repeated, or the object moved"
        )
    n_outside = sum(exposure.n_outside_volume for exposure in exposures)
    if n_outside:
        warnings.append(f"{n_outside} measured points lie outside the volume asked for")
    if not any(exposure.row.lasers for exposure in exposures):
        warnings.append("no exposure names its lasers: the laser was taken to be on in all")
    return tuple(warnings)
