# SPDX-License-Identifier: Apache-2.0
"""Channels of colour exposures, their differences, and the gate by the laser's colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import ImageArray
from armscan.records.exposure import Exposure
from armscan.vision.stripe.laser_off import subtract
from armscan.vision.stripe.options import LaserColour
from armscan.vision.stripe.plane import NORMAL_SCALE, StripePlane, saturated_mask, to_units

CHANNELS = ("red", "green", "blue")
COLOURS: tuple[LaserColour, ...] = ("red", "green", "blue")
RIDGE_STEP_PX = 14
RIDGE_QUANTILE = 0.9995
LEAST_COLOUR_SHARE = 0.25
"""A laser's colour shows at least this share of the grey contrast, else the line is grey."""
SATURATED_SHARE = 0.12
"""With more clipped pixels on the line than this, another channel is consulted."""
LEAST_CORE_HEIGHT = 8.0
"""A channel shows the core if it rises by this much above its surroundings there."""
LINE_SHARE = 0.4
NOWHERE = np.zeros((1, 1), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class ColourImages:
    """Channels of a colour exposure after background subtraction.

    Parameters
    ----------
    channels
        Red, green, blue: (H, W) float32.
    clipped
        The mask of saturated pixels of each.
    """

    channels: tuple[NDArray[np.float32], ...]
    clipped: tuple[NDArray[np.uint8], ...]


def split_channels(exposure: Exposure, background: Exposure | None) -> ColourImages:
    """Red, green and blue of an exposure, less the background."""
    scale = exposure.full_scale
    channels, clipped = [], []
    for k in range(3):
        raw = _channel(exposure, k)
        channel = to_units(raw, scale)
        if background is not None:
            dark = to_units(_channel(background, k), background.full_scale)
            channel = subtract(channel, dark, NORMAL_SCALE)
        channels.append(channel)
        clipped.append(saturated_mask(raw, scale))
    return ColourImages(tuple(channels), tuple(clipped))


def _channel(exposure: Exposure, k: int) -> ImageArray:
    image = exposure.image
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image[:, :, k], dtype=np.uint8)
    return np.ascontiguousarray(image[:, :, k], dtype=np.uint16)


def colour_excess(images: ColourImages, colour: str) -> NDArray[np.float32]:
    """How much stronger the laser's colour is than the mean of the two others, (H, W)."""
    k = CHANNELS.index(colour)
    others = [images.channels[m] for m in range(3) if m != k]
    return np.asarray(images.channels[k] - np.float32(0.5) * (others[0] + others[1]))


def ridge_height(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Height (H - 2 s, W - 2 s) above both neighbours at distance s, along rows or columns."""
    s = RIDGE_STEP_PX
    if min(image.shape) <= 2 * s:
        return np.zeros((0, 0), np.float32)
    middle = image[s:-s, s:-s]
    along_row = middle - np.maximum(image[s:-s, : -2 * s], image[s:-s, 2 * s :])
    down_column = middle - np.maximum(image[: -2 * s, s:-s], image[2 * s :, s:-s])
    return np.asarray(np.maximum(along_row, down_column))


def _strength(image: NDArray[np.float32]) -> float:
    ridge = ridge_height(image)
    return float(np.quantile(ridge, RIDGE_QUANTILE)) if ridge.size else 0.0


def find_laser_colour(images: ColourImages) -> LaserColour:
    """Colour whose excess forms the strongest thin lines; grey if none stands out."""
    strengths = [_strength(colour_excess(images, colour)) for colour in COLOURS]
    grey = _strength(np.asarray(sum(images.channels) / np.float32(3.0)))
    best = int(np.argmax(strengths))
    return COLOURS[best] if strengths[best] > LEAST_COLOUR_SHARE * grey else "grey"


def colour_plane(
    exposure: Exposure, background: Exposure | None, colour: LaserColour
) -> StripePlane:
    """The plane of a colour exposure in which the stripe is sought.

    Of ``auto``, the colour is found in this one image. For a colour, the laser's own channel is
    used; where its core is saturated, the least saturated channel that still shows the core is
    added: it rises where the first has reached its limit, while the halo and dim parts of the line
    stay with the laser's colour; only ridges with the laser's colour around them count. For a
    difference, what the channels have in common, the room's light on a printed pattern, cancels.
    """
    images = split_channels(exposure, background)
    factor = exposure.full_scale / NORMAL_SCALE
    if colour == "auto":
        colour = find_laser_colour(images)
    if colour == "grey":
        mean = np.asarray(sum(images.channels) / np.float32(3.0), dtype=np.float32)
        clipped = _any_clipped(images.clipped)
        return StripePlane(mean, clipped, clipped, factor)
    own = CHANNELS.index(colour.partition("-")[0])
    unknown = None
    if background is not None:
        unknown = saturated_mask(_channel(background, own), background.full_scale)
    if colour not in CHANNELS:
        clipped = images.clipped[own]
        return StripePlane(_difference(images, colour), clipped, clipped, factor, unknown=unknown)
    excess = colour_excess(images, colour)
    core = _core_channel(images, excess, own)
    image, clipped = images.channels[own], images.clipped[own]
    if core is not None:
        image, clipped = image + images.channels[core], images.clipped[core]
    return StripePlane(image, clipped, images.clipped[own], factor, excess, unknown)


def _difference(images: ColourImages, colour: LaserColour) -> NDArray[np.float32]:
    """One channel less another one, or less the mean of both others."""
    first, _, second = colour.partition("-")
    if second == "excess":
        return colour_excess(images, first)
    return images.channels[CHANNELS.index(first)] - images.channels[CHANNELS.index(second)]


def _any_clipped(masks: tuple[NDArray[np.uint8], ...]) -> NDArray[np.uint8]:
    found = [mask for mask in masks if mask.size > 1]
    return np.maximum.reduce(found) if found else NOWHERE


def _core_channel(images: ColourImages, excess: NDArray[np.float32], own: int) -> int | None:
    """The channel that shows a core in which the laser's own is saturated; None if none is."""
    s = RIDGE_STEP_PX
    ridge = ridge_height(excess)
    if not ridge.size or images.clipped[own].size == 1:
        return None
    line = ridge > LINE_SHARE * float(np.quantile(ridge, RIDGE_QUANTILE))
    core = line & (images.clipped[own][s:-s, s:-s] > 0)
    if core.sum() <= SATURATED_SHARE * line.sum():
        return None
    heights = [float(np.median(ridge_height(c)[core])) for c in images.channels]
    shares = [float(m[s:-s, s:-s][core].mean()) if m.size > 1 else 0.0 for m in images.clipped]
    others = [k for k in range(3) if k != own and heights[k] > LEAST_CORE_HEIGHT]
    return min(others, key=lambda k: (shares[k], -heights[k])) if others else None
