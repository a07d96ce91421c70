# SPDX-License-Identifier: Apache-2.0
"""``armscan inspect recipe`` as it is called: many parts, one table, resumption, refusals."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from armscan.cli import main
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.inspection.cad.part import part_of
from armscan.inspection.recipe import FollowedRecipe, Recipe, follow_recipe
from armscan.records.cloud import PointCloud
from armscan.storage.clouds import ply_bytes
from armscan.storage.documents import scanner_document
from rigs.calibration_documents import scanner_calibration
from rigs.inspection_clouds import cloud_of, random_motion
from rigs.parts import box_corners, extruded

TURN = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False)
RADIUS = 8.0
BOSS = extruded(RADIUS * np.column_stack([np.cos(TURN), np.sin(TURN)]), 12.0)
BOSS_AT = np.array([52.0, 20.0, 20.0])
PART = part_of(
    np.concatenate([
        box_corners([0, 0, 0], [70, 40, 20]), BOSS + BOSS_AT,
        box_corners([5, 6, 20], [22, 16, 26]),
    ]),
    source="plate",
)  # fmt: skip
RECIPE = """
title = "Plate"
part = "part.stl"
align = "none"
tolerance_mm = 0.05
[faces]
"{top}" = 0.03
[clean]
isolated_mm = 5
[[feature]]
name = "boss"
kind = "cylinder"
face = "{boss}"
diameter_mm = 16
tolerance_mm = 0.06
"""


def face_at(point: list[float]) -> str:
    """Name of the face whose triangle has its middle nearest to a point."""
    middles = PART.vertices_mm[PART.triangles].mean(axis=1)
    nearest = int(np.linalg.norm(middles - point, axis=1).argmin())
    return PART.face_names[int(PART.face[nearest])]


TOP, SIDE = face_at([13.0, 11.0, 26.0]), face_at([60.0, 20.0, 26.0])


def scan(seed: int, *, boss_mm: float = 0.0, top_mm: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Points and normals of a part whose boss is wider in radius, and whose block is higher."""
    points, triangle = PART.surface_points(8_000)
    normals, face = PART.normals[triangle], PART.face[triangle]
    off = 0.005 * np.random.default_rng(seed).normal(size=len(points))
    off += boss_mm * (face == PART.face_names.index(SIDE))
    off += top_mm * (face == PART.face_names.index(TOP))
    return points + off[:, None] * normals, normals


def written(path: Path, points: FloatArray, normals: FloatArray) -> None:
    exposure = np.random.default_rng(5).integers(0, 20, len(points))
    cloud = cloud_of(
        points, exposure, sigma_mm=0.003, noise_mm=0.005, noise_along=normals, normals=normals
    )
    path.write_bytes(ply_bytes(cloud))


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recipe with its model, and scans of four parts, one of which cannot be read."""
    folder = tmp_path_factory.mktemp("recipe")
    mesh = trimesh.Trimesh(PART.vertices_mm, PART.triangles, process=False)
    (folder / "part.stl").write_bytes(mesh.export(file_type="stl"))
    (folder / "recipe.toml").write_text(RECIPE.format(top=TOP, boss=SIDE))
    (folder / "scans").mkdir()
    written(folder / "scans" / "part-1.ply", *scan(1))
    written(folder / "scans" / "part-10.ply", *scan(2, boss_mm=0.045))
    written(folder / "scans" / "part-2.ply", *scan(3, top_mm=0.08))
    (folder / "scans" / "part-3.ply").write_bytes(b"ply\nformat ascii 1.0\nelement")
    return folder


def inspected(
    bench: Path, output: Path, capsys: pytest.CaptureFixture[str], *words: str, code: int = 1
) -> dict[str, Any]:
    places = words or (str(bench / "scans"),)
    command = ["inspect", "recipe", str(bench / "recipe.toml"), *places, "-o", str(output)]
    assert main([*command, "--json"]) == code
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_parts_of_a_folder_become_one_table(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "results"
    told = inspected(bench, output, capsys)
    rows = {row["part"]: row for row in told["parts"]["each"]}
    assert list(rows) == ["part-1", "part-2", "part-3", "part-10"]
    verdicts = [row["verdict"] for row in rows.values()]
    assert verdicts == ["pass", "fail", "not inspected", "fail"]
    wrong = {
        name: {one["name"] for one in row["quantities"] if one["decision"] == "fail"}
        for name, row in rows.items()
    }
    assert wrong == {"part-1": set(), "part-2": {TOP}, "part-3": set(), "part-10": {"boss"}}
    boss = {name: row["quantities"][0] for name, row in rows.items() if row["quantities"]}
    # the sigma of a diameter from 1,000 points of 5 um and 20 exposures of 3 um
    assert boss["part-1"]["value"] == pytest.approx(16.0, abs=0.008)
    assert boss["part-10"]["value"] == pytest.approx(16.09, abs=0.008)
    assert 0.0 < boss["part-10"]["u"] < 0.02
    mean = {one["name"]: one for one in rows["part-2"]["quantities"] if one["kind"] == "mean"}
    assert mean[TOP]["value"] == pytest.approx(0.08, abs=0.003)
    assert "header" in rows["part-3"]["reason"]
    with (output / "table.csv").open() as stream:
        table = list(csv.DictReader(line for line in stream if not line.startswith("#")))
    assert [row["verdict"] for row in table] == verdicts
    assert float(table[3]["boss_mm"]) == boss["part-10"]["value"]
    assert [row[f"{TOP} mean_decision"] for row in table] == ["pass", "fail", "", "pass"]
    page = (output / "index.html").read_text()
    assert 'href="part-10/part.html"' in page
    assert f"Trend: {TOP}" in page
    assert "https://" not in page
    files = sorted(path.name for path in (output / "part-10").iterdir())
    assert files == ["features.json", "part.csv", "part.html", "part.ply"]
    assert not (output / "part-3").exists()


def test_a_fit_without_a_solution_costs_its_own_part_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def follow(recipe: Recipe, cloud: PointCloud) -> FollowedRecipe | FitFailure:
        if len(cloud) == 300:
            raise np.linalg.LinAlgError("Singular matrix")
        return follow_recipe(recipe, cloud)

    monkeypatch.setattr("armscan.jobs.inspection.recipe.follow_recipe", follow)
    (tmp_path / "recipe.toml").write_text('[[feature]]\nname = "face"\nkind = "plane"\n')
    points = np.random.default_rng(0).uniform(0.0, [40.0, 30.0, 0.01], (600, 3))
    scans = [tmp_path / "a.ply", tmp_path / "b.ply"]
    for path, n in zip(scans, (300, 600), strict=True):
        path.write_bytes(ply_bytes(cloud_of(points[:n])))
    told = inspected(tmp_path, tmp_path / "results", capsys, *map(str, scans))
    broken, whole = told["parts"]["each"]
    assert "no solution in numbers (Singular matrix)" in broken["reason"]
    assert (broken["verdict"], whole["reason"]) == ("not inspected", "")


def test_what_is_done_is_kept_and_not_done_again(
    bench: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    output, done = tmp_path / "results", list[int]()

    def interrupted(*words: Any) -> Any:
        if len(done) == 1:
            raise KeyboardInterrupt
        done.append(1)
        return follow_recipe(*words)

    monkeypatch.setattr("armscan.jobs.inspection.recipe.follow_recipe", interrupted)
    scans = [str(bench / "scans" / f"part-{k}.ply") for k in (1, 2)]
    command = ["inspect", "recipe", str(bench / "recipe.toml"), *scans, "-o", str(output)]
    assert main(command) == 130
    assert [path.name for path in output.iterdir() if path.is_dir()] == ["part-1"]
    assert b"part-1," in (output / "table.csv").read_bytes()
    before = (output / "part-1" / "features.json").stat().st_mtime_ns
    done.clear()
    # one part is left: a second one would interrupt again
    told = inspected(bench, output, capsys, *scans)
    assert [row["verdict"] for row in told["parts"]["each"]] == ["pass", "fail"]
    assert (output / "part-1" / "features.json").stat().st_mtime_ns == before
    # a cloud that has changed is not what was done: nothing of the older one is left
    done.clear()
    other = tmp_path / "part-1.ply"
    other.write_bytes(b"")
    told = inspected(bench, output, capsys, str(other))
    assert "empty" in told["parts"]["each"][0]["reason"]
    files = sorted(path.name for path in output.iterdir())
    assert files == ["index.html", "part-2", "table.csv"]


def test_features_are_measured_where_the_alignment_puts_them(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A turned and shifted scan gives the same diameter, at the boss's place in the model."""
    text = (bench / "recipe.toml").read_text().replace('"none"', '"best"')
    other = tmp_path / "recipe.toml"
    other.write_text(text)
    (tmp_path / "part.stl").write_bytes((bench / "part.stl").read_bytes())
    points, normals = scan(7, boss_mm=0.045)
    rotation, shift = random_motion(3)
    written(tmp_path / "moved.ply", points @ rotation.T + shift, normals @ rotation.T)
    told = inspected(tmp_path, tmp_path / "results", capsys, str(tmp_path / "moved.ply"))
    boss = told["parts"]["each"][0]["quantities"][0]
    assert boss["value"] == pytest.approx(16.09, abs=0.008)
    found = json.loads((tmp_path / "results" / "moved" / "features.json").read_text())
    assert found["features"][0]["point_mm"][:2] == pytest.approx([52.0, 20.0], abs=0.01)
    assert abs(found["features"][0]["direction"][2]) == pytest.approx(1.0, abs=1e-5)


def test_features_alone_need_no_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "recipe.toml").write_text(
        '[[feature]]\nname = "boss"\nkind = "cylinder"\ndiameter_mm = 16\ntolerance_mm = 0.06\n'
    )
    written(tmp_path / "a.ply", *scan(8))
    told = inspected(tmp_path, tmp_path / "results", capsys, str(tmp_path / "a.ply"), code=0)
    boss = told["parts"]["each"][0]["quantities"][0]
    assert boss["value"] == pytest.approx(16.0, abs=0.008)
    files = sorted(path.name for path in (tmp_path / "results" / "a").iterdir())
    assert files == ["features.json", "part.html"]


def test_a_scanner_that_was_calibrated_anew_is_told_of_on_pages_of_before(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They were kept: their warning, or its absence, was of the older document."""
    (tmp_path / "recipe.toml").write_text(
        '[title_block]\nscanner = "scanner.json"\n'
        '[[feature]]\nname = "boss"\nkind = "cylinder"\ndiameter_mm = 16\n'
    )
    scanner = scanner_calibration()
    (tmp_path / "scanner.json").write_bytes(scanner_document(scanner))
    points, normals = (values[::4] for values in scan(8))
    measured = replace(cloud_of(points, normals=normals), calibrations=(scanner.provenance.mark,))
    (tmp_path / "a.ply").write_bytes(ply_bytes(measured))
    result = tmp_path / "results" / "a" / "features.json"

    def notes() -> str:
        told = inspected(tmp_path, tmp_path / "results", capsys, str(tmp_path / "a.ply"), code=0)
        return " ".join(told["warnings"])

    assert "was not measured with the calibration of scanner.json" not in notes()
    before = result.stat().st_mtime_ns
    notes()
    assert result.stat().st_mtime_ns == before
    anew = replace(scanner.provenance, document_id="anew", created_utc="2026-02-03T04:05:06+00:00")
    (tmp_path / "scanner.json").write_bytes(scanner_document(replace(scanner, provenance=anew)))
    assert "was not measured with the calibration of scanner.json" in notes()
    assert result.stat().st_mtime_ns != before


def test_what_is_to_be_known_of_the_reading_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "recipe.toml").write_text('[[feature]]\nname = "top"\nkind = "plane"\n')
    points = np.random.default_rng(1).uniform(0.0, 20.0, (800, 3)) * [1.0, 1.0, 0.0005]
    np.savetxt(tmp_path / "a.txt", points, header="east north up", comments="")
    told = inspected(tmp_path, tmp_path / "results", capsys, str(tmp_path / "a.txt"), code=0)
    assert any("does not name x, y and z" in text for text in told["warnings"])


FEATURE = '[[feature]]\nname = "b"\nkind = "cylinder"\n'
REFUSED = [
    ("", "neither a 'part' nor a 'feature'"),
    ("tolerance = 1", "'tolerance' is not known; 'tolerance_mm' is"),
    ('part = "none.stl"', "'part' is"),
    ("tolerance_mm = 0.1\n" + FEATURE, "'tolerance_mm' has no effect without 'part'"),
    ('part = "part.stl"\ntolerance_mm = -1', "'tolerance_mm' is -1"),
    ('part = "part.stl"\n[faces]\n"bore" = 0.1', "the part has no face 'bore'"),
    ('part = "part.stl"\n[faces]\n"face 1" = "x"', "'faces.face 1' is no length"),
    ('part = "part.stl"\nalign = "321"', "'datums' goes with"),
    ('part = "part.stl"\nalign = "321"\ndatums = "face 1,face 2,b"', "no face 'b'"),
    ('part = "part.stl"\nalign = "fit"', "'align' is 'fit', not one of best, none, 321"),
    ('part = "part.stl"\n[clean]\nedges = 1', "'clean.edges' is not known"),
    ('part = "part.stl"\n[clean]\nedge_mm = -1', "'clean.edge_mm' is -1"),
    ('part = "part.stl"\n[clean]', "no filter is given"),
    ('part = "part.stl"\n' + FEATURE + 'face = "hole"', "the part has no face 'hole'"),
    (FEATURE + "tolerance_mm = 0.1", "a tolerance and no nominal value"),
    (FEATURE + "nominal_deg = 3", "no size in that unit"),
    (FEATURE + "seed_mm = [1, 2]", "the seed is no point"),
    (FEATURE + "region = [1, 2]", "'feature.0.region'"),
    (FEATURE + FEATURE, "the name 'b' is there twice"),
    (FEATURE.replace("cylinder", "hole"), "'feature.0.kind' is 'hole'"),
    (FEATURE.replace("[[", "[").replace("]]", "]"), "two brackets"),
    ("align = ", "this is no TOML"),
]


@pytest.mark.parametrize(("text", "said"), REFUSED)
def test_a_wrong_recipe_is_one_sentence_and_writes_nothing(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, said: str
) -> None:
    recipe = bench / "wrong.toml"
    recipe.write_text(text or "title = 'x'")
    scans, output = str(bench / "scans"), tmp_path / "results"
    assert main(["inspect", "recipe", str(recipe), scans, "-o", str(output)]) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: ")
    assert said in told
    assert not output.exists()


def test_places_that_do_not_do_are_refused(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe, scan_1 = str(bench / "recipe.toml"), str(bench / "scans" / "part-1.ply")
    empty, foreign = tmp_path / "empty", tmp_path / "foreign"
    empty.mkdir()
    foreign.mkdir()
    (foreign / "table.csv").write_text("mine")
    for words, said in (
        ((str(empty), "-o", str(tmp_path / "r")), "no cloud lies in this folder"),
        ((scan_1, str(tmp_path / "part-1.xyz"), "-o", str(tmp_path / "r")), "would be one part"),
        ((scan_1, "-o", str(foreign)), "holds other files"),
        ((scan_1, "-o", str(tmp_path / "no" / "r")), "no folder above"),
    ):
        assert main(["inspect", "recipe", recipe, *words]) == 2
        assert said in capsys.readouterr().err
    assert (foreign / "table.csv").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "foreign"]
