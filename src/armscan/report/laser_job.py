# SPDX-License-Identifier: Apache-2.0
"""From stripe images on a board to a sensor's document, its observations and its report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from armscan.calibration.laser.result import LaserFit, PointUse, SheetFit, SheetImage
from armscan.errors import EstimationError
from armscan.geometry.estimate import FitFailure
from armscan.models.light_sheet import PLANE_PARAMETER_NAMES
from armscan.pipeline.documents import sensor_calibration
from armscan.pipeline.laser import LaserOptions, calibrate_sheets_from_exposures
from armscan.pipeline.progress import Progress, silent
from armscan.records.profile import Profile, StripeFlag
from armscan.report.laser_page import laser_page, sheet_facts
from armscan.report.numbers import sentence
from armscan.report.outputs import calibration_outputs
from armscan.report.page import render_page
from armscan.report.summary import Summary, Table
from armscan.storage.atomic import write_files
from armscan.storage.calibration_files import read_camera_calibration, sensor_document
from armscan.storage.image_options import ImageOptions
from armscan.storage.image_paths import expand_paths
from armscan.storage.images import read_exposures
from armscan.storage.observations import pack_observations
from armscan.storage.provenance import new_provenance
from armscan.storage.simulated import are_simulated
from armscan.vision.targets.specification import parse_target


@dataclass(frozen=True, slots=True)
class LaserRequest:
    """What to calibrate light sheets from, and where to write.

    Parameters
    ----------
    camera
        The camera's calibration: ``camera.json``, or one that OpenCV or ROS wrote.
    on
        Images with the laser on the board: files, folders or patterns.
    off
        The same placements without laser, one for each, or none.
    target
        Specification of the board's target.
    output
        The document ``NAME.json``; ``NAME.npz`` and ``NAME.html`` are written beside it.
    options
        Of target, stripes and sheets.
    image_options
        How pixels are read.
    is_overwriting
        Replace results that exist.
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
    is_overwriting: bool = False
    command: tuple[str, ...] = ()


def run_laser_calibration(request: LaserRequest, progress: Progress = silent) -> Summary:
    """Read, calibrate, write ``sensor.json``, ``.npz`` and ``.html``, and say what came out.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, or the images do not determine the sheets;
        nothing is written then.
    """
    target = parse_target(request.target)
    files = calibration_outputs(request.output, is_overwriting=request.is_overwriting)
    camera = read_camera_calibration(request.camera)
    on = expand_paths(request.on)
    off = expand_paths(request.off) if request.off else ()
    exposures = read_exposures((*on, *off), request.image_options)
    fit = calibrate_sheets_from_exposures(
        exposures[: len(on)],
        target,
        camera,
        backgrounds=exposures[len(on) :],
        options=request.options,
        progress=progress,
    )
    if isinstance(fit, FitFailure):
        raise EstimationError(fit.reason, remedy=fit.remedy)
    options = request.options
    provenance = new_provenance(
        (*on, *off, request.camera),
        command=request.command,
        options=(target, options.target, options.stripes, fit.options, request.image_options),
        parent_ids=(camera.provenance.document_id,),
        warnings=all_warnings(fit),
    )
    is_simulated = are_simulated((*on, *off))
    by_source = {exposure.source: exposure for exposure in exposures}
    page = laser_page(fit, by_source, provenance, is_simulated=is_simulated)
    hashes = {
        exposure.source: item.sha256
        for exposure, item in zip(exposures, provenance.inputs[: len(exposures)], strict=True)
    }
    observations = pack_observations(
        [image.view for image in fit.images],
        [_with_edge_flags(image) for image in fit.images],
        hashes,
    )
    document = sensor_document(
        sensor_calibration(fit, provenance), (files.observations.name, observations)
    )
    write_files(
        {files.document: document, files.observations: observations, files.page: render_page(page)},
        is_overwriting=request.is_overwriting,
    )
    written = (files.document, files.observations, files.page)
    return laser_summary(fit, written, is_simulated=is_simulated)


def _with_edge_flags(image: SheetImage) -> Profile:
    """The stripe points with those flagged that lay along an edge of the target.

    The edges themselves are not kept, and without them the sheet could not be solved again.
    """
    is_on_edge = image.use == int(PointUse.ON_EDGE)
    flags = image.profile.flags | np.where(is_on_edge, int(StripeFlag.TARGET_EDGE), 0)
    return replace(image.profile, flags=flags)


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
            "naming": fit.naming,
            "noise_factor": fit.noise_factor,
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
        "rms_px": fit.rms_px,
        "n_boards": fit.calibration.n_boards,
        "n_points": fit.calibration.n_points,
        "depth_min_mm": low,
        "depth_max_mm": high,
        "is_redundant": fit.calibration.is_redundant,
        "lack_of_fit_p": fit.final_test.p_value,
    }
