# SPDX-License-Identifier: Apache-2.0
"""Chessboards as people photograph them: no rim, dim, vignetted, hidden in part, under a laser."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from armscan.geometry.arrays import FloatArray
from armscan.records.exposure import Exposure
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.target import Chessboard, OtherCountSeen, TargetView
from rigs.flat_prints import ChessboardPattern, Lighting, RenderedTarget
from rigs.target_scenes import (
    BareChessboard,
    exposure,
    line_distance,
    render,
    vignetted,
    with_laser_line,
)

BOARD = Chessboard(8, 5, 3.0)
"""Columns + rows odd: there is one right numbering."""
SEEDS = range(4)
GROSS_PX = 0.5
"""No corner may be off by more, and the rms over corners must stay below `FINE_PX`."""
FINE_PX = 0.06


def scene(seed: int, *, is_bare: bool = False, lighting: Lighting | None = None) -> RenderedTarget:
    rng = np.random.default_rng(seed)
    pattern = BareChessboard(8, 5, 3.0) if is_bare else ChessboardPattern(8, 5, 3.0)
    return render(
        pattern,
        rng.uniform(75.0, 130.0),
        tilt_deg=rng.uniform(0.0, 40.0),
        azimuth_deg=rng.uniform(0.0, 360.0),
        roll_deg=rng.uniform(0.0, 360.0),
        lighting=lighting,
    )


def found(image: FloatArray, seed: int) -> TargetView:
    view = detect_target(exposure(image, seed), BOARD)
    assert isinstance(view, TargetView), view
    return view


def assert_right(view: TargetView, marks_px: FloatArray, *, rms_px: float = FINE_PX) -> None:
    """Every corner bears its own number and lies where it is."""
    error = view.points_px - marks_px[view.point_index]
    assert np.abs(error).max() < GROSS_PX
    assert np.sqrt((error**2).mean()) < rms_px
    sigma = np.sqrt(np.trace(view.covariance_px2.mean(axis=0)) / len(view))
    assert np.abs(error.mean(axis=0)).max() < 5.0 * sigma + 0.005


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("surround", [0.0, 0.5, 1.0])
def test_squares_without_a_rim_on_any_carrier(seed: int, surround: float) -> None:
    rendered = scene(seed, is_bare=True, lighting=Lighting(surround=surround))
    view = found(rendered.image, seed)
    assert len(view) == 40
    assert_right(view, rendered.marks_px)


@pytest.mark.parametrize("shown", [0.1, 0.2, 0.25])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_ring_of_cut_squares_costs_its_own_corners_and_not_the_view(
    seed: int, shown: float
) -> None:
    """Where the squares end lies another edge, which pulls such corners by up to 0.9 px."""
    board = BareChessboard(8, 5, 3.0, shown=shown)
    rng = np.random.default_rng(seed)
    rendered = render(
        board, rng.uniform(75.0, 110.0), tilt_deg=30.0, azimuth_deg=rng.uniform(0.0, 360.0),
        roll_deg=rng.uniform(0.0, 360.0), lighting=Lighting(surround=0.4),
    )  # fmt: skip
    view = found(rendered.image, seed)
    inner = BOARD.columns * np.arange(1, 4)[:, None] + np.arange(1, 7)
    assert set(view.point_index.tolist()) == set(inner.ravel().tolist())
    assert_right(view, rendered.marks_px)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_dim_board_under_a_vignette(seed: int) -> None:
    light = Lighting(light_level=45.0, dark_level=8.0, gradient=0.4)
    rendered = scene(seed, lighting=light)
    view = found(vignetted(rendered.image, 0.4), seed)
    assert len(view) >= 38
    assert_right(view, rendered.marks_px, rms_px=0.15)


@pytest.mark.parametrize("seed", SEEDS)
def test_what_lies_on_the_board_takes_away_corners_and_moves_none(seed: int) -> None:
    rendered = scene(seed)
    rng = np.random.default_rng(100 + seed)
    middle = rendered.marks_px.reshape(5, 8, 2)[2, 3 + seed % 2]
    along, away = line_distance(rendered.image.shape, middle, rng.uniform(0.0, np.pi))
    is_hidden = (along / 70.0) ** 2 + (away / 40.0) ** 2 < 1.0
    view = found(np.where(is_hidden, 140.0, rendered.image), seed)
    assert 20 <= len(view) < 40
    assert_right(view, rendered.marks_px)


@pytest.mark.parametrize("seed", range(6))
def test_corners_that_a_laser_line_pulls_are_left_out(seed: int) -> None:
    rendered = scene(seed)
    rng = np.random.default_rng(200 + seed)
    through, azimuth = rendered.marks_px.mean(axis=0), rng.uniform(0.0, np.pi)
    image = with_laser_line(rendered.image, through, azimuth, sigma_px=rng.uniform(1.0, 3.0))
    view = found(image, seed)
    assert len(view) >= 24
    assert_right(view, rendered.marks_px)


def test_a_line_along_a_row_of_corners(seed: int = 3) -> None:
    rendered = scene(seed)
    grid = rendered.marks_px.reshape(5, 8, 2)
    way = grid[2, -1] - grid[2, 0]
    image = with_laser_line(rendered.image, grid[2, 0], float(np.arctan2(way[1], way[0])))
    view = found(image, seed)
    assert 30 <= len(view) <= 33
    assert_right(view, rendered.marks_px)


def test_a_green_line_is_avoided_in_the_other_channels() -> None:
    rendered = scene(5)
    grid = rendered.marks_px.reshape(5, 8, 2)
    way = grid[2, -1] - grid[2, 0]
    green = with_laser_line(rendered.image, grid[2, 0], float(np.arctan2(way[1], way[0])))
    rng = np.random.default_rng(5)
    colours = np.stack([0.8 * rendered.image, green, rendered.image], axis=-1)
    noisy = np.clip(np.rint(colours + rng.normal(0.0, 2.0, colours.shape)), 0, 255)
    view = detect_target(Exposure(noisy.astype(np.uint8), "colour"), BOARD)
    assert isinstance(view, TargetView)
    assert len(view) == 40
    assert_right(view, rendered.marks_px)


@pytest.mark.parametrize("seed", range(12))
def test_a_part_is_numbered_rightly_or_not_at_all(seed: int) -> None:
    rendered = scene(seed, is_bare=seed % 2 == 1, lighting=Lighting(surround=0.5 * (seed % 3)))
    rng = np.random.default_rng(300 + seed)
    low, high = rendered.marks_px.min(axis=0), rendered.marks_px.max(axis=0)
    at = (low + rng.uniform(0.05, 0.4) * (high - low)).astype(int)
    first = np.array([at[0], 0]) if seed % 4 < 2 else np.array([0, at[1]])
    view = detect_target(exposure(rendered.image[first[1] :, first[0] :], seed), BOARD)
    if isinstance(view, TargetView):
        assert_right(view, rendered.marks_px - first)


def test_most_parts_are_numbered() -> None:
    n_found = 0
    for seed in range(12):
        rendered = scene(seed)
        left = int(np.quantile(rendered.marks_px[:, 0], 0.2))
        view = detect_target(exposure(rendered.image[:, left:], seed), BOARD)
        n_found += isinstance(view, TargetView)
    assert n_found >= 8


def test_a_sheet_that_hides_whole_rows_gives_no_wrong_numbers() -> None:
    for seed in range(8):
        rendered = scene(seed, lighting=Lighting(surround=0.5))
        grid = rendered.marks_px.reshape(5, 8, 2)
        along = grid[3, -1] - grid[3, 0]
        step = grid[4, 3] - grid[3, 3]
        edge = grid[3, 0] + (0.2 + 0.1 * (seed % 5)) * step
        _, away = line_distance(rendered.image.shape, edge, float(np.arctan2(along[1], along[0])))
        view = detect_target(exposure(np.where(away > 0.0, 190.0, rendered.image), seed), BOARD)
        if isinstance(view, TargetView):
            assert_right(view, rendered.marks_px)


@pytest.mark.parametrize("asked", [(9, 6), (9, 5), (8, 6), (7, 5), (8, 4), (7, 4)], ids=str)
def test_another_count_is_named_and_never_found(asked: tuple[int, int]) -> None:
    rendered = scene(2)
    answer = detect_target(
        exposure(rendered.image), replace(BOARD, columns=asked[0], rows=asked[1])
    )
    assert isinstance(answer, OtherCountSeen)
    assert (answer.columns, answer.rows) == (8, 5)


def test_a_swapped_count_is_the_same_board() -> None:
    rendered = scene(2)
    view = detect_target(exposure(rendered.image), Chessboard(5, 8, 3.0))
    assert isinstance(view, TargetView)
    assert len(view) == 40


def test_texture_is_no_chessboard() -> None:
    rng = np.random.default_rng(7)
    coarse = np.kron(rng.uniform(0.0, 255.0, (60, 80)), np.ones((10, 10)))
    stripes = 128.0 + 100.0 * np.sign(np.sin(np.arange(800) / 9.0)) * np.ones((600, 1))
    for image in (coarse, stripes, rng.uniform(0.0, 255.0, (600, 800))):
        assert not isinstance(detect_target(exposure(image), Chessboard(3, 3, 1.0)), TargetView)


def test_a_board_before_ribs_that_make_larger_lattices_is_found() -> None:
    """Of ribs, linked by chance to eight trees of more crossings than the board has."""
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:600, :800]
    image = 60.0 * np.sin(0.2 * np.pi * x) * np.sin(0.2 * np.pi * y)
    image += 120.0 * gaussian_filter(rng.normal(0.0, 1.0, (600, 800)), 2.0) + 128.0
    row, column = np.mgrid[:6, :9]
    squares = np.where((row + column) % 2 == 0, 20.0, 230.0)
    board = np.pad(np.kron(squares, np.ones((24, 24))), 24, constant_values=230.0)
    image[200 : 200 + board.shape[0], 300 : 300 + board.shape[1]] = board
    corners = np.mgrid[1:6, 1:9].reshape(2, -1).T[:, ::-1] * 24.0 + np.array([323.5, 223.5])
    view = found(np.clip(gaussian_filter(image, 0.8), 0.0, 255.0), 2)
    assert len(view) == 40
    assert_right(view, corners)


@pytest.mark.parametrize("seed", range(8))
def test_of_a_tangle_of_crossings_no_count_is_said(seed: int) -> None:
    """Chance crossings of a texture lie thinly spread: no rectangle as large as the board is full
    of them, so that none of that size may be told as corners that were seen.
    """
    texture = gaussian_filter(np.random.default_rng(seed).normal(size=(480, 640)), 1.2)
    levels = np.clip(128.0 + 60.0 * texture / texture.std(), 0.0, 255.0).astype(np.uint8)
    found = detect_target(Exposure(levels, "texture.png"), BOARD)
    assert not isinstance(found, TargetView)
    said = re.search(r"(\d+) x (\d+) corners were seen", found.reason)
    assert said is None or int(said[1]) * int(said[2]) < BOARD.columns * BOARD.rows
