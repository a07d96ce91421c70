# SPDX-License-Identifier: Apache-2.0
"""From pairs of photographs to a document of two cameras, its observations and its page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from armscan.calibration.cameras.pairs import StereoOptions
from armscan.calibration.cameras.stereo_result import PairFit, reasons_to_refuse
from armscan.errors import OptionError
from armscan.geometry.estimate import FitFailure
from armscan.jobs.job import calibration_outputs, refuse, refused_for, refused_page, tried_targets
from armscan.models.two_views import STEREO_PARAMETER_NAMES
from armscan.pipeline.cameras import (
    ExposedPair,
    Given,
    StereoRun,
    calibrate_stereo_from_found,
    pair_lists,
    stereo_calibration,
    stereo_rows,
)
from armscan.pipeline.progress import Progress, silent
from armscan.pipeline.targets import find_targets
from armscan.records.exposure import Exposure
from armscan.report.page import render_page
from armscan.report.quantity import Summary, Table, sentence, significant, without_source
from armscan.report.stereo import TITLE, pair_row, relative_rows, stereo_page
from armscan.storage.detection_cache import DetectionCache
from armscan.storage.documents import (
    fingerprint,
    new_provenance,
    read_camera_calibration,
    stereo_document,
)
from armscan.storage.files import write_files
from armscan.storage.image_paths import are_simulated, expand_paths, named_by
from armscan.storage.images import ImageOptions, check_same_size, read_exposures
from armscan.storage.observations import pack_observations
from armscan.storage.recording import read_recording
from armscan.vision.targets.target import parse_target


@dataclass(frozen=True, slots=True)
class StereoRequest:
    """What to calibrate two cameras from, and where to write.

    Parameters
    ----------
    left, right
        Image file, folder or pattern of each camera; empty if a recording is given.
    target
        Specification of the target.
    output
        The document ``NAME.json``; ``NAME.npz`` and ``NAME.html`` are written beside it.
    scan
        Folder recording of a head with two cameras, instead of images.
    left_camera, right_camera
        Calibrations of the single cameras, or None.
    options
        Of the calibration; what given calibrations are for.
    image_options
        How pixels are read.
    is_overwriting
        Replace results that exist.
    is_forced
        Write cameras that make no sense, marked as such.
    is_caching
        Keep the targets found beside the document, and take those kept there.
    command
        The command line, for the record.
    """

    left: str
    right: str
    target: str
    output: Path
    scan: Path | None = None
    left_camera: Path | None = None
    right_camera: Path | None = None
    options: StereoOptions = field(default_factory=StereoOptions)
    image_options: ImageOptions = field(default_factory=ImageOptions)
    is_overwriting: bool = False
    is_forced: bool = False
    is_caching: bool = False
    command: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class _Images:
    """Exposures in pairs, and the files that they came from."""

    pairs: list[ExposedPair]
    paths: dict[str, Path]
    is_simulated: bool

    @property
    def by_source(self) -> dict[str, Exposure]:
        """Exposures by their names."""
        return {one.source: one for pair in self.pairs for one in pair if one is not None}


def run_stereo_calibration(request: StereoRequest, progress: Progress = silent) -> Summary:
    """Read, calibrate, write ``stereo.json``, ``.npz`` and ``.html``, and say what came out.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, or the images do not determine the cameras;
        no document is written then. Where it is the images, a page shows them.
    """
    target = parse_target(request.target)
    files = calibration_outputs(request.output, is_overwriting=request.is_overwriting)
    given = _given(request)
    images = _read_images(request)
    for side in (0, 1):
        check_same_size([one for pair in images.pairs if (one := pair[side]) is not None])
    hashes = {source: fingerprint(path).sha256 for source, path in images.paths.items()}
    if given is not None and request.options.intrinsics == "prior":
        _check_not_the_same(given, hashes)
    left_out = named_by(request.options.leave_out, list(images.by_source), "--leave-out")
    options = replace(request.options, leave_out=left_out)
    cache = DetectionCache.beside(request.output) if request.is_caching else None
    found = find_targets(list(images.by_source.values()), target, cache=cache, progress=progress)
    run = calibrate_stereo_from_found(
        images.pairs, found, target, options, given, progress=progress
    )
    fit = None if isinstance(run, FitFailure) else run.fit
    nonsense = () if fit is None else reasons_to_refuse(fit)
    cameras = [path for path in (request.left_camera, request.right_camera) if path is not None]
    provenance = new_provenance(
        (*images.paths.values(), *cameras),
        command=request.command,
        options=(target, options, request.image_options),
        parents=tuple(one.provenance for one in given or ()),
        warnings=() if fit is None else fit.warnings,
        forced=nonsense,
    )
    if isinstance(run, FitFailure):
        tried = tried_targets(found.views, found.not_found, list(images.by_source))
        page = refused_page(
            TITLE, tried, images.by_source, provenance, is_simulated=images.is_simulated
        )
        refuse(files, page, run)
    page = stereo_page(
        run.fit, run.not_found, images.by_source, provenance, is_simulated=images.is_simulated
    )
    if nonsense and not request.is_forced:
        refuse(files, replace(page, forced=()), refused_for(nonsense))
    views = [view for pair in run.fit.pairs for view in pair.pair.views if view is not None]
    observations = pack_observations(views, (), hashes)
    document = stereo_document(
        stereo_calibration(run.fit, provenance), (files.observations.name, observations)
    )
    write_files(
        {files.document: document, files.observations: observations, files.page: render_page(page)},
        is_overwriting=request.is_overwriting,
    )
    files.refused_page.unlink(missing_ok=True)
    written = (files.document, files.observations, files.page)
    summary = stereo_summary(run, written, is_simulated=images.is_simulated)
    return replace(summary, forced=provenance.forced)


def _given(request: StereoRequest) -> Given | None:
    left, right = request.left_camera, request.right_camera
    if left is None and right is None:
        return None
    if left is None or right is None:
        raise OptionError(
            "the calibration of one camera is given and not that of the other",
            remedy="give both --left and --right, or neither",
        )
    return read_camera_calibration(left), read_camera_calibration(right)


def _read_images(request: StereoRequest) -> _Images:
    if request.scan is None:
        return _from_lists(request)
    if request.left or request.right:
        raise OptionError(
            "a recording and images are given", remedy="give --scan, or images left and right"
        )
    request.image_options.check_unused()
    return _from_scan(request.scan)


def _from_lists(request: StereoRequest) -> _Images:
    if not request.left or not request.right:
        raise OptionError(
            "images of both cameras are needed",
            remedy="give two folders or quoted patterns, left and right, or --scan FOLDER",
        )
    left, right = expand_paths([request.left]), expand_paths([request.right])
    exposures = read_exposures((*left, *right), request.image_options)
    pairs = pair_lists(exposures[: len(left)], exposures[len(left) :])
    paths = {
        exposure.source: path for exposure, path in zip(exposures, (*left, *right), strict=True)
    }
    return _Images(pairs, paths, are_simulated((*left, *right)))


def _from_scan(folder: Path) -> _Images:
    recording = read_recording(folder)
    pairs: list[ExposedPair] = []
    paths: dict[str, Path] = {}
    for rows in stereo_rows(recording.rows, str(folder)):
        pair = [None if row is None else recording.exposure(row) for row in rows]
        pairs.append((pair[0], pair[1]))
        paths |= {one.source: folder / one.source for one in pair if one is not None}
    return _Images(pairs, paths, recording.is_simulated)


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


def stereo_summary(run: StereoRun, written: Sequence[Path], *, is_simulated: bool) -> Summary:
    """What a person, and a program, wants to know of a calibration."""
    fit = run.fit
    facts = [
        ("pairs", f"{len(fit.related)} used of {len(fit.pairs)}"),
        ("points", str(fit.n_points)),
        (
            "rms",
            f"{significant(fit.rms_px)} px (left {significant(fit.left.rms_px)}, "
            f"right {significant(fit.right.rms_px)}; length of the residual)",
        ),
        (
            "epipolar",
            f"{significant(fit.epipolar_rms_px)} px rms, mean {fit.epipolar_mean_px:+.4f} px",
        ),
    ]
    if fit.hold_out is not None:
        facts.append(
            ("hold-out rms", f"{significant(fit.hold_out.rms_px)} px on pairs not used to solve")
        )
    facts += [(name, value) for name, value, _ in relative_rows(fit)]
    noted = tuple(pair_row(pair) for pair in fit.pairs if pair.note)
    tables = []
    if noted:
        rows = tuple((row[0], row[5], row[6]) for row in noted)
        tables.append(
            Table(("pair", "level (1: like the others)", "remark"), rows, "Pairs to look at", (2,))
        )
    if run.not_found:
        reasons = tuple((source, without_source(source, why)) for source, why in run.not_found)
        tables.append(Table(("image", "why"), reasons, "Images without the target", (1,)))
    return Summary(
        title="Two cameras calibrated" + (" from simulated images." if is_simulated else "."),
        facts=tuple(facts),
        tables=tuple(tables),
        warnings=tuple(sentence(warning) for warning in fit.warnings),
        written=tuple(written),
        next_step=f"open {written[-1]}, then `armscan calibrate laser -h`",
        data=_data(run, is_simulated),
    )


def _data(run: StereoRun, is_simulated: bool) -> dict[str, Any]:
    fit = run.fit
    return {
        "kind": "stereo calibration",
        "simulated": is_simulated,
        "intrinsics": fit.options.intrinsics,
        "right_from_sensor": {
            "rotation_rows": fit.views.right_from_left.rotation.tolist(),
            "translation_right_mm": fit.views.right_from_left.translation_mm.tolist(),
        },
        "parameters": _named(fit.parameters.tolist()),
        "sigmas": _named(fit.sigma.tolist()),
        "rms_px": fit.rms_px,
        "left_rms_px": fit.left.rms_px,
        "right_rms_px": fit.right.rms_px,
        "epipolar_rms_px": fit.epipolar_rms_px,
        "epipolar_mean_px": fit.epipolar_mean_px,
        "hold_out_rms_px": None if fit.hold_out is None else fit.hold_out.rms_px,
        "typical_level": fit.typical_level,
        "target_error_mm": fit.target_error_mm,
        "n_pairs": len(fit.related),
        "n_points": fit.n_points,
        "pairs": [_pair_data(pair) for pair in fit.pairs],
        "not_found": [{"source": source, "reason": reason} for source, reason in run.not_found],
    }


def _named(values: Sequence[float]) -> dict[str, float]:
    return dict(zip(STEREO_PARAMETER_NAMES, values, strict=True))


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
