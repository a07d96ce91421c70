# SPDX-License-Identifier: Apache-2.0
"""The sensor's document: order of its covariance, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from armscan.errors import InputError
from armscan.models.calibration import (
    SHEET_PARAMETER_NAMES,
    SensorCalibration,
)
from armscan.models.light_sheet import LightSheet
from rigs.calibration_documents import stereo_sensor_calibration
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


def test_a_step_moves_every_part_in_the_order_of_the_names() -> None:
    """Camera, sheets and right camera by their own names; the pose by a turn from the left."""
    sensor = stereo_sensor_calibration()
    names = sensor.parameter_names
    step = 1e-4 * np.arange(1.0, len(names) + 1.0)
    by_name = dict(zip(names, step, strict=True))
    other = 2.0 * sensor.covariance
    moved = sensor.updated(step, other)
    np.testing.assert_allclose(
        moved.camera.camera.parameters - sensor.camera.camera.parameters, step[:9], atol=1e-12
    )
    assert moved.camera.camera.fy_px - sensor.camera.camera.fy_px == pytest.approx(
        by_name["fy_px"], abs=1e-12
    )
    for before, after in zip(sensor.sheets, moved.sheets, strict=True):
        offset = (after.sheet.origin_mm - before.sheet.origin_mm) @ before.sheet.axes[2]
        assert offset == pytest.approx(by_name[f"{before.name}.offset_mm"], abs=1e-12)
    assert sensor.second is not None and moved.second is not None
    right, turned = sensor.second.right_from_sensor, moved.second.right_from_sensor
    turn = [by_name[f"right.rotation_{axis}_right_rad"] for axis in "xyz"]
    np.testing.assert_allclose(
        turned.rotation, Rotation.from_rotvec(turn).as_matrix() @ right.rotation, atol=1e-12
    )
    shift = [by_name[f"right.translation_{axis}_right_mm"] for axis in "xyz"]
    np.testing.assert_allclose(turned.translation_mm - right.translation_mm, shift, atol=1e-12)
    np.testing.assert_allclose(
        moved.second.camera.camera.parameters - sensor.second.camera.camera.parameters,
        [by_name[f"right.{name}"] for name in names[:9]],
        atol=1e-12,
    )
    np.testing.assert_array_equal(moved.camera.covariance, other[:9, :9])
    np.testing.assert_array_equal(moved.second.camera.covariance, other[-15:-6, -15:-6])
    assert moved.provenance is sensor.provenance
