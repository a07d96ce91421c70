# SPDX-License-Identifier: Apache-2.0
"""Triangles of STL files, binary and text."""

from __future__ import annotations

import re

import numpy as np

from armscan.errors import FileFormatError
from armscan.geometry.arrays import FloatArray
from armscan.storage.formats.columns import DAMAGED

STL_HEADER, STL_RECORD = 84, 50
STL_TYPE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
VERTEX = re.compile(rb"^[ \t]*vertex[ \t]+(.*)$", re.MULTILINE)


def stl_corners(data: bytes, where: str) -> FloatArray:
    """(F, 3, 3) corners; the normals in the file are not used: the order of corners tells them.

    Raises
    ------
    FileFormatError
        If it is cut short, or no STL file.
    """
    count = int.from_bytes(data[80:84], "little") if len(data) >= STL_HEADER else -1
    is_text = data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:4096].lower()
    if count >= 0 and len(data) == STL_HEADER + STL_RECORD * count:
        is_text = False
    if is_text:
        return _text_corners(data, where)
    held = (len(data) - STL_HEADER) // STL_RECORD
    if count < 0 or held < count:
        raise FileFormatError(
            f"the STL file holds {max(held, 0):,} of {count:,} triangles"
            if count >= 0
            else "this is not an STL file",
            where=where,
            remedy=DAMAGED,
        )
    if held > count + 1 and count == 0:
        raise FileFormatError("this is not an STL file", where=where, remedy=DAMAGED)
    table = np.frombuffer(data, STL_TYPE, count, STL_HEADER)
    return np.asarray(table["corners"], dtype=np.float64)


def _text_corners(data: bytes, where: str) -> FloatArray:
    if b"endsolid" not in data[-4096:].lower():
        raise FileFormatError("the STL file is cut short: no endsolid", where=where, remedy=DAMAGED)
    words = b" ".join(VERTEX.findall(data.replace(b"\r", b"\n").lower())).split()
    numbers = float_numbers(words, where, "STL")
    if len(numbers) % 9:
        raise FileFormatError(
            f"the STL file holds {len(numbers)} coordinates, which make no whole triangles",
            where=where,
            remedy=DAMAGED,
        )
    return numbers.reshape(-1, 3, 3)


def float_numbers(words: list[bytes], where: str, kind: str) -> FloatArray:
    """(N,) numbers of a text file of some kind, as ``STL``.

    Raises
    ------
    FileFormatError
        If one of them is none.
    """
    try:
        return np.array(words, dtype=np.bytes_).astype(np.float64) if words else np.zeros(0)
    except ValueError as error:
        raise FileFormatError(
            f"numbers of the {kind} file are not understood", where=where, remedy=DAMAGED
        ) from error
