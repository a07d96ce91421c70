# SPDX-License-Identifier: Apache-2.0
"""Points out of triangle meshes, STL and OBJ, and a cloud as an OBJ file of points."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np

from armscan.errors import FileFormatError
from armscan.geometry.arrays import FloatArray
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
from armscan.storage.formats.stl import stl_corners
from armscan.storage.formats.text import SIGMA_LOSS

OBJ_LOSES = (
    SIGMA_LOSS,
    "sheet, exposure and segment",
    "intensity",
    "where the sensor stood",
    "which calibration",
    "n_points of a fused cloud",
    "digits beyond 0.1 nm",
)
"""What an OBJ file of points does not hold."""


def stl_columns(data: bytes, path: Path) -> CloudColumns:
    """Vertices of an STL file, binary or ASCII, each once.

    Raises
    ------
    FileFormatError
        If it is cut short, or no STL file.
    """
    corners = stl_corners(data, path_text(path))
    points = np.unique(corners.reshape(-1, 3), axis=0)
    return CloudColumns(
        {name: points[:, k] for k, name in enumerate(POINT)},
        remarks=(vertices_remark(len(corners)),),
    )


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
