# SPDX-License-Identifier: Apache-2.0
"""What a person may choose about stripe extraction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from armscan.errors import OptionError

StripeMethod = Literal["fit", "threshold", "centroid", "template", "hessian"]
LaserColour = Literal[
    "auto",
    "red",
    "green",
    "blue",
    "grey",
    "red-excess",
    "green-excess",
    "blue-excess",
    "red-green",
    "red-blue",
    "green-red",
    "green-blue",
    "blue-red",
    "blue-green",
]
SIGMA_RANGE_PX = (0.6, 10.0)


@dataclass(frozen=True, slots=True)
class StripeOptions:
    """Options of `extract_stripes`.

    Parameters
    ----------
    method
        ``fit`` (noise-weighted profile fit, smoothed along the line) or one of the thesis's four.
    laser_colour
        What of a colour image shows the line: a channel of the laser's colour; ``grey``, the mean
        of all; an excess, a channel less the mean of the two others (``green-excess``); or a
        difference of two (``green-red`` is green less red). ``auto`` finds it.
    line_sigma_px
        Sigma of the line's cross-section, or None to find it.
    threshold
        Least height of a line above its background in grey levels, or None to set it from the
        image's noise.
    shortest_px
        Segments shorter than this are flagged as no stripe.
    smoothing_px
        Largest half window of the smoothing along the line; 0 switches it off.
    neighbour_sigmas
        A line within this many sigmas of another is flagged.
    background_step
        A background step of more than this share of the line's amplitude is flagged.
    faintest_share
        Segments fainter than this share of the bright ones are taken for reflections and left out.
    """

    method: StripeMethod = "fit"
    laser_colour: LaserColour = "auto"
    line_sigma_px: float | None = None
    threshold: float | None = None
    shortest_px: float = 15.0
    smoothing_px: float = 12.0
    neighbour_sigmas: float = 4.5
    background_step: float = 0.2
    faintest_share: float = 0.1

    def __post_init__(self) -> None:
        for name, choices in (("method", StripeMethod), ("laser_colour", LaserColour)):
            value = getattr(self, name)
            if value not in get_args(choices):
                raise OptionError(
                    f"{name} '{value}' is not known",
                    remedy=f"choose one of: {', '.join(get_args(choices))}",
                )
        low, high = SIGMA_RANGE_PX
        if self.line_sigma_px is not None and not low <= self.line_sigma_px <= high:
            raise OptionError(
                f"line_sigma_px is {self.line_sigma_px}",
                remedy=f"give {low} to {high} px, or leave it out to have it found",
            )
        if self.threshold is not None and not 0.0 < self.threshold < math.inf:
            raise OptionError(
                f"threshold is {self.threshold}", remedy="give a positive count of grey levels"
            )
        for name in (
            "shortest_px",
            "smoothing_px",
            "neighbour_sigmas",
            "background_step",
            "faintest_share",
        ):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise OptionError(
                    f"{name} is {getattr(self, name)}", remedy="give a number that is not negative"
                )
