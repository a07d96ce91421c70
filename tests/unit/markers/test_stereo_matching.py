# SPDX-License-Identifier: Apache-2.0
"""Rings matched in random scenes before the stereo head of the thesis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import OptionError
from armscan.markers.candidates import RingMatchOptions, find_candidates
from armscan.markers.stereo_matching import RingStatus, StereoMatches, match_rings
from armscan.records.points import RingImages
from rigs.ring_pair_scenes import (
    CALIBRATION_COVARIANCE,
    RADIUS_MM,
    MarkerScene,
    random_scene,
    true_views,
)
from rigs.stereo_rig import project_right

N_SCENES = 45


def matched(scene: MarkerScene, options: RingMatchOptions | None = None) -> StereoMatches:
    return match_rings(scene.left, scene.right, scene.views, CALIBRATION_COVARIANCE, options)


def some_of(rings: RingImages, rows: object) -> RingImages:
    arrays = (
        "centres_px",
        "covariance_px2",
        "outer_half_px",
        "inner_half_px",
        "direction_rad",
        "contrast",
        "perimeter_px",
        "roundness",
    )
    return replace(rings, **{name: getattr(rings, name)[rows] for name in arrays})


@pytest.fixture(scope="module")
def results() -> list[tuple[MarkerScene, StereoMatches]]:
    scenes = [random_scene(seed) for seed in range(1000, 1000 + N_SCENES)]
    return [(scene, matched(scene)) for scene in scenes]


def test_no_wrong_pair_and_most_are_matched(
    results: list[tuple[MarkerScene, StereoMatches]],
) -> None:
    n_right = 0
    for scene, matches in results:
        left, right = scene.left_marker[matches.left], scene.right_marker[matches.right]
        np.testing.assert_array_equal(left, right)
        n_right += len(left)
    assert n_right >= 0.95 * sum(scene.seen_by_both for scene, _ in results)


def test_every_ring_has_its_status(results: list[tuple[MarkerScene, StereoMatches]]) -> None:
    for scene, matches in results:
        assert sum(matches.counts.values()) == len(scene.left)
        assert matches.counts[RingStatus.MATCHED] == len(matches.left)
        rows = [k for k, status in enumerate(matches.statuses) if status is RingStatus.MATCHED]
        np.testing.assert_array_equal(np.sort(matches.left), rows)
        np.testing.assert_array_equal(matches.markers.ids, matches.left)


def test_epipolar_distances_scatter_as_their_sigma_says(
    results: list[tuple[MarkerScene, StereoMatches]],
) -> None:
    """Errors of a calibration are common to a scene: its mean square scatters between scenes."""
    squares = [np.mean((m.distance_px / m.sigma_px) ** 2) for _, m in results if len(m.left)]
    # Calibration and centres contribute alike here; 45 scenes: 1 +- 0.15.
    assert np.mean(squares) == pytest.approx(1.0, abs=0.45)


def test_markers_are_where_they_are() -> None:
    """With the true cameras the error is that of the centres: mean normalised square 3."""
    squares = []
    for seed in range(9):
        scene = replace(random_scene(seed), views=true_views())
        matches = match_rings(scene.left, scene.right, scene.views, np.zeros((24, 24)))
        error = matches.markers.points_mm - scene.points_mm[scene.left_marker[matches.left]]
        inverse = np.linalg.inv(matches.markers.covariance_mm2)
        squares.append(np.einsum("ni,nij,nj->n", error, inverse, error))
    n = sum(map(len, squares))
    assert n > 100
    assert np.mean(np.concatenate(squares)) == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / n))


def test_a_partner_that_was_not_seen_is_not_replaced() -> None:
    """A ring that has candidates, though its marker is not in the right image."""
    n_tried = 0
    for seed in range(40):
        scene = random_scene(seed)
        pairs = find_candidates(
            scene.left, scene.right, scene.views, CALIBRATION_COVARIANCE, RingMatchOptions()
        )
        is_alone = ~np.isin(scene.left_marker, scene.right_marker)
        tempted = np.unique(pairs.left[is_alone[pairs.left]])
        n_tried += len(tempted)
        statuses = matched(scene).statuses
        assert all(statuses[row] is not RingStatus.MATCHED for row in tempted)
    assert n_tried >= 5


def test_rows_along_the_epipolar_lines_are_not_guessed() -> None:
    """An even row of markers along one epipolar line, shifted by one place, fits as well."""
    views, scene = true_views(), random_scene(0)
    places = np.column_stack([np.linspace(-27.0, 27.0, 7), np.zeros(7), np.full(7, 140.0)])
    left_px, right_px = views.left.project(places), project_right(views, places)
    n = len(places)

    def rings(centres: np.ndarray) -> RingImages:
        shown = some_of(scene.left, np.zeros(n, np.int64))
        return replace(shown, centres_px=centres)

    wide = RingMatchOptions(size_tolerance=1.0)
    matches = match_rings(rings(left_px), rings(right_px), views, CALIBRATION_COVARIANCE, wide)
    assert len(matches.left) == 0
    assert matches.n_candidates > 2 * n


def test_known_size_and_depth_leave_fewer_candidates() -> None:
    scene = random_scene(5)
    plain, sized, near, other = (
        matched(scene, RingMatchOptions(**options))
        for options in (
            {"size_tolerance": 1.0},
            {"diameter_mm": 2.0 * RADIUS_MM},
            {"depth_mm": (10.0, 60.0)},
            {"diameter_mm": 3.0 * RADIUS_MM},
        )
    )
    assert sized.n_candidates < plain.n_candidates
    assert len(sized.left) >= len(plain.left) > 10
    assert near.n_candidates == 0
    assert other.n_candidates < 5
    assert len(other.left) == 0


def test_rings_of_another_size_than_given_are_told_from_rings_without_partner() -> None:
    scene = random_scene(3, missing=0.0)
    plain = matched(scene)
    sized = matched(scene, RingMatchOptions(diameter_mm=2.2 * RADIUS_MM))
    assert len(sized.left) == 0
    for before, now in zip(plain.statuses, sized.statuses, strict=True):
        is_alone = before is RingStatus.NO_PARTNER
        assert now is (RingStatus.NO_PARTNER if is_alone else RingStatus.WRONG_SIZE)


def test_three_rings_are_matched_only_if_their_size_is_known() -> None:
    """A pair is checked against three others: with two there is only its size."""
    scene = random_scene(3, missing=0.0)
    common = np.intersect1d(scene.left_marker, scene.right_marker)[:3]
    left, right = (
        some_of(rings, np.flatnonzero(np.isin(markers, common)))
        for rings, markers in (
            (scene.left, scene.left_marker),
            (scene.right, scene.right_marker),
        )
    )
    matches = match_rings(left, right, scene.views, CALIBRATION_COVARIANCE)
    assert set(matches.statuses) == {RingStatus.UNSUPPORTED}
    sized = match_rings(
        left,
        right,
        scene.views,
        CALIBRATION_COVARIANCE,
        RingMatchOptions(diameter_mm=2.0 * RADIUS_MM),
    )
    assert set(sized.statuses) == {RingStatus.MATCHED}
    none = match_rings(some_of(left, []), right, scene.views, CALIBRATION_COVARIANCE)
    assert len(none.left) == 0
    assert none.statuses == ()


def test_order_of_rings_changes_nothing() -> None:
    scene = random_scene(7)
    turn = np.random.default_rng(0).permutation(len(scene.left))
    plain = matched(scene)
    shuffled = match_rings(
        some_of(scene.left, turn), scene.right, scene.views, CALIBRATION_COVARIANCE
    )
    one = set(zip(plain.left.tolist(), plain.right.tolist(), strict=True))
    two = set(zip(turn[shuffled.left].tolist(), shuffled.right.tolist(), strict=True))
    assert one == two


def test_the_threshold_is_in_sigmas() -> None:
    """A right image shifted across the epipolar lines by many sigmas has no candidate."""
    scene = random_scene(2, missing=0.0)
    moved = replace(scene.right, centres_px=scene.right.centres_px + np.array([0.0, 6.0]))
    matches = match_rings(scene.left, moved, scene.views, CALIBRATION_COVARIANCE)
    assert len(matches.left) == 0


def test_diameters_are_those_of_the_markers() -> None:
    """Half axes carry 0.1 px of 90; the circle's own size on the sphere 0.0003."""
    scene = random_scene(4)
    pairs = find_candidates(
        scene.left, scene.right, true_views(), CALIBRATION_COVARIANCE, RingMatchOptions()
    )
    is_true = scene.left_marker[pairs.left] == scene.right_marker[pairs.right]
    error = pairs.diameter_mm[is_true] / (2.0 * RADIUS_MM) - 1.0
    assert np.abs(error).max() < 5.0 * 0.1 / 90.0 / np.sqrt(2.0) + 0.004


def test_markers_of_several_sizes_are_matched_by_their_neighbours() -> None:
    """Sizes that differ say nothing about depth; the two images must still agree."""
    n_right = n_both = 0
    for seed in range(12):
        scene = random_scene(seed)
        factor = 0.7 + 0.6 * np.random.default_rng(seed).random(60)
        left, right = (
            replace(rings, outer_half_px=rings.outer_half_px * factor[markers][:, None])
            for rings, markers in (
                (scene.left, scene.left_marker),
                (scene.right, scene.right_marker),
            )
        )
        matches = match_rings(left, right, scene.views, CALIBRATION_COVARIANCE)
        found = scene.left_marker[matches.left] == scene.right_marker[matches.right]
        assert found.all()
        n_right, n_both = n_right + len(found), n_both + scene.seen_by_both
    assert n_right >= 0.93 * n_both


@pytest.mark.parametrize("change", [{"depth_mm": (200.0, 100.0)}, {"diameter_mm": -1.0}])
def test_options_are_checked(change: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        RingMatchOptions(**change)  # type: ignore[arg-type]
