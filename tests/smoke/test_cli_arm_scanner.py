# SPDX-License-Identifier: Apache-2.0
"""Hand-eye and scans on the command line: a drawn bench on an arm, and input that is wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armscan.calibration.hand_eye.probed_plate import ProbingOptions
from armscan.cli.run import main
from armscan.jobs.job import Job
from armscan.jobs.probe import probe
from armscan.records.points import ProbedPoints
from armscan.storage.clouds import read_ply
from armscan.storage.documents import read_scanner_calibration
from armscan.storage.points import probed_points_csv
from rigs.drawn_arm import PLANE, PLATE, PLATE_D_MM, ROTATION, TRANSLATION_MM, draw_postures
from rigs.drawn_bench import Bench

Fails = Callable[..., str]
SIGMAS = 5.0


@pytest.fixture(scope="session")
def scan(calibrated: Bench) -> Path:
    folder = calibrated.folder / "scan"
    draw_postures(folder)
    return folder


@pytest.fixture(scope="session")
def scanner(calibrated: Bench, scan: Path) -> Path:
    output = calibrated.folder / "scanner.json"
    assert main([str(word) for word in hand_eye_words(calibrated, scan, output)]) == 0
    return output


def hand_eye_words(bench: Bench, scan: Path, output: Path) -> list[object]:
    words: list[object] = ["calibrate", "hand-eye", scan, "--sensor", bench.sensor]
    return [*words, "--plane", PLANE, "-o", output]


def test_hand_eye_is_found(scanner: Path) -> None:
    found = read_scanner_calibration(scanner)
    sigma = np.sqrt(np.diag(found.covariance)[-3:])
    error = found.hand_eye.tool_from_sensor.translation_mm - TRANSLATION_MM
    assert np.all(np.abs(error) < SIGMAS * sigma)
    assert np.all(sigma < 1.0)
    cosine = 0.5 * (np.trace(found.hand_eye.tool_from_sensor.rotation @ ROTATION.T) - 1.0)
    assert np.degrees(np.arccos(min(1.0, cosine))) < 0.5
    assert found.hand_eye.n_postures == 8
    assert scanner.with_suffix(".html").stat().st_size > 100_000


def test_a_scan_is_placed_on_the_plate(
    scan: Path, scanner: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud_path = tmp_path / "cloud.ply"
    words = ["reconstruct", scan, "--scanner", scanner, "-o", cloud_path, "--json"]
    assert main([str(word) for word in words]) == 0
    data = json.loads(capsys.readouterr().out)
    cloud = read_ply(cloud_path)
    assert (data["frame"], data["n_points"]) == ("Base", len(cloud))
    assert data["exposures"]["placed"] == 8
    height = cloud.points_mm @ PLATE + PLATE_D_MM
    sigma = np.sqrt(np.einsum("i,nij,j->n", PLATE, cloud.covariance_mm2, PLATE))
    assert np.median(np.abs(height) / sigma) < 2.0
    assert np.median(sigma) < 0.5
    assert cloud.normals is not None
    words += ["--force", "--volume", "-5,5,-5,5,0,100"]
    assert main([str(word) for word in words]) == 0
    inside = read_ply(cloud_path)
    assert 0 < len(inside) < len(cloud)
    assert np.abs(inside.points_mm[:, :2]).max() <= 5.0


def test_a_recording_with_a_sensor_only_stays_in_the_sensor(
    calibrated: Bench, scan: Path, tmp_path: Path
) -> None:
    cloud = tmp_path / "cloud.ply"
    words = ["reconstruct", scan, "--sensor", calibrated.sensor, "-o", cloud]
    assert main([str(word) for word in words]) == 0
    assert read_ply(cloud).frame == "Sensor"
    assert len(read_ply(cloud).exposure_sources) == 8


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"--plane": None}, "the reference is not given"),
        ({"--sphere-diameter": "50"}, "more than one reference"),
        ({"--sensor": None}, "needs the sensor's calibration"),
        ({"--plane": "0,0,0,1"}, "normal A,B,C is zero"),
        ({"--plane": "1,2"}, "4 are needed"),
        ({"--profiles": "p*.csv"}, "do not mix"),
        ({"--arm-rotation-deg": "20"}, "below 0.1 rad (5.7 degrees)"),
        ({"--euler": "zyx"}, "no rotation convention"),
        ({"--plane": None, "--plate": "absent.csv"}, "no such file"),
        ({"--sensor": "absent.json"}, "no such file"),
    ],
)
def test_wrong_hand_eye_options(
    calibrated: Bench,
    scan: Path,
    changes: dict[str, str | None],
    said: str,
    fails: Fails,
    tmp_path: Path,
) -> None:
    options = {"--sensor": str(calibrated.sensor), "--plane": PLANE} | changes
    given = [word for key, value in options.items() if value is not None for word in (key, value)]
    words = ["calibrate", "hand-eye", scan, *given, "-o", tmp_path / "scanner.json"]
    assert said in fails(*words, writes=tmp_path)


def test_a_file_that_is_no_plate(
    calibrated: Bench, scan: Path, fails: Fails, tmp_path: Path
) -> None:
    words = ["calibrate", "hand-eye", scan, "--sensor", calibrated.sensor, "--plate"]
    output = ["-o", tmp_path / "scanner.json"]
    assert "x_mm" in fails(*words, scan / "exposures.csv", *output)
    few = tmp_path / "two.csv"
    few.write_text("x_mm,y_mm,z_mm\n0,0,0\n100,0,0\n")
    assert "three points" in fails(*words, few, *output)


def test_a_plate_elsewhere_is_noticed(
    calibrated: Bench, scan: Path, fails: Fails, tmp_path: Path
) -> None:
    words = ["calibrate", "hand-eye", scan, "--sensor", calibrated.sensor]
    said = fails(*words, "--plane", "0.5,0,0.8,30", "-o", tmp_path / "s.json", writes=tmp_path)
    assert "plate" in said


def test_a_tip_compensated_to_the_wrong_side_is_told_by_its_diameter(
    calibrated: Bench, scan: Path, fails: Fails, tmp_path: Path
) -> None:
    """The way that the pages describe: probe writes plate.csv, the hand-eye reads it."""
    x, y = np.meshgrid([-60.0, 0.0, 60.0], [-50.0, 0.0, 50.0])
    flat = np.column_stack([x.ravel(), y.ravel(), np.zeros(9)])
    flat[:, 2] = -(flat @ PLATE + PLATE_D_MM) / PLATE[2]
    centres, wrong = tmp_path / "centres.csv", tmp_path / "wrong.csv"
    centres.write_bytes(
        probed_points_csv(ProbedPoints(points_mm=flat + 3.0 * PLATE, tip_diameter_mm=6.0))
    )
    probe(Job(wrong), centres, options=ProbingOptions(side="-z"))
    words = ["calibrate", "hand-eye", scan, "--sensor", calibrated.sensor, "--plate", wrong]
    said = fails(*words, "-o", tmp_path / "s.json")
    assert "that is the tip's diameter (6 mm)" in said
    assert "armscan probe --side" in said


def without(scan: Path, folder: Path, *names: str) -> Path:
    """The recording with some of its tables missing."""
    copy = folder / "copy"
    (copy / "images").mkdir(parents=True)
    for path in (*scan.iterdir(), *(scan / "images").iterdir()):
        if path.is_file() and path.name not in names:
            (copy / path.relative_to(scan)).write_bytes(path.read_bytes())
    return copy


def test_a_recording_without_arm(
    calibrated: Bench, scan: Path, scanner: Path, fails: Fails, tmp_path: Path
) -> None:
    copy = without(scan, tmp_path, "arm.csv")
    words = hand_eye_words(calibrated, copy, tmp_path / "s.json")
    assert "arm" in fails(*words, writes=tmp_path)
    said = fails("reconstruct", copy, "--scanner", scanner, "-o", tmp_path / "c.ply")
    assert "arm" in said


def test_a_folder_without_exposures(
    calibrated: Bench, scan: Path, fails: Fails, tmp_path: Path
) -> None:
    copy = without(scan, tmp_path, "exposures.csv")
    words = hand_eye_words(calibrated, copy, tmp_path / "s.json")
    assert "holds no exposures.csv" in fails(*words, writes=tmp_path)


def test_an_arm_that_lost_its_poses(
    scan: Path, scanner: Path, fails: Fails, tmp_path: Path
) -> None:
    copy = without(scan, tmp_path)
    header, *rows = (copy / "arm.csv").read_text().splitlines()
    gaps = [row.split(",")[0] + "," * 12 for row in rows]
    (copy / "arm.csv").write_text("\n".join([header, *gaps]) + "\n")
    said = fails("reconstruct", copy, "--scanner", scanner, "-o", tmp_path / "c.ply")
    assert "pose" in said


@pytest.mark.parametrize("option", ["--volume", "--arm"])
def test_options_of_recordings_need_one(
    calibrated: Bench, option: str, fails: Fails, tmp_path: Path
) -> None:
    image = calibrated.folder / "object" / "laser.png"
    words = ["reconstruct", image, "--sensor", calibrated.sensor, "-o", tmp_path / "c.ply"]
    value = "0,1,0,1,0,1" if option == "--volume" else "arm.toml"
    assert "no recording of an arm" in fails(*words, option, value, writes=tmp_path)


def test_a_wrong_volume(scan: Path, scanner: Path, fails: Fails, tmp_path: Path) -> None:
    words = ["reconstruct", scan, "--scanner", scanner, "-o", tmp_path / "c.ply"]
    assert "6 are needed" in fails(*words, "--volume", "1,2,3", writes=tmp_path)
    assert "not below" in fails(*words, "--volume", "2,1,0,1,0,1", writes=tmp_path)


def test_profiles_and_poses_belong_together(fails: Fails, tmp_path: Path) -> None:
    words = ["calibrate", "hand-eye", "--profiles", "p*.csv", "--sphere-diameter", "50"]
    assert "give --profiles and --poses" in fails(*words, "-o", tmp_path / "s.json")
    assert "nothing to calibrate" in fails("calibrate", "hand-eye", "-o", tmp_path / "s.json")
