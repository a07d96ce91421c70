# SPDX-License-Identifier: Apache-2.0
"""Errors against the truth, by hand; views of a scan that stay together."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from armscan.errors import EstimationError, OptionError
from armscan.geometry.poses import Pose
from armscan.geometry.rotations import rotation_from_vector
from armscan.models.calibration import ArmNoise, ScannerCalibration
from armscan.pipeline.simulate import fewer_views
from armscan.pipeline.truth import distance_by_arm, hand_eye_errors, true_names
from armscan.reconstruction.place import arm_covariance
from armscan.records.exposure import Exposure
from armscan.records.recording import ArmTrack, ExposureRow, Session
from rigs.hand_eye_fake import TOOL_FROM_SENSOR, fake_fit
from rigs.inspection_clouds import cloud_of
from rigs.scan_fake import scanner as one_sheet_scanner
from rigs.sheet_rig import PROVENANCE


def test_hand_eye_errors_are_in_the_form_of_its_covariance() -> None:
    # one sigma of a rotation about Tool's x, and two of a shift along z: length sqrt(1 + 4)
    hand_eye = fake_fit()[0].calibration
    sigma = np.sqrt(np.diag(hand_eye.covariance))
    turned = rotation_from_vector(np.array([sigma[0], 0.0, 0.0])) @ TOOL_FROM_SENSOR.rotation
    moved = TOOL_FROM_SENSOR.translation_mm + np.array([0.0, 0.0, 2.0 * sigma[5]])
    found = replace(hand_eye, tool_from_sensor=Pose(turned, moved))
    scanner = ScannerCalibration(sensor=None, hand_eye=found, provenance=PROVENANCE)
    errors = hand_eye_errors(scanner, TOOL_FROM_SENSOR)
    assert errors.rotation_deg == pytest.approx(np.degrees(sigma[0]), rel=1e-6)
    assert errors.translation_mm == pytest.approx(2.0 * sigma[5])
    assert errors.normalised == pytest.approx(np.sqrt(5.0), rel=1e-6)


def test_distances_follow_the_arm_as_placed_points_do() -> None:
    """Of one exposure about its middle: their variance is that of the covariance in Base."""
    rng = np.random.default_rng(4)
    points, tool = rng.uniform(-30.0, 30.0, (40, 3)), np.array([50.0, -90.0, 210.0])
    directions = rng.normal(size=points.shape)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    noise = ArmNoise(
        0.01, 2e-4, 0.004, 1e-4, tool_rotation_rad=3e-4, exposure_tool_rotation_rad=1e-4
    )
    tools = np.broadcast_to(tool, points.shape)
    effect = distance_by_arm(cloud_of(points), np.arange(40), directions, tools, noise)
    covariance = arm_covariance(points, points.mean(axis=0), tool, noise)
    expected = np.einsum("ni,nij,nj->n", directions, covariance, directions)
    np.testing.assert_allclose((effect**2).sum(axis=1), expected, rtol=1e-12)


@dataclass
class Rows:
    rows: tuple[ExposureRow, ...]
    name: str = "scan"
    session: Session = field(default_factory=Session)
    arm: ArmTrack | None = None
    is_simulated: bool = False

    def exposure(self, row: int) -> Exposure:
        return Exposure(np.zeros((2, 2), np.uint8), self.rows[row].source)


def scan_of(views: list[str | None]) -> Rows:
    return Rows(
        tuple(
            ExposureRow(index=k, t_ns=k, camera=0, source=f"{k}.png", view=v)
            for k, v in enumerate(views)
        )
    )


def test_exposures_of_a_view_stay_together_and_the_ends_are_kept() -> None:
    few = fewer_views(scan_of(["a", "a", "b", "b", "c", "c", "d", "d", "e", "e"]), 3)
    assert [row.view for row in few.rows] == ["a", "a", "c", "c", "e", "e"]
    assert [few.exposure(k).source for k in range(6)] == [row.source for row in few.rows]


def test_exposures_without_view_are_views_of_their_own() -> None:
    few = fewer_views(scan_of([None] * 7), 4)
    assert [row.index for row in few.rows] == [0, 2, 4, 6]
    assert len(fewer_views(scan_of([None] * 3), 9).rows) == 3


def test_no_view_at_all_is_refused() -> None:
    with pytest.raises(OptionError, match="keep at least one"):
        fewer_views(scan_of([None]), 0)


def test_a_sheet_without_true_points_at_its_depths_is_told() -> None:
    sensor = one_sheet_scanner().sensor
    assert sensor is not None
    far = {"A": np.array([[0.0, 0.0, 500.0]])}
    with pytest.raises(EstimationError, match=r"sheet A was calibrated from 115\.0 to 160\.0 mm"):
        true_names(sensor, far)
    near = {"A": np.array([[0.0, 0.0, 140.0]])}
    assert true_names(sensor, {**far, **near}) == {"A": "A"}
