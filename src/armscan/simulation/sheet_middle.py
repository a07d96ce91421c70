# SPDX-License-Identifier: Apache-2.0
"""Where a head's light sheet is in the Sensor frame: its middle, and points all over it."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.simulation.head import Head

_DEPTHS_MM = np.linspace(112.0, 172.0, 31)
_FAN_STEPS = 61


def sheet_middle_mm(head: Head, depth_mm: float) -> FloatArray:
    """(3,) point of the first laser's middle ray at a depth along the optical axis."""
    laser = head.lasers[0]
    ray = laser.rays(np.zeros(1))[0]
    return np.asarray(laser.source_mm + (depth_mm - laser.source_mm[2]) / ray[2] * ray)


def sheet_points_mm(head: Head) -> FloatArray:
    """(N, 3) points of the first laser's sheet that the full sensor sees, 112-172 mm deep."""
    laser, camera = head.lasers[0], head.camera
    fan = np.linspace(-laser.half_angle_rad, laser.half_angle_rad, _FAN_STEPS)
    rays = laser.rays(fan)
    reach = (_DEPTHS_MM[:, None] - laser.source_mm[2]) / rays[:, 2]
    points = (laser.source_mm + reach[..., None] * rays).reshape(-1, 3)
    pixels = camera.project(points)
    size = np.array([camera.width_px - 1, camera.height_px - 1])
    return np.asarray(points[((pixels >= 0.0) & (pixels <= size)).all(axis=1)])
