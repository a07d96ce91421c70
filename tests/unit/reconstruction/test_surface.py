# SPDX-License-Identifier: Apache-2.0
"""Triangles over a cloud: where they lie, which way they face, and what they leave open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.reconstruction.surface import (
    ScannedSurface,
    SurfaceOptions,
    draw_surface,
    thinned_surface,
)
from armscan.records.cloud import PointCloud
from armscan.storage.parts.meshes import encoded_surface

SIGMA_MM = 0.01
RADIUS_MM = 12.0


def cloud_of(points: FloatArray, normals: FloatArray | None, seed: int = 0) -> PointCloud:
    noise = SIGMA_MM * np.random.default_rng(seed).standard_normal(len(points))
    n = len(points)
    return PointCloud(
        frame="Base",
        points_mm=points if normals is None else points + noise[:, None] * normals,
        covariance_mm2=np.tile(SIGMA_MM**2 * np.eye(3), (n, 1, 1)),
        sigma_noise_mm=np.full(n, SIGMA_MM),
        sheet=np.zeros(n, np.int64),
        sheet_names=("A",),
        exposure=np.arange(n) // 200,
        exposure_sources=tuple(f"{k}.png" for k in range(n // 200 + 1)),
        segment=np.zeros(n, np.int64),
        intensity=np.full(n, 100.0),
        normals=normals,
    )


def ball(n: int = 20_000) -> FloatArray:
    """(N, 3) unit directions, evenly spread, in order of height as a scan goes."""
    z = 1.0 - 2.0 * (np.arange(n) + 0.5) / n
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(n)
    wide = np.sqrt(1.0 - z * z)
    return np.column_stack([wide * np.cos(turn), wide * np.sin(turn), z])


def volume(surface: ScannedSurface) -> float:
    a, b, c = (surface.vertices_mm[surface.triangles[:, k]] for k in range(3))
    return float(np.sum(np.cross(a, b) * c) / 6.0)


def test_a_ball_is_closed_over_many_blocks_and_faces_outwards() -> None:
    """At 0.15 mm a cell the ball is 160 cells wide: three blocks of 64 along each axis."""
    directions = ball(60_000)
    cloud = cloud_of(RADIUS_MM * directions + [5.0, -3.0, 100.0], directions)
    surface = draw_surface(cloud, SurfaceOptions(cell_mm=0.3))
    fine = draw_surface(cloud, SurfaceOptions(cell_mm=0.15))
    for drawn in (surface, fine):
        assert drawn.n_border_edges == 0
        centred = drawn.vertices_mm - [5.0, -3.0, 100.0]
        away = np.linalg.norm(centred, axis=1) - RADIUS_MM
        # tangent planes lie over a round face: under a Gaussian of sigma by sigma^2 / R on average
        higher = (0.75 * drawn.cell_mm) ** 2 / RADIUS_MM
        assert np.abs(away).max() < 5.0 * SIGMA_MM
        assert 0.7 * higher < away.mean() < 1.1 * higher
        assert np.isclose(volume(drawn), 4.0 / 3.0 * np.pi * RADIUS_MM**3, rtol=3e-3)
    # more points a cell average more noise away
    spread = [
        np.std(np.linalg.norm(one.vertices_mm - [5.0, -3.0, 100.0], axis=1))
        for one in (surface, fine)
    ]
    assert spread[0] < 0.6 * SIGMA_MM and spread[0] < spread[1]


def flat_with_hole(hole_mm: float) -> tuple[FloatArray, FloatArray]:
    x, y = np.meshgrid(np.arange(0.0, 30.0, 0.1), np.arange(0.0, 20.0, 0.25))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    points = points[np.hypot(points[:, 0] - 15.0, points[:, 1] - 10.0) > 0.5 * hole_mm]
    return points, np.tile([0.0, 0.0, 1.0], (len(points), 1))


def test_a_hole_stays_open_and_nothing_reaches_beyond_the_points() -> None:
    points, normals = flat_with_hole(5.0)
    surface = draw_surface(cloud_of(points, normals), SurfaceOptions(cell_mm=0.5, reach_mm=0.4))
    from_axis = np.hypot(*(surface.vertices_mm[:, :2] - [15.0, 10.0]).T)
    assert 2.5 - 0.4 < from_axis.min() < 2.5 + 0.5
    assert surface.vertices_mm[:, 0].max() < 29.9 + 0.4
    measured = 30.0 * 20.0 - np.pi * 2.5**2
    # a cell may be missing along the rims, 116 mm long, or a border beyond them
    assert abs(surface.area_mm2 - measured) < 116.0 * 0.5
    assert np.abs(surface.vertices_mm[:, 2]).max() < 4.0 * SIGMA_MM


def test_two_sides_of_a_thin_wall_stay_apart() -> None:
    points, normals = flat_with_hole(0.0)
    wall = np.concatenate([points, points - [0.0, 0.0, 2.0]])
    both = cloud_of(wall, np.concatenate([normals, -normals]))
    surface = draw_surface(both, SurfaceOptions(cell_mm=0.5))
    height = surface.vertices_mm[:, 2]
    assert np.minimum(np.abs(height), np.abs(height + 2.0)).max() < 4.0 * SIGMA_MM
    assert 0.45 < (height > -1.0).mean() < 0.55


def test_points_of_small_sigma_weigh_more() -> None:
    """Two passes 0.04 mm apart, one three times as good: the surface lies a tenth from it."""
    points, normals = flat_with_hole(0.0)
    n, up = len(points), np.array([0.0, 0.0, 0.04])
    both = cloud_of(np.concatenate([points, points + up]), np.tile(normals, (2, 1)))
    sigma = np.repeat([0.001, 0.003], n)
    exact = np.concatenate([points, points + up])
    weighed = replace(both, points_mm=exact, sigma_noise_mm=sigma)
    surface = draw_surface(weighed, SurfaceOptions(cell_mm=0.5))
    # the nodes are nearer to the one than to the other by 0.04 mm in a Gaussian of 0.375 mm
    np.testing.assert_allclose(surface.vertices_mm[:, 2], 0.004, atol=2e-4)


def test_the_cell_follows_from_the_distance_of_the_lines() -> None:
    points, normals = flat_with_hole(0.0)
    lines = cloud_of(points, normals)
    number = np.rint(points[:, 1] / 0.25).astype(np.int64)
    lines = replace(lines, exposure=number, exposure_sources=tuple(map(str, range(81))))
    surface = draw_surface(lines)
    assert np.isclose(surface.cell_mm, 0.25, atol=0.02)
    assert surface.reach_mm == surface.cell_mm


def test_points_without_normals_are_left_out_and_counted() -> None:
    points, normals = flat_with_hole(0.0)
    normals[::3] = 0.0
    surface = draw_surface(cloud_of(points, normals), SurfaceOptions(cell_mm=0.5))
    assert surface.n_without_normal == len(normals[::3])
    assert surface.n_points + surface.n_without_normal == len(points)
    with pytest.raises(EstimationError, match="no point has a normal"):
        draw_surface(cloud_of(points, None))


def test_what_cannot_be_drawn_is_refused() -> None:
    points, normals = flat_with_hole(0.0)
    corner = points.max(axis=1) < 3.0
    points, normals = points[corner], normals[corner]
    cloud = cloud_of(points, normals)
    with pytest.raises(EstimationError, match="too far apart"):
        draw_surface(cloud, SurfaceOptions(cell_mm=0.03))
    whole = cloud_of(*flat_with_hole(0.0))
    for cell_mm in (0.003, 1e-6):
        with pytest.raises(EstimationError, match="cells lie near the points"):
            draw_surface(whole, SurfaceOptions(cell_mm=cell_mm))
    with pytest.raises(EstimationError, match=r"is large beside the 29\.9 mm"):
        draw_surface(whole, SurfaceOptions(cell_mm=500.0))
    with pytest.raises(EstimationError, match="no surface"):
        draw_surface(cloud_of(points[:3], normals[:3]))
    for wrong in (0.0, -1.0, np.nan):
        with pytest.raises(OptionError):
            SurfaceOptions(cell_mm=wrong)


def test_a_flat_face_keeps_its_place_when_it_is_thinned() -> None:
    points, normals = flat_with_hole(5.0)
    full = draw_surface(cloud_of(points, normals), SurfaceOptions(cell_mm=0.5))
    few = thinned_surface(full, 400, points)
    away = cKDTree(points).query(few.vertices_mm)[0]
    assert away.max() <= full.reach_mm + 5.0 * SIGMA_MM
    assert 150 < len(few.triangles) <= 440 < len(full.triangles)
    assert np.abs(few.vertices_mm[:, 2]).max() < 5.0 * SIGMA_MM
    assert np.isclose(few.area_mm2, full.area_mm2, rtol=0.02)


@pytest.mark.parametrize("suffix", [".stl", ".ply"])
def test_files_hold_what_another_program_reads(suffix: str) -> None:
    """Read by hand from the formats' definitions."""
    vertices = np.array([[0.0, 0.0, 0.0], [600.123, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]])
    triangles = np.array([[0, 2, 1], [0, 1, 3]])
    data = encoded_surface(suffix, vertices, triangles, "solid or not")
    if suffix == ".ply":
        head, _, body = data.partition(b"end_header\n")
        assert b"element vertex 4\n" in head and b"element face 2\n" in head
        assert np.array_equal(np.frombuffer(body[: 4 * 24], "<f8").reshape(4, 3), vertices)
        assert body[96] == 3 and np.array_equal(np.frombuffer(body[97:109], "<i4"), triangles[0])
        return
    assert not data.startswith(b"solid")
    assert int.from_bytes(data[80:84], "little") == 2 and len(data) == 84 + 2 * 50
    facet = np.frombuffer(data[84:132], "<f4").reshape(4, 3)
    np.testing.assert_array_equal(facet[0], [0.0, 0.0, -1.0])
    np.testing.assert_allclose(facet[1:], vertices[triangles[0]], rtol=1e-7)
