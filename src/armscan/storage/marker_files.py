# SPDX-License-Identifier: Apache-2.0
"""Lists of markers: armscan's own tables, written and read; probed points, columns typed in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armscan.errors import FileFormatError, InputError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.records.markers import MarkerSet
from armscan.storage.csv_table import CsvTable, csv_bytes, number_text, read_csv

COORDINATES = ("x_mm", "y_mm", "z_mm")
COVARIANCES = ("cov_xx_mm2", "cov_xy_mm2", "cov_xz_mm2", "cov_yy_mm2", "cov_yz_mm2", "cov_zz_mm2")
ASSUMED_SIGMA_MM = 0.02
"""Standard deviation an axis of a marker about which a list says nothing: a probed point, or a
ring's centre measured by two cameras."""
SMALLEST_EXTENT_MM = 2.0
"""Markers that all lie this near to each other are taken for metres."""
FRAME = "frame ="
METRES = ("x_m", "y_m", "z_m")
_UPPER = np.triu_indices(3)


@dataclass(frozen=True, slots=True, eq=False)
class MarkerList:
    """A list as read.

    Parameters
    ----------
    markers
        The markers; without a column ``id`` they are numbered from 1 in the order of the rows.
    path
        The file.
    has_ids
        True if the list numbers its markers itself.
    is_sigma_assumed
        True if the list holds no covariance.
    """

    markers: MarkerSet
    path: Path
    has_ids: bool
    is_sigma_assumed: bool


def markers_csv(markers: MarkerSet) -> bytes:
    """Text of a table of markers; `read_marker_list` reads it back as the same numbers.

    Columns ``id,x_mm,y_mm,z_mm`` and the six different elements of the covariance; a comment
    ``# frame = Sensor`` names the coordinate frame.
    """
    upper = markers.covariance_mm2[:, _UPPER[0], _UPPER[1]]
    columns = {"id": tuple(str(number) for number in markers.ids)}
    columns |= _texts(COORDINATES, markers.points_mm) | _texts(COVARIANCES, upper)
    return csv_bytes(columns, (f"{FRAME} {markers.frame}",))


def _texts(names: tuple[str, ...], values: FloatArray) -> dict[str, tuple[str, ...]]:
    return {
        name: tuple(number_text(value) for value in values[:, k]) for k, name in enumerate(names)
    }


def read_marker_list(path: Path, *, frame: str, sigma_mm: float = ASSUMED_SIGMA_MM) -> MarkerList:
    """Read a table ``x_mm,y_mm,z_mm`` with, if you like, ``id`` and the six covariances.

    A comment ``# frame = Base`` names the frame. Tables of probed points are such lists; points
    are taken as they stand, centres of a tip included.

    Parameters
    ----------
    path
        The file.
    frame
        Frame of the markers where the list names none.
    sigma_mm
        Standard deviation an axis where the list gives no covariance.

    Raises
    ------
    FileFormatError
        If the file is no such table, holds no marker, is in metres, an id or a place occurs twice,
        or a covariance is none.
    """
    table = read_csv(path)
    if set(METRES) <= set(table.columns):
        raise FileFormatError(
            "the columns x_m, y_m, z_m are in metres",
            where=table.where,
            remedy="multiply them by 1000 and name them x_mm, y_mm, z_mm",
        )
    table.require(COORDINATES)
    points = table.floats(COORDINATES)
    if not len(points):
        raise FileFormatError(
            "the table holds no marker", where=table.where, remedy="measure the markers first"
        )
    _check_places(table, points)
    has_covariance = any(name in table for name in COVARIANCES)
    try:
        markers = MarkerSet(
            _ids(table),
            points,
            _covariance(table, sigma_mm, has_covariance=has_covariance),
            _frame(table, frame),
            str(path),
        )
    except InputError as error:
        raise FileFormatError(
            error.what, where=table.where, remedy="correct the table, or measure again"
        ) from error
    return MarkerList(markers, path, "id" in table, not has_covariance)


def _ids(table: CsvTable) -> IntArray:
    if "id" not in table:
        return np.arange(1, len(table) + 1)
    ids = table.ints("id")
    values, counts = np.unique(ids, return_counts=True)
    if (counts > 1).any():
        twice = int(values[np.argmax(counts > 1)])
        raise FileFormatError(
            f"the id {twice} occurs {counts.max()} times",
            where=table.where,
            remedy="number each marker once",
        )
    return ids


def _covariance(table: CsvTable, sigma_mm: float, *, has_covariance: bool) -> FloatArray:
    if not has_covariance:
        return np.tile(sigma_mm**2 * np.eye(3), (len(table), 1, 1))
    table.require(COVARIANCES)
    rows, columns = _UPPER
    covariance = np.zeros((len(table), 3, 3))
    covariance[:, rows, columns] = table.floats(COVARIANCES)
    covariance[:, columns, rows] = covariance[:, rows, columns]
    least = np.linalg.eigvalsh(covariance)[:, 0]
    if least.min() <= 0.0:
        raise FileFormatError(
            "the six covariances make no covariance matrix (it is not positive definite)",
            where=table.place(int(np.argmin(least))),
            remedy="give variances above 0, or leave the six columns out",
        )
    return covariance


def _frame(table: CsvTable, frame: str) -> str:
    named = [text[len(FRAME) :].strip() for text in table.comments if text.startswith(FRAME)]
    return named[0] if named else frame


def _check_places(table: CsvTable, points: FloatArray) -> None:
    extent = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))
    if len(points) >= 3 and 0.0 < extent < SMALLEST_EXTENT_MM:
        raise FileFormatError(
            f"all {len(points)} markers lie within {extent:.3g} mm: these look like metres",
            where=table.where,
            remedy="multiply x_mm, y_mm and z_mm by 1000",
        )
    _, first, counts = np.unique(points, axis=0, return_index=True, return_counts=True)
    if (counts > 1).any():
        raise FileFormatError(
            "two markers have the same place",
            where=table.place(int(first[np.argmax(counts > 1)])),
            remedy="list each marker once",
        )
