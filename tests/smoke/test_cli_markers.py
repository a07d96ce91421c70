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
from armscan.storage.points import read_marker_list
from rigs.marked_plate import DISTANCE_MM, PLACES, draw_marked_plate
from rigs.ring_scenes import tilted


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``left.png``, ``right.png``, ``stereo.json``."""
    path = tmp_path_factory.mktemp("markers")
    draw_marked_plate(path)
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
    assert "needs `armscan markers --stereo`" in fails("markers", left, "-o", out, writes=tmp_path)
    # The right image in the left one's place: every point would lie behind the cameras.
    swapped = fails("markers", right, left, *stereo, "-o", out, writes=tmp_path)
    assert "the left image comes first" in swapped
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), np.zeros((40, 50), np.uint8))
    assert "50 x 40 px" in fails("markers", small, right, *stereo, "-o", out)
    depth = fails("markers", left, right, *stereo, "--depth", "100", "-o", out)
    assert "100:180" in depth
