# SPDX-License-Identifier: Apache-2.0
"""PCD, the files of the Point Cloud Library (version 0.7): ASCII, binary, binary_compressed.

Binary files that armscan writes hold all columns; their notes are comments of the header.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armscan.errors import FileFormatError
from armscan.storage.files import path_text
from armscan.storage.formats.columns import (
    DAMAGED,
    MOST_HEADER_BYTES,
    POINT,
    CloudColumns,
    CloudPiece,
    cloud_columns,
    columns_of,
    dropped_columns,
    header_bytes,
    structured,
)

KINDS = {"F": "f", "I": "i", "U": "u"}
SIZES = {1, 2, 4, 8}
RENAMED = {"normal_x": "nx", "normal_y": "ny", "normal_z": "nz"}
MOST_VALUES = 10_000
"""Values of a point: descriptors of hundreds are usual, more is a damaged header."""
MOST_PACKED = 88
"""Bytes that a byte of LZF stands for at most: three make a reference to 264."""


@dataclass(frozen=True, slots=True, eq=False)
class _Header:
    """``kind``: (C,) fields of a point; ``width`` times ``height`` points; ``form`` of the data."""

    kind: np.dtype[Any]
    width: int
    height: int
    form: str
    notes: tuple[str, ...]
    body: int

    @property
    def count(self) -> int:
        """Points."""
        return self.width * self.height


def pcd_bytes(piece: CloudPiece) -> bytes:
    """Content of a binary PCD file that holds all of a cloud, in float64 and int32."""
    found = cloud_columns(piece)
    table = structured(found.columns)
    renamed = {own: theirs for theirs, own in RENAMED.items()}
    kinds = [table.dtype[name] for name in table.dtype.names or ()]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *(f"# {note}" for note in found.notes),
        "VERSION 0.7",
        "FIELDS " + " ".join(renamed.get(name, name) for name in table.dtype.names or ()),
        "SIZE " + " ".join(str(kind.itemsize) for kind in kinds),
        "TYPE " + " ".join(kind.kind.upper() for kind in kinds),
        "COUNT " + " ".join("1" for _ in kinds),
        f"WIDTH {len(table)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(table)}",
        "DATA binary",
    ]
    return b"".join((header_bytes(header), table.data))


def pcd_columns(data: bytes, path: Path) -> CloudColumns:
    """What the points of a PCD file carry.

    Points of an organised cloud (more than one row) without a position are left out: there they
    stand for "nothing seen here".
    """
    where = path_text(path)
    try:
        header = _header(data)
    except (ValueError, KeyError, IndexError, TypeError) as error:
        raise FileFormatError(
            "this is not a PCD file with a complete header", where=where, remedy=DAMAGED
        ) from error
    table = _table(data, header, where)
    if len(table) < header.count:
        raise FileFormatError(
            f"the PCD file holds {len(table)} of {header.count} points",
            where=where,
            remedy="copy the file again",
        )
    columns = {RENAMED.get(name, name): values for name, values in columns_of(table).items()}
    read = set(columns) - set(dropped_columns(CloudColumns(columns)))
    if wide := sorted(name for name in read if columns[name].ndim > 1):
        raise FileFormatError(
            f"field {wide[0]} of the PCD file has {columns[wide[0]].shape[1]} values a point",
            where=where,
            remedy="write fields x, y and z of one value each",
        )
    remarks: tuple[str, ...] = ()
    if header.height > 1 and set(POINT) <= set(columns):
        is_seen = np.isfinite(np.stack([columns[name] for name in POINT])).all(axis=0)
        columns = {name: values[is_seen] for name, values in columns.items()}
        if n_empty := int((~is_seen).sum()):
            remarks = (f"{n_empty:,} places of the grid hold no point and are left out",)
    return CloudColumns(columns, header.notes, remarks=remarks)


def _header(data: bytes) -> _Header:
    """The header; `ValueError`, `KeyError` or `IndexError` for what is none."""
    entries: dict[str, list[str]] = {}
    notes: list[str] = []
    start = 0
    while "DATA" not in entries:
        end = data.index(b"\n", start, MOST_HEADER_BYTES)
        line = data[start:end].decode("latin-1").strip()
        start = end + 1
        if line.startswith("#"):
            notes.append(line.removeprefix("# "))
        elif line:
            word, *rest = line.split()
            entries[word] = rest
    names = entries["FIELDS"]
    counts = [int(word[:9]) for word in entries.get("COUNT", ["1"] * len(names))]
    if not names or sum(counts) > MOST_VALUES or min(counts) < 1:
        raise ValueError("no fields")
    fields: list[tuple[Any, ...]] = []
    for k, (name, kind, size, n) in enumerate(
        zip(names, entries["TYPE"], entries["SIZE"], counts, strict=True)
    ):
        if int(size) not in SIZES:
            raise ValueError("no such size")
        # padding is called "_", as often as there is any
        own = f"_{k}" if name == "_" else name
        fields.append((own, f"<{KINDS[kind]}{int(size)}", *(((n,),) if n > 1 else ())))
    width, height = (int(entries[word][0][:12]) for word in ("WIDTH", "HEIGHT"))
    if width < 0 or height < 0:
        raise ValueError("no size")
    return _Header(np.dtype(fields), width, height, entries["DATA"][0], tuple(notes), start)


def _table(data: bytes, header: _Header, where: str) -> NDArray[Any]:
    """(M,) the points that are there."""
    if header.form == "ascii":
        return _ascii_table(data[header.body :], header, where)
    if header.form == "binary":
        whole = (len(data) - header.body) // header.kind.itemsize
        return np.frombuffer(data, header.kind, min(header.count, whole), header.body)
    if header.form == "binary_compressed":
        return _unpacked(data, header, where)
    raise FileFormatError(
        f"PCD data of the form '{header.form}' are not known",
        where=where,
        remedy="write the file as binary",
    )


def _ascii_table(body: bytes, header: _Header, where: str) -> NDArray[Any]:
    """Numbers in rows; a field of several values has several words."""
    counts = [header.kind[name].shape for name in header.kind.names or ()]
    first = np.concatenate([[0], np.cumsum([int(np.prod(shape)) for shape in counts])])
    try:
        text = io.StringIO(body.decode("ascii"))
        words = np.loadtxt(text, ndmin=2, max_rows=header.count) if header.count else None
        table = np.zeros(0 if words is None else len(words), header.kind)
        for k, name in enumerate(header.kind.names or ()):
            if words is not None:
                own = words[:, first[k] : first[k + 1]].reshape(len(words), *counts[k])
                # colours as one whole number may need more bits than their field says
                with np.errstate(invalid="ignore"):
                    table[name] = own
    except (ValueError, IndexError) as error:
        raise FileFormatError(
            "the points of the PCD file are not understood", where=where, remedy=DAMAGED
        ) from error
    return table


def _unpacked(data: bytes, header: _Header, where: str) -> NDArray[Any]:
    """Points of a compressed file, in which each field stands by itself, one after another."""
    sizes = np.frombuffer(data, "<u4", 2, header.body) if len(data) >= header.body + 8 else [0, 0]
    packed, size = (int(value) for value in sizes)
    whole = header.count * header.kind.itemsize
    start = header.body + 8
    if start + packed > len(data) or size != whole or whole > MOST_PACKED * (packed + 1):
        raise FileFormatError(
            f"the PCD file holds {max(len(data) - start, 0)} of {packed} compressed bytes",
            where=where,
            remedy="copy the file again",
        )
    # numba is asked for only here: it takes a second to load
    from armscan.kernels.decoding import decompress_lzf

    plain = np.zeros(size, np.uint8)
    if decompress_lzf(np.frombuffer(data, np.uint8, packed, start), plain) != size:
        raise FileFormatError(
            "the compressed points of the PCD file are damaged", where=where, remedy=DAMAGED
        )
    table = np.zeros(header.count, header.kind)
    place = 0
    for name in header.kind.names or ():
        kind = header.kind[name]
        stop = place + header.count * kind.itemsize
        table[name] = plain[place:stop].view(kind.base).reshape(header.count, *kind.shape)
        place = stop
    return table
