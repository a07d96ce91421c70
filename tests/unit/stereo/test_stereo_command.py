# SPDX-License-Identifier: Apache-2.0
"""``armscan calibrate stereo`` on real pairs; skipped where the data folder is absent."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.cli.run import main
from armscan.storage.documents import read_stereo_calibration
from rigs.photographs import DATA

PAIRS = DATA / "stereo_chessboard"
TARGET = ["--target", "chessboard:9x6:25"]
SMALL = ["--distortion", "k1k2"]
"""A model that need not be chosen by hold-out tests, which take time."""


def sides(pattern: str = "0*") -> list[str]:
    """Patterns of the left and of the right images."""
    if not list(PAIRS.glob("left*.jpg")):
        pytest.skip("no real photographs: set ARMSCAN_DATA")
    return [str(PAIRS / f"{side}{pattern}.jpg") for side in ("left", "right")]


def calibrate(*words: str) -> int:
    return main(["calibrate", "stereo", *words])


def test_real_pairs_from_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "stereo.json"
    assert calibrate(*sides(), *TARGET, "-o", str(output), "--json") == 0
    report = json.loads(capsys.readouterr().out)
    found = read_stereo_calibration(output)
    assert report["n_pairs"] == found.n_pairs == 9
    # NOTE of the data: OpenCV's own rms is about 0.28 px.
    assert found.rms_px < 0.2
    assert report["epipolar_rms_px"] < 0.12
    # Sigma of the baseline is 0.05 mm with squares taken as 25 mm; axes nearly parallel.
    assert abs(np.linalg.norm(found.right_from_left.translation_mm) - 83.2) < 0.25
    page = output.with_suffix(".html").read_text()
    assert "left08.jpg + right08.jpg" in page
    assert "Distance from the epipolar line" in page


def test_lists_of_different_length(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    left, _ = sides()
    right = str(PAIRS / "right0[1-5].jpg")
    assert calibrate(left, right, *TARGET, "-o", str(tmp_path / "s.json")) == 2
    said = capsys.readouterr().err
    assert "9 left images" in said
    assert "5 right ones" in said


def test_an_image_without_partner_can_be_left_out(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """But not one that has a partner: all others would be paired one off."""
    left, right = sides("0[1-4]")[0], sides("0[1-5]")[1]
    words = [*TARGET, *SMALL, "-o", str(tmp_path / "s.json"), "--json"]
    assert calibrate(left, right, *words) == 2
    assert "right05.jpg has no partner" in capsys.readouterr().err
    assert calibrate(left, right, *words, "--leave-out", "right05.jpg") == 0
    assert json.loads(capsys.readouterr().out)["n_pairs"] == 4
    assert calibrate(left, right, *words, "--leave-out", "right04.jpg", "--force") == 2
    assert "right05.jpg has no partner" in capsys.readouterr().err


def test_the_same_images_twice(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    left, _ = sides()
    assert calibrate(left, left, *TARGET, "-o", str(tmp_path / "s.json")) == 2
    assert "given for both cameras" in capsys.readouterr().err


def test_one_camera_sees_no_target(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    left = str(PAIRS / "left0[1-4].jpg")
    sides()
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"dark{k}.png"), np.zeros((480, 640), np.uint8))
    output = tmp_path / "s.json"
    assert calibrate(left, str(tmp_path / "dark*.png"), *TARGET, "-o", str(output)) == 2
    said = capsys.readouterr().err
    assert "4 of 4 left images and 0 of 4 right images" in said
    assert not output.exists()


def test_an_image_of_another_size(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    left = str(PAIRS / "left0[1-3].jpg")
    sides()
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"r{k}.png"), np.zeros((480, 640 + 2 * (k == 1)), np.uint8))
    assert calibrate(left, str(tmp_path / "r*.png"), *TARGET, "-o", str(tmp_path / "s.json")) == 2
    assert "642 x 480 px" in capsys.readouterr().err


def test_a_recording_of_two_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The same images as rows of a recording, paired by trigger; a row with laser is not used.

    The list of exposures is among the inputs, what the arm said is not; a column that nothing is
    known of is told on the terminal, on the page and in the document.
    """
    patterns = sides("0[1-4]")
    lines = ["index,t_ns,camera,file,lasers,trigger_id,weather"]
    for camera, pattern in enumerate(patterns):
        for k, path in enumerate(sorted(Path(pattern).parent.glob(Path(pattern).name))):
            (tmp_path / "scan").mkdir(exist_ok=True)
            (tmp_path / "scan" / path.name).write_bytes(path.read_bytes())
            # The right camera's clock is late: the trigger tells which images belong together.
            t_ns = 1000000 * k + 700000 * camera
            lines.append(f"{4 * camera + k},{t_ns},{camera},{path.name},,{k},fair")
    lines.append(f"99,99000000,0,{path.name},A,99,fair")
    (tmp_path / "scan" / "exposures.csv").write_text("\n".join(lines) + "\n")
    output = tmp_path / "s.json"
    words = ("--scan", str(tmp_path / "scan"), *TARGET, *SMALL, "-o", str(output))
    assert calibrate(*words, "--json") == 0
    found = read_stereo_calibration(output)
    assert found.n_pairs == 4
    inputs = [Path(item.path).name for item in found.provenance.inputs]
    assert "exposures.csv" in inputs and len(inputs) == 9
    told = json.loads(capsys.readouterr().out)["warnings"]
    for place in (told, found.provenance.warnings, [output.with_suffix(".html").read_text()]):
        assert any("weather" in text for text in place)


def test_calibrations_of_the_cameras_from_the_same_images_do_not_count_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = []
    for side, pattern in zip(("left", "right"), sides("0[1-4]"), strict=True):
        camera = tmp_path / f"{side}.json"
        assert main(["calibrate", "camera", pattern, *TARGET, *SMALL, "-o", str(camera)]) == 0
        words += [f"--{side}", str(camera)]
    both = (*sides("0[1-4]"), *TARGET, *words, "-o", str(tmp_path / "s.json"))
    capsys.readouterr()
    assert calibrate(*both) == 2
    assert "count twice" in capsys.readouterr().err
    assert calibrate(*both, "--intrinsics", "fixed") == 0
    found = read_stereo_calibration(tmp_path / "s.json")
    assert found.diagnostics is not None
    assert found.diagnostics.intrinsics == "fixed"
    assert found.left.covariance.any()
