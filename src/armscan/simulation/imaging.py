# SPDX-License-Identifier: Apache-2.0
"""How kind the optics and the surroundings are: the presets' optical half."""

from __future__ import annotations

from dataclasses import dataclass

from armscan.devices.twin import Preset
from armscan.errors import InputError
from armscan.simulation.detector import Detector
from armscan.simulation.render import Speckle

_FINE_GRAIN = Speckle(contrast=0.22, grain_px=0.6)
_MONO = Detector(is_colour=False, halo_share=0.02)


@dataclass(frozen=True, slots=True)
class Imaging:
    """All that decides how good an image is, save the scene.

    Parameters
    ----------
    laser_level
        Peak of the laser's line on matt white that faces it, as a part of full scale, before the
        lens's blur.
    ambient
        Even light of the room during a scan on white, as a part of full scale.
    target_light
        The same while a target is photographed.
    speckle
        Grain of laser light.
    detector
        Sensor noise, halo, bits.
    gloss, texture
        Factors on the gloss and texture of everything in the scene.
    ghost_share, ghost_sigma_px
        Part of the light that comes back from the lens mirrored at the image's centre, and how
        blurred.
    spot_level, spot_mm
        Undiffracted beam in the middle of a projector of several lines: its brightness over that
        of the middle line, and the Gaussian sigma of its round section.
    stray_share
        Brightness, over that of the lines, of those that a glossy plate throws back to the head
        and the head back to the plate, for a plate of gloss 1; projectors of several lines only.
    """

    laser_level: float = 0.8
    ambient: float = 0.012
    target_light: float = 0.9
    speckle: Speckle = _FINE_GRAIN
    detector: Detector = _MONO
    gloss: float = 1.0
    texture: float = 1.0
    ghost_share: float = 0.0
    ghost_sigma_px: float = 5.0
    spot_level: float = 6.0
    spot_mm: float = 0.6
    stray_share: float = 0.12

    def __post_init__(self) -> None:
        least = min(self.ambient, self.gloss, self.texture, self.ghost_share)
        least = min(least, self.spot_level, self.stray_share)
        if least < 0.0 or min(self.laser_level, self.target_light) <= 0.0:
            raise InputError("light, gloss and texture cannot be negative")
        if min(self.ghost_sigma_px, self.spot_mm) <= 0.0:
            raise InputError("a ghost image needs a blur and a spot a size")


IMAGING: dict[Preset, Imaging] = {
    "clean": Imaging(
        ambient=0.004,
        speckle=Speckle(contrast=0.01, grain_px=0.6),
        detector=Detector(
            is_colour=False, electrons_per_level=2000.0, read_noise=0.2, halo_share=0.0
        ),
        gloss=0.0,
        texture=0.0,
        spot_level=0.0,
        stray_share=0.0,
    ),
    "thesis": Imaging(),
    "harsh": Imaging(
        laser_level=1.3,
        ambient=0.08,
        speckle=Speckle(contrast=0.45, grain_px=0.9),
        detector=Detector(
            is_colour=False, electrons_per_level=20.0, read_noise=2.0, halo_share=0.06
        ),
        gloss=2.5,
        texture=2.5,
        ghost_share=0.01,
        spot_level=15.0,
        spot_mm=0.8,
    ),
}
