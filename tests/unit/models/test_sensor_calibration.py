# SPDX-License-Identifier: Apache-2.0
"""The sensor's document: order of its covariance, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from armscan.errors import InputError
from armscan.models.calibration import (
    SHEET_PARAMETER_NAMES,
    SensorCalibration,
)
from armscan.models.light_sheet import LightSheet
from rigs.plain_scanner import stored_sheet
from rigs.sheet_rig import PROVENANCE, thesis_rig

SHEET = LightSheet(
    origin_mm=np.array([0.0, 0.0, 135.0]), axes=np.eye(3), scale_mm=20.0, bow_mm=np.zeros(5)
)
ENTRY = stored_sheet("A", SHEET, (120.0, 150.0))
RIG = thesis_rig()
CAMERA = RIG.calibration(RIG.camera)


def test_names_and_slices_follow_the_covariance() -> None:
    entries = (ENTRY, replace(ENTRY, name="B"))
    sensor = SensorCalibration(
        camera=CAMERA, sheets=entries, covariance=np.zeros((25, 25)), provenance=PROVENANCE
    )
    assert len(sensor.parameter_names) == 25
    assert sensor.parameter_names[:2] == ("fx_px", "fy_px")
    own = sensor.parameter_names[sensor.sheet_parameter_slice(1)]
    assert own == tuple(f"B.{name}" for name in SHEET_PARAMETER_NAMES)


def test_what_does_not_fit_together_is_refused() -> None:
    with pytest.raises(InputError, match="at least one"):
        SensorCalibration(
            camera=CAMERA, sheets=(), covariance=np.zeros((9, 9)), provenance=PROVENANCE
        )
    with pytest.raises(InputError, match="share a name: A, A"):
        SensorCalibration(
            camera=CAMERA,
            sheets=(ENTRY, ENTRY),
            covariance=np.zeros((25, 25)),
            provenance=PROVENANCE,
        )
    with pytest.raises(InputError, match="25 parameters for 17"):
        SensorCalibration(
            camera=CAMERA, sheets=(ENTRY,), covariance=np.zeros((25, 25)), provenance=PROVENANCE
        )
