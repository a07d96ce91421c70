# SPDX-License-Identifier: Apache-2.0
"""From photographs of a target to a camera document, its observations and its page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from armscan.calibration.cameras.result import CameraOptions, reasons_to_refuse
from armscan.errors import OptionError
from armscan.geometry.estimate import FitFailure
from armscan.jobs.job import (
    OutputFiles,
    calibration_outputs,
    refuse,
    refused_for,
    refused_page,
    tried_targets,
)
from armscan.models.calibration import Provenance
from armscan.pipeline.cameras import CameraRun, calibrate_camera_from_found
from armscan.pipeline.documents import camera_calibration
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.targets import find_targets
from armscan.records.exposure import Exposure
from armscan.report.camera import TITLE, camera_page, parameter_rows
from armscan.report.page import Page, render_page
from armscan.report.quantity import Summary, Table, sentence, significant, without_source
from armscan.storage.detection_cache import DetectionCache
from armscan.storage.documents import camera_document, new_provenance
from armscan.storage.files import write_files
from armscan.storage.image_paths import are_simulated, expand_paths, named_by
from armscan.storage.images import ImageOptions, check_same_size, read_exposures
from armscan.storage.observations import pack_observations
from armscan.storage.recording import read_recording
from armscan.storage.recording_session import EXPOSURES_FILE, SESSION_FILE
from armscan.vision.targets.target import Target, describe_target, format_target, parse_target


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
    scan
        Folder recording of the target, instead of images.
    is_forced
        Write a camera that makes no sense, marked as such.
    is_caching
        Keep the targets found beside the document, and take those kept there.
    command
        The command line, for the record.
    """

    images: tuple[str, ...]
    target: str
    output: Path
    options: CameraOptions = field(default_factory=CameraOptions)
    image_options: ImageOptions = field(default_factory=ImageOptions)
    is_overwriting: bool = False
    scan: Path | None = None
    is_forced: bool = False
    is_caching: bool = False
    command: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Images:
    """What was read: exposures with their files, other files that went in, and what is odd."""

    exposures: tuple[Exposure, ...]
    paths: tuple[Path, ...]
    is_simulated: bool
    tables: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def by_source(self) -> dict[str, Exposure]:
        """Exposures by their names."""
        return {exposure.source: exposure for exposure in self.exposures}


def run_camera_calibration(request: CameraRequest, progress: Progress = silent) -> Summary:
    """Read, calibrate, write ``camera.json``, ``.npz`` and ``.html``, and say what came out.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, or the images do not determine the camera;
        no document is written then. Where it is the images, a page shows them.
    """
    target = parse_target(request.target)
    files = calibration_outputs(request.output, is_overwriting=request.is_overwriting)
    images = _read_images(request)
    check_same_size(images.exposures)
    sources = [exposure.source for exposure in images.exposures]
    left_out = named_by(request.options.leave_out, sources, "--leave-out")
    options = replace(request.options, leave_out=left_out)
    cache = DetectionCache.beside(request.output) if request.is_caching else None
    found = find_targets(images.exposures, target, cache=cache, progress=progress)
    run = calibrate_camera_from_found(found, options, progress=progress)
    fit = None if isinstance(run, FitFailure) else run.fit
    nonsense = () if fit is None else reasons_to_refuse(fit)
    provenance = new_provenance(
        (*images.paths, *images.tables),
        command=request.command,
        options=(target, options if fit is None else fit.options, request.image_options),
        warnings=(*images.warnings, *(() if fit is None else fit.warnings)),
        forced=nonsense,
    )
    if isinstance(run, FitFailure):
        tried = tried_targets(found.views, found.not_found, sources)
        page = refused_page(
            TITLE, tried, images.by_source, provenance, is_simulated=images.is_simulated
        )
        refuse(files, page, run)
    page = camera_page(
        run.fit, run.not_found, images.by_source, provenance, is_simulated=images.is_simulated
    )
    if nonsense and not request.is_forced:
        refuse(files, replace(page, forced=()), refused_for(nonsense))
    _write(files, run, images, (page, provenance), is_overwriting=request.is_overwriting)
    return camera_summary(
        run,
        target,
        (files.document, files.observations, files.page),
        images.warnings,
        nonsense,
        is_simulated=images.is_simulated,
    )


def _read_images(request: CameraRequest) -> _Images:
    if request.scan is None:
        if not request.images:
            raise OptionError("no images are given", remedy="name images, or give --scan FOLDER")
        paths = expand_paths(request.images)
        exposures = read_exposures(paths, request.image_options)
        return _Images(exposures, paths, are_simulated(paths))
    if request.images:
        raise OptionError(
            "a recording and images are given", remedy="give --scan FOLDER, or images"
        )
    request.image_options.check_unused()
    return _read_scan(request.scan)


def _read_scan(folder: Path) -> _Images:
    """The images without laser of a recording of one camera; all images where none is without."""
    recording = read_recording(folder)
    cameras = sorted({row.camera for row in recording.rows})
    if len(cameras) > 1:
        raise OptionError(
            f"the recording is of {len(cameras)} cameras",
            where=f"--scan {folder}",
            remedy="calibrate them together with `armscan calibrate stereo --scan`",
        )
    dark = [k for k, row in enumerate(recording.rows) if not row.lasers]
    chosen = dark or list(range(len(recording.rows)))
    tables = (folder / EXPOSURES_FILE, folder / SESSION_FILE)
    return _Images(
        tuple(recording.exposure(k) for k in chosen),
        tuple(folder / recording.rows[k].source for k in chosen),
        recording.is_simulated,
        tuple(path for path in tables if path.is_file()),
        (*recording.warnings, *recording.session.assumed),
    )


def _write(
    files: OutputFiles,
    run: CameraRun,
    images: _Images,
    report: tuple[Page, Provenance],
    *,
    is_overwriting: bool,
) -> None:
    page, provenance = report
    hashes = {
        exposure.source: item.sha256
        for exposure, item in zip(images.exposures, provenance.inputs, strict=False)
    }
    observations = pack_observations([view.view for view in run.fit.views], (), hashes)
    document = camera_document(
        camera_calibration(run.fit, provenance), (files.observations.name, observations)
    )
    write_files(
        {files.document: document, files.observations: observations, files.page: render_page(page)},
        is_overwriting=is_overwriting,
    )
    files.refused_page.unlink(missing_ok=True)


def camera_summary(
    run: CameraRun,
    target: Target,
    written: Sequence[Path],
    notes: Sequence[str] = (),
    forced: Sequence[str] = (),
    *,
    is_simulated: bool,
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
        warnings=tuple(sentence(warning) for warning in (*notes, *fit.warnings)),
        forced=tuple(forced),
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
