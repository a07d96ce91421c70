# SPDX-License-Identifier: Apache-2.0
"""A sensor on an arm that looks at a sphere: exact section circles, then noise of known size."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from armscan.calibration.hand_eye.observations import PosedStripe
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Base, Pose, Sensor, Tool
from armscan.geometry.rotations import rotation_from_vector

HAND_EYE: Pose[Tool, Sensor] = Pose.from_vectors([0.3, -1.9, 1.1], [41.4, 21.5, 112.3])
CENTRE_MM = np.array([650.0, -170.0, 35.0])
DIAMETER_MM = 50.0
SCAN_POINT_MM = np.array([2.0, -3.0, 140.0])
SHEET_NORMAL = np.array([-0.004, 0.735, -0.677]) / np.linalg.norm([-0.004, 0.735, -0.677])
"""The thesis's sheet, here through the scan point."""
POINT_NOISE_MM = 0.01
LEVER_MM = 265.0


@dataclass(frozen=True)
class SphereRig:
    """What is put into the stripes of a test."""

    pose_noise_mm: float = 0.0
    point_noise_mm: float = 0.0
    n_points: int = 120
    normals: tuple[FloatArray, ...] = (SHEET_NORMAL,)
    hand_eye: Pose[Tool, Sensor] = HAND_EYE
    lever_mm: float = LEVER_MM
    turns_about_mm: FloatArray = field(default_factory=lambda: np.zeros(3))
    """Point of Tool that a pose's error shifts, and about which it turns."""

    def base_from_tool(
        self, turn: FloatArray, height_mm: float, along_mm: float, depth_mm: float = 0.0
    ) -> Pose[Base, Tool]:
        """Pose that turns the sensor by ``turn`` and cuts the sphere off its centre."""
        rotation = rotation_from_vector(turn) @ rotation_from_vector(np.array([np.pi, 0.0, 0.2]))
        rotation = rotation @ self.hand_eye.rotation.T
        along = np.cross(self.normals[0], [0.0, 0.0, 1.0])
        looked_at = SCAN_POINT_MM + height_mm * self.normals[0] + along_mm * along
        looked_at = looked_at + depth_mm * np.cross(self.normals[0], along)
        in_tool = self.hand_eye.rotation @ looked_at + self.hand_eye.translation_mm
        return Pose(rotation, CENTRE_MM - rotation @ in_tool)

    def stripes(
        self, poses: list[Pose[Base, Tool]], generator: np.random.Generator
    ) -> list[PosedStripe]:
        return [self._stripe(f"p{k}", pose, generator) for k, pose in enumerate(poses)]

    def _stripe(
        self, name: str, pose: Pose[Base, Tool], generator: np.random.Generator
    ) -> PosedStripe:
        centre = (self.hand_eye.inverse() @ pose.inverse()).matrix[:3] @ [*CENTRE_MM, 1.0]
        points, noise, sheets = [], [], []
        for k, normal in enumerate(self.normals):
            height = float(normal @ (SCAN_POINT_MM - centre))
            radius = np.sqrt((0.5 * DIAMETER_MM) ** 2 - height**2)
            towards = -centre - (normal @ -centre) * normal
            towards /= np.linalg.norm(towards)
            turn = np.linspace(-1.1, 1.1, self.n_points)[:, None]
            radial = np.cos(turn) * towards + np.sin(turn) * np.cross(normal, towards)
            error = generator.normal(0.0, self.point_noise_mm, (self.n_points, 1))
            points.append(centre + height * normal + (radius + error) * radial)
            noise.append(max(self.point_noise_mm, 1e-6) * radial)
            sheets.append(np.full(self.n_points, k))
        return PosedStripe(
            source=name,
            posture=name,
            base_from_tool=self._reported(pose, generator),
            points_mm=np.concatenate(points),
            noise_mm=np.concatenate(noise)[:, :, None],
            sheet=np.concatenate(sheets),
        )

    def _reported(self, pose: Pose[Base, Tool], generator: np.random.Generator) -> Pose[Base, Tool]:
        """The pose with an error at `turns_about_mm`, and of the orientation about it."""
        sigma = self.pose_noise_mm
        turn = rotation_from_vector(generator.normal(0.0, sigma / self.lever_mm, 3))
        centre = pose.apply(self.turns_about_mm)
        moved = turn @ (pose.translation_mm - centre) + centre + generator.normal(0.0, sigma, 3)
        return Pose(turn @ pose.rotation, moved)


def turned_poses(rig: SphereRig, n: int = 12, depth_mm: float = 12.0) -> list[Pose[Base, Tool]]:
    """Poses of which no two share an orientation, cutting the sphere at various heights."""
    generator = np.random.default_rng(11)
    heights = np.resize([3.0, 9.0, 15.0, -6.0, -12.0, 6.0], n)
    return [
        rig.base_from_tool(
            generator.uniform(-0.7, 0.7, 3),
            height,
            generator.uniform(-8.0, 8.0),
            depth_mm * generator.uniform(-1.0, 1.0),
        )
        for height in heights
    ]


def shifted_poses(rig: SphereRig) -> list[Pose[Base, Tool]]:
    """Six poses of one orientation and five turned ones, all on one side of the sheet."""
    still = np.array([0.1, 0.2, -0.1])
    poses = [
        rig.base_from_tool(still, height, along)
        for height, along in ((6.0, 0.0), (12.0, 0.0), (18.0, 4.0), (6.0, 9.0), (9.0, -9.0))
    ]
    first = poses[0]
    away = rig.hand_eye.rotation @ np.array([0.0, 0.6, 0.8]) * 12.0
    poses.append(Pose(first.rotation, first.translation_mm - first.rotation @ away))
    turns = ([0.6, 0, 0], [0, 0.5, 0], [0, 0, 0.7], [-0.4, 0.3, 0], [0.1, -0.5, 0.4])
    return poses + [rig.base_from_tool(np.array(turn), 8.0, 2.0) for turn in turns]


def _by_sensor(points_mm: FloatArray) -> FloatArray:
    """(N, 3, 5) what a sensor's shift, scale and skew do to its points."""
    from_middle = points_mm - [0.0, 0.0, 140.0]
    skew = from_middle[:, [2, 1, 1]] * [1.0, 0.0, 0.0]
    shifts = np.broadcast_to(np.eye(3), (len(points_mm), 3, 3))
    return np.concatenate([shifts, from_middle[:, :, None], skew[:, :, None]], axis=2)


def with_wrong_sensor(stripes: list[PosedStripe], wrong: FloatArray) -> list[PosedStripe]:
    """Stripes of a sensor that errs by (5,) shift, scale and skew, alike in all postures."""
    return [
        replace(
            stripe,
            points_mm=stripe.points_mm + _by_sensor(stripe.points_mm) @ wrong,
            dpoint_dsensor=_by_sensor(stripe.points_mm),
        )
        for stripe in stripes
    ]
