# SPDX-License-Identifier: Apache-2.0
"""A plate pressed into waves some millimetres high: one surface on which stripes bend and bunch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.simulation.shapes import GREY
from armscan.simulation.surfaces import MISS

_CLOSE_MM = 1e-3
_WALK_STEPS = 200
_NEWTON_STEPS = 4


@dataclass(frozen=True, slots=True)
class Wave:
    """One sine over a plate.

    Parameters
    ----------
    amplitude_mm, length_mm
        Half its height, and the distance from crest to crest.
    azimuth_deg
        Direction in which it runs, from the plate's x axis.
    phase_rad
        At the plate's middle.
    """

    amplitude_mm: float
    length_mm: float
    azimuth_deg: float
    phase_rad: float = 0.0

    @property
    def steepest(self) -> float:
        """Largest slope."""
        return 2.0 * np.pi * self.amplitude_mm / self.length_mm

    def angle_rad(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(N,) phase at places (N,) and (N,)."""
        along = np.cos(self.azimuth_rad) * x_mm + np.sin(self.azimuth_rad) * y_mm
        return np.asarray(2.0 * np.pi / self.length_mm * along + self.phase_rad)

    @property
    def azimuth_rad(self) -> float:
        """The azimuth in radians."""
        return float(np.radians(self.azimuth_deg))


@dataclass(frozen=True, slots=True)
class WavyPlate:
    """A rectangle in x and y of its frame whose height is a sum of sines, seen from +z.

    Parameters
    ----------
    size_mm
        Length along x and width along y, centred on the origin.
    waves
        At least one.
    colour
        (3,) albedo.
    """

    size_mm: tuple[float, float]
    waves: tuple[Wave, ...]
    colour: tuple[float, float, float] = GREY

    def __post_init__(self) -> None:
        if not self.waves or min(self.size_mm) <= 0.0:
            raise InputError(f"a wavy plate of {self.size_mm} mm with {len(self.waves)} waves")

    @property
    def highest_mm(self) -> float:
        """No point lies higher than this."""
        return sum(wave.amplitude_mm for wave in self.waves)

    def height_mm(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """(N,) height at places (N,) and (N,)."""
        heights = [w.amplitude_mm * np.sin(w.angle_rad(x_mm, y_mm)) for w in self.waves]
        return np.asarray(sum(heights))

    def slopes(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(N,) derivatives of the height along x and y."""
        rises = [w.steepest * np.cos(w.angle_rad(x_mm, y_mm)) for w in self.waves]
        azimuths = [w.azimuth_rad for w in self.waves]
        along_x = sum(np.cos(a) * rise for a, rise in zip(azimuths, rises, strict=True))
        along_y = sum(np.sin(a) * rise for a, rise in zip(azimuths, rises, strict=True))
        return np.asarray(along_x), np.asarray(along_y)

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`; rays come from above.

        A ray may fall by its height over the surface, divided by the rate at which that can
        shrink, without passing through; close to the surface Newton's steps take over.
        """
        origins = np.broadcast_to(origins_mm, directions.shape)
        result = np.full(len(directions), MISS)
        falls = np.flatnonzero((directions[:, 2] < 0.0) & (origins[:, 2] > self.highest_mm))
        start, ray = origins[falls], directions[falls]
        distance = (self.highest_mm - start[:, 2]) / ray[:, 2]
        steepest = sum(wave.steepest for wave in self.waves)
        rate = -ray[:, 2] + steepest * np.hypot(ray[:, 0], ray[:, 1])
        walking = np.arange(len(falls))
        for _ in range(_WALK_STEPS):
            above = self._above(start[walking] + distance[walking, None] * ray[walking])
            distance[walking] += above / rate[walking]
            walking = walking[above > _CLOSE_MM]
            if len(walking) == 0:
                break
        for _ in range(_NEWTON_STEPS):
            points = start + distance[:, None] * ray
            slope_x, slope_y = self.slopes(points[:, 0], points[:, 1])
            falling = slope_x * ray[:, 0] + slope_y * ray[:, 1] - ray[:, 2]
            # A ray that only grazes a crest keeps its place: it is within `_CLOSE_MM` of it.
            step = self._above(points) / np.where(falling > 1e-3, falling, np.inf)
            distance += np.clip(step, -_CLOSE_MM * 10.0, _CLOSE_MM * 10.0)
        hit = start + distance[:, None] * ray
        is_near = np.abs(hit[:, :2]) <= 0.5 * np.asarray(self.size_mm)
        inside = np.asarray(is_near.all(axis=1))
        inside[walking] = False
        result[falls[inside]] = distance[inside]
        return result

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        slope_x, slope_y = self.slopes(points_mm[:, 0], points_mm[:, 1])
        normals = np.stack([-slope_x, -slope_y, np.ones(len(slope_x))], axis=1)
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return np.broadcast_to(np.asarray(self.colour), points_mm.shape)

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """As for `Solid`, over the face; true to first order close to it."""
        slope_x, slope_y = self.slopes(points_mm[:, 0], points_mm[:, 1])
        return np.asarray(self._above(points_mm) / np.sqrt(1.0 + slope_x**2 + slope_y**2))

    def _above(self, points_mm: FloatArray) -> FloatArray:
        return np.asarray(points_mm[:, 2] - self.height_mm(points_mm[:, 0], points_mm[:, 1]))
