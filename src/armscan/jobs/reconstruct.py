# SPDX-License-Identifier: Apache-2.0
"""From images or a recording, and a calibrated head, to a cloud and its page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import Box
from armscan.jobs.job import cloud_outputs
from armscan.models.calibration import ScannerCalibration, SensorCalibration
from armscan.pipeline.instants import PARTNER_MISSING, ScanInstants
from armscan.pipeline.measure import MeasureOptions, Reconstruction, cameras_of, reconstruct
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.scan import ExposureStatus, ScanOptions, ScanReconstruction, measure_scan
from armscan.reconstruction.labels import PointStatus
from armscan.records.exposure import Exposure
from armscan.report.cloud import cloud_page, fate_table, fate_totals, scan_page
from armscan.report.page import render_page
from armscan.report.quantity import Summary, sentence, significant
from armscan.report.stripes import evenly_chosen
from armscan.storage.arm import ARM_FILE, read_arm_model
from armscan.storage.clouds import XYZ_LOSES, ply_bytes, xyz_bytes
from armscan.storage.documents import (
    is_scanner_document,
    new_provenance,
    read_scanner_calibration,
    read_sensor_calibration,
)
from armscan.storage.files import write_files
from armscan.storage.image_paths import are_simulated, expand_paths
from armscan.storage.images import ImageOptions, read_exposures
from armscan.storage.recording import FolderRecording, is_recording, read_recording
from armscan.storage.recording_session import EXPOSURES_FILE, SESSION_FILE

LISTED = 4


@dataclass(frozen=True, slots=True, eq=False)
class CameraImages:
    """What one camera took: with laser, and the same without, one for each or none."""

    lit: tuple[Exposure, ...] = ()
    dark: tuple[Exposure, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class StillImages:
    """Images of one camera or two, and the files that they came from.

    Parameters
    ----------
    lit_paths, dark_paths
        Files with laser and without.
    left, right
        Exposures; of the right camera none where there is one only.
    warnings
        What was left out, in words.
    """

    lit_paths: tuple[Path, ...]
    dark_paths: tuple[Path, ...]
    left: CameraImages
    right: CameraImages
    warnings: tuple[str, ...] = ()

    @property
    def exposures(self) -> tuple[Exposure, ...]:
        """All of them."""
        return (*self.left.lit, *self.left.dark, *self.right.lit, *self.right.dark)


@dataclass(frozen=True, slots=True)
class StillPaths:
    """Files, folders or patterns of images, or the folder of one recording.

    Parameters
    ----------
    images, background
        With the laser on and off.
    right, right_background
        The same of the right camera.
    """

    images: tuple[str, ...]
    background: tuple[str, ...] = ()
    right: tuple[str, ...] = ()
    right_background: tuple[str, ...] = ()


def read_stills(paths: StillPaths, options: ImageOptions, n_cameras: int) -> StillImages:
    """Read images of files and folders, or the exposures of one recording.

    Raises
    ------
    ArmscanError
        If an image cannot be read, or a recording has not that many cameras, or not one instant of
        which all have an image.
    """
    folder = Path(paths.images[0]) if len(paths.images) == 1 else None
    if folder is not None and is_recording(folder) and not (paths.background or paths.right):
        return _of_recording(folder, n_cameras)
    groups = [
        expand_paths(names) if names else ()
        for names in (paths.images, paths.background, paths.right, paths.right_background)
    ]
    every = read_exposures([path for group in groups for path in group], options)
    ends = [sum(len(group) for group in groups[: k + 1]) for k in range(len(groups))]
    lit, dark, right, right_dark = (
        tuple(every[end - len(group) : end]) for group, end in zip(groups, ends, strict=True)
    )
    return StillImages(
        (*groups[0], *groups[2]),
        (*groups[1], *groups[3]),
        CameraImages(lit, dark),
        CameraImages(right, right_dark),
    )


def _of_recording(folder: Path, n_cameras: int) -> StillImages:
    recording = read_recording(folder)
    scan = ScanInstants(recording, n_cameras)
    cameras = []
    warnings = list(_alone(recording, scan))
    for camera in range(n_cameras):
        pairs = [scan.pair(one.rows[camera]) for one in scan.lit]
        dark = [background for _, background in pairs if background is not None]
        is_complete = len(dark) == len(pairs)
        if dark and not is_complete:
            warnings.append(_dark_left_out(camera, n_cameras, len(pairs) - len(dark), len(pairs)))
        cameras.append(
            CameraImages(tuple(on for on, _ in pairs), tuple(dark) if is_complete else ())
        )
    left, right = (*cameras, CameraImages())[:2]
    return StillImages(
        _paths(folder, (*left.lit, *right.lit)),
        _paths(folder, (*left.dark, *right.dark)),
        left,
        right,
        tuple(warnings),
    )


def _alone(recording: FolderRecording, scan: ScanInstants) -> tuple[str, ...]:
    names = [recording.rows[row].source for row in scan.without_partner]
    if not names:
        return ()
    named = ", ".join(names[:LISTED])
    return (f"{len(names)} images were not used, {PARTNER_MISSING}: {named}",)


def _dark_left_out(camera: int, n_cameras: int, n_without: int, n: int) -> str:
    whose = f" of camera {camera}" if n_cameras > 1 else ""
    return (
        f"{n_without} of {n} images{whose} have no image without laser of their view: none of its "
        "images had a background subtracted"
    )


def _paths(folder: Path, exposures: Sequence[Exposure]) -> tuple[Path, ...]:
    return tuple(dict.fromkeys(folder / exposure.source for exposure in exposures))


@dataclass(frozen=True, slots=True)
class CloudRequest:
    """What to measure, and where to write.

    Parameters
    ----------
    sensor
        The sensor's calibration ``sensor.json``, or a ``scanner.json``.
    images
        Images with the laser on: files, folders or patterns; or a recording's folder.
    background
        The same views without laser, one for each, or none.
    output
        The cloud ``NAME.ply`` or ``NAME.xyz``; ``NAME.html`` is written beside it.
    options
        Of stripes, depths and sheet.
    image_options
        How pixels are read.
    volume
        Part of Base to measure in a recording, ``xmin,xmax,ymin,ymax,zmin,zmax``; empty for all.
    arm
        ``arm.toml`` for recordings of joint angles; None to look for it in the recording.
    right, right_background
        The right camera's images of the same instants, for a sensor of two cameras.
    is_overwriting
        Replace results that exist.
    command
        The command line, for the record.
    """

    sensor: Path
    images: tuple[str, ...]
    background: tuple[str, ...]
    output: Path
    options: MeasureOptions = field(default_factory=MeasureOptions)
    image_options: ImageOptions = field(default_factory=ImageOptions)
    volume: str = ""
    arm: Path | None = None
    right: tuple[str, ...] = ()
    right_background: tuple[str, ...] = ()
    is_overwriting: bool = False
    command: tuple[str, ...] = ()


def run_reconstruction(request: CloudRequest, progress: Progress = silent) -> Summary:
    """Read, measure, write the cloud and its page, and say what came out.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, or nothing was measured; nothing is written
        then.
    """
    files = cloud_outputs(request.output, is_overwriting=request.is_overwriting)
    sensor = _sensor(request.sensor)
    paths = StillPaths(request.images, request.background, request.right, request.right_background)
    read = read_stills(paths, request.image_options, len(cameras_of(sensor)))
    images, background, exposures = read.lit_paths, read.dark_paths, read.exposures
    result = reconstruct(
        read.left.lit,
        sensor,
        backgrounds=read.left.dark,
        rights=read.right.lit,
        right_backgrounds=read.right.dark,
        options=request.options,
        progress=progress,
    )
    result = replace(result, warnings=(*read.warnings, *result.warnings))
    provenance = new_provenance(
        (*images, *background, request.sensor),
        command=request.command,
        options=(request.options, request.image_options),
        parents=(sensor.provenance,),
        warnings=result.warnings,
    )
    is_simulated = are_simulated((*images, *background))
    by_source = {exposure.source: exposure for exposure in exposures}
    page = cloud_page(result, sensor, by_source, provenance, is_simulated=is_simulated)
    is_ply = request.output.suffix.lower() == ".ply"
    forced = provenance.forced
    measured = replace(result.cloud, is_simulated=is_simulated, forced=forced)
    cloud = ply_bytes(measured) if is_ply else xyz_bytes(measured)
    write_files(
        {files.document: cloud, files.page: render_page(page)},
        is_overwriting=request.is_overwriting,
    )
    written = (files.document, files.page)
    losses = () if is_ply else (f"the XYZ file does not hold {', '.join(XYZ_LOSES)}",)
    summary = cloud_summary(result, written, losses, is_simulated=is_simulated)
    return replace(summary, forced=forced)


def _sensor(path: Path) -> SensorCalibration:
    if not is_scanner_document(path):
        return read_sensor_calibration(path)
    sensor = read_scanner_calibration(path).sensor
    if sensor is None:
        raise InputError(
            "this scanner delivers points itself: it has no camera and no light sheets",
            where=str(path),
            remedy="name the document of a scanner with a camera",
        )
    return sensor


def cloud_summary(
    result: Reconstruction,
    written: Sequence[Path],
    losses: Sequence[str] = (),
    *,
    is_simulated: bool,
) -> Summary:
    """What a person, and a program, wants to know of a reconstruction."""
    cloud = result.cloud
    median, high = (float(value) for value in np.percentile(cloud.sigma_mm, [50, 95]))
    low_corner, high_corner = cloud.points_mm.min(axis=0), cloud.points_mm.max(axis=0)
    facts = (
        ("points", f"{len(cloud)} in the {cloud.frame} frame"),
        ("sigma", f"{significant(median)} mm median, 95 % below {significant(high)} mm"),
        *(
            (axis, f"{low:.2f} to {top:.2f} mm")
            for axis, low, top in zip("XYZ", low_corner, high_corner, strict=True)
        ),
    )
    return Summary(
        title="Points measured" + (" on simulated images." if is_simulated else "."),
        facts=facts,
        tables=(fate_table(result),),
        warnings=tuple(sentence(warning) for warning in (*result.warnings, *losses)),
        written=tuple(written),
        next_step=f"open {written[-1]}, and the cloud in any viewer",
        data={
            "kind": "reconstruction",
            "simulated": is_simulated,
            "frame": cloud.frame,
            "n_points": len(cloud),
            "sigma_median_mm": median,
            "sigma_95_mm": high,
            "low_corner_mm": low_corner.tolist(),
            "high_corner_mm": high_corner.tolist(),
            "images": [
                {
                    "source": image.profile.source,
                    "n_stripe_points": len(image.profile),
                    "n_measured": image.count(PointStatus.MEASURED),
                    "naming": image.reason,
                }
                for image in result.images
            ],
        },
    )


MAX_SHOWN = 12


def run_measurement(request: CloudRequest, progress: Progress = silent) -> Summary:
    """Measure a recording in Base if there is one and a scanner's document, else in Sensor.

    Raises
    ------
    ArmscanError
        As `run_scan` and `armscan.jobs.reconstruct.run_reconstruction`; or if options do not fit.
    """
    folders = [Path(name) for name in request.images if Path(name).is_dir()]
    recordings = [folder for folder in folders if is_recording(folder)]
    if recordings and not (request.background or request.right):
        request.image_options.check_unused()
    if recordings and is_scanner_document(request.sensor):
        if len(request.images) > 1:
            raise OptionError(
                f"{len(request.images)} places to measure",
                where=", ".join(request.images[:3]),
                remedy="name one recording at a time",
            )
        return run_scan(request, recordings[0], progress)
    for option, value in (("--volume", request.volume), ("--arm", request.arm)):
        if value:
            raise OptionError(
                "there is no recording of an arm with a scanner's document",
                where=option,
                remedy="give a folder with exposures.csv and --scanner scanner.json",
            )
    return run_reconstruction(request, progress)


def run_scan(request: CloudRequest, folder: Path, progress: Progress = silent) -> Summary:
    """Read, measure, place, write the cloud and its page, and say what came out.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, no exposure has a pose, or nothing was
        measured; nothing is written then.
    """
    files = cloud_outputs(request.output, is_overwriting=request.is_overwriting)
    volume = Box.parse(request.volume, "--volume") if request.volume else None
    scanner = read_scanner_calibration(request.sensor)
    recording = read_recording(folder, None if request.arm is None else read_arm_model(request.arm))
    _check_own_images(request)
    options = ScanOptions(measure=request.options, volume=volume)
    scan = measure_scan(recording, scanner, options, progress=progress)
    notes = (*recording.warnings, *recording.session.assumed)
    provenance = new_provenance(
        _files(request, folder),
        command=request.command,
        options=(options,),
        parents=(scanner.provenance,),
        warnings=(*notes, *scan.warnings),
    )
    page = scan_page(
        scan,
        shown_exposures(recording, scan),
        provenance,
        notes,
        is_simulated=recording.is_simulated,
    )
    is_ply = request.output.suffix.lower() == ".ply"
    cloud = ply_bytes(scan.cloud) if is_ply else xyz_bytes(scan.cloud)
    write_files(
        {files.document: cloud, files.page: render_page(page)},
        is_overwriting=request.is_overwriting,
    )
    losses = () if is_ply else (f"the XYZ file does not hold {', '.join(XYZ_LOSES)}",)
    summary = scan_summary(
        scan,
        scanner,
        (files.document, files.page),
        (*notes, *scan.warnings, *losses),
        is_simulated=recording.is_simulated,
    )
    return replace(summary, forced=provenance.forced)


def _check_own_images(request: CloudRequest) -> None:
    """Raise if images are given beside a recording, which has its own."""
    if request.background:
        raise OptionError(
            "the backgrounds of a recording are its own exposures without laser",
            where="--background",
            remedy="leave it out, and give both exposures one view in exposures.csv",
        )
    for option, value in (
        ("--right", request.right),
        ("--right-background", request.right_background),
    ):
        if value:
            raise OptionError(
                "the right camera's images of a recording are its own rows of camera 1",
                where=option,
                remedy="leave it out",
            )


def shown_exposures(recording: FolderRecording, scan: ScanReconstruction) -> dict[str, Exposure]:
    """The images that a page shows, evenly chosen."""
    chosen = evenly_chosen(scan.image_rows, MAX_SHOWN)
    exposures = [recording.exposure(row) for row in chosen]
    return {exposure.source: exposure for exposure in exposures}


def _files(request: CloudRequest, folder: Path) -> tuple[Path, ...]:
    tables = [folder / name for name in (EXPOSURES_FILE, ARM_FILE, SESSION_FILE)]
    named = [*tables, request.sensor, request.arm]
    return tuple(path for path in named if path is not None and path.exists())


def scan_summary(
    scan: ScanReconstruction,
    scanner: ScannerCalibration,
    written: Sequence[Path],
    warnings: Sequence[str],
    *,
    is_simulated: bool,
) -> Summary:
    """What a person, and a program, wants to know of a scan."""
    cloud = scan.cloud
    median, high = (float(value) for value in np.percentile(cloud.sigma_mm, [50, 95]))
    low_corner, high_corner = cloud.points_mm.min(axis=0), cloud.points_mm.max(axis=0)
    counts = {fate: scan.count(fate) for fate in ExposureStatus}
    agreement = scan.doubt.agreement
    exposures = ", ".join(f"{count} {fate.value}" for fate, count in counts.items() if count)
    facts = (
        ("points", f"{len(cloud)} in the {cloud.frame} frame"),
        ("exposures", exposures),
        ("poses", scan.poses.how),
        ("sigma", f"{significant(median)} mm median, 95 % below {significant(high)} mm"),
        ("passes", passes_text(scan)),
        *(
            (axis, f"{low:.2f} to {top:.2f} mm")
            for axis, low, top in zip("XYZ", low_corner, high_corner, strict=True)
        ),
    )
    return Summary(
        title="Scan placed in Base" + (" (simulated images)." if is_simulated else "."),
        facts=facts,
        tables=(fate_totals(scan),),
        warnings=tuple(sentence(warning) for warning in warnings),
        written=tuple(written),
        next_step=f"open {written[-1]}, then `armscan inspect plane {written[0]}` or sphere, step",
        data={
            "kind": "scan",
            "simulated": is_simulated,
            "frame": cloud.frame,
            "n_points": len(cloud),
            "sigma_median_mm": median,
            "sigma_95_mm": high,
            "low_corner_mm": low_corner.tolist(),
            "high_corner_mm": high_corner.tolist(),
            "poses_by": scan.poses.source,
            "max_gap_ns": scan.poses.max_gap_ns,
            "exposures": {fate.name.lower(): count for fate, count in counts.items()},
            "without_pose": [{"source": name, "reason": why} for name, why in scan.without_pose],
            "hand_eye_of": scanner.provenance.document_id,
            "contradictions": list(scan.contradictions),
            "passes": None
            if agreement is None
            else {
                "distance_mm": agreement.distance_mm,
                "worst_mm": agreement.worst_mm,
                "claimed_mm": agreement.claimed_mm,
                "ratio": agreement.ratio,
                "worst_ratio": agreement.worst_ratio,
                "n_pairs": len(agreement.pairs),
                "cause": scan.doubt.cause,
            },
        },
    )


def passes_text(scan: ScanReconstruction) -> str:
    """How far the passes of a scan agree, in words."""
    found = scan.doubt.agreement
    if found is None:
        return "no two of them overlap, so the scan cannot be checked against itself"
    return (
        f"{significant(found.distance_mm)} mm apart where they overlap (median of "
        f"{len(found.pairs)} pairs; at most {significant(found.worst_mm)} mm), "
        f"{significant(found.ratio, '', 2)} times what is expected"
    )
