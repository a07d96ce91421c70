# SPDX-License-Identifier: Apache-2.0
"""Every driver against the contract of devices, and the contract against drivers that break it."""

from __future__ import annotations

import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from armscan.devices.contract import ContractError, check_arm, check_camera, check_lasers
from armscan.devices.protocols import ArmSample, Camera, CameraSettings, Frame
from armscan.devices.registry import open_device, survey_drivers
from armscan.drivers.arm_stream import encode_sample
from armscan.errors import DeviceError, DriverMissingError, OptionError
from armscan.geometry.poses import Pose
from armscan.records.exposure import SensorWindow
from rigs.laser_controller import ReferenceController
from rigs.recording_folders import lab_folder

TWIN = "twin:thesis-cross?scene=plate&preset=clean&rate=20&pause=0&loop=1"


def small_twin(place: str = TWIN) -> Camera:
    camera = open_device("camera", place)
    camera.configure(CameraSettings(window=SensorWindow(1400, 1000), size_px=(300, 100)))
    return camera


def test_twin() -> None:
    # rendering is compiled first where nothing is yet
    check_camera(small_twin, timeout_s=60.0)
    check_arm(lambda: open_device("arm", TWIN))
    check_lasers(lambda: open_device("lasers", TWIN))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> str:
    times = [1_000_000_000 + 20_000_000 * k for k in range(3)]
    rows = "".join(f"{k},{t},0,images/{k}.png,A,{k + 1}\n" for k, t in enumerate(times))
    arm = "".join(f"{995_000_000 + 5_000_000 * k},{900 + k},0,400,1,0,0,0\n" for k in range(12))
    folder = lab_folder(
        tmp_path_factory.mktemp("replay"),
        exposures=f"index,t_ns,camera,file,lasers,trigger_id\n{rows}",
        arm=f"t_ns,x_mm,y_mm,z_mm,qw,qx,qy,qz\n{arm}",
    )
    return f"replay:{folder}?loop=1"


def test_replay(recording: str) -> None:
    check_camera(lambda: open_device("camera", recording))
    check_arm(lambda: open_device("arm", recording))
    check_lasers(lambda: open_device("lasers", recording), can_switch=False)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "film.avi"
    codec = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), codec, 50.0, (64, 48))
    for k in range(10):
        image = np.zeros((48, 64, 3), np.uint8)
        image[:, 4 * k : 4 * k + 8] = (20, 40, 250)
        writer.write(image)
    writer.release()
    return path


def test_webcam_in_form_of_a_video(video: Path) -> None:
    check_camera(lambda: open_device("camera", f"webcam:{video}?loop=1"), is_exclusive=False)
    colour = open_device("camera", f"webcam:{video}?loop=1&colour=rgb")
    colour.start()
    frame = colour.read(2.0)
    colour.close()
    assert frame is not None and frame.image.shape == (48, 64, 3)
    # the bar is red: 250 of red, 20 of blue, but for what JPEG makes of it
    red, _, blue = frame.image[:, 2:6].reshape(-1, 3).mean(axis=0)
    assert red > 180.0 and blue < 80.0


def test_a_video_ends_and_a_webcam_is_told_so(video: Path) -> None:
    camera = open_device("camera", f"webcam:{video}?rate=500")
    camera.start()
    came = []
    with pytest.raises(DeviceError, match="the video is over"):
        while True:
            came.append(camera.read(0.5))
    camera.close()
    assert [frame.number for frame in came if frame] == list(range(10))
    for place, error in (("no-such.avi", DeviceError), ("9", DeviceError), ("", OptionError)):
        with pytest.raises(error):
            open_device("camera", f"webcam:{place}")
    video.with_name("empty.avi").write_bytes(b"")
    with pytest.raises(DeviceError, match="no image"):
        open_device("camera", f"webcam:{video.with_name('empty.avi')}")


def test_arm_stream() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        wanted = True

        def send() -> None:
            number = 0
            while wanted:
                client, _ = server.accept()
                with client:
                    try:
                        while wanted:
                            number += 1
                            pose: Any = Pose(np.eye(3), np.array([number, 0.0, 0.0]))
                            one = ArmSample(number, 5_000_000 * number, 0, pose)
                            client.sendall(encode_sample(one))
                            time.sleep(0.005)
                    except OSError:
                        continue

        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        address = f"tcp:127.0.0.1:{server.getsockname()[1]}"
        # who sends may send to any number
        check_arm(lambda: open_device("arm", address), is_exclusive=False)
        wanted = False
        with socket.create_connection(server.getsockname()):
            thread.join()


def test_laser_serial() -> None:
    pytest.importorskip("serial")
    firmware = ReferenceController()
    check_lasers(lambda: open_device("lasers", firmware.address))
    assert not firmware.is_on
    firmware.end()


def found_addresses() -> set[str]:
    return {device.address for report in survey_drivers() for device in report.found}


def test_the_driver_of_the_page_is_found_and_keeps_the_contract(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = Path(__file__).parents[2] / "docs" / "how-to" / "write-a-device-driver.md"
    program, check = re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL)
    (points,) = re.findall(r"```toml\n(.*?)```", page.read_text("utf-8"), re.DOTALL)
    (tmp_path / "my_camera.py").write_text(program, "utf-8")
    about = tmp_path / "mine-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1\n")
    named = points.replace('[project.entry-points."armscan.devices"]', "[armscan.devices]")
    (about / "entry_points.txt").write_text(named.replace('"', ""))
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "mycamera:0" in found_addresses()
    space: dict[str, Any] = {}
    exec(check, space)
    space["test_my_camera"]()


class Broken:
    """A camera of the twin, one of whose answers is changed."""

    def __init__(self, **changes: Callable[[Any, Any], Any]) -> None:
        self._camera: Any = small_twin()
        self._changes = changes

    def __getattr__(self, name: str) -> Any:
        known = getattr(self._camera, name)
        change = self._changes.get(name)
        if change is None:
            return known
        return lambda *given: change(known, given[0] if given else None)


_BUFFER: list[Any] = []


def _reused(read: Any, timeout_s: float) -> Frame | None:
    """Frames that share one buffer."""
    frame: Frame | None = read(timeout_s)
    if frame is None:
        return None
    _BUFFER[:] = [*_BUFFER, np.zeros_like(frame.image)][:1]
    _BUFFER[0][:] = frame.image
    return replace(frame, image=_BUFFER[0])


def _changed(**changes: Any) -> Callable[[Any, float], Frame | None]:
    def read(read: Any, timeout_s: float) -> Frame | None:
        frame: Frame | None = read(timeout_s)
        return frame and replace(frame, **changes)

    return read


_HELD: dict[str, Frame | None] = {}


def _starting(start: Any, trigger: Any) -> None:
    _HELD["again"] = _HELD.get("last")
    start(trigger)


def _holding(read: Any, timeout_s: float) -> Frame | None:
    """After a start, first of all the last frame of before the stop."""
    again = _HELD.pop("again", None)
    if again is not None:
        return again
    frame: Frame | None = read(timeout_s)
    _HELD["last"] = frame or _HELD.get("last")
    return frame


def _late(read: Any, timeout_s: float) -> Any:
    time.sleep(1.0)
    return read(timeout_s)


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"read": _reused}, "copy it out of the buffer"),
        ({"read": _changed(number=3)}, "count does not increase"),
        ({"read": _changed(t_device_ns=3)}, "time does not increase"),
        ({"read": _changed(t_host_ns=3)}, "not those of time.monotonic_ns"),
        ({"read": _changed(image=np.zeros((3, 3)))}, "not uint8"),
        ({"read": _changed(image=np.zeros((3, 3), np.uint8))}, "but setup says"),
        ({"read": _changed(window=SensorWindow(1, 1))}, "frames show"),
        ({"read": _late}, "keep to the timeout"),
        ({"read": lambda read, _: ()}, r"\(\) where nothing came|no Frame|frames came"),
        ({"stop": lambda stop, _: None}, "though it is not started"),
        ({"start": _starting, "read": _holding}, "had taken before the stop"),
        ({"close": lambda close, _: None}, "after close"),
        ({"configure": lambda configure, _: CameraSettings()}, "without values changed"),
    ],
)
def test_a_camera_that_breaks_a_rule_is_caught(changes: dict[str, Any], rule: str) -> None:
    opened: list[Broken] = []

    def open_broken() -> Any:
        opened.append(Broken(**changes))
        return opened[-1]

    try:
        with pytest.raises(ContractError, match=rule):
            check_camera(open_broken, n_frames=3, timeout_s=3.0)
    finally:
        for camera in opened:
            camera._camera.close()


def test_lasers_that_do_not_follow_are_caught() -> None:
    class Stubborn(Broken):
        def __init__(self) -> None:
            super().__init__(set_next=lambda set_next, _: None)
            self._camera.close()
            self._camera = open_device("lasers", TWIN)

    opened: list[Any] = []

    def open_stubborn() -> Any:
        opened.append(Stubborn())
        return opened[-1]

    try:
        with pytest.raises(ContractError, match="raises no error"):
            check_lasers(open_stubborn)
    finally:
        for one in opened:
            one._camera.close()


def test_drivers_are_listed_with_what_keeps_them_from_working(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = {report.name: report for report in survey_drivers()}
    assert {"twin", "replay", "tcp", "serial", "laser-serial", "webcam"} <= set(names)
    assert names["twin"].kinds == ("camera", "arm", "lasers") and not names["twin"].problem
    assert "twin:thesis-single" in found_addresses()
    for address in ("moon:1", "", "twin"):
        try:
            open_device("camera", address).close()
        except OptionError as error:
            assert "no driver is called" in str(error) and error.remedy
    monkeypatch.setitem(__import__("sys").modules, "serial", None)
    with pytest.raises(DriverMissingError, match=r"armscan\[serial\]"):
        open_device("arm", "serial:/dev/ttyUSB0")
    problem = {report.name: report.problem for report in survey_drivers()}["serial"]
    assert "pip install 'armscan[serial]'" in problem


@pytest.fixture(autouse=True)
def _all_is_given_back() -> Iterator[None]:
    yield
    alive = [thread.name for thread in threading.enumerate() if thread.name == "twin"]
    assert alive == []
