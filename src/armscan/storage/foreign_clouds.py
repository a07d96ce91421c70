# SPDX-License-Identifier: Apache-2.0
"""Clouds of any program: PLY with x, y, z, and text files with three columns."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path
from typing import cast, get_args

import numpy as np

from armscan.errors import FileFormatError, InputError
from armscan.geometry.arrays import FloatArray
from armscan.records.cloud import CloudFrame, PointCloud
from armscan.storage.clouds import COVARIANCE, FORCED, POINT, SIMULATED, read_ply
from armscan.storage.images import read_bytes
from armscan.storage.ply_format import parse_ply

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
    data = read_bytes(path)
    if data.startswith(b"ply"):
        table = parse_ply(data, str(path)).table
        names = set(table.dtype.names or ())
        if names.issuperset(COVARIANCE):
            return read_ply(path)
        if missing := sorted(set(POINT) - names):
            raise FileFormatError(
                f"the PLY file's points have no {missing[0]}",
                where=str(path),
                remedy="give a cloud with x, y and z in mm",
            )
        points = np.stack([table[name].astype(np.float64) for name in POINT], axis=1)
        return _bare_cloud(points, FOREIGN_FRAME, path)
    if path.suffix.lower() not in (".xyz", ".txt", ".csv", ".asc"):
        raise FileFormatError(
            "this is no point cloud that armscan knows",
            where=str(path),
            remedy="give a .ply file, or a text file .xyz, .txt, .asc or .csv with x y z in mm",
        )
    return _text_cloud(data, path)


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
    try:
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
    except InputError as error:
        raise FileFormatError(error.what, where=str(path), remedy=error.remedy) from error
