# SPDX-License-Identifier: Apache-2.0
"""What a stereo calibration holds, in a few lines."""

from __future__ import annotations

from typing import Any

import numpy as np

from armscan.models.stereo import StereoCalibration


def describe_stereo(calibration: StereoCalibration) -> dict[str, Any]:
    """Cameras, relative pose and evidence of ``stereo.json``, origin apart."""
    left, right = calibration.left.camera, calibration.right.camera
    pose = calibration.right_from_left
    angle = float(np.rad2deg(np.arccos(np.clip(pose.rotation[2, 2], -1.0, 1.0))))
    known = calibration.diagnostics
    content: dict[str, Any] = {
        "what": f"stereo calibration, cameras {left.width_px} x {left.height_px} px and "
        f"{right.width_px} x {right.height_px} px",
        "baseline_mm": round(float(np.linalg.norm(pose.translation_mm)), 4),
        "angle_between_axes_deg": round(angle, 4),
        "translation_right_mm": [round(float(value), 4) for value in pose.translation_mm],
        "rms_px": calibration.rms_px,
        "pairs": calibration.n_pairs,
        "points": calibration.n_points,
    }
    if known is not None:
        content["epipolar_rms_px"] = known.epipolar_rms_px
        content["epipolar_mean_px"] = known.epipolar_mean_px
        if known.hold_out_rms_px is not None:
            content["hold_out_rms_px"] = known.hold_out_rms_px
        content["intrinsics"] = known.intrinsics
        content["taken_apart"] = [name for name, _ in known.left_out]
    return content
