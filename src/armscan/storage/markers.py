# SPDX-License-Identifier: Apache-2.0
"""Markers as a table: number, centre and the covariance of the centre."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.records.markers import MarkerSet
from armscan.storage.csv_table import csv_bytes, number_text

COORDINATES = ("x_mm", "y_mm", "z_mm")
COVARIANCES = ("cov_xx_mm2", "cov_xy_mm2", "cov_xz_mm2", "cov_yy_mm2", "cov_yz_mm2", "cov_zz_mm2")
_UPPER = np.triu_indices(3)


def markers_csv(markers: MarkerSet) -> bytes:
    """Text of a table of markers; `armscan.storage.marker_files` reads it back as the same numbers.

    Columns ``id,x_mm,y_mm,z_mm`` and the six different elements of the covariance; a comment
    ``# frame = Sensor`` names the coordinate frame.
    """
    upper = markers.covariance_mm2[:, _UPPER[0], _UPPER[1]]
    columns = {"id": tuple(str(number) for number in markers.ids)}
    columns |= _texts(COORDINATES, markers.points_mm) | _texts(COVARIANCES, upper)
    return csv_bytes(columns, (f"frame = {markers.frame}",))


def _texts(names: tuple[str, ...], values: FloatArray) -> dict[str, tuple[str, ...]]:
    return {
        name: tuple(number_text(value) for value in values[:, k]) for k, name in enumerate(names)
    }
