# SPDX-License-Identifier: Apache-2.0
"""Targets in real photographs; skipped where the data are not at hand."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.target import Chessboard, CircleGrid, TargetView
from rigs.photographs import DATA, needs

pytestmark = needs("ciclop")
BOARD = Chessboard(11, 6, 13.0)


def load(path: Path) -> Exposure:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return Exposure(image if image.ndim == 2 else image[..., ::-1], path.name)


def residual_rms_px(view: TargetView) -> float:
    """Against a homography: lens distortion of these cameras stays below a pixel or two."""
    board = view.points_board_mm[:, :2]
    homography, _ = cv2.findHomography(board, view.points_px)
    mapped = cv2.perspectiveTransform(board[:, None], homography)[:, 0]
    return float(np.sqrt(np.mean((mapped - view.points_px) ** 2)))


@pytest.mark.parametrize("number", [0, 1, 7, 8, 10, 13])
def test_chessboard_in_photographs(number: int) -> None:
    view = detect_target(load(DATA / f"ciclop/camera/frame{number}.jpg"), BOARD)
    assert isinstance(view, TargetView)
    assert len(view) == 66
    assert residual_rms_px(view) < 1.0


@pytest.mark.parametrize("name", ["0-255-255-8", "0-255-255-8-x"])
def test_dark_chessboard_that_shows_in_red_only(name: str) -> None:
    view = detect_target(load(DATA / f"ciclop/laser_pattern/laser-background-{name}.png"), BOARD)
    assert isinstance(view, TargetView)
    assert len(view) >= 60
    assert residual_rms_px(view) < 1.0


def test_a_wrong_size_of_a_real_board_is_named() -> None:
    failure = detect_target(load(DATA / "ciclop/camera/frame3.jpg"), Chessboard(9, 6, 13.0))
    assert isinstance(failure, FitFailure)
    assert "11 x 6" in failure.reason


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_circle_grid_in_photographs(number: int) -> None:
    exposure = load(DATA / f"circle_grid36/grid36-0{number}.pgm")
    view = detect_target(exposure, CircleGrid(6, 6, 30.0))
    assert isinstance(view, TargetView)
    assert len(view) == 36
    assert view.is_ambiguous
    assert residual_rms_px(view) < 0.6
