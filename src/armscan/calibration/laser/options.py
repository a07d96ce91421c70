# SPDX-License-Identifier: Apache-2.0
"""Options of the light sheets' calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass

from armscan.errors import OptionError


@dataclass(frozen=True, slots=True)
class SheetOptions:
    """How stripes on boards become light sheets.

    Parameters
    ----------
    margin_mm
        Stripe points up to this far outside the rectangle of the target's points are used;
        negative keeps that far inside. None uses what the print covers, and of boards whose stripe
        lies beside it the carrier, as far as the boards agree.
    n_sheets
        Sheets that were on together; 0 finds out (the count of stripes that most images show).
    sheet_names
        Names to give, in the order of the stripes across the first image (left to right, or top
        to bottom where stripes lie flatter than 45 degrees); empty gives A, B, C, ...
    edge_widths
        A stripe point is left out if an edge of the target's marks that runs along the stripe is
        nearer than this many of the stripe's widths (sigma of its cross-section); 0 leaves none
        out.
    edge_angle_deg
        Largest angle between stripe and edge for this; edges that are turned further cross the
        stripe and pull it to neither side.
    line_tolerance_mm
        Half width of the band on the board in which points belong to one straight stripe, before
        robust statistics tighten it.
    outlier_sigma
        Points further than this many robust sigmas from their stripe or sheet are rejected.
    min_points
        Fewest points that make a stripe.
    lack_of_fit_p
        A bow is fitted when the plane's lack-of-fit probability is below this.
    min_boards_for_bow
        Fewest boards from which a bow is told from the boards' own errors.
    is_bow_allowed
        False holds every sheet to a plane.
    """

    margin_mm: float | None = None
    n_sheets: int = 0
    sheet_names: tuple[str, ...] = ()
    edge_widths: float = 3.0
    edge_angle_deg: float = 75.0
    line_tolerance_mm: float = 1.0
    outlier_sigma: float = 4.0
    min_points: int = 20
    lack_of_fit_p: float = 0.001
    min_boards_for_bow: int = 4
    is_bow_allowed: bool = True

    def __post_init__(self) -> None:
        _require(
            self.margin_mm is None or math.isfinite(self.margin_mm),
            f"margin of {self.margin_mm} mm",
            "give a finite length",
        )
        _require(0 <= self.n_sheets <= 32, f"{self.n_sheets} sheets", "give 0 (find out) to 32")
        _require(
            self.edge_widths >= 0.0,
            f"edges within {self.edge_widths} widths",
            "give 0 (use every point) or more",
        )
        _require(
            0.0 < self.edge_angle_deg <= 90.0,
            f"edges within {self.edge_angle_deg} deg of the stripe",
            "give an angle between 0 and 90",
        )
        _require(
            self.line_tolerance_mm > 0.0,
            f"line tolerance of {self.line_tolerance_mm} mm",
            "give a positive length",
        )
        _require(
            self.outlier_sigma >= 2.0,
            f"outlier limit of {self.outlier_sigma} sigma",
            "give at least 2, or good points are lost",
        )
        _require(self.min_points >= 5, f"{self.min_points} points a stripe", "give at least 5")
        _require(
            0.0 < self.lack_of_fit_p < 0.5,
            f"lack-of-fit probability {self.lack_of_fit_p}",
            "give a value between 0 and 0.5",
        )
        _require(
            self.min_boards_for_bow >= 3,
            f"bow from {self.min_boards_for_bow} boards",
            "give at least 3",
        )
        _require(
            len(set(self.sheet_names)) == len(self.sheet_names),
            "sheet names repeat",
            "give each sheet its own name",
        )
        _require(
            not self.sheet_names or self.n_sheets in (0, len(self.sheet_names)),
            f"{len(self.sheet_names)} names for {self.n_sheets} sheets",
            "give one name a sheet",
        )


def _require(holds: bool, what: str, remedy: str) -> None:
    if not holds:
        raise OptionError(what, where="light sheet options", remedy=remedy)
