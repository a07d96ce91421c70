# SPDX-License-Identifier: Apache-2.0
"""ChArUco boards as OpenCV draws them, in the new and the old layout."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray, apply_homography
from armscan.geometry.estimate import FitFailure
from armscan.pipeline.targets import find_targets
from armscan.records.exposure import Exposure
from armscan.vision.targets.detect import detect_target, settle_target
from armscan.vision.targets.target import (
    Charuco,
    CharucoLayout,
    TargetView,
    describe_target,
    parse_target,
)

PX_PER_SQUARE = 40
DICTIONARY = "DICT_4X4_250"
ODD = Charuco(9, 6, 4.0, 3.0, DICTIONARY)
EVEN = Charuco(8, 6, 4.0, 3.0, DICTIONARY)
LAYOUTS: list[CharucoLayout] = ["new", "old"]


def photograph(
    board: Charuco, columns: tuple[int, int] | None = None, source: str = "drawn"
) -> tuple[Exposure, FloatArray]:
    """OpenCV's drawing seen at an angle, and its corners (N, 2), pixels.

    Squares outside ``columns``, first and one after the last, are hidden.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    size = (board.columns, board.rows)
    printed = cv2.aruco.CharucoBoard(size, board.square_mm, board.marker_mm, dictionary)
    printed.setLegacyPattern(board.layout == "old")
    side = PX_PER_SQUARE
    drawn = printed.generateImage((side * board.columns, side * board.rows))
    if columns is not None:
        drawn[:, : side * columns[0]] = 255
        drawn[:, side * columns[1] :] = 255
    turn = np.deg2rad(20.0)
    seen = np.array(
        [
            [1.1 * np.cos(turn), -np.sin(turn), 150.0],
            [np.sin(turn), 1.2 * np.cos(turn), 40.0],
            [2e-4, -3e-4, 1.0],
        ]
    )
    image = cv2.warpPerspective(drawn, seen, (700, 600), borderValue=(255,))
    noise = np.random.default_rng(0).normal(0.0, 2.0, image.shape)
    blurred = cv2.GaussianBlur(image, (0, 0), 0.8) * 0.8 + 20.0
    corners = board.points_board_mm[:, :2] * (side / board.square_mm) - 0.5
    levels = np.clip(np.rint(blurred + noise), 0, 255).astype(np.uint8)
    return Exposure(levels, source), apply_homography(seen, corners)


@pytest.mark.parametrize("board", [ODD, EVEN, Charuco(8, 7, 4.0, 3.0, DICTIONARY)], ids=str)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_corners_of_both_layouts_bear_their_numbers(board: Charuco, layout: CharucoLayout) -> None:
    exposure, corners_px = photograph(replace(board, layout=layout))
    view = detect_target(exposure, board)
    assert isinstance(view, TargetView)
    assert len(view) >= 0.9 * len(corners_px)
    np.testing.assert_allclose(view.points_px, corners_px[view.point_index], atol=0.2)
    np.testing.assert_allclose(view.points_board_mm, board.points_board_mm[view.point_index])


@pytest.mark.parametrize("board", [ODD, EVEN], ids=str)
@pytest.mark.parametrize(("layout", "other"), [("new", "old"), ("old", "new")])
def test_the_wrong_layout_is_refused_and_the_right_one_named(
    board: Charuco, layout: CharucoLayout, other: CharucoLayout
) -> None:
    exposure, _ = photograph(replace(board, layout=layout))
    failure = detect_target(exposure, replace(board, layout=other))
    assert isinstance(failure, FitFailure)
    assert f"{DICTIONARY}:{layout}" in failure.reason
    right = parse_target(failure.remedy.removeprefix("write "))
    assert isinstance(detect_target(exposure, right), TargetView)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_swapped_counts_are_refused_and_the_right_ones_named(layout: CharucoLayout) -> None:
    exposure, _ = photograph(replace(ODD, layout=layout))
    failure = detect_target(exposure, replace(ODD, columns=ODD.rows, rows=ODD.columns))
    assert isinstance(failure, FitFailure)
    assert f"charuco:9x6:4:3:{DICTIONARY}:{layout}" in failure.reason


def test_a_count_that_is_wrong_by_one_is_refused() -> None:
    exposure, _ = photograph(replace(ODD, layout="new"))
    for columns in (8, 10):
        failure = detect_target(exposure, replace(ODD, columns=columns))
        assert isinstance(failure, FitFailure)
        assert f"{columns} x 6 squares" in failure.reason


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_part_that_fits_both_layouts_is_numbered_as_the_set_tells(layout: CharucoLayout) -> None:
    board = replace(ODD, layout=layout)
    part, corners_px = photograph(board, columns=(2, 7), source="part")
    alone = detect_target(part, ODD)
    assert isinstance(alone, FitFailure)
    assert "new and old" in alone.reason
    whole, _ = photograph(board, source="whole")
    assert settle_target([part, whole], ODD) == board
    found = find_targets([part, whole], ODD)
    view = found.views[0]
    assert [item.source for item in found.views] == ["part", "whole"]
    assert 6 <= len(view) < len(corners_px)
    np.testing.assert_allclose(view.points_px, corners_px[view.point_index], atol=0.2)


def test_an_old_layout_is_described_and_an_open_one_stays_open_without_a_board() -> None:
    assert "old layout" in describe_target(replace(ODD, layout="old"))
    assert "layout" not in describe_target(replace(ODD, layout="new"))
    blank = Exposure(np.full((200, 300), 90, np.uint8), "blank")
    assert settle_target([blank], ODD) == ODD
