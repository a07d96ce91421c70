# SPDX-License-Identifier: Apache-2.0
"""A webcam on a bench, or a video file in its place, by OpenCV.

Such a camera has no clock, no trigger and no count of its own: frames are counted as they come,
and their time is that of arrival. It serves to try out, not to scan while moving.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from armscan.devices.inbox import Inbox
from armscan.devices.protocols import (
    Camera,
    CameraSettings,
    DeviceInfo,
    DeviceKind,
    Frame,
    TriggerMode,
)
from armscan.devices.registry import number_option, split_place
from armscan.errors import DeviceError, DeviceTakenError, OptionError
from armscan.records.recording import CameraSetup

_MOST_FRAMES = 16
_MOST_CAMERAS = 10
_BLIND_READS = 20
"""So many reads without an image, and the camera is gone."""
_OPEN: set[str] = set()


class Webcam:
    """See `armscan.devices.protocols.Camera`.

    Parameters
    ----------
    place
        Number of the camera as the system counts them, or path of a video file.
    rate_hz
        Of a file; 0 for its own.
    is_loop
        Begin a file anew at its end.
    """

    def __init__(self, place: str, *, is_grey: bool, rate_hz: float, is_loop: bool) -> None:
        self.name = f"webcam {place}"
        self._place, self._is_grey, self._is_loop = place, is_grey, is_loop
        self._is_file = not place.isdecimal()
        if not self._is_file and place in _OPEN:
            raise DeviceTakenError("it is open already", where=self.name)
        if self._is_file and not Path(place).is_file():
            raise DeviceError(
                "there is no such file", where=place, remedy="write webcam:0, or webcam:film.avi"
            )
        self._capture: Any = cv2.VideoCapture(place if self._is_file else int(place))
        is_there, image = self._capture.read()
        if not is_there:
            self._capture.release()
            raise DeviceError(
                "it gives no image",
                where=self.name,
                remedy="check that it is plugged in, no other program uses it, and the file is a "
                "video",
            )
        if self._is_file:
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
        own_hz = float(self._capture.get(cv2.CAP_PROP_FPS))
        self._rate_hz = rate_hz or (own_hz if 0.0 < own_hz < 1e4 else 25.0)
        self._image = self._made(image)
        self._inbox: Inbox[Frame] = Inbox(self.name, _MOST_FRAMES)
        self._number = 0
        self._is_started = False
        self._is_closed = False
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        _OPEN.add(place)

    @property
    def setup(self) -> CameraSetup:
        """Size and colour of the frames."""
        height, width = self._image.shape[:2]
        return CameraSetup(width, height, colour="mono" if self._is_grey else "rgb")

    @property
    def settings(self) -> CameraSettings:
        """Rate and size: exposure and gain have no unit that such cameras agree on."""
        height, width = self._image.shape[:2]
        return CameraSettings(
            rate_hz=self._rate_hz, window=self.setup.window, size_px=(width, height)
        )

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Set the rate; nothing else can be set in units."""
        self._inbox.check_open()
        if settings.rate_hz is not None:
            with self._lock:
                if not self._is_file:
                    self._capture.set(cv2.CAP_PROP_FPS, settings.rate_hz)
                    told = float(self._capture.get(cv2.CAP_PROP_FPS))
                    self._rate_hz = told if told > 0.0 else self._rate_hz
                else:
                    self._rate_hz = float(np.clip(settings.rate_hz, 0.1, 1e3))
        return self.settings

    def start(self, trigger: TriggerMode = "free") -> None:
        """Begin to deliver frames."""
        self._inbox.check_open()
        if trigger != "free":
            raise DeviceError(
                "a webcam cannot be triggered",
                where=self.name,
                remedy="set trigger = 'free' for the rig",
            )
        if not self._is_started:
            self._inbox.clear()
            self._is_started = True
            self._thread = threading.Thread(target=self._run, daemon=True)
            self._thread.start()

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame; None if none came in time."""
        return self._inbox.take(timeout_s)

    def stop(self) -> None:
        """Take no more; what was taken can still be read."""
        self._inbox.check_open()
        self._halt()

    def close(self) -> None:
        """Give the camera back. Does nothing the second time."""
        if not self._is_closed:
            self._halt()
            self._is_closed = True
            self._capture.release()
            self._inbox.close()
            _OPEN.discard(self._place)

    def _halt(self) -> None:
        self._is_started = False
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _made(self, image: Any) -> Any:
        """A frame's image, of the camera's blue-green-red or grey."""
        if self._is_grey:
            return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.ndim == 3 else cv2.COLOR_GRAY2RGB)

    def _run(self) -> None:
        due_s, n_blind = time.monotonic(), 0
        while self._is_started:
            with self._lock:
                is_there, image = self._capture.read()
                if not is_there and self._is_file and self._is_loop:
                    self._capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
                    continue
            now_ns = time.monotonic_ns()
            if not is_there:
                n_blind += 1
                if self._is_file or n_blind > _BLIND_READS:
                    fact = "the video is over" if self._is_file else "it gives no image any more"
                    self._inbox.fail(DeviceError(fact, where=self.name))
                    return
                continue
            n_blind = 0
            self._inbox.put(Frame(self._made(image), self._number, now_ns, now_ns))
            self._number += 1
            if self._is_file:
                due_s = max(due_s + 1.0 / self._rate_hz, time.monotonic() - 1.0)
                time.sleep(max(due_s - time.monotonic(), 0.0))


class WebcamDriver:
    """Opens ``webcam:0`` or ``webcam:film.avi``.

    Options: ``colour=rgb`` for colour, ``rate`` of a file, ``loop=1`` begin a file anew.
    """

    kinds: tuple[DeviceKind, ...] = ("camera",)

    def discover(self) -> tuple[DeviceInfo, ...]:
        """Cameras that the system lists; on Linux alone, elsewhere asking would open them."""
        names = sorted(Path("/sys/class/video4linux").glob("video*/name"))
        found = []
        for path in names:
            number = path.parent.name.removeprefix("video")
            if number.isdecimal() and int(number) < _MOST_CAMERAS:
                label = path.read_text("utf-8", "replace").strip()
                found.append(DeviceInfo(f"webcam:{number}", "camera", label))
        return tuple(found)

    def open(self, kind: DeviceKind, place: str) -> Camera:
        """Open a webcam or a video file."""
        path, options = split_place(place, ("colour", "rate", "loop"))
        colour, loop = options.get("colour", "mono"), options.get("loop", "0")
        if not path or colour not in ("mono", "rgb") or loop not in ("0", "1"):
            raise OptionError(
                f"'{place}' is no webcam", remedy="write webcam:0?colour=mono, or a video's path"
            )
        return Webcam(
            path,
            is_grey=colour == "mono",
            rate_hz=number_option(options, "rate", 0.0, 1e3),
            is_loop=loop == "1",
        )


DRIVER = WebcamDriver()
