# SPDX-License-Identifier: Apache-2.0
"""A live session on devices that hand out a drawn scan, against the same scan reconstructed."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from armscan.devices.protocols import ArmSample, CameraSettings, Frame
from armscan.errors import DeviceError, OutputError
from armscan.pipeline.live.rig import Rig, RigDescription
from armscan.pipeline.live.session import LiveOptions, LiveSession, LiveStatus
from armscan.pipeline.scan import ScanOptions, measure_scan
from armscan.records.cloud import PointCloud
from armscan.records.recording import ArmTrack, CameraSetup
from rigs.scan_fake import CAMERA, FakeScan, as_source, fake_scan, scanner


@dataclass
class Device:
    """Hands out what it was given, then nothing; counts what is asked of it."""

    name: str
    elements: list[Any]
    calls: list[str] = field(default_factory=list)
    setup: CameraSetup = field(default_factory=lambda: CameraSetup(CAMERA.width_px))

    def start(self, *_: object) -> None:
        self.calls.append("start")

    def read(self, timeout_s: float) -> Any:
        if not self.elements:
            time.sleep(0.001)
            return None
        element = self.elements.pop(0)
        if isinstance(element, Exception):
            raise element
        now = time.monotonic_ns()
        if isinstance(element, Frame):
            return replace(element, t_host_ns=now)
        return tuple(replace(one, t_host_ns=now) for one in element)

    @property
    def settings(self) -> CameraSettings:
        return CameraSettings()

    def configure(self, settings: CameraSettings) -> CameraSettings:
        return settings

    def stop(self) -> None:
        self.calls.append("stop")

    def close(self) -> None:
        self.calls.append("close")


def triggered_scan(n: int) -> FakeScan:
    scan = fake_scan(n)
    track = ArmTrack(
        t_ns=np.array([row.t_ns for row in scan.rows]),
        rotations=np.array([pose.rotation for pose in scan.truth]),
        translations_mm=np.array([pose.translation_mm for pose in scan.truth]),
        is_known=np.ones(n, dtype=bool),
        trigger_ids=np.arange(n),
    )
    rows = tuple(replace(row, trigger_id=k) for k, row in enumerate(scan.rows))
    return replace(scan, rows=rows, arm=track)


def rig_of(scan: FakeScan, frames: list[Any] | None = None) -> Rig:
    samples = [
        (ArmSample(k, row.t_ns, row.t_ns, pose=scan.truth[k], trigger_id=k),)
        for k, row in enumerate(scan.rows)
    ]
    frames = [frame(scan, k) for k in range(len(scan.rows))] if frames is None else frames
    description = RigDescription(("fake",), is_common_trigger=True)
    return Rig([Device("camera 0", frames)], Device("arm", samples), None, description)


def frame(scan: FakeScan, k: int, **changes: Any) -> Frame:
    t_ns = scan.rows[k].t_ns
    image = scan.exposure(k).image
    return replace(Frame(image, k, t_ns, t_ns, trigger_id=k, lasers=("A",)), **changes)


def run(rig: Rig, n: int, **given: Any) -> tuple[LiveSession, dict[int, PointCloud], list[Any]]:
    clouds: dict[int, PointCloud] = {}
    told: list[Any] = []
    session = LiveSession(rig, scanner(), keep_cloud=clouds.__setitem__, **given)
    session.add_listener(told.append)
    devices = [*rig.cameras, rig.arm]
    held = [device.elements for device in devices]
    for device in devices:
        device.elements = []
    session.start()
    for device, elements in zip(devices, held, strict=True):
        device.elements = elements
    end = time.monotonic() + 20.0
    while sum(session.snapshot().counts.values()) < n and time.monotonic() < end:
        time.sleep(0.01)
    session.stop()
    return session, clouds, told


def test_places_what_a_reconstruction_places_bit_by_bit() -> None:
    scan = triggered_scan(8)
    session, clouds, _ = run(rig_of(scan), 8)
    later = measure_scan(as_source(scan), scanner(), ScanOptions(has_normals=False)).cloud
    assert session.snapshot().counts == {LiveStatus.PLACED: 8}
    for k, cloud in clouds.items():
        own = later.exposure == k
        np.testing.assert_array_equal(cloud.points_mm, later.points_mm[own])
        np.testing.assert_array_equal(cloud.covariance_mm2, later.covariance_mm2[own])
        assert len(cloud) > 200


def test_places_nothing_wrong_where_frames_are_lost_repeated_or_cut() -> None:
    scan = triggered_scan(8)
    frames = [frame(scan, k) for k in range(8)]
    frames[2] = frame(scan, 2, is_complete=False)
    frames[5] = frame(scan, 4)
    session, clouds, _ = run(rig_of(scan, frames), 7)
    later = measure_scan(as_source(scan), scanner(), ScanOptions(has_normals=False)).cloud
    shown = session.snapshot()
    assert shown.counts == {LiveStatus.PLACED: 6, LiveStatus.INCOMPLETE: 1}
    assert "1 delivered twice" in shown.streams[0]
    # numbers count the instants that there were: 0, 1, (2), 3, 4, 6, 7
    for number, row in zip((0, 1, 3, 4, 5, 6), (0, 1, 3, 4, 6, 7), strict=True):
        own = later.exposure == row
        np.testing.assert_array_equal(clouds[number].points_mm, later.points_mm[own])


def test_a_camera_that_is_unplugged_is_told_of_and_goes_on() -> None:
    scan = triggered_scan(4)
    frames = [frame(scan, k) for k in range(4)]
    session, _, told = run(rig_of(scan, [*frames[:2], DeviceError("unplugged"), *frames[2:]]), 4)
    assert session.snapshot().counts == {LiveStatus.PLACED: 4}
    kinds = [(event.kind, event.device) for event in told]
    assert ("fault", "camera 0") in kinds and ("recovered", "camera 0") in kinds


def test_shows_one_point_a_voxel_and_takes_a_pass_back() -> None:
    scan = triggered_scan(6)
    session, clouds, _ = run(rig_of(scan), 6, options=LiveOptions(voxel_mm=2.0))
    shown = session.cloud()
    cells = {tuple(cell) for cell in np.floor(shown.points_mm / 2.0).astype(int).tolist()}
    every = np.concatenate([cloud.points_mm for cloud in clouds.values()])
    assert cells == {tuple(cell) for cell in np.floor(every / 2.0).astype(int).tolist()}
    assert len(shown.points_mm) == len(cells)
    session.undo_pass()
    assert len(session.cloud().points_mm) == 0


def test_lines_of_a_hand_at_rest_are_dropped() -> None:
    scan = triggered_scan(4)
    still = replace(scan, truth=(scan.truth[0],) * 4)
    session, _, _ = run(rig_of(still), 4)
    assert session.snapshot().counts == {LiveStatus.PLACED: 1, LiveStatus.STILL: 3}


def test_a_rig_opens_all_devices_or_none() -> None:
    opened: list[Device] = []

    def open_device(kind: str, address: str) -> Device:
        if kind == "arm":
            raise DeviceError("the arm is taken")
        opened.append(Device(address, []))
        return opened[-1]

    with pytest.raises(DeviceError, match="taken"):
        Rig.open(RigDescription(("a", "b"), arm="c"), open_device)
    assert [device.calls for device in opened] == [["close"], ["close"]]


class FaultyRecorder:
    """Fails at the first image: as a full disk, or by a fault of its own."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def add_frame(self, camera: int, frame: Frame, status: object) -> None:
        raise self.error

    def add_samples(self, samples: object) -> None:
        """Keeps none."""

    def add_events(self, events: object) -> None:
        """Keeps none."""

    def add_instant(self, instant: object) -> None:
        """Keeps none."""


def test_a_full_disk_ends_the_recording_and_not_the_scan() -> None:
    scan = triggered_scan(4)
    recorder = FaultyRecorder(OutputError("the disk is full"))
    session, _, told = run(rig_of(scan), 4, recorder=recorder)
    assert session.snapshot().counts == {LiveStatus.PLACED: 4}
    assert [event.text for event in told if event.kind == "warning"] == [
        "the recording ended: the disk is full."
    ]


def test_a_fault_in_matching_is_told_and_nobody_waits_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("armscan.pipeline.live.acquire.MOST_WAITING", 2)
    scan = triggered_scan(8)
    rig = rig_of(scan)
    told: list[Any] = []
    session = LiveSession(rig, scanner(), recorder=FaultyRecorder(ValueError("a fault of its own")))
    session.add_listener(told.append)
    session.start()
    end = time.monotonic() + 10.0
    fault = "the images are no longer matched: ValueError: a fault of its own"
    while fault not in [event.text for event in told] and time.monotonic() < end:
        time.sleep(0.01)
    session.stop()
    assert fault in [event.text for event in told]
