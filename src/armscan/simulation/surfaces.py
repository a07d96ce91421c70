# SPDX-License-Identifier: Apache-2.0
"""What can stand in a scene: anything that a ray can be intersected with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, frozen_floats

MISS = np.inf


class Surface(Protocol):
    """A surface in the frame of the scene, with what it reflects."""

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """(N,) distance to the first hit along unit directions (N, 3); infinite for none.

        Origins are (N, 3), or (1, 3) if all rays start at one point.
        """

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """(N, 3) outward unit normals at points (N, 3) of the surface."""

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """(N, 3) part of red, green and blue light that is reflected at points (N, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """An endless plane of one colour.

    Parameters
    ----------
    point_mm, normal
        (3,) a point on it and its normal, on the side that is seen.
    colour
        (3,) albedo.
    """

    point_mm: FloatArray
    normal: FloatArray
    colour: tuple[float, float, float]

    def __post_init__(self) -> None:
        normal = frozen_floats(self.normal, (3,), "normal")
        unit = normal / np.linalg.norm(normal)
        object.__setattr__(self, "point_mm", frozen_floats(self.point_mm, (3,), "point_mm"))
        object.__setattr__(self, "normal", frozen_floats(unit, (3,), "normal"))

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`; seen from the normal's side only."""
        along = directions @ self.normal
        height = (origins_mm - self.point_mm) @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -height / along
        return np.where((along < 0.0) & (height > 0.0), distance, MISS)

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return np.broadcast_to(self.normal, points_mm.shape)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return np.broadcast_to(np.asarray(self.colour), points_mm.shape)


@dataclass(frozen=True, slots=True, eq=False)
class Sphere:
    """A ball of one colour: centre (3,) and radius in mm."""

    centre_mm: FloatArray
    radius_mm: float
    colour: tuple[float, float, float] = (0.8, 0.8, 0.8)

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_mm", frozen_floats(self.centre_mm, (3,), "centre_mm"))
        if not self.radius_mm > 0.0:
            raise InputError(f"sphere of radius {self.radius_mm} mm")

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`; rays start outside."""
        v = origins_mm - self.centre_mm
        b = np.sum(v * directions, axis=1)
        c = np.sum(v * v, axis=1) - self.radius_mm**2
        root = b * b - c
        distance = -b - np.sqrt(np.maximum(root, 0.0))
        return np.where((root > 0.0) & (distance > 0.0), distance, MISS)

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return np.asarray((points_mm - self.centre_mm) / self.radius_mm)

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """(N,) signed distance of points (N, 3) from the surface; positive outside."""
        away = np.linalg.norm(points_mm - self.centre_mm, axis=1)
        return np.asarray(away - self.radius_mm)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return np.broadcast_to(np.asarray(self.colour), points_mm.shape)
