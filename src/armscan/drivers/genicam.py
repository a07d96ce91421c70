# SPDX-License-Identifier: Apache-2.0
"""Industrial cameras of the GenICam standard, by two libraries: Aravis, and Basler's pylon.

Names of features are those of the Standard Features Naming Convention, with the older ones that
cameras still bear (EMVA, SFNC 2.7).
"""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

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
from armscan.devices.registry import needed_package, split_place
from armscan.drivers.raw_frames import (
    FORMATS,
    ContinuedCount,
    ExposureInUse,
    RawFrame,
    first_told,
    image_of,
)
from armscan.errors import ArmscanError, DeviceError, DeviceTakenError
from armscan.records.exposure import SensorWindow, window_of_sensor
from armscan.records.recording import CameraSetup

_EXPOSURE = ("ExposureTime", "ExposureTimeAbs")
_GAIN = ("Gain", "GainRaw")
_RATE = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
_TELLING = {"ChunkModeActive": True, "ChunkSelector": "ExposureTime", "ChunkEnable": True}
"""Has each frame tell its own exposure time."""
_N_BUFFERS = 16
_FETCH_S = 0.1
PYLON_INSTALL = "pip install 'armscan[pylon]'"
_MOST_FRAMES = 32
ARAVIS_INSTALL = (
    "install your system's packages, on Debian: apt install gir1.2-aravis-0.8 python3-gi; "
    "and in a virtual environment: pip install 'pygobject<3.51'"
)


class GenICamLibrary(Protocol):
    """One opened camera, by one of the libraries; any of its calls may raise anything."""

    has_short_ids: bool

    def has(self, feature: str) -> bool:
        """Whether the camera has a feature now."""

    def get(self, feature: str) -> Any:
        """Value of a feature."""

    def set(self, feature: str, value: Any) -> None:
        """Set a feature, within its bounds and to its increment."""

    def begin(self) -> None:
        """Start the acquisition."""

    def fetch(self) -> RawFrame | None:
        """The next frame, waiting `_FETCH_S` at most."""

    def end(self) -> None:
        """Stop the acquisition."""

    def close(self) -> None:
        """Give the camera back."""


_OPEN: set[str] = set()


class GenICamCamera:
    """See `armscan.devices.protocols.Camera`.

    Parameters
    ----------
    name
        What messages call it, and by which it is open once.
    open_library
        Opens it.
    trigger_line
        Where an external trigger comes in.
    """

    def __init__(
        self, name: str, open_library: Callable[[], GenICamLibrary], trigger_line: str
    ) -> None:
        self.name = name
        self._line = trigger_line
        if name in _OPEN:
            raise DeviceTakenError("it is open already", where=name)
        self._camera = open_library()
        _OPEN.add(name)
        self._inbox: Inbox[Frame] = Inbox(name, _MOST_FRAMES)
        self._is_closed = False
        self._trigger: TriggerMode | None = None
        self._thread: threading.Thread | None = None
        self._numbers = ContinuedCount()
        self._last_camera_ns: int | None = None
        self._exposure = ExposureInUse()
        self._is_auto = self._is_set_off = False
        self._has_asked_window = False
        self._lock = threading.RLock()
        try:
            self._setup = self._read_setup()
            self._settings = self._read_settings()
        except DeviceError:
            self.close()
            raise
        self._exposure.settle(self._settings.exposure_us)

    @property
    def setup(self) -> CameraSetup:
        """Size, window, bits and colour of the frames that it delivers now."""
        return self._setup

    @property
    def settings(self) -> CameraSettings:
        """What is set now."""
        return self._settings

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Set what is not None, and return what the camera took."""
        self._inbox.check_open()
        with self._lock:
            running = self._trigger
            is_resized = settings.window is not None or settings.size_px is not None
            if is_resized:
                # its own settings, which are set again, state a window only where one was asked for
                wished = settings.window
                self._has_asked_window = wished is None or wished.is_stated
            if running is not None and is_resized:
                self._halt()
            if settings.exposure_us is not None:
                self._exposure.begin_change(settings.exposure_us)
            try:
                self._call(lambda: self._apply(settings))
                self._setup = self._read_setup()
                self._settings = self._read_settings()
            finally:
                self._exposure.settle(self._settings.exposure_us)
            self._is_auto = self._has_own_control()
            if running is not None and is_resized:
                self._begin(running)
        return self._settings

    def start(self, trigger: TriggerMode = "free") -> None:
        """Begin to deliver frames; an external trigger comes in by the line of the address."""
        self._inbox.check_open()
        if trigger == "software":
            raise DeviceError("its software trigger is not used", where=self.name)
        with self._lock:
            if self._trigger is not None:
                self._halt()
            else:
                self._inbox.clear()
            self._begin(trigger)

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame; None if none came in time."""
        return self._inbox.take(timeout_s)

    def stop(self) -> None:
        """Take no more; what was taken can still be read."""
        self._inbox.check_open()
        with self._lock:
            self._halt()

    def close(self) -> None:
        """Give the camera back. Does nothing the second time."""
        if self._is_closed:
            return
        with self._lock:
            try:
                self._halt()
            except DeviceError:
                self._trigger = None
            self._is_closed = True
            self._inbox.close()
            _OPEN.discard(self.name)
            self._camera.close()

    def _call(self, work: Callable[[], Any]) -> Any:
        """Do what a library may answer with any exception."""
        try:
            return work()
        except ArmscanError:
            raise
        except Exception as error:
            raise DeviceError(
                f"it does not answer ({type(error).__name__}: {error})",
                where=self.name,
                remedy="check cable, power and whether another program uses it",
            ) from error

    def _begin(self, trigger: TriggerMode) -> None:
        self._call(lambda: self._set_trigger(trigger))
        self._know_exposures()
        self._numbers.begin_anew(self._camera.has_short_ids)
        self._call(self._camera.begin)
        self._trigger = trigger
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _halt(self) -> None:
        thread, self._thread, self._trigger = self._thread, None, None
        if thread is not None:
            thread.join()
            self._call(self._camera.end)

    def _first_of(self, names: tuple[str, ...]) -> str | None:
        return next((name for name in names if self._camera.has(name)), None)

    def _know_exposures(self) -> None:
        """Have frames tell their exposure; else the camera must not change it by itself."""
        try:
            for name, value in _TELLING.items():
                self._camera.set(name, value)
        except Exception:
            # libraries raise whatever they like where a feature or its value is missing
            with suppress(Exception):
                self._camera.set("ChunkModeActive", False)
            if self._has_own_control():
                self._call(lambda: self._switch("ExposureAuto", "Off"))
            self._settings = self._read_settings()
        self._exposure.settle(self._settings.exposure_us)
        self._is_auto = self._has_own_control()

    def _has_own_control(self) -> bool:
        """Whether the camera changes its exposure time by itself.

        What was switched off here is off, in whatever words a library tells of it.
        """
        if self._is_set_off or not self._camera.has("ExposureAuto"):
            return False
        return str(self._call(lambda: self._camera.get("ExposureAuto"))) != "Off"

    def _switch(self, name: str, state: str | bool) -> None:
        self._camera.set(name, state)
        self._is_set_off |= (name, state) == ("ExposureAuto", "Off")

    def _set_trigger(self, trigger: TriggerMode) -> None:
        if self._camera.has("TriggerSelector"):
            self._camera.set("TriggerSelector", "FrameStart")
        if self._camera.has("TriggerMode"):
            self._camera.set("TriggerMode", "On" if trigger == "external" else "Off")
        if trigger == "external" and self._camera.has("TriggerSource"):
            self._camera.set("TriggerSource", self._line)

    def _apply(self, settings: CameraSettings) -> None:
        if settings.size_px is not None or settings.window is not None:
            self._apply_window(settings)
        for names, value in (
            (_RATE, settings.rate_hz),
            (_EXPOSURE, settings.exposure_us),
            (_GAIN, settings.gain_db),
        ):
            name = None if value is None else self._first_of(names)
            if name is None:
                continue
            for switch, state in _SWITCHES.get(name, ()):
                if self._camera.has(switch):
                    self._switch(switch, state)
            self._camera.set(name, value)

    def _apply_window(self, settings: CameraSettings) -> None:
        now = self._setup
        window = settings.window or now.window
        width, height = settings.size_px or (now.width_px or 0, now.height_px or 0)
        step = window.binning
        binned = [("BinningHorizontal", step), ("BinningVertical", step)]
        # a size is bounded by what lies beside the offset: the offset goes to zero first
        sizes = [("OffsetX", 0), ("OffsetY", 0), ("Width", width), ("Height", height)]
        offsets = [("OffsetX", window.x_px // step), ("OffsetY", window.y_px // step)]
        for name, value in (*binned, *sizes, *offsets):
            if self._camera.has(name):
                self._camera.set(name, value)

    def _read_setup(self) -> CameraSetup:
        def read() -> CameraSetup:
            camera = self._camera
            if str(camera.get("PixelFormat")) not in FORMATS:
                camera.set("PixelFormat", "Mono8")
            bits, colour = FORMATS[str(camera.get("PixelFormat"))]
            step = int(camera.get("BinningHorizontal")) if camera.has("BinningHorizontal") else 1
            x, y = (
                int(camera.get(name)) * step if camera.has(name) else 0
                for name in ("OffsetX", "OffsetY")
            )
            size_px = int(camera.get("Width")), int(camera.get("Height"))
            is_asked = self._has_asked_window or (x, y) != (0, 0)
            place = SensorWindow(x, y, step, is_stated=is_asked)
            if is_asked and camera.has("SensorWidth") and camera.has("SensorHeight"):
                sensor_px = int(camera.get("SensorWidth")), int(camera.get("SensorHeight"))
                place = window_of_sensor(place, size_px, sensor_px)
            return CameraSetup(
                *size_px,
                place,
                bits,
                colour=colour,
            )

        found: CameraSetup = self._call(read)
        return found

    def _read_settings(self) -> CameraSettings:
        def read(names: tuple[str, ...]) -> float | None:
            name = self._first_of(names)
            return None if name is None else float(self._camera.get(name))

        setup = self._setup
        return CameraSettings(
            self._call(lambda: read(_EXPOSURE)),
            self._call(lambda: read(_GAIN)),
            self._call(lambda: read(_RATE)),
            setup.window,
            (setup.width_px or 0, setup.height_px or 0),
        )

    def _run(self) -> None:
        """Fetch until the halt; a camera that is gone is told of."""
        me, is_gone = threading.current_thread(), False
        while self._thread is me:
            try:
                raw = self._camera.fetch()
            except Exception as error:
                # libraries raise whatever they like when a cable is pulled
                is_gone = True
                fact = f"it does not answer ({type(error).__name__}: {error})"
                self._inbox.fail(DeviceError(fact, where=self.name))
                time.sleep(_FETCH_S)
                continue
            if raw is None:
                continue
            if is_gone:
                is_gone = False
                self._inbox.fail(None)
            frame = self._frame(raw, time.monotonic_ns())
            if frame is not None:
                self._inbox.put(frame)

    def _frame(self, raw: RawFrame, t_host_ns: int) -> Frame | None:
        """The frame; None where its first packet was lost, which bears its number and time.

        What the library tells then is left from an older frame in the same buffer. The count of
        the next one shows the gap.
        """
        last_ns, t_camera_ns = self._last_camera_ns, raw.t_camera_ns
        if not raw.is_complete and last_ns is not None and (t_camera_ns or 0) <= last_ns:
            return None
        self._last_camera_ns = t_camera_ns
        number = self._numbers.of(raw.number)
        if t_camera_ns is None:
            t_ns, exposure_ns, is_timed = t_host_ns, 0, True
        else:
            exposure_ns, is_timed = self._exposure.of_frame(t_host_ns, raw.exposure_us)
            is_timed = is_timed and not (self._is_auto and raw.exposure_us is None)
            t_ns = t_camera_ns + exposure_ns // 2
        return Frame(
            raw.image, number, t_ns, t_host_ns, window=self._setup.window,
            is_complete=raw.is_complete, exposure_ns=exposure_ns, is_timed=is_timed,
        )  # fmt: skip


_SWITCHES: dict[str, tuple[tuple[str, str | bool], ...]] = {
    "ExposureTime": (("ExposureAuto", "Off"),),
    "ExposureTimeAbs": (("ExposureAuto", "Off"),),
    "Gain": (("GainAuto", "Off"),),
    "GainRaw": (("GainAuto", "Off"),),
    "AcquisitionFrameRate": (("AcquisitionFrameRateEnable", True),),
    "AcquisitionFrameRateAbs": (("AcquisitionFrameRateEnable", True),),
}


class AravisLibrary:
    """A camera by Aravis; see `GenICamLibrary`."""

    def __init__(self, aravis: Any, camera_id: str | None) -> None:
        self._aravis = aravis
        try:
            # without it the camera's interface is not known, and no frame finds the way here
            aravis.update_device_list()
            self._camera = aravis.Camera.new(camera_id)
        except Exception as error:
            where = f"aravis:{camera_id or ''}"
            if "access" in str(error).lower() or "busy" in str(error).lower():
                raise DeviceTakenError(f"{error}", where=where) from error
            raise DeviceError(
                f"no such camera ({error})",
                where=where,
                remedy="'armscan devices --kind camera' lists those that answer",
            ) from error
        self._device = self._camera.get_device()
        self._stream: Any = None
        self._chunks: Any = None
        self._shape = 0, 0, "Mono8"
        self._is_lost = False
        self._device.connect("control-lost", self._lose)
        self.has_short_ids = aravis.Camera.is_gv_device(self._camera)

    def has(self, feature: str) -> bool:
        """Whether the camera has a feature now."""
        return bool(self._device.is_feature_available(feature))

    def get(self, feature: str) -> Any:
        """Value of a feature, by its own type: of an enumeration the name, not its number."""
        # Aravis hands out an enumeration as an integer, too
        if isinstance(self._device.get_feature(feature), self._aravis.GcEnumeration):
            return self._device.get_string_feature_value(feature)
        for read in (
            self._device.get_integer_feature_value,
            self._device.get_float_feature_value,
            self._device.get_string_feature_value,
        ):
            try:
                return read(feature)
            except Exception as error:
                last = error
        raise last

    def set(self, feature: str, value: Any) -> None:
        """Set a feature within its bounds."""
        device = self._device
        if isinstance(value, bool):
            device.set_boolean_feature_value(feature, value)
        elif isinstance(value, str):
            device.set_string_feature_value(feature, value)
        elif isinstance(value, int) or feature == "GainRaw":
            low, high = device.get_integer_feature_bounds(feature)
            step = max(device.get_integer_feature_increment(feature), 1)
            near = int(np.clip(round(value), low, high))
            device.set_integer_feature_value(feature, low + (near - low) // step * step)
        else:
            low, high = device.get_float_feature_bounds(feature)
            device.set_float_feature_value(feature, float(np.clip(value, low, high)))

    def begin(self) -> None:
        """Start the acquisition."""
        self._stream = self._camera.create_stream(None, None)
        self._chunks = self._camera.create_chunk_parser()
        payload = self._camera.get_payload()
        size = int(self.get("Width")), int(self.get("Height"))
        self._shape = *size, str(self.get("PixelFormat"))
        for _ in range(_N_BUFFERS):
            self._stream.push_buffer(self._aravis.Buffer.new_allocate(payload))
        self._camera.start_acquisition()

    def _lose(self, _: object) -> None:
        """The camera did not answer its heartbeat; every further call would wait for seconds."""
        self._is_lost = True

    def fetch(self) -> RawFrame | None:
        """The next frame; one with lost packets says so."""
        if self._is_lost:
            raise ConnectionError("it was unplugged, or lost its power")
        buffer = self._stream.timeout_pop_buffer(round(1e6 * _FETCH_S))
        if buffer is None:
            return None
        try:
            status = self._aravis.BufferStatus
            state = buffer.get_status()
            if state in (status.CLEARED, status.ABORTED):
                return None
            # of a frame that lost packets even the size may be missing
            image = image_of(buffer.get_data(), *self._shape)
            stamp = int(buffer.get_timestamp())
            is_whole = state == status.SUCCESS
            told = first_told(lambda name: self._chunks.get_float_value(buffer, name))
            return RawFrame(image, int(buffer.get_frame_id()), stamp or None, is_whole, told)
        finally:
            self._stream.push_buffer(buffer)

    def end(self) -> None:
        """Stop the acquisition."""
        if not self._is_lost:
            self._camera.stop_acquisition()
        self._stream = None

    def close(self) -> None:
        """Give the camera back: Aravis does so when nothing holds it, so what does is swept up."""
        self._stream = self._chunks = self._device = self._camera = None
        gc.collect()


class PylonLibrary:
    """A camera by Basler's pylon; see `GenICamLibrary`."""

    def __init__(self, pylon: Any, serial: str | None) -> None:
        self._pylon = pylon
        self._genicam = needed_package("pypylon.genicam", PYLON_INSTALL)
        where = f"pylon:{serial or ''}"
        factory = pylon.TlFactory.GetInstance()
        found = [one for one in factory.EnumerateDevices()
                 if serial is None or one.GetSerialNumber() == serial]  # fmt: skip
        if not found:
            raise DeviceError(
                "no such camera", where=where, remedy="'armscan devices --kind camera' lists them"
            )
        try:
            self._camera = pylon.InstantCamera(factory.CreateDevice(found[0]))
            self._camera.Open()
        except Exception as error:
            if "exclusive" in str(error).lower() or "use" in str(error).lower():
                raise DeviceTakenError(f"it cannot be opened ({error})", where=where) from error
            raise DeviceError(f"it cannot be opened ({error})", where=where) from error
        self._camera.MaxNumBuffer.SetValue(_N_BUFFERS)
        self._nodes = self._camera.GetNodeMap()
        self.has_short_ids = "gige" in found[0].GetDeviceClass().lower()
        tick_hz = "GevTimestampTickFrequency"
        self._tick_ns = 1e9 / self.get(tick_hz) if self.has(tick_hz) else 1.0

    def has(self, feature: str) -> bool:
        """Whether the camera has a feature now."""
        node = self._nodes.GetNode(feature)
        return node is not None and bool(self._genicam.IsAvailable(node))

    def get(self, feature: str) -> Any:
        """Value of a feature."""
        return self._nodes.GetNode(feature).GetValue()

    def set(self, feature: str, value: Any) -> None:
        """Set a feature within its bounds."""
        node = self._nodes.GetNode(feature)
        if isinstance(value, bool | str):
            node.SetValue(value)
            return
        near = min(max(value, node.GetMin()), node.GetMax())
        if isinstance(node.GetValue(), int):
            step, low = max(node.GetInc(), 1), node.GetMin()
            near = low + (round(near) - low) // step * step
        node.SetValue(near)

    def begin(self) -> None:
        """Start the acquisition."""
        self._camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne)

    def fetch(self) -> RawFrame | None:
        """The next frame; one with lost packets says so."""
        waited = round(1e3 * _FETCH_S)
        result = self._camera.RetrieveResult(waited, self._pylon.TimeoutHandling_Return)
        if result is None or not result.IsValid():
            if self._camera.IsCameraDeviceRemoved():
                raise ConnectionError("it was unplugged")
            return None
        try:
            is_whole = bool(result.GrabSucceeded())
            if is_whole:
                image = np.array(result.GetArray())
            else:
                # pylon hands out no pixels of a damaged frame: its place is kept, in black
                size = int(self.get("Width")), int(self.get("Height"))
                image = image_of(b"", *size, str(self.get("PixelFormat")))
            stamp = int(result.TimeStamp)
            t_ns = round(self._tick_ns * stamp) if stamp else None
            number = int(result.BlockID)
            if number in _NO_BLOCK:
                return None
            told = first_told(lambda name: result.ChunkDataNodeMap.GetNode(name).GetValue())
            return RawFrame(image, number, t_ns, is_whole, told)
        finally:
            result.Release()

    def end(self) -> None:
        """Stop the acquisition."""
        self._camera.StopGrabbing()

    def close(self) -> None:
        """Give the camera back."""
        self._camera.Close()
        self._camera.DestroyDevice()


_NO_BLOCK = (2**64 - 1,)
"""Told by pylon where a frame's number did not come."""


def _aravis() -> Any:
    gi = needed_package("gi", ARAVIS_INSTALL)
    try:
        gi.require_version("Aravis", "0.8")
    except ValueError:
        # says what to install, as for a package that is missing
        return needed_package("gi.repository.Aravis", ARAVIS_INSTALL)
    return needed_package("gi.repository.Aravis", ARAVIS_INSTALL)


class AravisDriver:
    """Opens ``aravis:`` (the first camera) or ``aravis:ID?line=Line1``: GigE and USB3 Vision."""

    kinds: tuple[DeviceKind, ...] = ("camera",)

    def discover(self) -> tuple[DeviceInfo, ...]:
        """Cameras that answer."""
        aravis = _aravis()
        aravis.update_device_list()
        return tuple(
            DeviceInfo(
                f"aravis:{aravis.get_device_id(k)}",
                "camera",
                f"{aravis.get_device_vendor(k)} {aravis.get_device_model(k)} "
                f"{aravis.get_device_serial_nbr(k)}, {aravis.get_device_protocol(k)}",
            )
            for k in range(aravis.get_n_devices())
        )

    def open(self, kind: DeviceKind, place: str) -> Camera:
        """Open a camera by its id; raises `DeviceError` if it is not there or taken."""
        camera_id, options = split_place(place, ("line",))
        aravis = _aravis()
        return GenICamCamera(
            f"aravis {camera_id or 'camera'}",
            lambda: AravisLibrary(aravis, camera_id or None),
            options.get("line", "Line1"),
        )


class PylonDriver:
    """Opens ``pylon:`` (the first camera) or ``pylon:SERIAL?line=Line1``."""

    kinds: tuple[DeviceKind, ...] = ("camera",)

    def discover(self) -> tuple[DeviceInfo, ...]:
        """Cameras that pylon finds."""
        pylon = needed_package("pypylon.pylon", PYLON_INSTALL)
        return tuple(
            DeviceInfo(f"pylon:{one.GetSerialNumber()}", "camera", one.GetFriendlyName())
            for one in pylon.TlFactory.GetInstance().EnumerateDevices()
        )

    def open(self, kind: DeviceKind, place: str) -> Camera:
        """Open a camera by its serial number; raises `DeviceError` if it is not there or taken."""
        serial, options = split_place(place, ("line",))
        pylon = needed_package("pypylon.pylon", PYLON_INSTALL)
        return GenICamCamera(
            f"pylon {serial or 'camera'}",
            lambda: PylonLibrary(pylon, serial or None),
            options.get("line", "Line1"),
        )


ARAVIS = AravisDriver()
PYLON = PylonDriver()
