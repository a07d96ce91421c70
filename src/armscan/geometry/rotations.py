# SPDX-License-Identifier: Apache-2.0
"""Rotation matrices from rotation vectors and Euler angles, and back; interpolation (SLERP)."""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.errors import OptionError
from armscan.geometry.arrays import FloatArray

_SMALL_ANGLE_RAD = 1e-6
_SMALL_FOR_SQUARES_RAD = 1e-3
"""Below it the difference of nearly equal numbers over the angle's square loses digits."""


def skew(vector: FloatArray) -> FloatArray:
    """Return the matrix ``[v]x`` with ``[v]x w = v x w``; (3,) -> (3, 3), (N, 3) -> (N, 3, 3)."""
    v = np.asarray(vector, dtype=np.float64)
    matrix = np.zeros((*v.shape[:-1], 3, 3))
    matrix[..., 0, 1] = -v[..., 2]
    matrix[..., 0, 2] = v[..., 1]
    matrix[..., 1, 0] = v[..., 2]
    matrix[..., 1, 2] = -v[..., 0]
    matrix[..., 2, 0] = -v[..., 1]
    matrix[..., 2, 1] = v[..., 0]
    return matrix


def rotation_from_vector(rotation_vector_rad: FloatArray) -> FloatArray:
    """Rodrigues' formula: rotation vectors in rad, (3,) -> (3, 3) or (N, 3) -> (N, 3, 3)."""
    v = np.asarray(rotation_vector_rad, dtype=np.float64)
    angle = np.sqrt(np.sum(v * v, axis=-1))[..., None, None]
    cross = skew(v)
    is_small = angle < _SMALL_ANGLE_RAD
    safe = np.where(is_small, 1.0, angle)
    a = np.where(is_small, 1.0, np.sin(safe) / safe)
    b = np.where(is_small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    return np.asarray(np.eye(3) + a * cross + b * (cross @ cross))


def vector_from_rotation(rotation: FloatArray) -> FloatArray:
    """Return the rotation vector in rad, angle in [0, pi], of a (3, 3) rotation matrix."""
    r = np.asarray(rotation, dtype=np.float64)
    axis = 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    sine = float(np.linalg.norm(axis))
    cosine = 0.5 * (float(np.trace(r)) - 1.0)
    angle = float(np.arctan2(sine, cosine))
    if sine > _SMALL_ANGLE_RAD:
        return np.asarray(axis * (angle / sine))
    if cosine > 0.0:
        return axis
    # Near half a turn the skew part vanishes; the symmetric part holds the axis.
    outer = 0.25 * (r + r.T) + 0.5 * np.eye(3)
    k = int(np.argmax(np.diag(outer)))
    direction = outer[:, k] / np.sqrt(outer[k, k])
    if axis @ direction < 0.0:
        direction = -direction
    return np.asarray(angle * direction / np.linalg.norm(direction))


def vector_sigma(rotation_vector_rad: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard deviations (3,) in rad of a rotation vector of at most half a turn.

    ``covariance`` (3, 3) is of an increment of the rotation from the left, ``R <- exp(dr) R``. The
    vector follows it by the inverse left Jacobian of SO(3), which is the identity for no turn.
    """
    cross = skew(rotation_vector_rad)
    angle = float(np.linalg.norm(rotation_vector_rad))
    square = 1.0 / 12.0
    if angle > _SMALL_FOR_SQUARES_RAD:
        square = (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2
    jacobian = np.eye(3) - 0.5 * cross + square * (cross @ cross)
    return np.asarray(np.sqrt(np.diag(jacobian @ covariance @ jacobian.T)))


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """Return the proper rotation nearest to ``matrix`` in the Frobenius norm."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def slerp(start: FloatArray, end: FloatArray, fraction: FloatArray) -> FloatArray:
    """Turn (N, 3, 3) from ``start`` to ``end`` by a part (N,) of the shortest way."""
    if len(start) == 0:
        return np.zeros((0, 3, 3))
    first = Rotation.from_matrix(start)
    turn = (first.inv() * Rotation.from_matrix(end)).as_rotvec()
    return np.asarray((first * Rotation.from_rotvec(turn * fraction[:, None])).as_matrix())


EulerConvention = Literal[
    "intrinsic-xyz", "extrinsic-xyz", "intrinsic-zyx", "intrinsic-zxz", "rotation-vector"
]
"""``intrinsic-xyz``: R = Rx(a) Ry(b) Rz(c), the thesis (eq. 2.69); ``extrinsic-xyz``:
R = Rz(c) Ry(b) Rx(a), FANUC's W P R; ``intrinsic-zyx``: R = Rz(a) Ry(b) Rx(c), KUKA's A B C;
``intrinsic-zxz``: R = Rz(a) Rx(b) Rz(c), FARO; ``rotation-vector``: R = exp([a, b, c]x), no Euler
angles but the axis times the angle, Universal Robots."""

_Sequence: TypeAlias = Literal["XYZ", "xyz", "ZYX", "ZXZ"]
_SEQUENCES: dict[EulerConvention, _Sequence | None] = {
    "intrinsic-xyz": "XYZ",
    "extrinsic-xyz": "xyz",
    "intrinsic-zyx": "ZYX",
    "intrinsic-zxz": "ZXZ",
    "rotation-vector": None,
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
    sequence = _SEQUENCES[convention]
    if sequence is None:
        return np.asarray(Rotation.from_rotvec(angles).as_matrix())
    return np.asarray(Rotation.from_euler(sequence, angles).as_matrix())


def euler_from_rotations(rotations: FloatArray, convention: EulerConvention) -> FloatArray:
    """Angles (N, 3) a, b, c in rad of rotations (N, 3, 3); not unique at gimbal lock."""
    matrices = np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
    if len(matrices) == 0:
        return np.zeros((0, 3))
    sequence, turns = _SEQUENCES[convention], Rotation.from_matrix(matrices)
    return np.asarray(turns.as_rotvec() if sequence is None else turns.as_euler(sequence))
