# SPDX-License-Identifier: Apache-2.0
"""Options of target detection."""

from __future__ import annotations

from dataclasses import dataclass

from armscan.errors import OptionError


@dataclass(frozen=True, slots=True)
class TargetOptions:
    """How targets are looked for.

    Parameters
    ----------
    search_size_px
        Larger images are reduced to this size for the search of chessboards; the corners are then
        measured in the full image.
    min_circle_px, max_circle_px
        Range of the circles' diameters in the image.
    min_contrast
        Least contrast of a circle or square, as a fraction of full scale.
    min_circles_fraction
        Least fraction of a grid's circles that must be found; each border row must be among them.
    """

    search_size_px: int = 1400
    min_circle_px: float = 8.0
    max_circle_px: float = 400.0
    min_contrast: float = 0.02
    min_circles_fraction: float = 0.8

    def __post_init__(self) -> None:
        if self.search_size_px < 100:
            raise OptionError(f"search_size_px = {self.search_size_px} is below 100")
        if not 6.0 <= self.min_circle_px < self.max_circle_px:
            raise OptionError(
                f"circles of {self.min_circle_px} to {self.max_circle_px} px across: the smallest "
                "must be at least 6 px and below the largest"
            )
        if not 0.0 < self.min_contrast < 1.0:
            raise OptionError(f"min_contrast = {self.min_contrast} is not between 0 and 1")
        if not 0.5 <= self.min_circles_fraction <= 1.0:
            raise OptionError(
                f"min_circles_fraction = {self.min_circles_fraction} is not between 0.5 and 1"
            )
