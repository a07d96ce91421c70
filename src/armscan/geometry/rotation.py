# SPDX-License-Identifier: Apache-2.0
"""Rotation matrices from rotation vectors, and back, with the derivative a solver needs."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray

_SMALL_ANGLE_RAD = 1e-6


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
    """Rodrigues' formula: (3,) rotation vector in rad to a (3, 3) rotation matrix."""
    v = np.asarray(rotation_vector_rad, dtype=np.float64)
    angle = float(np.linalg.norm(v))
    cross = skew(v)
    if angle < _SMALL_ANGLE_RAD:
        return np.eye(3) + cross + 0.5 * cross @ cross
    a = np.sin(angle) / angle
    b = (1.0 - np.cos(angle)) / angle**2
    return np.asarray(np.eye(3) + a * cross + b * cross @ cross)


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


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """Return the proper rotation nearest to ``matrix`` in the Frobenius norm."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
