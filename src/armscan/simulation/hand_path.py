# SPDX-License-Identifier: Apache-2.0
"""The way of a hand: joint angles as smooth functions of time, and a person's unsteadiness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.frames import Base, Sensor, Tool
from armscan.geometry.poses import Pose
from armscan.simulation.arm_inverse import COMFORTABLE_RAD, reach
from armscan.simulation.screw_arm import N_JOINTS, ScrewArm

_FREQUENCIES_HZ = (0.4, 0.9, 1.7)
_SHARES = (0.6, 0.3, 0.1)


@dataclass(frozen=True, slots=True, eq=False)
class HandPath:
    """Joint angles over time, cubic between knots.

    Parameters
    ----------
    t_s
        (N,) increasing times of the knots, N >= 2.
    joints_rad
        (N, 7) true joint angles there.
    """

    t_s: FloatArray
    joints_rad: FloatArray

    def __post_init__(self) -> None:
        times = frozen_floats(self.t_s, (None,), "t_s")
        joints = frozen_floats(self.joints_rad, (len(times), N_JOINTS), "joints_rad")
        object.__setattr__(self, "t_s", times)
        object.__setattr__(self, "joints_rad", joints)

    @staticmethod
    def through(
        arm: ScrewArm,
        tool_from_sensor: Pose[Tool, Sensor],
        t_s: FloatArray,
        poses: Sequence[Pose[Base, Sensor]],
    ) -> HandPath:
        """Path of a true arm whose sensor passes poses at times (N,), each reached exactly."""
        sensor_from_tool = tool_from_sensor.inverse()
        joints = COMFORTABLE_RAD
        knots = []
        for pose in poses:
            joints = reach(arm, pose @ sensor_from_tool, joints)
            knots.append(joints)
        return HandPath(t_s, np.array(knots))

    def joints(self, t_s: FloatArray) -> FloatArray:
        """True joint angles (N, 7) at times (N,) within the knots."""
        return np.asarray(CubicSpline(self.t_s, self.joints_rad, axis=0)(t_s))


@dataclass(frozen=True, slots=True)
class Unsteadiness:
    """How far a hand strays; each a standard deviation over time.

    Parameters
    ----------
    tilt_deg
        About each axis of the head.
    depth_mm
        Of the stand-off.
    aside_mm
        Across the way.
    speed
        Of the speed, over its mean.
    """

    tilt_deg: float = 1.5
    depth_mm: float = 1.0
    aside_mm: float = 1.5
    speed: float = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Sway:
    """A smooth random function of time: a few slow waves with random phases.

    Parameters
    ----------
    phases_rad
        (3,) phases of the waves.
    """

    phases_rad: FloatArray

    @staticmethod
    def draw(rng: np.random.Generator) -> Sway:
        """Draw the phases."""
        return Sway(rng.uniform(0.0, 2.0 * np.pi, len(_FREQUENCIES_HZ)))

    def __call__(self, t_s: FloatArray) -> FloatArray:
        """(N,) values of about unit standard deviation at times (N,)."""
        angle = 2.0 * np.pi * np.outer(t_s, _FREQUENCIES_HZ) + self.phases_rad
        scale = np.sqrt(2.0 / np.sum(np.square(_SHARES)))
        return np.asarray(scale * np.sin(angle) @ np.array(_SHARES))
