# SPDX-License-Identifier: Apache-2.0
"""Two cameras and recordings: what would be ignored or cannot be used is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.pipeline.cameras import pair_lists
from armscan.records.exposure import Exposure
from armscan.storage.documents import camera_document
from rigs.plain_scanner import plain_camera
from rigs.recording_folders import EXPOSURES, HEIGHT_PX, SESSION, WIDTH_PX, lab_folder
from rigs.stereo_rig import LEFT, held

Fails = Callable[..., str]
TARGET = ("--target", "chessboard:9x6:25")
SECOND_CAMERA = SESSION + SESSION[SESSION.index("[[camera]]") :]


def named(source: str) -> Exposure:
    return Exposure(np.zeros((4, 6), np.uint8), source)


def test_an_image_in_both_lists_is_refused_wherever_it_stands() -> None:
    left, right = [named("a.png"), named("b.png")], [named("b.png"), named("c.png")]
    with pytest.raises(InputError, match=r"b\.png: the same image is given for both cameras"):
        pair_lists(left, right)
    assert len(pair_lists(left, [named("c.png"), named("d.png")])) == 2


@pytest.mark.parametrize(
    ("left", "right", "said"),
    [
        ("left1 left2 left10", "right1 right2 right10 right11", "right11.png has no partner"),
        ("l1 l2 l3", "r2 r3", "in their names l1.png has no partner"),
        ("l1 l2 l3 l5", "r1 r3 r4", "l2.png, l5.png, r4.png have no partner"),
    ],
)
def test_of_lists_of_unlike_length_the_images_without_partner_are_named(
    left: str, right: str, said: str
) -> None:
    lists = [[named(f"{name}.png") for name in side.split()] for side in (left, right)]
    with pytest.raises(InputError, match=said.replace(".", r"\.")):
        pair_lists(*lists)


@pytest.mark.parametrize(
    ("left", "right"),
    [("a b", "c"), ("l1 l2", "r7"), ("cam1 cam1x1", "r1"), ("l1 l2 l3 l4 l5 l6", "r1")],
)
def test_names_that_do_not_tell_the_partner_name_none(left: str, right: str) -> None:
    lists = [[named(f"{name}.png") for name in side.split()] for side in (left, right)]
    with pytest.raises(InputError, match="left images") as refused:
        pair_lists(*lists)
    assert "no partner" not in str(refused.value)


def test_images_beside_a_recording_are_refused(tmp_path: Path, fails: Fails) -> None:
    scan, output = lab_folder(tmp_path), tmp_path / "stereo.json"
    words = ("calibrate", "stereo", *TARGET, "--scan", scan, "-o", output)
    assert "a recording and images are given" in fails(*words, "left", "right", writes=tmp_path)
    assert "a recording and images are given" in fails(*words, "left", writes=tmp_path)
    assert "bits_used and align under [[camera]]" in fails(*words, "--bits-used", 10)


def test_pixels_of_a_recording_are_described_by_it_alone(tmp_path: Path, fails: Fails) -> None:
    scan, camera = lab_folder(tmp_path), tmp_path / "camera.json"
    camera.write_bytes(camera_document(held(LEFT)))
    bits = ("--bits-used", 12, "--bits-align", "high")
    words = ("calibrate", "laser", "--camera", camera, "--scan", scan, *TARGET)
    said = fails(*words, *bits, "-o", tmp_path / "sensor.json", writes=tmp_path)
    assert "a recording says itself how its pixels are stored" in said
    other = ("reconstruct", scan, "--sensor", camera, *bits, "-o", tmp_path / "cloud.ply")
    assert "a recording says itself how its pixels are stored" in fails(*other, writes=tmp_path)


def test_a_single_camera_that_is_not_camera_0_is_said(tmp_path: Path, fails: Fails) -> None:
    rows = EXPOSURES.replace("000,0,", "000,1,")
    scan = lab_folder(tmp_path, exposures=rows, session=SECOND_CAMERA)
    camera = tmp_path / "camera.json"
    camera.write_bytes(camera_document(held(LEFT)))
    words = ("calibrate", "laser", "--camera", camera, "--scan", scan, *TARGET)
    said = fails(*words, "-o", tmp_path / "sensor.json", writes=tmp_path)
    assert "camera 0 has no rows, camera 1 has all" in said


def test_what_cameras_are_given_for_is_checked_without_them(tmp_path: Path, fails: Fails) -> None:
    words = ("calibrate", "stereo", "left", "right", *TARGET, "-o", tmp_path / "stereo.json")
    assert "intrinsics 'foo' is not known" in fails(*words, "--intrinsics", "foo", writes=tmp_path)
    fixed = fails(*words, "--intrinsics", "fixed", writes=tmp_path)
    assert "give --left and --right" in fixed
    prior = fails(*words, "--intrinsics", "prior", writes=tmp_path)
    assert "no calibration is given to count beside the images" in prior


def test_what_would_do_nothing_beside_given_cameras_is_refused(
    tmp_path: Path, fails: Fails
) -> None:
    """Free intrinsics take no calibrations, and calibrations say themselves what is solved."""
    camera = tmp_path / "camera.json"
    camera.write_bytes(camera_document(held(LEFT)))
    words = ["calibrate", "stereo", "left", "right", *TARGET, "--left", camera, "--right", camera]
    words += ["-o", tmp_path / "stereo.json"]
    free = fails(*words, "--intrinsics", "free", writes=tmp_path)
    assert "free intrinsics take none; leave --left and --right out" in free
    for use in ("prior", "fixed"):
        said = fails(*words, "--intrinsics", use, "--distortion", "k1", writes=tmp_path)
        assert "leave out --distortion" in said


@pytest.mark.parametrize("command", ["camera", "stereo", "laser"])
def test_the_page_of_a_refusal_tells_what_is_odd_in_the_recording(
    command: str, tmp_path: Path, fails: Fails
) -> None:
    """A cause of the refusal may be among it."""
    rows = {
        "camera": ["0,1000,0,images/0.png,", "1,2000,0,images/1.png,"],
        "stereo": ["0,1000,0,images/0.png,", "1,1000,1,images/1.png,"],
        "laser": ["0,1000,0,images/0.png,A"],
    }[command]
    header = "index,t_ns,camera,file,lasers,weather"
    exposures = "\n".join([header, *(f"{row},fair" for row in rows)]) + "\n"
    session = SECOND_CAMERA if command == "stereo" else SESSION
    scan = lab_folder(tmp_path, exposures=exposures, session=session, arm=None)
    camera = tmp_path / "camera.json"
    camera.write_bytes(camera_document(held(plain_camera(9.0, (3.5, 2.5), (WIDTH_PX, HEIGHT_PX)))))
    words = ["calibrate", command, "--scan", scan, *TARGET, "-o", tmp_path / "no.json"]
    fails(*words, *(("--camera", camera) if command == "laser" else ()))
    assert "weather" in (tmp_path / "no.refused.html").read_text()
