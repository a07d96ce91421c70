# SPDX-License-Identifier: Apache-2.0
"""An arm that moved: its new place, markers that moved, clouds with their covariance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.markers.alignments import MarkerMatchOptions
from armscan.pipeline.register import (
    RegisterOptions,
    carry_cloud,
    joint_markers,
    register_place,
)
from armscan.records.points import MarkerSet
from armscan.storage.points import MarkerList, markers_csv, read_marker_list
from rigs.inspection_clouds import cloud_of
from rigs.marker_scenes import (
    NOISE_MM,
    TwoViews,
    marker_set,
    random_pose,
    scattered,
    two_views,
)

SIZE = np.array([400.0, 300.0, 80.0])


def listed(markers: MarkerSet, name: str, *, has_ids: bool = False) -> MarkerList:
    return MarkerList(replace(markers, source=name), Path(name), has_ids, False)


def pushed(scene: TwoViews, common: int, by_mm: FloatArray) -> tuple[TwoViews, int, int]:
    """The scene with one common marker moved in b; its ids in a and in b."""
    both = np.intersect1d(scene.true_a, scene.true_b)
    k_a = int(np.flatnonzero(scene.true_a == both[common])[0])
    k_b = int(np.flatnonzero(scene.true_b == both[common])[0])
    points = np.array(scene.b.points_mm)
    points[k_b] += scene.a_from_b.rotation.T @ by_mm
    moved = replace(scene, b=marker_set(points))
    return moved, int(scene.a.ids[k_a]), int(scene.b.ids[k_b])


def test_the_new_place_is_found_within_its_covariance() -> None:
    squares = []
    for seed in range(25):
        scene = two_views(np.random.default_rng(seed), 12, SIZE)
        place = register_place(listed(scene.a, "old.csv"), listed(scene.b, "new.csv"))
        assert scene.n_wrong(place.pairs) == 0
        assert not place.moved
        lonely = len(scene.a) - 12
        assert len(place.only_old) == len(place.only_new) == lonely
        there = place.fit.value.inverse() @ scene.a_from_b
        shift = there.translation_mm
        turned = place.fit.value.rotation @ there.rotation_vector_rad
        e = np.concatenate([turned, place.fit.value.rotation @ shift])
        squares.append(float(e @ np.linalg.solve(place.fit.covariance, e)))
    assert abs(np.mean(squares) - 6.0) < 3.3 * np.sqrt(12.0 / len(squares))


@pytest.mark.parametrize("by", [0.2, 0.6, 3.0])
def test_a_marker_that_moved_is_named_with_how_far(by: float) -> None:
    """From seven times the noise of a difference on: no partner, but a neighbour without one."""
    step = by * np.array([0.6, -0.64, 0.48])
    for seed in range(5):
        scene, old_id, new_id = pushed(two_views(np.random.default_rng(seed), 14, SIZE), 4, step)
        place = register_place(listed(scene.a, "old.csv"), listed(scene.b, "new.csv"))
        assert [(item.old_id, item.new_id) for item in place.moved] == [(old_id, new_id)]
        np.testing.assert_allclose(place.moved[0].offset_mm, step, atol=6.0 * NOISE_MM)
        assert old_id not in place.only_old
        assert int(place.is_used.sum()) == 13


def test_a_marker_that_moved_is_named_among_those_with_ids() -> None:
    """Ids say that it is the same marker, so it is found by its misfit."""
    step = np.array([0.15, -0.16, 0.12])
    generator = np.random.default_rng(4)
    scene = two_views(generator, 9, SIZE, missing=0.0, extra=0.0)
    scene, old_id, _ = pushed(scene, 3, step)
    numbers = [replace(scene.a, ids=scene.true_a), replace(scene.b, ids=scene.true_b)]
    old, new = (listed(item, name, has_ids=True) for item, name in zip(numbers, "ab", strict=True))
    place = register_place(old, new, RegisterOptions(is_by_id=True))
    (moved,) = place.moved
    assert moved.old_id == moved.new_id == int(scene.true_a[scene.a.ids == old_id][0])
    np.testing.assert_allclose(moved.offset_mm, step, atol=6.0 * NOISE_MM)
    assert int(place.is_used.sum()) == 8


def numbered(points_a_mm: FloatArray, points_b_mm: FloatArray) -> tuple[MarkerList, MarkerList]:
    """Two lists in which equal numbers are one marker."""
    sets = marker_set(points_a_mm), marker_set(points_b_mm)
    old, new = (listed(item, name, has_ids=True) for item, name in zip(sets, "ab", strict=True))
    return old, new


@pytest.mark.parametrize(("is_by_id", "n_seeds"), [(False, 2), (True, 20)])
def test_markers_that_all_scatter_more_than_stated_are_not_said_to_have_moved(
    is_by_id: bool, n_seeds: int
) -> None:
    """Three times the noise stated, twelve markers: all count, and the covariance says so."""
    squares = []
    for seed in range(n_seeds):
        generator = np.random.default_rng(seed)
        points, pose = scattered(generator, 12, SIZE), random_pose(generator)
        noise = generator.normal(0.0, 3.0 * NOISE_MM, (2, 12, 3))
        old, new = numbered(pose.apply(points) + noise[0], points + noise[1])
        place = register_place(old, new, RegisterOptions(is_by_id=is_by_id))
        assert not place.moved
        assert len(place.pairs) == place.is_used.sum() == 12
        e = pose.step_from(place.fit.value)
        squares.append(float(e @ np.linalg.solve(place.fit.covariance, e)))
    assert np.mean(squares) < 6.0 + 3.3 * np.sqrt(12.0 / len(squares))


def test_two_of_six_that_moved_are_named_and_three_of_six_are_too_many() -> None:
    generator = np.random.default_rng(6)
    points, pose = scattered(generator, 7, SIZE), random_pose(generator)
    noise = generator.normal(0.0, NOISE_MM, (2, 7, 3))
    moved = points + noise[1]
    moved[:2] += [[2.0, 1.0, 0.0], [-4.0, 3.0, 2.0]]
    by_id = RegisterOptions(is_by_id=True)
    old, new = numbered((pose.apply(points) + noise[0])[:6], moved[:6])
    place = register_place(old, new, by_id)
    assert sorted(item.old_id for item in place.moved) == [1, 2]
    moved[2] += [0.0, 9.0, 4.0]
    old, new = numbered((pose.apply(points) + noise[0])[:6], moved[:6])
    with pytest.raises(EstimationError, match="do not fit each other: the residuals are"):
        register_place(old, new, by_id)


@pytest.mark.parametrize(("n", "n_moved"), [(11, 3), (12, 5)])
def test_up_to_half_of_the_markers_that_moved_are_named(n: int, n_moved: int) -> None:
    """Left in the fit, the last of them would make the others seem to scatter as much."""
    squares = []
    for seed in range(6):
        generator = np.random.default_rng(seed)
        points, pose = scattered(generator, n, SIZE), random_pose(generator)
        noise = generator.normal(0.0, NOISE_MM, (2, n, 3))
        moved = points + noise[1]
        step = generator.normal(size=(n_moved, 3))
        moved[:n_moved] += 2.0 * step / np.linalg.norm(step, axis=1)[:, None]
        old, new = numbered(pose.apply(points) + noise[0], moved)
        place = register_place(old, new, RegisterOptions(is_by_id=True))
        assert sorted(item.old_id for item in place.moved) == list(range(1, n_moved + 1))
        e = pose.step_from(place.fit.value)
        squares.append(float(e @ np.linalg.solve(place.fit.covariance, e)))
    assert np.mean(squares) < 6.0 + 3.3 * np.sqrt(12.0 / len(squares))


def test_few_markers_that_scatter_know_their_scatter_badly() -> None:
    """Of six, the scatter is that of twelve residuals: errors are Student's, not normal."""
    squares = []
    for seed in range(120):
        generator = np.random.default_rng(seed)
        points, pose = scattered(generator, 6, SIZE), random_pose(generator)
        noise = generator.normal(0.0, 3.0 * NOISE_MM, (2, 6, 3))
        old, new = numbered(pose.apply(points) + noise[0], points + noise[1])
        place = register_place(old, new, RegisterOptions(is_by_id=True))
        if not place.moved:
            e = pose.step_from(place.fit.value)
            squares.append(float(e @ np.linalg.solve(place.fit.covariance, e)))
    assert len(squares) > 110
    assert 5.0 < np.mean(squares) < 7.0


def test_by_id_a_lost_and_a_new_marker_stay_two() -> None:
    """A new marker 3 mm beside the place of a lost one is no moved one if its number differs."""
    generator = np.random.default_rng(7)
    points, pose = scattered(generator, 8, SIZE), random_pose(generator)
    old, new = numbered(pose.apply(points), points + np.eye(8, 3, -7) * [3.0, 0.0, 0.0])
    new = replace(new, markers=replace(new.markers, ids=np.array([1, 2, 3, 4, 5, 6, 7, 20])))
    place = register_place(old, new, RegisterOptions(is_by_id=True))
    assert (place.moved, place.only_old, place.only_new) == ((), (8,), (20,))


def test_three_markers_that_do_not_fit_are_refused() -> None:
    triangle = np.array([[0.0, 0.0, 0.0], [150.0, 0.0, 0.0], [0.0, 120.0, 0.0]])
    by_id = RegisterOptions(is_by_id=True)
    assert not register_place(*numbered(triangle, triangle + 5.0), by_id).moved
    off = triangle * [1.0 + 1.0 / 150.0, 1.0, 1.0]
    with pytest.raises(EstimationError, match="the 3 common markers do not fit each other"):
        register_place(*numbered(triangle, off), by_id)


def test_the_third_place_of_an_arm_errs_as_much_as_said(tmp_path: Path) -> None:
    """Each move sees the markers that the last one added, and some older; their list is a file."""
    squares, pooled = [], []
    by_id, path = RegisterOptions(is_by_id=True), tmp_path / "markers.csv"
    for seed in range(40):
        generator = np.random.default_rng(seed)
        points = scattered(generator, 22, SIZE * [3.0, 1.0, 1.0])
        points = points[points[:, 0].argsort()]
        path.write_bytes(markers_csv(noisy(generator, points, range(8))))
        for seen in (range(3, 14), range(6, 18), range(10, 22)):
            pose = random_pose(generator)
            new = noisy(generator, pose.inverse().apply(points), seen)
            old = read_marker_list(path, frame="")
            place = register_place(old, listed(new, "new", has_ids=True), by_id)
            assert not place.moved
            path.write_bytes(markers_csv(joint_markers(old, listed(new, "new"), place)))
        e = pose.step_from(place.fit.value)
        squares.append(float(e @ np.linalg.solve(place.fit.covariance, e)))
        independent = replace(old, markers=replace(old.markers, common=None))
        less = register_place(independent, listed(new, "new", has_ids=True), by_id).fit
        pooled.append(float(e @ np.linalg.solve(less.covariance, e)))
    assert abs(np.mean(squares) - 6.0) < 3.3 * np.sqrt(12.0 / len(squares))
    assert np.mean(pooled) > 9.0


def noisy(generator: np.random.Generator, points: FloatArray, seen: range) -> MarkerSet:
    rows = np.array(seen)
    noise = generator.normal(0.0, NOISE_MM, (len(rows), 3))
    return replace(marker_set(points[rows] + noise), ids=rows + 1)


def test_a_marker_that_does_not_fit_three_others_is_named() -> None:
    """Four markers are the least; with one of them moved there is no registration to believe."""
    scene = two_views(np.random.default_rng(4), 4, SIZE, missing=0.0, extra=0.0)
    scene, _, _ = pushed(scene, 2, np.array([3.0, -2.0, 1.0]))
    numbers = [replace(scene.a, ids=scene.true_a), replace(scene.b, ids=scene.true_b)]
    old, new = (listed(item, name, has_ids=True) for item, name in zip(numbers, "ab", strict=True))
    with pytest.raises(EstimationError, match=r"marker \d+ \(new \d+\) does not fit the others"):
        register_place(old, new, RegisterOptions(is_by_id=True))


def test_a_symmetric_part_is_refused_and_ids_resolve_it() -> None:
    square = np.array([(0, 0, 0), (90, 0, 0), (90, 90, 0), (0, 90, 0)], dtype=np.float64)
    pose = random_pose(np.random.default_rng(3))
    old, back = marker_set(square), pose.inverse()
    order = [2, 0, 3, 1]
    carried = square[order] @ back.rotation.T + back.translation_mm
    new = MarkerSet(
        ids=np.array(order) + 1, points_mm=carried, covariance_mm2=old.covariance_mm2, frame="Base"
    )
    with pytest.raises(EstimationError, match=r"equal distances.*--by-id"):
        register_place(listed(old, "old.csv", has_ids=True), listed(new, "new.csv", has_ids=True))
    by_id = RegisterOptions(is_by_id=True)
    place = register_place(
        listed(old, "old.csv", has_ids=True), listed(new, "new.csv", has_ids=True), by_id
    )
    np.testing.assert_allclose(place.fit.value.matrix, pose.matrix, atol=1e-9)
    assert place.n_rival == -1
    with pytest.raises(OptionError, match="no column id"):
        register_place(listed(old, "old.csv"), listed(new, "new.csv", has_ids=True), by_id)


def test_too_few_common_markers_are_refused_with_the_lists_named() -> None:
    scene = two_views(np.random.default_rng(1), 3, SIZE)
    with pytest.raises(EstimationError, match=r"old\.csv and new\.csv"):
        register_place(listed(scene.a, "old.csv"), listed(scene.b, "new.csv"))
    scene = two_views(np.random.default_rng(1), 6, SIZE)
    options = RegisterOptions(MarkerMatchOptions(least_common=7))
    with pytest.raises(EstimationError, match="7 are asked for"):
        register_place(listed(scene.a, "old.csv"), listed(scene.b, "new.csv"), options)
    with pytest.raises(OptionError, match="standard deviation of 0"):
        RegisterOptions(sigma_mm=0.0)


def test_a_carried_cloud_gets_the_registration_s_part_of_the_covariance() -> None:
    generator = np.random.default_rng(0)
    points = generator.normal(size=(40, 3)) * 50.0
    cloud = cloud_of(points, np.zeros(40, dtype=np.int64))
    cloud = replace(cloud, covariance_mm2=np.tile(np.diag([1e-4, 2e-4, 4e-4]), (40, 1, 1)))
    cloud = replace(cloud, normals=np.tile([0.0, 0.0, 1.0], (40, 1)))
    pose = random_pose(generator)
    shift_only = np.diag([0.0, 0.0, 0.0, 1e-4, 1e-4, 1e-4])
    carried = carry_cloud(cloud, pose, shift_only, "Base")
    assert carried.frame == "Base"
    np.testing.assert_allclose(
        carried.points_mm, points @ pose.rotation.T + pose.translation_mm, atol=1e-9
    )
    own = pose.rotation @ cloud.covariance_mm2[0] @ pose.rotation.T
    np.testing.assert_allclose(carried.covariance_mm2[0], own + 1e-4 * np.eye(3), atol=1e-12)
    assert carried.normals is not None
    np.testing.assert_allclose(carried.normals[0], pose.rotation[:, 2], atol=1e-12)
    turn_only = np.diag([1e-8, 0.0, 0.0, 0.0, 0.0, 0.0])
    turned = carry_cloud(cloud, pose, turn_only, "Base").covariance_mm2 - own
    lever = np.cross([1.0, 0.0, 0.0], carried.points_mm - pose.translation_mm)
    np.testing.assert_allclose(turned, 1e-8 * lever[:, :, None] * lever[:, None], atol=1e-12)
    foreign = replace(cloud, covariance_mm2=np.zeros((40, 3, 3)))
    assert not carry_cloud(foreign, pose, shift_only, "Base").covariance_mm2.any()
