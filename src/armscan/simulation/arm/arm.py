# SPDX-License-Identifier: Apache-2.0
"""The simulated measuring arm: forward kinematics by screws, its errors, and joint angles that
reach a pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.errors import EstimationError
from armscan.geometry.arrays import ArrayRecord, FloatArray, floats, frozen_floats
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import skew, vector_from_rotation

N_JOINTS = 7

_Z, _Y = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
_AXES = (_Z, _Y, _Z, _Y, _Z, _Y, _Z)
_POINTS_MM = (
    (0.0, 0.0, 0.0),
    (0.0, 0.0, 300.0),
    (-40.0, 0.0, 300.0),
    (-40.0, 0.0, 900.0),
    (-80.0, 0.0, 900.0),
    (-80.0, 0.0, 1400.0),
    (-120.0, 0.0, 1400.0),
)
_TOOL_MM = (-120.0, 0.0, 1600.0)


@dataclass(frozen=True, slots=True, eq=False)
class ScrewArm:
    """Revolute joints in a row, given by their lines where all angles are zero.

    Parameters
    ----------
    axes
        (7, 3) unit directions of the joints' axes in Base, all angles zero.
    points_mm
        (7, 3) a point on each axis, in Base.
    """

    axes: FloatArray
    points_mm: FloatArray
    rest: Pose[Base, Tool]

    def __post_init__(self) -> None:
        axes = frozen_floats(self.axes, (N_JOINTS, 3), "axes")
        unit = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        object.__setattr__(self, "axes", frozen_floats(unit, (N_JOINTS, 3), "axes"))
        points = frozen_floats(self.points_mm, (N_JOINTS, 3), "points_mm")
        object.__setattr__(self, "points_mm", points)

    def transforms(self, joints_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``base_from_tool`` of joint angles (N, 7): rotations (N, 3, 3), translations (N, 3) mm.

        Each joint turns a point p into ``R p + (1 - R) q`` with q on its axis.
        """
        rotation, translation, _, _ = self._chain(joints_rad)
        return (
            rotation @ self.rest.rotation,
            rotation @ self.rest.translation_mm + translation,
        )

    def pose(self, joints_rad: FloatArray) -> Pose[Base, Tool]:
        """``base_from_tool`` of joint angles (7,)."""
        rotations, translations = self.transforms(np.asarray(joints_rad)[None])
        return Pose(rotations[0], translations[0])

    def pose_and_axes(
        self, joints_rad: FloatArray
    ) -> tuple[Pose[Base, Tool], FloatArray, FloatArray]:
        """Pose at angles (7,), and the turned axes: directions (7, 3) and points (7, 3) in mm."""
        rotation, translation, axes, points = self._chain(np.asarray(joints_rad)[None])
        pose: Pose[Base, Tool] = Pose(
            rotation[0] @ self.rest.rotation,
            rotation[0] @ self.rest.translation_mm + translation[0],
        )
        return pose, axes[0], points[0]

    def _chain(
        self, joints_rad: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        joints = np.asarray(joints_rad, dtype=np.float64).reshape(-1, N_JOINTS)
        rotation = np.broadcast_to(np.eye(3), (len(joints), 3, 3))
        translation = np.zeros((len(joints), 3))
        axes = np.zeros((len(joints), N_JOINTS, 3))
        points = np.zeros((len(joints), N_JOINTS, 3))
        for i in range(N_JOINTS):
            axis, point = self.axes[i], self.points_mm[i]
            axes[:, i] = rotation @ axis
            points[:, i] = rotation @ point + translation
            turn = turns_about(axis, joints[:, i])
            translation = translation + (rotation @ (point - turn @ point)[..., None])[..., 0]
            rotation = rotation @ turn
        return rotation, translation, axes, points


def turns_about(axis: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3) about one unit axis (3,) by angles (N,): Rodrigues' formula."""
    cross = skew(np.asarray(axis))
    sine = np.sin(angles_rad)[:, None, None]
    versine = (1.0 - np.cos(angles_rad))[:, None, None]
    return np.asarray(np.eye(3) + sine * cross + versine * (cross @ cross))


def nominal_arm() -> ScrewArm:
    """Return the arm of Table 2 with the flange, as its drawing says.

    Upright, its axes point up and along y in turn; the shoulder is 300 mm above Base, the upper
    arm 600 mm long, the forearm 500 mm, the wrist 200 mm, and each even link steps back 40 mm.
    The fixed flange after axis 7 makes Tool parallel to Base there.
    """
    rest: Pose[Base, Tool] = Pose(np.eye(3), np.array(_TOOL_MM))
    return ScrewArm(np.array(_AXES), np.array(_POINTS_MM), rest)


COMFORTABLE_RAD = np.radians([-15.0, 35.0, 0.0, 85.0, 0.0, 60.0, 0.0])
"""The arm over the table before it: shoulder leant forward, elbow and wrist bent down."""

LEVER_MM = 200.0
"""A turn of 1 rad counts as much as this distance when steps are weighed."""


_LEFT_MM = 1e-8
"""Largest error left, at the tool and at a point `LEVER_MM` away."""
_MAX_STEPS, _MAX_TURN_RAD = 400, 0.3
_DAMPING = 0.05
"""Far from the goal, in the units of the goal's error over `LEVER_MM`."""
_COMFORT = 0.5
"""Share of the way to the preferred elbow that is gone in each step."""


def reach(
    arm: ScrewArm,
    base_from_tool: Pose[Base, Tool],
    start_rad: FloatArray = COMFORTABLE_RAD,
    preferred_rad: FloatArray = COMFORTABLE_RAD,
) -> FloatArray:
    """Joint angles (7,) with which an arm holds its tool at a pose; `EstimationError` beyond its
    reach.
    """
    joints = np.array(start_rad, dtype=np.float64)
    for _ in range(_MAX_STEPS):
        error, jacobian = _error_and_jacobian(arm, joints, base_from_tool)
        size = float(np.linalg.norm(error))
        damping = _DAMPING * min(1.0, size)
        weights = jacobian @ jacobian.T + damping**2 * np.eye(6)
        step = jacobian.T @ np.linalg.solve(weights, error)
        wish = _COMFORT * (preferred_rad - joints)
        ease = wish - jacobian.T @ np.linalg.solve(weights, jacobian @ wish)
        is_there = LEVER_MM * size < _LEFT_MM
        if is_there and float(np.abs(ease).max()) < 1e-5:
            return joints
        step = step + ease
        joints = joints + step * min(1.0, _MAX_TURN_RAD / float(np.abs(step).max()))
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


ARC_SECOND_RAD = np.pi / 180.0 / 3600.0


@dataclass(frozen=True, slots=True)
class ArmErrors:
    """Sizes of an arm's errors.

    Parameters
    ----------
    white_arcsec
        Standard deviation of the noise of one reading of one encoder.
    once_arcsec, twice_arcsec
        Amplitudes of the eccentricity, once and twice per turn; each encoder has its own phases.
    tilt_arcsec
        Standard deviation of each axis's direction about the drawing's, in both directions.
    shift_mm
        The same of its position.
    """

    white_arcsec: float
    once_arcsec: float
    twice_arcsec: float
    tilt_arcsec: float
    shift_mm: float


class MeasuringArm(ArrayRecord, kw_only=False):
    """The true arm, the controller's arm and the encoders between them.

    ``waves_rad`` (7, 4): cosine and sine amplitudes once per turn, then twice, of each encoder.
    """

    true: ScrewArm
    nominal: ScrewArm
    white_rad: float
    waves_rad: FloatArray = floats(N_JOINTS, 4)

    @staticmethod
    def build(errors: ArmErrors, rng: np.random.Generator) -> MeasuringArm:
        """Draw one arm: its axes and the phases of its encoders."""
        nominal = nominal_arm()
        phases = rng.uniform(0.0, 2.0 * np.pi, (N_JOINTS, 2))
        sizes = np.array([errors.once_arcsec, errors.twice_arcsec]) * ARC_SECOND_RAD
        waves = np.stack([sizes * np.cos(phases), sizes * np.sin(phases)], axis=2)
        true = bent_arm(nominal, errors.tilt_arcsec * ARC_SECOND_RAD, errors.shift_mm, rng)
        return MeasuringArm(
            true, nominal, errors.white_arcsec * ARC_SECOND_RAD, waves.reshape(N_JOINTS, 4)
        )

    def readings(self, joints_rad: FloatArray, rng: np.random.Generator) -> FloatArray:
        """What the encoders say (N, 7) at true angles (N, 7); noise is new for every row."""
        joints = np.asarray(joints_rad, dtype=np.float64)
        once_cos, once_sin, twice_cos, twice_sin = self.waves_rad.T
        eccentric = (
            once_cos * np.cos(joints)
            + once_sin * np.sin(joints)
            + twice_cos * np.cos(2.0 * joints)
            + twice_sin * np.sin(2.0 * joints)
        )
        return np.asarray(joints + eccentric + self.white_rad * rng.standard_normal(joints.shape))

    def true_pose(self, joints_rad: FloatArray) -> Pose[Base, Tool]:
        """Where the tool truly is at true angles (7,)."""
        return self.true.pose(joints_rad)


def bent_arm(arm: ScrewArm, tilt_rad: float, shift_mm: float, rng: np.random.Generator) -> ScrewArm:
    """Copy of an arm whose axes are tilted and shifted at random, square to themselves.

    The tool at rest stays: an error there belongs to the hand-eye.
    """
    axes, points = [], []
    for axis, point in zip(arm.axes, arm.points_mm, strict=True):
        aside = _square_to(axis)
        tilts = rng.normal(0.0, 1.0, 2) * tilt_rad
        tilted = turns_about(aside[0], tilts[:1])[0] @ turns_about(aside[1], tilts[1:])[0] @ axis
        axes.append(tilted)
        points.append(point + rng.normal(0.0, 1.0, 2) * shift_mm @ aside)
    return ScrewArm(np.array(axes), np.array(points), arm.rest)


def _square_to(axis: FloatArray) -> FloatArray:
    """(2, 3) unit vectors square to an axis and to each other."""
    start = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(axis, start)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(axis, first)])
