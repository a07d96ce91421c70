# SPDX-License-Identifier: Apache-2.0
"""Sheets of one source taken together equal the sheets one by one."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose, Sensor
from armscan.simulation.head import build_head
from armscan.simulation.optics.lasers import LaserSource, in_sources

N_POINTS = 4000


def projector() -> LaserSource:
    (source,) = in_sources(build_head("thesis-multi", seed=3).lasers)
    return source


def points_around(source: LaserSource) -> FloatArray:
    """Points within 4 sigmas of a random sheet each, over the whole fan."""
    rng = np.random.default_rng(8)
    points = []
    for k in rng.integers(0, len(source.sheets), N_POINTS):
        sheet = source.sheets[k]
        ray = sheet.rays(rng.uniform(-0.3, 0.3, 1))[0]
        points.append(sheet.source_mm + rng.uniform(110.0, 190.0) * ray)
    return np.array(points) + rng.uniform(-0.3, 0.3, (N_POINTS, 3))


def test_the_nearest_sheet_alone_lights_a_point() -> None:
    source = projector()
    points = points_around(source)
    normals = np.broadcast_to([0.0, 0.0, -1.0], points.shape)
    each = [sheet.reach_and_peak(points, normals) for sheet in source.sheets]
    brightness = np.array([peak * np.exp(-0.5 * reach**2) for reach, peak in each])
    reach, peak = source.reach_and_peak(points, normals)
    together = peak * np.exp(-0.5 * reach**2)
    assert brightness.max() > 0.5
    np.testing.assert_allclose(together, brightness.sum(axis=0), atol=1e-12)
    nearest = np.argmin(np.abs([one for one, _ in each]), axis=0)
    np.testing.assert_array_equal(
        reach, np.array([one for one, _ in each])[nearest, range(N_POINTS)]
    )
    sources = np.array([sheet.source_mm for sheet in source.sheets])
    np.testing.assert_array_equal(source.source_of_mm(points), sources[nearest])


def test_the_rank_counts_the_centres_on_one_side() -> None:
    source = projector()
    points = points_around(source)
    reach, rank = source.reach_and_rank(points)
    offsets = np.array([sheet.offset_mm(points) for sheet in source.sheets])
    below = (offsets > 0.0).sum(axis=0)
    # counted along the fan or against it, but the same way for all
    assert bool((rank == below).all()) or bool((rank == len(source.sheets) - below).all())
    np.testing.assert_array_equal(np.abs(reach).argmin(), np.abs(offsets).min(axis=0).argmin())


def test_a_moved_sheet_lights_moved_points_alike() -> None:
    laser = build_head("thesis-multi").lasers[9]
    pose: Pose[Sensor, Sensor] = Pose.from_vectors([0.4, -0.8, 0.3], [20.0, -100.0, 50.0])
    rng = np.random.default_rng(2)
    points = laser.source_mm + 150.0 * laser.rays(rng.uniform(-0.3, 0.3, 50))
    points = points + rng.uniform(-0.2, 0.2, points.shape)
    normals = rng.standard_normal(points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    moved = laser.moved(pose)
    there = points @ pose.rotation.T + pose.translation_mm
    for a, b in zip(
        laser.reach_and_peak(points, normals),
        moved.reach_and_peak(there, normals @ pose.rotation.T),
        strict=True,
    ):
        np.testing.assert_allclose(a, b, atol=1e-9)
    assert (moved.name, moved.source) == ("A.10", "A")


def test_sheets_out_of_order_and_empty_sources_are_refused() -> None:
    sheets = build_head("thesis-multi").lasers
    with pytest.raises(InputError, match="not in order"):
        LaserSource((sheets[0], sheets[2], sheets[1]))
    with pytest.raises(InputError, match="without sheets"):
        LaserSource(())
    cross = in_sources(build_head("thesis-cross").lasers)
    assert [source.sheets[0].name for source in cross] == ["A", "B"]
