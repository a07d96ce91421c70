# SPDX-License-Identifier: Apache-2.0
"""What a hand-eye calibration looks at."""

from __future__ import annotations

from dataclasses import dataclass

from armscan.geometry.arrays import FloatArray, IntArray, frozen_floats, frozen_ints
from armscan.geometry.fitting import Plane
from armscan.geometry.frames import Base, Tool
from armscan.geometry.poses import Pose


@dataclass(frozen=True, slots=True, eq=False)
class PosedStripe:
    """Points of one exposure, with the pose that the arm reported for it.

    Parameters
    ----------
    source
        Name of the exposure.
    posture
        Exposures of equal posture were taken without moving the arm.
    base_from_tool
        As the arm reported it.
    points_mm
        (N, 3) in the Sensor frame.
    noise_mm
        (N, 3, J) one standard deviation of each of a point's own noises, as the vector in which it
        acts: one of each camera that saw the point.
    sheet
        (N,) index of the light sheet that each point lies on.
    by_sensor
        (N, 3, P) derivative of the points by all the sensor's parameters, or None where the
        sensor delivered points.
    """

    source: str
    posture: str
    base_from_tool: Pose[Base, Tool]
    points_mm: FloatArray
    noise_mm: FloatArray
    sheet: IntArray
    by_sensor: FloatArray | None = None

    def __post_init__(self) -> None:
        points = frozen_floats(self.points_mm, (None, 3), "points_mm")
        object.__setattr__(self, "points_mm", points)
        noise = frozen_floats(self.noise_mm, (len(points), 3, None), "noise_mm")
        object.__setattr__(self, "noise_mm", noise)
        object.__setattr__(self, "sheet", frozen_ints(self.sheet, (len(points),), "sheet"))

    def __len__(self) -> int:
        """Count of points."""
        return len(self.points_mm)


@dataclass(frozen=True, slots=True, eq=False)
class PlateReference:
    """The flat plate in Base, as it was probed (eq. 2.55).

    Parameters
    ----------
    plane
        Plane in Base; its normal points to the side from which it was probed and is scanned.
    covariance
        (3, 3) of `armscan.geometry.fitting.PLANE_PARAMETERS` (rad, rad, mm) at ``plane.point_mm``,
        without the arm's systematic part; None where it is not known, as of A, B, C, D alone.
    rms_mm
        Root mean square distance of the probed points from the plane; None where not known.
    n_points
        Count of probed points; 0 where only A, B, C, D are known.
    source
        Where it came from.
    tip_diameter_mm
        Diameter of the probe's tip that was compensated for; 0 where not known.
    """

    plane: Plane
    covariance: FloatArray | None = None
    rms_mm: float | None = None
    n_points: int = 0
    source: str = ""
    tip_diameter_mm: float = 0.0

    def __post_init__(self) -> None:
        if self.covariance is not None:
            covariance = frozen_floats(self.covariance, (3, 3), "covariance")
            object.__setattr__(self, "covariance", covariance)
