# SPDX-License-Identifier: Apache-2.0
"""Ring markers on the simulated part: found, matched, and measured against the truth."""

from __future__ import annotations

import numpy as np

from armscan.devices.sources import Twin, load_driver
from armscan.geometry.arrays import FloatArray
from armscan.markers.stereo_matching import match_rings
from armscan.models.camera import CameraModel
from armscan.models.two_views import TwoViews
from armscan.vision.rings import detect_rings

ARM_MM = 0.1
"""Five times the arm's repeatability: where a marker is expected, by the arm's own report."""
ERROR_MM = 0.002
"""A twentieth of a pixel at the working distance."""


def views_of(twin: Twin) -> TwoViews:
    truth = twin.truth
    assert truth.right_camera_parameters is not None
    assert truth.right_from_sensor is not None
    left, right = (
        CameraModel.from_parameters(parameters, 3072, 2048)
        for parameters in (truth.camera_parameters, truth.right_camera_parameters)
    )
    return TwoViews(left, right, truth.right_from_sensor)


def rigid_residuals(points: FloatArray, truth: FloatArray) -> FloatArray:
    """What remains of (N, 3) points after the best rotation and shift onto the truth."""
    a, b = points - points.mean(axis=0), truth - truth.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return np.asarray(b @ turn - a)


def test_markers_of_one_place() -> None:
    twin: Twin = load_driver("twin")(head="thesis-multi", preset="thesis", seed=2)
    scan = twin.scan("markers")
    first = [k for k, row in enumerate(scan.rows) if row.view == scan.rows[0].view]
    rows = [k for k in first if not scan.rows[k].lasers]
    rings = [detect_rings(scan.exposure(row)).rings for row in rows]
    matches = match_rings(rings[0], rings[1], views_of(twin), np.zeros((24, 24)))
    points = matches.markers.points_mm

    assert scan.arm is not None
    nearest = int(np.abs(scan.arm.t_ns - scan.rows[rows[0]].t_ns).argmin())
    base_from_sensor = scan.arm.pose(nearest) @ twin.truth.tool_from_sensor
    expected = points @ base_from_sensor.rotation.T + base_from_sensor.translation_mm
    distance = np.linalg.norm(expected[:, None] - twin.truth.marker_centres_base_mm, axis=2)
    marker = distance.argmin(axis=1)

    # By eye: 14 whole rings left, 13 right, 12 of them the same.
    assert len(points) >= 11
    assert len(np.unique(marker)) == len(marker)
    assert distance.min(axis=1).max() < ARM_MM
    residuals = rigid_residuals(points, twin.truth.marker_centres_base_mm[marker])
    assert np.sqrt(np.mean(residuals**2)) < ERROR_MM
