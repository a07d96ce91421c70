# SPDX-License-Identifier: Apache-2.0
"""From image files to a camera's document, its observations and its report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from armscan.calibration.camera.options import CameraOptions
from armscan.errors import EstimationError
from armscan.geometry.estimate import FitFailure
from armscan.pipeline.camera import CameraRun, calibrate_camera_from_exposures
from armscan.pipeline.documents import camera_calibration
from armscan.pipeline.progress import Progress, silent
from armscan.report.camera_page import camera_page, parameter_rows
from armscan.report.numbers import sentence, significant, without_source
from armscan.report.outputs import calibration_outputs
from armscan.report.page import render_page
from armscan.report.summary import Summary, Table
from armscan.storage.atomic import write_files
from armscan.storage.calibration_files import camera_document
from armscan.storage.image_options import ImageOptions
from armscan.storage.image_paths import expand_paths
from armscan.storage.images import check_same_size, read_exposures
from armscan.storage.observations import pack_observations
from armscan.storage.provenance import new_provenance
from armscan.storage.simulated import are_simulated
from armscan.vision.targets.definition import Target
from armscan.vision.targets.specification import describe_target, format_target, parse_target


@dataclass(frozen=True, slots=True)
class CameraRequest:
    """What to calibrate a camera from, and where to write.

    Parameters
    ----------
    images
        Files, folders or patterns.
    target
        Specification of the target.
    output
        The document ``NAME.json``; ``NAME.npz`` and ``NAME.html`` are written beside it.
    options
        Of the calibration.
    image_options
        How pixels are read.
    is_overwriting
        Replace results that exist.
    command
        The command line, for the record.
    """

    images: tuple[str, ...]
    target: str
    output: Path
    options: CameraOptions = field(default_factory=CameraOptions)
    image_options: ImageOptions = field(default_factory=ImageOptions)
    is_overwriting: bool = False
    command: tuple[str, ...] = ()


def run_camera_calibration(request: CameraRequest, progress: Progress = silent) -> Summary:
    """Read, calibrate, write ``camera.json``, ``.npz`` and ``.html``, and say what came out.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, or the images do not determine the camera;
        nothing is written then.
    """
    target = parse_target(request.target)
    files = calibration_outputs(request.output, is_overwriting=request.is_overwriting)
    paths = expand_paths(request.images)
    exposures = read_exposures(paths, request.image_options)
    check_same_size(exposures)
    run = calibrate_camera_from_exposures(exposures, target, request.options, progress=progress)
    if isinstance(run, FitFailure):
        raise EstimationError(run.reason, remedy=run.remedy)
    provenance = new_provenance(
        paths,
        command=request.command,
        options=(target, run.fit.options, request.image_options),
        warnings=run.fit.warnings,
    )
    page = camera_page(
        run.fit,
        run.not_found,
        {exposure.source: exposure for exposure in exposures},
        provenance,
        is_simulated=are_simulated(paths),
    )
    hashes = {
        exposure.source: item.sha256
        for exposure, item in zip(exposures, provenance.inputs, strict=True)
    }
    observations = pack_observations([view.view for view in run.fit.views], (), hashes)
    document = camera_document(
        camera_calibration(run.fit, provenance), (files.observations.name, observations)
    )
    write_files(
        {files.document: document, files.observations: observations, files.page: render_page(page)},
        is_overwriting=request.is_overwriting,
    )
    return camera_summary(
        run,
        target,
        (files.document, files.observations, files.page),
        is_simulated=page.is_simulated,
    )


def camera_summary(
    run: CameraRun, target: Target, written: Sequence[Path], *, is_simulated: bool
) -> Summary:
    """What a person, and a program, wants to know of a calibration."""
    fit = run.fit
    held_out = fit.cross_validation
    facts = [
        ("target", describe_target(target)),
        ("images", f"{fit.n_views} used of {len(fit.views) + len(run.not_found)}"),
        ("points", str(fit.n_points)),
        ("rms", f"{significant(fit.rms_px)} px (length of the residual, x and y together)"),
    ]
    if held_out is not None:
        facts.append(
            ("hold-out rms", f"{significant(held_out.rms_px)} px on views not used to solve")
        )
    facts += [(name, value) for name, value, _ in parameter_rows(fit)]
    views = Table(
        ("image", "rms px", "tilt", "remark"),
        tuple(
            (view.source, significant(view.rms_px), f"{view.tilt_deg:.0f}°", view.note)
            for view in fit.views
            if view.note
        )
        + tuple(
            (source, "", "", without_source(source, reason)) for source, reason in run.not_found
        ),
        "Images to look at",
        (3,),
    )
    return Summary(
        title="Camera calibrated" + (" from simulated images." if is_simulated else "."),
        facts=tuple(facts),
        tables=(views,) if views.rows else (),
        warnings=tuple(sentence(warning) for warning in fit.warnings),
        written=tuple(written),
        next_step=f"open {written[-1]}, then `armscan calibrate laser --camera {written[0]} -h`",
        data=_data(run, target, is_simulated),
    )


def _data(run: CameraRun, target: Target, is_simulated: bool) -> dict[str, object]:
    fit = run.fit
    names = [name for name, _, _ in parameter_rows(fit)]
    held_out = fit.cross_validation
    return {
        "kind": "camera calibration",
        "simulated": is_simulated,
        "target": format_target(target),
        "target_description": describe_target(target),
        "width_px": fit.camera.width_px,
        "height_px": fit.camera.height_px,
        "parameters": dict(zip(names, fit.camera.parameters.tolist(), strict=True)),
        "sigmas": dict(zip(names, fit.sigma.tolist(), strict=True)),
        "free_parameters": list(fit.free_parameters),
        "rms_px": fit.rms_px,
        "hold_out_rms_px": None if held_out is None else held_out.rms_px,
        "sigma_point_px": fit.sigma_point_px,
        "n_views": fit.n_views,
        "n_points": fit.n_points,
        "covered_fraction": fit.coverage.fraction,
        "views": [
            {
                "source": view.source,
                "n_points": len(view.view),
                "rms_px": view.rms_px,
                "tilt_deg": view.tilt_deg,
                "distance_mm": view.distance_mm,
                "is_used": view.is_used,
                "note": view.note,
            }
            for view in fit.views
        ],
        "not_found": [{"source": source, "reason": reason} for source, reason in run.not_found],
    }
