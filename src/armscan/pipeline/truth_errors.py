# SPDX-License-Identifier: Apache-2.0
"""How far calibrations are from what a simulator made its images with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from armscan.errors import EstimationError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.frames import Sensor, Tool
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import vector_from_rotation
from armscan.models.calibration import CameraCalibration, SensorCalibration, SheetCalibration
from armscan.models.scanner import ScannerCalibration


@dataclass(frozen=True, slots=True)
class CameraErrors:
    """A calibrated camera against the true one.

    Parameters
    ----------
    focal_px, focal_sigma_px
        Error and stated sigma of fx.
    normalised, n_parameters
        Length of the error of all free parameters in their own sigmas, ``sqrt(e' C^-1 e)``, and
        their count.
    """

    focal_px: float
    focal_sigma_px: float
    normalised: float
    n_parameters: int


@dataclass(frozen=True, slots=True)
class SheetErrors:
    """A calibrated sheet against the true one, over the region of the boards.

    Parameters
    ----------
    angle_deg
        Between the two surfaces' directions in the middle.
    offset_mm
        Between them in the middle.
    rms_mm
        Root mean square distance over the true stripes.
    normalised
        Length of the error of the parameters in their own sigmas, ``sqrt(e' C^-1 e)``.
    n_parameters
        Count of parameters in it: 3 for a plane, 8 with a bow.
    """

    angle_deg: float
    offset_mm: float
    rms_mm: float
    normalised: float
    n_parameters: int


@dataclass(frozen=True, slots=True)
class HandEyeErrors:
    """A calibrated hand-eye against the true one.

    Parameters
    ----------
    rotation_deg, translation_mm
        Size of the rotation between them, and of the difference of their origins.
    normalised
        Length of the error of the six parameters in their own sigmas, the sensor's uncertainty
        included; 2.4 is usual.
    """

    rotation_deg: float
    translation_mm: float
    normalised: float


def camera_errors(camera: CameraCalibration, true_parameters: FloatArray) -> CameraErrors:
    """Errors of a camera; the true parameters (9,) in the order of the camera's own."""
    error = camera.camera.parameters - true_parameters
    is_free = np.asarray(np.diag(camera.covariance) > 0.0)
    return CameraErrors(
        focal_px=float(error[0]),
        focal_sigma_px=float(np.sqrt(camera.covariance[0, 0])),
        normalised=normalised_length(error, camera.covariance, is_free),
        n_parameters=int(is_free.sum()),
    )


def sheet_errors(
    calibration: SheetCalibration, covariance: FloatArray, true_points_mm: FloatArray
) -> SheetErrors:
    """Fit the parameters' error to the heights of true points over the calibrated sheet.

    Parameters
    ----------
    calibration
        The sheet.
    covariance
        (8, 8) of its parameters.
    true_points_mm
        (N, 3) points of the true sheet, Sensor frame.
    """
    sheet = calibration.sheet
    height, _, dheight = sheet.height_with_jacobian(true_points_mm)
    is_free = np.asarray(np.diag(covariance) > 0.0)
    error = np.zeros(len(covariance))
    error[is_free] = np.linalg.lstsq(dheight[:, is_free], height, rcond=None)[0]
    plane = np.linalg.lstsq(dheight[:, :3], height, rcond=None)[0]
    return SheetErrors(
        angle_deg=float(np.degrees(np.hypot(plane[0], plane[1]) / sheet.scale_mm)),
        offset_mm=float(plane[2]),
        rms_mm=float(np.sqrt(np.mean(height**2))),
        normalised=normalised_length(error, covariance, is_free),
        n_parameters=int(is_free.sum()),
    )


def true_names(
    sensor: SensorCalibration, true_points_mm: Mapping[str, FloatArray]
) -> dict[str, str]:
    """The true sheet that each calibrated one is, by its name: the nearest of all.

    A calibration numbers the lines of a source as it finds them; a line that no target ever saw
    shifts the numbers of those after it.

    Raises
    ------
    EstimationError
        If no true sheet has a point at the depths in which a sheet was calibrated.
    """
    found = {}
    for calibrated in sensor.sheets:
        low, high = calibrated.depth_range_mm
        distance = {}
        for name, points in true_points_mm.items():
            inside = points[(points[:, 2] >= low) & (points[:, 2] <= high)]
            if len(inside):
                height = calibrated.sheet.height_with_jacobian(inside)[0]
                distance[name] = float(np.mean(height**2))
        if not distance:
            raise EstimationError(
                f"sheet {calibrated.name} was calibrated from {low:.1f} to {high:.1f} mm, where no "
                "true sheet has a point: which one it is cannot be told",
                remedy="calibrate it over a larger range of depths, from boards of this head",
            )
        found[calibrated.name] = min(distance, key=lambda name: distance[name])
    return found


def hand_eye_errors(scanner: ScannerCalibration, truth: Pose[Tool, Sensor]) -> HandEyeErrors:
    """Errors of the hand-eye of a scanner, in the form of its own parameters."""
    found = scanner.hand_eye.tool_from_sensor
    turn = vector_from_rotation(found.rotation @ truth.rotation.T)
    shift = found.translation_mm - truth.translation_mm
    covariance = np.asarray(scanner.covariance[-6:, -6:])
    is_free = np.asarray(np.diag(covariance) > 0.0)
    return HandEyeErrors(
        rotation_deg=float(np.degrees(np.linalg.norm(turn))),
        translation_mm=float(np.linalg.norm(shift)),
        normalised=normalised_length(np.concatenate([turn, shift]), covariance, is_free),
    )


def normalised_length(error: FloatArray, covariance: FloatArray, is_free: BoolArray) -> float:
    """``sqrt(e' C^-1 e)`` over the free parameters."""
    chosen = np.ix_(is_free, is_free)
    return float(np.sqrt(error[is_free] @ np.linalg.solve(covariance[chosen], error[is_free])))
