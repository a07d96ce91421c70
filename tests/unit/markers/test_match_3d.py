# SPDX-License-Identifier: Apache-2.0
"""Matching in space: right, unique, or it says what is missing."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.errors import OptionError
from armscan.geometry.poses import Frame, Pose
from armscan.geometry.rotations import vector_from_rotation
from armscan.markers.alignments import MarkerMatchOptions, Matched, NoMatch, NotUnique
from armscan.markers.match_3d import match_markers
from armscan.records.points import MarkerSet
from armscan.thesis.two_cameras import match_after_thesis
from rigs.marker_scenes import NOISE_MM, marker_set, random_pose, scattered, two_views

SOLID = np.array([200.0, 150.0, 80.0])
FLAT = np.array([250.0, 160.0, 0.0])


def carried(markers: MarkerSet, pose: Pose[Frame, Frame], frame: str = "Base") -> MarkerSet:
    return marker_set(markers.points_mm @ pose.rotation.T + pose.translation_mm, frame=frame)


@pytest.mark.parametrize("size", [SOLID, FLAT], ids=["solid", "flat"])
def test_no_pair_is_wrong_and_the_motion_is_found(size: np.ndarray) -> None:
    """8 common of 14 and 14; the motion errs by the markers' noise, not more."""
    for seed in range(25):
        scene = two_views(np.random.default_rng(seed), 8, size)
        found = match_markers(scene.a, scene.b)
        assert isinstance(found, Matched), found
        assert scene.n_wrong(found.alignment.pairs) == 0
        assert len(found.alignment) == 8
        pose = found.alignment.first_from_second
        turn = vector_from_rotation(pose.rotation @ scene.a_from_b.rotation.T)
        # sqrt(2) noise over eight points that spread by more than 20 mm to either side
        assert np.linalg.norm(turn) < 6.0 * np.sqrt(2.0) * NOISE_MM / (np.sqrt(8.0) * 20.0)


def test_noise_free_sets_are_matched_exactly() -> None:
    generator = np.random.default_rng(3)
    scene = two_views(generator, 10, SOLID, noise_mm=0.0)
    found = match_markers(scene.a, scene.b)
    assert isinstance(found, Matched)
    pairs, pose = found.alignment.pairs, found.alignment.first_from_second
    moved = scene.b.points_mm[pairs[:, 1]] @ pose.rotation.T + pose.translation_mm
    np.testing.assert_allclose(moved, scene.a.points_mm[pairs[:, 0]], atol=1e-9)


def test_order_and_place_of_the_markers_do_not_matter() -> None:
    generator = np.random.default_rng(5)
    scene = two_views(generator, 14, SOLID)
    found = match_markers(scene.a, scene.b)
    assert isinstance(found, Matched)
    order_a, order_b = generator.permutation(len(scene.a)), generator.permutation(len(scene.b))
    moved = random_pose(generator)
    again = match_markers(
        marker_set(scene.a.points_mm[order_a]),
        carried(marker_set(scene.b.points_mm[order_b]), moved),
    )
    assert isinstance(again, Matched)
    back = np.stack(
        [order_a[again.alignment.pairs[:, 0]], order_b[again.alignment.pairs[:, 1]]], axis=1
    )
    assert {(i, k) for i, k in back.tolist()} == {(i, k) for i, k in found.alignment.pairs.tolist()}
    expected = found.alignment.first_from_second @ moved.inverse()
    np.testing.assert_allclose(again.alignment.first_from_second.matrix, expected.matrix, atol=1e-7)


def test_exchanging_the_sets_inverts_the_answer() -> None:
    scene = two_views(np.random.default_rng(8), 9, SOLID)
    there, back = match_markers(scene.a, scene.b), match_markers(scene.b, scene.a)
    assert isinstance(there, Matched)
    assert isinstance(back, Matched)
    assert {tuple(p) for p in there.alignment.pairs.tolist()} == {
        (k, i) for i, k in back.alignment.pairs.tolist()
    }


def test_a_mirror_image_is_no_match() -> None:
    for seed in range(10):
        points = scattered(np.random.default_rng(seed), 10, SOLID)
        found = match_markers(marker_set(points), marker_set(points * [1.0, 1.0, -1.0]))
        assert isinstance(found, NoMatch)
        assert found.reason.startswith("one list is the mirror image of the other: 10 markers")


def test_a_flat_set_is_not_matched_with_its_back_by_two_sensors() -> None:
    """In a frame that is no sensor's, half a turn of a flat part is a motion like any other."""
    points = scattered(np.random.default_rng(2), 9, FLAT) + np.array([0.0, 0.0, 140.0])
    mirrored = points * [-1.0, 1.0, 1.0]
    in_sensor = match_markers(
        marker_set(points, frame="Sensor"), marker_set(mirrored, frame="Sensor")
    )
    assert not isinstance(in_sensor, Matched)
    assert isinstance(match_markers(marker_set(points), marker_set(mirrored)), Matched)


@pytest.mark.parametrize("is_first", [True, False])
def test_a_flat_set_in_its_own_plane_is_matched_with_what_a_sensor_saw(is_first: bool) -> None:
    """A plate's drawing has its origin in the plate: from which side it is seen is not said."""
    generator = np.random.default_rng(2)
    points = scattered(generator, 9, FLAT)
    noise = generator.normal(0.0, NOISE_MM, points.shape)
    drawn = marker_set(points, frame="Sensor")
    for _ in range(3):
        pose = random_pose(generator)
        seen = marker_set(pose.apply(points) + noise, frame="Sensor")
        found = match_markers(*((drawn, seen) if is_first else (seen, drawn)))
        assert isinstance(found, Matched), found
        assert len(found.alignment) == 9


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_a_grid_is_not_unique(missing: float) -> None:
    generator = np.random.default_rng(1)
    grid = np.array([(20.0 * i, 20.0 * k, 0.0) for i in range(5) for k in range(5)])
    noisy = [grid + generator.normal(0.0, NOISE_MM, grid.shape) for _ in range(2)]
    sets = [marker_set(points[generator.random(25) >= missing]) for points in noisy]
    found = match_markers(*sets)
    assert isinstance(found, NotUnique)
    assert "equal distances" in found.reason
    first, second = found.rivals
    assert len(second) > len(first) / 2


@pytest.mark.parametrize(
    "points",
    [
        [(0, 0, 0), (50, 0, 0), (50, 50, 0), (0, 50, 0)],
        [(0, 0, 0), (60, 0, 0), (30, 51.9615242, 0), (30, 17.3205081, 48.98979486)],
        [(0, 0, 0), (80, 0, 0), (80, 50, 0), (0, 50, 0), (40, 25, 30)],
    ],
    ids=["square", "tetrahedron", "roof"],
)
def test_equal_distances_are_not_unique(points: list[tuple[float, float, float]]) -> None:
    markers = marker_set(np.array(points, dtype=np.float64))
    found = match_markers(markers, carried(markers, random_pose(np.random.default_rng(0))))
    assert isinstance(found, NotUnique)


def test_markers_on_a_line_are_not_unique() -> None:
    line = np.outer([0.0, 11.0, 35.0, 52.0, 90.0, 121.0], [1.0, 0.0, 0.0])
    assert isinstance(match_markers(marker_set(line), marker_set(line)), NotUnique)
    one_off = np.vstack([line, [40.0, 30.0, 0.0]])
    found = match_markers(marker_set(one_off), marker_set(one_off))
    assert isinstance(found, NotUnique)
    assert "all but one" in found.reason
    two_off = np.vstack([one_off, [70.0, -10.0, 15.0]])
    assert isinstance(match_markers(marker_set(two_off), marker_set(two_off)), Matched)


@pytest.mark.parametrize("n", [0, 1, 3])
def test_fewer_than_four_markers_are_not_unique(n: int) -> None:
    points = scattered(np.random.default_rng(4), 6, SOLID)
    found = match_markers(marker_set(points[:n]), marker_set(points))
    assert isinstance(found, NotUnique)
    assert f"holds {n} markers" in found.reason


def test_three_common_markers_are_never_taken_for_a_match() -> None:
    for seed in range(20):
        scene = two_views(np.random.default_rng(seed), 3, SOLID)
        assert not match_markers(scene.a, scene.b)


def test_sets_without_anything_in_common_do_not_match() -> None:
    """Dense and flat, so that chance alone makes four or five markers agree."""
    generator = np.random.default_rng(6)
    sets = [marker_set(scattered(generator, 60, np.array([120.0, 100.0, 0.0]))) for _ in range(2)]
    found = match_markers(*sets)
    assert isinstance(found, NoMatch)
    assert "chance would show as well" in found.reason
    assert found.n_best >= 4


def test_a_small_view_is_found_on_a_large_part() -> None:
    generator = np.random.default_rng(7)
    part = scattered(generator, 200, np.array([400.0, 300.0, 60.0]))
    near = np.flatnonzero(np.linalg.norm(part[:, :2] - [80.0, -40.0], axis=1) < 45.0)
    view = marker_set(part[near] + generator.normal(0.0, NOISE_MM, (len(near), 3)))
    found = match_markers(marker_set(part), carried(view, random_pose(generator)))
    assert isinstance(found, Matched)
    np.testing.assert_array_equal(found.alignment.pairs[:, 0], near)


def test_a_pattern_that_repeats_in_part_is_matched_by_the_rest() -> None:
    """Four markers in a square fit in four ways; six others fit in one."""
    square = np.array([(0, 0, 0), (40, 0, 0), (40, 40, 0), (0, 40, 0)], dtype=np.float64)
    rest = scattered(np.random.default_rng(11), 6, SOLID) + np.array([0.0, 150.0, 0.0])
    markers = marker_set(np.vstack([square, rest]))
    found = match_markers(markers, carried(markers, random_pose(np.random.default_rng(1))))
    assert isinstance(found, Matched)
    assert len(found.alignment) == 10


def test_more_common_markers_can_be_asked_for() -> None:
    scene = two_views(np.random.default_rng(0), 6, SOLID)
    assert isinstance(match_markers(scene.a, scene.b), Matched)
    found = match_markers(scene.a, scene.b, MarkerMatchOptions(least_common=7))
    assert isinstance(found, NoMatch)
    assert "7 are asked for" in found.reason
    with pytest.raises(OptionError, match="no check"):
        MarkerMatchOptions(least_common=3)


def test_the_eight_steps_confuse_markers_at_equal_distances() -> None:
    points = scattered(np.random.default_rng(1), 9, SOLID)
    a, pose = marker_set(points), random_pose(np.random.default_rng(2))
    pairs = match_after_thesis(a, carried(a, pose), 0.1)
    np.testing.assert_array_equal(pairs[:, 0], pairs[:, 1])
    assert len(pairs) == 9

    # two markers whose distances from the first pair the noise swaps
    def ring(reach_1: float, reach_2: float) -> MarkerSet:
        there = points[0] + np.array([[reach_1, 0.0, 0.0], [0.0, reach_2, 0.0]])
        return marker_set(np.vstack([points[:5], there]))

    first, second = ring(60.0, 60.04), carried(ring(60.04, 60.0), pose)
    pairs = match_after_thesis(first, second, 0.1)
    assert pairs[0].tolist() == [0, 0]
    assert {(5, 6), (6, 5)} <= {(i, k) for i, k in pairs.tolist()}
    found = match_markers(first, second)
    assert isinstance(found, Matched)
    np.testing.assert_array_equal(found.alignment.pairs[:, 0], found.alignment.pairs[:, 1])


@pytest.mark.parametrize(
    ("of_first", "of_second", "said"),
    [
        ([0, 1, 2, 3, 5, 6], [0, 1, 5, 6, 7, 8], "another 4"),
        ([0, 1, 2, 3, 4, 5, 6, 7], [5, 6, 7, 8, 9], "the part is symmetric"),
    ],
)
def test_different_halves_of_a_symmetric_part_are_not_matched(
    of_first: list[int], of_second: list[int], said: str
) -> None:
    """The wrong alignment explains more markers than the right one.

    In the second case the right one explains three only: nothing but the part's symmetry warns.
    """
    half = np.array([(25, 10, 0), (60, 22, 0), (48, 71, 0), (81, 55, 0), (33, 44, 0)], float)
    part = np.vstack([half, half * [-1.0, 1.0, 1.0]])
    found = match_markers(marker_set(part[of_first]), marker_set(part[of_second]))
    assert isinstance(found, NotUnique)
    assert said in found.reason
