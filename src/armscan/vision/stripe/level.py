# SPDX-License-Identifier: Apache-2.0
"""Background level, noise and threshold of an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CELL_PX = 64
SAMPLE_STEP_PX = 5
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
    rows = max(-(-height // CELL_PX), 1)
    columns = max(-(-width // CELL_PX), 1)
    grid = np.zeros((rows, columns), np.float32)
    for i in range(rows):
        band = image[i * CELL_PX : (i + 1) * CELL_PX : SAMPLE_STEP_PX, ::SAMPLE_STEP_PX]
        x = np.arange(band.shape[1]) * SAMPLE_STEP_PX // CELL_PX
        edges = np.searchsorted(x, np.arange(columns + 1))
        for j in range(columns):
            cell = band[:, edges[j] : edges[j + 1]]
            grid[i, j] = np.quantile(cell, BACKGROUND_QUANTILE) if cell.size else band[0, -1]
    return grid


def _noise(image: NDArray[np.float32], lag: int) -> float:
    rows = image[:: 2 * SAMPLE_STEP_PX]
    if rows.shape[1] <= lag:
        return LEAST_NOISE
    step = np.abs(rows[:, lag::3] - rows[:, : rows.shape[1] - lag : 3])
    typical = float(np.median(step)) * MAD_TO_SIGMA
    trimmed = float(np.minimum(step, max(2.5 * typical, 2.0)).mean()) * float(np.sqrt(np.pi / 2.0))
    return max(typical, trimmed, LEAST_NOISE * np.sqrt(2.0)) / float(np.sqrt(2.0))
