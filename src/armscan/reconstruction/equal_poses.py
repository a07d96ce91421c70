# SPDX-License-Identifier: Apache-2.0
"""Exposures with the very same pose that show different stripes: a pose that stood still."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import FloatArray
from armscan.reconstruction.exposure_poses import ExposurePoses
from armscan.records.cloud import PointCloud

SAME_MM, SAME = 1e-6, 1e-9
FEWEST_POINTS = 30
MOVED_MM = 0.3
"""Stripes further apart were not taken from one place: poses that are written with one decimal of
a millimetre or a degree stay equal over less than that."""


def stripes_at_equal_poses(
    clouds: Mapping[int, PointCloud], poses: ExposurePoses
) -> dict[int, float]:
    """Exposures that bear the pose of an earlier one but show another stripe.

    An arm at rest may well say the very same pose again, and a robot comes back to it; the object
    then shows the same stripe. A pose that hung, or was repeated, does not.

    Parameters
    ----------
    clouds
        Points in Base of each instant, of all its cameras, by the row whose pose it has.
    poses
        Of all rows.

    Returns
    -------
    dict[int, float]
        Distance in mm from the earlier stripe, by row; only where the same sheet shows in both.
    """
    found: dict[int, float] = {}
    first: dict[bytes, int] = {}
    for row in sorted(clouds):
        key = _key(poses, row)
        if key not in first:
            first[key] = row
            continue
        apart = _apart_mm(clouds[first[key]], clouds[row])
        if apart > MOVED_MM:
            found[row] = apart
    return found


def _key(poses: ExposurePoses, row: int) -> bytes:
    place = np.rint(poses.translations_mm[row] / SAME_MM).astype(np.int64)
    turn = np.rint(poses.rotations[row] / SAME).astype(np.int64)
    return bytes(place.tobytes() + turn.tobytes())


def _apart_mm(one: PointCloud, other: PointCloud) -> float:
    """Median distance between two stripes of one sheet; 0 where they cannot be compared."""
    distances: list[FloatArray] = []
    for sheet in np.intersect1d(one.sheet, other.sheet):
        a, b = (cloud.points_mm[cloud.sheet == sheet] for cloud in (one, other))
        if min(len(a), len(b)) >= FEWEST_POINTS:
            distances.append(np.asarray(cKDTree(a).query(b)[0]))
    return float(np.median(np.concatenate(distances))) if distances else 0.0
