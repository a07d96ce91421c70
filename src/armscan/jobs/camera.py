# SPDX-License-Identifier: Apache-2.0
"""From photographs of a flat target to a camera document, its observations and its page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from armscan.calibration.cameras.calibrate import calibrate_camera as solve_camera
from armscan.calibration.cameras.result import CameraOptions, reasons_to_refuse
from armscan.errors import FileFormatError, OptionError
from armscan.geometry.estimate import FitFailure
from armscan.jobs.job import Job, solved, was_simulated
from armscan.models.camera import PARAMETER_NAMES
from armscan.pipeline.cameras import (
    CameraRun,
    calibrate_camera_from_found,
    calibrate_camera_from_views,
    camera_calibration,
    numbered_alike,
)
from armscan.pipeline.targets import find_targets
from armscan.records.exposure import Exposure
from armscan.report.camera import CAMERA_TITLE, camera_page, camera_quantities
from armscan.report.photographs import refused_page, tried_targets
from armscan.report.quantity import Quantity, Summary, Table, sentences, significant, without_source
from armscan.storage.documents import (
    camera_document,
    observations_of,
    read_camera_calibration,
    recorded_options,
)
from armscan.storage.image_paths import are_simulated, expand_paths, named_by
from armscan.storage.images import ImageOptions, of_one_size, read_exposures
from armscan.storage.observations import pack_observations, read_observations
from armscan.storage.recording import camera_tables, read_recording
from armscan.thesis.ellipse import with_printed_centres
from armscan.vision.targets.detect import settle_target
from armscan.vision.targets.target import (
    AprilGrid,
    Charuco,
    Chessboard,
    CircleGrid,
    Target,
    describe_target,
    format_target,
    parse_target,
)

ODD_SIZE = "left out by request: it has another size"


@dataclass(frozen=True, slots=True, eq=False)
class _Images:
    """Images of one camera with their files, other files that went in, and what is odd."""

    exposures: tuple[Exposure, ...]
    paths: tuple[Path, ...]
    is_simulated: bool
    tables: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()


def calibrate_camera(
    job: Job,
    target: str,
    images: Sequence[str] = (),
    *,
    scan: Path | None = None,
    options: CameraOptions | None = None,
    image_options: ImageOptions | None = None,
    is_beside_thesis: bool = False,
) -> Summary:
    """Read, calibrate, write ``camera.json``, ``.npz`` and ``.html``, and say what came out.

    ``is_beside_thesis``: tell what the printed way to find circle centres gives of the same images.
    """
    options, image_options = options or CameraOptions(), image_options or ImageOptions()
    plate = parse_target(target)
    if is_beside_thesis and not isinstance(plate, CircleGrid):
        raise OptionError(
            "the printed centres are those of circles",
            where="--method thesis",
            remedy="take a circle grid, or leave it out",
        )
    places = job.places(".json", beside=(".npz", ".html"))
    read = _camera_images(images, scan, image_options)
    sources = [exposure.source for exposure in read.exposures]
    options = replace(options, leave_out=named_by(options.leave_out, sources))
    exposures = of_one_size(read.exposures, options.leave_out)
    seen = {exposure.source for exposure in exposures}
    options = replace(options, leave_out=tuple(one for one in options.leave_out if one in seen))
    plate = settle_target(exposures, plate)
    found = find_targets(exposures, plate, cache=job.cache, progress=job.progress)
    gone = tuple((source, ODD_SIZE) for source in sources if source not in seen)
    found = replace(found, not_found=(*found.not_found, *gone))
    run = calibrate_camera_from_found(found, plate, options, progress=job.progress)
    inputs = (*read.paths, *read.tables)
    by_source = dict(zip(sources, read.exposures, strict=True))
    if isinstance(run, FitFailure):
        used = (plate, options, image_options)
        provenance = job.provenance(inputs, used, warnings=read.warnings)
        tried = tried_targets(found.views, found.not_found, sources)
        page = refused_page(
            CAMERA_TITLE, tried, by_source, provenance, warnings=read.warnings,
            is_simulated=read.is_simulated,
        )  # fmt: skip
        job.refuse(page, run)
    fit = replace(run.fit, warnings=(*read.warnings, *run.fit.warnings))
    run, nonsense = replace(run, fit=fit), reasons_to_refuse(fit)
    provenance = job.provenance(
        inputs,
        (plate, fit.options, image_options),
        warnings=fit.warnings,
        forced=nonsense,
        is_simulated=read.is_simulated,
    )
    page = camera_page(fit, run.not_found, by_source, provenance, is_simulated=read.is_simulated)
    job.refuse_nonsense(page, nonsense)
    hashes = {source: item.sha256 for source, item in zip(sources, provenance.inputs, strict=False)}
    observations = pack_observations([view.view for view in fit.views], (), hashes)
    calibration = camera_calibration(fit, provenance)
    document = camera_document(calibration, (places[1].name, observations))
    written = job.write(dict(zip(places, (document, observations, page), strict=True)))
    summary = _camera_summary(run, plate, read, written)
    if is_beside_thesis:
        views = [with_printed_centres(view, by_source[view.source]) for view in found.views]
        table, data = _beside_thesis(calibrate_camera_from_views(views, options), run)
        extra = {**summary.extra, "thesis": data}
        summary = replace(summary, tables=(*summary.tables, table), extra=extra)
    return replace(summary, forced=nonsense)


def _beside_thesis(
    printed: CameraRun | FitFailure, ours: CameraRun
) -> tuple[Table, dict[str, object]]:
    """The camera from the printed circle centres beside ours, for people and for programs."""
    columns = ("As the thesis prints it (eqs. 2.22 to 2.27)", "", "ours")
    if isinstance(printed, FitFailure):
        return Table(columns, (("not found", printed.reason, ""),)), {"failure": printed.reason}
    rows = [("rms, px", significant(printed.fit.rms_px), significant(ours.fit.rms_px))]
    values = zip(
        PARAMETER_NAMES, printed.fit.camera.parameters, ours.fit.camera.parameters, strict=True
    )
    rows += [(name, f"{there:.6g}", f"{here:.6g}") for name, there, here in values]
    return Table(columns, tuple(rows), "", (1, 2)), {
        "rms_px": printed.fit.rms_px,
        "parameters": printed.fit.camera.parameters.tolist(),
    }


def calibrate_camera_from_file(
    job: Job, camera_file: Path, changes: Mapping[str, Any] | None = None
) -> Summary:
    """Solve the camera of a document again from the observations beside it, and write it anew.

    ``changes``: fields of `CameraOptions` that are not to be as the document records them.
    """
    places = job.places(".json", beside=(".npz", ".html"))
    observations_file = observations_of(camera_file)
    before, found = read_camera_calibration(camera_file), read_observations(observations_file)
    sources = [view.source for view in found.views]
    changed = recorded_options(before.provenance, CameraOptions)
    # a view that was left out and has no pose is not among the observations
    changed["leave_out"] = tuple(one for one in changed.get("leave_out", ()) if one in sources)
    changed.update(changes or {})
    changed["leave_out"] = named_by(changed["leave_out"], sources)
    options = CameraOptions(**changed)
    kinds: tuple[type[Target], ...] = (Chessboard, Charuco, CircleGrid, AprilGrid)
    recorded = {kind: recorded_options(before.provenance, kind) for kind in kinds}
    targets = [kind(**values) for kind, values in recorded.items() if values]
    if not targets:
        raise FileFormatError(
            "the document does not say of which target its views are",
            where=str(camera_file),
            remedy="calibrate again from the images",
        )
    target = targets[0]
    solution = solved(solve_camera(found.views, options), camera_file)
    fit = numbered_alike(found.views, solution, target)
    nonsense = reasons_to_refuse(fit)
    is_simulated = was_simulated(before.provenance, camera_file)
    provenance = job.provenance(
        (camera_file, observations_file),
        (target, fit.options),
        is_simulated=is_simulated,
        parents=(before.provenance,),
        warnings=fit.warnings,
        forced=nonsense,
    )
    inputs = tuple(Path(item.path) for item in before.provenance.inputs)
    read = _Images((), inputs, is_simulated)
    page = camera_page(fit, (), {}, provenance, is_simulated=read.is_simulated)
    job.refuse_nonsense(page, nonsense)
    observations = pack_observations([view.view for view in fit.views], (), found.sha256)
    document = camera_document(camera_calibration(fit, provenance), (places[1].name, observations))
    written = job.write(dict(zip(places, (document, observations, page), strict=True)))
    summary = _camera_summary(CameraRun(fit, (), 0), target, read, written)
    return replace(summary, forced=nonsense)


def _camera_images(
    images: Sequence[str], scan: Path | None, image_options: ImageOptions
) -> _Images:
    if scan is None:
        if not images:
            raise OptionError("no images are given", remedy="name images, or give --scan FOLDER")
        paths = expand_paths(images)
        return _Images(read_exposures(paths, image_options), paths, are_simulated(paths))
    if images:
        raise OptionError(
            "a recording and images are given", remedy="give --scan FOLDER, or images"
        )
    image_options.check_unused()
    return _camera_scan(scan)


def _camera_scan(folder: Path) -> _Images:
    """The images without laser of a recording of one camera; all images where none is without."""
    recording = read_recording(folder)
    cameras = sorted({row.camera for row in recording.rows})
    if len(cameras) > 1:
        raise OptionError(
            f"the recording is of {len(cameras)} cameras",
            where=f"--scan {folder}",
            remedy="calibrate them together with `armscan calibrate stereo --scan`",
        )
    dark = [k for k, row in enumerate(recording.rows) if row.is_dark]
    chosen = dark or list(range(len(recording.rows)))
    return _Images(
        tuple(recording.exposure(k) for k in chosen),
        tuple(folder / recording.rows[k].source for k in chosen),
        recording.is_simulated,
        camera_tables(folder),
        (*recording.warnings, *recording.session.assumed),
    )


def _camera_summary(
    run: CameraRun, target: Target, read: _Images, written: Sequence[Path]
) -> Summary:
    fit = run.fit
    noted = [view for view in fit.views if view.note]
    rows = [(v.source, significant(v.rms_px), f"{v.tilt_deg:.0f}°", v.note) for v in noted]
    rows += [(source, "", "", without_source(source, why)) for source, why in run.not_found]
    table = Table(("image", "rms px", "tilt", "remark"), tuple(rows), "Images to look at", (3,))
    return Summary(
        title="Camera calibrated" + (" from simulated images." if read.is_simulated else "."),
        quantities=(
            Quantity("target_description", "Target", describe_target(target)),
            *camera_quantities(fit, len(fit.views) + len(run.not_found)),
        ),
        tables=(table,) if rows else (),
        warnings=sentences(fit.warnings),
        written=tuple(written),
        next_step=f"open {written[-1]}, then `armscan calibrate laser --camera {written[0]} -h`; "
        f"on an arm without a laser `armscan calibrate hand-eye-target --camera {written[0]} -h`",
        extra={
            "kind": "camera calibration",
            "simulated": read.is_simulated,
            "target": format_target(target),
            "width_px": fit.camera.width_px,
            "height_px": fit.camera.height_px,
            "sigmas": {
                name.removesuffix("_px"): float(sigma)
                for name, sigma in zip(PARAMETER_NAMES, fit.sigma, strict=True)
            },
            "free_parameters": list(fit.free_parameters),
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
        },
    )
