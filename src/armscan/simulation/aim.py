# SPDX-License-Identifier: Apache-2.0
"""How a person holds the head: where the middle of the stripe falls, and from which side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Base, Sensor
from armscan.geometry.poses import Pose
from armscan.geometry.rotation import rotation_from_vector

FACE_DOWN = np.diag([1.0, -1.0, -1.0])
"""Sensor axes over a face with x to the right and z up: it looks down on it, upright."""


@dataclass(frozen=True, slots=True)
class Aim:
    """One way of holding the head over a face.

    Parameters
    ----------
    tilt_x_deg, tilt_y_deg
        The head turned from looking straight down, about its own x and y axes; negative
        ``tilt_x_deg`` brings the laser upright and lays the camera over.
    roll_deg
        The head turned about the face's normal first.
    depth_mm
        Depth, along the optical axis, of the middle of the stripe.
    """

    tilt_x_deg: float
    tilt_y_deg: float
    roll_deg: float
    depth_mm: float

    def rotation(self) -> FloatArray:
        """Rotation (3, 3) ``face_from_sensor``."""
        roll, about_y, about_x = (
            rotation_from_vector(np.radians(angle) * np.eye(3)[axis])
            for angle, axis in ((self.roll_deg, 2), (-self.tilt_y_deg, 1), (-self.tilt_x_deg, 0))
        )
        return np.asarray(roll @ FACE_DOWN @ about_x @ about_y)


def sensor_over(
    base_rotation: FloatArray, spot_base_mm: FloatArray, aim: Aim, stripe_sensor_mm: FloatArray
) -> Pose[Base, Sensor]:
    """``base_from_sensor`` that brings the middle of the stripe to a spot.

    Parameters
    ----------
    base_rotation
        (3, 3) ``base_from_face``: its z axis is the face's normal.
    spot_base_mm
        (3,) where the middle of the stripe shall fall.
    aim
        How the head is held.
    stripe_sensor_mm
        (3,) the middle of the stripe at the aim's depth, in Sensor.
    """
    rotation = base_rotation @ aim.rotation()
    return Pose(rotation, spot_base_mm - rotation @ stripe_sensor_mm)
