# SPDX-License-Identifier: Apache-2.0
"""What the naming of many stripes by a second camera takes for granted."""

from __future__ import annotations

from dataclasses import dataclass, field

from armscan.errors import OptionError
from armscan.reconstruction.choose_sheet import DepthRange


@dataclass(frozen=True, slots=True)
class StereoNamingOptions:
    """Options of `armscan.reconstruction.stereo_measure.measure_stereo`.

    Parameters
    ----------
    depths
        Depths in which a sheet is looked for: its calibrated range, widened.
    sample_points
        Every so many stripe points one is projected; the others follow it.
    reach_px
        A right stripe farther from the projected point than this is not its picture.
    floor_px
        What is left of the residual's bias after the epipolar offset was found: calibration
        errors that are not smooth, and the stripe's own.
    drift_px
        Standard deviation, before any data, of how far the two cameras have drifted apart since
        their calibration.
    seen_share
        Part of the points of one camera that the other is expected to see.
    runner_up
        A stretch is ambiguous if another sheet scores more than this part of the best one.
    least_matches
        A stretch with fewer samples that lie on a right stripe keeps no name.
    offset_chi_square
        A stretch is ambiguous if mean, slope and bend of its residuals differ by more (chi-square
        over its degrees of freedom) from the offset that the others show.
    consistency_sigmas
        Points whose left and right picture disagree by more are dropped.
    """

    depths: DepthRange = field(default_factory=lambda: DepthRange(0.5))
    sample_points: int = 6
    reach_px: float = 4.0
    floor_px: float = 0.06
    drift_px: float = 0.4
    seen_share: float = 0.75
    runner_up: float = 0.6
    least_matches: int = 3
    offset_chi_square: float = 4.0
    consistency_sigmas: float = 5.0

    def __post_init__(self) -> None:
        for name in ("reach_px", "floor_px", "drift_px", "consistency_sigmas", "offset_chi_square"):
            if not getattr(self, name) > 0.0:
                raise OptionError(f"{name} = {getattr(self, name)}", remedy="give more than 0")
        for name in ("sample_points", "least_matches"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} = {getattr(self, name)}", remedy="give 1 or more")
        for name in ("seen_share", "runner_up"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise OptionError(
                    f"{name} = {getattr(self, name)}", remedy="give a share between 0 and 1"
                )
