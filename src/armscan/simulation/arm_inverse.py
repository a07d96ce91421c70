# SPDX-License-Identifier: Apache-2.0
"""Joint angles that bring the tool to a wanted pose: damped least squares on the screws.

Seven joints leave one freedom: the elbow turns about the line from shoulder to wrist. It is used
to stay near a preferred posture, as the person's other hand does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import EstimationError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Base, Tool
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import vector_from_rotation
from armscan.simulation.screw_arm import ScrewArm

COMFORTABLE_RAD = np.radians([-15.0, 35.0, 0.0, 85.0, 0.0, 60.0, 0.0])
"""The arm over the table before it: shoulder leant forward, elbow and wrist bent down."""

LEVER_MM = 200.0
"""A turn of 1 rad counts as much as this distance when steps are weighed."""


@dataclass(frozen=True, slots=True)
class InverseOptions:
    """When the solver stops, and how it moves.

    Parameters
    ----------
    tolerance_mm
        Largest error left, in mm at the tool and at a point `LEVER_MM` away.
    max_steps
        Steps before it gives up.
    max_turn_rad
        Largest turn of a joint in one step.
    damping
        Damping far from the goal, in the units of the goal's error over `LEVER_MM`.
    comfort
        Share of the way to the preferred elbow that is gone in each step.
    """

    tolerance_mm: float = 1e-8
    max_steps: int = 400
    max_turn_rad: float = 0.3
    damping: float = 0.05
    comfort: float = 0.5


def reach(
    arm: ScrewArm,
    base_from_tool: Pose[Base, Tool],
    start_rad: FloatArray = COMFORTABLE_RAD,
    preferred_rad: FloatArray = COMFORTABLE_RAD,
    options: InverseOptions | None = None,
) -> FloatArray:
    """Joint angles (7,) with which an arm holds its tool at a pose.

    Raises
    ------
    EstimationError
        If the pose is out of reach.
    """
    settings = InverseOptions() if options is None else options
    joints = np.array(start_rad, dtype=np.float64)
    for _ in range(settings.max_steps):
        error, jacobian = _error_and_jacobian(arm, joints, base_from_tool)
        size = float(np.linalg.norm(error))
        damping = settings.damping * min(1.0, size)
        weights = jacobian @ jacobian.T + damping**2 * np.eye(6)
        step = jacobian.T @ np.linalg.solve(weights, error)
        wish = settings.comfort * (preferred_rad - joints)
        ease = wish - jacobian.T @ np.linalg.solve(weights, jacobian @ wish)
        is_there = LEVER_MM * size < settings.tolerance_mm
        if is_there and float(np.abs(ease).max()) < 1e-5:
            return joints
        step = step + ease
        joints = joints + step * min(1.0, settings.max_turn_rad / float(np.abs(step).max()))
    raise EstimationError(
        f"the simulated arm cannot bring its tool to {np.round(base_from_tool.translation_mm, 1)}"
        f" mm: {LEVER_MM * size:.3g} mm are left",
        remedy="choose a place nearer to the middle of its reach",
    )


def _error_and_jacobian(
    arm: ScrewArm, joints_rad: FloatArray, goal: Pose[Base, Tool]
) -> tuple[FloatArray, FloatArray]:
    """What is missing (6,), turn over shift, and its derivative (6, 7); shifts over `LEVER_MM`."""
    pose, axes, points = arm.pose_and_axes(joints_rad)
    turn = vector_from_rotation(goal.rotation @ pose.rotation.T)
    shift = (goal.translation_mm - pose.translation_mm) / LEVER_MM
    lever = (pose.translation_mm - points) / LEVER_MM
    jacobian = np.concatenate([axes, np.cross(axes, lever)], axis=1).T
    return np.concatenate([turn, shift]), jacobian
