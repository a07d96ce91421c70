# SPDX-License-Identifier: Apache-2.0
"""What became of each stripe point that two cameras named."""

from __future__ import annotations

from enum import IntEnum


class StereoFate(IntEnum):
    """What became of a stripe point of one of two cameras."""

    UNNAMED = 0
    """It has no sheet; its `NameFate` says why."""
    FUSED = 1
    """A left point that the right camera sees too: measured from both images."""
    ALONE = 2
    """Only this camera sees it: measured from its image and the sheet."""
    TAKEN = 3
    """A right point at or beside the right picture of a fused left point: it is measured there."""
    OUT_OF_DEPTH = 4
    """Only this camera sees it, and it lies outside the depths accepted: dropped."""
    INCONSISTENT = 5
    """Left and right picture contradict the sheet: dropped, as are the right points beside it."""
    NO_RAY = 6
    """The lens model has no inverse there, or the ray misses the sheet."""
