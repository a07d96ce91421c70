# SPDX-License-Identifier: Apache-2.0
"""A camera in one line, and sheets and hand-eyes as calibrations would store them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armscan.geometry.poses import Pose, Sensor, Tool
from armscan.models.calibration import ArmNoise, HandEyeCalibration, SheetCalibration
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import LightSheet


def plain_camera(
    focal_px: float | tuple[float, float],
    centre_px: tuple[float, float],
    size_px: tuple[int, int],
    distortion: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0),
) -> CameraModel:
    """A camera of one focal length, or of two, with ``k1 k2 p1 p2 k3`` or a pinhole."""
    fx_px, fy_px = focal_px if isinstance(focal_px, tuple) else (focal_px, focal_px)
    return CameraModel(
        fx_px=fx_px,
        fy_px=fy_px,
        cx_px=centre_px[0],
        cy_px=centre_px[1],
        distortion=np.asarray(distortion, dtype=np.float64),
        width_px=size_px[0],
        height_px=size_px[1],
    )


def stored_sheet(
    name: str, sheet: LightSheet, depth_range_mm: tuple[float, float], **known: Any
) -> SheetCalibration:
    """The entry of a sheet that six boards agree on; ``known`` are other fields of it."""
    fields: dict[str, Any] = {
        "rms_mm": 0.01,
        "n_boards": 6,
        "n_points": 600,
        "is_redundant": True,
        **known,
    }
    return SheetCalibration(name=name, sheet=sheet, depth_range_mm=depth_range_mm, **fields)


def stored_hand_eye(tool_from_sensor: Pose[Tool, Sensor]) -> HandEyeCalibration:
    """A hand-eye that is known for certain, of an arm that scatters by 5 um and 0.02 mrad."""
    return HandEyeCalibration(
        tool_from_sensor=tool_from_sensor,
        covariance=np.zeros((6, 6)),
        dhand_eye_dsensor=None,
        arm_noise=ArmNoise(position_mm=0.005, rotation_rad=2e-5),
        rms_mm=0.007,
        n_postures=12,
        n_exposures=12,
        n_points=8000,
    )
