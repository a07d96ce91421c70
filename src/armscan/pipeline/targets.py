# SPDX-License-Identifier: Apache-2.0
"""Targets found in images: count of what was found and why not, detection once per image, and
progress.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Sized
from dataclasses import dataclass, replace

import numpy as np

from armscan.errors import InputError
from armscan.geometry.estimate import FitFailure
from armscan.models.camera import CameraModel
from armscan.pipeline.progress import Progress, ProgressEvent, in_order, silent
from armscan.records.exposure import Exposure
from armscan.storage.detection_cache import DetectionCache, detection_key
from armscan.vision.targets.circle_grid import correct_centres
from armscan.vision.targets.detect import detect_target, settle_target
from armscan.vision.targets.target import (
    AprilGrid,
    Charuco,
    OtherCountSeen,
    Target,
    TargetView,
    format_target,
)


def cached_target(
    exposure: Exposure, target: Target, cache: DetectionCache | None = None
) -> TargetView | FitFailure:
    """As `detect_target`; looks only if the cache does not know. None for no cache."""
    if cache is None:
        return detect_target(exposure, target)
    key = detection_key("target", exposure, (target,))
    found = cache.get(key)
    if isinstance(found, TargetView | FitFailure):
        return found
    looked = detect_target(exposure, target)
    cache.put(key, looked)
    return looked


def on_sensor(view: TargetView, camera: CameraModel) -> TargetView:
    """The view with the size of its camera's sensor, which a window need not tell.

    `armscan.pipeline.instants.check_sizes` tells whether the image is of that sensor.
    """
    return replace(view, width_px=camera.width_px, height_px=camera.height_px)


ENOUGH_IMAGES = 4
"""Images that show one and the same other count, and never the target, prove the count wrong."""
_AGREEING = 0.5


def wrong_count(found: Sequence[TargetView | FitFailure], target: Target) -> FitFailure | None:
    """Tell that the target's count is wrong, as soon as that is certain.

    Parameters
    ----------
    found
        What was found in the images so far.
    target
        What was looked for.

    Returns
    -------
    The count that was seen instead and how to write it; None as long as the whole target was
    found once, or the images do not agree.
    """
    if isinstance(target, Charuco | AprilGrid) or any(_is_whole(item, target) for item in found):
        return None
    counts = [(item.columns, item.rows) for item in found if isinstance(item, OtherCountSeen)]
    if len(counts) < ENOUGH_IMAGES:
        return None
    usual = max(set(counts), key=counts.count)
    n_usual = counts.count(usual)
    if n_usual < max(ENOUGH_IMAGES, _AGREEING * len(found)):
        return None
    columns, rows = usual
    asked = sorted((target.columns, target.rows), reverse=True)
    is_by_squares = asked == [columns + 1, rows + 1]
    why = "; it looks as if squares were counted" if is_by_squares else ""
    right = format_target(replace(target, columns=columns, rows=rows, stretch=1.0))
    return FitFailure(
        f"{n_usual} of the first {len(found)} images show a board of {columns} x {rows} points, "
        f"none one of {target.columns} x {target.rows}{why}",
        f"count again: {right} fits what was seen; or show the whole board",
    )


def _is_whole(item: TargetView | FitFailure, target: Target) -> bool:
    """Tell whether all border lines of the target were seen: a part fits a larger count, too."""
    if isinstance(item, FitFailure):
        return False
    seen, every = item.points_board_mm, target.points_board_mm
    return bool(np.array_equal(np.ptp(seen, axis=0), np.ptp(every, axis=0)))


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

    def before(self, camera: CameraModel) -> FoundTargets:
        """As seen by a known camera: with circles' centres measured again without its distortion.

        Of a view with an edge that the camera's model cannot invert, that is said in its place.
        """
        views, not_found = [], list(self.not_found)
        for view in self.views:
            seen = on_sensor(view, camera)
            try:
                views.append(seen if seen.edges is None else correct_centres(seen, camera))
            except InputError as error:
                not_found.append((view.source, error.what))
        return replace(self, views=tuple(views), not_found=tuple(not_found))

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
    *,
    cache: DetectionCache | None = None,
    progress: Progress = silent,
) -> FoundTargets:
    """Look for the target in each exposure.

    Parameters
    ----------
    exposures
        Taken one after the other, so that a generator needs to hold only a few at a time. What the
        target's name leaves open (`settle_target`) is told from all of a sequence, and from each
        exposure by itself of a generator.
    target
        What to look for.
    cache
        What was found before; None to look again and keep nothing.
    progress
        Is told of each exposure.
    """
    total = len(exposures) if isinstance(exposures, Sized) else 0
    if isinstance(exposures, Sequence):
        target = settle_target(exposures, target)
    views: list[TargetView] = []
    not_found: list[tuple[str, str]] = []
    answers: list[TargetView | FitFailure] = []
    wrong: FitFailure | None = None

    def look(exposure: Exposure) -> TargetView | FitFailure:
        return cached_target(exposure, target, cache)

    for done, (exposure, found) in enumerate(in_order(look, exposures, DETECTION_THREADS), 1):
        source = exposure.source
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
