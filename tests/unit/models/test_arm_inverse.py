# SPDX-License-Identifier: Apache-2.0
"""Joint angles from poses, and the probe's tip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose
from armscan.models.arm import (
    ArmModel,
    JointSolution,
    forward,
    inverse,
    quarter_turn_flange,
    thesis_arm,
)
from armscan.models.probe import compensate_tip, tip_centres, tool_from_probe
from armscan.records.recording import ArmTrack

ARM = thesis_arm((300.0, 600.0, 500.0, 200.0), (40.0, 40.0, 40.0), flange=quarter_turn_flange())
BENT = np.array([0.2, 0.7, -0.3, 1.1, 0.4, -0.8, 0.3])


def pose_at(arm: ArmModel, joints: np.ndarray) -> Pose:
    rotations, translations = forward(arm, joints[None])
    return Pose(rotations[0], translations[0])


def test_inverse_reaches_what_forward_gave() -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        truth = BENT + rng.uniform(-0.5, 0.5, 7)
        found = inverse(ARM, pose_at(ARM, truth), BENT)
        assert isinstance(found, JointSolution)
        rotations, translations = forward(ARM, found.joints_rad[None])
        wanted = pose_at(ARM, truth)
        np.testing.assert_allclose(translations[0], wanted.translation_mm, atol=1e-6)
        np.testing.assert_allclose(rotations[0], wanted.rotation, atol=1e-8)


def test_of_all_answers_it_takes_one_near_the_start() -> None:
    """Seven axes: a step of 0.01 rad in the pose must not make the elbow swing."""
    near = BENT + 0.01 * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0])
    found = inverse(ARM, pose_at(ARM, near), BENT)
    assert isinstance(found, JointSolution)
    assert np.linalg.norm(found.joints_rad - BENT) <= np.linalg.norm(near - BENT) * 1.01


def test_limits_are_kept_and_the_spare_axis_makes_up_for_them() -> None:
    truth = BENT + 0.3
    free = inverse(ARM, pose_at(ARM, truth), BENT)
    assert isinstance(free, JointSolution)
    high = np.full(7, 3.0)
    high[2] = 0.5 * (free.joints_rad[2] + BENT[2])
    arm = replace(ARM, joint_min_rad=np.full(7, -3.0), joint_max_rad=high)
    assert free.joints_rad[2] > high[2]
    found = inverse(arm, pose_at(ARM, truth), BENT)
    assert isinstance(found, JointSolution)
    assert (found.joints_rad <= high).all()
    assert found.n_steps <= 12, "the other joints take the blocked one's share at once"
    assert found.position_error_mm < 1e-6


def test_out_of_reach_is_said_with_the_distance() -> None:
    far = Pose(np.eye(3), np.array([0.0, 0.0, 3000.0]))
    failure = inverse(ARM, far, BENT)
    assert isinstance(failure, FitFailure)
    assert "not reached" in failure.reason


def test_a_start_outside_the_limits_is_refused() -> None:
    arm = replace(ARM, joint_max_rad=np.full(7, 0.1))
    with pytest.raises(InputError, match="outside the limits"):
        inverse(arm, pose_at(ARM, BENT), BENT)


def test_turning_about_the_tips_centre_does_not_move_it() -> None:
    tip = np.array([3.0, -12.0, 150.0])
    rng = np.random.default_rng(2)
    touched = np.array([400.0, 100.0, 50.0])
    rotations = np.array(
        [Pose.from_vectors(v, [0, 0, 0]).rotation for v in rng.normal(size=(5, 3))]
    )
    track = ArmTrack(
        t_ns=np.arange(5),
        rotations=rotations,
        translations_mm=touched - rotations @ tip,
        is_known=[True, True, False, True, True],
    )
    centres = tip_centres(track, tool_from_probe(tip))
    assert centres.shape == (4, 3)
    np.testing.assert_allclose(centres, np.tile(touched, (4, 1)), atol=1e-12)
    with pytest.raises(InputError, match="no pose"):
        tip_centres(replace(track, is_known=np.zeros(5, bool)), tool_from_probe(tip))


def test_compensation_goes_half_a_diameter_against_the_normal() -> None:
    centres = np.array([[0.0, 0.0, 3.0], [5.0, 0.0, 3.0]])
    surface = compensate_tip(centres, np.array([0.0, 0.0, 17.0]), 6.0)
    np.testing.assert_allclose(surface[:, 2], 0.0, atol=1e-15)
    each = compensate_tip(centres, np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), 6.0)
    np.testing.assert_allclose(each, [[0.0, 0.0, 0.0], [2.0, 0.0, 3.0]], atol=1e-15)
    with pytest.raises(InputError, match="normal"):
        compensate_tip(centres, np.zeros(3), 6.0)
    with pytest.raises(InputError, match="normals of shape"):
        compensate_tip(centres, np.ones((3, 3)), 6.0)
