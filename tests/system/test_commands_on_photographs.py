# SPDX-License-Identifier: Apache-2.0
"""The commands as typed on real photographs: camera, both sheets of a turntable scanner, a bust."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from armscan.cli import main
from armscan.storage.clouds import read_ply

DATA = Path(os.environ.get("ARMSCAN_DATA", Path(__file__).parents[3] / "shared" / "data"))
CICLOP = DATA / "ciclop"
pytestmark = pytest.mark.skipif(
    not CICLOP.is_dir(), reason=f"the photographs of {CICLOP} are not here (ARMSCAN_DATA)"
)

BOARD = "chessboard:11x6:13"


def run(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, object]:
    assert main([*(str(word) for word in words), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert isinstance(report, dict)
    return report


def test_ciclop_from_photographs_to_points(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera, sensor, cloud = (tmp_path / name for name in ("camera.json", "sensor.json", "b.ply"))
    report = run(
        capsys,
        "calibrate",
        "camera",
        CICLOP / "camera/frame[0-7].jpg",
        "--target",
        BOARD,
        "-o",
        camera,
    )
    assert report["n_views"] == 8
    focal = report["parameters"]
    assert isinstance(focal, dict)
    assert focal["fx"] == pytest.approx(1431.0, abs=8.0)
    pattern = CICLOP / "laser_pattern"
    report = run(
        capsys,
        *("calibrate", "laser", "--camera", camera, "--target", BOARD, "-o", sensor),
        *("--on", pattern / "laser-0*.png", "--off", pattern / "laser-background*.png"),
    )
    sheets = report["sheets"]
    assert isinstance(sheets, list)
    assert [sheet["name"] for sheet in sheets] == ["A", "B"]
    assert all(sheet["rms_mm"] < 0.15 and not sheet["is_redundant"] for sheet in sheets)
    assert any("two boards" in str(warning).lower() for warning in report["warnings"])
    bust = CICLOP / "laser_object"
    report = run(
        capsys,
        *("reconstruct", bust / "laser.png", "--background", bust / "laser_background.png"),
        *("--sensor", sensor, "--sheet", "B", "--depth-margin", 3, "-o", cloud),
    )
    points = read_ply(cloud)
    assert report["n_points"] == len(points) > 800
    assert 220.0 < float(np.median(points.points_mm[:, 2])) < 300.0
    assert float(np.ptp(points.points_mm[:, 1])) > 150.0
