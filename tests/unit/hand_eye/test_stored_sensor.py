# SPDX-License-Identifier: Apache-2.0
"""The hand-eye belongs to the sensor that stands beside it: points of other postures are right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.hand_eye.calibrate import calibrate_on_plate, calibrate_on_sphere
from armscan.calibration.hand_eye.observations import HandEyeOptions, PosedStripe
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.calibration.hand_eye.surface import hand_eye_difference
from armscan.geometry.arrays import FloatArray
from rigs.calibrated_head import CalibratedHead
from rigs.plate_rig import PLATE_NORMAL, RigNoise
from rigs.sphere_rig import DIAMETER_MM, SphereRig, turned_poses

NOISE = RigNoise()
GIVEN = HandEyeOptions(
    arm_position_mm=float(np.hypot(NOISE.posture_mm, NOISE.exposure_mm)),
    arm_rotation_rad=float(np.hypot(NOISE.posture_rad, NOISE.exposure_rad)),
    plate_flatness_mm=NOISE.flatness_mm,
    sheet_shape_mm=0.0,
    stripe_noise_factor=1.0,
)
POOR_CAMERA = 3.0
"""Times the camera's usual sigmas: 1.8 px of focal length."""


def _change(one: HandEyeFit, other: HandEyeFit) -> FloatArray:
    """(6,) difference of two hand-eyes over the sigma of the second."""
    change = hand_eye_difference(
        one.calibration.tool_from_sensor, other.calibration.tool_from_sensor
    )
    return np.asarray(change / np.sqrt(np.diag(other.calibration.covariance)))


def test_on_a_plate_what_the_sensor_is_known_to_does_not_move_the_hand_eye() -> None:
    """With scatter that is given, only the stored sensor's points decide: as if it were exact."""
    head = CalibratedHead(POOR_CAMERA, 1)
    sensor = head.sensor()
    stripes, plate = head.stripes(sensor)
    exact = calibrate_on_plate(stripes, plate, GIVEN)
    fit = calibrate_on_plate(stripes, plate, GIVEN, sensor_covariance=sensor.covariance)
    assert isinstance(exact, HandEyeFit) and isinstance(fit, HandEyeFit)
    assert np.abs(_change(fit, exact)).max() < 1e-2
    np.testing.assert_allclose(
        fit.calibration.covariance, exact.calibration.covariance, rtol=1e-2, atol=1e-12
    )
    assert fit.calibration.rms_mm == pytest.approx(exact.calibration.rms_mm, rel=1e-3)


def test_on_a_sphere_what_the_sensor_is_known_to_does_not_move_the_hand_eye() -> None:
    """The sensor's points are skewed by 1 %, as its covariance allows.

    The form of the stripes is estimated, larger where no sensor explains a part of it, so that the
    weights differ a little; the hand-eye of a sensor that may move lies 4.2 sigmas off.
    """
    rig = SphereRig(pose_noise_mm=0.02, point_noise_mm=0.01, n_points=60)
    options = HandEyeOptions(
        per_stripe=10, arm_position_mm=0.02, arm_rotation_rad=0.02 / 265.0, posture_sigmas=1e6
    )
    stripes = [_skewed(one) for one in rig.stripes(turned_poses(rig), np.random.default_rng(2))]
    exact = calibrate_on_sphere(stripes, DIAMETER_MM, options)
    fit = calibrate_on_sphere(
        stripes, DIAMETER_MM, options, sensor_covariance=np.array([[0.01**2]])
    )
    assert isinstance(exact, HandEyeFit) and isinstance(fit, HandEyeFit)
    assert np.abs(_change(fit, exact)).max() < 1.0


def _skewed(stripe: PosedStripe) -> PosedStripe:
    by_skew = (stripe.points_mm - [0.0, 0.0, 140.0])[:, [2, 1, 1]] * [1.0, 0.0, 0.0]
    return replace(
        stripe, points_mm=stripe.points_mm + 0.01 * by_skew, dpoint_dsensor=by_skew[:, :, None]
    )


def test_points_of_other_postures_are_right_with_a_poor_camera() -> None:
    """From photographs' features to points in Base, beside where they truly are.

    Along the plate's normal arm and stripes alone make 0.0071 mm (a camera that is exact); with
    the hand-eye of the sensor as a joint fit would move it, these draws have 0.04 to 0.05 mm.
    """
    squares, claims = [], []
    for seed in range(8):
        head = CalibratedHead(POOR_CAMERA, seed)
        sensor = head.sensor()
        stripes, plate = head.stripes(sensor)
        fit = calibrate_on_plate(stripes, plate, sensor_covariance=sensor.covariance)
        assert isinstance(fit, HandEyeFit)
        error, covariance = head.scan(sensor, fit.calibration)
        squares.append(float(((error @ PLATE_NORMAL) ** 2).mean()))
        normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
        claims.append(float(normalised.mean()) / 3.0)
    assert np.sqrt(np.mean(squares)) < 2.5 * 0.0071
    assert 0.6 < np.mean(claims) < 1.5, "20 draws have 1.03"
