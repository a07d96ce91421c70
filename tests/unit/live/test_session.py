# SPDX-License-Identifier: Apache-2.0
"""A live session on devices that hand out a drawn scan, against the same scan reconstructed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from armscan.devices.matching import InstantMatcher, MatchedInstant
from armscan.devices.protocols import ArmSample, CameraSettings, Frame, LaserEvent
from armscan.errors import DeviceError, InputError, OptionError, OutputError
from armscan.models.arm import forward, thesis_arm
from armscan.pipeline.live.acquire import (
    Acquisition,
    LiveEvent,
    WaitingInstant,
    WaitingInstants,
    exposure_of,
)
from armscan.pipeline.live.exposure import ExposureSettings, LaserTarget
from armscan.pipeline.live.rig import Rig, RigDescription, read_rig
from armscan.pipeline.live.session import LiveOptions, LiveSession, LiveStatus
from armscan.pipeline.measure import measure_instants
from armscan.pipeline.scan import ScanOptions, measure_scan
from armscan.reconstruction.labels import SingleLabeller
from armscan.reconstruction.sync import PoseStatus
from armscan.records.cloud import PointCloud
from armscan.records.recording import ArmTrack, CameraSetup, ExposureRow
from armscan.storage.arm import arm_model_toml
from armscan.storage.recording import read_recorded
from rigs.scan_fake import CAMERA, FakeScan, as_source, fake_scan, scanner


@dataclass
class Device:
    """Hands out what it was given, then nothing; counts what is asked of it."""

    name: str
    elements: list[Any]
    calls: list[str] = field(default_factory=list)
    setup: CameraSetup = field(default_factory=lambda: CameraSetup(CAMERA.width_px))
    pose_form: str = "quaternion"
    on_its_way: list[Any] = field(default_factory=list)
    """What it has taken when it is stopped and can be read from then on alone."""

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
        self.elements, self.on_its_way = [*self.elements, *self.on_its_way], []

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


def rig_of(scan: FakeScan, frames: list[Any] | None = None) -> Any:
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


ALL = LiveOptions(is_thinned=False)
MEASURE = "armscan.pipeline.live.session.measure_instants"


def waited(is_done: Callable[[], bool]) -> None:
    end = time.monotonic() + 20.0
    while not is_done():
        assert time.monotonic() < end
        time.sleep(0.005)


def run(rig: Rig, n: int, **given: Any) -> tuple[LiveSession, dict[int, PointCloud], list[Any]]:
    clouds: dict[int, PointCloud] = {}
    told: list[Any] = []
    session = LiveSession(
        rig, scanner(), **{"keep_cloud": clouds.__setitem__, "options": ALL, **given}
    )
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


def test_of_two_devices_of_one_name_the_one_that_answers_does_not_hide_the_other() -> None:
    scan = triggered_scan(2)
    cameras = [Device("webcam", [DeviceError("unplugged", where="webcam")]) for _ in range(2)]
    session = LiveSession(Rig(cameras, None, None, RigDescription(("a", "b"))), options=ALL)  # type: ignore[arg-type]
    session.start()
    waited(lambda: len(session.snapshot().faults) == 2)
    cameras[0].elements = [frame(scan, 0)]
    waited(lambda: len(session.snapshot().faults) != 2)
    left = session.snapshot().faults
    session.stop()
    assert left == ("webcam: unplugged.",)


def test_shows_one_point_a_voxel_and_takes_a_pass_back() -> None:
    scan = triggered_scan(6)
    session, clouds, _ = run(rig_of(scan), 6, options=replace(ALL, voxel_mm=2.0))
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


def test_an_exposure_for_a_laser_that_is_not_there_is_refused_and_all_is_closed() -> None:
    opened: list[Any] = []

    def open_device(kind: str, address: str) -> Any:
        opened.append(Device(address, []))
        opened[-1].sources = ("A", "B")
        return opened[-1]

    asked = ExposureSettings("automatic", laser=(LaserTarget("b", 0.5),))
    with pytest.raises(OptionError, match="no laser is called 'b'; choose from A, B"):
        Rig.open(RigDescription(("a",), lasers="c", exposure=asked), open_device)
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


class Kept(FaultyRecorder):
    """Keeps which images came in which order, by their numbers."""

    def __init__(self) -> None:
        self.frames: list[int] = []
        self.instants: list[int] = []

    def add_frame(self, camera: int, frame: Frame, status: object) -> None:
        self.frames.append(frame.number)

    def add_instant(self, instant: Any) -> None:
        self.instants.append(instant.frames[0].number)


def test_what_devices_have_taken_when_they_are_stopped_is_recorded_and_placed() -> None:
    scan, kept = triggered_scan(8), Kept()
    rig = rig_of(scan)
    for device in (rig.cameras[0], rig.arm):
        device.on_its_way, device.elements = device.elements[3:], device.elements[:3]
    session, clouds, _ = run(rig, 3, recorder=kept)
    assert kept.frames == kept.instants == list(range(8))
    assert session.snapshot().counts == {LiveStatus.PLACED: 8} and len(clouds) == 8


def test_a_device_that_does_not_obey_the_stop_keeps_nobody_waiting() -> None:
    scan = triggered_scan(2)
    rig = rig_of(scan)
    endless = rig.cameras[0]
    number = iter(range(2, 10**9))
    late_ns = time.monotonic_ns() + 3_600_000_000_000
    given = endless.read
    endless.read = lambda timeout_s: (
        given(timeout_s)
        or (
            replace(frame(scan, 1), number=next(number), trigger_id=None, t_host_ns=late_ns)
            if "stop" in endless.calls
            else None
        )
    )
    session, _, _ = run(rig, 2)
    assert session.snapshot().counts[LiveStatus.PLACED] == 2


@pytest.mark.parametrize("error", [ValueError("a fault of its own"), ZeroDivisionError()])
def test_whatever_a_driver_raises_is_its_device_s_fault(error: Exception) -> None:
    scan = triggered_scan(4)
    frames = [frame(scan, k) for k in range(4)]
    rig = rig_of(scan, [*frames[:2], error, *frames[2:]])
    calls = rig.cameras[0].calls

    def stop() -> None:
        calls.append("stop")
        raise error

    rig.cameras[0].stop = stop
    session, _, told = run(rig, 4)
    assert session.snapshot().counts == {LiveStatus.PLACED: 4}
    faults = [event for event in told if event.kind == "fault"]
    assert [event.device for event in faults] == ["camera 0", ""]
    assert all(f"camera 0: its driver failed ({type(error).__name__}" in e.text for e in faults)
    assert rig.arm.calls == ["start", "stop"]


def test_a_driver_that_fails_at_the_start_stops_the_rig() -> None:
    rig = rig_of(triggered_scan(2))

    def start(*_: object) -> None:
        raise KeyError("firmware")

    rig.cameras[0].start = start
    session = LiveSession(rig, scanner())
    with pytest.raises(DeviceError, match="camera 0: its driver failed"):
        session.start()
    assert rig.arm.calls == ["start", "stop"]


def test_a_rig_that_did_not_start_may_be_started_again() -> None:
    """With exposure control, whose thread must not be left behind."""
    rig = rig_of(triggered_scan(2))
    real = rig.arm.start

    def start() -> None:
        raise DeviceError("not referenced")

    rig.arm.start = start
    before = threading.active_count()
    options = replace(ALL, exposure=ExposureSettings("automatic"))
    session = LiveSession(rig, scanner(), options=options)
    with pytest.raises(DeviceError, match="not referenced"):
        session.start()
    assert threading.active_count() == before
    rig.arm.start = real
    session.start()
    assert session.snapshot().state == "scanning"
    session.stop()
    assert threading.active_count() == before


def test_a_fault_in_measuring_is_told_and_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    real, n_calls = measure_instants, iter(range(100))

    def failing(instants: Any, *given: Any, **named: Any) -> Any:
        if next(n_calls) == 0:
            next(iter(instants))
            raise RuntimeError("a kernel failed")
        return real(instants, *given, **named)

    monkeypatch.setattr(MEASURE, failing)
    session, _, told = run(rig_of(triggered_scan(4)), 4)
    assert session.snapshot().counts == {LiveStatus.PLACED: 3, LiveStatus.FAILED: 1}
    text = "an image could not be measured: RuntimeError: a kernel failed"
    assert [event.text for event in told if event.kind == "warning"] == [text]


def test_faults_of_those_who_listen_are_theirs() -> None:
    rig, told = rig_of(triggered_scan(4)), []

    def keep(number: int, cloud: PointCloud) -> None:
        raise OSError("no room")

    session = LiveSession(rig, scanner(), options=ALL, keep_cloud=keep)
    session.add_listener(lambda event: 1 // 0)
    session.add_listener(told.append)
    devices = [rig.cameras[0], rig.arm]
    held = [device.elements for device in devices]
    rig.cameras[0].elements, rig.arm.elements = [], []
    session.start()
    rig.cameras[0].elements, rig.arm.elements = held
    waited(lambda: sum(session.snapshot().counts.values()) == 4)
    session.stop()
    assert session.snapshot().counts == {LiveStatus.PLACED: 4}
    texts = [event.text for event in told]
    assert texts.count("a cloud was not kept: OSError: no room") == 4
    assert [text for text in texts if "listener" in text] == [
        "a listener failed and is told no more: ZeroDivisionError: "
        "integer division or modulo by zero"
    ]


def test_a_session_that_is_over_does_not_say_that_it_scans() -> None:
    session, _, _ = run(rig_of(triggered_scan(2)), 2)
    for begin in (session.start, session.resume):
        with pytest.raises(DeviceError, match="is over"):
            begin()
    session.pause()
    session.stop()
    assert session.snapshot().state == "stopped"
    with pytest.raises(DeviceError, match="not open"):
        LiveSession(rig_of(triggered_scan(2)), scanner()).resume()


def test_an_arm_of_joints_alone_places_by_its_document(tmp_path: Path) -> None:
    scan = triggered_scan(4)
    model = thesis_arm((300.0, 600.0, 500.0, 200.0), (40.0, 40.0, 40.0))
    rng = np.random.default_rng(3)
    joints = rng.uniform(-0.5, 0.5, 7) + np.linspace(0, 0.1, 4)[:, None]
    rotations, places = forward(model, joints)
    (tmp_path / "arm.toml").write_bytes(arm_model_toml(model))
    description = 'cameras = ["c"]\narm = "a"\nis_common_trigger = true\narm_model = "arm.toml"\n'
    (tmp_path / "rig.toml").write_text(description)
    samples = [
        (ArmSample(k, row.t_ns, row.t_ns, joints_rad=joints[k], trigger_id=k),)
        for k, row in enumerate(scan.rows)
    ]
    devices = {
        "c": Device("camera 0", [frame(scan, k) for k in range(4)]),
        "a": Device("arm", samples, pose_form="joints"),
    }
    rig = Rig.open(read_rig(tmp_path / "rig.toml"), lambda _, address: devices[address])
    seen: list[Any] = []
    kept: Any = Kept()
    kept.add_instant = seen.append
    run(rig, 4, recorder=kept)
    assert len(seen) == 4
    for k, instant in enumerate(seen):
        np.testing.assert_array_equal(instant.pose.rotation, rotations[k])
        np.testing.assert_array_equal(instant.pose.translation_mm, places[k])
    with pytest.raises(InputError, match=r"arm_model = .arm\.toml"):
        LiveSession(replace_rig(rig), scanner())


def replace_rig(rig: Rig) -> Rig:
    """The same devices without the arm's document."""
    return Rig(rig.cameras, rig.arm, None, rig.description)


def test_a_bayer_pattern_is_measured_as_its_recording_is(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    mosaic = rng.integers(0, 1024, (12, 16)).astype(np.uint16)
    setup = CameraSetup(16, 12, bits_used=10, colour="bayer_rggb")
    (tmp_path / "0.png").write_bytes(cv2.imencode(".png", mosaic)[1].tobytes())
    row = ExposureRow(0, 5, 0, "0.png", ("A",), 7)
    recorded = read_recorded(tmp_path, row, setup)
    taken = Frame(mosaic, 0, 5, 5, trigger_id=7)
    instant = MatchedInstant((taken,), 5, ("A",), 7, None, PoseStatus.UNKNOWN_TRIGGER)
    live = exposure_of(taken, setup, instant)
    np.testing.assert_array_equal(live.image, recorded.image)
    assert (live.bits_used, live.t_ns, live.lasers) == (10, 5, ("A",))
    assert live.image.shape == (12, 16, 3)


def test_a_cloud_of_two_cameras_is_kept_once(monkeypatch: pytest.MonkeyPatch) -> None:
    real = measure_instants

    def twice(*given: Any, **named: Any) -> Any:
        for one in real(*given, **named):
            yield replace(one, profiles=one.profiles * 2)

    monkeypatch.setattr(MEASURE, twice)
    kept: list[tuple[int, PointCloud]] = []
    run(rig_of(triggered_scan(3)), 3, keep_cloud=lambda *given: kept.append(given))
    assert [number for number, _ in kept] == [0, 1, 2]
    for _, cloud in kept:
        half = len(cloud) // 2
        np.testing.assert_array_equal(cloud.points_mm[:half], cloud.points_mm[half:])
        assert len(cloud.exposure_sources) == 2 and set(cloud.exposure.tolist()) == {0, 1}


def test_the_newest_is_measured_and_what_waits_is_recorded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real, is_held = measure_instants, threading.Event()

    def held(instants: Any, *given: Any, **named: Any) -> Any:
        is_held.wait(10.0)
        return real(instants, *given, **named)

    monkeypatch.setattr(MEASURE, held)
    kept, clouds = Kept(), {}
    rig = rig_of(triggered_scan(8))
    every, rig.cameras[0].elements = rig.cameras[0].elements, []
    samples, rig.arm.elements = rig.arm.elements, []
    session = LiveSession(rig, scanner(), recorder=kept, keep_cloud=clouds.__setitem__)
    session.start()
    rig.cameras[0].elements, rig.arm.elements = every, samples
    waited(lambda: len(kept.instants) == 8)
    is_held.set()
    waited(lambda: 7 in clouds)
    session.stop()
    counts = session.snapshot().counts
    assert counts == {LiveStatus.PLACED: 1, LiveStatus.NOT_SHOWN: 7}
    assert list(clouds) == [7] and kept.instants == list(range(8))


def test_stripes_are_shown_on_the_image_in_which_they_were_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scan = triggered_scan(4)
    dark = replace(frame(scan, 3), lasers=())
    for newer_ns, shown in ((10**12, 2), (-(10**12), 3)):
        monkeypatch.setattr("armscan.pipeline.live.session.NEWER_NS", newer_ns)
        session, _, _ = run(rig_of(scan, [*(frame(scan, k) for k in range(3)), dark]), 4)
        (view,) = session.snapshot().cameras
        np.testing.assert_array_equal(view.image, frame(scan, shown).image)
        assert bool(len(view.points_px)) == (shown == 2)


def waiting(number: int, lasers: tuple[str, ...]) -> WaitingInstant:
    nothing = PoseStatus.UNKNOWN_TRIGGER
    instant = MatchedInstant((None,), None, lasers, number, None, nothing)
    return WaitingInstant(number, instant, time.monotonic_ns())


def test_lasers_that_take_turns_are_measured_in_turn() -> None:
    """Three triggers while one is measured, three lasers: the newest alone would be one laser's."""
    slots, lasers = WaitingInstants(is_thinned=True), (("A",), ("B",), ("A", "B"))
    seen, n_left_out = [], 0
    for k in range(30):
        n_left_out += slots.put(waiting(k, lasers[k % 3]))
        if k % 3 == 2:
            one, n_late = slots.take()
            assert one is not None and k - one.number < 3
            seen.append(one.instant.lasers)
            n_left_out += n_late
    assert len(seen) == 10 and all(seen.count(each) >= 3 for each in lasers)
    rest = []
    slots.close()
    while (found := slots.take())[0] is not None:
        rest.append(found[0])
    assert len(seen) + len(rest) + n_left_out == 30


def test_what_waited_too_long_gives_way_to_other_lasers(monkeypatch: pytest.MonkeyPatch) -> None:
    slots = WaitingInstants(is_thinned=True)
    slots.put(waiting(0, ("A",)))
    monkeypatch.setattr("armscan.pipeline.live.acquire.LATEST_NS", 0)
    slots.put(waiting(1, ("B",)))
    one, n_late = slots.take()
    assert one is not None and (one.number, n_late) == (1, 1)


class Held(Kept):
    """A disk that takes nothing until it is let."""

    def __init__(self) -> None:
        super().__init__()
        self.may_go_on = threading.Event()

    def add_frame(self, camera: int, frame: Frame, status: object) -> None:
        self.may_go_on.wait(20.0)
        super().add_frame(camera, frame, status)


@pytest.mark.parametrize("what", ["pause", "undo", "clear"])
def test_a_disk_that_is_behind_delays_no_picture_and_loses_nothing(what: str) -> None:
    kept, rig = Held(), rig_of(triggered_scan(8))
    devices: list[Any] = [rig.cameras[0], rig.arm]
    held = [device.elements for device in devices]
    for device in devices:
        device.elements = []
    session = LiveSession(rig, scanner(), options=ALL, recorder=kept)
    session.start()
    for device, elements in zip(devices, held, strict=True):
        device.elements = elements
    waited(lambda: session.snapshot().counts.get(LiveStatus.PLACED) == 8)
    assert kept.instants == []
    threading.Timer(0.1, kept.may_go_on.set).start()
    {"pause": session.pause, "undo": session.undo_pass, "clear": session.clear}[what]()
    # whoever takes the recorder off, or images out of what it lists, finds all that was matched
    assert kept.frames == kept.instants == list(range(8))
    session.stop()


def test_an_instant_waits_for_a_camera_whose_thread_lags(monkeypatch: pytest.MonkeyPatch) -> None:
    """What decides is when frames arrived, not when this computer comes to read them."""
    monkeypatch.setattr("armscan.devices.matching.PATIENCE_NS", 20_000_000)
    now = time.monotonic_ns()

    def arrived(k: int) -> Frame:
        t_ns = now + 1_000_000 * k
        return Frame(np.zeros((2, 2), np.uint8), k, t_ns, t_ns, trigger_id=k)

    class Arrived(Device):
        """Gives frames with the times of their arrival, the first one when it may."""

        may_go_on = threading.Event()

        def read(self, timeout_s: float) -> Any:
            if self.name == "slow":
                self.may_go_on.wait(10.0)
            time.sleep(0.001)
            return self.elements.pop(0) if self.elements else None

    cameras: list[Any] = [Arrived(name, [arrived(k) for k in range(5)]) for name in ("c", "slow")]
    instants: list[MatchedInstant] = []
    description = RigDescription(("c", "slow"), is_common_trigger=True)
    acquisition = Acquisition(Rig(cameras, None, None, description), instants.append, print)
    acquisition.start()
    time.sleep(0.3)
    assert instants == []
    Arrived.may_go_on.set()
    waited(lambda: len(instants) == 5)
    acquisition.stop()
    assert all(None not in one.frames for one in instants)


class Lasers(Device):
    """Switches; what it was asked for is kept."""

    sources = ("A", "B")

    def set_next(self, lasers: tuple[str, ...]) -> None:
        self.calls.append("+".join(lasers))


def test_the_head_s_rule_chooses_the_lasers(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = iter([("A",), ("A",), ("A", "B"), ("B",), ("B",)])
    monkeypatch.setattr(SingleLabeller, "next_lasers", lambda _: next(wanted))
    scan = triggered_scan(4)
    rig = rig_of(scan)
    events = [(LaserEvent(k, row.t_ns, row.t_ns, ("A",)),) for k, row in enumerate(scan.rows)]
    lasers = Lasers("lasers", events)
    description = replace(rig.description, chooses_lasers=True)
    session, _, _ = run(Rig(rig.cameras, rig.arm, lasers, description), 4)
    assert session.snapshot().counts == {LiveStatus.PLACED: 4}
    # before the first image, then after the images that changed the rule's mind
    assert lasers.calls == ["start", "A", "A+B", "B", "stop"]


def test_a_full_disk_ends_the_recording_and_not_the_scan() -> None:
    scan = triggered_scan(4)
    recorder = FaultyRecorder(OutputError("the disk is full"))
    session, _, told = run(rig_of(scan), 4, recorder=recorder)
    assert session.snapshot().counts == {LiveStatus.PLACED: 4}
    assert [event.text for event in told if event.kind == "warning"] == [
        "the recording ended: the disk is full."
    ]


def test_who_hears_that_the_disk_is_full_may_stop_the_scan(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From the thread that records, while the one that matches has no room any more."""
    monkeypatch.setattr("armscan.pipeline.live.acquire.MOST_TO_KEEP", 1)
    rig = rig_of(triggered_scan(8))
    frames, rig.cameras[0].elements = rig.cameras[0].elements, []
    recorder = FaultyRecorder(OutputError("the disk is full"))
    session = LiveSession(rig, scanner(), options=ALL, recorder=recorder)
    ended = threading.Event()

    def hear(event: LiveEvent) -> None:
        if "disk is full" in event.text:
            session.stop()
            ended.set()

    session.add_listener(hear)
    session.start()
    rig.cameras[0].elements = frames
    assert ended.wait(20.0)
    assert session.snapshot().state == "stopped"


def test_a_fault_in_matching_is_told_and_nobody_waits_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def failing(*_: object) -> None:
        raise ValueError("a fault of its own")

    monkeypatch.setattr("armscan.pipeline.live.acquire.MOST_WAITING", 2)
    monkeypatch.setattr(InstantMatcher, "add_frame", failing)
    scan = triggered_scan(8)
    rig = rig_of(scan)
    told: list[Any] = []
    session = LiveSession(rig, scanner())
    session.add_listener(told.append)
    session.start()
    end = time.monotonic() + 10.0
    fault = "the images are no longer matched: ValueError: a fault of its own"
    while fault not in [event.text for event in told] and time.monotonic() < end:
        time.sleep(0.01)
    session.stop()
    assert fault in [event.text for event in told]
