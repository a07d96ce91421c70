# SPDX-License-Identifier: Apache-2.0
"""A line of points from a sensor that delivers points instead of images."""

from __future__ import annotations

from dataclasses import dataclass

from armscan.geometry.arrays import FloatArray, frozen_floats


@dataclass(frozen=True, slots=True, eq=False)
class PointProfile:
    """Points of one profile.

    Parameters
    ----------
    source
        Where it came from, usually the file's name.
    points_mm
        (N, 3) in the Sensor frame; places where the sensor saw nothing are left out.
    n_gaps
        Count of such places.
    """

    source: str
    points_mm: FloatArray
    n_gaps: int = 0

    def __post_init__(self) -> None:
        points = frozen_floats(self.points_mm, (None, 3), "profile points (mm)")
        object.__setattr__(self, "points_mm", points)

    def __len__(self) -> int:
        """Count of points."""
        return len(self.points_mm)
