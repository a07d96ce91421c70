# SPDX-License-Identifier: Apache-2.0
"""Surfaces, lamps and lasers together: what a ray meets, and what light falls there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.simulation.light import LineLaser
from armscan.simulation.surfaces import Surface

SHADOW_MARGIN_MM = 0.02
"""A surface does not shade itself nearer than this."""
FAINTEST = 1e-6
"""Light below this part of full scale is not followed any further."""


@dataclass(frozen=True, slots=True)
class Lamp:
    """Room light: an even part and a lamp that throws shadows.

    Parameters
    ----------
    even
        Brightness of a white surface under the even part, as a part of full scale; surfaces that
        face up see all of it, those that face down a third.
    direct
        Brightness that the lamp adds to a white surface that faces it.
    position_mm
        (3,) where the lamp is, in the frame of the scene.
    up
        (3,) direction from which the even part comes.
    """

    even: float = 0.2
    direct: float = 0.3
    position_mm: tuple[float, float, float] = (380.0, -420.0, -60.0)
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """First points that rays meet.

    Parameters
    ----------
    distance_mm
        (N,) along the ray; infinite where nothing is met.
    surface
        (N,) index into the scene's surfaces; -1 where nothing is met.
    points_mm
        (N, 3); NaN where nothing is met.
    """

    distance_mm: FloatArray
    surface: IntArray
    points_mm: FloatArray

    def select(self, chosen: BoolArray | IntArray) -> Hits:
        """Return the hits that a mask or an index (N,) names."""
        return Hits(self.distance_mm[chosen], self.surface[chosen], self.points_mm[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What stands before the camera, in the Sensor frame: surfaces, lasers, a lamp."""

    surfaces: tuple[Surface, ...]
    lasers: tuple[LineLaser, ...] = ()
    lamp: Lamp = Lamp()

    def trace(self, origins_mm: FloatArray, directions: FloatArray) -> Hits:
        """First hits of rays from (N, 3) or (3,) origins along unit directions (N, 3)."""
        origins = np.asarray(origins_mm, dtype=np.float64).reshape(-1, 3)
        distance = np.full(len(directions), np.inf)
        surface = np.full(len(directions), -1, dtype=np.int64)
        for index, candidate in enumerate(self.surfaces):
            reached = candidate.intersect(origins, directions)
            is_nearer = reached < distance
            distance = np.where(is_nearer, reached, distance)
            surface[is_nearer] = index
        finite = np.where(surface >= 0, distance, np.nan)
        return Hits(distance, surface, origins + finite[:, None] * directions)

    def normals(self, hits: Hits) -> FloatArray:
        """(N, 3) unit normals at hits; zero where nothing was met."""
        normals = np.zeros((len(hits.surface), 3))
        for index, surface in enumerate(self.surfaces):
            here = hits.surface == index
            if here.any():
                normals[here] = surface.normals(hits.points_mm[here])
        return normals

    def albedo(self, hits: Hits) -> FloatArray:
        """(N, 3) reflected parts of red, green and blue at hits; zero where nothing was met."""
        albedo = np.zeros((len(hits.surface), 3))
        for index, surface in enumerate(self.surfaces):
            here = hits.surface == index
            if here.any():
                albedo[here] = surface.albedo(hits.points_mm[here])
        return albedo

    def sees(self, source_mm: ArrayLike, points_mm: FloatArray) -> BoolArray:
        """(N,) True where nothing stands between a source (3,) and surface points (N, 3)."""
        source = np.asarray(source_mm, dtype=np.float64)
        v = points_mm - source
        distance = np.linalg.norm(v, axis=1)
        first = self.trace(source, v / distance[:, None]).distance_mm
        return np.asarray(first >= distance - SHADOW_MARGIN_MM)

    def room_light(self, hits: Hits) -> FloatArray:
        """(N, 3) radiance of hits under the lamp, as parts of full scale (Lambert's law)."""
        lamp = self.lamp
        radiance = np.zeros((len(hits.surface), 3))
        is_hit = hits.surface >= 0
        met = hits.select(is_hit)
        normals = self.normals(met)
        light = lamp.even * (2.0 + normals @ np.asarray(lamp.up)) / 3.0
        v = lamp.position_mm - met.points_mm
        cosine = np.sum(v * normals, axis=1) / np.linalg.norm(v, axis=1)
        facing = np.flatnonzero(cosine > 0.0)
        lit = facing[self.sees(lamp.position_mm, met.points_mm[facing])]
        light[lit] += lamp.direct * cosine[lit]
        radiance[is_hit] = light[:, None] * self.albedo(met)
        return radiance

    def laser_light(self, laser: LineLaser, hits: Hits) -> FloatArray:
        """(N,) radiance of hits under one laser alone, as parts of full scale, without speckle.

        A laser is nearly of one wavelength: the surface answers with its red albedo, and the
        camera's channels with `LineLaser.colour`, which is not applied here.
        """
        radiance = np.zeros(len(hits.surface))
        met = np.flatnonzero(hits.surface >= 0)
        at = hits.select(met)
        light = laser.irradiance_at(at.points_mm, self.normals(at))
        bright = np.flatnonzero(light > FAINTEST)
        lit = bright[self.sees(laser.source_mm, at.points_mm[bright])]
        radiance[met[lit]] = light[lit] * self.albedo(at.select(lit))[:, 0]
        return radiance
