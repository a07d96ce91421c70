# SPDX-License-Identifier: Apache-2.0
"""The three commands, typed one after the other, against the truth of the drawn bench."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from armscan.cli.run import main
from armscan.storage.clouds import read_ply
from armscan.storage.documents import read_camera_calibration, read_sensor_calibration
from rigs.drawn_bench import FOCAL, HEIGHT, OBJECT_PLACE, SHEET, SHEET_D_MM, TARGET, WIDTH, Bench

SIGMAS = 4.0


def test_camera_is_found(calibrated: Bench) -> None:
    document = read_camera_calibration(calibrated.camera)
    sigma = np.sqrt(np.diag(document.covariance))[:4]
    truth = [FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2]
    error = np.abs(document.camera.parameters[:4] - truth)
    assert np.all(error < SIGMAS * sigma)
    assert np.all(sigma < 0.01 * FOCAL)
    assert len(document.provenance.inputs) == document.n_views == 7
    assert "calibrate" in document.provenance.command or document.provenance.command


def test_sheet_is_found(calibrated: Bench) -> None:
    document = read_sensor_calibration(calibrated.sensor)
    (sheet,) = document.sheets
    plane = sheet.sheet.plane * np.sign(sheet.sheet.plane[0])
    assert np.degrees(np.arccos(min(1.0, float(plane[:3] @ SHEET)))) < 0.3
    assert abs(float(plane[:3] @ [0.0, 0.0, 150.0]) + plane[3]) < 0.15
    assert abs(SHEET_D_MM + float(SHEET @ [0.0, 0.0, 150.0])) < 1e-12
    assert document.provenance.parent_ids == (document.camera.provenance.document_id,)


def test_points_lie_on_the_object(
    calibrated: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud_path = tmp_path / "cloud.ply"
    folder = calibrated.folder / "object"
    words = ["reconstruct", folder / "laser.png", "--background", folder / "dark.png"]
    words += ["--sensor", calibrated.sensor, "--sheet", "A", "-o", cloud_path, "--json"]
    assert main([str(word) for word in words]) == 0
    report = json.loads(capsys.readouterr().out)
    cloud = read_ply(cloud_path)
    assert "MeasureOptions.sheet" in cloud_path.with_suffix(".html").read_text("utf-8")
    assert report["n_points"] == len(cloud) > 200
    assert [Path(name).name for name in report["written"]] == ["cloud.ply", "cloud.html"]
    tilt_x, tilt_y, z = OBJECT_PLACE
    a, b = np.deg2rad(tilt_x), np.deg2rad(tilt_y)
    normal = np.array([np.sin(b) * np.cos(a), -np.sin(a), np.cos(b) * np.cos(a)])
    off_plane = (cloud.points_mm - [0.0, 0.0, z]) @ normal
    sigma = np.sqrt(np.einsum("i,nij,j->n", normal, cloud.covariance_mm2, normal))
    assert float(np.median(sigma)) < 0.5
    assert np.all(np.abs(off_plane) < SIGMAS * sigma)


@pytest.mark.parametrize("command", ["camera", "laser"])
def test_a_document_is_solved_again_from_its_own_files(
    calibrated: Bench, tmp_path: Path, command: str
) -> None:
    document = calibrated.camera if command == "camera" else calibrated.sensor
    again = tmp_path / "again.json"
    assert main(["calibrate", command, "--from", str(document), "-o", str(again)]) == 0
    before, after = (json.loads(path.read_text("utf-8")) for path in (document, again))
    assert after["provenance"]["parent_ids"] == [before["provenance"]["document_id"]]
    for content in (before, after):
        for key in ("provenance", "observations", "sha256"):
            del content[key]
    assert after == before
    npz = document.with_suffix(".npz").read_bytes()
    assert again.with_suffix(".npz").read_bytes() == npz


def test_a_document_without_its_own_observations_is_not_solved_again(
    calibrated: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moved = tmp_path / calibrated.sensor.name
    moved.write_bytes(calibrated.sensor.read_bytes())
    words = ["calibrate", "laser", "--from", str(moved), "-o", str(tmp_path / "again.json")]
    assert main(words) == 2
    moved.with_suffix(".npz").write_bytes(calibrated.camera.with_suffix(".npz").read_bytes())
    assert main(words) == 2
    assert "not the observations" in capsys.readouterr().err
    assert main([*words, "--target", "chessboard:7x5:10"]) == 2
    assert not (tmp_path / "again.json").exists()


@pytest.mark.parametrize("name", ["camera.html", "sensor.html"])
def test_pages_are_self_contained(calibrated: Bench, name: str) -> None:
    page = (calibrated.folder / name).read_text("utf-8")
    assert page.startswith("<!doctype html>")
    assert page.count("<svg") + page.count("<img") >= 6
    links = re.findall(r'(?:href|src)="([^"]{0,40})', page) + re.findall(r"url\(([^)]*)\)", page)
    assert links
    assert all(link.startswith("data:") for link in links)
    assert "http" not in re.sub(r"base64,[A-Za-z0-9+/=]+", "", page)
    assert "simulated" not in page


def test_json_is_the_whole_of_standard_output(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["calibrate", "camera", bench.camera_images, "--target", TARGET, "--json"]
    assert main([*words, "-o", str(tmp_path / "c.json"), "--leave-out", "view3.png"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    report = json.loads(out)
    assert report["kind"] == "camera calibration"
    assert report["n_views"] == 6
    (left_out,) = [view for view in report["views"] if not view["is_used"]]
    assert left_out["source"] == "view3.png"
    assert report["rms_px"] == pytest.approx(read_camera_calibration(tmp_path / "c.json").rms_px)


def test_xyz_says_what_it_loses(
    calibrated: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["reconstruct", calibrated.folder / "object/laser.png", "--sensor", calibrated.sensor]
    assert main([str(word) for word in (*words, "-o", tmp_path / "cloud.xyz")]) == 0
    assert "The XYZ file does not hold normals" in capsys.readouterr().out


def test_rendered_images_are_called_simulated(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = tmp_path / "set" / "camera"
    photos.mkdir(parents=True)
    for path in sorted((bench.folder / "camera").iterdir()):
        (photos / path.name).write_bytes(path.read_bytes())
    (tmp_path / "set" / "truth.json").write_text('{"simulated": true}')
    words = ["calibrate", "camera", str(photos), "--target", TARGET]
    assert main([*words, "-o", str(tmp_path / "camera.json")]) == 0
    assert "from simulated images" in capsys.readouterr().out
    assert "simulated data" in (tmp_path / "camera.html").read_text("utf-8")
    # wherever it is solved again, and whatever became of the images
    shutil.rmtree(tmp_path / "set")
    for before, after in (("camera.json", "again.json"), ("again.json", "once more.json")):
        words = ["calibrate", "camera", "--from", str(tmp_path / before)]
        assert main([*words, "-o", str(tmp_path / after)]) == 0
        assert "from simulated images" in capsys.readouterr().out
