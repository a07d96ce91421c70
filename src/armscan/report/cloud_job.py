# SPDX-License-Identifier: Apache-2.0
"""From stripe images and a sensor's document to a cloud and its report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from armscan.errors import InputError
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.measure import cameras_of
from armscan.pipeline.measure_options import MeasureOptions
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.reconstruct import reconstruct
from armscan.reconstruction.result import Reconstruction
from armscan.report.cloud_page import cloud_page, fate_table
from armscan.report.numbers import sentence, significant
from armscan.report.outputs import cloud_outputs
from armscan.report.page import render_page
from armscan.report.still_images import StillPaths, read_stills
from armscan.report.summary import Summary
from armscan.storage.atomic import write_files
from armscan.storage.calibration_files import read_sensor_calibration
from armscan.storage.clouds import XYZ_LOSES, ply_bytes, xyz_bytes
from armscan.storage.image_options import ImageOptions
from armscan.storage.provenance import new_provenance
from armscan.storage.scanner_files import is_scanner_document, read_scanner_calibration
from armscan.storage.simulated import are_simulated


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
                    "n_measured": int((image.fate == 0).sum()),
                    "naming": image.naming,
                }
                for image in result.images
            ],
        },
    )
