# SPDX-License-Identifier: Apache-2.0
"""How far repeated hand-eye calibrations scatter, against what each of them predicts (Table 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.rotations import euler_from_rotations, nearest_rotation
from armscan.models.calibration import HandEyeCalibration

REPEAT_NAMES = ("theta_deg", "gamma_deg", "phi_deg", "x_mm", "y_mm", "z_mm")
"""Order of all (6,) and (K, 6) arrays here: angles of eq. 2.69, then the translation in Tool."""
CONFIDENCE = 0.95
GIMBAL_SINE = 0.9999


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RepeatStudy:
    """K hand-eyes of one head, calibrated anew each time.

    Parameters
    ----------
    values
        (K, 6) angles and translation of each.
    mean
        Mean rotation (the rotation nearest to the mean matrix) and mean translation.
    std
        (6,) standard deviation of one calibration, with K - 1 in the denominator.
    predicted
        (6,) root of the mean predicted variance; None where covariances are not known.
    ratio_range
        Range in which ``std / predicted`` falls in 95 % of studies of K calibrations, if the
        prediction is right.
    """

    values: FloatArray
    mean: Pose[Tool, Sensor]
    std: FloatArray
    predicted: FloatArray | None
    ratio_range: tuple[float, float]

    @property
    def mean_values(self) -> FloatArray:
        """(6,) angles of the mean rotation in degrees, and mean translation in mm."""
        return _values(self.mean)

    @property
    def population_std(self) -> FloatArray:
        """(6,) standard deviation with K in the denominator, as Table 4 prints it."""
        n = len(self.values)
        return np.asarray(self.std * np.sqrt((n - 1) / n))

    @property
    def ratio(self) -> FloatArray | None:
        """(6,) observed over predicted standard deviation; None without prediction."""
        return None if self.predicted is None else self.std / self.predicted

    @property
    def unlike_predicted(self) -> tuple[str, ...]:
        """Names of the parameters whose scatter falls out of the range."""
        ratio = self.ratio
        if ratio is None:
            return ()
        low, high = self.ratio_range
        return tuple(
            name
            for name, one in zip(REPEAT_NAMES, ratio.tolist(), strict=True)
            if not low <= one <= high
        )


def study_repeats(
    calibrations: Sequence[HandEyeCalibration], sensor_covariance: FloatArray | None = None
) -> RepeatStudy | FitFailure:
    """Compare the scatter of repeated calibrations with the standard deviations they state.

    Parameters
    ----------
    calibrations
        Two or more of one head; each with its covariance.
    sensor_covariance
        (P, P) of the one sensor that all were calibrated with. What its error does to all alike is
        left out; how differently it moves them, as their postures differ, is a part of the
        scatter. None takes it as exact.
    """
    poses = [one.tool_from_sensor for one in calibrations]
    covariances = [one.covariance for one in calibrations]
    follow = [one.dhand_eye_dsensor for one in calibrations if one.dhand_eye_dsensor is not None]
    n = len(calibrations)
    if sensor_covariance is not None and len(follow) == n > 1:
        apart = np.array(follow) - np.mean(follow, axis=0)
        unlike = n / (n - 1) * (apart @ sensor_covariance @ apart.transpose(0, 2, 1))
        covariances = [own + more for own, more in zip(covariances, unlike, strict=True)]
    return study_poses(poses, covariances)


def study_poses(
    poses: Sequence[Pose[Tool, Sensor]], covariances: Sequence[FloatArray] | None = None
) -> RepeatStudy | FitFailure:
    """As `study_repeats`, from hand-eyes alone.

    Parameters
    ----------
    poses
        ``tool_from_sensor`` of each calibration.
    covariances
        (6, 6) of each in the order of
        `armscan.models.calibration.HAND_EYE_PARAMETER_NAMES`, or None.

    Raises
    ------
    InputError
        If the counts differ.
    """
    n = len(poses)
    if covariances is not None and len(covariances) != n:
        raise InputError(f"{len(covariances)} covariances for {n} hand-eyes")
    if n < 2:
        return FitFailure(f"{n} calibration has no scatter", "calibrate two times or more")
    rotation = nearest_rotation(np.sum([pose.rotation for pose in poses], axis=0))
    shift = np.mean([pose.translation_mm for pose in poses], axis=0)
    mean: Pose[Tool, Sensor] = Pose(rotation, shift)
    if abs(rotation[0, 2]) > GIMBAL_SINE:
        return FitFailure(
            "the angles of eq. 2.69 are not unique: gamma is 90 degrees",
            "compare rotation vectors instead",
        )
    centre = _values(mean)
    values = np.array([_values(pose) for pose in poses])
    values[:, :3] = centre[:3] + (values[:, :3] - centre[:3] + 180.0) % 360.0 - 180.0
    predicted = None
    if covariances is not None:
        spread = [
            angle_covariance(pose.rotation, covariance)
            for pose, covariance in zip(poses, covariances, strict=True)
        ]
        predicted = np.sqrt(np.diag(np.mean(spread, axis=0)))
    low, high = np.sqrt(chi2.ppf([0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE], n - 1) / (n - 1))
    std = values.std(axis=0, ddof=1)
    return RepeatStudy(
        values=values,
        mean=mean,
        std=std,
        predicted=predicted,
        ratio_range=(float(low), float(high)),
    )


def angle_covariance(rotation: FloatArray, covariance: FloatArray) -> FloatArray:
    """(6, 6) covariance of `REPEAT_NAMES` from that of the hand-eye's parameters.

    With R = Rx(theta) Ry(gamma) Rz(phi) of eq. 2.69, turns of the three angles act about x, about
    the turned y and about the twice turned z.

    Parameters
    ----------
    rotation
        (3, 3) of ``tool_from_sensor``; gamma not 90 degrees.
    covariance
        (6, 6) in the order of `armscan.models.calibration.HAND_EYE_PARAMETER_NAMES`.
    """
    theta = float(np.radians(_values(Pose(rotation, np.zeros(3)))[0]))
    turned_y = np.array([0.0, np.cos(theta), np.sin(theta)])
    axes = np.column_stack([[1.0, 0.0, 0.0], turned_y, rotation[:, 2]])
    by_parameters = np.eye(6)
    by_parameters[:3, :3] = np.degrees(np.linalg.inv(axes))
    return np.asarray(by_parameters @ covariance @ by_parameters.T)


def _values(pose: Pose[Tool, Sensor]) -> FloatArray:
    angles = np.degrees(euler_from_rotations(pose.rotation, "intrinsic-xyz")[0])
    return np.concatenate([angles, pose.translation_mm])
