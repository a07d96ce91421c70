# SPDX-License-Identifier: Apache-2.0
"""Board and stripe of each image by itself, for a person who asks why no sheet came out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from armscan.geometry.estimate import FitFailure
from armscan.pipeline.cached_detection import cached_profile, cached_target
from armscan.pipeline.exposure_pairs import ExposurePair
from armscan.pipeline.laser import LaserOptions, around_board
from armscan.pipeline.progress import Progress, ProgressEvent, silent
from armscan.records.profile import Profile
from armscan.storage.detection_cache import DetectionCache
from armscan.vision.targets.definition import Target
from armscan.vision.targets.view import TargetView

STAGE = "boards and stripes again"


@dataclass(frozen=True, slots=True, eq=False)
class SeenPair:
    """What an image with the laser on shows, the board perhaps in the one without.

    Parameters
    ----------
    source
        The image with the laser on.
    board
        The target, or why it was not found.
    board_source
        The image in which it was found.
    profile
        All stripe points.
    """

    source: str
    board: TargetView | FitFailure
    board_source: str
    profile: Profile


def look_at_pairs(
    pairs: Sequence[ExposurePair],
    target: Target,
    options: LaserOptions,
    *,
    cache: DetectionCache | None = None,
    progress: Progress = silent,
) -> tuple[SeenPair, ...]:
    """Look for board and stripe in each pair, without any other image's help."""
    seen = []
    for done, (exposure, background) in enumerate(pairs):
        progress(ProgressEvent(STAGE, done, len(pairs), exposure.source))
        tried = exposure if background is None else background
        board = cached_target(tried, target, options.target, cache)
        if isinstance(board, FitFailure) and tried is not exposure:
            again = cached_target(exposure, target, options.target, cache)
            if not isinstance(again, FitFailure):
                board, tried = again, exposure
        lit, dark = exposure, background
        if not isinstance(board, FitFailure):
            lit = around_board(board, exposure)
            dark = None if background is None else around_board(board, background)
        profile = cached_profile(lit, options.stripes, dark, cache)
        seen.append(SeenPair(exposure.source, board, tried.source, profile))
    progress(ProgressEvent(STAGE, len(pairs), len(pairs)))
    if cache is not None:
        cache.trim()
    return tuple(seen)
