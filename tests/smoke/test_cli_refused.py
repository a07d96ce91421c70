# SPDX-License-Identifier: Apache-2.0
"""Runs that end without a document show why; a document that was forced says so ever after."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from armscan.calibration.cameras import result
from armscan.cli.run import main
from armscan.storage.clouds import read_ply
from armscan.storage.documents import read_camera_calibration, read_sensor_calibration
from rigs.drawn_bench import TARGET, Bench

Fails = Callable[..., str]


def camera_words(bench: Bench, output: Path, target: str = TARGET) -> list[str]:
    words = ["calibrate", "camera", bench.camera_images, "--target", target, "-o", str(output)]
    return [*words, "--distortion", "none"]


def page_of(path: Path) -> str:
    """Text of a page without its pictures."""
    return re.sub(r"base64,[A-Za-z0-9+/=]+", "", path.read_text("utf-8"))


@pytest.mark.parametrize(("target", "n_tried"), [("circle-grid:9x7:6", 7), ("chessboard:9x7:6", 4)])
def test_a_target_that_is_nowhere_leaves_a_page_with_every_image_tried(
    bench: Bench, fails: Fails, tmp_path: Path, target: str, n_tried: int
) -> None:
    """A wrong kind is looked for in all seven images; a wrong count is told after four."""
    said = fails(*camera_words(bench, tmp_path / "c.json", target), "--no-cache")
    assert str(tmp_path / "c.refused.html") in said
    assert [path.name for path in tmp_path.iterdir()] == ["c.refused.html"]
    page = page_of(tmp_path / "c.refused.html")
    assert "(refused)" in page
    assert page.count("<svg") == n_tried
    assert "9 x 7" in page
    assert "none was written" in page


def test_a_refusal_leaves_an_earlier_document_and_goes_with_the_next(
    bench: Bench, fails: Fails, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "c.json"
    assert main([*camera_words(bench, output), "--no-cache"]) == 0
    capsys.readouterr()
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    fails(*camera_words(bench, output, "chessboard:9x7:6"), "--force", "--no-cache")
    left = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert left.pop("c.refused.html")
    assert left == before
    assert main([*camera_words(bench, output), "--force", "--no-cache"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == before.keys()


def test_one_board_shows_board_and_stripe_on_the_page(
    calibrated: Bench, fails: Fails, tmp_path: Path
) -> None:
    words = ["calibrate", "laser", "--camera", calibrated.camera, "--target", TARGET]
    words += ["--on", calibrated.folder / "on" / "place0.png", "-o", tmp_path / "s.json"]
    said = fails(*words)
    assert "s.refused.html" in said
    page = page_of(tmp_path / "s.refused.html")
    assert re.search(r"board found; \d{2,} clean stripe points", page)
    assert "target point" in page
    assert "stripe point" in page


def test_a_forced_camera_marks_all_that_rests_on_it(
    calibrated: Bench,
    fails: Fails,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Camera, sheet, cloud, inspection, conversion and what `info` says of them."""
    monkeypatch.setattr(result, "LARGEST_FOCAL_SIGMA", 1e-9)
    camera, sensor, cloud = (tmp_path / name for name in ("c.json", "s.json", "p.ply"))
    assert "--force-bad" in fails(*camera_words(calibrated, camera), writes=tmp_path)
    assert "focal length is known to" in page_of(tmp_path / "c.refused.html")
    assert main([*camera_words(calibrated, camera), "--force-bad"]) == 0
    assert "FORCED: The camera's focal length" in capsys.readouterr().out
    (reason,) = read_camera_calibration(camera).provenance.forced
    monkeypatch.undo()
    words = ["calibrate", "laser", "--camera", camera, "--on", calibrated.on, "--off"]
    words += [calibrated.off, "--target", TARGET, "-o", sensor, "--json"]
    assert main([str(word) for word in words]) == 0
    assert json.loads(capsys.readouterr().out)["forced"] == [reason]
    assert read_sensor_calibration(sensor).provenance.forced == (reason,)
    images = calibrated.folder / "object"
    words = ["reconstruct", images / "laser.png", "--background", images / "dark.png"]
    words += ["--sensor", sensor, "--sheet", "A", "-o", cloud]
    assert main([str(word) for word in words]) == 0
    assert read_ply(cloud).forced == (reason,)
    assert main(["convert", str(cloud), str(tmp_path / "p.xyz")]) == 0
    assert f"# forced: {reason}" in (tmp_path / "p.xyz").read_text()
    assert main(["convert", str(sensor), str(tmp_path / "ros.yaml")]) == 0
    assert f"# forced: {reason}" in (tmp_path / "ros.yaml").read_text()
    capsys.readouterr()
    assert main(["info", str(camera), str(sensor), str(cloud), "--json"]) == 0
    items = json.loads(capsys.readouterr().out)["items"]
    assert [item["forced"] for item in items] == [[reason]] * 3
    for page in ("c.html", "s.html", "p.html"):
        assert "(forced)" in page_of(tmp_path / page)
    content = json.loads(sensor.read_text())
    assert content["camera_provenance"]["forced"] == content["provenance"]["forced"] == [reason]


def test_documents_that_were_not_refused_bear_no_mark(calibrated: Bench) -> None:
    assert "forced" not in calibrated.camera.read_text()
    assert "(forced)" not in page_of(calibrated.camera.with_suffix(".html"))


def test_images_of_another_size_may_be_left_out(
    calibrated: Bench, fails: Fails, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A telephone's upright photographs among the others: all are named, and leaving them out
    is enough.
    """
    folder = tmp_path / "photographs"
    shutil.copytree(calibrated.folder / "camera", folder)
    for name in ("view1.png", "view3.png"):
        turned = cv2.rotate(cv2.imread(str(folder / name)), cv2.ROTATE_90_CLOCKWISE)
        cv2.imwrite(str(folder / name), turned)
    words = ["calibrate", "camera", str(folder), "--target", TARGET]
    words += ["-o", str(tmp_path / "c.json"), "--json"]
    said = fails(*words, writes=tmp_path)
    assert "view1.png" in said
    assert "view3.png" in said
    assert "view1.png" not in fails(*words, "--leave-out", "view1.png", writes=tmp_path)
    assert main([*words, "--leave-out", "view[13].png"]) == 0
    told = json.loads(capsys.readouterr().out)
    views = told["views"]
    assert not {"view1.png", "view3.png"} & {view["source"] for view in views}
    assert [one["source"] for one in told["not_found"]] == ["view1.png", "view3.png"]
    assert len(views) > 3


def test_images_are_left_out_by_pattern(
    calibrated: Bench, fails: Fails, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*camera_words(calibrated, tmp_path / "c.json"), "--json"]
    assert main([*words, "--leave-out", "view[12].png", "--leave-out", "view6.png"]) == 0
    views = json.loads(capsys.readouterr().out)["views"]
    out = {view["source"] for view in views if not view["is_used"]}
    assert out == {"view1.png", "view2.png", "view6.png"}
    said = fails(*words, "--force", "--leave-out", "nosuch*", writes=tmp_path)
    assert "nosuch" in said
    assert "view0.png" in said


def test_boards_of_a_laser_calibration_are_left_out_with_their_partners(
    calibrated: Bench, fails: Fails, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["calibrate", "laser", "--camera", calibrated.camera, "--on", calibrated.on]
    words += ["--off", calibrated.off, "--target", TARGET, "-o", tmp_path / "s.json", "--json"]
    typed = [str(word) for word in [*words, "--plane-only"]]
    assert main([*typed, "--leave-out", "off/place1.png"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["sheets"][0]["n_boards"] == 2
    assert [item["source"] for item in found["skipped"]] == ["on/place1.png"]
    assert "by request" in found["skipped"][0]["reason"]
    assert "nosuch" in fails(*typed, "--force", "--leave-out", "nosuch", writes=tmp_path)


def scan_of(bench: Bench, folder: Path, cameras: int = 1) -> Path:
    """The camera's photographs as a recording."""
    (folder / "images").mkdir(parents=True)
    lines = ["index,t_ns,camera,file,lasers"]
    for k, path in enumerate(sorted((bench.folder / "camera").iterdir())):
        shutil.copy(path, folder / "images" / path.name)
        lines.append(f"{k},{1000 * k},{k % cameras},images/{path.name},")
    (folder / "exposures.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_a_camera_is_calibrated_from_a_recording(
    calibrated: Bench, fails: Fails, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = scan_of(calibrated, tmp_path / "scan")
    words = ["calibrate", "camera", "--scan", str(scan), "--target", TARGET, "--distortion", "none"]
    words += ["-o", str(tmp_path / "c.json")]
    assert main(words) == 0
    found = read_camera_calibration(tmp_path / "c.json")
    of_images = read_camera_calibration(calibrated.camera)
    assert found.camera.parameters.tolist() == of_images.camera.parameters.tolist()
    inputs = [Path(item.path).name for item in found.provenance.inputs]
    assert inputs[-1] == "exposures.csv"
    assert len(inputs) == 8
    capsys.readouterr()
    assert "a recording and images" in fails(*words, "--force", "x.png", writes=tmp_path)
    assert "no images are given" in fails(*words[:2], *words[4:], "--force", writes=tmp_path)
    pair = scan_of(calibrated, tmp_path / "pair", cameras=2)
    words[3] = str(pair)
    assert "calibrate stereo --scan" in fails(*words, "--force", writes=tmp_path)


def test_a_second_run_finds_no_point_again(
    calibrated: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from armscan.pipeline import targets as cached_detection

    words = camera_words(calibrated, tmp_path / "c.json")
    assert main(words) == 0
    monkeypatch.setattr(cached_detection, "detect_target", None)
    assert main([*words, "--force", "--fix", "aspect"]) == 0
    assert (
        main([*camera_words(calibrated, tmp_path / "other.json"), "--leave-out", "view1.png"]) == 0
    )
    one, two = (read_camera_calibration(tmp_path / f"{name}.json") for name in ("c", "other"))
    assert one.camera.fx_px == one.camera.fy_px
    assert two.n_views == one.n_views - 1
