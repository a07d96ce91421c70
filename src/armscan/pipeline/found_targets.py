# SPDX-License-Identifier: Apache-2.0
"""The target in every exposure of a set: found, or why not."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence, Sized
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from armscan.geometry.estimate import FitFailure
from armscan.pipeline.cached_detection import cached_target
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.pipeline.target_count import wrong_count
from armscan.records.exposure import Exposure
from armscan.storage.detection_cache import DetectionCache
from armscan.vision.targets.definition import Target
from armscan.vision.targets.options import TargetOptions
from armscan.vision.targets.view import TargetView

DETECTION_THREADS = 2
LISTED = 4


@dataclass(frozen=True, slots=True, eq=False)
class FoundTargets:
    """What the exposures of a set show.

    Parameters
    ----------
    views
        The target of each exposure that shows it, in the order of the exposures.
    not_found
        (source, reason) of the others.
    wrong_count
        The target's count is wrong, and then no further exposure was looked at; None if not.
    """

    views: tuple[TargetView, ...]
    not_found: tuple[tuple[str, str], ...]
    wrong_count: FitFailure | None = None

    def shown_of(self, sources: Sequence[str]) -> tuple[str, ...]:
        """Those of the sources that show the target."""
        empty = {source for source, _ in self.not_found}
        return tuple(source for source in sources if source not in empty)

    def not_found_text(self) -> str:
        """Why there is no target, with the exposures of each reason, in brackets; or empty."""
        if not self.not_found:
            return ""
        by_reason: dict[str, list[str]] = {}
        for source, reason in self.not_found:
            by_reason.setdefault(reason.removeprefix(f"{source}: "), []).append(source)
        often = sorted(by_reason.items(), key=lambda item: -len(item[1]))
        parts = [f"{_listed(sources)}: {reason}" for reason, sources in often[:LISTED]]
        n_more = sum(len(sources) for _, sources in often[LISTED:])
        more = f"; and {n_more} more" if n_more > 0 else ""
        return f" (no target: {'; '.join(parts)}{more})"


def _listed(sources: Sequence[str]) -> str:
    if len(sources) <= LISTED:
        return ", ".join(sources)
    return f"{', '.join(sources[:2])} and {len(sources) - 2} more"


def find_targets(
    exposures: Iterable[Exposure],
    target: Target,
    options: TargetOptions | None = None,
    *,
    cache: DetectionCache | None = None,
    progress: Progress = silent,
) -> FoundTargets:
    """Look for the target in each exposure.

    Parameters
    ----------
    exposures
        Taken one after the other, so that a generator needs to hold only a few at a time.
    target, options
        What to look for, and how; None for the defaults.
    cache
        What was found before; None to look again and keep nothing.
    progress
        Is told of each exposure.
    """
    total = len(exposures) if isinstance(exposures, Sized) else 0
    views: list[TargetView] = []
    not_found: list[tuple[str, str]] = []
    answers: list[TargetView | FitFailure] = []
    wrong: FitFailure | None = None
    detections = _detect_in_order(exposures, target, options, cache)
    for done, (source, found) in enumerate(detections, 1):
        if isinstance(found, FitFailure):
            not_found.append((source, found.reason))
        else:
            views.append(found)
        progress(ProgressEvent("find target", done, max(total, done), source))
        answers.append(found)
        wrong = wrong_count(answers, target)
        if wrong is not None:
            break
    if cache is not None:
        cache.trim()
    return FoundTargets(tuple(views), tuple(not_found), wrong)


def _detect_in_order(
    exposures: Iterable[Exposure],
    target: Target,
    options: TargetOptions | None,
    cache: DetectionCache | None,
) -> Iterator[tuple[str, TargetView | FitFailure]]:
    """Detect in a few threads, in order, without holding more exposures than threads."""
    waiting: deque[tuple[str, Future[TargetView | FitFailure]]] = deque()
    with ThreadPoolExecutor(DETECTION_THREADS) as pool:
        for exposure in exposures:
            looking = pool.submit(cached_target, exposure, target, options, cache)
            waiting.append((exposure.source, looking))
            if len(waiting) == DETECTION_THREADS:
                source, future = waiting.popleft()
                yield source, future.result()
        for source, future in waiting:
            yield source, future.result()
