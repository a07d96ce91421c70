# SPDX-License-Identifier: Apache-2.0
"""The heads of the thesis as printed: cameras, lasers and where they stand."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import CameraRight, Pose, Sensor, Tool
from armscan.geometry.rotations import nearest_rotation, rotation_from_vector
from armscan.simulation.optics.camera import RenderCamera

_BLUR_PX = 0.8
_AIM_MM = 140.0

_CAMERA = RenderCamera(
    fx=5145.36,
    fy=5153.66,
    cx=1517.37,
    cy=1023.36,
    k1=-0.09035,
    k2=0.1954,
    p1=-0.000659,
    p2=-0.000978,
    k3=-0.4617,
    width_px=3072,
    height_px=2048,
    blur_sigma_px=_BLUR_PX,
)
"""Section 5.1.2. Section 5.2.2 repeats it and garbles the distortion."""

_LEFT = RenderCamera(
    fx=5174.97,
    fy=5175.62,
    cx=1524.358,
    cy=1032.405,
    k1=-0.1035,
    k2=0.3449,
    p1=0.000706,
    p2=-0.00032,
    k3=-0.139,
    blur_sigma_px=_BLUR_PX,
)
_RIGHT = RenderCamera(
    fx=5163.38,
    fy=5162.49,
    cx=1563.458,
    cy=1039.554,
    k1=-0.0895,
    k2=0.192148,
    p1=0.000079,
    p2=-0.00015,
    k3=-0.5824,
    blur_sigma_px=_BLUR_PX,
)
_R_LR = np.array(
    [
        [0.546702, 0.02539, 0.8369417],
        [-0.03461, 0.99937, -0.007715],
        [-0.83661, -0.0247, 0.547238],
    ]
)
_T_LR_MM = np.array([-117.4319, 2.4648, 63.229])
"""Section 5.3.2."""

SINGLE_SHEET = np.array([-0.0042275, 0.73558, -0.67742, 91.78])
"""Section 5.1.2: the printed plane a x + b y + c z + D = 0 of the laser, Sensor frame, mm."""

CROSS_SHEETS = np.array(
    [[-0.659905, -0.551732, 0.51, -68.7215], [0.76417, -0.543156, 0.34787, -49.616]]
)
"""Section 5.2.2: lasers A and B."""

MULTI_SHEETS = np.array(
    [
        [0.5465, 0.7106, 0.4431, -43.254],
        [0.5772, 0.7132, 0.3976, -44.228],
        [0.6050, 0.7144, 0.3513, -45.155],
        [0.6316, 0.7138, 0.3025, -45.743],
        [0.6565, 0.7107, 0.2527, -46.175],
    ]
)
"""Section 5.3.3: the middle five of eleven, along the head in order."""

_MULTI_SOURCE_MM = np.array([63.03, -0.58, 20.89])
"""Midway between the cameras: near the axis that the five planes miss by 0.1 mm at most."""
_OUTER_SHEETS = 3
_OUTER_STEP_RAD = np.radians(3.15)
"""The printed neighbours are 3.10, 3.15, 3.19, 3.20 degrees apart."""

_SINGLE_SOURCE_MM = np.array([0.0, -124.8, 0.0])
_SINGLE_SKEW_RAD = 0.035
"""Bows the line by 0.12 mm over the 72 mm field, 0.16 % of its length: what line lenses do."""

_MIDDLE_BOW_MM, _OUTERMOST_BOW_MM = 0.05, 0.35
_HALF_FIELD_MM = 36.0
_CUBIC_BOW_MM = 0.015
_OUTERMOST_ORDER = 5
_LOST_AT_OUTERMOST = 0.3

_TOOL_FROM_SINGLE = (
    [
        [-0.42453, 0.663009, -0.61659],
        [-0.90541, -0.31178, 0.28813],
        [-0.00121, 0.680594, 0.73266],
    ],
    [41.376, 21.496, 112.286],
)
"""Section 5.1.2."""
_TOOL_FROM_CROSS = (
    [
        [-0.42684, 0.66270, -0.61532],
        [-0.904314, -0.3163, 0.286604],
        [-0.004728, 0.678785, 0.73432],
    ],
    [41.373, 21.393, 112.962],
)
"""Section 5.2.3, with 41.373 for the misprint 4.1373."""
_TOOL_FROM_MULTI = (
    [
        [-0.77305, -0.44229, -0.454708],
        [0.38834, -0.896779, 0.212077],
        [-0.50157, -0.012635, 0.865022],
    ],
    [73.507, 4.651, 119.688],
)
"""Section 5.3.4."""

BLUE_MM, RED_MM = 405e-6, 650e-6


@dataclass(frozen=True, slots=True, eq=False)
class PrintedSheet:
    """One light sheet before an instrument is drawn.

    Parameters
    ----------
    name, source
        Of the sheet, and of the light source that it is switched with.
    plane
        (4,) of eq. 2.19, in which the fan's middle lies.
    source_mm, aim_mm
        (3,) where the fan starts, and a point of its middle in the working region.
    half_angle_rad
        The fan ends at plus and minus this angle.
    skew_rad, cubic_rad
        Bow; see `armscan.simulation.optics.lasers.LineLaser`. The second is a standard deviation.
    brightness
        As a part of the head's brightest line.
    wavelength_mm
        Sets how the sheet's thickness grows away from its waist.
    """

    name: str
    source: str
    plane: FloatArray
    source_mm: FloatArray
    aim_mm: FloatArray
    half_angle_rad: float
    skew_rad: float
    cubic_rad: float = 0.0
    brightness: float = 1.0
    wavelength_mm: float = BLUE_MM


@dataclass(frozen=True, slots=True, eq=False)
class PrintedHead:
    """One kind of head before an instrument is drawn.

    Parameters
    ----------
    cameras
        Camera 0 first.
    right_from_sensor
        Camera 1's place, if there is one.
    sheets
        In order along the head.
    tool_from_sensor
        The printed hand-eye.
    """

    cameras: tuple[RenderCamera, ...]
    right_from_sensor: Pose[CameraRight, Sensor] | None
    sheets: tuple[PrintedSheet, ...]
    tool_from_sensor: Pose[Tool, Sensor]


def printed_heads() -> dict[str, PrintedHead]:
    """All kinds of heads by name."""
    right: Pose[CameraRight, Sensor] = Pose(nearest_rotation(_R_LR), _T_LR_MM)
    multi = _multi_sheets()
    middle = tuple(
        replace(sheet, name=f"A.{k + 1}")
        for k, sheet in enumerate(multi[_OUTER_SHEETS:-_OUTER_SHEETS])
    )
    on_multi = _hand_eye(_TOOL_FROM_MULTI)
    return {
        "thesis-single": PrintedHead(
            (_CAMERA,), None, (_single_sheet(),), _hand_eye(_TOOL_FROM_SINGLE)
        ),
        "thesis-cross": PrintedHead((_CAMERA,), None, _cross_sheets(), _hand_eye(_TOOL_FROM_CROSS)),
        "thesis-multi": PrintedHead((_LEFT, _RIGHT), right, multi, on_multi),
        "thesis-multi-5": PrintedHead((_LEFT, _RIGHT), right, middle, on_multi),
    }


def _hand_eye(printed: tuple[list[list[float]], list[float]]) -> Pose[Tool, Sensor]:
    rotation, translation_mm = printed
    return Pose(nearest_rotation(np.array(rotation)), np.array(translation_mm))


def _single_sheet() -> PrintedSheet:
    normal = SINGLE_SHEET[:3] / np.linalg.norm(SINGLE_SHEET[:3])
    source = _SINGLE_SOURCE_MM - (normal @ _SINGLE_SOURCE_MM + SINGLE_SHEET[3]) * normal
    aim = np.array([0.0, 0.0, _AIM_MM])
    aim[1] = -(SINGLE_SHEET[2] * _AIM_MM + SINGLE_SHEET[3]) / SINGLE_SHEET[1]
    return PrintedSheet("A", "A", SINGLE_SHEET, source, aim, 0.32, _SINGLE_SKEW_RAD)


def _cross_sheets() -> tuple[PrintedSheet, ...]:
    """Each laser beside the camera, where its plane comes nearest to it, aimed at the axis."""
    return tuple(
        PrintedSheet(
            name,
            name,
            plane,
            _nearest_to_axis(plane, 0.0),
            _nearest_to_axis(plane, _AIM_MM),
            0.36,
            _SINGLE_SKEW_RAD,
        )
        for name, plane in zip(("A", "B"), CROSS_SHEETS, strict=True)
    )


def _nearest_to_axis(plane: FloatArray, depth_mm: float) -> FloatArray:
    """(3,) point of a plane at a depth that is nearest to the optical axis."""
    rest = -(plane[3] + depth_mm * plane[2]) / (plane[:2] @ plane[:2])
    return np.array([*(rest * plane[:2]), depth_mm])


def _multi_sheets() -> tuple[PrintedSheet, ...]:
    """Eleven sheets of one projector: the printed five, and three more on each side.

    The printed planes miss a common axis, so each keeps its own source point: the foot of the
    perpendicular from the common one. The others are turned about the axis.
    """
    printed = MULTI_SHEETS / np.linalg.norm(MULTI_SHEETS[:, :3], axis=1, keepdims=True)
    axis = np.linalg.svd(printed[:, :3])[2][2]
    axis = axis * np.sign(axis @ np.cross(printed[0, :3], printed[-1, :3]))
    normals = [
        *(_turned(printed[0, :3], axis, -k) for k in range(_OUTER_SHEETS, 0, -1)),
        *printed[:, :3],
        *(_turned(printed[-1, :3], axis, k) for k in range(1, _OUTER_SHEETS + 1)),
    ]
    offsets = np.array([-normal @ _MULTI_SOURCE_MM for normal in normals])
    offsets[_OUTER_SHEETS:-_OUTER_SHEETS] = printed[:, 3]
    return tuple(
        _multi_sheet(k - _OUTERMOST_ORDER, np.append(normal, offset), axis)
        for k, (normal, offset) in enumerate(zip(normals, offsets, strict=True))
    )


def _turned(normal: FloatArray, axis: FloatArray, steps: int) -> FloatArray:
    return np.asarray(rotation_from_vector(steps * _OUTER_STEP_RAD * axis) @ normal)


def _multi_sheet(order: int, plane: FloatArray, axis: FloatArray) -> PrintedSheet:
    """The line of one diffraction order.

    A grating bends oblique rays more: its orders lie on cones, bowed in proportion to the order
    (Born & Wolf, Principles of Optics, 8.6.1). Projectors are designed against the linear part;
    what is supposed to be left is cubic in the order, on top of the line lens's own bow: 0.05 mm
    in the middle, 0.4 and -0.3 mm at the two ends, over the 72 mm field.
    """
    normal = plane[:3]
    source = _MULTI_SOURCE_MM - (normal @ _MULTI_SOURCE_MM + plane[3]) * normal
    forward = np.cross(axis, normal)
    forward = forward * np.sign(forward[2])
    distance = (_AIM_MM - source[2]) / forward[2]
    outward = order / _OUTERMOST_ORDER
    bow_mm = _MIDDLE_BOW_MM + _OUTERMOST_BOW_MM * outward**3
    fan_rad = _HALF_FIELD_MM / distance
    return PrintedSheet(
        f"A.{order + _OUTERMOST_ORDER + 1}",
        "A",
        plane,
        source,
        source + distance * forward,
        half_angle_rad=0.42,
        skew_rad=2.0 * bow_mm / (distance * fan_rad**2),
        cubic_rad=_CUBIC_BOW_MM / (distance * fan_rad**3),
        brightness=1.0 - _LOST_AT_OUTERMOST * outward**2,
        wavelength_mm=RED_MM,
    )
