# SPDX-License-Identifier: Apache-2.0
"""A live recording written to one MCAP file by a thread of its own, whole but for what waits."""

from __future__ import annotations

import json
import math
import os
import struct
import sys
import threading
import time
import zlib
from base64 import b64encode
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zstandard
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap_protobuf.schema import build_file_descriptor_set
from scipy.spatial.transform import Rotation

from armscan.errors import InputError, OutputError
from armscan.geometry.arrays import ImageArray
from armscan.records.recording import ArmTrack, ExposureRow, Session
from armscan.storage.arm import arm_columns
from armscan.storage.files import path_text
from armscan.storage.recording_session import (
    SESSION_FILE,
    banded_image,
    exposure_columns,
    session_toml,
)
from armscan.storage.recordings.mcap_folder import (
    ARM_TOPIC,
    DOCUMENT_TOPIC,
    EVENT_TOPIC,
    EXPOSURE_TOPIC,
    MAGIC,
    TRANSFORM_TOPIC,
    image_message,
    transform_message,
)

CHUNK_BYTES = 4 << 20
"""Of images in one chunk: reading one exposure unpacks no more than this and one image."""
CHUNK_SECONDS = 0.4
"""After so long a chunk is closed and handed to the system; a killed process loses no more."""
PACKED_WITHIN_SECONDS = 0.5
"""A chunk is written as it is when its first message came so long ago and it is not packed: with
what writing takes, a killed process loses nothing that is older than a second."""
NICENESS = 10
"""Of the packing thread: a scan is measured with nine tenths of a core that both want."""
DOCUMENTS_SECONDS, MOST_REPEATED_BYTES = 5.0, 1 << 16
"""So often documents up to this size come again: a broken file is read without its beginning."""
SYNC_SECONDS = 1.0
"""So often the system is asked to put all on the disk: a power cut loses about as much."""
NEW_FILE = os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_BINARY", 0)

Compression = Literal["auto", "raw", "zstd"]


@dataclass(frozen=True, slots=True)
class WriterOptions:
    """How a recording is written; nothing but the stripe band changes a pixel.

    Parameters
    ----------
    compression
        ``raw``; ``zstd`` at level 1; ``auto`` packs what a thread that yields to all others has
        time for, while less than half of the queue is filled, on a machine of at least two cores.
    queue_bytes
        Images that may wait; a caller waits when they are that many.
    is_stripe_band
        Grey pixels of exposures with a laser and without a view are kept near what could be a
        stripe, and zero elsewhere; see `near_lines`. What is extracted from them stays the same.
    """

    compression: Compression = "auto"
    queue_bytes: int = 256 << 20
    is_stripe_band: bool = False


@dataclass(frozen=True, slots=True)
class WriterStatus:
    """How far a recording is.

    Parameters
    ----------
    n_accepted, n_written
        Exposures that were given, and those whose chunk the system has.
    fill
        Part of the queue that is filled, 0 to 1.
    n_waits
        How often a caller had to wait for room.
    n_bytes
        Size of the file.
    """

    n_accepted: int
    n_written: int
    fill: float
    n_waits: int
    n_bytes: int


@dataclass
class _Message:
    channel: int
    kind: str
    t_ns: int
    pieces: tuple[bytes, ...]
    n_exposures: int = 0
    number: int | None = None
    """Of an exposure: what its image and its facts have in common."""
    since: float = field(default_factory=time.monotonic)

    @property
    def n_bytes(self) -> int:
        return sum(map(len, self.pieces))


@dataclass
class _Chunk:
    """An open chunk: messages whose bytes are not joined before they are written, and what they
    need of schemas and channels, so that it can be read alone.
    """

    pieces: list[bytes] = field(default_factory=list)
    n_bytes: int = 0
    times: list[int] = field(default_factory=list)
    index: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    n_exposures: int = 0
    since: float = math.inf
    """When the first of its messages came."""

    def add(self, message: _Message, sequence: int, declared: Sequence[bytes]) -> None:
        if message.channel not in self.index:
            self.pieces += declared
            self.n_bytes += sum(map(len, declared))
        time_ns = max(message.t_ns, 0)
        length = 22 + message.n_bytes
        head = struct.pack(
            "<BQHIQQ", Opcode.MESSAGE, length, message.channel, sequence, time_ns, time_ns
        )
        self.index.setdefault(message.channel, []).append((time_ns, self.n_bytes))
        self.pieces += (head, *message.pieces)
        self.n_bytes += 9 + length
        self.times.append(time_ns)
        self.n_exposures += message.n_exposures
        self.since = min(self.since, message.since)

    @property
    def is_late(self) -> bool:
        return time.monotonic() > self.since + PACKED_WITHIN_SECONDS


@dataclass(frozen=True, slots=True)
class _Closed:
    """A chunk that waits to be written, and how it is packed; None to write it raw."""

    chunk: _Chunk
    packed: Future[list[bytes]] | None


class RecordingWriter:
    """Writes a recording while it is taken.

    Exposures, samples of the arm and events may be added from several threads. Times may be in any
    order: what is recorded is what was delivered. A file whose `close` never came has no summary;
    its chunks are whole, checksummed, and declare what they hold; facts follow their images.

    Parameters
    ----------
    path
        File to write; must not exist.
    options
        How it is written.
    """

    def __init__(self, path: Path, options: WriterOptions | None = None) -> None:
        self._path, self._options = path, options or WriterOptions()
        self._ready = threading.Condition()
        self._queue: deque[_Message] = deque()
        self._queued_bytes = 0
        self._is_closing = False
        self._failure: BaseException | None = None
        self._has_summary = False
        self._n_accepted = self._n_written = self._n_waits = self._size = 0
        self._handle = -1
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._chunks: list[records.ChunkIndex] = []
        self._sequence: Counter[int] = Counter()
        self._counts: Counter[int] = Counter()
        self._synced = 0.0
        self._documented = -math.inf
        self._documents: tuple[_Message, ...] = ()
        self._declared: dict[int, tuple[bytes, ...]] = {}
        self._session = Session()
        self._of_topic: dict[str, int] = {}
        self._closed: deque[_Closed] = deque()
        self._packing = ThreadPoolExecutor(1, "packing", _yield_to_all)
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)

    def begin(self, session: Session, documents: Mapping[str, bytes] | None = None) -> None:
        """Make the file, with what holds for all of it.

        Parameters
        ----------
        session
            Cameras, clock and form of the poses; written as ``session.toml``.
        documents
            Further files of a recording by name, as ``arm.toml``.

        Raises
        ------
        OutputError
            If the file exists or cannot be made; nothing is left of it then.
        InputError
            If the recording was begun before.
        """
        if self._thread.ident is not None or self._is_closing:
            raise InputError("the recording was begun before", remedy="make a new writer")
        kept = dict(documents or {})
        if self._options.is_stripe_band:
            session = replace(session, is_stripe_band=True)
            kept[SESSION_FILE] = session_toml(session)
        self._session = session
        try:
            self._handle = os.open(self._path, NEW_FILE, 0o666)
            self._write_head({SESSION_FILE: session_toml(session), **kept})
            self._thread.start()
        except BaseException as error:
            if self._handle >= 0:
                self._leave_nothing()
            if not isinstance(error, OSError):
                raise
            raise OutputError(
                f"the recording cannot be begun ({error.strerror})",
                where=path_text(self._path),
                remedy="choose another name or folder",
            ) from error

    def _leave_nothing(self) -> None:
        """Remove the file that this writer made and could not begin."""
        with suppress(OSError):
            os.close(self._handle)
        self._handle = -1
        self._is_closing = True
        with suppress(OSError):
            self._path.unlink()

    def _write_head(self, documents: Mapping[str, bytes]) -> None:
        self._write((MAGIC, _record(records.Header("", "armscan"))))
        self._declare(len(self._session.cameras))
        for name, data in documents.items():
            self._attach(name, data)
        self._documents = tuple(
            self._json(DOCUMENT_TOPIC, 0, {"name": name, "base64": b64encode(data).decode()})
            for name, data in documents.items()
            if len(data) <= MOST_REPEATED_BYTES
        )

    def add_exposure(
        self,
        row: ExposureRow,
        image: ImageArray | bytes,
        flags: Sequence[str] = (),
        cells: Mapping[str, str] | None = None,
    ) -> float:
        """Record one exposure; its pixels are copied, the caller may use the array again.

        Parameters
        ----------
        row
            Its facts; ``source`` is its name in a folder.
        image
            (H, W) uint8 or uint16, (H, W, 3) uint8 red, green, blue; or a whole image file.
        flags
            Marks of the synchronisation, as ``no-pose``.
        cells
            Its line of ``exposures.csv`` as it stands there; made of ``row`` if None.

        Returns
        -------
        fill
            Part of the queue that is filled, 0 to 1; at 1 the next call waits.

        Raises
        ------
        OutputError
            If the disk is full or refuses; says how much is safe.
        """
        if not 0 <= row.camera < len(self._session.cameras):
            raise InputError(f"camera {row.camera} is not among those of the session")
        setup = self._session.cameras[row.camera]
        banded = banded_image(row, image, setup) if self._options.is_stripe_band else None
        pieces, facts = image_message(row, image if banded is None else banded, self._session)
        facts |= {} if banded is None else {"outside_band": "zero"}
        topic = f"/camera/{row.camera}/" + facts["stored"]
        if cells is None:
            cells = {name: column[0] for name, column in exposure_columns((row,), {}).items()}
        said: dict[str, Any] = {
            "index": row.index,
            "t_ns": row.t_ns,
            "camera": row.camera,
            "file": row.source,
            "lasers": list(row.lasers),
            "trigger_id": row.trigger_id,
            "view": row.view,
            "flags": list(flags),
            "cells": dict(cells),
            "image": {"topic": topic, **facts},
        }
        pixels = _Message(self._of_topic[topic], "images", row.t_ns, pieces)
        return self._put(pixels, self._json(EXPOSURE_TOPIC, row.t_ns, said, n_exposures=1))

    def add_arm_samples(
        self,
        track: ArmTrack,
        columns: Mapping[str, Sequence[str]] | None = None,
        cells: Mapping[str, Sequence[str]] | None = None,
    ) -> float:
        """Record samples of the arm.

        Parameters
        ----------
        track
            (N,) samples as delivered.
        columns
            (N,) texts of further columns by name, as buttons.
        cells
            (N,) texts of all columns of ``arm.csv`` as they stand there; made of ``track`` if None.

        Returns
        -------
        fill
            As `add_exposure`.
        """
        session = self._session
        extra = {name: tuple(cells) for name, cells in (columns or {}).items()}
        if cells is None:
            cells = arm_columns(track, session.pose_form, session.rotation, extra)
        rows = [list(row) for row in zip(*cells.values(), strict=True)]
        first = int(track.t_ns[0]) if len(track) else 0
        table = self._json(ARM_TOPIC, first, {"columns": list(cells), "rows": rows})
        quaternions = Rotation.from_matrix(np.asarray(track.rotations)).as_quat()
        shown = [
            self._transform(track, k, quaternions[k])
            for k in range(len(track))
            if track.is_known[k]
        ]
        return self._put(table, *shown)

    def add_event(self, t_ns: int, kind: str, facts: Mapping[str, Any] | None = None) -> float:
        """Record what happened, as a button or a lost packet; returns as `add_exposure`."""
        said = {"t_ns": t_ns, "kind": kind, "facts": dict(facts or {})}
        return self._put(self._json(EVENT_TOPIC, t_ns, said))

    def status(self) -> WriterStatus:
        """How far the recording is."""
        with self._ready:
            fill = min(1.0, self._queued_bytes / self._options.queue_bytes)
            return WriterStatus(self._n_accepted, self._n_written, fill, self._n_waits, self._size)

    def close(self) -> WriterStatus:
        """Write all that waits, and the summary with which readers find exposures.

        Raises
        ------
        OutputError
            If the disk is full or refuses; says how much is safe.
        """
        with self._ready:
            self._is_closing = True
            self._ready.notify_all()
        if self._thread.is_alive():
            self._thread.join()
        if self._handle >= 0:
            handle, self._handle = self._handle, -1
            try:
                os.close(handle)
            except OSError as error:
                self._failure = self._failure or error
        self._refuse_failed()
        return self.status()

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _refuse_failed(self) -> None:
        if self._failure is None:
            return
        cause = self._failure
        why = getattr(cause, "strerror", None) or f"{type(cause).__name__}: {cause}"
        first = "" if self._has_summary else "run `armscan recover` on the file, "
        raise OutputError(
            f"the recording stopped ({why}): {self._n_written} exposures of "
            f"{self._n_accepted} are safe",
            where=path_text(self._path),
            remedy=f"{first}free some space, and record the rest into a new file",
        ) from cause

    def _put(self, *messages: _Message) -> float:
        n_bytes = sum(message.n_bytes for message in messages)
        most = self._options.queue_bytes
        with self._ready:
            self._n_waits += self._is_full(n_bytes)
            while self._is_full(n_bytes) and self._failure is None:
                self._ready.wait()
            self._refuse_failed()
            if self._is_closing or self._handle < 0:
                raise InputError("the recording is not open", remedy="call begin first")
            n_exposures = sum(message.n_exposures for message in messages)
            if n_exposures:
                for message in messages:
                    message.number = self._n_accepted
            self._queue += messages
            self._queued_bytes += n_bytes
            self._n_accepted += n_exposures
            self._ready.notify_all()
            return min(1.0, self._queued_bytes / most)

    def _is_full(self, n_bytes: int) -> bool:
        is_empty = not self._queue and not self._closed
        return not is_empty and self._queued_bytes + n_bytes > self._options.queue_bytes

    def _run(self) -> None:
        """The thread: whatever ends it is kept for the callers."""
        try:
            self._fill_chunks()
        except BaseException as error:  # nobody else sees what a thread raises
            self._stop(error)
        finally:
            self._packing.shutdown(cancel_futures=True)

    def _fill_chunks(self) -> None:
        """Fill chunks, close them when they are full or old, write them."""
        chunks = {kind: _Chunk() for kind in ("images", "views", "tables")}
        begun = time.monotonic()
        while True:
            messages, is_last = self._take(self._next_look(begun))
            for message in messages:
                self._add(chunks, message)
                # facts last: an exposure that is listed has its image
                if message.n_exposures and chunks["images"].n_bytes >= CHUNK_BYTES:
                    self._close_chunk(chunks, "images")
                    self._close_chunk(chunks, "tables")
                with self._ready:
                    self._queued_bytes -= message.n_bytes
                    self._ready.notify_all()
            if is_last or time.monotonic() >= begun + CHUNK_SECONDS:
                for kind in chunks:
                    self._close_chunk(chunks, kind)
                begun = time.monotonic()
            self._write_closed(is_last=is_last)
            if is_last:
                self._write(self._summary())
                os.fsync(self._handle)
                self._has_summary = True
                return

    def _next_look(self, begun: float) -> float:
        """When something is to be done though no message came."""
        waits = [one.chunk.since + PACKED_WITHIN_SECONDS for one in self._closed]
        return min([begun + CHUNK_SECONDS, *waits[:1]])

    def _add(self, chunks: dict[str, _Chunk], message: _Message) -> None:
        if message.kind == "tables" and time.monotonic() > self._documented + DOCUMENTS_SECONDS:
            self._documented = time.monotonic()
            for document in self._documents:
                again = replace(document, t_ns=message.t_ns, since=message.since)
                self._add(chunks, again)
        sequence = self._sequence[message.channel] if message.number is None else message.number
        self._sequence[message.channel] += 1
        chunks[message.kind].add(message, sequence, self._declared[message.channel])

    def _take(self, until: float) -> tuple[list[_Message], bool]:
        with self._ready:
            while not self._queue and not self._is_closing:
                left = until - time.monotonic()
                if left <= 0.0:
                    break
                self._ready.wait(left)
            # one exposure at a time: what was taken still counts as waiting
            taken = [self._queue.popleft()] if self._queue else []
            return taken, self._is_closing and not self._queue

    def _stop(self, error: BaseException) -> None:
        """Cut what was begun off, and close what is whole as well as the disk allows."""
        try:
            self._cut_off()
            self._write(self._summary())
            os.fsync(self._handle)
            self._has_summary = True
        except Exception:
            # a summary that is cut is none: without it the file is an unfinished one
            with suppress(OSError):
                self._cut_off()
        finally:
            with self._ready:
                self._failure = error
                self._queue.clear()
                self._closed.clear()
                self._queued_bytes = 0
                self._ready.notify_all()

    def _cut_off(self) -> None:
        os.ftruncate(self._handle, self._size)
        os.lseek(self._handle, self._size, os.SEEK_SET)

    def _close_chunk(self, chunks: dict[str, _Chunk], kind: str) -> None:
        """Let a chunk wait to be written, and be packed meanwhile."""
        chunk, chunks[kind] = chunks[kind], _Chunk()
        if not chunk.n_bytes:
            return
        is_packing = self._is_packing(chunk)
        packed = self._packing.submit(_packed, chunk) if is_packing else None
        with self._ready:
            self._closed.append(_Closed(chunk, packed))
            self._queued_bytes += chunk.n_bytes

    def _write_closed(self, *, is_last: bool) -> None:
        """Write chunks in their order: packed where that is done, as they are where it is late."""
        while self._closed:
            one, packed = self._closed[0], self._closed[0].packed
            if packed is not None and not packed.done() and not self._must_pack:
                is_late = is_last or one.chunk.is_late
                if not is_late and 2 * self._queued_bytes < self._options.queue_bytes:
                    return
                packed.cancel()
                packed = None
            # what cannot be packed, for want of memory, is written as it is
            is_raw = packed is None or packed.exception() is not None
            self._write_chunk(one.chunk, None if packed is None or is_raw else packed.result())
            with self._ready:
                self._closed.popleft()
                self._queued_bytes -= one.chunk.n_bytes
                self._ready.notify_all()

    def _write_chunk(self, chunk: _Chunk, packed: list[bytes] | None) -> None:
        crc = 0
        for piece in chunk.pieces:
            crc = zlib.crc32(piece, crc)
        pieces, name = (chunk.pieces, "") if packed is None else (packed, "zstd")
        n_bytes = sum(map(len, pieces))
        first, last = min(chunk.times), max(chunk.times)
        inner = struct.pack("<QQQII", first, last, chunk.n_bytes, crc, len(name))
        inner += name.encode() + struct.pack("<Q", n_bytes)
        head = struct.pack("<BQ", Opcode.CHUNK, len(inner) + n_bytes) + inner
        start, length = self._size, len(head) + n_bytes
        indexes = {n: _record(records.MessageIndex(n, at)) for n, at in chunk.index.items()}
        offsets, place = {}, start + length
        for channel, content in indexes.items():
            offsets[channel] = place
            place += len(content)
        self._write((head, *pieces, *indexes.values()))
        self._chunks.append(
            records.ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression=name,
                compressed_size=n_bytes,
                message_end_time=last,
                message_index_length=place - start - length,
                message_index_offsets=offsets,
                message_start_time=first,
                uncompressed_size=chunk.n_bytes,
            )
        )
        self._counts.update({channel: len(at) for channel, at in chunk.index.items()})
        with self._ready:
            self._n_written += chunk.n_exposures
        if time.monotonic() - self._synced > SYNC_SECONDS:
            os.fsync(self._handle)
            self._synced = time.monotonic()

    @property
    def _must_pack(self) -> bool:
        chosen = self._options.compression
        return chosen == "zstd" or (self._options.is_stripe_band and chosen != "raw")

    def _is_packing(self, chunk: _Chunk) -> bool:
        if self._must_pack or self._options.compression == "raw":
            return self._must_pack
        is_behind = chunk.is_late or 2 * self._queued_bytes >= self._options.queue_bytes
        return (os.cpu_count() or 1) > 1 and not is_behind

    def _write(self, pieces: Sequence[bytes]) -> None:
        """Write pieces that belong together; the file's size counts them when all are written."""
        total = 0
        for first in range(0, len(pieces), 500):
            rest = [memoryview(piece) for piece in pieces[first : first + 500] if piece]
            while rest:
                done = _write_some(self._handle, rest)
                total += done
                while rest and done >= len(rest[0]):
                    done -= len(rest.pop(0))
                if done:
                    rest[0] = rest[0][done:]
        self._size += total

    def _declare(self, n_cameras: int) -> None:
        for kind in (RawImage, CompressedImage, FrameTransform):
            data = build_file_descriptor_set(kind).SerializeToString()
            self._schema(kind.DESCRIPTOR.full_name, "protobuf", data)
        for name in ("Exposure", "ArmSamples", "Event", "Document"):
            self._schema(f"armscan.{name}", "jsonschema", b'{"type": "object"}')
        for camera in range(n_cameras):
            self._channel(f"/camera/{camera}/raw", "protobuf", 1)
            self._channel(f"/camera/{camera}/file", "protobuf", 2)
        self._channel(TRANSFORM_TOPIC, "protobuf", 3)
        self._channel(EXPOSURE_TOPIC, "json", 4)
        self._channel(ARM_TOPIC, "json", 5)
        self._channel(EVENT_TOPIC, "json", 6)
        self._channel(DOCUMENT_TOPIC, "json", 7)

    def _schema(self, name: str, encoding: str, data: bytes) -> None:
        schema = records.Schema(len(self._schemas) + 1, data, encoding, name)
        self._schemas.append(schema)
        self._write((_record(schema),))

    def _channel(self, topic: str, encoding: str, schema: int) -> None:
        channel = records.Channel(len(self._channels) + 1, topic, encoding, {}, schema)
        self._channels.append(channel)
        self._of_topic[topic] = channel.id
        self._write((_record(channel),))
        self._declared[channel.id] = (_record(self._schemas[schema - 1]), _record(channel))

    def _attach(self, name: str, data: bytes) -> None:
        content = _record(records.Attachment(0, 0, name, "application/octet-stream", data))
        index = records.AttachmentIndex(
            self._size, len(content), 0, 0, len(data), name, "application/octet-stream"
        )
        self._write((content,))
        self._attachments.append(index)

    def _json(self, topic: str, t_ns: int, facts: Any, n_exposures: int = 0) -> _Message:
        content = json.dumps(facts, ensure_ascii=False).encode()
        return _Message(self._of_topic[topic], "tables", t_ns, (content,), n_exposures)

    def _transform(self, track: ArmTrack, row: int, quaternion: Any) -> _Message:
        t_ns = int(track.t_ns[row])
        content = transform_message(t_ns, track.translations_mm[row], quaternion)
        return _Message(self._of_topic[TRANSFORM_TOPIC], "views", t_ns, (content,))

    def _summary(self) -> tuple[bytes, ...]:
        ends = [index.message_end_time for index in self._chunks]
        starts = [index.message_start_time for index in self._chunks]
        statistics = records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max(ends, default=0),
            message_start_time=min(starts, default=0),
            metadata_count=0,
            schema_count=len(self._schemas),
        )
        end = _record(records.DataEnd(0))
        listed = (*self._schemas, *self._channels, statistics, *self._chunks, *self._attachments)
        body = b"".join(map(_record, listed))
        start = self._size + len(end)
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, 0)
        footer = head + struct.pack("<I", zlib.crc32(head, zlib.crc32(body)))
        return (end, body, footer, MAGIC)


def _yield_to_all() -> None:
    """Let this thread have what the others leave; where one thread's rank can be set."""
    if sys.platform == "linux":
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)


def _packed(chunk: _Chunk) -> list[bytes]:
    """A chunk's bytes as one frame; piece by piece, which needs no copy of all of them."""
    frame = zstandard.ZstdCompressor(level=1).compressobj(size=chunk.n_bytes)
    return [*(frame.compress(piece) for piece in chunk.pieces), frame.flush()]


def _write_some(handle: int, pieces: list[memoryview]) -> int:
    """Windows cannot write several pieces at once."""
    if hasattr(os, "writev"):
        return os.writev(handle, pieces)
    return os.write(handle, pieces[0])


def _record(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())
