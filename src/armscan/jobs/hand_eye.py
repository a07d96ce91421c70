# SPDX-License-Identifier: Apache-2.0
"""From recordings or profiles over a plate or a sphere to a scanner document and its page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate, calibrate_on_sphere
from armscan.calibration.hand_eye.observations import HandEyeOptions, PlateReference, PosedStripe
from armscan.calibration.hand_eye.probed_plate import (
    ProbedPlate,
    ProbeSide,
    ProbingOptions,
    fit_probed_plate,
    plate_from_coefficients,
)
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.rotations import EulerConvention
from armscan.jobs.job import TriedImage, document_and_page, refuse, refused_page
from armscan.models.calibration import Provenance, ScannerCalibration, SensorCalibration
from armscan.pipeline.hand_eye import HandEyeScanOptions, ObservedStripes, observe_stripes
from armscan.pipeline.measure import MeasureOptions
from armscan.pipeline.profiles import posed_stripes_from_profiles
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.reconstruction.labels import PointStatus
from armscan.records.exposure import Exposure
from armscan.records.points import ProbedPoints
from armscan.report.hand_eye import (
    TITLE,
    hand_eye_facts,
    hand_eye_numbers,
    hand_eye_page,
    posture_table,
    repeat_blocks,
    size_facts,
    total_covariance,
)
from armscan.report.page import Page, Text, render_page
from armscan.report.quantity import Summary, Table, sentence
from armscan.report.stripes import MAX_PICTURES, evenly_chosen
from armscan.storage.arm import ARM_FILE, read_arm_model
from armscan.storage.documents import new_provenance, read_sensor_calibration, scanner_document
from armscan.storage.files import write_files
from armscan.storage.image_paths import are_simulated, expand_paths
from armscan.storage.points import parse_plane, read_points_or_plane, read_profiles
from armscan.storage.poses import read_robot_poses
from armscan.storage.recording import FolderRecording, read_recording
from armscan.storage.recording_session import EXPOSURES_FILE, SESSION_FILE
from armscan.vision.stripe.image import StripeOptions


@dataclass(frozen=True, slots=True)
class HandEyeRequest:
    """What to calibrate a hand-eye from, and where to write.

    Either recordings with a sensor's calibration, or profiles of a sensor that delivers points
    with a table of poses; of a plate or of a sphere.

    Parameters
    ----------
    scans
        Folders of recordings; several are one calibration each, and one of all together.
    sensor
        The sensor's calibration ``sensor.json``; None with profiles.
    profiles
        Profiles of points: files, folders or patterns, one a posture.
    poses
        Table of the robot's poses, one a profile, in the profiles' order.
    euler
        What the angles in ``poses`` mean.
    plate
        Probed points of the plate, or a file with its ``A,B,C,D``.
    plane
        ``A,B,C,D`` of the plate in Base; empty for none.
    side
        Axis of Base along which the plate's face looks; None to take it from where the arm was.
    sphere_diameter_mm
        Diameter of the sphere in place of a plate; None for a plate.
    arm
        ``arm.toml`` for recordings of joint angles; None to look for it in the recording.
    output
        The document ``NAME.json``; ``NAME.html`` is written beside it.
    options
        Of the calibration.
    stripes
        Of stripe extraction.
    is_overwriting
        Replace results that exist.
    command
        The command line, for the record.

    Raises
    ------
    OptionError
        If these do not go together.
    """

    output: Path
    scans: tuple[Path, ...] = ()
    sensor: Path | None = None
    profiles: tuple[str, ...] = ()
    poses: Path | None = None
    euler: EulerConvention = "extrinsic-xyz"
    plate: Path | None = None
    plane: str = ""
    side: ProbeSide | None = None
    sphere_diameter_mm: float | None = None
    arm: Path | None = None
    options: HandEyeOptions = field(default_factory=HandEyeOptions)
    stripes: StripeOptions = field(default_factory=StripeOptions)
    is_overwriting: bool = False
    command: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _check_source(self)
        _check_reference(self)

    @property
    def is_sphere(self) -> bool:
        """True if a sphere was looked at, False for a plate."""
        return self.sphere_diameter_mm is not None


def _check_source(request: HandEyeRequest) -> None:
    has_profiles = bool(request.profiles) or request.poses is not None
    if bool(request.scans) == has_profiles:
        raise OptionError(
            "recordings and profiles do not mix" if has_profiles else "nothing to calibrate from",
            remedy="name a recording's folder, or give --profiles with --poses",
        )
    if has_profiles and (not request.profiles or request.poses is None):
        raise OptionError(
            "profiles and poses belong together", remedy="give --profiles and --poses"
        )
    if request.scans and request.sensor is None:
        raise OptionError(
            "a recording of images needs the sensor's calibration",
            remedy="give --sensor sensor.json, as `armscan calibrate laser` writes it",
        )


def _check_reference(request: HandEyeRequest) -> None:
    given = [request.plate is not None, bool(request.plane), request.is_sphere]
    if sum(given) != 1:
        raise OptionError(
            "the reference is not given" if not any(given) else "there is more than one reference",
            remedy="give one of --plate plate.csv, --plane A,B,C,D, --sphere-diameter MM; with "
            "--solve-plate a rough plane is enough",
        )
    if request.is_sphere and request.options.solve_plate:
        raise OptionError("a sphere has no plate to solve", remedy="leave --solve-plate out")


TABLES = (EXPOSURES_FILE, ARM_FILE, SESSION_FILE)


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeInputs:
    """What was read.

    Parameters
    ----------
    groups
        Name and stripes of each recording, or of all profiles.
    sensor
        The sensor's calibration; None with profiles.
    plate
        The plate; None for a sphere.
    files
        All files that went in.
    is_simulated
        True if any recording was rendered.
    warnings
        What is odd about the recordings, in words.
    """

    groups: tuple[tuple[str, ObservedStripes], ...]
    sensor: SensorCalibration | None
    plate: PlateReference | None
    files: tuple[Path, ...]
    is_simulated: bool
    warnings: tuple[str, ...]
    recordings: tuple[FolderRecording, ...] = ()

    @property
    def all_stripes(self) -> tuple[PosedStripe, ...]:
        """Stripes of all groups."""
        return tuple(stripe for _, seen in self.groups for stripe in seen.stripes)


def read_hand_eye_inputs(request: HandEyeRequest, progress: Progress = silent) -> HandEyeInputs:
    """Read all that a request names, and find the stripes.

    Raises
    ------
    ArmscanError
        If a file is unreadable or does not fit the others.
    """
    if request.sensor is None or not request.scans:
        return _from_profiles(request)
    return _from_recordings(request, request.sensor, progress)


def shown_exposures(inputs: HandEyeInputs) -> dict[str, Exposure]:
    """The images that a page shows, by the names that their stripes bear."""
    found: dict[str, Exposure] = {}
    most = max(1, MAX_PICTURES // max(len(inputs.recordings), 1))
    for recording, (_, seen) in zip(inputs.recordings, inputs.groups, strict=False):
        prefix = _prefix(recording, len(inputs.recordings))
        used = {image.profile.source.removeprefix(prefix) for image in seen.images}
        rows = [k for k, row in enumerate(recording.rows) if row.source in used]
        for k in evenly_chosen(rows, most):
            exposure = recording.exposure(k)
            found[prefix + exposure.source] = exposure
    return found


def _from_recordings(
    request: HandEyeRequest, sensor_file: Path, progress: Progress
) -> HandEyeInputs:
    arm = None if request.arm is None else read_arm_model(request.arm)
    _refuse_repeated(request.scans)
    recordings = tuple(read_recording(folder, arm) for folder in request.scans)
    sensor = read_sensor_calibration(sensor_file)
    plate, notes = _reference(request, _tool_places(recordings))
    options = HandEyeScanOptions(
        hand_eye=request.options, measure=MeasureOptions(stripes=request.stripes)
    )
    groups = []
    for recording in recordings:
        seen = observe_stripes(recording, sensor, options, progress=progress)
        groups.append((recording.name, _named(seen, _prefix(recording, len(recordings)))))
    tables = [folder / name for folder in request.scans for name in TABLES]
    files = [path for path in (*tables, sensor_file, request.plate, request.arm) if path]
    return HandEyeInputs(
        tuple(groups),
        sensor,
        plate,
        tuple(path for path in files if path.exists()),
        any(recording.is_simulated for recording in recordings) or are_simulated([sensor_file]),
        (*notes, *(text for r in recordings for text in (*r.warnings, *r.session.assumed))),
        recordings,
    )


def _refuse_repeated(folders: Sequence[Path]) -> None:
    """Names of postures begin with those of their recordings, so these must differ."""
    names = [folder.resolve().name for folder in folders]
    for name in names:
        if names.count(name) > 1:
            raise OptionError(
                f"{names.count(name)} recordings are called '{name}'",
                remedy="name each recording once, and give their folders different names",
            )


def _from_profiles(request: HandEyeRequest) -> HandEyeInputs:
    if request.poses is None:
        raise OptionError("profiles need a table of poses", remedy="give --poses")
    files = tuple(path for name in request.profiles for path in _profile_files(name))
    profiles = read_profiles(files)
    poses = read_robot_poses(request.poses, request.euler)
    stripes = posed_stripes_from_profiles(profiles, poses)
    plate, notes = _reference(request, np.array([pose.translation_mm for pose in poses]))
    named = [*files, request.poses, request.plate]
    seen = ObservedStripes(stripes, (), (), ())
    return HandEyeInputs(
        (("profiles", seen),), None, plate, tuple(p for p in named if p), False, notes
    )


def _profile_files(name: str) -> tuple[Path, ...]:
    return (Path(name),) if Path(name).is_dir() else expand_paths([name])


def _reference(
    request: HandEyeRequest, towards_mm: FloatArray
) -> tuple[PlateReference | None, tuple[str, ...]]:
    return (None, ()) if request.is_sphere else read_reference(request, towards_mm)


def read_reference(
    request: HandEyeRequest, towards_mm: FloatArray
) -> tuple[PlateReference, tuple[str, ...]]:
    """The plate of a request, and what is weak about it.

    Parameters
    ----------
    request
        With a file of the plate, or its plane.
    towards_mm
        (M, 3) places of the arm's tool: they are on the side that is scanned.

    Raises
    ------
    ArmscanError
        If it is neither, or its points determine no plane.
    """
    where = "--plane" if request.plate is None else str(request.plate)
    if request.plate is None:
        found: ProbedPoints | FloatArray = parse_plane(request.plane, where)
    else:
        found = read_points_or_plane(request.plate)
    known = towards_mm if len(towards_mm) else None
    if isinstance(found, ProbedPoints):
        probed = fit_probed_plate(found, known, ProbingOptions(side=request.side))
        if isinstance(probed, ProbedPlate):
            return probed.reference, probed.warnings
        raise EstimationError(probed.reason, where=where, remedy=probed.remedy)
    plate = plate_from_coefficients(found, known, request.side, where)
    if isinstance(plate, FitFailure):
        raise EstimationError(plate.reason, where=where, remedy=plate.remedy)
    return plate, ()


def _tool_places(recordings: Sequence[FolderRecording]) -> FloatArray:
    """(M, 3) places of the arm's tool."""
    places = [
        recording.arm.translations_mm[recording.arm.is_known]
        for recording in recordings
        if recording.arm is not None
    ]
    return np.concatenate(places) if places else np.zeros((0, 3))


def _prefix(recording: FolderRecording, n_recordings: int) -> str:
    """Names of several recordings' exposures begin with the recording's."""
    return f"{recording.name}/" if n_recordings > 1 else ""


def _named(seen: ObservedStripes, prefix: str) -> ObservedStripes:
    if not prefix:
        return seen
    return replace(
        seen,
        stripes=tuple(
            replace(item, source=prefix + item.source, posture=prefix + item.posture)
            for item in seen.stripes
        ),
        images=tuple(
            replace(item, profile=replace(item.profile, source=prefix + item.profile.source))
            for item in seen.images
        ),
    )


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
        sensor=inputs.sensor,
        hand_eye=fit.calibration,
        provenance=_provenance(request, inputs, fit.warnings),
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
            stripes, request.sphere_diameter_mm, request.options, sensor_covariance=known
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
        is_measured = image.fate == int(PointStatus.MEASURED)
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
    parents = () if inputs.sensor is None else (inputs.sensor.provenance,)
    return new_provenance(
        inputs.files,
        command=request.command,
        options=(request.options, request.stripes),
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
