# SPDX-License-Identifier: Apache-2.0
"""What a hand-eye calibration returns, with all evidence for a report."""

from __future__ import annotations

from dataclasses import dataclass

from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.frames import Sensor, Tool
from armscan.geometry.poses import Pose
from armscan.models.scanner import HandEyeCalibration


@dataclass(frozen=True, slots=True, eq=False)
class StripeResidual:
    """What one exposure left over.

    Parameters
    ----------
    source, posture
        Names of the exposure and of its posture.
    points_base_mm
        (N, 3) points placed with the result.
    residual_mm
        (N,) signed distance from the reference.
    """

    source: str
    posture: str
    points_base_mm: FloatArray
    residual_mm: FloatArray

    def __post_init__(self) -> None:
        points = frozen_floats(self.points_base_mm, (None, 3), "points_base_mm")
        object.__setattr__(self, "points_base_mm", points)
        residual = frozen_floats(self.residual_mm, (len(points),), "residual_mm")
        object.__setattr__(self, "residual_mm", residual)


@dataclass(frozen=True, slots=True)
class PostureResult:
    """One posture of the arm.

    Parameters
    ----------
    posture
        Its name.
    n_exposures, n_points
        What was used.
    mean_mm, rms_mm
        Mean and root mean square distance of its points from the reference.
    normalised_mean
        The mean over the standard deviation that the noise model gives it after the fit, which
        follows a part of the errors.
    tilt_deg, azimuth_deg
        Of the sensor's optical axis against the plate's normal, and about it; NaN for a sphere.
    stand_off_mm
        Distance of the points from the camera.
    left_out_rotation_deg, left_out_translation_mm
        Change of the hand-eye if this posture is left out.
    left_out_normalised
        Size of the residuals of the posture when it took no part, over their predicted standard
        deviation; 1 is usual.
    """

    posture: str
    n_exposures: int
    n_points: int
    mean_mm: float
    rms_mm: float
    normalised_mean: float
    tilt_deg: float
    azimuth_deg: float
    stand_off_mm: float
    left_out_rotation_deg: float
    left_out_translation_mm: float
    left_out_normalised: float


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeFit:
    """A hand-eye calibration and its evidence.

    Parameters
    ----------
    calibration
        The result.
    start
        Where the refinement started: the linear solution.
    stripes, postures
        What each exposure and each posture left over.
    singular_values
        (6,) of the scaled and whitened system, largest first.
    reference
        What the reference was and how far the data agree with it, as (label, value) for a reader.
    warnings
        What is weak, in words.
    """

    calibration: HandEyeCalibration
    start: Pose[Tool, Sensor]
    stripes: tuple[StripeResidual, ...]
    postures: tuple[PostureResult, ...]
    singular_values: FloatArray
    reference: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        values = frozen_floats(self.singular_values, (None,), "singular_values")
        object.__setattr__(self, "singular_values", values)
