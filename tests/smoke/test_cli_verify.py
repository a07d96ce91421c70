# SPDX-License-Identifier: Apache-2.0
"""``armscan verify`` on a recording: a good head passes, a moved one does not."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armscan.cli.run import main
from armscan.geometry.poses import Pose
from armscan.storage.documents import scanner_document
from armscan.storage.recording import write_recording
from rigs import scan_fake

SIGMA = np.array([2e-4, 2e-4, 2e-4, 0.015, 0.015, 0.015])


def scanner_bytes(shift_mm: float) -> bytes:
    scanner = scan_fake.scanner()
    pose = scanner.hand_eye.tool_from_sensor
    moved = Pose(pose.rotation, pose.translation_mm + np.array([0.0, 0.0, shift_mm]))
    hand_eye = replace(scanner.hand_eye, tool_from_sensor=moved, covariance=np.diag(SIGMA**2))
    return scanner_document(replace(scanner, hand_eye=hand_eye))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the plane Z = 0, its plate file, and two scanners."""
    made = tmp_path_factory.mktemp("verify")
    source = scan_fake.as_source(scan_fake.fake_scan(12, 2.0))
    write_recording(made / "plate", source)
    (made / "good.json").write_bytes(scanner_bytes(0.0))
    (made / "moved.json").write_bytes(scanner_bytes(0.3))
    (made / "plate.csv").write_text("A,B,C,D\n0,0,1,0\n")
    return made


def test_a_good_head_passes_and_a_moved_one_does_not(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["verify", str(folder / "plate"), "--plate", str(folder / "plate.csv"), "--json"]
    found = {}
    for name, code in (("good", 0), ("moved", 1)):
        assert main([*words, "--scanner", str(folder / f"{name}.json")]) == code
        found[name] = json.loads(capsys.readouterr().out)
    assert found["good"]["verdict"] == "still valid"
    assert found["moved"]["verdict"] == "not valid"
    assert abs(found["moved"]["checks"][0]["error"]) == pytest.approx(0.3, abs=0.02)
    assert found["good"]["checks"][1]["name"] == "hand-eye correction"
    assert any("uncertainty is not known" in text for text in found["good"]["warnings"])


def test_a_recording_without_the_ball_gets_one_sentence(
    folder: Path, fails: Callable[..., str]
) -> None:
    scan, scanner = folder / "plate", folder / "good.json"
    assert "no ball of 34.96 mm" in fails("verify", scan, "--scanner", scanner, "--ball", 34.96)
    assert "give --scanner" in fails("verify", scan, "--ball", 34.96)
