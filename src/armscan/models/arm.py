# SPDX-License-Identifier: Apache-2.0
"""A measuring arm: Denavit-Hartenberg chain, from joint angles to pose (eqs. 2.1 to 2.10)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import ArrayRecord, FloatArray, floats, frozen_floats
from armscan.geometry.poses import Pose, Probe, Tool
from armscan.records.recording import ArmTrack

AXIS_PARAMETERS = ("theta_offset_rad", "offset_mm", "length_mm", "twist_rad")
"""The four numbers of an axis, in this order: theta_i0, d_i, l_i, alpha_i of eq. 2.5."""
THESIS_TWISTS_RAD = tuple(np.pi / 2 * sign for sign in (-1, 1, -1, 1, -1, 1, -1))
"""Table 2."""


def no_flange() -> Pose[Tool, Tool]:
    """The frame of the last axis is Tool."""
    return Pose(np.eye(3), np.zeros(3))


def quarter_turn_flange() -> Pose[Tool, Tool]:
    """Rx(+90 degrees): Tool's z then runs along the last axis of `thesis_arm`, not across it."""
    return Pose(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), np.zeros(3))


class ArmModel(ArrayRecord):
    """Geometry of an arm of n revolute joints.

    ``base_from_tool`` is the product of ``Rz(theta_i + theta_i0) Tz(d_i) Tx(l_i) Rx(alpha_i)``
    over the axes (eqs. 2.1, 2.9), then the flange.

    Parameters
    ----------
    theta_offset_rad
        (n,) offsets theta_i0 added to the joint angles that the encoders give.
    offset_mm
        (n,) d_i, along the axis.
    length_mm
        (n,) l_i, along the common normal; Table 2 writes -l_2, -l_4, -l_6.
    twist_rad
        (n,) alpha_i, about the common normal.
    flange
        Fixed pose of Tool in the frame of the last axis.
    joint_min_rad, joint_max_rad
        (n,) limits of the joint angles as the encoders give them; infinite where there is none.

    Raises
    ------
    InputError
        If the lengths of the lists differ or a lower limit is not below its upper one.
    """

    theta_offset_rad: FloatArray = floats("n")
    offset_mm: FloatArray = floats("n")
    length_mm: FloatArray = floats("n")
    twist_rad: FloatArray = floats("n")
    flange: Pose[Tool, Tool] = field(default_factory=no_flange)
    joint_min_rad: FloatArray | None = floats("n", infinite=True, default=None)
    joint_max_rad: FloatArray | None = floats("n", infinite=True, default=None)
    name: str = "arm"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_axes == 0:
            raise InputError("an arm needs at least one axis", where=self.name)
        low, high = self.joint_limits_rad
        if not bool((low < high).all()):
            axis = int(np.flatnonzero(~(low < high))[0]) + 1
            raise InputError(f"limits of joint {axis} are not in order", where=self.name)

    @property
    def n_axes(self) -> int:
        """Count of joints."""
        return len(self.theta_offset_rad)

    @property
    def joint_limits_rad(self) -> tuple[FloatArray, FloatArray]:
        """(n,) lower and (n,) upper limits, infinite where there is none."""
        free = np.full(self.n_axes, np.inf)
        low = -free if self.joint_min_rad is None else self.joint_min_rad
        high = free if self.joint_max_rad is None else self.joint_max_rad
        return low, high

    @property
    def parameters(self) -> FloatArray:
        """(4 n,) all numbers of the chain, axis by axis in the order of `AXIS_PARAMETERS`."""
        return np.stack([getattr(self, name) for name in AXIS_PARAMETERS], axis=1).ravel()

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names in the order of ``parameters``, as ``axis_2.offset_mm``."""
        return tuple(
            f"axis_{axis + 1}.{name}" for axis in range(self.n_axes) for name in AXIS_PARAMETERS
        )


def thesis_arm(
    d_mm: Sequence[float],
    l_mm: Sequence[float],
    theta_offset_rad: Sequence[float] = (0.0,) * 7,
    flange: Pose[Tool, Tool] | None = None,
    name: str = "thesis arm",
) -> ArmModel:
    """The nominal seven-axis arm of Table 2 (eqs. 2.7 and 2.8).

    Parameters
    ----------
    d_mm
        (d_1, d_3, d_5, d_7).
    l_mm
        (l_2, l_4, l_6) as Table 2 names them: the chain holds their negatives.
    theta_offset_rad
        (7,) encoder offsets theta_i0.
    flange
        Pose of Tool after axis 7; that of the axis itself if None.
    name
        What reports call it.

    Raises
    ------
    InputError
        If a count is wrong or a number is not finite.
    """
    d = frozen_floats(d_mm, (4,), "d_mm")
    lengths = frozen_floats(l_mm, (3,), "l_mm")
    offset, length = np.zeros(7), np.zeros(7)
    offset[0::2] = d
    length[1::2] = -lengths
    return ArmModel(
        theta_offset_rad=frozen_floats(theta_offset_rad, (7,), "theta_offset_rad"),
        offset_mm=offset,
        length_mm=length,
        twist_rad=np.array(THESIS_TWISTS_RAD),
        flange=no_flange() if flange is None else flange,
        name=name,
    )


class AxisFrames(ArrayRecord):
    """Where the axes of an arm stand, for N joint vectors.

    ``rotations`` (N, n + 1, 3, 3) and ``origins_mm`` (N, n + 1, 3) are those of frames 0 (Base) to
    n (last axis) of fig. 2.4, seen in Base.
    """

    rotations: FloatArray = floats("N", "frames", 3, 3)
    origins_mm: FloatArray = floats("N", "frames", 3)


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
    return AxisFrames(rotations=frames[:, :, :3, :3], origins_mm=frames[:, :, :3, 3])


def forward(arm: ArmModel, joints_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pose of the tool (N, 3, 3), (N, 3) for many joint vectors (eq. 2.9, then the flange).

    ``joints_rad`` (N, n) are as the encoders give them; the arm's offsets are added here.

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


def parameter_jacobian(
    arm: ArmModel, joints_rad: FloatArray, point_tool_mm: FloatArray | None = None
) -> FloatArray:
    """Derivative (N, 6, 4 n) of the pose by all the numbers of the chain.

    An error of theta_i turns all that follows about z of frame i - 1, one of alpha_i about x of
    frame i; d_i and l_i shift it along these axes. Rows are the rotation vector in Base, multiplied
    from the left (``R <- exp(dr) R``), and the motion in mm of a point (3,) given in Tool, its
    origin if None; columns are in the order of ``arm.parameters``, so that every fourth is the
    derivative by a joint angle.
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


def tool_from_probe(centre_tool_mm: FloatArray) -> Pose[Tool, Probe]:
    """Pose of the tip from the (3,) place of its centre in Tool; a ball has no orientation."""
    return Pose(np.eye(3), frozen_floats(centre_tool_mm, (3,), "tip centre in Tool (mm)"))


def tip_centres(arm: ArmTrack, tool_from_probe: Pose[Tool, Probe]) -> FloatArray:
    """(M, 3) centres of the tip in Base, one for each of the M known samples of a track.

    Raises
    ------
    InputError
        If no sample is known.
    """
    known = arm.is_known
    if not bool(known.any()):
        raise InputError("the arm gave no pose for any touch")
    offset = tool_from_probe.translation_mm
    return np.asarray(arm.rotations[known] @ offset + arm.translations_mm[known])


def compensate_tip(
    centres_mm: FloatArray, outward_normals: FloatArray, tip_diameter_mm: float
) -> FloatArray:
    """Points (N, 3) on the surface from the centres of the tip that touched it.

    Normals (3,) or (N, 3) point towards the tip, of any length but zero; a diameter of 0 leaves the
    points as they are.

    Raises
    ------
    InputError
        If shapes do not fit, a normal is zero or the diameter is negative.
    """
    centres = frozen_floats(centres_mm, (None, 3), "tip centres (mm)")
    normals = np.atleast_2d(np.asarray(outward_normals, dtype=np.float64))
    if normals.shape not in ((1, 3), centres.shape):
        raise InputError(f"normals of shape {normals.shape} for {len(centres)} tip centres")
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    if not bool((lengths > 0.0).all()) or not np.isfinite(normals).all():
        raise InputError("a normal of the touched surface is zero or not finite")
    if not tip_diameter_mm >= 0.0:
        raise InputError(f"a tip of {tip_diameter_mm} mm diameter")
    return np.asarray(centres - 0.5 * tip_diameter_mm * normals / lengths)
