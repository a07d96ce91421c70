# SPDX-License-Identifier: Apache-2.0
"""From recordings or profiles to a scanner's document and its report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.calibration.hand_eye.plate import calibrate_on_plate
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.hand_eye.sphere import calibrate_on_sphere
from armscan.errors import EstimationError
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import Provenance
from armscan.models.scanner import ScannerCalibration
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.reconstruction.result import PointFate
from armscan.report.hand_eye_inputs import HandEyeInputs, read_hand_eye_inputs, shown_exposures
from armscan.report.hand_eye_numbers import (
    hand_eye_facts,
    hand_eye_numbers,
    size_facts,
    total_covariance,
)
from armscan.report.hand_eye_page import TITLE, hand_eye_page, posture_table
from armscan.report.hand_eye_repeat import repeat_blocks
from armscan.report.hand_eye_request import HandEyeRequest
from armscan.report.numbers import sentence
from armscan.report.outputs import document_and_page
from armscan.report.page import Page, Text, render_page
from armscan.report.refusal import TriedImage, refuse, refused_page
from armscan.report.summary import Summary, Table
from armscan.storage.atomic import write_files
from armscan.storage.provenance import new_provenance
from armscan.storage.scanner_files import scanner_document


def run_hand_eye_calibration(request: HandEyeRequest, progress: Progress = silent) -> Summary:
    """Read, calibrate, write ``scanner.json`` and ``.html``, and say what came out.

    Raises
    ------
    ArmscanError
        If a file is unreadable, an option is wrong, or the postures do not determine the
        hand-eye; no document is written then. Where it is the postures, a page shows them.
    """
    files = document_and_page(request.output, is_overwriting=request.is_overwriting)
    inputs = read_hand_eye_inputs(request, progress)
    progress(ProgressEvent("solve", 0, len(inputs.groups) + 1))
    try:
        fit = calibrated(inputs.all_stripes, inputs, request)
    except EstimationError as error:
        refuse(files, _refused(request, inputs), FitFailure(error.what, error.remedy))
    repeats = _repeats(inputs, request)
    progress(ProgressEvent("solve", len(inputs.groups) + 1, len(inputs.groups) + 1))
    fit = replace(fit, warnings=(*_input_warnings(inputs), *fit.warnings))
    scanner = ScannerCalibration(
        inputs.sensor, fit.calibration, _provenance(request, inputs, fit.warnings)
    )
    images = tuple(image for _, seen in inputs.groups for image in seen.images)
    page = hand_eye_page(
        fit,
        scanner,
        inputs.all_stripes,
        images,
        shown_exposures(inputs),
        repeats=repeats,
        is_simulated=inputs.is_simulated,
    )
    write_files(
        {files.document: scanner_document(scanner), files.page: render_page(page)},
        is_overwriting=request.is_overwriting,
    )
    files.refused_page.unlink(missing_ok=True)
    summary = hand_eye_summary(
        fit,
        scanner,
        (files.document, files.page),
        [block for block in repeats if isinstance(block, Table)],
        is_simulated=inputs.is_simulated,
    )
    return replace(summary, forced=scanner.provenance.forced)


def calibrated(
    stripes: Sequence[PosedStripe], inputs: HandEyeInputs, request: HandEyeRequest, name: str = ""
) -> HandEyeFit:
    """The hand-eye of some stripes on the plate, or on the sphere.

    Raises
    ------
    EstimationError
        If they do not determine it.
    """
    known = None if inputs.sensor is None else inputs.sensor.covariance
    if request.sphere_diameter_mm is not None:
        fit = calibrate_on_sphere(
            stripes, request.sphere_diameter_mm, request.sphere_options, sensor_covariance=known
        )
    elif inputs.plate is not None:
        fit = calibrate_on_plate(stripes, inputs.plate, request.options, sensor_covariance=known)
    if isinstance(fit, FitFailure):
        assumed = dict.fromkeys(text for r in inputs.recordings for text in r.session.assumed)
        reason = "; ".join((fit.reason, *(f"assumed: {text}" for text in assumed)))
        raise EstimationError(reason, where=name, remedy=fit.remedy)
    return fit


def _repeats(inputs: HandEyeInputs, request: HandEyeRequest) -> tuple[Table | Text, ...]:
    if len(inputs.groups) < 2:
        return ()
    fits = [calibrated(seen.stripes, inputs, request, name) for name, seen in inputs.groups]
    known = None if inputs.sensor is None else inputs.sensor.covariance
    return repeat_blocks([name for name, _ in inputs.groups], fits, known)


def _input_warnings(inputs: HandEyeInputs) -> tuple[str, ...]:
    own = [text for _, seen in inputs.groups for text in seen.warnings]
    return (*inputs.warnings, *own)


def _refused(request: HandEyeRequest, inputs: HandEyeInputs) -> Page:
    """The page of stripes that determine no hand-eye."""
    tried = []
    for image in (image for _, seen in inputs.groups for image in seen.images):
        is_measured = image.fate == int(PointFate.MEASURED)
        n_points, n = int(is_measured.sum()), len(image.profile)
        remark = f"{n_points} of {n} stripe points measured" if n else "no stripe was found"
        points = image.profile.points_px[is_measured]
        source = image.profile.source
        tried.append(TriedImage(source, remark, n_points > 0, stripe_px=points))
    warnings = _input_warnings(inputs)
    page = refused_page(
        TITLE,
        tried,
        shown_exposures(inputs),
        _provenance(request, inputs, warnings),
        is_simulated=inputs.is_simulated,
    )
    return replace(page, warnings=tuple(sentence(text) for text in warnings))


def _provenance(
    request: HandEyeRequest, inputs: HandEyeInputs, warnings: Sequence[str]
) -> Provenance:
    options = request.sphere_options if request.is_sphere else request.options
    parents = () if inputs.sensor is None else (inputs.sensor.provenance,)
    return new_provenance(
        inputs.files,
        command=request.command,
        options=(options, request.stripes),
        parents=parents,
        warnings=warnings,
    )


def hand_eye_summary(
    fit: HandEyeFit,
    scanner: ScannerCalibration,
    written: Sequence[Path],
    repeats: Sequence[Table] = (),
    *,
    is_simulated: bool,
) -> Summary:
    """What a person, and a program, wants to know of a hand-eye calibration."""
    next_step = f"open {written[-1]}"
    if scanner.sensor is not None:
        next_step += f", then `armscan reconstruct SCAN --scanner {written[0]} -o cloud.ply`"
    return Summary(
        title="Hand-eye calibrated" + (" from simulated images." if is_simulated else "."),
        facts=(*hand_eye_facts(scanner), *size_facts(fit), *fit.reference),
        tables=(*repeats, posture_table(fit)),
        warnings=tuple(sentence(warning) for warning in fit.warnings),
        written=tuple(written),
        next_step=next_step,
        data={
            "kind": "hand-eye calibration",
            "simulated": is_simulated,
            **_numbers(fit, scanner),
            "postures": [_posture_data(fit, k) for k in range(len(fit.postures))],
        },
    )


def _numbers(fit: HandEyeFit, scanner: ScannerCalibration) -> dict[str, Any]:
    hand_eye = fit.calibration
    numbers = hand_eye_numbers(hand_eye, total_covariance(scanner))
    known, noise = hand_eye.diagnostics, hand_eye.arm_noise
    evidence = (
        {}
        if known is None
        else {
            "method": known.method,
            "rank": known.rank,
            "condition": known.condition,
            "weakest": known.weakest,
            "chi2_probability": known.chi2_probability,
            "plate_flatness_mm": known.plate_flatness_mm,
            "is_noise_estimated": known.is_noise_estimated,
        }
    )
    return {
        "rotation_tool_from_sensor": hand_eye.tool_from_sensor.rotation.tolist(),
        "translation_tool_mm": numbers.translation_mm.tolist(),
        "euler_intrinsic_xyz_deg": numbers.euler_deg.tolist(),
        "translation_sigma_mm": numbers.translation_sigma_mm.tolist(),
        "euler_sigma_deg": numbers.euler_sigma_deg.tolist(),
        "rms_mm": hand_eye.rms_mm,
        "arm_position_mm": noise.position_mm,
        "arm_rotation_deg": float(np.degrees(noise.rotation_rad)),
        "n_postures": hand_eye.n_postures,
        "n_exposures": hand_eye.n_exposures,
        "n_points": hand_eye.n_points,
        **evidence,
    }


def _posture_data(fit: HandEyeFit, k: int) -> dict[str, Any]:
    item = fit.postures[k]
    return {
        "name": item.posture,
        "mean_mm": item.mean_mm,
        "rms_mm": item.rms_mm,
        "mean_over_sigma": item.normalised_mean,
        "left_out_rotation_deg": item.left_out_rotation_deg,
        "left_out_translation_mm": item.left_out_translation_mm,
        "left_out_normalised": item.left_out_normalised,
    }
