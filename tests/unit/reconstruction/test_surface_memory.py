# SPDX-License-Identifier: Apache-2.0
"""What the last exposures predict: near, further away, beside the surface, after forgetting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Points, Pose, Sensor
from armscan.reconstruction.label_cross import CrossLabeller
from armscan.reconstruction.segments import REACH_MM, SPACING_MM, SurfaceMemory
from rigs.cross_rig import sensor

BASE_FROM_SENSOR: Pose[Base, Sensor] = Pose.from_vectors([2.9, 0.3, -0.2], [600.0, -150.0, 140.0])
SLOPE_X, SLOPE_Y = 0.4, -0.3
STEEP = np.sqrt(1.0 + SLOPE_X**2 + SLOPE_Y**2)
"""Depth from the plane over the distance from it."""


def surface(x: FloatArray, y: FloatArray) -> FloatArray:
    """Points (N, 3), in Sensor, of a plane that slopes towards the camera."""
    return np.stack([x, y, 140.0 + SLOPE_X * x + SLOPE_Y * y], axis=1)


def stripe(y: float) -> FloatArray:
    x = np.linspace(-15.0, 15.0, 601)
    return surface(x, np.full_like(x, y))


def taught(*rows_y: float, pose: Pose[Base, Sensor] = BASE_FROM_SENSOR) -> SurfaceMemory:
    memory = SurfaceMemory()
    for y in rows_y:
        in_sensor: Points[Sensor] = Points(stripe(y))
        memory.remember((pose @ in_sensor).xyz_mm)
    return memory


def at(x: float, y: float, off_mm: float = 0.0) -> FloatArray:
    return surface(np.array([x]), np.array([y])) + np.array([0.0, 0.0, off_mm])


def gain(memory: SurfaceMemory, point: FloatArray) -> float:
    return float(memory.evidence(point, BASE_FROM_SENSOR)[0][0])


def sharpness(memory: SurfaceMemory, point: FloatArray) -> float:
    return float(memory.evidence(point, BASE_FROM_SENSOR)[1][0])


def test_a_plane_is_continued_along_its_slope() -> None:
    memory = taught(-3.0, -2.0, -1.0, 0.0)
    on = gain(memory, at(2.0, 1.5))
    assert on > np.log(60.0 * 0.37 / 0.3)
    for off in (-1.0, 1.0):
        assert gain(memory, at(2.0, 1.5, 1.05 * STEEP * off)) < on - 2.5
    # a horizontal continuation would be 0.45 mm off: it fits worse
    assert gain(memory, at(2.0, 1.5, -1.5 * SLOPE_Y)) < on - 1.0


def test_the_further_the_vaguer() -> None:
    memory = taught(-3.0, -2.0, -1.0, 0.0)
    near, middle, far = (sharpness(memory, at(0.0, y)) for y in (0.3, 1.5, 3.0))
    assert near > 0.8 > middle > far > 0.0


def test_one_stripe_alone_does_not_tell_the_slope_across_it() -> None:
    one = sharpness(taught(0.0), at(0.0, 2.0))
    assert one < 0.01
    three = sharpness(taught(-2.0, -1.0, 0.0), at(0.0, 2.0))
    assert three > max(100.0 * one, 0.1)
    assert sharpness(taught(0.0), at(0.0, 0.0)) > 0.9


def test_beside_a_wall_seen_edge_on_nothing_fits() -> None:
    """The wall's own noise is no slope by which it would reach beside itself."""
    for seed in range(20):
        rng, memory = np.random.default_rng(seed), SurfaceMemory()
        for start in np.arange(-6.0, 6.0):
            z = np.linspace(-3.0, 3.0, 60)
            wall = np.stack([rng.normal(0.0, 0.02, 60), start - z, 140.0 + z], axis=1)
            in_sensor: Points[Sensor] = Points(wall)
            memory.remember((BASE_FROM_SENSOR @ in_sensor).xyz_mm)
        assert gain(memory, np.array([[0.0, 0.3, 140.0]])) > 3.0
        assert gain(memory, np.array([[0.4, 0.3, 140.0]])) < 0.1


def test_in_a_wider_field_all_lengths_grow() -> None:
    """Three times the field is a drawing at three times the scale: the same evidence."""
    memory, wide = taught(-1.0, 0.0), SurfaceMemory(depth_span_mm=180.0, scale=3.0)
    far: Pose[Base, Sensor] = Pose(BASE_FROM_SENSOR.rotation, 3.0 * BASE_FROM_SENSOR.translation_mm)
    for y in (-1.0, 0.0):
        in_sensor: Points[Sensor] = Points(3.0 * stripe(y))
        wide.remember((far @ in_sensor).xyz_mm)
    points = np.concatenate([at(1.0, 1.0), at(3.0, 2.0, 0.4), at(0.0, 4.0)])
    small = memory.evidence(points, BASE_FROM_SENSOR)
    large = wide.evidence(3.0 * points, far)
    assert large[0] == pytest.approx(small[0], rel=1e-6)
    assert large[1] == pytest.approx(small[1], rel=1e-6)


@pytest.mark.parametrize("times", [1.0, 3.0])
def test_the_lengths_are_those_of_the_sensors_field(times: float) -> None:
    """Up to 85 mm as they are, beyond it longer by as much as the field is wider."""
    made = sensor()
    sheets = tuple(
        replace(one, depth_range_mm=(times * one.depth_range_mm[0], times * one.depth_range_mm[1]))
        for one in made.sheets
    )
    width_px, fx_px = made.camera.camera.width_px, made.camera.camera.fx_px
    field = times * width_px / fx_px * 140.0
    assert (field > 85.0) == (times > 1.0)
    namer = CrossLabeller(replace(made, sheets=sheets))
    assert namer._surface.scale == pytest.approx(max(1.0, field / 85.0), rel=1e-3)


def test_beyond_reach_nothing_is_known() -> None:
    memory = taught(0.0)
    assert gain(memory, at(0.0, 1.1 * REACH_MM)) == 0.0
    assert sharpness(memory, at(0.0, 1.1 * REACH_MM)) == 0.0
    assert gain(SurfaceMemory(), at(0.0, 0.0)) == 0.0


def test_a_level_elsewhere_neither_helps_nor_harms() -> None:
    """At an edge both levels are known; a point on either fits its own."""
    memory = taught(-2.0, -1.0, 0.0)
    low: Points[Sensor] = Points(stripe(-1.0) + np.array([0.0, 0.0, 20.0]))
    memory.remember((BASE_FROM_SENSOR @ low).xyz_mm)
    assert gain(memory, at(0.0, -1.0)) > 4.0
    assert gain(memory, at(0.0, -1.0, 20.0)) > 4.0
    assert gain(memory, at(0.0, -1.0, 10.0)) == 0.0


def test_where_the_base_lies_does_not_matter() -> None:
    moved: Pose[Base, Base] = Pose.from_vectors([0.4, -0.8, 0.1], [-80.0, 55.0, 30.0])
    pose = moved @ BASE_FROM_SENSOR
    points = np.concatenate([at(1.0, 1.0), at(3.0, 2.0, 0.4)])
    here = taught(-1.0, 0.0).evidence(points, BASE_FROM_SENSOR)
    there = taught(-1.0, 0.0, pose=pose).evidence(points, pose)
    assert there[0] == pytest.approx(here[0], rel=1e-6)
    assert there[1] == pytest.approx(here[1], rel=1e-6)


def test_it_is_thinned_and_forgets_the_oldest() -> None:
    memory = taught(0.0)
    length = 30.0 * np.sqrt(1.0 + SLOPE_X**2)
    assert len(memory) == pytest.approx(length / SPACING_MM, abs=2)
    memory = SurfaceMemory(n_exposures=2)
    for y in (0.0, 20.0, 40.0):
        in_sensor: Points[Sensor] = Points(stripe(y))
        memory.remember((BASE_FROM_SENSOR @ in_sensor).xyz_mm)
    assert gain(memory, at(0.0, 0.0)) == 0.0
    assert gain(memory, at(0.0, 20.0)) > 4.0
    memory.forget()
    assert len(memory) == 0
    assert gain(memory, at(0.0, 40.0)) == 0.0


def test_stripes_that_follow_each_other_in_one_exposure_are_both_kept() -> None:
    memory = SurfaceMemory()
    short = [surface(np.linspace(x, x + 0.2, 5), np.zeros(5)) for x in (0.0, 8.0)]
    in_sensor: Points[Sensor] = Points(np.concatenate(short))
    memory.remember((BASE_FROM_SENSOR @ in_sensor).xyz_mm)
    assert gain(memory, at(0.1, 0.0)) > 4.0
    assert gain(memory, at(8.1, 0.0)) > 4.0


def test_a_plane_along_the_sheet_tells_nothing() -> None:
    """All points of a stripe that jumps lie in its sheet, and so does whatever it may have drawn.

    Another line's stripe that passes the jump would fit under this sheet whatever it lies on.
    """
    normal = np.array([0.0, np.cos(0.6), np.sin(0.6)])
    along = np.array([0.0, -np.sin(0.6), np.cos(0.6)])
    x, memory = np.linspace(-4.0, 4.0, 161), SurfaceMemory()
    height = np.where(x < 0.0, 0.0, 2.5)
    in_sheet = np.array([0.0, 0.0, 140.0]) + x[:, None] * [1.0, 0.0, 0.0] + height[:, None] * along
    in_sensor: Points[Sensor] = Points(in_sheet)
    memory.remember((BASE_FROM_SENSOR @ in_sensor).xyz_mm)
    between = np.array([[0.0, 0.0, 140.0]]) + 1.25 * along
    assert memory.evidence(between, BASE_FROM_SENSOR)[1][0] > 0.9
    assert memory.evidence(between, BASE_FROM_SENSOR, normal)[1][0] < 0.1
    # across the sheet the surface of three stripes is as sharp as before
    plane = taught(-1.0, 0.0, 1.0).evidence(at(0.0, 0.3), BASE_FROM_SENSOR, normal)
    assert plane[0][0] > 4.0
    assert plane[1][0] > 0.9


def two_levels(scatter_mm: float = 0.0) -> SurfaceMemory:
    """Eleven stripes over a step of 2 mm, each off by its own arm error."""
    memory, rng = SurfaceMemory(), np.random.default_rng(3)
    for y in np.arange(-2.0, 2.01, 0.4):
        x = np.linspace(0.0, 6.0, 121)
        z = np.where(x < 3.0, 140.0, 142.0) + rng.normal(0.0, scatter_mm)
        in_sensor: Points[Sensor] = Points(np.stack([x, np.full_like(x, y), z], axis=1))
        memory.remember((BASE_FROM_SENSOR @ in_sensor).xyz_mm)
    return memory


def test_between_two_levels_nothing_is_seen_again() -> None:
    """A plane through the edge of each is near both, and continues neither, however many ask."""
    memory = two_levels()
    places = np.array([[0.8, 0.1, 140.0], [5.2, 0.1, 142.0], [3.0, 0.1, 141.0]])
    assert memory.sees_again(places, BASE_FROM_SENSOR).tolist() == [True, True, False]
    between = np.stack([np.full(9, 3.0), np.linspace(-0.8, 0.8, 9), np.full(9, 141.0)], axis=1)
    assert not memory.sees_again(between, BASE_FROM_SENSOR).any()


def test_surfaces_that_the_arm_scatters_are_seen_again() -> None:
    """By 0.08 mm, twice what is expected of stripe, arm and calibration together."""
    memory = two_levels(0.08)
    x, y = np.meshgrid([0.6, 0.9, 5.1, 5.4], np.linspace(-0.8, 0.8, 9))
    level = np.where(x < 3.0, 140.0, 142.0)
    places = np.stack([x.ravel(), y.ravel(), level.ravel()], axis=1)
    assert memory.sees_again(places, BASE_FROM_SENSOR).mean() > 0.8
    between = np.stack([np.full(9, 3.0), np.linspace(-0.8, 0.8, 9), np.full(9, 141.0)], axis=1)
    assert not memory.sees_again(between, BASE_FROM_SENSOR).any()
