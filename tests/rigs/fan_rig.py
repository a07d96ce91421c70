# SPDX-License-Identifier: Apache-2.0
"""The thesis's multi-line head before its target, at feature level: bowed sheets, two cameras.

The light is the simulator's (`armscan.simulation.optics.lasers`), the projection OpenCV's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armscan.calibration.cameras.start import estimate_board_pose
from armscan.calibration.sheets.board_points import HeadCameras, place_board
from armscan.calibration.sheets.result import BoardStripes
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Board, CameraRight, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector
from armscan.models.calibration import CameraCalibration
from armscan.models.camera import CameraModel
from armscan.models.two_views import StereoCalibration
from armscan.simulation.head import Tolerances, draw_lasers, printed_heads
from armscan.simulation.optics.lasers import LineLaser
from rigs.sheet_rig import PROVENANCE, SheetRig, make_profile, project, stripe_on_board

COLUMNS, ROWS, PITCH_MM = 11, 9, 3.75
MIDDLE_MM = np.array([(COLUMNS - 1) * PITCH_MM / 2, (ROWS - 1) * PITCH_MM / 2, 0.0])
SIZE_PX = (3072, 2048)
RIM_PX = 12.0
SHORTEST_PX = 150.0
"""A stripe that crosses a corner of the board by less is not drawn."""
LARGEST_SLANT_DEG = 62.0
"""Boards that a camera sees at a larger angle are not found in its image."""

LEFT_SIGMA = np.array([0.2, 0.2, 0.25, 0.25, 3e-4, 2.5e-3, 1e-5, 1e-5, 6e-3])
POSE_SIGMA = np.array([2e-5, 2e-5, 2e-5, 2e-3, 2e-3, 2e-3])
STEREO_SIGMA = np.concatenate([LEFT_SIGMA, LEFT_SIGMA, POSE_SIGMA])


@dataclass(frozen=True, slots=True, eq=False)
class LaserTruth:
    """A simulated sheet as `sheet_rig` wants it."""

    laser: LineLaser

    @property
    def plane(self) -> FloatArray:
        """(4,) of the fan's plane."""
        normal = self.laser.normal
        return np.append(normal, -normal @ self.laser.source_mm)

    def height_mm(self, points: FloatArray) -> FloatArray:
        """Distance of points (N, 3) from the sheet."""
        return self.laser.offset_mm(points)


@dataclass(frozen=True, slots=True, eq=False)
class FanRig:
    """What is true, and how noisy the features are.

    Parameters
    ----------
    sheets
        In order along the head.
    poses
        Placements of the target.
    left, right, right_from_left
        The true cameras.
    stereo_covariance
        (24, 24) of the calibration of the cameras.
    sigma_stripe_px, sigma_corner_px, points_per_stripe
        Of the features.
    """

    sheets: tuple[LaserTruth, ...]
    poses: tuple[Pose[Sensor, Board], ...]
    left: CameraModel
    right: CameraModel
    right_from_left: Pose[CameraRight, Sensor]
    stereo_covariance: FloatArray
    sigma_stripe_px: float = 0.04
    sigma_corner_px: float = 0.01
    points_per_stripe: int = 60

    def stereo(self, error: FloatArray | None = None) -> StereoCalibration:
        """A calibration of both cameras, wrong by ``error`` (24,)."""
        e = np.zeros(24) if error is None else error
        left = CameraModel.from_parameters(self.left.parameters + e[:9], *SIZE_PX)
        right = CameraModel.from_parameters(self.right.parameters + e[9:18], *SIZE_PX)
        pose: Pose[CameraRight, Sensor] = Pose(
            rotation_from_vector(e[18:21]) @ self.right_from_left.rotation,
            self.right_from_left.translation_mm + e[21:],
        )
        known = self.stereo_covariance
        return StereoCalibration(
            left=_calibration(left, known[:9, :9]),
            right=_calibration(right, known[9:18, 9:18]),
            right_from_left=pose,
            covariance=known,
            rms_px=0.02,
            n_pairs=15,
            n_points=1485,
            provenance=PROVENANCE,
        )

    def drawn_stereo(self, rng: np.random.Generator) -> StereoCalibration:
        """A calibration whose errors follow the covariance that it claims."""
        return self.stereo(rng.multivariate_normal(np.zeros(24), self.stereo_covariance))

    def boards(
        self,
        calibration: CameraCalibration | StereoCalibration,
        rng: np.random.Generator,
        *,
        dropped: float = 0.0,
        n_strays: int = 0,
    ) -> tuple[list[BoardStripes], list[list[int]]]:
        """Input of the calibration, and the true sheet of each segment of each profile.

        Parameters
        ----------
        calibration
            Of the left camera or of both: which images there are, and how boards are posed.
        rng
            Noise.
        dropped
            Part of the stripes that are not found.
        n_strays
            Straight stripes of no sheet in each image; their true sheet is -1.
        """
        cameras = HeadCameras.of(calibration)
        found: list[BoardStripes] = []
        truth: list[list[int]] = []
        n_cameras = 1 if cameras.second is None else 2
        for i, pose in enumerate(self.poses):
            rigs = [self._camera_rig(pose, c) for c in range(n_cameras)]
            seen = []
            for c, rig in enumerate(rigs):
                if not _is_seen(rig):
                    continue
                view = replace(rig.view(0, rng), source=f"{c}-{i}.png")
                own = estimate_board_pose(view, cameras.model(c))
                assert own, own
                seen.append((c, view, own))
            placed = place_board(seen, cameras)
            for c, view, own in seen:
                stripes, names = self._stripes(pose, rigs[c], rng, dropped)
                strays = [_stray(rigs[c], rng) for _ in range(n_strays)]
                if not stripes + strays:
                    continue
                profile = make_profile(f"{c}-{i}.png", stripes + strays, self.sigma_stripe_px)
                found.append(BoardStripes(profile, view, own, ("A",), None, c, placed, f"{i}"))
                truth.append(names + [-1] * n_strays)
        return found, truth

    def _camera_rig(self, pose: Pose[Sensor, Board], camera: int) -> SheetRig:
        """The placement in one camera's own frame, for the tools of `sheet_rig`."""
        model = self.right if camera else self.left
        own = pose if camera == 0 else self.right_from_left @ pose
        in_camera: Pose[Sensor, Board] = Pose(own.rotation, own.translation_mm)
        return SheetRig(
            (),
            (in_camera,),
            model,
            np.zeros((9, 9)),
            self.sigma_stripe_px,
            self.sigma_corner_px,
            COLUMNS,
            ROWS,
            PITCH_MM,
            self.points_per_stripe,
        )

    def _stripes(
        self, pose: Pose[Sensor, Board], rig: SheetRig, rng: np.random.Generator, dropped: float
    ) -> tuple[list[tuple[FloatArray, FloatArray]], list[int]]:
        stripes, names = [], []
        for k, sheet in enumerate(self.sheets):
            on_board = stripe_on_board(pose, sheet, rig.board_points_mm(), 400)
            if len(on_board) < 2 or rng.random() < dropped:
                continue
            q = project(rig.camera, rig.poses[0], on_board)
            if np.linalg.norm(q[-1] - q[0]) < SHORTEST_PX:
                continue
            stripes.append(_noisy(q, rig, rng))
            names.append(k)
        return stripes, names


def _noisy(q: FloatArray, rig: SheetRig, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    step = np.linspace(0, len(q) - 1, rig.points_per_stripe).astype(int)
    tangent = np.gradient(q, axis=0)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True))[step]
    noise = rng.normal(0.0, rig.sigma_stripe_px, len(step))
    return q[step] + noise[:, None] * normal, normal


def _stray(rig: SheetRig, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """A straight line anywhere on the board, within 25 degrees of the stripes' direction."""
    angle = np.radians(rng.uniform(-70.0, -20.0))
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    at = MIDDLE_MM + np.array([*rng.uniform(-9.0, 9.0, 2), 0.0])
    on_board = at + np.linspace(-6.0, 6.0, 400)[:, None] * along
    return _noisy(project(rig.camera, rig.poses[0], on_board), rig, rng)


def _is_seen(rig: SheetRig) -> bool:
    pose = rig.poses[0]
    board = rig.board_points_mm()
    points = board @ pose.rotation.T + pose.translation_mm
    middle = points.mean(axis=0)
    slant = abs(float(pose.rotation[:, 2] @ middle)) / float(np.linalg.norm(middle))
    q = project(rig.camera, pose, board)
    inside = (q > RIM_PX) & (q < np.array(SIZE_PX) - RIM_PX)
    return bool(inside.all()) and slant > np.cos(np.radians(LARGEST_SLANT_DEG))


def _calibration(camera: CameraModel, covariance: FloatArray) -> CameraCalibration:
    box = np.array([0.0, 0.0, SIZE_PX[0] - 1.0, SIZE_PX[1] - 1.0])
    return CameraCalibration(
        camera=camera,
        covariance=covariance,
        has_covariance=True,
        rms_px=0.02,
        sigma_point_px=0.01,
        n_views=15,
        n_points=1485,
        covered_px=box,
        provenance=PROVENANCE,
    )


def fan_rig(seed: int, n_placements: int = 8, n_lines: int = 11) -> FanRig:
    """One instrument of the printed kind with random placements of the target in the left view."""
    rng = np.random.default_rng(seed)
    head = printed_heads()["thesis-multi" if n_lines == 11 else "thesis-multi-5"]
    lasers = draw_lasers(head.sheets, 1.0, Tolerances(), rng)
    left, right = (
        CameraModel.from_parameters(
            [c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.p1, c.p2, c.k3], *SIZE_PX
        )
        for c in head.cameras
    )
    assert head.right_from_sensor is not None
    rig = FanRig(
        tuple(LaserTruth(laser) for laser in lasers),
        (),
        left,
        right,
        head.right_from_sensor,
        np.diag(STEREO_SIGMA**2),
    )
    poses: list[Pose[Sensor, Board]] = []
    while len(poses) < n_placements:
        pose = _placement(rng)
        if _is_seen(rig._camera_rig(pose, 0)):
            poses.append(pose)
    return FanRig(
        rig.sheets, tuple(poses), left, right, head.right_from_sensor, rig.stereo_covariance
    )


def _placement(rng: np.random.Generator) -> Pose[Sensor, Board]:
    tilt = np.radians([rng.uniform(-25.0, 25.0), rng.uniform(-10.0, 40.0), 0.0])
    roll = np.radians([0.0, 0.0, rng.uniform(-30.0, 30.0)])
    rotation = rotation_from_vector(tilt) @ rotation_from_vector(roll)
    middle = np.array([rng.uniform(-25.0, 25.0), rng.uniform(-14.0, 14.0), rng.uniform(122, 158)])
    return Pose(rotation, middle - rotation @ MIDDLE_MM)
