# SPDX-License-Identifier: Apache-2.0
"""From photographs of a laser on a target to the document of camera and light sheets, its
observations and its page.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any

from armscan.calibration.sheets.result import (
    LaserFit,
    PointUse,
    SheetFit,
    SkippedImage,
    reasons_to_refuse,
)
from armscan.errors import InputError, OptionError
from armscan.geometry.estimate import FitFailure
from armscan.jobs.job import TriedImage, calibration_outputs, refuse, refused_for, refused_page
from armscan.models.calibration import CameraCalibration, Provenance
from armscan.models.light_sheet import PLANE_PARAMETER_NAMES
from armscan.models.two_views import StereoCalibration
from armscan.pipeline.instants import ExposurePair, pair_by_view, pair_exposures
from armscan.pipeline.laser import (
    LaserOptions,
    SeenPair,
    calibrate_sheets_from_pairs,
    look_at_pairs,
)
from armscan.pipeline.progress import Progress, silent
from armscan.records.exposure import Exposure
from armscan.report.page import Page, render_page
from armscan.report.quantity import Summary, Table, sentence, without_source
from armscan.report.sheets import TITLE, laser_page, sheet_facts
from armscan.storage.arm import ARM_FILE
from armscan.storage.detection_cache import DetectionCache
from armscan.storage.documents import (
    STEREO_SCHEMA,
    document_schema,
    new_provenance,
    read_camera_calibration,
    read_stereo_calibration,
    sensor_document,
)
from armscan.storage.files import write_files
from armscan.storage.image_paths import are_simulated, expand_paths, named_by
from armscan.storage.images import ImageOptions, read_exposures
from armscan.storage.observations import pack_board_stripes
from armscan.storage.recording import read_recording
from armscan.storage.recording_session import EXPOSURES_FILE, SESSION_FILE
from armscan.vision.targets.target import Target, parse_target

REQUESTED = "left out by request"
COUNTS = ("columns", "rows")
SIZES = ("square_mm", "pitch_mm")
SCAN_TABLES = (EXPOSURES_FILE, ARM_FILE, SESSION_FILE)


@dataclass(frozen=True, slots=True)
class LaserRequest:
    """What to calibrate light sheets from, and where to write.

    Parameters
    ----------
    camera
        The camera's calibration: ``camera.json``, or one that OpenCV or ROS wrote; or
        ``stereo.json`` of a head with two cameras.
    on
        Images with the laser on the board: files, folders or patterns; empty if a recording is
        given.
    off
        The same placements without laser, one for each, or none.
    scan
        Folder recording of the board, instead of images: its columns ``lasers`` and ``view`` say
        what belongs together.
    target
        Specification of the board's target.
    output
        The document ``NAME.json``; ``NAME.npz`` and ``NAME.html`` are written beside it.
    options
        Of target, stripes and sheets.
    image_options
        How pixels are read.
    leave_out
        Images, or views of a recording, that are not used: names or patterns.
    is_overwriting
        Replace results that exist.
    is_caching
        Keep the points found beside the document, and take those kept there.
    is_forced
        Write sheets that make no sense, marked.
    command
        The command line, for the record.
    """

    camera: Path
    on: tuple[str, ...]
    off: tuple[str, ...]
    target: str
    output: Path
    options: LaserOptions = field(default_factory=LaserOptions)
    image_options: ImageOptions = field(default_factory=ImageOptions)
    scan: Path | None = None
    leave_out: tuple[str, ...] = ()
    is_overwriting: bool = False
    is_caching: bool = False
    is_forced: bool = False
    command: tuple[str, ...] = ()


def run_laser_calibration(request: LaserRequest, progress: Progress = silent) -> Summary:
    """Read, calibrate, write ``sensor.json``, ``.npz`` and ``.html``, and say what came out.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, or the images do not determine the sheets;
        no document is written then. Where it is the images, a page shows them.
    """
    target = parse_target(request.target)
    files = calibration_outputs(request.output, is_overwriting=request.is_overwriting)
    camera = read_cameras(request.camera)
    images = _read_images(request, is_stereo=isinstance(camera, StereoCalibration))
    exposures = images.exposures
    cache = DetectionCache.beside(request.output) if request.is_caching else None
    fit = calibrate_sheets_from_pairs(
        images.pairs, target, camera, options=request.options, cache=cache, progress=progress
    )
    if cache is not None:
        cache.trim()
    if isinstance(fit, FitFailure):
        refuse(files, _refused(request, images, camera.provenance, progress), fit)
    fit = replace(fit, skipped=(*images.left_out, *fit.skipped))
    fit = replace(fit, warnings=(*fit.warnings, *_other_size(target, camera.provenance)))
    nonsense = reasons_to_refuse(fit)
    options = request.options
    provenance = new_provenance(
        (*images.paths, *images.tables, request.camera),
        command=request.command,
        options=(target, options.stripes, fit.options, request.image_options),
        parents=(camera.provenance,),
        warnings=(*images.warnings, *all_warnings(fit)),
        forced=nonsense,
    )
    is_simulated = are_simulated(images.paths)
    by_source = {exposure.source: exposure for exposure in exposures}
    page = laser_page(fit, by_source, provenance, is_simulated=is_simulated)
    if nonsense and not request.is_forced:
        refuse(files, replace(page, forced=()), refused_for(nonsense))
    hashes = {
        exposure.source: item.sha256
        for exposure, item in zip(exposures, provenance.inputs[: len(exposures)], strict=True)
    }
    observations = pack_board_stripes(fit, hashes)
    document = sensor_document(
        fit.to_calibration(provenance), (files.observations.name, observations)
    )
    write_files(
        {files.document: document, files.observations: observations, files.page: render_page(page)},
        is_overwriting=request.is_overwriting,
    )
    files.refused_page.unlink(missing_ok=True)
    written = (files.document, files.observations, files.page)
    summary = laser_summary(fit, written, is_simulated=is_simulated)
    notes = tuple(sentence(warning) for warning in images.warnings)
    warnings = (*notes, *summary.warnings)
    return replace(summary, warnings=warnings, forced=provenance.forced)


def _refused(
    request: LaserRequest, images: _Images, parent: Provenance, progress: Progress
) -> Page:
    """The page of images that determine no sheet: what each of them shows by itself."""
    target, options = parse_target(request.target), request.options
    cache = DetectionCache.beside(request.output) if request.is_caching else None
    seen = look_at_pairs(images.pairs, target, options, cache=cache, progress=progress)
    provenance = new_provenance(
        (*images.paths, *images.tables, request.camera),
        command=request.command,
        options=(target, options.stripes, options.sheets, request.image_options),
        parents=(parent,),
        warnings=images.warnings,
    )
    left_out = tuple(TriedImage(item.source, item.reason, False) for item in images.left_out)
    return refused_page(
        TITLE,
        (*left_out, *(_tried(pair) for pair in seen)),
        {exposure.source: exposure for exposure in images.exposures},
        provenance,
        is_simulated=are_simulated(images.paths),
    )


def _other_size(target: Target, parent: Provenance) -> tuple[str, ...]:
    """Warn of a board of the camera's kind and count that is of another size."""
    kind = type(target).__name__
    known = dict(parent.options)
    same = all(known.get(f"{kind}.{name}") == str(getattr(target, name)) for name in COUNTS)
    name = next((name for name in SIZES if hasattr(target, name)), "")
    size = known.get(f"{kind}.{name}")
    if not same or size is None or float(size) == target.size_mm:
        return ()
    return (
        f"the camera was calibrated with a board of {float(size):g} mm from point to point, this "
        f"one is said to have {target.size_mm:g} mm: is it the same board?",
    )


def _tried(pair: SeenPair) -> TriedImage:
    n_points = int(pair.profile.is_accepted.sum())
    stripe = f"{n_points} clean stripe points" if n_points else "no stripe was found"
    if isinstance(pair.board, FitFailure):
        board, points = without_source(pair.board_source, pair.board.reason), None
    else:
        board, points = "board found", pair.board.points_px
        if pair.board_source != pair.source:
            board += f" in {pair.board_source}"
    is_used = points is not None and n_points > 0
    accepted = pair.profile.points_px[pair.profile.is_accepted]
    return TriedImage(pair.source, f"{board}; {stripe}", is_used, points, accepted)


@dataclass(frozen=True, slots=True, eq=False)
class _Images:
    """What was read.

    Parameters
    ----------
    exposures, paths
        All images.
    pairs
        Each image with a laser on and its partner.
    tables
        Other files that went in.
    warnings
        What is odd about a recording.
    left_out
        Images with a laser on that take no part by request.
    """

    exposures: tuple[Exposure, ...]
    paths: tuple[Path, ...]
    pairs: list[ExposurePair]
    tables: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()
    left_out: tuple[SkippedImage, ...] = ()


def read_cameras(path: Path) -> CameraCalibration | StereoCalibration:
    """Read the calibration of one camera, or of the two of a stereo head.

    Raises
    ------
    FileFormatError
        If the file is damaged or is neither.
    """
    if document_schema(path) == STEREO_SCHEMA:
        return read_stereo_calibration(path)
    return read_camera_calibration(path)


def _read_images(request: LaserRequest, *, is_stereo: bool) -> _Images:
    if request.scan is not None and (request.on or request.off):
        raise OptionError(
            "a recording and images are given", remedy="give --scan, or --on with --off"
        )
    if request.scan is not None:
        request.image_options.check_unused()
        return _read_scan(request.scan, request.leave_out, is_stereo=is_stereo)
    if is_stereo:
        raise OptionError(
            "images of a head with two cameras come as a recording, which says which camera took "
            "which and what belongs together",
            remedy="give --scan FOLDER",
        )
    on = expand_paths(request.on)
    off = expand_paths(request.off) if request.off else ()
    exposures = read_exposures((*on, *off), request.image_options)
    lit, dark = exposures[: len(on)], exposures[len(on) :]
    named = named_by(request.leave_out, [one.source for one in exposures], "--leave-out")
    gone = _with_partners(lit, dark, set(named))
    pairs = pair_exposures(
        [one for one in lit if one.source not in gone],
        [one for one in dark if one.source not in gone],
    )
    return _Images(exposures, (*on, *off), pairs, left_out=_skipped(lit, gone))


def _with_partners(lit: Sequence[Exposure], dark: Sequence[Exposure], named: set[str]) -> set[str]:
    """Images to leave out, each with the other of its pair: of its name, else of its place."""
    names = {PurePath(one.source).name: one.source for one in dark}
    if len(names) == len(dark) and set(names) == {PurePath(one.source).name for one in lit}:
        partners = [(one.source, names[PurePath(one.source).name]) for one in lit]
    else:
        partners = [(on.source, off.source) for on, off in zip(lit, dark, strict=False)]
    return named.union(*({on, off} for on, off in partners if {on, off} & named))


def _skipped(lit: Sequence[Exposure], gone: set[str]) -> tuple[SkippedImage, ...]:
    return tuple(SkippedImage(one.source, REQUESTED) for one in lit if one.source in gone)


def _read_scan(folder: Path, leave_out: Sequence[str], *, is_stereo: bool) -> _Images:
    recording = read_recording(folder)
    rows = [k for k, row in enumerate(recording.rows) if row.camera == 0 or is_stereo]
    if not rows:
        numbers = sorted({row.camera for row in recording.rows})
        raise InputError(
            f"camera 0 has no rows, camera {' and '.join(map(str, numbers))} has all",
            where=str(folder),
            remedy="number a single camera 0 in the column 'camera' of exposures.csv",
        )
    exposures = tuple(recording.exposure(k) for k in rows)
    views = {one.view: None for one in exposures if one.view is not None}
    names = [*(one.source for one in exposures), *views]
    named = set(named_by(leave_out, names, "--leave-out"))
    # without its image without laser a view is no pair any more
    named |= {one.view for one in exposures if one.view and not one.lasers and one.source in named}
    gone = {one.source for one in exposures if one.view in named or one.source in named}
    return _Images(
        exposures,
        tuple(folder / recording.rows[k].source for k in rows),
        pair_by_view([one for one in exposures if one.source not in gone]),
        tuple(folder / name for name in SCAN_TABLES if (folder / name).is_file()),
        (*recording.warnings, *recording.session.assumed),
        _skipped([one for one in exposures if one.lasers], gone),
    )


def all_warnings(fit: LaserFit) -> tuple[str, ...]:
    """Warnings of the whole and of each sheet."""
    own = [f"sheet {sheet.name}: {text}" for sheet in fit.sheets for text in sheet.warnings]
    return (*fit.warnings, *own)


def laser_summary(fit: LaserFit, written: Sequence[Path], *, is_simulated: bool) -> Summary:
    """What a person, and a program, wants to know of a calibration of light sheets."""
    facts = []
    for sheet in fit.sheets:
        facts.append((f"sheet {sheet.name}", ""))
        facts += [(f"  {label}", value) for label, value in sheet_facts(sheet)]
    skipped = Table(
        ("image", "why"),
        tuple((item.source, item.reason) for item in fit.skipped),
        "Images that gave nothing",
        (1,),
    )
    if fit.channel_reason:
        facts.insert(0, ("stripes in", sentence(fit.channel_reason)))
    names = ", ".join(fit.sheet_names)
    return Summary(
        title=f"Light sheets calibrated{' from simulated images' if is_simulated else ''}: {names}",
        facts=tuple(facts),
        tables=(skipped,) if skipped.rows else (),
        warnings=tuple(sentence(warning) for warning in all_warnings(fit)),
        written=tuple(written),
        next_step=f"open {written[-1]}, then `armscan reconstruct IMAGES --sensor {written[0]}`",
        data={
            "kind": "light sheet calibration",
            "simulated": is_simulated,
            "sheets": [_sheet_data(sheet) for sheet in fit.sheets],
            "naming": fit.diagnostics.naming,
            "cameras": 1 if fit.second is None else 2,
            "unnamed_points": sum(image.count(PointUse.UNNAMED) for image in fit.images),
            "noise_factor": fit.diagnostics.noise_factor,
            "laser_colour": fit.laser_colour,
            "channel_reason": fit.channel_reason,
            "skipped": [{"source": item.source, "reason": item.reason} for item in fit.skipped],
        },
    )


def _sheet_data(fit: SheetFit) -> dict[str, Any]:
    low, high = fit.calibration.depth_range_mm
    return {
        "name": fit.name,
        "plane_sensor_a_b_c_d_mm": fit.sheet.plane.tolist(),
        "bow_mm": fit.sheet.bow_mm.tolist(),
        "plane_sigma_mm": dict(
            zip(PLANE_PARAMETER_NAMES, (fit.covariance.diagonal()[:3] ** 0.5).tolist(), strict=True)
        ),
        "tilt_sigma_deg": fit.tilt_sigma_deg,
        "offset_sigma_mm": fit.offset_sigma_mm,
        "rms_mm": fit.calibration.rms_mm,
        "rms_px": fit.diagnostics.rms_px,
        "n_boards": fit.calibration.n_boards,
        "n_points": fit.calibration.n_points,
        "depth_min_mm": low,
        "depth_max_mm": high,
        "is_redundant": fit.calibration.is_redundant,
        "lack_of_fit_p": fit.diagnostics.final_test.p_value,
        "points_off_boards": {
            **asdict(fit.points.fitted),
            "left_out_rms_mm": _known(fit.points.left_out_rms_mm),
            "left_out_claimed_mm": _known(fit.points.left_out_claimed_mm),
            "boards": [asdict(board) for board in fit.points.boards],
        },
    }


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
