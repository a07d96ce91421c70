# SPDX-License-Identifier: Apache-2.0
"""Options of the hand-eye calibration on a sphere."""

from __future__ import annotations

import math
from dataclasses import dataclass

from armscan.errors import OptionError


@dataclass(frozen=True, slots=True)
class SphereOptions:
    """How stripes on a sphere become a hand-eye, and how much everything scatters.

    A standard deviation that is None is estimated from the data.

    Parameters
    ----------
    arm_position_mm
        Scatter of the scan point by the arm's pose, an axis, common to a posture.
    arm_rotation_rad
        Scatter of the arm's orientation, an axis, common to a posture; None follows the position.
    solve_diameter
        Solve the sphere's diameter along, without regard to the one given.
    solve_scale
        Solve a common scale of the sensor's points along.
    nodes_per_stripe
        Mean residuals that an exposure's stripe is condensed to.
    outlier_sigma
        Points further than this many robust sigmas from their section circle are rejected.
    posture_sigma
        Postures whose pose errs by more than this many standard deviations lose weight.
    min_points
        Fewest points that make a section of the sphere.
    min_arc_deg
        Shortest arc that makes a section of the sphere.
    same_rotation_deg
        Postures that turn by less against each other count as moved without turning.
    max_rms_mm
        Typical distance of the points from the sphere above which the data contradict each other
        and no hand-eye is returned.
    """

    arm_position_mm: float | None = None
    arm_rotation_rad: float | None = None
    solve_diameter: bool = False
    solve_scale: bool = False
    nodes_per_stripe: int = 24
    outlier_sigma: float = 5.0
    posture_sigma: float = 2.5
    min_points: int = 20
    min_arc_deg: float = 20.0
    same_rotation_deg: float = 0.1
    max_rms_mm: float = 0.5

    def __post_init__(self) -> None:
        for name in ("arm_position_mm", "arm_rotation_rad"):
            value = getattr(self, name)
            _require(
                value is None or (math.isfinite(value) and value >= 0.0),
                f"{name} is {value}",
                "give 0 or more, or leave it out to have it estimated",
            )
        rotation = self.arm_rotation_rad
        _require(
            rotation is None or rotation < 0.1,
            f"arm_rotation_rad is {rotation}",
            "an arm's orientation scatters by less than 0.1 rad: give rad, not degrees",
        )
        for name, least, most in (
            ("nodes_per_stripe", 6.0, 100.0),
            ("outlier_sigma", 2.0, 100.0),
            ("posture_sigma", 1.5, 1e6),
            ("min_points", 5.0, 1e6),
            ("min_arc_deg", 1.0, 180.0),
            ("same_rotation_deg", 1e-6, 5.0),
            ("max_rms_mm", 1e-6, 1000.0),
        ):
            value = getattr(self, name)
            _require(least <= value <= most, f"{name} is {value}", f"give {least:g} to {most:g}")


def check_diameter(diameter_mm: float) -> None:
    """Refuse a sphere that is none.

    Raises
    ------
    OptionError
        If the diameter is not between 1 and 1000 mm.
    """
    _require(
        1.0 <= diameter_mm <= 1000.0,
        f"a sphere of {diameter_mm} mm diameter",
        "give the diameter in mm, 1 to 1000",
    )


def _require(holds: bool, what: str, remedy: str) -> None:
    if not holds:
        raise OptionError(what, where="sphere hand-eye options", remedy=remedy)


DEFAULT_OPTIONS = SphereOptions()
