# SPDX-License-Identifier: Apache-2.0
"""Clouds of any program: PLY with x, y, z, and text files with three columns."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import cast, get_args

import numpy as np

from armscan.errors import FileFormatError, InputError
from armscan.geometry.arrays import FloatArray
from armscan.records.cloud import CloudFrame, PointCloud
from armscan.storage.clouds import COVARIANCE, POINT, SIMULATED, read_ply
from armscan.storage.images import read_bytes
from armscan.storage.ply_format import parse_ply

FOREIGN_FRAME: CloudFrame = "Part"
"""Frame of points about which a file says nothing."""


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
    lines = text.replace(",", " ").replace(";", " ").splitlines()
    # other programs put a count or column names first
    start = 1 if lines and not lines[0].startswith("#") and not _is_point(lines[0]) else 0
    body = "\n".join(lines[start:])
    if not any(line.strip() and not line.startswith("#") for line in lines[start:]):
        raise FileFormatError(
            "the file holds no points", where=str(path), remedy="write lines of x y z in mm"
        )
    try:
        points = np.loadtxt(io.StringIO(body), usecols=(0, 1, 2), ndmin=2)
    except (ValueError, IndexError) as error:
        raise FileFormatError(
            f"the points are not understood ({error})",
            where=str(path),
            remedy="give one point a line: x y z in mm, with a point as decimal sign",
        ) from error
    known = cast(CloudFrame, frame) if frame in get_args(CloudFrame) else FOREIGN_FRAME
    is_simulated = named is not None and f"; {SIMULATED};" in text.partition("\n")[0]
    return _bare_cloud(points, known, path, is_simulated=is_simulated)


def _is_point(line: str) -> bool:
    try:
        return len([float(word) for word in line.split()]) >= 3
    except ValueError:
        return False


def _bare_cloud(
    points_mm: FloatArray, frame: CloudFrame, path: Path, *, is_simulated: bool = False
) -> PointCloud:
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
            is_simulated=is_simulated,
        )
    except InputError as error:
        raise FileFormatError(error.what, where=str(path), remedy=error.remedy) from error
