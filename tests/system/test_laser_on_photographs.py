# SPDX-License-Identifier: Apache-2.0
"""Both light sheets of a desktop scanner from real photographs, and the stripe on a bust."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armscan.calibration.sheets.result import LaserFit, PointUse
from armscan.errors import EstimationError, OptionError
from armscan.jobs.job import Job
from armscan.jobs.sheets import SheetImages
from armscan.jobs.sheets import calibrate_sheets as calibrate_sheets_of_files
from armscan.models.calibration import CameraCalibration, Provenance, SensorCalibration
from armscan.pipeline.cameras import CameraRun, calibrate_camera_from_exposures
from armscan.pipeline.instants import pair_exposures
from armscan.pipeline.laser import calibrate_sheets_from_pairs
from armscan.pipeline.measure import MeasureOptions, reconstruct
from armscan.reconstruction.labels import PointStatus
from armscan.reconstruction.triangulate import DepthRange
from armscan.storage.documents import camera_document, read_sensor_calibration
from armscan.storage.images import read_exposure
from armscan.vision.targets.target import Chessboard
from rigs.photographs import DATA, needs

CICLOP = DATA / "ciclop"
pytestmark = needs("ciclop")
BOARD = Chessboard(11, 6, 13.0)
PLACEMENTS = ("0-255-255-8", "0-255-255-8-x")
NO_PROVENANCE = Provenance(
    document_id="test",
    created_utc="2026-01-01T00:00:00Z",
    armscan_version="0",
    command=("test",),
    inputs=(),
)
STRIPE_PX = 0.7
"""The lines are 3 px wide on paper squares, with speckle, through a webcam's JPEG."""


@pytest.fixture(scope="module")
def laser() -> LaserFit:
    photos = [read_exposure(CICLOP / "camera" / f"frame{k}.jpg") for k in range(16)]
    run = calibrate_camera_from_exposures(photos, BOARD)
    assert isinstance(run, CameraRun), run
    fit = run.fit
    camera = CameraCalibration(
        camera=fit.camera,
        covariance=fit.covariance,
        has_covariance=True,
        rms_px=fit.rms_px,
        sigma_point_px=fit.sigma_point_px,
        n_views=fit.n_views,
        n_points=fit.n_points,
        covered_px=fit.coverage.covered_px,
        provenance=NO_PROVENANCE,
    )
    folder = CICLOP / "laser_pattern"
    pairs = pair_exposures(
        [read_exposure(folder / f"laser-{name}.png") for name in PLACEMENTS],
        [read_exposure(folder / f"laser-background-{name}.png") for name in PLACEMENTS],
    )
    found = calibrate_sheets_from_pairs(pairs, BOARD, camera)
    assert isinstance(found, LaserFit), found
    return found


@pytest.fixture(scope="module")
def sensor(laser: LaserFit) -> SensorCalibration:
    return laser.to_calibration(NO_PROVENANCE)


def test_both_sheets_fit_their_two_boards(laser: LaserFit) -> None:
    assert laser.sheet_names == ("A", "B")
    for sheet in laser.sheets:
        assert sheet.calibration.n_boards == 2
        assert sheet.calibration.n_points > 300
        assert sheet.diagnostics.rms_px < STRIPE_PX
        assert sheet.diagnostics.coplanarity_mm < 3.0 * sheet.diagnostics.coplanarity_sigma_mm
        assert 15.0 < sheet.diagnostics.board_angle_deg < 30.0
        assert not sheet.calibration.is_redundant
        assert any("two boards only" in warning for warning in sheet.warnings)
        assert sheet.tilt_sigma_deg < 1.5
    for image in laser.images:
        assert image.pose_shift_sigma < 4.0
        assert image.count(PointUse.OFF_LINE) < 0.1 * len(image.profile)


def test_a_recording_gives_the_same_sheets(laser: LaserFit, tmp_path: Path) -> None:
    """The same photographs as a folder recording: lasers and views say what belongs together."""
    scan = tmp_path / "scan"
    (scan / "images").mkdir(parents=True)
    rows = ["index,t_ns,camera,file,lasers,view"]
    for k, name in enumerate(PLACEMENTS):
        for j, kind in enumerate(("laser", "laser-background")):
            photo = f"images/{kind}-{name}.png"
            shutil.copy(CICLOP / "laser_pattern" / Path(photo).name, scan / photo)
            lit = "A+B" if kind == "laser" else ""
            rows.append(f"{2 * k + j},{1000 * (2 * k + j)},0,{photo},{lit},{k}")
    (scan / "exposures.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    session = 'kind = "calibration"\n[[camera]]\nwidth_px = 960\nheight_px = 1280\ncolour = "rgb"\n'
    (scan / "session.toml").write_text(session, encoding="utf-8")
    camera = tmp_path / "camera.json"
    camera.write_bytes(camera_document(laser.camera))
    output = tmp_path / "sensor.json"
    board, images = "chessboard:11x6:13", SheetImages(scan=scan)
    summary = calibrate_sheets_of_files(Job(output), camera, board, images)
    found = read_sensor_calibration(output)
    assert [sheet.name for sheet in found.sheets] == ["A", "B"]
    for ours, theirs in zip(found.sheets, laser.sheets, strict=True):
        np.testing.assert_allclose(ours.sheet.plane, theirs.sheet.plane, atol=1e-9)
    assert len(found.provenance.inputs) == 4 + 2 + 1
    assert summary.data["cameras"] == 1
    with pytest.raises(OptionError, match="a recording and images"):
        calibrate_sheets_of_files(
            Job(output, is_overwriting=True), camera, board, SheetImages(on=("x.png",), scan=scan)
        )


def test_the_sheets_lie_as_the_scanner_is_built(laser: LaserFit) -> None:
    """Upright line lasers at about 30 degrees left and right, crossing near the turntable's axis.

    Neither fact went into the fit; two placements alone could not check the planes.
    """
    left, right = (sheet.sheet.plane for sheet in laser.sheets)
    for plane in (left, right):
        turn = np.degrees(np.arctan2(abs(plane[2]), abs(plane[0])))
        assert 25.0 < turn < 37.0
    crossing = np.cross(left[:3], right[:3])
    upright = np.degrees(np.arccos(abs(crossing[1]) / np.linalg.norm(crossing)))
    assert upright < 3.0
    at_axis = np.linalg.solve(
        np.stack([left[:3], right[:3], [0.0, 1.0, 0.0]]), [-left[3], -right[3], 0.0]
    )
    assert 285.0 < at_axis[2] < 335.0
    assert abs(at_axis[0]) < 25.0


def test_the_stripe_on_the_bust_is_in_front_of_the_turntables_axis(
    sensor: SensorCalibration,
) -> None:
    """Only sheet B puts it there; A would put it 60 mm behind the axis, inside the bust's back.

    Two boards calibrated 15 mm of depth, and the bust is 65 mm deep: the margin asks for that.
    """
    folder = CICLOP / "laser_object"
    on, off = read_exposure(folder / "laser.png"), read_exposure(folder / "laser_background.png")
    options = MeasureOptions(depths=DepthRange(margin=3.0))
    result = reconstruct([on], sensor, backgrounds=[off], options=options)
    cloud = result.cloud
    assert "B" in result.images[0].reason
    assert set(cloud.sheet.tolist()) == {1}
    assert result.images[0].count(PointStatus.MEASURED) == len(cloud) > 700
    assert 215.0 < cloud.points_mm[:, 2].min() < cloud.points_mm[:, 2].max() < 300.0
    assert 190.0 < np.ptp(cloud.points_mm[:, 1]) < 225.0, "a bust of about 20 cm"
    assert any("outside its calibrated depth range" in warning for warning in result.warnings)
    asked = reconstruct([on], sensor, backgrounds=[off], options=replace(options, sheet="B"))
    np.testing.assert_array_equal(asked.cloud.points_mm, cloud.points_mm)


def test_an_ambiguous_stripe_is_asked_for_not_guessed(sensor: SensorCalibration) -> None:
    on = read_exposure(CICLOP / "laser_object" / "laser.png")
    off = read_exposure(CICLOP / "laser_object" / "laser_background.png")
    wide = MeasureOptions(depths=DepthRange(margin=20.0))
    with pytest.raises(EstimationError, match="--sheet"):
        reconstruct([on], sensor, backgrounds=[off], options=wide)
