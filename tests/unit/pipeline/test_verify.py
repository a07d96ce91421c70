# SPDX-License-Identifier: Apache-2.0
"""The daily check: what distances depend on, by differences, and a head that has moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armscan.calibration.hand_eye.observations import PlateReference
from armscan.errors import EstimationError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Points, Pose
from armscan.geometry.shapes import Plane
from armscan.inspection.plane import inspect_plane
from armscan.inspection.results import PlaneInspection
from armscan.models.calibration import ScannerCalibration
from armscan.models.camera import CameraModel
from armscan.pipeline.scan import ScanOptions, ScanReconstruction, measure_scan
from armscan.pipeline.truth import distance_by_calibration, distance_by_plate
from armscan.pipeline.verify import Measured, VerifyOptions, verify_on_plate
from armscan.reconstruction.labels import LabelledProfile
from armscan.reconstruction.place import BaseTransform, merge_clouds, propagate_to_base
from armscan.reconstruction.sync import ExposurePoses
from armscan.reconstruction.triangulate import intersect_sheets, triangulate_stripe
from rigs import placing_rig as rig
from rigs import scan_fake
from rigs.sheet_rig import thesis_rig

PLACES_PX = np.array([[1400.0, 600.0], [700.0, 820.0], [1000.0, 700.0]])
SHEET_OF = np.array([0, 1, 1])
OTHER_POSE = rig.stepped(rig.BASE_FROM_TOOL, np.array([0.3, -0.2, 0.1, 40.0, -20.0, 10.0]))
POSES = (rig.BASE_FROM_TOOL, OTHER_POSE)


def two_exposures(scanner: ScannerCalibration) -> ScanReconstruction:
    placing, profile = BaseTransform.of(scanner), rig.profile_at(PLACES_PX)
    assert scanner.sensor is not None
    stripe = triangulate_stripe(profile, SHEET_OF, scanner.sensor)
    cloud = merge_clouds([propagate_to_base(stripe, profile, pose, placing) for pose in POSES])
    image = LabelledProfile(
        profile=profile, sheet=SHEET_OF, status=np.zeros(3, dtype=np.int64), reason=""
    )
    poses = ExposurePoses(
        rotations=np.stack([pose.rotation for pose in POSES]),
        translations_mm=np.stack([pose.translation_mm for pose in POSES]),
        status=np.zeros(2, dtype=np.int64),
        sample=np.arange(2),
        source="time",
        max_gap_ns=0,
    )
    return ScanReconstruction(cloud, (image, image), (0, 1), (), poses)


def points_base_mm(sensor_step: FloatArray, hand_eye_step: FloatArray) -> FloatArray:
    """(6, 3) where the points of both exposures would lie with other parameters."""
    camera = CameraModel.from_parameters(
        thesis_rig().camera.parameters + sensor_step[:9], 2048, 1536
    )
    pair = rig.sheets()
    moved = (pair[0].updated(sensor_step[9:17]), pair[1].updated(sensor_step[17:]))
    points, _ = intersect_sheets(PLACES_PX, SHEET_OF, rig.sensor_of(camera, moved))
    hand_eye = rig.stepped(rig.TOOL_FROM_SENSOR, hand_eye_step)
    return np.concatenate([(pose @ (hand_eye @ Points(points))).xyz_mm for pose in POSES])


def test_distances_depend_on_the_calibration_as_differences_say() -> None:
    scanner = rig.scanner()
    assert scanner.sensor is not None
    directions = np.random.default_rng(3).normal(size=(6, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    found = distance_by_calibration(two_exposures(scanner), scanner, directions)
    steps = np.concatenate([1e-3 * np.sqrt(np.diag(scanner.sensor.covariance)), np.full(6, 1e-5)])
    for k, size in enumerate(steps):
        step = size * np.eye(31)[k]
        up = points_base_mm(step[:25], step[25:])
        down = points_base_mm(-step[:25], -step[25:])
        difference = np.einsum("ni,ni->n", directions, up - down) / (2.0 * size)
        np.testing.assert_allclose(
            found[:, k], difference, atol=1e-5 * (1.0 + np.abs(difference).max())
        )


def test_points_that_are_missing_are_noticed() -> None:
    scanner = rig.scanner()
    scan = two_exposures(scanner)
    other = np.full(3, 1, dtype=np.int64)
    cut = replace(scan, images=(replace(scan.images[0], status=other), scan.images[1]))
    with pytest.raises(EstimationError, match="cut off"):
        distance_by_calibration(cut, scanner, np.ones((6, 3)))


SIGMA = np.array([2e-4, 2e-4, 2e-4, 0.015, 0.015, 0.015])
PLATE = PlateReference(
    plane=Plane(np.zeros(3), np.eye(3)),
    covariance=np.diag([1e-5, 1e-5, 0.002]) ** 2,
    rms_mm=0.003,
    n_points=12,
)


def test_distances_depend_on_the_plate_as_touches_and_tip_err() -> None:
    points = np.array([[0.0, 0.0, 0.0], [80.0, -60.0, 0.3]])
    found = distance_by_plate(PLATE, points)
    of_touches = 0.002**2 + 1e-10 * np.array([0.0, 80.0**2 + 60.0**2])
    np.testing.assert_allclose((found**2).sum(axis=1), of_touches + 0.16 * 12.0 * 0.002**2)
    exact = replace(PLATE, covariance=np.zeros((3, 3)), n_points=0)
    assert not distance_by_plate(exact, points).any()
    unknown = PlateReference(plane=PLATE.plane)
    assert distance_by_plate(unknown, points).shape == (2, 0)


def scanner_with(shift_mm: FloatArray) -> ScannerCalibration:
    """The fake's scanner with a hand-eye that is wrong by a shift in Tool."""
    true = scan_fake.scanner()
    pose = true.hand_eye.tool_from_sensor
    moved = Pose(pose.rotation, pose.translation_mm + shift_mm)
    hand_eye = replace(true.hand_eye, tool_from_sensor=moved, covariance=np.diag(SIGMA**2))
    return replace(true, hand_eye=hand_eye)


@pytest.mark.parametrize(
    ("shift_mm", "verdict"), [((0.0, 0.0, 0.0), "still valid"), ((0.0, 0.0, 0.3), "not valid")]
)
def test_a_head_that_has_moved_on_a_plate(
    shift_mm: tuple[float, float, float], verdict: str
) -> None:
    scanner = scanner_with(np.array(shift_mm))
    source = scan_fake.as_source(scan_fake.fake_scan(12, 2.0))
    scan = measure_scan(source, scanner, ScanOptions(has_normals=False))
    found = verify_on_plate(Measured(scan.cloud, scan, scanner), PLATE)
    assert found.verdict == verdict
    place, correction, *_ = found.checks
    down = scan_fake.looking_down(0.0).rotation[2]
    assert place.error == pytest.approx(float(down @ shift_mm), abs=0.03)
    # looking straight down, a shift along the normal is the hand-eye's own sigma along it
    assert place.predicted == pytest.approx(0.015, rel=0.6)
    assert correction.unit == "sigma"
    # the page's offset holds what the plate errs there, as the check's U does beside the scatter
    told, bare = found.found, inspect_plane(scan.cloud, PLATE.plane)
    assert isinstance(told, PlaneInspection)
    assert isinstance(bare, PlaneInspection)
    assert told.offset is not None
    assert bare.offset is not None
    # of touches 0.002 mm there, of the tip 0.4 of what one of the twelve scatters by
    by_tip = 0.4 * np.sqrt(12.0) * 0.002
    assert told.reference_sigma_mm == pytest.approx(np.hypot(0.002, by_tip), rel=0.05)
    both = np.hypot(bare.offset.sigma_mm, told.reference_sigma_mm)
    assert told.offset.sigma_mm == pytest.approx(both)
    assert place.uncertainty == pytest.approx(
        2.0 * np.hypot(bare.offset.sigma_scatter_mm, told.reference_sigma_mm)
    )
    given = verify_on_plate(Measured(scan.cloud), PLATE, VerifyOptions(mpe_mm=1.0))
    assert given.checks[0].verdict == "still valid"
    assert any("independent between blocks of exposures" in text for text in given.warnings)
