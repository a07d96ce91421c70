# SPDX-License-Identifier: Apache-2.0
"""Find a calibration target in an exposure."""

from __future__ import annotations

from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure
from armscan.vision.targets.charuco import detect_charuco
from armscan.vision.targets.chessboard import detect_chessboard
from armscan.vision.targets.circle_grid import detect_circle_grid
from armscan.vision.targets.definition import Chessboard, CircleGrid, Target
from armscan.vision.targets.options import TargetOptions
from armscan.vision.targets.view import TargetView

SMALLEST_IMAGE_PX = 32


def detect_target(
    exposure: Exposure, target: Target, options: TargetOptions | None = None
) -> TargetView | FitFailure:
    """Find a target and measure its points (section 2.3.1.1).

    Parameters
    ----------
    exposure
        Grey or colour, 8 to 16 bit, any sensor window.
    target
        What to look for.
    options
        How; None for the defaults.

    Returns
    -------
    The points in full-sensor pixels with their covariance, or the reason why there are none.
    """
    chosen = TargetOptions() if options is None else options
    if min(exposure.width_px, exposure.height_px) < SMALLEST_IMAGE_PX:
        return FitFailure(
            f"{exposure.source}: an image of {exposure.width_px} x {exposure.height_px} px is too "
            "small to show a target",
            "give the full image",
        )
    if isinstance(target, CircleGrid):
        return detect_circle_grid(exposure, target, chosen)
    if isinstance(target, Chessboard):
        return detect_chessboard(exposure, target, chosen)
    return detect_charuco(exposure, target, chosen)
