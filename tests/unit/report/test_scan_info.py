# SPDX-License-Identifier: Apache-2.0
"""``armscan info`` knows recordings, scanners, arms, probes and probed points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armscan.cli.run import main
from armscan.errors import FileFormatError
from armscan.jobs.info import OWN_PAGE, _line, describe_files
from armscan.models.arm import thesis_arm
from armscan.records.points import MarkerSet
from armscan.records.recording import ArmTrack
from armscan.report.quantity import summary_json, summary_text
from armscan.storage.arm import ProbeTip, arm_model_toml, write_probing
from armscan.storage.clouds import read_cloud, write_cloud
from armscan.storage.documents import scanner_document
from armscan.storage.parts.meshes import encoded_surface
from armscan.storage.points import markers_csv
from rigs.calibration_documents import scanner_calibration
from rigs.recording_folders import ARM, EXPOSURES, lab_folder

ROOT = Path(__file__).parents[3]


def described(path: Path) -> dict[str, object]:
    summary = describe_files([str(path)])
    assert summary_text(summary) and summary_json(summary)
    found: dict[str, object] = summary.data["items"][0]
    return found


def test_sigmas_of_a_rotation_vector_are_its_own() -> None:
    """Those of an increment of the rotation were told: 0.0026, 0.0013 and 0.0011 rad."""
    found = described(ROOT / "tests" / "net" / "inputs" / "documents" / "scanner.json")
    told = [found[f"rotation_vector_{axis}_tool_rad"] for axis in "xyz"]
    assert told == ["0.3024 ± 0.0029", "-0.7999 ± 0.0020", "1.70023 ± 0.00061"]


def test_a_recording_is_counted_and_what_is_odd_is_said(tmp_path: Path) -> None:
    views = [",view", ",p1", ",p1", ","]
    table = [line + cell for line, cell in zip(EXPOSURES.splitlines(), views, strict=True)]
    arm = ARM.replace("1500,901,1,400", "1500,,1,400")
    folder = lab_folder(tmp_path, session=None, exposures="\n".join(table) + "\n", arm=arm)
    for path in (folder, folder / "arm.csv", folder / "exposures.csv"):
        found = described(path)
        assert found["exposures"] == 3 and found["views"] == 2
        assert (found["arm_samples"], found["arm_samples_without_pose"]) == (3, 1)
        assert found["lasers"] == ["A", "B"]
        assert found["cameras"] == ["8 x 6 px, 8 bits, mono"]
        assert "no session.toml" in str(found["assumed"])
        assert "1 of 3 samples" in str(found["warnings"])


def test_rates_missing_rows_and_exposures_without_pose_are_said(tmp_path: Path) -> None:
    """The arm reports every 10 ms; its rows from 100 to 200 ms are missing, without a mark."""
    ms = 10**6
    lines = [f"{t * ms},{900 + t},0,400,1,0,0,0" for t in range(0, 301, 10) if not 100 < t < 200]
    arm = "\n".join([ARM.splitlines()[0], *lines]) + "\n"
    head = EXPOSURES.splitlines()[0]
    shown = [f"{k},{t * ms},0,images/{k}.png,A" for k, t in enumerate((45, 85, 165))]
    found = described(lab_folder(tmp_path, arm=arm, exposures="\n".join([head, *shown]) + "\n"))
    assert (found["exposure_median_period_ms"], found["exposure_longest_step_ms"]) == (60.0, 80.0)
    assert (found["arm_median_period_ms"], found["arm_longest_step_ms"]) == (10.0, 100.0)
    assert (found["arm_gap_limit_ms"], found["arm_steps_above_gap_limit"]) == (30.0, 1)
    assert found["arm_samples_without_pose"] == 0
    assert found["exposures_with_pose"] == 2
    assert found["poses_found"] == "by time, between samples up to 30 ms apart"
    assert found["exposures_without_pose"] == "1 in a gap of the arm's samples"


def test_a_recording_of_which_no_exposure_has_a_pose_is_described_all_the_same(
    tmp_path: Path,
) -> None:
    empty = ARM.replace("901,1,400,0.8,0.6,0,0", ",,,,,,")
    found = described(lab_folder(tmp_path, arm=empty))
    assert found["exposures_with_pose"] == 0
    assert "none of 3 exposures has a pose" in str(found["exposures_without_pose"])


def test_a_simulated_recording_is_called_so(tmp_path: Path) -> None:
    folder = lab_folder(tmp_path, session="simulated = true\n")
    assert "simulated" in str(described(folder)["what"])


@pytest.mark.parametrize("has_sensor", [True, False])
def test_a_scanner(tmp_path: Path, has_sensor: bool) -> None:
    path = tmp_path / "scanner.json"
    path.write_bytes(scanner_document(scanner_calibration(has_sensor=has_sensor)))
    found = described(path)
    said = "2 light sheets" if has_sensor else "no images"
    assert str(found["what"]).endswith(said)
    assert str(found["translation_x_tool_mm"]).startswith("-149.9")
    assert found["postures"] == 12


def test_touches_probe_arm_and_probed_points(tmp_path: Path) -> None:
    track = ArmTrack(
        t_ns=np.arange(4),
        rotations=np.tile(np.eye(3), (4, 1, 1)),
        translations_mm=100.0 * np.eye(4, 3),
        is_known=np.ones(4, bool),
    )
    folder = tmp_path / "touches"
    write_probing(folder, track, ProbeTip(np.array([0, 0.5, 60]), 6.0))
    assert described(folder)["what"] == "touches of a probe, 4 samples"
    assert described(folder / "probe.toml")["tip_diameter_mm"] == 6.0
    arm = folder / "arm.toml"
    arm.write_bytes(arm_model_toml(thesis_arm((300, 400, 300, 100), (20, 30, 20))))
    assert described(arm)["longest_reach_mm"] == 1170.0
    points = tmp_path / "plate.csv"
    points.write_text("# point = tip-centre, tip_diameter_mm = 6\nx_mm,y_mm,z_mm\n1,2,3\n4,-5,6\n")
    found = described(points)
    assert found["what"] == "2 probed points, centres of the tip"
    assert found["y_range_mm"] == [-5.0, 2.0]


@pytest.mark.parametrize(
    "before", ["", "\ufeff", "# " + 2000 * "x" + "\n"], ids=["plain", "marked", "told of at length"]
)
def test_markers_are_no_probed_points(tmp_path: Path, before: str) -> None:
    markers = MarkerSet(
        ids=np.array([3, 7, 9]),
        points_mm=np.arange(9.0).reshape(3, 3) ** 2,
        covariance_mm2=np.tile(np.diag([1e-4, 4e-4, 1e-4]), (3, 1, 1)),
        frame="Part",
    )
    path = tmp_path / "markers.csv"
    path.write_text(before + markers_csv(markers, is_simulated=True).decode(), "utf-8")
    found = described(path)
    assert found["what"] == "3 markers" and found["frame"] == "Part" and found["simulated"]
    assert found["median_sigma_mm"] == pytest.approx(0.02)
    path.write_text("x_mm,y_mm,z_mm\n1,2,3\n4,5,6\n7,8,1\n")
    assert "probed points" in str(described(path)["what"])


def test_long_lists_are_told_by_their_ends() -> None:
    names = [f"{k:03d}.png" for k in range(30)]
    assert _line("exposures", names) == "exposures: 30, 000.png to 029.png"
    assert _line("exposures", names[:2]) == "exposures: 000.png, 001.png"
    assert _line("not_joined", []) == "not joined: none"


def test_clouds_as_text_are_described_as_clouds(tmp_path: Path) -> None:
    """A table that armscan wrote of a cloud is no list of probed points."""
    plain, own = tmp_path / "cloud.txt", tmp_path / "cloud.csv"
    plain.write_text("1 2 3\n4 -5 6\n")
    assert described(plain)["what"] == "point cloud, 2 points"
    assert described(plain)["y_range"] == [-5.0, 2.0]
    write_cloud(own, replace(read_cloud(plain), frame="Base"))
    assert described(own)["what"] == "point cloud, 2 points"
    assert described(own)["frame"] == "Base"


def test_what_armscan_writes_beside_its_results_is_called_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "summary.json").write_text('{"kind": "demo", "simulated": true}')
    (tmp_path / "truth.json").write_text(
        '{"simulated": true, "head": "thesis-single", "preset": "thesis", "seed": 1}'
    )
    (tmp_path / "page.html").write_text(f"<html>{OWN_PAGE.decode()}</html>")
    (tmp_path / "files.txt").write_text("summary.json\ntruth.json\n")
    corners = np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 9.0, 0.0], [0.0, 0.0, 9.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    (tmp_path / "part.stl").write_bytes(encoded_surface(".stl", corners, faces, "part"))
    for name, what in {
        "summary.json": "what `armscan` says with --json (demo)",
        "truth.json": "truth of a simulation (thesis-single)",
        "page.html": "page of armscan; open it in a browser",
        "files.txt": "list of the files that stand beside it",
        "part.stl": "model of a part, 4 triangles, 4 corners",
    }.items():
        assert described(tmp_path / name)["what"] == what


def test_what_is_not_known_is_no_zero(tmp_path: Path) -> None:
    plain = tmp_path / "cloud.xyz"
    plain.write_text("1 2 3\n4 -5 6\n")
    assert described(plain)["median_sigma_mm"] is None
    told = describe_files([str(plain)]).quantities[0].text
    assert "median sigma mm: not known" in told
    assert "x range: 1.0, 4.0 mm" in told


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("part.step", "ISO-10303-21;\nHEADER;\n", "STEP model of a part"),
        ("rig.toml", 'arm = "tcp://h:1"\n', "devices of a rig"),
        ("batch.json", '{"results": {"a": {"mark": "x"}}}', "list of what was made of a folder"),
        ("plane.csv", "A,B,C,D\n0,0,2,-5\n", "plane A x"),
        ("plane.txt", "# of the table\n0 0 1 -5\n", "plane A x"),
    ],
)
def test_what_holds_no_facts_is_named(tmp_path: Path, name: str, text: str, what: str) -> None:
    """Some were told to be no table, some to be of no known kind."""
    path = tmp_path / name
    path.write_text(text)
    assert str(described(path)["what"]).startswith(what)


@pytest.mark.parametrize(
    ("name", "text", "what"),
    [
        ("paraview.csv", "Points:0,Points:1,Points:2\n1,2,3\n2,3,4\n", "point cloud, 2 points"),
        ("label.csv", "x,y,z,label\n1,2,3,4\n2,2,3,4\n", "point cloud, 2 points"),
        ("slashes.csv", "//X,Y,Z,Intensity\n1,2,3,4\n1,2,4,4\n", "point cloud, 2 points"),
        ("bare.csv", "1,2,3\n2,3,4\n", "point cloud, 2 points"),
        ("deviation.csv", "x_mm,y_mm,z_mm,deviation_mm\n1,2,3,0\n", "point cloud, 1 points"),
        ("profile.csv", "x_mm,z_mm\n1,2\n2,3\n", "profile of a sensor, 2 points"),
        ("profile.yml", "%YAML:1.0\nscan_line: [1.0, 0.0, 2.0]\n", "profile of a sensor, 1 point"),
        ("poses.csv", "x_mm,y_mm,z_mm,a_deg,b_deg,c_deg\n9,2,3,1,2,3\n", "1 pose of an arm"),
        ("one.txt", "# x y z intensity\n1.5 2.5 3.5 128\n", "point cloud, 1 points"),
        ("quat.csv", "x,y,z,qw,qx,qy,qz\n9,2,3,1,0,0,0\n", "1 pose of an arm"),
        ("poses.txt", "900,200,300,10,20,30\n", "(or poses of an arm"),
        ("stripes.csv", "image,x_px,y_px\n1.png,2,3\n", "table of stripe points of images"),
        (
            "table.csv",
            "# x\npart,cloud,verdict,reason\na,a.ply,pass,\n",
            "table of parts inspected",
        ),
    ],
)
def test_tables_are_told_by_their_headings(tmp_path: Path, name: str, text: str, what: str) -> None:
    (tmp_path / name).write_text(text)
    assert what in str(described(tmp_path / name)["what"])


def test_json_of_another_program_that_has_a_schema_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.json"
    path.write_text('{"schema": {"type": "object"}}')
    with pytest.raises(FileFormatError, match=r"other\.json"):
        describe_files([str(path)])


def test_other_tables_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.csv"
    path.write_text("name,age\nx,3\n")
    with pytest.raises(FileFormatError, match="which of 2 columns are x, y and z"):
        describe_files([str(path)])


def test_one_file_that_cannot_be_read_hides_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    odd, good = tmp_path / "a.xyzzy", tmp_path / "points.csv"
    odd.write_bytes(b"what is this")
    good.write_text("x_mm,y_mm,z_mm\n1,2,3\n100,2,3\n1,90,3\n")
    missing = tmp_path / "no.csv"
    names = [str(odd), str(missing), str(good)]
    summary = describe_files(names)
    unknown, absent, known = summary.data["items"]
    assert unknown["failed"].startswith("armscan does not know this kind of file")
    assert "there is no such file" in absent["failed"]
    assert (known["points"], "failed" in known) == (3, False)
    assert summary.data["n_failed"] == 2
    assert main(["info", *names]) == 2
    told = capsys.readouterr()
    assert "3 probed points" in told.out and "does not know this kind of file" in told.out
    assert told.err.startswith("error: 2 of 3 items cannot be read")
    with pytest.raises(FileFormatError, match="does not know"):
        describe_files(names[:1])
