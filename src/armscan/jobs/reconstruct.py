# SPDX-License-Identifier: Apache-2.0
"""From images or a recording, and a calibrated head, to a cloud and its page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import ArmscanError, InputError, OptionError
from armscan.fusion.digest import CloudDigest
from armscan.fusion.point_spool import PointSpool
from armscan.fusion.voxel_map import VoxelMap
from armscan.geometry.arrays import Box
from armscan.geometry.rotations import EulerConvention, check_convention
from armscan.jobs.fuse import fused_marks, fused_pieces
from armscan.jobs.job import Batch, BatchItem, Job, noise_remarks
from armscan.jobs.live.recordings import count_exposures, recording_mark, recordings_in
from armscan.models.calibration import Provenance, ScannerCalibration, SensorCalibration
from armscan.pipeline.cluster.extraction import ClusterAddress, ClusterReader
from armscan.pipeline.instants import PARTNER_MISSING, ScanInstants
from armscan.pipeline.measure import (
    MeasureOptions,
    Reconstruction,
    cameras_of,
    scan_as_seen,
    stripes_for,
)
from armscan.pipeline.measure import reconstruct as reconstruct_images
from armscan.pipeline.progress import StageClock
from armscan.pipeline.scan import (
    ExposureStatus,
    ScanOptions,
    ScanReconstruction,
    measure_long_scan,
    place_profiles,
    scan_spool,
)
from armscan.reconstruction.labels import PointStatus
from armscan.records.cloud import PointCloud
from armscan.records.exposure import Exposure
from armscan.report.cloud import (
    cloud_page,
    cloud_quantities,
    profile_quantities,
    profile_table,
    scan_page,
    scan_quantities,
    status_table,
    status_totals,
)
from armscan.report.page import Page, render_page
from armscan.report.quantity import Quantity, Summary, Table, sentences
from armscan.storage.arm import read_arm_model
from armscan.storage.clouds import CLOUD_SUFFIXES, CloudPiece, cloud_losses, cloud_parts
from armscan.storage.documents import (
    is_scanner_document,
    read_scanner_calibration,
    read_sensor_calibration,
)
from armscan.storage.files import read_bytes, scratch_folder
from armscan.storage.image_paths import are_simulated, expand_paths
from armscan.storage.images import ImageOptions, read_exposures
from armscan.storage.points import profile_files, read_profiles
from armscan.storage.recording import (
    FolderRecording,
    is_recording,
    read_recording,
    recording_name,
    recording_tables,
)
from armscan.storage.recordings.robot_poses import USUAL_EULER, read_robot_poses

LISTED = 4


@dataclass(frozen=True, slots=True)
class StillPaths:
    """Files, folders or patterns of images with the laser on and off, or the folder of one
    recording.
    """

    images: tuple[str, ...]
    background: tuple[str, ...] = ()
    right: tuple[str, ...] = ()
    right_background: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PoseTable:
    """A robot's poses, one a profile of a sensor that delivers points."""

    path: Path
    euler: EulerConvention = USUAL_EULER

    def __post_init__(self) -> None:
        check_convention(self.euler)


@dataclass(frozen=True, slots=True, eq=False)
class CameraImages:
    """What one camera took: with laser, and the same without, one for each or none."""

    lit: tuple[Exposure, ...] = ()
    dark: tuple[Exposure, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class StillImages:
    """Images of one camera or two, and the files that they came from: with laser, then without.

    ``right`` is empty where there is one camera only; ``are_paired`` is True where the views of a
    recording say which images belong together.
    """

    paths: tuple[Path, ...]
    left: CameraImages
    right: CameraImages
    warnings: tuple[str, ...] = ()
    are_paired: bool = False

    @property
    def exposures(self) -> tuple[Exposure, ...]:
        """All of them."""
        return (*self.left.lit, *self.left.dark, *self.right.lit, *self.right.dark)


def reconstruct(
    job: Job,
    calibration: Path,
    paths: StillPaths,
    *,
    volume: str = "",
    arm: Path | None = None,
    poses: PoseTable | None = None,
    options: MeasureOptions | None = None,
    image_options: ImageOptions | None = None,
    is_profiled: bool = False,
    cluster: ClusterAddress | None = None,
    voxel_mm: float | None = None,
    tell: Callable[[str], None] | None = None,
) -> Summary:
    """Measure a recording in Base if there is one and a scanner's document, else in Sensor.

    A folder of recordings is measured one by one into a folder of clouds; what is there already
    is not measured again, and a recording that fails ends no other.

    With a table of poses the files are profiles that a sensor delivered, to be placed in Base.

    Parameters
    ----------
    job
        Where to write the cloud, ``NAME.ply`` or another of `CLOUD_SUFFIXES`; ``NAME.html`` is
        written beside it.
    calibration
        The sensor's calibration ``sensor.json``, or a ``scanner.json``.
    paths
        What to read.
    volume
        Part of Base to measure in a recording, ``xmin,xmax,ymin,ymax,zmin,zmax``; empty for all.
    arm
        ``arm.toml`` for recordings of joint angles; None to look for it in the recording.
    poses
        Of profiles; None for images.
    options, image_options
        Of stripes, depths and sheet, and how pixels are read.
    is_profiled
        Say what each stage of a scan took.
    cluster
        Whose workers extract the stripes of a scan; None to do so here.
    voxel_mm
        Edge of the voxels of which each gives one point of the cloud in Base; None for all points.
    tell
        Told a line when one of several recordings is done or failed.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong or does not fit, no exposure has a pose, or
        nothing was measured; nothing is written then.
    """
    options, image_options = options or MeasureOptions(), image_options or ImageOptions()
    box = Box.parse(volume, "--volume") if volume else None
    if voxel_mm is not None:
        # a wrong size is refused before the work
        VoxelMap(voxel_mm).close()
    if poses is not None:
        return _delivered(job, calibration, paths.images, poses, box, voxel_mm=voxel_mm)
    recordings = [Path(name) for name in paths.images if is_recording(Path(name))]
    several = [] if recordings or len(paths.images) != 1 else recordings_in(Path(paths.images[0]))
    if (recordings or several) and not (paths.background or paths.right):
        image_options.check_unused()
    if (recordings or several) and is_scanner_document(calibration):
        if len(paths.images) > 1:
            raise OptionError(
                f"{len(paths.images)} places to measure",
                where=", ".join(paths.images[:3]),
                remedy="name one recording at a time, or the folder that holds them all",
            )
        _check_own_images(paths)
        chosen = ScanOptions(measure=options, volume=box)

        def measure(folder: Path, own: Job) -> Summary:
            return _scan(
                own,
                calibration,
                folder,
                arm,
                chosen,
                is_profiled=is_profiled,
                cluster=cluster,
                voxel_mm=voxel_mm,
            )

        if recordings:
            return measure(recordings[0], job)
        files = [path for path in (calibration, arm) if path is not None]
        asked = f"{chosen!r} {voxel_mm}"
        return _scans(Batch(job, ".ply", tell or (lambda _: None)), several, files, asked, measure)
    of_scans = {
        "--volume": volume,
        "--arm": arm,
        "--profile": is_profiled,
        "--cluster": cluster,
        "--voxel": voxel_mm,
    }
    for option, value in of_scans.items():
        if value:
            raise OptionError(
                "there is no recording of an arm with a scanner's document",
                where=option,
                remedy="give a folder with exposures.csv and --scanner scanner.json",
            )
    return _stills(job, calibration, paths, options, image_options)


def _scans(
    batch: Batch,
    folders: Sequence[Path],
    files: Sequence[Path],
    asked: str,
    measure: Callable[[Path, Job], Summary],
) -> Summary:
    """A cloud of each recording, and a line of each."""
    repeated = [name for name, n in Counter(map(recording_name, folders)).items() if n > 1]
    if repeated:
        raise OptionError(f"two recordings are called {repeated[0]}", remedy="rename one of them")
    given = sha256(f"{version('armscan')} {asked}".encode())
    for path in files:
        given.update(read_bytes(path))
    items = [
        BatchItem(
            recording_name(folder),
            _mark(folder, given.hexdigest()),
            count_exposures(folder),
            partial(measure, folder),
        )
        for folder in folders
    ]
    found = batch.run(items)
    failed = {name: entry["failed"] for name, entry in found.items() if "failed" in entry}
    rows = []
    for item in items:
        entry = found[item.name]
        data = entry.get("data", {})
        n_warnings = len(data.get("warnings", ()))
        told = "failed" if item.name in failed else "done before" if "is_old" in entry else "done"
        counts = (f"{data['n_points']:,}", str(n_warnings)) if data else ("", "")
        seconds = f"{entry['seconds']:.1f}" if "seconds" in entry else ""
        rows.append((item.name, *counts, f"{item.n_steps:,}", seconds, told))
    return Summary(
        title=f"{len(items) - len(failed)} of {len(items)} scans placed in Base.",
        tables=(Table(("scan", "points", "warnings", "exposures", "s", "result"), tuple(rows), "",
                      (5,)),),
        warnings=tuple(f"{name}: {why}" for name, why in failed.items()),
        written=(batch.folder,),
        extra={"kind": "scans", "n_failed": len(failed), "scans": found},
    )  # fmt: skip


def _mark(recording: Path, given: str) -> str:
    """As `recording_mark`; nothing for one that cannot be read, which its own job will tell."""
    try:
        return recording_mark(recording, given)
    except (ArmscanError, OSError):
        return ""


def _stills(
    job: Job,
    calibration: Path,
    paths: StillPaths,
    options: MeasureOptions,
    image_options: ImageOptions,
) -> Summary:
    places = job.places(*CLOUD_SUFFIXES, beside=(".html",))
    sensor = _sensor(calibration)
    read = read_stills(paths, image_options, len(cameras_of(sensor)))
    result = reconstruct_images(
        read.left.lit,
        sensor,
        backgrounds=read.left.dark,
        rights=read.right.lit,
        right_backgrounds=read.right.dark,
        are_paired=read.are_paired,
        options=options,
        progress=job.progress,
        cache=job.cache,
    )
    result = replace(result, warnings=(*read.warnings, *result.warnings))
    provenance = job.provenance(
        (*read.paths, calibration),
        (options, image_options),
        parents=(sensor.provenance,),
        warnings=result.warnings,
    )
    is_simulated = are_simulated(read.paths)
    by_source = {exposure.source: exposure for exposure in read.exposures}
    page = cloud_page(result, sensor, by_source, provenance, is_simulated=is_simulated)
    measured = replace(
        result.cloud,
        is_simulated=is_simulated,
        forced=provenance.forced,
        calibrations=(sensor.provenance.mark,),
    )
    written, losses = _write(
        job,
        places,
        marks=measured,
        n_points=len(measured),
        pieces=[CloudPiece(measured, measured.sigma_mm)],
        page=lambda: page,
    )
    return Summary(
        title="Points measured" + (" on simulated images." if is_simulated else "."),
        quantities=cloud_quantities(result),
        tables=(status_table(result),),
        warnings=sentences((*result.warnings, *losses)),
        written=written,
        next_step=f"open {written[-1]}, and the cloud in any viewer",
        forced=provenance.forced,
        extra={
            "kind": "reconstruction",
            "simulated": is_simulated,
            "images": _image_data(result),
        },
    )


def _image_data(result: Reconstruction) -> list[dict[str, Any]]:
    return [
        {
            "source": image.profile.source,
            "n_stripe_points": len(image.profile),
            "n_measured": image.count(PointStatus.MEASURED),
            "naming": image.reason,
        }
        for image in result.images
    ]


def _sensor(path: Path) -> SensorCalibration:
    if not is_scanner_document(path):
        return read_sensor_calibration(path)
    sensor = read_scanner_calibration(path).sensor
    if sensor is None:
        raise InputError(
            "this scanner delivers points itself: it has no camera and no light sheets",
            where=str(path),
            remedy="name the document of a scanner with a camera, or give --poses with profiles",
        )
    return sensor


def _write(
    job: Job,
    places: Sequence[Path],
    *,
    marks: PointCloud,
    n_points: int,
    pieces: Iterable[CloudPiece],
    page: Callable[[], Page],
    is_fused: bool = False,
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """The files written, the page last, and what they do not hold."""
    content = cloud_parts(places[0], marks, n_points, pieces, is_fused=is_fused)
    written = job.write({places[0]: content, places[1]: (render_page(make()) for make in (page,))})
    losses = cloud_losses(marks, places[0])
    kind = places[0].suffix.lstrip(".").upper()
    return written, (f"the {kind} file does not hold {', '.join(losses)}",) if losses else ()


def _scan(
    job: Job,
    calibration: Path,
    folder: Path,
    arm: Path | None,
    options: ScanOptions,
    *,
    is_profiled: bool,
    cluster: ClusterAddress | None,
    voxel_mm: float | None,
) -> Summary:
    clock, cache = StageClock(), job.cache
    places = job.places(*CLOUD_SUFFIXES, beside=(".html",))
    scanner = read_scanner_calibration(calibration)
    recording = read_recording(folder, None if arm is None else read_arm_model(arm))
    reader, about = None, ""
    if scanner.sensor is not None:
        cameras = cameras_of(scanner.sensor)
        measure, about = scan_as_seen(
            ScanInstants(recording, len(cameras)), scanner.sensor, options.measure, cache
        )
        options = replace(options, measure=measure)
        if cluster is not None:
            stripes = stripes_for(scanner.sensor, measure.stripes)
            reader = ClusterReader(cluster, recording, cameras, stripes, cache)
    with scratch_folder(places[0]) as scratch, scan_spool(scanner, scratch) as points:
        scan = measure_long_scan(
            recording, scanner, points, options,
            progress=job.progress, cache=cache, clock=clock, reader=reader,
        )  # fmt: skip
        clock.n_cached = 0 if cache is None else cache.n_earlier
        warnings = (
            *recording.warnings,
            *recording.session.assumed,
            *filter(None, [about]),
            *scan.warnings,
        )
        provenance = job.provenance(
            (*recording_tables(folder, arm), calibration),
            (options,),
            parents=(scanner.provenance,),
            warnings=warnings,
        )
        shown = [recording.exposure(row) for row in scan.image_rows]
        return _told(
            job,
            places,
            scan,
            points,
            exposures={exposure.source: exposure for exposure in shown},
            provenance=provenance,
            warnings=warnings,
            scanner=scanner,
            is_simulated=recording.is_simulated,
            clock=clock if is_profiled else None,
            voxel_mm=voxel_mm,
        )


def _delivered(
    job: Job,
    calibration: Path,
    names: Sequence[str],
    table: PoseTable,
    volume: Box | None,
    *,
    voxel_mm: float | None,
) -> Summary:
    """Place profiles that a sensor delivered."""
    places = job.places(*CLOUD_SUFFIXES, beside=(".html",))
    scanner = read_scanner_calibration(calibration)
    files = [path for name in names for path in profile_files(Path(name), table.path)]
    profiles = read_profiles(files)
    points = scan_spool(scanner)
    poses = read_robot_poses(table.path, table.euler, files)
    scan = place_profiles(profiles, poses, scanner, volume, points=points)
    warnings = scan.warnings
    if voxel_mm is not None:
        told = (text for piece in points.pieces() for text in noise_remarks(piece.cloud))
        warnings = (*warnings, *islice(told, 1))
    provenance = job.provenance(
        (*files, table.path, calibration),
        (table,),
        parents=(scanner.provenance,),
        warnings=warnings,
    )
    return _told(
        job,
        places,
        scan,
        points,
        exposures={},
        provenance=provenance,
        warnings=warnings,
        scanner=scanner,
        voxel_mm=voxel_mm,
    )


def _told(
    job: Job,
    places: Sequence[Path],
    scan: ScanReconstruction,
    points: PointSpool,
    *,
    exposures: Mapping[str, Exposure],
    provenance: Provenance,
    warnings: Sequence[str],
    scanner: ScannerCalibration,
    is_simulated: bool = False,
    clock: StageClock | None = None,
    voxel_mm: float | None = None,
) -> Summary:
    """Write a cloud in Base and say what came out."""
    timer = clock or StageClock()
    with timer.stage("page", is_alone=True):
        digest = CloudDigest.of_spool(points, scan.cloud)

    def page() -> Page:
        return scan_page(
            scan,
            exposures,
            provenance,
            warnings,
            digest=digest,
            profile=None if clock is None else clock.profile(),
            is_simulated=is_simulated,
        )

    with _writing(points, scan.cloud, voxel_mm, timer) as cloud:
        written, losses = _write(
            job,
            places,
            marks=cloud.marks,
            n_points=cloud.n_points,
            pieces=cloud.pieces,
            page=page,
            is_fused=voxel_mm is not None,
        )
    profile = None if clock is None else clock.profile()
    costs = () if profile is None else profile_quantities(scan, digest, profile)
    tables = (status_totals(scan),) if scan.counts else ()
    return Summary(
        title="Scan placed in Base" + (" (simulated images)." if is_simulated else "."),
        quantities=(*scan_quantities(scan, digest), *cloud.told, *costs),
        tables=tables if profile is None else (*tables, profile_table(scan, profile)),
        warnings=sentences((*warnings, *losses)),
        written=written,
        next_step=f"open {written[-1]}, then `armscan inspect plane {written[0]}` or sphere, step",
        forced=scan.cloud.forced,
        extra={
            "kind": "scan",
            "simulated": is_simulated,
            "hand_eye_of": scanner.provenance.document_id,
        },
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Writing:
    """What goes into the file of a cloud: names, count, points, and what is told of thinning."""

    marks: PointCloud
    n_points: int
    pieces: Iterator[CloudPiece]
    told: tuple[Quantity, ...] = ()


@contextmanager
def _writing(
    points: PointSpool, marks: PointCloud, voxel_mm: float | None, timer: StageClock
) -> Iterator[_Writing]:
    """All points, or one a voxel, while they are written."""

    def timed(pieces: Iterable[CloudPiece]) -> Iterator[CloudPiece]:
        with timer.stage("writing", is_alone=True):
            yield from pieces

    if voxel_mm is None:
        every = (CloudPiece(one.cloud, one.sigma_mm) for one in points.pieces())
        yield _Writing(marks, len(points), timed(every))
        return
    voxels = VoxelMap(voxel_mm, points.folder)
    try:
        with timer.stage("fusing", is_alone=True):
            for piece in points.pieces():
                voxels.add(piece.cloud)
            n_fused = sum(len(part.cloud) for part in voxels.fused())
        own = replace(
            fused_marks(voxels),
            is_simulated=marks.is_simulated,
            forced=marks.forced,
            calibrations=marks.calibrations,
        )
        meaning = f"in the cloud, one a voxel of {voxel_mm:g} mm; all else is told of all points"
        told = (
            Quantity("n_fused", "Fused points", n_fused, meaning=meaning),
            Quantity("voxel_mm", "", voxel_mm),
        )
        yield _Writing(own, n_fused, timed(fused_pieces(voxels)), told)
    finally:
        voxels.close()


def _check_own_images(paths: StillPaths) -> None:
    """Raise if images are given beside a recording, which has its own."""
    if paths.background:
        raise OptionError(
            "the backgrounds of a recording are its own exposures without laser",
            where="--background",
            remedy="leave it out, and give both exposures one view in exposures.csv",
        )
    for option, value in (
        ("--right", paths.right),
        ("--right-background", paths.right_background),
    ):
        if value:
            raise OptionError(
                "the right camera's images of a recording are its own rows of camera 1",
                where=option,
                remedy="leave it out",
            )


def read_stills(paths: StillPaths, options: ImageOptions, n_cameras: int) -> StillImages:
    """Read images of files and folders, or the exposures of one recording."""
    folder = Path(paths.images[0]) if len(paths.images) == 1 else None
    others = (*paths.background, *paths.right, *paths.right_background)
    if folder is not None and is_recording(folder) and not others:
        return _stills_of_recording(folder, n_cameras)
    names = (paths.images, paths.background, paths.right, paths.right_background)
    groups = [expand_paths(given) if given else () for given in names]
    every = read_exposures([path for group in groups for path in group], options)
    ends = np.cumsum([len(group) for group in groups])
    lit, dark, right, right_dark = (
        tuple(every[end - len(group) : end]) for group, end in zip(groups, ends, strict=True)
    )
    return StillImages(
        (*groups[0], *groups[2], *groups[1], *groups[3]),
        CameraImages(lit, dark),
        CameraImages(right, right_dark),
    )


def _stills_of_recording(folder: Path, n_cameras: int) -> StillImages:
    recording = read_recording(folder)
    scan = ScanInstants(recording, n_cameras)
    cameras = []
    warnings = [*recording.warnings, *recording.session.assumed, *_not_used(recording, scan)]
    for camera in range(n_cameras):
        pairs = [scan.pair(one.rows[camera]) for one in scan.lit]
        dark = [background for _, background in pairs if background is not None]
        if dark and len(dark) < len(pairs):
            whose = f" of camera {camera}" if n_cameras > 1 else ""
            warnings.append(
                f"{len(pairs) - len(dark)} of {len(pairs)} images{whose} have no image without "
                "laser of their view: none of its images had a background subtracted"
            )
            dark = []
        cameras.append(CameraImages(tuple(on for on, _ in pairs), tuple(dark)))
    left, right = (*cameras, CameraImages())[:2]
    used = (*left.lit, *right.lit, *left.dark, *right.dark)
    files = dict.fromkeys(folder / exposure.source for exposure in used)
    return StillImages(tuple(files), left, right, tuple(warnings), are_paired=True)


def _not_used(recording: FolderRecording, scan: ScanInstants) -> Iterator[str]:
    """What a person should know of a recording's rows, as of those of a scan."""
    if names := [recording.rows[row].source for row in scan.without_partner]:
        named = ", ".join(names[:LISTED])
        yield f"{len(names)} images were not used, {PARTNER_MISSING}: {named}"
    n_unknown = int(scan.is_unknown.sum())
    if n_unknown:
        why = ExposureStatus.LASER_UNKNOWN.value
        yield f"{n_unknown} of {len(recording.rows)} images were not measured: {why}"
    elif not any(row.lasers for row in recording.rows):
        yield "no exposure names its lasers: the laser was taken to be on in all"
