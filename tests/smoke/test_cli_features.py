# SPDX-License-Identifier: Apache-2.0
"""``armscan inspect`` of features: numbers, pages, relations, failures in one sentence."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from armscan.cli import main
from armscan.storage.clouds import write_cloud
from rigs.feature_clouds import workpiece
from rigs.inspection_clouds import cloud_of, paused_scan, seen_from


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("part") / "part.ply"
    write_cloud(path, workpiece(3, n=8_000))
    return path


def test_a_cylinder_with_its_page(
    part: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "bore.html"
    words = [
        "cylinder",
        str(part),
        "--diameter",
        "12",
        "--region=10,30,5,25,-9,-1",
        "-o",
        str(page),
    ]
    assert main(["inspect", *words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["fitted"]["diameter"]["value_mm"] == pytest.approx(12.0, abs=0.03)
    sigma_mm = found["fitted"]["diameter"]["sigma_mm"]
    assert found["fitted"]["diameter_u_mm"] == pytest.approx(2 * sigma_mm)
    assert found["fitted"]["form_mm"] == pytest.approx(found["fitted"]["range_mm"])
    text = page.read_text(encoding="utf-8")
    assert "Cylindricity" in text
    assert "U (k = 2)" in text
    assert "https://" not in text


def test_a_relation(part: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["cylinder:diameter=12:region=10,30,5,25,-9,-1", "plane:seed=5,5,0"]
    assert main(["inspect", "relation", str(part), *words]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "statistic cylinder" in told and "against its fit (second)" in told
    assert main(["inspect", "relation", str(part), *words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["angle"]["value_deg"] == pytest.approx(90.0, abs=0.2)
    assert found["first"]["feature"] == "cylinder"
    assert "distance" not in found


def test_normals_of_another_cloud_hide_no_feature(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    faces = np.random.default_rng(0).uniform(0.0, [20.0, 20.0, 0.01], (2, 300, 3))
    points = np.concatenate([faces[0], faces[1][:, [2, 1, 0]] + [-0.01, 0.0, 2.0]])
    stale = cloud_of(points, normals=np.tile([0.6, 0.0, 0.8], (len(points), 1)))
    write_cloud(tmp_path / "a.ply", stale)
    words = ["plane:seed=10,10,0", "plane:seed=0,10,12"]
    assert main(["inspect", "relation", str(tmp_path / "a.ply"), *words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["angle"]["value_deg"] == pytest.approx(90.0, abs=0.1)
    assert "normals do not stand on the faces" in " ".join(told["warnings"])
    (tmp_path / "recipe.toml").write_text('[[feature]]\nname = "table"\nkind = "plane"\n')
    words = [str(tmp_path / "recipe.toml"), str(tmp_path / "a.ply")]
    assert main(["inspect", "recipe", *words, "-o", str(tmp_path / "results"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert "normals do not stand on the faces" in told["warnings"][0]


def test_the_normals_of_a_scan_that_paused_are_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of the points lie in one light sheet and are flat in it; seen from below."""
    points, exposure = paused_scan(30, 30, 0.03)
    cloud = cloud_of(points, exposure, normals=np.tile([0.0, 0.0, -1.0], (len(points), 1)))
    n = len(cloud.exposure_sources)
    places = np.array([[0.0, points[exposure == k, 1].mean(), -200.0] for k in range(n)])
    seen = seen_from(cloud, places, np.tile(np.eye(3), (n, 1, 1)))
    write_cloud(tmp_path / "a.ply", seen)
    assert main(["inspect", "plane", str(tmp_path / "a.ply"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert "normals" not in " ".join(told["warnings"])
    assert told["fitted"]["plane"][2] < -0.99


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["cylinder", "PART", "--diameter", "-3"], "above 0"),
        (["cylinder", "PART", "--diameter-range", "3"], "least,largest"),
        (["cone", "PART", "--seed", "1,2"], "three numbers"),
        (["cylinder", "PART", "--region=0,1,0,1,0,1"], "an inspection needs"),
        (["relation", "PART", "torus", "cone"], "no feature 'torus'"),
        (["relation", "PART", "cone:size=3", "cone"], "'size=3' is not understood"),
        (["cylinder", "PART", "--diameter", "45"], "there is no cylinder of 45 mm"),
    ],
)
def test_what_is_wrong_is_said_in_a_sentence(
    part: Path, capsys: pytest.CaptureFixture[str], words: list[str], told: str
) -> None:
    assert main(["inspect", *(str(part) if word == "PART" else word for word in words)]) == 2
    assert told in capsys.readouterr().err
