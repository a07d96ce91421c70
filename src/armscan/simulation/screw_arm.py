# SPDX-License-Identifier: Apache-2.0
"""The measuring arm as a product of screws: seven lines in space, and the tool at rest.

Where the arm stands straight up, all angles zero, its axes are seven known lines. Turning joint i
turns everything beyond it about its line, so the pose is the product of seven rotations about
fixed lines, times the pose at rest. No link frames are needed; nothing is shared with the chain
of link matrices that the program itself uses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, frozen_floats
from armscan.geometry.frames import Base, Tool
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import skew

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
    rest
        ``base_from_tool`` with all angles zero.
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
