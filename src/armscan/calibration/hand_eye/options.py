# SPDX-License-Identifier: Apache-2.0
"""Options of the hand-eye calibration on a flat plate."""

from __future__ import annotations

import math
from dataclasses import dataclass

from armscan.errors import OptionError


@dataclass(frozen=True, slots=True)
class HandEyeOptions:
    """How stripes on a flat plate become a hand-eye, and how much everything scatters.

    A standard deviation that is None is estimated from the data.

    Parameters
    ----------
    arm_position_mm
        Scatter of the scan point by the arm's pose, an axis, common to a posture.
    arm_rotation_rad
        Scatter of the arm's orientation, an axis, common to a posture. None follows the position
        (see `armscan.calibration.hand_eye.noise_model.ROTATION_LEVER_MM`).
    exposure_position_mm, exposure_rotation_rad
        The parts of both that are new in every exposure. None: none if the arm's position is
        given; else estimated where a posture has several exposures.
    plate_flatness_mm
        Standard deviation of the plate's smooth flatness error.
    flatness_length_mm
        Length over which it stays alike; need not be exact.
    sheet_shape_mm
        Standard deviation of the light sheets' own shape, beyond what their parameters describe.
    stripe_noise_factor
        What the stripes' own noise is multiplied with.
    solve_plate
        Solve the plate's plane along, without regard to where it was probed.
    nodes_per_stripe
        Mean points that an exposure's stripe is condensed to before the refinement.
    line_tolerance_mm
        Half width of the band in which points belong to one stripe on the plate, before robust
        statistics tighten it.
    outlier_sigma
        Points further than this many robust sigmas from their stripe are rejected.
    min_points
        Fewest points that make a stripe.
    max_rms_mm
        Typical distance of a posture's points from the plate above which the data contradict each
        other and no hand-eye is returned.
    """

    arm_position_mm: float | None = None
    arm_rotation_rad: float | None = None
    exposure_position_mm: float | None = None
    exposure_rotation_rad: float | None = None
    plate_flatness_mm: float | None = None
    flatness_length_mm: float = 30.0
    sheet_shape_mm: float | None = None
    stripe_noise_factor: float | None = None
    solve_plate: bool = False
    nodes_per_stripe: int = 12
    line_tolerance_mm: float = 0.5
    outlier_sigma: float = 5.0
    min_points: int = 20
    max_rms_mm: float = 0.5

    def __post_init__(self) -> None:
        for name in (
            "arm_position_mm",
            "arm_rotation_rad",
            "exposure_position_mm",
            "exposure_rotation_rad",
            "plate_flatness_mm",
            "sheet_shape_mm",
            "stripe_noise_factor",
        ):
            value = getattr(self, name)
            _require(
                value is None or (math.isfinite(value) and value >= 0.0),
                f"{name} is {value}",
                "give 0 or more, or leave it out to have it estimated",
            )
        for name in ("arm_rotation_rad", "exposure_rotation_rad"):
            value = getattr(self, name)
            _require(
                value is None or value < 0.1,
                f"{name} is {value} rad",
                "an arm's orientation scatters by less than 0.1 rad: give rad, not degrees",
            )
        _require(
            1.0 <= self.flatness_length_mm <= 1000.0,
            f"flatness length of {self.flatness_length_mm} mm",
            "give 1 to 1000 mm",
        )
        _require(
            4 <= self.nodes_per_stripe <= 60,
            f"{self.nodes_per_stripe} nodes a stripe",
            "give 4 to 60",
        )
        for name in ("line_tolerance_mm", "max_rms_mm"):
            value = getattr(self, name)
            _require(
                math.isfinite(value) and value > 0.0, f"{name} is {value}", "give a positive length"
            )
        _require(
            self.outlier_sigma >= 2.0,
            f"outlier limit of {self.outlier_sigma} sigma",
            "give at least 2, or good points are lost",
        )
        _require(self.min_points >= 5, f"{self.min_points} points a stripe", "give at least 5")


def _require(holds: bool, what: str, remedy: str) -> None:
    if not holds:
        raise OptionError(what, where="hand-eye options", remedy=remedy)
