# SPDX-License-Identifier: Apache-2.0
"""What a device has delivered and nobody has read yet, and how it gets there."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import replace
from typing import Any, Generic, TypeVar, cast

import numpy as np

from armscan.devices.protocols import Fault, Frame, LaserEvent
from armscan.errors import DeviceError, DeviceTakenError

T = TypeVar("T")


class Inbox(Generic[T]):
    """Elements between the thread that receives them and the one that reads them, in order.

    Where nobody reads, the oldest are lost: elements bear the device's own count, which shows it.

    Attributes
    ----------
    n_lost
        Elements that nobody read in time.
    """

    def __init__(self, name: str, most: int) -> None:
        self.name = name
        self.n_lost = 0
        self._most = most
        self._waiting: deque[tuple[int, T | DeviceError]] = deque()
        self._changed = threading.Condition()
        self._fault: DeviceError | None = None
        self._is_closed = False

    def put(self, element: T, due_ns: int = 0) -> None:
        """Add an element, to be read not before a time of the monotonic clock, in ns."""
        with self._changed:
            if self._is_closed:
                return
            if len(self._waiting) >= self._most:
                self._waiting.popleft()
                self.n_lost += 1
            self._waiting.append((due_ns, element))
            self._changed.notify_all()

    def fail(self, fault: DeviceError | None) -> None:
        """Raise this from every `take` that finds nothing left, until None takes it back.

        It is raised once at least, between what came before and what comes after it.
        """
        with self._changed:
            self._fault = fault
            if fault is not None:
                self._waiting.append((0, fault))
            self._changed.notify_all()

    def take(self, timeout_s: float) -> T | None:
        """The oldest element; None if none came in time."""
        found = self._take(timeout_s, 1)
        return found[0] if found else None

    def take_all(self, timeout_s: float) -> tuple[T, ...]:
        """All elements that are there; waits for the first. Raises as `take` does."""
        return tuple(self._take(timeout_s, self._most))

    def clear(self) -> None:
        """Forget what nobody has read."""
        with self._changed:
            self._waiting.clear()

    def close(self) -> None:
        """Wake up who waits; nothing can be taken any more."""
        with self._changed:
            self._is_closed = True
            self._waiting.clear()
            self._changed.notify_all()

    def check_open(self) -> None:
        """Raise `DeviceError` after `close`."""
        if self._is_closed:
            raise DeviceError("it is closed", where=self.name, remedy="open it again")

    def _take(self, timeout_s: float, most: int) -> list[T]:
        until_ns = time.monotonic_ns() + round(1e9 * timeout_s)
        with self._changed:
            while True:
                self._check()
                found = self._due(most)
                now_ns = time.monotonic_ns()
                if found or now_ns >= until_ns:
                    return found
                if self._fault is not None and not self._waiting:
                    raise self._fault
                next_ns = min(until_ns, self._waiting[0][0]) if self._waiting else until_ns
                self._changed.wait(max(next_ns - now_ns, 0) * 1e-9)

    def _check(self) -> None:
        self.check_open()
        if self._fault is not None and not self._waiting:
            raise self._fault

    def _due(self, most: int) -> list[T]:
        found: list[T] = []
        now_ns = time.monotonic_ns()
        while self._waiting and self._waiting[0][0] <= now_ns and len(found) < most:
            element = self._waiting[0][1]
            if isinstance(element, DeviceError):
                if not found:
                    self._waiting.popleft()
                    raise element
                return found
            found.append(element)
            self._waiting.popleft()
        return found


class DeviceClock:
    """A device's clock: offset at ``zero_ns`` of this computer's, a drift, and jumps on demand."""

    def __init__(self, offset_ns: int, drift: float, zero_ns: int) -> None:
        self.offset_ns = offset_ns
        self.drift = drift
        self.zero_ns = zero_ns

    def at(self, t_ns: int) -> int:
        """What it shows at a time of the computer's monotonic clock."""
        since = t_ns - self.zero_ns
        return self.offset_ns + since + round(self.drift * since)


class FaultyLine(Generic[T]):
    """From a device that is played to its reader: clock, delay, and faults on demand.

    The mean of what comes on top of the least delay is ``spread_ns``, by chance, exponentially
    distributed as on a busy computer.
    """

    def __init__(
        self,
        name: str,
        most: int,
        clock: DeviceClock,
        *,
        delay_ns: int,
        spread_ns: int,
        rng: np.random.Generator,
    ) -> None:
        self.inbox: Inbox[T] = Inbox(name, most)
        self.clock = clock
        self.delay_ns = delay_ns
        self.number = 0
        self.is_open = False
        self._most = most
        self._spread_ns = spread_ns
        self._rng = rng
        self._last_ns = 0
        self._stalled_ns = 0
        self._unplugged_ns = 0
        self._left: dict[str, int] = {}
        self._held: tuple[Any, int] | None = None

    def open(self) -> None:
        """Begin with an empty inbox.

        Raises
        ------
        DeviceTakenError
            If it is open.
        """
        if self.is_open:
            raise DeviceTakenError("it is open already", where=self.inbox.name)
        self.inbox = Inbox(self.inbox.name, self._most)
        self.is_open = True

    def close(self) -> None:
        """Wake up who reads; no element comes any more."""
        self.is_open = False
        self.inbox.close()

    def send(self, t_ns: int, element: T) -> None:
        """Deliver what was taken at a time of the monotonic clock; its number and times are set.

        A frame's time is the middle of its exposure, and its delay begins with the end.
        """
        number, self.number = self.number, self.number + 1
        delay_ns = self.delay_ns + round(self._spread_ns * self._rng.exponential())
        delay_ns += element.exposure_ns // 2 if isinstance(element, Frame) else 0
        due_ns = max(t_ns + delay_ns, self._last_ns, self._stalled_ns)
        if self._counts_down("drop") or t_ns < self._unplugged_ns:
            return
        self._last_ns = due_ns
        changes = {} if isinstance(element, LaserEvent) else {"number": number}
        changes |= {"t_device_ns": self.clock.at(t_ns), "t_host_ns": due_ns}
        element = cast(T, replace(cast(Any, element), **changes))
        if isinstance(element, Frame) and self._counts_down("corrupt"):
            element = cast(T, _without_a_part(element))
        if self._held is None and self._counts_down("reorder"):
            self._held = element, due_ns
            return
        for _ in range(2 if self._counts_down("duplicate") else 1):
            self.inbox.put(element, due_ns)
        if self._held is not None:
            self.inbox.put(replace(self._held[0], t_host_ns=due_ns), due_ns)
            self._held = None

    def inject(self, fault: Fault, amount: float) -> None:
        """Make the device fail.

        Parameters
        ----------
        fault
            ``unplug``: it answers with `DeviceError` for so many seconds; ``stall``: for so many
            seconds nothing arrives, all of it comes afterwards; ``drop``: so many elements never
            arrive; ``corrupt``: as many frames arrive with a part lost, `Frame.is_complete` False;
            ``clock-jump``: its clock jumps by so many seconds; ``duplicate``: so many elements
            arrive twice; ``reorder``: so many arrive after the one that follows them.
        amount
            Seconds or count, as the fault says.
        """
        now_ns = time.monotonic_ns()
        if fault == "unplug":
            self._unplugged_ns = now_ns + round(1e9 * amount)
            self.inbox.clear()
            self.inbox.fail(DeviceError("it was unplugged", where=self.inbox.name))
        elif fault == "stall":
            self._stalled_ns = now_ns + round(1e9 * amount)
        elif fault == "clock-jump":
            self.clock.offset_ns += round(1e9 * amount)
        else:
            self._left[fault] = self._left.get(fault, 0) + int(amount)

    def mend(self) -> None:
        """Answer again where the time of an unplugged device is over."""
        if self._unplugged_ns and time.monotonic_ns() >= self._unplugged_ns:
            self._unplugged_ns = 0
            self.inbox.fail(None)

    def check_answers(self) -> None:
        """Raise `DeviceError` if it is closed or unplugged."""
        self.mend()
        if not self.is_open or self._unplugged_ns:
            fact = "it was unplugged" if self.is_open else "it is closed"
            raise DeviceError(fact, where=self.inbox.name, remedy="open it again")

    def _counts_down(self, fault: str) -> bool:
        left = self._left.get(fault, 0)
        self._left[fault] = max(left - 1, 0)
        return left > 0


def _without_a_part(frame: Frame) -> Frame:
    image: Any = np.array(frame.image)
    third = len(image) // 3
    image[third : 2 * third] = 0
    return replace(frame, image=image, is_complete=False)
