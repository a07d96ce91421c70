# SPDX-License-Identifier: Apache-2.0
"""Boards, stripes and a camera at feature level, with optics of their own (OpenCV's)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from armscan.calibration.cameras.start import estimate_board_pose
from armscan.calibration.sheets.result import BoardStripes
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.models.calibration import CameraCalibration, Provenance
from armscan.models.camera import CameraModel
from armscan.records.profile import Profile
from armscan.vision.targets.target import TargetView
from rigs.plain_scanner import plain_camera

THESIS_PLANE = np.array([-0.0042275, 0.73558, -0.67742, 91.78])
"""The thesis's printed single-line sheet, camera frame, mm."""

CAMERA_SIGMA = np.array([0.6, 0.6, 0.8, 0.8, 1e-3, 4e-3, 5e-5, 5e-5, 5e-3])
PROVENANCE = Provenance(
    document_id="test",
    created_utc="2026-01-01T00:00:00Z",
    armscan_version="0",
    command=("test",),
    inputs=(),
)


@dataclass(frozen=True)
class SheetTruth:
    """A sheet: plane ``a b c D`` and a bow ``bow(u, v)`` in mm over ``reach_mm``."""

    plane: FloatArray
    bow_uu_mm: float = 0.0
    bow_uv_mm: float = 0.0
    centre_mm: tuple[float, float, float] = (0.0, 0.0, 135.5)
    reach_mm: float = 20.0

    def height_mm(self, points: FloatArray) -> FloatArray:
        """Distance of points (N, 3) from the sheet along its normal."""
        normal = self.plane[:3] / np.linalg.norm(self.plane[:3])
        flat = (points @ self.plane[:3] + self.plane[3]) / np.linalg.norm(self.plane[:3])
        along = np.cross(normal, [0.0, 0.0, 1.0])
        along = along / np.linalg.norm(along)
        u = (points - self.centre_mm) @ along / self.reach_mm
        v = (points - self.centre_mm) @ np.cross(normal, along) / self.reach_mm
        return np.asarray(flat - self.bow_uu_mm * u * u - self.bow_uv_mm * u * v)


@dataclass(frozen=True)
class SheetRig:
    """What is true, and how noisy the features are."""

    sheets: tuple[SheetTruth, ...]
    poses: tuple[Pose[Sensor, Board], ...]
    camera: CameraModel
    camera_covariance: FloatArray
    sigma_stripe_px: float = 0.06
    sigma_corner_px: float = 0.05
    columns: int = 9
    rows: int = 7
    pitch_mm: float = 4.0
    points_per_stripe: int = 120
    correlated_points: int = 1

    def calibration(self, camera: CameraModel) -> CameraCalibration:
        """A camera calibration that claims the rig's covariance."""
        box = np.array([0.0, 0.0, camera.width_px - 1.0, camera.height_px - 1.0])
        return CameraCalibration(
            camera=camera,
            covariance=self.camera_covariance,
            has_covariance=True,
            rms_px=0.07,
            sigma_point_px=0.05,
            n_views=20,
            n_points=1260,
            covered_px=box,
            provenance=PROVENANCE,
        )

    def noisy_camera(self, rng: np.random.Generator) -> CameraModel:
        """A camera as a calibration with the rig's covariance would return it."""
        error = rng.multivariate_normal(np.zeros(9), self.camera_covariance)
        return CameraModel.from_parameters(
            self.camera.parameters + error, self.camera.width_px, self.camera.height_px
        )

    def board_points_mm(self) -> FloatArray:
        """(M, 3) target points in the Board frame."""
        j, i = np.mgrid[: self.rows, : self.columns]
        return np.stack([i, j, 0.0 * i], axis=-1).reshape(-1, 3) * self.pitch_mm

    def view(self, index: int, rng: np.random.Generator) -> TargetView:
        """The target of placement ``index``, as a detector would find it."""
        board = self.board_points_mm()
        q = project(self.camera, self.poses[index], board)
        q = q + rng.normal(0.0, self.sigma_corner_px, q.shape)
        covariance = np.tile(self.sigma_corner_px**2 * np.eye(2), (len(q), 1, 1))
        return TargetView(
            source=f"board-{index}.png",
            width_px=self.camera.width_px,
            height_px=self.camera.height_px,
            point_index=np.arange(len(q)),
            points_px=q,
            covariance_px2=covariance,
            points_board_mm=board,
        )

    def stripe(
        self, index: int, sheet: SheetTruth, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Stripe centres (N, 2) and normals (N, 2) in pixels on placement ``index``."""
        on_board = stripe_on_board(self.poses[index], sheet, self.board_points_mm(), 400)
        step = np.linspace(0, len(on_board) - 1, self.points_per_stripe).astype(int)
        q = project(self.camera, self.poses[index], on_board)
        tangent = np.gradient(q, axis=0)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True))[step]
        k = self.correlated_points
        white = rng.normal(0.0, self.sigma_stripe_px, len(step) + k - 1)
        noise = np.convolve(white, np.full(k, 1.0 / np.sqrt(k)), "valid")
        return q[step] + noise[:, None] * normal, normal

    def boards(
        self,
        camera: CameraModel,
        rng: np.random.Generator,
        *,
        order: Sequence[Sequence[int]] | None = None,
        lasers: Sequence[tuple[str, ...]] | None = None,
    ) -> list[BoardStripes]:
        """Input of the calibration: every placement with all sheets, or those of ``order``."""
        found = []
        for i in range(len(self.poses)):
            view = self.view(i, rng)
            pose = estimate_board_pose(view, camera)
            assert pose, pose
            which = range(len(self.sheets)) if order is None else order[i]
            stripes = [self.stripe(i, self.sheets[k], rng) for k in which]
            profile = make_profile(f"laser-{i}.png", stripes, self.sigma_stripe_px)
            found.append(BoardStripes(profile, view, pose, lasers[i] if lasers else ()))
        return found


def make_profile(
    source: str, stripes: Sequence[tuple[FloatArray, FloatArray]], sigma_px: float
) -> Profile:
    """A profile whose segments are the stripes given as (points, normals)."""
    points = np.concatenate([q for q, _ in stripes])
    n = len(points)
    return Profile(
        source=source,
        points_px=points,
        normals_px=np.concatenate([normal for _, normal in stripes]),
        sigma_px=np.full(n, sigma_px),
        width_px=np.full(n, 3.0),
        intensity=np.full(n, 150.0),
        flags=np.zeros(n, dtype=np.int64),
        segment=np.concatenate([np.full(len(q), k) for k, (q, _) in enumerate(stripes)]),
    )


def project(
    camera: CameraModel, sensor_from_board: Pose[Sensor, Board], board_mm: FloatArray
) -> FloatArray:
    """(N, 2) pixels of board points, by OpenCV."""
    q, _ = cv2.projectPoints(
        board_mm,
        cv2.Rodrigues(sensor_from_board.rotation.copy())[0],
        sensor_from_board.translation_mm.copy(),
        camera.matrix,
        camera.distortion.copy(),
    )
    return np.asarray(q, dtype=np.float64).reshape(-1, 2)


def stripe_on_board(
    pose: Pose[Sensor, Board], sheet: SheetTruth, board_mm: FloatArray, n: int
) -> FloatArray:
    """(K, 3) board points that lie on the sheet, within the target, evenly spaced."""
    normal = sheet.plane[:3] @ pose.rotation
    along = 0 if abs(normal[0]) < abs(normal[1]) else 1
    low, high = board_mm.min(axis=0), board_mm.max(axis=0)
    points = np.zeros((n, 3))
    points[:, along] = np.linspace(low[along], high[along], n)
    for _ in range(20):
        height = sheet.height_mm(points @ pose.rotation.T + pose.translation_mm)
        moved = points.copy()
        moved[:, 1 - along] += 1e-4
        slope = (sheet.height_mm(moved @ pose.rotation.T + pose.translation_mm) - height) / 1e-4
        points[:, 1 - along] -= height / slope
    inside = (points >= low - 1e-9).all(axis=1) & (points <= high + 1e-9).all(axis=1)
    return points[inside]


def placed(
    tilt_x_deg: float, tilt_y_deg: float, depth_mm: float, centre_mm: tuple[float, float]
) -> Pose[Sensor, Board]:
    """A board whose middle lies on the optical axis at a depth, tilted about x and y."""
    turn = np.radians([tilt_x_deg, tilt_y_deg, 0.0])
    rotation = Pose.from_vectors(turn, np.zeros(3)).rotation
    middle = np.array([*centre_mm, 0.0])
    return Pose(rotation, np.array([0.0, 0.0, depth_mm]) - rotation @ middle)


def thesis_rig(bow_uu_mm: float = 0.0, bow_uv_mm: float = 0.0) -> SheetRig:
    """Six tilted boards in the thesis's printed sheet, a camera of its working distance."""
    camera = plain_camera(
        (2600.0, 2602.0), (1010.0, 745.0), (2048, 1536), [-0.12, 0.08, 4e-4, -3e-4, 0.02]
    )
    tilts = (
        (0, 0, 134),
        (25, 5, 137),
        (-20, 15, 140),
        (15, -25, 131),
        (-25, -15, 128),
        (8, 28, 143),
    )
    poses = tuple(placed(a, b, z, (16.0, 12.0)) for a, b, z in tilts)
    sheet = SheetTruth(THESIS_PLANE, bow_uu_mm, bow_uv_mm)
    return SheetRig((sheet,), poses, camera, np.diag(CAMERA_SIGMA**2))


def exact(rig: SheetRig) -> SheetRig:
    """The same rig with features that are all but free of noise."""
    return replace(
        rig, sigma_stripe_px=1e-6, sigma_corner_px=1e-6, camera_covariance=1e-18 * np.eye(9)
    )
