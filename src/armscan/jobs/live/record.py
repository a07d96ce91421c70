# SPDX-License-Identifier: Apache-2.0
"""Recording a rig to one file until somebody ends it, and measuring meanwhile where it is known."""

from __future__ import annotations

import math
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from armscan.devices.protocols import AT_END_STOP, INACCURATE
from armscan.devices.registry import device_drivers, open_device
from armscan.errors import DeviceError, OptionError, OutputError
from armscan.jobs.live.recordings import SUFFIX
from armscan.models.calibration import ScannerCalibration
from armscan.pipeline.live.acquire import MATCHING, OWN_PARTS, RECORDER, LiveEvent
from armscan.pipeline.live.recorder import LiveRecorder
from armscan.pipeline.live.rig import MOST_RATE_HZ, Rig, RigDescription, read_rig
from armscan.pipeline.live.session import LiveOptions, LiveSession, LiveStatus
from armscan.pipeline.simulate import TwinName
from armscan.report.quantity import Quantity, Summary, plural
from armscan.storage.documents import read_scanner_calibration
from armscan.storage.files import (
    SetAside,
    bring_back,
    check_aside,
    check_outputs,
    locked,
    set_aside,
)
from armscan.storage.recordings.write_mcap import WriterOptions, WriterStatus

TOLD_EVERY_S = 1.0
CLOCKS_S = 5.0
"""Recording begins when the devices' clocks are known, or after so long with those that are."""
LOOK_S = 0.02
TWIN = "twin:"
TRIGGER_AND_EXPOSURE = (
    "with a common trigger a pose is that of the trigger, and the middle of an exposure moves "
    'against it as its time changes: set mode = "fixed" in [exposure]'
)


@dataclass(frozen=True, slots=True)
class RecordRequest:
    """What is recorded, and until when.

    Parameters
    ----------
    rig
        Path of ``rig.toml``, or the address of a simulated rig, ``twin:HEAD``; empty where the
        devices are given.
    scanner
        Path of ``scanner.json``, to measure meanwhile; None for that of ``rig.toml``, if any.
    seconds, n_exposures
        End after so long, or so many; None for never.
    rate_hz
        Triggers a second; None for what ``rig.toml`` says, or the default.
    is_common_trigger
        Frames and arm samples bear ids of one trigger, whatever ``rig.toml`` says.
    """

    rig: str = ""
    devices: RigDescription = field(default_factory=lambda: RigDescription(()))
    scanner: Path | None = None
    seconds: float | None = None
    n_exposures: int | None = None
    rate_hz: float | None = None
    is_common_trigger: bool = False
    is_stripe_band: bool = False

    def description(self) -> RigDescription:
        """The rig that is asked for."""
        self._check_numbers()
        is_named = bool(self.devices.cameras or self.devices.arm or self.devices.lasers)
        if self.rig and is_named:
            raise OptionError(
                "both a rig's description and devices are given", remedy="leave one of them out"
            )
        if not self.rig and not self.devices.cameras:
            raise OptionError(
                "no camera is named",
                remedy="give rig.toml, or --camera with an address that `armscan devices` lists",
            )
        found = self.devices
        if self.rig.startswith(TWIN):
            found = _simulated(self.rig)
        elif self.rig:
            driver, colon, _ = self.rig.partition(":")
            if colon and driver in device_drivers() and not Path(self.rig).exists():
                raise OptionError(
                    f"{self.rig} is the address of one device",
                    remedy="give it as --camera, --arm or --lasers",
                )
            found = read_rig(Path(self.rig))
        return replace(
            found,
            rate_hz=found.rate_hz if self.rate_hz is None else self.rate_hz,
            is_common_trigger=found.is_common_trigger or self.is_common_trigger,
        )

    def _check_numbers(self) -> None:
        for option, value in (("--seconds", self.seconds), ("--exposures", self.n_exposures)):
            if value is not None and not 0 < value < math.inf:
                raise OptionError(
                    f"{value:g} is no time or count to record",
                    where=option,
                    remedy="give a number above 0, or leave it out: Ctrl-C ends the recording",
                )
        if self.rate_hz is not None and not 0.0 < self.rate_hz <= MOST_RATE_HZ:
            raise OptionError(
                f"{self.rate_hz:g} triggers a second",
                where="--rate",
                remedy=f"give a rate above 0 and up to {MOST_RATE_HZ:g}",
            )


def _simulated(address: str) -> RigDescription:
    """All devices of a simulated rig, with both cameras where its head has two."""
    head, _, query = address.removeprefix(TWIN).partition("?")
    twin = TwinName(head or "thesis-single", "thesis", 1).build()
    second = f"{address}{'&' if query else '?'}camera=1"
    cameras = (address,) if twin.truth.right_camera_parameters is None else (address, second)
    return RigDescription(
        cameras, address, address, is_common_trigger="wired=0" not in query.split("&")
    )


def record_scan(
    request: RecordRequest,
    output: Path,
    tell: Callable[[str], None],
    *,
    show_rate: Callable[[str], None] | None = None,
    is_overwriting: bool = False,
) -> Summary:
    """Record until the time or count is reached, or Ctrl-C; what is there is then whole.

    ``tell``: told at once of faults. ``show_rate``: told once a second how it goes; None for
    ``tell``.

    Raises
    ------
    DeviceError
        If a device does not answer at the start, no image came at all, what arrived could not be
        kept to the end, or none of it can be used; what was written stays.
    OutputError
        If the file exists, a killed run left what it was to replace, or the disk is full; what was
        written stays.
    """
    description = request.description()
    if output.suffix.lower() != SUFFIX:
        raise OptionError(
            f"the output's name ends in '{output.suffix}'", where=f"-o {output}",
            remedy=f"end it in {SUFFIX}",
        )  # fmt: skip
    check_outputs((output,), is_overwriting=is_overwriting)
    check_aside(output)
    place = request.scanner or (Path(description.scanner) if description.scanner else None)
    if description.chooses_lasers and place is None:
        raise OptionError(
            "chooses_lasers asks the scanner which lasers come next, and no scanner is given",
            where=request.rig,
            remedy='give --scanner, or schedule = ["A", "B"] in place of chooses_lasers',
        )
    scanner = None if place is None else read_scanner_calibration(place)
    tell("opening the devices ...")
    if description.is_common_trigger and description.arm and description.exposure.mode != "fixed":
        tell(f"warning: {TRIGGER_AND_EXPOSURE}")
    with Rig.open(description, open_device) as rig:
        rig.set_windows()
        options = WriterOptions(is_stripe_band=request.is_stripe_band)
        told = tell, show_rate or tell
        run = _Recording(rig, scanner, output, options, told, is_overwriting=is_overwriting)
        run.until_the_end(request)
    return run.summary(place)


@contextmanager
def _deaf() -> Iterator[None]:
    """A second Ctrl-C does not cut short what ends a recording."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class _Recording:
    """One recording from its begin to its end."""

    def __init__(
        self,
        rig: Rig,
        scanner: ScannerCalibration | None,
        output: Path,
        writer_options: WriterOptions,
        tell: tuple[Callable[[str], None], Callable[[str], None]],
        *,
        is_overwriting: bool = False,
    ) -> None:
        self._is_overwriting = is_overwriting
        self._output, (self._tell, self._show_rate) = output, tell
        self._recorder = LiveRecorder(output, rig, options=writer_options)
        options = LiveOptions.of(rig.description)
        self._session = LiveSession(rig, scanner, options=options, recorder=self._recorder)
        self._session.add_listener(self._hear)
        self._has_arm = rig.arm is not None
        self._is_measuring = scanner is not None
        self._n_faults = 0
        self._seconds = 0.0
        self._end = WriterStatus(0, 0, 0.0, 0, 0)
        self._before = replace(self._end), 0.0
        self._is_interrupted = False
        self._before_it: SetAside | None = None
        self._held = ExitStack()
        self._own_file: os.stat_result | None = None
        self._why_ended = ""
        self._is_over = False
        self._is_triggered = rig.description.is_common_trigger

    def until_the_end(self, request: RecordRequest) -> None:
        """Record; the file is whole afterwards, whatever happens."""
        self._session.open()
        try:
            self._wait_for_clocks()
            self._put_aside()
            self._recorder.begin()
            self._own_file = self._output.stat()
            self._held.enter_context(locked(self._output))
            self._session.add_listener(self._recorder.hear)
            start = time.monotonic()
            self._session.start()
            try:
                self._watch(request, start)
            except KeyboardInterrupt:
                self._is_interrupted = True
            self._seconds = time.monotonic() - start
        except BaseException:
            with _deaf():
                self._session.stop()
                with suppress(OutputError):
                    self._close()
            raise
        is_kept = self._session.is_recording and not self._is_over
        with _deaf():
            self._session.stop()
            self._close()
        self._check_end(is_kept)

    def _check_end(self, is_kept: bool) -> None:
        """An error where there is nothing to go on with, or not all."""
        if not self._end.n_written:
            raise DeviceError(
                f"no image came in {self._seconds:.1f} s"
                + (f"; {self._why_ended}" if self._why_ended else ""),
                remedy="check camera and trigger; `armscan devices` lists what answers",
            )
        if not self._recorder.n_usable or any(self._recorder.unplaced):
            raise self._useless()
        if not is_kept:
            raise DeviceError(
                f"after {self._seconds:.1f} s {self._why_ended}",
                where=str(self._output),
                remedy="what came before is whole",
            )

    def _useless(self) -> DeviceError:
        """Says why no reader can measure or place any exposure, by what most of them lack."""
        recorder = self._recorder
        n_untriggered = recorder.n_untriggered if self._has_arm else 0
        reasons = (
            (
                recorder.n_aside,
                "parts of them were lost, or their clock was not known",
                "record longer or at a higher rate, or say that one trigger takes image and "
                "pose (--common-trigger)",
            ),
            (
                n_untriggered,
                "they bear no trigger's id, and ids alone give poses",
                "let the cameras tell the id, or record without is_common_trigger",
            ),
            (
                recorder.n_of_other_count,
                "they bear ids of samples of the arm that came long before or after",
                "let camera and arm count the same triggers from the same one on",
            ),
            (
                recorder.n_laser_unknown,
                "it is not known what lasers were on",
                "see that the laser controller answers, and use a schedule of one step or fewer "
                "triggers a second",
            ),
        )
        _, fact, remedy = max(reasons, key=lambda reason: reason[0])
        if recorder.n_usable:
            fact, remedy = recorder.unplaced
        return DeviceError(
            f"none of {self._end.n_written} exposures can be used: {fact}"
            + (f"; {self._why_ended}" if self._why_ended else ""),
            where=str(self._output),
            remedy=f"{remedy}; the file keeps them",
        )

    def _put_aside(self) -> None:
        """What is to be replaced, until this recording has ended with an image."""
        self._before_it = set_aside(self._output, is_overwriting=self._is_overwriting)
        if self._before_it is not None:
            name = self._before_it.path.name
            self._tell(f"what was there lies in {name} until the recording ends")

    def _close(self) -> None:
        """The new file where it holds an image; else what was there before."""
        is_new = False
        try:
            self._end = self._recorder.close()
        finally:
            if self._recorder.is_begun:
                is_new = self._recorder.status().n_written > 0
                if not is_new and self._is_own_there():
                    self._output.unlink()
            self._held.close()
            if self._before_it is not None and is_new:
                self._remove(self._before_it)
            elif self._before_it is not None:
                self._bring_back(self._before_it)

    def _is_own_there(self) -> bool:
        """Whether the name is still that of its own file: what another run made is not ours."""
        with suppress(OSError):
            own = self._own_file
            return own is not None and os.path.samestat(own, self._output.stat())
        return False

    def _remove(self, before: SetAside) -> None:
        if not before.remove():
            self._tell(
                f"warning: what was there before lies in {before.path.name} and is not removed: "
                "another run wrote it meanwhile, or it may not be removed; rename it to keep it"
            )

    def _bring_back(self, before: SetAside) -> None:
        try:
            bring_back(before, self._output)
        except OutputError as error:
            self._tell(f"warning: {error}")

    def _wait_for_clocks(self) -> None:
        """Without an arm nothing is placed by time, so that nobody waits for clocks."""
        end = time.monotonic() + CLOCKS_S
        while self._has_arm and not self._session.is_timed and time.monotonic() < end:
            time.sleep(LOOK_S)
        if self._has_arm and not self._session.is_timed and not self._is_triggered:
            self._tell(
                f"warning: after {CLOCKS_S:g} s not all clocks are related to this computer's; "
                "what comes before they are is kept, and used by nobody"
            )

    def _watch(self, request: RecordRequest, start: float) -> None:
        told = start
        while True:
            time.sleep(LOOK_S)
            now = time.monotonic()
            status = self._recorder.status()
            is_over = request.seconds is not None and now - start >= request.seconds
            wanted = request.n_exposures
            if is_over or (wanted is not None and status.n_accepted >= wanted):
                return
            if self._is_over or not self._session.is_recording:
                return
            if now - told >= TOLD_EVERY_S:
                told = now
                self._show_rate(self._line(status, now - start))

    def _line(self, status: WriterStatus, seconds: float) -> str:
        """How it goes, in one line."""
        before, then = self._before
        self._before = status, seconds
        speed = (status.n_bytes - before.n_bytes) / max(seconds - then, 1e-3)
        rate = (status.n_accepted - before.n_accepted) / max(seconds - then, 1e-3)
        free = shutil.disk_usage(self._output.parent).free
        # chunks are written now and then: how long the space lasts follows from the whole
        lasts = f" ({free * seconds / status.n_bytes / 60.0:,.0f} min)" if status.n_accepted else ""
        n_lost, n_late = self._losses()
        words = [
            f"{seconds:5.0f} s",
            f"{status.n_accepted:,} exposures",
            f"{rate:.1f}/s",
            f"lost {n_lost}, late {n_late}, not to be used {self._n_unusable}",
            f"{speed / 1e6:.0f} MB/s, {free / 1e9:,.0f} GB left{lasts}",
        ]
        if self._recorder.n_samples and not self._recorder.n_posed:
            words.append("the arm gives no pose")
        if status.fill > 0.5:
            words.append(f"the disk is behind ({100.0 * status.fill:.0f} % of the buffer)")
        shown = self._session.snapshot()
        if self._is_measuring:
            words.append(f"{shown.n_points:,} points in {shown.n_passes} passes")
        if shown.latency_ms is not None:
            words.append(f"{shown.latency_ms[0]:.0f} ms to the screen")
        return "  ".join(words)

    @property
    def _n_unusable(self) -> int:
        """Exposures that are kept, and that no reader places or measures."""
        return self._recorder.n_exposures - self._recorder.n_usable

    def _losses(self) -> tuple[int, int]:
        """Elements of all streams that never came, and that came after newer ones."""
        counts = self._session.stream_counts
        return sum(one.n_missing for one in counts), sum(one.n_late for one in counts)

    def _hear(self, event: LiveEvent) -> None:
        if event.kind in ("fault", "recovered", "warning"):
            self._n_faults += event.kind == "fault" and event.device not in OWN_PARTS
            self._tell(f"{event.kind}: {event.words}")
        # lasers that went off for safety are lit by a person alone, and nothing is seen without
        self._is_over |= event.is_final
        if (event.is_final or event.device in (MATCHING, RECORDER)) and not self._why_ended:
            self._why_ended = event.words

    def _strained(self) -> list[str]:
        """How many of the arm's samples it spoke against itself."""
        counts = self._session.stream_counts
        found = (
            (sum(one.n_inaccurate for one in counts), INACCURATE),
            (sum(one.n_end_stop for one in counts), AT_END_STOP),
        )
        return [f"{n} samples {what}" for n, what in found if n]

    def summary(self, scanner: Path | None) -> Summary:
        """What was written."""
        n_lost, n_late = self._losses()
        shown = self._session.snapshot()
        speed = self._end.n_bytes / 1e6 / max(self._seconds, 1e-3)
        quantities = [
            Quantity("exposures", "exposures", self._end.n_written),
            Quantity("seconds", "duration", self._seconds, unit="s"),
            Quantity("lost", "lost", n_lost, meaning="counted by the devices, never delivered"),
            Quantity("late", "late", n_late, meaning="delivered after newer ones"),
            Quantity("aside", "not to be used", self._recorder.n_aside,
                     meaning="kept: parts or times were lost"),
            Quantity("megabytes", "size", self._end.n_bytes / 1e6, unit="MB"),
            Quantity("megabytes_per_second", "disk rate", speed, unit="MB/s"),
        ]  # fmt: skip
        if self._is_measuring:
            placed = shown.counts.get(LiveStatus.PLACED, 0)
            quantities.append(Quantity("placed", "measured live", placed))
            quantities.append(Quantity("points", "points shown", shown.n_points))
        if shown.latency_ms is not None:
            quantities.append(
                Quantity("latency_ms", "exposure to screen", shown.latency_ms[0], unit="ms",
                         meaning=f"median; 95 % within {shown.latency_ms[1]:.0f} ms")
            )  # fmt: skip
        others = {one.value: n for one, n in shown.counts.items() if one is not LiveStatus.PLACED}
        warnings = [f"{n} instants: {what}" for what, n in others.items()]
        if self._recorder.n_aside:
            warnings.insert(
                0,
                f"{self._recorder.n_aside} of {self._end.n_written} exposures are kept and not to "
                "be used: parts of them were lost, or their clock was not known",
            )
        if self._recorder.n_untriggered:
            warnings.insert(
                0,
                f"{self._recorder.n_untriggered} exposures bear no trigger's id, as those before "
                "the first trigger: they are listed, and get no pose",
            )
        n_images = self._recorder.n_of_other_count
        n_samples = self._recorder.n_samples_of_other_count
        if n_images or n_samples:
            warnings.insert(
                0,
                f"{n_images} exposures and {n_samples} samples of the arm bear the id of another "
                "trigger, as of a device that was switched off and counts anew: they are listed "
                "without it, and such exposures get no pose",
            )
        if self._recorder.n_laser_unknown:
            warnings.insert(
                0,
                f"of {self._recorder.n_laser_unknown} of {self._end.n_written} exposures it is not "
                "known what lasers were on: they are listed, and not measured",
            )
        warnings = [*self._strained(), *warnings]
        if self._n_faults:
            warnings.insert(
                0, f"devices failed {plural(self._n_faults, 'time')}; the recording says when"
            )
        cloud = self._output.with_suffix(".ply")
        next_step = (
            f"armscan info {self._output}"
            if scanner is None
            else f"armscan reconstruct {self._output} --scanner {scanner} -o {cloud}"
        )
        return Summary(
            title="Recorded.",
            quantities=tuple(quantities),
            warnings=tuple(warnings),
            written=(self._output,),
            next_step=next_step,
            extra={"kind": "recording", "interrupted": self._is_interrupted,
                   "live": {one.name.lower(): n for one, n in shown.counts.items()}},
        )  # fmt: skip
