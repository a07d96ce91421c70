# SPDX-License-Identifier: Apache-2.0
"""``armscan stripes``: a table and a page of what photographs show, or a refusal and nothing."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.cli.run import main
from rigs.stripe_image import StripeScene
from rigs.stripe_scenes import line

SCENE = StripeScene((line(12.0),), 320, 240)


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    folder = tmp_path / "photographs"
    folder.mkdir()
    for k in range(2):
        cv2.imwrite(str(folder / f"lit{k}.png"), SCENE.expose(k).image)
    dark = np.random.default_rng(0).normal(20.0, 1.0, (240, 320))
    cv2.imwrite(str(folder / "dark.png"), dark.astype(np.uint8))
    return folder


def test_table_and_page_of_a_folder(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "lines.csv"
    assert main(["stripes", str(photographs), "-o", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    good = [row for row in rows if row["accepted"] == "1"]
    assert {row["image"] for row in good} == {"lit0.png", "lit1.png"}
    assert report["n_points"] == len(good) > 560
    assert report["n_images"] == 2
    assert "dark.png" in report["warnings"][0]
    points = np.array([[float(row["x_px"]), float(row["y_px"])] for row in good])
    assert np.abs(SCENE.errors(points)[0]).max() < 0.3
    assert all(float(row["sigma_px"]) > 0.0 for row in rows)
    flagged = {row["flags"] for row in rows if row["accepted"] == "0"}
    assert flagged <= {"END", "SHORT_SEGMENT", "END+SHORT_SEGMENT", "SHORT_SEGMENT+END"}
    page = out.with_suffix(".html").read_text()
    assert all(name in page for name in ("lit0.png", "lit1.png", "dark.png"))


def test_nothing_is_written_where_an_image_is_cut(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (photographs / "lit1.png").read_bytes()
    (photographs / "lit1.png").write_bytes(whole[: len(whole) // 2])
    out = tmp_path / "lines.csv"
    assert main(["stripes", str(photographs), "-o", str(out)]) == 2
    assert "lit1.png" in capsys.readouterr().err
    assert not out.exists()
    assert not out.with_suffix(".html").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["-o", "lines.html"], ".csv"),
        (["--laser-colour", "purple"], "green-red"),
        (["--stripe-method", "magic"], "hessian"),
    ],
)
def test_wrong_options_are_named(
    photographs: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["stripes", str(photographs), *words]) == 2
    assert said in capsys.readouterr().err


def test_one_colour_is_taken_for_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Three photographs show a red line; in the third a blue pattern stands out a little more."""
    folder = tmp_path / "colours"
    folder.mkdir()
    for k in range(3):
        image = SCENE.expose_red(k, 1.0).image.copy()
        if k == 2:
            image[:, 20:300:40, 2] = 160
            image[:, 21:300:40, 2] = 160
        cv2.imwrite(str(folder / f"{k}.png"), image[:, :, ::-1])
    assert main(["stripes", str(folder), "-o", str(tmp_path / "lines.csv"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["laser_colour"] == "red"
    alone = ["stripes", str(folder / "2.png"), "-o", str(tmp_path / "alone.csv"), "--json"]
    assert main(alone) == 0
    assert json.loads(capsys.readouterr().out)["laser_colour"] == "blue"
