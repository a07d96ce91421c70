# SPDX-License-Identifier: Apache-2.0
"""mrcal as the oracle for a whole solution, where it is installed."""

import numpy as np
import pytest

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.geometry.rotations import vector_from_rotation
from rigs.camera_scene import CAMERA, GRID, Scene, make_views

mrcal = pytest.importorskip("mrcal")

FULL = Scene(reach=0.05, distance_mm=330.0)
"""Views that show the whole board: mrcal's observations are rectangular arrays."""


def test_solution_is_that_of_mrcal() -> None:
    views = [view for view in make_views(FULL, 1)[0] if len(view) == len(GRID.points_board_mm)]
    assert len(views) >= 8
    fit = calibrate_camera(views, CameraOptions(distortion="k1k2p1p2k3", n_folds=0))
    assert isinstance(fit, CameraFit)
    # mrcal's order is x along its second axis, and its boards are observed as (rows, columns).
    observations = np.stack(
        [
            np.column_stack([view.points_px, np.ones(len(view))]).reshape(
                GRID.rows, GRID.columns, 3
            )
            for view in views
        ]
    )
    frames = np.stack(
        [
            np.append(
                vector_from_rotation(view.sensor_from_board.rotation),
                view.sensor_from_board.translation_mm,
            )
            for view in fit.views
        ]
    )
    is_new = "rt_cam_ref" in (mrcal.optimize.__doc__ or "")
    cameras, boards = (
        ("rt_cam_ref", "rt_ref_frame") if is_new else ("extrinsics_rt_fromref", "frames_rt_toref")
    )
    start = CAMERA.parameters * [1.01, 0.99, 1.01, 0.99, 0.9, 0.9, 0.9, 0.9, 0.9]
    inputs = {
        "lensmodel": "LENSMODEL_OPENCV5",
        "intrinsics": start[None].copy(),
        cameras: np.zeros((0, 6)),
        boards: frames.copy(),
        "points": None,
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "observations_board": observations,
        "indices_frame_camintrinsics_camextrinsics": np.array(
            [[index, 0, -1] for index in range(len(views))], dtype=np.int32
        ),
        "imagersizes": np.array([[CAMERA.width_px, CAMERA.height_px]], dtype=np.int32),
        "calibration_object_spacing": GRID.pitch_mm,
        "do_optimize_calobject_warp": False,
        "do_apply_regularization": False,
        "do_apply_outlier_rejection": False,
        "verbose": False,
    }
    mrcal.optimize(**inputs)
    theirs = inputs["intrinsics"][0]
    assert np.abs((fit.camera.parameters - theirs) / fit.sigma).max() < 0.01
