# SPDX-License-Identifier: Apache-2.0
"""Options that would be without effect are refused by name; what was done is said."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from armscan.cli import main
from armscan.storage.documents import read_sensor_calibration
from rigs.drawn_bench import Bench

INPUTS = Path(__file__).parents[1] / "net" / "inputs"
DOCUMENTS = INPUTS / "documents"
CAMERA = ["calibrate", "camera", "--from", DOCUMENTS / "camera.json", "-o", "no.json"]
LASER = ["calibrate", "laser", "--from", DOCUMENTS / "sensor.json", "-o", "no.json"]
PROFILES = ["reconstruct", INPUTS / "profiles/p*.csv", "--scanner", DOCUMENTS / "profiles.json"]
PLACED = [*PROFILES, "--poses", INPUTS / "profiles/poses.txt", "-o", "no.ply"]
POINTS = ["calibrate", "hand-eye", "--profiles", INPUTS / "profiles/p*.csv", "--plane", "0,0,1,0"]
POSED = [*POINTS, "--poses", INPUTS / "profiles/poses.txt", "-o", "no.json"]
SCANNED = ["calibrate", "hand-eye", INPUTS / "plate-scan", "--sensor", DOCUMENTS / "sensor.json"]
RINGS = ["markers", INPUTS / "plain/rings0.jpg", "-o", "no.html"]
STILL = ["reconstruct", INPUTS / "plain/single.jpg", "--sensor", DOCUMENTS / "sensor.json"]


@pytest.mark.parametrize(
    ("words", "vain"),
    [
        (CAMERA, "--bits-used 12"),
        (CAMERA, "--bits-align high"),
        (CAMERA, "--no-cache"),
        (CAMERA, "--method thesis"),
        (LASER, "--stripe-method centroid"),
        (LASER, "--laser-colour red"),
        (LASER, "--bits-used 12 --no-cache"),
        (LASER, "--bits-align low"),
        (PLACED, "--sheet A --depth-margin 0"),
        (PLACED, "--stripe-method fit --laser-colour red"),
        (PLACED, "--background a.png --right b.png --right-background c.png"),
        (PLACED, "--method thesis --arm arm.toml"),
        (PLACED, "--bits-used 12 --bits-align low"),
        (STILL, "--euler intrinsic-zxz"),
        (POSED, "--sensor no.json --arm no.toml"),
        (POSED, "--stripe-method fit --laser-colour red"),
        ([*SCANNED, "--plane", "0,0,1,0"], "--euler intrinsic-zxz"),
        (RINGS, "--diameter 6"),
        (RINGS, "--depth 120:200"),
    ],
    ids=lambda given: given if isinstance(given, str) else str(given[1]).rpartition("/")[2],
)
def test_an_option_without_effect_is_refused(
    words: list[object],
    vain: str,
    fails: Callable[..., str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    message = fails(*words, *vain.split())
    assert all(word in message for word in vain.split() if word.startswith("--"))
    assert not list(tmp_path.iterdir())


def test_sheets_solved_again_keep_how_their_stripes_were_found(
    calibrated: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again = calibrated.sensor
    old = read_sensor_calibration(again).provenance.options
    found_by = [entry for entry in old if entry[0].startswith("StripeOptions.")]
    for output in (tmp_path / "again.json", tmp_path / "twice.json"):
        words = ["calibrate", "laser", "--from", str(again), "-o", str(output)]
        assert main(words) == 0, capsys.readouterr().err
        again = output
        new = read_sensor_calibration(again).provenance.options
        assert [entry for entry in new if entry[0].startswith("StripeOptions.")] == found_by != []


def test_the_observations_of_a_hand_eye_are_described(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["calibrate", "hand-eye", str(INPUTS / "plate-scan")]
    words += ["--sensor", str(DOCUMENTS / "sensor.json")]
    words += ["--plate", str(INPUTS / "tables/plate.csv")]
    assert main(words) == 0, capsys.readouterr().err
    capsys.readouterr()
    assert main(["info", "scanner.npz", "--json"]) == 0
    (item,) = json.loads(capsys.readouterr().out)["items"]
    assert item["exposures"] >= item["postures"] > 3
    assert item["points"] > 100


def test_a_code_that_no_line_bears_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["markers", str(INPUTS / "plain/rings0.jpg"), "--code", "A=0,1,2,300"]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "cross ratio of A" in text
    assert "coded lines in" not in text


def test_the_rule_of_rows_says_that_it_lacks_earlier_exposures(
    fails: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["reconstruct", INPUTS / "plain/cross.jpg", "--sensor", DOCUMENTS / "cross.json"]
    message = fails(*words, "--method", "thesis")
    assert "rule of rows" in message
    assert "--depth-margin" not in message
