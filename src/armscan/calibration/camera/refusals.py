# SPDX-License-Identifier: Apache-2.0
"""When a solved camera is no camera to measure with."""

from __future__ import annotations

from armscan.calibration.camera.result import CameraFit

LARGEST_FOCAL_SIGMA = 0.02
LARGEST_RMS_SHARE = 0.005


def reasons_to_refuse(fit: CameraFit) -> tuple[str, ...]:
    """Why a solved camera must not be written as if it were one; empty if nothing speaks against.

    Parameters
    ----------
    fit
        The camera with its evidence.
    """
    return ()
