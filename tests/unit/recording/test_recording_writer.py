# SPDX-License-Identifier: Apache-2.0
"""Recordings are written whole, and files that a camera wrote are not touched."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from armscan.errors import FileFormatError, InputError, OutputError
from armscan.records.recording import ArmTrack, CameraSetup
from armscan.storage.arm import ProbeTip, read_probe_tip, write_probing
from armscan.storage.recording import read_arm_track, read_recording, write_recording
from armscan.storage.tables import csv_bytes
from rigs.recording_folders import EXPOSURES, SESSION, lab_folder, memory_scan, pixels


def test_a_camera_file_is_copied_byte_by_byte(tmp_path: Path) -> None:
    """A JPEG that is decoded and encoded again has other pixels."""
    folder = lab_folder(tmp_path, exposures=EXPOSURES.replace("0.png", "a b.jpg"))
    cv2.imwrite(str(folder / "images/a b.jpg"), pixels(0))
    cv2.imwrite(str(folder / "images/1.png"), pixels(1), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    write_recording(tmp_path / "copy", read_recording(folder))
    for name in ("images/a b.jpg", "images/1.png", "images/2.png"):
        assert (tmp_path / "copy" / name).read_bytes() == (folder / name).read_bytes()


def test_a_bayer_recording_is_copied_as_one(tmp_path: Path) -> None:
    session = SESSION.replace('"mono"', '"bayer_rggb"')
    folder = lab_folder(tmp_path, session=session)
    scan = read_recording(folder)
    write_recording(tmp_path / "copy", scan)
    copy = read_recording(tmp_path / "copy")
    assert copy.session.cameras[0].colour == "bayer_rggb"
    np.testing.assert_array_equal(copy.exposure(1).image, scan.exposure(1).image)


def test_a_head_beside_the_tables_comes_along(tmp_path: Path) -> None:
    folder = lab_folder(tmp_path, session='head = "parts/head.toml"\n' + SESSION)
    (folder / "parts").mkdir()
    (folder / "parts/head.toml").write_bytes(b"name = 'x'")
    write_recording(tmp_path / "copy", read_recording(folder))
    assert (tmp_path / "copy/parts/head.toml").read_bytes() == b"name = 'x'"


def test_names_of_images_may_be_given(tmp_path: Path) -> None:
    write_recording(tmp_path / "a", memory_scan(2), names=["images/on/1.png", "images/off/1.png"])
    assert [row.source for row in read_recording(tmp_path / "a").rows] == [
        "images/on/1.png",
        "images/off/1.png",
    ]
    write_recording(tmp_path / "b", memory_scan(2))
    assert read_recording(tmp_path / "b").rows[1].source == "images/0001.png"
    with pytest.raises(InputError, match="one name"):
        write_recording(tmp_path / "c", memory_scan(2), names=["a.png", "a.png"])


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_an_interrupt_or_a_full_disk_leaves_nothing(
    tmp_path: Path, error: type[BaseException] | BaseException
) -> None:
    def stop(done: int, total: int, item: str) -> None:
        if done == 2:
            raise error

    folder = tmp_path / "scan"
    folder.mkdir()
    expected = KeyboardInterrupt if error is KeyboardInterrupt else OutputError
    with pytest.raises(expected):
        write_recording(folder, memory_scan(3), stop)
    assert [path.name for path in tmp_path.iterdir()] == ["scan"]
    assert list(folder.iterdir()) == []
    write_recording(folder, memory_scan(3))
    assert len(read_recording(folder).rows) == 3


def test_nothing_that_exists_is_replaced(tmp_path: Path) -> None:
    folder = lab_folder(tmp_path)
    with pytest.raises(OutputError, match="not empty"):
        write_recording(folder, memory_scan())
    with pytest.raises(OutputError, match="not empty"):
        write_recording(folder / "session.toml", memory_scan())
    with pytest.raises(OutputError, match="no such folder"):
        write_recording(tmp_path / "none" / "scan", memory_scan())


def test_exposures_that_contradict_their_session_are_refused(tmp_path: Path) -> None:
    """The session says grey, the exposures are coloured."""
    scan = memory_scan()
    coloured = replace(scan, images=tuple(pixels(k, (6, 8, 3)) for k in range(3)))
    with pytest.raises(InputError, match="its camera"):
        write_recording(tmp_path / "scan", coloured)
    assert list(tmp_path.iterdir()) == []


def test_joints_are_written_only_where_they_are_known(tmp_path: Path) -> None:
    track = ArmTrack(
        t_ns=np.arange(3),
        rotations=np.tile(np.eye(3), (3, 1, 1)),
        translations_mm=np.ones((3, 3)),
        is_known=np.ones(3, bool),
    )
    scan = memory_scan(arm=track)
    wrong = replace(scan, session=replace(scan.session, pose_form="joints"))
    with pytest.raises(InputError, match="no joint angles"):
        write_recording(tmp_path / "scan", wrong)


def test_a_cell_with_a_line_break_is_refused() -> None:
    with pytest.raises(InputError, match="column view"):
        csv_bytes({"view": ("a\nb",)})


def test_touches_of_a_probe_come_back(tmp_path: Path) -> None:
    track = ArmTrack(
        t_ns=np.array([5, 7, 9]),
        rotations=np.tile(np.eye(3), (3, 1, 1)),
        translations_mm=np.array([[1.0, 2, 1 / 3], [400, 5, 6], [7, 8, 9]]),
        is_known=np.array([True, False, True]),
    )
    tip = ProbeTip(np.array([0.1, -0.2, 61 / 3]), 5.9987)
    write_probing(tmp_path / "touches", track, tip, is_simulated=True)
    assert "\n7,,,,,,,\n" in (tmp_path / "touches/arm.csv").read_text()
    found, notes = read_arm_track(tmp_path / "touches")
    np.testing.assert_array_equal(found.translations_mm[[0, 2]], track.translations_mm[[0, 2]])
    assert found.is_known.tolist() == [True, False, True]
    assert len(notes) == 1 and "1 of 3 samples" in notes[0]
    read = read_probe_tip(tmp_path / "touches/probe.toml")
    np.testing.assert_array_equal(read.centre_tool_mm, tip.centre_tool_mm)
    assert read.diameter_mm == tip.diameter_mm


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("centre_tool_mm = [1.0, 2.0]\ntip_diameter_mm = 6.0", "centre_tool_mm"),
        ("centre_tool_mm = [1.0, 2.0, 3.0]\n", "tip_diameter_mm"),
        ("centre_tool_mm = [1.0, 2.0, 3.0]\ntip_diameter_mm = 0.0", "tip_diameter_mm"),
        ("centre_tool_mm = [1.0, 2.0, 3.0]\ntip_diameter_mm = '6'", "tip_diameter_mm"),
        ("centre = 1", "centre"),
        ("centre", "no TOML"),
    ],
)
def test_a_bad_probe_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "probe.toml"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        read_probe_tip(path)
    assert said in str(caught.value)


def test_the_size_of_a_camera_may_be_unknown(tmp_path: Path) -> None:
    scan = memory_scan()
    write_recording(
        tmp_path / "scan", replace(scan, session=replace(scan.session, cameras=(CameraSetup(),)))
    )
    setup = read_recording(tmp_path / "scan").session.cameras[0]
    assert (setup.width_px, setup.height_px) == (8, 6)
