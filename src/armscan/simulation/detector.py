# SPDX-License-Identifier: Apache-2.0
"""From light on the sensor to grey levels: halo, colour, noise, saturation, bits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, ImageArray
from armscan.simulation.optics import add_noise, blur_image

LEVELS = 255.0


@dataclass(frozen=True, slots=True)
class Detector:
    """Sensor and amplifier of a camera.

    Parameters
    ----------
    is_colour
        Deliver red, green, blue; else one channel, the first.
    bits
        Significant bits; more than 8 are stored in 16.
    electrons_per_level
        Electrons per level of an 8-bit image: sets the shot noise.
    read_noise
        Noise that does not depend on the light, in levels of an 8-bit image.
    halo_share, halo_sigma_px
        Part of strong light that the lens and the cover glass scatter, and how far.
    """

    is_colour: bool = True
    bits: int = 8
    electrons_per_level: float = 60.0
    read_noise: float = 0.8
    halo_share: float = 0.05
    halo_sigma_px: float = 8.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.halo_share < 1.0 or not self.electrons_per_level > 0.0:
            raise InputError("a detector scatters a part of the light and counts electrons")

    def scatter(self, light: FloatArray) -> FloatArray:
        """Move the halo's share of light (H, W) away from where it belongs; the sum is kept."""
        if self.halo_share == 0.0:
            return light
        halo = blur_image(light, self.halo_sigma_px)
        return np.asarray((1.0 - self.halo_share) * light + self.halo_share * halo)

    def expose(self, light: FloatArray, rng: np.random.Generator) -> ImageArray:
        """Grey levels of light (H, W) or (H, W, 3), given as parts of full scale."""
        seen = light[..., 0] if light.ndim == 3 and not self.is_colour else light
        return add_noise(
            np.asarray(LEVELS * seen),
            rng,
            sigma=self.read_noise,
            electrons_per_level=self.electrons_per_level,
            bits=self.bits,
        )
