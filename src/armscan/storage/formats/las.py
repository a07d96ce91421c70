# SPDX-License-Identifier: Apache-2.0
"""LAS and LAZ, the files of laser scanning: all columns, positions on a grid (extra ``formats``).

Coordinates are written in mm, as whole multiples of a step; other columns as extra dimensions in
float64; notes in a record of armscan's own.
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import FileFormatError
from armscan.records.cloud import PointCloud
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

FINEST_STEP_MM = 1e-6
COARSEST_KEPT_MM = 1e-4
"""Step up to which nothing that a scanner can tell is lost."""
OFFSET_OFF_MM = 0.5
"""How far the offset, a whole number of mm, lies from a cloud's middle at most."""
LARGEST_MULTIPLE = 2**31 - 2
LARGEST_RECORD = 60_000
"""Bytes of a record of notes; a record may have 65,535."""
MOST_PACKED = 100_000
"""Bytes that a byte of LAZ stands for at most: a header that promises more is damaged."""
RECORD_USER, RECORD_ID = "armscan", 1
GREY_STEPS = 256
"""LAS holds grey levels as whole numbers: other programs see this many a level of 8 bits."""


def step_mm(cloud: PointCloud) -> float:
    """Step of the grid on which a cloud's positions are written: as fine as its extent allows."""
    half_width = float(np.ptp(cloud.points_mm, axis=0).max()) / 2.0 if len(cloud) else 0.0
    needed = (half_width + OFFSET_OFF_MM) / LARGEST_MULTIPLE
    return max(FINEST_STEP_MM, 10.0 ** math.ceil(math.log10(needed)))


def las_losses(cloud: PointCloud) -> tuple[str, ...]:
    """What a LAS or LAZ file of a cloud does not hold."""
    step = step_mm(cloud)
    lost = f"positions between multiples of {step:g} mm"
    if step > COARSEST_KEPT_MM:
        lost += f" (more than {COARSEST_KEPT_MM:g}: the cloud is {step * 4e9:,.0f} mm wide)"
    return (lost,)


def las_bytes(piece: CloudPiece, *, is_packed: bool) -> bytes:
    """Content of a LAS 1.4 file, packed as LAZ.

    Raises
    ------
    OptionError
        If the packages are not installed.
    """
    laspy = needed_packages("LAS and LAZ", "laspy", "lazrs")
    found, cloud = cloud_columns(piece), piece.cloud
    header = laspy.LasHeader(point_format=6, version="1.4")
    middle = (
        (cloud.points_mm.min(axis=0) + cloud.points_mm.max(axis=0)) / 2.0
        if len(cloud)
        else np.zeros(3)
    )
    header.offsets, header.scales = np.round(middle), np.full(3, step_mm(cloud))
    extra = [name for name in found.columns if name not in POINT]
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(
                name=_theirs(name), type=np.dtype("i4" if name in WHOLE else "f8")
            )
            for name in extra
        ]
    )
    for k, text in enumerate(_pieces(found.notes)):
        header.vlrs.append(laspy.VLR(RECORD_USER, RECORD_ID + k, "notes", text))
    file = laspy.LasData(header)
    file.x, file.y, file.z = cloud.points_mm.T
    file.intensity = np.clip(np.round(cloud.intensity * GREY_STEPS), 0, 65535).astype(np.uint16)
    for name in extra:
        file[_theirs(name)] = found.columns[name]
    out = io.BytesIO()
    file.write(out, do_compress=is_packed)
    return out.getvalue()


def las_columns(data: bytes, path: Path) -> CloudColumns:
    """What the points of a LAS or LAZ file carry.

    Raises
    ------
    OptionError
        If the packages are not installed.
    """
    where = path_text(path)
    if not data.startswith(b"LASF"):
        raise FileFormatError("this is not a LAS or LAZ file", where=where, remedy=DAMAGED)
    laspy = needed_packages("LAS and LAZ", "laspy", "lazrs")
    try:
        header = laspy.open(io.BytesIO(data)).header
        _refuse_cut(header, data)
        file = laspy.read(io.BytesIO(data))
        columns: dict[str, Column] = {name: np.array(file[name]) for name in POINT}
        extra = set(file.point_format.extra_dimension_names)
        columns |= {name.removeprefix("grey_"): np.array(file[name]) for name in sorted(extra)}
        if "intensity" not in columns and np.any(file.intensity):
            columns["intensity"] = np.array(file.intensity, dtype=np.float64)
        records = [item for item in header.vlrs if getattr(item, "user_id", "") == RECORD_USER]
        notes = b"".join(item.record_data for item in records).decode()
    except BaseException as error:
        # a panic of the unpacking library is no Exception, and any of its kinds means damage
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise FileFormatError(
            f"the LAS file is not understood ({_first_line(error)})", where=where, remedy=DAMAGED
        ) from error
    n, told = len(columns["x"]), int(header.point_count)
    if n < told:
        raise FileFormatError(
            f"the LAS file holds {n} of {told} points", where=where, remedy="copy the file again"
        )
    return CloudColumns(columns, tuple(notes.splitlines()))


def _theirs(name: str) -> str:
    """Name of a column in a file that has a whole-numbered ``intensity`` of its own."""
    return f"grey_{name}" if name == "intensity" else name


def _pieces(notes: tuple[str, ...]) -> list[bytes]:
    """Notes as records, each of which holds so many bytes."""
    text = "\n".join(notes).encode()
    return [text[k : k + LARGEST_RECORD] for k in range(0, len(text), LARGEST_RECORD)]


def _refuse_cut(header: Any, data: bytes) -> None:
    """Raise `ValueError` where a header promises more than a file could hold."""
    room = len(data) - int(header.offset_to_point_data)
    size = int(header.point_count) * int(header.point_format.size)
    if size > (MOST_PACKED if header.are_points_compressed else 1) * room:
        raise ValueError(f"{header.point_count} points in {room} bytes")


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
