# SPDX-License-Identifier: Apache-2.0
"""A scan measured: every exposure placed in Base or counted with its reason."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from armscan.devices.sources import ScanSource
from armscan.errors import ArmscanError, EstimationError, InputError, OptionError
from armscan.geometry.arrays import Box, FloatArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.models.calibration import ScannerCalibration, SensorCalibration
from armscan.pipeline.instants import PARTNER_MISSING, ExposurePair, Instant, ScanInstants
from armscan.pipeline.measure import (
    LitProfile,
    MeasuredImage,
    MeasureOptions,
    cameras_of,
    collected,
    see,
    stripes_for,
)
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.reconstruct import (
    NOTHING_MEASURED_REMEDY,
    measurement_warnings,
    measurer_for,
    nothing_measured,
)
from armscan.pipeline.scan_doubts import ScanDoubt, doubt_scan
from armscan.reconstruction.labels import MeasuredProfile, PointStatus
from armscan.reconstruction.place import (
    BaseTransform,
    NormalOptions,
    choose_radius_mm,
    cut_cloud,
    estimate_normals,
    merge_clouds,
    prepare_placing,
    propagate_to_base,
)
from armscan.reconstruction.sync import (
    ExposurePoses,
    PoseStatus,
    SyncOptions,
    exposure_poses,
    stripes_at_equal_poses,
)
from armscan.records.cloud import PointCloud
from armscan.records.recording import ExposureRow

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
    fate
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
    fate: ExposureStatus
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
    images: tuple[MeasuredProfile, ...]
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
        return tuple(
            (exposure.row.source, exposure.reason)
            for exposure in self.exposures
            if exposure.fate in (ExposureStatus.NO_POSE, ExposureStatus.EQUAL_POSE)
        )

    @property
    def unreadable(self) -> tuple[tuple[str, str], ...]:
        """(source, reason) of the exposures whose image could not be read."""
        return tuple(
            (exposure.row.source, exposure.reason)
            for exposure in self.exposures
            if exposure.fate is ExposureStatus.UNREADABLE
        )

    def count(self, fate: ExposureStatus) -> int:
        """Count of exposures of this fate."""
        return sum(exposure.fate is fate for exposure in self.exposures)


def scan_warnings(exposures: Sequence[ScanExposure], poses: ExposurePoses) -> tuple[str, ...]:
    """What a person should know of the exposures that are not in the cloud."""
    warnings = list(poses.warnings)
    without = [e for e in exposures if e.fate is ExposureStatus.NO_POSE]
    if without:
        counts: dict[str, int] = {}
        for exposure in without:
            counts[exposure.reason] = counts.get(exposure.reason, 0) + 1
        reasons = ", ".join(f"{n} {reason}" for reason, n in counts.items())
        warnings.append(f"{len(without)} of {len(exposures)} exposures have no pose: {reasons}")
    broken = [e for e in exposures if e.fate is ExposureStatus.UNREADABLE]
    if broken:
        named = "; ".join(exposure.reason.rstrip(".") for exposure in broken[:LISTED])
        warnings.append(f"{len(broken)} of {len(exposures)} images cannot be read: {named}")
    alone = [e.row.source for e in exposures if e.fate is ExposureStatus.NO_PARTNER]
    if alone:
        warnings.append(
            f"{len(alone)} of {len(exposures)} images were not used, {PARTNER_MISSING}: "
            f"{', '.join(alone[:LISTED])}"
        )
    hung = [e for e in exposures if e.fate is ExposureStatus.EQUAL_POSE]
    if hung:
        warnings.append(
            f"{len(hung)} of {len(exposures)} exposures were left out: {hung[0].reason}: the arm's "
            "pose hung or was repeated, or the object moved"
        )
    n_outside = sum(exposure.n_outside_volume for exposure in exposures)
    if n_outside:
        warnings.append(f"{n_outside} measured points lie outside the volume asked for")
    if not any(exposure.row.lasers for exposure in exposures):
        warnings.append("no exposure names its lasers: the laser was taken to be on in all")
    return tuple(warnings)


def scan_exposure(row: ExposureRow, image: MeasuredProfile, n_outside: int) -> ScanExposure:
    """The record of an exposure that was placed."""
    n_measured = image.count(PointStatus.MEASURED)
    return ScanExposure(row, ExposureStatus.PLACED, "", len(image.profile), n_measured, n_outside)


__all__ = ["PlacedImage", "ScanOptions", "ScanReconstruction", "measure_scan", "place_image"]

STAGE = "scan"
MANY_WITHOUT_NORMAL = 0.1
"""A larger share of points without normal is warned of."""


@dataclass(frozen=True, slots=True)
class ScanOptions:
    """How a scan becomes a cloud in Base.

    Parameters
    ----------
    measure
        Stripe extraction, the depths accepted in Sensor, the sheet.
    sync
        How exposures find their pose.
    volume
        Part of Base that is measured; None for all of it.
    normals
        Neighbourhood of the normals; None to leave them out.
    threads
        Exposures measured at a time, while the next one is read.
    """

    measure: MeasureOptions = field(default_factory=MeasureOptions)
    sync: SyncOptions = field(default_factory=SyncOptions)
    volume: Box | None = None
    normals: NormalOptions | None = field(default_factory=NormalOptions)
    threads: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.threads <= 64:
            raise OptionError(f"{self.threads} threads", remedy="give 1 to 64")


@dataclass(frozen=True, slots=True, eq=False)
class PlacedImage:
    """What one exposure gave: its stripe, its points in Base, their depths, those cut away."""

    image: MeasuredProfile
    cloud: PointCloud
    depths_mm: tuple[FloatArray, ...]
    n_outside_volume: int


def measure_scan(
    source: ScanSource,
    scanner: ScannerCalibration,
    options: ScanOptions | None = None,
    *,
    progress: Progress = silent,
) -> ScanReconstruction:
    """Measure the stripes of every exposure that has a pose and place them in Base.

    Instants are read one after another and dropped once measured; an image that cannot be read
    is counted and named, and so is its partner of the same instant, or an image of one camera of
    which the other has none. Where rows name lasers, rows
    without any serve as background of the exposures of their view.

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

    Raises
    ------
    InputError
        If the scanner has no camera, the scan no arm or not as many cameras as the scanner, or an
        image is not of the scanner's sensor.
    EstimationError
        If no exposure has a pose, the sheet of a stripe is ambiguous, or nothing was measured.
    """
    options = options or ScanOptions()
    if scanner.sensor is None:
        raise InputError(
            "the scanner's document has no camera and light sheet", remedy="give one with a sensor"
        )
    stripes = stripes_for(scanner.sensor, options.measure.stripes)
    poses = exposure_poses(
        source.rows, source.arm, source.session.clock, scanner.latency_ns, options.sync
    )
    cameras = cameras_of(scanner.sensor)
    images = ScanInstants(source, len(cameras))
    wanted = [one for one in images.lit if poses.has_pose[list(one.rows)].all()]
    placing = prepare_placing(scanner)
    placed: dict[int, PlacedImage] = {}
    reasons: dict[int, str] = {}

    def readings() -> Iterator[tuple[Instant, tuple[ExposurePair, ...]]]:
        for done, instant in enumerate(wanted):
            progress(ProgressEvent(STAGE, done, len(wanted), source.rows[instant.rows[0]].source))
            try:
                pairs = tuple(images.pair(row) for row in instant.rows)
            except ArmscanError as error:
                reasons.update(dict.fromkeys(instant.rows, str(error)))
                continue
            yield instant, pairs

    def extract(pairs: tuple[ExposurePair, ...]) -> list[LitProfile]:
        return [see(pair, camera, stripes) for pair, camera in zip(pairs, cameras, strict=True)]

    measurer = measurer_for(scanner.sensor, options.measure, is_scan=True)
    hand_eye = scanner.hand_eye.tool_from_sensor
    weak: list[str] = []
    for instant, seen in _in_threads(extract, readings(), options.threads):
        pose = poses.pose(instant.rows[0])
        measured = measurer.measure(seen, pose @ hand_eye, instant.t_ns)
        for row, one in zip(instant.rows, measured, strict=True):
            placed[row] = place_image(one, pose, placing, options.volume)
            weak += one.warnings
    progress(ProgressEvent(STAGE, len(wanted), len(wanted)))
    hung = _hung(placed, wanted, poses)
    kept = {row: one for row, one in placed.items() if row not in hung}
    exposures = _records(source, images, poses, kept, reasons=reasons, hung=hung)
    found = _joined(kept, exposures, poses, placing, options)
    first_row = {row: instant.rows[0] for instant in wanted for row in instant.rows}
    doubt = doubt_scan(
        source,
        scanner,
        poses,
        cloud=found.cloud,
        images=found.images,
        pose_rows=tuple(first_row[row] for row in found.image_rows),
    )
    return replace(
        found,
        cloud=replace(
            found.cloud,
            is_simulated=source.is_simulated,
            forced=scanner.provenance.forced,
        ),
        warnings=(
            *found.warnings,
            *doubt.warnings,
            *_unknown_lasers(source, scanner.sensor, options.measure),
            *collected(weak),
        ),
        doubt=doubt,
    )


def place_image(
    measured: MeasuredImage,
    base_from_tool: Pose[Base, Tool],
    placing: BaseTransform,
    volume: Box | None,
) -> PlacedImage:
    """Place the measured points of one exposure in Base and cut those outside a volume."""
    stripe, image = measured.points, measured.image
    cloud = propagate_to_base(stripe, image.profile, base_from_tool, placing)
    n_sheets = len(placing.factors)
    depths = tuple(stripe.points_mm[stripe.sheet == k, 2] for k in range(n_sheets))
    inside = cloud if volume is None else cut_cloud(cloud, volume)
    return PlacedImage(image, inside, depths, len(cloud) - len(inside))


def _hung(
    placed: dict[int, PlacedImage], instants: Sequence[Instant], poses: ExposurePoses
) -> dict[int, float]:
    """Rows whose pose stood still, and how far in mm their stripes lie from an earlier one's.

    The cameras of one instant share its pose and see parts of one stripe: they count as one.
    """
    seen = [instant for instant in instants if instant.rows[0] in placed]
    clouds = {
        instant.rows[0]: merge_clouds([placed[row].cloud for row in instant.rows])
        for instant in seen
    }
    apart = stripes_at_equal_poses(clouds, poses)
    return {
        row: apart[instant.rows[0]]
        for instant in seen
        if instant.rows[0] in apart
        for row in instant.rows
    }


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


def _in_threads(
    extract: Callable[[tuple[ExposurePair, ...]], list[LitProfile]],
    readings: Iterator[tuple[Instant, tuple[ExposurePair, ...]]],
    threads: int,
) -> Iterator[tuple[Instant, list[LitProfile]]]:
    """Extract in order with a bounded number of exposures in memory; stops at the first error."""
    pending: deque[tuple[Instant, Future[list[LitProfile]]]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for instant, pairs in readings:
                pending.append((instant, pool.submit(extract, pairs)))
                if len(pending) > threads:
                    first, result = pending.popleft()
                    yield first, result.result()
            while pending:
                first, result = pending.popleft()
                yield first, result.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _records(
    source: ScanSource,
    images: ScanInstants,
    poses: ExposurePoses,
    placed: dict[int, PlacedImage],
    *,
    reasons: dict[int, str],
    hung: dict[int, float],
) -> tuple[ScanExposure, ...]:
    records = []
    alone = set(images.without_partner)
    for k, row in enumerate(source.rows):
        if k in placed:
            records.append(scan_exposure(row, placed[k].image, placed[k].n_outside_volume))
        elif k in reasons:
            records.append(ScanExposure(row, ExposureStatus.UNREADABLE, reasons[k]))
        elif k in hung:
            reason = f"the pose of an earlier one, but its stripe lies {hung[k]:.2g} mm away"
            records.append(ScanExposure(row, ExposureStatus.EQUAL_POSE, reason))
        elif not images.is_lit[k]:
            records.append(ScanExposure(row, ExposureStatus.LASER_OFF, "no laser was on"))
        elif k in alone:
            records.append(ScanExposure(row, ExposureStatus.NO_PARTNER, PARTNER_MISSING))
        else:
            own = PoseStatus(int(poses.fate[k]))
            reason = "the other camera's image has none" if own is PoseStatus.FOUND else own.label
            records.append(ScanExposure(row, ExposureStatus.NO_POSE, reason))
    return tuple(records)


def _joined(
    placed: dict[int, PlacedImage],
    exposures: Sequence[ScanExposure],
    poses: ExposurePoses,
    placing: BaseTransform,
    options: ScanOptions,
) -> ScanReconstruction:
    sensor = placing.scanner.sensor
    rows = list(placed)
    if sensor is None or not rows:
        broken = "; ".join(e.reason for e in exposures if e.fate is ExposureStatus.UNREADABLE)
        raise EstimationError(f"no exposure with a pose could be measured: {broken or 'no laser'}")
    images = tuple(placed[row].image for row in rows)
    cloud = merge_clouds([placed[row].cloud for row in rows])
    if len(cloud) == 0:
        n_outside = sum(placed[row].n_outside_volume for row in rows)
        if n_outside:
            raise EstimationError(
                f"all {n_outside} measured points lie outside the volume {options.volume}",
                remedy="give limits in mm in the arm's base frame, or none",
            )
        raise EstimationError(nothing_measured(images), remedy=NOTHING_MEASURED_REMEDY)
    cloud, extra = _with_normals(cloud, rows, poses, placing, options)
    depths = [
        np.concatenate([placed[row].depths_mm[k] for row in rows])
        for k in range(len(sensor.sheets))
    ]
    warnings = (
        *scan_warnings(exposures, poses),
        *measurement_warnings(images, depths, sensor),
        *extra,
    )
    return ScanReconstruction(cloud, images, tuple(rows), tuple(exposures), poses, warnings)


def _with_normals(
    cloud: PointCloud,
    rows: Sequence[int],
    poses: ExposurePoses,
    placing: BaseTransform,
    options: ScanOptions,
) -> tuple[PointCloud, tuple[str, ...]]:
    """The cloud with normals towards the camera of each point's exposure."""
    if options.normals is None:
        return cloud, ()
    eye = placing.scanner.hand_eye.tool_from_sensor.translation_mm
    cameras = poses.rotations[list(rows)] @ eye + poses.translations_mm[list(rows)]
    chosen = options.normals
    if chosen.radius_mm is None:
        chosen = replace(chosen, radius_mm=choose_radius_mm(cloud.points_mm, cloud.exposure))
    normals = estimate_normals(cloud.points_mm, cameras[cloud.exposure], chosen)
    share = float((~normals.any(axis=1)).mean())
    warnings: tuple[str, ...] = ()
    if share > MANY_WITHOUT_NORMAL:
        warnings = (
            f"{100.0 * share:.0f} % of the points have no normal: within {chosen.radius_mm:.1f} mm "
            "they lie on single lines, or on no plane",
        )
    return replace(cloud, normals=normals), warnings
