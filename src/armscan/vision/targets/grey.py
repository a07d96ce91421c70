# SPDX-License-Identifier: Apache-2.0
"""Grey images in which a target may show, the likeliest first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import FloatArray, ImageArray
from armscan.records.exposure import Exposure

MIN_CONTRAST = 0.02
"""Least contrast of a circle or square, as a fraction of full scale."""
SAME_CHANNEL_LEVELS = 1.5
"""Channels whose mean difference is below this (8-bit levels) show the same."""
_WEIGHTS = (0.299, 0.587, 0.114)
_SAMPLES_PER_CUBE = 65_536

Grey8 = NDArray[np.uint8]
Grey32 = NDArray[np.float32]
RawGrey = ImageArray | FloatArray


def grey_channels(exposure: Exposure) -> list[RawGrey]:
    """Return the grey images (H, W) worth a search, raw levels, without near duplicates.

    A monochrome exposure has one. A colour exposure has its luminance, then red, green and blue
    (a board lit by a red laser shows in red only), then the darkest and the brightest channel.
    """
    if exposure.colour == "mono":
        return [exposure.image]
    image = exposure.image
    red, green, blue = (image[..., k] for k in range(3))
    luminance: FloatArray = _WEIGHTS[0] * red + _WEIGHTS[1] * green + _WEIGHTS[2] * blue
    channels: list[RawGrey] = [luminance]
    darkest = np.minimum(np.minimum(red, green), blue)
    brightest = np.maximum(np.maximum(red, green), blue)
    others = [red, green, blue, darkest, brightest]
    step = max(1, int(np.sqrt(image.shape[0] * image.shape[1] / _SAMPLES_PER_CUBE)))
    limit = SAME_CHANNEL_LEVELS * exposure.full_scale / 255.0
    for other in others:
        differences = [
            np.abs(other[::step, ::step] - known[::step, ::step].astype(np.float64)).mean()
            for known in channels
        ]
        if min(differences) > limit:
            channels.append(np.ascontiguousarray(other))
    return channels


def to_grey8(grey: RawGrey, full_scale: int) -> Grey8:
    """Return an 8-bit copy for OpenCV's finders.

    Up to 8 significant bits the levels are kept. Deeper images are scaled so that their brightest
    0.1 % reach 255, because a dark board would lose its grey levels otherwise.
    """
    if full_scale <= 255 and grey.dtype == np.uint8:
        return np.ascontiguousarray(grey, dtype=np.uint8)
    if full_scale <= 255:
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    top = max(float(np.percentile(grey[::4, ::4], 99.9)), full_scale / 64.0)
    return np.clip(np.rint(grey * (255.0 / top)), 0, 255).astype(np.uint8)


def sample(grey: RawGrey | Grey32, points_px: FloatArray) -> FloatArray:
    """Return the levels (N,) at the pixels nearest to (N, 2) points; NaN outside the image."""
    u = np.rint(points_px[:, 0])
    v = np.rint(points_px[:, 1])
    height, width = grey.shape[:2]
    is_inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    levels = np.full(len(points_px), np.nan)
    levels[is_inside] = grey[v[is_inside].astype(np.int64), u[is_inside].astype(np.int64)]
    return levels
