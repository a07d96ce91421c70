# SPDX-License-Identifier: Apache-2.0
"""How each kind of head is held over a face: with its light upright, or half-way to the cameras.

Angles follow from where a head's cameras and sheets are, but for the roll: it is that in which the
arm holds each kind of head with the same wrist.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.simulation.aim import Aim
from armscan.simulation.head import Head
from armscan.simulation.sheet_middle import sheet_middle_mm

DEPTH_MM = 137.0
"""Middle of the depths that the scanning window sees."""
_STEREO_DEPTH_MM = 140.0
"""There the axes of two cameras meet."""
_STEREO_ROLL_DEG = 92.0


def light_upright(head: Head) -> Aim:
    """Aim at which the light falls along the face's normal.

    One sheet: its middle ray stands upright. Two: both sheets do, that is the line in which they
    meet. More: the middle ray of the middle one.
    """
    if len(head.lasers) == 2:
        along = np.cross(head.lasers[0].normal, head.lasers[1].normal)
        return _looking_along(head, along * np.sign(along[2]))
    return _looking_along(head, head.lasers[len(head.lasers) // 2].rays(np.zeros(1))[0])


def half_way(head: Head) -> Aim:
    """Aim at which light and camera lie equally far from the face's normal.

    For two cameras it is that at which both of them do.
    """
    if len(head.cameras) > 1:
        return facing_both(head)
    upright = light_upright(head)
    return replace(
        upright, tilt_x_deg=0.5 * upright.tilt_x_deg, tilt_y_deg=0.5 * upright.tilt_y_deg
    )


def facing_both(head: Head) -> Aim:
    """Aim at which a face is seen equally obliquely by all cameras."""
    return _looking_along(head, _mean_view(head))


def viewing_axes(head: Head) -> FloatArray:
    """(3, 3) axes, in Sensor, of a target that faces all cameras alike: its z points away."""
    away = _mean_view(head)
    down = np.array([0.0, 1.0, 0.0]) - away[1] * away
    down /= np.linalg.norm(down)
    return np.stack([np.cross(down, away), down, away], axis=1)


def aim_point_mm(head: Head, depth_mm: float) -> FloatArray:
    """(3,) point of Sensor, at a depth along camera 0's axis, that is brought to what is scanned.

    For one camera it is the middle of its light, for two the middle of what both see.
    """
    if len(head.cameras) == 1:
        return sheet_middle_mm(head, depth_mm)
    away = _mean_view(head)
    return overlap_middle_mm(head, (depth_mm - _STEREO_DEPTH_MM) / away[2])


def overlap_middle_mm(head: Head, farther_mm: float = 0.0) -> FloatArray:
    """(3,) point of Sensor on which all cameras look, or farther away from them.

    For one camera it is the middle of its light.
    """
    if len(head.cameras) > 1:
        return np.array([0.0, 0.0, _STEREO_DEPTH_MM]) + farther_mm * _mean_view(head)
    return sheet_middle_mm(head, DEPTH_MM + farther_mm)


def _mean_view(head: Head) -> FloatArray:
    """(3,) unit mean of the cameras' axes."""
    axes = [mounted.camera_from_sensor.rotation[2] for mounted in head.cameras]
    total = np.sum(axes, axis=0)
    return np.asarray(total / np.linalg.norm(total))


def _looking_along(head: Head, direction: FloatArray) -> Aim:
    """Aim that turns a direction (3,) of Sensor against the face's normal."""
    x, y, z = direction / np.linalg.norm(direction)
    is_stereo = len(head.cameras) > 1
    return Aim(
        float(-np.degrees(np.arcsin(y))),
        float(np.degrees(np.arctan2(x, z))),
        _STEREO_ROLL_DEG if is_stereo else 0.0,
        _STEREO_DEPTH_MM if is_stereo else DEPTH_MM,
    )
