# SPDX-License-Identifier: Apache-2.0
"""The thesis's multi-line head at feature level: printed cameras and sheets, and a calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Board, CameraRight, Pose, Sensor
from armscan.geometry.rotations import nearest_rotation, rotation_from_vector, skew
from armscan.models.calibration import (
    CameraCalibration,
    SecondCamera,
    SensorCalibration,
    SheetCalibration,
)
from armscan.models.camera import CameraModel
from armscan.models.light_sheet import LightSheet
from armscan.models.two_views import TwoViews
from armscan.simulation.optics.lasers import LineLaser
from rigs.sheet_rig import PROVENANCE

LEFT = CameraModel(
    fx_px=5174.97,
    fy_px=5175.62,
    cx_px=1524.358,
    cy_px=1032.405,
    distortion=np.array([-0.1035, 0.3449, 0.000706, -0.00032, -0.139]),
    width_px=3072,
    height_px=2048,
)
RIGHT = CameraModel(
    fx_px=5163.38,
    fy_px=5162.49,
    cx_px=1563.458,
    cy_px=1039.554,
    distortion=np.array([-0.0895, 0.192148, 0.000079, -0.00015, -0.5824]),
    width_px=3072,
    height_px=2048,
)
RIGHT_FROM_LEFT: Pose[CameraRight, Sensor] = Pose(
    nearest_rotation(
        np.array(
            [
                [0.546702, 0.02539, 0.8369417],
                [-0.03461, 0.99937, -0.007715],
                [-0.83661, -0.0247, 0.547238],
            ]
        )
    ),
    np.array([-117.4319, 2.4648, 63.229]),
)
PRINTED_SHEETS = np.array(
    [
        [0.5465, 0.7106, 0.4431, -43.254],
        [0.5772, 0.7132, 0.3976, -44.228],
        [0.6050, 0.7144, 0.3513, -45.155],
        [0.6316, 0.7138, 0.3025, -45.743],
        [0.6565, 0.7107, 0.2527, -46.175],
    ]
)
SOURCE_MM = np.array([63.0, -0.6, 20.9])
STEP_RAD = np.radians(3.15)
WINDOW_PX = (207, 624, 2658, 800)
DEPTHS_MM = (118.0, 162.0)
DETECTION_PX = 0.02
"""Noise of the target's points in the stereo calibration whose covariance the rig claims."""


def sheet_lasers(n_sheets: int = 11, skew_rad: float = 0.012) -> tuple[LineLaser, ...]:
    """The printed five sheets with as many more on either side, each a shallow cone."""
    normals = PRINTED_SHEETS[:, :3] / np.linalg.norm(PRINTED_SHEETS[:, :3], axis=1)[:, None]
    axis = np.cross(normals[0], normals[4])
    axis /= np.linalg.norm(axis)
    lasers = []
    for k in range(n_sheets):
        j = k - (n_sheets - 1) // 2 + 2
        base = min(max(j, 0), 4)
        turn = rotation_from_vector(axis * STEP_RAD * (j - base))
        normal = turn @ normals[base]
        printed = -PRINTED_SHEETS[base, 3] / np.linalg.norm(PRINTED_SHEETS[base, :3])
        offset = printed if j == base else float(normal @ SOURCE_MM)
        source = SOURCE_MM - (normal @ SOURCE_MM - offset) * normal
        middle = np.array([0.0, 0.0, 140.0])
        aim = middle - (normal @ middle - offset) * normal
        forward = (aim - source) / np.linalg.norm(aim - source)
        across = np.cross(normal, forward)
        back = rotation_from_vector(skew_rad * across)
        name = f"A.{k + 1}"
        lasers.append(
            LineLaser(name, source, back @ forward, across, 0.42, skew_rad, 0.06, 130.0, 4e-4)
        )
    return tuple(lasers)


def fitted_sheet(laser: LineLaser) -> LightSheet:
    """Plane and bow through the true sheet within the working region."""
    fan = np.linspace(-0.35, 0.35, 41)
    along = np.linspace(80.0, 180.0, 21)
    points = (laser.rays(fan)[:, None, :] * along[None, :, None]).reshape(-1, 3) + laser.source_mm
    seen = (np.abs(points[:, 0]) < 36.0) & (np.abs(points[:, 1]) < 25.0)
    points = points[seen & (points[:, 2] > 95.0) & (points[:, 2] < 185.0)]
    middle = np.array([0.0, 0.0, 140.0])
    origin = middle - laser.offset_mm(middle[None])[0] * laser.normal
    e_u = laser.across
    axes = np.stack([e_u, np.cross(laser.normal, e_u), laser.normal])
    sheet = LightSheet(origin_mm=origin, axes=axes, scale_mm=30.0, bow_mm=np.zeros(5))
    for _ in range(3):
        height, _, by_parameters = sheet.height_with_jacobian(points)
        sheet = sheet.updated(np.linalg.lstsq(by_parameters, -height, rcond=None)[0])
    return sheet


BOARD_MM = np.stack([*np.mgrid[-5:6, -4:5].reshape(2, -1) * 3.2, np.zeros(99)], axis=1)
"""Target points in the board's frame."""


def board_poses(n_views: int = 24) -> list[Pose[Sensor, Board]]:
    """Boards over the whole field of both cameras, tilted every way."""
    rng = np.random.default_rng(3)
    poses = []
    for _ in range(n_views):
        turn = np.array([rng.uniform(-0.5, 0.5), rng.uniform(0.0, 1.0), rng.uniform(-0.3, 0.3)])
        place = np.array([rng.uniform(-18, 18), rng.uniform(-9, 9), rng.uniform(120, 160)])
        poses.append(Pose.from_vectors(turn, place))
    return poses


def stereo_covariance() -> FloatArray:
    """(24, 24) of a stereo calibration from these boards, in the order of its names."""
    views = TwoViews(LEFT, RIGHT, RIGHT_FROM_LEFT)
    information = np.zeros((24, 24))
    for pose in board_poses():
        turned = BOARD_MM @ pose.rotation.T
        points = turned + pose.translation_mm
        _, left_by_point, left_by_camera = LEFT.project_with_jacobian(points)
        _, right_by_point, right_by_second = views.project_right_with_jacobian(points)
        n = len(points)
        by_pose = np.concatenate([-skew(turned), np.tile(np.eye(3), (n, 1, 1))], axis=2)
        shared = np.zeros((n, 4, 24))
        shared[:, :2, :9], shared[:, 2:, 9:] = left_by_camera, right_by_second
        own = np.concatenate([left_by_point @ by_pose, right_by_point @ by_pose], axis=1)
        a, b = shared.reshape(-1, 24), own.reshape(-1, 6)
        information += a.T @ a - a.T @ b @ np.linalg.solve(b.T @ b, b.T @ a)
    return np.asarray(DETECTION_PX**2 * np.linalg.inv(information))


def sheet_by_camera(laser: LineLaser, sheet: LightSheet) -> FloatArray:
    """(8, 9) how a sheet that is calibrated through the left camera follows that camera's errors.

    A wrong camera moves every board to where its target still fits the picture, and the laser
    line on it with it: the fitted sheet passes through these moved lines.
    """
    steps = np.array([1.0, 1.0, 1.0, 1.0, 1e-3, 1e-2, 1e-4, 1e-4, 0.1])
    moved_height, by_parameters = [], []
    for pose in board_poses():
        turned = BOARD_MM @ pose.rotation.T
        _, by_point, by_camera = LEFT.project_with_jacobian(turned + pose.translation_mm)
        by_pose = by_point @ np.concatenate(
            [-skew(turned), np.tile(np.eye(3), (len(turned), 1, 1))], axis=2
        )
        follow = -np.linalg.lstsq(by_pose.reshape(-1, 6), by_camera.reshape(-1, 9), rcond=None)[0]
        rays, normal = laser.rays(np.linspace(-0.2, 0.2, 60)), pose.rotation[:, 2]
        reach = (pose.translation_mm - laser.source_mm) @ normal / (rays @ normal)
        line = laser.source_mm + reach[:, None] * rays
        pixels = LEFT.project(line)
        line, pixels = line[LEFT.is_inside(pixels)], pixels[LEFT.is_inside(pixels)]
        shift = np.zeros((len(line), 9))
        _, gradient, by_sheet = sheet.height_with_jacobian(line)
        for j, step in enumerate(steps):
            error = np.zeros(9)
            error[j] = step
            camera = _moved(LEFT, error)
            turn = rotation_from_vector(follow[:3, j] * step)
            place = pose.translation_mm + follow[3:, j] * step
            seen = np.concatenate([camera.undistort(pixels)[0], np.ones((len(pixels), 1))], axis=1)
            facing = turn @ normal
            there = seen * ((place @ facing) / (seen @ facing))[:, None]
            shift[:, j] = np.sum((there - line) * gradient, axis=1) / step
        moved_height.append(shift)
        by_parameters.append(-by_sheet)
    fit = np.linalg.lstsq(np.concatenate(by_parameters), np.concatenate(moved_height), rcond=None)
    return np.asarray(fit[0])


SHEET_SIGMA_MM = np.array([0.004, 0.004, 0.003, 0.003, 0.003, 0.003, 0.002, 0.002])
"""Of tilts, offset and bow, beside what follows from the camera."""


@dataclass(frozen=True)
class StereoHead:
    """What is true: cameras (with the pose between them) and lasers."""

    views: TwoViews
    lasers: tuple[LineLaser, ...]
    sheets: tuple[LightSheet, ...]
    covariance: FloatArray

    @staticmethod
    def thesis(n_sheets: int = 11) -> StereoHead:
        """The printed instrument."""
        lasers = sheet_lasers(n_sheets)
        sheets = tuple(fitted_sheet(laser) for laser in lasers)
        n = 9 + 8 * n_sheets
        free = np.zeros((n + 15, n + 15))
        places = np.concatenate([np.arange(9), np.arange(n, n + 15)])
        free[np.ix_(places, places)] = stereo_covariance()
        follow = np.eye(n + 15)
        for k in range(n_sheets):
            own = slice(9 + 8 * k, 17 + 8 * k)
            free[own, own] = np.diag(SHEET_SIGMA_MM**2)
            follow[own, :9] = sheet_by_camera(lasers[k], sheets[k])
        joint = follow @ free @ follow.T
        return StereoHead(TwoViews(LEFT, RIGHT, RIGHT_FROM_LEFT), lasers, sheets, joint)

    def calibration(self, error: FloatArray | None = None) -> SensorCalibration:
        """The calibration document: the truth moved by ``error`` in its parameters' order."""
        n = len(self.covariance)
        e = np.zeros(n) if error is None else error
        left, right = _moved(self.views.left, e[:9]), _moved(self.views.right, e[n - 15 : n - 6])
        pose = self.views.right_from_left
        moved: Pose[CameraRight, Sensor] = Pose(
            rotation_from_vector(e[n - 6 : n - 3]) @ pose.rotation,
            pose.translation_mm + e[n - 3 :],
        )
        sheets = tuple(
            SheetCalibration(
                name=laser.name,
                sheet=sheet.updated(e[9 + 8 * k : 17 + 8 * k]),
                rms_mm=0.004,
                n_boards=12,
                n_points=6000,
                depth_range_mm=DEPTHS_MM,
                is_redundant=True,
            )
            for k, (laser, sheet) in enumerate(zip(self.lasers, self.sheets, strict=True))
        )
        cov = self.covariance
        second = SecondCamera(
            camera=_document(right, cov[n - 15 : n - 6, n - 15 : n - 6]), right_from_sensor=moved
        )
        return SensorCalibration(
            camera=_document(left, cov[:9, :9]),
            sheets=sheets,
            covariance=cov,
            provenance=PROVENANCE,
            diagnostics=None,
            second=second,
        )

    def drawn_calibration(self, rng: np.random.Generator) -> SensorCalibration:
        """A calibration whose errors follow the covariance that it claims."""
        return self.calibration(
            rng.multivariate_normal(np.zeros(len(self.covariance)), self.covariance)
        )


def _moved(camera: CameraModel, error: FloatArray) -> CameraModel:
    return CameraModel.from_parameters(camera.parameters + error, camera.width_px, camera.height_px)


def _document(camera: CameraModel, covariance: FloatArray) -> CameraCalibration:
    box = np.array([0.0, 0.0, camera.width_px - 1.0, camera.height_px - 1.0])
    return CameraCalibration(
        camera=camera,
        covariance=covariance,
        has_covariance=True,
        rms_px=0.07,
        sigma_point_px=0.05,
        n_views=14,
        n_points=1386,
        covered_px=box,
        provenance=PROVENANCE,
    )
