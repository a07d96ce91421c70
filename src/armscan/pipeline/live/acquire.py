# SPDX-License-Identifier: Apache-2.0
"""Streams of a rig, read by one thread a device, matched to instants by another and kept."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import Any, Literal, Protocol

import numpy as np

from armscan.devices.clocks import ElementStatus, StreamMonitor
from armscan.devices.matching import LASER_BOUND_NS, InstantMatcher, MatchedInstant, TimedSample
from armscan.devices.protocols import ArmFlag, ArmSample, Frame, LaserEvent
from armscan.errors import ArmscanError, DeviceStoppedError
from armscan.pipeline.instants import SAME_TIME_NS
from armscan.pipeline.live.rig import Rig, told_as_fault_of
from armscan.records.exposure import Exposure
from armscan.records.recording import CameraSetup
from armscan.storage.recording import demosaiced

READ_S = 0.1
"""A device is asked again after so long, so that a stop is obeyed at once."""
LATE_NS = 100_000_000
"""What arrives so long after the stop was not on its way then: a device did not obey."""
SILENT_S = 2.0
"""A device that delivers nothing for so long is pointed out."""
MOST_WAITING = 512
"""Elements that wait to be matched; more, and this computer cannot keep up."""
MOST_TO_KEEP = 256
"""Elements that are matched and wait to be recorded; then matching waits, and nothing is lost."""
BEHIND_SHARE = 0.25
"""Of them: with more, recording needs the processor, and what is measured live is seldom."""
SEEN_EVERY_NS = 20_000_000
"""So often a device that has nothing says so."""
TOLD_EVERY_S = 10.0
"""So often the same trouble of this computer or a clock is told again."""
BEHIND = "this computer cannot keep up with the recording; the devices' own buffers must hold"

JUMPED = (
    "its clock jumped, or what it sends takes longer from now on; what is found by this clock's "
    "time is placed again when the clock is known anew"
)

WATCHED_NS = 2_000_000_000
"""So long a stream may begin without ids, as before the first trigger."""
FRAMES_WITHOUT = (
    "none of its images bears a trigger's id, and the rig is said to have a common trigger: they "
    "are kept and get no pose; let the camera tell the id, or leave is_common_trigger out"
)
SAMPLES_WITHOUT = (
    "images bear triggers' ids, and none of its samples does: no image gets a pose; let the arm "
    "send a sample with the id at each trigger, or leave is_common_trigger out"
)
IDS_APART = (
    "none of its samples came with the image of its trigger's id: no image gets a pose; let camera "
    "and arm count the same triggers from the same one on, or leave is_common_trigger out"
)
LASERS_MIXED = (
    "what lasers were on is not known: the images bear no trigger's id, and the lasers change "
    f"within {LASER_BOUND_NS / 1e6:g} ms; such images are kept and not measured: use a schedule "
    "of one step, or fewer than 10 triggers a second"
)
LASERS_UNTOLD = (
    "what lasers were on is not known: the images bear no trigger's id, and within "
    f"{LASER_BOUND_NS / 1e6:g} ms of them it told nothing whose time is known; such images are "
    "kept and not measured: see that it triggers and answers"
)
TIMES_APART = (
    f"images of the cameras are more than {SAME_TIME_NS / 1e6:g} ms apart, and no pair to "
    "reconstruct: cameras that are to measure together need one trigger"
)
EXPOSED_APART = (
    f"exposure times of the cameras differ by more than {2 * SAME_TIME_NS / 1e6:g} ms, so that the "
    "middles of what one trigger takes lie apart, and points are wrong while the head moves: give "
    "both cameras one exposure time"
)
STRAINED = {
    ArmFlag.INACCURATE: "it says of itself that its poses are inaccurate: they are not used",
    ArmFlag.END_STOP: "it is at an end stop: its poses are used, and may be worse than usual",
}
"""What an arm's own flags mean for its poses."""

MOST_AHEAD = 16
"""Instants that wait where all are to be measured; further ones are recorded and not shown."""
LATEST_NS = 100_000_000
"""An instant that waited for longer gives way to newer ones with other lasers."""

RECORDER, MATCHING, MEASURING = OWN_PARTS = ("recorder", "matching", "measuring")
"""Named in events in the place of a device."""

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
        Name of the device, or of one of `OWN_PARTS`, that it concerns; empty for none.
    is_final
        Of a fault: the device does nothing until a person has it started again.
    """

    kind: EventKind
    text: str
    device: str = ""
    is_final: bool = False

    @property
    def words(self) -> str:
        """The text, with the device's name where it lacks it."""
        is_named = not self.device or self.device in OWN_PARTS or self.device in self.text
        return self.text if is_named else f"{self.device}: {self.text}"


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


@dataclass(slots=True, eq=False)
class _Recording:
    """From a begin to a pause or a failure."""

    recorder: Recorder
    has_failed: bool = False


@dataclass(slots=True)
class _Stream:
    """How far one device is read.

    Parameters
    ----------
    asked_ns
        Since when a read has not answered; 0 while none is under way.
    seen_ns
        All that arrived before is matched; written by the matching thread.
    """

    asked_ns: int = 0
    seen_ns: int = 0


class IdWatch:
    """Looks at all that arrives and tells what will not be matched; called from one thread.

    Parameters
    ----------
    is_triggered
        True if ids alone decide which pose belongs to a frame.
    has_controller
        True if a laser controller tells what was on.
    is_free
        True if each camera takes images by its own clock.
    """

    def __init__(self, *, is_triggered: bool, has_controller: bool, is_free: bool = False) -> None:
        self._is_free = is_free
        self._is_triggered = is_triggered
        self._has_controller = has_controller
        self._begun_ns: dict[int, int] = {}
        self._cameras_with_ids: set[int] = set()
        self._triggered_ns: int | None = None
        self._arm_ids_ns: int | None = None
        self._has_sample = False
        self._unknown_ns: int | None = None

    def see_frame(self, frame: Frame, camera: int) -> str:
        """What a person should know of this camera now; empty for nothing."""
        begun_ns = self._begun_ns.setdefault(camera, frame.t_host_ns)
        if frame.trigger_id is not None:
            self._cameras_with_ids.add(camera)
            if self._triggered_ns is None:
                self._triggered_ns = frame.t_host_ns
        is_without = self._is_triggered and camera not in self._cameras_with_ids
        return FRAMES_WITHOUT if is_without and frame.t_host_ns > begun_ns + WATCHED_NS else ""

    def see_samples(self, samples: Sequence[ArmSample]) -> str:
        """The same of the arm."""
        if self._arm_ids_ns is None:
            told = (one.t_host_ns for one in samples if one.trigger_id is not None)
            self._arm_ids_ns = next(told, None)
        since_ns = self._triggered_ns
        if not self._is_triggered or self._has_sample or since_ns is None or not samples:
            return ""
        text = SAMPLES_WITHOUT if self._arm_ids_ns is None else IDS_APART
        since_ns = max(since_ns, self._arm_ids_ns or 0)
        return text if samples[-1].t_host_ns > since_ns + WATCHED_NS else ""

    def see_instant(self, instant: MatchedInstant) -> str:
        """The same of the laser controller; what has no time yet tells nothing."""
        if not self._has_controller or instant.trigger_id is not None or instant.t_ns is None:
            return ""
        if instant.lasers is not None:
            self._unknown_ns = None
            return ""
        if self._unknown_ns is None:
            self._unknown_ns = instant.t_ns
        if instant.t_ns <= self._unknown_ns + WATCHED_NS:
            return ""
        return LASERS_MIXED if instant.are_lasers_mixed else LASERS_UNTOLD

    def see_pair(self, instant: MatchedInstant) -> str:
        """What a person should know of the times of two cameras; sees whether the arm's ids fit."""
        self._has_sample |= instant.has_sample
        first, *others = (frame for frame in instant.frames if frame is not None)
        if not others:
            return ""
        if self._is_free:
            known = [t_ns for t_ns in instant.times_ns if t_ns is not None]
            return TIMES_APART if known and max(known) - min(known) > SAME_TIME_NS else ""
        long = [frame.exposure_ns for frame in (first, *others)]
        return EXPOSED_APART if min(long) and max(long) - min(long) > 2 * SAME_TIME_NS else ""


class Acquisition:
    """Reads a rig and hands out its instants in order; nothing that arrives is dropped.

    An instant is handed out before it is recorded: a disk that is behind delays no picture. It
    waits for what belongs to it by what has arrived, not by how far these threads are behind.

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

    Attributes
    ----------
    faults
        What is wrong with the devices that do not answer now, by their place in the rig.
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
        self._watch = IdWatch(
            is_triggered=rig.description.is_common_trigger and rig.arm is not None,
            has_controller=rig.lasers is not None,
            is_free=rig.description.is_free,
        )
        self.faults: dict[tuple[str, int], str] = {}
        self._recording: _Recording | None = None
        self._deliver, self._tell = deliver, tell
        self._arrived: queue.Queue[tuple[str, int, Any]] = queue.Queue(MOST_WAITING)
        self._to_keep: queue.Queue[_ToKeep | threading.Event] = queue.Queue(MOST_TO_KEEP)
        self._keeper: threading.Thread | None = None
        self._devices: dict[tuple[str, int], tuple[Any, StreamMonitor]] = {
            ("frame", k): both
            for k, both in enumerate(zip(rig.cameras, self.matcher.cameras, strict=True))
        }
        if rig.arm is not None:
            self._devices["samples", 0] = rig.arm, self.matcher.arm
        if rig.lasers is not None:
            self._devices["events", 0] = rig.lasers, self.matcher.controller
        self._streams: dict[tuple[str, int], _Stream] = {}
        self._stopping = threading.Event()
        self._stopped_ns = 0
        self._is_broken = threading.Event()
        self._threads: list[threading.Thread] = []
        self._buttons = 0
        self._told_at: dict[tuple[str, str], float] = {}

    def start(self) -> None:
        """Start the rig and the threads.

        Raises
        ------
        DeviceError
            If a device does not answer; all are stopped then.
        """
        self.rig.start()
        self._streams = {key: _Stream() for key in self._devices}
        self._keeper = threading.Thread(target=self._keep, daemon=True)
        self._keeper.start()
        for (what, k), (device, _) in self._devices.items():
            self._run(self._read, what, k, device)
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
        self.wait_until_kept()
        keeper = self._keeper
        if keeper is not None and keeper is not threading.current_thread():
            self._to_keep.put(_END)
            keeper.join()
        # it ends by itself where it was the one that stopped
        self._keeper = None

    @property
    def recorder(self) -> Recorder | None:
        """Set while what arrives is to be recorded; None is set when all before it is kept."""
        return None if self._recording is None else self._recording.recorder

    @recorder.setter
    def recorder(self, recorder: Recorder | None) -> None:
        self._recording = None if recorder is None else _Recording(recorder)
        if recorder is None:
            self.wait_until_kept()

    @property
    def monitored(self) -> tuple[tuple[Any, StreamMonitor], ...]:
        """Cameras, arm and laser controller, as far as there are, each with what watches it."""
        return tuple(self._devices.values())

    @property
    def n_waiting(self) -> int:
        """Elements that wait to be matched or recorded."""
        return self._arrived.qsize() + self._to_keep.qsize()

    @property
    def is_behind(self) -> bool:
        """Whether recording is behind what arrives."""
        return self._to_keep.qsize() > BEHIND_SHARE * MOST_TO_KEEP

    def _run(self, work: Callable[..., None], *given: Any) -> None:
        thread = threading.Thread(target=work, args=given, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _read(self, what: str, k: int, device: Any) -> None:
        """Read one device until it is stopped and empty; a silent one is told of and asked again.

        Drivers are other people's: whatever one of them raises is its device's fault.
        """
        stream = self._streams[what, k]
        try:
            self._read_all(what, k, device, stream)
        finally:
            self._put(what, k, _ALL_SEEN)

    def _read_all(self, what: str, k: int, device: Any, stream: _Stream) -> None:
        last, is_silent, n_faults = time.monotonic(), False, 0
        has_stopped = was_stopped = False
        told_ns = 0
        while True:
            # asked before reading: what came before the stop is then read by this very read
            is_stopped, fault, found = self._stopping.is_set(), "", None
            asked_ns = stream.asked_ns = time.monotonic_ns()
            try:
                with told_as_fault_of(device.name):
                    found = device.read(READ_S)
            except ArmscanError as error:
                fault, has_stopped = str(error), isinstance(error, DeviceStoppedError)
            stream.asked_ns = 0
            if fault:
                self._stopping.wait(READ_S)
            # a fault may stand between what came before and after it, and is raised once then
            n_faults = n_faults + 1 if fault else 0
            if is_stopped and (self._is_late(found) if found else n_faults != 1):
                return
            if found:
                if is_silent:
                    self.faults.pop((what, k), None)
                    self._tell(LiveEvent("recovered", f"{device.name} answers again", device.name))
                last, is_silent = time.monotonic(), False
                has_stopped = was_stopped = False
                self._put(what, k, found)
                continue
            if asked_ns - told_ns > SEEN_EVERY_NS:
                told_ns = asked_ns
                self._put(what, k, asked_ns)
            is_news = has_stopped and not was_stopped
            was_stopped = has_stopped
            is_due = not is_silent and (fault or time.monotonic() - last > SILENT_S)
            if is_news or is_due:
                is_silent = True
                since = f"{device.name} has delivered nothing for {time.monotonic() - last:.1f} s"
                self.faults[what, k] = fault or since
                self._tell(LiveEvent("fault", fault or since, device.name, has_stopped))

    def _is_late(self, found: Any) -> bool:
        first = found[0] if isinstance(found, tuple) else found
        return bool(first.t_host_ns > self._stopped_ns + LATE_NS)

    def wait_until_kept(self) -> None:
        """Wait until what was matched so far is with the recorder; from any thread."""
        keeper, is_kept = self._keeper, threading.Event()
        if keeper is None or keeper is threading.current_thread():
            return
        self._to_keep.put(is_kept)
        while keeper.is_alive() and not is_kept.wait(READ_S):
            """What is before it goes on."""

    @property
    def is_matching(self) -> bool:
        """Whether what arrives still becomes instants."""
        return not self._is_broken.is_set()

    def _put(self, what: str, k: int, found: Any) -> None:
        """Hand on what arrived; while there is no room the device's own buffer must hold."""
        while not self._is_broken.is_set():
            try:
                self._arrived.put((what, k, found), timeout=READ_S)
            except queue.Full:
                self._warn(BEHIND)
            else:
                return

    def _warn(self, text: str, device: str = "") -> None:
        """Tell of trouble, of the same now and then; nothing where there is no text."""
        same = device, text
        if text and time.monotonic() > self._told_at.get(same, -TOLD_EVERY_S) + TOLD_EVERY_S:
            self._told_at[same] = time.monotonic()
            self._tell(LiveEvent("warning", text, device))

    def _match(self) -> None:
        """Match until all is read; whatever ends it early is told, and no reader waits for it."""
        try:
            self._match_all()
        except Exception as error:  # any fault of it must not hang those that wait
            self._is_broken.set()
            text = f"the images are no longer matched: {type(error).__name__}: {error}"
            self._tell(LiveEvent("fault", text, MATCHING))

    def _match_all(self) -> None:
        readers = self._threads[:-1] if self._threads else []
        while True:
            try:
                self._take_in(*self._arrived.get(timeout=READ_S))
            except queue.Empty:
                if self._stopping.is_set() and not any(one.is_alive() for one in readers):
                    self._hand_out(time.monotonic_ns() + 2**40)
                    return
            self._hand_out(self._seen_ns())

    def _seen_ns(self) -> int:
        """All that arrived before this time is taken in; a device that hangs counts no more."""
        now_ns = time.monotonic_ns()
        hangs = now_ns - round(1e9 * SILENT_S)
        read = [one.seen_ns for one in self._streams.values() if not 0 < one.asked_ns < hangs]
        return min(read, default=now_ns)

    def _take_in(self, what: str, k: int, found: Any) -> None:
        stream, (device, monitor) = self._streams[what, k], self._devices[what, k]
        n_jumps = monitor.counts.n_jumps
        if isinstance(found, int):
            stream.seen_ns = max(stream.seen_ns, found)
            return
        if what == "frame":
            status = self.matcher.add_frame(found, k)
            self._record(lambda recorder: recorder.add_frame(k, found, status))
            self._warn(self._watch.see_frame(found, k), device.name)
        elif what == "samples":
            samples = self.matcher.add_samples(found)
            self._record(lambda recorder: recorder.add_samples(samples))
            self._press(found)
            self._warn_of_strain(found, device.name)
            self._warn(self._watch.see_samples(found), device.name)
        else:
            self.matcher.add_events(found)
            self._record(lambda recorder: recorder.add_events(found))
        if monitor.counts.n_jumps > n_jumps:
            self._warn(JUMPED, device.name)
        last = found[-1] if isinstance(found, tuple) else found
        stream.seen_ns = max(stream.seen_ns, last.t_host_ns)

    def _warn_of_strain(self, samples: tuple[ArmSample, ...], arm: str) -> None:
        """Tell of what the arm says against its own poses, while somebody holds it."""
        flags = reduce(or_, (sample.flags for sample in samples), ArmFlag.NONE)
        for flag, text in STRAINED.items():
            if flag in flags:
                self._warn(text, arm)

    def _hand_out(self, seen_ns: int) -> None:
        for instant in self.matcher.take(seen_ns):
            self._deliver(instant)
            self._record_instant(instant)
            self._warn(self._watch.see_pair(instant))
            if self.rig.lasers is not None:
                self._warn(self._watch.see_instant(instant), self.rig.lasers.name)

    def _record_instant(self, instant: MatchedInstant) -> None:
        self._record(lambda recorder: recorder.add_instant(instant))

    def _record(self, write: Callable[[Recorder], None]) -> None:
        recording = self._recording
        while recording is not None and not recording.has_failed:
            with suppress(queue.Full):
                self._to_keep.put((recording, write), timeout=READ_S)
                return

    def _keep(self) -> None:
        """Record in the order of matching; a recording that failed is given nothing more."""
        while (waiting := self._to_keep.get()) is not _END:
            if isinstance(waiting, threading.Event):
                waiting.set()
                continue
            recording, write = waiting
            if recording.has_failed:
                continue
            try:
                write(recording.recorder)
            except Exception as error:  # whatever ends a recording must not hang those that wait
                recording.has_failed = True
                if self._recording is recording:
                    self._recording = None
                fact = error if isinstance(error, ArmscanError) else repr(error)
                self._tell(LiveEvent("warning", f"the recording ended: {fact}", RECORDER))
                if self._keeper is None:
                    return

    def _press(self, samples: tuple[ArmSample, ...]) -> None:
        for sample in samples:
            pressed = sample.buttons & ~self._buttons
            self._buttons = sample.buttons
            for bit in range(pressed.bit_length()):
                if pressed >> bit & 1:
                    self._tell(LiveEvent("button", str(bit), "arm"))


@dataclass(frozen=True, slots=True, eq=False)
class WaitingInstant:
    """An instant that waits to be measured, and since when.

    Parameters
    ----------
    number
        Since the start of the session.
    instant
        What waits.
    since_ns
        By this computer's monotonic clock.
    """

    number: int
    instant: MatchedInstant
    since_ns: int


class WaitingInstants:
    """Instants that wait to be measured; any thread may put, one takes.

    Parameters
    ----------
    is_thinned
        Keep the newest of each choice of lasers; else all, in order, up to `MOST_AHEAD`.
    """

    def __init__(self, *, is_thinned: bool) -> None:
        self._is_thinned, self._is_closed = is_thinned, False
        self._waiting: list[WaitingInstant] = []
        self._measured: dict[tuple[str, ...] | None, int] = {}
        self._changed = threading.Condition()

    def put(self, new: WaitingInstant) -> int:
        """Let an instant wait; how many, it may be itself, do not any more."""
        with self._changed:
            n_before = len(self._waiting)
            if self._is_thinned:
                self._waiting = [one for one in self._waiting if _lasers(one) != _lasers(new)]
            elif n_before >= MOST_AHEAD:
                return 1
            self._waiting.append(new)
            self._changed.notify_all()
            return n_before + 1 - len(self._waiting)

    def take(self) -> tuple[WaitingInstant | None, int]:
        """The next one, None after the end, and how many waited too long."""
        with self._changed:
            while not self._waiting and not self._is_closed:
                self._changed.wait()
            n_before = len(self._waiting)
            if not n_before:
                return None, 0
            if not self._is_thinned:
                return self._waiting.pop(0), 0
            oldest_ns = time.monotonic_ns() - LATEST_NS
            newest = self._waiting[-1]
            young = [one for one in self._waiting if one.since_ns > oldest_ns or one is newest]
            # lasers that take turns shall not be measured by the beat of measuring and triggers
            chosen = min(young, key=lambda one: self._measured.get(_lasers(one), -1))
            self._measured[_lasers(chosen)] = chosen.number
            self._waiting = [one for one in young if one is not chosen]
            return chosen, n_before - len(young)

    def close(self) -> None:
        """Nothing comes any more."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()


def instant_ns(instant: MatchedInstant) -> int:
    """Time of an instant; by the camera's own clock where no other is known."""
    first = next(frame for frame in instant.frames if frame is not None)
    return first.t_device_ns if instant.t_ns is None else instant.t_ns


def exposure_of(
    frame: Frame, setup: CameraSetup, instant: MatchedInstant, camera: int = 0
) -> Exposure:
    """An image as the measuring loop takes it, equal to what a recording of it gives."""
    image = frame.image
    if setup.align == "high":
        image = np.right_shift(image, 8 * image.dtype.itemsize - setup.bits_used)
    if setup.colour == "bayer_rggb":
        image = demosaiced(image)
    return Exposure(
        image,
        f"camera {camera} frame {frame.number}",
        bits_used=setup.bits_used,
        window=frame.window,
        lasers=instant.lasers or (),
        t_ns=instant_ns(instant),
        camera=camera,
        trigger_id=frame.trigger_id,
    )


def _lasers(one: WaitingInstant) -> tuple[str, ...] | None:
    return one.instant.lasers


_ToKeep = tuple[_Recording, Callable[[Recorder], None]]
_END = threading.Event()
"""Ends the keeping thread."""
_ALL_SEEN = 2**62
"""Of a device that is read no more."""
