# SPDX-License-Identifier: Apache-2.0
"""Profiles and poses joined: postures, noise of the points, floor and outliers at the sphere."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.calibration.hand_eye.calibrate import calibrate_on_sphere
from armscan.calibration.hand_eye.result import HandEyeFit
from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.pipeline.hand_eye import posed_stripes_from_profiles
from armscan.records.profile import PointProfile

SEED = 2
NOISE_MM = 0.01
RADIUS_MM = 40.0
CENTRE_MM = np.array([1000.0, 200.0, 50.0])
TOOL_FROM_SENSOR = Pose(
    Rotation.from_euler("xyz", [-1.0, -179.0, 90.0], degrees=True).as_matrix(),
    np.array([-60.0, 120.0, 180.0]),
)
FLOOR_MM = 30.0
"""The floor under the sphere, below its centre by this much in the sensor's z."""


def profile(name: str, points: FloatArray) -> PointProfile:
    return PointProfile(source=name, points_mm=points)


def cut(sensor_from_base: Pose, generator: np.random.Generator) -> FloatArray:
    """Profile in the plane y = 0 over x: the near side of the sphere, floor beside it, spikes."""
    centre = sensor_from_base.matrix[:3] @ [*CENTRE_MM, 1.0]
    radius = np.sqrt(RADIUS_MM**2 - centre[1] ** 2)
    x = centre[0] + np.arange(-60.0, 60.0, 0.1)
    inside = np.abs(x - centre[0]) < 0.93 * radius
    rise = np.sqrt(np.maximum(radius**2 - (x - centre[0]) ** 2, 0.0))
    z = np.where(inside, centre[2] + rise, centre[2] - FLOOR_MM)
    z += generator.normal(0.0, NOISE_MM, len(x))
    spikes = generator.integers(0, len(x), 12)
    z[spikes] += generator.uniform(1.0, 8.0, 12)
    return np.column_stack([x, np.zeros_like(x), z])


def scan(n: int) -> tuple[list[PointProfile], list[Pose[Base, Tool]]]:
    generator = np.random.default_rng(SEED)
    profiles, poses = [], []
    for k in range(n):
        turn = Rotation.from_rotvec(generator.uniform(-0.5, 0.5, 3)).as_matrix()
        seen = np.array([generator.uniform(-15, 15), 4.0 + 5.0 * (k % 5), -20.0 - 4.0 * (k % 4)])
        in_tool = TOOL_FROM_SENSOR.matrix[:3] @ [*seen, 1.0]
        pose: Pose[Base, Tool] = Pose(turn, CENTRE_MM - turn @ in_tool)
        sensor_from_base = TOOL_FROM_SENSOR.inverse() @ pose.inverse()
        profiles.append(profile(f"p{k}", cut(sensor_from_base, generator)))
        poses.append(pose)
    return profiles, poses


def test_floor_and_spikes_do_not_disturb_the_hand_eye() -> None:
    profiles, poses = scan(10)
    fit = calibrate_on_sphere(posed_stripes_from_profiles(profiles, poses), 2.0 * RADIUS_MM)
    assert isinstance(fit, HandEyeFit), fit
    assert fit.calibration.rms_mm < 1.2 * NOISE_MM
    error = fit.calibration.tool_from_sensor.translation_mm - TOOL_FROM_SENSOR.translation_mm
    sigma = np.sqrt(np.diag(fit.calibration.covariance))[3:]
    assert (np.abs(error) < 4.5 * sigma).all()
    assert sigma.max() < 10.0 * NOISE_MM
    # about 745 of 1200 points lie on the sphere; none of the floor may be counted
    assert all(500 < posture.n_points < 750 for posture in fit.postures)


def test_noise_is_the_scatter_about_a_smooth_profile() -> None:
    generator = np.random.default_rng(SEED)
    x = np.arange(-20.0, 20.0, 0.02)
    for course in (0.3 * x, np.sqrt(40.0**2 - x**2)):
        z = course + generator.normal(0.0, NOISE_MM, len(x))
        stripe = posed_stripes_from_profiles(
            [profile("p", np.column_stack([x, 0.0 * x, z]))], [Pose(np.eye(3), np.zeros(3))]
        )[0]
        size = np.linalg.norm(stripe.noise_mm, axis=1)
        # across a slanted profile, noise in z acts with the cosine of the slope; 5 % of scatter
        assert np.median(size) == pytest.approx(NOISE_MM, rel=0.12)
        assert np.abs(stripe.noise_mm[:, 1]).max() < 1e-9
        assert stripe.sheet.max() == 0


def test_profiles_of_one_pose_are_one_posture() -> None:
    points = np.column_stack([np.arange(30.0), np.zeros(30), np.zeros(30)])
    origin: Pose[Base, Tool] = Pose(np.eye(3), np.zeros(3))
    near: Pose[Base, Tool] = Pose(np.eye(3), np.array([0.02, 0.0, 0.0]))
    away: Pose[Base, Tool] = Pose(np.eye(3), np.array([5.0, 0.0, 0.0]))
    turned: Pose[Base, Tool] = Pose(Rotation.from_rotvec([0.0, 0.01, 0.0]).as_matrix(), np.zeros(3))
    profiles = [profile(name, points) for name in "abcd"]
    stripes = posed_stripes_from_profiles(profiles, [origin, away, near, turned])
    assert [stripe.posture for stripe in stripes] == ["a", "b", "a", "d"]
    assert [stripe.source for stripe in stripes] == list("abcd")
    # a straight line has no plane of its own, so its noise has no direction
    assert (stripes[0].noise_mm == 0.0).all()


def test_missing_poses_are_refused() -> None:
    with pytest.raises(InputError, match="2 profiles but 1 poses"):
        posed_stripes_from_profiles(
            [profile("a", np.eye(3)), profile("b", np.eye(3))], [Pose(np.eye(3), np.zeros(3))]
        )
