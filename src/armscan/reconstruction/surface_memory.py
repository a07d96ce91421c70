# SPDX-License-Identifier: Apache-2.0
"""The surface that the last exposures of a stroke measured, and what it predicts nearby."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Points, Pose

SPACING_MM = 0.5
"""Remembered points of one stripe are thinned to about this."""
N_NEAR = 32
REACH_MM = 5.0
"""Nothing is predicted further than this from all that is known."""
NOISE_MM = 0.04
"""Stripe, arm and calibration together, between exposures of one stroke."""
BEND_PER_MM = 0.06
"""Half the curvature of surfaces, 1/mm: a plane is off by this times the distance squared."""
SLOPE = 1.0
"""Standard deviation, before anything is known, of a surface's slope towards the camera."""
SHARP_MM = 0.3
"""Vaguer predictions err by the same all along a stretch."""
STUDENT = 3.0
"""Degrees of freedom of the error's distribution: edges and sharp bends have long tails."""


@dataclass(slots=True, eq=False)
class SurfaceMemory:
    """Points in Base of the last exposures.

    Parameters
    ----------
    n_exposures
        How many exposures are remembered.
    depth_span_mm
        Width of the range over which a new surface is as likely at any depth.
    """

    n_exposures: int = 40
    depth_span_mm: float = 60.0
    _kept: deque[FloatArray] = field(default_factory=deque)
    _tree: cKDTree | None = None

    def __len__(self) -> int:
        """Count of remembered points."""
        return sum(len(points) for points in self._kept)

    def forget(self) -> None:
        """Begin anew."""
        self._kept.clear()
        self._tree = None

    def remember(self, points_base_mm: FloatArray) -> None:
        """Add the points (N, 3) of an exposure, in the order of their stripes."""
        step = np.linalg.norm(np.diff(points_base_mm, axis=0, prepend=points_base_mm[:1]), axis=1)
        # a jump between stripes counts for one step, so that each stripe's first point is kept
        way = np.floor(np.cumsum(np.minimum(step, SPACING_MM)) / SPACING_MM)
        kept = points_base_mm[np.diff(way, prepend=-1.0) != 0]
        self._kept.append(kept)
        while len(self._kept) > self.n_exposures:
            self._kept.popleft()
        self._tree = None

    def evidence(
        self, points_sensor_mm: FloatArray, base_from_sensor: Pose[Base, Sensor]
    ) -> tuple[FloatArray, FloatArray]:
        """How well points (S, 3) of a new exposure continue what is known.

        Where the surface is known nearby, it is continued by a local plane with a weak prior on
        its slope, so that the prediction is the vaguer the further it reaches.

        Returns
        -------
        log_gain
            (S,) logarithm of the density of the point's depth over that of a new surface, which
            may be anywhere: 0 where nothing is known or the point does not fit.
        sharpness
            (S,) 1 for a prediction to within `SHARP_MM`, towards 0 the vaguer it is.
        """
        n = len(points_sensor_mm)
        gain, sharpness = np.zeros(n), np.zeros(n)
        if self._tree is None and len(self):
            self._tree = cKDTree(np.concatenate(self._kept))
        if self._tree is None or not n:
            return gain, sharpness
        in_sensor: Points[Sensor] = Points(points_sensor_mm)
        places = (base_from_sensor @ in_sensor).xyz_mm
        found = self._tree.query(places, k=N_NEAR, distance_upper_bound=REACH_MM)
        distance, index = np.asarray(found[0]), np.asarray(found[1])
        known = np.flatnonzero(np.isfinite(distance[:, 0]))
        if not len(known):
            return gain, sharpness
        distance = distance[known]
        is_near = np.isfinite(distance)
        near = self._tree.data[np.where(is_near, index[known], 0)] - places[known, None]
        offset, sigma = _continued(near @ base_from_sensor.rotation, distance, is_near)
        share = 1.0 + (offset / sigma) ** 2 / STUDENT
        peak = 2.0 / (np.pi * np.sqrt(STUDENT)) / sigma
        gain[known] = np.log1p(self.depth_span_mm * peak / share**2)
        sharpness[known] = 1.0 / (1.0 + (sigma / SHARP_MM) ** 2)
        return gain, sharpness


def _continued(
    near_mm: FloatArray, distance_mm: FloatArray, is_near: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Depth (S,) of the surface over each place, from its neighbours (S, K, 3), and its sigma."""
    bend = BEND_PER_MM * np.where(is_near, distance_mm, 0.0) ** 2
    weight = is_near / (NOISE_MM**2 + bend**2)
    x, y, z = np.moveaxis(np.where(is_near[..., None], near_mm, 0.0), 2, 0)
    design = np.stack([np.ones_like(x), x, y], axis=2)
    weighted = design * weight[..., None]
    normal = weighted.transpose(0, 2, 1) @ design
    normal[:, [1, 2], [1, 2]] += SLOPE**-2
    right = (weighted.transpose(0, 2, 1) @ z[..., None])[..., 0]
    covariance = np.linalg.inv(normal)
    offset = np.einsum("si,si->s", covariance[:, 0], right)
    return offset, np.sqrt(covariance[:, 0, 0] + NOISE_MM**2)
