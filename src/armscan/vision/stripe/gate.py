# SPDX-License-Identifier: Apache-2.0
"""Rejection of ridges that do not have the laser's colour around them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.vision.stripe.chains import mean_along, strong_median

CORE_SIGMAS = 3.0
BESIDE_SIGMAS = (5.0, 8.0)
LEAST_CORE_PX = 3.0
HALF = 4
NOISE_FACTOR = 4.0
LEAST_SHARE = 0.25


def has_laser_colour(
    gate: NDArray[np.float32], table: FloatArray, chain: IntArray, line_sigma_px: float
) -> BoolArray:
    """(N,) True where the colour excess near the ridge stands out from both sides.

    The core of a saturated line is white; its halo keeps the colour. So the strongest excess within
    three sigmas is compared with the excess farther out, averaged along the line.

    Parameters
    ----------
    gate
        (H, W) colour excess.
    table, chain
        Ridge points and their chains.
    line_sigma_px
        Typical sigma of the lines.
    """
    core = max(CORE_SIGMAS * line_sigma_px, LEAST_CORE_PX)
    inside = _across(gate, table, np.arange(-core, core + 0.5, 1.0)).max(axis=1)
    far = np.linspace(BESIDE_SIGMAS[0], BESIDE_SIGMAS[1], 4) * max(line_sigma_px, 1.0)
    beside = np.maximum(
        np.median(_across(gate, table, -far), axis=1), np.median(_across(gate, table, far), axis=1)
    )
    ones = np.ones(len(table))
    contrast = mean_along(inside - beside, ones, chain, HALF)
    step = np.abs(np.diff(gate[::7, :], axis=1))
    noise = 1.05 * float(np.median(step)) if step.size else 0.0
    typical = strong_median(np.maximum(contrast, 0.0))
    return np.asarray(contrast > max(NOISE_FACTOR * noise, LEAST_SHARE * typical))


def is_on_known_ground(
    unknown: NDArray[np.uint8], table: FloatArray, line_sigma_px: float
) -> BoolArray:
    """(N,) False where the view without laser was saturated within three sigmas of the ridge."""
    if unknown.size == 1:
        return np.ones(len(table), dtype=np.bool_)
    core = max(CORE_SIGMAS * line_sigma_px, LEAST_CORE_PX)
    return np.asarray(_across(unknown, table, np.arange(-core, core + 0.5, 1.0)).max(axis=1) == 0)


def _across(
    gate: NDArray[np.float32] | NDArray[np.uint8], table: FloatArray, offsets: FloatArray
) -> FloatArray:
    height, width = gate.shape
    x = np.rint(table[:, :1] + table[:, 2:3] * offsets).astype(np.int64)
    y = np.rint(table[:, 1:2] + table[:, 3:4] * offsets).astype(np.int64)
    return gate[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(np.float64)
