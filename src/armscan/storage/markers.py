# SPDX-License-Identifier: Apache-2.0
"""Markers as a table: number, centre and the covariance of the centre."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from armscan.errors import FileFormatError, InputError
from armscan.geometry.arrays import FloatArray
from armscan.records.markers import MarkerSet
from armscan.storage.csv_table import csv_bytes, number_text, read_csv

COORDINATES = ("x_mm", "y_mm", "z_mm")
COVARIANCES = ("cov_xx_mm2", "cov_xy_mm2", "cov_xz_mm2", "cov_yy_mm2", "cov_yz_mm2", "cov_zz_mm2")
_UPPER = np.triu_indices(3)
_FRAME = "frame = "


def markers_csv(markers: MarkerSet) -> bytes:
    """Text of a table of markers; reads back as the same numbers."""
    upper = markers.covariance_mm2[:, _UPPER[0], _UPPER[1]]
    columns = {"id": tuple(str(number) for number in markers.ids)}
    columns |= _texts(COORDINATES, markers.points_mm) | _texts(COVARIANCES, upper)
    return csv_bytes(columns, (f"{_FRAME}{markers.frame}",))


def read_markers(path: Path) -> MarkerSet:
    """Read a table of markers.

    Columns ``id,x_mm,y_mm,z_mm`` and the six different elements of the covariance; a comment
    ``# frame = Sensor`` names the coordinate frame, which is the Sensor's without it.

    Raises
    ------
    FileFormatError
        If the file is no such table, an id occurs twice, or a covariance is none.
    """
    table = read_csv(path)
    table.require(("id", *COORDINATES, *COVARIANCES))
    covariance = np.zeros((len(table), 3, 3))
    covariance[:, _UPPER[0], _UPPER[1]] = table.floats(COVARIANCES)
    covariance[:, _UPPER[1], _UPPER[0]] = covariance[:, _UPPER[0], _UPPER[1]]
    frames = [text.removeprefix(_FRAME) for text in table.comments if text.startswith(_FRAME)]
    try:
        return MarkerSet(
            table.ints("id"),
            table.floats(COORDINATES),
            covariance,
            frames[0].strip() if frames else "Sensor",
            str(path),
        )
    except InputError as error:
        raise FileFormatError(error.what, where=str(path), remedy="copy the file again") from error


def _texts(names: tuple[str, ...], values: FloatArray) -> dict[str, tuple[str, ...]]:
    return {
        name: tuple(number_text(value) for value in values[:, k]) for k, name in enumerate(names)
    }
