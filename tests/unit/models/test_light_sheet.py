# SPDX-License-Identifier: Apache-2.0
"""The light sheet: values by hand, derivatives by differences, steps to first order."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.rotations import rotation_from_vector
from armscan.models.light_sheet import LightSheet

THESIS_PLANE = np.array([-0.0042275, 0.73558, -0.67742, 91.78])
BOW_MM = np.array([0.3, -0.2, 0.15, 0.05, -0.1])
STEP = 1e-6
DIFFERENCE = 1e-7
"""Error of a central difference with STEP: third derivatives of order 1 give about 1e-12; the
rounding of 1e2 mm over STEP gives 1e-8."""


def bowed_sheet(bow_mm: FloatArray = BOW_MM) -> LightSheet:
    axes = rotation_from_vector(np.array([0.8, 0.1, -0.2]))
    return LightSheet(
        origin_mm=np.array([3.0, -2.0, 135.0]), axes=axes, scale_mm=20.0, bow_mm=bow_mm
    )


def thesis_sheet() -> LightSheet:
    normal = THESIS_PLANE[:3] / np.linalg.norm(THESIS_PLANE[:3])
    e_u = np.cross(normal, [0.0, 0.0, 1.0])
    e_u = e_u / np.linalg.norm(e_u)
    origin = np.array([0.0, 0.0, THESIS_PLANE[3] / 0.67742])
    return LightSheet(
        origin_mm=origin,
        axes=np.stack([e_u, np.cross(normal, e_u), normal]),
        scale_mm=20.0,
        bow_mm=np.zeros(5),
    )


def test_the_printed_plane_meets_the_optical_axis_at_135_mm() -> None:
    """By hand from eq. 2.21: Z = -91.78 / -0.67742 on the axis; at x = 0.1, y = 0.05 likewise."""
    points, is_met = thesis_sheet().intersect(np.array([[0.0, 0.0], [0.1, 0.05]]))
    assert is_met.all()
    np.testing.assert_allclose(points[0], [0.0, 0.0, 135.48463], atol=1e-5)
    depth = -91.78 / (-0.0042275 * 0.1 + 0.73558 * 0.05 - 0.67742)
    np.testing.assert_allclose(points[1], [0.1 * depth, 0.05 * depth, depth], rtol=1e-10)


def test_plane_property_returns_the_printed_coefficients() -> None:
    scale = np.linalg.norm(THESIS_PLANE[:3])
    np.testing.assert_allclose(thesis_sheet().plane, THESIS_PLANE / scale, atol=1e-9)


def test_bow_by_hand() -> None:
    """At u = 1, v = -1: every even product is +, v's odd powers flip the sign."""
    sheet = LightSheet(origin_mm=np.zeros(3), axes=np.eye(3), scale_mm=10.0, bow_mm=BOW_MM)
    height, _, _ = sheet.height_with_jacobian(np.array([[10.0, -10.0, 1.0]]))
    np.testing.assert_allclose(height, 1.0 - (0.3 + 0.2 + 0.15 + 0.05 + 0.1), rtol=1e-12)


def test_height_derivatives_by_differences() -> None:
    sheet = bowed_sheet()
    points = np.array([[5.0, 6.0, 140.0], [-12.0, 3.0, 128.0], [3.0, -2.0, 135.0]])
    _, by_point, by_parameters = sheet.height_with_jacobian(points)
    for k in range(3):
        d = STEP * np.eye(3)[k]
        up, down = (sheet.height_with_jacobian(points + s * d)[0] for s in (1, -1))
        np.testing.assert_allclose(by_point[:, k], (up - down) / (2 * STEP), atol=DIFFERENCE)
    for k in range(8):
        d = STEP * np.eye(8)[k]
        up, down = (sheet.updated(s * d).height_with_jacobian(points)[0] for s in (1, -1))
        # A tilt also turns the bow's own axes: of the order bow / scale, 0.02, times the height.
        tolerance = DIFFERENCE if k > 1 else 0.05
        np.testing.assert_allclose(by_parameters[:, k], (up - down) / (2 * STEP), atol=tolerance)


def test_derivatives_along_a_fan_by_differences() -> None:
    """The terms of u alone follow the rays; the second point lies beside the region."""
    sheet = replace(bowed_sheet(), fan=np.array([0.5, 0.6]))
    points = np.array([[5.0, 6.0, 140.0], [-22.0, 13.0, 128.0], [3.0, -2.0, 135.0]])
    straight, _, _ = bowed_sheet().height_with_jacobian(points)
    height, by_point, by_parameters = sheet.height_with_jacobian(points)
    assert np.abs(height - straight).max() > 0.01, "the fan must matter"
    for k in range(3):
        d = STEP * np.eye(3)[k]
        up, down = (sheet.height_with_jacobian(points + s * d)[0] for s in (1, -1))
        np.testing.assert_allclose(by_point[:, k], (up - down) / (2 * STEP), atol=DIFFERENCE)
    for k in range(3, 8):
        d = STEP * np.eye(8)[k]
        up, down = (sheet.updated(s * d).height_with_jacobian(points)[0] for s in (1, -1))
        np.testing.assert_allclose(by_parameters[:, k], (up - down) / (2 * STEP), atol=DIFFERENCE)


@pytest.mark.parametrize("lean", [-1.2, -0.4, 0.9])
def test_a_cone_whose_rays_lean_is_met_exactly(lean: float) -> None:
    """Rays from (-lean d, -d, 0) in u, v, n: plane and ``u^2`` along the fan leave nothing."""
    distance, slope, scale = 1.8, np.tan(0.02), 90.0
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-0.7, 0.7, 15)))
    height = slope * scale * np.hypot(u + lean * distance, v + distance)
    points = np.column_stack([scale * u, scale * v, height])
    sheet = LightSheet(
        origin_mm=np.zeros(3),
        axes=np.eye(3),
        scale_mm=scale,
        bow_mm=np.zeros(5),
        fan=np.array([lean, 1.0 / distance]),
    )
    _, _, by_parameters = sheet.height_with_jacobian(points)
    design = -by_parameters[:, :4]
    left_mm = height - design @ np.linalg.lstsq(design, height, rcond=None)[0]
    assert np.abs(left_mm).max() < 1e-10


def test_a_cone_is_met_exactly_by_a_fan_and_not_by_powers() -> None:
    """Rays from (0, 0, -3) in u, v, n, all 0.02 rad over the plane: h = tan(0.02) |p - source|.

    The simulator's line lasers are such cones; here it is written down anew.
    """
    distance, slope, scale = 3.0, np.tan(0.02), 40.0
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-0.7, 0.7, 15)))
    height = slope * scale * np.hypot(u, v + distance)
    points = np.column_stack([scale * u, scale * v, height])
    left = []
    for spread in (0.0, 1.0 / distance):
        fan = np.array([0.0, spread])
        sheet = LightSheet(
            origin_mm=np.zeros(3), axes=np.eye(3), scale_mm=scale, bow_mm=np.zeros(5), fan=fan
        )
        off, _, by_parameters = sheet.height_with_jacobian(points)
        left.append(off - by_parameters @ np.linalg.lstsq(by_parameters, off, rcond=None)[0])
    assert np.abs(left[1]).max() < 1e-9
    assert np.abs(left[0]).max() > 1e-3


def test_in_another_frame_the_surface_is_the_same() -> None:
    sheet = replace(bowed_sheet(), fan=np.array([-0.1, 0.4]))
    turn, shift = rotation_from_vector(np.array([0.1, -0.7, 0.3])), np.array([30.0, -5.0, 12.0])
    points = np.array([[5.0, 6.0, 140.0], [-12.0, 3.0, 128.0]])
    there = sheet.in_frame(turn, shift)
    np.testing.assert_allclose(
        there.height_with_jacobian(points @ turn.T + shift)[0],
        sheet.height_with_jacobian(points)[0],
        atol=1e-12,
    )


def test_plane_parameters_by_differences_without_bow() -> None:
    sheet = bowed_sheet(np.zeros(5))
    points = sheet.origin_mm + np.array([[5.0, 6.0], [-12.0, 3.0]]) @ sheet.axes[:2]
    _, _, by_parameters = sheet.height_with_jacobian(points)
    for k in range(3):
        d = STEP * np.eye(8)[k]
        up, down = (sheet.updated(s * d).height_with_jacobian(points)[0] for s in (1, -1))
        np.testing.assert_allclose(by_parameters[:, k], (up - down) / (2 * STEP), atol=DIFFERENCE)


def test_intersection_lies_on_the_bowed_sheet_and_on_the_ray() -> None:
    sheet = bowed_sheet()
    xy = np.random.default_rng(1).uniform(-0.15, 0.15, (50, 2))
    points, is_met = sheet.intersect(xy)
    assert is_met.all()
    np.testing.assert_allclose(sheet.height_with_jacobian(points)[0], 0.0, atol=1e-10)
    np.testing.assert_allclose(points[:, :2] / points[:, 2:], xy, atol=1e-14)


def test_intersection_derivatives_by_differences() -> None:
    sheet = bowed_sheet()
    xy = np.array([[0.02, -0.05], [-0.1, 0.08]])
    _, _, by_xy, by_parameters = sheet.intersect_with_jacobian(xy)
    step = 1e-7
    for k in range(2):
        d = step * np.eye(2)[k]
        up, down = (sheet.intersect(xy + s * d)[0] for s in (1, -1))
        numeric = (up - down) / (2 * step)
        np.testing.assert_allclose(by_xy[:, :, k], numeric, rtol=1e-6, atol=1e-5)
    for k in range(2, 8):
        d = STEP * np.eye(8)[k]
        up, down = (sheet.updated(s * d).intersect(xy)[0] for s in (1, -1))
        np.testing.assert_allclose(
            by_parameters[:, :, k], (up - down) / (2 * STEP), rtol=1e-6, atol=1e-6
        )
    flat = bowed_sheet(np.zeros(5))
    _, _, _, by_parameters = flat.intersect_with_jacobian(xy)
    for k in range(3):
        d = STEP * np.eye(8)[k]
        up, down = (flat.updated(s * d).intersect(xy)[0] for s in (1, -1))
        np.testing.assert_allclose(
            by_parameters[:, :, k], (up - down) / (2 * STEP), rtol=1e-6, atol=1e-6
        )


def test_rays_along_or_away_from_the_sheet_are_invalid() -> None:
    sheet = LightSheet(
        origin_mm=np.array([0.0, 10.0, 0.0]),
        axes=np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]),
        scale_mm=10.0,
        bow_mm=np.zeros(5),
    )
    points, is_met = sheet.intersect(np.array([[0.0, 0.0], [0.0, -0.1], [0.0, 0.1]]))
    assert is_met.tolist() == [False, False, True]
    np.testing.assert_allclose(points[0], 0.0)
    np.testing.assert_allclose(points[2], [0.0, 10.0, 100.0], rtol=1e-12)


def test_a_ray_that_passes_by_a_strong_bow_is_invalid() -> None:
    """By hand: y = 10 - 0.03 (z - 100)^2 meets y = z s where 0.03 d^2 + s d + 100 s - 10 = 0.

    Its discriminant s^2 - 0.12 (100 s - 10) is negative from s = 0.1008 to 11.9; at s = 0.1 the
    middle of the sheet is met.
    """
    axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    sheet = LightSheet(
        origin_mm=np.array([0.0, 10.0, 100.0]),
        axes=axes,
        scale_mm=10.0,
        bow_mm=np.array([0.0, 0, 3.0, 0, 0]),
    )
    slopes = np.array([0.1, 0.05, 0.15, 0.2, 0.25, 0.3])
    points, is_met = sheet.intersect(np.column_stack([0.0 * slopes, slopes]))
    assert is_met.tolist() == [True, True, False, False, False, False]
    np.testing.assert_allclose(points[0], [0.0, 10.0, 100.0], atol=1e-9)
    np.testing.assert_allclose(sheet.height_with_jacobian(points)[0][:2], 0.0, atol=1e-9)


def test_update_keeps_the_triad_orthonormal_for_large_steps() -> None:
    sheet = bowed_sheet().updated(np.array([4.0, -7.0, 2.0, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(sheet.axes @ sheet.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(sheet.axes) > 0.0


@pytest.mark.parametrize(
    ("axes", "scale_mm"), [(np.eye(3)[[1, 0, 2]], 10.0), (2 * np.eye(3), 10.0), (np.eye(3), 0.0)]
)
def test_bad_triads_and_scales_are_refused(axes: FloatArray, scale_mm: float) -> None:
    with pytest.raises(InputError):
        LightSheet(origin_mm=np.zeros(3), axes=axes, scale_mm=scale_mm, bow_mm=np.zeros(5))
