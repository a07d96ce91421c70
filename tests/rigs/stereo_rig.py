# SPDX-License-Identifier: Apache-2.0
"""Feature-level pairs of views of a flat target with known cameras, poses and noise."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from armscan.calibration.cameras.pairs import StereoPair
from armscan.calibration.cameras.stereo_result import StereoFit
from armscan.geometry.arrays import FloatArray
from armscan.geometry.poses import Board, CameraRight, Pose, Sensor
from armscan.geometry.rotations import rotation_from_vector, vector_from_rotation
from armscan.models.calibration import CameraCalibration, Provenance
from armscan.models.camera import CameraModel
from armscan.models.two_views import TwoViews
from armscan.vision.targets.target import CircleGrid, Target, TargetView
from rigs.plain_scanner import plain_camera

LEFT = plain_camera(
    (2300.0, 2310.0), (1010.0, 770.0), (2048, 1536), [-0.12, 0.1, 6e-4, -4e-4, 0.02]
)
RIGHT = plain_camera(
    (2340.0, 2335.0), (1040.0, 755.0), (2048, 1536), [-0.1, 0.08, -5e-4, 7e-4, 0.03]
)
CONVERGING: Pose[CameraRight, Sensor] = Pose.from_vectors([0.02, 0.45, -0.01], [-128.0, 2.0, 35.0])
"""The axes meet about 270 mm ahead, 26 degrees apart."""


def project_right(views: TwoViews, points_sensor_mm: FloatArray) -> FloatArray:
    """(N, 2) pixels of points of the Sensor frame in the right image; NaN behind the camera."""
    return views.right.project(views.points_right_mm(points_sensor_mm))


GRID = CircleGrid(11, 9, 12.0)


@dataclass(frozen=True)
class StereoScene:
    """How pairs are arranged; distances in mm, angles in degrees."""

    views: TwoViews = field(default_factory=lambda: TwoViews(LEFT, RIGHT, CONVERGING))
    target: Target = field(default_factory=lambda: GRID)
    n_pairs: int = 12
    noise_px: tuple[float, float] = (0.05, 0.05)
    """Standard deviation of a coordinate in the left and the right image."""

    claimed_px: float = 0.05
    """What the detector says of it."""

    distance_mm: float = 280.0
    max_tilt_deg: float = 35.0
    missed_mm: float = 0.0
    """Standard deviation by which each target point misses its place, alike in all views."""

    is_ambiguous: bool = False


def board_pose(scene: StereoScene, rng: np.random.Generator) -> Pose[Sensor, Board]:
    """A board about in the middle of what both cameras see, turned half way between them."""
    azimuth, tilt = 2.0 * np.pi * rng.random(), np.deg2rad(scene.max_tilt_deg) * rng.random()
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    spin = rotation_from_vector(np.array([0.0, 0.0, 0.2 * rng.normal()]))
    between = rotation_from_vector(-0.5 * scene.views.right_from_left.rotation_vector_rad)
    rotation = between @ rotation_from_vector(tilt * axis) @ spin
    z = scene.distance_mm * rng.uniform(0.92, 1.1)
    middle = np.array([*(scene.distance_mm * rng.uniform(-0.09, 0.09, 2)), z])
    return Pose(rotation, middle - rotation @ scene.target.points_board_mm.mean(axis=0))


def view_in(
    camera: CameraModel,
    pixels: FloatArray,
    scene: StereoScene,
    noise_px: float,
    rng: np.random.Generator,
    source: str,
) -> TargetView:
    """What a detector with Gaussian noise would deliver; only points inside the image."""
    inside = np.flatnonzero(camera.is_inside(pixels))
    m = len(inside)
    return TargetView(
        source=source,
        width_px=camera.width_px,
        height_px=camera.height_px,
        point_index=inside,
        points_px=pixels[inside] + noise_px * rng.normal(size=(m, 2)),
        covariance_px2=np.tile(scene.claimed_px**2 * np.eye(2), (m, 1, 1)),
        points_board_mm=scene.target.points_board_mm[inside],
        is_ambiguous=scene.is_ambiguous,
    )


def pair_at(
    scene: StereoScene,
    pose: Pose[Sensor, Board],
    rng: np.random.Generator,
    number: int,
    missed_mm: FloatArray | float = 0.0,
    right_pose: Pose[Sensor, Board] | None = None,
) -> StereoPair:
    """The pair that shows a board; ``right_pose`` if it moved before the right image was taken."""
    views, board = scene.views, scene.target.points_board_mm + missed_mm
    points = board @ pose.rotation.T + pose.translation_mm
    later = pose if right_pose is None else right_pose
    moved = board @ later.rotation.T + later.translation_mm
    return StereoPair(
        view_in(
            views.left,
            views.left.project(points),
            scene,
            scene.noise_px[0],
            rng,
            f"left{number:02d}.png",
        ),
        view_in(
            views.right,
            project_right(views, moved),
            scene,
            scene.noise_px[1],
            rng,
            f"right{number:02d}.png",
        ),
    )


def make_pairs(scene: StereoScene, seed: int) -> tuple[list[StereoPair], list[Pose[Sensor, Board]]]:
    """Pairs whose images each show at least half of the target, and the poses of the board."""
    rng = np.random.default_rng(seed)
    missed = np.zeros_like(scene.target.points_board_mm)
    missed[:, :2] = scene.missed_mm * np.random.default_rng([seed, 1]).normal(
        size=missed[:, :2].shape
    )
    least = 0.5 * len(missed)
    pairs: list[StereoPair] = []
    poses: list[Pose[Sensor, Board]] = []
    while len(pairs) < scene.n_pairs:
        pose = board_pose(scene, rng)
        pair = pair_at(scene, pose, rng, len(pairs), missed)
        if all(view is not None and len(view) >= least for view in pair.views):
            pairs.append(pair)
            poses.append(pose)
    return pairs, poses


def held(camera: CameraModel, covariance: FloatArray | None = None) -> CameraCalibration:
    """The camera's calibration by itself, exact unless a covariance (9, 9) is given."""
    known = np.zeros((9, 9)) if covariance is None else covariance
    origin = Provenance(
        document_id="id",
        created_utc="2026-01-01T00:00:00+00:00",
        armscan_version="0",
        command=(),
        inputs=(),
    )
    return CameraCalibration(
        camera=camera,
        covariance=known,
        has_covariance=covariance is not None,
        rms_px=0.1,
        sigma_point_px=0.1,
        n_views=9,
        n_points=99,
        covered_px=np.zeros(4),
        provenance=origin,
    )


def increments(truth: TwoViews, found: TwoViews) -> FloatArray:
    """(24,) what is to be added to the parameters of ``truth`` to get those found."""
    turn = found.right_from_left.rotation @ truth.right_from_left.rotation.T
    return np.concatenate(
        [
            found.left.parameters - truth.left.parameters,
            found.right.parameters - truth.right.parameters,
            vector_from_rotation(turn),
            found.right_from_left.translation_mm - truth.right_from_left.translation_mm,
        ]
    )


def normalised_stereo_error(truth: TwoViews, fit: StereoFit) -> float:
    """``e' C^-1 e`` over the 24 parameters, scaled first: they differ by many orders."""
    sigma = fit.sigma
    scaled = increments(truth, fit.views) / sigma
    return float(scaled @ np.linalg.solve(fit.covariance / np.outer(sigma, sigma), scaled))
