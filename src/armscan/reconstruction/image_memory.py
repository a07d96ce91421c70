# SPDX-License-Identifier: Apache-2.0
"""Where the last exposures of a pass showed each laser's stripe in the image."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import FloatArray, IntArray

REACH_PX = 60.0
"""A stripe is not looked for further from where it is expected."""
SIGMA_PX = 5.0
"""Of the expected place across the stripe; a hand's acceleration and the surface's shape."""
STUDENT = 3.0
WINDOW_PX = 600.0
"""A stripe of which nothing is known may be anywhere over about this width."""
SHARPNESS = 0.15
"""What the prediction errs by is nearly the same all along a stripe."""
STIFFNESS = 20.0
"""Points' worth of belief that a stripe stands still, so that its motion is always determined."""


@dataclass(frozen=True, slots=True, eq=False)
class _Stripe:
    points_px: FloatArray
    normals_px: FloatArray
    motion_px: FloatArray


@dataclass(slots=True, eq=False)
class ImageMemory:
    """The last stripe of each sheet with its motion from the one before."""

    _last: dict[int, _Stripe] = field(default_factory=dict)

    def forget(self) -> None:
        """Begin anew."""
        self._last.clear()

    def remember(self, points_px: FloatArray, normals_px: FloatArray, sheet: IntArray) -> None:
        """Take in the named points (N, 2) of an exposure, their normals and sheets (N,)."""
        for k in np.unique(sheet).tolist():
            own = sheet == k
            motion = self._motion(k, points_px[own], normals_px[own])
            self._last[k] = _Stripe(points_px[own], normals_px[own], motion)

    def log_gain(self, points_px: FloatArray, sheet: int) -> FloatArray:
        """How well new points (S, 2) continue a sheet's stripe.

        The logarithm (S,) of the density of their place, if they are of the sheet, over that of
        something new, which may be anywhere: 0 where nothing is expected.
        """
        gain = np.zeros(len(points_px))
        if sheet not in self._last or not len(points_px):
            return gain
        last = self._last[sheet]
        distance, index = _nearest(last, points_px)
        known = np.flatnonzero(distance < REACH_PX)
        place = last.points_px[index[known]] + last.motion_px
        across = np.einsum("ni,ni->n", points_px[known] - place, last.normals_px[index[known]])
        share = 1.0 + (across / SIGMA_PX) ** 2 / STUDENT
        peak = 2.0 / (np.pi * np.sqrt(STUDENT)) / SIGMA_PX
        gain[known] = np.log1p(WINDOW_PX * peak / share**2)
        return gain

    def _motion(self, sheet: int, points: FloatArray, normals: FloatArray) -> FloatArray:
        """(2,) motion since the last image: only its part across the stripe can be seen."""
        if sheet not in self._last:
            return np.zeros(2)
        last = self._last[sheet]
        distance, index = _nearest(last, points)
        near = distance < REACH_PX
        n = normals[near]
        step = np.einsum("ni,ni->n", points[near] - last.points_px[index[near]], n)
        return np.asarray(np.linalg.solve(n.T @ n + STIFFNESS * np.eye(2), n.T @ step))


def _nearest(last: _Stripe, points_px: FloatArray) -> tuple[FloatArray, IntArray]:
    """Distance (N,) to the nearest point of a stripe that moved on, and its index."""
    found = cKDTree(last.points_px + last.motion_px).query(points_px)
    return np.asarray(found[0]), np.asarray(found[1])
