# SPDX-License-Identifier: Apache-2.0
"""Points out of triangle meshes, STL and OBJ, and a cloud as an OBJ file of points."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np

from armscan.errors import FileFormatError
from armscan.geometry.arrays import FloatArray
from armscan.records.cloud import PointCloud
from armscan.storage.files import path_text
from armscan.storage.formats.columns import (
    DAMAGED,
    FORCED,
    NORMAL,
    POINT,
    SIMULATED,
    CloudColumns,
)
from armscan.storage.formats.ply import vertices_remark

OBJ_LOSES = (
    "sigma_mm and covariance",
    "sheet, exposure and segment",
    "intensity",
    "digits beyond 0.1 nm",
)
"""What an OBJ file of points does not hold."""
TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
HEADER_BYTES = 80


def stl_columns(data: bytes, path: Path) -> CloudColumns:
    """Vertices of an STL file, binary or ASCII, each once.

    Raises
    ------
    FileFormatError
        If it is cut short, or no STL file.
    """
    where = path_text(path)
    corners = _ascii_corners(data, where) if _is_ascii(data) else _binary_corners(data, where)
    points = np.unique(corners, axis=0)
    return CloudColumns(
        {name: points[:, k] for k, name in enumerate(POINT)},
        remarks=(vertices_remark(len(corners) // 3),),
    )


def _is_ascii(data: bytes) -> bool:
    """Whether the text names corners: binary headers may begin with "solid" too."""
    return data[:5].lower() == b"solid" and b"vertex" in data[:2000]


def _ascii_corners(data: bytes, where: str) -> FloatArray:
    """(3 M, 3) corners of the triangles."""
    words = [line.split() for line in data.splitlines()]
    try:
        found = [[float(word) for word in row[1:4]] for row in words if row[:1] == [b"vertex"]]
        corners = np.array(found, dtype=np.float64).reshape(len(found), 3)
    except ValueError as error:
        raise FileFormatError(
            "the corners of the STL file are not understood", where=where, remedy=DAMAGED
        ) from error
    if len(corners) % 3 or b"endsolid" not in data[-1000:].lower():
        raise FileFormatError("the STL file is cut short", where=where, remedy=DAMAGED)
    return corners


def _binary_corners(data: bytes, where: str) -> FloatArray:
    """(3 M, 3) corners of the triangles."""
    room = len(data) - HEADER_BYTES - 4
    if room < 0:
        raise FileFormatError("this is not an STL file", where=where, remedy=DAMAGED)
    told = int.from_bytes(data[HEADER_BYTES : HEADER_BYTES + 4], "little")
    held = room // TRIANGLE.itemsize
    if held < told:
        raise FileFormatError(
            f"the STL file holds {held} of {told} triangles",
            where=where,
            remedy="copy the file again",
        )
    table = np.frombuffer(data, TRIANGLE, told, HEADER_BYTES + 4)
    return np.asarray(table["corners"].reshape(-1, 3), dtype=np.float64)


def obj_columns(data: bytes, path: Path) -> CloudColumns:
    """Vertices of an OBJ file, with its normals where there is one for each.

    Raises
    ------
    FileFormatError
        If it holds no vertices, or numbers that are not understood.
    """
    lines = data.decode("utf-8-sig", errors="replace").splitlines()
    points = _numbers(lines, "v ", path)
    if not len(points):
        raise FileFormatError(
            "the OBJ file holds no vertices", where=path_text(path), remedy=DAMAGED
        )
    columns = {name: points[:, k] for k, name in enumerate(POINT)}
    normals = _numbers(lines, "vn ", path)
    n_faces = sum(line.startswith("f ") for line in lines)
    if len(normals) == len(points) and not n_faces:
        columns |= {name: normals[:, k] for k, name in enumerate(NORMAL)}
    notes = tuple(line.removeprefix("# ") for line in lines if line.startswith("# "))
    remarks = (vertices_remark(n_faces),) if n_faces else ()
    return CloudColumns(columns, notes, remarks=remarks)


def _numbers(lines: list[str], word: str, path: Path) -> FloatArray:
    """(N, 3) of the lines that begin with a word."""
    rows = [line.removeprefix(word).split()[:3] for line in lines if line.startswith(word)]
    try:
        return np.array(rows, dtype=np.float64).reshape(len(rows), 3)
    except ValueError as error:
        raise FileFormatError(
            "the vertices of the OBJ file are not understood",
            where=path_text(path),
            remedy=DAMAGED,
        ) from error


def obj_bytes(cloud: PointCloud) -> bytes:
    """Content of an OBJ file of points without faces; it lacks `OBJ_LOSES`."""
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
