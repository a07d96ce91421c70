# SPDX-License-Identifier: Apache-2.0
"""``doctor --bundle``: what is inside is listed, and nothing is that is nobody else's business."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

from armscan.cli import main
from armscan.jobs.live import doctor
from armscan.jobs.live.doctor import without_secrets
from armscan.storage.documents import read_camera_calibration
from armscan.storage.recording import read_recording
from armscan.storage.recordings.read_mcap import record_folder
from rigs.drawn_bench import Bench
from rigs.recording_folders import lab_folder


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        ('"path": "/home/anna maria/scans/a b.png",', '"path": ".../a b.png",'),
        (r'"path": "C:\\Users\\anna\\a.png"', '"path": ".../a.png"'),
        ("read /home/anna/x/scan.mcap, line 3", "read .../scan.mcap, line 3"),
        ("replay:/home/anna/scan?rate=2", "replay:.../scan?rate=2"),
        ("~/scans/one.png", ".../one.png"),
        ('lasers = "serial:/dev/ttyUSB0:115200"', 'lasers = "serial:/dev/ttyUSB0:115200"'),
        ("speed in mm/s, +/- 3, and/or http://host/page", "speed in mm/s, +/- 3, and/or http://host/page"),
        ("open file:///home/anna/scan.mcap", "open .../scan.mcap"),
        ("from \\\\nas01\\anna\\scan.mcap", "from .../scan.mcap"),
        ("rtsp://anna:hunter2@10.0.0.5/x", "rtsp://***@10.0.0.5/x"),
        ("Authorization: Bearer abc.def", "Authorization: ***"),
        ("--token abc -o x", "--token *** -o x"),
        ('{"passphrase": "a,b}c", "x": 1}', '{"passphrase": "***", "x": 1}'),
        ("compass = 3, 4 passes", "compass = 3, 4 passes"),
        ("token=abc123&x=1 Password: 'secret!'", "token=***&x=1 Password: '***'"),
    ],
)  # fmt: skip
def test_texts_keep_what_matters(text: str, kept: str) -> None:
    assert without_secrets(text) == kept


def test_a_bundle_says_what_is_inside_and_keeps_secrets(
    calibrated: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setenv("SOME_TOKEN", "hunter2hunter2")
    monkeypatch.setattr(doctor, "CUT_EXPOSURES", 1)
    monkeypatch.setattr(doctor, "_user", lambda: "annika")
    scan, log, place = lab_folder(tmp_path / "scan"), tmp_path / "run.log", tmp_path / "q.zip"
    log.write_text(f"annika began in {tmp_path}/scan\ntoken=abc\n")
    words = ["doctor", "--bundle", str(place)]
    for path in (calibrated.camera, scan, log, tmp_path / "absent.json", tmp_path):
        words += ["--with", str(path)]
    assert main([*words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert len(said["warnings"]) == 2
    assert "absent.json is not inside: there is no such file" in said["warnings"][0]
    with zipfile.ZipFile(place) as archive:
        archive.extractall(tmp_path / "out")
        names = set(archive.namelist())
    assert names == {"README.txt", "versions.json", "camera.json", "scan.mcap", "run.log"}
    listed = (tmp_path / "out/README.txt").read_text()
    assert all(f"{name}: " in listed for name in (*names, "absent.json", tmp_path.name))
    assert "the first 1 of 3 exposures" in listed
    for path in (tmp_path / "out").iterdir():
        content = path.read_bytes()
        for secret in (str(tmp_path), str(calibrated.folder), "hunter2", "annika", "token=abc"):
            assert secret.encode() not in content, path.name
    assert (tmp_path / "out/run.log").read_text().startswith("USER began in .../scan\ntoken=***")
    read_camera_calibration(tmp_path / "out/camera.json")
    cut, whole = read_recording(tmp_path / "out/scan.mcap"), read_recording(scan)
    assert cut.rows == whole.rows[:1]
    assert (cut.exposure(0).image == whole.exposure(0).image).all()
    assert cut.arm is not None
    assert cut.arm.t_ns.tolist() == [
        t for t in whole.arm.t_ns.tolist() if abs(t - whole.rows[0].t_ns) <= 1_000_000_000
    ]
    assert main(words) == 2
    assert "the file exists" in capsys.readouterr().err
    assert main(["doctor", "--with", str(log)]) == 2
    assert main(["doctor", "--bundle", str(tmp_path / "q.tar")]) == 2
    assert main(["doctor", "--bundle", str(tmp_path / "new.zip"), "--warm"]) == 2
    assert main(["doctor", "--force"]) == 2
    assert not (tmp_path / "new.zip").exists()


def test_a_recording_that_cannot_be_read_goes_in_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, place = tmp_path / "whole.mcap", tmp_path / "q.zip"
    record_folder(lab_folder(tmp_path / "scan"), whole)
    broken = tmp_path / "killed.mcap"
    broken.write_bytes(whole.read_bytes()[:-30])
    words = ["doctor", "--bundle", str(place), "--with", str(broken), "--json", "--force"]
    assert main(words) == 0
    said = json.loads(capsys.readouterr().out)
    with zipfile.ZipFile(place) as archive:
        assert archive.read("killed.mcap") == broken.read_bytes()
        listed = archive.read("README.txt").decode()
    assert said["warnings"] == [] and "it cannot be read (the recording is unfinished" in listed
    monkeypatch.setattr(doctor, "MOST_BYTES", 1000)
    assert main(words) == 0
    with zipfile.ZipFile(place) as archive:
        assert archive.read("killed.mcap") == broken.read_bytes()[:1000]


def test_doctor_tells_of_drivers(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["found"]
    assert found["devices by twin"].startswith("ready")
