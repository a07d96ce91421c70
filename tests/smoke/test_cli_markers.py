# SPDX-License-Identifier: Apache-2.0
"""``armscan markers`` on drawn plates: rings in images, and in space with two cameras."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.cli.run import main
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose
from armscan.models.calibration import CameraCalibration, Provenance
from armscan.models.camera import CameraModel
from armscan.models.two_views import StereoCalibration
from armscan.storage.documents import stereo_document
from armscan.storage.points import read_marker_list
from rigs.ring_scenes import Mark, render, tilted

WIDTH, HEIGHT, FOCAL_PX = 480, 400, 1000.0
DISTANCE_MM, BASELINE_MM, RADIUS_MM = 150.0, 60.0, 3.0
PLACES = [(-18.0, -11.0), (-2.0, -14.0), (14.0, -9.0), (-12.0, 4.0), (5.0, 1.0), (16.0, 9.0)]
PLACES += [(-4.0, 13.0)]


def right_from_left() -> tuple[FloatArray, FloatArray]:
    """The right camera stands 60 mm to the right and looks at the same place."""
    turn = np.arctan2(BASELINE_MM, DISTANCE_MM)
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return rotation, -rotation @ np.array([BASELINE_MM, 0.0, 0.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``left.png``, ``right.png``, ``stereo.json``."""
    path = tmp_path_factory.mktemp("markers")
    marks = [Mark("ring", x, y, RADIUS_MM, 0.5 * RADIUS_MM) for x, y in PLACES]
    plate = tilted(15.0, 40.0), np.array([0.0, 0.0, DISTANCE_MM])
    turn, shift = right_from_left()
    for name, rotation, translation in (
        ("left", *plate),
        ("right", turn @ plate[0], turn @ plate[1] + shift),
    ):
        rendered = render(marks, rotation, translation, (WIDTH, HEIGHT), focal_px=FOCAL_PX, rays=4)
        cv2.imwrite(str(path / f"{name}.png"), rendered.exposure(1).image)
    camera = CameraModel(
        fx_px=FOCAL_PX,
        fy_px=FOCAL_PX,
        cx_px=(WIDTH - 1) / 2,
        cy_px=(HEIGHT - 1) / 2,
        distortion=np.zeros(5),
        width_px=WIDTH,
        height_px=HEIGHT,
    )
    origin = Provenance(
        document_id="drawn",
        created_utc="2026-01-01T00:00:00+00:00",
        armscan_version="0",
        command=(),
        inputs=(),
    )
    calibration = CameraCalibration(
        camera=camera,
        covariance=np.zeros((9, 9)),
        has_covariance=True,
        rms_px=0.1,
        sigma_point_px=0.05,
        n_views=9,
        n_points=99,
        covered_px=np.array([0, 0, WIDTH, HEIGHT]),
        provenance=origin,
    )
    stereo = StereoCalibration(
        left=calibration,
        right=calibration,
        right_from_left=Pose(turn, shift),
        covariance=np.zeros((24, 24)),
        rms_px=0.1,
        n_pairs=9,
        n_points=99,
        provenance=origin,
    )
    (path / "stereo.json").write_bytes(stereo_document(stereo))
    return path


def test_rings_in_images(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = folder / "rings.html"
    words = ["markers", str(folder / "left.png"), str(folder / "right.png"), "-o", str(page)]
    assert main([*words, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [len(image["rings"]) for image in report["images"]] == [len(PLACES)] * 2
    assert page.read_text("utf-8").count("<svg") == 2
    assert main(words) == 2
    assert "--force" in capsys.readouterr().err


def test_markers_in_space(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = folder / "markers.csv"
    words = ["markers", str(folder / "left.png"), str(folder / "right.png")]
    words += ["--stereo", str(folder / "stereo.json"), "--diameter", "6", "--depth", "100:200"]
    assert main([*words, "-o", str(table), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    markers = read_marker_list(table, frame="Base").markers
    assert markers.frame == report["frame"] == "Sensor"
    assert len(markers) == len(report["markers"]) == len(PLACES)
    true = np.column_stack([PLACES, np.zeros(len(PLACES))]) @ tilted(15.0, 40.0).T
    true[:, 2] += DISTANCE_MM
    away = np.linalg.norm(markers.points_mm[:, None] - true, axis=2)
    # A hundredth of a pixel is 0.0015 mm across and 0.004 mm in depth.
    assert away.min(axis=0).max() < 0.03
    assert report["left_rings"]["matched"] == len(PLACES)
    assert table.with_suffix(".html").is_file()


def test_wrong_input_is_said(folder: Path, tmp_path: Path, fails: Callable[..., str]) -> None:
    left, right = folder / "left.png", folder / "right.png"
    stereo = ("--stereo", folder / "stereo.json")
    out = tmp_path / "m.csv"
    assert "1 images" in fails("markers", left, *stereo, "-o", out, writes=tmp_path)
    assert "end it in .csv" in fails("markers", left, right, *stereo, "-o", tmp_path / "m.html")
    assert "needs --stereo" in fails("markers", left, "-o", out, writes=tmp_path)
    # The right image in the left one's place: every point would lie behind the cameras.
    swapped = fails("markers", right, left, *stereo, "-o", out, writes=tmp_path)
    assert "the left image comes first" in swapped
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), np.zeros((40, 50), np.uint8))
    assert "50 x 40 px" in fails("markers", small, right, *stereo, "-o", out)
    depth = fails("markers", left, right, *stereo, "--depth", "100", "-o", out)
    assert "100:180" in depth
