# SPDX-License-Identifier: Apache-2.0
"""Cameras that are not those of the photographs are named by the boards they are given."""

from collections.abc import Sequence

import numpy as np
import pytest

from armscan.calibration.cameras.start import estimate_board_pose
from armscan.calibration.sheets.board_points import HeadCameras
from armscan.calibration.sheets.result import BoardStripes
from armscan.models.camera import CameraModel
from armscan.pipeline.laser import about_cameras
from armscan.vision.targets.target import Chessboard, TargetView
from rigs.camera_scene import CAMERA, Scene, make_views
from rigs.fisheye import fisheye_views
from rigs.sheet_rig import PROVENANCE, make_profile
from rigs.true_scanner import certain_camera

K1 = float(CAMERA.distortion[0])
BENT = Scene(n_views=8, bow_mm=(0.3, -0.2))


def told(views: Sequence[TargetView], camera: CameraModel) -> tuple[str, ...]:
    """What is said of a camera that is given for the views."""
    boards = []
    for view in views:
        pose = estimate_board_pose(view, camera)
        assert pose, pose
        line = (view.points_px[:2], np.tile([1.0, 0.0], (2, 1)))
        boards.append(BoardStripes(make_profile(view.source, [line], 0.1), view, pose))
    return about_cameras(boards, HeadCameras.of(certain_camera(camera, PROVENANCE)))


def other(factor: float, k1: float) -> CameraModel:
    """The true camera with focal lengths longer by a factor, and another k1."""
    values = CAMERA.parameters.copy()
    values[:2] *= factor
    values[4] = k1
    return CameraModel.from_parameters(values, CAMERA.width_px, CAMERA.height_px)


@pytest.mark.parametrize(
    "camera", [other(1.1, K1), other(1.0, -K1)], ids=["focal length", "distortion"]
)
def test_a_camera_under_which_the_boards_fit_badly_is_named(camera: CameraModel) -> None:
    views, _ = make_views(BENT, 1)
    (said,) = told(views, camera)
    assert "not that of these photographs" in said


@pytest.mark.parametrize("seed", range(4))
def test_bent_boards_say_nothing_of_their_own_camera(seed: int) -> None:
    views, _ = make_views(BENT, seed)
    assert told(views, CAMERA) == ()


def test_few_boards_say_nothing_of_a_camera() -> None:
    views, _ = make_views(BENT, 1)
    assert told(views[:4], other(1.1, K1)) == ()


@pytest.mark.parametrize(("factor", "is_named"), [(1.0, False), (1.1, True)])
def test_a_fisheye_is_compared_with_a_fisheye(factor: float, is_named: bool) -> None:
    """70 degrees to each side, where no pinhole fits the boards and all would seem well."""
    board = Chessboard(9, 6, 24.0)
    truth = np.array([231.0, 229.5, 472.0, 305.0, 0.021, -0.012, 0.0, 0.0, 0.004])
    views = fisheye_views(truth, (960, 600), board, n_views=8, noise_px=0.05, seed=3)
    values = truth * np.array([factor, factor, *[1.0] * 7])
    said = told(views, CameraModel.from_parameters(values, 960, 600, "fisheye"))
    assert bool(said) == is_named
