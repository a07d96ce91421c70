# SPDX-License-Identifier: Apache-2.0
"""A live recording written to one MCAP file by a thread of its own, whole but for what waits."""

from __future__ import annotations

import json
import math
import os
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
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap_protobuf.schema import build_file_descriptor_set
from scipy.spatial.transform import Rotation

from armscan.errors import InputError, OutputError
from armscan.geometry.arrays import FloatArray, ImageArray
from armscan.records.recording import ArmTrack, ExposureRow, Session
from armscan.storage.arm import arm_columns
from armscan.storage.files import path_text
from armscan.storage.images import image_format, raw_encoding
from armscan.storage.recording_session import (
    SESSION_FILE,
    banded_image,
    exposure_columns,
    session_toml,
)
from armscan.storage.recordings.mcap_file import Chunk, GrowingFile
from armscan.storage.recordings.mcap_folder import (
    ARM_TOPIC,
    DOCUMENT_TOPIC,
    EVENT_TOPIC,
    EXPOSURE_TOPIC,
    NS_PER_S,
    TRANSFORM_TOPIC,
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
        Grey pixels of exposures with a laser (``is_lit``) and without a view are kept near what
        could be a stripe, and zero elsewhere; see `near_lines`. What is extracted from them stays
        the same.
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
class _Waiting:
    """A chunk, how many exposures it lists, and when the first of its messages came."""

    chunk: Chunk = field(default_factory=Chunk)
    n_exposures: int = 0
    since: float = math.inf

    @property
    def is_late(self) -> bool:
        return time.monotonic() > self.since + PACKED_WITHIN_SECONDS


@dataclass(frozen=True, slots=True)
class _Closed:
    """A chunk that is to be written, and how it is packed; None to write it raw."""

    waiting: _Waiting
    packed: Future[list[bytes]] | None


class RecordingWriter:
    """Writes a recording while it is taken.

    Exposures, samples of the arm and events may be added from several threads. Times may be in any
    order: what is recorded is what was delivered. A file whose `close` never came has no summary;
    its chunks are whole, checksummed, and declare what they hold; facts follow their images.
    """

    def __init__(self, path: Path, options: WriterOptions | None = None) -> None:
        self._path, self._options = path, options or WriterOptions()
        self._ready = threading.Condition()
        self._queue: deque[_Message] = deque()
        self._queued_bytes = 0
        self._is_closing = False
        self._failure: BaseException | None = None
        self._n_accepted = self._n_written = self._n_waits = 0
        self._file = GrowingFile()
        self._sequence: Counter[int] = Counter()
        self._documented = -math.inf
        self._documents: tuple[_Message, ...] = ()
        self._declared: dict[int, bytes] = {}
        self._session = Session()
        self._of_topic: dict[str, int] = {}
        self._closed: deque[_Closed] = deque()
        self._packing = ThreadPoolExecutor(1, "packing", _yield_to_all)
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)

    def begin(self, session: Session, documents: Mapping[str, bytes] | None = None) -> None:
        """Make the file, with what holds for all of it: the session and further documents.

        Raises
        ------
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
            self._file.create(self._path)
            self._write_head({SESSION_FILE: session_toml(session), **kept})
            self._thread.start()
        except BaseException as error:
            if self._file.is_open:
                self._leave_nothing()
            if not isinstance(error, OSError):
                raise
            raise OutputError(
                f"the recording cannot be begun ({error.strerror})",
                where=path_text(self._path),
                remedy="choose another name or folder",
            ) from error

    @property
    def is_begun(self) -> bool:
        """Whether the file at its path is this recording's own."""
        return self._thread.ident is not None

    def _leave_nothing(self) -> None:
        """Remove the file that this writer made and could not begin."""
        with suppress(OSError):
            self._file.close()
        self._is_closing = True
        with suppress(OSError):
            self._path.unlink()

    def _write_head(self, documents: Mapping[str, bytes]) -> None:
        self._declare(len(self._session.cameras))
        for name, data in documents.items():
            self._file.attach(name, data)
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
        *,
        is_lit: bool = False,
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
        is_lit
            A laser is on, though the row names none; the band is kept of it, too.

        Returns
        -------
        fill
            Part of the queue that is filled, 0 to 1; at 1 the next call waits.
        """
        if not 0 <= row.camera < len(self._session.cameras):
            raise InputError(f"camera {row.camera} is not among those of the session")
        setup = self._session.cameras[row.camera]
        is_band = self._options.is_stripe_band
        banded = banded_image(row, image, setup, is_lit=is_lit) if is_band else None
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
            counts = self._n_accepted, self._n_written, fill, self._n_waits
            return WriterStatus(*counts, self._file.n_bytes)

    def close(self) -> WriterStatus:
        """Write all that waits, and the summary with which readers find exposures."""
        with self._ready:
            self._is_closing = True
            self._ready.notify_all()
        if self._thread.is_alive():
            self._thread.join()
        try:
            self._file.close()
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
        first = "" if self._file.has_summary else "run `armscan recover` on the file, "
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
            if self._is_closing or not self._file.is_open:
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
        chunks = {kind: _Waiting() for kind in ("images", "views", "tables")}
        begun = time.monotonic()
        while True:
            messages, is_last = self._take(self._next_look(begun))
            for message in messages:
                self._add(chunks, message)
                # facts last: an exposure that is listed has its image
                if message.n_exposures and chunks["images"].chunk.n_bytes >= CHUNK_BYTES:
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
                self._file.finish()
                return

    def _next_look(self, begun: float) -> float:
        """When something is to be done though no message came."""
        waits = [one.waiting.since + PACKED_WITHIN_SECONDS for one in self._closed]
        return min([begun + CHUNK_SECONDS, *waits[:1]])

    def _add(self, chunks: dict[str, _Waiting], message: _Message) -> None:
        if message.kind == "tables" and time.monotonic() > self._documented + DOCUMENTS_SECONDS:
            self._documented = time.monotonic()
            for document in self._documents:
                again = replace(document, t_ns=message.t_ns, since=message.since)
                self._add(chunks, again)
        sequence = self._sequence[message.channel] if message.number is None else message.number
        self._sequence[message.channel] += 1
        waiting, channel = chunks[message.kind], message.channel
        declared = self._declared[channel]
        waiting.chunk.add(channel, sequence, message.t_ns, message.pieces, declared)
        waiting.n_exposures += message.n_exposures
        waiting.since = min(waiting.since, message.since)

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
            self._file.cut_off()
            self._file.finish()
        except Exception:
            # a summary that is cut is none: without it the file is an unfinished one
            with suppress(OSError):
                self._file.cut_off()
        finally:
            with self._ready:
                self._failure = error
                self._queue.clear()
                self._closed.clear()
                self._queued_bytes = 0
                self._ready.notify_all()

    def _close_chunk(self, chunks: dict[str, _Waiting], kind: str) -> None:
        """Let a chunk wait to be written, and be packed meanwhile."""
        waiting, chunks[kind] = chunks[kind], _Waiting()
        if not waiting.chunk.n_bytes:
            return
        is_packing = self._is_packing(waiting)
        packed = self._packing.submit(waiting.chunk.packed) if is_packing else None
        with self._ready:
            self._closed.append(_Closed(waiting, packed))
            self._queued_bytes += waiting.chunk.n_bytes

    def _write_closed(self, *, is_last: bool) -> None:
        """Write chunks in their order: packed where that is done, as they are where it is late."""
        while self._closed:
            waiting, packed = self._closed[0].waiting, self._closed[0].packed
            if packed is not None and not packed.done() and not self._must_pack:
                is_late = is_last or waiting.is_late
                if not is_late and 2 * self._queued_bytes < self._options.queue_bytes:
                    return
                packed.cancel()
                packed = None
            # what cannot be packed, for want of memory, is written as it is
            is_raw = packed is None or packed.exception() is not None
            chunk = waiting.chunk
            self._file.add_chunk(chunk, None if packed is None or is_raw else packed.result())
            with self._ready:
                self._n_written += waiting.n_exposures
                self._closed.popleft()
                self._queued_bytes -= chunk.n_bytes
                self._ready.notify_all()
            self._file.sync()

    @property
    def _must_pack(self) -> bool:
        chosen = self._options.compression
        return chosen == "zstd" or (self._options.is_stripe_band and chosen != "raw")

    def _is_packing(self, waiting: _Waiting) -> bool:
        if self._must_pack or self._options.compression == "raw":
            return self._must_pack
        is_behind = waiting.is_late or 2 * self._queued_bytes >= self._options.queue_bytes
        return (os.cpu_count() or 1) > 1 and not is_behind

    def _declare(self, n_cameras: int) -> None:
        for kind in (RawImage, CompressedImage, FrameTransform):
            data = build_file_descriptor_set(kind).SerializeToString()
            self._file.add_schema(kind.DESCRIPTOR.full_name, "protobuf", data)
        for name in ("Exposure", "ArmSamples", "Event", "Document"):
            self._file.add_schema(f"armscan.{name}", "jsonschema", b'{"type": "object"}')
        for camera in range(n_cameras):
            self._channel(f"/camera/{camera}/raw", "protobuf", 1)
            self._channel(f"/camera/{camera}/file", "protobuf", 2)
        self._channel(TRANSFORM_TOPIC, "protobuf", 3)
        self._channel(EXPOSURE_TOPIC, "json", 4)
        self._channel(ARM_TOPIC, "json", 5)
        self._channel(EVENT_TOPIC, "json", 6)
        self._channel(DOCUMENT_TOPIC, "json", 7)

    def _channel(self, topic: str, encoding: str, schema: int) -> None:
        channel = self._of_topic[topic] = self._file.add_channel(topic, encoding, schema)
        self._declared[channel] = self._file.declaration(channel)

    def _json(self, topic: str, t_ns: int, facts: Any, n_exposures: int = 0) -> _Message:
        content = json.dumps(facts, ensure_ascii=False).encode()
        return _Message(self._of_topic[topic], "tables", t_ns, (content,), n_exposures)

    def _transform(self, track: ArmTrack, row: int, quaternion: Any) -> _Message:
        t_ns = int(track.t_ns[row])
        content = transform_message(t_ns, track.translations_mm[row], quaternion)
        return _Message(self._of_topic[TRANSFORM_TOPIC], "views", t_ns, (content,))


def _yield_to_all() -> None:
    """Let this thread have what the others leave; where one thread's rank can be set."""
    if sys.platform == "linux":
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)


def transform_message(t_ns: int, place_mm: FloatArray, quaternion: FloatArray) -> bytes:
    """Where the tool is in Base, as viewers draw it: (3,) mm and (4,) x, y, z, w."""
    shown = FrameTransform(parent_frame_id="base", child_frame_id="tool")
    shown.timestamp.seconds, shown.timestamp.nanos = divmod(max(t_ns, 0), NS_PER_S)
    shown.translation.x, shown.translation.y, shown.translation.z = map(float, 1e-3 * place_mm)
    turn = shown.rotation
    turn.x, turn.y, turn.z, turn.w = map(float, quaternion)
    return bytes(shown.SerializeToString())


def _varint(value: int) -> bytes:
    n = max(1, -(-value.bit_length() // 7))
    return bytes(value >> 7 * k & 0x7F | (k + 1 < n) << 7 for k in range(n))


def image_message(
    row: ExposureRow, image: ImageArray | bytes, session: Session
) -> tuple[tuple[bytes, ...], dict[str, Any]]:
    """Bytes of an image's message without a copy of the pixels into it, and what is stored."""
    shown: Any
    if isinstance(image, bytes):
        kind = image_format(image)
        if kind is None:
            raise InputError("these bytes are no image file", where=row.source)
        shown, data, tag = CompressedImage(frame_id="sensor", format=kind.lower()), image, 0x12
        facts: dict[str, Any] = {"stored": "file", "format": kind.lower()}
    else:
        encoding = raw_encoding(image, session.cameras[row.camera].colour, row.source)
        height, width = image.shape[:2]
        data, tag = np.ascontiguousarray(image).tobytes(), 0x32
        shown = RawImage(
            frame_id="sensor", width=width, height=height, encoding=encoding,
            step=len(data) // height,
        )  # fmt: skip
        facts = {"stored": "raw", "encoding": encoding, "width_px": width, "height_px": height}
    shown.timestamp.seconds, shown.timestamp.nanos = divmod(max(row.t_ns, 0), NS_PER_S)
    facts |= {"crc32": zlib.crc32(data), "bytes": len(data)}
    return (shown.SerializeToString(), bytes([tag]) + _varint(len(data)), data), facts
