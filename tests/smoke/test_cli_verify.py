# SPDX-License-Identifier: Apache-2.0
"""``armscan verify`` on a recording: a good head passes, a moved one does not."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from armscan.cli.run import main
from armscan.devices.sources import ScanSource
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.models.arm import forward, thesis_arm
from armscan.storage.arm import arm_model_toml
from armscan.storage.documents import scanner_document
from armscan.storage.recording import read_recording, write_recording
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
    source = read_recording(folder / "plate")
    of_recording = (*source.warnings, *source.session.assumed)
    assert of_recording
    assert any(of_recording[0][1:] in text for text in found["good"]["warnings"])


def test_a_recording_is_known_as_well_as_the_cloud_of_it(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What the calibration errs is in both; `verify` left it out of the recording's."""
    standard = ("--plate", str(folder / "plate.csv"))
    scanner, cloud = str(folder / "good.json"), folder / "same.ply"
    recording = ["verify", str(folder / "plate"), "--scanner", scanner, *standard, "--json"]
    assert main(recording) == 0
    verified = json.loads(capsys.readouterr().out)["inspection"]["nominal"]["offset"]
    assert main(["reconstruct", str(folder / "plate"), "--scanner", scanner, "-o", str(cloud)]) == 0
    capsys.readouterr()
    assert main(["inspect", "plane", str(cloud), *standard, "--json"]) == 0
    inspected = json.loads(capsys.readouterr().out)["nominal"]["offset"]
    for key in ("sigma_mm", "sigma_scatter_mm", "sigma_propagated_mm"):
        assert verified[key] == pytest.approx(inspected[key], rel=1e-3)


def test_a_recording_without_the_ball_gets_one_sentence(
    folder: Path, fails: Callable[..., str], capsys: pytest.CaptureFixture[str]
) -> None:
    scan, scanner = folder / "plate", folder / "good.json"
    assert "no ball of 34.96 mm" in fails("verify", scan, "--scanner", scanner, "--ball", 34.96)
    assert "give --scanner" in fails("verify", scan, "--ball", 34.96)
    cloud = folder / "plate.ply"
    assert main(["reconstruct", str(scan), "--scanner", str(scanner), "-o", str(cloud)]) == 0
    capsys.readouterr()
    words = ("verify", cloud, "--plate", folder / "plate.csv", "--arm", folder / "arm.toml")
    assert "a cloud in Base takes no arm" in fails(*words)
    assert "no such file" in fails("verify", folder / "nothing", *words[2:], "--scanner", scanner)


def test_a_cloud_is_of_the_scanner_that_is_given(
    folder: Path, tmp_path: Path, fails: Callable[..., str], capsys: pytest.CaptureFixture[str]
) -> None:
    scanner = scan_fake.scanner()
    own = replace(scanner.provenance, document_id="own")
    (tmp_path / "own.json").write_bytes(scanner_document(replace(scanner, provenance=own)))
    other = replace(scanner.provenance, document_id="other")
    (tmp_path / "other.json").write_bytes(scanner_document(replace(scanner, provenance=other)))
    (tmp_path / "cut.json").write_bytes((tmp_path / "own.json").read_bytes()[:500])
    cloud = tmp_path / "plate.ply"
    words = ["reconstruct", folder / "plate", "--scanner", tmp_path / "own.json", "-o", cloud]
    assert main([str(word) for word in words]) == 0
    capsys.readouterr()
    check = ["verify", cloud, "--plane", "0,0,1,0", "--scanner"]
    said = fails(*check, tmp_path / "other.json")
    assert "the calibration own, and other.json is other" in said
    assert "cut.json" in fails(*check, tmp_path / "cut.json")
    assert "no such file" in fails(*check, tmp_path / "nothing.json")
    main([*map(str, check), str(tmp_path / "own.json"), "--json"])
    assert not any("taken from you" in text for text in _warnings(capsys))
    bare = tmp_path / "plate.xyz"
    assert main(["convert", str(cloud), str(bare)]) == 0
    capsys.readouterr()
    check[1] = bare
    main([*map(str, check), str(tmp_path / "own.json"), "--json"])
    assert any("own.json is taken from you" in text for text in _warnings(capsys))


def _warnings(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return list(json.loads(capsys.readouterr().out)["warnings"])


def test_a_plane_in_words_is_that_of_a_file(
    folder: Path, fails: Callable[..., str], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["verify", str(folder / "plate"), "--scanner", str(folder / "good.json"), "--json"]
    found = []
    for plate in (("--plane", "0,0,1,0"), ("--plate", str(folder / "plate.csv"))):
        assert main([*words, *plate]) == 0
        found.append(json.loads(capsys.readouterr().out)["checks"])
    assert found[0] == found[1]
    assert "a check needs one standard" in fails(*words, "--plane", "0,0,1,0", "--ball", 30)


ARM = thesis_arm((100.0, 200.0, 200.0, 50.0), (20.0, 30.0, 20.0))


def in_joints(scan: scan_fake.FakeScan) -> ScanSource:
    """The same scan by an arm that stands beside the plate and stores its joints' angles."""
    track, rng = scan.arm, np.random.default_rng(0)
    assert track is not None
    joints = np.zeros((len(track), 7))
    for k in range(len(track)):
        start = joints[k - 1]
        starts = (start, *rng.uniform(-2.0, 2.0, (20, 7)))
        found = (least_squares(apart, s, args=(track.pose(k),), xtol=1e-14) for s in starts)
        joints[k] = next(each.x for each in found if np.abs(each.fun).max() < 1e-6)
    session = replace(scan.session, pose_form="joints")
    return scan_fake.as_source(
        replace(scan, arm=replace(track, joints_rad=joints), session=session)
    )


def apart(joints: FloatArray, pose: Pose[Base, Tool]) -> FloatArray:
    """How far the arm is from a pose, mm, turns by a lever of 300 mm."""
    rotations, places = forward(ARM, joints[None])
    turned = 300.0 * (rotations[0] - pose.rotation).ravel()
    return np.concatenate([places[0] - pose.translation_mm, turned])


def test_joint_angles_go_through_the_arm_that_is_given(
    folder: Path, tmp_path: Path, fails: Callable[..., str], capsys: pytest.CaptureFixture[str]
) -> None:
    arm, source = tmp_path / "arm.toml", in_joints(scan_fake.fake_scan(12, 2.0))
    write_recording(tmp_path / "plate", source)
    arm.write_bytes(arm_model_toml(ARM))
    words = ["verify", tmp_path / "plate", "--plate", folder / "plate.csv"]
    words += ["--scanner", folder / "good.json"]
    assert "joint angles need the arm's geometry" in fails(*words)
    assert main([*map(str, words), "--arm", str(arm), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "still valid"
