# SPDX-License-Identifier: Apache-2.0
"""The vertices of a PLY file as a numpy table."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armscan.errors import FileFormatError

TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
WRITTEN_TYPES = {"f8": "double", "i4": "int"}
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
HEADER = re.compile(rb"ply\s*\n(.*?)end_header\r?\n", re.DOTALL)


@dataclass(frozen=True, slots=True, eq=False)
class PlyVertices:
    """Vertices of a PLY file.

    Parameters
    ----------
    table
        (N,) structured array, one field a property.
    comments
        Comment lines of the header, without the word ``comment``.
    """

    table: NDArray[Any]
    comments: tuple[str, ...]


def ply_header(kind: np.dtype[Any], count: int, comments: Iterable[str]) -> bytes:
    """Header of a binary little-endian file with ``count`` vertices of a structured type."""
    properties = [
        f"property {WRITTEN_TYPES[kind[name].str[1:]]} {name}" for name in kind.names or ()
    ]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {text}" for text in comments),
        f"element vertex {count}",
        *properties,
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def parse_ply(data: bytes, where: str) -> PlyVertices:
    """Read the vertices of any PLY file whose first element they are.

    Raises
    ------
    FileFormatError
        If it is no PLY file, its vertices are lists or not first, or it is cut short.
    """
    header = HEADER.match(data)
    if header is None:
        raise FileFormatError(
            "this is not a PLY file with a complete header",
            where=where,
            remedy="copy the file again; it may be cut or damaged",
        )
    body = data[header.end() :]
    try:
        order, count, fields, comments = _header(header[1].decode("latin-1"))
    except (ValueError, KeyError, IndexError) as error:
        raise FileFormatError(
            "the PLY header is not understood",
            where=where,
            remedy="copy the file again; it may be cut or damaged",
        ) from error
    if order == "=":
        table = _ascii_table(body, fields, count, where)
    else:
        kind = np.dtype([(name, order + code) for name, code in fields])
        table = np.frombuffer(body[: len(body) // kind.itemsize * kind.itemsize], kind)[:count]
    if len(table) < count:
        raise FileFormatError(
            f"the PLY file holds {len(table)} of {count} points",
            where=where,
            remedy="copy the file again",
        )
    return PlyVertices(table, comments)


def _header(text: str) -> tuple[str, int, list[tuple[str, str]], tuple[str, ...]]:
    order, count = "", -1
    element = ""
    fields: list[tuple[str, str]] = []
    comments: list[str] = []
    for line in text.splitlines():
        words = line.split()
        if line.startswith("comment "):
            comments.append(line[8:])
        elif words[:1] == ["format"]:
            order = BYTE_ORDERS[words[1]]
        elif words[:1] == ["element"]:
            element = words[1]
            if element == "vertex":
                count = int(words[2])
            elif count < 0:
                raise ValueError("vertices are not the first element")
        elif words[:1] == ["property"] and element == "vertex":
            fields.append((words[2], TYPES[words[1]]))
    if not order or count < 0 or not fields:
        raise ValueError("the header names no vertices")
    return order, count, fields, tuple(comments)


def _ascii_table(
    body: bytes, fields: list[tuple[str, str]], count: int, where: str
) -> NDArray[Any]:
    rows = [line.split() for line in body.split(b"\n", count)[:count] if line.strip()]
    try:
        return np.array([tuple(float(word) for word in row) for row in rows], dtype=fields)
    except ValueError as error:
        raise FileFormatError(
            "the points of the PLY file are not understood",
            where=where,
            remedy="copy the file again; it may be cut or damaged",
        ) from error
