# SPDX-License-Identifier: Apache-2.0
"""The grey image in which the stripe is sought, whatever the exposure's format."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import ImageArray
from armscan.records.exposure import Exposure
from armscan.vision.stripe.laser_off import subtract

NORMAL_SCALE = 255.0
"""Grey levels are scaled to 8 bits, so that no constant depends on the camera's depth."""


@dataclass(frozen=True, slots=True, eq=False)
class StripePlane:
    """One channel of an exposure, ready for extraction.

    Parameters
    ----------
    image
        (H, W) float32, full scale 255 before background subtraction.
    clipped
        (H, W) uint8, 1 where ``image`` says nothing because the camera saturated; (1, 1) if
        nowhere.
    saturated
        (H, W) uint8, 1 where the laser's own channel saturated; (1, 1) if nowhere.
    grey_levels_per_unit
        Factor from ``image`` to the exposure's own grey levels.
    gate
        (H, W) float32 how much the pixel has the laser's colour, or None for grey images.
    unknown
        (H, W) uint8, 1 where the view without laser saturated already; (1, 1) if nowhere; None
        without such a view.
    """

    image: NDArray[np.float32]
    clipped: NDArray[np.uint8]
    saturated: NDArray[np.uint8]
    grey_levels_per_unit: float
    gate: NDArray[np.float32] | None = None
    unknown: NDArray[np.uint8] | None = None


def saturated_mask(channel: ImageArray, full_scale: int) -> NDArray[np.uint8]:
    """Mask (H, W) of clipped pixels, or (1, 1) zeros if there are none."""
    if int(channel.max()) < full_scale:
        return np.zeros((1, 1), np.uint8)
    return np.ascontiguousarray(channel >= full_scale).view(np.uint8)


def to_units(channel: ImageArray, full_scale: int) -> NDArray[np.float32]:
    """Scale grey levels so that full scale is 255."""
    return channel.astype(np.float32) * np.float32(NORMAL_SCALE / full_scale)


def mono_plane(exposure: Exposure, background: Exposure | None) -> StripePlane:
    """Plane of a grey exposure, less the background."""
    scale = exposure.full_scale
    image = to_units(exposure.image, scale)
    unknown = None
    if background is not None:
        unknown = saturated_mask(background.image, background.full_scale)
        image = subtract(image, to_units(background.image, background.full_scale), NORMAL_SCALE)
    clipped = saturated_mask(exposure.image, scale)
    return StripePlane(image, clipped, clipped, scale / NORMAL_SCALE, unknown=unknown)
