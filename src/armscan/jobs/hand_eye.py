# SPDX-License-Identifier: Apache-2.0
"""From recordings or profiles over a plate or a sphere to a scanner document and its page.

Hand-eye first; then, from a plate and a stand-off that moves, the time between camera and arm.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate, calibrate_on_sphere
from armscan.calibration.hand_eye.observations import HandEyeOptions, PlateReference, PosedStripe
from armscan.calibration.hand_eye.probed_plate import (
    ProbeSide,
    ProbingOptions,
    fit_probed_plate,
    plate_from_coefficients,
)
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.latency import calibrate_latency as fit_latency
from armscan.errors import FileFormatError, InputError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.rotations import EulerConvention
from armscan.jobs.job import Job, solved
from armscan.models.calibration import (
    ScannerCalibration,
    SensorCalibration,
    without_covariance,
)
from armscan.pipeline.hand_eye import (
    ObservedStripes,
    measured_beside,
    observe_plate,
    observe_stripes,
    posed_stripes_from_profiles,
)
from armscan.pipeline.measure import MeasureOptions
from armscan.pipeline.progress import Progress, ProgressEvent
from armscan.reconstruction.labels import LabelledProfile, PointStatus
from armscan.records.exposure import Exposure
from armscan.records.points import ProbedPoints
from armscan.report.hand_eye import (
    TITLE,
    hand_eye_page,
    hand_eye_quantities,
    latency_page,
    latency_quantities,
    posture_table,
    repeat_blocks,
)
from armscan.report.page import Text
from armscan.report.photographs import MAX_PICTURES, TriedImage, evenly_chosen, refused_page
from armscan.report.quantity import Summary, Table, fact, sentences, significant
from armscan.storage.arm import ARM_FILE, read_arm_model
from armscan.storage.documents import (
    observations_named,
    observations_of,
    read_scanner_calibration,
    read_sensor_calibration,
    scanner_document,
)
from armscan.storage.files import read_bytes
from armscan.storage.image_paths import are_simulated
from armscan.storage.observations import pack_posed_stripes
from armscan.storage.points import (
    parse_plane,
    profile_files,
    read_points_or_plane,
    read_profiles,
)
from armscan.storage.recording import (
    FolderRecording,
    read_recording,
    recording_name,
    recording_tables,
)
from armscan.storage.recordings.robot_poses import USUAL_EULER, read_robot_poses
from armscan.thesis.hand_eye import PrintedHandEye, as_printed
from armscan.vision.stripe.image import StripeOptions


@dataclass(frozen=True, slots=True)
class StripeSource:
    """Where the stripes are: recordings, or profiles of a sensor that delivers points.

    `OptionError` if these do not go together.

    Parameters
    ----------
    scans
        Folders of recordings; several are one calibration each, and one of all together.
    sensor
        The sensor's calibration ``sensor.json``; None with profiles.
    arm
        ``arm.toml`` for recordings of joint angles; None to look for it in the recording.
    profiles
        Profiles of points: files, folders or patterns, one a posture.
    poses
        Table of the robot's poses, one a profile.
    euler
        What angles in ``poses`` mean; None for `USUAL_EULER`.
    """

    scans: tuple[Path, ...] = ()
    sensor: Path | None = None
    arm: Path | None = None
    profiles: tuple[str, ...] = ()
    poses: Path | None = None
    euler: EulerConvention | None = None

    def __post_init__(self) -> None:
        has_profiles = bool(self.profiles) or self.poses is not None
        if bool(self.scans) == has_profiles:
            raise OptionError(
                "recordings and profiles do not mix"
                if has_profiles
                else "nothing to calibrate from",
                remedy="name a recording's folder, or give --profiles with --poses",
            )
        if has_profiles and (not self.profiles or self.poses is None):
            raise OptionError(
                "profiles and poses belong together", remedy="give --profiles and --poses"
            )
        given: dict[str, object] = {"--sensor": self.sensor, "--arm": self.arm}
        fact = "profiles with --poses are points already"
        if self.scans:
            given, fact = {"--euler": self.euler}, "a recording says what its angles mean"
        vain = ", ".join(name for name, value in given.items() if value is not None)
        if vain:
            raise OptionError(f"without effect: {fact}", where=vain, remedy=f"leave out {vain}")
        if self.scans and self.sensor is None:
            raise OptionError(
                "a recording of images needs the sensor's calibration",
                remedy="give --sensor sensor.json, as `armscan calibrate laser` writes it",
            )


@dataclass(frozen=True, slots=True)
class Artefact:
    """What the stripes lie on: a plate or a sphere; `OptionError` if it is not one of them.

    Parameters
    ----------
    plate
        Probed points of the plate, or a file with its ``A,B,C,D``.
    plane
        ``A,B,C,D`` of the plate in Base; empty for none.
    side
        Axis of Base along which the plate's face looks; None to take it from where the arm was.
    sphere_diameter_mm
        Diameter of the sphere in place of a plate; None for a plate.
    """

    plate: Path | None = None
    plane: str = ""
    side: ProbeSide | None = None
    sphere_diameter_mm: float | None = None

    def __post_init__(self) -> None:
        given = [self.plate is not None, bool(self.plane), self.sphere_diameter_mm is not None]
        if sum(given) != 1:
            what = (
                "there is more than one reference" if any(given) else "the reference is not given"
            )
            raise OptionError(
                what,
                remedy="give one of --plate plate.csv, --plane A,B,C,D, --sphere-diameter MM; with "
                "--solve-plate a rough plane is enough",
            )


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
    warnings
        What is odd about the recordings, in words.
    is_simulated
        True if any recording was rendered.
    recordings
        One a group; none with profiles.
    """

    groups: tuple[tuple[str, ObservedStripes], ...]
    sensor: SensorCalibration | None
    plate: PlateReference | None
    files: tuple[Path, ...]
    warnings: tuple[str, ...]
    is_simulated: bool = False
    recordings: tuple[FolderRecording, ...] = ()

    @property
    def stripes(self) -> tuple[PosedStripe, ...]:
        """Stripes of all groups."""
        return tuple(stripe for _, seen in self.groups for stripe in seen.stripes)

    @property
    def images(self) -> tuple[LabelledProfile, ...]:
        """Stripe points of all groups' exposures."""
        return tuple(image for _, seen in self.groups for image in seen.images)

    @property
    def sensor_covariance(self) -> FloatArray | None:
        """(P, P) of the sensor's parameters; None where it has none."""
        return None if self.sensor is None else self.sensor.covariance


def _check_solved_along(artefact: Artefact, options: HandEyeOptions) -> None:
    if artefact.sphere_diameter_mm is not None and options.solve_plate:
        raise OptionError("a sphere has no plate to solve", remedy="leave --solve-plate out")
    if artefact.sphere_diameter_mm is not None and artefact.side is not None:
        raise OptionError("a sphere has no side that was touched", remedy="leave --side out")
    if artefact.sphere_diameter_mm is not None and options.plate_flatness_mm is not None:
        raise OptionError("a sphere has no flatness", remedy="leave --plate-flatness-mm out")
    if artefact.sphere_diameter_mm is None and options.solve_diameter:
        raise OptionError("a plate has no diameter to solve", remedy="leave --solve-diameter out")


def calibrate_hand_eye(
    job: Job,
    source: StripeSource,
    artefact: Artefact,
    *,
    options: HandEyeOptions | None = None,
    stripe_options: StripeOptions | None = None,
    is_beside_thesis: bool = False,
) -> Summary:
    """Read, calibrate, write ``scanner.json``, ``.npz`` and ``.html``, and say what came out.

    ``is_beside_thesis``: tell what the printed equations give of the same stripes.
    """
    options, stripe_options = options or HandEyeOptions(), stripe_options or StripeOptions()
    _check_solved_along(artefact, options)
    diameter = artefact.sphere_diameter_mm
    places = job.places(".json", beside=(".npz", ".html"))
    inputs = read_hand_eye_inputs(source, artefact, stripe_options, job.progress)
    parents = () if inputs.sensor is None else (inputs.sensor.provenance,)
    used = (options, stripe_options)

    def solve(stripes: Sequence[PosedStripe]) -> HandEyeFit | FitFailure:
        known = inputs.sensor_covariance
        if diameter is not None:
            return calibrate_on_sphere(stripes, diameter, options, sensor_covariance=known)
        if inputs.plate is None:
            return FitFailure("there is no plate")
        return calibrate_on_plate(stripes, inputs.plate, options, sensor_covariance=known)

    n_steps = len(inputs.groups) + 1
    job.progress(ProgressEvent("solve", 0, n_steps))
    fit, stripes = solved_where_it_moves(solve, inputs)
    if isinstance(fit, FitFailure):
        provenance = job.provenance(inputs.files, used, parents=parents, warnings=inputs.warnings)
        page = refused_page(
            TITLE, [_tried(image) for image in inputs.images], _shown_exposures(inputs),
            provenance, warnings=inputs.warnings, is_simulated=inputs.is_simulated,
        )  # fmt: skip
        job.refuse(page, _with_assumptions(fit, inputs))
    repeats: tuple[Table, Text] | None = None
    if len(inputs.groups) > 1:
        fits = []
        for name, seen in inputs.groups:
            one = solve(seen.stripes)
            if isinstance(one, FitFailure):
                one = _with_assumptions(one, inputs)
            fits.append(solved(one, name))
        names = [name for name, _ in inputs.groups]
        repeats = repeat_blocks(names, fits, inputs.sensor_covariance)
    job.progress(ProgressEvent("solve", n_steps, n_steps))
    fit = replace(fit, warnings=(*inputs.warnings, *fit.warnings))
    provenance = job.provenance(inputs.files, used, parents=parents, warnings=fit.warnings)
    provenance = replace(provenance, is_simulated=inputs.is_simulated)
    scanner = fit.scanner(inputs.sensor, provenance)
    stripes = tuple(stripe.beside(fit.sensor_step) for stripe in stripes)
    page = hand_eye_page(
        fit,
        scanner,
        stripes,
        inputs.images,
        _shown_exposures(inputs),
        repeats=repeats or (),
        is_simulated=inputs.is_simulated,
    )
    observations = pack_posed_stripes(stripes, {})
    document = scanner_document(scanner, (places[1].name, observations))
    written = job.write(dict(zip(places, (document, observations, page), strict=True)))
    tables = (posture_table(fit),) if repeats is None else (repeats[0], posture_table(fit))
    summary = hand_eye_summary(fit, scanner, written, tables, is_simulated=inputs.is_simulated)
    if is_beside_thesis:
        reference = inputs.plate if diameter is None else diameter
        pose = fit.calibration.tool_from_sensor
        printed = (
            FitFailure("there is no plate")
            if reference is None
            else as_printed(stripes, reference, pose)
        )
        table, data = _beside_thesis(printed, pose)
        extra = {**summary.extra, "thesis": data}
        summary = replace(summary, tables=(*summary.tables, table), extra=extra)
    return replace(summary, forced=provenance.forced)


SENSOR_ROUNDS, STRAIGHT = 4, 0.03
"""Solutions at most, and what the sensor's step may leave unlinear, over a point's own noise."""


def solved_where_it_moves(
    solve: Callable[[Sequence[PosedStripe]], HandEyeFit | FitFailure], inputs: HandEyeInputs
) -> tuple[HandEyeFit | FitFailure, tuple[PosedStripe, ...]]:
    """The solution, and the stripes with which it was found, linearised by the sensor it stores.

    The first round takes the derivatives at the sensor as it was given; a lens that is weakly known
    moves so far that they do not hold at the image's border. Of two cameras they are kept. A round
    that refuses speaks for all: the one before rests on derivatives that do not hold.
    """
    stripes, sensor = inputs.stripes, inputs.sensor
    fit = solve(stripes)
    if sensor is None or sensor.second is not None:
        return fit, stripes
    for count in range(SENSOR_ROUNDS):
        if isinstance(fit, FitFailure) or fit.sensor_step is None:
            break
        moved = fit.sensor_after(sensor)
        found, bend = measured_beside(stripes, inputs.images, moved, fit.sensor_step)
        if bend < STRAIGHT:
            break
        if count == SENSOR_ROUNDS - 1:
            fit = replace(fit, warnings=(*fit.warnings, _still_bent(bend)))
            break
        again = solve(found)
        if isinstance(again, FitFailure):
            reason = f"with the sensor where the stripes move it: {again.reason}"
            return FitFailure(reason, again.remedy), stripes
        fit, stripes = again, found
    return fit, stripes


def _still_bent(bend: float) -> str:
    return (
        f"the stripes move the sensor so far that {SENSOR_ROUNDS} solutions do not settle: points "
        f"lie {significant(bend)} of their noise (rms) beside where the derivatives put them, "
        f"{STRAIGHT:g} is the limit; calibrate camera and sheets with more views, up to the "
        "image's border"
    )


def calibrate_latency(
    job: Job,
    scan: Path,
    scanner: Path,
    *,
    arm: Path | None = None,
    stripe_options: StripeOptions | None = None,
) -> Summary:
    """Find the time between camera and arm, and write the scanner's document with it.

    Clocks that are not shared have a time of their own in every recording: it is told, and no
    document is written.

    Parameters
    ----------
    job
        Where to write the document ``NAME.json`` and its page.
    scan
        Recording of a flat plate, the head moved nearer and away.
    scanner
        The document ``scanner.json`` so far.
    arm
        ``arm.toml`` for recordings of joint angles; None to look for it in the recording.
    stripe_options
        Of stripe extraction.

    Raises
    ------
    ArmscanError
        If a file is unreadable, or the motion does not tell the time; nothing is written then.
    """
    stripe_options = stripe_options or StripeOptions()
    places = job.places(".json", beside=(".npz", ".html"))
    before = read_scanner_calibration(scanner)
    if before.sensor is None:
        raise InputError(
            "the scanner's document has no camera and light sheet",
            where=str(scanner),
            remedy="give one with a sensor",
        )
    recording = read_recording(scan, None if arm is None else read_arm_model(arm))
    if recording.arm is None:
        raise InputError(
            "the recording has no samples of the arm",
            where=str(scan),
            remedy=f"record the arm's poses in {ARM_FILE}",
        )
    is_shared = recording.session.clock != "separate"
    measure = MeasureOptions(stripes=stripe_options)
    looks = observe_plate(recording, before.sensor, measure, progress=job.progress)
    fit = solved(
        fit_latency(looks, recording.arm, before.hand_eye.tool_from_sensor, is_shared=is_shared),
        scan,
    )
    data, lacking = _evidence(scanner) if is_shared else (None, ())
    odd = (*recording.warnings, *recording.session.assumed, *fit.warnings, *lacking)
    if not is_shared:
        odd += ("the clocks are separate: the time holds for this recording, nothing is written",)
    is_simulated = recording.is_simulated or are_simulated([scanner])
    provenance = job.provenance(
        (*recording_tables(scan, arm), scanner),
        (stripe_options,),
        parents=(before.provenance,),
        warnings=odd,
        is_simulated=is_simulated,
    )
    written: tuple[Path, ...] = ()
    if is_shared:
        timed = replace(
            before,
            provenance=provenance,
            latency_ns=fit.latency_ns,
            latency_sigma_ns=fit.sigma_ns,
        )
        page = latency_page(fit, provenance, warnings=odd, is_simulated=is_simulated)
        # the hand-eye's own evidence goes with it
        beside = None if data is None else (places[1].name, data)
        kept = {} if data is None else {places[1]: data}
        written = job.write({places[0]: scanner_document(timed, beside), **kept, places[2]: page})
    done = "Latency calibrated" if written else "Clocks of this recording compared"
    return Summary(
        title=done + (" from simulated images." if is_simulated else "."),
        quantities=latency_quantities(fit),
        warnings=sentences(odd),
        written=written,
        next_step=f"armscan reconstruct SCAN --scanner {written[0]} -o cloud.ply"
        if written
        else "",
        extra={"kind": "latency calibration", "simulated": is_simulated},
        forced=provenance.forced,
    )


def _evidence(document: Path) -> tuple[bytes | None, tuple[str, ...]]:
    """Observations that a document was solved from, and what is odd about them.

    None where it has none any more, or others than it was solved from.
    """
    beside = observations_named(document)
    if beside is None or not beside.exists():
        return None, ()
    try:
        return read_bytes(observations_of(document)), ()
    except FileFormatError as error:
        return None, (f"the hand-eye's observations are left out: {error.where}: {error.what}",)


def _beside_thesis(
    printed: PrintedHandEye | FitFailure, ours: Pose[Tool, Sensor]
) -> tuple[Table, dict[str, Any]]:
    """The printed equations' hand-eye beside ours, for people and for programs."""
    columns = ("As the thesis prints it", "")
    if isinstance(printed, FitFailure):
        return Table(columns, (("not found", printed.reason),)), {"failure": printed.reason}
    between = printed.tool_from_sensor @ ours.inverse()
    turn_deg = float(np.degrees(np.linalg.norm(between.rotation_vector_rad)))
    shift_mm = printed.tool_from_sensor.translation_mm - ours.translation_mm
    rows = (
        ("equations", printed.equations),
        ("they leave, rms", f"{significant(printed.rms_mm)} mm"),
        ("turned from ours", f"{significant(turn_deg)}°"),
        ("origin of Sensor off ours", f"{significant(float(np.linalg.norm(shift_mm)))} mm"),
    )
    return Table(columns, rows), {
        "equations": printed.equations,
        "rms_mm": printed.rms_mm,
        "rotation": printed.tool_from_sensor.rotation.tolist(),
        "translation_mm": printed.tool_from_sensor.translation_mm.tolist(),
        "turned_deg": turn_deg,
        "shifted_mm": shift_mm.tolist(),
    }


def read_hand_eye_inputs(
    source: StripeSource,
    artefact: Artefact,
    stripe_options: StripeOptions,
    progress: Progress,
) -> HandEyeInputs:
    """Read all that is named, and find the stripes."""
    if source.poses is not None:
        return _from_profiles(source, artefact)
    if source.sensor is None:
        raise OptionError("a recording needs the sensor's calibration", remedy="give --sensor")
    arm = None if source.arm is None else read_arm_model(source.arm)
    _refuse_repeated(source.scans)
    recordings = tuple(read_recording(folder, arm) for folder in source.scans)
    sensor = read_sensor_calibration(source.sensor)
    plate, notes = _reference(artefact, _tool_places(recordings))
    measure = MeasureOptions(stripes=stripe_options)
    groups = []
    n_shown = _pictures_of_each(len(recordings))
    for recording in recordings:
        seen = observe_stripes(recording, sensor, measure, n_wanted=n_shown, progress=progress)
        groups.append((recording.name, _named(seen, _prefix(recording, len(recordings)))))
    tables = dict.fromkeys(p for one in source.scans for p in recording_tables(one, source.arm))
    files = [path for path in (*tables, source.sensor, artefact.plate) if path]
    odd = [text for r in recordings for text in (*r.warnings, *r.session.assumed)]
    of_groups = [text for _, seen in groups for text in seen.warnings]
    if not sensor.has_camera_covariance:
        of_groups.append(without_covariance("the hand-eye's sigmas"))
    return HandEyeInputs(
        groups=tuple(groups),
        sensor=sensor,
        plate=plate,
        files=tuple(files),
        warnings=(*notes, *odd, *of_groups),
        is_simulated=any(r.is_simulated for r in recordings) or are_simulated([source.sensor]),
        recordings=recordings,
    )


def _refuse_repeated(folders: Sequence[Path]) -> None:
    """Names of postures begin with those of their recordings, so these must differ."""
    names = [recording_name(folder) for folder in folders]
    for name in names:
        if names.count(name) > 1:
            raise OptionError(
                f"{names.count(name)} recordings are called '{name}'",
                remedy="name each recording once, and give their folders different names",
            )


def _from_profiles(source: StripeSource, artefact: Artefact) -> HandEyeInputs:
    if source.poses is None:
        raise OptionError("profiles need a table of poses", remedy="give --poses")
    files = [path for name in source.profiles for path in profile_files(Path(name), source.poses)]
    profiles = read_profiles(files)
    poses = read_robot_poses(source.poses, source.euler or USUAL_EULER, files)
    stripes = posed_stripes_from_profiles(profiles, poses)
    plate, notes = _reference(artefact, np.array([pose.translation_mm for pose in poses]))
    seen = ObservedStripes(stripes, (), (), ())
    named = (*files, source.poses, artefact.plate)
    return HandEyeInputs(
        groups=(("profiles", seen),),
        sensor=None,
        plate=plate,
        files=tuple(path for path in named if path),
        warnings=notes,
    )


def _reference(
    artefact: Artefact, towards_mm: FloatArray
) -> tuple[PlateReference | None, tuple[str, ...]]:
    """The plate and what is weak about it; none for a sphere.

    ``towards_mm`` are (M, 3) places of the arm's tool: they are on the side that is scanned.
    """
    if artefact.sphere_diameter_mm is not None:
        return None, ()
    where = "--plane" if artefact.plate is None else str(artefact.plate)
    if artefact.plate is None:
        found: ProbedPoints | FloatArray = parse_plane(artefact.plane, where)
    else:
        found = read_points_or_plane(artefact.plate)
    known = towards_mm if len(towards_mm) else None
    if isinstance(found, ProbedPoints):
        probed = solved(fit_probed_plate(found, known, ProbingOptions(side=artefact.side)), where)
        return probed.reference, probed.warnings
    return solved(plate_from_coefficients(found, known, artefact.side, where), where), ()


def _tool_places(recordings: Sequence[FolderRecording]) -> FloatArray:
    """(M, 3) places of the arm's tool."""
    arms = [recording.arm for recording in recordings if recording.arm is not None]
    return np.concatenate([np.zeros((0, 3)), *(arm.translations_mm[arm.is_known] for arm in arms)])


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


def _shown_exposures(inputs: HandEyeInputs) -> dict[str, Exposure]:
    """The images that a page shows, by the names that their stripes bear."""
    found: dict[str, Exposure] = {}
    most = _pictures_of_each(len(inputs.recordings))
    for recording, (_, seen) in zip(inputs.recordings, inputs.groups, strict=False):
        prefix = _prefix(recording, len(inputs.recordings))
        used = {image.profile.source.removeprefix(prefix) for image in seen.images}
        rows = [k for k, row in enumerate(recording.rows) if row.source in used]
        for k in evenly_chosen(rows, most):
            exposure = seen.exposures.get(k) or recording.exposure(k)
            found[prefix + exposure.source] = exposure
    return found


def _pictures_of_each(n_recordings: int) -> int:
    return max(1, MAX_PICTURES // max(n_recordings, 1))


def _with_assumptions(failure: FitFailure, inputs: HandEyeInputs) -> FitFailure:
    """A failure that also says what may be its cause: exposures left out, and what was assumed."""
    assumed = dict.fromkeys(text for r in inputs.recordings for text in r.session.assumed)
    not_used = Counter(reason for _, seen in inputs.groups for _, reason in seen.not_used)
    left = ", ".join(f"{n} ({reason})" for reason, n in not_used.most_common(3))
    of_scan = (f"exposures that were not used: {left}",) if left else ()
    reason = "; ".join((failure.reason, *of_scan, *(f"assumed: {text}" for text in assumed)))
    return FitFailure(reason, failure.remedy)


def _tried(image: LabelledProfile) -> TriedImage:
    is_measured = image.status == PointStatus.MEASURED
    n_points, n = int(is_measured.sum()), len(image.profile)
    remark = f"{n_points} of {n} stripe points measured" if n else "no stripe was found"
    points = image.profile.points_px[is_measured]
    return TriedImage(image.profile.source, remark, n_points > 0, stripe_px=points)


def hand_eye_summary(
    fit: HandEyeFit,
    scanner: ScannerCalibration,
    written: Sequence[Path],
    tables: tuple[Table, ...] = (),
    *,
    is_simulated: bool,
) -> Summary:
    """What a person, and a program, wants to know of a hand-eye calibration."""
    next_step = f"open {written[-1]}"
    if scanner.sensor is not None:
        next_step += f", then `armscan reconstruct SCAN --scanner {written[0]} -o cloud.ply`"
    reference = (fact(label, text) for label, text in fit.reference)
    return Summary(
        title="Hand-eye calibrated" + (" from simulated images." if is_simulated else "."),
        quantities=(*hand_eye_quantities(scanner), *reference),
        tables=tables,
        warnings=sentences(fit.warnings),
        written=tuple(written),
        next_step=next_step,
        extra={
            "kind": "hand-eye calibration",
            "simulated": is_simulated,
            "postures": [_posture_data(fit, k) for k in range(len(fit.postures))],
        },
    )


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
