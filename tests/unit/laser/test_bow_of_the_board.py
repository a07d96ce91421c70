# SPDX-License-Identifier: Apache-2.0
"""What views that show no bow of the board leave likely of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate

from armscan.calibration.sheets import board_points
from armscan.calibration.sheets.board_points import (
    LIKELY_BOARD_BOWS,
    BoardBow,
    HeadCameras,
    find_board_bow,
    find_bow,
)
from armscan.calibration.sheets.result import BoardStripes, PlacedBoard
from armscan.geometry.arrays import FloatArray
from armscan.records.exposure import Exposure
from armscan.vision.targets.detect import numberings, renumbered
from armscan.vision.targets.target import CircleGrid, TargetView
from rigs.fan_rig import fan_rig
from rigs.sheet_rig import SheetRig, project, thesis_rig

HALF_MM = 150.0
SIZES_MM = LIKELY_BOARD_BOWS * HALF_MM
BY_CAMERAS = np.arange(18.0).reshape(2, 9)
ENDS = -HALF_MM * np.ones(2), HALF_MM * np.ones(2)


def found(bow_mm: FloatArray, covariance: FloatArray) -> BoardBow:
    return BoardBow(bow_mm, covariance, BY_CAMERAS, *ENDS)


@pytest.mark.parametrize("noise_mm", [0.003, 0.03, 0.3])
def test_boards_of_any_size_of_bow_err_as_stated(noise_mm: float) -> None:
    """Squares of 4000 bows over those stated for each: 1 within four standard errors.

    Were all boards taken to bow by the rms of these sizes, 0.77 and 0.48 of the first two.
    """
    rng = np.random.default_rng(4)
    covariance = noise_mm**2 * np.array([[1.0, 0.3], [0.3, 0.5]])
    root = np.linalg.cholesky(covariance)
    squares = np.zeros(4000)
    for k, size in enumerate(rng.choice(SIZES_MM, len(squares))):
        true = size * rng.standard_normal(2)
        held = found(true + root @ rng.standard_normal(2), covariance).held_at_zero(SIZES_MM)
        assert not held.bow_mm.any()
        squares[k] = true @ true / np.trace(held.covariance_mm2)
    error = float(np.std(squares)) / np.sqrt(len(squares))
    assert error < 0.05
    assert np.mean(squares) == pytest.approx(1.0, abs=4.0 * error)


def test_one_size_by_hand() -> None:
    """Bayes's rule in one dimension, integrated: mean square of what is left of a bow of 0.02.

    Of what the cameras move in the bow found as much is left as of the bow: 9 of 9 + 1 parts.
    """
    held = found(np.array([0.02, 0.0]), 0.01**2 * np.eye(2)).held_at_zero(np.array([0.03]))

    def weight(bow: float) -> float:
        return float(np.exp(-0.5 * ((bow - 0.02) / 0.01) ** 2 - 0.5 * (bow / 0.03) ** 2))

    mass = integrate.quad(weight, -0.3, 0.3, points=[0.02])[0]
    square = integrate.quad(lambda bow: bow**2 * weight(bow), -0.3, 0.3, points=[0.02])[0] / mass
    assert held.covariance_mm2[0, 0] == pytest.approx(square, rel=1e-6)
    assert held.by_cameras == pytest.approx(0.9 * BY_CAMERAS)


@pytest.mark.parametrize("stated_mm", [None, 0.05, 0.0])
def test_of_two_views_a_bow_is_as_likely_as_before(stated_mm: float | None) -> None:
    rig = thesis_rig()
    camera = rig.noisy_camera(np.random.default_rng(1))
    views = [rig.view(k, np.random.default_rng(k)) for k in range(2)]
    bow = find_board_bow(views, HeadCameras.of(rig.calibration(camera)), stated_mm)
    if stated_mm == 0.0:
        assert bow is None
        return
    assert bow is not None
    half_mm = 0.5 * float(np.ptp(views[0].points_board_mm, axis=0).max())
    rms_mm = stated_mm or half_mm * float(np.sqrt(np.mean(LIKELY_BOARD_BOWS**2)))
    assert bow.covariance_mm2 == pytest.approx(rms_mm**2 * np.eye(2))
    assert not bow.bow_mm.any()


def bowed_view(rig: SheetRig, k: int, bow_mm: tuple[float, float]) -> TargetView:
    """What the camera sees of a bowed board in place ``k``."""
    rng, board = np.random.default_rng(k), rig.board_points_mm()
    low, high = board.min(axis=0)[:2], board.max(axis=0)[:2]
    board[:, 2] = (1.0 - ((2.0 * board[:, :2] - low - high) / (high - low)) ** 2) @ bow_mm
    seen = project(rig.camera, rig.poses[k], board)
    noise_px = rng.normal(0.0, rig.sigma_corner_px, seen.shape)
    return replace(rig.view(k, rng), points_px=seen + noise_px)


def test_of_a_square_target_only_the_mean_of_both_bows_is_known() -> None:
    """Its views, every second numbered from another side, swap a bow along x and one along y."""
    rig, target = replace(thesis_rig(), columns=8, rows=8), CircleGrid(8, 8, 4.0)
    quarter = numberings(target)[1]
    assert quarter.quarter_turns == 1
    blank, no_points = Exposure(np.zeros((9, 9), np.uint8), "0.png"), np.zeros(0, dtype=np.int64)
    for columns in (8, 7):
        grid = CircleGrid(columns, 8, 4.0)
        empty = np.zeros((0, 2)), np.zeros((0, 2, 2))
        assert TargetView.of_image(blank, grid, no_points, *empty).is_square == (columns == 8)
    bowed = [replace(bowed_view(rig, k, (0.15, 0.0)), is_square=True) for k in range(6)]
    views = [renumbered(v, target, quarter) if k % 2 else v for k, v in enumerate(bowed)]
    cameras = HeadCameras.of(rig.calibration(rig.camera))
    bow = find_board_bow(views, cameras)
    assert bow is not None
    assert bow.bow_mm == pytest.approx([0.075, 0.075], abs=0.01)
    assert bow.bow_mm[0] == bow.bow_mm[1]
    for true_mm in ((0.15, 0.0), (0.0, 0.15)):
        off = true_mm - bow.bow_mm
        assert off @ np.linalg.solve(bow.covariance_mm2, off) < 13.8
    assert np.sqrt(np.ones(2) @ bow.covariance_mm2 @ np.ones(2)) < 0.02
    told = find_board_bow([replace(view, is_square=False) for view in bowed], cameras)
    assert told is not None
    assert told.bow_mm == pytest.approx([0.15, 0.0], abs=0.01)


def of_camera(boards: list[BoardStripes], camera: int) -> list[BoardStripes]:
    """Those that one camera saw with a stripe."""
    return [board for board in boards if board.camera == camera]


def test_boards_that_the_right_camera_alone_sees_may_be_bowed() -> None:
    rig = fan_rig(3, 14, 5)
    stereo = rig.stereo()
    boards = of_camera(rig.boards(stereo, np.random.default_rng(3))[0], 1)
    bow, placed = find_bow(boards, HeadCameras.of(stereo), None)
    assert bow is not None
    assert not bow.bow_mm.any() and np.diag(bow.covariance_mm2).min() > 0.0
    assert bow.by_cameras[:, 9:18].any() and not bow.by_cameras[:, :9].any()
    widths = {one.placed.by_cameras.shape[1] for one in placed if one.placed is not None}
    assert widths == {24 + 2}
    assert find_bow(boards, HeadCameras.of(stereo), 0.0)[0] is None


@pytest.mark.parametrize("bow_mm", [(0.0, 0.0), (0.06, -0.03)])
def test_what_a_camera_without_stripes_saw_of_a_board_is_kept(
    bow_mm: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The board lies where both cameras saw it, and follows its bow as if both showed a stripe."""
    rig = replace(fan_rig(3, 14, 5), sigma_corner_px=0.5)
    stereo = rig.stereo()
    cameras = HeadCameras.of(stereo)
    boards = rig.boards(stereo, np.random.default_rng(3))[0]
    found = find_board_bow([board.view for board in of_camera(boards, 0)], cameras)
    assert found is not None
    bow = replace(found, bow_mm=np.array(bow_mm))
    monkeypatch.setattr(board_points, "find_board_bow", lambda *_: bow)

    def placed_by(seen: list[BoardStripes]) -> dict[str, PlacedBoard]:
        moved = find_bow(seen, cameras, None)[1]
        return {board.place: board.placed for board in moved if board.placed is not None}

    seen_by_both = {b.place for b in of_camera(boards, 1)} & {b.place for b in of_camera(boards, 0)}
    both, left = placed_by(boards), placed_by(of_camera(boards, 0))
    given = {board.place: board.placed for board in boards if board.placed is not None}
    assert len(seen_by_both) > 2
    for place in seen_by_both:
        step = left[place].sensor_from_board.step_from(both[place].sensor_from_board)
        moved = both[place].sensor_from_board.step_from(given[place].sensor_from_board)
        # of points so uncertain the bow leaves residuals and weights nearly as they are
        assert np.abs(step).max() < 1e-12 + 0.15 * np.abs(moved).max()
        by_both, by_left = (found[place].by_cameras[:, 24:] for found in (both, left))
        assert np.abs(by_left - by_both).max() < 0.1 * np.abs(by_both).max()
        if not bow.bow_mm.any():
            assert (left[place].covariance == given[place].covariance).all()
