# SPDX-License-Identifier: Apache-2.0
"""The thesis's equations of the flat-plate hand-eye calibration (2.53-2.76), as printed.

For points of one flat light sheet the 12 unknowns of eq. 2.73 are not determined by eq. 2.72,
however many postures there are: the points satisfy ``a x + b y + c z + D = 0`` (eq. 2.19), which
makes three combinations of the columns of `design_rows` vanish. The rank is 9 at most; the linear
start therefore has 9 unknowns in the sheet's own coordinates (`plate_start`).
"""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.frames import Base, Sensor, Tool
from armscan.geometry.poses import Pose


def plane_in_tool(plane_base: FloatArray, base_from_tool: Pose[Base, Tool]) -> FloatArray:
    """Bring the plate into Tool (eqs. 2.57 and 2.58).

    Parameters
    ----------
    plane_base
        (4,) ``A B C D`` of eq. 2.55 in Base, D in mm.
    base_from_tool
        Pose of the arm; the thesis writes its inverse, ``tool_from_base``.

    Returns
    -------
    plane_tool
        (4,) of eq. 2.56: ``D_t = D_b - [A_t B_t C_t] T`` with T of ``tool_from_base``.
    """
    tool_from_base = base_from_tool.inverse()
    normal = tool_from_base.rotation @ plane_base[:3]
    return np.array([*normal, plane_base[3] - normal @ tool_from_base.translation_mm])


def design_rows(plane_tool: FloatArray, points_mm: FloatArray) -> FloatArray:
    """Rows H_ij (N, 12) of eqs. 2.72 and 2.75.

    Parameters
    ----------
    plane_tool
        (4,) the plate in Tool.
    points_mm
        (N, 3) in the Sensor frame.
    """
    homogeneous = np.column_stack([points_mm, np.ones(len(points_mm))])
    rows = plane_tool[None, :3, None] * homogeneous[:, None, :]
    return np.asarray(rows.reshape(len(points_mm), 12))


def hand_eye_unknowns(tool_from_sensor: Pose[Tool, Sensor]) -> FloatArray:
    """X (12,) of eq. 2.73: r1 r2 r3 t_x r4 r5 r6 t_y r7 r8 r9 t_z."""
    return np.column_stack([tool_from_sensor.rotation, tool_from_sensor.translation_mm]).ravel()


def rotation_from_angles(theta_rad: float, gamma_rad: float, phi_rad: float) -> FloatArray:
    """R (3, 3) of eq. 2.69: Rx(theta) Ry(gamma) Rz(phi)."""
    ct, st = np.cos(theta_rad), np.sin(theta_rad)
    cg, sg = np.cos(gamma_rad), np.sin(gamma_rad)
    cp, sp = np.cos(phi_rad), np.sin(phi_rad)
    return np.array(
        [
            [cg * cp, -cg * sp, sg],
            [ct * sp + st * sg * cp, ct * cp - st * sg * sp, -st * cg],
            [st * sp - ct * sg * cp, st * cp + ct * sg * sp, ct * cg],
        ]
    )


def objective(
    plane_base: FloatArray,
    poses: list[Pose[Base, Tool]],
    points_mm: list[FloatArray],
    tool_from_sensor: Pose[Tool, Sensor],
) -> float:
    """F of eq. 2.76 in mm^2: the sum of squared distances of all points from the plate.

    Parameters
    ----------
    plane_base
        (4,) ``A B C D`` with a unit normal.
    poses
        Pose of the arm for each scan.
    points_mm
        (N, 3) points of each scan in the Sensor frame.
    tool_from_sensor
        Where it is evaluated.
    """
    unknowns = hand_eye_unknowns(tool_from_sensor)
    total = 0.0
    for pose, points in zip(poses, points_mm, strict=True):
        plane_tool = plane_in_tool(plane_base, pose)
        misclosure = design_rows(plane_tool, points) @ unknowns + plane_tool[3]  # eq. 2.74
        total += float(misclosure @ misclosure)
    return total
