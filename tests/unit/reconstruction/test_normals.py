# SPDX-License-Identifier: Apache-2.0
"""Normals of surfaces whose normals are known, scanned in lines."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.reconstruction.place import (
    LARGEST_RADIUS_MM,
    SMALLEST_RADIUS_MM,
    choose_radius_mm,
    estimate_normals,
)

NOISE_MM = 0.01
RADIUS_MM = 17.48


def lines(gap_mm: float, extent_mm: float = 12.0) -> FloatArray:
    """(N, 2): points every 0.05 mm along x on lines a gap apart."""
    x, y = np.meshgrid(np.arange(0.0, extent_mm, 0.05), np.arange(0.0, extent_mm, gap_mm))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def angles_deg(normals: FloatArray, truth: FloatArray) -> FloatArray:
    cosine = np.einsum("ni,ni->n", normals, np.broadcast_to(truth, normals.shape))
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def test_a_tilted_plane_scanned_in_lines() -> None:
    """A tangent of half the radius and 20 cells: noise 0.01 mm tilts it by 0.1 degrees or so."""
    flat = lines(0.8)
    normal = np.array([0.4, -0.3, 0.87]) / np.linalg.norm([0.4, -0.3, 0.87])
    height = -(flat @ normal[:2]) / normal[2]
    points = np.column_stack([flat, height])
    points += np.random.default_rng(0).normal(0.0, NOISE_MM, points.shape)
    above = estimate_normals(points, np.tile([0.0, 0.0, 140.0], (len(points), 1)))
    assert np.percentile(angles_deg(above, normal), 99) < np.degrees(3.0 * NOISE_MM / 1.0)
    below = estimate_normals(points, np.tile([0.0, 0.0, -140.0], (len(points), 1)))
    np.testing.assert_allclose(below, -above, atol=0.0)


def test_a_ball_seen_from_two_sides() -> None:
    """Each point's normal points out, to the sensor that saw it, within a degree or two."""
    flat = lines(0.5, 16.0) - 8.0
    cap = np.column_stack([flat, np.sqrt(RADIUS_MM**2 - (flat**2).sum(axis=1))])
    other = cap * [1.0, 1.0, -1.0]
    points = np.concatenate([cap, other])
    points += np.random.default_rng(1).normal(0.0, NOISE_MM, points.shape)
    seen = np.sign(points[:, 2:]) * [0.0, 0.0, 150.0]
    normals = estimate_normals(points, seen)
    truth = points / np.linalg.norm(points, axis=1, keepdims=True)
    angle = angles_deg(normals, truth)
    assert np.median(angle) < 0.5
    assert np.percentile(angle, 95) < 2.0


def by_numpy(points: FloatArray, radius_mm: float) -> FloatArray:
    """(N, 3) least axes of the 32 nearest means of cells of a quarter of the radius, unsigned."""
    cell = np.floor((points - points.min(axis=0)) / (radius_mm / 4.0)).astype(np.int64)
    _, member, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(member.ravel(), axis) for axis in points.T], axis=1)
    means /= count[:, None]
    found = np.zeros_like(points)
    for k, point in enumerate(points):
        distance, near = cKDTree(means).query(point, k=32, distance_upper_bound=radius_mm)
        around = means[near[np.isfinite(distance)]]
        if len(around) >= 6:
            values, axes = np.linalg.eigh(np.cov(around.T, bias=True))
            thickness, width = np.sqrt(np.maximum(values[:2], 0.0))
            if width >= 0.15 * radius_mm and thickness <= 0.5 * width:
                found[k] = axes[:, 0]
    return found


def test_they_are_those_of_a_tree_and_of_eigenvectors() -> None:
    """A dense bent face, of which the nearest 32 cells count, and a slab that is nearly too thick.

    Rounding of squares of 100 mm moves a direction by 1e-10.
    """
    rng = np.random.default_rng(3)
    flat = rng.uniform(-6.0, 6.0, (600, 2))
    bent = np.column_stack([flat, 0.05 * flat[:, 0] ** 2 + rng.normal(0.0, 0.02, 600)])
    slab = rng.uniform(6.0, [12.0, 12.0, 7.4], (400, 3))
    points = np.concatenate([bent, slab]) + 100.0
    wanted = by_numpy(points, 3.0)
    found = estimate_normals(points, points + wanted, 3.0)
    assert 600 < wanted.any(axis=1).sum() < 1000
    np.testing.assert_allclose(found, wanted, atol=1e-10)


def test_where_there_is_no_tangent_plane_the_normal_is_zero() -> None:
    line = np.column_stack([np.arange(0.0, 10.0, 0.02), np.zeros(500), np.zeros(500)])
    few = np.array([[100.0, 0.0, 0.0], [100.5, 1.0, 0.0], [101.0, 0.3, 0.0]])
    blob = 200.0 + np.random.default_rng(2).normal(0.0, 0.7, (400, 3))
    points = np.concatenate([line, few, blob])
    normals = estimate_normals(points, points + np.array([0.0, 0.0, 140.0]))
    assert not normals[:503].any()
    lengths = np.linalg.norm(normals, axis=1)
    assert np.isfinite(normals).all()
    assert (lengths[503:] == 0.0).mean() > 0.9
    assert np.isin(np.round(lengths, 12), [0.0, 1.0]).all()


def test_lines_of_a_quick_sweep_need_a_wider_radius() -> None:
    flat = lines(3.0, 24.0)
    points = np.column_stack([flat, np.zeros(len(flat))])
    seen = np.tile([0.0, 0.0, 140.0], (len(points), 1))
    assert not estimate_normals(points, seen).any()
    wide = estimate_normals(points, seen, 6.0)
    np.testing.assert_allclose(wide, np.tile([0.0, 0.0, 1.0], (len(points), 1)), atol=1e-9)


def test_the_radius_follows_the_distance_between_exposures() -> None:
    """Lines 3 mm apart, one an exposure: 2.5 spacings; dense or lonely ones meet the limits."""
    for gap, expected in ((3.0, 7.5), (5.0, 12.5), (0.2, 2.0)):
        flat = lines(gap, 48.0)
        points = np.column_stack([flat, np.zeros(len(flat))])
        exposure = np.round(flat[:, 1] / gap).astype(np.int64)
        found = choose_radius_mm(points, exposure)
        assert found == pytest.approx(expected, rel=0.05)
    one = np.zeros(len(points), dtype=np.int64)
    assert choose_radius_mm(points, one) == LARGEST_RADIUS_MM
    assert choose_radius_mm(np.zeros((0, 3)), np.zeros(0, dtype=np.int64)) == SMALLEST_RADIUS_MM


def test_no_points_and_wrong_shapes() -> None:
    assert estimate_normals(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0, 3)
    with pytest.raises(InputError, match="shape"):
        estimate_normals(np.zeros((2, 3)), np.zeros((1, 3)))
