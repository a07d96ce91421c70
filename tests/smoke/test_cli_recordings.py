# SPDX-License-Identifier: Apache-2.0
"""Recordings on the command line: simulated ones, and damaged ones in one sentence."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from armscan.cli import main
from rigs.recording_folders import ARM, EXPOSURES, SESSION, lab_folder


def test_the_real_twin_probes_its_plate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "touches"
    words = ["simulate", "thesis-single", "probing", "-o", str(folder), "--seed", "4"]
    assert main(words) == 0
    assert "armscan probe" in capsys.readouterr().out
    assert json.loads((tmp_path / "touches.truth.json").read_text())["simulated"] is True
    assert main(["info", str(folder), "--json"]) == 0
    (item,) = json.loads(capsys.readouterr().out)["items"]
    assert item["arm_samples"] >= 20 and item["arm_samples_without_pose"] == 0
    assert main(words) == 2
    assert "not empty" in capsys.readouterr().err


def contents(folder: Path) -> dict[str, bytes]:
    found = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


def test_a_simulated_file_is_the_simulated_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["simulate", "thesis-single", "still-step", "--seed", "3"]
    for place in ("a/scan", "b/scan.mcap"):
        (tmp_path / place).parent.mkdir()
        assert main([*words, "-o", str(tmp_path / place)]) == 0
    assert sorted(path.name for path in (tmp_path / "b").iterdir()) == [
        "scan.mcap",
        "scan.truth.json",
    ]
    truth = (tmp_path / "b/scan.truth.json").read_bytes()
    assert truth == (tmp_path / "a/scan.truth.json").read_bytes()
    assert main(["convert", str(tmp_path / "b/scan.mcap"), str(tmp_path / "back")]) == 0
    there = contents(tmp_path / "a/scan")
    assert contents(tmp_path / "back") == there
    assert not any("truth" in name for name in there)
    capsys.readouterr()
    assert main(["info", str(tmp_path / "b/scan.mcap"), "--json"]) == 0
    (item,) = json.loads(capsys.readouterr().out)["items"]
    assert item["simulated"] is True
    assert main([*words, "-o", str(tmp_path / "b/scan.mcap")]) == 2
    assert "the file exists" in capsys.readouterr().err
    assert main(["simulate", "thesis-single", "probing", "-o", str(tmp_path / "touches.mcap")]) == 2
    assert "name a folder" in capsys.readouterr().err
    assert not (tmp_path / "touches.mcap").exists()
    for command in (["convert"], ["recover", "-o"]):
        cloud = tmp_path / "scan.ply"
        words = [*command, str(cloud), str(tmp_path / "b/scan.mcap")]
        if command == ["convert"]:
            words[1:] = words[:0:-1]
        assert main(words) == 2
        said = capsys.readouterr().err
        assert "holds images" in said and "armscan reconstruct" in said
        assert not cloud.exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["thesis-double", "ball"], "no simulated head is called 'thesis-double'"),
        (["thesis-single", "bell"], "'bell' is not one of"),
        (["thesis-single", "ball", "--preset", "best"], "'best' is not one of"),
        (["thesis-single", "ball", "--processes", "0"], "'--processes'"),
    ],
)
def test_what_cannot_be_simulated_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], said: str
) -> None:
    assert main(["simulate", *words, "-o", str(tmp_path / "scan")]) == 2
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("head", ["thesis-cross", "thesis-multi-5"])
def test_an_earlier_truth_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], head: str
) -> None:
    """`simulate` has no --force, so none may be advised."""
    truth = tmp_path / "scan.truth.json"
    truth.write_text("mine")
    assert main(["simulate", head, "still-step", "-o", str(tmp_path / "scan")]) == 2
    out, err = capsys.readouterr()
    assert out == "" and "--force" not in err and "remove it, or name another folder" in err
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


BAD = {
    "swapped columns": ({"arm": ARM.replace("z_mm,qw", "qw,z_mm")}, "norm is 400"),
    "duplicate times": ({"arm": ARM.replace("3500,", "1500,")}, "appears again"),
    "metres": ({"arm": ARM.replace("_mm", "_m")}, "in metres"),
    "lost image": ({"exposures": EXPOSURES.replace("1.png", "7.png")}, "do not exist"),
    "wrong key": ({"session": SESSION.replace('"mono"', "7")}, "camera.0.colour"),
    "cut": ({"arm": ARM[:-6]}, "may be cut"),
    "empty": ({"exposures": ""}, "empty (0 bytes)"),
    "other text": ({"exposures": b"\xff\xfe\x00x"}, "not UTF-8"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_recording_costs_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    files, said = BAD[case]
    assert main(["info", str(lab_folder(tmp_path, **files))]) == 2
    out, err = capsys.readouterr()
    assert out == "" and said in err
    assert err.startswith("error: ") and err.count("\n") == 1
