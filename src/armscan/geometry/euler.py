# SPDX-License-Identifier: Apache-2.0
"""Euler angles, to read and to print; inside, rotations are matrices."""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.errors import OptionError
from armscan.geometry.arrays import FloatArray

EulerConvention = Literal["intrinsic-xyz", "extrinsic-xyz", "intrinsic-zxz"]
"""``intrinsic-xyz``: R = Rx(a) Ry(b) Rz(c), the thesis (eq. 2.69); ``extrinsic-xyz``:
R = Rz(c) Ry(b) Rx(a), FANUC's W P R; ``intrinsic-zxz``: R = Rz(a) Rx(b) Rz(c), FARO."""

_Sequence: TypeAlias = Literal["XYZ", "xyz", "ZXZ"]
_SEQUENCES: dict[EulerConvention, _Sequence] = {
    "intrinsic-xyz": "XYZ",
    "extrinsic-xyz": "xyz",
    "intrinsic-zxz": "ZXZ",
}


def check_convention(name: str) -> EulerConvention:
    """Return the convention of that name.

    Raises
    ------
    OptionError
        If there is none.
    """
    for convention in _SEQUENCES:
        if convention == name:
            return convention
    raise OptionError(
        f"no rotation convention is called '{name}'",
        remedy=f"choose one of: {', '.join(get_args(EulerConvention))}",
    )


def rotations_from_euler(angles_rad: FloatArray, convention: EulerConvention) -> FloatArray:
    """Rotations (N, 3, 3) of angles (N, 3) a, b, c in rad."""
    angles = np.asarray(angles_rad, dtype=np.float64).reshape(-1, 3)
    if len(angles) == 0:
        return np.zeros((0, 3, 3))
    return np.asarray(Rotation.from_euler(_SEQUENCES[convention], angles).as_matrix())


def euler_from_rotations(rotations: FloatArray, convention: EulerConvention) -> FloatArray:
    """Angles (N, 3) a, b, c in rad of rotations (N, 3, 3); not unique at gimbal lock."""
    matrices = np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
    if len(matrices) == 0:
        return np.zeros((0, 3))
    return np.asarray(Rotation.from_matrix(matrices).as_euler(_SEQUENCES[convention]))
