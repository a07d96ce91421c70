# SPDX-License-Identifier: Apache-2.0
"""Which part of the image, and which tilts, a set of views covers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from armscan.calibration.camera.result import Coverage
from armscan.geometry.arrays import FloatArray

GRID_LONG_SIDE = 10
"""Cells along the longer side of the image; the shorter gets cells of about the same shape."""

_ROW_NAMES = ("top", "middle", "bottom")
_COLUMN_NAMES = ("left", "centre", "right")


def measure_coverage(
    points_px: FloatArray, normals_sensor: FloatArray, width_px: int, height_px: int
) -> Coverage:
    """Count target points over the image.

    Parameters
    ----------
    points_px
        (N, 2) points of the used views.
    normals_sensor
        (V, 3) normals of the boards in the Sensor frame, pointing away from the camera.
    width_px, height_px
        Size of the image.
    """
    cell = max(width_px, height_px) / GRID_LONG_SIDE
    shape = max(1, round(height_px / cell)), max(1, round(width_px / cell))
    counts = _histogram(points_px, shape, width_px, height_px)
    thirds = _histogram(points_px, (3, 3), width_px, height_px)
    empty = tuple(
        _region_name(row, column) for row, column in np.argwhere(thirds == 0).astype(int).tolist()
    )
    return Coverage(
        counts.astype(np.int64),
        float(np.mean(counts > 0)),
        empty,
        np.concatenate([points_px.min(axis=0), points_px.max(axis=0)]),
        np.asarray(np.rad2deg(np.arccos(np.clip(np.abs(normals_sensor[:, 2]), 0.0, 1.0)))),
        np.asarray(np.rad2deg(np.arctan2(normals_sensor[:, 1], normals_sensor[:, 0]))),
    )


def _histogram(
    points_px: FloatArray, shape: tuple[int, int], width_px: int, height_px: int
) -> FloatArray:
    limits = [(-0.5, height_px - 0.5), (-0.5, width_px - 0.5)]
    return np.histogram2d(points_px[:, 1], points_px[:, 0], bins=shape, range=limits)[0]


def _region_name(row: int, column: int) -> str:
    if (row, column) == (1, 1):
        return "centre"
    return f"{_ROW_NAMES[row]} {_COLUMN_NAMES[column]}"


def largest_angle_deg(normals: FloatArray | Sequence[FloatArray]) -> float:
    """Largest angle between any two of the boards' planes, from (V, 3) unit normals."""
    n = np.asarray(normals, dtype=np.float64)
    cosine = np.clip(np.abs(n @ n.T), 0.0, 1.0)
    return float(np.rad2deg(np.arccos(cosine.min())))
