# SPDX-License-Identifier: Apache-2.0
"""PLY: armscan's own clouds, which lose nothing, and the vertices of other programs' files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armscan.errors import FileFormatError
from armscan.records.cloud import PointCloud
from armscan.storage.files import path_text, read_bytes
from armscan.storage.formats.columns import (
    DAMAGED,
    MOST_HEADER_BYTES,
    CloudColumns,
    CloudPiece,
    cloud_notes,
    columns_of,
    header_bytes,
    own_cloud,
    point_columns,
    structured,
)

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
END_HEADER = re.compile(rb"end_header\r?\n")
MOST_PROPERTIES, MOST_DIGITS = 1000, 15


@dataclass(frozen=True, slots=True, eq=False)
class PlyVertices:
    """Vertices of a PLY file.

    Parameters
    ----------
    table
        (N,) structured array, one field a property.
    comments
        Comment lines of the header, without the word ``comment``.
    n_faces
        Faces that follow, which are not read.
    """

    table: NDArray[Any]
    comments: tuple[str, ...]
    n_faces: int = 0


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
    return header_bytes(lines)


def parse_ply(data: bytes, where: str) -> PlyVertices:
    """Read the vertices of any PLY file whose first element they are."""
    is_ply = data.startswith(b"ply")
    end = data.find(b"\nend_header", 0, MOST_HEADER_BYTES) if is_ply else -1
    start = data.find(b"\n", end + 1) + 1
    if END_HEADER.fullmatch(data[end + 1 : start]) is None or not is_ply:
        raise FileFormatError(
            "this is not a PLY file with a complete header", where=where, remedy=DAMAGED
        )
    try:
        text = data[:end].decode("latin-1")
        order, count, kind, vertices = _header(text)
    except (ValueError, KeyError, IndexError) as error:
        raise FileFormatError(
            "the PLY header is not understood", where=where, remedy=DAMAGED
        ) from error
    if order == "ascii":
        table = _ascii_table(data[start:], kind, count, where)
    else:
        table = np.frombuffer(data, kind, min(count, (len(data) - start) // kind.itemsize), start)
    if len(table) < count:
        raise FileFormatError(
            f"the PLY file holds {len(table)} of {count} points",
            where=where,
            remedy="copy the file again",
        )
    return replace(vertices, table=table)


def _header(text: str) -> tuple[str, int, np.dtype[Any], PlyVertices]:
    """Format, count and type of the vertices, and these with none read yet.

    `ValueError` for what is no header.
    """
    order, count, element = "", -1, ""
    fields: list[tuple[str, str]] = []
    comments: list[str] = []
    for line in text.split("\n"):
        words = line.split()
        if line.startswith("comment "):
            comments.append(line[8:].rstrip("\r"))
        elif words[:1] == ["format"]:
            order = words[1]
        elif words[:1] == ["element"]:
            element = words[1]
            if element == "vertex":
                count = int(words[2][:MOST_DIGITS])
            elif count < 0:
                raise ValueError("vertices are not the first element")
        elif words[:1] == ["property"] and element == "vertex":
            fields.append((words[2], BYTE_ORDERS[order] + TYPES[words[1]]))
    if count < 0 or not 0 < len(fields) <= MOST_PROPERTIES:
        raise ValueError("the header names no vertices")
    faces = re.search(r"^element face (\d{1,15})\b", text, re.MULTILINE)
    # a name that occurs twice is a ValueError of numpy
    kind = np.dtype(fields)
    none = PlyVertices(np.zeros(0, kind), tuple(comments), int(faces[1]) if faces else 0)
    return order, count, kind, none


def _ascii_table(body: bytes, kind: np.dtype[Any], count: int, where: str) -> NDArray[Any]:
    most = min(count, len(body))
    rows = [line.split() for line in body.split(b"\n", most)[:most] if line.strip()]
    try:
        return np.array([tuple(float(word) for word in row) for row in rows], dtype=kind)
    except (ValueError, OverflowError) as error:
        raise FileFormatError(
            "the points of the PLY file are not understood", where=where, remedy=DAMAGED
        ) from error


def ply_bytes(points: PointCloud | CloudPiece) -> bytes:
    """Content of a binary little-endian PLY file that holds all of a cloud, in float64 and int32.

    Names stand in the header: ``comment frame Sensor``, ``comment sheet 0 "A"``,
    ``comment exposure 0 "laser.png"``; of points measured on rendered images also
    ``comment simulated``, of those of a calibration that was refused and forced
    ``comment forced 0 "why"``.
    """
    piece = points if isinstance(points, CloudPiece) else CloudPiece(points)
    has_counts = piece.n_points is not None
    return b"".join(ply_parts(piece.cloud, len(piece.cloud), [piece], is_fused=has_counts))


def ply_parts(
    marks: PointCloud, n_points: int, pieces: Iterable[CloudPiece], *, is_fused: bool = False
) -> Iterator[bytes]:
    """As `ply_bytes`, of a cloud that comes in pieces.

    Parameters
    ----------
    marks
        Names and marks of the cloud, with or without points.
    n_points
        Of all pieces.
    pieces
        In order.
    is_fused
        The pieces say how many measured points each point stands for.
    """
    none = CloudPiece(
        marks.select(slice(0)), np.zeros(0), np.zeros(0, np.int64) if is_fused else None
    )
    yield ply_header(structured(point_columns(none)).dtype, n_points, cloud_notes(marks))
    for piece in pieces:
        yield structured(point_columns(piece)).tobytes()


def ply_columns(data: bytes, path: Path) -> CloudColumns:
    """What the vertices of any PLY file carry."""
    return _columns(parse_ply(data, path_text(path)))


def _columns(vertices: PlyVertices) -> CloudColumns:
    remarks = (vertices_remark(vertices.n_faces),) if vertices.n_faces else ()
    return CloudColumns(columns_of(vertices.table), vertices.comments, remarks=remarks)


def ply_pieces(path: Path, most_points: int) -> Iterator[CloudColumns] | None:
    """Vertices of a binary PLY file, so many at a time; None for any other file."""
    with path.open("rb") as file:
        lines: list[bytes] = []
        n_bytes = 0
        while (line := file.readline()) and n_bytes < MOST_HEADER_BYTES:
            lines.append(line)
            n_bytes += len(line)
            if not lines[0].startswith(b"ply") or END_HEADER.fullmatch(line):
                break
    start = b"".join(lines)
    is_binary = start.startswith(b"ply") and b"\nformat binary" in start[:100]
    if not (is_binary and END_HEADER.fullmatch(line)):
        return None
    try:
        _, count, _, empty = _header(start.decode("latin-1"))
    except (ValueError, KeyError, IndexError):
        # what is wrong with a header is said by the reader of whole files
        return None
    return _pieces(path, len(start), count, empty, most_points)


def _pieces(
    path: Path, start: int, count: int, empty: PlyVertices, most_points: int
) -> Iterator[CloudColumns]:
    kind = empty.table.dtype
    with path.open("rb") as file:
        file.seek(start)
        for first in range(0, count, most_points):
            asked = min(most_points, count - first)
            data = file.read(asked * kind.itemsize)
            n = len(data) // kind.itemsize
            if n < asked:
                raise FileFormatError(
                    f"the PLY file holds {first + n} of {count} points",
                    where=path_text(path),
                    remedy="copy the file again",
                )
            yield _columns(replace(empty, table=np.frombuffer(data, kind, asked)))


def vertices_remark(n_triangles: int) -> str:
    """What it means that a cloud was made from a mesh, in words."""
    return (
        f"the file is a mesh of {n_triangles:,} faces: its vertices are taken for points, as "
        "dense or sparse as they are; nothing is sampled between them"
    )


def read_ply(path: Path) -> PointCloud:
    """Read a cloud that armscan wrote."""
    return own_cloud(ply_columns(read_bytes(path), path), path_text(path))
