# SPDX-License-Identifier: Apache-2.0
"""Parts of triangles: rays, normals and distances against shapes that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.simulation.objects.fixtures import Fixtures, made_workpiece
from armscan.simulation.objects.mesh import Mesh
from armscan.simulation.objects.shapes import Box
from armscan.simulation.twin import build_twin


def hull(points: FloatArray) -> FloatArray:
    """(T, 3, 3) triangles of a convex hull around the origin, seen from outside anticlockwise."""
    triangles = points[ConvexHull(points).simplices]
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = np.sum(across * triangles.mean(axis=1), axis=1) < 0.0
    triangles[inward] = triangles[inward][:, ::-1]
    return triangles


SIZE_MM = np.array([30.0, 20.0, 12.0])
CORNERS = np.array(np.meshgrid([-15, 15], [-10, 10], [0, 12])).reshape(3, -1).T.astype(float)
UP_MM = np.array([0.0, 0.0, 6.0])
BOX = Mesh(hull(CORNERS - UP_MM) + UP_MM)


def rays(n: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(2)
    starts = rng.normal(size=(n, 3))
    starts *= 80.0 / np.linalg.norm(starts, axis=1, keepdims=True)
    ways = rng.uniform([-20, -15, -5], [20, 15, 17], (n, 3)) - starts
    return starts, ways / np.linalg.norm(ways, axis=1, keepdims=True)


def test_rays_meet_a_box_of_triangles_where_they_meet_the_box() -> None:
    starts, ways = rays(3000)
    exact = Box(SIZE_MM).intersect(starts, ways)
    found = BOX.intersect(starts, ways)
    assert 0.3 < np.isfinite(exact).mean() < 0.95
    np.testing.assert_allclose(found, exact, atol=1e-9)
    met = np.isfinite(exact)
    points = starts[met] + found[met, None] * ways[met]
    np.testing.assert_allclose(BOX.normals(points), Box(SIZE_MM).normals(points), atol=1e-12)


def test_rays_along_the_axes_and_through_edges_are_not_lost() -> None:
    """A ray in the plane of a box of the tree, and one through a diagonal of two triangles."""
    up = np.array([[0.0, 0.0, -1.0]] * 4)
    starts = np.array(
        [[0.0, 0.0, 50.0], [15.0, 0.0, 50.0], [5.0, 10.0 / 3.0, 50.0], [0.0, 9.0, 50.0]]
    )
    np.testing.assert_allclose(BOX.intersect(starts, up), 38.0, atol=1e-12)


def test_a_ball_of_triangles_lies_between_its_corners_and_their_chords() -> None:
    golden = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(4000)
    z = np.linspace(-1.0, 1.0, 4000)
    wide = np.sqrt(1.0 - z * z)
    ball = Mesh(hull(10.0 * np.column_stack([wide * np.cos(golden), wide * np.sin(golden), z])))
    starts, ways = rays(2000)
    found = ball.intersect(starts, ways)
    met = np.isfinite(found)
    away = np.linalg.norm(starts[met] + found[met, None] * ways[met], axis=1)
    longest = np.linalg.norm(np.diff(ball.triangles_mm, axis=1), axis=2).max()
    # the sagitta of the longest edge, over its circumscribed triangle
    assert away.max() < 10.0 + 1e-9 and away.min() > 10.0 - longest**2 / (6.0 * 10.0) - 1e-9
    outside = np.linalg.norm(starts - np.sum(starts * ways, axis=1, keepdims=True) * ways, axis=1)
    assert not met[outside > 10.0].any() and met[outside < 9.9].all()


def test_distances_are_those_to_the_box() -> None:
    points = np.random.default_rng(3).uniform(-40.0, 40.0, (2000, 3))
    middle = points - [0.0, 0.0, 6.0]
    beyond = np.abs(middle) - 0.5 * SIZE_MM
    exact = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.abs(
        np.minimum(beyond.max(axis=1), 0.0)
    )
    np.testing.assert_allclose(BOX.distance_mm(points), exact, atol=1e-9)


@pytest.mark.parametrize("wrong", [np.zeros((0, 3, 3)), np.full((1, 3, 3), np.nan)])
def test_no_part_is_made_of_nothing(wrong: FloatArray) -> None:
    with pytest.raises(InputError):
        Mesh(wrong)


def test_the_workpiece_is_closed_and_made_with_its_two_faults() -> None:
    triangles = made_workpiece()
    edges = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    names = {
        corner: k for k, corner in enumerate(map(tuple, np.unique(edges.reshape(-1, 3), axis=0)))
    }
    pairs = sorted((names[tuple(a)], names[tuple(b)]) for a, b in edges)
    assert pairs == sorted((b, a) for a, b in pairs)
    corners = triangles.reshape(-1, 3)
    from_axis = np.hypot(corners[:, 0] + 18.0, corners[:, 1] - 12.0)
    bore = from_axis[(from_axis < 12.0) & (corners[:, 2] < 14.1)]
    np.testing.assert_allclose(bore, 10.025, atol=2e-5)
    over_pad = (np.abs(corners[:, 0] + 13.0) < 11.1) & (np.abs(corners[:, 1] + 16.0) < 8.1)
    assert np.isclose(corners[over_pad, 2].max(), 20.08, atol=1e-5)


def test_a_part_of_ones_own_stands_in_place_of_the_workpiece() -> None:
    fixtures = Fixtures.build("thesis", np.random.default_rng([1, 3]), BOX.triangles_mm)
    own = Fixtures.build("thesis", np.random.default_rng([1, 3]))
    middle = fixtures.base_from_workpiece.apply(np.array([0.0, 0.0, 0.0]))
    np.testing.assert_allclose(middle, own.base_from_workpiece.apply(np.zeros(3)), atol=1e-9)
    twin = build_twin("thesis-single", "thesis", 1, BOX.triangles_mm)
    stripes = [s for row in (15, 40, 75) for s in twin.scan("workpiece").true_stripes(row)]
    seen = np.concatenate([stripe.points_base_mm for stripe in stripes])
    assert len(seen) > 1000
    # as exact as the stripe's centre is looked for
    assert twin.truth.workpiece_distance_mm(seen).max() < 1e-5
