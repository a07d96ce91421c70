# SPDX-License-Identifier: Apache-2.0
"""The whole scanner: a sensor and where it sits on the arm's last link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.fitting import Plane
from armscan.geometry.frames import Sensor, Tool
from armscan.geometry.poses import Pose
from armscan.models.calibration import Provenance, SensorCalibration

HAND_EYE_PARAMETER_NAMES = (
    "rotation_x_tool_rad",
    "rotation_y_tool_rad",
    "rotation_z_tool_rad",
    "translation_x_tool_mm",
    "translation_y_tool_mm",
    "translation_z_tool_mm",
)
"""Order of the hand-eye's parameters: rotation-vector increment in Tool, multiplied from the left
(``R <- exp(dr) R``), then the increment of the translation."""

HandEyeMethod = Literal["plate", "sphere"]


@dataclass(frozen=True, slots=True)
class ArmNoise:
    """How much the arm's reported pose scatters, one standard deviation an axis.

    Parameters
    ----------
    position_mm
        Of the scan point (the middle of the sensor's working range), common to a posture.
    rotation_rad
        Of the orientation, common to a posture.
    exposure_position_mm, exposure_rotation_rad
        The part that is new in every exposure.
    """

    position_mm: float
    rotation_rad: float
    exposure_position_mm: float = 0.0
    exposure_rotation_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class HandEyeDiagnostics:
    """Evidence of a hand-eye calibration.

    Parameters
    ----------
    method
        What was looked at.
    rank, condition
        Of the whitened and scaled system of the hand-eye's six parameters.
    weakest
        The combination of parameters that is known least, in words.
    plate_flatness_mm, flatness_length_mm
        Standard deviation and correlation length of the plate's flatness in the noise model.
    is_noise_estimated
        True if the variances came from the data, not from the user.
    left_out_rotation_deg, left_out_translation_mm
        Largest change when one posture is left out.
    chi2_probability
        Probability of residuals at least this large under the noise model.
    """

    method: HandEyeMethod
    rank: int
    condition: float
    weakest: str
    plate_flatness_mm: float
    flatness_length_mm: float
    is_noise_estimated: bool
    left_out_rotation_deg: float
    left_out_translation_mm: float
    chi2_probability: float


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeCalibration:
    """Where the sensor sits on the arm's last link.

    Parameters
    ----------
    tool_from_sensor
        The hand-eye.
    covariance
        (6, 6) in the order of `HAND_EYE_PARAMETER_NAMES`: arm, plate and stripe noise, the sensor
        being held fixed.
    sensor_coupling
        (6, P) derivative of these parameters by the sensor's, in the order of the sensor's
        ``parameter_names``: an error of the sensor moves the hand-eye. None where points came
        without a sensor's calibration.
    arm_noise
        Of the arm during the calibration; scans are given the same.
    rms_mm
        Root mean square distance of the points from the reference.
    n_postures, n_exposures, n_points
        What was used.
    plate
        The plate in Base: frame "Base"; None after a sphere.
    diagnostics
        Evidence for a reader; None where there is none.
    """

    tool_from_sensor: Pose[Tool, Sensor]
    covariance: FloatArray
    sensor_coupling: FloatArray | None
    arm_noise: ArmNoise
    rms_mm: float
    n_postures: int
    n_exposures: int
    n_points: int
    plate: Plane | None = None
    diagnostics: HandEyeDiagnostics | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", frozen_floats(self.covariance, (6, 6), "covariance"))
        if self.sensor_coupling is not None:
            coupling = frozen_floats(self.sensor_coupling, (6, None), "sensor_coupling")
            object.__setattr__(self, "sensor_coupling", coupling)


@dataclass(frozen=True, slots=True, eq=False)
class ScannerCalibration:
    """All that turns exposures and arm samples into points in Base.

    Parameters
    ----------
    sensor
        Camera and sheets; None for a sensor that delivers points itself.
    hand_eye
        Its place on the arm.
    provenance
        How it came to be.
    latency_ns
        Added to an exposure's time before the arm's pose is looked up.
    """

    sensor: SensorCalibration | None
    hand_eye: HandEyeCalibration
    provenance: Provenance
    latency_ns: int = 0

    def __post_init__(self) -> None:
        coupling = self.hand_eye.sensor_coupling
        if self.sensor is None or coupling is None:
            return
        if coupling.shape[1] != len(self.sensor.parameter_names):
            raise InputError(
                f"the hand-eye depends on {coupling.shape[1]} parameters, but the sensor has "
                f"{len(self.sensor.parameter_names)}"
            )

    @property
    def covariance(self) -> FloatArray:
        """(P + 6, P + 6) joint covariance of the sensor's parameters and the hand-eye's.

        An error of the sensor and what it does to the hand-eye largely cancel in the points, so
        the two must not be taken as independent.
        """
        if self.sensor is None:
            return self.hand_eye.covariance
        coupling = self.hand_eye.sensor_coupling
        n = len(self.sensor.parameter_names)
        follow = np.zeros((6, n)) if coupling is None else coupling
        spread = np.vstack([np.eye(n), follow])
        joint = spread @ self.sensor.covariance @ spread.T
        joint[n:, n:] += self.hand_eye.covariance
        return np.asarray(joint)
