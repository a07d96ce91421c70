# SPDX-License-Identifier: Apache-2.0
"""Why no board was found in a placement is told as it was in its first image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.cameras.start import estimate_board_pose
from armscan.calibration.sheets.board_points import HeadCameras, SeenBoard
from armscan.geometry.estimate import FitFailure
from armscan.pipeline import targets
from armscan.pipeline.laser import _same_placement, find_placements
from armscan.records.exposure import Exposure
from armscan.vision.targets.detect import numberings, renumbered
from armscan.vision.targets.target import Chessboard, CircleEdges, CircleGrid, TargetView
from rigs.fan_rig import fan_rig
from rigs.sheet_rig import thesis_rig


def test_the_first_images_reason_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without laser it is looked for first; that reason was lost, being no true value."""
    monkeypatch.setattr(
        targets,
        "detect_target",
        lambda image, *_: FitFailure(f"nothing in {image.source}"),
    )
    rig = thesis_rig()
    image = np.zeros((64, 64), np.uint8)
    pair = Exposure(image, "on.png"), Exposure(image, "off.png")
    cameras = HeadCameras.of(rig.calibration(rig.camera))
    (placement,) = find_placements([pair], Chessboard(8, 6, 5.0), cameras)
    assert placement.seen == {0: FitFailure("nothing in off.png")}
    assert placement.placed is None


def test_a_window_of_the_sensor_shows_the_board(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its size is not the camera's, and `check_sizes` says whether it is of that sensor."""
    rig = thesis_rig()
    view = rig.view(0, np.random.default_rng(0))
    window = replace(view, width_px=view.width_px - 200, height_px=view.height_px - 100)
    monkeypatch.setattr(targets, "detect_target", lambda *_: window)
    cameras = HeadCameras.of(rig.calibration(rig.camera))
    pair = Exposure(np.zeros((64, 64), np.uint8), "on.png"), None
    (placement,) = find_placements([pair], Chessboard(8, 6, 5.0), cameras)
    seen = placement.seen[0]
    assert not isinstance(seen, FitFailure)
    assert (seen[1].width_px, seen[1].height_px) == (view.width_px, view.height_px)


def test_points_that_the_laser_pulls_stay_uncertain_when_numbered_anew() -> None:
    """Of the right camera's view, where it is numbered from the other end than the left one's."""
    rig, target = fan_rig(3, 6, 5), CircleGrid(11, 9, 3.75)
    cameras = HeadCameras.of(rig.stereo())
    boards = rig.boards(rig.stereo(), np.random.default_rng(3))[0]
    places = [board.place for board in boards if board.camera == 1]
    left, right = (b for b in boards if b.place == places[0])

    def seen(camera: int, view: TargetView) -> SeenBoard:
        pose = estimate_board_pose(view, cameras.model(camera), allow_ambiguous=True)
        assert not isinstance(pose, FitFailure)
        return camera, view, pose

    n, angle = len(right.view), np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    rim = 8.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    edges = CircleEdges(
        points_px=(right.view.points_px[:, None] + rim).reshape(-1, 2),
        circle=np.repeat(np.arange(n), 12),
        sigma_px=np.full(12 * n, 0.05),
    )
    wide = right.view.covariance_px2.copy()
    wide[5] *= 1e4
    pulled = replace(right.view, edges=edges, covariance_px2=wide)
    turned = renumbered(pulled, target, numberings(target)[1])
    found = _same_placement(seen(0, left.view), seen(1, turned), target, cameras)
    assert not isinstance(found, FitFailure), found
    assert (found[1].point_index == right.view.point_index).all()
    assert (found[1].covariance_px2 == wide).all()
