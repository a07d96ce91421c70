# SPDX-License-Identifier: Apache-2.0
"""The last steps of a mono exposure, in single precision: halo, ghost, noise, bits."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.errors import InputError
from armscan.geometry.arrays import ImageArray
from armscan.simulation.detector import LEVELS, Detector
from armscan.simulation.optics import blur_image

Image32 = NDArray[np.float32]

_HALO_CELL_PX = 4


def with_halo(light: Image32, share: float, sigma_px: float) -> Image32:
    """Move a share of light (H, W) into a wide halo; the sum is kept up to the border."""
    if share == 0.0:
        return light
    return np.asarray(light * np.float32(1.0 - share) + np.float32(share) * _wide(light, sigma_px))


def with_ghost(light: Image32, share: float, sigma_px: float) -> Image32:
    """Add a share of light (H, W) mirrored at the image's centre and blurred."""
    if share == 0.0:
        return light
    mirrored = np.ascontiguousarray(light[::-1, ::-1])
    return np.asarray(light + np.float32(share) * _wide(mirrored, sigma_px))


def expose_mono(light: Image32, detector: Detector, rng: np.random.Generator) -> ImageArray:
    """Grey levels of light (H, W), parts of full scale: shot and read noise, clipping, bits."""
    if not 1 <= detector.bits <= 16:
        raise InputError(f"{detector.bits} bits do not fit into 16")
    levels = light * np.float32(LEVELS)
    sigma = np.maximum(levels, 0.0, dtype=np.float32)
    sigma *= np.float32(1.0 / detector.electrons_per_level)
    sigma += np.float32(detector.read_noise**2)
    np.sqrt(sigma, out=sigma)
    sigma *= rng.standard_normal(light.shape, dtype=np.float32)
    levels += sigma
    full_scale = (1 << detector.bits) - 1
    levels *= np.float32(full_scale / LEVELS)
    np.rint(levels, out=levels)
    np.clip(levels, 0, full_scale, out=levels)
    return levels.astype(np.uint8) if detector.bits <= 8 else levels.astype(np.uint16)


def _wide(light: Image32, sigma_px: float) -> Image32:
    """Wide blur on a coarser grid."""
    height, width = light.shape
    size = (-(-width // _HALO_CELL_PX), -(-height // _HALO_CELL_PX))
    coarse = cv2.resize(light, size, interpolation=cv2.INTER_AREA)
    blurred = blur_image(np.asarray(coarse, dtype=np.float32), sigma_px / _HALO_CELL_PX)
    return np.asarray(
        cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float32
    )
