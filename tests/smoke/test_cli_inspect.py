# SPDX-License-Identifier: Apache-2.0
"""``armscan inspect``: numbers, pages, clouds of other programs, failures in one sentence."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes

from armscan.cli import main
from armscan.storage.clouds import ply_bytes, read_ply, xyz_bytes
from rigs.inspection_clouds import RADIUS_MM, ball_stripes, block_stripes, cloud_of

Fails = Callable[..., str]


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clouds")
    exposure = np.repeat(np.arange(20), 40)
    outward = ball_stripes(20, 40)
    rng = np.random.default_rng(1)
    points = outward * (RADIUS_MM + 0.01 + rng.normal(0.0, 0.005, (800, 1)))
    ball = cloud_of(points + np.array([300.0, 20.0, 90.0]), exposure)
    (folder / "ball.ply").write_bytes(ply_bytes(ball))
    (folder / "ball.xyz").write_bytes(xyz_bytes(ball))
    points, exposure = block_stripes(20.0, n_points=200)
    (folder / "block.ply").write_bytes(ply_bytes(cloud_of(points, exposure)))
    return folder


def report(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, object]:
    assert main(["inspect", *(str(word) for word in words), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert isinstance(found, dict)
    return found


def test_a_ball_with_its_page(
    clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "ball.html"
    found = report(capsys, "sphere", clouds / "ball.ply", "--diameter", 34.96, "-o", page)
    assert found["diameter_error_mm"] == pytest.approx(0.02, abs=0.003)
    assert found["written"] == [page.as_posix()]
    text = page.read_text(encoding="utf-8")
    assert "nominal reference" in text
    assert "fitted reference" in text
    assert "about their mean, divided by n - 1 = 799" in text
    assert "not an accredited test" in text
    assert 'class="scene"' in text


def test_a_ball_of_another_program_has_no_sigma(
    clouds: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["inspect", "sphere", str(clouds / "ball.xyz"), "--diameter", "34.96"]) == 0
    out = capsys.readouterr().out
    (diameter,) = (line for line in out.splitlines() if "Fitted diameter" in line)
    assert "nominal 34.96 mm" in diameter
    assert "±" not in diameter
    assert "carries no standard deviations" in out


def test_a_page_of_a_foreign_cloud_does_not_contradict_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither of its frame, nor of its exposures, nor of shares next to all."""
    path, page = tmp_path / "plane.csv", tmp_path / "plane.html"
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(0.0, 50.0, (30_000, 2)), rng.normal(0.0, 0.005, 30_000)])
    points[0, 2] = 0.4
    path.write_text("x,y,z\n" + "".join("{:.4f},{:.4f},{:.4f}\n".format(*row) for row in points))
    titles: list[str] = []
    monkeypatch.setattr(Axes, "set_title", lambda _, text, **__: titles.append(text))
    report(capsys, "plane", path, "-o", page)
    text = page.read_text(encoding="utf-8")
    assert "in the Part frame, as it is called where a file names none" in text
    assert "does not name" not in text
    assert "exposures are not told apart" in text
    assert "in 1 exposure" not in text
    assert "above 99.99 %" in text
    assert titles == ["above 99.99 % of 30,000 points within 0.05 mm"]


@pytest.mark.parametrize("words", [("step", "--height", "20"), ("plane",)])
def test_a_cloud_without_sheets_is_said_to_have_none(
    words: tuple[str, ...], clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its points were called those of one exposure."""
    foreign = tmp_path / "block.xyz"
    foreign.write_bytes(xyz_bytes(read_ply(clouds / "block.ply")))
    for path in (foreign, clouds / "block.ply"):
        assert main(["inspect", words[0], str(path), *words[1:]]) == 0
        out = capsys.readouterr().out
        assert ("the cloud does not tell which points lie in one" in out) == (path == foreign)
        assert "one exposure" not in out


@pytest.mark.parametrize(
    "words",
    [
        ("plane", "block"),
        ("step", "block", "--height", "20"),
        ("relation", "block", "plane:seed=0,0,0", "plane:seed=15,20,20"),
        ("sphere", "ball", "--diameter", "34.96"),
        ("clean", "block", "-o", "clean.ply", "--density", "1"),
    ],
)
def test_what_is_to_be_known_of_the_reading_is_said(
    words: tuple[str, ...],
    clouds: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Only `convert` said it."""
    monkeypatch.chdir(tmp_path)
    points = read_ply(clouds / f"{words[1]}.ply").points_mm
    np.savetxt("foreign.txt", points, header="east north up", comments="")
    group = [] if words[0] == "clean" else ["inspect"]
    assert main([*group, words[0], "foreign.txt", *words[2:]]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "'east north up' does not name x, y and z" in told


def test_a_step_and_a_plane(clouds: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = report(capsys, "step", clouds / "block.ply", "--height", 20, "--margin", 2)
    assert found["height_error_mm"] == pytest.approx(0.0, abs=1e-9)
    given = ["plane", clouds / "block.ply", "--plane", "0,0,2,0.04"]
    found = report(capsys, *given, "--region=-50,50,-50,50,-1,1")
    nominal, points = found["nominal"], found["points"]
    assert isinstance(nominal, dict)
    assert isinstance(points, dict)
    assert nominal["mean_mm"] == pytest.approx(0.02)
    assert points["n_region"] < points["n_given"]
    assert nominal["offset"]["value_mm"] == pytest.approx(0.02)


def test_a_plane_against_a_probed_plate(
    clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plate = tmp_path / "plate.csv"
    corners = [(x, y) for x in (0, 30, 60) for y in (0, 40)]
    rows = "".join(f"{x},{y},-0.05\n" for x, y in corners)
    plate.write_text("x_mm,y_mm,z_mm\n" + rows)
    found = report(capsys, "plane", clouds / "block.ply", "--plate", plate)
    nominal = found["nominal"]
    assert isinstance(nominal, dict)
    assert abs(nominal["mean_mm"]) == pytest.approx(0.05)
    assert nominal["counted_from"] == "the plane of plate.csv"


def test_the_offset_from_a_badly_touched_plate_is_as_uncertain_as_the_plate(
    clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Six touches that scatter by 0.22 mm tell no height to 0.005 mm."""
    plate, exact = tmp_path / "plate.csv", tmp_path / "plane.csv"
    heights = (0.25, -0.2, -0.25, 0.2, 0.2, -0.2)
    corners = [(x, y) for x in (-20, 5, 30) for y in (0, 40)]
    rows = "".join(f"{x},{y},{z}\n" for (x, y), z in zip(corners, heights, strict=True))
    plate.write_text("x_mm,y_mm,z_mm\n" + rows)
    exact.write_text("A,B,C,D\n0,0,1,0\n")
    words = ("plane", clouds / "block.ply", "--region=-50,50,-50,50,-1,1")
    found = report(capsys, *words, "--plate", plate)
    nominal = found["nominal"]
    assert isinstance(nominal, dict)
    # over the middle of the touches: their scatter, 0.22 mm or what is expected of it, over the
    # root of six of them, and 0.4 of it by the tip
    assert 0.1 < nominal["offset_sigma_plate_mm"] < 0.15
    assert nominal["offset"]["sigma_mm"] >= nominal["offset_sigma_plate_mm"]
    assert nominal["offset_u_mm"] == pytest.approx(2.0 * nominal["offset"]["sigma_mm"])
    for option, value, is_told in (("--plate", exact, True), ("--plane", "0,0,1,0", False)):
        assert main(["inspect", *(str(word) for word in words), option, str(value)]) == 0
        assert ("without the plate's own uncertainty" in capsys.readouterr().out) == is_told


def test_what_cannot_be_inspected_gets_one_sentence(
    clouds: Path, tmp_path: Path, fails: Fails
) -> None:
    ball = clouds / "ball.ply"
    assert "25.4 mm" in fails("inspect", "sphere", ball, "--diameter", 25.4)
    assert "--diameter" in fails("inspect", "sphere", ball)
    assert "6 are needed" in fails(
        "inspect", "sphere", ball, "--diameter", 34.96, "--region", "0,1,2"
    )
    assert "not a list of numbers" in fails(
        "inspect", "sphere", ball, "--diameter", 34.96, "--region", "left,right"
    )
    assert "in the region lie 0 of" in fails(
        "inspect", "sphere", ball, "--diameter", 34.96, "--region", "0,1,0,1,0,1"
    )
    assert "xmax is nan" in fails(
        "inspect", "sphere", ball, "--diameter", 34.96, "--region", "0,nan,0,1,0,1"
    )
    for option in ("--diameter=nan", "--diameter=-1", "--diameter=inf"):
        assert "give the diameter in mm" in fails("inspect", "sphere", ball, option)
    assert "normal is 0, 0, 0" in fails("inspect", "step", ball, "--height", 7, "--normal", "0,0,0")
    for option in ("--height=nan", "--margin=-1", "--margin=nan", "--feature-mm=inf"):
        assert "; give" in fails("inspect", "step", clouds / "block.ply", "--height=7", option)
    assert "no two parallel faces 7" in fails(
        "inspect", "step", clouds / "block.ply", "--height", 7
    )
    page = tmp_path / "page.pdf"
    assert "end it in .html" in fails("inspect", "plane", ball, "-o", page, writes=tmp_path)
    plate = tmp_path / "plate.csv"
    plate.write_text("A,B,C,D\n0,0,1,6.4\n")
    assert "both --plane and --plate" in fails(
        "inspect", "plane", ball, "--plane", "0,0,1,0", "--plate", plate
    )
    assert "there is no such file" in fails("inspect", "plane", tmp_path / "absent.ply")


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("--uncertainty=-1", "--uncertainty: the uncertainty of the standard is -1 mm"),
        ("--uncertainty=nan", "uncertainty of the standard is nan mm"),
        ("--mpe=nan", "the limit is nan mm"),
        ("--mpe=-0.1", "the limit is -0.1 mm"),
        ("--mpe=0", "--mpe: the limit is 0 mm; give more than 0 mm"),
        ("--ball=nan", "--ball: a diameter of nan mm"),
        ("--ball=inf", "--ball: a diameter of inf mm"),
        ("--feature-mm=nan", "a feature band of nan mm"),
        ("--region=1,0,0,1,0,1", "--region: xmin 1 is not below xmax 0"),
    ],
)
def test_the_daily_check_refuses_what_is_no_length(
    clouds: Path, fails: Fails, option: str, said: str
) -> None:
    assert said in fails("verify", clouds / "ball.ply", "--ball=34.96", option)


def test_points_of_which_nothing_is_said_lie_on_the_surface_and_the_report_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "touches.csv"
    rows = "\n".join(f"{10 * x},{10 * y},0" for x in range(3) for y in range(3))
    table.write_text(f"x_mm,y_mm,z_mm\n{rows}\n")
    assert main(["probe", str(table)]) == 0
    assert "no tip's radius was taken off" in capsys.readouterr().out
    table.write_text(f"# point = tip-centre, tip_diameter_mm = 6\nx_mm,y_mm,z_mm\n{rows}\n")
    assert main(["probe", str(table)]) == 0
    told = capsys.readouterr().out
    assert "tip of 6 mm compensated" in told
    assert "no tip's radius" not in told


def test_the_daily_check_ends_with_its_verdict(
    clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], fails: Fails
) -> None:
    """The ball is 0.02 mm too large: within a given limit of 0.05, beyond one of 0.01."""
    page = tmp_path / "verify.html"
    words = ["verify", str(clouds / "ball.ply"), "--ball", "34.96"]
    assert main([*words, "--mpe", "0.05", "-o", str(page)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("Scanner verified: still valid")
    assert "passed if |E| is at most MPE - U" in out
    assert "the calibration may be used" in page.read_text(encoding="utf-8")
    assert main([*words, "--mpe", "0.01", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "not valid"
    assert found["checks"][0]["error"] == pytest.approx(0.02, abs=0.003)
    assert main([*words, "--mpe", "0.02", "--uncertainty", "0.01"]) == 1
    assert "inconclusive" in capsys.readouterr().out
    assert "one of --ball DIAMETER, --plate FILE and --plane A,B,C,D" in fails(
        "verify", clouds / "ball.ply"
    )
    assert "give --scanner" in fails("verify", tmp_path, "--ball", 34.96)
    said = fails("verify", clouds / "ball.ply", "--ball", 34.96, "--mpe", -1)
    assert said == "error: --mpe: the limit is -1 mm; give more than 0 mm.\n"


def test_a_fused_cloud_says_why_nothing_is_known_of_its_exposures(
    clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = read_ply(clouds / "ball.ply")
    one = np.zeros(len(cloud), dtype=np.int64)
    fused = replace(cloud, exposure=one, exposure_sources=("fused",), sheet_names=("fused",))
    (tmp_path / "fused.ply").write_bytes(ply_bytes(replace(fused, noise_length=None)))
    assert main(["inspect", "sphere", str(tmp_path / "fused.ply"), "--diameter", "34.96"]) == 0
    out = capsys.readouterr().out
    assert "the cloud is fused and no longer tells its exposures apart" in out.replace("The", "the")
    assert "not known: from what exposures" not in out
    main(["verify", str(tmp_path / "fused.ply"), "--ball", "34.96", "--mpe", "0.05"])
    out = capsys.readouterr().out
    assert "verify the recording, or the cloud from before it was fused" in out
    assert "oo few exposures" not in out


def test_the_sign_of_a_deviation_is_told(clouds: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", "sphere", str(clouds / "ball.ply"), "--diameter", "34.96"]) == 0
    assert "outside the ball, farther from its centre" in capsys.readouterr().out
    assert main(["inspect", "plane", str(clouds / "block.ply")]) == 0
    assert "on the side of +z: the cloud has no normals" in capsys.readouterr().out


def test_a_simulated_cloud_is_called_so_wherever_it_lies(
    clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The mark is in the cloud, so a copy far from the recording bears it too."""
    copy = tmp_path / "copy.ply"
    copy.write_bytes(ply_bytes(replace(read_ply(clouds / "ball.ply"), is_simulated=True)))
    assert report(capsys, "sphere", copy, "--diameter", 34.96)["simulated"] is True
    assert report(capsys, "sphere", clouds / "ball.ply", "--diameter", 34.96)["simulated"] is False
    assert main(["verify", str(copy), "--ball", "34.96", "--mpe", "0.05"]) == 0
    assert "(simulated data)" in capsys.readouterr().out


def test_words_of_small_refusals(clouds: Path, fails: Fails, tmp_path: Path) -> None:
    ball = clouds / "ball.ply"
    said = fails("inspect", "sphere", ball, "--diameter", 35, "--region", "0,1,0,1,0,1")
    assert "in the region lie 0 of the cloud's 800 points" in said
    folder = tmp_path / "x"
    said = fails("simulate", "thesis-single", "ball", "-o", folder, "--preset=bad")
    assert "'bad' is not one of" in said and "Value error" not in said


def test_a_plane_of_one_sheet_in_the_sensor_frame_says_nothing_and_is_told_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All points lie on the light sheet by construction, whatever it met."""
    across = np.random.default_rng(1).uniform(-20.0, 20.0, (400, 2))
    points = np.column_stack([across, 300.0 + 0.01 * across[:, 0]])
    for frame, is_told in (("Sensor", True), ("Base", False)):
        path = tmp_path / f"{frame}.ply"
        path.write_bytes(ply_bytes(cloud_of(points, frame=frame)))  # type: ignore[arg-type]
        assert main(["inspect", "plane", str(path), "--json"]) == 0
        said = json.loads(capsys.readouterr().out)["warnings"]
        assert any("light sheet" in warning for warning in said) == is_told


def test_a_mesh_and_what_stands_in_its_way(
    clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], fails: Fails
) -> None:
    exposure = np.repeat(np.arange(100), 100)
    outward = ball_stripes(100, 100)
    cloud = cloud_of(outward * RADIUS_MM, exposure, normals=outward)
    (tmp_path / "normals.ply").write_bytes(ply_bytes(cloud))
    whole, mesh = tmp_path / "normals.ply", tmp_path / "ball.stl"
    assert main(["mesh", str(whole), "-o", str(mesh), "--cell", "0.8", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    data = mesh.read_bytes()
    assert int.from_bytes(data[80:84], "little") == found["n_triangles"] > 1000
    # the cap of 140 by 140 degrees, a border of a cell more or less
    rim_mm2 = 2.0 * np.pi * RADIUS_MM * 0.8
    lune = np.deg2rad(140.0) * 2.0 * np.sin(np.deg2rad(70.0)) * RADIUS_MM**2
    assert abs(found["area_mm2"] - lune) < rim_mm2
    copy = tmp_path / "copy.ply"
    copy.write_bytes(whole.read_bytes())
    for words in (
        ("mesh", copy, "-o", copy, "--force"),
        ("clean", copy, "-o", copy, "--force", "--isolated", 2),
        ("fuse", copy, "--voxel", 1, "-o", copy, "--force"),
    ):
        assert "copy.ply is read, and would be replaced" in fails(*words)
    assert copy.read_bytes() == whole.read_bytes()
    assert "no point has a normal" in fails("mesh", clouds / "ball.ply", "-o", tmp_path / "n.stl")
    assert "ends in '.obj'" in fails("mesh", whole, "-o", tmp_path / "n.obj")
    assert "--cell is -1.0 mm" in fails("mesh", whole, "-o", tmp_path / "n.stl", "--cell", "-1")
    assert "give 4 or more" in fails("mesh", whole, "-o", tmp_path / "n.stl", "--triangles", "2")
    assert not (tmp_path / "n.stl").exists()


@pytest.mark.parametrize("far_mm", [1e3, 1e6])
def test_a_mesh_far_from_the_origin_is_said_to_be_rounded_in_stl(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], far_mm: float
) -> None:
    """Single precision holds multiples of 0.06 mm at a kilometre; nothing said so."""
    outward = ball_stripes(60, 60)
    points = outward * RADIUS_MM + [far_mm, 0.0, 0.0]
    path = tmp_path / "far.ply"
    names = "".join(f"property double {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{names}element face 1\n"
    header += "property list uchar int vertex_indices\nend_header"
    rows = np.column_stack([points, outward])
    np.savetxt(path, rows, header=header, comments="", footer="3 0 1 2")
    for suffix in (".stl", ".ply"):
        words = ["mesh", str(path), "-o", str(tmp_path / f"ball{suffix}"), "--cell", "2"]
        assert main([*words, "--json"]) == 0
        said = json.loads(capsys.readouterr().out)["warnings"]
        is_told = any("as multiples of 0.062 mm: write .ply" in text for text in said)
        assert is_told == (suffix == ".stl" and far_mm == 1e6)
        assert any("a mesh of 1 faces" in text for text in said)
