# SPDX-License-Identifier: Apache-2.0
"""A recording that is played, against the same recording read."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armscan.devices.protocols import ArmSample, Frame, LaserEvent
from armscan.devices.registry import open_device
from armscan.errors import DeviceError, OptionError
from armscan.storage.recording import read_recording
from armscan.storage.recordings.read_mcap import record_folder
from rigs.recording_folders import lab_folder

# three exposures in 40 ms, samples before, between and after
TIMES = (1_000_000_000, 1_020_000_000, 1_040_000_000)
EXPOSURES = "index,t_ns,camera,file,lasers,trigger_id\n" + "".join(
    f"{k},{t},0,images/{k}.png,{'A' if k else 'A+B'},{k + 5}\n" for k, t in enumerate(TIMES)
)
ARM = "t_ns,x_mm,y_mm,z_mm,qw,qx,qy,qz,trigger_id\n" + "".join(
    f"{990_000_000 + 10_000_000 * k},{900 + k},0,400,1,0,0,0,{k // 2 + 5 if k % 2 else ''}\n"
    for k in range(7)
).replace("994,0,400,1,0,0,0", ",,,,,,", 1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return lab_folder(tmp_path / "scan", exposures=EXPOSURES, arm=ARM)


def played(
    place: str, n: int, n_samples: int = 0, n_events: int = 0
) -> tuple[list[Frame], list[ArmSample], list[LaserEvent]]:
    devices: list[Any] = [
        open_device(kind, f"replay:{place}") for kind in ("camera", "arm", "lasers")
    ]
    camera, arm, lasers = devices
    frames: list[Frame] = []
    samples: list[ArmSample] = []
    events: list[LaserEvent] = []
    arm.start()
    camera.start("external")
    lasers.start(None)
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        if len(frames) >= n and len(samples) >= n_samples and len(events) >= n_events:
            break
        frame = camera.read(0.02)
        frames += [frame] if frame else []
        samples += arm.read(0.0)
        events += lasers.read(0.0)
    for device in devices:
        device.close()
        device.close()
    return frames, samples, events


def test_plays_what_is_recorded_at_its_times(folder: Path) -> None:
    source = read_recording(folder)
    frames, samples, events = played(str(folder), 3, 7, 3)
    assert [frame.t_device_ns for frame in frames] == list(TIMES)
    assert [frame.trigger_id for frame in frames] == [5, 6, 7]
    assert [frame.lasers for frame in frames] == [event.lasers for event in events]
    assert [event.lasers for event in events] == [("A", "B"), ("A",), ("A",)]
    for row, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, source.exposure(row).image)
    assert [one.t_device_ns for one in samples] == source.arm.t_ns.tolist()
    assert [one.trigger_id for one in samples] == [None, 5, None, 6, None, 7, None]
    for one, known, place in zip(
        samples, source.arm.is_known, source.arm.translations_mm, strict=True
    ):
        assert (one.pose is not None) == known
        if one.pose is not None:
            assert one.pose.translation_mm.tolist() == place.tolist()
    # the pace is the recorded one, whatever else this computer does
    assert np.diff([frame.t_host_ns for frame in frames]).tolist() == [20_000_000] * 2


def test_plays_a_recording_of_one_file_alike(folder: Path, tmp_path: Path) -> None:
    record_folder(folder, tmp_path / "scan.mcap")
    frames, samples, events = played(str(tmp_path / "scan.mcap"), 3, 7, 3)
    images, poses, switched = played(str(folder), 3, 7, 3)
    assert [one.t_device_ns for one in frames] == [one.t_device_ns for one in images]
    assert [one.t_device_ns for one in samples] == [one.t_device_ns for one in poses]
    assert [one.t_device_ns for one in events] == [one.t_device_ns for one in switched]
    assert all(np.array_equal(a.image, b.image) for a, b in zip(frames, images, strict=True))
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "scan.mcap").read_bytes()[:500])
    with pytest.raises(DeviceError):
        open_device("camera", f"replay:{tmp_path / 'cut.mcap'}")


def test_plays_at_another_rate_round_after_round(folder: Path) -> None:
    frames, samples, _ = played(f"{folder}?rate=200&loop=1&ahead=1", 7)
    steps = np.diff([frame.t_device_ns for frame in frames])
    # 20 ms become 5; a round, 60 ms and a step more, becomes 20
    assert set(steps.tolist()) == {5_000_000, 10_000_000}
    assert [frame.number for frame in frames] == list(range(len(frames)))
    ids = [frame.trigger_id for frame in frames]
    assert ids == [5, 6, 7, 8, 9, 10, 11][: len(ids)]
    latched = {one.trigger_id: one.t_device_ns for one in samples if one.trigger_id is not None}
    assert all(latched[frame.trigger_id] == frame.t_device_ns for frame in frames)


def test_a_recording_that_names_no_lasers_does_not_say_that_they_were_off(tmp_path: Path) -> None:
    unnamed = EXPOSURES.replace(",A+B,", ",,").replace(",A,", ",,")
    folder = lab_folder(tmp_path / "scan", exposures=unnamed, arm=ARM)
    camera = open_device("camera", f"replay:{folder}")
    camera.start()
    frames = [camera.read(20.0) for _ in range(3)]
    assert [one.lasers for one in frames if one is not None] == [None] * 3
    with pytest.raises(DeviceError, match=r"no lasers.*leave this device out"):
        open_device("lasers", f"replay:{folder}")
    camera.close()


@pytest.mark.parametrize("has_ids", [False, True])
def test_the_lasers_of_an_instant_are_those_of_any_of_its_rows(
    tmp_path: Path, has_ids: bool
) -> None:
    """Of three cameras the last one's row names them; with ids its time may differ."""
    lines = [f"index,t_ns,camera,file,lasers{',trigger_id' * has_ids}"]
    for k in range(9):
        shot, camera = divmod(k, 3)
        lit = "A" if camera == 2 and shot else ""
        t_ns = TIMES[shot] + 7 * camera * has_ids
        lines.append(f"{k},{t_ns},{camera},images/{shot}.png,{lit}{f',{shot}' * has_ids}")
    table = "\n".join(lines) + "\n"
    folder = lab_folder(tmp_path / "scan", exposures=table, arm=None, session=None)
    cameras = [open_device("camera", f"replay:{folder}?camera={k}") for k in range(2)]
    lasers: Any = open_device("lasers", f"replay:{folder}")
    for one in cameras:
        one.start("external")
    lasers.start(None)
    frames = [[one.read(20.0) for _ in range(3)] for one in cameras]
    events: list[LaserEvent] = []
    while len(events) < 3:
        events += lasers.read(1.0)
    told = [(), ("A",), ("A",)]
    assert [[frame and frame.lasers for frame in own] for own in frames] == [told] * 2
    assert [event.lasers for event in events] == told
    for one in (*cameras, lasers):
        one.close()


def test_a_row_without_lasers_among_others_was_dark(tmp_path: Path) -> None:
    dark = EXPOSURES.replace(",A+B,", ",,")
    camera = open_device(
        "camera", f"replay:{lab_folder(tmp_path / 'scan', exposures=dark, arm=ARM)}"
    )
    camera.start()
    frames = [camera.read(20.0) for _ in range(3)]
    assert [one.lasers for one in frames if one is not None] == [(), ("A",), ("A",)]
    camera.close()


@pytest.mark.parametrize(
    ("named", "lasers", "events"),
    [
        (("A", "", ""), [("A",), None, ()], [("A",), ()]),
        # none is named, and yet one row says that it was dark
        (("", "", ""), [None, None, ()], [()]),
    ],
)
def test_lasers_that_were_not_known_are_not_known_where_they_are_played(
    tmp_path: Path,
    named: tuple[str, ...],
    lasers: list[tuple[str, ...] | None],
    events: list[tuple[str, ...]],
) -> None:
    flags = ["laser-unknown" if on is None else "" for on in lasers]
    table = "index,t_ns,camera,file,lasers,trigger_id,flags\n" + "".join(
        f"{k},{t},0,images/{k}.png,{named[k]},{k + 5},{flags[k]}\n" for k, t in enumerate(TIMES)
    )
    folder = lab_folder(tmp_path / "scan", exposures=table, arm=ARM)
    frames, _, switched = played(str(folder), 3, 7, len(events))
    assert [one.lasers for one in frames] == lasers
    assert [one.lasers for one in switched] == events
    known = [one.trigger_id for one in frames if one.lasers is not None]
    assert [one.trigger_id for one in switched] == known


def test_waits_while_everything_is_stopped(folder: Path) -> None:
    camera = open_device("camera", f"replay:{folder}?rate=50&loop=1")
    camera.start()
    first = camera.read(2.0)
    camera.stop()
    last = first
    while (taken := camera.read(0.1)) is not None:
        last = taken
    time.sleep(0.3)
    assert camera.read(0.0) is None
    camera.start()
    following = camera.read(5.0)
    camera.close()
    assert last is not None and following is not None
    # one may have been under way to a camera that was stopped
    assert following.number <= last.number + 2
    assert following.t_device_ns - last.t_device_ns > 250_000_000


def test_a_lost_packet_and_a_missing_image(folder: Path) -> None:
    camera: Any = open_device("camera", f"replay:{folder}?loop=1&rate=100")
    camera.rig.inject("camera0", "corrupt", 1)
    camera.start()
    assert [camera.read(2.0).is_complete for _ in range(3)] == [False, True, True]
    camera.close()
    (folder / "images" / "1.png").write_bytes(b"")
    camera = open_device("camera", f"replay:{folder}")
    camera.start()
    with pytest.raises(DeviceError, match=r"1\.png"):
        for _ in range(50):
            camera.read(0.1)
    camera.close()


@pytest.mark.parametrize("place", ["", "?rate=x", "x?loop=2", "x?camera=9"])
def test_a_wrong_address_is_refused(place: str) -> None:
    with pytest.raises(OptionError):
        open_device("camera", f"replay:{place}")


def test_a_recording_that_is_not_there_is_refused(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(DeviceError):
        open_device("camera", f"replay:{tmp_path / 'nothing'}")
    with pytest.raises(DeviceError, match="no camera1"):
        open_device("camera", f"replay:{folder}?camera=1")
