# SPDX-License-Identifier: Apache-2.0
"""Subtraction of the view with the laser off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armscan.errors import InputError
from armscan.records.exposure import Exposure

SAMPLE_STEP_PX = 4
ROUNDS = 4
TRIM_SIGMAS = 2.5
GAIN_LIMITS = (0.05, 20.0)


def check_background(exposure: Exposure, background: Exposure) -> None:
    """Raise `InputError` unless both exposures show the same pixels in the same format."""
    if exposure.image.shape != background.image.shape or exposure.window != background.window:
        raise InputError(
            f"the background image is {background.image.shape} at {background.window}, the stripe "
            f"image {exposure.image.shape} at {exposure.window}",
            where=background.source,
            remedy="take both with the same camera settings",
        )


def subtract(
    lit: NDArray[np.float32], dark: NDArray[np.float32], full_scale: float
) -> NDArray[np.float32]:
    """Subtract the dark view after matching its brightness.

    Gain and offset come from a trimmed line fit over a sample of unsaturated pixels, so that a
    lamp that flickers between the two images leaves no ghost, and the laser's own pixels do not
    count.

    Parameters
    ----------
    lit, dark
        (H, W) float32, laser on and off.
    full_scale
        Grey level of saturation.
    """
    x = dark[::SAMPLE_STEP_PX, ::SAMPLE_STEP_PX].ravel().astype(np.float64)
    y = lit[::SAMPLE_STEP_PX, ::SAMPLE_STEP_PX].ravel().astype(np.float64)
    use = (x < 0.98 * full_scale) & (y < 0.98 * full_scale)
    gain, offset = 1.0, 0.0
    for _ in range(ROUNDS):
        if use.sum() < 16:
            break
        middle = x[use].mean()
        spread = float(((x[use] - middle) ** 2).sum())
        if spread > use.sum():
            slope = float(((x[use] - middle) * y[use]).sum()) / spread
            gain = float(np.clip(slope, *GAIN_LIMITS))
        offset = float(np.median(y[use] - gain * x[use]))
        rest = np.abs(y - gain * x - offset)
        use = rest <= TRIM_SIGMAS * max(1.4826 * float(np.median(rest)), 0.5)
    return np.asarray(lit - np.float32(gain) * dark - np.float32(offset), dtype=np.float32)
