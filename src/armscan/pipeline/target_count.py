# SPDX-License-Identifier: Apache-2.0
"""Is the target's count wrong? Told after a few images, not after all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armscan.geometry.estimate import FitFailure
from armscan.vision.targets.definition import Charuco, Target
from armscan.vision.targets.specification import format_target
from armscan.vision.targets.view import OtherCountSeen, TargetView

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
    if isinstance(target, Charuco) or any(_is_whole(item, target) for item in found):
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
    right = format_target(replace(target, columns=columns, rows=rows))
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
