# SPDX-License-Identifier: Apache-2.0
"""Shadows, Lambert's law, and what comes first along a ray."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.simulation.optics.lasers import LineLaser
from armscan.simulation.optics.scene import Floor, RoomLight, Scene, Sphere

WALL_MM = 400.0
BALL_MM = 20.0


def wall() -> Floor:
    return Floor(np.array([0.0, 0.0, WALL_MM]), np.array([0.0, 0.0, -1.0]), (0.6, 0.5, 0.4))


def ball() -> Sphere:
    return Sphere(np.array([0.0, 0.0, 200.0]), BALL_MM, (0.9, 0.9, 0.9))


def rays_to(
    points: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))


def test_the_nearer_surface_hides_the_farther() -> None:
    scene = Scene((wall(), ball()))
    hits = scene.trace(np.zeros(3), rays_to(np.array([[0.0, 0, 1], [0.3, 0, 1], [0, 0, -1.0]])))
    np.testing.assert_array_equal(hits.surface, [1, 0, -1])
    np.testing.assert_allclose(hits.points_mm[0], [0, 0, 200.0 - BALL_MM])
    np.testing.assert_allclose(hits.points_mm[1], [0.3 * WALL_MM, 0, WALL_MM])
    assert np.isinf(hits.distance_mm[2])


def test_a_ball_throws_the_shadow_that_its_tangent_cone_says() -> None:
    source = np.array([0.0, 0.0, 0.0])
    edge_mm = WALL_MM * np.tan(np.arcsin(BALL_MM / 200.0))
    x = edge_mm + np.array([-0.5, -0.05, 0.05, 0.5])
    points = np.stack([x, 0 * x, np.full_like(x, WALL_MM)], axis=1)
    seen = Scene((wall(), ball())).sees(source, points)
    np.testing.assert_array_equal(seen, [False, False, True, True])


def test_a_surface_does_not_shade_itself() -> None:
    scene = Scene((wall(), ball()))
    hits = scene.trace(np.zeros(3), rays_to(np.array([[0.02, 0.03, 1.0], [0.3, 0.1, 1.0]])))
    assert scene.sees(np.array([5.0, -5.0, 0.0]), hits.points_mm).all()


def test_laser_light_is_hidden_from_the_laser_although_the_camera_sees_the_place() -> None:
    laser = LineLaser(
        "A", np.array([-100.0, 0, 0]), np.array([100.0, 0, 200.0]), np.array([0.0, 1, 0])
    )
    # The fan's middle passes the ball's centre and would reach the wall at x = 100.
    behind = np.array([[100.0, 0.0, WALL_MM], [100.0, 120.0, WALL_MM]])
    scene = Scene((wall(), ball()), (laser,))
    hits = scene.trace(np.zeros(3), rays_to(behind))
    np.testing.assert_array_equal(hits.surface, [0, 0])
    shaded, lit = scene.laser_light(laser, hits)
    assert shaded == 0.0
    expected = laser.irradiance_at(behind[1:], np.array([[0.0, 0, -1.0]]))[0]
    assert lit == pytest.approx(0.6 * expected, rel=1e-9)


def test_room_light_is_the_even_part_plus_the_cosine_of_the_lamp() -> None:
    lamp = RoomLight(even=0.3, direct=0.5, position_mm=(0.0, -400.0, 0.0))
    scene = Scene((wall(),), lamp=lamp)
    hits = scene.trace(np.zeros(3), np.array([[0.0, 0.0, 1.0]]))
    # The wall is vertical: two thirds of the even part. The lamp stands 45 degrees up.
    expected = (0.3 * 2.0 / 3.0 + 0.5 * np.cos(np.pi / 4)) * np.array([0.6, 0.5, 0.4])
    np.testing.assert_allclose(scene.room_light(hits)[0], expected, rtol=1e-12)
    blocked = Scene((wall(), Sphere(np.array([0, -200.0, 200.0]), 30.0)), lamp=lamp)
    again = blocked.trace(np.zeros(3), np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(blocked.room_light(again)[0], 0.2 * np.array([0.6, 0.5, 0.4]))
