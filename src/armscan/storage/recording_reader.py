# SPDX-License-Identifier: Apache-2.0
"""A folder of images with tables of exposures and poses, read as a scan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from armscan.errors import FileFormatError
from armscan.models.arm import ArmModel
from armscan.records.arm_track import ArmTrack
from armscan.records.exposure import Exposure
from armscan.records.session import CameraSetup, ExposureRow, Session
from armscan.storage.arm_files import ARM_MODEL_FILE, read_arm_model
from armscan.storage.csv_table import CsvTable, read_csv
from armscan.storage.recording_arm import ARM_FILE, ArmTable, read_arm_table
from armscan.storage.recording_clock import check_clock
from armscan.storage.recording_exposures import (
    EXPOSURES_FILE,
    check_files,
    exposure_rows,
    is_inside,
    repeated_files,
)
from armscan.storage.recording_images import read_recorded, setup_of_image, window_note
from armscan.storage.recording_session import SESSION_FILE, SessionFile, read_session_file
from armscan.storage.simulated import are_simulated

SIZE_KEYS = ("width_px", "height_px")
WINDOW_KEYS = ("window_x_px", "window_y_px")
CAMERA_KEYS = (*SIZE_KEYS, "bits_used", "colour")


@dataclass(frozen=True, slots=True, eq=False)
class FolderRecording:
    """A folder recording: a `ScanSource` whose images are read when they are asked for.

    Parameters
    ----------
    folder
        Where it lies.
    session, rows, arm
        See `ScanSource`.
    is_simulated
        True if it, or a mark beside it, says that its images were rendered.
    warnings
        What is odd in it, in words.
    exposure_columns, arm_columns
        Columns of the tables that are not known, in the order of ``rows`` and of the samples.
    arm_model
        Geometry with which joint angles were turned into poses; None where it was not needed.
    """

    folder: Path
    session: Session
    rows: tuple[ExposureRow, ...]
    arm: ArmTrack | None
    is_simulated: bool
    warnings: tuple[str, ...]
    exposure_columns: Mapping[str, tuple[str, ...]]
    arm_columns: Mapping[str, tuple[str, ...]]
    arm_model: ArmModel | None

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.resolve().name

    def exposure(self, row: int) -> Exposure:
        """Read the exposure of ``rows[row]`` with its pixels.

        Raises
        ------
        FileFormatError
            If the image is missing or damaged, or its size or layout is not the camera's.
        """
        chosen = self.rows[row]
        return read_recorded(self.folder, chosen, self.session.cameras[chosen.camera])


def is_recording(folder: Path) -> bool:
    """True for a folder that holds the list of a recording's exposures."""
    return (folder / EXPOSURES_FILE).is_file()


def read_recording(folder: Path, arm: ArmModel | None = None) -> FolderRecording:
    """Read a folder recording; images are read later, one by one.

    Parameters
    ----------
    folder
        Holds ``exposures.csv``, images, and as a rule ``session.toml`` and ``arm.csv``.
    arm
        Turns joint angles into poses; ``arm.toml`` of the recording if None.

    Raises
    ------
    FileFormatError
        If a table is missing, damaged or against a rule of the format.
    """
    _check_folder(folder)
    table = read_csv(folder / EXPOSURES_FILE)
    rows, unknown = exposure_rows(table)
    check_files(folder, rows)
    said, assumed = _said(folder)
    warnings = [*said.warnings, *_odd(table, unknown)]
    warnings += [f"{table.where}: {name} is listed again" for name in repeated_files(rows)]
    track, form, arm_model, arm_unknown = None, said.session.pose_form, None, {}
    if (folder / ARM_FILE).exists():
        arm_csv = read_csv(folder / ARM_FILE)
        arm_model = arm if arm is not None else _own_arm_model(folder)
        found = _arm_table(arm_csv, said, arm_model)
        track, form, arm_unknown = found.track, found.form, dict(found.extra)
        warnings += [*_odd(arm_csv, arm_unknown), *found.warnings]
        assumed += _assumed_of_arm(found, said)
        of_clock, odd_times = check_clock(rows, track, said, folder)
        assumed += of_clock
        warnings += odd_times
    cameras, facts = _cameras(folder, rows, said)
    session = replace(said.session, cameras=cameras, pose_form=form, assumed=(*assumed, *facts))
    warnings += _odd_head(folder, session.head)
    return FolderRecording(
        folder,
        session,
        rows,
        track,
        session.is_simulated or are_simulated((folder / EXPOSURES_FILE,)),
        tuple(warnings),
        unknown,
        arm_unknown,
        arm_model,
    )


def read_arm_track(folder: Path, arm: ArmModel | None = None) -> tuple[ArmTrack, tuple[str, ...]]:
    """Read what the arm reported, from a folder with or without images.

    Parameters
    ----------
    folder
        Holds ``arm.csv``, and as a rule ``session.toml``.
    arm
        Turns joint angles into poses; ``arm.toml`` of the folder if None.

    Returns
    -------
    track
        The samples.
    notes
        What is odd in the files or was assumed, in words.

    Raises
    ------
    FileFormatError
        If a file is missing, damaged or against a rule of the format.
    """
    said, notes = _said(folder)
    table = read_csv(folder / ARM_FILE)
    found = _arm_table(table, said, arm if arm is not None else _own_arm_model(folder))
    notes += [*said.warnings, *_odd(table, found.extra), *found.warnings]
    return found.track, (*notes, *_assumed_of_arm(found, said))


def _said(folder: Path) -> tuple[SessionFile, list[str]]:
    """The session, and that there is none if there is none."""
    path = folder / SESSION_FILE
    if path.exists():
        return read_session_file(path), []
    return SessionFile(Session(cameras=())), [f"there is no {SESSION_FILE}"]


def _check_folder(folder: Path) -> None:
    if not folder.is_dir():
        raise FileFormatError(
            "there is no such folder", where=str(folder), remedy="name a recording's folder"
        )
    if not is_recording(folder):
        raise FileFormatError(
            f"the folder holds no {EXPOSURES_FILE}, so it is no recording",
            where=str(folder),
            remedy="name the folder that holds it, or list the images in one",
        )


def _own_arm_model(folder: Path) -> ArmModel | None:
    path = folder / ARM_MODEL_FILE
    return read_arm_model(path) if path.exists() else None


def _arm_table(table: CsvTable, said: SessionFile, arm: ArmModel | None) -> ArmTable:
    form = said.session.pose_form if "pose.form" in said.stated else None
    return read_arm_table(table, form, said.session.rotation, arm)


def _assumed_of_arm(found: ArmTable, said: SessionFile) -> list[str]:
    facts = []
    if "pose.form" not in said.stated:
        facts.append(f"the arm's poses are of the form '{found.form}', by their columns")
    if found.form == "euler" and "pose.rotation" not in said.stated:
        facts.append(f"Euler angles are '{said.session.rotation}'")
    return facts


def _odd_head(folder: Path, head: str | None) -> list[str]:
    where = str(folder / SESSION_FILE)
    if head is None or (is_inside(head) and (folder / head).is_file()):
        return []
    if not is_inside(head):
        raise FileFormatError(
            f"head is '{head}', no path inside the recording",
            where=where,
            remedy="copy the file into the recording and name it relative to that",
        )
    return [f"{where}: there is no file {head}"]


def _odd(table: CsvTable, unknown: Mapping[str, tuple[str, ...]]) -> list[str]:
    found = []
    if unknown:
        found.append(f"{table.where}: columns not known, kept: {', '.join(unknown)}")
    if table.is_cut:
        found.append(
            f"{table.where}: the last line does not end with a line break, so the file may be cut"
        )
    return found


def _cameras(
    folder: Path, rows: Sequence[ExposureRow], said: SessionFile
) -> tuple[tuple[CameraSetup, ...], list[str]]:
    """Setups of all cameras as said, what nobody said by the first image of each; and that."""
    count = max(row.camera for row in rows) + 1
    setups = said.session.cameras
    if setups and count > len(setups):
        raise FileFormatError(
            f"camera {count - 1} is not among the {len(setups)} cameras of {SESSION_FILE}",
            where=str(folder / EXPOSURES_FILE),
            remedy="count cameras from 0, and describe each under [[camera]]",
        )
    cameras, facts = [], []
    for number in range(len(setups) or count):
        setup = setups[number] if setups else CameraSetup()
        prefix = f"camera.{number}."
        stated = frozenset(
            key.removeprefix(prefix) for key in said.stated if key.startswith(prefix)
        )
        first = next((row for row in rows if row.camera == number), None)
        # a camera that is described takes the format's defaults, one that is not its images'
        lacking = [key for key in (CAMERA_KEYS if not setups else SIZE_KEYS) if key not in stated]
        if first is not None and lacking:
            setup = setup_of_image(folder / first.source, setup, lacking)
            values = ", ".join(f"{key} {getattr(setup, key)}" for key in lacking)
            facts.append(f"camera {number} has {values}, as {first.source}")
        if first is not None and not lacking and not stated.issuperset(WINDOW_KEYS):
            note = window_note(folder / first.source, setup)
            facts += [f"camera {number}: {note}"] if note else []
        cameras.append(setup)
    return tuple(cameras), facts
