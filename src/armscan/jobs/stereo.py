# SPDX-License-Identifier: Apache-2.0
"""From pairs of photographs of a flat target to a document of two cameras, and its page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from armscan.calibration.cameras.pairs import StereoOptions
from armscan.calibration.cameras.stereo_result import PairFit, reasons_to_refuse
from armscan.errors import OptionError
from armscan.geometry.estimate import FitFailure
from armscan.jobs.job import Job, with_old_layout
from armscan.models.two_views import STEREO_PARAMETER_NAMES
from armscan.pipeline.cameras import (
    ExposedPair,
    Given,
    StereoRun,
    calibrate_stereo_from_found,
    pair_lists,
    stereo_calibration,
    stereo_rows,
    without_partner,
)
from armscan.pipeline.targets import find_targets
from armscan.records.exposure import Exposure
from armscan.report.photographs import refused_page, tried_targets
from armscan.report.quantity import (
    Summary,
    Table,
    sentences,
    without_source,
)
from armscan.report.stereo import STEREO_TITLE, pair_row, stereo_page, stereo_quantities
from armscan.storage.documents import (
    fingerprint,
    read_camera_calibration,
    stereo_document,
)
from armscan.storage.image_paths import are_simulated, expand_paths, named_by
from armscan.storage.images import ImageOptions, of_one_size, read_exposures
from armscan.storage.observations import pack_observations
from armscan.storage.recording import camera_tables, read_recording
from armscan.vision.targets.detect import settle_target
from armscan.vision.targets.target import parse_target


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Exposures in pairs, the files they came from, other files that went in, and what is odd."""

    pairs: list[ExposedPair]
    paths: dict[str, Path]
    is_simulated: bool
    tables: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()


def calibrate_stereo(
    job: Job,
    target: str,
    left: str = "",
    right: str = "",
    *,
    scan: Path | None = None,
    cameras: tuple[Path | None, Path | None] = (None, None),
    options: StereoOptions | None = None,
    image_options: ImageOptions | None = None,
) -> Summary:
    """Read, calibrate, write ``stereo.json``, ``.npz`` and ``.html``, and say what came out.

    ``left``, ``right``: image file, folder or pattern of each camera; empty if a recording is
    given. ``scan``: folder recording of a head with two cameras, instead of images. ``cameras``:
    calibrations of the single cameras, left and right, or None; for ``options.intrinsics`` that
    take them.
    """
    options, image_options = options or StereoOptions(), image_options or ImageOptions()
    plate = parse_target(target)
    places = job.places(".json", beside=(".npz", ".html"))
    given = _given(*cameras)
    options.check_given(is_given=given is not None)
    read = _stereo_images(left, right, scan, image_options, options.leave_out)
    hashes = {source: fingerprint(path).sha256 for source, path in read.paths.items()}
    if given is not None and options.intrinsics == "prior":
        _check_not_the_same(given, hashes)
    options = replace(options, leave_out=named_by(options.leave_out, list(read.paths)))
    pairs = _of_one_size(read.pairs, options.leave_out)
    by_source = {one.source: one for pair in pairs for one in pair if one is not None}
    left_out = tuple(one for one in options.leave_out if one in by_source)
    options, exposures = replace(options, leave_out=left_out), list(by_source.values())
    plate = settle_target(exposures, plate)
    found = find_targets(exposures, plate, cache=job.cache, progress=job.progress)
    run = calibrate_stereo_from_found(pairs, found, plate, options, given, progress=job.progress)
    given_files = (path for path in cameras if path is not None)
    inputs = (*read.paths.values(), *read.tables, *given_files)
    parents = tuple(one.provenance for one in given or ())
    used = (plate, options, image_options)
    if isinstance(run, FitFailure):
        provenance = job.provenance(inputs, used, parents=parents, warnings=read.warnings)
        tried = tried_targets(found.views, found.not_found, list(by_source))
        page = refused_page(
            STEREO_TITLE, tried, by_source, provenance, warnings=read.warnings,
            is_simulated=read.is_simulated,
        )  # fmt: skip
        job.refuse(page, run)
    fit = replace(run.fit, warnings=(*read.warnings, *run.fit.warnings))
    run, nonsense = replace(run, fit=fit), reasons_to_refuse(fit)
    provenance = job.provenance(
        inputs,
        used,
        parents=parents,
        warnings=fit.warnings,
        forced=nonsense,
        is_simulated=read.is_simulated,
    )
    page = stereo_page(fit, run.not_found, by_source, provenance, is_simulated=read.is_simulated)
    job.refuse_nonsense(page, nonsense)
    views = [view for pair in fit.pairs for view in pair.pair.views if view is not None]
    observations = pack_observations(views, (), hashes)
    calibration = stereo_calibration(fit, provenance)
    document = stereo_document(calibration, (places[1].name, observations))
    written = job.write(dict(zip(places, (document, observations, page), strict=True)))
    summary = _stereo_summary(run, written, is_simulated=read.is_simulated)
    return replace(with_old_layout(summary, plate), forced=provenance.forced)


def _of_one_size(pairs: Sequence[ExposedPair], leave_out: Sequence[str]) -> list[ExposedPair]:
    """Pairs without those of which an image that is left out has not its camera's size."""
    kept: set[str] = set()
    for side in (0, 1):
        seen = [one for pair in pairs if (one := pair[side]) is not None]
        kept.update(one.source for one in of_one_size(seen, leave_out))
    return [pair for pair in pairs if all(one is None or one.source in kept for one in pair)]


def _given(left: Path | None, right: Path | None) -> Given | None:
    if left is None and right is None:
        return None
    if left is None or right is None:
        raise OptionError(
            "the calibration of one camera is given and not that of the other",
            remedy="give both --left and --right, or neither",
        )
    return read_camera_calibration(left), read_camera_calibration(right)


def _stereo_images(
    left: str,
    right: str,
    scan: Path | None,
    image_options: ImageOptions,
    leave_out: Sequence[str],
) -> _Pairs:
    if scan is not None:
        if left or right:
            raise OptionError(
                "a recording and images are given", remedy="give --scan, or images left and right"
            )
        image_options.check_unused()
        return _stereo_scan(scan)
    if not left or not right:
        raise OptionError(
            "images of both cameras are needed",
            remedy="give two folders or quoted patterns, left and right, or --scan FOLDER",
        )
    lefts, rights = expand_paths([left]), expand_paths([right])
    files = (*lefts, *rights)
    exposures = read_exposures(files, image_options)
    pairs = pair_lists(*_with_partners(exposures, len(lefts), leave_out))
    paths = {exposure.source: path for exposure, path in zip(exposures, files, strict=True)}
    return _Pairs(pairs, paths, are_simulated(files))


def _with_partners(
    exposures: Sequence[Exposure], n_left: int, leave_out: Sequence[str]
) -> tuple[list[Exposure], list[Exposure]]:
    """Images left and right; of unlike counts without those left out that have no partner."""
    left, right = list(exposures[:n_left]), list(exposures[n_left:])
    if len(left) == len(right):
        return left, right
    named = set(named_by(leave_out, [exposure.source for exposure in exposures]))
    out = named & {exposure.source for exposure in without_partner(left, right)}
    left, right = ([one for one in side if one.source not in out] for side in (left, right))
    return left, right


def _stereo_scan(folder: Path) -> _Pairs:
    recording = read_recording(folder)
    pairs: list[ExposedPair] = []
    paths: dict[str, Path] = {}
    for rows in stereo_rows(recording.rows, str(folder)):
        pair = [None if row is None else recording.exposure(row) for row in rows]
        pairs.append((pair[0], pair[1]))
        paths |= {one.source: folder / one.source for one in pair if one is not None}
    return _Pairs(
        pairs,
        paths,
        recording.is_simulated,
        camera_tables(folder),
        (*recording.warnings, *recording.session.assumed),
    )


def _check_not_the_same(given: Given, hashes: dict[str, str]) -> None:
    """Raise if given calibrations rest on images that count here again."""
    used = {item.sha256 for calibration in given for item in calibration.provenance.inputs}
    again = [source for source, sha256 in hashes.items() if sha256 in used]
    if again:
        raise OptionError(
            f"{len(again)} of these images are among those that the given calibrations rest on, "
            f"the first is {again[0]}: their evidence would count twice",
            remedy="leave --left and --right out, or hold them with --intrinsics fixed",
        )


def _stereo_summary(run: StereoRun, written: Sequence[Path], *, is_simulated: bool) -> Summary:
    fit = run.fit
    noted = [pair_row(pair) for pair in fit.pairs if pair.note]
    rows = tuple((row[0], row[5], row[6]) for row in noted)
    missed = tuple((source, without_source(source, why)) for source, why in run.not_found)
    tables = (
        Table(("pair", "level (1: like the others)", "remark"), rows, "Pairs to look at", (2,)),
        Table(("image", "why"), missed, "Images without the target", (1,)),
    )
    return Summary(
        title="Two cameras calibrated" + (" from simulated images." if is_simulated else "."),
        quantities=stereo_quantities(fit),
        tables=tuple(table for table in tables if table.rows),
        warnings=sentences(fit.warnings),
        written=tuple(written),
        next_step=f"open {written[-1]}, then `armscan calibrate laser --camera {written[0]} -h`",
        extra={
            "kind": "stereo calibration",
            "simulated": is_simulated,
            "intrinsics": fit.options.intrinsics,
            "right_from_sensor": {
                "rotation_rows": fit.views.right_from_left.rotation.tolist(),
                "translation_right_mm": fit.views.right_from_left.translation_mm.tolist(),
            },
            "parameters": dict(zip(STEREO_PARAMETER_NAMES, fit.parameters.tolist(), strict=True)),
            "sigmas": dict(zip(STEREO_PARAMETER_NAMES, fit.sigma.tolist(), strict=True)),
            "typical_level": fit.typical_level,
            "target_error_mm": fit.target_error_mm,
            "pairs": [_pair_data(pair) for pair in fit.pairs],
            "not_found": [{"source": source, "reason": reason} for source, reason in run.not_found],
        },
    )


def _pair_data(pair: PairFit) -> dict[str, Any]:
    sources = [None if view is None else view.source for view in pair.pair.views]
    return {
        "left": sources[0],
        "right": sources[1],
        "left_rms_px": None if pair.left is None else pair.left.rms_px,
        "right_rms_px": None if pair.right is None else pair.right.rms_px,
        "epipolar_rms_px": None if pair.matched is None else pair.matched.rms_px,
        "rotation_off_deg": float(np.rad2deg(np.linalg.norm(pair.apart[:3]))),
        "translation_off_mm": float(np.linalg.norm(pair.apart[3:])),
        "level": pair.level,
        "right_numbers_turned_deg": 90 * pair.quarter_turns,
        "is_related": pair.is_related,
        "is_misfit": pair.is_misfit,
        "note": pair.note,
    }
