# SPDX-License-Identifier: Apache-2.0
"""How long the stages of a long piece of work take."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import TypeVar

T = TypeVar("T")


class Stopwatch:
    """Seconds of named stages."""

    def __init__(self) -> None:
        """Start with no stage."""
        self.seconds: dict[str, float] = {}

    def timed(self, stage: str, work: Callable[[], T]) -> T:
        """Do the work and note how long it took; parts of one stage are added up."""
        start = perf_counter()
        result = work()
        before = self.seconds.get(stage, 0.0)
        self.seconds[stage] = round(before + perf_counter() - start, 2)
        return result
