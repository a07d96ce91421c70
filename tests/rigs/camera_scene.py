# SPDX-License-Identifier: Apache-2.0
"""Feature-level views of a flat target with known camera, poses and noise."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Board, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector
from armscan.models.camera import CameraModel
from armscan.vision.targets.target import CircleGrid, Target, TargetView
from rigs.plain_scanner import plain_camera

CAMERA = plain_camera(
    (2300.0, 2310.0), (1010.0, 770.0), (2048, 1536), [-0.12, 0.1, 6e-4, -4e-4, 0.02]
)
GRID = CircleGrid(11, 9, 15.0)


@dataclass(frozen=True)
class Scene:
    """How views are arranged; distances in mm, angles in degrees."""

    camera: CameraModel = CAMERA
    target: Target = field(default_factory=lambda: GRID)
    n_views: int = 12
    noise_px: float = 0.05
    distance_mm: float = 300.0
    max_tilt_deg: float = 35.0
    reach: float = 0.2
    """Offset of the board's middle from the image centre, over the image size."""

    bow_mm: tuple[float, float] = (0.0, 0.0)
    missed_mm: float = 0.0
    """Standard deviation by which each target point misses its place, alike in all views."""


def board_pose(scene: Scene, rng: np.random.Generator) -> Pose[Sensor, Board]:
    azimuth, tilt = 2.0 * np.pi * rng.random(), np.deg2rad(scene.max_tilt_deg) * rng.random()
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    spin = rotation_from_vector(np.array([0.0, 0.0, 0.2 * rng.normal()]))
    rotation = rotation_from_vector(tilt * axis) @ spin
    camera, z = scene.camera, scene.distance_mm * rng.uniform(0.9, 1.2)
    offset = scene.reach * rng.uniform(-1.0, 1.0, 2)
    sight = offset * [camera.width_px, camera.height_px] / [camera.fx_px, camera.fy_px]
    middle = np.array([*(sight * z), z])
    return Pose(rotation, middle - rotation @ scene.target.points_board_mm.mean(axis=0))


def bowed_points(target: Target, bow_mm: tuple[float, float]) -> FloatArray:
    points = target.points_board_mm.copy()
    half = 0.5 * np.ptp(points[:, :2], axis=0)
    unit = (points[:, :2] - points[:, :2].mean(axis=0)) / half
    points[:, 2] += (1.0 - unit**2) @ np.array(bow_mm)
    return points


def view_of(
    scene: Scene,
    pose: Pose[Sensor, Board],
    rng: np.random.Generator,
    source: str,
    missed_mm: FloatArray | float = 0.0,
) -> TargetView:
    """What a detector with Gaussian noise would deliver; only points inside the image."""
    surface = bowed_points(scene.target, scene.bow_mm) + missed_mm
    pixels = scene.camera.project(surface @ pose.rotation.T + pose.translation_mm)
    inside = np.flatnonzero(scene.camera.is_inside(pixels))
    m = len(inside)
    return TargetView(
        source=source,
        width_px=scene.camera.width_px,
        height_px=scene.camera.height_px,
        point_index=inside,
        points_px=pixels[inside] + scene.noise_px * rng.normal(size=(m, 2)),
        covariance_px2=np.tile(max(scene.noise_px, 1e-3) ** 2 * np.eye(2), (m, 1, 1)),
        points_board_mm=scene.target.points_board_mm[inside],
    )


def make_views(scene: Scene, seed: int) -> tuple[list[TargetView], list[Pose[Sensor, Board]]]:
    """Views that show at least half of the target, with the poses they were taken from."""
    rng = np.random.default_rng(seed)
    missed = np.zeros_like(scene.target.points_board_mm)
    missed[:, :2] = scene.missed_mm * np.random.default_rng([seed, 1]).normal(
        size=missed[:, :2].shape
    )
    views: list[TargetView] = []
    poses: list[Pose[Sensor, Board]] = []
    while len(views) < scene.n_views:
        pose = board_pose(scene, rng)
        view = view_of(scene, pose, rng, f"view{len(views):02d}.png", missed)
        if len(view) >= 0.5 * len(scene.target.points_board_mm):
            views.append(view)
            poses.append(pose)
    return views, poses


def normalised_error(truth: FloatArray, estimate: FloatArray, covariance: FloatArray) -> float:
    """``e' C^-1 e``, scaled first: focal lengths and k3 differ by many orders."""
    sigma = np.sqrt(np.diag(covariance))
    scaled = (estimate - truth) / sigma
    return float(scaled @ np.linalg.solve(covariance / np.outer(sigma, sigma), scaled))
