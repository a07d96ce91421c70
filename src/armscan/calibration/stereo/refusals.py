# SPDX-License-Identifier: Apache-2.0
"""When two solved cameras are no cameras to measure with."""

from __future__ import annotations

import numpy as np

from armscan.calibration.camera.refusals import focal_reasons, rms_reasons
from armscan.calibration.stereo.pairs import SIDES
from armscan.calibration.stereo.result import StereoFit
from armscan.models.camera import PARAMETER_NAMES

LARGEST_BASELINE_SIGMA = 0.05
"""Relative. The distance of a point scales with the baseline."""


def reasons_to_refuse(fit: StereoFit) -> tuple[str, ...]:
    """Why a solved pair must not be written as if it were one; empty if nothing speaks against.

    The limits of each camera are those of `armscan.calibration.camera.refusals`.

    Parameters
    ----------
    fit
        Both cameras with their evidence.
    """
    n = len(PARAMETER_NAMES)
    reasons: list[str] = []
    held_out = 0.0 if fit.hold_out is None else fit.hold_out.rms_px
    for side, camera in enumerate((fit.views.left, fit.views.right)):
        sigma = fit.sigma[side * n : side * n + 2]
        rms_px = max(fit.sides[side].rms_px, held_out)
        found = (*focal_reasons(camera, *sigma.tolist()), *rms_reasons(camera, rms_px))
        reasons += [f"{SIDES[side]} camera: {reason}" for reason in found]
    translation = fit.views.right_from_left.translation_mm
    length = float(np.linalg.norm(translation))
    along = translation / length
    sigma_mm = float(np.sqrt(along @ fit.covariance[-3:, -3:] @ along))
    if sigma_mm > LARGEST_BASELINE_SIGMA * length:
        reasons.append(
            f"the cameras' distance of {length:.1f} mm is known to {sigma_mm:.1f} mm only, "
            f"{100.0 * LARGEST_BASELINE_SIGMA:.0f} % is the limit"
        )
    return tuple(reasons)
