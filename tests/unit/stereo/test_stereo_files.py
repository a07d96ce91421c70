# SPDX-License-Identifier: Apache-2.0
"""``stereo.json`` holds what was written, and refuses what it should."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from armscan.errors import FileFormatError
from armscan.jobs.info import describe_files
from armscan.models.two_views import StereoCalibration, StereoDiagnostics
from armscan.storage.documents import (
    camera_document,
    read_sensor_calibration,
    read_stereo_calibration,
    stereo_document,
)
from rigs.stereo_rig import CONVERGING, LEFT, RIGHT, held


def calibration() -> StereoCalibration:
    """Two cameras with a covariance of odd numbers."""
    root = np.random.default_rng(0).normal(size=(24, 24)) / 3.0
    covariance = root @ root.T
    left, right = held(LEFT, covariance[:9, :9]), held(RIGHT, covariance[9:18, 9:18])
    evidence = StereoDiagnostics(
        epipolar_rms_px=0.1,
        epipolar_mean_px=-1 / 3,
        left_out=(("left3.png + right3.png", "moved"),),
        intrinsics="prior",
        hold_out_rms_px=0.21,
        typical_level=1.5,
        target_error_mm=0.02,
    )
    return StereoCalibration(
        left=left,
        right=right,
        right_from_left=CONVERGING,
        covariance=covariance,
        rms_px=1 / 7,
        n_pairs=8,
        n_points=700,
        provenance=left.provenance,
        diagnostics=evidence,
    )


def test_reading_gives_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "stereo.json"
    given = calibration()
    path.write_bytes(stereo_document(given, ("stereo.npz", b"content")))
    found = read_stereo_calibration(path)
    assert np.array_equal(found.covariance, given.covariance)
    assert np.array_equal(found.right_from_left.matrix, given.right_from_left.matrix)
    for side in ("left", "right"):
        a, b = getattr(found, side), getattr(given, side)
        assert np.array_equal(a.camera.parameters, b.camera.parameters)
        assert np.array_equal(a.covariance, b.covariance)
    assert found.diagnostics == given.diagnostics
    assert (found.rms_px, found.n_pairs, found.n_points) == (1 / 7, 8, 700)
    assert found.provenance == given.provenance


def test_info_knows_the_document(tmp_path: Path) -> None:
    path = tmp_path / "stereo.json"
    path.write_bytes(stereo_document(calibration()))
    item = describe_files([str(path)]).data["items"][0]
    assert item["what"].startswith("stereo calibration, cameras 2048 x 1536")
    assert item["baseline_mm"] == pytest.approx(np.hypot(np.hypot(128.0, 2.0), 35.0), abs=1e-4)
    assert item["taken_apart"] == ["left3.png + right3.png"]


def test_documents_of_other_kinds_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_bytes(camera_document(held(LEFT)))
    with pytest.raises(FileFormatError, match="camera calibration, and a stereo calibration"):
        read_stereo_calibration(path)
    path.write_bytes(stereo_document(calibration()))
    with pytest.raises(FileFormatError, match="stereo calibration, and a sensor calibration"):
        read_sensor_calibration(path)


def test_values_that_cannot_be_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "stereo.json"
    content = json.loads(stereo_document(calibration()))
    del content["sha256"]
    content["right_from_sensor"]["rotation_rows"][0][0] += 0.1
    path.write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match="not a rotation"):
        read_stereo_calibration(path)
    content["right_from_sensor"]["angle"] = 3
    path.write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match="right_from_sensor"):
        read_stereo_calibration(path)
