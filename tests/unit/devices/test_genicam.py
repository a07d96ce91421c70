# SPDX-License-Identifier: Apache-2.0
"""Industrial cameras: pylon's emulation that replays images, and Aravis's fake GigE camera."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from armscan.devices.contract import check_camera
from armscan.devices.protocols import Camera, CameraSettings, Frame
from armscan.devices.registry import open_device, survey_drivers
from armscan.drivers.genicam import AravisLibrary, GenICamCamera
from armscan.drivers.raw_frames import RawFrame, image_of
from armscan.errors import DeviceError, DeviceTakenError
from armscan.records.exposure import SensorWindow

# read by pylon when it is first used
os.environ["PYLON_CAMEMU"] = "1"


def frames_of(camera: Camera, n: int, timeout_s: float = 10.0) -> list[Frame]:
    came: list[Frame] = []
    end = time.monotonic() + timeout_s
    while len(came) < n and time.monotonic() < end:
        frame = camera.read(0.2)
        came += [frame] if frame else []
    assert len(came) == n
    return came


def emulated() -> Camera:
    pytest.importorskip("pypylon", reason="pypylon is not installed (extra pylon)")
    there = (device.address for report in survey_drivers() for device in report.found)
    found = [address for address in there if address == "pylon:0815-0000"]
    if not found:
        pytest.skip("pylon was used before its emulation was switched on")
    camera = open_device("camera", found[0])
    camera.configure(CameraSettings(rate_hz=50.0, exposure_us=1000.0))
    return camera


def test_pylon_keeps_the_contract() -> None:
    check_camera(emulated)


def test_pylon_replays_images_and_marks_those_that_are_damaged(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    images = [rng.integers(0, 256, (48, 64)).astype(np.uint8) for _ in range(3)]
    for k, image in enumerate(images):
        assert cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    camera: Any = emulated()
    took = camera.configure(CameraSettings(size_px=(64, 48), window=SensorWindow()))
    assert took.size_px == (64, 48)
    library = camera._camera
    library.set("TestImageSelector", "Off")
    library.get("ImageFilename")
    library._nodes.GetNode("ImageFilename").SetValue(str(tmp_path))
    library.set("ImageFileMode", "On")
    camera.start()
    came = frames_of(camera, 6)
    shown = [
        next(k for k, image in enumerate(images) if np.array_equal(image, one.image))
        for one in came
    ]
    assert sorted(set(shown)) == [0, 1, 2]
    assert set(np.diff(shown) % 3) == {1}
    library.set("ForceFailedBufferCount", 3)
    library._nodes.GetNode("ForceFailedBuffer").Execute()
    came = frames_of(camera, 12)
    library.set("ImageFileMode", "Off")
    camera.close()
    assert sum(not frame.is_complete for frame in came) == 3
    numbers = np.diff([frame.number for frame in came])
    assert (numbers == 1).all()


def test_pylon_sets_what_fits_the_camera() -> None:
    camera = emulated()
    took = camera.configure(
        CameraSettings(
            exposure_us=1e9, gain_db=-3.0, window=SensorWindow(100, 40), size_px=(200, 100)
        )
    )
    assert took.exposure_us == 1e7 and took.gain_db == 0.0
    assert camera.setup.window == SensorWindow(100, 40)
    camera.start()
    (frame,) = frames_of(camera, 1)
    assert frame.image.shape == (100, 200) and frame.window == SensorWindow(100, 40)
    took = camera.configure(CameraSettings(window=SensorWindow(0, 0), size_px=(300, 100)))
    frames = frames_of(camera, 20)
    assert frames[-1].image.shape == (100, 300)
    with pytest.raises(DeviceTakenError):
        open_device("camera", "pylon:0815-0000")
    with pytest.raises(DeviceError, match="software trigger"):
        camera.start("software")
    camera.start("external")
    while camera.read(0.0):
        pass
    assert camera.read(0.3) is None
    camera.close()
    with pytest.raises(DeviceError, match="no such camera"):
        open_device("camera", "pylon:4711")


FAKE = """
import sys, time, gi
gi.require_version("Aravis", "0.8")
from gi.repository import Aravis
camera = Aravis.GvFakeCamera.new("127.0.0.1", sys.argv[1])
camera.set_property("gvsp-lost-ratio", float(sys.argv[2]))
print(camera.is_running(), flush=True)
time.sleep(60)
"""


class FakeGigE:
    """Aravis's fake camera in a process of its own."""

    def __init__(self, serial: str, lost: float = 0.0) -> None:
        gi = pytest.importorskip("gi", reason="PyGObject is not installed")
        try:
            gi.require_version("Aravis", "0.8")
        except ValueError:
            pytest.skip("Aravis 0.8 is not installed (gir1.2-aravis-0.8)")
        self.address = f"aravis:Aravis-{serial}"
        self._program = [sys.executable, "-c", FAKE, serial, str(lost)]
        self.run()

    def run(self) -> None:
        self.process = subprocess.Popen(self._program, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        assert self.process.stdout.readline().strip() == "True"

    def end(self) -> None:
        self.process.kill()
        if self.process.stdout is not None:
            self.process.stdout.close()
        self.process.wait()


@pytest.fixture
def fake() -> Iterator[FakeGigE]:
    running = FakeGigE("A1")
    yield running
    running.end()


def small(address: str) -> Camera:
    camera = open_device("camera", address)
    camera.configure(
        CameraSettings(rate_hz=50.0, exposure_us=2000.0, window=SensorWindow(), size_px=(256, 128))
    )
    return camera


def test_aravis_keeps_the_contract(fake: FakeGigE) -> None:
    assert any("Aravis" in one.label for report in survey_drivers() for one in report.found)
    check_camera(lambda: small(fake.address))


def test_aravis_times_are_the_middle_of_the_exposure(fake: FakeGigE) -> None:
    camera = small(fake.address)
    camera.start()
    came = frames_of(camera, 10)
    # the fake camera's clock is that of the system: the frame began before it came
    now = time.time_ns() - time.monotonic_ns()
    delays = [one.t_host_ns + now - (one.t_device_ns - 1_000_000) for one in came]
    assert min(delays) > 0 and np.median(delays) < 60e6
    camera.close()


def test_lost_packets_leave_gaps_or_frames_that_say_so() -> None:
    fake = FakeGigE("A2", lost=0.02)
    camera = small(fake.address)
    lossy: list[Frame] = []
    try:
        camera.start()
        end = time.monotonic() + 6.0
        while time.monotonic() < end:
            frame = camera.read(0.2)
            if frame is not None:
                lossy.append(frame)
    finally:
        camera.close()
        fake.end()
    numbers = np.diff([frame.number for frame in lossy])
    n_missing = int((numbers - 1).sum())
    n_marked = sum(not frame.is_complete for frame in lossy)
    assert (numbers >= 1).all() and n_missing + n_marked > 0
    whole = [frame for frame in lossy if frame.is_complete]
    # the fake draws x + y + the frame's count: a part of another frame breaks the diagonals
    assert len(whole) > 20
    for frame in whole:
        assert len(np.unique(frame.image)) > 20
        np.testing.assert_array_equal(frame.image[1:, :-1], frame.image[:-1, 1:])


def test_a_camera_that_vanishes_is_told_of(fake: FakeGigE) -> None:
    camera = small(fake.address)
    camera.start()
    frames_of(camera, 2)
    fake.end()
    with pytest.raises(DeviceError, match="does not answer"):
        end = time.monotonic() + 20.0
        while time.monotonic() < end:
            camera.read(0.2)
    camera.close()


class Library:
    """A camera of 16-bit frame ids, as GigE Vision 1 counts, in memory."""

    has_short_ids = True

    def __init__(self) -> None:
        self.features: dict[str, Any] = {"PixelFormat": "Mono8", "Width": 4, "Height": 2}
        self.ids = [65_533, 65_534, 65_535, 1, 2, 5]

    def has(self, feature: str) -> bool:
        return feature in self.features

    def get(self, feature: str) -> Any:
        return self.features[feature]

    def set(self, feature: str, value: Any) -> None:
        self.features[feature] = value

    def begin(self) -> None:
        pass

    def fetch(self) -> RawFrame | None:
        if not self.ids:
            time.sleep(0.01)
            return None
        image = np.zeros((2, 4), np.uint8)
        return RawFrame(image, self.ids.pop(0), None, True)

    end = close = begin


def test_short_counts_go_on_after_their_end_and_after_a_start() -> None:
    library = Library()
    camera = GenICamCamera("fake 1", lambda: library, "Line1")
    camera.start()
    assert [frame.number for frame in frames_of(camera, 6)] == [0, 1, 2, 3, 4, 7]
    camera.stop()
    library.ids = [1, 2]
    camera.start()
    assert [frame.number for frame in frames_of(camera, 2)] == [8, 9]
    camera.close()


class TimedLibrary(Library):
    """A camera with a clock, 12.5 ms a frame, that may tell how long each frame was exposed."""

    def __init__(self, exposures_us: list[float] | None = None, **features: Any) -> None:
        super().__init__()
        self.features |= {"ExposureTime": 2000.0, **features}
        self.told_us = exposures_us
        self.n = 0
        self.ids = []

    def set(self, feature: str, value: Any) -> None:
        if feature == "ChunkSelector" and self.told_us is None:
            raise RuntimeError("there is no such feature")
        super().set(feature, value)

    def expose(self, n: int) -> None:
        """Let so many frames come."""
        self.ids += range(self.n + 1, self.n + 1 + n)
        self.n += n

    def fetch(self) -> RawFrame | None:
        raw = super().fetch()
        if raw is None:
            return None
        told = None if self.told_us is None else self.told_us[raw.number - 1]
        return replace(raw, t_camera_ns=12_500_000 * raw.number, exposure_us=told)


def middles_us(frames: list[Frame]) -> list[float]:
    """How long after the start of its exposure each frame is said to have its middle."""
    return [(one.t_device_ns - 12_500_000 * (one.number + 1)) / 1e3 for one in frames]


def test_a_frame_that_tells_its_exposure_is_timed_by_it() -> None:
    library = TimedLibrary([2000.0, 900.0, 4000.0], ExposureAuto="Continuous")
    camera = GenICamCamera("fake chunks", lambda: library, "Line1")
    camera.start()
    library.expose(3)
    frames = frames_of(camera, 3)
    camera.close()
    assert middles_us(frames) == [1000.0, 450.0, 2000.0]
    assert [one.exposure_ns for one in frames] == [2_000_000, 900_000, 4_000_000]
    assert all(one.is_timed for one in frames)
    assert library.features["ChunkEnable"] and library.features["ExposureAuto"] == "Continuous"


def test_frames_under_way_at_a_change_are_not_timed_where_none_tells_its_exposure() -> None:
    library = TimedLibrary()
    camera = GenICamCamera("fake plain", lambda: library, "Line1")
    camera.start()
    library.expose(2)
    before = frames_of(camera, 2)
    camera.configure(CameraSettings(exposure_us=1000.0))
    library.expose(3)
    under_way = frames_of(camera, 3)
    after: list[Frame] = []
    end = time.monotonic() + 10.0
    while not (after and after[-1].is_timed) and time.monotonic() < end:
        library.expose(1)
        after += frames_of(camera, 1)
    camera.close()
    assert all(one.is_timed for one in before) and middles_us(before) == [1000.0, 1000.0]
    # the shorter time: no arrival is earlier than the clock allows
    assert not any(one.is_timed for one in under_way)
    assert {one.exposure_ns for one in under_way} == {1_000_000}
    assert after[-1].is_timed and middles_us(after[-1:]) == [500.0]


def test_a_camera_that_tells_no_exposure_may_not_change_it_by_itself() -> None:
    library = TimedLibrary(ExposureAuto="Continuous")
    camera = GenICamCamera("fake auto", lambda: library, "Line1")
    camera.start()
    library.expose(1)
    (frame,) = frames_of(camera, 1)
    camera.close()
    assert library.features["ExposureAuto"] == "Off" and not library.features["ChunkModeActive"]
    assert frame.is_timed and middles_us([frame]) == [1000.0]


class Stubborn(TimedLibrary):
    """Its word for the exposure control is not the standard's."""

    def get(self, feature: str) -> Any:
        found = super().get(feature)
        return f"AE_{found}" if feature == "ExposureAuto" else found


@pytest.mark.parametrize("wished_us", [None, 2000.0])
def test_what_was_switched_off_counts_as_off_whatever_it_is_called(
    wished_us: float | None,
) -> None:
    library = Stubborn(ExposureAuto="Continuous")
    camera = GenICamCamera("fake stubborn", lambda: library, "Line1")
    if wished_us is not None:
        camera.configure(CameraSettings(exposure_us=wished_us))
    camera.start()
    library.expose(1)
    (frame,) = frames_of(camera, 1)
    camera.close()
    assert library.features["ExposureAuto"] == "Off" and frame.is_timed


class Buffer:
    """One frame of the device below."""

    def __init__(self, number: int) -> None:
        self.get_frame_id = lambda: number
        self.get_timestamp = lambda: 12_500_000 * number
        self.get_status = lambda: "success"
        self.get_data = lambda: bytes(8)


class AravisDevice:
    """A device, camera and stream as Aravis's: an enumeration is an integer, too."""

    def __init__(self) -> None:
        self.names = {"PixelFormat": ["Mono16", "Mono8"], "ExposureAuto": ["Off", "Continuous"]}
        self.numbers: dict[str, float] = {
            "PixelFormat": 1, "ExposureAuto": 1, "Width": 4, "Height": 2, "ExposureTime": 2000.0,
        }  # fmt: skip
        self.buffers = [Buffer(1), Buffer(2)]
        self.connect = self.push_buffer = lambda *_: None
        self.start_acquisition = self.stop_acquisition = lambda: None
        self.get_payload = lambda: 8
        self.get_device = lambda: self
        self.create_stream = lambda *_: self
        self.create_chunk_parser = lambda: self

    def is_feature_available(self, name: str) -> bool:
        return name in self.numbers

    def get_feature(self, name: str) -> Any:
        return Enumeration() if name in self.names else object()

    def get_integer_feature_value(self, name: str) -> int:
        if not isinstance(self.numbers[name], int):
            raise TypeError(f"{name} is no integer")
        return int(self.numbers[name])

    def get_float_feature_value(self, name: str) -> float:
        return self.numbers[name]

    def get_string_feature_value(self, name: str) -> str:
        return self.names[name][int(self.numbers[name])]

    def set_string_feature_value(self, name: str, value: str) -> None:
        self.numbers[name] = self.names[name].index(value)

    def set_boolean_feature_value(self, name: str, value: bool) -> None:
        if name not in self.numbers:
            raise KeyError(name)

    def timeout_pop_buffer(self, wait_us: int) -> Buffer | None:
        return self.buffers.pop(0) if self.buffers else None


class Enumeration:
    """A node of that type."""


def aravis_of(device: AravisDevice) -> Any:
    """A module with what the driver takes of Aravis."""
    cameras = SimpleNamespace(new=lambda _: device, is_gv_device=lambda _: False)
    return SimpleNamespace(
        Camera=cameras,
        GcEnumeration=Enumeration,
        update_device_list=lambda: None,
        Buffer=SimpleNamespace(new_allocate=lambda _: None),
        BufferStatus=SimpleNamespace(SUCCESS="success", CLEARED="cleared", ABORTED="aborted"),
    )


@pytest.mark.parametrize("control", ["Off", "Continuous"])
def test_frames_of_aravis_have_times_whatever_controlled_the_exposure(control: str) -> None:
    device = AravisDevice()
    device.set_string_feature_value("ExposureAuto", control)
    library = AravisLibrary(aravis_of(device), "fake")
    assert library.get("ExposureAuto") == control and library.get("Width") == 4
    assert library.get("ExposureTime") == 2000.0
    camera = GenICamCamera("fake aravis", lambda: library, "Line1")
    camera.start()
    frames = frames_of(camera, 2)
    assert library.get("ExposureAuto") == "Off"
    camera.close()
    assert all(one.is_timed for one in frames)
    assert [one.exposure_ns for one in frames] == [2_000_000, 2_000_000]


WHOLE = {"SensorWidth": 4, "SensorHeight": 2}
OTHER = {"SensorWidth": 8, "SensorHeight": 6}


@pytest.mark.parametrize(
    ("features", "wished", "is_stated"),
    [
        # nobody asked for a window: what the camera says of its sensor may be of another size
        (OTHER, None, False),
        ({}, None, False),
        ({"OffsetX": 2, "OffsetY": 0}, None, True),
        (WHOLE, CameraSettings(window=SensorWindow(), size_px=(4, 2)), False),
        (OTHER, CameraSettings(window=SensorWindow(), size_px=(4, 2)), True),
        (WHOLE, CameraSettings(window=SensorWindow(), size_px=(4, 1)), True),
        ({}, CameraSettings(size_px=(4, 1)), True),
        (OTHER, CameraSettings(exposure_us=500.0), False),
    ],
)
def test_a_window_is_stated_where_somebody_asked_for_one(
    features: dict[str, int], wished: CameraSettings | None, is_stated: bool
) -> None:
    library = Library()
    library.features |= features
    camera = GenICamCamera("fake window", lambda: library, "Line1")
    own = camera.settings
    if wished is not None:
        camera.configure(wished)
    assert camera.setup.window.is_stated == is_stated
    # as it was opened: nobody asks any more
    camera.configure(own)
    assert camera.setup.window.is_stated == ("OffsetX" in features)
    camera.close()


def test_pixels_of_each_format() -> None:
    data = np.arange(12, dtype="<u2").tobytes()
    np.testing.assert_array_equal(image_of(data, 4, 3, "Mono12"), np.arange(12).reshape(3, 4))
    assert image_of(bytes(range(12)), 2, 2, "RGB8")[1, 0].tolist() == [6, 7, 8]
    assert image_of(b"\x07", 2, 1, "Mono8").tolist() == [[7, 0]]
    with pytest.raises(DeviceError, match="not read"):
        image_of(b"", 1, 1, "Mono12p")
