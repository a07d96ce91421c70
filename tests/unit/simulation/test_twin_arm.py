# SPDX-License-Identifier: Apache-2.0
"""The twin's arm: screws against two other ways of writing the same chain, inverse, encoders."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.errors import EstimationError
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import vector_from_rotation
from armscan.models.arm import forward, quarter_turn_flange, thesis_arm
from armscan.simulation.arm.arm import (
    ARC_SECOND_RAD,
    COMFORTABLE_RAD,
    ArmErrors,
    MeasuringArm,
    bent_arm,
    nominal_arm,
    reach,
)


def test_a_quarter_turn_of_shoulder_and_elbow_is_where_the_drawing_says():
    # Shoulder forward by 90 degrees: the upper arm lies along +x at the shoulder's height 300,
    # 40 mm above it for each link's step back. Elbow down by 90 degrees: the forearm points to -z.
    joints = np.zeros(7)
    joints[1] = joints[3] = np.pi / 2
    pose = nominal_arm().pose(joints)
    np.testing.assert_allclose(pose.rotation, np.diag([-1.0, 1.0, -1.0]), atol=1e-15)
    # x: 600 upper arm, then the two steps back beyond the elbow, now forwards: 40 + 40
    # z: 300, the step at the shoulder up 40 and at the elbow up 40 ... minus 500 and 200
    np.testing.assert_allclose(pose.translation_mm, [600.0 + 80.0, 0.0, 340.0 - 700.0], atol=1e-10)


def test_a_turn_of_the_first_and_last_joint_turns_the_tool_about_the_vertical():
    pose = nominal_arm().pose(np.array([np.pi / 2, 0, 0, 0, 0, 0, np.pi / 2]))
    np.testing.assert_allclose(pose.rotation, np.diag([-1.0, -1.0, 1.0]), atol=1e-15)
    np.testing.assert_allclose(pose.translation_mm, [0.0, -120.0, 1600.0], atol=1e-10)


def test_screws_agree_with_the_chain_of_link_matrices():
    links = thesis_arm((300, 600, 500, 200), (40, 40, 40), flange=quarter_turn_flange())
    joints = np.random.default_rng(5).uniform(-np.pi, np.pi, (200, 7))
    rotations, translations = nominal_arm().transforms(joints)
    expected_rotations, expected_translations = forward(links, joints)
    np.testing.assert_allclose(rotations, expected_rotations, atol=1e-13)
    np.testing.assert_allclose(translations, expected_translations, atol=1e-9)


def test_turned_axes_are_the_instantaneous_screws():
    arm = bent_arm(nominal_arm(), 0.01, 1.0, np.random.default_rng(2))
    joints, step = np.random.default_rng(3).uniform(-1.0, 1.0, 7), 1e-6
    here, axes, points = arm.pose_and_axes(joints)
    for i in range(7):
        ahead, behind = (arm.pose(joints + sign * step * np.eye(7)[i]) for sign in (1, -1))
        turn = vector_from_rotation(ahead.rotation @ behind.rotation.T) / (2 * step)
        speed = (ahead.translation_mm - behind.translation_mm) / (2 * step)
        np.testing.assert_allclose(turn, axes[i], atol=1e-8)
        lever = here.translation_mm - points[i]
        np.testing.assert_allclose(speed, np.cross(axes[i], lever), atol=1e-5)


def test_the_inverse_reaches_and_keeps_the_elbow():
    arm = bent_arm(nominal_arm(), 1e-3, 0.5, np.random.default_rng(1))
    rng = np.random.default_rng(4)
    for _ in range(12):
        wanted = arm.pose(COMFORTABLE_RAD + rng.uniform(-0.5, 0.5, 7))
        joints = reach(arm, wanted)
        found = arm.pose(joints)
        assert np.abs(found.translation_mm - wanted.translation_mm).max() < 1e-7
        assert np.abs(found.rotation - wanted.rotation).max() < 1e-9
        # Among all elbows the nearest to the preferred one: no step along the free motion helps.
        _, axes, points = arm.pose_and_axes(joints)
        lever = found.translation_mm - points
        free = np.linalg.svd(np.concatenate([axes, np.cross(axes, lever)], 1).T)[2][6]
        assert abs(free @ (joints - COMFORTABLE_RAD)) < 1e-4


def test_a_place_out_of_reach_is_said_to_be():
    away: Pose[Base, Tool] = Pose(np.eye(3), np.array([1900.0, 0.0, 300.0]))
    with pytest.raises(EstimationError, match="cannot bring its tool"):
        reach(nominal_arm(), away)


def test_white_noise_is_new_in_every_reading_and_has_its_size():
    arm = MeasuringArm.build(ArmErrors(2.0, 0.0, 0.0, 0.0, 0.0), np.random.default_rng(1))
    joints = np.tile(COMFORTABLE_RAD, (4000, 1))
    noise = (arm.readings(joints, np.random.default_rng(2)) - joints) / ARC_SECOND_RAD
    # 28,000 values: the standard deviation is known to 0.4 %; successive rows do not correlate.
    assert noise.std() == pytest.approx(2.0, rel=0.02)
    assert abs(np.mean(noise[1:] * noise[:-1])) < 4.0 * 4.0 / np.sqrt(noise.size)


def test_eccentricity_is_a_wave_once_and_twice_per_turn():
    arm = MeasuringArm.build(ArmErrors(0.0, 3.0, 1.0, 0.0, 0.0), np.random.default_rng(1))
    turn = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    joints = np.tile(turn[:, None], (1, 7))
    wave = (arm.readings(joints, np.random.default_rng(2)) - joints) / ARC_SECOND_RAD
    spectrum = np.abs(np.fft.rfft(wave, axis=0)) / 32.0
    np.testing.assert_allclose(spectrum[1], 3.0, rtol=1e-9)
    np.testing.assert_allclose(spectrum[2], 1.0, rtol=1e-9)
    assert np.delete(spectrum, [1, 2], axis=0).max() < 1e-9
    again = arm.readings(joints, np.random.default_rng(3))
    np.testing.assert_allclose(again - joints, wave * ARC_SECOND_RAD, atol=1e-14)
