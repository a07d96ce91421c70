# SPDX-License-Identifier: Apache-2.0
"""Bodies with sharp edges in a frame of their own, and the way to put a shape into a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.poses import Pose
from armscan.simulation.surfaces import MISS, Surface

GREY = (0.7, 0.7, 0.7)


class Solid(Surface, Protocol):
    """A surface that knows how far a point is from it."""

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """(N,) signed distance of points (N, 3) from the surface; positive outside."""


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A shape moved into another frame.

    Parameters
    ----------
    shape
        In a frame of its own.
    scene_from_shape
        Where that frame is in the scene.
    """

    shape: Surface
    scene_from_shape: Pose[Any, Any]

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`."""
        rotation = self.scene_from_shape.rotation
        return self.shape.intersect(self.in_shape(origins_mm), directions @ rotation)

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        normals = self.shape.normals(self.in_shape(points_mm))
        return np.asarray(normals @ self.scene_from_shape.rotation.T)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return self.shape.albedo(self.in_shape(points_mm))

    def in_shape(self, points_mm: FloatArray) -> FloatArray:
        """Points (N, 3) of the scene in the shape's frame."""
        pose = self.scene_from_shape
        return np.asarray((points_mm - pose.translation_mm) @ pose.rotation)


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """A block with sharp edges that stands on z = 0 of its frame, its footprint centred on z.

    Parameters
    ----------
    size_mm
        (3,) length along x, width along y, height along z.
    colour
        (3,) albedo.
    """

    size_mm: FloatArray
    colour: tuple[float, float, float] = GREY

    def __post_init__(self) -> None:
        size = frozen_floats(self.size_mm, (3,), "size_mm")
        if not bool((size > 0.0).all()):
            raise InputError(f"block of size {size.tolist()} mm")
        object.__setattr__(self, "size_mm", size)

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`: the rays enter through the last of three pairs of faces."""
        origins = self._from_centre(origins_mm)
        half = 0.5 * self.size_mm
        enter, leave = np.full(len(directions), -np.inf), np.full(len(directions), np.inf)
        for axis in range(3):
            along = directions[:, axis]
            with np.errstate(divide="ignore", invalid="ignore"):
                a = (-half[axis] - origins[:, axis]) / along
                b = (half[axis] - origins[:, axis]) / along
            enter = np.fmax(enter, np.fmin(a, b))
            leave = np.fmin(leave, np.fmax(a, b))
        return np.where((enter < leave) & (enter > 0.0), enter, MISS)

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`: of the nearest face."""
        centred = self._from_centre(points_mm)
        depth = np.abs(centred) - 0.5 * self.size_mm
        face = np.argmax(depth, axis=1)
        rows = np.arange(len(face))
        normals = np.zeros(centred.shape)
        normals[rows, face] = np.where(centred[rows, face] < 0.0, -1.0, 1.0)
        return normals

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return np.broadcast_to(np.asarray(self.colour), points_mm.shape)

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """As for `Solid`."""
        beyond = np.abs(self._from_centre(points_mm)) - 0.5 * self.size_mm
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0))

    def _from_centre(self, points_mm: FloatArray) -> FloatArray:
        return np.asarray(points_mm - np.array([0.0, 0.0, 0.5 * self.size_mm[2]]))


@dataclass(frozen=True, slots=True)
class Rod:
    """A round bar with flat ends, from z = 0 to z = length of its frame, about the z axis."""

    radius_mm: float
    length_mm: float
    colour: tuple[float, float, float] = GREY

    def __post_init__(self) -> None:
        if min(self.radius_mm, self.length_mm) <= 0.0:
            raise InputError(f"bar of radius {self.radius_mm} mm, length {self.length_mm} mm")

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`; rays start outside."""
        flat, along = directions[:, :2], directions[:, 2]
        a = np.sum(flat * flat, axis=1)
        b = np.sum(origins_mm[:, :2] * flat, axis=1)
        c = np.sum(origins_mm[:, :2] ** 2, axis=1) - self.radius_mm**2
        root = b * b - a * c
        half = np.sqrt(np.maximum(root, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            side_in, side_out = (-b - half) / a, (-b + half) / a
            ends = np.stack(
                [-origins_mm[:, 2] / along, (self.length_mm - origins_mm[:, 2]) / along]
            )
        enter = np.fmax(side_in, ends.min(axis=0))
        leave = np.fmin(side_out, ends.max(axis=0))
        return np.where((root > 0.0) & (enter < leave) & (enter > 0.0), enter, MISS)

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`: of the nearest of mantle and ends."""
        beyond_side, beyond_end = self._beyond(points_mm)
        centred = points_mm - np.array([0.0, 0.0, 0.5 * self.length_mm])
        is_end = beyond_end > beyond_side
        radius = np.maximum(np.hypot(centred[:, 0], centred[:, 1]), 1e-12)
        normals = np.zeros(centred.shape)
        normals[:, :2] = np.where(is_end[:, None], 0.0, centred[:, :2] / radius[:, None])
        normals[:, 2] = np.where(is_end, np.where(centred[:, 2] < 0.0, -1.0, 1.0), 0.0)
        return normals

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return np.broadcast_to(np.asarray(self.colour), points_mm.shape)

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """As for `Solid`."""
        side, end = self._beyond(points_mm)
        outside = np.hypot(np.maximum(side, 0.0), np.maximum(end, 0.0))
        return np.asarray(outside + np.minimum(np.maximum(side, end), 0.0))

    def _beyond(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(N,) how far points lie beyond the mantle and beyond the nearer end."""
        side = np.hypot(points_mm[:, 0], points_mm[:, 1]) - self.radius_mm
        end = np.abs(points_mm[:, 2] - 0.5 * self.length_mm) - 0.5 * self.length_mm
        return np.asarray(side), np.asarray(end)
