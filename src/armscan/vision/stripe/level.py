# SPDX-License-Identifier: Apache-2.0
"""Background level, noise and threshold of an image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CELL_PX = 64
SQRT2 = math.sqrt(2.0)
SAMPLE_STEP_PX = 4
CLUTTER_LAG_PX = 12
BACKGROUND_QUANTILE = 0.4
MAD_TO_SIGMA = 1.4826
LEAST_NOISE = 0.35
"""Rounding to whole grey levels hides smaller noise."""
THRESHOLD_SIGMAS = 6.0
LEAST_PEAK_SHARE = 0.06
"""Lines fainter than this share of the brightest ones are reflections, not stripes."""
PEAK_QUANTILE = 0.999


@dataclass(frozen=True, slots=True, eq=False)
class ImageLevel:
    """What the pixels beside the lines look like.

    Parameters
    ----------
    background
        (rows, columns) float32 background level per cell of `CELL_PX` pixels.
    noise
        Standard deviation of a background pixel against its neighbour.
    clutter
        The same at a distance of `CLUTTER_LAG_PX`, where compression blocks, chroma subsampling and
        surface texture show; never less than ``noise``.
    rise
        Height above the background at which a line begins.
    """

    background: NDArray[np.float32]
    noise: float
    clutter: float
    rise: float


def measure_level(image: NDArray[np.float32], threshold: float | None) -> ImageLevel:
    """Estimate background and noise from a sample of the pixels.

    Parameters
    ----------
    image
        (H, W) float32.
    threshold
        Least height of a line above the background, or None to set it from the noise.
    """
    background = _cell_quantiles(image)
    noise = _noise(image, 1)
    clutter = max(_noise(image, CLUTTER_LAG_PX), noise)
    if threshold is None:
        sample = image[::2, ::2]
        peak = float(np.quantile(sample, PEAK_QUANTILE)) - float(np.median(background))
        threshold = max(THRESHOLD_SIGMAS * clutter, LEAST_PEAK_SHARE * peak)
    return ImageLevel(background, noise, clutter, threshold)


def _cell_quantiles(image: NDArray[np.float32]) -> NDArray[np.float32]:
    height, width = image.shape
    rows, columns = -(-height // CELL_PX), -(-width // CELL_PX)
    steps = CELL_PX // SAMPLE_STEP_PX
    sample = image[::SAMPLE_STEP_PX, ::SAMPLE_STEP_PX]
    missing = (rows * steps - sample.shape[0], columns * steps - sample.shape[1])
    filled = np.pad(sample, ((0, missing[0]), (0, missing[1])), mode="edge")
    cells = filled.reshape(rows, steps, columns, steps).swapaxes(1, 2)
    ordered = np.sort(cells.reshape(rows, columns, steps * steps), axis=2)
    return np.ascontiguousarray(ordered[:, :, int(BACKGROUND_QUANTILE * steps * steps)])


def _noise(image: NDArray[np.float32], lag: int) -> float:
    rows = image[:: 2 * SAMPLE_STEP_PX]
    if rows.shape[1] <= lag:
        return LEAST_NOISE
    step = np.abs(rows[:, lag::3] - rows[:, : rows.shape[1] - lag : 3])
    typical = float(np.median(step)) * MAD_TO_SIGMA
    trimmed = float(np.minimum(step, max(2.5 * typical, 2.0)).mean()) * math.sqrt(math.pi / 2.0)
    return max(typical, trimmed, LEAST_NOISE * SQRT2) / SQRT2
