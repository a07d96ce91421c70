# SPDX-License-Identifier: Apache-2.0
"""A scan measured: every exposure placed in Base or counted with its reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Protocol

import numpy as np

from armscan.devices.sources import ScanSource
from armscan.errors import EstimationError, InputError, begun
from armscan.fusion.point_spool import PointSpool
from armscan.fusion.scan_normals import ScanNormals, choose_scan_radius_mm
from armscan.geometry.arrays import Box, FloatArray
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.instants import (
    PARTNER_MISSING,
    Instant,
    InstantImages,
    ScanInstants,
    check_poses,
)
from armscan.pipeline.measure import (
    PLACING,
    MeasureOptions,
    SheetDepths,
    cameras_of,
    labeller_for,
    laser_warnings,
    measure_instants,
    measurement_warnings,
    nothing_measured,
    scan_as_seen,
    summarised,
)
from armscan.pipeline.progress import (
    Progress,
    ProgressEvent,
    StageClock,
    count_cores,
    silent,
)
from armscan.pipeline.scan_doubts import ScanDoubt, doubt_scan, doubt_times
from armscan.reconstruction.labels import LabelledProfile, PointStatus, StripeCounts
from armscan.reconstruction.place import (
    BaseTransform,
    cut_cloud,
    delivered_points,
    errors_of_calibration,
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
from armscan.records.cloud import DELIVERED, PointCloud
from armscan.records.profile import PointProfile
from armscan.records.recording import ExposureRow
from armscan.storage.detection_cache import DetectionCache

STAGE = "scan"
MANY_WITHOUT_NORMAL = 0.1
"""A larger share of points without normal is warned of."""
LISTED = 4
SHOWN_IMAGES = 12
"""Stripes that a page shows on their photographs."""


class ExposureStatus(Enum):
    """What became of one exposure of a scan; the value is what a report shows."""

    PLACED = "placed in Base"
    NO_POSE = "without pose"
    LASER_OFF = "laser off"
    LASER_UNKNOWN = "what laser was on is not known"
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
        Stripe points of the exposures that were placed, in order of time, or of some of them; if
        of all, ``cloud.exposure`` points into it.
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
    counts
        How many stripe points of each exposure that was placed became what.
    """

    cloud: PointCloud
    images: tuple[LabelledProfile, ...]
    image_rows: tuple[int, ...]
    exposures: tuple[ScanExposure, ...]
    poses: ExposurePoses
    warnings: tuple[str, ...] = ()
    doubt: ScanDoubt = field(default_factory=lambda: ScanDoubt(None))
    counts: tuple[StripeCounts, ...] = ()

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


class InstantReader(Protocol):
    """Gives the instants of a scan in order, with profiles that were extracted elsewhere."""

    def read(
        self,
        scan: ScanInstants,
        instants: Sequence[Instant],
        stage: str,
        progress: Progress,
        base_from_sensor: Callable[[Instant], Pose[Base, Sensor] | None],
    ) -> Iterator[InstantImages]:
        """Parameters as of `ScanInstants.read`; what cannot be read goes to its `unreadable`."""


@dataclass(slots=True, eq=False)
class _Measured:
    """What the exposures of a scan gave besides points, which are in a spool.

    ``rows`` are those of the recording, as they were measured; ``images`` the stripes of some of
    them, by row. ``depths`` count also what is left out afterwards for its pose.
    """

    depths: tuple[SheetDepths, ...]
    rows: list[int] = field(default_factory=list)
    counts: list[StripeCounts] = field(default_factory=list)
    n_outside_volume: list[int] = field(default_factory=list)
    images: dict[int, LabelledProfile] = field(default_factory=dict)
    weak: list[str] = field(default_factory=list)


def measure_scan(
    source: ScanSource,
    scanner: ScannerCalibration,
    options: ScanOptions | None = None,
    *,
    progress: Progress = silent,
    cache: DetectionCache | None = None,
) -> ScanReconstruction:
    """Measure the stripes of every exposure that has a pose and place them in Base.

    All points and the stripes of all exposures are in memory at the end; `measure_long_scan`
    leaves them on disk.

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
    options, about = options or ScanOptions(), ""
    if scanner.sensor is not None:
        seen = ScanInstants(source, len(cameras_of(scanner.sensor)))
        measure, about = scan_as_seen(seen, scanner.sensor, options.measure, cache)
        options = replace(options, measure=measure)
    with scan_spool(scanner) as points:
        scan = measure_long_scan(
            source, scanner, points, options, progress=progress, cache=cache, most_images=None
        )
        cloud = points.cloud()
    scan = replace(scan, warnings=(*filter(None, [about]), *scan.warnings))
    marks = scan.cloud
    cloud = replace(
        cloud,
        is_simulated=marks.is_simulated,
        forced=marks.forced,
        calibrations=marks.calibrations,
    )
    return replace(scan, cloud=cloud)


def scan_spool(scanner: ScannerCalibration, folder: Path | None = None) -> PointSpool:
    """An empty place for the points of a scan in Base; None for the folder keeps it in memory."""
    sensor = scanner.sensor
    names = (DELIVERED,) if sensor is None else tuple(one.name for one in sensor.sheets)
    return PointSpool("Base", names, folder)


def measure_long_scan(
    source: ScanSource,
    scanner: ScannerCalibration,
    points: PointSpool,
    options: ScanOptions | None = None,
    *,
    progress: Progress = silent,
    cache: DetectionCache | None = None,
    most_images: int | None = SHOWN_IMAGES,
    clock: StageClock | None = None,
    reader: InstantReader | None = None,
) -> ScanReconstruction:
    """As `measure_scan`, with memory that does not grow with the scan's length.

    Parameters
    ----------
    source, scanner, options, progress, cache
        As for `measure_scan`.
    points
        From `scan_spool`; holds the points with their normals afterwards.
    most_images
        Exposures whose stripes are kept, evenly chosen; None for all.
    clock
        Counts what the stages take.
    reader
        Reads and extracts elsewhere; None to do so here.

    Returns
    -------
    ScanReconstruction
        Its ``cloud`` has names and marks but no points.

    Raises
    ------
    ArmscanError
        As `measure_scan`.
    OutputError
        If the disk is full.
    """
    options, clock = options or ScanOptions(), clock or StageClock()
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
    of_lasers = laser_warnings([one.lasers for one in wanted], labeller, sensor, options.measure)
    found = _Measured(SheetDepths.of(sensor))
    shown = _shown_rows(wanted, most_images)
    at = sensor_poses(poses, scanner)
    if reader is None:
        instants = scan.read(wanted, STAGE, progress, at, clock=clock)
    else:
        instants = reader.read(scan, wanted, STAGE, progress, at)
    for one in measure_instants(
        instants, labeller, sensor, options.measure, is_pass=True, cache=cache, clock=clock
    ):
        rows = one.images.instant.rows
        for row, measured in zip(rows, one.profiles, strict=True):
            found.rows.append(row)
            with clock.stage(PLACING):
                placed = _place(measured, poses.pose(rows[0]), transform, options.volume, found)
                points.add(*placed, instant=rows[0])
            if row in shown:
                found.images[row] = measured.labelled
    hung = _hung(found.rows, wanted, poses, points)
    kept = [k for k, row in enumerate(found.rows) if row not in hung]
    points.keep(kept)
    exposures = _exposures(source, scan, poses, found, hung)
    first_row = {row: instant.rows[0] for instant in wanted for row in instant.rows}
    pose_rows = [first_row[found.rows[k]] for k in kept]
    if not len(points):
        raise _nothing_placed(found, exposures, options)
    cameras, extra = _looking(points, pose_rows, poses, transform), doubt_times(source, scanner)
    if options.has_normals:
        with clock.stage("normals", is_alone=True):
            extra += _add_normals(points, cameras, progress)
    with clock.stage("passes", is_alone=True):
        doubt = doubt_scan(source, scanner, poses, points=points, pose_rows=pose_rows)
    counts = tuple(found.counts[k] for k in kept)
    image_rows = tuple(row for row in found.images if row not in hung)
    return ScanReconstruction(
        cloud=replace(
            points.without_points(),
            is_simulated=source.is_simulated,
            forced=scanner.provenance.forced,
            calibrations=(scanner.provenance.mark,),
        ),
        images=tuple(found.images[row] for row in image_rows),
        image_rows=image_rows,
        exposures=exposures,
        poses=poses,
        warnings=(
            *_scan_warnings(exposures, poses),
            *measurement_warnings(counts, found.depths, sensor),
            *extra,
            *doubt.warnings,
            *of_lasers,
            *summarised(found.weak),
        ),
        doubt=doubt,
        counts=counts,
    )


def _shown_rows(instants: Sequence[Instant], most: int | None) -> set[int]:
    """Rows whose stripes are kept."""
    rows = [row for one in instants for row in one.rows]
    if most is None or len(rows) <= most:
        return set(rows)
    return {rows[k] for k in np.linspace(0, len(rows) - 1, most).astype(int)}


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
    found: _Measured,
) -> tuple[PointCloud, FloatArray]:
    """Points of one exposure in Base, without those outside a volume, and their pixels (N, 2)."""
    stripe, labelled = measured.points, measured.labelled
    cloud = propagate_to_base(stripe, labelled.profile, base_from_tool, transform)
    pixel_px = labelled.profile.points_px[stripe.row]
    SheetDepths.add(found.depths, stripe.sheet, stripe.points_mm[:, 2])
    n_all = len(cloud)
    if volume is not None:
        inside = volume.holds(cloud.points_mm)
        cloud, pixel_px = cut_cloud(cloud, volume), pixel_px[inside]
    found.counts.append(labelled.counts)
    found.n_outside_volume.append(n_all - len(cloud))
    found.weak += measured.warnings
    return cloud, pixel_px


class _InstantClouds(Mapping[int, PointCloud]):
    """Points of all cameras of an instant by the row of its pose, read when they are asked for."""

    def __init__(self, points: PointSpool, members: Mapping[int, list[int]]) -> None:
        self._points, self._members = points, members

    def __getitem__(self, row: int) -> PointCloud:
        return merge_clouds([self._points.of_exposure(k) for k in self._members[row]])

    def __iter__(self) -> Iterator[int]:
        return iter(self._members)

    def __len__(self) -> int:
        return len(self._members)


def _hung(
    rows: Sequence[int], instants: Sequence[Instant], poses: ExposurePoses, points: PointSpool
) -> dict[int, float]:
    """Rows whose pose stood still, and how far in mm their stripes lie from an earlier one's.

    The cameras of one instant share its pose and see parts of one stripe: they count as one.
    """
    number = {row: k for k, row in enumerate(rows)}
    measured = {one.rows[0]: one.rows for one in instants if one.rows[0] in number}
    members = {first: [number[row] for row in group] for first, group in measured.items()}
    apart = stripes_at_equal_poses(_InstantClouds(points, members), poses)
    return {row: apart[first] for first in apart for row in measured[first]}


def _exposures(
    source: ScanSource,
    scan: ScanInstants,
    poses: ExposurePoses,
    found: _Measured,
    hung: dict[int, float],
) -> tuple[ScanExposure, ...]:
    """What became of every row."""
    records = []
    placed = {row: k for k, row in enumerate(found.rows) if row not in hung}
    for k, row in enumerate(source.rows):
        if k in placed:
            counts = found.counts[placed[k]]
            records.append(
                ScanExposure(
                    row,
                    ExposureStatus.PLACED,
                    n_stripe_points=len(counts),
                    n_measured=counts.count(PointStatus.MEASURED),
                    n_outside_volume=found.n_outside_volume[placed[k]],
                )
            )
            continue
        status, reason = ExposureStatus.NO_POSE, PoseStatus(int(poses.status[k])).label
        if k in scan.unreadable:
            status, reason = ExposureStatus.UNREADABLE, scan.unreadable[k]
        elif k in hung:
            status = ExposureStatus.EQUAL_POSE
            reason = f"the pose of an earlier one, but its stripe lies {hung[k]:.2g} mm away"
        elif scan.is_unknown[k]:
            status, reason = ExposureStatus.LASER_UNKNOWN, ExposureStatus.LASER_UNKNOWN.value
        elif not scan.is_lit[k]:
            status, reason = ExposureStatus.LASER_OFF, "no laser was on"
        elif k in scan.without_partner:
            status, reason = ExposureStatus.NO_PARTNER, PARTNER_MISSING
        elif poses.has_pose[k]:
            reason = "the other camera's image has none"
        records.append(ScanExposure(row, status, reason))
    return tuple(records)


def _nothing_placed(
    found: _Measured, exposures: Sequence[ScanExposure], options: ScanOptions
) -> EstimationError:
    """Why a scan has no point in Base, to be raised."""
    placed = [one for one in exposures if one.status is ExposureStatus.PLACED]
    if not placed:
        why = []
        for status, n in Counter(one.status for one in exposures).items():
            of_status = dict.fromkeys(e.reason for e in exposures if e.status is status)
            reasons = [reason for reason in of_status if reason != status.value]
            why.append(f"{status.value}: {n}{f' ({begun(reasons, LISTED)})' if reasons else ''}")
        return EstimationError(f"no exposure with a pose could be measured; {'; '.join(why)}")
    n_outside = sum(one.n_outside_volume for one in placed)
    if n_outside:
        return EstimationError(
            f"all {n_outside} measured points lie outside the volume {options.volume}",
            remedy="give limits in mm in the arm's base frame, or none",
        )
    return nothing_measured(found.counts, is_by_thesis=options.measure.is_by_thesis)


def _looking(
    points: PointSpool, pose_rows: list[int], poses: ExposurePoses, transform: BaseTransform
) -> FloatArray:
    """(E, 3) where the sensor stood, told to the points with what its calibration may err by."""
    hand_eye = transform.scanner.hand_eye.tool_from_sensor
    turns = poses.rotations[pose_rows]
    cameras = turns @ hand_eye.translation_mm + poses.translations_mm[pose_rows]
    points.look_from(cameras, errors_of_calibration(transform.scanner, turns @ hand_eye.rotation))
    return cameras


def _add_normals(points: PointSpool, cameras: FloatArray, progress: Progress) -> tuple[str, ...]:
    """Give the points normals towards the sensor of each exposure; what is weak about these."""
    radius_mm = choose_scan_radius_mm(points)
    n_done = n_without = 0
    n_threads = count_cores()
    with ScanNormals(points, radius_mm) as surface, ThreadPoolExecutor(n_threads) as pool:
        for places, exposure in points.places():
            near = surface.near(places)
            parts = [np.array_split(v, n_threads) for v in (places, cameras[exposure])]
            normals = np.concatenate(list(pool.map(near.normals, *parts)))
            points.add_normals(normals)
            n_done += len(places)
            n_without += int((np.einsum("ni,ni->n", normals, normals) == 0.0).sum())
            progress(ProgressEvent("normals", n_done, len(points)))
    return _normals_warning(n_without / n_done, radius_mm)


def _normals_warning(share: float, radius_mm: float) -> tuple[str, ...]:
    if share <= MANY_WITHOUT_NORMAL:
        return ()
    return (
        f"{100.0 * share:.0f} % of the points have no normal: within {radius_mm:.1f} mm "
        "they lie on single lines, or on no plane",
    )


def place_profiles(
    profiles: Sequence[PointProfile],
    poses: Sequence[Pose[Base, Tool]],
    scanner: ScannerCalibration,
    volume: Box | None = None,
    *,
    points: PointSpool | None = None,
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
    points
        From `scan_spool`, to hold the points as well; None for one that is dropped.

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
    points = scan_spool(scanner) if points is None else points
    exposures = []
    for k, (profile, cloud) in enumerate(zip(profiles, clouds, strict=True)):
        row = ExposureRow(index=k, t_ns=k, camera=0, source=profile.source, lasers=(DELIVERED,))
        inside = cloud if volume is None else cut_cloud(cloud, volume)
        points.add(inside)
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
    points.keep(kept)
    if len(points) == 0:
        raise EstimationError(
            f"no point lies in the volume {volume}",
            remedy="give limits in mm in the arm's base frame, or none",
        )
    extra = _add_normals(points, _looking(points, kept, found, transform), silent)
    return ScanReconstruction(
        cloud=replace(
            points.cloud(),
            forced=scanner.provenance.forced,
            calibrations=(scanner.provenance.mark,),
        ),
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
    if unknown := of[ExposureStatus.LASER_UNKNOWN]:
        warnings.append(f"{len(unknown)} of {n} images were not measured: {unknown[0].reason}")
    elif not any(exposure.row.lasers for exposure in exposures):
        warnings.append("no exposure names its lasers: the laser was taken to be on in all")
    return tuple(warnings)
