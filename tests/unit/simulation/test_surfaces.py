# SPDX-License-Identifier: Apache-2.0
"""Surfaces to shine on: planes, balls, boards and bodies of melted limbs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from armscan.errors import InputError
from armscan.geometry.poses import Board, Part, Pose, Sensor
from armscan.simulation.objects.boards import CirclePattern, PrintedBoard
from armscan.simulation.objects.body import (
    GRADIENT_STEP_MM,
    HIT_MM,
    Body,
    MetaballLimb,
    free_form_part,
)
from armscan.simulation.optics.scene import Floor, Sphere

POSE: Pose[Sensor, Part] = Pose.from_vectors([0.4, -0.7, 0.3], [10.0, -20.0, 300.0])
LIMBS = (
    MetaballLimb((0, 0, 0), (0, 40, 0), 20.0, 9.0),
    MetaballLimb((-25, 30, 0), (25, 34, 5), 6.0, 11.0, 8.0),
    MetaballLimb((0, 10, 16), (2, 12, 18), 7.0, 8.0, 3.0, is_hollow=True),
    MetaballLimb((0, 60, 0), (0, 60, 0), 12.0, 12.0, 0.0),
)


def distance_by_balls(limb: MetaballLimb, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """A limb is the union of balls along its axis: search for the nearest one."""
    share = np.linspace(0.0, 1.0, 4001)[:, None]
    centres = (1 - share) * np.array(limb.start_mm) + share * np.array(limb.end_mm)
    radii = (1 - share[:, 0]) * limb.start_radius_mm + share[:, 0] * limb.end_radius_mm
    gaps = np.linalg.norm(points[:, None] - centres, axis=2) - radii
    return np.asarray(gaps.min(axis=1))


def melted(limbs: tuple[MetaballLimb, ...], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Readable twin of the kernel."""
    total = distance_by_balls(limbs[0], points)
    for limb in limbs[1:]:
        other = distance_by_balls(limb, points)
        mine = -total if limb.is_hollow else total
        joined = np.minimum(mine, other)
        if limb.blend_mm > 0:
            overlap = np.clip(limb.blend_mm - np.abs(mine - other), 0, None)
            joined = joined - overlap**2 / (4 * limb.blend_mm)
        total = -joined if limb.is_hollow else joined
    return total


def rays_at_body(n: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    origins = np.tile([30.0, 20.0, 0.0], (n, 1))
    aim = POSE.translation_mm + rng.uniform(-60, 60, (n, 3))
    directions = aim - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_kernel_gives_the_distance_of_the_readable_twin() -> None:
    points = np.random.default_rng(1).uniform(-50, 70, (300, 3))
    sensor = points @ POSE.rotation.T + POSE.translation_mm
    expected = melted(LIMBS, points)
    # 4000 balls a limb: the nearest is missed by half a step, which matters in second order
    step_mm = 51.0 / 4000
    tolerance = step_mm**2
    np.testing.assert_allclose(Body(LIMBS, POSE).distance_mm(sensor), expected, atol=tolerance)


def test_rays_stop_at_the_first_point_of_the_surface() -> None:
    body = Body(LIMBS, POSE)
    origins, directions = rays_at_body(1500, 2)
    distance = body.intersect(origins, directions)
    is_hit = np.isfinite(distance)
    assert 200 < is_hit.sum() < 800
    at = origins + np.where(is_hit, distance, 0.0)[:, None] * directions
    assert np.abs(body.distance_mm(at[is_hit])).max() < 2 * HIT_MM
    for share in np.linspace(0.05, 0.999, 60):
        before = origins[is_hit] + share * distance[is_hit, None] * directions[is_hit]
        assert body.distance_mm(before).min() > -HIT_MM
    for along in np.linspace(200.0, 450.0, 120):
        assert body.distance_mm(origins[~is_hit] + along * directions[~is_hit]).min() > 0.0


def test_normals_are_the_gradient_and_face_the_ray() -> None:
    body = Body(LIMBS, POSE)
    origins, directions = rays_at_body(200, 3)
    distance = body.intersect(origins, directions)
    hit = np.isfinite(distance)
    at = origins[hit] + distance[hit, None] * directions[hit]
    normals = body.normals(at)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    outside = body.distance_mm(at + 0.01 * normals)
    assert np.median(outside) == pytest.approx(0.01, rel=1e-2)
    assert float(np.sum(normals * directions[hit], axis=1).max()) < 1e-2


def test_a_body_of_one_ball_is_a_sphere() -> None:
    ball = Body((MetaballLimb((1, 2, 3), (1, 2, 3), 25.0, 25.0),), POSE)
    centre = POSE.rotation @ [1.0, 2.0, 3.0] + POSE.translation_mm
    sphere = Sphere(centre, 25.0)
    origins, directions = rays_at_body(900, 4)
    far, exact = ball.intersect(origins, directions), sphere.intersect(origins, directions)
    agree = np.isfinite(exact)
    assert agree.sum() > 50
    np.testing.assert_array_equal(np.isfinite(far)[agree], True)
    steep = agree & (np.abs(exact - np.linalg.norm(centre - origins, axis=1)) < 60)
    np.testing.assert_allclose(far[steep], exact[steep], atol=0.02)
    at = origins[agree] + exact[agree, None] * directions[agree]
    np.testing.assert_allclose(ball.normals(at), sphere.normals(at), atol=GRADIENT_STEP_MM / 25.0)


def test_a_plane_is_met_where_similar_triangles_say_and_only_from_its_front() -> None:
    floor = Floor(np.array([0.0, 0.0, 100.0]), np.array([0.0, 0.0, -2.0]), (0.5, 0.5, 0.5))
    rays = np.array([[0.6, 0.0, 0.8], [0.0, 0.0, -1.0]])
    np.testing.assert_allclose(floor.intersect(np.zeros((2, 3)), rays), [125.0, np.inf])
    behind = np.array([[0.0, 0.0, 200.0]])
    assert np.isinf(floor.intersect(behind, np.array([[0.0, 0.0, -1.0]])))[0]


def test_a_board_ends_at_its_rim_and_shows_its_print() -> None:
    pattern = CirclePattern(3, 2, 10.0, 6.0)
    pose: Pose[Sensor, Board] = Pose(np.eye(3), np.array([0.0, 0.0, 200.0]))
    board = PrintedBoard(pattern, pose)
    on_board = np.array([[0, 0, 200.0], [5, 5, 200], [3.0, 0, 200], [29.9, 0, 200], [30.1, 0, 200]])
    distance = board.intersect(
        np.zeros((5, 3)), on_board / np.linalg.norm(on_board, axis=1)[:, None]
    )
    np.testing.assert_array_equal(np.isfinite(distance), [True, True, True, True, False])
    albedo = board.albedo(on_board[:3])[:, 0]
    np.testing.assert_allclose(albedo, [board.dark, board.light, 0.5 * (board.dark + board.light)])


def test_the_part_is_as_tall_as_its_limbs_say() -> None:
    down = np.array([[0.0, 0.0, -1.0]])
    top = 300.0 - free_form_part().intersect(np.array([[-22.0, 0.0, 300.0]]), down)[0]
    assert top == pytest.approx(17.0, abs=4.0)


def test_rays_hit_the_whole_part_and_not_some_of_its_limbs() -> None:
    """The kernel asks only the limbs near a ray; the others must not matter where it stops."""
    body = replace(free_form_part(), sensor_from_part=POSE)
    rng = np.random.default_rng(6)
    aim = rng.uniform([-50, -30, -20], [50, 30, 20], (3000, 3)) @ POSE.rotation.T
    rays = aim + POSE.translation_mm
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance = body.intersect(np.zeros((3000, 3)), rays)
    hit = np.isfinite(distance)
    assert hit.sum() > 1500
    assert np.abs(body.distance_mm(distance[hit, None] * rays[hit])).max() < 2 * HIT_MM
    for along in np.linspace(150.0, 550.0, 200):
        assert body.distance_mm(along * rays[~hit]).min() > -HIT_MM


def test_impossible_limbs_are_refused() -> None:
    with pytest.raises(InputError, match="positive radii"):
        MetaballLimb((0, 0, 0), (0, 1, 0), 0.0, 1.0)
    with pytest.raises(InputError, match="swallows"):
        MetaballLimb((0, 0, 0), (0, 1, 0), 5.0, 1.0)
    with pytest.raises(InputError, match="must be solid"):
        Body((MetaballLimb((0, 0, 0), (0, 1, 0), 1.0, 1.0, is_hollow=True),), POSE)
    with pytest.raises(InputError, match="sphere of radius"):
        Sphere(np.zeros(3), -1.0)


def test_rays_along_a_body_neither_stop_before_it_nor_cut_through_it() -> None:
    """Rays that nearly touch: where they must hit is known from dense samples of the distance."""
    pose: Pose[Sensor, Part] = Pose(np.eye(3), np.zeros(3))
    body = Body(
        (
            MetaballLimb((-30, 0, 0), (30, 0, 0), 9.0, 12.0),
            MetaballLimb((5, 6, 4), (9, 8, 6), 7, 7, 9),
        ),
        pose,
    )
    rng = np.random.default_rng(4)
    origins = np.column_stack(
        [np.full(400, -150.0), rng.uniform(-2, 22, 400), rng.uniform(6, 18, 400)]
    )
    directions = np.tile([1.0, 0.0, 0.0], (400, 1)) + 0.02 * rng.standard_normal((400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    travelled = body.intersect(origins, directions)
    along = np.arange(90.0, 210.0, 0.02)
    n_hits = 0
    for origin, direction, reached in zip(origins, directions, travelled, strict=True):
        gaps = body.distance_mm(origin + along[:, None] * direction)
        before = gaps[along < min(reached, along[-1]) - 0.02]
        assert before.min() > -1e-4
        if np.isfinite(reached):
            n_hits += 1
            assert abs(body.distance_mm((origin + reached * direction)[None])[0]) < HIT_MM
    assert 100 < n_hits < 380
