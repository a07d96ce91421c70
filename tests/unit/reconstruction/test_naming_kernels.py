# SPDX-License-Identifier: Apache-2.0
"""The compiled loops of naming against the same in NumPy and SciPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.kernels.chains import best_states, compare_light, cut_at_largest
from armscan.kernels.naming import (
    choose_sheets,
    find_nearest,
    find_steps,
    number_segments,
    predict_residuals,
    take_every,
)
from armscan.models.camera import Lens
from armscan.models.two_views import TwoViews
from armscan.reconstruction.epipolar import (
    RightStripes,
    find_crossings,
    possible_sheets,
    project_on_sheets,
)
from armscan.reconstruction.label_stereo import LIMITS
from armscan.reconstruction.triangulate import (
    LABEL_DEPTHS,
    differentiated,
    lens_numbers,
    sheet_numbers,
)
from rigs.fisheye import fisheye_sensor
from rigs.stereo_head import StereoHead
from rigs.stereo_scenes import Noise, draw_surfaces, expose

REACH = 8
TURN_RAD, JUMP_PX = 0.35, 0.6


def numbered(
    points: FloatArray, normals: FloatArray, is_cut: BoolArray
) -> tuple[IntArray, FloatArray]:
    """Segments by polynomial fits of every window, and how far each place exceeds the limits."""
    n, m = len(points), REACH
    segment, size = np.cumsum(is_cut), np.zeros(n)
    index = np.arange(m)
    for i in range(m, n - m + 1):
        if segment[i - m] != segment[i + m - 1]:
            continue
        before = np.polyfit(index - (m - 0.5), points[i - m : i], 1)
        after = np.polyfit(index + 0.5, points[i : i + m], 1)
        step = abs((after[1] - before[1]) @ normals[i])
        cosine = before[0] @ after[0] / np.linalg.norm(before[0]) / np.linalg.norm(after[0])
        size[i] = max(np.arccos(np.clip(cosine, -1.0, 1.0)) / TURN_RAD, step / JUMP_PX)
    is_kink = np.array(
        [size[i] > 1.0 and size[i] >= size[max(i - m, 0) : i + m + 1].max() for i in range(n)]
    )
    return np.cumsum(is_cut | is_kink) - 1, size


def test_segments_are_cut_where_fits_of_both_sides_disagree() -> None:
    rng = np.random.default_rng(3)
    course = np.concatenate(
        [
            np.zeros(40),
            np.full(35, 1.5),
            1.5 + 0.9 * np.arange(30.0),
            28.0 - 2.0 * np.arange(25.0),
            np.zeros(20),
        ]
    )
    points = np.stack([np.arange(len(course)), course + rng.normal(0.0, 0.05, len(course))], axis=1)
    normals = np.tile([0.0, 1.0], (len(course), 1))
    is_cut = np.zeros(len(course), dtype=np.bool_)
    is_cut[[0, 130]] = True
    number = np.zeros(len(course), np.int64)
    number_segments(points, normals, is_cut.view(np.uint8), REACH, TURN_RAD, JUMP_PX, number)
    expected, size = numbered(points, normals, is_cut)
    assert (number == expected).all()
    # the step, both kinks, the cut; and none that a hair would decide
    assert number[-1] == 4
    assert np.abs(size - 1.0).min() > 1e-3


def test_brightness_is_compared_within_a_chain() -> None:
    rng, reach = np.random.default_rng(5), 6
    light, is_cut = rng.normal(size=90), np.zeros(90, np.uint8)
    is_cut[[0, 40, 48]] = 1
    change, expected = np.zeros(90), np.full(90, -1.0)
    compare_light(light, is_cut, reach, change)
    for i in range(reach, 91 - reach):
        if not is_cut[i - reach + 1 : i + reach].any():
            expected[i] = abs(light[i : i + reach].mean() - light[i - reach : i].mean())
    np.testing.assert_allclose(change, expected, atol=1e-12)
    # the chain of eight is too short
    assert (change[35:54] == -1.0).all() and (change[6:35] >= 0.0).all()
    cut_at_largest(change, 0.5, reach, is_cut)
    largest = [
        i for i in range(90) if change[i] > 0.5 and change[i] >= change[max(i - 6, 0) : i + 7].max()
    ]
    assert set(np.flatnonzero(is_cut)) == {0, 40, 48, *largest} and len(largest) >= 2


def test_steps_are_those_between_chosen_points() -> None:
    rng = np.random.default_rng(4)
    points, chain = rng.normal(size=(60, 2)), np.repeat([0, 1, 2], 20)
    is_beside = rng.random(60) < 0.1
    row = np.flatnonzero(rng.random(60) < 0.6)
    step, is_cut = np.zeros(len(row)), np.zeros(len(row), np.uint8)
    find_steps(points, row, chain, is_beside.view(np.uint8), step, is_cut)
    np.testing.assert_allclose(step[1:], np.linalg.norm(np.diff(points[row], axis=0), axis=1))
    beside = np.cumsum(is_beside)[row]
    assert (is_cut[1:] == ((np.diff(chain[row]) != 0) | (np.diff(beside) > 0))).all()
    assert is_cut[0] == 1


@pytest.mark.parametrize("length", [1, 3, 4, 7, 18, 23, 24, 100])
def test_samples_share_a_segment_out(length: int) -> None:
    """Each stands for its neighbours, about four on a short segment and one in six on a long."""
    number = np.repeat([0, 1, 2], [5, length, 9])
    at, nearest = np.zeros((2, len(number)), np.int64)
    weight = np.zeros(len(number))
    count = take_every(number, 6, at, weight, nearest)
    of_segment = np.flatnonzero(number[at[:count]] == 1)
    step = min(max(length // 4, 1), 6)
    assert len(of_segment) == max(length // step, 1)
    points = np.bincount(nearest, minlength=count)
    np.testing.assert_allclose(weight[:count], points / 6.0)
    assert (number[at[nearest]] == number).all()
    assert (np.diff(nearest) >= 0).all()
    middle = [np.flatnonzero(nearest == k)[points[k] // 2] for k in range(count)]
    assert (at[:count] == middle).all()


@pytest.mark.parametrize("reach", [0.4, 3.0, 30.0])
def test_the_nearest_point_is_that_of_a_tree(reach: float) -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform(-20.0, 60.0, (400, 2))
    asked = rng.uniform(-40.0, 80.0, (900, 2))
    asked[:3] = np.nan
    asked[3] = points.max(axis=0)
    nearest = np.zeros(len(asked), np.int64)
    find_nearest(asked, points, reach, nearest)
    _, expected = cKDTree(points).query(asked[3:], distance_upper_bound=reach)
    assert (nearest[:3] == -1).all()
    assert (nearest[3:] == np.where(expected == len(points), -1, expected)).all()
    find_nearest(asked, np.zeros((0, 2)), reach, nearest)
    assert (nearest == -1).all()


def test_sheets_are_chosen_by_the_sum_of_scores() -> None:
    """Against sums with NumPy, segment by segment."""
    rng = np.random.default_rng(6)
    number = np.repeat(np.arange(30), rng.integers(1, 9, 30))
    n, k = len(number), 4
    truth = rng.integers(0, k, 30)[number]
    scores = rng.normal(-1.0, 3.0, (n, k))
    scores[np.arange(n), truth] += rng.uniform(0.0, 6.0, 30)[number]
    is_match = scores > 1.0
    weight = rng.uniform(0.3, 1.8, n)
    state = np.zeros(n, np.int64)
    is_sure, is_tied = np.zeros((2, n), np.uint8)
    is_candidate = np.zeros(30 * k, np.uint8)
    bits = np.ascontiguousarray(is_match).view(np.uint8).reshape(-1)
    choose_sheets(scores, bits, weight, number, LIMITS, state, is_sure, is_tied, is_candidate)
    independent, runner_up, least, least_matches, change = LIMITS
    weighted = scores * (independent * weight)[:, None]
    table = np.concatenate([weighted, np.zeros((n, 1))], axis=1)
    path = np.zeros(n, np.int64)
    best_states(table, np.where(np.diff(number, prepend=-1) != 0, 0.0, change), path)
    for segment in range(30):
        rows = np.flatnonzero(number == segment)
        total = weighted[rows].sum(axis=0)
        winner, others = int(total.argmax()), np.sort(total)[:-1]
        ahead = max(0.0, others[-1]) <= runner_up * total[winner] and total[winner] >= least
        ahead = ahead and (is_match[rows, winner] @ weight[rows]) >= least_matches
        is_other = (path[rows] < k) & (path[rows] != winner)
        assert (state[rows] == winner).all()
        assert (is_sure[rows] == (ahead & ~is_other)).all()
        assert (is_tied[rows] == ((not ahead and total[winner] > 0.0) | is_other)).all()
        near = (total > runner_up * total[winner]) & (total >= least)
        assert (is_candidate[segment * k : (segment + 1) * k] == near).all()
    assert 0 < is_sure.sum() < n


def test_possible_sheets_are_those_whose_planes_are_met_in_depth() -> None:
    head = StereoHead.thesis().calibration()
    narrow = replace(head.sheets[4], depth_range_mm=(139.0, 141.0))
    sensor = replace(head, sheets=(*head.sheets[:4], narrow, *head.sheets[5:]))
    pixels = np.random.default_rng(7).uniform([800.0, 500.0], [2200.0, 1600.0], (300, 2))
    point, sheet = possible_sheets(pixels, sensor, LABEL_DEPTHS)
    xy, _ = sensor.camera.camera.undistort(pixels)
    rays = np.column_stack([xy, np.ones(len(xy))])
    expected = []
    for k, one in enumerate(sensor.sheets):
        plane = one.sheet.plane
        depth = -plane[3] / (rays @ plane[:3])
        low, high = LABEL_DEPTHS.limits_mm(head.sheets[0])
        inside = (depth >= 0.97 * low) & (depth <= 1.03 * high)
        expected += [(int(i), k) for i in np.flatnonzero(inside)]
    assert list(zip(point.tolist(), sheet.tolist(), strict=True)) == expected
    assert 300 < len(point) < 300 * len(sensor.sheets)


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_crossings_and_their_derivatives_are_those_of_the_models(lens: Lens) -> None:
    """Right pixel and its derivatives by `TwoViews`, the rest by matrix products."""
    rng = np.random.default_rng(8)
    head = StereoHead.thesis()
    sensor = head.drawn_calibration(rng)
    sensor = fisheye_sensor(sensor) if lens == "fisheye" else sensor
    left, right = expose(head, draw_surfaces("ball", rng), Noise(), rng)
    rows = np.flatnonzero((left.sheet >= 0) & left.profile.is_accepted)[::7]
    pixels, sheet = left.profile.points_px[rows], left.sheet[rows]
    there = project_on_sheets(pixels, sheet, sensor)
    normals, sigma = left.profile.normals_px[rows], left.profile.sigma_px[rows]
    found = find_crossings(there, normals, sigma, RightStripes.of(right.profile), sensor)
    q, by_point, by_second = TwoViews.of_sensor(sensor).project_right_with_jacobian(there.points_mm)
    np.testing.assert_allclose(there.q_px, q, atol=1e-9)
    by_px, by_left = differentiated(
        there.points_mm, there.sheet, lens_numbers(sensor), sheet_numbers(sensor)
    )
    accepted = np.flatnonzero(right.profile.is_accepted)
    _, nearest = cKDTree(right.profile.points_px[accepted]).query(q)
    at = found.at
    assert 100 < len(at) <= len(rows)
    assert (found.row == accepted[nearest[at]]).all()
    n = right.profile.normals_px[found.row]
    away = np.sum((q[at] - right.profile.points_px[found.row]) * n, axis=1)
    np.testing.assert_allclose(found.residual_px, away, atol=1e-9)
    g = np.einsum("ni,nij->nj", n, by_point[at])
    np.testing.assert_allclose(found.by_point, g, rtol=1e-9, atol=1e-12)
    gain = np.einsum("ni,nij,nj->n", g, by_px[at], normals[at])
    expected = np.hypot(gain * sigma[at], right.profile.sigma_px[found.row])
    np.testing.assert_allclose(found.sigma_px, expected, rtol=1e-9)
    line = np.einsum("nij,nj->ni", by_point[at], there.points_mm[at])
    across = np.stack([-line[:, 1], line[:, 0]], axis=1) / np.linalg.norm(line, axis=1)[:, None]
    across *= np.where(across[:, 1] < 0.0, -1.0, 1.0)[:, None]
    camera = TwoViews.of_sensor(sensor).right
    half = 0.5 * np.array([camera.width_px, camera.height_px])
    place = np.column_stack([np.ones(len(at)), (q[at] - half) / half])
    expected = np.column_stack(
        [
            np.einsum("ni,nij->nj", g, by_left[at]),
            np.einsum("ni,nij->nj", n, by_second[at]),
            np.sum(n * across, axis=1)[:, None] * place,
        ]
    )
    scale = np.abs(expected).max(axis=0)
    assert (np.abs(found.by_errors - expected) < 1e-9 * scale + 1e-12).all()


def test_predicted_residuals_are_quadratic_forms() -> None:
    rng = np.random.default_rng(9)
    n, q, n_sheets = 50, 35, 3
    by_errors, sheet = rng.normal(size=(n, q)), rng.integers(0, n_sheets, n)
    step, root = rng.normal(size=(n_sheets, q)), rng.normal(size=(n_sheets, q, q))
    covariance = root @ root.transpose(0, 2, 1)
    found = np.zeros((n, 2))
    predict_residuals(by_errors, sheet, step, covariance.reshape(n_sheets, -1), found)
    np.testing.assert_allclose(found[:, 0], np.sum(by_errors * step[sheet], axis=1), rtol=1e-9)
    variance = np.einsum("nq,nqr,nr->n", by_errors, covariance[sheet], by_errors)
    np.testing.assert_allclose(found[:, 1], variance, rtol=1e-9)
