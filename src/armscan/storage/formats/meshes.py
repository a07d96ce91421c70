# SPDX-License-Identifier: Apache-2.0
"""Triangles of STL files, points out of meshes, and a cloud as an OBJ file of points."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from armscan.errors import FileFormatError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.storage.files import path_text
from armscan.storage.formats.columns import (
    DAMAGED,
    FORCED,
    NORMAL,
    POINT,
    SIMULATED,
    CloudColumns,
    CloudPiece,
)
from armscan.storage.formats.ply import vertices_remark
from armscan.storage.formats.text import XYZ_LOSES

BYTE_ORDER_MARK = b"\xef\xbb\xbf"
OBJ_LOSES = tuple(words for words in XYZ_LOSES if words != "normals")
"""What an OBJ file of points does not hold."""


def stl_columns(data: bytes, path: Path) -> CloudColumns:
    """Vertices of an STL file, binary or ASCII, each once."""
    corners = stl_corners(data, path_text(path))
    points = np.unique(corners.reshape(-1, 3), axis=0)
    return CloudColumns(
        {name: points[:, k] for k, name in enumerate(POINT)},
        remarks=(vertices_remark(len(corners)),),
    )


class ObjContent(NamedTuple):
    """What an OBJ file holds.

    Parameters
    ----------
    vertices, normals
        (N, 3) of the lines ``v``, (M, 3) of the lines ``vn``.
    polygons
        Of each line ``f`` its (K,) rows of ``vertices``; beyond these where the file is damaged.
    group
        Of each polygon the row of ``names``.
    names
        Of groups and objects, in order; "unnamed" before the first.
    notes
        Comments.
    """

    vertices: FloatArray
    normals: FloatArray
    polygons: list[IntArray]
    group: list[int]
    names: tuple[str, ...]
    notes: tuple[str, ...]


def parse_obj(data: bytes, where: str) -> ObjContent:
    """Content of an OBJ file."""
    vertices: list[bytes] = []
    normals: list[bytes] = []
    polygons: list[IntArray] = []
    owner: list[int] = []
    names: dict[str, int] = {}
    notes: list[str] = []
    group, n = 0, 0
    for line in data.removeprefix(BYTE_ORDER_MARK).splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == b"v":
            vertices += words[1:4]
            n += 1
        elif words[0] == b"vn":
            normals += words[1:4]
        elif words[0] == b"f":
            polygons.append(_polygon(words[1:], n, where))
            owner.append(group)
        elif words[0] in (b"g", b"o"):
            name = b" ".join(words[1:]).decode("utf-8", "replace") or "unnamed"
            group = names.setdefault(name, len(names))
        elif line.startswith(b"# "):
            notes.append(line[2:].decode("utf-8", "replace"))
    if len(vertices) != 3 * n or len(normals) % 3:
        raise FileFormatError(
            "a vertex of the OBJ file has no three numbers", where=where, remedy=DAMAGED
        )
    return ObjContent(
        float_numbers(vertices, where, "OBJ").reshape(-1, 3),
        float_numbers(normals, where, "OBJ").reshape(-1, 3),
        polygons,
        owner,
        tuple(names) or ("unnamed",),
        tuple(notes),
    )


def _polygon(words: list[bytes], n: int, where: str) -> IntArray:
    """Rows of the vertices of a face; numbers below 0 count back from the last one so far."""
    try:
        rows = np.array([int(word.partition(b"/")[0]) for word in words], dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise FileFormatError(
            "the faces of the OBJ file are not understood", where=where, remedy=DAMAGED
        ) from error
    return np.where(rows < 0, n + rows, rows - 1)


def obj_columns(data: bytes, path: Path) -> CloudColumns:
    """Vertices of an OBJ file, with its normals where there is one for each."""
    found = parse_obj(data, path_text(path))
    points, normals = found.vertices, found.normals
    if not len(points):
        raise FileFormatError(
            "the OBJ file holds no vertices", where=path_text(path), remedy=DAMAGED
        )
    columns = {name: points[:, k] for k, name in enumerate(POINT)}
    n_faces = len(found.polygons)
    if len(normals) == len(points) and not n_faces:
        columns |= {name: normals[:, k] for k, name in enumerate(NORMAL)}
    remarks = (vertices_remark(n_faces),) if n_faces else ()
    return CloudColumns(columns, found.notes, remarks=remarks)


def obj_bytes(piece: CloudPiece) -> bytes:
    """Content of an OBJ file of points without faces; it lacks `OBJ_LOSES`."""
    cloud = piece.cloud
    buffer = io.StringIO()
    buffer.write(f"# frame {cloud.frame}\n")
    if cloud.is_simulated:
        buffer.write(f"# {SIMULATED}\n")
    for k, reason in enumerate(cloud.forced):
        buffer.write(f"# {FORCED} {k} {json.dumps(reason)}\n")
    np.savetxt(buffer, cloud.points_mm, fmt="v %.7f %.7f %.7f")
    if cloud.normals is not None:
        np.savetxt(buffer, cloud.normals, fmt="vn %.7f %.7f %.7f")
    return buffer.getvalue().encode()


STL_HEADER, STL_RECORD = 84, 50
STL_TYPE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
VERTEX = re.compile(rb"^[ \t]*vertex[ \t]+(.*)$", re.MULTILINE)


def stl_corners(data: bytes, where: str) -> FloatArray:
    """(F, 3, 3) corners; the normals in the file are not used: the order of corners tells them."""
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
    """(N,) numbers of a text file of some kind, as ``STL``."""
    try:
        return np.array(words, dtype=np.bytes_).astype(np.float64) if words else np.zeros(0)
    except ValueError as error:
        raise FileFormatError(
            f"numbers of the {kind} file are not understood", where=where, remedy=DAMAGED
        ) from error
