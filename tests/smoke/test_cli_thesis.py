# SPDX-License-Identifier: Apache-2.0
"""The printed methods from the command line, beside armscan's own on the same data."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armscan.cli import main
from armscan.storage.points import read_marker_list
from armscan.thesis.two_cameras import cross_ratio, match_after_thesis

INPUTS = Path(__file__).parents[1] / "net" / "inputs"


def told(words: list[str], capsys: pytest.CaptureFixture[str]) -> Any:
    assert main([*words, "--json"]) == 0, capsys.readouterr().err
    return json.loads(capsys.readouterr().out)


def test_the_plate_by_the_printed_objective_stands_beside_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Eq. 2.76 of the same stripes; the document is ours."""
    monkeypatch.chdir(tmp_path)
    words = ["calibrate", "hand-eye", str(INPUTS / "plate-scan")]
    words += ["--sensor", str(INPUTS / "documents/sensor.json")]
    words += ["--plate", str(INPUTS / "tables/plate.csv"), "--method", "thesis"]
    printed = told(words, capsys)["thesis"]
    assert printed["equations"] == "eq. 2.76"
    assert 0.0 < printed["rms_mm"] < 0.1
    assert 0.0 < printed["turned_deg"] < 0.5
    assert 0.0 < float(np.linalg.norm(printed["shifted_mm"])) < 1.0
    assert (tmp_path / "scanner.json").is_file()


def test_printed_centres_are_those_of_circles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["calibrate", "camera", str(INPUTS / "left"), "--target", "chessboard:9x6:20"]
    assert main([*words, "--method", "thesis"]) == 2
    assert "--method thesis" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_sphere_without_pure_shifts_says_why_the_two_steps_fail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["calibrate", "hand-eye", "--profiles", str(INPUTS / "profiles/p*.csv")]
    words += ["--poses", str(INPUTS / "profiles/poses.txt"), "--sphere-diameter", "80"]
    printed = told([*words, "--method", "thesis"], capsys)["thesis"]
    assert "share one orientation" in printed["failure"]


def test_markers_are_paired_by_the_eight_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Section 4.3.1: the pairs are those of the steps, and the page says that nobody checked."""
    monkeypatch.chdir(tmp_path)
    old, new = (INPUTS / "tables" / name for name in ("before.csv", "after.csv"))
    found = told(["register", str(old), "--moved", str(new), "--method", "thesis"], capsys)
    before, after = (read_marker_list(path, frame="Base").markers for path in (old, new))
    pairs = match_after_thesis(before, after, 0.16)
    assert found["n_matched"] == len(pairs) >= 4


def test_the_rule_of_rows_tells_crossed_lines_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Eqs. 3.1 to 3.7: one line has nothing to tell; without earlier exposures nothing is told."""
    monkeypatch.chdir(tmp_path)
    words = ["reconstruct", str(INPUTS / "plain/cross.jpg"), "--method", "thesis", "--sensor"]
    assert main([*words, str(INPUTS / "documents/sensor.json")]) == 2
    assert "--method thesis" in capsys.readouterr().err
    assert main([*words, str(INPUTS / "documents/cross.json")]) == 2
    assert "rule of rows" in capsys.readouterr().err


def test_the_eight_steps_need_two_lists(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    views = [str(INPUTS / "tables" / name) for name in ("view1.csv", "view2.csv")]
    assert main(["register", *views, "--method", "thesis"]) == 2
    assert "--method" in capsys.readouterr().err


@pytest.mark.parametrize("code", ["A", "A=1,2,3", "A=0,2,1,3", "A=a,b,c,d"])
def test_a_code_that_is_none_is_refused(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["markers", str(INPUTS / "left"), "--code", code]) == 2
    assert "--code" in capsys.readouterr().err


def test_a_line_of_rings_is_named_by_its_cross_ratio(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Eqs. 4.24 and 4.25: what is told is the code's own ratio within its sigmas."""
    monkeypatch.chdir(tmp_path)
    places = (0.0, 12.0, 30.0, 52.0)
    _draw_rings(tmp_path / "line.png", [(60.0 + 8.0 * place, 150.0) for place in places])
    found = told(["markers", "line.png", "--code", "A=0,12,30,52"], capsys)["lines"]
    assert [line["code"] for line in found] == ["A"]
    assert abs(found[0]["cross_ratio"] - cross_ratio(*places)) < 4.0 * found[0]["sigma"]


def _draw_rings(path: Path, centres_px: list[tuple[float, float]]) -> None:
    """Bright discs in dark rings on grey, drawn eight times as large and averaged."""
    import cv2

    scale = 8
    image = np.full((300 * scale, 560 * scale), 170, np.uint8)
    for x, y in centres_px:
        middle = (round((x + 0.5) * scale), round((y + 0.5) * scale))
        cv2.circle(image, middle, 22 * scale, (20,), -1, cv2.LINE_AA)
        cv2.circle(image, middle, 12 * scale, (230,), -1, cv2.LINE_AA)
    small = cv2.resize(image, (560, 300), interpolation=cv2.INTER_AREA)
    noisy = small + np.random.default_rng(1).normal(0.0, 1.0, small.shape)
    assert cv2.imwrite(str(path), np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
