# SPDX-License-Identifier: Apache-2.0
"""From stripe images on a board to a sensor's document, its observations and its page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

from armscan.calibration.sheets.result import (
    LaserFit,
    PointUse,
    SheetOptions,
    SkippedImage,
    reasons_to_refuse,
)
from armscan.errors import InputError, OptionError
from armscan.geometry.estimate import FitFailure
from armscan.jobs.job import Job, solved, was_simulated, with_old_layout
from armscan.models.calibration import Provenance
from armscan.pipeline.instants import ExposurePair, pair_by_view, pair_exposures
from armscan.pipeline.laser import (
    LaserOptions,
    SeenPair,
    calibrate_sheets_again,
    calibrate_sheets_from_pairs,
    look_at_pairs,
)
from armscan.records.exposure import Exposure
from armscan.records.recording import LASER_UNKNOWN
from armscan.report.camera import bow_quantities
from armscan.report.photographs import TriedImage, refused_page
from armscan.report.quantity import (
    Quantity,
    Summary,
    Table,
    fact,
    for_people,
    sentence,
    sentences,
    values,
    without_source,
)
from armscan.report.sheets import TITLE, laser_page, sheet_quantities, sheet_warnings
from armscan.storage.documents import (
    STEREO_SCHEMA,
    document_schema,
    observations_of,
    read_camera_calibration,
    read_sensor_calibration,
    read_stereo_calibration,
    recorded_options,
    sensor_document,
)
from armscan.storage.image_paths import are_simulated, expand_paths, named_by
from armscan.storage.images import ImageOptions, read_exposures
from armscan.storage.observations import pack_board_stripes, read_observations
from armscan.storage.recording import read_recording, recording_tables
from armscan.vision.targets.detect import settle_target
from armscan.vision.targets.target import Target, parse_target

REQUESTED = "left out by request"
STRIPES = "StripeOptions."
"""Entries of a document's record that say how stripes were found."""
COUNTS = ("columns", "rows")
SIZES = ("square_mm", "pitch_mm")


@dataclass(frozen=True, slots=True)
class SheetImages:
    """Where the images of light sheets on a board are.

    Parameters
    ----------
    on
        Images with the laser on the board: files, folders or patterns; empty if a recording is
        given.
    off
        The same placements without laser, one for each, or none.
    scan
        Folder recording of the board, instead of images: its columns ``lasers`` and ``view`` say
        what belongs together.
    leave_out
        Images, or views of a recording, that are not used: names or patterns.
    """

    on: tuple[str, ...] = ()
    off: tuple[str, ...] = ()
    scan: Path | None = None
    leave_out: tuple[str, ...] = ()


def calibrate_sheets(
    job: Job,
    camera_file: Path,
    target: str,
    images: SheetImages,
    *,
    options: LaserOptions | None = None,
    image_options: ImageOptions | None = None,
) -> Summary:
    """Read, calibrate, write ``sensor.json``, ``.npz`` and ``.html``, and say what came out.

    ``camera_file``: the camera's calibration: ``camera.json``, or one that OpenCV or ROS wrote; or
    ``stereo.json`` of a head with two cameras.
    """
    options, image_options = options or LaserOptions(), image_options or ImageOptions()
    board = parse_target(target)
    places = job.places(".json", beside=(".npz", ".html"))
    is_stereo = document_schema(camera_file) == STEREO_SCHEMA
    camera = (read_stereo_calibration if is_stereo else read_camera_calibration)(camera_file)
    read = _read(images, image_options, is_stereo=is_stereo)
    cache = job.cache
    board = settle_target(read.exposures, board)
    fit = calibrate_sheets_from_pairs(
        read.pairs, board, camera, options=options, cache=cache, progress=job.progress
    )
    if cache is not None:
        cache.trim()
    is_simulated = are_simulated(read.paths)
    by_source = {exposure.source: exposure for exposure in read.exposures}
    inputs = (*read.paths, *read.tables, camera_file)
    if isinstance(fit, FitFailure):
        seen = look_at_pairs(read.pairs, board, options, cache=job.cache, progress=job.progress)
        used = (board, options.stripes, options.sheets, image_options)
        provenance = job.provenance(
            inputs, used, parents=(camera.provenance,), warnings=read.warnings
        )
        tried = [TriedImage(item.source, item.reason, False) for item in read.left_out]
        tried += [_tried(pair) for pair in seen]
        page = refused_page(
            TITLE, tried, by_source, provenance, warnings=read.warnings, is_simulated=is_simulated
        )
        job.refuse(page, fit)
    other_size = _other_size(board, camera.provenance)
    fit = replace(
        fit,
        skipped=(*read.left_out, *fit.skipped),
        warnings=(*read.warnings, *fit.warnings, *other_size),
    )
    nonsense = reasons_to_refuse(fit)
    provenance = job.provenance(
        inputs,
        (board, options.stripes, fit.options, image_options),
        parents=(camera.provenance,),
        warnings=sheet_warnings(fit),
        forced=nonsense,
        is_simulated=is_simulated,
    )
    page = laser_page(fit, by_source, provenance, is_simulated=is_simulated)
    job.refuse_nonsense(page, nonsense)
    hashes = {
        source: item.sha256 for source, item in zip(by_source, provenance.inputs, strict=False)
    }
    observations = pack_board_stripes(fit, hashes)
    document = sensor_document(fit.to_calibration(provenance), (places[1].name, observations))
    written = job.write(dict(zip(places, (document, observations, page), strict=True)))
    summary = sheets_summary(fit, written, is_simulated=is_simulated)
    return replace(with_old_layout(summary, board), forced=provenance.forced)


def calibrate_sheets_from_file(
    job: Job, sensor_file: Path, changes: Mapping[str, Any] | None = None
) -> Summary:
    """Solve the sheets of a document again from the observations beside it, and write them anew.

    ``changes``: fields of `SheetOptions` that are not to be as the document records them.
    """
    places = job.places(".json", beside=(".npz", ".html"))
    sensor, observations_file = read_sensor_calibration(sensor_file), observations_of(sensor_file)
    found = read_observations(observations_file)
    recorded = recorded_options(sensor.provenance, SheetOptions)
    options = SheetOptions(**{**recorded, **(changes or {})})
    fit = solved(calibrate_sheets_again(found, sensor, options), sensor_file)
    nonsense = reasons_to_refuse(fit)
    is_simulated = was_simulated(sensor.provenance, sensor_file)
    provenance = job.provenance(
        (sensor_file, observations_file),
        (options,),
        is_simulated=is_simulated,
        parents=(sensor.provenance,),
        warnings=sheet_warnings(fit),
        forced=nonsense,
    )
    # the stripes are the old document's: how they were found goes on word for word
    found_by = (entry for entry in sensor.provenance.options if entry[0].startswith(STRIPES))
    provenance = replace(provenance, options=(*found_by, *provenance.options))
    page = laser_page(fit, {}, provenance, is_simulated=is_simulated)
    job.refuse_nonsense(page, nonsense)
    observations = pack_board_stripes(fit, found.sha256)
    document = sensor_document(fit.to_calibration(provenance), (places[1].name, observations))
    written = job.write(dict(zip(places, (document, observations, page), strict=True)))
    summary = sheets_summary(fit, written, is_simulated=is_simulated)
    return replace(summary, forced=provenance.forced)


@dataclass(frozen=True, slots=True, eq=False)
class _Images:
    """What was read: ``pairs`` are each image with a laser on and its partner, ``tables`` other
    files.
    """

    exposures: tuple[Exposure, ...]
    paths: tuple[Path, ...]
    pairs: list[ExposurePair]
    left_out: tuple[SkippedImage, ...]
    tables: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()


def _read(images: SheetImages, image_options: ImageOptions, *, is_stereo: bool) -> _Images:
    if images.scan is not None:
        if images.on or images.off:
            raise OptionError(
                "a recording and images are given", remedy="give --scan, or --on with --off"
            )
        image_options.check_unused()
        return _read_scan(images.scan, images.leave_out, is_stereo=is_stereo)
    if is_stereo:
        raise OptionError(
            "images of a head with two cameras come as a recording, which says which camera took "
            "which and what belongs together",
            remedy="give --scan FOLDER",
        )
    on = expand_paths(images.on)
    off = expand_paths(images.off) if images.off else ()
    exposures = read_exposures((*on, *off), image_options)
    lit, dark = exposures[: len(on)], exposures[len(on) :]
    named = named_by(images.leave_out, [one.source for one in exposures])
    gone = _with_partners(lit, dark, set(named))
    pairs = pair_exposures(
        [one for one in lit if one.source not in gone],
        [one for one in dark if one.source not in gone],
    )
    return _Images(exposures, (*on, *off), pairs, _skipped(lit, gone))


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
    # neither lit nor the dark partner of a view
    known = [k for k in rows if LASER_UNKNOWN not in recording.rows[k].flags]
    doubtful: tuple[str, ...] = ()
    if len(known) < len(rows):
        doubtful = (
            f"{len(rows) - len(known)} of {len(rows)} images are left out: it is not known what "
            "lasers were on",
        )
    exposures = tuple(recording.exposure(k) for k in known)
    views = {one.view: None for one in exposures if one.view is not None}
    names = [*(one.source for one in exposures), *views]
    named = set(named_by(leave_out, names))
    # without its image without laser a view is no pair any more
    named |= {one.view for one in exposures if one.view and not one.lasers and one.source in named}
    gone = {one.source for one in exposures if one.view in named or one.source in named}
    alone: tuple[str, ...] = ()
    if is_stereo and len({recording.rows[k].camera for k in rows}) == 1:
        alone = (
            f"{folder} holds images of camera {recording.rows[rows[0]].camera} alone, the "
            "calibration is of two: the other camera told nothing of the sheets; is it the right "
            "recording?",
        )
    return _Images(
        exposures,
        tuple(folder / recording.rows[k].source for k in known),
        pair_by_view([one for one in exposures if one.source not in gone]),
        _skipped([one for one in exposures if one.lasers], gone),
        recording_tables(folder),
        (*recording.warnings, *recording.session.assumed, *alone, *doubtful),
    )


def _tried(pair: SeenPair) -> TriedImage:
    accepted = pair.profile.points_px[pair.profile.is_accepted]
    n_points = len(accepted)
    stripe = f"{n_points} clean stripe points" if n_points else "no stripe was found"
    if isinstance(pair.board, FitFailure):
        board, points = without_source(pair.board_source, pair.board.reason), None
    else:
        board, points = "board found", pair.board.points_px
        if pair.board_source != pair.source:
            board += f" in {pair.board_source}"
    is_used = points is not None and n_points > 0
    return TriedImage(pair.source, f"{board}; {stripe}", is_used, points, accepted)


def _other_size(target: Target, parent: Provenance) -> tuple[str, ...]:
    """Warn of a board of the camera's kind and count that is of another size."""
    kind = type(target).__name__
    known = dict(parent.options)
    same = all(known.get(f"{kind}.{name}") == str(getattr(target, name)) for name in COUNTS)
    name = next((name for name in SIZES if hasattr(target, name)), "")
    size = known.get(f"{kind}.{name}")
    if not same or size is None:
        return ()
    if float(known.get(f"{kind}.stretch", "1")) != getattr(target, "stretch", 1.0):
        return (
            "the camera was calibrated with another length from row to row of this board: give "
            "both commands the same target",
        )
    if float(size) == target.size_mm:
        return ()
    return (
        f"the camera was calibrated with a board of {float(size):g} mm from point to point, this "
        f"one is said to have {target.size_mm:g} mm: is it the same board?",
    )


def sheets_summary(fit: LaserFit, written: Sequence[Path], *, is_simulated: bool) -> Summary:
    """What a person, and a program, wants to know of a calibration of light sheets."""
    told = [Quantity("laser_colour", "", fit.laser_colour)]
    if fit.channel_reason:
        told.append(fact("stripes in", sentence(fit.channel_reason)))
    if fit.print_reason:
        told.append(fact("target's print", sentence(fit.print_reason)))
    told += bow_quantities(fit.board_bow_mm)
    for sheet in fit.sheets:
        told.append(fact(f"sheet {sheet.name}", ""))
        told += [fact(f"  {q.label}", q.line) for q in for_people(sheet_quantities(sheet))]
    reasons = tuple((item.source, item.reason) for item in fit.skipped)
    skipped = Table(("image", "why"), reasons, "Images that gave nothing", (1,))
    names = ", ".join(fit.sheet_names)
    return Summary(
        title=f"Light sheets calibrated{' from simulated images' if is_simulated else ''}: {names}",
        quantities=tuple(told),
        tables=(skipped,) if reasons else (),
        warnings=sentences(sheet_warnings(fit)),
        written=tuple(written),
        next_step=f"open {written[-1]}, then `armscan reconstruct IMAGES --sensor {written[0]}`",
        extra={
            "kind": "light sheet calibration",
            "simulated": is_simulated,
            "sheets": [values(sheet_quantities(sheet)) for sheet in fit.sheets],
            "naming": fit.diagnostics.naming,
            "cameras": 1 if fit.second is None else 2,
            "unnamed_points": sum(image.count(PointUse.UNNAMED) for image in fit.images),
            "noise_factor": fit.diagnostics.noise_factor,
            "channel_reason": fit.channel_reason,
            "print_reason": fit.print_reason,
            "skipped": [{"source": source, "reason": reason} for source, reason in reasons],
        },
    )
