# SPDX-License-Identifier: Apache-2.0
"""Real photographs; skipped where the data folder is absent."""

import cv2
import numpy as np
import pytest

from armscan.geometry.estimate import FitFailure
from armscan.pipeline.cameras import CameraRun, calibrate_camera_from_exposures
from armscan.pipeline.progress import ProgressEvent
from armscan.records.exposure import Exposure
from armscan.storage.images import read_exposure
from armscan.vision.targets.target import Chessboard, CircleGrid
from rigs.photographs import DATA


def photos(pattern: str) -> list[Exposure]:
    paths = sorted(DATA.glob(pattern))
    if not paths:
        pytest.skip("no real photographs: set ARMSCAN_DATA")
    return [read_exposure(path) for path in paths]


def test_stereo_chessboard_left_agrees_with_opencv_on_the_same_points() -> None:
    events: list[ProgressEvent] = []
    exposures = photos("stereo_chessboard/left*.jpg")
    run = calibrate_camera_from_exposures(
        iter(exposures), Chessboard(9, 6, 25.0), progress=events.append
    )
    assert isinstance(run, CameraRun), run
    assert run.fit.n_views == len(exposures)
    assert run.not_found == ()
    assert [event.item for event in events if event.stage == "find target"] == [
        exposure.source for exposure in exposures
    ]
    views = [view.view for view in run.fit.views]
    _, matrix, _, _, _ = cv2.calibrateCamera(
        [view.points_board_mm.astype(np.float32) for view in views],
        [view.points_px.astype(np.float32) for view in views],
        (640, 480),
        np.eye(3),
        np.zeros(5),
    )
    theirs = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    assert np.abs((run.fit.camera.parameters[:4] - theirs) / run.fit.sigma[:4]).max() < 1.0
    assert run.fit.cross_validation is not None
    assert run.fit.cross_validation.rms_px < 0.2073 * 1.02  # OpenCV's whole chain, same folds


def test_circle_grid_is_solved_with_stable_centres() -> None:
    run = calibrate_camera_from_exposures(photos("circle_grid36/*.pgm"), CircleGrid(6, 6, 30.0))
    assert isinstance(run, CameraRun), run
    assert 1 <= run.centre_rounds < 4
    assert run.fit.n_views == 4
    assert run.fit.camera.fx_px == pytest.approx(550.0, abs=5.0)
    assert "k3 rest" in run.fit.model_reason


def test_wrong_columns_are_noticed_and_blank_images_named() -> None:
    exposures = photos("stereo_chessboard/left0[1-4].jpg")
    wrong = calibrate_camera_from_exposures(exposures, Chessboard(8, 7, 25.0))
    assert isinstance(wrong, FitFailure)
    assert "9 x 6" in wrong.reason
    assert "chessboard:9x6:25" in wrong.remedy
    blank = Exposure(np.full((480, 640), 90, dtype=np.uint8), "blank.png")
    run = calibrate_camera_from_exposures([*exposures, blank], Chessboard(9, 6, 25.0))
    assert isinstance(run, CameraRun)
    assert [source for source, _ in run.not_found] == ["blank.png"]


def test_too_few_images_are_refused() -> None:
    blank = Exposure(np.full((64, 64), 90, dtype=np.uint8), "blank.png")
    counts = ("0 images were", "1 image was", "2 images were")
    for exposures, count in zip(([], [blank], [blank, blank]), counts, strict=True):
        failure = calibrate_camera_from_exposures(exposures, Chessboard(9, 6, 25.0))
        assert isinstance(failure, FitFailure)
        assert f"{count} given" in failure.reason
