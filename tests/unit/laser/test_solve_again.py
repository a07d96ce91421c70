# SPDX-License-Identifier: Apache-2.0
"""Light sheets are solved again, to the last bit, from what lies beside their document."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armscan.calibration.sheets.board_points import HeadCameras, place_board
from armscan.calibration.sheets.calibrate import calibrate_sheets
from armscan.calibration.sheets.result import BoardStripes, LaserFit, SheetOptions
from armscan.errors import InputError
from armscan.geometry.estimate import FitFailure
from armscan.models.calibration import CameraCalibration, SensorCalibration
from armscan.models.two_views import StereoCalibration
from armscan.pipeline.laser import calibrate_sheets_again
from armscan.storage.documents import read_sensor_calibration, sensor_document
from armscan.storage.observations import (
    pack_board_stripes,
    pack_observations,
    read_observations,
)
from rigs.fan_rig import fan_rig
from rigs.sheet_rig import PROVENANCE, thesis_rig


def kept(
    boards: Sequence[BoardStripes],
    camera: CameraCalibration | StereoCalibration,
    options: SheetOptions,
    folder: Path,
) -> tuple[SensorCalibration, Path]:
    """The document as it is read back, and the file of observations."""
    fit = calibrate_sheets(boards, camera, options)
    assert isinstance(fit, LaserFit), fit
    (folder / "s.npz").write_bytes(pack_board_stripes(fit, {}))
    (folder / "s.json").write_bytes(sensor_document(fit.to_calibration(PROVENANCE)))
    return read_sensor_calibration(folder / "s.json"), folder / "s.npz"


def assert_same(found: LaserFit | FitFailure, document: SensorCalibration) -> None:
    assert isinstance(found, LaserFit), found
    text = sensor_document(found.to_calibration(PROVENANCE))
    assert text == sensor_document(document)


def boards_of_one_camera() -> tuple[list[BoardStripes], CameraCalibration]:
    """One board has points along an edge, of one the edges are unknown, one runs along an edge."""
    rig = thesis_rig(bow_uu_mm=0.15)
    camera = rig.calibration(rig.camera)
    cameras = HeadCameras.of(camera)
    boards = []
    for k, board in enumerate(rig.boards(rig.camera, np.random.default_rng(1))):
        n = len(board.profile)
        on_edge = np.arange(n) < (n // 3 if k != 2 else n)
        placed = place_board(((0, board.view, board.sensor_from_board),), cameras)
        boards.append(replace(board, on_edge=None if k == 1 else on_edge, placed=placed))
    return boards, camera


def test_one_camera_with_edges_of_its_target(tmp_path: Path) -> None:
    boards, camera = boards_of_one_camera()
    document, observations = kept(boards, camera, SheetOptions(), tmp_path)
    assert document.sheets[0].sheet.is_bowed
    found = read_observations(observations)
    assert_same(calibrate_sheets_again(found, document), document)
    flat = calibrate_sheets_again(found, document, SheetOptions(is_bow_allowed=False))
    assert isinstance(flat, LaserFit)
    assert not flat.sheets[0].sheet.is_bowed


def test_two_cameras_and_a_fan(tmp_path: Path) -> None:
    rig = fan_rig(3, 6, 5)
    rng = np.random.default_rng(3)
    stereo = rig.drawn_stereo(rng)
    boards, _ = rig.boards(stereo, rng)
    options = SheetOptions(n_sheets=5)
    document, observations = kept(boards, stereo, options, tmp_path)
    assert document.second is not None
    again = calibrate_sheets_again(read_observations(observations), document, options)
    assert_same(again, document)


def test_observations_without_lasers_and_cameras_are_refused(tmp_path: Path) -> None:
    """As an older version wrote them: views and stripe points alone."""
    boards, camera = boards_of_one_camera()
    document, observations = kept(boards, camera, SheetOptions(), tmp_path)
    views, profiles = [b.view for b in boards], [b.profile for b in boards]
    for content in (pack_observations(views, profiles, {}), pack_observations(views, (), {})):
        observations.write_bytes(content)
        failure = calibrate_sheets_again(read_observations(observations), document)
        assert isinstance(failure, FitFailure)
        assert "older version" in failure.reason


def test_a_board_without_pose_is_not_packed(tmp_path: Path) -> None:
    rig = thesis_rig()
    boards = rig.boards(rig.camera, np.random.default_rng(1))
    with pytest.raises(InputError, match="pose in Sensor is not given"):
        kept(boards, rig.calibration(rig.camera), SheetOptions(), tmp_path)
