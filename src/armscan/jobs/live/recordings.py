# SPDX-License-Identifier: Apache-2.0
"""Recordings from a folder to one file and back, what is whole of a broken file, and which there
are in a folder.
"""

from __future__ import annotations

import math
from hashlib import sha256
from pathlib import Path

from armscan.errors import ArmscanError, FileFormatError, InputError, OptionError, OutputError
from armscan.reconstruction.sync import exposure_poses
from armscan.report.quantity import Quantity, Summary
from armscan.storage.clouds import CLOUD_SUFFIXES
from armscan.storage.files import (
    check_outputs,
    is_folder,
    packed_notes,
    path_text,
    read_bytes,
    scratch_folder,
)
from armscan.storage.image_paths import IMAGE_SUFFIXES
from armscan.storage.recording import is_recording, read_recording, recording_tables
from armscan.storage.recording_session import EXPOSURES_FILE, has_band
from armscan.storage.recordings.mcap_folder import read_summary
from armscan.storage.recordings.read_mcap import ReadBack, extract_recording, record_folder

SUFFIX = ".mcap"


def recordings_in(folder: Path) -> list[Path]:
    """Recordings in a folder that is none itself, by name; what is hidden is left.

    Raises
    ------
    InputError
        If images lie beside them: it does not tell which of the two is meant.
    """
    if not is_folder(folder) or is_recording(folder):
        return []
    # a file system's own, and recordings that are not yet whole
    there = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    found = [path for path in there if is_recording(path)]
    images = [path.name for path in there if path.suffix.lower() in IMAGE_SUFFIXES]
    if found and images:
        raise InputError(
            f"image {images[0]} lies beside the recording {found[0].name}",
            where=str(folder),
            remedy="put images and recordings into folders of their own",
        )
    return found


def count_exposures(recording: Path) -> int:
    """Exposures that a recording lists, without a look at them; 0 if it cannot be read."""
    try:
        if not is_folder(recording):
            return read_summary(recording).n_exposures
        lines = read_bytes(recording / EXPOSURES_FILE).splitlines()
    except FileFormatError:
        return 0
    return max(sum(bool(line) and not line.startswith(b"#") for line in lines) - 1, 0)


def recording_mark(recording: Path, given: str) -> str:
    """Hash of what a result follows from: a recording's tables, its images' or its file's sizes and
    times, and what else was ``given``.
    """
    mark = sha256(given.encode())
    files = [recording]
    if is_folder(recording):
        for path in recording_tables(recording):
            mark.update(path.name.encode() + read_bytes(path))
        files = sorted(one for one in recording.rglob("*") if one.suffix.lower() in IMAGE_SUFFIXES)
    for path in files:
        facts = path.stat()
        mark.update(f"{path.name} {facts.st_size} {facts.st_mtime_ns}".encode())
    return mark.hexdigest()


def convert_recording(
    source: Path, output: Path, *, is_overwriting: bool = False, is_stripe_band: bool = False
) -> Summary:
    """Write a folder recording as one file, or the other way."""
    if is_stripe_band and output.suffix.lower() != SUFFIX:
        raise OptionError(
            "a stripe band is for recordings in one file",
            where="--stripe-band",
            remedy=f"end the new name in {SUFFIX}, or leave it out",
        )
    _refuse_points(output, source)
    if output.exists() and source.exists() and output.samefile(source):
        raise OutputError(
            f"{output.name} is read, and would be replaced",
            where=str(output),
            remedy="give another name",
        )
    if source.suffix.lower() == SUFFIX and output.suffix.lower() != SUFFIX:
        return _summary("Converted: recording to a folder.", extract_recording(source, output),
                        output)  # fmt: skip
    if not is_folder(source) and not (is_stripe_band and is_recording(source)):
        raise OptionError(
            f"there is no conversion from {source.name} to {output.name}",
            remedy="convert the folder of a recording to .mcap, or a .mcap to a folder",
        )
    check_outputs((output,), is_overwriting=is_overwriting)
    status = record_folder(source, output, is_stripe_band=is_stripe_band)
    made = read_recording(output) if is_stripe_band else None
    n_banded = (
        0
        if made is None
        else sum(has_band(row, made.session.cameras[row.camera]) for row in made.rows)
    )
    return Summary(
        title="Converted: recording to one file.",
        warnings=packed_notes(source),
        quantities=(
            Quantity("exposures", "exposures", status.n_written),
            *((Quantity("with_band", "of these as a band", n_banded),) if is_stripe_band else ()),
        ),
        written=(output,),
        next_step=f"armscan convert {output} FOLDER",
        extra={"kind": "conversion"},
    )


def recover_recording(source: Path, output: Path, *, is_overwriting: bool = False) -> Summary:
    """Write what is whole of a killed or damaged file as a folder, or a file that has its end."""
    title = "Recovered."
    _refuse_points(output, source)
    if output.exists() and output.samefile(source):
        raise OutputError(
            "this is the damaged file itself", where=f"-o {output}", remedy="name another file"
        )
    if output.suffix.lower() != SUFFIX:
        found = extract_recording(source, output, is_recovering=True)
        return _summary(title, found, output, _lost_poses(output, found))
    check_outputs((output,), is_overwriting=is_overwriting)
    with scratch_folder(output) as scratch:
        folder = scratch / "recording"
        found = extract_recording(source, folder, is_recovering=True)
        poses = _lost_poses(folder, found)
        try:
            record_folder(folder, output)
        except FileFormatError as error:
            raise OutputError(
                f"what came back is no recording to be read ({error.what})",
                where=path_text(source),
                remedy="save it as a folder, which you can mend: armscan recover "
                f"{path_text(source)} -o {path_text(output.with_suffix(''))}",
            ) from error
    return _summary(title, found, output, poses)


def _lost_poses(folder: Path, found: ReadBack) -> tuple[str, ...]:
    """Say if exposures came back whose poses did not; nothing of a file that lost nothing."""
    if not found.lost:
        return ()
    if not found.n_samples:
        return (
            "NO POSES: the file gives no sample of the arm; if an arm was recorded, none of the "
            f"{found.n_exposures} exposures that came back can be placed",
        )
    try:
        scan = read_recording(folder)
        poses = exposure_poses(scan.rows, scan.arm, scan.session.clock)
    except ArmscanError as error:
        return (f"NO POSES: of {found.n_exposures} exposures none can be placed ({error.what})",)
    n_lost = int((~poses.has_pose).sum())
    if not n_lost:
        return ()
    return (
        f"POSES LOST: {n_lost} of {found.n_exposures} exposures that came back have no pose "
        f"({poses.missing})",
    )


def _refuse_points(output: Path, source: Path) -> None:
    """Raise if a recording is to become a cloud: it holds images."""
    if output.suffix.lower() in CLOUD_SUFFIXES:
        raise OptionError(
            f"'{output.name}' is the name of a cloud, and a recording holds images",
            where=path_text(source),
            remedy=f"measure its points: armscan reconstruct {source} --scanner scanner.json "
            f"-o {output}",
        )


def _lost_exposures(found: ReadBack) -> Quantity:
    """How many exposures are lost; without the file's summary only the least number is known."""
    key, label = "lost_exposures", "lost exposures"
    if found.is_loss_counted:
        return Quantity(key, label, found.n_lost)
    shown = f"at least {found.n_lost:,}" if found.n_lost else "not known"
    meaning = "the end of the file, which has their count, is gone"
    return Quantity(key, label, math.nan, meaning=meaning, shown=shown)


def _summary(title: str, found: ReadBack, output: Path, poses: tuple[str, ...] = ()) -> Summary:
    is_file = output.suffix.lower() == SUFFIX
    return Summary(
        title=title,
        quantities=(
            Quantity("exposures", "exposures", found.n_exposures),
            Quantity("arm_samples", "arm samples", found.n_samples),
            Quantity("events", "events", found.n_events),
            Quantity("set_aside", "set aside", found.n_aside),
            _lost_exposures(found),
            Quantity("least_lost_exposures", "", found.n_lost),
            Quantity("seconds", "duration", found.seconds, unit="s"),
        ),
        warnings=(*poses, *(f"lost: {text}" for text in found.lost), *found.aside, *found.warnings),
        written=(output,),
        next_step=f"armscan convert {output} FOLDER" if is_file else f"armscan info {output}",
        extra={"kind": "recording", "lost": list(found.lost)},
    )
