# SPDX-License-Identifier: Apache-2.0
"""From a pose of the tool to joint angles: damped least squares from a start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray, frozen_floats
from armscan.geometry.estimate import FitFailure
from armscan.geometry.frames import Base, Tool
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import vector_from_rotation
from armscan.models.arm import ArmModel
from armscan.models.arm_forward import forward, joint_jacobian


@dataclass(frozen=True, slots=True)
class InverseOptions:
    """When joint angles are good enough.

    Parameters
    ----------
    position_tolerance_mm, rotation_tolerance_rad
        Largest remaining errors of the pose.
    lever_mm
        Length at which an error of the orientation counts as much as one of the position.
    max_steps
        Steps before giving up.
    """

    position_tolerance_mm: float = 1e-6
    rotation_tolerance_rad: float = 1e-9
    lever_mm: float = 300.0
    max_steps: int = 200

    def __post_init__(self) -> None:
        positive = (self.position_tolerance_mm, self.rotation_tolerance_rad, self.lever_mm)
        if not min(positive) > 0.0 or self.max_steps < 1:
            raise OptionError("tolerances, lever and steps of the arm's inverse must be positive")


@dataclass(frozen=True, slots=True, eq=False)
class JointSolution:
    """Joint angles that reach a pose, (n,), with what remains of the error."""

    joints_rad: FloatArray
    position_error_mm: float
    rotation_error_rad: float
    n_steps: int


def inverse(
    arm: ArmModel,
    base_from_tool: Pose[Base, Tool],
    start_rad: FloatArray,
    options: InverseOptions | None = None,
) -> JointSolution | FitFailure:
    """Joint angles near a start that bring the tool to a pose.

    An arm of more than six axes reaches a pose in many ways: the steps are the shortest ones, so
    the answer is close to the start. A joint at a limit stays there as long as its step would
    leave the range.

    Parameters
    ----------
    arm
        Geometry and limits.
    base_from_tool
        Wanted pose.
    start_rad
        (n,) angles to begin with.
    options
        Defaults if None.

    Returns
    -------
    JointSolution or FitFailure
        A failure says how far the nearest pose found is away.

    Raises
    ------
    InputError
        If the start does not fit the arm or lies outside its limits.
    """
    options = options or InverseOptions()
    low, high = arm.joint_limits_rad
    joints = frozen_floats(start_rad, (arm.n_axes,), "start_rad")
    if not bool(((joints >= low) & (joints <= high)).all()):
        raise InputError("the start lies outside the limits of the joints", where=arm.name)
    error = _error(arm, base_from_tool, joints, options.lever_mm)
    damping, step = 1e-3, 0
    while step < options.max_steps and damping < 1e12 and not _is_reached(error, options):
        step += 1
        trial = _step(arm, joints, error, damping, options.lever_mm)
        trial_error = _error(arm, base_from_tool, trial, options.lever_mm)
        if trial_error @ trial_error < error @ error:
            joints, error, damping = trial, trial_error, max(damping / 10.0, 1e-12)
        else:
            damping *= 10.0
    position = float(np.linalg.norm(error[3:]))
    rotation = float(np.linalg.norm(error[:3])) / options.lever_mm
    if not _is_reached(error, options):
        return FitFailure(
            f"the pose is not reached: the nearest found is {position:.3g} mm and "
            f"{np.degrees(rotation):.3g} degrees away",
            "ask for a pose within reach and within the joints' limits, or start nearer to it",
        )
    return JointSolution(joints, position, rotation, step)


def _error(
    arm: ArmModel, wanted: Pose[Base, Tool], joints: FloatArray, lever_mm: float
) -> FloatArray:
    """(6,) what is missing: rotation in Base times the lever, then position, mm."""
    rotations, translations = forward(arm, joints[None])
    turn = vector_from_rotation(wanted.rotation @ rotations[0].T)
    return np.concatenate([lever_mm * turn, wanted.translation_mm - translations[0]])


def _is_reached(error: FloatArray, options: InverseOptions) -> bool:
    is_near = float(np.linalg.norm(error[3:])) <= options.position_tolerance_mm
    turn_rad = float(np.linalg.norm(error[:3])) / options.lever_mm
    return is_near and turn_rad <= options.rotation_tolerance_rad


def _step(
    arm: ArmModel, joints: FloatArray, error: FloatArray, damping: float, lever_mm: float
) -> FloatArray:
    """Damped step; joints that it would push out of their range are held and the rest redone."""
    low, high = arm.joint_limits_rad
    jacobian = joint_jacobian(arm, joints[None])[0]
    jacobian[:3] *= lever_mm
    is_free = np.ones(arm.n_axes, dtype=np.bool_)
    while True:
        move = _damped(jacobian, error, is_free, damping)
        blocked = is_free & (((joints <= low) & (move < 0.0)) | ((joints >= high) & (move > 0.0)))
        if not blocked.any():
            return np.clip(joints + move, low, high)
        is_free &= ~blocked


def _damped(
    jacobian: FloatArray, error: FloatArray, is_free: BoolArray, damping: float
) -> FloatArray:
    """(n,) shortest step of the free joints in the damped least-squares sense."""
    move = np.zeros(len(is_free))
    free = jacobian[:, is_free]
    if free.shape[1]:
        normal = free @ free.T
        normal += damping * max(float(np.trace(normal)) / 6.0, 1e-300) * np.eye(6)
        move[is_free] = free.T @ np.linalg.solve(normal, error)
    return move
