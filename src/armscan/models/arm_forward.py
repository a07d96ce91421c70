# SPDX-License-Identifier: Apache-2.0
"""From joint angles to the pose of the tool, with derivatives (eqs. 2.1 to 2.10)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray
from armscan.models.arm import ArmModel


@dataclass(frozen=True, slots=True, eq=False)
class AxisFrames:
    """Where the axes of an arm stand, for N joint vectors.

    Parameters
    ----------
    rotations
        (N, n + 1, 3, 3) frames 0 (Base) to n (last axis) of fig. 2.4, seen in Base.
    origins_mm
        (N, n + 1, 3) their origins in Base.
    """

    rotations: FloatArray
    origins_mm: FloatArray


def link_matrices(
    theta_rad: FloatArray, offset_mm: FloatArray, length_mm: FloatArray, twist_rad: FloatArray
) -> FloatArray:
    """(..., 4, 4) matrices A_i of eq. 2.5 from arrays of one shape; theta holds the offsets."""
    theta, d, length, twist = np.broadcast_arrays(theta_rad, offset_mm, length_mm, twist_rad)
    cos_t, sin_t, cos_a, sin_a = np.cos(theta), np.sin(theta), np.cos(twist), np.sin(twist)
    zero, one = np.zeros_like(theta), np.ones_like(theta)
    rows = (
        (cos_t, -sin_t * cos_a, sin_t * sin_a, length * cos_t),
        (sin_t, cos_t * cos_a, -cos_t * sin_a, length * sin_t),
        (zero, sin_a, cos_a, d),
        (zero, zero, zero, one),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def axis_frames(arm: ArmModel, joints_rad: FloatArray) -> AxisFrames:
    """Frames of all axes for (N, n) joint angles as the encoders give them (eq. 2.6).

    Raises
    ------
    InputError
        If the count of joints is not the arm's, or an angle is not finite.
    """
    joints = np.atleast_2d(np.asarray(joints_rad, dtype=np.float64))
    if joints.ndim != 2 or joints.shape[1] != arm.n_axes:
        raise InputError(
            f"{np.asarray(joints_rad).shape} joint angles for an arm of {arm.n_axes} axes",
            where=arm.name,
        )
    if not np.isfinite(joints).all():
        raise InputError("a joint angle is not finite", where=arm.name, remedy="mask the gaps")
    links = link_matrices(
        joints + arm.theta_offset_rad, arm.offset_mm, arm.length_mm, arm.twist_rad
    )
    frames = np.zeros((len(joints), arm.n_axes + 1, 4, 4))
    frames[:, 0] = np.eye(4)
    for axis in range(arm.n_axes):
        frames[:, axis + 1] = frames[:, axis] @ links[:, axis]
    return AxisFrames(frames[:, :, :3, :3], frames[:, :, :3, 3])


def forward(arm: ArmModel, joints_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pose of the tool for many joint vectors (eq. 2.9, then the flange).

    Parameters
    ----------
    arm
        Geometry.
    joints_rad
        (N, n) angles as the encoders give them; the arm's offsets are added here.

    Returns
    -------
    rotations
        (N, 3, 3) of ``base_from_tool``.
    translations_mm
        (N, 3).

    Raises
    ------
    InputError
        If the count of joints is not the arm's, or an angle is not finite.
    """
    return _after_flange(arm, axis_frames(arm, joints_rad))


def _after_flange(arm: ArmModel, frames: AxisFrames) -> tuple[FloatArray, FloatArray]:
    last = frames.rotations[:, -1]
    origin = frames.origins_mm[:, -1] + last @ arm.flange.translation_mm
    return last @ arm.flange.rotation, origin


def joint_jacobian(
    arm: ArmModel, joints_rad: FloatArray, point_tool_mm: FloatArray | None = None
) -> FloatArray:
    """Derivative of the pose by the joint angles.

    Parameters
    ----------
    arm, joints_rad
        As for `forward`.
    point_tool_mm
        (3,) point in Tool whose motion is asked for; Tool's origin if None.

    Returns
    -------
    FloatArray
        (N, 6, n): rows 0 to 2 rotation vector in Base, multiplied from the left
        (``R <- exp(dr) R``), rows 3 to 5 motion of the point in Base, mm per rad.
    """
    return np.asarray(parameter_jacobian(arm, joints_rad, point_tool_mm)[:, :, 0::4])


def parameter_jacobian(
    arm: ArmModel, joints_rad: FloatArray, point_tool_mm: FloatArray | None = None
) -> FloatArray:
    """Derivative of the pose by all the numbers of the chain.

    An error of theta_i turns all that follows about z of frame i - 1, one of alpha_i about x of
    frame i; d_i and l_i shift it along these axes.

    Parameters
    ----------
    arm, joints_rad, point_tool_mm
        As for `joint_jacobian`.

    Returns
    -------
    FloatArray
        (N, 6, 4 n): rows as in `joint_jacobian`, columns in the order of ``arm.parameters``.
    """
    frames = axis_frames(arm, joints_rad)
    rotation, point = _after_flange(arm, frames)
    if point_tool_mm is not None:
        point = point + rotation @ np.asarray(point_tool_mm, dtype=np.float64)
    along_axis = frames.rotations[:, :-1, :, 2]
    along_normal = frames.rotations[:, 1:, :, 0]
    lever_axis = point[:, None] - frames.origins_mm[:, :-1]
    lever_normal = point[:, None] - frames.origins_mm[:, 1:]
    turns = (along_axis, np.zeros_like(along_axis), np.zeros_like(along_axis), along_normal)
    shifts = (
        np.cross(along_axis, lever_axis),
        along_axis,
        along_normal,
        np.cross(along_normal, lever_normal),
    )
    by_axis = np.concatenate([np.stack(turns, axis=2), np.stack(shifts, axis=2)], axis=3)
    n_rows = len(by_axis)
    return np.asarray(by_axis.transpose(0, 3, 1, 2).reshape(n_rows, 6, 4 * arm.n_axes))
