# SPDX-License-Identifier: Apache-2.0
"""Where the centre of a light sheet truly meets the scene, in 3-D and in the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_floats
from armscan.simulation.light import LineLaser
from armscan.simulation.optics import STEP_TOLERANCE, RenderCamera
from armscan.simulation.scene import Hits, Scene

BISECTIONS = 30
SAME_SURFACE_MM = 3.0
"""Neighbouring pixels that differ more in distance lie on two sides of a silhouette."""


@dataclass(frozen=True, slots=True, eq=False)
class StripeTruth:
    """True centre points of one laser's stripe, one a row (or a column, if it lies flat).

    Parameters
    ----------
    laser
        Name of the laser.
    points_px
        (N, 2) full-sensor pixels.
    points_mm
        (N, 3) in the Sensor frame.
    surface
        (N,) index into the scene's surfaces, as float64.
    """

    laser: str
    points_px: FloatArray
    points_mm: FloatArray
    surface: FloatArray

    def __post_init__(self) -> None:
        n = len(self.points_px)
        object.__setattr__(self, "points_px", frozen_floats(self.points_px, (n, 2), "points_px"))
        object.__setattr__(self, "points_mm", frozen_floats(self.points_mm, (n, 3), "points_mm"))
        object.__setattr__(self, "surface", frozen_floats(self.surface, (n,), "surface"))


def camera_rays(
    camera: RenderCamera, pixels_px: FloatArray, tolerance: float = STEP_TOLERANCE
) -> FloatArray:
    """(N, 3) unit directions, in the Sensor frame, of full-sensor pixels (N, 2)."""
    xy = camera.rays(pixels_px, tolerance)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def find_stripe(
    scene: Scene, camera: RenderCamera, laser: LineLaser, band: BoolArray
) -> StripeTruth:
    """Find where the sheet's centre crosses the pixel rows or columns within a band.

    Parameters
    ----------
    scene, camera, laser
        What is seen, and by what light.
    band
        (H, W) True where the light may reach.
    """
    rows, columns = np.nonzero(band)
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    hits = scene.trace(np.zeros(3), camera_rays(camera, pixels))
    number = np.full(band.shape, -1, dtype=np.int64)
    number[rows, columns] = np.arange(len(rows))
    offset = np.full(len(rows), np.nan)
    is_hit = hits.surface >= 0
    offset[is_hit] = laser.offset_mm(hits.points_mm[is_hit])
    across_rows = _crossings(number[:, :-1], number[:, 1:], hits, offset)
    across_columns = _crossings(number[:-1, :], number[1:, :], hits, offset)
    pairs = across_rows if len(across_rows) >= len(across_columns) else across_columns
    return _refine(scene, camera, laser, pixels[pairs[:, 0]], pixels[pairs[:, 1]])


def _crossings(first: IntArray, second: IntArray, hits: Hits, offset_mm: FloatArray) -> IntArray:
    """(K, 2) neighbours on one surface between which the sheet's centre passes."""
    both = (first >= 0) & (second >= 0)
    a, b = first[both], second[both]
    changes = (offset_mm[a] <= 0.0) != (offset_mm[b] <= 0.0)
    known = np.isfinite(offset_mm[a]) & np.isfinite(offset_mm[b])
    same = hits.surface[a] == hits.surface[b]
    a, b = a[changes & known & same], b[changes & known & same]
    step = np.abs(hits.distance_mm[a] - hits.distance_mm[b])
    return np.asarray(np.stack([a, b], axis=1)[step < SAME_SURFACE_MM])


def _refine(
    scene: Scene, camera: RenderCamera, laser: LineLaser, low_px: FloatArray, high_px: FloatArray
) -> StripeTruth:
    """Halve the interval between two pixels until the sheet's centre is found."""
    low, high = low_px.copy(), high_px.copy()
    at_low = scene.trace(np.zeros(3), camera_rays(camera, low))
    sign_low = laser.offset_mm(at_low.points_mm) <= 0.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        hits = scene.trace(np.zeros(3), camera_rays(camera, middle))
        is_low = (laser.offset_mm(hits.points_mm) <= 0.0) == sign_low
        low[is_low], high[~is_low] = middle[is_low], middle[~is_low]
    hits = scene.trace(np.zeros(3), camera_rays(camera, 0.5 * (low + high)))
    is_lit = scene.laser_light(laser, hits) > 0.0
    pixels = 0.5 * (low + high)
    return StripeTruth(
        laser.name, pixels[is_lit], hits.points_mm[is_lit], hits.surface[is_lit].astype(np.float64)
    )
