# SPDX-License-Identifier: Apache-2.0
"""Distances from a mesh, against formulas and against trimesh's own search."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from armscan.inspection.cad.distance import PartSurface, neighbour_order
from armscan.inspection.cad.part import PartModel, part_of
from rigs.parts import box_corners, sphere_part, wedge_part


def to_box(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Signed distance from a box about the origin."""
    over = np.abs(points) - half
    outside = np.linalg.norm(np.maximum(over, 0.0), axis=1)
    return outside + np.minimum(over.max(axis=1), 0.0)


def test_a_box_has_the_distances_of_its_formula() -> None:
    half = np.array([10.0, 4.0, 1.5])
    surface = PartSurface(part_of(box_corners(-half, half), source="box"))
    points = np.random.default_rng(1).uniform(-15.0, 15.0, (5000, 3))
    found = surface.distance(points)
    assert np.allclose(found.signed_mm, to_box(points, half), atol=1e-12)
    away = points - found.closest_mm
    assert np.allclose(np.linalg.norm(away, axis=1), np.abs(found.signed_mm), atol=1e-12)
    assert np.allclose(away, found.signed_mm[:, None] * found.normals, atol=1e-12)


def test_a_sphere_of_triangles_is_within_its_chord_of_the_sphere() -> None:
    radius, sides = 20.0, 120
    surface = PartSurface(sphere_part(radius, sides))
    chord = radius * (2.0 - np.cos(np.pi / sides) - np.cos(np.pi / (sides - 2)))
    points = np.random.default_rng(2).normal(size=(4000, 3)) * 20.0
    error = surface.distance(points).signed_mm - (np.linalg.norm(points, axis=1) - radius)
    assert error.min() > -1e-9
    assert error.max() < chord


def other_library(part: PartModel, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.Trimesh(part.vertices_mm, part.triangles, process=False)
    closest, distance, _ = trimesh.proximity.closest_point(mesh, points)
    return closest, distance


def test_the_closest_points_are_those_of_trimesh() -> None:
    part = sphere_part(15.0, 40)
    # a mesh with sharp edges inside and out, and triangles of very different sizes
    random = np.random.default_rng(3)
    bent = part.corners_mm * [1.0, 0.3, 2.0] + 2.0 * np.sin(part.corners_mm[:, :, ::-1])
    part = part_of(bent, source="bent")
    points = random.uniform(-25.0, 25.0, (1500, 3))
    found = PartSurface(part).distance(points)
    closest, distance = other_library(part, points)
    assert np.allclose(np.abs(found.signed_mm), distance, atol=1e-9)
    same = np.linalg.norm(closest - found.closest_mm, axis=1) < 1e-6
    assert same.mean() > 0.995  # the rest are as near to two places


@pytest.mark.parametrize("direction", [(1, 1, 1), (1, 1, 0), (1, -1, 0.001), (-1, 0.02, 0.3)])
def test_points_beside_edges_and_corners_know_outside(direction: tuple[float, ...]) -> None:
    """A face's own normal is wrong there for one in two: the corner is sharp."""
    corners = box_corners([-1, -1, -1.0], [1, 1, 1.0]) @ np.array(
        [[1, 0.9, 0], [0, 1, 0.9], [0, 0, 1.0]]
    )
    surface = PartSurface(part_of(corners, source="sheared"))
    mesh = trimesh.Trimesh(surface.part.vertices_mm, surface.part.triangles, process=False)
    tips = surface.part.vertices_mm + 1e-3 * np.random.default_rng(4).normal(size=(8, 3))
    points = np.concatenate([tips, 1.3 * np.array([direction])])
    inside = mesh.contains(points)
    assert np.array_equal(surface.distance(points).signed_mm < 0.0, inside)


def test_a_displaced_thin_wall_keeps_its_sides() -> None:
    """A wall 1 mm thick stands 0.8 mm off: its points lie nearer to the wrong side."""
    surface = PartSurface(part_of(box_corners([0, 0, 0.0], [50, 30, 1.0]), source="wall"))
    random = np.random.default_rng(5)
    points = np.column_stack(
        [random.uniform(5, 45, 200), random.uniform(5, 25, 200), np.zeros(200)]
    )
    points[:, 2] = np.repeat([0.8, 1.8], 100)
    normals = np.zeros((200, 3))
    normals[:, 2] = np.repeat([-1.0, 1.0], 100)
    without = surface.distance(points).signed_mm
    with_normals = surface.distance(points, towards=normals).signed_mm
    assert np.allclose(without[:100], -0.2)
    assert np.allclose(with_normals[:100], -0.8)
    assert np.allclose(with_normals[100:], 0.8)
    near = surface.distance(points, towards=normals, reach_mm=0.5).signed_mm
    assert np.allclose(near[:100], -0.2)
    # whoever saw them stood on their side, so that the wrong one was out of sight
    seen = surface.distance(points, towards=normals, sight=normals).signed_mm
    assert np.allclose(seen, with_normals)


def test_a_wrong_normal_takes_no_point_off_a_face_that_was_in_sight() -> None:
    """One stripe runs along the foot of a wall, and its normals point into the wall."""
    surface = PartSurface(part_of(box_corners([0, 0, 0.0], [50, 30, 20.0]), source="block"))
    points = np.column_stack([np.full(50, 50.01), np.linspace(5, 25, 50), np.full(50, 2.0)])
    normals = np.tile([-0.96, -0.18, -0.21], (50, 1))
    sight = np.tile([0.21, -0.07, 0.98], (50, 1))
    misled = surface.distance(points, towards=normals).signed_mm
    assert np.abs(misled).min() > 1.9
    found = surface.distance(points, towards=normals, sight=sight)
    assert np.allclose(found.signed_mm, 0.01)
    assert np.allclose(found.closest_mm[:, 0], 50.0)


def test_nothing_beyond_the_reach() -> None:
    surface = PartSurface(wedge_part())
    found = surface.distance(np.array([[40.0, 25.0, -3.0], [40.0, 25.0, -1.0]]), reach_mm=2.0)
    assert np.isnan(found.signed_mm[0])
    assert found.triangle[0] == -1
    assert found.signed_mm[1] == pytest.approx(1.0)


def test_the_order_of_points_changes_no_distance() -> None:
    """A walk begins with the triangle of the point before."""
    surface = PartSurface(wedge_part())
    points = np.random.default_rng(6).uniform(-10.0, 90.0, (9000, 3))
    shuffled = np.random.default_rng(7).permutation(9000)
    one = surface.distance(points).signed_mm
    other = surface.distance(points[shuffled]).signed_mm
    assert np.array_equal(one[shuffled], other)
    assert sorted(neighbour_order(points)) == list(range(9000))
