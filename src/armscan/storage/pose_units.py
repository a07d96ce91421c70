# SPDX-License-Identifier: Apache-2.0
"""Poses that can only be in another unit than millimetres."""

from __future__ import annotations

import math

import numpy as np

from armscan.errors import FileFormatError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.rotation import vector_from_rotation
from armscan.storage.csv_table import LARGEST_MM

REACH_MM = 10.0
"""No arm keeps its last link this near to the origin of Base; in metres, no arm gets farther."""
MOVED_MM = 0.01
TURNED_RAD = math.radians(3.0)

METRES_REMEDY = (
    "multiply x, y and z by 1000; if they are millimetres, add 1000 to each x, for Base may lie "
    "anywhere"
)


def refuse_beyond_reach(points_mm: FloatArray, where: str) -> None:
    """Raise for coordinates (N, 3) that no instrument reaches; gaps of NaN pass.

    Raises
    ------
    FileFormatError
        If one lies beyond `armscan.storage.csv_table.LARGEST_MM`.
    """
    beyond = np.abs(points_mm) > LARGEST_MM
    if beyond.any():
        row, column = (int(value) for value in np.argwhere(beyond)[0])
        raise FileFormatError(
            f"coordinate {points_mm[row, column]:g} mm (entry {row + 1}) is beyond all reach",
            where=where,
            remedy="correct it, or leave the entry out",
        )


def are_within_reach_of_base(translations_mm: FloatArray) -> bool:
    """True if all (N, 3) positions lie within 10 mm of Base's origin, and not all at it."""
    if not len(translations_mm):
        return False
    distance = np.linalg.norm(translations_mm, axis=1)
    return bool(0.0 < distance.max() < REACH_MM)


def are_surely_metres(rotations: FloatArray, translations_mm: FloatArray) -> bool:
    """True if the poses of an arm make no sense in millimetres.

    They do not where the tool stays within 10 mm of Base's origin and moves, while it turns about
    two axes: a stage of small travel does not turn, and a turntable turns about one axis only.

    Parameters
    ----------
    rotations
        (N, 3, 3) of ``base_from_tool``.
    translations_mm
        (N, 3) as written under the name of millimetres.
    """
    if len(rotations) < 3 or not are_within_reach_of_base(translations_mm):
        return False
    moved = np.linalg.norm(translations_mm - translations_mm.mean(axis=0), axis=1).max()
    chosen = np.unique(np.linspace(0, len(rotations) - 1, 200).astype(np.int64))
    turns = np.array([vector_from_rotation(rotations[0].T @ rotations[k]) for k in chosen])
    _, _, axes = np.linalg.svd(turns, full_matrices=False)
    about_second = np.abs(turns @ axes[1]).max()
    return bool(moved > MOVED_MM and about_second > TURNED_RAD)
