# SPDX-License-Identifier: Apache-2.0
"""Planes of a floor are found although a nearer thing stands among its stripes."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.reconstruction.label_stereo import (
    KNOWN_MM,
    ON_MM,
    SCALE_PX,
    SIGMAS,
    Planes,
    fit_planes,
    surface_distance,
)

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


def depths_off(
    points_px: FloatArray, depth_mm: FloatArray, planes: Planes
) -> tuple[FloatArray, FloatArray]:
    """How far points are off each plane in depth (N, B), mm, and its standard deviation (N, B)."""
    place = (points_px[:, None, :] - planes.middle_px[None, :, :]) / SCALE_PX
    design = np.concatenate([np.ones((*place.shape[:2], 1)), place], axis=2)
    expected = np.einsum("nbj,bj->nb", design, planes.inverse)
    variance = np.einsum("nbj,bjk,nbk->nb", design, planes.covariance, design)
    square = depth_mm[:, None] ** 2
    return (expected - 1.0 / depth_mm[:, None]) * square, np.sqrt(variance) * square


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


def test_distances_are_those_of_each_segment_on_each_sheet_by_itself() -> None:
    """Every other sample is on sheet 0 and on sheet 2 besides, there at random depths.

    A sum of signed distances, a plane of the segment itself, or a covariance read in another order
    would each differ.
    """
    points, depth, number = stripes()
    planes = fit_planes(points, depth, number)
    rng = np.random.default_rng(7)
    some = np.arange(0, len(points), 2)
    points = np.concatenate([points, points[some]])
    segment = np.concatenate([number, number[some]])
    sheet = np.concatenate([np.zeros(len(number), np.int64), np.full(len(some), 2)])
    depth = np.concatenate([depth, depth[some] + rng.normal(0.0, 0.4, len(some))])
    found, is_on = surface_distance(points, depth, segment, sheet, planes, shape=(7, 3))
    off, sigma = depths_off(points, depth, planes)
    for b in range(7):
        for k in range(3):
            rows = (segment == b) & (sheet == k)
            others = planes.segment != b
            if not rows.any():
                assert np.isinf(found[b, k])
                assert not is_on[b, k]
                continue
            mean = np.abs(off[rows]).mean(axis=0)
            std = sigma[rows].mean(axis=0)
            known = others & (std < KNOWN_MM)
            expected = mean[known].min() if known.any() else np.inf
            np.testing.assert_allclose(found[b, k], expected, rtol=1e-9)
            assert is_on[b, k] == (known & (mean <= np.maximum(ON_MM, SIGMAS * std))).any()
    assert is_on.any()
    assert np.isfinite(found[:, 2]).any()
