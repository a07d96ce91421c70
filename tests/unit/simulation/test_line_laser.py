# SPDX-License-Identifier: Apache-2.0
"""The line laser: a cone of rays, its thickness, its power."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.simulation.optics.lasers import LineLaser

SKEW_RAD = 0.02


def laser(**changes: Any) -> LineLaser:
    return LineLaser(
        "A", np.zeros(3), np.array([0.0, 0.0, 2.0]), np.array([0.0, 3.0, 1.0]), **changes
    )


def test_the_line_on_a_wall_is_the_hyperbola_of_a_cone() -> None:
    source = laser(skew_rad=SKEW_RAD)
    wall_mm = 300.0
    rays = source.rays(np.linspace(-0.5, 0.5, 21))
    on_wall = rays * (wall_mm / rays[:, 2])[:, None]
    # forward is z, across is y, so the fan's normal is z x y = -x
    expected_x = -np.tan(SKEW_RAD) * np.hypot(wall_mm, on_wall[:, 1])
    np.testing.assert_allclose(on_wall[:, 0], expected_x, atol=1e-12 * wall_mm)
    sag = np.ptp(on_wall[:, 0])
    assert sag == pytest.approx(np.tan(SKEW_RAD) * wall_mm * (1 / np.cos(0.5) - 1), rel=1e-9)


def test_offset_vanishes_on_the_sheet_and_counts_millimetres_off_it() -> None:
    source = laser(skew_rad=SKEW_RAD)
    angle = np.linspace(-0.4, 0.4, 9)
    rays = source.rays(angle)
    flat = laser().rays(angle)
    off_sheet = np.cos(SKEW_RAD) * source.normal - np.sin(SKEW_RAD) * flat
    for shift_mm in (-0.3, 0.0, 0.7):
        points = 250.0 * rays + shift_mm * off_sheet
        # the arc and the tangent differ in the third order: 250 (shift / 250)^3 / 3
        np.testing.assert_allclose(source.offset_mm(points), shift_mm, atol=1e-5)


def test_a_cubic_bend_raises_one_end_of_the_line_and_lowers_the_other() -> None:
    bent = laser(cubic_rad=0.3)
    angle = np.linspace(-0.3, 0.3, 7)
    points = 200.0 * bent.rays(angle)
    np.testing.assert_allclose(points @ bent.normal, 200.0 * np.sin(0.3 * angle**3), atol=1e-10)
    np.testing.assert_allclose(bent.offset_mm(points), 0.0, atol=1e-10)
    reach, peak = bent.reach_and_peak(points, -bent.rays(angle))
    np.testing.assert_allclose(reach, 0.0, atol=1e-9)
    assert peak.min() > 0.0
    assert (laser().source, laser(source="red").source) == ("A", "red")


def test_without_skew_the_sheet_is_a_plane_through_the_source() -> None:
    rays = laser().rays(np.linspace(-0.6, 0.6, 7))
    np.testing.assert_allclose(rays @ laser().normal, 0.0, atol=1e-15)


@pytest.mark.parametrize("distance_mm", [150.0, 300.0, 450.0])
def test_power_through_the_sheet_does_not_depend_on_its_thickness(distance_mm: float) -> None:
    source = laser(divergence_rad=2e-3, irradiance=1.3)
    x = np.linspace(-8.0, 8.0, 4001)
    points = np.stack([x, 0.0 * x, np.full_like(x, distance_mm)], axis=1)
    towards_source = -points / np.linalg.norm(points, axis=1, keepdims=True)
    power = source.irradiance_at(points, towards_source).sum() * (x[1] - x[0])
    expected = 1.3 * source.waist_mm * np.sqrt(2 * np.pi) * 300.0 / distance_mm
    # the flat wall replaces the arc of the cone: (x / distance)^2 within a few sigmas
    assert power == pytest.approx(expected, rel=2e-4)


def test_light_follows_the_cosine_fades_to_the_ends_and_stops_there() -> None:
    source = laser(half_angle_rad=0.5, falloff=0.4, irradiance=1.0, divergence_rad=0.0)
    point = np.array([[0.0, 0.0, 300.0]])
    for tilt in (0.0, 0.5, 1.2, 2.0):
        normal = np.array([[0.0, np.sin(tilt), -np.cos(tilt)]])
        light = source.irradiance_at(point, normal)[0]
        assert light == pytest.approx(max(np.cos(tilt), 0.0), abs=1e-12)
    rays = source.rays(np.array([0.0, 0.25, 0.4999, 0.5001]))
    light = source.irradiance_at(300.0 * rays, -rays)
    np.testing.assert_allclose(light, [1.0, 0.9, 0.6, 0.0], atol=1e-3)


def test_a_fan_along_its_own_direction_is_refused() -> None:
    with pytest.raises(InputError, match="spreads along its own direction"):
        LineLaser("B", np.zeros(3), np.array([0.0, 0, 1]), np.array([0.0, 0, 2]))
    with pytest.raises(InputError, match="positive size"):
        laser(waist_mm=0.0)
