# SPDX-License-Identifier: Apache-2.0
"""Blocks, plates and their places in a scene, against geometry done by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from armscan.errors import InputError
from armscan.geometry.poses import Base, Part, Pose
from armscan.simulation.objects.shapes import Box, FlatPlate, Placed
from armscan.simulation.optics.scene import Material, SceneObject, Sphere

SOLIDS: dict[str, Box | Sphere | FlatPlate] = {
    "box": Box(np.array([30.0, 9.0, 20.0])),
    "ball": Sphere(np.array([1.0, 2.0, 10.0]), 17.48),
    "plate": FlatPlate.draw((200.0, 150.0), 0.015, np.random.default_rng(3)),
}


def rays_at(middle: float, n: int = 4000) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays from above and around to points near the middle of a shape."""
    rng = np.random.default_rng(7)
    origins = rng.normal(size=(n, 3)) * 40.0
    origins[:, 2] = np.abs(origins[:, 2]) + 60.0
    aims = rng.normal(size=(n, 3)) * 9.0 + [0.0, 0.0, middle]
    directions = aims - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("name", SOLIDS)
def test_rays_stop_on_the_surface_and_nowhere_before(name: str) -> None:
    solid = SOLIDS[name]
    origins, directions = rays_at(10.0)
    distance = solid.intersect(origins, directions)
    hit = np.isfinite(distance)
    assert 0.05 * len(hit) < hit.sum()
    points = origins[hit] + distance[hit, None] * directions[hit]
    # one step from the plane to the wavy face leaves nanometres on grazing rays
    assert np.abs(solid.distance_mm(points)).max() < 5e-6
    for share in np.linspace(0.05, 0.999, 40):
        before = origins[hit] + share * distance[hit, None] * directions[hit]
        assert solid.distance_mm(before).min() > 0.0


@pytest.mark.parametrize("name", ["box", "ball"])
def test_rays_that_miss_never_come_inside(name: str) -> None:
    solid = SOLIDS[name]
    origins, directions = rays_at(10.0)
    missed = ~np.isfinite(solid.intersect(origins, directions))
    assert missed.any()
    for along in np.linspace(20.0, 250.0, 460):
        points = origins[missed] + along * directions[missed]
        assert solid.distance_mm(points).min() > -1e-9


@pytest.mark.parametrize("name", SOLIDS)
def test_normals_are_the_gradient_of_the_distance(name: str) -> None:
    solid = SOLIDS[name]
    origins, directions = rays_at(10.0, 300)
    distance = solid.intersect(origins, directions)
    hit = np.isfinite(distance)
    normals = solid.normals(origins[hit] + distance[hit, None] * directions[hit])
    # 1 micrometre outside, so that no edge of a box or bar lies within the step
    points = origins[hit] + distance[hit, None] * directions[hit] + 1e-3 * normals
    step = 1e-4
    gradient = np.stack(
        [
            (solid.distance_mm(points + step * e) - solid.distance_mm(points - step * e))
            / (2.0 * step)
            for e in np.eye(3)
        ],
        axis=1,
    )
    np.testing.assert_allclose(normals, gradient, atol=1e-5)


def test_a_box_is_known_at_its_faces_edges_and_corners() -> None:
    box = Box(np.array([30.0, 9.0, 20.0]))
    points = np.array(
        [[0, 0, 25], [18, 0, 10], [18, 8.5, 10], [0, 0, 19], [18, 8.5, 32], [0, 4.0, 10]], float
    )
    by_hand = [5.0, 3.0, 5.0, -1.0, 13.0, -0.5]
    np.testing.assert_allclose(box.distance_mm(points), by_hand, atol=1e-12)


def test_a_placed_shape_turns_with_its_frame() -> None:
    pose: Pose[Base, Part] = Pose.from_vectors([0.0, 0.0, np.pi / 2.0], [100.0, 50.0, 5.0])
    placed = Placed(Box(np.array([30.0, 9.0, 20.0])), pose)
    down = np.array([[0.0, 0.0, -1.0]])
    # the block's length now lies along y
    for dx, dy, hits in ((0, 14, True), (0, 16, False), (4, 0, True), (5, 0, False)):
        distance = placed.intersect(np.array([[100.0 + dx, 50.0 + dy, 125.0]]), down)[0]
        assert distance == (pytest.approx(100.0) if hits else np.inf)
    side = np.array([[104.5, 50.0, 15.0]])
    np.testing.assert_allclose(placed.normals(side), [[1.0, 0.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_plates_heights_span_the_flatness_about_its_best_plane(seed: int) -> None:
    plate = FlatPlate.draw((200.0, 150.0), 0.015, np.random.default_rng(seed))
    x, y = np.meshgrid(np.linspace(-100, 100, 201), np.linspace(-75, 75, 151))
    height = plate.height_mm(x.ravel(), y.ravel())
    assert np.ptp(height) == pytest.approx(0.015, rel=0.02)
    basis = np.stack([np.ones(x.size), x.ravel() / 100.0, y.ravel() / 75.0], axis=1)
    fitted = np.linalg.lstsq(basis, height, rcond=None)[0]
    assert np.abs(fitted).max() < 0.015 * 0.01
    # smooth over tens of mm: a parabola over 10 mm leaves next to nothing
    rows = height.reshape(x.shape)[::25, ::1]
    bend = rows[:, 10:] - 2.0 * rows[:, 5:-5] + rows[:, :-10]
    assert np.abs(bend).max() < 0.2 * 0.015
    # and it is not a mere bowl: the heights forget themselves within the plate
    flat = rows - rows.mean(axis=1, keepdims=True)
    correlation = (flat[:, :-60] * flat[:, 60:]).mean() / (flat * flat).mean()
    assert correlation < 0.6


def test_a_perfect_plate_is_a_plane_with_sharp_ends() -> None:
    plate = FlatPlate(np.array([200.0, 150.0]))
    origins = np.array([[99.0, 74.0, 30.0], [101.0, 0.0, 30.0], [0.0, 76.0, 30.0], [0, 0, -30.0]])
    directions = np.array([[0, 0, -1.0]] * 3 + [[0, 0, 1.0]])
    distance = plate.intersect(origins, directions)
    np.testing.assert_array_equal(distance, [30.0, np.inf, np.inf, np.inf])


def test_texture_has_its_contrast_and_grain_and_stays_on_the_thing() -> None:
    finish = Material(texture=0.1, texture_mm=0.5)
    thing = SceneObject(
        "plate", FlatPlate(np.array([200.0, 150.0]), colour=(0.5, 0.5, 0.5)), finish
    )
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-60, 60, (20000, 2)), np.zeros(20000)])
    albedo = thing.albedo(points)[:, 0]
    assert albedo.mean() == pytest.approx(0.5, rel=0.01)
    assert albedo.std() / albedo.mean() == pytest.approx(0.1, rel=0.05)
    factor = thing.texture_factor
    near = np.corrcoef(factor(points), factor(points + np.array([0.1, 0.0, 0.0])))[0, 1]
    far = np.corrcoef(factor(points), factor(points + np.array([1.5, 0.0, 0.0])))[0, 1]
    assert near > 0.8
    assert abs(far) < 0.05
    np.testing.assert_array_equal(thing.albedo(points)[:, 0], albedo)
    assert finish.scaled(2.0, 0.0) == Material(texture=0.0, texture_mm=0.5)


def test_shapes_without_size_are_refused() -> None:
    for make in (
        lambda: Box(np.array([1.0, 0.0, 1.0])),
        lambda: FlatPlate(np.array([-1.0, 1.0])),
        lambda: Material(gloss=-1.0),
        lambda: Material(texture_mm=0.0),
    ):
        with pytest.raises(InputError):
            make()
