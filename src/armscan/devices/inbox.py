# SPDX-License-Identifier: Apache-2.0
"""What a device has delivered and nobody has read yet."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Generic, TypeVar

from armscan.errors import DeviceError

T = TypeVar("T")


class Inbox(Generic[T]):
    """Elements between the thread that receives them and the one that reads them, in order.

    Where nobody reads, the oldest are lost: elements bear the device's own count, which shows it.

    Parameters
    ----------
    name
        What messages call the device.
    most
        Elements that it holds.

    Attributes
    ----------
    n_lost
        Elements that nobody read in time.
    """

    def __init__(self, name: str, most: int) -> None:
        self.name = name
        self.n_lost = 0
        self._most = most
        self._waiting: deque[tuple[int, T]] = deque()
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
        """Raise this from every `take` that finds nothing left, until None takes it back."""
        with self._changed:
            self._fault = fault
            self._changed.notify_all()

    def take(self, timeout_s: float) -> T | None:
        """The oldest element; None if none came in time.

        Raises
        ------
        DeviceError
            If the device failed, or if this is called after `close`.
        """
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
        if self._is_closed:
            raise DeviceError("it is closed", where=self.name, remedy="open it again")
        if self._fault is not None and not self._waiting:
            raise self._fault

    def _due(self, most: int) -> list[T]:
        found: list[T] = []
        now_ns = time.monotonic_ns()
        while self._waiting and self._waiting[0][0] <= now_ns and len(found) < most:
            found.append(self._waiting.popleft()[1])
        return found
