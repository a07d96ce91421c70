# SPDX-License-Identifier: Apache-2.0
"""Three rendered photographs that travel with the project: board, stripe and rings from JPEG.

What is in them was counted and measured by eye; no data folder is needed.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.cli import main
from armscan.geometry.estimate import FitFailure
from armscan.storage.images import read_exposure
from armscan.vision.rings import detect_rings
from armscan.vision.stripe.extract import extract_stripes
from armscan.vision.targets.detect import detect_target
from armscan.vision.targets.target import CircleGrid, TargetView

PHOTOGRAPHS = Path(__file__).parents[1] / "photographs"
BOARD = CircleGrid(11, 9, 3.75)


@pytest.mark.parametrize("name", ["board", "stripe"])
def test_every_circle_of_the_board_is_found(name: str) -> None:
    view = detect_target(read_exposure(PHOTOGRAPHS / f"{name}.jpg"), BOARD)
    assert isinstance(view, TargetView)
    assert len(view) == 99
    board = view.points_board_mm[:, :2]
    homography, _ = cv2.findHomography(board, view.points_px)
    mapped = cv2.perspectiveTransform(board[:, None], homography)[:, 0]
    # the lens bends the board's edges by about a pixel; a circle is found to a tenth of that
    assert np.sqrt(np.mean((mapped - view.points_px) ** 2)) < 0.5


def test_a_wrong_size_of_the_board_is_refused() -> None:
    found = detect_target(read_exposure(PHOTOGRAPHS / "board.jpg"), CircleGrid(10, 9, 3.75))
    assert isinstance(found, FitFailure)


def test_the_stripe_is_one_line_across_the_board() -> None:
    profile = extract_stripes(read_exposure(PHOTOGRAPHS / "stripe.jpg"))
    points = profile.points_px[profile.is_accepted]
    # from the board's left edge to its right one, along a line from (12, 84) to (668, 60)
    line = np.polynomial.Polynomial.fit(points[:, 0], points[:, 1], 2)
    assert abs(line(12.0) - 84.0) < 2.0
    assert abs(line(636.0) - 61.0) < 2.0
    assert np.std(points[:, 1] - line(points[:, 0])) < 0.3
    assert len(points) > 550


def test_every_ring_is_found_once() -> None:
    found = detect_rings(read_exposure(PHOTOGRAPHS / "rings.jpg"))
    centres = found.rings.centres_px
    assert len(centres) == 15
    for place in ((297, 155), (777, 144), (365, 505), (831, 552)):
        assert np.linalg.norm(centres - place, axis=1).min() < 2.0


def test_commands_read_the_photographs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", *map(str, sorted(PHOTOGRAPHS.glob("*.jpg"))), "--json"]) == 0
    assert capsys.readouterr().out.count("1024 x 682") == 3
