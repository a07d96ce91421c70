# SPDX-License-Identifier: Apache-2.0
"""Plane curves with an exact distance: the true centre lines of simulated stripes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from armscan.geometry.arrays import FloatArray

NEWTON_STEPS = 12


class Curve(Protocol):
    """A centre line in image pixels."""

    def locate(self, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Signed distance (N,) of points (N, 2) to the curve, and arc length (N,) of the foot."""
        ...


@dataclass(frozen=True, slots=True)
class StraightCurve:
    """A straight line through ``(x_px, y_px)`` at ``angle_deg`` from the x axis towards y."""

    x_px: float
    y_px: float
    angle_deg: float

    def locate(self, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Signed distance and arc length from the given point."""
        angle = math.radians(self.angle_deg)
        c, s = math.cos(angle), math.sin(angle)
        dx, dy = points_px[:, 0] - self.x_px, points_px[:, 1] - self.y_px
        return c * dy - s * dx, c * dx + s * dy


@dataclass(frozen=True, slots=True)
class CircleCurve:
    """A full circle; distances are positive outside."""

    x_px: float
    y_px: float
    radius_px: float

    def locate(self, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Signed distance and arc length from the x axis."""
        dx, dy = points_px[:, 0] - self.x_px, points_px[:, 1] - self.y_px
        return np.hypot(dx, dy) - self.radius_px, np.arctan2(dy, dx) * self.radius_px


@dataclass(frozen=True, slots=True)
class WaveCurve:
    """A sine wave along a straight line.

    Parameters
    ----------
    x_px, y_px, angle_deg
        The wave's axis, as in `StraightCurve`.
    amplitude_px, period_px
        Height and period of the wave.
    """

    x_px: float
    y_px: float
    angle_deg: float
    amplitude_px: float
    period_px: float

    @property
    def crest_radius_px(self) -> float:
        """Radius of curvature at a crest."""
        return (self.period_px / (2.0 * math.pi)) ** 2 / self.amplitude_px

    def locate(self, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Signed distance to the nearest point, and its position along the axis."""
        v, u = StraightCurve(self.x_px, self.y_px, self.angle_deg).locate(points_px)
        k = 2.0 * math.pi / self.period_px
        t = u.copy()
        for _ in range(NEWTON_STEPS):
            f = self.amplitude_px * np.sin(k * t)
            slope = self.amplitude_px * k * np.cos(k * t)
            error = (u - t) + (v - f) * slope
            bend = -1.0 - slope**2 - (v - f) * k * k * f
            t = t - np.clip(error / np.where(bend < -0.2, bend, -1.0 - slope**2), -3.0, 3.0)
        f = self.amplitude_px * np.sin(k * t)
        slope = self.amplitude_px * k * np.cos(k * t)
        distance = np.hypot(u - t, v - f) * np.sign(v - f)
        return distance, t
