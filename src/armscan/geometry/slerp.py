# SPDX-License-Identifier: Apache-2.0
"""Rotations between two rotations, at constant angular velocity (SLERP)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.geometry.arrays import FloatArray


def slerp(start: FloatArray, end: FloatArray, fraction: FloatArray) -> FloatArray:
    """Turn from ``start`` towards ``end`` by a part of the shortest way.

    Parameters
    ----------
    start, end
        (N, 3, 3) proper rotations.
    fraction
        (N,) part of the way, 0 at the start and 1 at the end.

    Returns
    -------
    FloatArray
        (N, 3, 3) ``start exp(fraction log(start' end))``.
    """
    if len(start) == 0:
        return np.zeros((0, 3, 3))
    first = Rotation.from_matrix(start)
    turn = (first.inv() * Rotation.from_matrix(end)).as_rotvec()
    return np.asarray((first * Rotation.from_rotvec(turn * fraction[:, None])).as_matrix())
