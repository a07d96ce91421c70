# SPDX-License-Identifier: Apache-2.0
"""Scatter of repeated hand-eyes: Table 4 as printed, derivatives, and sound predictions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.result import (
    REPEAT_NAMES,
    RepeatStudy,
    angle_covariance,
    study_poses,
    study_repeats,
)
from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.geometry.rotations import nearest_rotation, rotation_from_vector
from armscan.models.calibration import ArmNoise, HandEyeCalibration
from rigs.thesis_instrument import MEAN_ROTATION, TABLE_4, TABLE_4_MEAN, TABLE_4_STD

SEED = 3


def pose(row: FloatArray) -> Pose[Tool, Sensor]:
    rotation = Rotation.from_euler("XYZ", row[:3], degrees=True).as_matrix()
    return Pose(rotation, row[3:])


def solved(result: RepeatStudy | FitFailure) -> RepeatStudy:
    assert isinstance(result, RepeatStudy), result
    return result


def test_table_4_is_reproduced() -> None:
    """Its standard deviations divide by five; one calibration's own, by four, is 12 % larger."""
    study = solved(study_poses([pose(row) for row in TABLE_4]))
    np.testing.assert_allclose(study.values, TABLE_4, atol=1e-9)
    # printed to three digits; the mean of matrices is the mean of such small turns to 1e-4 degrees
    np.testing.assert_allclose(study.mean_values, TABLE_4_MEAN, atol=0.0011)
    np.testing.assert_allclose(study.std * np.sqrt(4 / 5), TABLE_4_STD, atol=0.00006)
    # the printed mean matrix is nearly the first calibration's: 0.013 degrees off its own angles
    np.testing.assert_allclose(study.mean.rotation, MEAN_ROTATION, atol=2.5e-4)
    assert study.predicted is None
    assert study.ratio is None
    assert study.unlike_predicted == ()


def test_angles_near_the_turn_of_phi_are_not_averaged_across_it() -> None:
    rows = np.array([[10.0, 20.0, 179.9, 0, 0, 0], [10.0, 20.0, -179.9, 0, 0, 0]])
    study = solved(study_poses([pose(row) for row in rows]))
    assert abs(abs(study.mean_values[2]) - 180.0) < 1e-9
    assert study.std[2] == pytest.approx(0.1 * np.sqrt(2.0))


def test_angle_covariance_is_the_derivative() -> None:
    start = pose(np.array([-21.4, -38.1, -122.6, 1.0, 2.0, 3.0]))
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        turned = Pose(rotation_from_vector(step) @ start.rotation, start.translation_mm)
        both = solved(study_poses([start, turned]))
        change = both.values[1] - both.values[0]
        source = np.zeros((6, 6))
        source[k, k] = 1e-12
        found = angle_covariance(start.rotation, source)
        np.testing.assert_allclose(found, np.outer(change, change), atol=1e-6 * np.abs(found).max())


def test_sound_predictions_are_found_sound_and_bad_ones_named() -> None:
    generator = np.random.default_rng(SEED)
    true = pose(TABLE_4_MEAN)
    root = np.diag([1e-3, 5e-4, 8e-4, 0.05, 0.02, 0.08])
    root[3, 0] = 0.03
    covariance = root @ root.T

    def draw(stated: FloatArray) -> HandEyeCalibration:
        error = root @ generator.normal(size=6)
        turned = rotation_from_vector(error[:3]) @ true.rotation
        moved = Pose(nearest_rotation(turned), true.translation_mm + error[3:])
        return HandEyeCalibration(
            tool_from_sensor=moved,
            covariance=stated,
            dhand_eye_dsensor=None,
            arm_noise=ArmNoise(position_mm=0.01, rotation_rad=1e-5),
            rms_mm=0.01,
            n_postures=12,
            n_exposures=24,
            n_points=1000,
        )

    study = solved(study_repeats([draw(covariance) for _ in range(200)]))
    assert study.ratio is not None
    # 200 repeats know a standard deviation to 5 %
    np.testing.assert_allclose(study.ratio, 1.0, atol=4.0 * 0.05)
    five = solved(study_repeats([draw(covariance / 100.0) for _ in range(12)]))
    assert five.unlike_predicted == REPEAT_NAMES
    assert five.ratio_range[0] < 1.0 < five.ratio_range[1]


def test_one_sensors_error_that_moves_the_repeats_apart_is_predicted() -> None:
    """Hand-eyes D s of one error s; a part of D that all share moves them alike and is no scatter.

    400 parameters of a sensor: |s|^2 is their count to 7 %.
    """
    generator = np.random.default_rng(SEED)
    scale = np.array([1e-4, 1e-4, 1e-4, 0.01, 0.02, 0.03])[:, None] / 20.0
    error, shared = generator.normal(size=400), 10.0 * generator.normal(size=(6, 400))
    calibrations = []
    for _ in range(100):
        coupling = scale * (shared + generator.normal(size=(6, 400)))
        change = coupling @ error
        turned = rotation_from_vector(change[:3]) @ pose(TABLE_4_MEAN).rotation
        moved = Pose(nearest_rotation(turned), TABLE_4_MEAN[3:] + change[3:])
        calibrations.append(
            HandEyeCalibration(
                tool_from_sensor=moved,
                covariance=1e-16 * np.eye(6),
                dhand_eye_dsensor=coupling,
                arm_noise=ArmNoise(position_mm=0.01, rotation_rad=1e-5),
                rms_mm=0.01,
                n_postures=12,
                n_exposures=24,
                n_points=1000,
            )
        )
    study = solved(study_repeats(calibrations, np.eye(400)))
    assert study.ratio is not None
    np.testing.assert_allclose(study.ratio, 1.0, atol=4.0 * np.hypot(0.07, 0.035))


def test_refusals() -> None:
    one = pose(TABLE_4[0])
    assert isinstance(study_poses([one]), FitFailure)
    with pytest.raises(InputError, match="1 covariances for 2"):
        study_poses([one, one], [np.eye(6)])
    gimbal = pose(np.array([0.0, 90.0, 0.0, 0.0, 0.0, 0.0]))
    failure = study_poses([gimbal, gimbal])
    assert isinstance(failure, FitFailure)
    assert "gamma is 90 degrees" in failure.reason
