# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.special import erf

from armscan.geometry.arrays import apply_homography
from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure
from armscan.vision.targets.chessboard import _with_one_row_around
from armscan.vision.targets.crossings import predict_cells
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.saddle import fit_saddles
from armscan.vision.targets.target import Charuco, Chessboard, OtherCountSeen, TargetView
from rigs.flat_prints import CharucoPattern, ChessboardPattern, Lighting, RenderedTarget
from rigs.target_scenes import exposure, nees, render

BOARD = Chessboard(7, 4, 3.0)
PATTERN = ChessboardPattern(7, 4, 3.0)


@pytest.fixture(scope="module")
def tilted() -> RenderedTarget:
    return render(PATTERN, 75.0, tilt_deg=30.0, azimuth_deg=50.0, roll_deg=20.0)


def test_corners_and_covariance_against_the_truth(tilted: RenderedTarget) -> None:
    errors, covariances = [], []
    rough = tilted.marks_px.reshape(4, 7, 2)
    step_x, step_y = (np.asarray(np.gradient(rough, axis=k)).reshape(-1, 2) for k in (1, 0))
    for seed in range(20):
        image = exposure(tilted.image, seed).image
        start = tilted.marks_px + 0.7 * np.random.default_rng(seed).uniform(-1, 1, (28, 2))
        points, covariance, is_good = fit_saddles(image, start, step_x, step_y)
        assert is_good.all()
        errors.append(points - tilted.marks_px)
        covariances.append(covariance)
    error = np.concatenate(errors)
    n = len(error)
    assert np.sqrt((error**2).mean()) < 0.02
    mean = nees(error, np.concatenate(covariances)).mean() / 2.0
    assert mean == pytest.approx(1.0, abs=5.0 / np.sqrt(n))


def test_detection_numbers_the_corners_from_the_dark_square(tilted: RenderedTarget) -> None:
    view = detect_target(exposure(tilted.image), BOARD)
    assert isinstance(view, TargetView)
    assert len(view) == 28
    assert not view.is_ambiguous
    sigma = np.sqrt(np.trace(view.covariance_px2, axis1=1, axis2=2))
    error = np.linalg.norm(view.points_px - tilted.marks_px[view.point_index], axis=1)
    assert (error < 5.0 * sigma).all()
    np.testing.assert_allclose(view.points_board_mm, BOARD.points_board_mm)


@pytest.mark.parametrize("roll_deg", [95.0, 175.0, 260.0])
def test_any_roll_gives_the_same_numbers(roll_deg: float) -> None:
    rendered = render(PATTERN, 75.0, tilt_deg=20.0, azimuth_deg=10.0, roll_deg=roll_deg)
    view = detect_target(exposure(rendered.image), BOARD)
    assert isinstance(view, TargetView)
    np.testing.assert_allclose(view.points_px, rendered.marks_px[view.point_index], atol=0.1)


def test_half_turn_symmetric_board_is_flagged_and_numbered_to_the_right() -> None:
    rendered = render(ChessboardPattern(6, 4, 3.0), 75.0, tilt_deg=20.0, roll_deg=170.0)
    view = detect_target(exposure(rendered.image), Chessboard(6, 4, 3.0))
    assert isinstance(view, TargetView)
    assert view.is_ambiguous
    np.testing.assert_allclose(view.points_px, rendered.marks_px[::-1], atol=0.1)


@pytest.mark.parametrize(("columns", "rows"), [(6, 4), (7, 3), (5, 3), (8, 4), (9, 6)], ids=str)
def test_a_wrong_count_fails_and_says_what_was_seen(
    tilted: RenderedTarget, columns: int, rows: int
) -> None:
    failure = detect_target(exposure(tilted.image), Chessboard(columns, rows, 3.0))
    assert isinstance(failure, FitFailure)
    assert "7 x 4" in failure.reason
    assert f"{columns} x {rows}" in failure.reason


def test_a_dark_board_in_the_red_channel_only(tilted: RenderedTarget) -> None:
    image = np.zeros((*tilted.image.shape, 3))
    image[..., 0] = 0.12 * tilted.image
    image[700:, :, 0] = 255.0
    image[..., 2] = 3.0
    noisy = exposure(image)
    view = detect_target(noisy, BOARD)
    assert isinstance(view, TargetView)
    assert len(view) >= 26
    np.testing.assert_allclose(view.points_px, tilted.marks_px[view.point_index], atol=0.6)


def test_a_board_lit_in_one_colour_is_measured_in_that_colour(tilted: RenderedTarget) -> None:
    """The mean of the channels shows it, too, with a third of the contrast and more noise."""
    board = np.zeros((*tilted.image.shape, 3))
    board[..., 0] = 0.5 * tilted.image
    one_channel = exposure(0.5 * tilted.image)
    view, alone = detect_target(exposure(board), BOARD), detect_target(one_channel, BOARD)
    assert isinstance(view, TargetView)
    assert isinstance(alone, TargetView)
    assert len(view) == len(alone)
    # medians over 28 corners scatter by some percent; in the mean of the channels it is 1.5 times
    sigmas = [np.sqrt(np.trace(one.covariance_px2, axis1=1, axis2=2)) for one in (view, alone)]
    assert np.median(sigmas[0]) == pytest.approx(np.median(sigmas[1]), rel=0.25)
    error = view.points_px - tilted.marks_px[view.point_index]
    assert np.mean(nees(error, view.covariance_px2)) < 4.0


@pytest.mark.parametrize("cut_px", [60, 140])
def test_a_board_partly_out_of_view_is_numbered_by_the_end_that_is_seen(
    tilted: RenderedTarget, cut_px: int
) -> None:
    left = int(tilted.marks_px[:, 0].min()) + cut_px
    view = detect_target(exposure(tilted.image[:, left:]), BOARD)
    assert isinstance(view, TargetView)
    assert len(view) < 28
    true = tilted.marks_px[view.point_index] - np.array([left, 0.0])
    np.testing.assert_allclose(view.points_px, true, atol=0.1)


def test_a_board_of_which_no_end_is_seen_fails(tilted: RenderedTarget) -> None:
    low, high = np.quantile(tilted.marks_px, [0.2, 0.8], axis=0).astype(int)
    inner = exposure(tilted.image[low[1] : high[1], low[0] : high[0]])
    failure = detect_target(inner, BOARD)
    assert isinstance(failure, FitFailure)
    assert failure.remedy


def test_a_faint_board_is_found_with_honest_sigma_or_not_at_all(tilted: RenderedTarget) -> None:
    """Squares that differ by four levels, in noise of one; by one level, none is found."""
    noise = np.random.default_rng(1).normal(0.0, 1.0, tilted.image.shape)
    image = np.clip(np.rint(100.0 + 0.02 * tilted.image + noise), 0, 255).astype(np.uint8)
    view = detect_target(Exposure(image, "faint"), BOARD)
    assert isinstance(view, TargetView)
    error = view.points_px - tilted.marks_px[view.point_index]
    squares = nees(error, view.covariance_px2) / 2.0
    assert squares.mean() == pytest.approx(1.0, abs=4.0 / np.sqrt(len(view)))
    image = np.clip(np.rint(100.0 + 0.005 * tilted.image + noise), 0, 255).astype(np.uint8)
    assert isinstance(detect_target(Exposure(image, "fainter"), BOARD), FitFailure)


def test_a_board_that_is_warm_in_its_middle_is_found(tilted: RenderedTarget) -> None:
    """As before a thermal camera: squares differ by 6 % of what lies on the glow, 12 of 65,535
    levels noise.
    """
    v, u = np.mgrid[: tilted.image.shape[0], : tilted.image.shape[1]]
    middle = tilted.marks_px.mean(axis=0)
    extent = float(np.ptp(tilted.marks_px, axis=0).max())
    glow = np.exp(-0.5 * ((u - middle[0]) ** 2 + (v - middle[1]) ** 2) / (0.3 * extent) ** 2)
    levels = (3000.0 + 50000.0 * glow) * (1.0 + 0.06 * tilted.image / tilted.image.max())
    levels += np.random.default_rng(2).normal(0.0, 12.0, levels.shape)
    view = detect_target(Exposure(np.rint(levels).astype(np.uint16), "warm"), BOARD)
    assert isinstance(view, TargetView)
    assert len(view) > 24
    np.testing.assert_allclose(view.points_px, tilted.marks_px[view.point_index], atol=0.25)


def test_a_square_beyond_the_board_adds_no_column() -> None:
    """It touches an outermost one: one more crossing, where an eighth column would be.

    A count that is wrong by one would fit it.
    """
    image = np.full((400, 600), 230, np.uint8)
    for a in range(8):
        for b in range(5):
            if (a + b) % 2 == 0:
                image[80 + 40 * b : 120 + 40 * b, 120 + 40 * a : 160 + 40 * a] = 30
    image[160:178, 440:480] = 30
    seen = Exposure(cv2.GaussianBlur(image, (0, 0), 1.0), "framed")
    assert isinstance(detect_target(seen, Chessboard(7, 4, 3.0)), TargetView)
    other = detect_target(seen, Chessboard(8, 4, 3.0))
    assert isinstance(other, OtherCountSeen)
    assert (other.columns, other.rows) == (7, 4)


@pytest.mark.parametrize("kind", [BOARD, Charuco(8, 5, 3.0, 2.2, "DICT_4X4_50")])
def test_blank_and_tiny_images_fail(kind: Chessboard | Charuco) -> None:
    for shape in ((300, 400), (20, 20), (33, 32, 3)):
        failure = detect_target(Exposure(np.full(shape, 90, np.uint8), "blank"), kind)
        assert isinstance(failure, FitFailure)
        assert "blank" in failure.reason


def test_charuco_corners_whole_and_in_part() -> None:
    target = Charuco(8, 5, 3.0, 2.2, "DICT_4X4_50")
    pattern = CharucoPattern(8, 5, 3.0, 2.2, "DICT_4X4_50")
    light = Lighting(gradient=0.4)
    rendered = render(
        pattern, 75.0, tilt_deg=30.0, azimuth_deg=70.0, roll_deg=200.0, lighting=light
    )
    view = detect_target(exposure(rendered.image), target)
    assert isinstance(view, TargetView)
    assert len(view) == 28
    assert not view.is_ambiguous
    error = view.points_px - rendered.marks_px[view.point_index]
    assert np.abs(error).max() < 0.06
    assert nees(error, view.covariance_px2).mean() / 2.0 == pytest.approx(1.0, abs=1.0)
    part = detect_target(exposure(rendered.image[:, :680]), target)
    assert isinstance(part, TargetView)
    assert 6 <= len(part) < 28
    np.testing.assert_allclose(part.points_px, rendered.marks_px[part.point_index], atol=0.1)


def test_charuco_of_another_dictionary_fails_by_its_name() -> None:
    pattern = CharucoPattern(8, 5, 3.0, 2.2, "DICT_4X4_50")
    rendered = render(pattern, 75.0)
    failure = detect_target(exposure(rendered.image), Charuco(8, 5, 3.0, 2.2, "DICT_6X6_50"))
    assert isinstance(failure, FitFailure)
    assert "DICT_6X6_50" in failure.reason


def test_saddle_fit_reports_a_corner_that_is_none() -> None:
    image = np.full((200, 200), 80, np.uint8)
    cv2.rectangle(image, (100, 0), (199, 199), 180, -1)
    step = np.array([[40.0, 0.0]])
    _, _, is_good = fit_saddles(image, np.array([[100.0, 100.0]]), step, step[:, ::-1])
    assert not is_good.any()


@pytest.mark.parametrize("between_edges_deg", [30.0, 40.0, 140.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_bright_corners_of_skewed_edges_are_good_whatever_their_parity(
    between_edges_deg: float, sign: float
) -> None:
    true_px = np.array([40.3, 39.6])
    angles = np.deg2rad([10.0, 10.0 + between_edges_deg])
    edges_uv = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    v, u = np.mgrid[:80, :80]
    away = np.stack([u, v], axis=-1) - true_px
    beside = away[..., 0, None] * edges_uv[:, 1] - away[..., 1, None] * edges_uv[:, 0]
    print_ = erf(beside / (np.sqrt(2.0) * 0.8)).prod(axis=-1)
    image = np.rint(190.0 + 30.0 * sign * print_).astype(np.uint8)
    steps = 40.0 * edges_uv[:, None, :]
    points, _, is_good = fit_saddles(image, np.rint(true_px)[None], steps[0], steps[1])
    assert is_good.all()
    np.testing.assert_allclose(points[0], true_px, atol=0.05)


@pytest.mark.parametrize(("scale", "blur_px", "noise"), [(1.0, 16.0, 2.0), (0.4, 9.0, 4.0)])
def test_a_large_image_as_blurred_as_a_window_is_wide_is_measured_reduced(
    scale: float, blur_px: float, noise: float
) -> None:
    """Squares of 220 px with edges of 40 px: no fit within 18 px sees two of them."""
    board, (width, height) = Chessboard(7, 5, 20.0), (round(2600 * scale), round(2100 * scale))
    mapped = np.array([[11.0, 1.25, 500.0], [-1.5, 10.5, 700.0], [1e-4, 2e-4, 1.0]])
    mapped[:2] *= scale
    v, u = np.mgrid[:height, :width]
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1).astype(np.float64)
    x, y = apply_homography(np.linalg.inv(mapped), pixels).T / board.square_mm
    column, row = np.floor(x), np.floor(y)
    is_on = (column >= -1) & (column < board.columns) & (row >= -1) & (row < board.rows)
    is_light = (~is_on | ((column + row) % 2 == 1)).reshape(height, width)
    blurred = cv2.GaussianBlur(20.0 + 200.0 * is_light, (0, 0), blur_px)
    squares = []
    for seed in range(4):
        image = blurred + np.random.default_rng(seed).normal(0.0, noise, blurred.shape)
        view = detect_target(Exposure(np.clip(np.rint(image), 0, 255).astype(np.uint8), "b"), board)
        assert isinstance(view, TargetView), view
        assert len(view) >= 0.9 * board.columns * board.rows
        error = view.points_px - apply_homography(mapped, view.points_board_mm[:, :2])
        assert np.hypot(*error.T).max() < 0.3
        squares.append(nees(error, view.covariance_px2))
    # of some 140 corners: its standard deviation is 0.085
    assert 0.75 < np.concatenate(squares).mean() / 2.0 < 1.6


@pytest.mark.parametrize("size", [(3, 4), (9, 12)])
def test_rows_at_the_sides_of_a_lattice_are_seen_or_predicted(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    cells = np.argwhere(np.ones(size, dtype=np.bool_))
    points = 30.0 * cells + rng.normal(0.0, 0.1, cells.shape)
    is_seen = ~np.isin(np.arange(len(cells)), [1, size[1] + 1, len(cells) - 2])
    around = np.argwhere(np.ones((size[1] + 2, size[0] + 2), dtype=np.bool_))[:, ::-1] - 1
    whole = predict_cells(cells[is_seen], points[is_seen], around)
    whole = whole.reshape(size[1] + 2, size[0] + 2, 2)
    whole[cells[is_seen, 1] + 1, cells[is_seen, 0] + 1] = points[is_seen]
    found = _with_one_row_around(cells[is_seen], points[is_seen], np.array(size))
    for side in (np.s_[:3], np.s_[-3:], np.s_[:, :3], np.s_[:, -3:]):
        np.testing.assert_array_equal(found[side], whole[side])
