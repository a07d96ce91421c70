# SPDX-License-Identifier: Apache-2.0
"""The sensor's document: order of its covariance, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.models.calibration import (
    SHEET_PARAMETER_NAMES,
    SensorCalibration,
    SheetCalibration,
)
from armscan.models.light_sheet import LightSheet
from sheet_rig import PROVENANCE, thesis_rig

SHEET = LightSheet(np.array([0.0, 0.0, 135.0]), np.eye(3), 20.0, np.zeros(5))
ENTRY = SheetCalibration("A", SHEET, 0.01, 6, 600, (120.0, 150.0), True)
RIG = thesis_rig()
CAMERA = RIG.calibration(RIG.camera)


def test_names_and_slices_follow_the_covariance() -> None:
    entries = (ENTRY, replace(ENTRY, name="B"))
    sensor = SensorCalibration(CAMERA, entries, np.zeros((25, 25)), PROVENANCE)
    assert len(sensor.parameter_names) == 25
    assert sensor.parameter_names[:2] == ("fx_px", "fy_px")
    own = sensor.parameter_names[sensor.sheet_parameter_slice(1)]
    assert own == tuple(f"B.{name}" for name in SHEET_PARAMETER_NAMES)


def test_what_does_not_fit_together_is_refused() -> None:
    with pytest.raises(InputError, match="at least one"):
        SensorCalibration(CAMERA, (), np.zeros((9, 9)), PROVENANCE)
    with pytest.raises(InputError, match="share a name: A, A"):
        SensorCalibration(CAMERA, (ENTRY, ENTRY), np.zeros((25, 25)), PROVENANCE)
    with pytest.raises(InputError, match=r"\(17, 17\)"):
        SensorCalibration(CAMERA, (ENTRY,), np.zeros((25, 25)), PROVENANCE)
