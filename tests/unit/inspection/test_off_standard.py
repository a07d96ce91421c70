# SPDX-License-Identifier: Apache-2.0
"""Exposures that a robust fit would leave out must take part in the verdict."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.inspection.conformity import Check, check_exposures_off
from armscan.inspection.plane import inspect_plane
from armscan.inspection.results import PlaneInspection, SphereInspection
from armscan.inspection.sphere import inspect_sphere
from armscan.records.cloud import PointCloud
from rigs.inspection_clouds import cloud_of

RADIUS_MM, NOISE_MM, STRIPES = 17.5, 0.005, 24


def ball_stripe(at_mm: float, rng: np.random.Generator) -> FloatArray:
    """A section of the upper half of a ball, and the post that it stands on beside it."""
    angle = np.linspace(-1.0, 1.0, 120)
    size = np.sqrt(RADIUS_MM**2 - at_mm**2) + NOISE_MM * rng.standard_normal(120)
    arc = np.stack([size * np.sin(angle), np.full(120, at_mm), size * np.cos(angle)], axis=1)
    post = np.stack([np.full(30, 4.0), np.full(30, at_mm), np.linspace(-30.0, -18.0, 30)], axis=1)
    return np.concatenate([arc, post])


def plate_stripe(at_mm: float, rng: np.random.Generator) -> FloatArray:
    x = np.linspace(-30.0, 30.0, 150)
    return np.stack([x, np.full(150, at_mm), NOISE_MM * rng.standard_normal(150)], axis=1)


def judged(kind: str, shift_mm: FloatArray, n_shifted: int, seed: int = 1) -> Check:
    rng = np.random.default_rng(seed)
    stripe = ball_stripe if kind == "ball" else plate_stripe
    # two passes to and fro, so that shifted exposures have their right counterparts beside them
    places = np.linspace(-12.0, 12.0, STRIPES // 2)
    parts = [stripe(float(at), rng) for at in (*places, *places[::-1])]
    for k in range(n_shifted):
        parts[STRIPES - 1 - k] = parts[STRIPES - 1 - k] + shift_mm
    exposure = np.repeat(np.arange(STRIPES), 150)
    cloud: PointCloud = cloud_of(np.concatenate(parts), exposure)
    is_ball = kind == "ball"
    found = inspect_sphere(cloud, 2.0 * RADIUS_MM) if is_ball else inspect_plane(cloud)
    assert isinstance(found, SphereInspection | PlaneInspection)
    within = np.ones(len(cloud), dtype=np.bool_)
    check = check_exposures_off(cloud, found, within)
    assert check is not None
    return check


@pytest.mark.parametrize("kind", ["ball", "plate"])
@pytest.mark.parametrize("seed", range(5))
def test_a_clean_scan_has_none(kind: str, seed: int) -> None:
    check = judged(kind, np.zeros(3), 0, seed)
    assert (check.error, check.verdict) == (0.0, "still valid")


@pytest.mark.parametrize("kind", ["ball", "plate"])
@pytest.mark.parametrize("size_mm", [0.3, 3.0])
def test_exposures_that_are_shifted_are_counted(kind: str, size_mm: float) -> None:
    check = judged(kind, np.array([0.0, 0.0, size_mm]), 6)
    # a fit tilts towards what is hardly off, and is then off more exposures than those
    assert check.error >= 100.0 * 6 / STRIPES
    assert size_mm < 1.0 or check.error == pytest.approx(100.0 * 6 / STRIPES)
    assert check.verdict == "not valid"


@pytest.mark.parametrize("size_mm", [30.0, 1000.0])
def test_a_second_ball_is_the_same_ball_elsewhere(size_mm: float) -> None:
    check = judged("ball", np.array([0.6 * size_mm, 0.0, 0.8 * size_mm]), 8)
    assert check.error == pytest.approx(100.0 * 8 / STRIPES)
    assert check.verdict == "not valid"


def test_a_speck_is_no_second_ball() -> None:
    """Points within 1 mm would be taken for a cloud in metres, and the check was refused."""
    rng = np.random.default_rng(0)
    balls = [ball_stripe(float(at), rng)[:120] for at in np.linspace(-12.0, 12.0, 8)]
    speck = rng.uniform([59.7, -0.3, -0.3], [60.3, 0.3, 0.3], (300, 3))
    exposure = np.concatenate([np.repeat(np.arange(8), 120), np.repeat([8, 9], 150)])
    cloud = cloud_of(np.concatenate([*balls, speck]), exposure)
    found = inspect_sphere(cloud, 2.0 * RADIUS_MM)
    assert isinstance(found, SphereInspection)
    check = check_exposures_off(cloud, found, np.ones(len(cloud), dtype=np.bool_))
    assert check is not None
    assert check.verdict == "still valid"


def test_one_exposure_behind_a_cable_is_allowed() -> None:
    assert judged("ball", np.array([0.0, 0.0, 2.0]), 1).verdict == "still valid"
