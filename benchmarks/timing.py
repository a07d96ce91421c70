# SPDX-License-Identifier: Apache-2.0
"""What speed benchmarks share: ways to do one work, timed in one run, as rows of one table."""

from __future__ import annotations

import platform
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

HEADINGS = ("work", "by", "gives", "error", "ms", "faster than the usual")

LONG_MS = 1000.0

T = TypeVar("T")


@dataclass(frozen=True)
class Row:
    """One way to do a work: who, processor milliseconds of all threads, result and its error."""

    by: str
    ms: float
    gives: str = ""
    error: str = ""


@dataclass(frozen=True)
class Comparison:
    """Ways to do one work; ``usual`` is the row of what a user would do without us, if any."""

    work: str
    rows: tuple[Row, ...]
    usual: str | None = None

    @property
    def lines(self) -> list[str]:
        """Lines of the table; the work stands in the first."""
        times = {row.by: row.ms for row in self.rows}
        lines = []
        for k, row in enumerate(self.rows):
            faster = ""
            if self.usual is not None:
                ratio = times[self.usual] / row.ms
                faster = f"{ratio:.2g}" if ratio < 100.0 else f"{ratio:,.0f}"
            ms = f"{row.ms:.3g}" if row.ms < 1000.0 else f"{row.ms:,.0f}"
            cells = ("" if k else self.work, row.by, row.gives, row.error, ms, faster)
            lines.append(f"| {' | '.join(cells)} |")
        return lines


def compare(
    work: str,
    ways: Mapping[str, Callable[[], T]],
    repeats: int,
    *,
    usual: str | None = None,
    tell: Callable[[T], tuple[str, str]] = lambda _: ("", ""),
    parts: int = 1,
) -> Comparison:
    """Time ways in turn; told is the least of the repeats.

    In each round a way is gone once before it is timed, as if image followed image: what the other
    ways left in the caches would slow it. Ways of a second and more, which do not feel it, are not.

    Parameters
    ----------
    work, usual
        As of `Comparison`.
    ways
        By name.
    repeats
        Rounds.
    tell
        What a way's result gives, and its error.
    parts
        Of which the work consists; told is the time of one.
    """
    results: dict[str, T] = {}
    least = dict.fromkeys(ways, np.inf)
    for k in range(repeats):
        for by, way in ways.items():
            if k == 0 or least[by] < LONG_MS:
                way()
            start = time.process_time()
            results[by] = way()
            least[by] = min(least[by], 1e3 * (time.process_time() - start))
    rows = [Row(by, least[by] / parts, *tell(results[by])) for by in ways]
    return Comparison(work, tuple(rows), usual)


def heading() -> str:
    """Machine, day and commit, marked if the tree holds changes."""
    names = Path("/proc/cpuinfo")
    found = names.read_text("utf-8").splitlines() if names.exists() else []
    models = [line.partition(":")[2].strip() for line in found if line.startswith("model name")]
    machine = f"{len(models)} cores, {models[0]}" if models else platform.machine()
    changes = "+changes" if git("status", "--porcelain") else ""
    head = git("rev-parse", "--short=8", "HEAD") or "unknown"
    return f"{machine}, {time.strftime('%Y-%m-%d')}, commit {head}{changes}"


def git(*words: str) -> str:
    """What git says in this tree."""
    command = ["git", "-C", str(Path(__file__).parent), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def print_table(comparisons: Iterable[Comparison]) -> None:
    """Print each comparison as soon as it is done."""
    print(f"| {' | '.join(HEADINGS)} |")
    print("|---|---|---|---|--:|--:|", flush=True)
    for one in comparisons:
        print("\n".join(one.lines), flush=True)
