# SPDX-License-Identifier: Apache-2.0
"""Progress of long work, as events that any front end can show, and what its stages cost."""

from __future__ import annotations

import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

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


def silent(event: ProgressEvent) -> None:
    """Show nothing."""


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
