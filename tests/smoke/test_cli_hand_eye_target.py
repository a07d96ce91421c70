# SPDX-License-Identifier: Apache-2.0
"""Hand-eye before a target on the command line: recording, photographs with a table, bad input."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.cli.run import main
from armscan.storage.documents import read_camera_calibration, read_scanner_calibration
from rigs.drawn_arm import POSTURES, ROTATION, TRANSLATION_MM, base_from_tool, draw_postures
from rigs.drawn_bench import TARGET, Bench

Fails = Callable[..., str]
SIGMAS = 5.0


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("target") / "scan"
    draw_postures(folder, of_target=True)
    return folder


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    rows = [np.column_stack(base_from_tool(a, b, z, 0)) for a, b, z in POSTURES]
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(" ".join(map(repr, row.ravel().tolist())) for row in rows))
    return path


def repeat_exposures(scan: Path, folder: Path, n_postures: int) -> None:
    """Two looks from each of the first postures, without views; the arm's poses are 4 um apart."""
    (folder / "images").mkdir(parents=True)
    shutil.copy(scan / "session.toml", folder / "session.toml")
    header, *samples = (scan / "arm.csv").read_text().splitlines()
    exposures, track = ["index,t_ns,camera,file,lasers"], [header]
    for row in range(2 * n_postures):
        k, t_ns = row // 2, 10**9 * (row + 1)
        shutil.copy(scan / "images" / f"{k}.png", folder / "images" / f"{row}.png")
        exposures.append(f"{row},{t_ns},0,images/{row}.png,")
        _, x, *others = samples[2 * k].split(",")
        told = ",".join([repr(float(x) + 0.002 * (-1) ** row), *others])
        track += [f"{t_ns + shift},{told}" for shift in (-(10**7), 10**7)]
    (folder / "exposures.csv").write_text("\n".join(exposures) + "\n")
    (folder / "arm.csv").write_text("\n".join(track) + "\n")


def words_of(*words: object) -> list[str]:
    return ["calibrate", "hand-eye-target", "--target", TARGET, *map(str, words)]


def test_a_recording_makes_a_scanner(
    calibrated: Bench, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "scanner.json"
    words = words_of("--scan", scan, "--sensor", calibrated.sensor, "-o", output, "--json")
    assert main(words) == 0
    told = json.loads(capsys.readouterr().out)
    scanner = read_scanner_calibration(output)
    pose, sigma = scanner.hand_eye.tool_from_sensor, np.sqrt(np.diag(scanner.covariance)[-6:])
    off = pose.translation_mm - TRANSLATION_MM
    assert (np.abs(off) < SIGMAS * sigma[3:]).all()
    assert sigma[3:].max() < 2.0
    assert np.abs(pose.rotation - ROTATION).max() < SIGMAS * sigma[:3].max()
    assert scanner.sensor is not None
    assert told["method"] == "board"
    assert told["n_postures"] == len(POSTURES) == len(told["postures"])
    assert told["rms_px"] < 0.2
    assert told["target_scale_sigma"] < 0.02
    assert told["target_scale"] == pytest.approx(1.0, abs=5.0 * told["target_scale_sigma"])
    page = output.with_suffix(".html").read_text()
    assert "from 8 views of a target at rest" in page


def test_photographs_with_a_table_give_the_same_beside_the_camera_as_given(
    calibrated: Bench, scan: Path, poses: Path, tmp_path: Path
) -> None:
    """With the sensor, camera and hand-eye move together; without one, the camera stays."""
    both, alone = tmp_path / "both.json", tmp_path / "alone.json"
    images = scan / "images"
    assert main(words_of(images, "--poses", poses, "--sensor", calibrated.sensor, "-o", both)) == 0
    assert main(words_of(images, "--poses", poses, "--camera", calibrated.camera, "-o", alone)) == 0
    scanner, hand_eye = read_scanner_calibration(both), read_scanner_calibration(alone).hand_eye
    assert scanner.sensor is not None
    follow = scanner.hand_eye.dhand_eye_dsensor
    assert follow is not None
    given = read_camera_calibration(calibrated.camera).camera.parameters
    step = scanner.sensor.camera.camera.parameters - given
    assert np.abs(step).max() > 0.0
    back = scanner.hand_eye.tool_from_sensor.retract(-follow[:, : len(step)] @ step)
    np.testing.assert_allclose(back.matrix, hand_eye.tool_from_sensor.matrix, atol=1e-9)
    assert (np.diag(hand_eye.covariance) >= np.diag(scanner.covariance)[-6:] * 0.999).all()


def test_of_a_recording_what_shows_the_target_best_is_taken(
    calibrated: Bench, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exposures without laser before those with one; what has no pose, or another camera, is told.

    Those with a laser are black here: had one been taken, it would be among what was not used.
    """
    folder = tmp_path / "scan"
    shutil.copytree(scan, folder)
    black = cv2.imread(str(folder / "images" / "0.png"), cv2.IMREAD_GRAYSCALE) * 0
    for name in ("black0", "black1", "black2", "late"):
        cv2.imwrite(str(folder / "images" / f"{name}.png"), black)
    session, table = folder / "session.toml", folder / "exposures.csv"
    size = f"[[camera]]\nwidth_px = {black.shape[1]}\nheight_px = {black.shape[0]}\n"
    session.write_text(session.read_text() + size)
    header, *rows = (line.split(",") for line in table.read_text().splitlines())
    rows += [["", f"{10**9 * k + 5 * 10**6}", "0", f"images/black{k}.png", "A", ""] for k in (1, 2)]
    rows += [["", f"{10**9}", "1", "images/black0.png", "", ""]]
    rows += [["", f"{90 * 10**9}", "0", "images/late.png", "", ""]]
    rows.sort(key=lambda row: int(row[1]))
    lines = [",".join([str(k), *row[1:]]) for k, row in enumerate(rows)]
    table.write_text("\n".join([",".join(header), *lines]) + "\n")
    words = words_of("--scan", folder, "--camera", calibrated.camera, "-o", tmp_path / "out.json")
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["n_postures"] == len(POSTURES)
    assert "1 exposure of other cameras" in str(told["warnings"])
    assert "1 view was not used: images/late.png (the arm gave no pose for it)" in str(told)
    assert "black" not in str(told)


def test_looks_from_one_pose_are_one_posture(
    calibrated: Bench, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They share the arm's error: in a recording without views, and under one pose of a table."""
    folder, table = tmp_path / "scan", tmp_path / "poses.csv"
    repeat_exposures(scan, folder, 5)
    lines = (folder / "arm.csv").read_text().splitlines()[1::2]
    rows = np.array([line.split(",")[1:] for line in lines], dtype=float)
    poses = np.concatenate([rows[:, 3:].reshape(-1, 3, 3), rows[:, :3, None]], axis=2)
    np.savetxt(table, poses.reshape(-1, 12))
    sources = (["--scan", folder], [folder / "images", "--poses", table])
    notes = ("5 exposures were taken where the one before", "5 photographs with the pose of one")
    for source, note in zip(sources, notes, strict=True):
        words = words_of(*source, "--camera", calibrated.camera, "-o", tmp_path / "out.json")
        assert main([*words, "--json", "--force"]) == 0, capsys.readouterr().err
        told = json.loads(capsys.readouterr().out)
        assert told["n_postures"] == 5
        assert len(told["postures"]) == 10
        assert len({look["name"] for look in told["postures"]}) == 5
        assert note in str(told["warnings"])


def test_three_postures_are_too_few_however_often_they_are_looked_at_from(
    calibrated: Bench, scan: Path, tmp_path: Path, fails: Fails
) -> None:
    folder = tmp_path / "scan"
    repeat_exposures(scan, folder, 3)
    words = words_of("--scan", folder, "--camera", calibrated.camera)
    assert "3 postures with the target" in fails(*words, "-o", tmp_path / "no.json")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["IMAGES", "--camera", "CAMERA"], "photographs and poses belong together"),
        (["IMAGES", "--poses", "POSES"], "need one calibration of the camera"),
        (["--camera", "CAMERA"], "nothing to calibrate from"),
        (["--scan", "SCAN", "--camera", "CAMERA", "--bits-used", "12"], "a recording says itself"),
        (["IMAGES", "--poses", "POSES", "--scan", "SCAN", "--camera", "CAMERA"], "do not mix"),
        (["IMAGES/[0-5].png", "--poses", "POSES", "--camera", "CAMERA"], "6 photographs but 8"),
        (
            ["IMAGES", "--poses", "POSES", "--camera", "CAMERA", "--leave-out", "[0-4].png"],
            "3 postures with the target",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(
    calibrated: Bench, scan: Path, poses: Path, tmp_path: Path, fails: Fails,
    words: list[str], said: str,
) -> None:  # fmt: skip
    names = {"IMAGES": str(scan / "images"), "CAMERA": str(calibrated.camera)}
    names |= {"POSES": str(poses), "SCAN": str(scan)}
    output = tmp_path / "no.json"
    given = [word.replace("IMAGES", names["IMAGES"]) for word in words]
    assert said in fails(*words_of(*(names.get(word, word) for word in given), "-o", output))
    assert not output.exists()


def test_inverse_poses_are_refused_by_name(
    calibrated: Bench, scan: Path, poses: Path, tmp_path: Path, fails: Fails
) -> None:
    matrices = np.loadtxt(poses).reshape(-1, 3, 4)
    turned = matrices[:, :, :3].transpose(0, 2, 1)
    places = -np.einsum("nij,nj->ni", turned, matrices[:, :, 3])
    np.savetxt(poses, np.concatenate([turned, places[:, :, None]], axis=2).reshape(-1, 12))
    output = tmp_path / "no.json"
    words = words_of(scan / "images", "--poses", poses, "--camera", calibrated.camera)
    message = fails(*words, "-o", output)
    assert "taking the poses as tool_from_base" in message
    assert "no.refused.html shows what was found" in message
    assert (tmp_path / "no.refused.html").exists()
    assert not output.exists()


@pytest.mark.parametrize("n_each", [1, 2])
def test_a_table_in_the_order_of_a_plain_sort_is_told(
    calibrated: Bench, scan: Path, poses: Path, tmp_path: Path, fails: Fails, n_each: int
) -> None:
    images = tmp_path / "images"
    images.mkdir()
    n = len(POSTURES)
    names = [f"view{k}.png" for k in range(5, 5 + n)]
    files = [scan / "images" / f"{k // n_each}.png" for k in range(n)]
    for file, name in zip(files, names, strict=True):
        shutil.copy(file, images / name)
    rows = poses.read_text().split("\n")
    lines = {name: rows[k // n_each] for k, name in enumerate(names)}
    poses.write_text("\n".join(lines[name] for name in sorted(names)))
    words = words_of(images, "--poses", poses, "--camera", calibrated.camera)
    message = fails(*words, "-o", tmp_path / "no.json")
    assert "as a plain sort lists these (10 before 2) would leave 0." in message
    assert "in natural order (2 before 10): sort the table so" in message


@pytest.mark.parametrize("convention", ["rotation-vector", "intrinsic-zyx"])
def test_a_table_in_metres_and_radians_is_told_what_to_type(
    calibrated: Bench, scan: Path, poses: Path, tmp_path: Path, fails: Fails, convention: str
) -> None:
    """As Universal Robots' programs print it, without a header; what is told works then."""
    matrices = np.loadtxt(poses).reshape(-1, 3, 4)
    turns = Rotation.from_matrix(matrices[:, :, :3])
    angles = turns.as_rotvec() if convention == "rotation-vector" else turns.as_euler("ZYX")
    numbers = np.column_stack([matrices[:, :, 3] / 1000.0, angles])
    np.savetxt(poses, numbers, delimiter=",")
    words = words_of(scan / "images", "--poses", poses, "--camera", calibrated.camera)
    message = fails(*words, "-o", tmp_path / "no.json")
    header = "x_m,y_m,z_m,a_rad,b_rad,c_rad"
    assert f"put the header {header} above the table" in message
    told = re.search(r"give --euler ([a-z-]+)", message)
    assert told is not None
    np.savetxt(poses, numbers, delimiter=",", header=header, comments="")
    assert main([*words, "--euler", told[1], "-o", str(tmp_path / "yes.json")]) == 0
