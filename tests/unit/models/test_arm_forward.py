# SPDX-License-Identifier: Apache-2.0
"""The chain against matrices multiplied by hand, finite differences and group axioms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Pose
from armscan.models.arm import (
    AXIS_PARAMETERS,
    ArmModel,
    axis_frames,
    forward,
    link_matrices,
    parameter_jacobian,
    quarter_turn_flange,
    thesis_arm,
)

D_MM, L_MM = (300.0, 600.0, 500.0, 200.0), (40.0, 40.0, 40.0)
DIFFERENCE = 1e-5
"""Step of central differences; their error is about 1e-10 of a metre."""
DIFFERENCE_TOLERANCE = 1e-5


def general_arm(seed: int = 3, n_axes: int = 7) -> ArmModel:
    """An arm with nothing zero: each of its 4 n numbers matters."""
    rng = np.random.default_rng(seed)
    return ArmModel(
        theta_offset_rad=rng.uniform(-0.5, 0.5, n_axes),
        offset_mm=rng.uniform(-300.0, 300.0, n_axes),
        length_mm=rng.uniform(-300.0, 300.0, n_axes),
        twist_rad=rng.uniform(-1.5, 1.5, n_axes),
        flange=Pose.from_vectors([0.3, -0.2, 0.9], [12.0, -7.0, 41.0]),
    )


def some_joints(n: int, n_axes: int = 7, seed: int = 5) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-3.0, 3.0, (n, n_axes))


def by_elementary_motions(theta: float, d: float, length: float, twist: float) -> np.ndarray:
    """Eq. 2.1 written out with eqs. 2.2 to 2.4."""
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(twist), np.sin(twist)
    turn_z = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    shift_z = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, d], [0, 0, 0, 1.0]])
    shift_x = np.array([[1, 0, 0, length], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    turn_x = np.array([[1, 0, 0, 0], [0, ca, -sa, 0], [0, sa, ca, 0], [0, 0, 0, 1.0]])
    return turn_z @ shift_z @ shift_x @ turn_x


def test_a_link_is_the_product_of_its_four_motions() -> None:
    for theta, d, length, twist in np.random.default_rng(0).uniform(-2.0, 2.0, (20, 4)):
        np.testing.assert_allclose(
            link_matrices(theta, d, length, twist),
            by_elementary_motions(theta, d, length, twist),
            atol=1e-15,
        )


def test_the_nominal_arm_is_that_of_table_2() -> None:
    """Eqs. 2.7 and 2.8 as printed, with the minus of l_i in the matrix."""
    joints = some_joints(1)[0]
    offsets = np.linspace(-0.4, 0.4, 7)
    arm = thesis_arm(D_MM, L_MM, offsets)
    expected = np.eye(4)
    d, length = iter(D_MM), iter(L_MM)
    for axis, angle in enumerate(joints + offsets):
        c, s = np.cos(angle), np.sin(angle)
        if axis % 2 == 0:
            link = [[c, 0, -s, 0], [s, 0, c, 0], [0, -1, 0, next(d)], [0, 0, 0, 1]]
        else:
            own = next(length)
            link = [[c, 0, s, -own * c], [s, 0, -c, -own * s], [0, 1, 0, 0], [0, 0, 0, 1]]
        expected = expected @ np.array(link)
    rotations, translations = forward(arm, joints[None])
    np.testing.assert_allclose(rotations[0], expected[:3, :3], atol=1e-14)
    np.testing.assert_allclose(translations[0], expected[:3, 3], atol=1e-11)


def test_at_zero_the_nominal_arm_stands_upright() -> None:
    """By eye: -l_2, -l_4, -l_6 along x, all d along z; axis 7 and so z of frame 7 horizontal."""
    rotations, translations = forward(thesis_arm(D_MM, L_MM), np.zeros((1, 7)))
    np.testing.assert_allclose(translations[0], [-120.0, 0.0, 1600.0], atol=1e-11)
    np.testing.assert_allclose(rotations[0][:, 2], [0.0, 1.0, 0.0], atol=1e-15)


def test_the_quarter_turn_flange_puts_tool_z_along_axis_7() -> None:
    arm = thesis_arm(D_MM, L_MM, flange=quarter_turn_flange())
    joints = some_joints(4)
    rotations, _ = forward(arm, joints)
    axis_7 = axis_frames(arm, joints).rotations[:, 6, :, 2]
    np.testing.assert_allclose(rotations[:, :, 2], axis_7, atol=1e-14)


def test_many_joint_vectors_are_each_on_their_own() -> None:
    arm, joints = general_arm(), some_joints(9)
    rotations, translations = forward(arm, joints)
    for k in range(9):
        one_rotation, one_translation = forward(arm, joints[k][None])
        np.testing.assert_array_equal(rotations[k], one_rotation[0])
        np.testing.assert_array_equal(translations[k], one_translation[0])
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (9, 1, 1)), atol=1e-13
    )


def test_an_arm_cut_in_two_composes() -> None:
    """Flange, offsets and order: the pose of the whole is that of the parts, one after another."""
    arm, joints = general_arm(), some_joints(1)
    first = ArmModel(**{name: getattr(arm, name)[:3] for name in AXIS_PARAMETERS})
    second = ArmModel(
        **{name: getattr(arm, name)[3:] for name in AXIS_PARAMETERS}, flange=arm.flange
    )
    whole, low, high = (
        Pose(*(part[0] for part in forward(a, q)))
        for a, q in ((arm, joints), (first, joints[:, :3]), (second, joints[:, 3:]))
    )
    np.testing.assert_allclose((low @ high).matrix, whole.matrix, atol=1e-11)


def numerical_jacobian(pose_of, at: np.ndarray, point: np.ndarray) -> np.ndarray:
    columns = []
    rotation_at = pose_of(at)[0]
    for k in range(len(at)):
        step = np.zeros(len(at))
        step[k] = DIFFERENCE
        (r_up, t_up), (r_low, t_low) = pose_of(at + step), pose_of(at - step)
        spin = (r_up - r_low) / (2 * DIFFERENCE) @ rotation_at.T
        turn = 0.5 * np.array(
            [spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]]
        )
        shift = (r_up @ point + t_up - r_low @ point - t_low) / (2 * DIFFERENCE)
        columns.append(np.concatenate([turn, shift]))
    return np.array(columns).T


@pytest.mark.parametrize("point", [np.zeros(3), np.array([-45.0, 62.0, 215.0])])
def test_jacobian_by_joints(point: np.ndarray) -> None:
    arm = general_arm()
    for joints in some_joints(3):
        expected = numerical_jacobian(
            lambda q: tuple(part[0] for part in forward(arm, q[None])), joints, point
        )
        np.testing.assert_allclose(
            parameter_jacobian(arm, joints[None], point)[0][:, 0::4],
            expected,
            atol=DIFFERENCE_TOLERANCE,
        )


def with_parameters(arm: ArmModel, parameters: FloatArray) -> ArmModel:
    """The same arm with other (28,) numbers of its chain."""
    columns = parameters.reshape(-1, 4).T
    return replace(arm, **dict(zip(AXIS_PARAMETERS, columns, strict=True)))


def test_jacobian_by_all_28_numbers() -> None:
    arm, joints = general_arm(), some_joints(1)
    point = np.array([-45.0, 62.0, 215.0])
    expected = numerical_jacobian(
        lambda p: tuple(part[0] for part in forward(with_parameters(arm, p), joints)),
        arm.parameters,
        point,
    )
    found = parameter_jacobian(arm, joints, point)[0]
    assert found.shape == (6, 28)
    np.testing.assert_allclose(found, expected, atol=DIFFERENCE_TOLERANCE)


def test_an_offset_of_the_encoder_is_an_angle() -> None:
    arm, joints = general_arm(), some_joints(1)
    table = arm.parameters.reshape(-1, 4).copy()
    table[:, 0] += 0.1
    np.testing.assert_allclose(
        forward(with_parameters(arm, table.ravel()), joints)[1],
        forward(arm, joints + 0.1)[1],
        atol=1e-10,
    )
    assert arm.parameter_names[5] == "axis_2.offset_mm"
    assert arm.parameters[5] == arm.offset_mm[1]


def test_what_does_not_fit_is_refused() -> None:
    arm = general_arm()
    with pytest.raises(InputError, match="7 axes"):
        forward(arm, np.zeros((2, 6)))
    with pytest.raises(InputError, match="not finite"):
        forward(arm, np.full((1, 7), np.nan))
    with pytest.raises(InputError, match="joint 2"):
        ArmModel(
            **dict.fromkeys(AXIS_PARAMETERS, np.zeros(2)),
            joint_min_rad=[-1.0, 1.0],
            joint_max_rad=[1.0, 1.0],
        )
    with pytest.raises(InputError, match="length_mm"):
        ArmModel(
            theta_offset_rad=np.zeros(2),
            offset_mm=np.zeros(2),
            length_mm=np.zeros(3),
            twist_rad=np.zeros(2),
        )
