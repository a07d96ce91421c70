# SPDX-License-Identifier: Apache-2.0
"""The arm's chain against the twin's screws, and its plate probed, touch by touch, with its tip."""

from __future__ import annotations

import numpy as np
import pytest

from armscan.calibration.hand_eye.probed_plate import ProbedPlate, fit_probed_plate
from armscan.devices.sources import Twin, load_driver
from armscan.models.arm import (
    forward,
    quarter_turn_flange,
    thesis_arm,
    tip_centres,
    tool_from_probe,
)
from armscan.records.points import ProbedPoints

D_MM, L_MM = (300.0, 600.0, 500.0, 200.0), (40.0, 40.0, 40.0)
ARM_ALONG_NORMAL_MM = 0.0053
"""What the arm of 0.02 mm repeatability errs along a plate's normal, one standard deviation."""
PLATE_HALF_MM = 60.0


@pytest.fixture(scope="module", params=[1, 2, 3])
def twin(request: pytest.FixtureRequest) -> Twin:
    found: Twin = load_driver("twin")(seed=request.param)
    return found


def test_the_chain_agrees_with_screws(twin: Twin) -> None:
    """The twin's controller reports nominal poses of its joints, worked out in another way."""
    track = twin.probe_plate().arm
    assert track.joints_rad is not None
    arm = thesis_arm(D_MM, L_MM, flange=quarter_turn_flange())
    rotations, translations = forward(arm, track.joints_rad)
    np.testing.assert_allclose(translations, track.translations_mm, atol=1e-9)
    np.testing.assert_allclose(rotations, track.rotations, atol=1e-12)


def test_the_probed_plate_is_the_true_one(twin: Twin) -> None:
    """Within the arm's own error, common to all touches, and the scatter of the touches.

    A tip that is not compensated, or to the wrong side, errs by 3 or 6 mm.
    """
    probing = twin.probe_plate()
    centres = tip_centres(probing.arm, tool_from_probe(probing.tool_from_probe_mm))
    plate = fit_probed_plate(
        ProbedPoints(points_mm=centres, tip_diameter_mm=probing.tip_diameter_mm),
        probing.arm.translations_mm,
    )
    assert isinstance(plate, ProbedPlate)
    found, truth = plate.reference.plane, twin.truth.plate_plane
    assert found.normal @ truth[:3] > 0.0
    assert abs(truth[:3] @ found.point_mm + truth[3]) < 4.0 * ARM_ALONG_NORMAL_MM
    tilt = float(np.linalg.norm(np.cross(found.normal, truth[:3])))
    assert tilt < 4.0 * ARM_ALONG_NORMAL_MM / PLATE_HALF_MM
    assert plate.outliers == ()
