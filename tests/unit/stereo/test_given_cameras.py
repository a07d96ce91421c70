# SPDX-License-Identifier: Apache-2.0
"""Given calibrations are set beside the images, whatever shape the board has."""

import numpy as np
import pytest

from armscan.calibration.cameras.pairs import StereoOptions, prepare_cameras
from armscan.geometry.estimate import FitFailure
from armscan.models.camera import CameraModel
from rigs.camera_scene import CAMERA, Scene, make_views
from rigs.sheet_rig import PROVENANCE
from rigs.true_scanner import certain_camera

TRUE = certain_camera(CAMERA, PROVENANCE)


@pytest.mark.parametrize("bow_mm", [(0.0, 0.0), (0.3, -0.2), (1.0, 0.6)])
def test_the_true_cameras_are_taken_though_the_board_is_bent(bow_mm: tuple[float, float]) -> None:
    """Its bow is solved with a camera of their own, and not with the given one."""
    views, _ = make_views(Scene(n_views=10, bow_mm=bow_mm), 1)
    found = prepare_cameras((views, views), StereoOptions(), (TRUE, TRUE))
    assert not isinstance(found, FitFailure), found


def test_cameras_of_another_focus_are_refused() -> None:
    views, _ = make_views(Scene(n_views=10, bow_mm=(0.3, -0.2)), 1)
    values = CAMERA.parameters * np.where(np.arange(len(CAMERA.parameters)) < 2, 1.1, 1.0)
    moved = CameraModel.from_parameters(values, CAMERA.width_px, CAMERA.height_px)
    found = prepare_cameras(
        (views, views), StereoOptions(), (certain_camera(moved, PROVENANCE),) * 2
    )
    assert isinstance(found, FitFailure)
    assert "do not fit the calibration given" in found.reason
