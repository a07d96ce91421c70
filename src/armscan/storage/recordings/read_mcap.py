# SPDX-License-Identifier: Apache-2.0
"""MCAP files of `RecordingWriter` as folder recordings and back; what is whole of a broken one."""

from __future__ import annotations

import base64
import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap import records
from numpy.typing import NDArray

from armscan.devices.sources import ScanSource
from armscan.errors import ArmscanError, FileFormatError, OutputError
from armscan.geometry.arrays import ImageArray
from armscan.records.exposure import Exposure
from armscan.records.recording import (
    NO_TRIGGER,
    ArmTrack,
    CameraSetup,
    ExposureRow,
    Session,
)
from armscan.storage.arm import ARM_FILE, ARM_MODEL_FILE, arm_columns
from armscan.storage.files import (
    check_outputs,
    is_file,
    new_folder,
    path_text,
    read_bytes,
    scratch_folder,
    write_files,
)
from armscan.storage.images import read_exposure
from armscan.storage.recording import (
    FolderRecording,
    Report,
    encoded_png,
    image_files,
    named_rows,
    read_recording,
    written_session,
)
from armscan.storage.recording_session import (
    EXPOSURES_FILE,
    SESSION_FILE,
    exposure_columns,
    has_band,
    is_inside,
    session_toml,
)
from armscan.storage.recordings.mcap_folder import (
    ARM_TOPIC,
    CAMERA_TOPICS,
    DAMAGE,
    DOCUMENT_TOPIC,
    EVENT_TOPIC,
    EVENTS_FILE,
    EXPOSURE_TOPIC,
    NS_PER_S,
    RECOVER_REMEDY,
    TABLES,
    Damage,
    FileSummary,
    RecordedTables,
    StoredMessage,
    opened,
    pieces_of,
    raw_pixels,
    read_summary,
    stored_image,
)
from armscan.storage.recordings.write_mcap import RecordingWriter, WriterOptions, WriterStatus
from armscan.storage.tables import read_csv

ARM_BATCH = 1000
"""Samples in one message: a second of a quick arm."""
LISTED = 5
"""Damages told one by one; of more, the count."""


@dataclass
class ReadBack:
    """What came out of a file.

    Parameters
    ----------
    n_exposures, n_samples, n_events
        Written into the folder.
    n_aside
        Exposures and samples that a table cannot hold: repeated or backward times or ids, names
        outside of the recording.
    n_lost
        Exposures that were recorded and are not whole; the least number without the file's summary.
    is_loss_counted
        True if the file's summary says how many exposures were recorded, so that ``n_lost`` is all.
    seconds
        From the first exposure to the last.
    aside
        What was set aside and why, in words.
    lost
        What the file does not give any more, in words; empty for nothing.
    warnings
        Why the folder cannot be used as it is, in words.
    """

    n_exposures: int = 0
    n_samples: int = 0
    n_events: int = 0
    n_aside: int = 0
    n_lost: int = 0
    is_loss_counted: bool = True
    seconds: float = 0.0
    aside: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass
class _Folder:
    """A recording as it grows in its folder."""

    path: Path
    tables: RecordedTables = field(default_factory=RecordedTables)
    pending: dict[int, StoredMessage] = field(default_factory=dict)
    damages: list[Damage] = field(default_factory=list)
    n_seen: Counter[str] = field(default_factory=Counter)
    n_said: defaultdict[str, int] = field(default_factory=lambda: defaultdict(int))

    def take(self, message: StoredMessage) -> None:
        kind = EXPOSURE_TOPIC if message.topic.startswith(CAMERA_TOPICS) else message.topic
        self.n_said[kind] = max(self.n_said[kind], message.number + 1)
        self.n_seen[message.topic] += 1
        if kind != message.topic:
            self.pending[message.number] = message
        elif kind == EXPOSURE_TOPIC:
            self._take_exposure(message)
        elif kind == DOCUMENT_TOPIC:
            said = json.loads(message.data)
            self.take_document(said["name"], base64.b64decode(said["base64"]))
        else:
            self.tables.take(message)

    def take_document(self, name: str, content: bytes) -> None:
        if is_inside(name) and name not in TABLES:
            self._write(name, content)

    def _take_exposure(self, message: StoredMessage) -> None:
        said = json.loads(message.data)
        image = self.pending.pop(message.number, None)
        # facts come in the order of their images: what is older has lost its own
        self.pending = {n: one for n, one in self.pending.items() if n > message.number}
        if image is None:
            return
        shown = stored_image(image, said)
        self.n_seen["whole"] += 1
        name = self.tables.take_exposure(said)
        if name is not None:
            self._write(name, shown.data if isinstance(shown, CompressedImage) else _png(shown))

    def _write(self, name: str, content: bytes) -> None:
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)

    def finish(self, n_stated: int | None) -> ReadBack:
        """Write the tables, and say what became of it.

        ``n_stated`` exposures were recorded; None if the file does not say so any more.
        """
        tables = self.tables
        for name, content in tables.contents().items():
            self._write(name, content)
        times = tables.times
        found = ReadBack(
            n_exposures=len(tables.exposures),
            n_samples=len(tables.samples),
            n_events=len(tables.events),
            n_aside=tables.aside.total() + tables.n_samples_aside,
            aside=tables.notes,
            n_lost=self.n_lost(n_stated or 0),
            is_loss_counted=n_stated is not None,
            seconds=1e-9 * (max(times) - min(times)) if times else 0.0,
            lost=self._lost(n_stated),
        )
        try:
            read_recording(self.path)
        except ArmscanError as error:
            found.warnings = (f"the folder is no whole recording: {error.what}",)
        return found

    def n_lost(self, n_stated: int) -> int:
        """Exposures that were recorded, as far as is known, and did not come whole."""
        n_whole = self.n_seen["whole"]
        return max(self.n_said[EXPOSURE_TOPIC], n_stated) - n_whole

    def _lost(self, n_stated: int | None) -> tuple[str, ...]:
        said = []
        if n_lost := self.n_lost(n_stated or 0):
            known = f"{n_lost} of {n_stated} exposures"
            said.append(f"at least {n_lost} exposures" if n_stated is None else known)
        for topic, what in ((ARM_TOPIC, "packets of the arm's samples"), (EVENT_TOPIC, "events")):
            if self.n_seen[topic] < self.n_said[topic]:
                said.append(f"at least {self.n_said[topic] - self.n_seen[topic]} {what}")
        for one in self.damages[:LISTED]:
            place = f"{one.n_bytes} bytes from byte {one.place} on ({one.reason})"
            said.append(place if one.n_bytes else f"no byte that is there, but {one.reason}")
        if len(self.damages) > LISTED:
            rest = self.damages[LISTED:]
            said.append(f"{sum(one.n_bytes for one in rest)} bytes in {len(rest)} further places")
        return tuple(said)


def extract_recording(path: Path, folder: Path, *, is_recovering: bool = False) -> ReadBack:
    """Write the recording of an MCAP file as a folder.

    Image files are written as they were recorded, pixels without a file as PNG; cells of the tables
    as they were recorded. Every checksum is checked.

    Parameters
    ----------
    path
        File of `RecordingWriter`.
    folder
        Must not exist, or be empty.
    is_recovering
        Take a file without its end, or a damaged one: all that is whole before and after a damage.

    Raises
    ------
    FileFormatError
        If the file is none of armscan, holds no exposure that is whole, or, unless recovering, is
        unfinished or damaged.
    """
    where = path_text(path)
    stated = _stated(path, is_recovering=is_recovering)
    with new_folder(folder) as partial, opened(path) as file:
        grown = _Folder(partial)
        for piece in pieces_of(file, path.stat().st_size):
            _take(grown, piece)
        if not is_recovering:
            _refuse_lost(grown, stated, where)
        if not grown.tables.exposures:
            is_whole = bool(grown.n_seen["whole"])
            fact = "every exposure in it was taken back or set aside" if is_whole else (
                "no exposure in the file is whole")  # fmt: skip
            raise FileFormatError(fact, where=where, remedy="record again, or look for a copy")
        return grown.finish(None if stated is None else stated.n_exposures)


def _stated(path: Path, *, is_recovering: bool) -> FileSummary | None:
    try:
        return read_summary(path)
    except FileFormatError as error:
        if not is_recovering or error.remedy != RECOVER_REMEDY:
            raise
        return None


def _take(grown: _Folder, piece: list[StoredMessage] | records.Attachment | Damage) -> None:
    if isinstance(piece, Damage):
        grown.damages.append(piece)
    elif isinstance(piece, records.Attachment):
        grown.take_document(piece.name, piece.data)
    else:
        for message in piece:
            try:
                grown.take(message)
            except DAMAGE as error:
                reason = f"a message cannot be read: {error or type(error).__name__}"
                grown.damages.append(Damage(0, len(message.data), reason))


def _refuse_lost(grown: _Folder, stated: FileSummary | None, where: str) -> None:
    n_stated = 0 if stated is None else stated.n_messages
    n_found = sum(n for topic, n in grown.n_seen.items() if topic != "whole")
    fact = ""
    if grown.damages:
        fact = grown.damages[0].reason
    elif n_found != n_stated:
        fact = f"{n_found} messages of {n_stated} are there"
    elif grown.n_lost(0):
        fact = f"{grown.n_lost(0)} exposures have no image"
    if fact:
        raise FileFormatError(f"the file is damaged ({fact})", where=where, remedy=RECOVER_REMEDY)


def _png(shown: RawImage) -> bytes:
    pixels = raw_pixels(shown)
    bits = 8 * pixels.dtype.itemsize
    setup = CameraSetup(bits_used=bits, colour="rgb" if pixels.ndim == 3 else "mono")
    native: NDArray[Any] = pixels.astype(np.uint16 if bits == 16 else np.uint8)
    return encoded_png(Exposure(native, "image", bits_used=bits), setup)


def record_folder(
    folder: Path,
    output: Path,
    *,
    most: int | None = None,
    edit: Callable[[bytes], bytes] | None = None,
    is_stripe_band: bool = False,
) -> WriterStatus:
    """Write a folder recording as an MCAP file; image files and cells of tables stay as they are.

    An ``output`` that exists is replaced when the new one is whole.

    Of ``most`` exposures, the first ones, with what the arm reported a second before and after
    them; of all if None. ``edit`` says what becomes of each document. With ``is_stripe_band``
    (`WriterOptions`) grey pixels are written raw, not as their files; nothing changes, and none is
    said to be kept, where no exposure has one.
    """
    recording = read_recording(folder)
    session = written_session(recording)
    names = [SESSION_FILE, ARM_MODEL_FILE, EVENTS_FILE, *([session.head] if session.head else [])]
    documents = {name: read_bytes(folder / name) for name in names if is_file(folder / name)}
    if session.is_simulated != recording.session.is_simulated:
        documents[SESSION_FILE] = session_toml(session)
    if edit is not None:
        documents = {name: edit(data) for name, data in documents.items()}
    table = read_csv(folder / EXPOSURES_FILE)
    by_index = {row.index: row for row in recording.rows[:most]}
    kept = [k for k, index in enumerate(table.ints("index").tolist()) if index in by_index]
    rows = [by_index[int(table.columns["index"][k])] for k in kept]
    is_stripe_band &= any(has_band(row, session.cameras[row.camera]) for row in rows)
    columns = {name: [cells[k] for k in kept] for name, cells in table.columns.items()}
    arm, arm_cells = recording.arm, {}
    if arm is not None:
        span = slice(None) if most is None else _span(arm, rows, session)
        arm_cells = {
            name: cells[span] for name, cells in read_csv(folder / ARM_FILE).columns.items()
        }
        arm = arm.select(span)
    return _record(
        output,
        _Content(session, documents, rows, columns, arm, arm_cells),
        _stored(recording, rows)
        if is_stripe_band
        else (read_bytes(folder / row.source) for row in rows),
        options=WriterOptions(is_stripe_band=is_stripe_band),
    )


def _stored(
    recording: FolderRecording, rows: Sequence[ExposureRow]
) -> Iterator[ImageArray | bytes]:
    """Pixels, as their files hold them, of images of which a band is kept; files of the others."""
    for row in rows:
        setup, path = recording.session.cameras[row.camera], recording.folder / row.source
        yield read_exposure(path).image if has_band(row, setup) else read_bytes(path)


def _span(arm: ArmTrack, rows: Sequence[ExposureRow], session: Session) -> slice:
    """Samples a second before to a second after exposures; all where the clocks differ."""
    if session.clock == "separate":
        return slice(None)
    times = [row.t_ns for row in rows]
    low, high = min(times) - NS_PER_S, max(times) + NS_PER_S
    return slice(*np.searchsorted(arm.t_ns, (low, high)).tolist())


def record_source(
    output: Path,
    source: ScanSource,
    progress: Report | None = None,
    *,
    encoded: Iterable[bytes] | None = None,
    beside: Mapping[Path, bytes] | None = None,
) -> WriterStatus:
    """Write a scan as an MCAP file: what `write_recording` writes into a folder.

    Parameters
    ----------
    output
        Must not exist.
    source
        What to write.
    progress
        Called with images written, images in all, and the name of the latest.
    encoded
        (N,) the images' PNG files, where they were made already.
    beside
        Files that appear with it; they must not exist.

    Raises
    ------
    OutputError
        If the file exists or cannot be written; nothing is left then.
    """
    check_new_file(output)
    session, rows = written_session(source), named_rows(source)
    columns, arm = exposure_columns(rows, {}), source.arm
    of_arm = {} if arm is None else arm_columns(arm, session.pose_form, session.rotation, {})
    content = _Content(session, {SESSION_FILE: session_toml(session)}, rows, columns, arm, of_arm)
    files = image_files(source, session) if encoded is None else encoded
    return _record(output, content, files, progress=progress, beside=beside)


def check_new_file(output: Path) -> None:
    """Raise before long work if a new file could not be written afterwards."""
    if output.exists():
        raise OutputError("the file exists", where=path_text(output), remedy="name another file")
    check_outputs((output,))


@dataclass(frozen=True, slots=True, eq=False)
class _Content:
    """What a file holds beside its images, which come in the order of ``rows``."""

    session: Session
    documents: Mapping[str, bytes]
    rows: Sequence[ExposureRow]
    columns: Mapping[str, Sequence[str]]
    arm: ArmTrack | None
    arm_cells: Mapping[str, Sequence[str]]


def _record(
    output: Path,
    content: _Content,
    images: Iterable[ImageArray | bytes],
    *,
    progress: Report | None = None,
    beside: Mapping[Path, bytes] | None = None,
    options: WriterOptions | None = None,
) -> WriterStatus:
    with scratch_folder(output) as scratch:
        part = scratch / "recording.mcap"
        try:
            status = _write_all(RecordingWriter(part, options), content, images, progress)
            write_files(beside or {})
            _give_name(part, output, beside or {})
        except OutputError as error:
            cause = error.__cause__
            why = (isinstance(cause, OSError) and cause.strerror) or error.what
            raise OutputError(
                f"nothing was written ({why})",
                where=path_text(output),
                remedy="free some space or choose another folder",
            ) from error
    return status


def _write_all(
    writer: RecordingWriter,
    content: _Content,
    images: Iterable[ImageArray | bytes],
    progress: Report | None,
) -> WriterStatus:
    n_arm, n_before = 0 if content.arm is None else len(content.arm), _samples_before(content)
    n_written = 0
    with writer:
        writer.begin(content.session, content.documents)
        for k, (row, image) in enumerate(zip(content.rows, images, strict=True)):
            n_written = _write_samples(writer, content, n_written, n_before[k])
            cells = {name: column[k] for name, column in content.columns.items()}
            writer.add_exposure(row, image, cells=cells)
            if progress is not None:
                progress(k + 1, len(content.rows), row.source)
        _write_samples(writer, content, n_written, n_arm)
    return writer.status()


def _samples_before(content: _Content) -> list[int]:
    """(E,) samples of the arm that stand before each exposure in the file, none after its pose.

    As they would come live, so that a file that is cut off keeps the poses of what is left: up to
    the sample after the exposure's time or that of its trigger; of separate clocks without
    triggers the same share of samples as of exposures.
    """
    rows, arm = content.rows, content.arm
    if arm is None or not rows:
        return [0] * len(rows)
    after = np.ceil(np.arange(1, len(rows) + 1) * (len(arm) / len(rows))).astype(np.int64)
    if content.session.clock != "separate":
        times = np.array([row.t_ns for row in rows], dtype=np.int64)
        after = np.searchsorted(arm.t_ns, times, "right") + 1
    elif arm.trigger_ids is not None:
        place = {int(trigger): k + 1 for k, trigger in enumerate(arm.trigger_ids)}
        own = [NO_TRIGGER - 1 if row.trigger_id is None else row.trigger_id for row in rows]
        after = np.array([place.get(k, 0) for k in own], dtype=np.int64)
    least = np.minimum(np.maximum.accumulate(after), len(arm))
    return [int(n) for n in least]


def _write_samples(writer: RecordingWriter, content: _Content, first: int, end: int) -> int:
    """Write samples of the arm from one on to before another; returns how many there are now."""
    arm = content.arm
    while arm is not None and first < end:
        span = slice(first, min(first + ARM_BATCH, end))
        cells = {name: column[span] for name, column in content.arm_cells.items()}
        writer.add_arm_samples(arm.select(span), cells=cells)
        first = span.stop
    return first


def _give_name(part: Path, output: Path, beside: Mapping[Path, bytes]) -> None:
    try:
        part.replace(output)
    except OSError as error:
        for path in beside:
            path.unlink(missing_ok=True)
        raise OutputError("the file cannot get its name", where=path_text(output)) from error
