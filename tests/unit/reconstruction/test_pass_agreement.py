# SPDX-License-Identifier: Apache-2.0
"""Passes over a ball whose points are known: what they say of each other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from armscan.geometry.arrays import FloatArray
from armscan.kernels.faces import quadric_offsets
from armscan.reconstruction.pass_agreement import (
    Stripes,
    pass_agreement,
    pass_distances,
    passes_of,
    thinned_rows,
)
from armscan.reconstruction.place import NeighbourBins, spacings_mm

RADIUS_MM, NOISE_MM = 17.5, 0.005


def ball_passes(shift_mm: FloatArray, seed: int = 1) -> Stripes:
    """Two passes of ten sections each, square to each other; the second is shifted."""
    rng = np.random.default_rng(seed)
    points, exposure = [], []
    for number in range(20):
        at = np.linspace(-9.0, 9.0, 10)[number % 10]
        along = np.linspace(-10.0, 10.0, 80)
        x, y = (along, np.full(80, at)) if number < 10 else (np.full(80, at), along)
        z = np.sqrt(RADIUS_MM**2 - x**2 - y**2) + NOISE_MM * rng.standard_normal(80)
        points.append(np.stack([x, y, z], axis=1) + (number >= 10) * shift_mm)
        exposure.append(np.full(80, number))
    n = 20 * 80
    return Stripes(
        np.concatenate(points),
        np.broadcast_to(NOISE_MM**2 * np.eye(3), (n, 3, 3)),
        np.concatenate(exposure),
        np.repeat([0, 1], 10),
        np.broadcast_to(np.eye(3), (20, 3, 3)),
        np.zeros((20, 3)),
    )


def faces_of_a_block(turn_rad: float, seed: int = 1) -> Stripes:
    """Two passes of ten stripes that end at an edge: one saw the top only, one the side only.

    The side leans by ``turn_rad`` from square to the top.
    """
    rng = np.random.default_rng(seed)
    points = []
    for number in range(20):
        along = np.linspace(0.0, 15.0, 60)
        at = np.full(60, 1.5 * (number % 10))
        noise = NOISE_MM * rng.standard_normal(60)
        on_top = np.stack([at, -along, noise], axis=1)
        cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
        on_side = np.stack([at, noise - sine * along, -cosine * along], axis=1)
        points.append(on_top if number < 10 else on_side)
    return Stripes(
        np.concatenate(points),
        np.broadcast_to(NOISE_MM**2 * np.eye(3), (20 * 60, 3, 3)),
        np.repeat(np.arange(20), 60),
        np.repeat([0, 1], 10),
        np.broadcast_to(np.eye(3), (20, 3, 3)),
        np.zeros((20, 3)),
    )


def test_quadrics_are_those_of_a_tree_and_of_least_squares() -> None:
    """The nearest 60 points within 3 mm, without one exposure: some have too few."""
    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.uniform(-4.0, 4.0, (400, 2)), rng.uniform(4.0, 12.0, (150, 2))])
    points = np.column_stack([flat, 0.03 * flat[:, 0] ** 2 + rng.normal(0.0, 0.02, 550)])
    exposure, radius = rng.integers(0, 6, 550), 3.0
    bins = NeighbourBins.of(
        np.column_stack([points, exposure, np.arange(550)]), points.min(axis=0), radius
    )
    asked = points[::11] + rng.normal(0.0, 0.3, (50, 3))
    asked[::5, 2] += 2.8
    found = np.zeros((50, 9))
    quadric_offsets(
        np.column_stack([asked, np.full(50, 2.0)]),
        bins.low_mm,
        radius,
        bins.slots,
        bins.keys,
        bins.starts,
        bins.cells,
        np.array([60.0, 12.0, 3.0, 0.0]),
        found,
    )
    n_nearest = []
    for k, place in enumerate(asked):
        distance, near = cKDTree(points).query(place, k=60, distance_upper_bound=radius)
        near = near[np.isfinite(distance)]
        n_nearest.append(len(near))
        near = near[exposure[near] != 2]
        assert found[k, 0] == (len(near) >= 12)
        if len(near) < 12:
            continue
        offset = (points[near] - place) / radius
        values, axes = np.linalg.eigh(np.cov(offset.T, bias=True))
        u, v, w = (offset @ axes[:, column] for column in (2, 1, 0))
        design = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
        solution, left, _, _ = np.linalg.lstsq(design, w, rcond=None)
        sign = np.sign(found[k, 3:6] @ axes[:, 0])
        np.testing.assert_allclose(found[k, 3:6], sign * axes[:, 0], atol=1e-9)
        wanted = (
            near[0],
            -sign * solution[0],
            np.sqrt(left[0] / max(len(near) - 6, 1)),
            np.linalg.inv(design.T @ design)[0, 0],
            np.hypot(u.mean(), v.mean()),
        )
        np.testing.assert_allclose(found[k, [1, 2, 6, 7, 8]], wanted, rtol=1e-7, atol=1e-9)
        assert values[1] > 0.02 * values[2]
    assert 60 in n_nearest
    assert min(n_nearest) < 12


@pytest.mark.parametrize("seed", range(5))
def test_passes_over_one_ball_agree(seed: int) -> None:
    found = pass_agreement(ball_passes(np.zeros(3), seed))
    assert found is not None
    assert len(found.pairs) == 2
    # the median distance of points with three noises of this size: 0.67 of their sum at most
    assert found.distance_mm < 2.0 * NOISE_MM
    assert found.worst_ratio < 1.0
    assert found.agreeing > 0.99


@pytest.mark.parametrize("shift_mm", [0.1, 1.0])
def test_a_pass_that_is_shifted_lies_that_far_away(shift_mm: float) -> None:
    found = pass_agreement(ball_passes(np.array([0.0, 0.0, shift_mm])))
    assert found is not None
    # along normals that lean by up to 40 degrees
    assert 0.75 * shift_mm < found.distance_mm < 1.02 * shift_mm
    assert found.ratio > 5.0
    assert found.agreeing < 0.1


def test_a_shift_along_a_surface_shows_by_its_slope() -> None:
    found = pass_agreement(ball_passes(np.array([0.5, 0.0, 0.0])))
    assert found is not None
    assert found.ratio > 3.0


@pytest.mark.parametrize("turn_rad", [0.0, 0.7])
def test_passes_that_saw_the_faces_beside_an_edge_are_not_compared(turn_rad: float) -> None:
    stripes = faces_of_a_block(turn_rad)
    assert pass_agreement(stripes) is None
    assert pass_distances(stripes) is None


def test_what_does_not_overlap_is_not_compared() -> None:
    assert pass_agreement(ball_passes(np.array([200.0, 0.0, 0.0]))) is None


def test_passes_end_at_pauses() -> None:
    times = np.concatenate([np.arange(5) * 10, 1000 + np.arange(4) * 10, 3000 + np.arange(2) * 10])
    assert passes_of(times).tolist() == [0] * 5 + [1] * 4 + [2] * 2


def test_thinning_keeps_one_point_a_cell_and_exposure() -> None:
    points = np.array([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [0.9, 0.0, 0.0], [0.1, 0.0, 0.0]])
    assert thinned_rows(points, np.array([0, 0, 0, 1])).tolist() == [0, 2, 3]


def test_spacings_of_stripes_are_those_of_a_tree() -> None:
    """The next stripe counts only if it is among the nearest points, as where stripes are dense."""
    rng = np.random.default_rng(9)
    stripes = ball_passes(np.zeros(3))
    # no multiple of what is compared at once
    n = 1595
    points, exposure = stripes.points_base_mm[:n] + rng.normal(0.0, 0.05, (n, 3)), stripes.exposure
    exposure = exposure[:n]
    sample = np.append(np.arange(0, n, 13), n - 1)
    places = np.column_stack([points, exposure])
    at = np.searchsorted(exposure, exposure.max() // 2)
    for looked_at, farthest_mm in ((3, 40.0), (n, 40.0), (n, 1.0)):
        found = spacings_mm(places[sample], [places[:at], places[at:]], looked_at, farthest_mm)
        distance, near = cKDTree(points).query(points[sample], k=looked_at)
        is_other = exposure[near] != exposure[sample, None]
        expected = np.where(is_other, distance, np.inf).min(axis=1)
        expected = np.where(np.isinf(expected), expected, np.minimum(expected, farthest_mm))
        np.testing.assert_allclose(found, expected, rtol=1e-12)
        assert np.isinf(found).any() == (looked_at < n)
        assert (found == farthest_mm).any() == (farthest_mm < 40.0)


def test_passes_that_lie_far_apart_say_nothing_of_each_other() -> None:
    assert pass_distances(ball_passes(np.zeros(3))) is not None
    assert pass_distances(ball_passes(np.array([90.0, 0.0, 0.0]))) is None
