# SPDX-License-Identifier: Apache-2.0
"""Everything that a hand-eye calibration reads: recordings or profiles, sensor, reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armscan.calibration.hand_eye.observations import PlateReference, PosedStripe
from armscan.calibration.hand_eye.probed_plate import (
    ProbedPlate,
    ProbingOptions,
    fit_probed_plate,
    plate_from_coefficients,
)
from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import SensorCalibration
from armscan.pipeline.hand_eye import HandEyeScanOptions, ObservedStripes, observe_stripes
from armscan.pipeline.measure_options import MeasureOptions
from armscan.pipeline.profiles import posed_stripes_from_profiles
from armscan.pipeline.progress import Progress, silent
from armscan.records.exposure import Exposure
from armscan.records.probing import ProbedPoints
from armscan.report.hand_eye_request import HandEyeRequest
from armscan.report.stripe_figures import MAX_PICTURES, evenly_chosen
from armscan.storage.arm_files import read_arm_model
from armscan.storage.calibration_files import read_sensor_calibration
from armscan.storage.image_paths import expand_paths
from armscan.storage.probed_points import parse_plane, read_points_or_plane
from armscan.storage.profiles import read_profiles
from armscan.storage.recording_arm import ARM_FILE
from armscan.storage.recording_exposures import EXPOSURES_FILE
from armscan.storage.recording_reader import FolderRecording, read_recording
from armscan.storage.recording_session import SESSION_FILE
from armscan.storage.robot_poses import read_robot_poses
from armscan.storage.simulated import are_simulated

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
