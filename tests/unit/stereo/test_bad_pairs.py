# SPDX-License-Identifier: Apache-2.0
"""Pairs that are no pairs are named, with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.cameras.calibrate_stereo import calibrate_stereo
from armscan.calibration.cameras.pairs import StereoOptions, StereoPair
from armscan.calibration.cameras.relate import BoardSeen, PairNoise, _Stacked, true_order
from armscan.calibration.cameras.result import CameraOptions
from armscan.calibration.cameras.stereo_result import StereoFit
from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose
from armscan.geometry.rotations import rotation_from_vector
from armscan.vision.targets.detect import numberings
from rigs.stereo_rig import CONVERGING, StereoScene, make_pairs, normalised_stereo_error, pair_at

SCENE = StereoScene(n_pairs=8)
OPTIONS = StereoOptions(CameraOptions(distortion="k1k2p1p2k3", n_folds=0), n_folds=0)
LIKELY = 51.2
"""99.9 % point of chi-squared with 24 degrees of freedom."""


def pairs_with_right_of(order: list[int], seed: int = 0) -> list[StereoPair]:
    """Pairs whose right images were put into another order."""
    pairs = make_pairs(SCENE, seed)[0]
    return [StereoPair(pair.left, pairs[k].right) for pair, k in zip(pairs, order, strict=True)]


def moved_pairs(shift_mm: float, seed: int = 0) -> list[StereoPair]:
    """In pair 3 the board moved sideways between the left and the right image."""
    pairs, poses = make_pairs(SCENE, seed)
    pose = poses[3]
    later = Pose(pose.rotation, pose.translation_mm + np.array([0.0, shift_mm, 0.0]))
    pairs[3] = pair_at(SCENE, pose, np.random.default_rng(9), 3, right_pose=later)
    return pairs


def solved(pairs: list[StereoPair], options: StereoOptions = OPTIONS) -> StereoFit:
    fit = calibrate_stereo(pairs, SCENE.target, options)
    assert isinstance(fit, StereoFit), fit
    return fit


def test_good_pairs_are_not_blamed() -> None:
    """Forty-eight good pairs: none is a misfit, and their levels are those of noise."""
    levels = []
    for seed in range(6):
        fit = solved(make_pairs(SCENE, seed)[0])
        assert not any(pair.note for pair in fit.pairs)
        levels += [pair.level * fit.typical_level for pair in fit.pairs]
    # 48 mean squares of six degrees of freedom each; cameras that are not quite known add to them.
    assert 0.8 < float(np.mean(levels)) < 1.6


def test_a_right_image_of_another_instant_is_named_and_taken_apart() -> None:
    pairs = make_pairs(SCENE, 0)[0]
    other = make_pairs(SCENE, 50)[0][0].right
    assert other is not None
    pairs[5] = StereoPair(pairs[5].left, replace(other, source="right05.png"))
    fit = solved(pairs)
    assert [pair.is_related for pair in fit.pairs] == [k != 5 for k in range(8)]
    warning = next(text for text in fit.warnings if text.startswith("left05.png + right05.png"))
    assert "moved between its images, or they are no pair" in warning
    # Its views still count for each camera by itself.
    assert fit.left.n_views == fit.right.n_views == 8
    assert normalised_stereo_error(SCENE.views, fit) < LIKELY


def test_two_right_images_that_were_swapped_are_matched_again() -> None:
    fit = solved(pairs_with_right_of([0, 1, 4, 3, 2, 5, 6, 7]))
    assert [pair.is_related for pair in fit.pairs] == [k not in (2, 4) for k in range(8)]
    assert any("left02.png with right02.png would fit" in text for text in fit.warnings)
    assert any("left04.png with right04.png would fit" in text for text in fit.warnings)


def test_lists_in_different_orders_are_refused_with_the_right_one() -> None:
    fit = calibrate_stereo(pairs_with_right_of([*range(1, 8), 0]), SCENE.target, OPTIONS)
    assert isinstance(fit, FitFailure)
    assert "not in the same order" in fit.reason
    assert "left01.png with right01.png" in fit.reason


def test_the_order_of_long_lists_is_found_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any order of 24 pairs, one without partner; places that are tried grow with their count."""
    rng, n, tried = np.random.default_rng(5), 24, 0
    levels = _Stacked.levels

    def counted(stacked: _Stacked, k: int) -> FloatArray:
        nonlocal tried
        tried += 1
        return levels(stacked, k)

    def seen(turn: FloatArray, place_mm: FloatArray) -> tuple[BoardSeen, ...]:
        covariance = np.diag([1e-8] * 3 + [1e-4] * 3)
        return (BoardSeen(Pose(rotation_from_vector(turn), place_mm), covariance),)

    left = [seen(rng.normal(0.0, 0.4, 3), rng.normal(0.0, 20.0, 3)) for _ in range(n)]
    where = [CONVERGING @ board.camera_from_board for (board,) in left]
    right = [seen(pose.rotation_vector_rad, pose.translation_mm) for pose in where]
    right[7] = seen(rng.normal(0.0, 0.4, 3), rng.normal(0.0, 20.0, 3))
    order = rng.permutation(n)
    monkeypatch.setattr(_Stacked, "levels", counted)
    known = numberings(SCENE.target)[:1]
    found = true_order(left, [right[k] for k in order], known)
    assert found is not None
    assert [int(order[k]) for i, k in enumerate(found) if i != 7] == [i for i in range(n) if i != 7]
    assert tried <= 3 * n


def test_pairs_of_different_instants_throughout_are_refused() -> None:
    left, right = make_pairs(SCENE, 0)[0], make_pairs(SCENE, 70)[0]
    pairs = [StereoPair(a.left, b.right) for a, b in zip(left, right, strict=True)]
    fit = calibrate_stereo(pairs, SCENE.target, OPTIONS)
    assert isinstance(fit, FitFailure)
    assert "do not agree" in fit.reason
    assert "one instant" in fit.remedy


def test_a_board_that_moved_a_little_is_proposed_to_be_left_out() -> None:
    """0.02 mm is 0.17 px, by which all points of the image move alike, with noise of 0.05 px."""
    pairs = moved_pairs(0.02)
    fit = solved(pairs)
    misfits = [k for k, pair in enumerate(fit.pairs) if pair.note]
    assert misfits == [3]
    harmed = normalised_stereo_error(SCENE.views, fit)
    freed = solved(pairs, replace(OPTIONS, leave_out_misfits=True))
    assert not freed.pairs[3].is_related
    assert normalised_stereo_error(SCENE.views, freed) < min(LIKELY, harmed)
    by_hand = solved(pairs, replace(OPTIONS, leave_out=("right03.png",)))
    assert len(by_hand.pairs) == 7
    assert normalised_stereo_error(SCENE.views, by_hand) < LIKELY


@pytest.mark.parametrize("shift_mm", [0.5, 20.0])
def test_a_board_that_moved_much_is_taken_apart(shift_mm: float) -> None:
    fit = solved(moved_pairs(shift_mm))
    assert [k for k, pair in enumerate(fit.pairs) if not pair.is_related] == [3]
    assert normalised_stereo_error(SCENE.views, fit) < LIKELY


def test_one_of_three_pairs_that_is_wrong_leaves_too_few() -> None:
    pairs = moved_pairs(20.0)[1:4]
    fit = calibrate_stereo(pairs, SCENE.target, OPTIONS)
    assert isinstance(fit, FitFailure)
    assert "2 pairs tell where the cameras are to each other, 3 are needed" in fit.reason
    assert "left03.png" in fit.reason


def test_of_three_pairs_none_is_left_out_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two that are left would not say which of them is wrong."""
    misfit = PairNoise(np.array([1.0, 1.0, 10.0]), 1.0, np.array([False, False, True]))
    monkeypatch.setattr(
        "armscan.calibration.cameras.calibrate_stereo.compare_pairs", lambda *_: misfit
    )
    pairs = make_pairs(SCENE, 0)[0][:3]
    assert [pair.is_misfit for pair in solved(pairs).pairs] == [False, False, True]
    fit = calibrate_stereo(pairs, SCENE.target, replace(OPTIONS, leave_out_misfits=True))
    assert isinstance(fit, FitFailure)
    assert "2 pairs tell where the cameras are to each other, 3 are needed" in fit.reason
    assert "left02.png + right02.png: taken apart" in fit.reason


def test_a_camera_that_shook_between_pairs_is_said() -> None:
    """The right camera turns by 0.02 degrees from pair to pair: no pair is worse than another."""
    rng = np.random.default_rng(4)
    poses = make_pairs(SCENE, 0)[1]
    pairs = []
    for number, pose in enumerate(poses):
        turn = rotation_from_vector(np.deg2rad(0.02) * rng.normal(size=3))
        shaken: Pose = Pose(turn @ CONVERGING.rotation, turn @ CONVERGING.translation_mm)
        views = replace(SCENE.views, right_from_left=shaken)
        pairs.append(pair_at(replace(SCENE, views=views), pose, rng, number))
    fit = solved(pairs)
    assert any("further apart than their noise allows" in text for text in fit.warnings)


def test_too_few_pairs() -> None:
    pairs = make_pairs(SCENE, 0)[0]
    fit = calibrate_stereo(pairs[:2], SCENE.target, OPTIONS)
    assert isinstance(fit, FitFailure)
    assert fit.reason.startswith("2 pairs")
    lonely = pairs[:2] + [StereoPair(pair.left, None) for pair in pairs[2:]]
    assert isinstance(calibrate_stereo(lonely, SCENE.target, OPTIONS), FitFailure)


def test_parallel_boards_name_the_camera() -> None:
    flat = replace(SCENE, max_tilt_deg=0.0)
    fit = calibrate_stereo(make_pairs(flat, 0)[0], flat.target, OPTIONS)
    assert isinstance(fit, FitFailure)
    assert fit.reason.startswith("left camera: ")


def test_names_that_are_wrong() -> None:
    pairs = make_pairs(SCENE, 0)[0]
    with pytest.raises(InputError, match="share a name: left00"):
        calibrate_stereo([pairs[0], *pairs], SCENE.target, OPTIONS)
    with pytest.raises(OptionError, match="no such image"):
        calibrate_stereo(pairs, SCENE.target, replace(OPTIONS, leave_out=("x.png",)))
    small = pairs[0].left
    assert small is not None
    pairs[0] = StereoPair(replace(small, width_px=1000), pairs[0].right)
    with pytest.raises(InputError, match="different sizes"):
        calibrate_stereo(pairs, SCENE.target, OPTIONS)


def test_an_image_of_another_board_is_named() -> None:
    """A board of another pitch fits the camera as well, and puts the other one elsewhere."""
    pairs = make_pairs(SCENE, 0)[0]
    wrong = pairs[1].right
    assert wrong is not None
    pairs[1] = StereoPair(
        pairs[1].left, replace(wrong, points_board_mm=1.3 * wrong.points_board_mm)
    )
    fit = solved(pairs)
    assert [k for k, pair in enumerate(fit.pairs) if not pair.is_related] == [1]
    assert any(text.startswith("left01.png + right01.png: ") for text in fit.warnings)
    assert normalised_stereo_error(SCENE.views, fit) < LIKELY
