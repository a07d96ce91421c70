# SPDX-License-Identifier: Apache-2.0
"""An MCAP file that grows: chunks that can be read alone, with checksums and indexes, and the
summary with which readers find them.
"""

from __future__ import annotations

import os
import struct
import time
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from armscan.storage.recordings.mcap_folder import MAGIC

SYNC_SECONDS = 1.0
"""So often the system is asked to put all on the disk: a power cut loses about as much."""
MOST_PIECES = 500
"""The system is given so many pieces to write at once."""
NEW_FILE = os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_BINARY", 0)


@dataclass
class Chunk:
    """Messages whose bytes are not joined before they are written.

    It holds what they need of schemas and channels, so that it can be read alone.

    Parameters
    ----------
    pieces, n_bytes
        What is written, and its size.
    times
        Of the messages, ns.
    index
        Times and places of the messages by channel.
    """

    pieces: list[bytes] = field(default_factory=list)
    n_bytes: int = 0
    times: list[int] = field(default_factory=list)
    index: dict[int, list[tuple[int, int]]] = field(default_factory=dict)

    def add(
        self, channel: int, sequence: int, t_ns: int, pieces: Sequence[bytes], declared: bytes
    ) -> None:
        """Put a message behind the others; ``declared`` goes before the first of a channel."""
        if channel not in self.index:
            self.pieces.append(declared)
            self.n_bytes += len(declared)
        time_ns = max(t_ns, 0)
        length = 22 + sum(map(len, pieces))
        head = struct.pack("<BQHIQQ", Opcode.MESSAGE, length, channel, sequence, time_ns, time_ns)
        self.index.setdefault(channel, []).append((time_ns, self.n_bytes))
        self.pieces += (head, *pieces)
        self.n_bytes += 9 + length
        self.times.append(time_ns)

    def packed(self) -> list[bytes]:
        """Its bytes as one frame of zstd; piece by piece, which needs no copy of all of them."""
        frame = zstandard.ZstdCompressor(level=1).compressobj(size=self.n_bytes)
        return [*(frame.compress(piece) for piece in self.pieces), frame.flush()]


class GrowingFile:
    """Records one after the other; from one thread at a time.

    Every method raises `OSError` where the disk is full or refuses; `cut_off` then takes off what
    was begun.

    Attributes
    ----------
    n_bytes
        Size of what is whole.
    has_summary
        Whether the file is finished.
    """

    def __init__(self) -> None:
        self.n_bytes, self.has_summary = 0, False
        self._handle = -1
        self._synced = 0.0
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._chunks: list[records.ChunkIndex] = []
        self._counts: Counter[int] = Counter()

    @property
    def is_open(self) -> bool:
        """Whether it was made and not closed."""
        return self._handle >= 0

    def create(self, path: Path) -> None:
        """Make the file; it must not exist."""
        self._handle = os.open(path, NEW_FILE, 0o666)
        self._write((MAGIC, _record(records.Header("", "armscan"))))

    def close(self) -> None:
        """Give the file back as it is; does nothing the second time."""
        handle, self._handle = self._handle, -1
        if handle >= 0:
            os.close(handle)

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Declare a schema; returns its number, from 1."""
        schema = records.Schema(len(self._schemas) + 1, data, encoding, name)
        self._schemas.append(schema)
        self._write((_record(schema),))
        return schema.id

    def add_channel(self, topic: str, encoding: str, schema: int) -> int:
        """Declare a channel; returns its number, from 1."""
        channel = records.Channel(len(self._channels) + 1, topic, encoding, {}, schema)
        self._channels.append(channel)
        self._write((_record(channel),))
        return channel.id

    def declaration(self, channel: int) -> bytes:
        """A channel and its schema, as each chunk that holds it repeats them."""
        found = self._channels[channel - 1]
        return _record(self._schemas[found.schema_id - 1]) + _record(found)

    def attach(self, name: str, data: bytes) -> None:
        """Write a whole document."""
        content = _record(records.Attachment(0, 0, name, "application/octet-stream", data))
        index = records.AttachmentIndex(
            self.n_bytes, len(content), 0, 0, len(data), name, "application/octet-stream"
        )
        self._write((content,))
        self._attachments.append(index)

    def add_chunk(self, chunk: Chunk, packed: list[bytes] | None) -> None:
        """Write a chunk and its indexes; ``packed`` as of `Chunk.packed`, None to write it raw."""
        crc = 0
        for piece in chunk.pieces:
            crc = zlib.crc32(piece, crc)
        pieces, name = (chunk.pieces, "") if packed is None else (packed, "zstd")
        n_bytes = sum(map(len, pieces))
        first, last = min(chunk.times), max(chunk.times)
        inner = struct.pack("<QQQII", first, last, chunk.n_bytes, crc, len(name))
        inner += name.encode() + struct.pack("<Q", n_bytes)
        head = struct.pack("<BQ", Opcode.CHUNK, len(inner) + n_bytes) + inner
        start, length = self.n_bytes, len(head) + n_bytes
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

    def sync(self) -> None:
        """Have the system put all on the disk, if it was not asked for a while."""
        if time.monotonic() - self._synced > SYNC_SECONDS:
            os.fsync(self._handle)
            self._synced = time.monotonic()

    def finish(self) -> None:
        """Write the summary, and have all put on the disk."""
        self._write(self._summary())
        os.fsync(self._handle)
        self.has_summary = True

    def cut_off(self) -> None:
        """Take off what was begun and is not whole."""
        os.ftruncate(self._handle, self.n_bytes)
        os.lseek(self._handle, self.n_bytes, os.SEEK_SET)

    def _write(self, pieces: Sequence[bytes]) -> None:
        """Write pieces that belong together; the file's size counts them when all are written."""
        total = 0
        for first in range(0, len(pieces), MOST_PIECES):
            rest = [memoryview(piece) for piece in pieces[first : first + MOST_PIECES] if piece]
            while rest:
                done = _write_some(self._handle, rest)
                total += done
                while rest and done >= len(rest[0]):
                    done -= len(rest.pop(0))
                if done:
                    rest[0] = rest[0][done:]
        self.n_bytes += total

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
        start = self.n_bytes + len(end)
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, 0)
        footer = head + struct.pack("<I", zlib.crc32(head, zlib.crc32(body)))
        return (end, body, footer, MAGIC)


def _write_some(handle: int, pieces: list[memoryview]) -> int:
    """Windows cannot write several pieces at once."""
    if hasattr(os, "writev"):
        return os.writev(handle, pieces)
    return os.write(handle, pieces[0])


def _record(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())
