# SPDX-License-Identifier: Apache-2.0
"""What a ray meets: surfaces, materials, room light, and scenes put together from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_floats
from armscan.simulation.optics.camera import blur_image
from armscan.simulation.optics.lasers import LineLaser

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


class OneColour:
    """What reflects all over alike: ``colour`` is its (3,) albedo."""

    __slots__ = ()
    colour: tuple[float, float, float]

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return np.broadcast_to(np.asarray(self.colour), np.shape(points_mm))


@dataclass(frozen=True, slots=True, eq=False)
class Floor(OneColour):
    """An endless plane of one colour through a point (3,); its normal (3,) is on the seen side."""

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


@dataclass(frozen=True, slots=True, eq=False)
class Sphere(OneColour):
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


_TEXTURE_CELLS = 1024
CELLS_PER_GRAIN = 4.0
SLANT = (0.6180, 0.4142)
DARKEST = 0.05


@dataclass(frozen=True, slots=True)
class Material:
    """How a skin differs from an even Lambert reflector.

    Parameters
    ----------
    gloss
        Light in the middle of the mirror direction, as a multiple of what white paper returns.
    gloss_width_rad
        Gaussian sigma of the angle between the normal and the half-way direction.
    texture
        Standard deviation of the reflectance over its mean.
    texture_mm
        Grain of the texture.
    """

    gloss: float = 0.0
    gloss_width_rad: float = 0.12
    texture: float = 0.0
    texture_mm: float = 0.6

    def __post_init__(self) -> None:
        if min(self.gloss, self.texture) < 0.0:
            raise InputError("gloss and texture cannot be negative")
        if min(self.gloss_width_rad, self.texture_mm) <= 0.0:
            raise InputError("a gloss needs a width and a texture a grain")

    def scaled(self, gloss: float, texture: float) -> Material:
        """The finish with its gloss and its texture multiplied."""
        return replace(self, gloss=gloss * self.gloss, texture=texture * self.texture)


MATT_PAINT = Material(gloss=0.06, gloss_width_rad=0.35, texture=0.03)
CERAMIC = Material(gloss=0.15, gloss_width_rad=0.2, texture=0.02, texture_mm=0.4)
GROUND_STEEL = Material(gloss=0.5, gloss_width_rad=0.18, texture=0.05, texture_mm=0.2)


@dataclass(frozen=True, slots=True, eq=False)
class SceneObject:
    """A surface in Base with its finish; it is a `Surface` itself.

    Truth and messages call it by its name.
    """

    name: str
    surface: Surface
    finish: Material = MATT_PAINT

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return self.surface.intersect(origins_mm, directions)

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`."""
        return self.surface.normals(points_mm)

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`, texture included."""
        albedo = self.surface.albedo(points_mm)
        if self.finish.texture == 0.0:
            return albedo
        return albedo * self.texture_factor(points_mm)[:, None]

    def texture_factor(self, points_mm: FloatArray) -> FloatArray:
        """(N,) reflectance over its mean at points (N, 3) in Base."""
        cells = points_mm * (CELLS_PER_GRAIN / self.finish.texture_mm)
        x = (cells[:, 0] + SLANT[0] * cells[:, 2]).astype(np.int64) % _TEXTURE_CELLS
        y = (cells[:, 1] + SLANT[1] * cells[:, 2]).astype(np.int64) % _TEXTURE_CELLS
        return np.maximum(1.0 + self.finish.texture * texture_pattern()[y, x], DARKEST)


@cache
def texture_pattern() -> FloatArray:
    """Smooth random field of unit variance that every skin takes its texture from."""
    noise = np.random.default_rng(405).standard_normal((_TEXTURE_CELLS, _TEXTURE_CELLS))
    smooth = blur_image(noise, 0.5 * CELLS_PER_GRAIN)
    return np.asarray(smooth / smooth.std())


SHADOW_MARGIN_MM = 0.02
"""A surface does not shade itself nearer than this."""
FAINTEST = 1e-6
"""Light below this part of full scale is not followed any further."""


@dataclass(frozen=True, slots=True)
class RoomLight:
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
    """First points that rays meet; nothing met: infinite distance, surface -1, points NaN.

    ``distance_mm`` (N,), ``surface`` (N,) index into the scene's, ``points_mm`` (N, 3).
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
    lamp: RoomLight = RoomLight()

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

        A laser is nearly of one wavelength: the surface answers with its red albedo.
        """
        radiance = np.zeros(len(hits.surface))
        met = np.flatnonzero(hits.surface >= 0)
        at = hits.select(met)
        light = laser.irradiance_at(at.points_mm, self.normals(at))
        bright = np.flatnonzero(light > FAINTEST)
        lit = bright[self.sees(laser.source_mm, at.points_mm[bright])]
        radiance[met[lit]] = light[lit] * self.albedo(at.select(lit))[:, 0]
        return radiance
