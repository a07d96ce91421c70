# SPDX-License-Identifier: Apache-2.0
"""Options of ring detection, and what size a ring has in the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from armscan.errors import OptionError

THESIS_PERIMETER_PX = (200.0, 350.0)
"""Limits of eq. 4.19 as the thesis sets them."""
THESIS_MAX_ROUNDNESS = 1.7
"""Limit of eq. 4.21: a tilt of 54 degrees by the convention of `armscan.vision.rings.shape`."""

Disc = Literal["light", "dark"]


@dataclass(frozen=True, slots=True)
class RingOptions:
    """Which rings are looked for.

    Parameters
    ----------
    min_perimeter_px, max_perimeter_px
        Limits of the outer rim's circumference, as if the ring were not tilted (eq. 4.19);
        `perimeter_limits` derives them from a marker's size.
    max_roundness
        Largest C of eq. 4.20 (eq. 4.21).
    disc
        A light disc in a dark ring, as in figure 4.5, or a dark disc in a light ring.
    min_contrast
        Least contrast of either rim, as a fraction of full scale.
    """

    min_perimeter_px: float = 40.0
    max_perimeter_px: float = 1200.0
    max_roundness: float = THESIS_MAX_ROUNDNESS
    disc: Disc = "light"
    min_contrast: float = 0.04

    def __post_init__(self) -> None:
        if not 30.0 <= self.min_perimeter_px < self.max_perimeter_px:
            raise OptionError(
                f"perimeters of {self.min_perimeter_px:g} to {self.max_perimeter_px:g} px: the "
                "smallest must be at least 30 px and below the largest"
            )
        if not self.max_roundness > 1.0:
            raise OptionError(
                f"max_roundness = {self.max_roundness:g} lets no ring pass",
                remedy="give a number above 1; a ring tilted by 54 degrees has 1.7",
            )
        if self.disc not in ("light", "dark"):
            raise OptionError(f"disc = {self.disc} is not known", remedy="choose light or dark")
        if not 0.0 < self.min_contrast < 1.0:
            raise OptionError(f"min_contrast = {self.min_contrast:g} is not between 0 and 1")


def perimeter_limits(
    diameter_mm: float, focal_px: float, distances_mm: tuple[float, float], tolerance: float = 0.1
) -> tuple[float, float]:
    """Limits of eq. 4.19 for a ring of known size, ``P = pi D f / Z``.

    Parameters
    ----------
    diameter_mm
        Outer diameter D of the ring.
    focal_px
        Focal length f.
    distances_mm
        Nearest and farthest Z.
    tolerance
        Share by which the limits are widened: for the tilt's perspective and the print.

    Raises
    ------
    OptionError
        If a number is not positive, or the distances are not in order.
    """
    near, far = distances_mm
    if not (diameter_mm > 0.0 and focal_px > 0.0 and 0.0 < near <= far):
        raise OptionError(
            f"a ring of {diameter_mm:g} mm at {near:g} to {far:g} mm, focal length {focal_px:g} px",
            remedy="give positive numbers, the nearer distance first",
        )
    at_one_mm = float(np.pi * diameter_mm * focal_px)
    return (1.0 - tolerance) * at_one_mm / far, (1.0 + tolerance) * at_one_mm / near
