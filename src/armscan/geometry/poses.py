# SPDX-License-Identifier: Apache-2.0
"""Frame-typed rigid transforms: ``base_from_tool @ tool_from_sensor @ points_sensor``."""

from __future__ import annotations

from typing import Generic, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike

from armscan.errors import InputError
from armscan.geometry.arrays import ArrayRecord, FloatArray, RowRecord, floats, frozen_floats
from armscan.geometry.rotations import rotation_from_vector, skew, vector_from_rotation


class Frame:
    """A right-handed Cartesian coordinate frame; never instantiated."""


class Base(Frame):
    """Fixed base of the arm."""


class Tool(Frame):
    """What the arm's pose describes: its last link."""


class Probe(Frame):
    """Centre of the touch probe's tip."""


class Sensor(Frame):
    """The scanner head: camera 0, x to the right, y down, z forward along its optical axis."""


class CameraRight(Frame):
    """Camera 1 of a stereo head, axes as for the Sensor."""


class Board(Frame):
    """Calibration target: origin in its first point, x along a row, y along a column."""


class Plate(Frame):
    """Flat reference plate."""


class Part(Frame):
    """The object being measured."""


class Cad(Frame):
    """Coordinate frame of a CAD model."""


A = TypeVar("A", bound=Frame)
B = TypeVar("B", bound=Frame)
C = TypeVar("C", bound=Frame)

UNTURNED = np.eye(3)
ORTHONORMAL_TOLERANCE = 1e-6
"""Rotations are computed, or were made exact when read: what is left is rounding, so that this is
stricter than what `armscan.storage.points` grants to printed decimals."""


class Points(RowRecord, Generic[A], kw_only=False):
    """Points in the frame ``A``: ``xyz_mm`` of shape (N, 3)."""

    xyz_mm: FloatArray = floats("N", 3)


class Pose(ArrayRecord, Generic[A, B], kw_only=False):
    """Rigid transform that maps coordinates in ``B`` to coordinates in ``A`` (``a_from_b``).

    Parameters
    ----------
    rotation
        (3, 3) proper rotation; columns are the axes of B seen in A.
    translation_mm
        (3,) origin of B in A, in mm.

    Raises
    ------
    InputError
        If the matrix is not a proper rotation within 1e-6.
    """

    rotation: FloatArray = floats(3, 3)
    translation_mm: FloatArray = floats(3)

    def __post_init__(self) -> None:
        super().__post_init__()
        defect = float(np.abs(self.rotation @ self.rotation.T - UNTURNED).max())
        (a, b, c), (d, e, f), (g, h, i) = self.rotation.tolist()
        determinant = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
        if defect > ORTHONORMAL_TOLERANCE or determinant < 0.0:
            raise InputError(
                f"matrix is not a rotation: |R R' - 1| = {defect:.2g}, det = {determinant:.3f}",
                remedy="check row/column order and handedness",
            )

    @staticmethod
    def from_vectors(rotation_vector_rad: ArrayLike, translation_mm: ArrayLike) -> Pose[A, B]:
        """Build a pose from a rotation vector (3,) in rad and a translation (3,) in mm."""
        vector = frozen_floats(rotation_vector_rad, (3,), "rotation_vector_rad")
        return Pose(rotation_from_vector(vector), np.asarray(translation_mm, dtype=np.float64))

    @property
    def rotation_vector_rad(self) -> FloatArray:
        """(3,) rotation vector in rad."""
        return vector_from_rotation(self.rotation)

    @property
    def matrix(self) -> FloatArray:
        """(4, 4) homogeneous matrix, translation in mm."""
        m = np.eye(4)
        m[:3, :3] = self.rotation
        m[:3, 3] = self.translation_mm
        return m

    def inverse(self) -> Pose[B, A]:
        """Return ``b_from_a``."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation_mm)

    def apply(self, points_mm: FloatArray) -> FloatArray:
        """(..., 3) points of B, in A."""
        return np.asarray(points_mm @ self.rotation.T + self.translation_mm)

    def rotate(self, vectors: FloatArray) -> FloatArray:
        """(..., 3) directions of B, in A."""
        return np.asarray(vectors @ self.rotation.T)

    def rotate_covariance(self, covariance: FloatArray) -> FloatArray:
        """(..., 3, 3) covariances in B, in A."""
        return np.asarray(self.rotation @ covariance @ self.rotation.T)

    def retract(self, step: FloatArray) -> Pose[A, B]:
        """The pose after a step (6,): a rotation vector in A from the left, then a translation."""
        return Pose(rotation_from_vector(step[:3]) @ self.rotation, self.translation_mm + step[3:])

    def step_from(self, other: Pose[A, B]) -> FloatArray:
        """(6,) step of `retract` that leads from another pose to this one."""
        turn = vector_from_rotation(self.rotation @ other.rotation.T)
        return np.concatenate([turn, self.translation_mm - other.translation_mm])

    def jacobian(self, points_mm: FloatArray) -> FloatArray:
        """(N, 3, 6) derivative of ``apply(points_mm)`` by a step of `retract`; points (N, 3)."""
        turned = self.rotate(points_mm)
        shift = np.broadcast_to(np.eye(3), (len(turned), 3, 3))
        return np.concatenate([-skew(turned), shift], axis=2)

    @overload
    def __matmul__(self, other: Pose[B, C]) -> Pose[A, C]: ...
    @overload
    def __matmul__(self, other: Points[B]) -> Points[A]: ...
    def __matmul__(self, other: Pose[B, C] | Points[B]) -> Pose[A, C] | Points[A]:
        """Compose with a pose, or map points."""
        if isinstance(other, Points):
            return Points(self.apply(other.xyz_mm))
        return Pose(
            self.rotation @ other.rotation,
            self.rotation @ other.translation_mm + self.translation_mm,
        )
