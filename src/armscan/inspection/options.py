# SPDX-License-Identifier: Apache-2.0
"""Options of every inspection: what belongs to a feature, and what a fit leaves out."""

from __future__ import annotations

import math
from dataclasses import dataclass

from armscan.errors import OptionError


@dataclass(frozen=True, slots=True)
class InspectionOptions:
    """How a feature is found in a cloud.

    Parameters
    ----------
    feature_mm
        Points up to this far from the surface belong to the feature: every statistic counts them,
        outliers included. Points further away are other objects and are only counted.
    outlier_sigma
        A fit leaves out points further from its surface than this many robust standard deviations
        (1.4826 times the median absolute deviation), in turn with the fit.
    kept_band_mm
        Points nearer to the surface than this are never left out of a fit.
    search_band_mm
        Half width of the band in which points support a candidate while a feature is searched.
    min_points
        Fewest points that make a feature.
    """

    feature_mm: float = 1.0
    outlier_sigma: float = 4.0
    kept_band_mm: float = 0.02
    search_band_mm: float = 0.2
    min_points: int = 30

    def __post_init__(self) -> None:
        _require(
            0.0 < self.feature_mm < math.inf,
            f"feature_mm is {self.feature_mm}",
            "give more than 0 mm, as 1.0",
        )
        _require(
            2.0 <= self.outlier_sigma < math.inf,
            f"outlier limit of {self.outlier_sigma} sigma",
            "give at least 2, or good points are lost",
        )
        _require(
            0.0 <= self.kept_band_mm < math.inf,
            f"a kept band of {self.kept_band_mm} mm",
            "give 0 or up",
        )
        _require(
            0.0 < self.search_band_mm <= self.feature_mm,
            f"a search band of {self.search_band_mm} mm",
            f"give more than 0 and at most feature_mm, {self.feature_mm}",
        )
        _require(self.min_points >= 4, f"features of {self.min_points} points", "give at least 4")


@dataclass(frozen=True, slots=True)
class StepOptions:
    """How two parallel faces are found.

    Parameters
    ----------
    margin_mm
        Points this near to an end of their face are left out: along each stripe its runs on the
        face are shortened by it, and left out is all that lies this near to points off the face,
        seen along the normal, or to the face's outline in a cloud of many stripes.
    height_tolerance
        Faces are searched up to this part of the nominal height from it.
    """

    margin_mm: float = 1.0
    height_tolerance: float = 0.05

    def __post_init__(self) -> None:
        _require(
            0.0 <= self.margin_mm < 100.0, f"margin_mm is {self.margin_mm}", "give 0 to 100 mm"
        )
        _require(
            0.0 < self.height_tolerance <= 0.5,
            f"a height tolerance of {self.height_tolerance}",
            "give more than 0 and at most 0.5",
        )


def _require(holds: bool, what: str, remedy: str) -> None:
    if not holds:
        raise OptionError(what, where="inspection options", remedy=remedy)
