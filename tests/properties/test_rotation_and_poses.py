# SPDX-License-Identifier: Apache-2.0
"""Group axioms of rotations and poses, and what frames promise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from armscan.errors import InputError
from armscan.geometry.poses import Base, Board, Points, Pose, Sensor, Tool
from armscan.geometry.rotations import (
    nearest_rotation,
    rotation_from_vector,
    skew,
    vector_from_rotation,
    vector_sigma,
)

ROUNDING = 1e-12
LENGTH_ROUNDING_MM = 1e-9
"""Rounding of a few products of lengths below a metre."""

vectors = arrays(np.float64, 3, elements=st.floats(-3.0, 3.0, allow_subnormal=False))
small_vectors = arrays(np.float64, 3, elements=st.floats(-1e-5, 1e-5, allow_subnormal=False))
lengths = arrays(np.float64, 3, elements=st.floats(-500.0, 500.0, allow_subnormal=False))
any_rotation_vector = st.one_of(vectors, small_vectors)
settings.register_profile("armscan-geometry", max_examples=60, deadline=None)
settings.load_profile("armscan-geometry")


@given(any_rotation_vector)
def test_rotation_of_a_vector_is_that_of_scipy(vector: np.ndarray) -> None:
    oracle = Rotation.from_rotvec(vector).as_matrix()
    assert np.abs(rotation_from_vector(vector) - oracle).max() < ROUNDING


@given(any_rotation_vector)
def test_vector_of_a_rotation_gives_the_rotation_back(vector: np.ndarray) -> None:
    rotation = rotation_from_vector(vector)
    back = vector_from_rotation(rotation)
    assert np.linalg.norm(back) <= np.pi + ROUNDING
    # Near half a turn the angle's cosine hides it to the square root of rounding.
    assert np.abs(rotation_from_vector(back) - rotation).max() < 1e-7


@pytest.mark.parametrize(
    "axis", [[1, 0, 0], [0, -1, 0], [0, 0, 1], [0.6, -0.8, 0], [0.48, 0.6, -0.64]]
)
@pytest.mark.parametrize("short_of_half_turn_rad", [0.0, 1e-9, 1e-7, 1e-5, 1e-3])
def test_half_turns(axis: list[float], short_of_half_turn_rad: float) -> None:
    vector = (np.pi - short_of_half_turn_rad) * np.array(axis, dtype=float)
    rotation = rotation_from_vector(vector)
    back = vector_from_rotation(rotation)
    assert np.abs(rotation_from_vector(back) - rotation).max() < 1e-8
    if short_of_half_turn_rad >= 1e-7:
        assert np.abs(back - vector).max() < 1e-6


@pytest.mark.parametrize("angle_rad", [0.0, 1e-5, 9e-4, 1.1e-3, 0.3, 1.6, 3.0, 3.141])
def test_sigma_of_a_rotation_vector_is_that_of_differences(angle_rad: float) -> None:
    """That of the increment was told in its place."""
    vector = angle_rad * np.array([0.48, 0.6, -0.64])
    factor = np.array([[2.0, 0.0, 0.0], [-0.5, 1.0, 0.0], [0.3, 0.7, 0.6]])
    step = 1e-5
    moved = [
        [
            vector_from_rotation(rotation_from_vector(s * row) @ rotation_from_vector(vector))
            for row in step * np.eye(3)
        ]
        for s in (1.0, -1.0)
    ]
    jacobian = (np.array(moved[0]) - np.array(moved[1])).T / (2.0 * step)
    expected = np.linalg.norm(jacobian @ factor, axis=1)
    np.testing.assert_allclose(vector_sigma(vector, factor @ factor.T), expected, rtol=1e-5)


@given(any_rotation_vector, lengths)
def test_skew_is_the_cross_product(vector: np.ndarray, other: np.ndarray) -> None:
    assert np.abs(skew(vector) @ other - np.cross(vector, other)).max() < LENGTH_ROUNDING_MM


@given(vectors, arrays(np.float64, (3, 3), elements=st.floats(-0.1, 0.1)))
def test_nearest_rotation_is_proper_and_no_other_is_nearer(
    vector: np.ndarray, noise: np.ndarray
) -> None:
    matrix = rotation_from_vector(vector) + noise
    nearest = nearest_rotation(matrix)
    assert np.abs(nearest @ nearest.T - np.eye(3)).max() < ROUNDING
    assert np.linalg.det(nearest) > 0.0
    distance = np.linalg.norm(nearest - matrix)
    for axis in np.eye(3):
        for angle in (-1e-3, 1e-3):
            other = rotation_from_vector(angle * axis) @ nearest
            assert np.linalg.norm(other - matrix) >= distance - ROUNDING


@given(st.lists(st.tuples(vectors, lengths), min_size=3, max_size=3))
def test_poses_form_a_group(parts: list[tuple[np.ndarray, np.ndarray]]) -> None:
    base_from_tool: Pose[Base, Tool] = Pose.from_vectors(*parts[0])
    tool_from_sensor: Pose[Tool, Sensor] = Pose.from_vectors(*parts[1])
    sensor_from_board: Pose[Sensor, Board] = Pose.from_vectors(*parts[2])
    left = (base_from_tool @ tool_from_sensor) @ sensor_from_board
    right = base_from_tool @ (tool_from_sensor @ sensor_from_board)
    assert np.abs(left.matrix - right.matrix).max() < LENGTH_ROUNDING_MM
    unit = base_from_tool @ base_from_tool.inverse()
    assert np.abs(unit.matrix - np.eye(4)).max() < LENGTH_ROUNDING_MM
    twice = base_from_tool.inverse().inverse()
    assert np.abs(twice.matrix - base_from_tool.matrix).max() < LENGTH_ROUNDING_MM


@given(vectors, lengths, vectors, lengths, lengths)
def test_mapping_points_follows_composition_and_keeps_distances(
    r1: np.ndarray, t1: np.ndarray, r2: np.ndarray, t2: np.ndarray, point: np.ndarray
) -> None:
    base_from_tool: Pose[Base, Tool] = Pose.from_vectors(r1, t1)
    tool_from_sensor: Pose[Tool, Sensor] = Pose.from_vectors(r2, t2)
    points: Points[Sensor] = Points(np.stack([point, np.zeros(3)]))
    step_by_step = base_from_tool @ (tool_from_sensor @ points)
    at_once = (base_from_tool @ tool_from_sensor) @ points
    assert np.abs(step_by_step.xyz_mm - at_once.xyz_mm).max() < LENGTH_ROUNDING_MM
    apart = np.linalg.norm(at_once.xyz_mm[0] - at_once.xyz_mm[1])
    assert abs(apart - np.linalg.norm(point)) < LENGTH_ROUNDING_MM


def test_pose_by_hand() -> None:
    # Tool is turned by +90 degrees about z and sits at (10, 0, 0): its x axis is Base's y axis.
    base_from_tool: Pose[Base, Tool] = Pose.from_vectors([0.0, 0.0, np.pi / 2], [10.0, 0.0, 0.0])
    tip: Points[Tool] = Points(np.array([[5.0, 0.0, 1.0]]))
    assert (base_from_tool @ tip).xyz_mm[0] == pytest.approx([10.0, 5.0, 1.0])
    assert base_from_tool.rotation_vector_rad == pytest.approx([0.0, 0.0, np.pi / 2])


@pytest.mark.parametrize(
    "matrix", [np.diag([1.0, 1.0, -1.0]), 1.01 * np.eye(3), np.zeros((3, 3)), np.eye(3)[[1, 0, 2]]]
)
def test_matrices_that_are_no_rotations_are_refused(matrix: np.ndarray) -> None:
    with pytest.raises(InputError, match="not a rotation"):
        Pose(matrix, np.zeros(3))


def test_poses_and_points_cannot_be_changed() -> None:
    pose: Pose[Base, Tool] = Pose(np.eye(3), np.zeros(3))
    with pytest.raises(ValueError, match="read-only"):
        pose.translation_mm[0] = 1.0
    source = np.zeros((2, 3))
    points: Points[Base] = Points(source)
    source[0, 0] = 7.0
    assert points.xyz_mm[0, 0] == 0.0


@given(small_vectors, lengths, vectors, lengths)
def test_a_step_leads_from_one_pose_to_the_other(
    turn: np.ndarray, shift: np.ndarray, vector: np.ndarray, place: np.ndarray
) -> None:
    pose: Pose[Base, Tool] = Pose.from_vectors(vector, place)
    step = np.concatenate([turn, shift])
    assert np.abs(pose.retract(step).step_from(pose) - step).max() < LENGTH_ROUNDING_MM
