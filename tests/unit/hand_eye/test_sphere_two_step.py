# SPDX-License-Identifier: Apache-2.0
"""The thesis's two steps on a sphere, with its print corrected."""

import numpy as np
import pytest

from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Pose
from armscan.geometry.rotations import rotation_from_vector
from armscan.thesis.hand_eye import (
    TwoStepHandEye,
    calibrate_in_two_steps,
    group_by_rotation,
    rotation_from_shifts,
    translation_from_turns,
)
from rigs.sphere_rig import DIAMETER_MM, HAND_EYE, SHEET_NORMAL, SphereRig, shifted_poses

SEED = 9


@pytest.mark.parametrize("given", [True, False])
def test_exact_points_give_the_hand_eye_back(given: bool) -> None:
    rig = SphereRig()
    stripes = rig.stripes(shifted_poses(rig), np.random.default_rng(SEED))
    found = calibrate_in_two_steps(stripes, DIAMETER_MM)
    assert isinstance(found, TwoStepHandEye), found
    if given:
        found = calibrate_in_two_steps(stripes, DIAMETER_MM, side=found.side)
        assert isinstance(found, TwoStepHandEye), found
    np.testing.assert_allclose(found.tool_from_sensor.rotation, HAND_EYE.rotation, atol=1e-7)
    error = found.tool_from_sensor.translation_mm - HAND_EYE.translation_mm
    np.testing.assert_allclose(error, 0.0, atol=1e-5)
    assert found.shifted == ("p0", "p1", "p2", "p3", "p4", "p5")
    assert found.centre_misfit_mm.max() < 1e-5


def test_the_wrong_side_of_the_sheet_contradicts() -> None:
    rig = SphereRig()
    stripes = rig.stripes(shifted_poses(rig), np.random.default_rng(SEED))
    right = calibrate_in_two_steps(stripes, DIAMETER_MM)
    assert isinstance(right, TwoStepHandEye), right
    wrong = calibrate_in_two_steps(stripes, DIAMETER_MM, side=-right.side)
    assert not isinstance(wrong, TwoStepHandEye) or wrong.centre_misfit_mm.max() > 1.0


def test_shifts_in_one_plane_need_the_determinant() -> None:
    """U V' alone (the print of eq. 2.50) is a reflection for about half of such data."""
    generator = np.random.default_rng(SEED)
    for _ in range(20):
        rotation = rotation_from_vector(generator.normal(0.0, 1.0, 3))
        shifts = generator.normal(0.0, 20.0, (6, 3)) * [1.0, 1.0, 0.0]
        centres = -(shifts @ rotation) + generator.normal(0.0, 0.01, (6, 3))
        solved = rotation_from_shifts([Pose(np.eye(3), shift) for shift in shifts], centres)
        assert not isinstance(solved, FitFailure)
        assert np.linalg.det(solved[0]) == pytest.approx(1.0)
        np.testing.assert_allclose(solved[0], rotation, atol=0.01)
        assert solved[1] < 0.05


def test_orientations_are_grouped_by_the_data() -> None:
    turns = [0.0, 0.5, 0.0004, 0.5001, -0.0004, 0.9]
    poses = [Pose(rotation_from_vector(np.array([0.0, turn, 0.0])), np.zeros(3)) for turn in turns]
    assert group_by_rotation(poses, 0.1).tolist() == [0, 1, 0, 1, 0, 2]
    assert group_by_rotation(poses[3:], 0.1).tolist() == [0, 1, 2]


def test_shifts_along_a_line_and_turns_about_one_axis_are_refused() -> None:
    still = [Pose(np.eye(3), np.array([step, 0.0, 0.0])) for step in (0.0, 5.0, 10.0, 15.0)]
    centres = np.array([[-step, 1.0, 2.0] for step in (0.0, 5.0, 10.0, 15.0)])
    line = rotation_from_shifts(still, centres)
    assert isinstance(line, FitFailure)
    assert "along one line" in line.reason
    assert isinstance(rotation_from_shifts(still[:2], centres[:2]), FitFailure)
    about_y = [
        Pose(rotation_from_vector(np.array([0.0, turn, 0.0])), np.zeros(3)) for turn in (0, 0.5, 1)
    ]
    one_axis = translation_from_turns(about_y, np.ones((3, 3)))
    assert isinstance(one_axis, FitFailure)
    assert "about one axis" in one_axis.reason


def test_too_few_or_only_turned_postures_are_refused() -> None:
    rig = SphereRig(normals=(SHEET_NORMAL,))
    stripes = rig.stripes(shifted_poses(rig), np.random.default_rng(SEED))
    few = calibrate_in_two_steps(stripes[:3], DIAMETER_MM)
    assert isinstance(few, FitFailure)
    turned = calibrate_in_two_steps(stripes[5:], DIAMETER_MM)
    assert isinstance(turned, FitFailure)
    assert "one-step" in turned.remedy
