# SPDX-License-Identifier: Apache-2.0
"""Ring markers: sharp in room light, hidden where something stands before them, true in the truth.

The oracle of the drawing is the renderer of flat prints, which samples 8 x 8 points a cell.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from armscan.geometry.poses import Points, Pose
from armscan.geometry.rotations import rotation_from_vector
from armscan.simulation.head import build_head
from armscan.simulation.objects.boards import CirclePattern
from armscan.simulation.objects.fixtures import N_MARKERS
from armscan.simulation.objects.rings import Marked, RingMarker, draw_markers
from armscan.simulation.optics.scene import Floor, Scene, Sphere
from armscan.simulation.twin import build_twin
from rigs.flat_prints import Lighting, render_flat_target

CAMERA = build_head("thesis-multi", seed=3).camera.cropped(1300, 800, 500, 420)
FACE = (0.5, 0.5, 0.5)
CENTRE_PX = 0.002
"""A tenth of what a ring's centre is measured to."""
TILT = rotation_from_vector(np.array([0.5, -0.35, 0.0]))


def _marker() -> RingMarker:
    ray = np.append(CAMERA.rays(np.array([[243.3, 210.8]]))[0], 1.0)
    return RingMarker(140.0 * ray, TILT @ [0.0, 0.0, -1.0])


def _drawn(marker: RingMarker, *others: Any) -> np.ndarray:
    face = Floor(marker.centre_mm, marker.normal, FACE)
    light = np.full((CAMERA.height_px, CAMERA.width_px), 0.5)
    return draw_markers(light, [marker], Scene((face, *others)), CAMERA)


def test_a_marker_is_drawn_as_a_flat_print_of_its_circles():
    """Both circles as prints of their own: disc on ring, ring on face, outside in."""
    marker = _marker()
    pose = (TILT, marker.centre_mm)
    shares = [
        render_flat_target(
            CAMERA,
            CirclePattern(1, 1, 8.0, diameter, is_light_on_dark=True),
            *pose,
            Lighting(light_level=1.0, dark_level=0.0, surround=0.0),
        ).image
        for diameter in (marker.disc_mm, marker.ring_mm)
    ]
    disc, whole = shares
    wanted = disc * marker.light + (whole - disc) * marker.dark + (1.0 - whole) * FACE[0]
    off = _drawn(marker) - wanted
    # 8 samples along half a pixel know an edge to 1/32 px; it rises by 0.37 of its step a pixel.
    step = marker.light - marker.dark
    assert np.abs(off).max() < step * 0.37 / 32.0
    assert np.sqrt(np.mean(off[np.abs(off) > 1e-9] ** 2)) < 5e-4


def test_the_disc_lies_where_its_circle_projects_to():
    """Area centroid of the disc against that of the projected circle's outline."""
    marker = _marker()
    rows, columns = np.indices((CAMERA.height_px, CAMERA.width_px))
    drawn = _drawn(marker)
    near = np.hypot(columns - 243.3, rows - 210.8) < 75.0
    weight = np.where(near, (drawn - marker.dark) / (marker.light - marker.dark), 0.0)
    angle = np.linspace(0.0, 2.0 * np.pi, 2000, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1) @ TILT.T
    rim = CAMERA.project(marker.centre_mm + 0.5 * marker.disc_mm * circle)
    x, y = rim.T
    x_next, y_next = np.roll(x, -1), np.roll(y, -1)
    cross = x * y_next - x_next * y
    centroid = [
        ((x + x_next) * cross).sum() / (3.0 * cross.sum()),
        ((y + y_next) * cross).sum() / (3.0 * cross.sum()),
    ]
    disc = weight > 0.02
    found = [(weight * disc * grid).sum() / (weight * disc).sum() for grid in (columns, rows)]
    np.testing.assert_allclose(found, centroid, atol=CENTRE_PX)


def test_what_stands_before_a_marker_hides_it():
    marker = _marker()
    ball = Sphere(0.75 * marker.centre_mm + np.array([1.2, 0.0, 0.0]), 1.2)
    hidden = CAMERA.project(0.75 * marker.centre_mm + np.array([1.2, 0.0, 0.0])).round().astype(int)
    column, row = hidden
    assert _drawn(marker)[row, column] != 0.5
    assert _drawn(marker, ball)[row, column] == 0.5


def test_a_marker_that_faces_away_is_not_drawn():
    marker = _marker()
    away = replace(marker, normal=-marker.normal)
    assert (_drawn(marker) != 0.5).any()
    face = Floor(marker.centre_mm, marker.normal, FACE)
    light = np.full((CAMERA.height_px, CAMERA.width_px), 0.5)
    assert (draw_markers(light, [away], Scene((face,)), CAMERA) == 0.5).all()


def test_the_laser_meets_disc_ring_and_face():
    marker = RingMarker(np.array([10.0, 20.0, 5.0]), np.array([0.0, 0.0, 1.0]))
    face = Floor(marker.centre_mm, marker.normal, FACE)
    radii = [0.0, 1.4, 1.6, 2.7, 2.9]
    points = marker.centre_mm + np.outer(radii, [0.6, 0.8, 0.0])
    albedo = Marked(face, [marker]).albedo(points)[:, 0]
    np.testing.assert_allclose(albedo, [0.85, 0.85, 0.06, 0.06, 0.5])
    below = points - np.array([0.0, 0.0, 3.0])
    np.testing.assert_allclose(Marked(face, [marker]).albedo(below), 0.5)


def test_markers_lie_on_faces_and_clear_of_each_other():
    for seed in range(5):
        bench = build_twin("thesis-multi", seed=seed).instrument.fixtures
        centres = bench.marker_centres_mm()
        assert len(centres) == N_MARKERS == 30
        up = bench.base_from_marked.rotation[:, 2]
        surfaces = tuple(thing for thing in bench.with_markers().things)
        hits = Scene(surfaces).trace(centres[0] + 50.0 * up, -up[None, :])
        np.testing.assert_allclose(hits.points_mm[0], centres[0], atol=1e-9)
        apart = np.linalg.norm(centres[:, None] - centres[None], axis=2) + 100.0 * np.eye(30)
        assert apart.min() > 6.9
        heights = (centres - bench.base_from_marked.translation_mm) @ up
        assert len(set(heights.round(6))) >= 4


def test_after_the_move_everything_stands_where_the_truth_says():
    twin = build_twin("thesis-multi", seed=2)
    moved = twin.truth.moved_from_base
    before, after = (twin.scan(scene).shots[0].station for scene in ("markers", "markers-moved"))
    old: Points[Any] = Points(twin.truth.marker_centres_base_mm)
    new = np.array([marker.centre_mm for marker in after.markers])
    np.testing.assert_allclose(new, (moved @ old).xyz_mm, atol=1e-9)
    np.testing.assert_allclose(
        [marker.centre_mm for marker in before.markers], old.xyz_mm, atol=1e-12
    )
    # The arm was truly put down elsewhere: turned by 5 degrees or more, and shifted.
    angle = np.degrees(np.arccos(0.5 * (np.trace(moved.rotation) - 1.0)))
    assert angle > 5.0 and np.linalg.norm(moved.translation_mm) > 20.0
    here: Pose[Any, Any] = moved @ moved.inverse()
    np.testing.assert_allclose(here.matrix, np.eye(4), atol=1e-12)
