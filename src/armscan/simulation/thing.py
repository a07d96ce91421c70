# SPDX-License-Identifier: Apache-2.0
"""Things on the bench of the arm: a shape in Base and how its skin reflects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.simulation.optics import blur_image
from armscan.simulation.surfaces import Surface

_TEXTURE_CELLS = 1024
_CELLS_PER_GRAIN = 4.0
_SLANT = (0.6180, 0.4142)
DARKEST = 0.05


@dataclass(frozen=True, slots=True)
class Finish:
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

    def scaled(self, gloss: float, texture: float) -> Finish:
        """The finish with its gloss and its texture multiplied."""
        return replace(self, gloss=gloss * self.gloss, texture=texture * self.texture)


MATT_PAINT = Finish(gloss=0.06, gloss_width_rad=0.35, texture=0.03)
CERAMIC = Finish(gloss=0.15, gloss_width_rad=0.2, texture=0.02, texture_mm=0.4)
GROUND_STEEL = Finish(gloss=0.5, gloss_width_rad=0.18, texture=0.05, texture_mm=0.2)


@dataclass(frozen=True, slots=True, eq=False)
class Thing:
    """A surface in Base with its finish; it is a `Surface` itself.

    Parameters
    ----------
    name
        What truth and messages call it.
    surface
        In Base.
    finish
        Gloss and texture.
    """

    name: str
    surface: Surface
    finish: Finish = MATT_PAINT

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
        cells = points_mm * (_CELLS_PER_GRAIN / self.finish.texture_mm)
        x = (cells[:, 0] + _SLANT[0] * cells[:, 2]).astype(np.int64) % _TEXTURE_CELLS
        y = (cells[:, 1] + _SLANT[1] * cells[:, 2]).astype(np.int64) % _TEXTURE_CELLS
        return np.maximum(1.0 + self.finish.texture * _pattern()[y, x], DARKEST)


@cache
def _pattern() -> FloatArray:
    """Smooth random field of unit variance that every skin takes its texture from."""
    noise = np.random.default_rng(405).standard_normal((_TEXTURE_CELLS, _TEXTURE_CELLS))
    smooth = blur_image(noise, 0.5 * _CELLS_PER_GRAIN)
    return np.asarray(smooth / smooth.std())
