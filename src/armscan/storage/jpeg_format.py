# SPDX-License-Identifier: Apache-2.0
"""Whether a JPEG file holds its whole picture: its markers, and the codes between them.

A decoder draws a file that lacks bytes in the middle with a grey or shifted rest and no error. So
the codes of sequential files (ITU T.81, baseline and extended) are counted before the picture is
used. Of progressive and arithmetic files, which cameras do not write, only the markers are
followed.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from math import ceil

import numpy as np

from armscan.geometry.arrays import IntArray
from armscan.kernels.jpeg_entropy import WHOLE, walk_scan

NO_LENGTH = frozenset({0x01, *range(0xD0, 0xD8)})
END, SCAN, HUFFMAN, RESTART_INTERVAL = 0xD9, 0xDA, 0xC4, 0xDD
SEQUENTIAL = (0xC0, 0xC1)
FRAMES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
FILL_BYTES = 2
"""Bytes that some writers leave between the last code and the end."""
MOST_PIXELS_A_BYTE = 1600
"""A block of 64 pixels takes two codes of at least two bits in all: 0.04 bytes with its share of
the chroma. A header that claims more than this is not that of the data."""
STANDARD_TABLES = bytes.fromhex(
    "0000010501010101010100000000000000000102030405060708090a0b100002010303020403050504040000"
    "017d01020300041105122131410613516107227114328191a1082342b1c11552d1f02433627282090a161718"
    "191a25262728292a3435363738393a434445464748494a535455565758595a636465666768696a7374757677"
    "78797a838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7"
    "c8c9cad2d3d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa010003010101010101010101"
    "0000000000000102030405060708090a0b110002010204040304070504040001027700010203110405213106"
    "1241510761711322328108144291a1b1c109233352f0156272d10a162434e125f11718191a262728292a3536"
    "3738393a434445464748494a535455565758595a636465666768696a737475767778797a8283848586878889"
    "8a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8"
    "d9dae2e3e4e5e6e7e8e9eaf2f3f4f5f6f7f8f9fa"
)
"""Codes of T.81, annex K: single pictures of a camera's MJPEG stream hold none, and mean these."""


@dataclass
class _Picture:
    """What the markers have said so far."""

    is_sequential: bool = False
    size_px: tuple[int, int] = (0, 0)
    components: dict[int, tuple[int, int]] = field(default_factory=dict)
    tables: dict[int, IntArray] = field(default_factory=dict)
    restart: int = 0


def jpeg_defect(data: bytes) -> str:
    """What is wrong with a JPEG file, as the end of a sentence; empty if nothing was found.

    Raises
    ------
    struct.error, IndexError
        If it ends within a marker.
    """
    picture, position = _Picture(), 2
    while True:
        position = data.find(b"\xff", position)
        if position < 0 or position + 1 >= len(data):
            return "is cut short"
        marker = data[position + 1]
        if marker == END:
            return ""
        if marker in NO_LENGTH or marker in (0x00, 0xFF):
            position += 1 if marker == 0xFF else 2
            continue
        (length,) = struct.unpack_from(">H", data, position + 2)
        body = data[position + 4 : position + 2 + length]
        position += 2 + length
        if marker == SCAN:
            if not picture.tables:
                _read_tables(STANDARD_TABLES, picture.tables)
            end = _end_of_scan(data, position)
            defect = "is cut short" if end < 0 else _scan_defect(data[position:end], body, picture)
            position = end
        else:
            defect = _heading_defect(marker, body, picture, len(data))
        if defect:
            return defect


def _heading_defect(marker: int, body: bytes, picture: _Picture, n_bytes: int) -> str:
    """Take in what a marker says of the picture."""
    if marker in FRAMES:
        picture.is_sequential = marker in SEQUENTIAL
        height, width, n = struct.unpack_from(">HHB", body, 1)
        picture.size_px = (width, height)
        picture.components = {
            body[6 + 3 * k]: (body[7 + 3 * k] >> 4, body[7 + 3 * k] & 15) for k in range(n)
        }
        if width * height > MOST_PIXELS_A_BYTE * n_bytes:
            return f"claims {width} x {height} px, more than its {n_bytes} bytes can hold"
    elif marker == HUFFMAN:
        _read_tables(body, picture.tables)
    elif marker == RESTART_INTERVAL:
        (picture.restart,) = struct.unpack_from(">H", body)
    return ""


def _read_tables(body: bytes, tables: dict[int, IntArray]) -> None:
    """Spread each code over all 16-bit words that begin with it (T.81, annex C)."""
    position = 0
    while position + 17 <= len(body):
        kind, counts = body[position], body[position + 1 : position + 17]
        values = body[position + 17 : position + 17 + sum(counts)]
        position += 17 + sum(counts)
        table = np.zeros(1 << 16, dtype=np.int64)
        start, used = 0, 0
        for length, count in enumerate(counts, start=1):
            width = 1 << (16 - length)
            for value in values[used : used + count]:
                table[start : start + width] = 256 * length + value
                start += width
            used += count
        tables[kind] = table


def _end_of_scan(data: bytes, position: int) -> int:
    """Where the next marker that does not belong to a scan begins; -1 if there is none."""
    while True:
        position = data.find(b"\xff", position)
        if position < 0 or position + 1 >= len(data):
            return -1
        marker = data[position + 1]
        if marker == 0x00 or 0xD0 <= marker <= 0xD7:
            position += 2
        elif marker == 0xFF:
            position += 1
        else:
            return position


def _scan_defect(codes: bytes, header: bytes, picture: _Picture) -> str:
    if not picture.is_sequential:
        return ""
    n = header[0]
    chosen = [(header[1 + 2 * k], header[2 + 2 * k]) for k in range(n)]
    kinds = sorted(picture.tables)
    places: list[tuple[int, int]] = []
    across, down = (max(sizes) for sizes in zip(*picture.components.values(), strict=True))
    width, height = picture.size_px
    for component, codes_of in chosen:
        if component not in picture.components:
            return f"has a scan of a colour {component} that it has not"
        pair = (codes_of >> 4, 0x10 | (codes_of & 15))
        if not set(pair) <= set(kinds):
            return "lacks a table of codes"
        h, v = picture.components[component]
        # a scan of one colour has one block a unit
        n_blocks = h * v if n > 1 else 1
        places += [(kinds.index(pair[0]), kinds.index(pair[1]))] * n_blocks
    if n > 1:
        n_units = ceil(width / (8 * across)) * ceil(height / (8 * down))
    else:
        h, v = picture.components[chosen[0][0]]
        n_units = ceil(ceil(width * h / across) / 8) * ceil(ceil(height * v / down) / 8)
    tables = np.stack([picture.tables[kind] for kind in kinds])
    defect, left = walk_scan(
        np.frombuffer(codes, np.uint8), tables, np.array(places), n_units, picture.restart
    )
    if defect != WHOLE:
        return f"is damaged: {left} of {n_units} blocks of its picture are missing or unreadable"
    return f"is damaged: {left} bytes too many in its picture" if left > FILL_BYTES else ""
