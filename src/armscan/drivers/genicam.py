# SPDX-License-Identifier: Apache-2.0
"""Industrial cameras of the GenICam standard, by two libraries: Aravis, and Basler's pylon.

Names of features are those of the Standard Features Naming Convention, with the older ones that
cameras still bear (EMVA, SFNC 2.7).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

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
from armscan.drivers.genicam_libraries import (
    FETCH_S,
    FORMATS,
    PYLON_INSTALL,
    AravisLibrary,
    GenICamLibrary,
    PylonLibrary,
    RawFrame,
)
from armscan.errors import ArmscanError, DeviceError, DeviceTakenError
from armscan.records.exposure import SensorWindow
from armscan.records.recording import CameraSetup

_EXPOSURE = ("ExposureTime", "ExposureTimeAbs")
_GAIN = ("Gain", "GainRaw")
_RATE = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")
_CHUNKS = (("ChunkModeActive", True), ("ChunkSelector", "ExposureTime"), ("ChunkEnable", True))
"""Has each frame tell its own exposure time."""
_UNDER_WAY, _UNDER_WAY_NS = 3, 100_000_000
"""So many frames, and all that came so soon, may still have been exposed as before a change."""
_SMALL_CHANGE_NS = 50_000
"""A change by less moves no middle by more than 25 us."""
_MOST_FRAMES = 32
_SHORT_IDS = 65_535
"""GigE Vision 1 counts frames from 1 to this and then begins again at 1."""
ARAVIS_INSTALL = (
    "install your system's packages, on Debian: apt install gir1.2-aravis-0.8 python3-gi; "
    "and in a virtual environment: pip install 'pygobject<3.51'"
)
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
        self._numbers = _Count()
        self._last_camera_ns: int | None = None
        self._exposure = _ExposureInUse()
        self._is_auto = False
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
            for name, value in _CHUNKS:
                self._camera.set(name, value)
        except Exception:
            # libraries raise whatever they like where a feature or its value is missing
            with suppress(Exception):
                self._camera.set("ChunkModeActive", False)
            if self._has_own_control():
                self._call(lambda: self._camera.set("ExposureAuto", "Off"))
            self._settings = self._read_settings()
        # none that is under way outlives a stop
        self._exposure.settle(self._settings.exposure_us)
        self._is_auto = self._has_own_control()

    def _has_own_control(self) -> bool:
        """Whether the camera changes its exposure time by itself."""

        def ask() -> bool:
            camera = self._camera
            return camera.has("ExposureAuto") and str(camera.get("ExposureAuto")) != "Off"

        return bool(self._call(ask))

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
                    self._camera.set(switch, state)
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
            return CameraSetup(
                int(camera.get("Width")),
                int(camera.get("Height")),
                SensorWindow(x, y, step),
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
                time.sleep(FETCH_S)
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
            exposure_ns, is_sure = self._exposure.of_frame(t_host_ns)
            if raw.exposure_us is not None:
                exposure_ns, is_sure = round(1e3 * raw.exposure_us), True
            is_timed = is_sure and not (self._is_auto and raw.exposure_us is None)
            t_ns = t_camera_ns + exposure_ns // 2
        return Frame(
            raw.image, number, t_ns, t_host_ns, window=self._setup.window,
            is_complete=raw.is_complete, exposure_ns=exposure_ns, is_timed=is_timed,
        )  # fmt: skip


_SWITCHES = {
    "ExposureTime": (("ExposureAuto", "Off"),),
    "ExposureTimeAbs": (("ExposureAuto", "Off"),),
    "Gain": (("GainAuto", "Off"),),
    "GainRaw": (("GainAuto", "Off"),),
    "AcquisitionFrameRate": (("AcquisitionFrameRateEnable", True),),
    "AcquisitionFrameRateAbs": (("AcquisitionFrameRateEnable", True),),
}


class _ExposureInUse:
    """The exposure time of frames that do not tell their own; any thread may ask.

    After a change nobody tells which frame is the first of the new time. Until all that were under
    way must have come, the shorter one is told, with which no arrival is too early, as not sure.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._possible_ns: tuple[int, ...] = (0,)
        self._is_changing = False
        self._settled_ns = self._n_since = 0

    def begin_change(self, wished_us: float) -> None:
        """Another time is about to be set."""
        with self._lock:
            self._possible_ns = (*self._possible_ns, round(1e3 * wished_us))
            self._is_changing = True

    def settle(self, exposure_us: float | None) -> None:
        """This one is set now."""
        with self._lock:
            set_ns = round(1e3 * (exposure_us or 0.0))
            if self._is_changing:
                self._settled_ns, self._n_since = time.monotonic_ns(), 0
                self._possible_ns = (min(self._possible_ns), max(self._possible_ns), set_ns)
            else:
                self._possible_ns = (set_ns,)
            self._is_changing = False

    def of_frame(self, t_host_ns: int) -> tuple[int, bool]:
        """Exposure time in ns of a frame that arrives, and whether it is sure."""
        with self._lock:
            self._n_since += 1
            is_late = t_host_ns > self._settled_ns + _UNDER_WAY_NS
            if not self._is_changing and is_late and self._n_since > _UNDER_WAY:
                self._possible_ns = self._possible_ns[-1:]
            least, most = min(self._possible_ns), max(self._possible_ns)
            is_sure = most - least <= _SMALL_CHANGE_NS
            return (self._possible_ns[-1] if is_sure else least), is_sure


class _Count:
    """A count that goes on where the camera's begins anew."""

    def __init__(self) -> None:
        self._last = -1
        self._base: int | None = 0
        self._turn = 0

    def begin_anew(self, has_short_ids: bool) -> None:
        """The camera counts from its beginning again, after a start."""
        self._turn = _SHORT_IDS if has_short_ids else 0
        self._base = None

    def of(self, number: int) -> int:
        """The frame's number among all since the camera was opened."""
        if self._base is None:
            self._base = self._last + 1 - number
        while self._turn and number + self._base < self._last - self._turn // 2:
            self._base += self._turn
        self._last = number + self._base
        return self._last


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
