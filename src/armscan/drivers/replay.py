# SPDX-License-Identifier: Apache-2.0
"""A recording as devices: its cameras, its arm and its lasers play it at its own pace or another.

Times are the recorded ones where it is played at its own pace. At another they are stretched, all
alike, so that what lies between them keeps its place.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import merge
from pathlib import Path
from typing import Any

import numpy as np

from armscan.devices.inbox import DeviceClock, FaultyLine
from armscan.devices.protocols import (
    Arm,
    ArmFlag,
    ArmSample,
    Camera,
    CameraSettings,
    DeviceInfo,
    DeviceKind,
    Fault,
    Frame,
    LaserController,
    LaserEvent,
    TriggerMode,
)
from armscan.devices.registry import number_option, split_place
from armscan.devices.sources import ScanSource
from armscan.errors import ArmscanError, DeviceError, OptionError
from armscan.records.exposure import Exposure
from armscan.records.recording import (
    LASER_UNKNOWN,
    NO_TRIGGER,
    CameraSetup,
    ExposureRow,
    PoseForm,
)
from armscan.storage.recording import read_recording

_MOST = {"camera": 64, "arm": 20_000, "lasers": 2_000}
_READ_AHEAD = 8
"""Images that are read before their time has come."""
_LEAST_STEP_NS = 1_000_000

Play = tuple[int, str, Any]
"""Time since the first, in ns of the recording; the device; and the row or sample."""


@dataclass(frozen=True, slots=True)
class _Plan:
    """What an address says, the number of the camera apart."""

    path: str
    rate_hz: float
    is_loop: bool
    is_ahead: bool


def _plan(place: str) -> tuple[_Plan, int]:
    path, options = split_place(place, ("rate", "loop", "ahead", "camera"))
    for key in ("loop", "ahead"):
        if options.get(key, "0") not in ("0", "1"):
            raise OptionError(f"{key}={options[key]} is neither 0 nor 1", where=place)
    if not path:
        raise OptionError("no recording is named", remedy="write replay:scan?rate=20")
    plan = _Plan(
        str(Path(path).resolve()),
        number_option(options, "rate", 0.0, 1e4),
        options.get("loop") == "1",
        options.get("ahead") == "1",
    )
    return plan, int(number_option(options, "camera", 0, 1))


class Playback:
    """A recording that is played, as soon as all devices that are open were started.

    Parameters
    ----------
    rate_hz
        Middle rate of the exposures of one camera; 0 for that of the recording.
    is_loop
        Begin anew at the end; triggers and times go on.
    is_ahead
        Read all images into memory first.
    """

    def __init__(
        self, source: ScanSource, *, rate_hz: float = 0.0, is_loop: bool = False, is_ahead: bool
    ) -> None:
        if not source.rows:
            raise DeviceError("the recording holds no exposure", where=source.name)
        self.source = source
        self.sources = tuple(sorted({name for row in source.rows for name in row.lasers}))
        self._are_lasers_told = _are_lasers_told(source.rows)
        ids = [row.trigger_id for row in source.rows if row.trigger_id is not None]
        self._ids_of_round = max(ids) - min(ids) + 1 if ids else 0
        self._is_loop = is_loop
        self._lasers = _lasers_of(source.rows)
        self._plays = _plays(source)
        own_ns = _usual_step_ns(source)
        self._slower = 1.0 if rate_hz == 0.0 else 1e9 / rate_hz / own_ns
        self._length_ns = self._plays[-1][0] + own_ns
        self._kept: dict[int, Exposure] = {}
        self.setups = tuple(
            self._setup(camera, setup) for camera, setup in enumerate(source.session.cameras)
        )
        if is_ahead:
            self._kept = {row: self._exposure(row) for row in range(len(source.rows))}
        # at its own pace the devices' clocks show the recorded times
        clock = DeviceClock(self._first_ns(), 0.0, 0)
        names = [f"camera{k}" for k in range(len(self.setups))]
        names += ["arm"] if source.arm is not None else []
        self.lines: dict[str, FaultyLine[Any]] = {
            name: FaultyLine(
                f"replay {source.name} {name}",
                _MOST[name.rstrip("0123456789")],
                clock,
                delay_ns=0,
                spread_ns=0,
                rng=np.random.default_rng(0),
            )
            for name in (*names, *(["lasers"] if self._are_lasers_told else []))
        }
        self._clock = clock
        self.started: set[str] = set()
        self.lock = threading.Condition()
        self._is_closed = False
        self._is_playing = False
        self._images: queue.Queue[Exposure | ArmscanError] = queue.Queue(_READ_AHEAD)
        self._threads = [
            threading.Thread(target=work, daemon=True) for work in (self._read_ahead, self._play)
        ]
        for thread in self._threads:
            thread.start()

    def start(self, device: str) -> None:
        """Let a device deliver; the recording runs once all open ones do."""
        with self.lock:
            if device not in self.started:
                self.lines[device].inbox.clear()
            self.started.add(device)
            self.lock.notify_all()

    def stop(self, device: str) -> None:
        """Let a device deliver no more; where none does, the recording waits."""
        with self.lock:
            self.started.discard(device)
            self.lock.notify_all()

    def inject(self, device: str, fault: Fault, amount: float = 1.0) -> None:
        """Make a device fail: see `FaultyLine.inject`; raises `OptionError` for other devices."""
        if device not in self.lines or not amount > 0.0:
            raise OptionError(f"no device '{device}', or no fault by {amount}")
        self.lines[device].inject(fault, amount)

    def open(self, device: str) -> None:
        """Take a device; raises `DeviceError` if there is none, or it is taken."""
        if device not in self.lines:
            raise DeviceError(
                f"the recording has no {device}",
                where=self.source.name,
                remedy="leave this device out",
            )
        self.lines[device].open()

    def close(self, device: str) -> bool:
        """Give a device back; True if it was the last, and the playback is over."""
        self.stop(device)
        self.lines[device].close()
        if any(line.is_open for line in self.lines.values()):
            return False
        self.end()
        return True

    def end(self) -> None:
        """Let the threads end."""
        with self.lock:
            self._is_closed = True
            self.lock.notify_all()
        for thread in self._threads:
            thread.join()

    def _first_ns(self) -> int:
        first = self.source.rows[0].t_ns
        arm = self.source.arm
        return min(first, int(arm.t_ns[0])) if arm is not None and len(arm) else first

    def _setup(self, camera: int, setup: CameraSetup) -> CameraSetup:
        for number, row in enumerate(self.source.rows):
            if row.camera == camera:
                seen = self._exposure(number)
                return CameraSetup(
                    seen.width_px, seen.height_px, seen.window, seen.bits_used, colour=seen.colour
                )
        return setup

    def _exposure(self, row: int) -> Exposure:
        kept = self._kept.get(row)
        if kept is not None:
            return kept
        try:
            return self.source.exposure(row)
        except ArmscanError as error:
            raise DeviceError(error.what, where=error.where, remedy=error.remedy) from error

    def _rounds(self) -> Iterator[tuple[int, Play]]:
        """What is played, with the number of the round."""
        number = 0
        while number == 0 or self._is_loop:
            yield from ((number, play) for play in self._plays)
            number += 1

    def _read_ahead(self) -> None:
        for _, (_, device, what) in self._rounds():
            if not device.startswith("camera"):
                continue
            found: Exposure | ArmscanError
            try:
                found = self._exposure(what)
            except ArmscanError as error:
                found = error
            while not self._is_closed:
                try:
                    self._images.put(found, timeout=0.05)
                    break
                except queue.Full:
                    continue
            if self._is_closed:
                return

    def _play(self) -> None:
        later_ns = 0
        for number, (since_ns, device, what) in self._rounds():
            paused_ns = self._wait_for_readers()
            if not later_ns:
                later_ns = self._clock.zero_ns = time.monotonic_ns() + _LEAST_STEP_NS
                paused_ns = 0
            later_ns += paused_ns
            t_ns = later_ns + round(self._slower * (since_ns + number * self._length_ns))
            element = self._element(number, device, what)
            self._wait_until(t_ns)
            if self._is_closed:
                return
            line = self.lines[device]
            if element is None or device not in self.started:
                line.number += 1
            else:
                line.send(t_ns, element)

    def _wait_for_readers(self) -> int:
        """Wait until all open devices were started, or until one is again; how long, in ns."""
        asked_ns = time.monotonic_ns()
        with self.lock:
            if self._is_playing and self.started:
                return 0
            while not self._is_closed:
                opened = {name for name, line in self.lines.items() if line.is_open}
                self._is_playing = bool(opened) and opened <= self.started
                if self._is_playing:
                    break
                self.lock.wait()
        return time.monotonic_ns() - asked_ns

    def _wait_until(self, t_ns: int) -> None:
        with self.lock:
            while not self._is_closed and (rest_ns := t_ns - time.monotonic_ns()) > 0:
                self.lock.wait(1e-9 * rest_ns)

    def _element(self, number: int, device: str, what: int) -> Any:
        """A frame, sample or event; None for an image that cannot be read."""
        rows = self.source.rows
        passed = number * self._ids_of_round
        if device == "arm":
            return self._sample(what, passed)
        row = rows[what]
        trigger_id = None if row.trigger_id is None else row.trigger_id + passed
        if device == "lasers":
            counted = what + number * len(rows) if trigger_id is None else trigger_id
            return LaserEvent(counted, 0, 0, self._lasers[what])
        seen = self._next_image()
        if isinstance(seen, Exposure):
            # where no row names a laser nobody knows, and it is taken to have been on
            is_known = self._are_lasers_told and LASER_UNKNOWN not in row.flags
            lasers = self._lasers[what] if is_known else None
            return Frame(seen.image, 0, 0, 0, trigger_id, lasers, seen.window)
        if seen is not None:
            self.lines[device].inbox.fail(DeviceError(seen.what, where=seen.where))
        return None

    def _next_image(self) -> Exposure | ArmscanError | None:
        while not self._is_closed:
            try:
                return self._images.get(timeout=0.05)
            except queue.Empty:
                continue
        return None

    def _sample(self, row: int, passed: int) -> ArmSample | None:
        track = self.source.arm
        if track is None:
            return None
        trigger_id = None
        if track.trigger_ids is not None and track.trigger_ids[row] != NO_TRIGGER:
            trigger_id = int(track.trigger_ids[row]) + passed
        is_known = bool(track.is_known[row])
        joints = track.joints_rad[row] if track.joints_rad is not None and is_known else None
        return ArmSample(
            0,
            0,
            0,
            track.pose(row) if is_known else None,
            joints,
            flags=ArmFlag.REFERENCED if is_known else ArmFlag.NONE,
            trigger_id=trigger_id,
        )


def _plays(source: ScanSource) -> list[Play]:
    """All exposures, instants of lasers that are known, and samples, by time from 0."""
    frames = [(row.t_ns, f"camera{row.camera}", k) for k, row in enumerate(source.rows)]
    lights, last = [], None
    are_told = _are_lasers_told(source.rows)
    for k, row in enumerate(source.rows):
        moment = _moment(row)
        if are_told and LASER_UNKNOWN not in row.flags and moment != last:
            lights.append((row.t_ns, "lasers", k))
            last = moment
    samples: list[tuple[int, str, int]] = []
    if source.arm is not None:
        samples = [(int(t_ns), "arm", k) for k, t_ns in enumerate(source.arm.t_ns)]
    every = list(merge(sorted(frames), sorted(lights), samples, key=lambda play: play[0]))
    return [(t_ns - every[0][0], device, what) for t_ns, device, what in every]


def _moment(row: ExposureRow) -> tuple[int | None, int]:
    """Alike for the rows of two cameras at one instant."""
    return row.trigger_id, row.t_ns if row.trigger_id is None else 0


def _lasers_of(rows: Sequence[ExposureRow]) -> list[tuple[str, ...]]:
    """(N,) lasers of each row's instant, of which the row of one camera is enough."""
    named = {_moment(row): row.lasers for row in rows if row.lasers}
    return [row.lasers or named.get(_moment(row), ()) for row in rows]


def _are_lasers_told(rows: Sequence[ExposureRow]) -> bool:
    """Whether a row without lasers was dark: others name some, or say that they are not known."""
    return any(row.lasers or LASER_UNKNOWN in row.flags for row in rows)


def _usual_step_ns(source: ScanSource) -> int:
    times = [row.t_ns for row in source.rows if row.camera == source.rows[0].camera]
    steps = np.diff(np.array(times, dtype=np.int64))
    return max(int(np.median(steps)), _LEAST_STEP_NS) if len(steps) else 1_000_000_000


class _Played:
    """What the devices of a recording have in common."""

    def __init__(self, rig: Playback, device: str) -> None:
        rig.open(device)
        self.rig = rig
        self._device = device

    @property
    def is_simulated(self) -> bool:
        """Whether what it plays is simulated."""
        return self.rig.source.session.is_simulated

    @property
    def name(self) -> str:
        """What messages call it."""
        return self._line.inbox.name

    def stop(self) -> None:
        """Take no more; what was taken can still be read."""
        self._line.check_answers()
        self.rig.stop(self._device)

    def close(self) -> None:
        """Give it back. Does nothing the second time."""
        with _PLAYED_LOCK:
            if self._line.is_open and self.rig.close(self._device):
                for plan in [plan for plan, rig in _PLAYED.items() if rig is self.rig]:
                    del _PLAYED[plan]

    def _begin(self) -> None:
        self._line.check_answers()
        self.rig.start(self._device)

    @property
    def _line(self) -> FaultyLine[Any]:
        return self.rig.lines[self._device]


class ReplayedCamera(_Played):
    """See `armscan.devices.protocols.Camera`; what is recorded cannot be set."""

    def __init__(self, rig: Playback, camera: int) -> None:
        super().__init__(rig, f"camera{camera}")
        self._camera = camera

    @property
    def setup(self) -> CameraSetup:
        """Size, window, bits and colour of the frames."""
        return self.rig.setups[self._camera]

    @property
    def settings(self) -> CameraSettings:
        """What a recording says: the window alone."""
        size = (self.setup.width_px or 0, self.setup.height_px or 0)
        return CameraSettings(window=self.setup.window, size_px=size)

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Change nothing; the settings are those of the recording."""
        self._line.check_answers()
        return self.settings

    def start(self, trigger: TriggerMode = "free") -> None:
        """Begin to deliver frames, whatever triggered them."""
        self._begin()

    def read(self, timeout_s: float) -> Frame | None:
        """The next frame; None if none came in time."""
        self._line.mend()
        found: Frame | None = self._line.inbox.take(timeout_s)
        return found


class ReplayedArm(_Played):
    """See `armscan.devices.protocols.Arm`."""

    def __init__(self, rig: Playback) -> None:
        super().__init__(rig, "arm")

    @property
    def pose_form(self) -> PoseForm:
        """How the recording keeps the poses."""
        return self.rig.source.session.pose_form

    def start(self) -> None:
        """Begin to deliver samples."""
        self._begin()

    def read(self, timeout_s: float) -> tuple[ArmSample, ...]:
        """All samples that came since the last call; waits for the first."""
        self._line.mend()
        found: tuple[ArmSample, ...] = self._line.inbox.take_all(timeout_s)
        return found


class ReplayedLasers(_Played):
    """See `armscan.devices.protocols.LaserController`; what was on cannot be changed."""

    def __init__(self, rig: Playback) -> None:
        super().__init__(rig, "lasers")

    @property
    def sources(self) -> tuple[str, ...]:
        """Laser sources that were on at some time."""
        return self.rig.sources

    def set_schedule(self, steps: Sequence[tuple[str, ...]]) -> None:
        """Raise `DeviceError`."""
        raise DeviceError(
            "the lasers of a recording are what they were",
            where=self.name,
            remedy="leave the schedule out",
        )

    def set_next(self, lasers: tuple[str, ...]) -> None:
        """Raise `DeviceError`."""
        self.set_schedule([lasers])

    def start(self, rate_hz: float | None) -> None:
        """Begin to deliver events; the rate is that of the address."""
        self._begin()

    def read(self, timeout_s: float) -> tuple[LaserEvent, ...]:
        """All events since the last call; waits for the first."""
        self._line.mend()
        found: tuple[LaserEvent, ...] = self._line.inbox.take_all(timeout_s)
        return found


_PLAYED: dict[_Plan, Playback] = {}
_PLAYED_LOCK = threading.Lock()


class ReplayDriver:
    """Opens ``replay:PATH?rate=20``: devices of one recording, folder or MCAP, which run together.

    Options: ``rate`` exposures a second of one camera, ``camera=1`` the second one, ``loop=1``
    begin anew at the end, ``ahead=1`` read all images into memory first.
    """

    kinds: tuple[DeviceKind, ...] = ("camera", "arm", "lasers")

    def discover(self) -> tuple[DeviceInfo, ...]:
        """Nothing: recordings are named."""
        return ()

    def open(self, kind: DeviceKind, place: str) -> Camera | Arm | LaserController:
        """Open one device of a recording."""
        plan, camera = _plan(place)
        with _PLAYED_LOCK:
            rig = _PLAYED.get(plan) or _playback(plan)
            try:
                if kind == "camera":
                    return ReplayedCamera(rig, camera)
                return ReplayedArm(rig) if kind == "arm" else ReplayedLasers(rig)
            except DeviceError:
                if not any(line.is_open for line in rig.lines.values()):
                    rig.end()
                raise
            finally:
                if any(line.is_open for line in rig.lines.values()):
                    _PLAYED[plan] = rig


def _playback(plan: _Plan) -> Playback:
    try:
        source = read_recording(Path(plan.path))
        rig = Playback(source, rate_hz=plan.rate_hz, is_loop=plan.is_loop, is_ahead=plan.is_ahead)
    except ArmscanError as error:
        raise DeviceError(error.what, where=error.where, remedy=error.remedy) from error
    return rig


DRIVER = ReplayDriver()
