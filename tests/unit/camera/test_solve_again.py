# SPDX-License-Identifier: Apache-2.0
"""A camera's document is solved again from its own observations (``calibrate camera --from``)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from armscan.calibration.cameras.calibrate import calibrate_camera
from armscan.calibration.cameras.result import CameraFit, CameraOptions
from armscan.errors import OptionError
from armscan.jobs.camera import calibrate_camera_from_file
from armscan.jobs.job import Job
from armscan.pipeline.cameras import camera_calibration
from armscan.storage.documents import (
    camera_document,
    new_provenance,
    read_camera_calibration,
    recorded_options,
)
from armscan.storage.observations import pack_observations
from armscan.vision.targets.target import TargetView
from rigs.camera_scene import GRID, Scene, make_views

OPTIONS = CameraOptions(distortion="k1k2", n_folds=0)


def one_row(view: TargetView) -> TargetView:
    """Only the points of the board's first row, which tell no pose."""
    row = view.points_board_mm[:, 1] == view.points_board_mm[0, 1]
    return replace(
        view,
        point_index=view.point_index[row],
        points_px=view.points_px[row],
        covariance_px2=view.covariance_px2[row],
        points_board_mm=view.points_board_mm[row],
    )


def written(folder: Path) -> Path:
    """The document of a camera of which one usable view and one of a single row were left out."""
    views, _ = make_views(Scene(n_views=8), seed=1)
    views[7] = one_row(views[7])
    options = replace(OPTIONS, leave_out=(views[2].source, views[7].source))
    fit = calibrate_camera(views, options)
    assert isinstance(fit, CameraFit)
    assert [view.source for view in fit.refused_views] == [views[7].source]
    observations = pack_observations([view.view for view in fit.views], (), {})
    calibration = camera_calibration(fit, new_provenance(options=(GRID, fit.options)))
    (folder / "camera.npz").write_bytes(observations)
    (folder / "camera.json").write_bytes(camera_document(calibration, ("camera.npz", observations)))
    return folder / "camera.json"


def test_a_view_left_out_that_has_no_pose_does_not_bar_the_document(tmp_path: Path) -> None:
    """It is not among the observations; the other one that was left out stays out."""
    document = written(tmp_path)
    again = tmp_path / "again.json"
    calibrate_camera_from_file(Job(output=again), document)
    before, after = (read_camera_calibration(path) for path in (document, again))
    assert after.n_views == before.n_views == 6
    assert after.camera.parameters == pytest.approx(before.camera.parameters, rel=1e-9, abs=1e-9)
    kept = recorded_options(after.provenance, CameraOptions)["leave_out"]
    assert kept == ("view02.png",)


def test_a_name_that_is_typed_must_be_there(tmp_path: Path) -> None:
    document = written(tmp_path)
    with pytest.raises(OptionError, match="view07"):
        calibrate_camera_from_file(
            Job(output=tmp_path / "again.json"), document, {"leave_out": ("view07.png",)}
        )
