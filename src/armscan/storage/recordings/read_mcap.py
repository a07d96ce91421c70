# SPDX-License-Identifier: Apache-2.0
"""MCAP files of `RecordingWriter` as folder recordings and back; what is whole of a broken one."""

from __future__ import annotations

import json
import struct
import zlib
from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import zstandard
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.stream_reader import StreamReader, breakup_chunk
from numpy.typing import NDArray

from armscan.errors import ArmscanError, FileFormatError
from armscan.records.exposure import Exposure
from armscan.records.recording import CameraSetup, ExposureRow
from armscan.storage.arm import ARM_FILE, ARM_MODEL_FILE
from armscan.storage.files import new_folder, path_text, read_bytes, scratch_folder
from armscan.storage.recording import encoded_png, read_recording, written_session
from armscan.storage.recording_session import (
    EXPOSURES_FILE,
    MOST_CAMERAS,
    SESSION_FILE,
    is_inside,
    session_toml,
)
from armscan.storage.recordings.write_mcap import (
    ARM_TOPIC,
    EVENT_TOPIC,
    EXPOSURE_TOPIC,
    MAGIC,
    TRANSFORM_TOPIC,
    RecordingWriter,
    WriterStatus,
)
from armscan.storage.tables import csv_bytes, read_csv

EVENTS_FILE = "events.jsonl"
TABLES = {EXPOSURES_FILE, ARM_FILE}
FOOTER = struct.Struct("<BQQQI")
ARM_BATCH = 1000
"""Samples in one message: a second of a quick arm."""
RECOVER_REMEDY = "run `armscan recover` on it first"
DAMAGE = (
    *(McapError, DecodeError, zstandard.ZstdError, struct.error),
    *(ValueError, KeyError, IndexError, TypeError, EOFError, OverflowError, MemoryError),
)
"""What readers of bytes raise where the bytes are not what they should be."""


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
    seconds
        From the first exposure to the last.
    lost
        What the file does not give any more, in words; empty for nothing.
    warnings
        Why the folder cannot be used as it is, in words.
    """

    n_exposures: int = 0
    n_samples: int = 0
    n_events: int = 0
    n_aside: int = 0
    seconds: float = 0.0
    lost: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass
class _Folder:
    """A recording as it grows in its folder."""

    path: Path
    found: ReadBack = field(default_factory=ReadBack)
    topics: dict[int, str] = field(default_factory=dict)
    pending: dict[str, deque[bytes]] = field(default_factory=lambda: defaultdict(deque))
    exposures: list[dict[str, str]] = field(default_factory=list)
    samples: list[dict[str, str]] = field(default_factory=list)
    events: list[bytes] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    latest: dict[str, int] = field(default_factory=dict)
    ids: set[tuple[str, str]] = field(default_factory=set)
    checksums: dict[str, int] = field(default_factory=dict)
    n_messages: int = 0

    def take(self, record: records.McapRecord) -> None:
        if isinstance(record, records.Channel):
            self.topics[record.id] = record.topic
        elif isinstance(record, records.Attachment):
            if is_inside(record.name) and record.name not in TABLES:
                self._write(record.name, record.data)
        elif isinstance(record, records.Message):
            self.n_messages += 1
            self._take_message(self.topics[record.channel_id], record.data)

    def _take_message(self, topic: str, data: bytes) -> None:
        if topic.startswith("/camera/"):
            self.pending[topic].append(data)
        elif topic == EXPOSURE_TOPIC:
            self._exposure(json.loads(data))
        elif topic == ARM_TOPIC:
            said = json.loads(data)
            for row in said["rows"]:
                self._sample(dict(zip(said["columns"], row, strict=True)))
        elif topic == EVENT_TOPIC:
            self.events.append(data)
        elif topic != TRANSFORM_TOPIC:
            raise ValueError("a topic is not one of armscan")

    def _exposure(self, said: dict[str, Any]) -> None:
        facts, cells = said["image"], dict(said["cells"])
        content = self.pending[facts["topic"]].popleft()
        shown = CompressedImage() if facts["stored"] == "file" else RawImage()
        shown.ParseFromString(content)
        if zlib.crc32(shown.data) != facts["crc32"]:
            raise ValueError("an image is not the one that was recorded")
        name = str(said["file"])
        if isinstance(shown, RawImage):
            name = name if name.lower().endswith(".png") else f"{name}.png"
            cells["file"] = name
        keys = [("index", cells["index"])]
        if cells.get("trigger_id"):
            keys.append((f"trigger of camera {said['camera']}", cells["trigger_id"]))
        is_usable = (
            is_inside(name)
            and name not in TABLES
            and 0 <= said["camera"] < MOST_CAMERAS
            and self.checksums.get(name, facts["crc32"]) == facts["crc32"]
        )
        if not (is_usable and self._is_next(f"camera {said['camera']}", said["t_ns"], keys)):
            self.found.n_aside += 1
            return
        self._write(name, shown.data if isinstance(shown, CompressedImage) else _png(shown))
        self.checksums[name] = facts["crc32"]
        if said["flags"]:
            cells["flags"] = "+".join(said["flags"])
        self.exposures.append(cells)
        self.times.append(said["t_ns"])

    def _sample(self, cells: dict[str, str]) -> None:
        number = cells.get("trigger_id")
        if self._is_next("arm", int(cells["t_ns"]), [("arm", number)] if number else []):
            self.samples.append(cells)
        else:
            self.found.n_aside += 1

    def _is_next(self, source: str, t_ns: int, ids: list[tuple[str, str]]) -> bool:
        """False for what the tables' parsers refuse."""
        if t_ns <= self.latest.get(source, t_ns - 1) or not self.ids.isdisjoint(ids):
            return False
        self.latest[source] = t_ns
        self.ids.update(ids)
        return True

    def _write(self, name: str, content: bytes) -> None:
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)

    def finish(self) -> None:
        """Write the tables, and say what became of it."""
        for name, rows in ((EXPOSURES_FILE, self.exposures), (ARM_FILE, self.samples)):
            heads = dict.fromkeys(head for row in rows for head in row)
            if rows:
                columns = {head: tuple(row.get(head, "") for row in rows) for head in heads}
                self._write(name, csv_bytes(columns))
        if self.events:
            self._write(EVENTS_FILE, b"".join(line + b"\n" for line in self.events))
        found = self.found
        found.n_exposures, found.n_samples = len(self.exposures), len(self.samples)
        found.n_events = len(self.events)
        found.seconds = 1e-9 * (max(self.times) - min(self.times)) if self.times else 0.0
        try:
            read_recording(self.path)
        except ArmscanError as error:
            found.warnings = (f"the folder is no whole recording: {error.what}",)


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
        Take a file without its end, or a damaged one, up to the damage.

    Raises
    ------
    FileFormatError
        If the file is none of armscan, holds no exposure that is whole, or, unless recovering, is
        unfinished or damaged.
    OutputError
        If the folder holds something, or cannot be written.
    """
    where = path_text(path)
    n_stated = None if is_recovering else _stated_messages(path)
    with new_folder(folder) as partial, _opened(path) as file:
        grown = _Folder(partial)
        size = path.stat().st_size
        damage, place = "", 0
        try:
            for record in _records(file, size):
                grown.take(record)
                place = file.tell()
        except DAMAGE as error:
            damage = f"{error}" or type(error).__name__
        if not is_recovering and (damage or grown.n_messages != n_stated):
            fact = damage or f"{grown.n_messages} messages of {n_stated} are there"
            raise FileFormatError(f"the file is damaged ({fact})", where=where,
                                  remedy=RECOVER_REMEDY)  # fmt: skip
        if not grown.exposures:
            raise FileFormatError("no exposure in the file is whole", where=where,
                                  remedy="record again, or look for a copy")  # fmt: skip
        grown.finish()
        grown.found.lost = _lost(grown, damage, size - place)
        return grown.found


def _lost(grown: _Folder, damage: str, n_bytes: int) -> tuple[str, ...]:
    said = []
    if damage:
        said.append(f"the last {n_bytes} bytes, from the damage on ({damage})")
    n_images = sum(map(len, grown.pending.values()))
    if n_images:
        said.append(f"{n_images} images whose facts were not written any more")
    return tuple(said)


def _opened(path: Path) -> BinaryIO:
    try:
        with path.open("rb") as file:
            head = file.read(len(MAGIC))
        if head == MAGIC:
            return path.open("rb")
    except (OSError, ValueError):
        read_bytes(path)
    raise FileFormatError(
        "this is no MCAP file" if head else "the file is empty (0 bytes)",
        where=path_text(path),
        remedy="name a recording that armscan wrote",
    )


def _records(file: BinaryIO, size: int) -> Iterator[records.McapRecord]:
    """Records of the data, chunks broken up; each is whole, its checksum right."""
    reader = StreamReader(
        file, emit_chunks=True, validate_crcs=True, record_size_limit=max(size, 1)
    )
    for record in reader.records:
        if isinstance(record, records.DataEnd):
            return
        if isinstance(record, records.Chunk):
            yield from breakup_chunk(record, validate_crc=True)
        else:
            if isinstance(record, records.Attachment):
                _check_attachment(record, file)
            yield record
    raise EOFError("the file has no end")


def _check_attachment(record: records.Attachment, file: BinaryIO) -> None:
    """The library reads an attachment's checksum and does not compare it."""
    file.seek(-4, 1)
    builder = RecordBuilder()
    record.write(builder)
    if bytes(builder.end())[-4:] != file.read(4):
        raise ValueError("an attachment's checksum is wrong")


def _stated_messages(path: Path) -> int:
    """Messages that the summary of a finished file counts."""
    with _opened(path) as file:
        size = path.stat().st_size
        length = FOOTER.size + len(MAGIC)
        file.seek(max(size - length, 0))
        tail = file.read()
        try:
            _, _, start, _, crc = FOOTER.unpack_from(tail)
            if not tail.endswith(MAGIC) or not 0 < start <= size - length:
                raise ValueError
            file.seek(start)
            body = file.read(size - length - start)
            if zlib.crc32(tail[: FOOTER.size - 4], zlib.crc32(body)) != crc:
                raise ValueError
            file.seek(start)
            for record in StreamReader(file, skip_magic=True).records:
                if isinstance(record, records.Statistics):
                    return record.message_count
        except DAMAGE:
            pass
    raise FileFormatError(
        "the recording is unfinished: it has no whole summary",
        where=path_text(path),
        remedy=RECOVER_REMEDY,
    )


def _png(shown: RawImage) -> bytes:
    channels = 3 if shown.encoding == "rgb8" else 1
    dtype = "<u2" if shown.encoding == "mono16" else "u1"
    shape = (shown.height, shown.width, 3) if channels == 3 else (shown.height, shown.width)
    pixels = np.frombuffer(shown.data, dtype).reshape(shape)
    bits = 16 if dtype == "<u2" else 8
    setup = CameraSetup(bits_used=bits, colour="rgb" if channels == 3 else "mono")
    native: NDArray[Any] = pixels.astype(np.uint16 if bits == 16 else np.uint8)
    return encoded_png(Exposure(native, "image", bits_used=bits), setup)


def record_folder(folder: Path, output: Path) -> WriterStatus:
    """Write a folder recording as an MCAP file; image files and cells of tables stay as they are.

    An ``output`` that exists is replaced when the new one is whole.

    Raises
    ------
    FileFormatError
        If the recording cannot be read.
    OutputError
        If the file cannot be written.
    """
    recording = read_recording(folder)
    session = written_session(recording)
    names = [SESSION_FILE, ARM_MODEL_FILE, EVENTS_FILE, *([session.head] if session.head else [])]
    documents = {name: read_bytes(folder / name) for name in names if (folder / name).is_file()}
    if session.is_simulated != recording.session.is_simulated:
        documents[SESSION_FILE] = session_toml(session)
    table = read_csv(folder / EXPOSURES_FILE)
    by_index = {row.index: row for row in recording.rows}
    with scratch_folder(output) as scratch:
        part = scratch / "recording.mcap"
        with RecordingWriter(part) as writer:
            writer.begin(session, documents)
            for k, index in enumerate(table.ints("index").tolist()):
                row: ExposureRow = by_index[index]
                cells = {name: column[k] for name, column in table.columns.items()}
                writer.add_exposure(row, read_bytes(folder / row.source), cells=cells)
            if recording.arm is not None:
                arm_cells = read_csv(folder / ARM_FILE).columns
                for first in range(0, len(recording.arm), ARM_BATCH):
                    span = slice(first, first + ARM_BATCH)
                    writer.add_arm_samples(
                        recording.arm.select(span),
                        cells={name: cells[span] for name, cells in arm_cells.items()},
                    )
        status = writer.status()
        part.replace(output)
    return status
