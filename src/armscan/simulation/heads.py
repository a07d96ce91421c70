# SPDX-License-Identifier: Apache-2.0
"""The heads of the thesis as printed: cameras, lasers and where they stand."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import CameraRight, Pose, Sensor, Tool
from armscan.geometry.rotations import nearest_rotation, rotation_from_vector
from armscan.simulation.optics.camera import RenderCamera
from armscan.simulation.plans import PRINTED

_BLUR_PX = 0.8
_AIM_MM = 140.0

SINGLE_SHEET = np.array(PRINTED["sheets"]["single"][0])
"""(4,) the printed plane of the laser; section 5.1.2."""
CROSS_SHEETS = np.array(PRINTED["sheets"]["cross"])
"""(2, 4) lasers A and B; section 5.2.2."""
MULTI_SHEETS = np.array(PRINTED["sheets"]["multi"])
"""(5, 4) the middle five of eleven; section 5.3.3."""

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
    single, left, right = (
        RenderCamera(**PRINTED["cameras"][name], blur_sigma_px=_BLUR_PX)
        for name in ("single", "left", "right")
    )
    right_from_left: Pose[CameraRight, Sensor] = _pose(PRINTED["right_from_left"])
    on_tool: dict[str, Pose[Tool, Sensor]] = {
        name: _pose(printed) for name, printed in PRINTED["tool_from_sensor"].items()
    }
    sheets = _multi_sheets()
    middle = tuple(
        replace(sheet, name=f"A.{k}")
        for k, sheet in enumerate(sheets[_OUTER_SHEETS:-_OUTER_SHEETS], start=1)
    )
    two = (left, right)
    return {
        "thesis-single": PrintedHead((single,), None, (_single_sheet(),), on_tool["single"]),
        "thesis-cross": PrintedHead((single,), None, _cross_sheets(), on_tool["cross"]),
        "thesis-multi": PrintedHead(two, right_from_left, sheets, on_tool["multi"]),
        "thesis-multi-5": PrintedHead(two, right_from_left, middle, on_tool["multi"]),
    }


def _pose(printed: dict[str, Any]) -> Pose[Any, Sensor]:
    return Pose(
        nearest_rotation(np.array(printed["rotation"])), np.array(printed["translation_mm"])
    )


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
