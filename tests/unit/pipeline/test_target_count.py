# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from armscan.geometry.estimate import FitFailure
from armscan.pipeline.cameras import calibrate_camera_from_exposures
from armscan.pipeline.targets import ENOUGH_IMAGES, wrong_count
from armscan.simulation.objects.boards import CirclePattern
from armscan.vision.targets.target import Chessboard, CircleGrid, OtherCountSeen, TargetView
from rigs.flat_prints import ChessboardPattern
from rigs.target_scenes import exposure, render

ASKED = Chessboard(9, 7, 3.0)


def other(columns: int = 8, rows: int = 6) -> OtherCountSeen:
    return OtherCountSeen("another", "count", columns=columns, rows=rows)


def view_of(target: Chessboard, chosen: slice) -> TargetView:
    points = target.points_board_mm[chosen]
    n = len(points)
    return TargetView(
        source="seen",
        width_px=640,
        height_px=480,
        point_index=np.arange(n),
        points_px=points[:, :2],
        covariance_px2=np.tile(np.eye(2), (n, 1, 1)),
        points_board_mm=points,
    )


def test_four_agreeing_images_are_enough_and_name_the_count() -> None:
    assert wrong_count([other()] * (ENOUGH_IMAGES - 1), ASKED) is None
    failure = wrong_count([other()] * ENOUGH_IMAGES, ASKED)
    assert isinstance(failure, FitFailure)
    assert "8 x 6" in failure.reason
    assert "squares" in failure.reason
    assert "chessboard:8x6:3" in failure.remedy


def test_one_whole_board_refutes_it_and_a_part_does_not() -> None:
    found = [other()] * 6
    assert wrong_count([*found, view_of(ASKED, slice(None))], ASKED) is None
    assert wrong_count([*found, view_of(ASKED, slice(0, 40))], ASKED) is not None


def test_images_that_disagree_prove_nothing() -> None:
    found = [other(8, k) for k in range(3, 9)]
    assert wrong_count(found, ASKED) is None
    assert wrong_count([other()] * 4 + [FitFailure("nothing")] * 5, ASKED) is None


@pytest.mark.parametrize("is_circles", [False, True])
def test_a_calibration_stops_after_a_few_images(*, is_circles: bool) -> None:
    taken = []

    def photographs():
        for k in range(30):
            pattern = CirclePattern(7, 5, 3.0, 1.8) if is_circles else ChessboardPattern(7, 4, 3.0)
            taken.append(k)
            yield exposure(render(pattern, 90.0, tilt_deg=20.0, azimuth_deg=40.0 * k).image, k)

    asked = CircleGrid(8, 6, 3.0) if is_circles else Chessboard(8, 5, 3.0)
    answer = calibrate_camera_from_exposures(photographs(), asked)
    assert isinstance(answer, FitFailure)
    assert ("7 x 5" if is_circles else "7 x 4") in answer.reason
    assert len(taken) <= ENOUGH_IMAGES + 4
