# SPDX-License-Identifier: Apache-2.0
"""From views of a flat target, with the arm's poses, to a scanner document and its page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from armscan.calibration.hand_eye.alternatives import other_readings
from armscan.calibration.hand_eye.board_looks import BoardLook, Reading, board_poses
from armscan.calibration.hand_eye.board_result import BoardHandEyeFit
from armscan.calibration.hand_eye.observations import HandEyeOptions
from armscan.calibration.hand_eye.on_board import (
    MAX_LOOKS,
    calibrate_on_board,
)
from armscan.calibration.sheets.board_points import BoardBow, HeadCameras, find_board_bow
from armscan.errors import InputError, OptionError, listed
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import EulerConvention
from armscan.jobs.job import Job
from armscan.models.calibration import (
    CameraCalibration,
    ScannerCalibration,
    SensorCalibration,
)
from armscan.pipeline.hand_eye import (
    REPEATED_DEG,
    REPEATED_MM,
    repeated_postures,
    standing_postures,
)
from armscan.pipeline.instants import check_sizes
from armscan.pipeline.targets import FoundTargets, find_targets
from armscan.reconstruction.sync import exposure_poses
from armscan.records.exposure import Exposure
from armscan.report.board_hand_eye import board_hand_eye_page, board_quantities, look_table
from armscan.report.hand_eye import TITLE, hand_eye_quantities
from armscan.report.photographs import refused_page, tried_targets
from armscan.report.quantity import Quantity, Summary, plural, sentences, without_source
from armscan.storage.arm import read_arm_model
from armscan.storage.documents import (
    read_camera_calibration,
    read_sensor_calibration,
    scanner_document,
)
from armscan.storage.image_paths import are_simulated, expand_paths, named_by
from armscan.storage.images import ImageOptions, check_same_size, read_exposures, source_names
from armscan.storage.observations import pack_observations
from armscan.storage.recording import read_recording, recording_tables
from armscan.storage.recordings.robot_poses import (
    USUAL_EULER,
    other_table_readings,
    read_robot_poses,
)
from armscan.vision.targets.detect import settle_target
from armscan.vision.targets.target import Target, describe_target, format_target, parse_target

MOST_ROWS = 2 * MAX_LOOKS
"""Of a longer recording, the target is looked for in so many exposures, evenly spread."""


@dataclass(frozen=True, slots=True)
class LookSource:
    """Where the views of the target and the arm's poses are; `OptionError` if they do not go
    together.

    Parameters
    ----------
    poses
        Table of the robot's poses, one a photograph.
    euler
        What angles in ``poses`` mean; None for `USUAL_EULER`.
    arm
        ``arm.toml`` for a recording of joint angles; None to look for it in the recording.
    camera, sensor
        The camera's calibration, by itself or as a part of ``sensor.json``.
    """

    images: tuple[str, ...] = ()
    poses: Path | None = None
    euler: EulerConvention | None = None
    scan: Path | None = None
    arm: Path | None = None
    camera: Path | None = None
    sensor: Path | None = None
    leave_out: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if (self.camera is None) == (self.sensor is None):
            raise OptionError(
                "the views of a target need one calibration of the camera",
                remedy="give --sensor sensor.json, or --camera camera.json before there is one",
            )
        if bool(self.images) == (self.scan is not None):
            raise OptionError(
                "recordings and photographs do not mix"
                if self.images
                else "nothing to calibrate from",
                remedy="name a recording's folder, or photographs with --poses",
            )
        vain = ("--arm", self.arm) if self.images else ("--euler", self.euler)
        if vain[1] is not None:
            other = "photographs have a table of poses" if self.images else "a recording says so"
            fact = f"{vain[0]} is without effect: {other}"
            raise OptionError(fact, remedy=f"leave {vain[0]} out")
        if bool(self.images) != (self.poses is not None):
            raise OptionError(
                "photographs and poses belong together",
                remedy="name the photographs, and give --poses",
            )


@dataclass(frozen=True, slots=True, eq=False)
class _Views:
    """Photographs with the arm's poses, and what else was read.

    ``poses`` and ``postures`` are those of ``exposures``, ``rows`` their lines in the table of
    photographs; ``not_used`` are (source, reason); ``convention`` is that of a recording's angles.
    """

    exposures: tuple[Exposure, ...]
    poses: tuple[Pose[Base, Tool], ...]
    postures: tuple[str, ...]
    paths: tuple[Path, ...]
    tables: tuple[Path, ...]
    is_simulated: bool
    warnings: tuple[str, ...] = ()
    not_used: tuple[tuple[str, str], ...] = ()
    rows: tuple[int, ...] = ()
    convention: EulerConvention | None = None


def calibrate_hand_eye_on_board(
    job: Job,
    source: LookSource,
    target: str,
    *,
    options: HandEyeOptions | None = None,
    image_options: ImageOptions | None = None,
) -> Summary:
    """Read, calibrate, write ``scanner.json``, ``.npz`` and ``.html``, and say what came out."""
    options, image_options = options or HandEyeOptions(), image_options or ImageOptions()
    places = job.places(".json", beside=(".npz", ".html"))
    plate = parse_target(target)
    camera, sensor = _cameras(source)
    if source.scan is None:
        views = _photographs(source, image_options)
    else:
        image_options.check_unused()
        views = _scan_views(source)
    check_same_size(views.exposures)
    check_sizes(views.exposures, camera.camera)
    plate = settle_target(views.exposures, plate)
    found = find_targets(views.exposures, plate, cache=job.cache, progress=job.progress)
    found = found.before(camera.camera)
    bow = find_board_bow(found.views, HeadCameras.of(camera))
    looks, unclear = _looks(found, views, plate, camera, bow)
    fit = calibrate_on_board(
        looks, camera, options, bow=bow, target=plate, readings=_readings(looks, source, views)
    )
    parents = ((sensor or camera).provenance,)
    calibrated = source.sensor if source.camera is None else source.camera
    files = [path for path in (*views.paths, *views.tables, calibrated) if path is not None]
    not_used = (*views.not_used, *found.not_found, *unclear)
    by_source = {exposure.source: exposure for exposure in views.exposures}
    if isinstance(fit, FitFailure):
        used = (plate, options, image_options)
        provenance = job.provenance(files, used, parents=parents, warnings=views.warnings)
        sources = [exposure.source for exposure in views.exposures]
        page = refused_page(
            TITLE, tried_targets(found.views, (*found.not_found, *unclear), sources), by_source,
            provenance, warnings=views.warnings, is_simulated=views.is_simulated,
        )  # fmt: skip
        job.refuse(page, _explained(fit, found))
    fit = replace(fit, not_used=(*not_used, *fit.not_used))
    warnings = (*views.warnings, *_not_used_warnings(not_used), *fit.warnings)
    provenance = job.provenance(
        files,
        (plate, options, image_options),
        parents=parents,
        warnings=warnings,
        is_simulated=views.is_simulated,
    )
    scanner = fit.scanner(sensor, provenance)
    page = board_hand_eye_page(
        replace(fit, warnings=warnings), scanner, plate, by_source, is_simulated=views.is_simulated
    )
    observations = pack_observations([pose.view for pose in fit.chosen], (), {})
    document = scanner_document(scanner, (places[1].name, observations))
    written = job.write(dict(zip(places, (document, observations, page), strict=True)))
    return _summary(fit, scanner, plate, written, warnings, is_simulated=views.is_simulated)


def _cameras(source: LookSource) -> tuple[CameraCalibration, SensorCalibration | None]:
    """The camera that gives the Sensor frame, and the sensor where one was named."""
    if source.sensor is None:
        if source.camera is None:
            raise OptionError("there is no camera", remedy="give --camera camera.json")
        return read_camera_calibration(source.camera), None
    sensor = read_sensor_calibration(source.sensor)
    return sensor.camera, sensor


def _photographs(source: LookSource, image_options: ImageOptions) -> _Views:
    if source.poses is None:
        raise OptionError("photographs need a table of poses", remedy="give --poses")
    paths = expand_paths(source.images)
    poses = read_robot_poses(source.poses, source.euler or USUAL_EULER, paths)
    if len(poses) != len(paths):
        raise InputError(
            f"{len(paths)} photographs but {len(poses)} poses",
            where=str(source.poses),
            remedy="give one pose a photograph, in the photographs' order",
        )
    names = source_names(paths)
    gone = set(named_by(source.leave_out, names))
    kept = [k for k, name in enumerate(names) if name not in gone]
    exposures = read_exposures([paths[k] for k in kept], image_options)
    used = [poses[k] for k in kept]
    postures = repeated_postures([exposure.source for exposure in exposures], used)
    return _Views(
        exposures=exposures,
        poses=tuple(used),
        postures=tuple(postures),
        paths=tuple(paths[k] for k in kept),
        tables=(source.poses,),
        is_simulated=are_simulated(paths),
        warnings=_repeated(postures),
        rows=tuple(kept),
    )


def _repeated(postures: Sequence[str]) -> tuple[str, ...]:
    """Say which photographs were put together without being asked."""
    n = len(postures) - len(set(postures))
    if not n:
        return ()
    verb = "counts" if n == 1 else "count"
    return (
        f"{plural(n, 'photograph')} with the pose of one before (within {REPEATED_MM:g} mm and "
        f"{REPEATED_DEG:g} deg) {verb} as one posture with it",
    )


def _scan_views(source: LookSource) -> _Views:
    """Exposures of camera 0 with a pose, without laser where there are such."""
    folder = source.scan
    if folder is None:
        raise OptionError("there is no recording", remedy="name its folder")
    arm = None if source.arm is None else read_arm_model(source.arm)
    recording = read_recording(folder, arm)
    poses = exposure_poses(recording.rows, recording.arm, recording.session.clock)
    names = [row.source for row in recording.rows]
    gone = set(named_by(source.leave_out, names))
    left = [k for k, row in enumerate(recording.rows) if row.camera == 0 and names[k] not in gone]
    dark = [k for k in left if recording.rows[k].is_dark]
    posed = [k for k in dark or left if poses.has_pose[k]]
    if not posed:
        raise InputError(
            "no exposure of camera 0 has a pose of the arm",
            where=str(folder),
            remedy="record the target at rest with the arm's poses beside the images",
        )
    n_used = min(len(posed), MOST_ROWS)
    chosen = [posed[k] for k in np.linspace(0, len(posed) - 1, n_used).round().astype(int)]
    held = [poses.pose(k) for k in chosen]
    postures, merged = standing_postures(
        [recording.rows[k].view for k in chosen], held, [names[k] for k in chosen]
    )
    n_other = sum(row.camera != 0 for row in recording.rows)
    note = f"{plural(n_other, 'exposure')} of other cameras not used: camera 0 gives the hand-eye"
    without = [(names[k], "the arm gave no pose for it") for k in dark or left if k not in posed]
    return _Views(
        exposures=tuple(recording.exposure(k) for k in chosen),
        poses=tuple(held),
        postures=tuple(postures),
        paths=tuple(folder / names[k] for k in chosen),
        tables=recording_tables(folder, source.arm),
        is_simulated=recording.is_simulated,
        warnings=(
            *recording.warnings,
            *recording.session.assumed,
            *poses.warnings,
            *merged,
            *((note,) if n_other else ()),
        ),
        not_used=tuple(without),
        convention=recording.session.rotation if recording.session.pose_form == "euler" else None,
    )


def _looks(
    found: FoundTargets,
    views: _Views,
    target: Target,
    camera: CameraCalibration,
    bow: BoardBow | None,
) -> tuple[list[BoardLook], tuple[tuple[str, str], ...]]:
    """Looks at the target, and (source, reason) of views that give no pose."""
    place = {exposure.source: k for k, exposure in enumerate(views.exposures)}
    looks: list[BoardLook] = []
    unclear: list[tuple[str, str]] = []
    for view in found.views:
        poses, k = board_poses(view, target, camera.camera, bow), place[view.source]
        if isinstance(poses, FitFailure):
            unclear.append((view.source, poses.reason))
        else:
            looks.append(BoardLook(views.postures[k], views.poses[k], poses))
    return looks, tuple(unclear)


def _readings(looks: Sequence[BoardLook], source: LookSource, views: _Views) -> Iterator[Reading]:
    """Other ways to read the looks' poses, of the table that they are from."""
    if source.poses is None:
        if views.convention is not None:
            turns = np.array([look.base_from_tool.rotation for look in looks])
            shifts = np.array([look.base_from_tool.translation_mm for look in looks])
            yield from other_readings(turns, shifts, views.convention)
        return
    sources = [exposure.source for exposure in views.exposures]
    row_of = dict(zip(sources, views.rows, strict=True))
    rows = [row_of[look.source] for look in looks]
    paths, euler = expand_paths(source.images), source.euler or USUAL_EULER
    for words, remedy, turns, shifts in other_table_readings(source.poses, euler, paths):
        yield words, remedy, turns[rows], shifts[rows]
    plainly = sorted(range(len(paths)), key=lambda k: paths[k].as_posix())
    line_of = np.argsort(plainly)[rows]
    poses = read_robot_poses(source.poses, euler, [paths[k] for k in plainly])
    if not np.array_equal(line_of, rows):
        yield (
            "giving the poses to the photographs as a plain sort lists these (10 before 2)",
            "photographs are taken in natural order (2 before 10): sort the table so",
            np.array([poses[line].rotation for line in line_of]),
            np.array([poses[line].translation_mm for line in line_of]),
        )


def _not_used_warnings(not_used: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    """Name the views that give no pose of the target, with the reasons of the first."""
    if not not_used:
        return ()
    named = listed([f"{source} ({without_source(source, why)})" for source, why in not_used], 4)
    verb = "was" if len(not_used) == 1 else "were"
    return (f"{plural(len(not_used), 'view')} {verb} not used: {named}",)


def _explained(failure: FitFailure, found: FoundTargets) -> FitFailure:
    """A failure with what may be its cause: no target in some views, or one of another count."""
    if found.wrong_count is not None:
        return found.wrong_count
    return FitFailure(failure.reason + found.not_found_text(), failure.remedy)


def _summary(
    fit: BoardHandEyeFit,
    scanner: ScannerCalibration,
    target: Target,
    written: Sequence[Path],
    warnings: Sequence[str],
    *,
    is_simulated: bool,
) -> Summary:
    next_step = f"open {written[-1]}"
    if scanner.sensor is None:
        next_step += "; with light sheets, the same command with --sensor makes a scanner of it"
    else:
        next_step += f", then `armscan reconstruct SCAN --scanner {written[0]} -o cloud.ply`"
    extra: dict[str, Any] = {
        "kind": "hand-eye calibration",
        "simulated": is_simulated,
        "target": format_target(target),
        "postures": [_look_data(fit, k) for k in range(len(fit.postures))],
        "not_used": [{"source": source, "reason": reason} for source, reason in fit.not_used],
    }
    return Summary(
        title="Hand-eye calibrated" + (" from simulated images." if is_simulated else "."),
        quantities=(
            Quantity("target_description", "Target", describe_target(target)),
            *hand_eye_quantities(scanner),
            *board_quantities(fit),
        ),
        tables=(look_table(fit),),
        warnings=sentences(warnings),
        written=tuple(written),
        next_step=next_step,
        extra=extra,
        forced=scanner.provenance.forced,
    )


def _look_data(fit: BoardHandEyeFit, k: int) -> dict[str, Any]:
    item = fit.postures[k]
    return {
        "name": item.posture,
        "source": item.source,
        "n_points": item.n_points,
        "rms_px": item.rms_px,
        "tilt_deg": item.tilt_deg,
        "stand_off_mm": item.stand_off_mm,
        "shift_mm": item.shift_mm,
        "turn_deg": item.turn_deg,
        "left_out_rotation_deg": item.left_out_rotation_deg,
        "left_out_translation_mm": item.left_out_translation_mm,
        "left_out_normalised": item.left_out_normalised,
    }
