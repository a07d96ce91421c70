# SPDX-License-Identifier: Apache-2.0
"""The scanner of a twin as it truly is, for tests and benchmarks that need one and judge no error.

Its covariances are those of the thesis's heads, not of a calibration of this twin.
"""

from __future__ import annotations

import numpy as np

from armscan.devices.sources import Twin
from armscan.geometry.arrays import FloatArray
from armscan.models.calibration import (
    CameraCalibration,
    Provenance,
    ScannerCalibration,
    SensorCalibration,
)
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import LightSheet
from armscan.models.two_views import TwoViews
from rigs.plain_scanner import plain_camera, stored_hand_eye, stored_sheet
from rigs.sheet_rig import PROVENANCE
from rigs.stereo_head import DEPTHS_MM, StereoHead

SENSOR_PX = (3072, 2048)


def camera_model(parameters: FloatArray) -> CameraModel:
    """``fx fy cx cy k1 k2 p1 p2 k3`` on the full sensor."""
    fx, fy, cx, cy = map(float, parameters[:4])
    return plain_camera((fx, fy), (cx, cy), SENSOR_PX, parameters[4:])


def fitted(points_mm: FloatArray) -> LightSheet:
    """Plane and bow through points (N, 3) of a sheet."""
    origin = points_mm.mean(axis=0)
    normal = np.linalg.svd(points_mm - origin, full_matrices=False)[2][2]
    along = np.cross(normal, [0.0, 0.0, 1.0])
    along /= np.linalg.norm(along)
    axes = np.stack([along, np.cross(normal, along), normal])
    sheet = LightSheet(origin_mm=origin, axes=axes, scale_mm=30.0, bow_mm=np.zeros(5))
    for _ in range(3):
        height, _, by_parameters = sheet.height_with_jacobian(points_mm)
        sheet = sheet.updated(np.linalg.lstsq(by_parameters, -height, rcond=None)[0])
    return sheet


def true_scanner(twin: Twin) -> ScannerCalibration:
    """Camera or cameras, sheets and hand-eye of a twin."""
    truth = twin.truth
    left = camera_model(truth.camera_parameters)
    sheets = {name: fitted(points) for name, points in truth.sheet_points_mm.items()}
    if truth.right_camera_parameters is None or truth.right_from_sensor is None:
        sensor = _of_one_camera(left, sheets)
    else:
        views = TwoViews(left, camera_model(truth.right_camera_parameters), truth.right_from_sensor)
        head = StereoHead.thesis(len(sheets))
        sensor = StereoHead(
            views, head.lasers, tuple(sheets.values()), head.covariance
        ).calibration()
    hand_eye = stored_hand_eye(truth.tool_from_sensor)
    return ScannerCalibration(sensor=sensor, hand_eye=hand_eye, provenance=PROVENANCE)


def certain_camera(camera: CameraModel, provenance: Provenance | None = None) -> CameraCalibration:
    """A camera that is known for certain over its whole image."""
    return CameraCalibration(
        camera=camera,
        covariance=np.zeros((9, 9)),
        has_covariance=True,
        rms_px=0.1,
        sigma_point_px=0.05,
        n_views=9,
        n_points=99,
        covered_px=np.array([0.0, 0.0, camera.width_px - 1.0, camera.height_px - 1.0]),
        provenance=provenance or PROVENANCE,
    )


def _of_one_camera(camera: CameraModel, sheets: dict[str, LightSheet]) -> SensorCalibration:
    document = certain_camera(camera)
    calibrated = tuple(stored_sheet(name, sheet, DEPTHS_MM) for name, sheet in sheets.items())
    n = 9 + 8 * len(calibrated)
    return SensorCalibration(
        camera=document, sheets=calibrated, covariance=np.zeros((n, n)), provenance=PROVENANCE
    )
