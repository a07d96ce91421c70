# SPDX-License-Identifier: Apache-2.0
"""Targets that look the same when turned: the numbering in which all pairs agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.cameras.calibrate_stereo import calibrate_stereo
from armscan.calibration.cameras.pairs import StereoOptions, StereoPair
from armscan.calibration.cameras.result import CameraOptions
from armscan.calibration.cameras.stereo_result import StereoFit
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import CameraRight, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector
from armscan.models.two_views import TwoViews
from armscan.pipeline.cameras import StereoRun, calibrate_stereo_from_pairs
from armscan.vision.targets.detect import numberings, renumbered
from armscan.vision.targets.target import Charuco, Chessboard, CircleGrid, Target
from rigs.stereo_rig import (
    CONVERGING,
    LEFT,
    RIGHT,
    StereoScene,
    held,
    make_pairs,
    normalised_stereo_error,
    pair_at,
)

OPTIONS = StereoOptions(CameraOptions(distortion="k1k2p1p2k3", n_folds=0), n_folds=0)
LIKELY = 51.2
"""99.9 % point of chi-squared with 24 degrees of freedom."""

SCENE = StereoScene(n_pairs=8, is_ambiguous=True)
SQUARE = replace(SCENE, target=CircleGrid(9, 9, 12.0))


def turned(pair: StereoPair, target: Target, left: int, right: int) -> StereoPair:
    """The pair as a detector may number it: each view turned by its own quarter turns."""
    of = {numbering.quarter_turns: numbering for numbering in numberings(target)}
    views = [
        None if view is None else renumbered(view, target, of[turns])
        for view, turns in zip(pair.views, (left, right), strict=True)
    ]
    return StereoPair(views[0], views[1])


def solved(pairs: list[StereoPair], target: Target) -> StereoFit:
    fit = calibrate_stereo(pairs, target, OPTIONS)
    assert isinstance(fit, StereoFit), fit
    return fit


@pytest.mark.parametrize(
    ("target", "turns"),
    [
        (CircleGrid(11, 9, 3.0), [0, 2]),
        (CircleGrid(6, 6, 3.0), [0, 1, 2, 3]),
        (CircleGrid(4, 11, 3.0, is_asymmetric=True), [0]),
        (CircleGrid(4, 10, 3.0, is_asymmetric=True), [0, 2]),
        (Chessboard(9, 6, 3.0), [0]),
        (Chessboard(8, 6, 3.0), [0, 2]),
        (Chessboard(6, 6, 3.0), [0, 1, 2, 3]),
        (Chessboard(7, 7, 3.0), [0, 2]),
        (Charuco(6, 6, 4.0, 3.0, "DICT_4X4_50"), [0]),
    ],
)
def test_which_targets_can_be_numbered_in_several_ways(target: Target, turns: list[int]) -> None:
    found = numberings(target)
    assert [numbering.quarter_turns for numbering in found] == turns
    points = target.points_board_mm
    for numbering in found:
        assert sorted(numbering.new_index.tolist()) == list(range(len(points)))
        pose = numbering.new_from_found
        carried = points @ pose.rotation.T + pose.translation_mm
        assert np.abs(carried - points[numbering.new_index]).max() < 1e-12 * points.max()


def test_colours_of_a_square_chessboard_decide_on_quarter_turns() -> None:
    """By hand: fields around the inner corners, dark where the sum of their indices is even."""
    for n, may_turn in ((6, True), (7, False)):
        fields = np.indices((n + 1, n + 1)).sum(axis=0) % 2
        assert np.array_equal(np.rot90(fields), fields) is may_turn
        assert (len(numberings(Chessboard(n, n, 1.0))) == 4) is may_turn


@pytest.mark.parametrize("seed", range(4))
def test_half_turns_in_any_image_are_undone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pairs = make_pairs(SCENE, seed)[0]
    given = rng.choice([0, 2], (len(pairs), 2)).tolist()
    mixed = [turned(p, SCENE.target, *g) for p, g in zip(pairs, given, strict=True)]
    fit = solved(mixed, SCENE.target)
    assert [pair.quarter_turns for pair in fit.pairs] == [(a - b) % 4 for a, b in given]
    assert normalised_stereo_error(SCENE.views, fit) < LIKELY


def test_quarter_turns_of_a_square_grid_are_undone() -> None:
    pairs = make_pairs(SQUARE, 1)[0]
    given = np.random.default_rng(1).integers(0, 4, (len(pairs), 2)).tolist()
    mixed = [turned(p, SQUARE.target, *g) for p, g in zip(pairs, given, strict=True)]
    fit = solved(mixed, SQUARE.target)
    assert [pair.quarter_turns for pair in fit.pairs] == [(a - b) % 4 for a, b in given]
    assert normalised_stereo_error(SQUARE.views, fit) < LIKELY
    assert any("numbers were turned" in warning for warning in fit.warnings)


def test_cameras_upside_down_to_each_other() -> None:
    """A detector that numbers so that x points to the right turns every right image by half."""
    spun = rotation_from_vector(np.array([0.0, 0.0, np.pi]))
    pose: Pose[CameraRight, Sensor] = Pose(
        spun @ CONVERGING.rotation, spun @ CONVERGING.translation_mm
    )
    scene = replace(SCENE, views=TwoViews(LEFT, RIGHT, pose))
    rng = np.random.default_rng(0)
    poses = make_pairs(SCENE, 0)[1]
    pairs = [pair_at(scene, board, rng, k) for k, board in enumerate(poses)]
    fit = solved([turned(pair, scene.target, 0, 2) for pair in pairs], scene.target)
    assert {pair.quarter_turns for pair in fit.pairs} == {2}
    assert normalised_stereo_error(scene.views, fit) < LIKELY


def test_a_wrong_pair_among_ambiguous_ones_is_still_named() -> None:
    pairs = make_pairs(SCENE, 2)[0]
    other = make_pairs(SCENE, 60)[0][0].right
    assert other is not None
    pairs[4] = StereoPair(pairs[4].left, replace(other, source="right04.png"))
    mixed = [turned(pair, SCENE.target, 0, 2 * (k % 2)) for k, pair in enumerate(pairs)]
    fit = solved(mixed, SCENE.target)
    assert [k for k, pair in enumerate(fit.pairs) if not pair.is_related] == [4]


def test_boards_that_lie_alike_do_not_tell() -> None:
    """Turned about one axis through the middle, along the board's normal: both answers are exact.

    The cameras are given, so that boards parallel to each other are enough.
    """
    rng = np.random.default_rng(0)
    middle = SCENE.target.points_board_mm.mean(axis=0)
    pairs = []
    for number in range(5):
        spin = rotation_from_vector(np.array([0.0, 0.0, 0.1 * number]))
        pose: Pose = Pose(spin, np.array([3.0, -2.0, 280.0]) - spin @ middle)
        pairs.append(pair_at(SCENE, pose, rng, number))
    options = replace(OPTIONS, intrinsics="fixed")
    fit = calibrate_stereo(pairs, SCENE.target, options, (held(LEFT), held(RIGHT)))
    assert isinstance(fit, FitFailure)
    assert "looks the same when it is turned" in fit.reason
    assert "180 degrees" in fit.reason
    assert "chessboard" in fit.remedy


@pytest.mark.parametrize("n_right_only", [0, 6])
@pytest.mark.parametrize(("scene", "turns"), [(SCENE, (0, 2)), (SQUARE, (0, 1, 2, 3))])
def test_pairs_numbered_apart_state_what_pairs_numbered_alike_do(
    scene: StereoScene, turns: tuple[int, ...], n_right_only: int
) -> None:
    """Errors of the print turn with it: taken for others in each pair, they would average out."""
    scene = replace(scene, n_pairs=12, missed_mm=0.01)
    rng = np.random.default_rng(3)
    pairs, _ = make_pairs(scene, 3)
    pairs[-n_right_only or len(pairs) :] = [
        StereoPair(None, pair.right) for pair in pairs[-n_right_only or len(pairs) :]
    ]
    chosen = [(int(rng.choice(turns)), int(rng.choice(turns))) for _ in pairs]
    mixed = [turned(pair, scene.target, *of) for pair, of in zip(pairs, chosen, strict=True)]
    alike, again = (
        calibrate_stereo_from_pairs(given, scene.target, OPTIONS) for given in (pairs, mixed)
    )
    assert isinstance(alike, StereoRun)
    assert isinstance(again, StereoRun)
    assert len({left for left, _ in chosen}) > 1
    assert alike.fit.target_error_mm == pytest.approx(0.01, rel=0.25)
    sigma, expected = (np.sqrt(np.diag(run.fit.covariance)) for run in (again, alike))
    np.testing.assert_allclose(sigma, expected, rtol=1e-4)


def test_a_view_that_cannot_be_used_stays_in_its_pair() -> None:
    """It is in no pair of the solution, by which the others are numbered alike."""
    scene = replace(SCENE, n_pairs=8, missed_mm=0.01)
    pairs = [
        turned(pair, scene.target, *((2, 0) if k % 2 else (0, 2)))
        for k, pair in enumerate(make_pairs(scene, 3)[0])
    ]
    right = pairs[3].right
    assert right is not None
    pairs[3] = StereoPair(pairs[3].left, right.select(np.arange(4)))
    run = calibrate_stereo_from_pairs(pairs, scene.target, OPTIONS)
    assert isinstance(run, StereoRun), run
    assert [pair.is_related for pair in run.fit.pairs] == [k != 3 for k in range(8)]
    assert run.fit.target_error_mm == pytest.approx(0.01, rel=0.25)
