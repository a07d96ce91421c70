# SPDX-License-Identifier: Apache-2.0
"""A laser controller on a serial line; ``docs/reference/laser-controller.md`` has its lines.

The host asks and the controller answers, by numbers, so that a damaged line is asked again. The
controller switches the lasers off by itself where it hears nothing, and says so.
"""

from __future__ import annotations

import binascii
import threading
import time
from collections.abc import Sequence

from armscan.devices.inbox import Inbox
from armscan.devices.protocols import DeviceInfo, DeviceKind, LaserController, LaserEvent
from armscan.devices.registry import needed_package
from armscan.drivers.arm_stream import SerialLink
from armscan.errors import DeviceError, DeviceStoppedError, OptionError, shown

VERSION = 1
MOST_LINE = 240
"""Characters of a line, its end left out: what a small controller keeps."""
PING_S = 0.25
"""The controller waits a second before it switches the lasers off: four of these."""
_ANSWER_S, _TRIES = 0.3, 3
_MOST_EVENTS = 10_000
_MOST_HZ = 10_000.0
_MOST_SOURCES = 16


def framed(text: str) -> bytes:
    """One line: the text, ``*``, its CRC-16 (CCITT-FALSE) in four hexadecimal digits, its end."""
    content = text.encode("ascii")
    return content + b"*%04X\n" % binascii.crc_hqx(content, 0xFFFF)


def unframed(line: bytes) -> str | None:
    """Text of one line without its end; None if it is damaged."""
    content, mark, checksum = line.rstrip(b"\r").rpartition(b"*")
    if not mark or checksum != b"%04X" % binascii.crc_hqx(content, 0xFFFF):
        return None
    return content.decode("ascii") if content.isascii() else None


def sources_word(lasers: Sequence[str]) -> str:
    """Sources joined by ``+``, ``-`` for none."""
    return "+".join(lasers) or "-"


class SerialLasers:
    """See `armscan.devices.protocols.LaserController`.

    Attributes
    ----------
    n_damaged
        Lines that came with a wrong checksum or content.
    """

    def __init__(self, place: str) -> None:
        self.name = f"lasers {place}"
        self.n_damaged = 0
        self._link = SerialLink(place)
        self._inbox: Inbox[LaserEvent] = Inbox(self.name, _MOST_EVENTS)
        self._answers: dict[int, list[str]] = {}
        self._changed = threading.Condition()
        self._asking = threading.Lock()
        self._number = 0
        self._partial = bytearray()
        self._is_started = False
        self._is_closed = False
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._pinging = threading.Thread(target=self._ping, daemon=True)
        self._thread.start()
        try:
            answer = self._ask("HELLO")
            is_known = len(answer) == 2 and answer[0] == str(VERSION)
            self.sources = tuple(answer[1].split("+")) if is_known else ()
            if not 1 <= len(self.sources) <= _MOST_SOURCES or not all(self.sources):
                raise DeviceError(
                    f"it answers '{shown(' '.join(answer), 80)}'",
                    where=self.name,
                    remedy=f"use a controller of version {VERSION} of the protocol",
                )
            self._ask("STOP")
        except DeviceError:
            self._hang_up()
            raise
        self._pinging.start()

    def set_schedule(self, steps: Sequence[tuple[str, ...]]) -> None:
        """Sources of one trigger after the other, repeated; holds until it is set anew."""
        if not steps:
            raise OptionError("a schedule without steps", where=self.name)
        unknown = sorted({name for step in steps for name in step} - set(self.sources))
        if unknown:
            raise OptionError(
                f"no laser is called '{unknown[0]}'",
                where=self.name,
                remedy=f"choose from {', '.join(self.sources)}",
            )
        self._ask("SCHED", ";".join(sources_word(step) for step in steps))

    def set_next(self, lasers: tuple[str, ...]) -> None:
        """Sources of the next trigger alone, and of those after it until the next call."""
        self.set_schedule([lasers])

    def start(self, rate_hz: float | None) -> None:
        """Trigger at this rate; None waits for triggers from elsewhere."""
        if rate_hz is not None and not 0.001 <= rate_hz <= _MOST_HZ:
            raise OptionError(f"{rate_hz} triggers a second", where=self.name)
        self._inbox.fail(None)
        self._inbox.clear()
        # the first event may come before the answer is read
        self._is_started = True
        try:
            self._ask("START", "EXT" if rate_hz is None else str(round(1000.0 * rate_hz)))
        except DeviceError:
            self._is_started = False
            raise

    def read(self, timeout_s: float) -> tuple[LaserEvent, ...]:
        """All events since the last call; waits for the first."""
        return self._inbox.take_all(timeout_s)

    def stop(self) -> None:
        """All lasers off, no more triggers; events that were told can still be read."""
        try:
            # events that were sent before the answer still count
            self._ask("STOP")
        finally:
            self._is_started = False

    def close(self) -> None:
        """Lasers off, and give the port back. Does nothing the second time."""
        if self._is_closed:
            return
        try:
            self.stop()
        except DeviceError:
            # a silent controller switches them off by itself
            self._is_started = False
        self._hang_up()
        self._inbox.close()

    def _hang_up(self) -> None:
        self._is_closed = True
        for thread in (self._thread, self._pinging):
            if thread.is_alive():
                thread.join()
        self._link.close()

    def _ask(self, command: str, argument: str = "") -> list[str]:
        """Send a command, again if no answer comes, and return the words of the answer."""
        if self._is_closed:
            raise DeviceError("it is closed", where=self.name, remedy="open it again")
        with self._asking:
            self._number = self._number % 9999 + 1
            text = " ".join(filter(None, (str(self._number), command, argument)))
            if len(text) > MOST_LINE:
                raise OptionError("the schedule is too long for the controller", where=self.name)
            for _ in range(_TRIES):
                try:
                    self._link.write(framed(text))
                except OSError as error:
                    raise DeviceError(f"the port is gone ({error})", where=self.name) from error
                words = self._answer(self._number)
                if words is not None:
                    if words[0] == "OK":
                        return words[1:]
                    raise DeviceError(
                        f"it refuses {command}: {shown(' '.join(words[1:]), 120)}", where=self.name
                    )
        raise DeviceError(
            f"no answer to {command} in {_TRIES * _ANSWER_S:.1f} s",
            where=self.name,
            remedy="check cable, baud rate and that the controller runs",
        )

    def _answer(self, number: int) -> list[str] | None:
        end_s = time.monotonic() + _ANSWER_S
        with self._changed:
            while number not in self._answers:
                rest_s = end_s - time.monotonic()
                if rest_s <= 0.0:
                    return None
                self._changed.wait(rest_s)
            return self._answers.pop(number)

    def _ping(self) -> None:
        """Keep the lasers on while the host is alive: that is, while this thread runs."""
        is_silent = False
        while not self._is_closed:
            time.sleep(PING_S)
            if not self._is_started or self._is_closed:
                is_silent = False
                continue
            try:
                self._ask("PING")
            except DeviceError as error:
                is_silent = True
                if self._is_started:
                    self._inbox.fail(error)
            else:
                if is_silent and self._is_started:
                    self._inbox.fail(None)
                is_silent = False

    def _listen(self) -> None:
        while not self._is_closed:
            try:
                received = self._link.read()
            except Exception as error:
                # drivers of serial adapters raise whatever they like when they are pulled out
                self._inbox.fail(DeviceError(f"the port is gone ({error})", where=self.name))
                return
            t_host_ns = time.monotonic_ns()
            *lines, rest = bytes(self._partial + received).split(b"\n")
            self._partial = bytearray(rest[-2 * MOST_LINE :])
            for line in lines:
                if not self._take(unframed(line), t_host_ns):
                    self.n_damaged += 1

    def _take(self, text: str | None, t_host_ns: int) -> bool:
        """Take one line; False if it is damaged or says nothing known."""
        words = (text or "").split(" ")
        if words[0] == "EV":
            event = self._event(words, t_host_ns)
            if event is not None and self._is_started:
                self._inbox.put(event)
            return event is not None
        if words == ["OFF", "WATCHDOG"]:
            self._is_started = False
            self._inbox.fail(
                DeviceStoppedError(
                    "it heard nothing for too long and switched the lasers off",
                    where=self.name,
                    remedy="start it again",
                )
            )
            return True
        if len(words) < 2 or not words[0].isdecimal() or words[1] not in ("OK", "ERR"):
            return False
        with self._changed:
            self._answers.clear()
            self._answers[int(words[0])] = words[1:]
            self._changed.notify_all()
        return True

    def _event(self, words: list[str], t_host_ns: int) -> LaserEvent | None:
        if len(words) != 4 or not words[1].isdecimal() or not words[2].isdecimal():
            return None
        lasers = () if words[3] == "-" else tuple(words[3].split("+"))
        if not set(lasers) <= set(self.sources):
            return None
        return LaserEvent(int(words[1]), int(words[2]), t_host_ns, lasers)


class LaserSerialDriver:
    """Opens ``laser-serial:PORT:BAUD``."""

    kinds: tuple[DeviceKind, ...] = ("lasers",)

    def discover(self) -> tuple[DeviceInfo, ...]:
        """Nothing: a port does not say what is behind it, and is not to be asked by chance."""
        needed_package("serial", "pip install 'armscan[serial]'")
        return ()

    def open(self, kind: DeviceKind, place: str) -> LaserController:
        """Open the controller at a port; its lasers are off then."""
        return SerialLasers(place)


DRIVER = LaserSerialDriver()
