# SPDX-License-Identifier: Apache-2.0
"""Any scan as a folder recording: complete, or not there at all."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TypeAlias

from armscan.devices.sources import ScanSource
from armscan.errors import InputError
from armscan.models.arm import ArmModel
from armscan.records.recording import CameraSetup, ExposureRow, PixelColour, Session
from armscan.storage.arm import ARM_FILE, ARM_MODEL_FILE, arm_columns, arm_model_toml
from armscan.storage.atomic import new_folder
from armscan.storage.images import read_bytes
from armscan.storage.recording import FolderRecording, encoded_png
from armscan.storage.recording_session import (
    EXPOSURES_FILE,
    SESSION_FILE,
    exposure_columns,
    is_inside,
    session_toml,
)
from armscan.storage.tables import csv_bytes

Report: TypeAlias = Callable[[int, int, str], None]


def write_recording(
    folder: Path,
    source: ScanSource,
    progress: Report | None = None,
    *,
    names: Sequence[str] | None = None,
    encoded: Iterable[bytes] | None = None,
    arm: ArmModel | None = None,
    beside: Mapping[Path, bytes] | None = None,
) -> None:
    """Write a scan as a folder recording.

    Everything is written into a folder of another name, which is renamed when it is complete; an
    interrupt or a full disk leaves nothing. Images of a folder recording are copied byte by byte,
    those of any other source are written as PNG.

    Parameters
    ----------
    folder
        Must not exist, or be empty.
    source
        What to write.
    progress
        Called with images written, images in all, and the name of the latest.
    names
        (N,) paths of the images inside the recording; if None their own names where those are
        paths of PNG files, else by index.
    encoded
        (N,) the images' PNG files, where they were made already; see `encoded_png`.
    arm
        Geometry that turns joint angles into poses.
    beside
        Files outside the folder that appear with it; see `new_folder`.

    Raises
    ------
    OutputError
        If the folder holds something, or cannot be written.
    InputError
        If an exposure is not what its session says.
    """
    session = written_session(source)
    rows = _named(source, names)
    contents = _contents(source, session) if encoded is None else encoded
    with new_folder(folder, beside) as partial:
        for done, (row, content) in enumerate(zip(rows, contents, strict=True), start=1):
            path = partial / row.source
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            if progress is not None:
                progress(done, len(rows), row.source)
        _write_tables(partial, source, session, rows, arm)


def written_session(source: ScanSource) -> Session:
    """The session as it is written: pixels are stored as exposures deliver them.

    A folder recording's images are copied, so that its session stays as it is.
    """
    session = replace(source.session, is_simulated=source.is_simulated)
    if isinstance(source, FolderRecording):
        return session
    return replace(session, cameras=tuple(_delivered(setup) for setup in session.cameras))


def _delivered(setup: CameraSetup) -> CameraSetup:
    colour: PixelColour = "mono" if setup.colour == "mono" else "rgb"
    return replace(setup, align="low", colour=colour)


def _contents(source: ScanSource, session: Session) -> Iterator[bytes]:
    for k, row in enumerate(source.rows):
        if isinstance(source, FolderRecording):
            yield read_bytes(source.folder / row.source)
        else:
            yield encoded_png(source.exposure(k), session.cameras[row.camera])


def _named(source: ScanSource, names: Sequence[str] | None) -> tuple[ExposureRow, ...]:
    """Rows with the names under which their images are written."""
    if isinstance(source, FolderRecording) and names is None:
        return source.rows
    chosen = [_png_name(row) for row in source.rows] if names is None else names
    rows = tuple(replace(row, source=name) for row, name in zip(source.rows, chosen, strict=True))
    if len({row.source for row in rows}) < len(rows):
        raise InputError("two images would have one name", where=source.name)
    return rows


def _png_name(row: ExposureRow) -> str:
    """Its own name if that is a PNG inside a recording, else one by its index."""
    path = PurePosixPath(row.source)
    is_usable = is_inside(row.source) and path.suffix == ".png" and len(path.parts) > 1
    return row.source if is_usable else f"images/{row.index:04d}.png"


def _write_tables(
    folder: Path,
    source: ScanSource,
    session: Session,
    rows: tuple[ExposureRow, ...],
    arm: ArmModel | None,
) -> None:
    extra = source.exposure_columns if isinstance(source, FolderRecording) else {}
    (folder / EXPOSURES_FILE).write_bytes(csv_bytes(exposure_columns(rows, extra)))
    if source.arm is not None:
        extra = source.arm_columns if isinstance(source, FolderRecording) else {}
        columns = arm_columns(source.arm, session.pose_form, session.rotation, extra)
        (folder / ARM_FILE).write_bytes(csv_bytes(columns))
    model = source.arm_model if isinstance(source, FolderRecording) and arm is None else arm
    if model is not None:
        (folder / ARM_MODEL_FILE).write_bytes(arm_model_toml(model))
    if isinstance(source, FolderRecording) and session.head is not None:
        head = source.folder / session.head
        if head.is_file():
            (folder / session.head).parent.mkdir(parents=True, exist_ok=True)
            (folder / session.head).write_bytes(head.read_bytes())
    (folder / SESSION_FILE).write_bytes(session_toml(session))
