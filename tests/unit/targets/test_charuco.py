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
    numbers = np.arange(board.first_id, board.first_id + board.columns * board.rows // 2)
    printed = cv2.aruco.CharucoBoard(size, board.square_mm, board.marker_mm, dictionary, numbers)
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


@pytest.mark.parametrize("board", [ODD, EVEN], ids=str)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_markers_may_begin_at_any_number(board: Charuco, layout: CharucoLayout) -> None:
    shown = replace(board, layout=layout, first_id=31)
    exposure, corners_px = photograph(shown)
    view = detect_target(exposure, replace(board, first_id=31))
    assert isinstance(view, TargetView)
    assert len(view) >= 0.9 * len(corners_px)
    np.testing.assert_allclose(view.points_px, corners_px[view.point_index], atol=0.2)
    assert settle_target([exposure], replace(board, first_id=31)) == shown


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("first", [5, 31, 100])
def test_a_wrong_first_number_is_refused_and_the_right_one_named(
    layout: CharucoLayout, first: int
) -> None:
    exposure, corners_px = photograph(replace(ODD, layout=layout, first_id=first))
    failure = detect_target(exposure, ODD)
    assert isinstance(failure, FitFailure)
    right = parse_target(failure.remedy.split()[-1])
    assert isinstance(right, Charuco)
    assert right.first_id == first
    view = detect_target(exposure, right)
    assert isinstance(view, TargetView)
    np.testing.assert_allclose(view.points_px, corners_px[view.point_index], atol=0.2)


def test_a_wrong_first_number_is_refused_of_a_part_of_the_board_too() -> None:
    """All numbers are on the board that was asked for, and most neighbours beside each other."""
    exposure, _ = photograph(replace(ODD, layout="new", first_id=3))
    upper = Exposure(np.ascontiguousarray(exposure.image[:285]), "upper")
    failure = detect_target(upper, ODD)
    assert isinstance(failure, FitFailure)
    assert "first=3" in failure.remedy
    assert isinstance(detect_target(upper, replace(ODD, first_id=3)), TargetView)


@pytest.mark.parametrize("first", [9, 18])
def test_a_board_that_goes_on_beyond_its_numbers_is_refused(first: int) -> None:
    """Its markers are those of another, two rows on: every neighbour lies where it should."""
    exposure, _ = photograph(replace(ODD, layout="new", first_id=first))
    failure = detect_target(exposure, ODD)
    assert isinstance(failure, FitFailure)
    assert f"{first} to {first + 26} were read" in failure.reason
    assert f":first={first}" in failure.remedy
    fewer_rows = detect_target(exposure, replace(ODD, rows=4, first_id=first))
    assert isinstance(fewer_rows, FitFailure)
    assert "goes on" in fewer_rows.reason


def test_an_old_layout_is_described_and_an_open_one_stays_open_without_a_board() -> None:
    assert "old layout" in describe_target(replace(ODD, layout="old"))
    assert "layout" not in describe_target(replace(ODD, layout="new"))
    blank = Exposure(np.full((200, 300), 90, np.uint8), "blank")
    assert settle_target([blank], ODD) == ODD


def outlines_px(board: Charuco, corners_px: FloatArray) -> FloatArray:
    """Corners (M, 4, 2) of the markers' squares, pixels, from where the inner corners lie."""
    inner = board.points_board_mm[:, :2] / board.square_mm
    found, _ = cv2.findHomography(inner, corners_px)
    ring = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    outlines = board.marker_squares[:, None] + ring
    return apply_homography(np.asarray(found), outlines.reshape(-1, 2)).reshape(-1, 4, 2)


def beside(board: Charuco, squares: FloatArray) -> list[int]:
    """Numbers of the inner corners at the corners of squares (M, 2)."""
    inner = board.points_board_mm[:, :2] / board.square_mm
    apart = np.abs(inner[:, None] - squares - 0.5).max(axis=-1).min(axis=1, initial=np.inf)
    return np.flatnonzero(apart < 0.6).tolist()


def test_a_board_that_the_image_cuts_gives_every_corner_beside_a_whole_marker() -> None:
    board = replace(ODD, layout="new")
    exposure, corners_px = photograph(board)
    low, high = np.array([215, 190]), np.array([420, 330])
    image = np.ascontiguousarray(exposure.image[low[1] : high[1], low[0] : high[0]])
    view = detect_target(Exposure(image, "cut"), board)
    assert isinstance(view, TargetView)
    corners_px = corners_px - low
    np.testing.assert_allclose(view.points_px, corners_px[view.point_index], atol=0.2)
    outlines = outlines_px(board, corners_px)
    is_whole = ((outlines > 0.0) & (outlines < high - low - 1.0)).all(axis=(1, 2))
    expected = beside(board, board.marker_squares[is_whole])
    is_clear = ((corners_px > 6.0) & (corners_px < high - low - 7.0)).all(axis=1)
    assert {k for k in expected if is_clear[k]} <= set(view.point_index.tolist())
    size = (board.columns, board.rows)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    printed = cv2.aruco.CharucoBoard(size, board.square_mm, board.marker_mm, dictionary)
    by_opencv = cv2.aruco.CharucoDetector(printed).detectBoard(image)[1]
    assert len(view) >= 1.3 * len(by_opencv)


def test_corners_beside_a_marker_that_is_covered_are_left_out() -> None:
    board = replace(ODD, layout="new")
    exposure, corners_px = photograph(board)
    image = exposure.image.copy()
    covered = 12
    outline = outlines_px(board, corners_px)[covered]
    centre = outline.mean(axis=0)
    inside = centre + 0.7 * (outline - centre)
    cv2.fillPoly(image, [np.rint(inside).astype(np.int32)], 120)
    whole, view = detect_target(exposure, board), detect_target(Exposure(image, "covered"), board)
    assert isinstance(whole, TargetView)
    assert isinstance(view, TargetView)
    lost = set(whole.point_index.tolist()) - set(view.point_index.tolist())
    assert lost == set(beside(board, board.marker_squares[[covered]]))


@pytest.mark.parametrize("is_covered", [False, True])
def test_a_marker_beside_the_board_moves_no_corner(*, is_covered: bool) -> None:
    board, number = replace(ODD, layout="new"), 13
    exposure, corners_px = photograph(board)
    image = exposure.image.copy()
    if is_covered:
        cv2.fillPoly(image, [np.rint(outlines_px(board, corners_px)[number]).astype(int)], 120)
    alone = detect_target(Exposure(image.copy(), "alone"), board)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    image[500:560, 20:80] = 220
    image[508:552, 28:72] = cv2.aruco.generateImageMarker(dictionary, number, 44)
    both = detect_target(Exposure(image, "with another"), board)
    assert isinstance(alone, TargetView)
    assert isinstance(both, TargetView)
    np.testing.assert_array_equal(both.point_index, alone.point_index)
    np.testing.assert_allclose(both.points_px, alone.points_px, atol=1e-6)


def test_a_corner_off_the_others_lattice_is_left_out() -> None:
    """As sharp as any other: a patch of the print that was torn and glued down 3 px aside."""
    board, number = replace(ODD, layout="new"), 20
    exposure, corners_px = photograph(board)
    image, (u, v) = exposure.image.copy(), np.rint(corners_px[number]).astype(int)
    image[v - 9 : v + 10, u - 6 : u + 13] = exposure.image[v - 9 : v + 10, u - 9 : u + 10]
    whole, torn = detect_target(exposure, board), detect_target(Exposure(image, "torn"), board)
    assert isinstance(whole, TargetView)
    assert isinstance(torn, TargetView)
    assert set(whole.point_index.tolist()) - set(torn.point_index.tolist()) == {number}


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_of_two_copies_that_hide_each_other_one_is_taken(share: float) -> None:
    board = replace(ODD, layout="new")
    column = round(share * board.columns)
    left, corners_px = photograph(board, columns=(0, column))
    right, _ = photograph(board, columns=(column, board.columns))
    image = np.concatenate([left.image, right.image], axis=1)
    view = detect_target(Exposure(image, "two"), board)
    assert isinstance(view, TargetView)
    aside = np.array([left.width_px, 0])
    off = [
        np.hypot(*(view.points_px - corners_px[view.point_index] - k * aside).T).max()
        for k in range(2)
    ]
    assert min(off) < 0.2
