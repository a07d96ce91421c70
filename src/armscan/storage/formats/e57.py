# SPDX-License-Identifier: Apache-2.0
"""E57 (ASTM E2807), the exchange format of 3-D imaging: all columns (extra ``formats``).

The standard counts in metres. Columns that it does not know are fields of an extension, which
other programs pass over; notes are the scan's description.
"""

from __future__ import annotations

import tempfile
import uuid
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.errors import FileFormatError
from armscan.geometry.arrays import FloatArray
from armscan.storage.files import path_text
from armscan.storage.formats.columns import (
    DAMAGED,
    POINT,
    WHOLE,
    CloudColumns,
    CloudPiece,
    Column,
    cloud_columns,
    needed_packages,
)

MM_PER_M = 1000.0
OWN, OWN_URI = "armscan", "urn:armscan:cloud:1"
NORMALS, NORMALS_URI = "nor", "http://www.libe57.org/E57_NOR_surface_normals.txt"
FIELDS = {
    **{name: f"cartesian{name.upper()}" for name in POINT},
    **{f"n{name}": f"{NORMALS}:normal{name.upper()}" for name in POINT},
    "intensity": "intensity",
}
"""Columns that the standard, or its extension for normals, has a name for."""
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
INVALID = ("cartesianInvalidState", "sphericalInvalidState")


def e57_bytes(piece: CloudPiece) -> bytes:
    """Content of an E57 file of one scan that holds all of a cloud.

    Raises
    ------
    OptionError
        If the package is not installed.
    """
    pye57 = needed_packages("E57", "pye57")
    found = cloud_columns(piece)
    values = {
        FIELDS.get(name, f"{OWN}:{name}"): np.array(column, np.float64)
        for name, column in found.columns.items()
    }
    for name in POINT:
        values[FIELDS[name]] /= MM_PER_M
    # the library writes to a path only
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.e57"
        file = pye57.E57(str(path), mode="w")
        try:
            _write_scan(file, pye57.libe57, values, "\n".join(found.notes))
        finally:
            file.close()
        return path.read_bytes()


def _write_scan(file: Any, lib: Any, values: dict[str, FloatArray], notes: str) -> None:
    image = file.image_file
    image.extensionsAdd(NORMALS, NORMALS_URI)
    image.extensionsAdd(OWN, OWN_URI)
    scan = lib.StructureNode(image)
    scan.set("guid", lib.StringNode(image, f"{{{uuid.uuid4()}}}"))
    scan.set("name", lib.StringNode(image, "armscan"))
    scan.set("description", lib.StringNode(image, notes))
    prototype = lib.StructureNode(image)
    buffers = lib.VectorSourceDestBuffer()
    for name, column in values.items():
        low, high = (float(column.min()), float(column.max())) if len(column) else (0.0, 0.0)
        if name.removeprefix(f"{OWN}:") in WHOLE:
            node = lib.IntegerNode(image, int(low), int(low), int(high))
        else:
            node = lib.FloatNode(image, low, lib.E57_DOUBLE, low, high)
        prototype.set(name, node)
        buffers.append(lib.SourceDestBuffer(image, name, column, len(column), True, True))
    _set_limits(scan, image, lib, values)
    points = lib.CompressedVectorNode(image, prototype, lib.VectorNode(image, True))
    scan.set("points", points)
    file.data3d.append(scan)
    n = len(values[FIELDS["x"]])
    writer = points.writer(buffers)
    if n:
        writer.write(n)
    writer.close()


def _set_limits(scan: Any, image: Any, lib: Any, values: dict[str, FloatArray]) -> None:
    """Bounds that viewers frame and grade a scan by."""
    if not len(values[FIELDS["x"]]):
        return
    for group, names in (
        ("cartesianBounds", {axis: FIELDS[axis] for axis in POINT}),
        ("intensityLimits", {"intensity": "intensity"}),
    ):
        node = lib.StructureNode(image)
        for name, field in names.items():
            node.set(f"{name}Minimum", lib.FloatNode(image, float(values[field].min())))
            node.set(f"{name}Maximum", lib.FloatNode(image, float(values[field].max())))
        scan.set(group, node)


def e57_columns(data: bytes, path: Path) -> CloudColumns:
    """What the scans of an E57 file carry: each in its place, another program's as one exposure.

    Raises
    ------
    OptionError
        If the package is not installed.
    """
    where = path_text(path)
    if not data.startswith(b"ASTM-E57"):
        raise FileFormatError("this is not an E57 file", where=where, remedy=DAMAGED)
    pye57 = needed_packages("E57", "pye57")
    try:
        file = pye57.E57(str(path))
        try:
            scans = [_scan(file, pye57.libe57, k) for k in range(file.scan_count)]
        finally:
            file.close()
    except Exception as error:
        raise FileFormatError(
            f"the E57 file is not understood ({str(error).splitlines()[0] if str(error) else ''})",
            where=where,
            remedy=DAMAGED,
        ) from error
    if not scans:
        raise FileFormatError("the E57 file holds no scan", where=where, remedy=DAMAGED)
    if len(scans) == 1 and CloudColumns(scans[0][0]).is_own:
        return CloudColumns(scans[0][0], tuple(scans[0][1].splitlines()))
    return _together(scans, path)


def _scan(file: Any, lib: Any, k: int) -> tuple[dict[str, Column], str]:
    """Columns of one scan in mm and in the file's frame, and its description."""
    header = file.get_header(k)
    n = int(header.point_count)
    fields = set(header.point_fields)
    known = {theirs: own for own, theirs in FIELDS.items()}
    wanted = [
        name
        for name in header.point_fields
        if name in known or name in (*SPHERICAL, *INVALID) or name.startswith(f"{OWN}:")
    ]
    raw = {name: np.zeros(n) for name in wanted}
    buffers = lib.VectorSourceDestBuffer()
    for name in wanted:
        buffers.append(lib.SourceDestBuffer(file.image_file, name, raw[name], n, True, True))
    if n:
        header.points.reader(buffers).read()
    is_round = not {FIELDS[axis] for axis in POINT} <= fields
    invalid = raw.get(INVALID[int(is_round)])
    is_valid = np.ones(n, np.bool_) if invalid is None else invalid == 0
    if is_round:
        points = _from_spherical(*(raw[name][is_valid] for name in SPHERICAL))
    else:
        points = np.stack([raw[FIELDS[axis]][is_valid] for axis in POINT], axis=1)
    turn = np.eye(3)
    if header.has_pose():
        turn = Rotation.from_quat(np.roll(header.rotation, -1)).as_matrix()
        points = points @ turn.T + np.asarray(header.translation, np.float64)
    columns: dict[str, Column] = {axis: MM_PER_M * points[:, j] for j, axis in enumerate(POINT)}
    for name in wanted:
        own = known.get(name, name.removeprefix(f"{OWN}:"))
        if own not in (*POINT, *SPHERICAL, *INVALID):
            columns[own] = raw[name][is_valid]
    if {f"n{axis}" for axis in POINT} <= set(columns):
        normals = np.stack([columns[f"n{axis}"] for axis in POINT], axis=1) @ turn.T
        columns |= {f"n{axis}": normals[:, j] for j, axis in enumerate(POINT)}
    scan = file.data3d[k]
    return columns, scan["description"].value() if scan.isDefined("description") else ""


def _from_spherical(range_m: FloatArray, azimuth: FloatArray, elevation: FloatArray) -> FloatArray:
    """(N, 3) positions of points in spherical coordinates (ASTM E2807, 8.4)."""
    flat = range_m * np.cos(elevation)
    return np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), range_m * np.sin(elevation)], axis=1
    )


def _together(scans: list[tuple[dict[str, Column], str]], path: Path) -> CloudColumns:
    """Scans of another program as one cloud: what all of them carry."""
    shared = set.intersection(*(set(columns) for columns, _ in scans))
    columns = {
        name: np.concatenate([scan[name] for scan, _ in scans])
        for name in scans[0][0]
        if name in shared
    }
    counts = [len(scan["x"]) for scan, _ in scans]
    columns["exposure"] = np.repeat(np.arange(len(scans)), counts)
    sources = tuple(f"{path.name} scan {k + 1}" for k in range(len(scans)))
    remark = f"{len(scans)} scans are put together, each in its place and as one exposure"
    return CloudColumns(columns, sources=sources, remarks=(remark,) if len(scans) > 1 else ())
