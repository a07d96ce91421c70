# SPDX-License-Identifier: Apache-2.0
"""Points touched with the arm's probe."""

from __future__ import annotations

from dataclasses import dataclass

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, frozen_floats


@dataclass(frozen=True, slots=True, eq=False)
class ProbedPoints:
    """Points in Base that a probe touched.

    Parameters
    ----------
    points_mm
        (N, 3) in Base: on the surface, or the tip's centres.
    tip_diameter_mm
        Diameter of the tip that touched; 0 where not known, for points on the surface.
    features
        (N,) name of the feature that each point belongs to; empty where nobody said.
    source
        Where they came from, for messages.
    is_compensated
        True if the tip's radius was taken off already: the points are on the surface.
    rows
        (N,) row of each point in its table, from 1; all rows in turn if empty.
    """

    points_mm: FloatArray
    tip_diameter_mm: float = 0.0
    features: tuple[str, ...] = ()
    source: str = ""
    is_compensated: bool = False
    rows: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        points = frozen_floats(self.points_mm, (None, 3), "probed points (mm)")
        object.__setattr__(self, "points_mm", points)
        if not 0.0 <= self.tip_diameter_mm < 1000.0:
            raise InputError(f"a tip of {self.tip_diameter_mm} mm diameter", where=self.source)
        if self.features and len(self.features) != len(points):
            raise InputError(
                f"{len(self.features)} features for {len(points)} points", where=self.source
            )
        rows = self.rows or tuple(range(1, len(points) + 1))
        if len(rows) != len(points):
            raise InputError(f"{len(rows)} rows for {len(points)} points", where=self.source)
        object.__setattr__(self, "rows", rows)

    def __len__(self) -> int:
        """Count of points."""
        return len(self.points_mm)

    @property
    def are_tip_centres(self) -> bool:
        """True if the points still have to be compensated for the tip's radius."""
        return self.tip_diameter_mm > 0.0 and not self.is_compensated
