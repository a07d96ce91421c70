# SPDX-License-Identifier: Apache-2.0
"""``armscan inspect cad`` as it is called: files, exit codes, refusals."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
import trimesh

from armscan.cli import main
from armscan.storage.clouds import parse_ply, ply_bytes, read_cloud
from rigs.inspection_clouds import cloud_of
from rigs.parts import wedge_part

PART = wedge_part()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, and a scan of the part in its frame with one face 0.08 mm high."""
    folder = tmp_path_factory.mktemp("cad")
    mesh = trimesh.Trimesh(PART.vertices_mm, PART.triangles, process=False)
    (folder / "part.stl").write_bytes(mesh.export(file_type="stl"))
    (folder / "metres.stl").write_bytes(mesh.copy().apply_scale(1e-3).export(file_type="stl"))
    points, triangle = PART.surface_points(30_000)
    normals = PART.normals[triangle]
    random = np.random.default_rng(0)
    off = 0.01 * random.normal(size=len(points)) + 0.08 * (PART.face[triangle] == 3)
    exposure = random.integers(0, 20, len(points))
    for name, more in (("high", off), ("good", 0.01 * random.normal(size=len(points)))):
        cloud = cloud_of(
            points + more[:, None] * normals, exposure, sigma_mm=0.003, noise_mm=0.01,
            noise_along=normals, normals=normals,
        )  # fmt: skip
        (folder / f"{name}.ply").write_bytes(ply_bytes(cloud))
    return folder


def inspect(files: Path, *words: str, cloud: str = "high.ply", part: str = "part.stl") -> int:
    return main(["inspect", "cad", str(files / cloud), str(files / part), *words])


def test_a_high_face_is_found_and_no_other(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "report.html"
    assert inspect(files, "--tolerance", "0.05", "--json", "-o", str(page)) == 1
    told = json.loads(capsys.readouterr().out)
    decisions = {face["face"]: face["decision"] for face in told["faces"]["each"]}
    assert [name for name, one in decisions.items() if one != "pass"] == ["face 4"]
    assert told["faces"]["each"][3]["mean_mm"] == pytest.approx(0.08, abs=0.002)
    assert told["verdict"] == "fail"
    assert told["deviation"]["rms_mm"] > told["alignment"]["rms_mm"]
    with (tmp_path / "report.csv").open() as stream:
        rows = list(csv.DictReader(line for line in stream if not line.startswith("#")))
    assert [row["face"] for row in rows if row["decision"] == "fail"] == ["face 4"]
    table = parse_ply((tmp_path / "report.ply").read_bytes(), "report.ply").table
    assert len(table) == told["points"]["n"] == 30_000
    high = table["deviation_mm"][table["face"] == 3]
    within = told["faces"]["each"][3]["fraction_within_tolerance"]
    assert within == pytest.approx(scipy.stats.norm.cdf(-3.0), abs=0.004)
    assert told["points"]["fraction_within_tolerance"] == pytest.approx(
        np.mean(np.abs(table["deviation_mm"]) <= 0.05), abs=1e-12
    )
    assert high.mean() == pytest.approx(told["faces"]["each"][3]["mean_mm"], abs=1e-9)
    text = page.read_text()
    assert "https://" not in text
    assert "data-values" in text


def test_a_good_part_passes(files: Path) -> None:
    assert inspect(files, "--tolerance", "0.05", "--align", "none", cloud="good.ply") == 0
    assert inspect(files, "--align", "none", cloud="good.ply") == 0


def test_datums_are_told_with_what_they_hold(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A side that is 0.08 mm high is the first datum, and met by itself."""
    low_x, _, low_z = (int(PART.face[np.argmax(PART.normals @ way)]) for way in -np.eye(3))
    names = "|".join(PART.face_names[k] for k in (3, low_x, low_z))
    assert inspect(files, "--align", "features", "--datums", names, "--json") == 0
    told = json.loads(capsys.readouterr().out)["alignment"]
    assert told["method"] == "features"
    assert told["datums"][0]["residual_mm"] < 1e-6
    assert [len(one["holds"]) for one in told["datums"]] == [3, 2, 1]
    assert all(one["sigma_mm"] > 0.0 for one in told["datums"])


def test_a_cloud_is_laid_on_points_and_markers(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = np.random.default_rng(3).uniform(0.0, 50.0, (6, 3))
    rows = [f"P{k},{x},{y},{z}" for k, (x, y, z) in enumerate(places)]
    nominal = tmp_path / "nominal.csv"
    nominal.write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows]) + "\n")
    words = ("--points", str(nominal), "--measured", str(nominal), "--json")
    for method in ("points", "markers"):
        assert inspect(files, "--align", method, *words, cloud="good.ply") == 0
        told = json.loads(capsys.readouterr().out)["alignment"]
        assert told["method"] == method
        assert np.allclose(told["cad_from_part"], np.eye(4), atol=1e-9)
        assert len(told["datums"]) == 6


REFUSED = [
    (("--align", "features"), "part.stl"),
    (("--align", "points"), "part.stl"),
    (("--align", "features", "--datums", "face 99"), "part.stl"),
    (("--measured", "x.csv"), "part.stl"),
    (("--unit", "furlong"), "part.stl"),
    (("--tolerance", "-1"), "part.stl"),
    (("--tolerance", "missing.toml"), "part.stl"),
    (("--align", "321"), "part.stl"),
    (("--datums", "face 1,face 2,face 3"), "part.stl"),
    (("--reach-mm", "0"), "part.stl"),
    (("--region", "1000,1001,0,1,0,1"), "part.stl"),
    (("--align", "none"), "metres.stl"),
    ((), "no-such.stl"),
]


@pytest.mark.parametrize(("words", "part"), REFUSED)
def test_what_cannot_be_done_is_one_sentence(
    files: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    part: str,
) -> None:
    page = tmp_path / "report.html"
    assert inspect(files, *words, "-o", str(page), part=part) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert "Traceback" not in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["cloud.ply", "part.ply", "limits.csv"])
def test_what_is_read_is_never_replaced(
    name: str, files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Beside the page goes a file of the same stem, which may be the cloud or the model."""
    mesh = trimesh.Trimesh(PART.vertices_mm, PART.triangles, process=False)
    contents = {
        "cloud.ply": (files / "good.ply").read_bytes(),
        "part.ply": mesh.export(file_type="ply"),
        "limits.csv": b"face,tolerance_mm\n*,0.05\n",
    }
    for one, content in contents.items():
        (tmp_path / one).write_bytes(content)
    cloud, part, limits = (str(tmp_path / one) for one in contents)
    page = (tmp_path / name).with_suffix(".html")
    words = ("--align", "none", "--tolerance", limits, "-o", str(page), "--force")
    assert main(["inspect", "cad", cloud, part, *words]) == 2
    assert f"{name} is read" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == contents


def test_a_cloud_without_points_is_not_blamed_on_a_region(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 0\n"
    named = "".join(f"property float {name}\n" for name in "xyz")
    (files / "empty.ply").write_text(head + named + "end_header\n")
    assert inspect(files, cloud="empty.ply") == 2
    said = capsys.readouterr().err
    assert "the cloud holds no points" in said
    assert "--region" not in said


def test_metres_are_noticed_and_cured(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert inspect(files, "--align", "none", part="metres.stl") == 2
    assert "--unit m" in capsys.readouterr().err
    assert inspect(files, "--align", "none", "--unit", "m", part="metres.stl") == 0


def test_a_heading_of_other_names_is_told(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = read_cloud(files / "good.ply").points_mm[::8]
    np.savetxt(files / "foreign.txt", points, header="east north up", comments="")
    assert inspect(files, "--align", "none", cloud="foreign.txt") == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "'east north up' does not name x, y and z" in told


@pytest.mark.parametrize("kind", ["own", "constant", "random", "zero"])
def test_normals_that_are_not_of_the_points_are_told_and_not_used(
    files: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    """The same one at every point, as some programs write, made the part its mirror image."""
    points, triangle = PART.surface_points(30_000)
    random = np.random.default_rng(0).normal(size=points.shape)
    normals = {
        "own": PART.normals[triangle],
        "constant": np.tile([0.0, 0.0, 1.0], (len(points), 1)),
        "random": random / np.linalg.norm(random, axis=1)[:, None],
        "zero": np.zeros_like(points),
    }[kind]
    turned = points[:, [1, 2, 0]] + [100.0, 50.0, 20.0]
    cloud = cloud_of(turned, normals=normals[:, [1, 2, 0]] if kind == "own" else normals)
    (files / f"{kind}.ply").write_bytes(ply_bytes(cloud))
    assert inspect(files, cloud=f"{kind}.ply") == 0
    said = capsys.readouterr()
    assert ("normals do not stand on the faces" in said.out + said.err) == (
        kind in ("constant", "random")
    )
