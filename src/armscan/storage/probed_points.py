# SPDX-License-Identifier: Apache-2.0
"""Points touched with the arm's probe, and planes given by their coefficients."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from armscan.errors import FileFormatError, InputError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.records.probing import ProbedPoints
from armscan.storage.csv_table import LARGEST_MM, CsvTable, csv_bytes, number_text, parse_csv
from armscan.storage.images import read_bytes

COORDINATES = ("x_mm", "y_mm", "z_mm")
PLANE_NAMES = ("a", "b", "c", "d")
SMALLEST_EXTENT_MM = 2.0
"""Points that all lie this near to each other are taken for metres: nothing that small is probed
to place a scanner, and a plate in metres is not larger."""


def read_probed_points(path: Path) -> ProbedPoints:
    """Read points in Base that a probe touched.

    A table ``x_mm,y_mm,z_mm[,feature]``. A comment ``# point = tip-centre, tip_diameter_mm = 6``
    says that the points are centres of the tip; without it they are on the surface.
    ``# point = surface, tip_diameter_mm = 6`` keeps the diameter that was compensated for.

    Raises
    ------
    FileFormatError
        If the file is not such a table, holds no point, or is in metres.
    """
    return _points(parse_csv(read_bytes(path), str(path)))


def probed_points_csv(points: ProbedPoints) -> bytes:
    """Text of a table of probed points; reads back as the same numbers."""
    columns: dict[str, tuple[str, ...]] = {
        name: tuple(number_text(value) for value in points.points_mm[:, k])
        for k, name in enumerate(COORDINATES)
    }
    if points.features:
        columns["feature"] = points.features
    kind = "tip-centre" if points.are_tip_centres else "surface"
    if points.tip_diameter_mm:
        kind += f", tip_diameter_mm = {points.tip_diameter_mm!r}"
    return csv_bytes(columns, (f"point = {kind}",))


def parse_plane(text: str, where: str = "") -> FloatArray:
    """Plane (4,) ``A B C D`` with ``A x + B y + C z + D = 0`` from four numbers of any scale.

    Returns
    -------
    coefficients
        (4,) scaled so that the normal has length 1 and D is in mm (eq. 2.55).

    Raises
    ------
    OptionError
        If these are not four finite numbers, or the normal is zero.
    """
    words = re.split(r"[\s,]+", text.strip())
    remedy = "give four numbers A,B,C,D, with D in mm"
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise OptionError(f"'{text.strip()}' is no plane", where=where, remedy=remedy) from error
    if values.shape != (4,):
        fact = f"{len(words)} numbers where 4 are needed"
        raise OptionError(fact, where=where, remedy=remedy)
    for name, value in zip(PLANE_NAMES, values, strict=True):
        if not np.isfinite(value):
            raise OptionError(f"{name.upper()} is {value:g}", where=where, remedy=remedy)
    length = math.sqrt(float(values[:3] @ values[:3]))
    if not 0.0 < length < math.inf or abs(float(values[3])) > LARGEST_MM * length:
        raise OptionError(
            "the plane's normal A,B,C is zero, or the plane is beyond all reach",
            where=where,
            remedy="give a plane's A,B,C,D",
        )
    return np.asarray(values / length)


def read_points_or_plane(path: Path) -> ProbedPoints | FloatArray:
    """Read probed points, or a plane's four numbers with or without the header ``A,B,C,D``.

    Returns
    -------
    points or coefficients
        As `read_probed_points` or `parse_plane` give them.

    Raises
    ------
    FileFormatError
        If the file is neither.
    """
    data = read_bytes(path)
    words = _plane_words(data)
    if words is None:
        return _points(parse_csv(data, str(path)))
    try:
        return parse_plane(words, str(path))
    except OptionError as error:
        raise FileFormatError(error.what, where=str(path), remedy=error.remedy) from error


def _plane_words(data: bytes) -> str | None:
    """The numbers of a file that holds a plane and nothing else; None for any other file."""
    text = data.decode("utf-8-sig", errors="replace")
    lines = [line.strip() for line in text.splitlines()]
    lines = [line for line in lines if line and not line.startswith("#")]
    if len(lines) == 2 and tuple(re.split(r"[\s,]+", lines[0].lower())) == PLANE_NAMES:
        return lines[1]
    if len(lines) == 1 and re.fullmatch(r"[-+\d.eE]+(?:[\s,]+[-+\d.eE]+){3}", lines[0]):
        return lines[0]
    return None


def _points(table: CsvTable) -> ProbedPoints:
    _refuse_metres_by_name(table)
    table.require(COORDINATES)
    points = table.floats(COORDINATES)
    if not len(points):
        raise FileFormatError(
            "the table holds no point", where=table.where, remedy="probe the surface first"
        )
    extent = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))
    if len(points) >= 3 and 0.0 < extent < SMALLEST_EXTENT_MM:
        raise FileFormatError(
            f"all {len(points)} points lie within {extent:.3g} mm: these look like metres",
            where=table.where,
            remedy="multiply x_mm, y_mm and z_mm by 1000",
        )
    tip_diameter_mm, is_compensated = _tip(table)
    try:
        return ProbedPoints(
            points,
            tip_diameter_mm,
            table.columns.get("feature", ()),
            table.where,
            is_compensated=is_compensated,
        )
    except InputError as error:
        raise FileFormatError(error.what, where=table.where, remedy=error.remedy) from error


def _refuse_metres_by_name(table: CsvTable) -> None:
    if {"x_m", "y_m", "z_m"} <= set(table.columns):
        raise FileFormatError(
            "the columns x_m, y_m, z_m are in metres",
            where=table.where,
            remedy="multiply them by 1000 and name them x_mm, y_mm, z_mm",
        )


def _tip(table: CsvTable) -> tuple[float, bool]:
    """Diameter that a comment gives, 0 for none; whether the points are on the surface."""
    stated: dict[str, str] = {}
    for comment in table.comments:
        stated |= {
            key: value.strip()
            for key, value in re.findall(r"(point|tip_diameter_mm)\s*=\s*([^,;]+)", comment)
        }
    kind = stated.get("point", "tip-centre" if "tip_diameter_mm" in stated else "surface")
    is_surface = kind == "surface"
    if is_surface and "tip_diameter_mm" not in stated:
        return 0.0, True
    if kind not in ("surface", "tip-centre"):
        raise FileFormatError(
            f"'point = {kind}' is not known",
            where=table.where,
            remedy="write surface or tip-centre",
        )
    try:
        diameter_mm = float(stated.get("tip_diameter_mm", ""))
    except ValueError:
        diameter_mm = 0.0
    if not 0.0 < diameter_mm < math.inf:
        what = "on the surface" if is_surface else "centres of the tip"
        raise FileFormatError(
            f"the points are {what}, but the tip's diameter is not given as a number of mm",
            where=table.where,
            remedy=f"write the line '# point = {kind}, tip_diameter_mm = 6'",
        )
    return diameter_mm, is_surface
