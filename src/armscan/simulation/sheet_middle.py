# SPDX-License-Identifier: Apache-2.0
"""Where a head's light sheets are in the Sensor frame: their middles, and points all over them."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.simulation.head import Head
from armscan.simulation.light import LineLaser

_DEPTHS_MM = np.linspace(112.0, 172.0, 31)
_FAN_STEPS = 61


def sheet_middle_mm(head: Head, depth_mm: float, sheet: str | None = None) -> FloatArray:
    """(3,) point of a sheet's middle ray at a depth along the optical axis.

    Without a name it is the middle sheet of an odd number, the mean of the two of an even one.
    """
    count = len(head.lasers)
    chosen = [laser for laser in head.lasers if laser.name == sheet]
    middles = chosen or head.lasers[(count - 1) // 2 : count // 2 + 1]
    return np.asarray(np.mean([_middle_mm(laser, depth_mm) for laser in middles], axis=0))


def sheet_points_mm(head: Head) -> dict[str, FloatArray]:
    """(N, 3) points of each sheet that camera 0's full sensor sees, 112-172 mm deep."""
    return {laser.name: _points_mm(head, laser) for laser in head.lasers}


def _middle_mm(laser: LineLaser, depth_mm: float) -> FloatArray:
    ray = laser.rays(np.zeros(1))[0]
    return np.asarray(laser.source_mm + (depth_mm - laser.source_mm[2]) / ray[2] * ray)


def _points_mm(head: Head, laser: LineLaser) -> FloatArray:
    camera = head.camera
    fan = np.linspace(-laser.half_angle_rad, laser.half_angle_rad, _FAN_STEPS)
    rays = laser.rays(fan)
    reach = (_DEPTHS_MM[:, None] - laser.source_mm[2]) / rays[:, 2]
    points = (laser.source_mm + reach[..., None] * rays).reshape(-1, 3)
    pixels = camera.project(points)
    size = np.array([camera.width_px - 1, camera.height_px - 1])
    return np.asarray(points[((pixels >= 0.0) & (pixels <= size)).all(axis=1)])
