# SPDX-License-Identifier: Apache-2.0
"""Planes of a floor are found although a nearer thing stands among its stripes."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.reconstruction.label_stereo import depths_off, fit_planes

FLOOR_MM = 150.0
SLOPE = 0.004
"""Of the floor's depth to the right, mm a px."""
BLOCK_MM = 122.0


def stripes() -> tuple[FloatArray, FloatArray, IntArray]:
    """Samples of six stripes across a floor whose middle two lie on a block in front of it."""
    rng = np.random.default_rng(1)
    points, depth, number = [], [], []
    for k in range(6):
        y = np.linspace(0.0, 800.0, 100)
        x = 1000.0 + 60.0 * k + 0.2 * y
        on_block = k in (2, 3)
        z = np.full(100, BLOCK_MM) if on_block else FLOOR_MM + SLOPE * (x - 1000.0)
        points.append(np.column_stack([x, y]))
        depth.append(z + 0.01 * rng.standard_normal(100))
        number.append(np.full(100, k))
    return np.concatenate(points), np.concatenate(depth), np.concatenate(number)


def test_neighbours_on_a_nearer_thing_do_not_hide_the_floor() -> None:
    points, depth, number = stripes()
    planes = fit_planes(points, depth, number)
    assert set(planes.segment.tolist()) == set(range(6))
    on_floor = np.isin(number, (0, 1, 4, 5))
    of_floor = np.isin(planes.segment, (0, 1, 4, 5))
    off, sigma = depths_off(points[on_floor], depth[on_floor], planes)
    own = off[:, of_floor]
    assert np.abs(own).max() < 0.3
    assert (np.abs(own) < 5.0 * np.hypot(sigma[:, of_floor], 0.01)).mean() > 0.98
    assert np.abs(off[:, ~of_floor]).min() > 20.0
