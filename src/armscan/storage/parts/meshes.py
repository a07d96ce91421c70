# SPDX-License-Identifier: Apache-2.0
"""Triangle meshes from STL (text and binary), PLY and OBJ files, and as binary STL and PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from armscan.errors import FileFormatError, OptionError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.inspection.cad.part import PartModel, part_of
from armscan.storage.files import path_text, read_bytes
from armscan.storage.formats.columns import DAMAGED as CUT
from armscan.storage.formats.meshes import parse_obj, stl_corners
from armscan.storage.formats.ply import BYTE_ORDERS, TYPES, parse_ply
from armscan.storage.parts.step import STEP_SUFFIXES, ChordError, read_step

MESH_SUFFIXES, SURFACE_SUFFIXES = (".stl", ".ply", ".obj"), (".stl", ".ply")
"""That are read, and that are written."""
_HEADER_BYTES = 80
UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
"""Length of each unit that a mesh may be in; mesh files do not tell."""
MOST_CORNERS = 1000
"""Corners of one polygon."""


def read_part(path: Path, *, unit: str = "mm", chord: ChordError | None = None) -> PartModel:
    """Read the model of a part.

    Parameters
    ----------
    path
        ``.stl``, ``.ply``, ``.obj``, ``.step`` or ``.stp``.
    unit
        Unit of a mesh's numbers, of `UNITS_MM`; STEP files say theirs.
    chord
        How finely a STEP file's faces are made into triangles.

    Raises
    ------
    OptionError
        If a unit is given for a STEP file, or a chord error for a mesh.
    InputError
        If it holds no surface.
    """
    suffix, where = path.suffix.lower(), path_text(path)
    if suffix in STEP_SUFFIXES and unit != "mm":
        raise OptionError(
            "a STEP file says its own unit", where="--unit", remedy="leave out --unit"
        )
    if suffix not in STEP_SUFFIXES and chord is not None:
        raise OptionError(
            "a mesh has no faces to make triangles of", where="--chord-mm", remedy="leave it out"
        )
    if suffix in STEP_SUFFIXES:
        return read_step(path, chord or ChordError())
    if suffix not in MESH_SUFFIXES:
        raise FileFormatError(
            "this is no model of a part that armscan knows",
            where=where,
            remedy=f"give one of {', '.join((*MESH_SUFFIXES, *STEP_SUFFIXES))}",
        )
    data = read_bytes(path)
    if not data.strip():
        raise FileFormatError("the file is empty", where=where, remedy=CUT)
    face: IntArray | None = None
    names: tuple[str, ...] = ()
    if suffix == ".obj":
        corners, face, names = _obj(data, where)
    else:
        corners = stl_corners(data, where) if suffix == ".stl" else _ply(data, where)
    return part_of(corners * UNITS_MM[unit], source=path.name, face=face, face_names=names)


def _ply(data: bytes, where: str) -> FloatArray:
    """(F, 3, 3) corners of a PLY mesh whose elements are vertices, then faces."""
    table = parse_ply(data, where).table
    if not {"x", "y", "z"} <= set(table.dtype.names or ()):
        raise FileFormatError("the PLY file's vertices have no x, y, z", where=where, remedy=CUT)
    points = np.stack([table[name].astype(np.float64) for name in "xyz"], axis=1)
    start = data.find(b"\n", data.find(b"\nend_header") + 1) + 1
    try:
        order, count, kinds = _ply_faces(data[:start].decode("latin-1"))
    except (ValueError, KeyError, IndexError, StopIteration) as error:
        raise FileFormatError(
            "the PLY header is not understood", where=where, remedy=CUT
        ) from error
    if count == 0:
        raise FileFormatError(
            "the PLY file holds points but no faces: it is a cloud, not the model of a part",
            where=where,
            remedy="give a mesh",
        )
    if order == "ascii":
        lines = [line for line in data[start:].split(b"\n") if line.strip()]
        rows = [line.split() for line in lines[len(table) : len(table) + count]]
        polygons = _text_polygons(rows, count, where)
    else:
        body = start + len(table) * table.dtype.itemsize
        polygons = _binary_polygons(
            data, body, count, kinds=kinds, order=BYTE_ORDERS[order], where=where
        )
    return _triangulated(points, polygons, where)


def _ply_faces(header: str) -> tuple[str, int, list[list[str]]]:
    """Byte order, count of faces, and their properties; `ValueError` and the like for no header."""
    words = [line.split() for line in header.split("\n")]
    order = next(line[1] for line in words if line[:1] == ["format"])
    elements = [k for k, line in enumerate(words) if line[:1] == ["element"]]
    if len(elements) < 2 or words[elements[1]][1] != "face":
        return order, 0, []
    end = elements[2] if len(elements) > 2 else len(words)
    kinds = [line[1:] for line in words[elements[1] : end] if line[:1] == ["property"]]
    for kind in kinds:
        # a type that is not known is a KeyError here, not while faces are read
        _ = [TYPES[name] for name in (kind[1:3] if kind[0] == "list" else kind[:1])]
    count = int(words[elements[1]][2])
    if count < 0:
        raise ValueError("a count below zero")
    return order, count, kinds


def _text_polygons(rows: list[list[bytes]], count: int, where: str) -> list[IntArray]:
    try:
        found = [np.array([int(word) for word in row[1 : 1 + int(row[0])]]) for row in rows]
        is_whole = all(len(one) == int(row[0]) for one, row in zip(found, rows, strict=True))
    except (ValueError, IndexError) as error:
        raise FileFormatError(
            "the faces of the PLY file are not understood", where=where, remedy=CUT
        ) from error
    if len(found) < count or not is_whole:
        raise _short(len(found), count, where)
    return found


def _binary_polygons(
    data: bytes, at: int, count: int, *, kinds: list[list[str]], order: str, where: str
) -> list[IntArray]:
    """Lists of corners; a table where all are triangles, which most are."""
    fields = []
    for k, kind in enumerate(kinds):
        if kind[0] == "list":
            fields += [(f"n{k}", order + TYPES[kind[1]]), (f"v{k}", order + TYPES[kind[2]], 3)]
        else:
            fields.append((f"s{k}", order + TYPES[kind[0]]))
    lists = [k for k, kind in enumerate(kinds) if kind[0] == "list"]
    if not lists:
        raise FileFormatError("the PLY file's faces list no corners", where=where, remedy=CUT)
    name = lists[0]
    triangles = np.dtype(fields)
    if len(lists) == 1 and at + count * triangles.itemsize <= len(data):
        table = np.frombuffer(data, triangles, count, at)
        if (table[f"n{name}"] == 3).all():
            return list(table[f"v{name}"].astype(np.int64))
    found: list[IntArray] = []
    for _ in range(count):
        corners = np.zeros(0, dtype=np.int64)
        for k, kind in enumerate(kinds):
            length = 1
            if kind[0] == "list":
                head = np.dtype(order + TYPES[kind[1]])
                if at + head.itemsize > len(data):
                    raise _short(len(found), count, where)
                length = int(np.frombuffer(data, head, 1, at)[0])
                at += head.itemsize
            item = np.dtype(order + TYPES[kind[2] if kind[0] == "list" else kind[0]])
            if not 0 <= length <= MOST_CORNERS or at + length * item.itemsize > len(data):
                raise _short(len(found), count, where)
            if k == name:
                corners = np.frombuffer(data, item, length, at).astype(np.int64)
            at += length * item.itemsize
        found.append(corners)
    return found


def _short(held: int, count: int, where: str) -> FileFormatError:
    return FileFormatError(
        f"the PLY file holds {held:,} of {count:,} faces", where=where, remedy=CUT
    )


def _triangulated(points: FloatArray, polygons: list[IntArray], where: str) -> FloatArray:
    """Corners of triangles, polygons with more corners cut from their first one."""
    fans = [
        np.stack([np.full(len(one) - 2, one[0]), one[1:-1], one[2:]], axis=1)
        for one in polygons
        if len(one) >= 3
    ]
    rows = np.concatenate(fans) if fans else np.zeros((0, 3), dtype=np.int64)
    if len(rows) and not 0 <= int(rows.min()) <= int(rows.max()) < len(points):
        raise FileFormatError(
            f"a face names a corner beyond the {len(points):,} of the file",
            where=where,
            remedy=CUT,
        )
    return np.asarray(points[rows])


def _obj(data: bytes, where: str) -> tuple[FloatArray, IntArray | None, tuple[str, ...]]:
    """Corners, and the groups ``g`` or ``o`` as faces where there are several."""
    found = parse_obj(data, where)
    corners = _triangulated(found.vertices, found.polygons, where)
    if len(set(found.group)) < 2:
        return corners, None, ()
    counts = [max(len(one) - 2, 0) for one in found.polygons]
    face = np.repeat(np.array(found.group, dtype=np.int64), counts)
    used, face = np.unique(face, return_inverse=True)
    return corners, face.astype(np.int64), tuple(found.names[k] for k in used.tolist())


def encoded_surface(suffix: str, vertices_mm: FloatArray, triangles: IntArray, title: str) -> bytes:
    """Content of a file of triangles.

    Parameters
    ----------
    suffix
        ``.stl``: corners of each triangle in single precision, which is 0.06 um at a metre.
        ``.ply``: vertices in double precision, each once.
    vertices_mm, triangles
        (V, 3) and (T, 3) rows of them, anticlockwise seen from outside.
    title
        What it is; STL keeps 80 letters of it.
    """
    if suffix == ".stl":
        return _stl(vertices_mm, triangles, title)
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment {title}\n"
        f"element vertex {len(vertices_mm)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(triangles)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(triangles), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    rows["count"], rows["corners"] = 3, triangles
    return header.encode("ascii", "replace") + vertices_mm.astype("<f8").tobytes() + rows.tobytes()


def _stl(vertices: FloatArray, triangles: IntArray, title: str) -> bytes:
    corners = vertices[triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=1, keepdims=True)
    facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    rows = np.zeros(len(triangles), facet)
    rows["normal"] = np.divide(across, length, out=np.zeros_like(across), where=length > 0.0)
    rows["corners"] = corners
    # a reader takes a file that begins with "solid" for text
    head = f"armscan: {title}".encode("ascii", "replace")[:_HEADER_BYTES].ljust(_HEADER_BYTES)
    return head + np.array(len(rows), "<u4").tobytes() + rows.tobytes()
