# SPDX-License-Identifier: Apache-2.0
"""Views chained and solved together: exact, as uncertain as said, and open about what fails."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Frame, Pose
from armscan.geometry.rotations import vector_from_rotation
from armscan.markers.join_views import (
    JoinedViews,
    Link,
    adjust_jointly,
    chain_markers,
    join_views,
)
from armscan.records.points import MarkerSet
from rigs.marker_scenes import NOISE_MM, Walk, marker_set, scattered, walk


def joined(scene: Walk) -> JoinedViews:
    result = join_views(scene.views)
    assert isinstance(result, JoinedViews), result
    return result


@cache
def four_views() -> tuple[Walk, JoinedViews]:
    scene = walk(np.random.default_rng(4), 4, step_mm=20.0)
    return scene, joined(scene)


def truth(scene: Walk, view: int) -> Pose[Frame, Frame]:
    """Pose of a view in the frame of the first."""
    return scene.part_from_sensor[0].inverse() @ scene.part_from_sensor[view]


def error(found: Pose[Frame, Frame], true: Pose[Frame, Frame]) -> FloatArray:
    turn = vector_from_rotation(true.rotation @ found.rotation.T)
    return np.concatenate([turn, true.translation_mm - found.translation_mm])


def test_views_without_noise_are_joined_exactly() -> None:
    scene = walk(np.random.default_rng(0), 4, noise_mm=1e-7)
    views = tuple(marker_set(view.points_mm, frame="Sensor") for view in scene.views)
    result = joined(replace(scene, views=views))
    assert sorted(result.placed) == [0, 1, 2, 3]
    for k, view in enumerate(result.placed):
        np.testing.assert_allclose(
            result.map.part_from_view[k].matrix, truth(scene, view).matrix, atol=1e-5
        )


def test_errors_are_as_large_as_the_map_says() -> None:
    """The pose of the last of three views, and the residuals, over 25 walks."""
    squares, ratio = [], []
    for seed in range(25):
        scene = walk(np.random.default_rng(seed), 3)
        result = joined(scene)
        if 2 not in result.placed:
            continue
        k = result.placed.index(2)
        e = error(result.map.part_from_view[k], truth(scene, 2))
        squares.append(float(e @ np.linalg.solve(result.map.pose_covariance[k], e)))
        ratio.append(result.map.chi2 / result.map.degrees_of_freedom)
        wrong = [
            np.unique(scene.true[view][result.marker_of[n] == marker]).size > 1
            for n, view in enumerate(result.placed)
            for marker in result.marker_of[n]
        ]
        assert not any(wrong)
    assert len(squares) >= 22
    assert abs(np.mean(squares) - 6.0) < 3.3 * np.sqrt(12.0 / len(squares))
    # about 40 degrees of freedom a walk
    assert abs(np.mean(ratio) - 1.0) < 3.3 * np.sqrt(2.0 / (40.0 * len(ratio)))


def test_the_joint_solution_is_that_of_a_general_solver() -> None:
    """Schur complement against SciPy on all unknowns at once, three views that overlap."""
    scene = walk(np.random.default_rng(3), 3, step_mm=20.0)
    result = joined(scene)
    seen, n = result.sightings, len(result.map.markers_mm)

    def residuals(x: FloatArray) -> FloatArray:
        turns = np.concatenate(
            [np.eye(3)[None], Rotation.from_rotvec(x[:6].reshape(2, 3)).as_matrix()]
        )
        shifts = np.vstack([np.zeros(3), 100.0 * x[6:12].reshape(2, 3)])
        markers = 100.0 * x[12:].reshape(n, 3)
        carried = np.einsum("kij,kj->ki", turns[seen.view], seen.point_mm) + shifts[seen.view]
        return ((carried - markers[seen.marker]) / NOISE_MM).ravel()

    poses = result.map.part_from_view
    x = np.concatenate(
        [
            *(pose.rotation_vector_rad for pose in poses[1:]),
            *(pose.translation_mm / 100.0 for pose in poses[1:]),
            (result.map.markers_mm / 100.0).ravel(),
        ]
    )
    start = x + np.random.default_rng(0).normal(0.0, 1e-3, x.shape)
    solved = least_squares(residuals, start, xtol=1e-14, ftol=1e-14)
    assert result.map.chi2 == pytest.approx(2.0 * solved.cost, rel=1e-6)
    information = solved.jac.T @ solved.jac
    covariance = np.linalg.inv(information)
    shift = 1e4 * covariance[6:9, 6:9]
    np.testing.assert_allclose(result.map.pose_covariance[1][3:, 3:], shift, rtol=1e-3, atol=1e-9)
    marker = 1e4 * covariance[12:15, 12:15]
    np.testing.assert_allclose(result.map.marker_covariance_mm2[0], marker, rtol=1e-3, atol=1e-9)


def test_a_walk_around_closes_and_drifts_less() -> None:
    """Around a drum the last view sees the first one's markers; along a strip it does not."""
    around = joined(walk(np.random.default_rng(1), 8, around_mm=60.0))
    along = joined(walk(np.random.default_rng(1), 8))
    assert len(around.placed) == len(along.placed) == 8
    assert around.n_links > 7
    views = walk(np.random.default_rng(1), 8, around_mm=60.0).views
    assert (
        around.sigma_mm(views).max()
        < 0.5 * along.sigma_mm(walk(np.random.default_rng(1), 8).views).max()
    )
    assert around.shift_mm(views).max() > 1e-3


def test_a_moved_marker_is_left_out_and_the_rest_stays() -> None:
    _, clean = four_views()
    counts = np.bincount(clean.sightings.marker)
    row = int(
        np.flatnonzero((counts[clean.sightings.marker] >= 3) & (clean.sightings.view == 1))[0]
    )
    moved = np.array(clean.sightings.point_mm)
    moved[row] += [0.2, -0.15, 0.1]
    again = adjust_jointly(
        replace(clean.sightings, point_mm=moved), clean.chain, clean.map.markers_mm
    )
    assert np.flatnonzero(~again.is_used).tolist() == [row]
    # it was noise on one of its sightings that is missing now
    away = np.abs(again.markers_mm - clean.map.markers_mm).max()
    assert away < 3.0 * NOISE_MM
    np.testing.assert_allclose(np.linalg.norm(again.residual_mm[row]), 0.27, atol=6 * NOISE_MM)


def test_a_view_that_scatters_more_than_stated_counts_whole_and_as_uncertain() -> None:
    """Eight times the noise stated: none of its markers moved, and the other views stay as sure."""
    scene, clean = four_views()
    is_its = clean.sightings.view == 1
    true = truth(scene, clean.placed[1])
    squares = []
    for seed in range(6):
        noise = np.random.default_rng(seed).normal(
            0.0, 8.0 * NOISE_MM, clean.sightings.point_mm.shape
        )
        point = clean.sightings.point_mm + noise * is_its[:, None]
        again = adjust_jointly(
            replace(clean.sightings, point_mm=point), clean.chain, clean.map.markers_mm
        )
        assert again.is_used.all()
        assert 4.0 < again.factor[1] < 14.0
        assert again.factor[[0, 2, 3]].max() < 1.5
        e = error(again.part_from_view[1], true)
        squares.append(float(e @ np.linalg.solve(again.pose_covariance[1], e)))
    assert np.mean(squares) < 6.0 + 3.3 * np.sqrt(12.0 / len(squares))


@pytest.mark.parametrize("by_mm", [0.6, 2.0])
def test_four_of_the_twelve_markers_of_a_view_that_moved_are_left_out(by_mm: float) -> None:
    """Kept, they would make the whole view ten times less sure."""
    _, clean = four_views()
    seen = clean.sightings
    n_seen = np.bincount(seen.marker)[seen.marker]
    assert int(((seen.view == 3) & (n_seen > 1)).sum()) == 12
    shared = np.flatnonzero((seen.view == 3) & (n_seen >= 3))
    for seed in range(4):
        generator = np.random.default_rng(seed)
        rows, point = np.sort(generator.permutation(shared)[:4]), np.array(seen.point_mm)
        step = generator.normal(size=(4, 3))
        point[rows] += by_mm * step / np.linalg.norm(step, axis=1)[:, None]
        again = adjust_jointly(replace(seen, point_mm=point), clean.chain, clean.map.markers_mm)
        assert np.flatnonzero(~again.is_used).tolist() == rows.tolist()
        assert again.factor.max() < 1.5


def test_a_view_that_shares_eight_and_scatters_much_keeps_them() -> None:
    """The four that fit best by chance scatter too little to say that the other four moved."""
    scene, clean = four_views()
    seen = clean.sightings
    n_seen = np.bincount(seen.marker)[seen.marker]
    squares = []
    for seed in range(100, 112):
        generator = np.random.default_rng(seed)
        noise = generator.normal(0.0, 8.0 * NOISE_MM, seen.point_mm.shape)
        point = seen.point_mm + noise * (seen.view == 1)[:, None]
        is_kept = np.ones(len(seen), dtype=bool)
        is_kept[generator.permutation(np.flatnonzero((seen.view == 1) & (n_seen > 1)))[8:]] = False
        again = adjust_jointly(
            replace(seen, point_mm=point).select(is_kept), clean.chain, clean.map.markers_mm
        )
        assert again.is_used.all()
        e = error(again.part_from_view[1], truth(scene, clean.placed[1]))
        squares.append(float(e @ np.linalg.solve(again.pose_covariance[1], e)))
    assert np.mean(squares) < 6.0 + 3.3 * np.sqrt(12.0 / len(squares))


def test_a_view_keeps_the_four_markers_that_fix_it() -> None:
    """Its pose would otherwise be that of two or three markers, off by metres and called joined."""
    _, clean = four_views()
    seen = clean.sightings
    n_seen = np.bincount(seen.marker)[seen.marker]
    shared = np.flatnonzero((seen.view == 3) & (n_seen >= 3))[:4]
    assert len(shared) == 4
    is_kept = (seen.view != 3) | (n_seen == 1)
    is_kept[shared] = True
    point = np.array(seen.point_mm)
    point[shared[:2]] += [[0.3, 0.0, 0.2], [-0.2, 0.3, 0.0]]
    less = replace(seen, point_mm=point).select(is_kept)
    again = adjust_jointly(less, clean.chain, clean.map.markers_mm)
    assert again.is_used[less.view == 3].all()
    assert again.factor[3] > 2.0
    assert 0.0 < np.sqrt(np.diag(again.pose_covariance[3])[3:]).max() < 20.0


def test_views_that_cannot_be_joined_are_named() -> None:
    scene = walk(np.random.default_rng(2), 3)
    stranger = marker_set(scattered(np.random.default_rng(9), 12, np.array([80.0, 55.0, 20.0])))
    grid = marker_set(np.array([(12.0 * i, 12.0 * k, 140.0) for i in range(5) for k in range(4)]))
    result = join_views((*scene.views, stranger, grid))
    assert isinstance(result, JoinedViews)
    assert [item.view for item in result.left] == [3, 4]
    assert "agree with another view" in result.left[0].reason
    nothing = join_views((scene.views[0], stranger))
    assert isinstance(nothing, FitFailure)
    assert "no view can be joined to the first" in nothing.reason
    assert isinstance(join_views(scene.views[:1]), FitFailure)


def test_the_order_of_the_views_does_not_matter() -> None:
    """Relative poses: the frame is that of whichever view comes first."""
    scene = walk(np.random.default_rng(5), 4)
    one = joined(scene)
    order = [2, 0, 3, 1]
    other = joined(replace(scene, views=tuple(scene.views[k] for k in order)))

    def relative(result: JoinedViews, first: int, second: int) -> FloatArray:
        poses = dict(zip(result.placed, result.map.part_from_view, strict=True))
        return (poses[first].inverse() @ poses[second]).matrix

    np.testing.assert_allclose(
        relative(one, 1, 3), relative(other, order.index(1), order.index(3)), atol=1e-5
    )


def test_pairs_that_contradict_stronger_ones_are_dropped() -> None:
    views: list[MarkerSet] = [marker_set(np.eye(3) * 50.0 * (k + 1)) for k in range(3)]
    links = [
        Link(first=0, second=1, pairs=np.array([[0, 0], [1, 1], [2, 2]])),
        Link(first=1, second=2, pairs=np.array([[0, 0], [1, 1]])),
        Link(first=0, second=2, pairs=np.array([[0, 1]])),
    ]
    tracks = chain_markers(views, links)
    assert tracks.n_contradictions == 1
    assert tracks.of_view[0].tolist() == [0, 1, 2]
    assert tracks.of_view[1].tolist() == [0, 1, 2]
    assert tracks.of_view[2].tolist() == [0, 1, 3]
    assert tracks.n_markers == 4
