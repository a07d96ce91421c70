# SPDX-License-Identifier: Apache-2.0
"""A scanner with two sheets whose every number errs and whose hand-eye follows the sensor."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.geometry.rotations import rotation_from_vector
from armscan.models.calibration import (
    ArmNoise,
    CameraCalibration,
    HandEyeCalibration,
    ScannerCalibration,
    SensorCalibration,
    SheetCalibration,
)
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import LightSheet
from armscan.records.profile import Profile
from rigs.sheet_rig import CAMERA_SIGMA, PROVENANCE, THESIS_PLANE, make_profile, thesis_rig

TOOL_FROM_SENSOR: Pose[Tool, Sensor] = Pose.from_vectors([0.4, -0.9, -1.9], [41.4, 21.5, 112.3])
BASE_FROM_TOOL: Pose[Base, Tool] = Pose.from_vectors([1.1, 0.3, -0.6], [420.0, -310.0, 250.0])
ARM_NOISE = ArmNoise(
    position_mm=0.006,
    rotation_rad=2e-5,
    exposure_position_mm=0.004,
    exposure_rotation_rad=1e-5,
    tool_rotation_rad=1.5e-5,
    exposure_tool_rotation_rad=1e-5,
)
HAND_EYE_SIGMA = np.array([3e-4, 1.5e-4, 2.5e-4, 0.015, 0.024, 0.02])
SHEET_SIGMA_MM = np.array([0.02, 0.03, 0.01, 0.004, 0.003, 0.004, 0.002, 0.002])
SIGMA_PX = 0.1


def correlated(sigma: FloatArray, seed: int) -> FloatArray:
    """A covariance of these standard deviations, strongly correlated."""
    n = len(sigma)
    mixing = np.linalg.qr(np.random.default_rng(seed).normal(size=(n, n)))[0]
    spread = mixing @ np.diag(np.linspace(0.05, 1.95, n)) @ mixing.T
    scale = np.sqrt(np.diag(spread))
    return np.asarray(spread / np.outer(scale, scale) * np.outer(sigma, sigma))


def sheets() -> tuple[LightSheet, LightSheet]:
    """The printed sheet and a tilted copy."""
    normal = THESIS_PLANE[:3] / np.linalg.norm(THESIS_PLANE[:3])
    e_u = np.cross(normal, [0.0, 0.0, 1.0])
    e_u /= np.linalg.norm(e_u)
    axes = np.stack([e_u, np.cross(normal, e_u), normal])
    first = LightSheet(
        origin_mm=np.array([0.0, 0.0, 135.5]),
        axes=axes,
        scale_mm=20.0,
        bow_mm=np.array([0.02, 0, 0, 0, 0.01]),
    )
    return first, first.updated(np.array([1.0, -2.0, 3.0, 0, 0, 0, 0, 0]))


def sensor_of(camera: CameraModel, pair: tuple[LightSheet, LightSheet]) -> SensorCalibration:
    """Camera and sheets with their joint covariance."""
    joint = correlated(np.concatenate([CAMERA_SIGMA, SHEET_SIGMA_MM, 2.0 * SHEET_SIGMA_MM]), 8)
    box = np.array([0.0, 0.0, camera.width_px - 1.0, camera.height_px - 1.0])
    calibrated = CameraCalibration(
        camera=camera,
        covariance=joint[:9, :9],
        has_covariance=True,
        rms_px=0.1,
        sigma_point_px=0.05,
        n_views=9,
        n_points=99,
        covered_px=box,
        provenance=PROVENANCE,
    )
    entries = tuple(
        SheetCalibration(
            name=name,
            sheet=sheet,
            rms_mm=0.01,
            n_boards=6,
            n_points=600,
            depth_range_mm=(110.0, 165.0),
            is_redundant=True,
            shape_mm=0.0,
        )
        for name, sheet in zip("AB", pair, strict=True)
    )
    return SensorCalibration(
        camera=calibrated, sheets=entries, covariance=joint, provenance=PROVENANCE
    )


def coupling() -> FloatArray:
    """(6, 25) how the hand-eye follows the sensor: as large as the hand-eye's own errors."""
    by_sigma = np.random.default_rng(9).normal(size=(6, 25))
    sensor_sigma = np.concatenate([CAMERA_SIGMA, SHEET_SIGMA_MM, 2.0 * SHEET_SIGMA_MM])
    return np.asarray(0.3 * by_sigma * HAND_EYE_SIGMA[:, None] / sensor_sigma)


def scanner() -> ScannerCalibration:
    """The scanner as its document would say it."""
    return ScannerCalibration(
        sensor=sensor_of(thesis_rig().camera, sheets()),
        hand_eye=HandEyeCalibration(
            tool_from_sensor=TOOL_FROM_SENSOR,
            covariance=correlated(HAND_EYE_SIGMA, 11),
            dhand_eye_dsensor=coupling(),
            arm_noise=ARM_NOISE,
            rms_mm=0.007,
            n_postures=12,
            n_exposures=12,
            n_points=8000,
        ),
        provenance=PROVENANCE,
    )


def profile_at(points_px: FloatArray) -> Profile:
    """Stripe points whose normals are (0.6, 0.8)."""
    normals = np.tile([0.6, 0.8], (len(points_px), 1))
    return make_profile("stripe.png", [(points_px, normals)], SIGMA_PX)


def stepped(pose: Pose, step: FloatArray) -> Pose:
    """``R <- exp(dr) R``, ``t <- t + dt`` for a (6,) step."""
    return Pose(rotation_from_vector(step[:3]) @ pose.rotation, pose.translation_mm + step[3:])
