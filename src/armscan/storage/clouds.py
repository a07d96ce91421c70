# SPDX-License-Identifier: Apache-2.0
"""Point clouds as PLY and XYZ, armscan's own and other programs', and conversion from one
format to another.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
from numpy.typing import NDArray

from armscan.errors import FileFormatError, InputError, OptionError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.models.calibration import SensorCalibration
from armscan.models.camera import CameraModel
from armscan.records.cloud import CloudFrame, PointCloud
from armscan.storage.codec import parse_json
from armscan.storage.documents import read_calibration, read_camera_calibration
from armscan.storage.files import (
    check_outputs,
    is_file,
    path_text,
    read_bytes,
    told_of,
    write_files,
)
from armscan.storage.foreign import camera_info_yaml
from armscan.storage.tables import refuse_beyond_reach

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
MOST_HEADER_BYTES = 16 * 2**20
"""A comment for each of a hundred thousand exposures."""
MOST_PROPERTIES, MOST_DIGITS = 1000, 15
DAMAGED = "copy the file again; it may be cut or damaged"


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
    end = data.find(b"\nend_header", 0, MOST_HEADER_BYTES)
    start = data.find(b"\n", end + 1) + 1
    if END_HEADER.fullmatch(data[end + 1 : start]) is None or data[:3] != b"ply":
        raise FileFormatError(
            "this is not a PLY file with a complete header", where=where, remedy=DAMAGED
        )
    try:
        order, count, kind, comments = _header(data[:end].decode("latin-1"))
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
    return PlyVertices(table, comments)


def _header(text: str) -> tuple[str, int, np.dtype[Any], tuple[str, ...]]:
    """Format, count and type of the vertices, and comments; `ValueError` for what is no header."""
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
    # a name that occurs twice is a ValueError of numpy
    return order, count, np.dtype(fields), tuple(comments)


def _ascii_table(body: bytes, kind: np.dtype[Any], count: int, where: str) -> NDArray[Any]:
    most = min(count, len(body))
    rows = [line.split() for line in body.split(b"\n", most)[:most] if line.strip()]
    try:
        return np.array([tuple(float(word) for word in row) for row in rows], dtype=kind)
    except (ValueError, OverflowError) as error:
        raise FileFormatError(
            "the points of the PLY file are not understood", where=where, remedy=DAMAGED
        ) from error


POINT = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
COVARIANCE = {
    "cov_xx_mm2": (0, 0),
    "cov_xy_mm2": (0, 1),
    "cov_xz_mm2": (0, 2),
    "cov_yy_mm2": (1, 1),
    "cov_yz_mm2": (1, 2),
    "cov_zz_mm2": (2, 2),
}
INDICES = ("sheet", "exposure", "segment")
NOISE_LENGTH = "noise_length_points"
N_POINTS = "n_points"
"""Measured points that one of a fused cloud stands for."""
SIMULATED = "simulated"
"""Comment in the header of a cloud that was measured on rendered images."""
FORCED = "forced"
"""Comment with a reason for which the cloud's calibration was refused, and used all the same."""

XYZ_LOSES = (
    "normals",
    "sigma_mm and covariance",
    "sheet, exposure and segment",
    "intensity",
    "digits beyond 0.1 nm",
)
"""What an XYZ file does not hold."""


def ply_bytes(cloud: PointCloud) -> bytes:
    """Content of a binary little-endian PLY file that holds all of a cloud, in float64 and int32.

    ``sigma_mm`` is written for other programs; it follows from the covariance. Names stand in the
    header: ``comment frame Sensor``, ``comment sheet 0 "A"``, ``comment exposure 0 "laser.png"``;
    of points measured on rendered images also ``comment simulated``, of those of a calibration
    that was refused and forced ``comment forced 0 "why"``.
    """
    return b"".join(ply_parts(cloud, len(cloud), [CloudPiece(cloud, cloud.sigma_mm)]))


@dataclass(frozen=True, slots=True, eq=False)
class CloudPiece:
    """Points of a cloud that is written piece by piece.

    Parameters
    ----------
    cloud
        The points.
    sigma_mm
        (N,) as `PointCloud.sigma_mm`.
    n_points
        (N,) measured points that each stands for; None if each is one.
    """

    cloud: PointCloud
    sigma_mm: FloatArray
    n_points: IntArray | None = None


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
    comments = ["written by armscan", "unit mm", f"frame {marks.frame}"]
    if marks.is_simulated:
        comments.append(SIMULATED)
    for word, names in (
        ("sheet", marks.sheet_names),
        ("exposure", marks.exposure_sources),
        (FORCED, marks.forced),
    ):
        comments += [f"{word} {k} {json.dumps(name)}" for k, name in enumerate(names)]
    none = CloudPiece(marks.select(slice(0)), np.zeros(0), np.zeros(0, int) if is_fused else None)
    yield ply_header(_ply_table(none).dtype, n_points, comments)
    for piece in pieces:
        yield _ply_table(piece).tobytes()


def _ply_table(piece: CloudPiece) -> NDArray[Any]:
    cloud = piece.cloud
    columns: dict[str, NDArray[Any]] = {}
    columns |= {name: cloud.points_mm[:, k] for k, name in enumerate(POINT)}
    if cloud.normals is not None:
        columns |= {name: cloud.normals[:, k] for k, name in enumerate(NORMAL)}
    columns["sigma_mm"] = piece.sigma_mm
    columns["sigma_noise_mm"] = cloud.sigma_noise_mm
    if cloud.noise_length is not None:
        columns[NOISE_LENGTH] = cloud.noise_length
    columns |= {name: cloud.covariance_mm2[:, i, j] for name, (i, j) in COVARIANCE.items()}
    columns["intensity"] = cloud.intensity
    columns |= {name: getattr(cloud, name) for name in INDICES}
    if piece.n_points is not None:
        columns[N_POINTS] = piece.n_points
    whole = (*INDICES, N_POINTS)
    kinds = [(name, "<i4" if name in whole else "<f8") for name in columns]
    table = np.zeros(len(cloud), dtype=kinds)
    for name, values in columns.items():
        table[name] = values
    return table


def xyz_bytes(cloud: PointCloud) -> bytes:
    """Content of an XYZ text file; it lacks `XYZ_LOSES`."""
    return b"".join(xyz_parts(cloud, [CloudPiece(cloud, np.zeros(0))]))


def xyz_parts(marks: PointCloud, pieces: Iterable[CloudPiece]) -> Iterator[bytes]:
    """As `xyz_bytes`, of a cloud that comes in pieces; parameters as of `ply_parts`."""
    frame = f"{marks.frame}; {SIMULATED}" if marks.is_simulated else marks.frame
    header = f"x_mm y_mm z_mm in frame {frame}; not in this file: {'; '.join(XYZ_LOSES)}"
    header = "\n".join((header, *(f"{FORCED}: {reason}" for reason in marks.forced)))
    for k, piece in enumerate(pieces):
        buffer = io.StringIO()
        np.savetxt(buffer, piece.cloud.points_mm, fmt="%.7f", header=header if k == 0 else "")
        yield buffer.getvalue().encode()


def read_ply(path: Path) -> PointCloud:
    """Read a cloud that armscan wrote.

    Raises
    ------
    FileFormatError
        If the file is cut short, is no PLY, or lacks what armscan writes.
    """
    where = path_text(path)
    return _own_cloud(parse_ply(read_bytes(path), where), where)


def _own_cloud(vertices: PlyVertices, where: str) -> PointCloud:
    table = vertices.table
    names = set(table.dtype.names or ())
    needed = {*POINT, *COVARIANCE, *INDICES, "sigma_noise_mm", "intensity"}
    if missing := sorted(needed - names):
        raise FileFormatError(
            f"the PLY file has no {missing[0]}, so it was not written by armscan",
            where=where,
            remedy="use the cloud that `armscan reconstruct` wrote",
        )
    covariance = np.zeros((len(table), 3, 3))
    for name, (i, j) in COVARIANCE.items():
        covariance[:, i, j] = covariance[:, j, i] = table[name]
    has_normals = names.issuperset(NORMAL)
    points = np.stack([table[name] for name in POINT], axis=1)
    refuse_beyond_reach(points, where)
    with told_of(where):
        return PointCloud(
            frame=_frame(vertices),
            points_mm=points,
            covariance_mm2=covariance,
            sigma_noise_mm=table["sigma_noise_mm"],
            sheet=table["sheet"],
            sheet_names=_names(vertices, "sheet"),
            exposure=table["exposure"],
            exposure_sources=_names(vertices, "exposure"),
            segment=table["segment"],
            intensity=table["intensity"],
            normals=np.stack([table[n] for n in NORMAL], axis=1) if has_normals else None,
            noise_length=table[NOISE_LENGTH] if NOISE_LENGTH in names else None,
            is_simulated=SIMULATED in vertices.comments,
            forced=_names(vertices, FORCED),
        )


def _frame(vertices: PlyVertices) -> CloudFrame:
    found = [text[6:] for text in vertices.comments if text.startswith("frame ")]
    if len(found) != 1 or found[0] not in get_args(CloudFrame):
        raise InputError("the PLY header does not name the frame of the points")
    return cast(CloudFrame, found[0])


def _names(vertices: PlyVertices, word: str) -> tuple[str, ...]:
    names = []
    for text in vertices.comments:
        if text.startswith(f"{word} "):
            try:
                names.append(str(json.loads(text.split(" ", 2)[2])))
            except (IndexError, ValueError, RecursionError) as error:
                raise InputError(f"the PLY header's comment {text!r} is damaged") from error
    return tuple(names)


FOREIGN_FRAME: CloudFrame = "Part"
"""Frame of points about which a file says nothing."""


LOOKED_AT = 1000
"""Lines in which decimal commas are sought: a table that has them has them everywhere."""


def read_cloud(path: Path) -> PointCloud:
    """Read a cloud that armscan wrote, or the points of another program's PLY, XYZ or CSV file.

    Points of other programs come with covariances of zero, which stands for "not known", and as
    one exposure.

    Raises
    ------
    FileFormatError
        If the file is cut short, or holds no points in x, y, z.
    """
    data, where = read_bytes(path), path_text(path)
    if data.startswith(b"ply"):
        return _cloud_of(parse_ply(data, where), path)
    if path.suffix.lower() not in (".xyz", ".txt", ".csv", ".asc"):
        raise FileFormatError(
            "this is no point cloud that armscan knows",
            where=str(path),
            remedy="give a .ply file, or a text file .xyz, .txt, .asc or .csv with x y z in mm",
        )
    return _text_cloud(data, path)


def _cloud_of(vertices: PlyVertices, path: Path) -> PointCloud:
    table = vertices.table
    names = set(table.dtype.names or ())
    if names.issuperset(COVARIANCE):
        return _own_cloud(vertices, path_text(path))
    if missing := sorted(set(POINT) - names):
        raise FileFormatError(
            f"the PLY file's points have no {missing[0]}",
            where=str(path),
            remedy="give a cloud with x, y and z in mm",
        )
    points = np.stack([table[name].astype(np.float64) for name in POINT], axis=1)
    return _bare_cloud(points, FOREIGN_FRAME, path)


PIECE_POINTS = 200_000
"""Points of a file that are read at a time: 60 MB with all that is made of them."""


def read_cloud_pieces(path: Path) -> Iterator[PointCloud]:
    """As `read_cloud`, piece by piece; text files in one piece.

    Raises
    ------
    FileFormatError
        As `read_cloud`.
    """
    where = path_text(path)
    if not is_file(path):
        read_bytes(path)
    with path.open("rb") as file:
        start = b""
        while (line := file.readline()) and len(start) < MOST_HEADER_BYTES:
            start += line
            if not start.startswith(b"ply") or END_HEADER.fullmatch(line):
                break
        is_binary = start.startswith(b"ply") and b"\nformat binary" in start[:100]
        if not (is_binary and END_HEADER.fullmatch(line)):
            yield read_cloud(path)
            return
        # what is wrong with a header is said by the reader of whole files
        try:
            _, count, kind, comments = _header(start.decode("latin-1"))
        except (ValueError, KeyError, IndexError):
            yield read_cloud(path)
            return
        for first in range(0, count, PIECE_POINTS):
            asked = min(PIECE_POINTS, count - first)
            table = np.frombuffer(file.read(asked * kind.itemsize)[: asked * kind.itemsize], "u1")
            n = len(table) // kind.itemsize
            if n < asked:
                raise FileFormatError(
                    f"the PLY file holds {first + n} of {count} points",
                    where=where,
                    remedy="copy the file again",
                )
            yield _cloud_of(PlyVertices(table.view(kind), comments), path)


def _text_cloud(data: bytes, path: Path) -> PointCloud:
    text = data.decode("utf-8-sig", errors="replace")
    named = re.match(r"#.*\bframe (\w+)", text)
    frame = named[1] if named is not None else ""
    lines = text.splitlines()
    start = 1 if _is_heading(lines, path) else 0
    body = [line.partition("#")[0] for line in lines[start:]]
    filled = [line for line in body[:LOOKED_AT] if line.strip()]
    if not filled:
        raise FileFormatError(
            "the file holds no points", where=str(path), remedy="write lines of x y z in mm"
        )
    for line in filled:
        _refuse_decimal_commas(line, path)
    if start and len(_words(lines[0])) > 1 and len(_words(filled[0])) == 2 * len(_words(lines[0])):
        raise FileFormatError(
            f"twice as many numbers as columns, as of commas in them: '{filled[0][:60]}'",
            where=str(path),
            remedy="write numbers with points: 1.5,2.5,3.5",
        )
    joined = "\n".join(body).replace(",", " ").replace(";", " ")
    try:
        points = np.loadtxt(io.StringIO(joined), usecols=(0, 1, 2), ndmin=2)
    except (ValueError, IndexError) as error:
        raise FileFormatError(
            f"the points are not understood ({error})",
            where=str(path),
            remedy="give one point a line: x y z in mm, with a point as decimal sign",
        ) from error
    known = cast(CloudFrame, frame) if frame in get_args(CloudFrame) else FOREIGN_FRAME
    is_simulated = named is not None and f"; {SIMULATED};" in text.partition("\n")[0]
    mark = f"# {FORCED}: "
    forced = tuple(line.removeprefix(mark) for line in lines if line.startswith(mark))
    return replace(_bare_cloud(points, known, path), is_simulated=is_simulated, forced=forced)


def _is_heading(lines: list[str], path: Path) -> bool:
    """Whether the first line is no point but a count of points, or names of columns.

    Raises
    ------
    FileFormatError
        If it is none of these: a damaged point is not to be dropped in silence.
    """
    words = _words(lines[0]) if lines else []
    if not words or lines[0].startswith("#"):
        return False
    if len(words) == 1 and words[0].isdecimal():
        return True
    if all(_is_number(word) for word in words):
        return False
    if not all(re.match(r"[\W_]*[A-Za-z]", word) for word in words):
        raise FileFormatError(
            f"the first line is neither a point nor a heading: '{lines[0][:60]}'",
            where=str(path),
            remedy="correct the line, or put # before it",
        )
    return True


def _refuse_decimal_commas(line: str, path: Path) -> None:
    """Raise for a line whose commas can only be decimal signs, or may be.

    ``1,5;2,5;3,5`` and ``1,5 2,5 3,5`` hold commas and another separator between numbers; so do
    six whole numbers ``1,5,2,5,3,5`` from a table of three columns, which is not told from one of
    six: only what is certain is refused.
    """
    fields = [word for word in re.split(r"[;\s]+", line.strip().strip(",;")) if word]
    with_comma = [word for word in fields if re.fullmatch(r"[-+]?\d+,\d+([eE][-+]?\d+)?", word)]
    if len(fields) >= 2 and with_comma:
        raise FileFormatError(
            f"the numbers have commas as decimal signs: '{line.strip()[:60]}'",
            where=str(path),
            remedy="write them with points: 1.5 2.5 3.5",
        )


def _words(line: str) -> list[str]:
    return [word for word in re.split(r"[,;\s]+", line.strip()) if word]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _bare_cloud(points_mm: FloatArray, frame: CloudFrame, path: Path) -> PointCloud:
    n = len(points_mm)
    zeros = np.zeros(n, dtype=np.int64)
    refuse_beyond_reach(points_mm, path_text(path))
    with told_of(path_text(path)):
        return PointCloud(
            frame=frame,
            points_mm=points_mm,
            covariance_mm2=np.zeros((n, 3, 3)),
            sigma_noise_mm=np.zeros(n),
            sheet=zeros,
            sheet_names=("",),
            exposure=zeros,
            exposure_sources=(path.name,),
            segment=zeros,
            intensity=np.zeros(n),
        )


YAML_LOSES = ("covariance", "evidence and provenance")


@dataclass(frozen=True, slots=True)
class Conversion:
    """What was converted, in words, what the new file does not hold, and marks of the old one."""

    what: str
    losses: tuple[str, ...]
    forced: tuple[str, ...] = ()


def convert_file(source: Path, output: Path, *, is_overwriting: bool = False) -> Conversion:
    """Write a calibration's camera as ROS ``camera_info``, or a cloud as XYZ.

    Parameters
    ----------
    source
        ``.ply`` of armscan, or any calibration that armscan reads: its own camera or sensor
        document, OpenCV's YAML, XML or JSON, ROS.
    output
        ``.yaml`` for a camera, ``.xyz`` for a cloud.
    is_overwriting
        Replace a file that exists.

    Raises
    ------
    OptionError
        If there is no way from the one kind of file to the other.
    FileFormatError
        If the source cannot be read.
    OutputError
        If the output exists or cannot be written.
    """
    kinds = source.suffix.lower() == ".ply", output.suffix.lower()
    if kinds not in ((True, ".xyz"), (False, ".yaml"), (False, ".yml")):
        raise OptionError(
            f"there is no conversion from {source.name} to {output.name}",
            remedy="convert a calibration to .yaml, or a cloud .ply to .xyz",
        )
    check_outputs((output,), is_overwriting=is_overwriting)
    if kinds[0]:
        cloud = read_ply(source)
        content = xyz_bytes(cloud)
        conversion = Conversion("cloud to XYZ", XYZ_LOSES, cloud.forced)
    else:
        camera, forced = _camera(source)
        content = camera_info_yaml(camera, comments=forced).encode()
        conversion = Conversion("camera to ROS camera_info", YAML_LOSES, forced)
    write_files({output: content}, is_overwriting=is_overwriting)
    return conversion


def _camera(path: Path) -> tuple[CameraModel, tuple[str, ...]]:
    data = read_bytes(path)
    is_own = data.lstrip().startswith(b"{") and "schema" in parse_json(data, str(path))
    calibration = read_calibration(path) if is_own else read_camera_calibration(path)
    if isinstance(calibration, SensorCalibration):
        return calibration.camera.camera, calibration.camera.provenance.forced
    return calibration.camera, calibration.provenance.forced
