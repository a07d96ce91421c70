# SPDX-License-Identifier: Apache-2.0
"""When a solved camera is no camera to measure with.

The limits are far outside what photographs give that are worth anything, so that a refusal means a
mistake (another target than stated, views of two cameras or zooms, a board that bends), not a
poor set. 91 calibrations of 12 real sets, down to four views drawn at random: focal length known
to 0.02 to 1.7 %, residuals on views not used of 0.00001 to 0.0013 of the diagonal.
"""

from __future__ import annotations

import math

from armscan.calibration.camera.result import CameraFit
from armscan.models.camera import CameraModel

LARGEST_FOCAL_SIGMA = 0.02
"""Relative. Lengths across the image scale with the focal length: 2 mm in 100, one sigma."""
LARGEST_RMS = 0.003
"""Of the image's diagonal: 2.4 px of 640 x 480."""


def reasons_to_refuse(fit: CameraFit) -> tuple[str, ...]:
    """Why a solved camera must not be written as if it were one; empty if nothing speaks against.

    Parameters
    ----------
    fit
        The camera with its evidence.
    """
    held_out = fit.cross_validation
    rms_px = fit.rms_px if held_out is None else max(fit.rms_px, held_out.rms_px)
    return (
        *focal_reasons(fit.camera, float(fit.sigma[0]), float(fit.sigma[1])),
        *rms_reasons(fit.camera, rms_px),
    )


def focal_reasons(camera: CameraModel, sigma_fx_px: float, sigma_fy_px: float) -> tuple[str, ...]:
    """Why a camera's focal length is known too badly; empty if it is not."""
    known_to = max(sigma_fx_px / camera.fx_px, sigma_fy_px / camera.fy_px)
    if known_to <= LARGEST_FOCAL_SIGMA:
        return ()
    return (
        f"the camera's focal length is known to {100.0 * known_to:.1f} % only, "
        f"{100.0 * LARGEST_FOCAL_SIGMA:.0f} % is the limit",
    )


def rms_reasons(camera: CameraModel, rms_px: float) -> tuple[str, ...]:
    """Why target points lie too far from where the camera puts them; empty if they do not."""
    limit_px = LARGEST_RMS * math.hypot(camera.width_px, camera.height_px)
    if rms_px <= limit_px:
        return ()
    return (
        f"target points lie {rms_px:.1f} px (rms) from where the camera puts them, {limit_px:.1f} "
        "px is the limit: the target is not as stated, or the photographs are not of one camera",
    )
