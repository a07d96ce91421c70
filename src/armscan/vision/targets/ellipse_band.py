# SPDX-License-Identifier: Apache-2.0
"""The pixels along the rims of ellipses, with their exact distance to the rim."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.vision.targets.grey import RawGrey

_NEWTON_STEPS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Rims:
    """Ellipses by centre and axes.

    Parameters
    ----------
    centres_px
        (N, 2) centres.
    half_px
        (N, 2) half axes, the shorter one first.
    directions
        (N, 2, 2) unit vectors of the two axes, as columns.
    """

    centres_px: FloatArray
    half_px: FloatArray
    directions: FloatArray

    def __len__(self) -> int:
        """Count of ellipses."""
        return len(self.centres_px)

    @staticmethod
    def from_shapes(centres_px: FloatArray, shapes_px2: FloatArray) -> Rims:
        """Build rims from centres and matrices S with ``d' S^-1 d = 1`` on the rim."""
        square, directions = np.linalg.eigh(shapes_px2)
        return Rims(centres_px, np.sqrt(square), directions)

    def points(self, angle_rad: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rim points (N, K, 2) at parametric angles (K,), outward normals and curvatures (N, K)."""
        p, q = self.half_px[:, :1], self.half_px[:, 1:]
        cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
        own = np.stack([p * cosine, q * sine], axis=-1)
        normal = np.stack([q * cosine, p * sine], axis=-1)
        speed = np.linalg.norm(normal, axis=-1)
        normal = normal / speed[..., None]
        turn = self.directions.transpose(0, 2, 1)
        return self.centres_px[:, None] + own @ turn, normal @ turn, p * q / speed**3


@dataclass(frozen=True, slots=True, eq=False)
class BandPixels:
    """Pixels of all bands in one list: levels, ellipse, distance (px, outward) and angle (rad)."""

    levels: FloatArray
    ellipse: IntArray
    distance_px: FloatArray
    angle_rad: FloatArray


def band_pixels(
    grey: RawGrey, rims: Rims, half_width_px: FloatArray, gradient: FloatArray
) -> BandPixels:
    """Collect the pixels along the rims.

    Parameters
    ----------
    grey
        (H, W) raw levels.
    rims
        N ellipses.
    half_width_px
        (N,) largest distance from the rim.
    gradient
        (N, 2) relative slope of the illumination per px, divided out of the levels.
    """
    parts = [_patch(grey.shape, rims, k, half_width_px[k]) for k in range(len(rims))]
    ellipse = np.repeat(np.arange(len(rims)), [len(part) for part in parts])
    pixels = np.concatenate(parts) if parts else np.zeros((0, 2), np.int64)
    offset = pixels - rims.centres_px[ellipse]
    own = np.einsum("kij,ki->kj", rims.directions[ellipse], offset)
    distance, angle = _nearest(own, rims.half_px[ellipse])
    kept = np.abs(distance) <= half_width_px[ellipse]
    shade = 1.0 + (gradient[ellipse[kept]] * offset[kept]).sum(axis=1)
    levels = grey[pixels[kept, 1], pixels[kept, 0]] / shade
    return BandPixels(levels, ellipse[kept], distance[kept], angle[kept])


def _patch(shape: tuple[int, ...], rims: Rims, k: int, half_width_px: float) -> IntArray:
    """Pixels (K, 2), column and row, that may lie in the band of ellipse ``k``."""
    centre, half = rims.centres_px[k], rims.half_px[k]
    reach = np.sqrt(rims.directions[k] ** 2 @ half**2) + half_width_px + 1.0
    low = np.maximum(np.floor(centre - reach), 0).astype(np.int64)
    high = np.minimum(np.ceil(centre + reach), [shape[1] - 1, shape[0] - 1]).astype(np.int64)
    v, u = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1]
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    own = (pixels - centre) @ rims.directions[k]
    inner = np.maximum(half - half_width_px - 0.5, 0.1)
    is_inner = ((own / inner) ** 2).sum(axis=1) < 1.0
    is_outer = ((own / (half + half_width_px + 0.5)) ** 2).sum(axis=1) > 1.0
    # A parallel curve of an ellipse lies between these two ellipses.
    return np.asarray(pixels[~is_inner & ~is_outer])


def _nearest(own: FloatArray, half: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Signed distance, positive outside, and parametric angle of the nearest rim point."""
    p, q = half[:, 0], half[:, 1]
    x, y = own[:, 0], own[:, 1]
    angle = np.arctan2(p * y, q * x)
    for _ in range(_NEWTON_STEPS):
        cosine, sine = np.cos(angle), np.sin(angle)
        slope = (q**2 - p**2) * sine * cosine + p * x * sine - q * y * cosine
        curvature = (q**2 - p**2) * (cosine**2 - sine**2) + p * x * cosine + q * y * sine
        angle = angle - np.clip(slope / np.maximum(curvature, 0.1 * p**2), -0.3, 0.3)
    cosine, sine = np.cos(angle), np.sin(angle)
    speed = np.hypot(q * cosine, p * sine)
    outward = (x - p * cosine) * q * cosine + (y - q * sine) * p * sine
    return outward / speed, angle
