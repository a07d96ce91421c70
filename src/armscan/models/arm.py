# SPDX-License-Identifier: Apache-2.0
"""A measuring arm: a Denavit-Hartenberg chain of revolute joints (eqs. 2.1 to 2.10)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.frames import Tool
from armscan.geometry.poses import Pose

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


@dataclass(frozen=True, slots=True, eq=False)
class ArmModel:
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
    name
        What reports call it.

    Raises
    ------
    InputError
        If the lengths of the lists differ or a lower limit is not below its upper one.
    """

    theta_offset_rad: FloatArray
    offset_mm: FloatArray
    length_mm: FloatArray
    twist_rad: FloatArray
    flange: Pose[Tool, Tool] = field(default_factory=no_flange)
    joint_min_rad: FloatArray | None = None
    joint_max_rad: FloatArray | None = None
    name: str = "arm"

    def __post_init__(self) -> None:
        n = len(np.atleast_1d(self.theta_offset_rad))
        if n == 0:
            raise InputError("an arm needs at least one axis", where=self.name)
        for name in AXIS_PARAMETERS:
            object.__setattr__(self, name, frozen_floats(getattr(self, name), (n,), name))
        for name in ("joint_min_rad", "joint_max_rad"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _limits(getattr(self, name), n, name))
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

    def with_parameters(self, parameters: FloatArray) -> ArmModel:
        """The same arm with other (4 n,) ``parameters``; flange, limits and name stay."""
        table = frozen_floats(parameters, (4 * self.n_axes,), "arm parameters").reshape(-1, 4)
        return replace(
            self,
            theta_offset_rad=table[:, 0],
            offset_mm=table[:, 1],
            length_mm=table[:, 2],
            twist_rad=table[:, 3],
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
        frozen_floats(theta_offset_rad, (7,), "theta_offset_rad"),
        offset,
        length,
        np.array(THESIS_TWISTS_RAD),
        no_flange() if flange is None else flange,
        name=name,
    )


def _limits(values: FloatArray, n: int, name: str) -> FloatArray:
    """Limits may be infinite, unlike other numbers of a record."""
    limits = np.array(values, dtype=np.float64)
    if limits.shape != (n,) or bool(np.isnan(limits).any()):
        raise InputError(f"{name} must hold {n} numbers")
    limits.setflags(write=False)
    return limits
