# SPDX-License-Identifier: Apache-2.0
"""Rings and other things on a plane, drawn by brute force: many rays through each pixel.

Nothing of the product or of its simulator is used, so that a test compares two independent
computations. The camera is a pinhole without distortion; pixel (0, 0) is the centre of the first
pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.records.exposure import Exposure

Floats = NDArray[np.float64]
FOCAL_PX = 5150.0
RAYS = 6
"""Rays a pixel along each axis."""
GROUND, DARK, LIGHT = 150.0, 40.0, 210.0


@dataclass(frozen=True)
class Mark:
    """Something on the plane at (x, y), mm; ``kind`` is ring, disc, square, stripes or letter."""

    kind: str
    x_mm: float
    y_mm: float
    outer_mm: float = 3.0
    inner_mm: float = 1.5
    """Radii; the half side of squares, stripes and letters is ``outer_mm``."""


@dataclass(frozen=True)
class Rendered:
    """Levels without noise, and where the marks' centres truly are."""

    levels: Floats
    centres_px: Floats

    def exposure(self, seed: int, noise: float = 2.0, source: str = "rendered") -> Exposure:
        rng = np.random.default_rng(seed)
        noisy = self.levels + noise * rng.standard_normal(self.levels.shape)
        return Exposure(np.clip(np.rint(noisy), 0, 255).astype(np.uint8), source)


def tilted(tilt_deg: float, azimuth_deg: float) -> Floats:
    """Rotation of a plane tilted by ``tilt_deg`` about an axis at ``azimuth_deg`` in the image."""
    azimuth = np.deg2rad(azimuth_deg)
    axis = np.deg2rad(tilt_deg) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    return np.asarray(cv2.Rodrigues(axis)[0], np.float64)


def render(
    marks: list[Mark],
    rotation: Floats,
    translation_mm: Floats,
    size_px: tuple[int, int],
    *,
    focal_px: float = FOCAL_PX,
    blur_px: float = 1.0,
    ground: float = GROUND,
    rays: int = RAYS,
) -> Rendered:
    """Draw marks on the plane z = 0 of a frame posed by ``rotation`` and ``translation_mm``."""
    width, height = size_px
    offsets = (np.arange(rays) + 0.5) / rays - 0.5
    u = (np.arange(width)[:, None] + offsets).ravel()
    v = (np.arange(height)[:, None] + offsets).ravel()
    x = ((u - (width - 1) / 2.0) / focal_px)[None, :]
    y = ((v - (height - 1) / 2.0) / focal_px)[:, None]
    to_plane = np.linalg.inv(np.column_stack([rotation[:, :2], translation_mm]))
    plane = [row[0] * x + row[1] * y + row[2] for row in to_plane]
    px, py = plane[0] / plane[2], plane[1] / plane[2]
    levels = np.full(px.shape, ground)
    for mark in marks:
        _draw(mark, px - mark.x_mm, py - mark.y_mm, levels)
    if blur_px > 0.0:
        levels = cv2.GaussianBlur(levels, (0, 0), rays * blur_px, borderType=cv2.BORDER_REPLICATE)
    levels = levels.reshape(height, rays, width, rays).mean(axis=(1, 3))
    places = np.array([[mark.x_mm, mark.y_mm, 0.0] for mark in marks]).reshape(-1, 3)
    seen = places @ rotation.T + translation_mm
    middle = [(width - 1) / 2.0, (height - 1) / 2.0]
    return Rendered(levels, focal_px * seen[:, :2] / seen[:, 2:] + middle)


def _draw(mark: Mark, x: Floats, y: Floats, levels: Floats) -> None:
    near = (np.abs(x) <= mark.outer_mm) & (np.abs(y) <= mark.outer_mm)
    own_x, own_y = x[near], y[near]
    radius = np.hypot(own_x, own_y)
    values = levels[near]
    if mark.kind == "ring":
        values[radius < mark.outer_mm] = DARK
        values[radius < mark.inner_mm] = LIGHT
    elif mark.kind == "disc":
        values[radius < mark.outer_mm] = DARK
    elif mark.kind == "square":
        values[:] = DARK
        inner = np.maximum(np.abs(own_x), np.abs(own_y)) < mark.inner_mm
        values[inner] = LIGHT
    elif mark.kind == "stripes":
        values[np.mod(own_x, mark.inner_mm) < 0.5 * mark.inner_mm] = DARK
    elif mark.kind == "letter":
        bar = np.abs(own_x) < 0.25 * mark.outer_mm
        values[bar | (own_y > 0.6 * mark.outer_mm) | (np.abs(own_y) < 0.2 * mark.outer_mm)] = DARK
    else:
        raise ValueError(mark.kind)
    levels[near] = values
