# SPDX-License-Identifier: Apache-2.0
"""The same pose with another stripe is told; with the same stripe or another sheet it is not."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.reconstruction.sync import MOVED_MM, ExposurePoses, stripes_at_equal_poses
from armscan.records.cloud import PointCloud

N, NOISE_MM = 200, 0.01


def stripe(shift_mm: float, sheet: int = 0, n: int = N, seed: int = 1) -> PointCloud:
    """A stripe along x, shifted along y, with noise of its own."""
    rng = np.random.default_rng([seed, round(1000 * shift_mm)])
    along = np.linspace(0.0, 40.0, n)
    points = np.stack([along, np.full(n, shift_mm), np.zeros(n)], axis=1)
    points += NOISE_MM * rng.standard_normal(points.shape)
    zeros = np.zeros(n, dtype=np.int64)
    covariance = np.broadcast_to(NOISE_MM**2 * np.eye(3), (n, 3, 3))
    return PointCloud(
        frame="Base",
        points_mm=points,
        covariance_mm2=covariance,
        sigma_noise_mm=np.full(n, NOISE_MM),
        sheet=np.full(n, sheet),
        sheet_names=("A", "B"),
        exposure=zeros,
        exposure_sources=("x.png",),
        segment=zeros,
        intensity=np.full(n, 100.0),
    )


def poses(places_mm: FloatArray) -> ExposurePoses:
    n = len(places_mm)
    zeros = np.zeros(n, dtype=np.int64)
    turns = np.broadcast_to(np.eye(3), (n, 3, 3))
    return ExposurePoses(
        rotations=turns,
        translations_mm=places_mm,
        status=zeros,
        sample=np.arange(n),
        source="trigger",
        max_gap_ns=0,
    )


STILL = poses(np.zeros((3, 3)))


def test_a_pose_that_hung_is_told_with_the_distance() -> None:
    clouds = {0: stripe(0.0), 1: stripe(2.0), 2: stripe(4.0)}
    found = stripes_at_equal_poses(clouds, STILL)
    assert found.keys() == {1, 2}
    # the nearest point of the other stripe lies up to half a step of 0.2 mm along it
    assert found[1] == pytest.approx(2.0, abs=0.03)
    assert found[2] == pytest.approx(4.0, abs=0.03)


def test_an_arm_at_rest_shows_the_same_stripe_again() -> None:
    clouds = {0: stripe(0.0, seed=1), 1: stripe(0.0, seed=2), 2: stripe(0.5 * MOVED_MM)}
    assert stripes_at_equal_poses(clouds, STILL) == {}


def test_other_poses_may_show_other_stripes() -> None:
    moved = poses(np.array([[0.0, 0.0, 0.0], [0.0, 0.001, 0.0], [0.0, 0.002, 0.0]]))
    assert stripes_at_equal_poses({k: stripe(2.0 * k) for k in range(3)}, moved) == {}


def test_what_cannot_be_compared_is_not_blamed() -> None:
    """Another laser's stripe, or a stripe of a few points."""
    clouds = {0: stripe(0.0), 1: stripe(5.0, sheet=1), 2: stripe(5.0, n=20)}
    assert stripes_at_equal_poses(clouds, STILL) == {}
