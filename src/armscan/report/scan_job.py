# SPDX-License-Identifier: Apache-2.0
"""From a recording and a scanner's document to a cloud in Base and its report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from armscan.errors import OptionError
from armscan.models.scanner import ScannerCalibration
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.scan import ScanOptions, measure_scan
from armscan.pipeline.scan_result import ScanExposureFate, ScanReconstruction
from armscan.reconstruction.volume import parse_volume
from armscan.records.exposure import Exposure
from armscan.report.cloud_job import CloudRequest, run_reconstruction
from armscan.report.numbers import sentence, significant
from armscan.report.outputs import cloud_outputs
from armscan.report.page import render_page
from armscan.report.scan_page import fate_totals, scan_page
from armscan.report.stripe_figures import evenly_chosen
from armscan.report.summary import Summary
from armscan.storage.arm_files import read_arm_model
from armscan.storage.atomic import write_files
from armscan.storage.clouds import XYZ_LOSES, ply_bytes, xyz_bytes
from armscan.storage.provenance import new_provenance
from armscan.storage.recording_arm import ARM_FILE
from armscan.storage.recording_exposures import EXPOSURES_FILE
from armscan.storage.recording_reader import FolderRecording, is_recording, read_recording
from armscan.storage.recording_session import SESSION_FILE
from armscan.storage.scanner_files import is_scanner_document, read_scanner_calibration

MAX_SHOWN = 12


def run_measurement(request: CloudRequest, progress: Progress = silent) -> Summary:
    """Measure a recording in Base if there is one and a scanner's document, else in Sensor.

    Raises
    ------
    ArmscanError
        As `run_scan` and `armscan.report.cloud_job.run_reconstruction`; or if options do not fit.
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
    volume = parse_volume(request.volume) if request.volume else None
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
    counts = {fate: scan.count(fate) for fate in ScanExposureFate}
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
