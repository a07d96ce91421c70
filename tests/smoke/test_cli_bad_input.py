# SPDX-License-Identifier: Apache-2.0
"""Bad input: every command says in one sentence what is wrong, and leaves nothing behind."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.cli import main
from rigs.drawn_bench import TARGET, Bench

Fails = Callable[..., str]


def camera_words(images: object, output: Path, target: str = TARGET) -> list[object]:
    return ["calibrate", "camera", images, "--target", target, "-o", output]


def laser_words(
    bench: Bench, output: Path, *, on: object = "", camera: Path | None = None
) -> list[object]:
    words: list[object] = ["calibrate", "laser", "--camera", camera or bench.camera]
    return [*words, "--on", on or bench.on, "--target", TARGET, "-o", output]


def cloud_words(
    bench: Bench, output: Path, *, images: object = "", sensor: Path | None = None
) -> list[object]:
    found = images or bench.folder / "object" / "laser.png"
    return ["reconstruct", found, "--sensor", sensor or bench.sensor, "-o", output]


def words_of(command: str, bench: Bench, folder: Path, images: object) -> list[object]:
    """The command with its images replaced."""
    if command == "camera":
        return camera_words(images, folder / "out.json")
    if command == "laser":
        return laser_words(bench, folder / "out.json", on=images)
    return cloud_words(bench, folder / "out.ply", images=images)


COMMANDS = pytest.mark.parametrize("command", ["camera", "laser", "reconstruct"])


@COMMANDS
@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty", None, "the folder holds no image"),
        ("absent/*.png", None, "no file matches the pattern"),
        ("absent.png", None, "there is no such file"),
        ("zero.png", b"", "the file is empty"),
        ("text.png", b"this is no image", "not a PNG, BMP, JPEG, TIFF or PGM image"),
    ],
)
def test_images_that_are_none(
    command: str,
    name: str,
    content: bytes | None,
    message: str,
    calibrated: Bench,
    fails: Fails,
    tmp_path: Path,
) -> None:
    (tmp_path / "empty").mkdir()
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert message in fails(
        *words_of(command, calibrated, tmp_path, tmp_path / name), writes=tmp_path
    )


@COMMANDS
def test_truncated_image(command: str, calibrated: Bench, fails: Fails, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    source = calibrated.folder / ("camera" if command == "camera" else "on")
    for path in sorted(source.iterdir()):
        (folder / path.name).write_bytes(path.read_bytes())
    last = sorted(folder.iterdir())[-1]
    last.write_bytes(last.read_bytes()[:5000])
    said = fails(*words_of(command, calibrated, tmp_path, folder), writes=tmp_path)
    assert last.name in said
    assert "cut short" in said


@COMMANDS
def test_images_of_different_size(
    command: str, calibrated: Bench, fails: Fails, tmp_path: Path
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    source = calibrated.folder / ("camera" if command == "camera" else "on")
    for path in sorted(source.iterdir()):
        (folder / path.name).write_bytes(path.read_bytes())
    odd = sorted(folder.iterdir())[1]
    cv2.imwrite(str(odd), cv2.imread(str(odd), 0)[:200])
    said = fails(*words_of(command, calibrated, tmp_path, folder), writes=tmp_path)
    assert odd.name in said
    assert "480 x 200" in said
    assert "480 x 360" in said


@pytest.mark.parametrize(
    "target", ["", "chessboard", "chessboard:8x6", "chess:8x6:6", "chessboard:8x6:-6", "8x6"]
)
def test_wrong_target_specification(
    bench: Bench, target: str, fails: Fails, tmp_path: Path
) -> None:
    said = fails(*camera_words(bench.camera_images, tmp_path / "c.json", target), writes=tmp_path)
    assert "chessboard:11x6:13" in said or "chessboard:" in said


def test_wrong_target_size_says_what_was_looked_for(
    bench: Bench, fails: Fails, tmp_path: Path
) -> None:
    images = f"{bench.folder}/camera/view[0-2].png"
    words = camera_words(images, tmp_path / "c.json", "chessboard:9x7:6")
    said = fails(*words, writes=tmp_path)
    assert "9 x 7" in said or "9x7" in said
    assert "check columns, rows" in said


def test_too_few_images(bench: Bench, fails: Fails, tmp_path: Path) -> None:
    images = bench.folder / "camera" / "view0.png"
    said = fails(*camera_words(images, tmp_path / "c.json"), writes=tmp_path)
    assert "needs at least 3" in said


def test_the_same_image_again_and_again(bench: Bench, fails: Fails, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    content = (bench.folder / "camera" / "view0.png").read_bytes()
    for k in range(5):
        (folder / f"{k}.png").write_bytes(content)
    said = fails(*camera_words(folder, tmp_path / "c.json"), writes=tmp_path)
    assert "tilt" in said


def test_one_board_makes_no_sheet(calibrated: Bench, fails: Fails, tmp_path: Path) -> None:
    on = calibrated.folder / "on" / "place0.png"
    said = fails(*laser_words(calibrated, tmp_path / "s.json", on=on), writes=tmp_path)
    assert "board" in said


def test_more_images_with_laser_than_without(
    calibrated: Bench, fails: Fails, tmp_path: Path
) -> None:
    words = laser_words(calibrated, tmp_path / "s.json")
    said = fails(*words, "--off", calibrated.folder / "off" / "place0.png", writes=tmp_path)
    assert "3 images with laser" in said


def test_images_with_and_without_laser_swapped(
    calibrated: Bench, fails: Fails, tmp_path: Path
) -> None:
    words = laser_words(calibrated, tmp_path / "s.json", on=calibrated.off)
    said = fails(*words, "--off", calibrated.on, writes=tmp_path)
    assert "swap the images with and without laser" in said


def test_no_laser_in_the_image(calibrated: Bench, fails: Fails, tmp_path: Path) -> None:
    black = tmp_path / "black.png"
    cv2.imwrite(str(black), np.zeros((360, 480), np.uint8))
    said = fails(*cloud_words(calibrated, tmp_path / "c.ply", images=black), writes=tmp_path)
    assert "no stripe was found" in said


def test_swapped_documents(calibrated: Bench, fails: Fails, tmp_path: Path) -> None:
    said = fails(*laser_words(calibrated, tmp_path / "s.json", camera=calibrated.sensor))
    assert "this is a sensor calibration, and a camera calibration is needed" in said
    said = fails(*cloud_words(calibrated, tmp_path / "c.ply", sensor=calibrated.camera))
    assert "this is a camera calibration, and a sensor calibration is needed" in said
    image = calibrated.folder / "object" / "laser.png"
    said = fails(*cloud_words(calibrated, tmp_path / "c.ply", sensor=image))
    assert "JSON" in said
    said = fails(*laser_words(calibrated, tmp_path / "s.json", camera=image), writes=tmp_path)
    assert "not a camera calibration" in said


def test_documents_with_nan(calibrated: Bench, fails: Fails, tmp_path: Path) -> None:
    content = json.loads(calibrated.camera.read_text("utf-8"))
    content["camera"]["intrinsics"]["fx_px"] = math.nan
    camera = tmp_path / "nan.json"
    camera.write_text(json.dumps(content))
    assert "holds NaN" in fails(*laser_words(calibrated, tmp_path / "s.json", camera=camera))
    content = json.loads(calibrated.sensor.read_text("utf-8"))
    content["sheets"][0]["origin_sensor_mm"][2] = math.inf
    camera.write_text(json.dumps(content))
    assert "holds Infinity" in fails(*cloud_words(calibrated, tmp_path / "c.ply", sensor=camera))
    assert "holds Infinity" in fails("info", camera)


def test_unknown_sheet(calibrated: Bench, fails: Fails, tmp_path: Path) -> None:
    said = fails(*cloud_words(calibrated, tmp_path / "c.ply"), "--sheet", "Z", writes=tmp_path)
    assert "Z" in said


@COMMANDS
def test_no_folder_to_write_to(
    command: str, calibrated: Bench, fails: Fails, tmp_path: Path
) -> None:
    images = calibrated.camera_images if command == "camera" else calibrated.on
    words = words_of(command, calibrated, tmp_path / "absent", images)
    assert "there is no such folder" in fails(*words, writes=tmp_path)


@COMMANDS
def test_results_are_not_replaced_unasked(
    command: str, calibrated: Bench, fails: Fails, tmp_path: Path
) -> None:
    images = calibrated.camera_images if command == "camera" else calibrated.on
    (tmp_path / "out.html").write_text("old")
    words = words_of(command, calibrated, tmp_path, images)
    assert "the file exists" in fails(*words, writes=tmp_path)


@pytest.mark.parametrize("name", ["camera", "camera.txt", "camera.html"])
def test_output_of_another_kind(bench: Bench, name: str, fails: Fails, tmp_path: Path) -> None:
    assert "end it in .json" in fails(*camera_words(bench.camera_images, tmp_path / name))


@pytest.mark.skipif(
    os.name == "nt" or os.access("/", os.W_OK), reason="this user may write everywhere"
)
def test_folder_that_may_not_be_written(bench: Bench, fails: Fails, tmp_path: Path) -> None:
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o500)
    said = fails(*camera_words(bench.camera_images, folder / "c.json"))
    assert "may not be written" in said


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--fix", "everything", "choose aspect or centre"),
        ("--distortion", "rational", "distortion model"),
        ("--bits-used", "77", "bits used is 77"),
        ("--bits-used", "12", "8 bits a pixel"),
        ("--bits-align", "middle", "choose low or high"),
        ("--bits-align", "high", "count of bits used"),
        ("--leave-out", "absent.png", "absent.png"),
    ],
)
def test_wrong_options(
    bench: Bench, option: str, value: str, message: str, fails: Fails, tmp_path: Path
) -> None:
    words = camera_words(bench.camera_images, tmp_path / "c.json")
    assert message in fails(*words, option, value, writes=tmp_path)


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--stripe-method", "magic", "'magic' is not known"),
        ("--laser-colour", "pink", "'pink' is not known"),
        ("--depth-margin", "-1", "depth margin"),
        ("--depth-margin", "80", "depth margin 80; give 0 to 20 widths"),
    ],
)
def test_wrong_stripe_options(
    calibrated: Bench, option: str, value: str, message: str, fails: Fails, tmp_path: Path
) -> None:
    words = cloud_words(calibrated, tmp_path / "c.ply")
    assert message in fails(*words, option, value, writes=tmp_path)


def test_interrupt_leaves_no_result(
    bench: Bench,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    words = camera_words(bench.camera_images, tmp_path / "c.json")
    assert main([str(word) for word in words]) == 130
    assert "interrupted; no file is left half-written" in capsys.readouterr().err
    # the targets that were found before are whole, and the next run takes them
    assert [path.name for path in tmp_path.iterdir()] == ["armscan-cache"]
    assert not list(tmp_path.rglob("*.part"))


SLOW_DISK = (
    "import os, sys, time\n"
    "from armscan.cli import main\n"
    "os.fsync = lambda handle: (print('writing', flush=True), time.sleep(60))\n"
    "sys.exit(main(sys.argv[1:]))\n"
)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows ends a process without a signal")
def test_a_process_that_is_told_to_end_leaves_no_result(tmp_path: Path) -> None:
    (tmp_path / "cloud.xyz").write_text("1 2 3\n4 5 6\n7 8 9.5\n")
    words = [sys.executable, "-c", SLOW_DISK, "convert", "cloud.xyz", "cloud.ply"]
    with subprocess.Popen(
        words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline() == "writing\n"
        assert [path.suffix for path in sorted(tmp_path.iterdir())] == [".part", ".xyz"]
        process.terminate()
        assert process.wait(30) == 143
        assert process.stderr.read() == "ended; no file is left half-written\n"
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.xyz"]
