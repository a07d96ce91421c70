# SPDX-License-Identifier: Apache-2.0
"""Long work: its progress, as events that any front end can show, what its stages cost, and its
items in a few threads.
"""

from __future__ import annotations

import os
import re
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias, TypeVar

try:
    import resource
except ImportError:  # pragma: no cover - Windows has none
    resource = None  # type: ignore[assignment]


@dataclass(frozen=True, slots=True)
class ProgressEvent:
    """``done`` of ``total`` steps of a stage are finished; ``item`` names the latest."""

    stage: str
    done: int
    total: int
    item: str = ""


Progress: TypeAlias = Callable[[ProgressEvent], None]
Item = TypeVar("Item")
Result = TypeVar("Result")


def silent(event: ProgressEvent) -> None:
    """Show nothing."""


def count_cores() -> int:
    """Cores that this process may use, where the system tells."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def worker_threads(n_threads: int) -> Iterator[ThreadPoolExecutor]:
    """Threads for the block; an error in it drops the work that nobody has begun.

    An interrupt does not wait for the work under way either: a first run compiles kernels in it for
    half a minute on a busy machine, and Ctrl-C would seem to do nothing.
    """
    pool = ThreadPoolExecutor(n_threads)
    is_awaited = True
    try:
        yield pool
    except KeyboardInterrupt:
        is_awaited = False
        raise
    finally:
        pool.shutdown(wait=is_awaited, cancel_futures=True)


def in_order(
    work: Callable[[Item], Result], items: Iterable[Item], most_threads: int
) -> Generator[tuple[Item, Result]]:
    """Each item with what ``work`` makes of it, in the order of the items.

    Works ahead on as many items as there are cores for, ``most_threads`` at most, and takes only a
    few more from ``items`` than were given back. Ends at the first error, of the work or of the
    items, and drops what waits when it is closed.
    """
    n_threads = min(count_cores(), most_threads)
    if n_threads == 1:
        yield from ((item, work(item)) for item in items)
        return
    pending: deque[tuple[Item, Future[Result]]] = deque()
    with worker_threads(n_threads) as pool:
        for item in items:
            pending.append((item, pool.submit(work, item)))
            if len(pending) > n_threads:
                first, future = pending.popleft()
                yield first, future.result()
        while pending:
            first, future = pending.popleft()
            yield first, future.result()


@dataclass(frozen=True, slots=True)
class ChainProfile:
    """What a chain cost from its start until now.

    Parameters
    ----------
    stages
        Processor time in seconds of each stage, in the order in which they began.
    wall_s, processor_s
        Of all, with what belongs to no stage.
    peak_mb
        Most memory that the process has held; None where the system does not tell.
    n_cached
        Images whose points an earlier run had found: finding them is in no stage.
    """

    stages: tuple[tuple[str, float], ...]
    wall_s: float
    processor_s: float
    peak_mb: float | None
    n_cached: int = 0


@dataclass(slots=True)
class StageClock:
    """Adds up processor time by stage, of all threads that work for it.

    Parameters
    ----------
    n_cached
        As of `ChainProfile`.
    """

    n_cached: int = 0
    _seconds: dict[str, float] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _start: tuple[float, float] = field(
        default_factory=lambda: (time.perf_counter(), time.process_time())
    )

    @contextmanager
    def stage(self, name: str, *, is_alone: bool = False) -> Iterator[None]:
        """Count the time of the block for a stage.

        Parameters
        ----------
        name
            Of the stage.
        is_alone
            Nothing else runs meanwhile, so that threads which the block starts count for it.
        """
        clock = time.process_time if is_alone else time.thread_time
        start = clock()
        with self._lock:
            self._seconds.setdefault(name, 0.0)
        try:
            yield
        finally:
            with self._lock:
                self._seconds[name] += clock() - start

    def profile(self) -> ChainProfile:
        """What was counted so far."""
        wall, processor = self._start
        with self._lock:
            stages = tuple(self._seconds.items())
        return ChainProfile(
            stages,
            time.perf_counter() - wall,
            time.process_time() - processor,
            peak_memory_mb(),
            self.n_cached,
        )


def peak_memory_mb() -> float | None:
    """Most memory that this process has held, in MB of 10^6 bytes; None where it is not told."""
    status = Path("/proc/self/status")
    if status.exists():
        # resource counts what the process held that started this one
        held = re.search(rb"^VmHWM:\s+(\d+) kB", status.read_bytes(), re.MULTILINE)
        if held is not None:
            return 1.024e-3 * int(held[1])
    if resource is None:
        return None
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
