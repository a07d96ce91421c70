# SPDX-License-Identifier: Apache-2.0
"""Calibrations of made-up numbers, whose documents are the golden files."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from armscan.geometry.poses import CameraRight, Pose, Sensor, Tool
from armscan.geometry.shapes import Plane
from armscan.models.calibration import (
    ArmNoise,
    CameraCalibration,
    CameraDiagnostics,
    FTest,
    HandEyeCalibration,
    HandEyeDiagnostics,
    InputFile,
    Provenance,
    ScannerCalibration,
    SecondCamera,
    SensorCalibration,
    SensorDiagnostics,
    SheetCalibration,
    SheetDiagnostics,
    WarpedBoard,
)
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import LightSheet


def covariance(size: int, seed: int) -> np.ndarray:
    """Without linear algebra libraries, whose last bits differ between machines."""
    values = 1.0 / np.arange(seed + 2, seed + 2 + size)
    return np.multiply.outer(values, values) / 7 + np.diag(values / 1e6)


def provenance() -> Provenance:
    return Provenance(
        document_id="3f0c1a9e-0000-4000-8000-000000000001",
        created_utc="2026-01-02T03:04:05+00:00",
        armscan_version="0.1.0",
        command=("armscan", "calibrate", "camera", "größe *.png"),
        inputs=(InputFile("photos/größe 1.png", "00" * 32),),
        parent_ids=("parent",),
        options=(("CameraOptions.solve_warp", "False"),),
        warnings=("only three views",),
    )


def camera_calibration() -> CameraCalibration:
    distortion = np.array([0.1, -0.2, 1e-17, 3e-4, 1 / 3])
    camera = CameraModel(
        fx_px=1431.1 / 3,
        fy_px=1430.9 / 7,
        cx_px=479.0 + 1e-13,
        cy_px=639.0 / 1.1,
        distortion=distortion,
        width_px=960,
        height_px=1280,
    )
    return CameraCalibration(
        camera=camera,
        covariance=covariance(9, 1),
        has_covariance=True,
        rms_px=0.1 + 0.2,
        sigma_point_px=1 / 7,
        n_views=16,
        n_points=1056,
        covered_px=np.array([10.1, 20.2, 900.3, 1200.4]),
        provenance=provenance(),
        diagnostics=CameraDiagnostics(
            free_parameters=("fx_px", "k1"),
            model_reason="k2 does not pay",
            hold_out_rms_px=0.1 + 0.3,
            n_folds=8,
            condition=1e3 / 7,
            noise_scale=1.1,
            covered_fraction=2 / 3,
            board=WarpedBoard(
                (0.1 / 3, -0.2),
                (1e-3, 2e-3),
                FTest(f_ratio=17.3, degrees_of_freedom=2, p_value=1e-8 / 3),
            ),
        ),
    )


def sensor_calibration() -> SensorCalibration:
    axes = np.array([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 3
    sheets = tuple(
        SheetCalibration(
            name=name,
            sheet=LightSheet(
                origin_mm=np.array([1.0, 2.0, 300.0]) / 7,
                axes=axes,
                scale_mm=41.3 / 3,
                bow_mm=np.arange(5) / 70,
            ),
            rms_mm=0.03,
            n_boards=3,
            n_points=900,
            depth_range_mm=(212.0 / 3, 290.0 / 3),
            is_redundant=True,
            diagnostics=SheetDiagnostics(
                rms_px=0.1 / 3,
                plane_test=FTest(f_ratio=9.1, degrees_of_freedom=14, p_value=1e-9),
                final_test=FTest(f_ratio=1.1, degrees_of_freedom=12, p_value=1 / 3),
                bow_decision="it pays",
                coplanarity_mm=0.01,
                coplanarity_sigma_mm=0.02,
                board_angle_deg=37.5,
            ),
        )
        for name in ("A", "B")
    )
    return SensorCalibration(
        camera=camera_calibration(),
        sheets=sheets,
        covariance=covariance(25, 2),
        provenance=provenance(),
        diagnostics=SensorDiagnostics(
            noise_factor=1.2, correlation_points=3.4, naming="one sheet in each image"
        ),
    )


def stereo_sensor_calibration() -> SensorCalibration:
    """The same sensor with a right camera."""
    first = sensor_calibration()
    axes = np.array([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 3
    pose: Pose[CameraRight, Sensor] = Pose(axes, np.array([-117.4, 1 / 3, 63.2]))
    second = SecondCamera(
        camera=replace(camera_calibration(), rms_px=1 / 9), right_from_sensor=pose
    )
    return replace(first, second=second, covariance=covariance(40, 5))


def scanner_calibration(*, has_sensor: bool = True) -> ScannerCalibration:
    axes = np.array([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 3
    pose: Pose[Tool, Sensor] = Pose(axes.T, np.array([-149.94, 714.56, 1 / 3]))
    hand_eye = HandEyeCalibration(
        tool_from_sensor=pose,
        covariance=covariance(6, 3),
        dhand_eye_dsensor=np.arange(150).reshape(6, 25) / 7 if has_sensor else None,
        arm_noise=ArmNoise(
            position_mm=0.02 / 3,
            rotation_rad=1e-5 / 7,
            exposure_position_mm=0.001,
            exposure_rotation_rad=0.0,
        ),
        rms_mm=0.1 / 3,
        n_postures=12,
        n_exposures=36,
        n_points=9000,
        plate=Plane(np.array([1.0, 2.0, 300.0]) / 7, axes),
        diagnostics=HandEyeDiagnostics(
            method="plate" if has_sensor else "sphere",
            rank=6,
            condition=1e3 / 7,
            weakest="along the laser line",
            plate_flatness_mm=0.01 / 3,
            flatness_length_mm=math.nan,
            is_noise_estimated=True,
            left_out_rotation_deg=0.1 / 7,
            left_out_translation_mm=0.2 / 7,
            chi2_probability=1 / 3,
        ),
    )
    sensor = sensor_calibration() if has_sensor else None
    return ScannerCalibration(
        sensor=sensor, hand_eye=hand_eye, provenance=provenance(), latency_ns=-(10**12 - 1)
    )


def assert_same(left: Any, right: Any) -> None:
    """Compare dataclasses of arrays exactly, bit for bit."""
    assert type(left) is type(right)
    if is_dataclass(left):
        for item in fields(left):
            assert_same(getattr(left, item.name), getattr(right, item.name))
    elif isinstance(left, tuple):
        assert len(left) == len(right)
        for a, b in zip(left, right, strict=True):
            assert_same(a, b)
    elif isinstance(left, float) and math.isnan(left):
        assert math.isnan(right)
    else:
        np.testing.assert_array_equal(left, right)
