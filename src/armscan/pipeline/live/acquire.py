# SPDX-License-Identifier: Apache-2.0
"""Streams of a rig, read by one thread a device and matched to instants by another."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from armscan.devices.clocks import ElementStatus
from armscan.devices.matching import InstantMatcher, MatchedInstant, TimedSample
from armscan.devices.protocols import ArmSample, Frame, LaserEvent
from armscan.errors import ArmscanError
from armscan.pipeline.live.rig import Rig, told_as_fault_of

READ_S = 0.1
"""A device is asked again after so long, so that a stop is obeyed at once."""
LATE_NS = 100_000_000
"""What arrives so long after the stop was not on its way then: a device did not obey."""
SILENT_S = 2.0
"""A device that delivers nothing for so long is pointed out."""
MOST_WAITING = 512
"""Elements that wait to be matched and recorded; more, and this computer cannot keep up."""
BEHIND = "this computer cannot keep up with the recording; the devices' own buffers must hold"

EventKind = Literal["state", "pass", "fault", "recovered", "button", "warning", "setting"]


@dataclass(frozen=True, slots=True)
class LiveEvent:
    """Something that a person should know at once.

    Parameters
    ----------
    kind
        What happened.
    text
        In words.
    device
        Name of the device that it concerns; empty for none.
    """

    kind: EventKind
    text: str
    device: str = ""


class Recorder(Protocol):
    """Keeps all that a rig delivers; raises `ArmscanError` where it cannot."""

    def add_frame(self, camera: int, frame: Frame, status: ElementStatus) -> None:
        """Keep one image as delivered, with its mark."""

    def add_samples(self, samples: tuple[TimedSample, ...]) -> None:
        """Keep samples of the arm, with their marks and times."""

    def add_events(self, events: tuple[LaserEvent, ...]) -> None:
        """Keep what was on."""

    def add_instant(self, instant: MatchedInstant) -> None:
        """Keep what belongs together, at which time and why it has no pose."""


class Acquisition:
    """Reads a rig and hands out its instants in order; nothing that arrives is dropped.

    Parameters
    ----------
    rig
        Opened; it is started and stopped here.
    deliver
        Told of every instant, from the matching thread.
    tell
        Told of faults and buttons.
    latency_ns
        As `armscan.models.calibration.ScannerCalibration.latency_ns`.
    """

    def __init__(
        self,
        rig: Rig,
        deliver: Callable[[MatchedInstant], None],
        tell: Callable[[LiveEvent], None],
        *,
        latency_ns: int = 0,
    ) -> None:
        self.rig = rig
        self.matcher = InstantMatcher(
            len(rig.cameras),
            is_triggered=rig.description.is_common_trigger,
            has_arm=rig.arm is not None,
            has_controller=rig.lasers is not None,
            latency_ns=latency_ns,
            arm=rig.arm_model,
        )
        self.recorder: Recorder | None = None
        """Set while what arrives is to be recorded."""
        self._deliver, self._tell = deliver, tell
        self._arrived: queue.Queue[tuple[str, int, Any]] = queue.Queue(MOST_WAITING)
        self._stopping = threading.Event()
        self._stopped_ns = 0
        self._is_broken = threading.Event()
        self._threads: list[threading.Thread] = []
        self._buttons = 0

    def start(self) -> None:
        """Start the rig and the threads.

        Raises
        ------
        DeviceError
            If a device does not answer; all are stopped then.
        """
        self.rig.start()
        for k, camera in enumerate(self.rig.cameras):
            self._run(self._read, "frame", k, camera)
        if self.rig.arm is not None:
            self._run(self._read, "samples", 0, self.rig.arm)
        if self.rig.lasers is not None:
            self._run(self._read, "events", 0, self.rig.lasers)
        self._run(self._match)

    def stop(self) -> None:
        """Lasers off, all that was taken read and matched; does nothing the second time."""
        for text in self.rig.stop():
            self._tell(LiveEvent("fault", text))
        self._stopped_ns = time.monotonic_ns()
        self._stopping.set()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join()
        self._threads.clear()

    @property
    def n_waiting(self) -> int:
        """Elements that wait to be matched and recorded."""
        return self._arrived.qsize()

    def _run(self, work: Callable[..., None], *given: Any) -> None:
        thread = threading.Thread(target=work, args=given, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _read(self, what: str, k: int, device: Any) -> None:
        """Read one device until it is stopped and empty; a silent one is told of and asked again.

        Drivers are other people's: whatever one of them raises is its device's fault.
        """
        last, is_silent, n_faults = time.monotonic(), False, 0
        while True:
            # asked before reading: what came before the stop is then read by this very read
            is_stopped, fault, found = self._stopping.is_set(), "", None
            try:
                with told_as_fault_of(device.name):
                    found = device.read(READ_S)
            except ArmscanError as error:
                fault = str(error)
                self._stopping.wait(READ_S)
            # a fault may stand between what came before and after it, and is raised once then
            n_faults = n_faults + 1 if fault else 0
            if is_stopped and (self._is_late(found) if found else n_faults != 1):
                return
            if found:
                if is_silent:
                    self._tell(LiveEvent("recovered", f"{device.name} answers again", device.name))
                last, is_silent = time.monotonic(), False
                self._put(what, k, found)
            elif not is_silent and (fault or time.monotonic() - last > SILENT_S):
                is_silent = True
                since = f"{device.name} has delivered nothing for {time.monotonic() - last:.1f} s"
                self._tell(LiveEvent("fault", fault or since, device.name))

    def _is_late(self, found: Any) -> bool:
        first = found[0] if isinstance(found, tuple) else found
        return bool(first.t_host_ns > self._stopped_ns + LATE_NS)

    @property
    def is_matching(self) -> bool:
        """Whether what arrives still becomes instants."""
        return not self._is_broken.is_set()

    def _put(self, what: str, k: int, found: Any) -> None:
        """Hand on what arrived; while there is no room the device's own buffer must hold."""
        is_told = False
        while not self._is_broken.is_set():
            try:
                self._arrived.put((what, k, found), timeout=READ_S)
            except queue.Full:
                if not is_told:
                    self._tell(LiveEvent("warning", BEHIND, "recorder"))
                is_told = True
            else:
                return

    def _match(self) -> None:
        """Match until all is read; whatever ends it early is told, and no reader waits for it."""
        try:
            self._match_all()
        except Exception as error:  # any fault of it must not hang those that wait
            self._is_broken.set()
            text = f"the images are no longer matched: {type(error).__name__}: {error}"
            self._tell(LiveEvent("fault", text))

    def _match_all(self) -> None:
        readers = self._threads[:-1] if self._threads else []
        while True:
            try:
                self._take_in(*self._arrived.get(timeout=READ_S))
            except queue.Empty:
                if self._stopping.is_set() and not any(one.is_alive() for one in readers):
                    self._hand_out(time.monotonic_ns() + 2**40)
                    return
            self._hand_out(time.monotonic_ns())

    def _take_in(self, what: str, k: int, found: Any) -> None:
        if what == "frame":
            status = self.matcher.add_frame(found, k)
            self._record(lambda recorder: recorder.add_frame(k, found, status))
        elif what == "samples":
            samples = self.matcher.add_samples(found)
            self._record(lambda recorder: recorder.add_samples(samples))
            self._press(found)
        else:
            self.matcher.add_events(found)
            self._record(lambda recorder: recorder.add_events(found))

    def _hand_out(self, now_ns: int) -> None:
        for instant in self.matcher.take(now_ns):
            self._record_instant(instant)
            self._deliver(instant)

    def _record_instant(self, instant: MatchedInstant) -> None:
        self._record(lambda recorder: recorder.add_instant(instant))

    def _record(self, write: Callable[[Recorder], None]) -> None:
        recorder = self.recorder
        if recorder is None:
            return
        try:
            write(recorder)
        except ArmscanError as error:
            self.recorder = None
            self._tell(LiveEvent("warning", f"the recording ended: {error}", "recorder"))

    def _press(self, samples: tuple[ArmSample, ...]) -> None:
        for sample in samples:
            pressed = sample.buttons & ~self._buttons
            self._buttons = sample.buttons
            for bit in range(pressed.bit_length()):
                if pressed >> bit & 1:
                    self._tell(LiveEvent("button", str(bit), "arm"))
