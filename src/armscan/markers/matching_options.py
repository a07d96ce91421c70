# SPDX-License-Identifier: Apache-2.0
"""Options of stereo matching."""

from __future__ import annotations

from dataclasses import dataclass

from armscan.errors import OptionError


@dataclass(frozen=True, slots=True)
class MatchingOptions:
    """How rings in two images are matched.

    Parameters
    ----------
    max_sigmas
        Threshold on the epipolar distance (delta of eq. 4.27), in its standard deviations.
    unmodelled_px
        Standard deviation, an axis, that is added to each centre for what its covariance cannot
        know: print, light and lens across the ring.
    depth_mm
        Nearest and farthest Z of a marker in the Sensor frame; None for all that lie ahead.
    diameter_mm
        Outer diameter of the markers; None if not known.
    size_tolerance
        Largest difference, as a fraction, of the diameters that the two images of one marker show,
        and of each from ``diameter_mm``.
    same_size
        Markers whose diameters differ by less than this fraction are of one make; where most are,
        a pair of that size is believed without neighbours.
    plane_px
        T of the homography's consensus: markers on one plane agree to this, px.
    depth_tolerance
        Largest distance in depth of a marker from the plane through its neighbours, as a fraction
        of the distance to them; for parts that curve.
    """

    max_sigmas: float = 4.0
    unmodelled_px: float = 0.01
    depth_mm: tuple[float, float] | None = None
    diameter_mm: float | None = None
    size_tolerance: float = 0.04
    same_size: float = 0.015
    plane_px: float = 2.0
    depth_tolerance: float = 0.15

    def __post_init__(self) -> None:
        positive = (
            *(self.max_sigmas, self.size_tolerance, self.same_size),
            *(self.plane_px, self.depth_tolerance),
        )
        if not (min(positive) > 0.0 and self.unmodelled_px >= 0.0):
            raise OptionError("the thresholds of matching must be positive")
        if self.depth_mm is not None and not 0.0 <= self.depth_mm[0] < self.depth_mm[1]:
            raise OptionError(
                f"a depth range of {self.depth_mm[0]:g} to {self.depth_mm[1]:g} mm",
                remedy="give the nearer depth first",
            )
        if self.diameter_mm is not None and not self.diameter_mm > 0.0:
            raise OptionError(f"a marker of {self.diameter_mm:g} mm diameter")


def parse_depth(text: str) -> tuple[float, float]:
    """Nearest and farthest depth in mm from ``NEAR:FAR``.

    Raises
    ------
    OptionError
        If the text is not two numbers with a colon between them.
    """
    try:
        near, far = (float(word) for word in text.split(":"))
    except ValueError as error:
        raise OptionError(
            f"'{text}' is no range of depths", remedy="write it as 100:180, in mm"
        ) from error
    return near, far
