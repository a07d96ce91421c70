# SPDX-License-Identifier: Apache-2.0
"""An MCAP recording piece by piece, over damage as well, and as the folder that it holds."""

from __future__ import annotations

import json
import re
import struct
import threading
import zlib
from collections import Counter, OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import zstandard
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from armscan.errors import FileFormatError
from armscan.storage.arm import ARM_FILE, ARM_MODEL_FILE
from armscan.storage.files import is_file, path_text, read_bytes
from armscan.storage.recording_session import (
    EXPOSURES_FILE,
    MOST_CAMERAS,
    SESSION_FILE,
    is_inside,
)
from armscan.storage.tables import csv_bytes

MAGIC = b"\x89MCAP0\r\n"
EXPOSURE_TOPIC, ARM_TOPIC, EVENT_TOPIC = "/exposures", "/arm/samples", "/events"
TRANSFORM_TOPIC, DOCUMENT_TOPIC = "/tf", "/documents"
EVENTS_FILE = "events.jsonl"
TABLES = {EXPOSURES_FILE, ARM_FILE}
OWN_NAMES = {*TABLES, SESSION_FILE, ARM_MODEL_FILE, EVENTS_FILE}
"""No image is called so."""
HEAD = struct.Struct("<BQ")
FOOTER = struct.Struct("<BQQQI")
CHUNK_HEAD = struct.Struct("<QQQII")
MESSAGE_HEAD = struct.Struct("<HIQQ")
CHUNK_BEGIN = re.compile(rb"(?=\x06.{5}\x00{3}.{28}[\x00\x03\x04]\x00{3})", re.DOTALL)
"""Opcode, a length below a terabyte, times, size, checksum, length of the compression's name."""
WINDOW_BYTES = 16 << 20
MOST_RECORD_BYTES, MOST_OTHER_BYTES = 1 << 31, 1 << 28
"""Of a chunk, and of any other record."""
LONGEST_NAME = 4
"""Of a compression: zstd."""
MOST_OPCODE = 15
ASIDE_FLAGS = {
    "incomplete": "lack parts",
    "no-time": "have no time that is known",
    "back": "have a time that goes back",
    "late": "came after newer ones",
}
"""Why a frame is in the file and used by none."""
REPEATED = "repeat or go back"
NS_PER_S = 1_000_000_000
UNKNOWN_SIZE = zstandard.CONTENTSIZE_UNKNOWN
LISTED_KINDS = frozenset({EXPOSURE_TOPIC, ARM_TOPIC, EVENT_TOPIC})
CAMERA_TOPICS = "/camera/"
KEPT_CHUNKS = 4
"""Unpacked and kept: exposures are mostly read one after the other, of each camera."""
KEPT_FILES = 8
TAKEN_BACK = "taken-back"
"""An event: exposures from its ``since`` on that stand before it are in the file, and listed by no
table."""
RECOVER_REMEDY = "run `armscan recover` on it first"
DAMAGE = (
    *(McapError, DecodeError, zstandard.ZstdError, struct.error),
    *(ValueError, KeyError, IndexError, TypeError, AttributeError),
    *(EOFError, OverflowError, MemoryError, RecursionError),
)
"""What readers of bytes raise where the bytes are not what they should be."""


class StoredMessage(NamedTuple):
    """A message of a chunk: an exposure's image and its facts have one number."""

    topic: str
    number: int
    data: bytes


class Damage(NamedTuple):
    """Bytes that hold nothing whole, and why."""

    place: int
    n_bytes: int
    reason: str


@dataclass(frozen=True, slots=True)
class FileSummary:
    """What a finished file lists of itself.

    ``chunks``: in the order of the file. ``topics``: of the channels' numbers. ``attachments``: all
    of them. ``n_messages``, ``n_exposures``: in the file.
    """

    chunks: tuple[records.ChunkIndex, ...]
    topics: dict[int, str]
    attachments: tuple[records.AttachmentIndex, ...]
    n_messages: int
    n_exposures: int


@dataclass
class RecordedTables:
    """The tables of a recording as its messages are read, one after the other.

    ``exposures``, ``samples``: their lines. ``events``: as they were recorded. ``aside``: counts of
    exposures that no table lists, by reason. ``n_samples_aside``: samples that the table's parser
    would refuse.
    """

    exposures: list[dict[str, str]] = field(default_factory=list)
    samples: list[dict[str, str]] = field(default_factory=list)
    events: list[bytes] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    aside: Counter[str] = field(default_factory=Counter)
    n_samples_aside: int = 0
    latest: dict[str, int] = field(default_factory=dict)
    ids: set[tuple[str, str]] = field(default_factory=set)
    checksums: dict[str, int] = field(default_factory=dict)

    def take(self, message: StoredMessage) -> None:
        """Samples of the arm and events."""
        if message.topic == ARM_TOPIC:
            said = json.loads(message.data)
            for row in said["rows"]:
                self._take_sample(dict(zip(said["columns"], row, strict=True)))
        elif message.topic == EVENT_TOPIC:
            self.events.append(message.data)
            if TAKEN_BACK.encode() in message.data:
                self._take_back(json.loads(message.data))
        elif message.topic not in (TRANSFORM_TOPIC, DOCUMENT_TOPIC):
            raise ValueError("a topic is not one of armscan")

    def take_exposure(self, said: dict[str, Any]) -> str | None:
        """The name under which an exposure is listed from now on; None if it is set aside."""
        facts, cells, name = said["image"], dict(said["cells"]), str(said["file"])
        if facts["stored"] == "raw":
            name = name if name.lower().endswith(".png") else f"{name}.png"
            cells["file"] = name
        keys = [("index", cells["index"])]
        if cells.get("trigger_id"):
            keys.append((f"trigger of camera {said['camera']}", cells["trigger_id"]))
        fault = next((text for flag, text in ASIDE_FLAGS.items() if flag in said["flags"]), "")
        is_usable = (
            not fault
            and is_inside(name)
            and name not in OWN_NAMES
            and 0 <= said["camera"] < MOST_CAMERAS
            and self.checksums.get(name, facts["crc32"]) == facts["crc32"]
        )
        if not (is_usable and self._is_next(f"camera {said['camera']}", said["t_ns"], keys)):
            self.aside[fault or REPEATED] += 1
            return None
        self.checksums[name] = facts["crc32"]
        if said["flags"]:
            cells["flags"] = "+".join(said["flags"])
        self.exposures.append(cells)
        self.times.append(said["t_ns"])
        return name

    def _take_back(self, event: dict[str, Any]) -> None:
        if event["kind"] == TAKEN_BACK:
            # files of before had no end: all that came so far
            facts = {"until": 2**63, **event["facts"]}
            gone = range(int(facts["since"]), int(facts["until"]))
            kept = [k for k, row in enumerate(self.exposures) if int(row["index"]) not in gone]
            self.exposures = [self.exposures[k] for k in kept]
            self.times = [self.times[k] for k in kept]

    def _take_sample(self, cells: dict[str, str]) -> None:
        number = cells.get("trigger_id")
        if self._is_next("arm", int(cells["t_ns"]), [("arm", number)] if number else []):
            self.samples.append(cells)
        else:
            self.n_samples_aside += 1

    @property
    def notes(self) -> tuple[str, ...]:
        """What the file holds and the tables do not, in words."""
        why = ", ".join(f"{n} {text}" for text, n in self.aside.items())
        found = [(self.aside.total(), len(self.exposures), "exposures", why)]
        found.append((self.n_samples_aside, len(self.samples), "samples of the arm", REPEATED))
        return tuple(
            f"{n} of {n + n_used} {what} in the file are set aside: {reason}"
            for n, n_used, what, reason in found
            if n
        )

    def _is_next(self, source: str, t_ns: int, ids: list[tuple[str, str]]) -> bool:
        """False for what the tables' parsers refuse."""
        if t_ns <= self.latest.get(source, t_ns - 1) or not self.ids.isdisjoint(ids):
            return False
        self.latest[source] = t_ns
        self.ids.update(ids)
        return True

    def contents(self) -> dict[str, bytes]:
        """The tables as files, by name; none that would be empty."""
        found = {}
        for name, rows in ((EXPOSURES_FILE, self.exposures), (ARM_FILE, self.samples)):
            heads = dict.fromkeys(head for row in rows for head in row)
            if rows:
                columns = {head: tuple(row.get(head, "") for row in rows) for head in heads}
                found[name] = csv_bytes(columns)
        if self.events:
            found[EVENTS_FILE] = b"".join(line + b"\n" for line in self.events)
        return found


def stored_image(message: StoredMessage, said: Mapping[str, Any]) -> CompressedImage | RawImage:
    """The image of an exposure, of which its facts speak.

    Raises
    ------
    ValueError
        If it is another one.
    """
    facts = said["image"]
    shown = CompressedImage() if facts["stored"] == "file" else RawImage()
    shown.ParseFromString(message.data)
    if message.topic != facts["topic"] or zlib.crc32(shown.data) != facts["crc32"]:
        raise ValueError("an image is not the one that was recorded")
    return shown


def raw_pixels(shown: RawImage) -> NDArray[Any]:
    """Pixels (H, W) uint8 or little-endian uint16, or (H, W, 3) uint8, of a raw image."""
    dtype = "<u2" if shown.encoding == "mono16" else "u1"
    shape = (shown.height, shown.width, *((3,) if shown.encoding == "rgb8" else ()))
    return np.frombuffer(shown.data, dtype).reshape(shape)


def _netpbm(shown: RawImage) -> bytes:
    """A raw image as a file, without work: PGM, or PPM of colours."""
    pixels = raw_pixels(shown)
    kind, greatest = (6 if pixels.ndim == 3 else 5), np.iinfo(pixels.dtype).max
    head = f"P{kind}\n{shown.width} {shown.height}\n{greatest}\n".encode()
    return head + (shown.data if greatest == 255 else pixels.astype(">u2").tobytes())


def pieces_of(
    file: BinaryIO, size: int
) -> Iterator[list[StoredMessage] | records.Attachment | Damage]:
    """What is whole in a file, in its order, and where it is damaged.

    After a damage it goes on with the next chunk that is whole. A file without its end ends in a
    damage.
    """
    topics: dict[int, str] = {}
    place = len(MAGIC)
    while place < size:
        end, reason = place, "a record is cut or is none"
        opcode, length = _record_head(file, place)
        is_record = 0 < opcode <= MOST_OPCODE and length <= size - place - HEAD.size
        if is_record and _is_likely(file, opcode, length):
            end = place + HEAD.size + length
            file.seek(place + HEAD.size)
            if opcode == Opcode.DATA_END:
                return
            try:
                found = _parsed(opcode, file.read(length), topics)
            except DAMAGE as error:
                reason = f"{error}" or type(error).__name__
            else:
                if found is not None:
                    yield found
                place = end
                continue
            if not 0 < _record_head(file, end)[0] <= MOST_OPCODE:
                end = place
        begin, place = place, end if end > place else _next_chunk(file, place + 1, size)
        yield Damage(begin, place - begin, reason)
    yield Damage(size, 0, "the file has no end")


def _record_head(file: BinaryIO, place: int) -> tuple[int, int]:
    file.seek(place)
    head = file.read(HEAD.size)
    return HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)


def _is_likely(file: BinaryIO, opcode: int, length: int) -> bool:
    """Whether a record may be so long: a wrong length must not fill the memory."""
    if opcode != Opcode.CHUNK:
        return length <= MOST_OTHER_BYTES
    head = file.read(CHUNK_HEAD.size + LONGEST_NAME + 8)
    if len(head) < CHUNK_HEAD.size + 8:
        return False
    _, _, n_bytes, _, n_name = CHUNK_HEAD.unpack_from(head)
    if n_name > LONGEST_NAME or max(n_bytes, length) > MOST_RECORD_BYTES:
        return False
    packed = head[CHUNK_HEAD.size + n_name :][:8]
    return bool(length == CHUNK_HEAD.size + n_name + 8 + int.from_bytes(packed, "little"))


def _next_chunk(file: BinaryIO, place: int, size: int) -> int:
    """Where the next chunk that is whole begins; the file's size if none is."""
    while place < size:
        file.seek(place)
        window = file.read(WINDOW_BYTES)
        for match in CHUNK_BEGIN.finditer(window):
            begin = place + match.start()
            length = _record_head(file, begin)[1]
            if length > size - begin - HEAD.size or not _is_likely(file, Opcode.CHUNK, length):
                continue
            file.seek(begin + HEAD.size)
            try:
                chunk_content(file.read(length))
            except DAMAGE:
                continue
            return begin
        place += max(len(window) - 64, 1) if len(window) == WINDOW_BYTES else len(window)
    return size


def _parsed(
    opcode: int, body: bytes, topics: dict[int, str]
) -> list[StoredMessage] | records.Attachment | None:
    if opcode == Opcode.CHUNK:
        return chunk_messages(chunk_content(body), topics)
    if opcode == Opcode.MESSAGE:
        return [_message(body, topics)]
    if opcode == Opcode.CHANNEL:
        channel = records.Channel.read(ReadDataStream(BytesIO(body)))
        topics[channel.id] = channel.topic
    elif opcode == Opcode.ATTACHMENT:
        return attachment_of(body)
    return None


def attachment_of(body: bytes) -> records.Attachment:
    """An attachment whose checksum is right."""
    if zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
        raise ValueError("an attachment's checksum is wrong")
    found: records.Attachment = records.Attachment.read(ReadDataStream(BytesIO(body)))
    return found


def chunk_content(body: bytes) -> bytes:
    """Records of a chunk, unpacked; its checksum is right."""
    _, _, n_bytes, crc, n_name = CHUNK_HEAD.unpack_from(body)
    start = CHUNK_HEAD.size + n_name + 8
    name = body[CHUNK_HEAD.size : start - 8]
    (n_packed,) = struct.unpack_from("<Q", body, start - 8)
    if n_packed != len(body) - start or n_bytes > MOST_RECORD_BYTES:
        raise ValueError("a chunk's lengths are wrong")
    packed = body[start:]
    if name == b"zstd":
        if zstandard.get_frame_parameters(packed).content_size not in (n_bytes, UNKNOWN_SIZE):
            raise ValueError("a chunk's lengths are wrong")
        packed = zstandard.ZstdDecompressor().decompress(packed, max_output_size=n_bytes)
    elif name:
        raise ValueError(f"a chunk is packed as '{name.decode(errors='replace')[:20]}'")
    if len(packed) != n_bytes or zlib.crc32(packed) != crc:
        raise ValueError("a chunk's checksum is wrong")
    return packed


def chunk_messages(content: bytes, topics: dict[int, str]) -> list[StoredMessage]:
    """Messages of a chunk; what it declares of channels is added to ``topics``."""
    place, found = 0, []
    while place < len(content):
        opcode, length = HEAD.unpack_from(content, place)
        place += HEAD.size
        body = content[place : place + length]
        if len(body) != length:
            raise ValueError("a chunk's record is cut")
        if opcode == Opcode.CHANNEL:
            channel = records.Channel.read(ReadDataStream(BytesIO(body)))
            topics[channel.id] = channel.topic
        elif opcode == Opcode.MESSAGE:
            found.append(_message(body, topics))
        place += length
    return found


def _message(body: bytes, topics: Mapping[int, str]) -> StoredMessage:
    channel, number, _, _ = MESSAGE_HEAD.unpack_from(body)
    return StoredMessage(topics[channel], number, body[MESSAGE_HEAD.size :])


def opened(path: Path) -> BinaryIO:
    """An MCAP file, for reading."""
    head = b""
    if is_file(path):
        with suppress(OSError), path.open("rb") as file:
            head = file.read(len(MAGIC))
    if not head:
        read_bytes(path)
    if head != MAGIC:
        raise FileFormatError(
            "this is no MCAP file",
            where=path_text(path),
            remedy="name a recording that armscan wrote",
        )
    return path.open("rb")


def read_summary(path: Path) -> FileSummary:
    """What a finished file lists of itself."""
    with opened(path) as file:
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
            listed = list(StreamReader(BytesIO(body + tail), skip_magic=True).records)
            return _file_summary(listed)
        except DAMAGE:
            pass
    raise FileFormatError(
        "the recording is unfinished: it has no whole summary",
        where=path_text(path),
        remedy=RECOVER_REMEDY,
    )


def _file_summary(listed: list[records.McapRecord]) -> FileSummary:
    topics = {one.id: one.topic for one in listed if isinstance(one, records.Channel)}
    counted = next(one for one in listed if isinstance(one, records.Statistics))
    counts = counted.channel_message_counts
    chunks = (one for one in listed if isinstance(one, records.ChunkIndex))
    return FileSummary(
        chunks=tuple(sorted(chunks, key=lambda one: one.chunk_start_offset)),
        topics=topics,
        attachments=tuple(one for one in listed if isinstance(one, records.AttachmentIndex)),
        n_messages=counted.message_count,
        n_exposures=sum(n for k, n in counts.items() if topics.get(k) == EXPOSURE_TOPIC),
    )


@dataclass(frozen=True, slots=True)
class _ImagePlace:
    """Where an image lies: its chunk, the place in it, its number, and what is said of it."""

    chunk: int
    offset: int
    number: int
    said: Mapping[str, Any]


class McapFolder:
    """A finished MCAP recording, read as the folder recording that it holds.

    Its tables are those that `extract_recording` writes. Images that were recorded raw are given as
    PGM or PPM files under the names that they have there.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._summary = read_summary(path)
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._lock = threading.Lock()
        self._images: dict[str, _ImagePlace] = {}
        self.notes: tuple[str, ...] = ()
        """What is set aside in it, in words."""
        try:
            with opened(path) as file:
                self._files = self._read_files(file)
        except DAMAGE as error:
            raise self._damaged(error) from error

    @property
    def names(self) -> tuple[str, ...]:
        """All files, as paths with ``/``."""
        return (*self._files, *self._images)

    def __contains__(self, name: str) -> bool:
        """True if there is a file of that name."""
        return name in self._files or name in self._images

    def read(self, name: str) -> bytes:
        """Content of a file."""
        if name in self._files:
            return self._files[name]
        if name not in self._images:
            raise FileFormatError("there is no such file in the recording",
                                  where=path_text(self.path / name),
                                  remedy="check the path")  # fmt: skip
        place = self._images[name]
        try:
            content = self._content(place.chunk)
            opcode, length = HEAD.unpack_from(content, place.offset)
            start = place.offset + HEAD.size
            message = _message(content[start : start + length], self._summary.topics)
            if opcode != Opcode.MESSAGE or message.number != place.number:
                raise ValueError("an index is wrong")
            shown = stored_image(message, place.said)
            return shown.data if isinstance(shown, CompressedImage) else _netpbm(shown)
        except DAMAGE as error:
            raise self._damaged(error, name) from error

    @property
    def damaged_images(self) -> tuple[str, ...]:
        """Images that cannot be read; it reads all of the file."""
        found = []
        for name in self._images:
            try:
                self.read(name)
            except FileFormatError:
                found.append(name)
        return tuple(found)

    def _damaged(self, error: BaseException, name: str = "") -> FileFormatError:
        return FileFormatError(
            f"the recording is damaged ({error or type(error).__name__})",
            where=path_text(self.path / name),
            remedy=RECOVER_REMEDY,
        )

    def _content(self, number: int) -> bytes:
        with self._lock:
            if number not in self._kept:
                with opened(self.path) as file:
                    self._kept[number] = self._chunk(file, self._summary.chunks[number])
                if len(self._kept) > KEPT_CHUNKS:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(number)
            return self._kept[number]

    @staticmethod
    def _chunk(file: BinaryIO, index: records.ChunkIndex) -> bytes:
        file.seek(index.chunk_start_offset)
        opcode, length = HEAD.unpack(file.read(HEAD.size))
        if opcode != Opcode.CHUNK or HEAD.size + length != index.chunk_length:
            raise ValueError("an index is wrong")
        return chunk_content(file.read(length))

    def _read_files(self, file: BinaryIO) -> dict[str, bytes]:
        """Documents and tables, and where the images are."""
        files: dict[str, bytes] = {}
        for one in self._summary.attachments:
            file.seek(one.offset + HEAD.size)
            attachment = attachment_of(file.read(one.length - HEAD.size))
            if is_inside(attachment.name) and attachment.name not in TABLES:
                files[attachment.name] = attachment.data
        tables, places = RecordedTables(), _ImagePlaces(file, self._summary)
        n_exposures = 0
        for number, index in enumerate(self._summary.chunks):
            places.add(number)
            topics = {self._summary.topics[channel] for channel in index.message_index_offsets}
            if topics.isdisjoint(LISTED_KINDS):
                continue
            for message in chunk_messages(self._chunk(file, index), dict(self._summary.topics)):
                if message.topic.startswith(CAMERA_TOPICS):
                    continue
                if message.topic != EXPOSURE_TOPIC:
                    tables.take(message)
                    continue
                n_exposures += 1
                said = json.loads(message.data)
                chunk, offset = places.next_of(said["image"]["topic"])
                name = tables.take_exposure(said)
                if name is not None:
                    self._images[name] = _ImagePlace(chunk, offset, message.number, said)
        if n_exposures != self._summary.n_exposures:
            raise ValueError(f"{n_exposures} exposures of {self._summary.n_exposures} are there")
        self.notes = tables.notes
        return files | tables.contents()


@dataclass
class _ImagePlaces:
    """Images of each camera's topic that were not asked for yet, in the order of the file."""

    file: BinaryIO
    summary: FileSummary
    waiting: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    n_given: dict[str, int] = field(default_factory=dict)

    def add(self, number: int) -> None:
        """Those of a chunk."""
        for channel, place in self.summary.chunks[number].message_index_offsets.items():
            topic = self.summary.topics[channel]
            if topic.startswith(CAMERA_TOPICS):
                opcode, length = _record_head(self.file, place)
                if opcode != Opcode.MESSAGE_INDEX:
                    raise ValueError("an index is wrong")
                index = records.MessageIndex.read(ReadDataStream(BytesIO(self.file.read(length))))
                waiting = self.waiting.setdefault(topic, [])
                waiting += [(number, offset) for _, offset in index.records]

    def next_of(self, topic: str) -> tuple[int, int]:
        """Chunk and place of the next one."""
        n = self.n_given.get(topic, 0)
        self.n_given[topic] = n + 1
        return self.waiting[topic][n]


def folder_in(path: Path) -> McapFolder:
    """The folder that a file holds; kept until the file changes."""
    if not is_file(path):
        read_bytes(path)
    facts = path.stat()
    return _folder_of(path, facts.st_mtime_ns, facts.st_size)


@lru_cache(maxsize=KEPT_FILES)
def _folder_of(path: Path, _time_ns: int, _size: int) -> McapFolder:
    return McapFolder(path)
