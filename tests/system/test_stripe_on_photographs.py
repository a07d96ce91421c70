# SPDX-License-Identifier: Apache-2.0
"""Stripes on real photographs of a desktop scanner (folder ``ciclop`` of the test data)."""

from typing import Any

import cv2
import numpy as np
import pytest

from armscan.geometry.arrays import FloatArray
from armscan.records.exposure import Exposure
from armscan.records.profile import REJECTING, Profile, StripeFlag
from armscan.vision.stripe.extract import extract_stripes
from rigs.photographs import DATA, needs

CICLOP = DATA / "ciclop"
pytestmark = needs("ciclop")
# (y, x) knots of the two laser lines on the board, read off the photographs by eye, +-2 px
BOARDS: dict[str, Any] = {
    "8": {"top": 470, "bottom": 1000, "lines": ((276, 273), (597, 588)), "lean": 4.0},
    "8-x": {"top": 475, "bottom": 990, "lines": ((316, 314), (645, 632)), "lean": 4.0},
}
BOARD_SCATTER_PX = 0.6
"""The line is two to four pixels wide and went through JPEG; the board is flat."""


def photograph(name: str) -> Exposure:
    image = cv2.imread(str(CICLOP / name))
    assert image is not None
    return Exposure(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), name)


def extract(folder: str, lit: str, dark: str) -> Profile:
    return extract_stripes(
        photograph(f"{folder}/{lit}.png"), background=photograph(f"{folder}/{dark}.png")
    )


def rows_found(points: FloatArray, top: int, bottom: int) -> float:
    rows = np.unique(np.rint(points[:, 1]))
    return float(((rows >= top) & (rows < bottom)).sum() / (bottom - top))


@pytest.mark.parametrize("board", sorted(BOARDS))
def test_two_lines_on_the_dark_board(board: str) -> None:
    known = BOARDS[board]
    lit, dark = (f"laser-{part}0-255-255-{board}" for part in ("", "background-"))
    profile = extract("laser_pattern", lit, dark)
    points = profile.points_px[profile.is_accepted]
    share = (points[:, 1] - known["top"]) / (known["bottom"] - known["top"])
    on_a_line = np.zeros(len(points), dtype=bool)
    for top_x, bottom_x in known["lines"]:
        near = np.abs(points[:, 0] - top_x - share * (bottom_x - top_x)) < known["lean"]
        on_a_line |= near
        line = points[near]
        fit = np.polynomial.Polynomial.fit(line[:, 1], line[:, 0], 2)
        assert rows_found(line, known["top"], known["bottom"]) > 0.7
        assert np.std(line[:, 0] - fit(line[:, 1])) < BOARD_SCATTER_PX
    assert (~on_a_line).sum() < 0.05 * len(points)


def test_stripe_on_the_bust() -> None:
    profile = extract("laser_object", "laser", "laser_background")
    points = profile.points_px[profile.is_accepted]
    is_rim = (points[:, 1] > 1200) & (np.abs(points[:, 0] - 778) < 8)
    bust = points[~is_rim]
    # nothing on the cube, the blue lamp or the walls: the stripe keeps to the middle of the bust
    assert bust[:, 0].min() > 500
    assert bust[:, 0].max() < 610
    assert bust[:, 1].max() < 1130
    assert rows_found(bust, 56, 1118) > 0.78
    # hair and chin break the line: what is missing beyond that lies at those breaks
    cause = profile.flags & int(REJECTING)
    unbroken = profile.points_px[(cause == 0) | (cause == int(StripeFlag.END))]
    assert rows_found(unbroken[unbroken[:, 1] < 1130], 56, 1118) > 0.85
    assert is_rim.sum() > 30
