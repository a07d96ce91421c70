# SPDX-License-Identifier: Apache-2.0
"""Ring markers on planes and bumps before the stereo head of the thesis, as points with noise.

Projection is written out here anew, so that nothing of the product computes the truth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armscan.geometry.poses import Pose
from armscan.models.camera import CameraModel
from armscan.models.two_views import TwoViews
from armscan.records.points import RingImages
from rigs.plain_scanner import plain_camera

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
FOCAL_PX, WIDTH_PX, HEIGHT_PX = 5150.0, 3072, 2048
BASELINE_MM, CROSSING_MM = 133.4, 140.0
"""Section 5.3.2: the two optical axes meet at 140 mm."""
RADIUS_MM = 2.5
NOISE_PX = 0.1
MISSING = 0.2
SIGMAS = np.array(2 * [0.5, 0.5, 0.5, 0.5, 2e-4, 1e-3, 2e-5, 2e-5, 0.0] + 3 * [2e-5] + 3 * [0.004])
"""Standard deviations of a stereo calibration: both cameras, then rotation and translation."""
CALIBRATION_COVARIANCE = np.diag(SIGMAS**2)


@dataclass(frozen=True)
class MarkerScene:
    """Rings as two cameras see them; ``left_marker`` and ``right_marker`` name the marker."""

    left: RingImages
    right: RingImages
    left_marker: Ints
    right_marker: Ints
    points_mm: Floats
    views: TwoViews

    @property
    def seen_by_both(self) -> int:
        return len(np.intersect1d(self.left_marker, self.right_marker))


def true_views() -> TwoViews:
    half = np.arcsin(0.5 * BASELINE_MM / CROSSING_MM)
    turn = 2.0 * half
    rotation = np.array(
        [[np.cos(turn), 0.0, np.sin(turn)], [0.0, 1.0, 0.0], [-np.sin(turn), 0.0, np.cos(turn)]]
    )
    centre = BASELINE_MM * np.array([np.cos(half), 0.0, np.sin(half)])
    camera = plain_camera(
        FOCAL_PX,
        ((WIDTH_PX - 1) / 2.0, (HEIGHT_PX - 1) / 2.0),
        (WIDTH_PX, HEIGHT_PX),
        [-0.1, 0.05, 1e-3, -5e-4, 0.0],
    )
    return TwoViews(camera, camera, Pose(rotation, -rotation @ centre))


def perturbed(views: TwoViews, rng: np.random.Generator) -> TwoViews:
    """Cameras as a calibration with `CALIBRATION_COVARIANCE` would give them."""
    error = SIGMAS * rng.standard_normal(24)
    left, right = (
        CameraModel.from_parameters(camera.parameters + change, WIDTH_PX, HEIGHT_PX)
        for camera, change in ((views.left, error[:9]), (views.right, error[9:18]))
    )
    turn = Pose.from_vectors(error[18:21], error[21:])
    pose = views.right_from_left
    return TwoViews(
        left,
        right,
        Pose(turn.rotation @ pose.rotation, pose.translation_mm + turn.translation_mm),
    )


def random_scene(seed: int, *, missing: float = MISSING, noise_px: float = NOISE_PX) -> MarkerScene:
    """20 to 40 markers on a tilted plane, on two planes that meet, or on bumps, in turns."""
    rng = np.random.default_rng(seed)
    views = true_views()
    places, normals = _surface(rng, int(rng.integers(20, 41)), seed % 3)
    left, left_marker = _images(views, places, normals, False, rng, missing, noise_px)
    right, right_marker = _images(views, places, normals, True, rng, missing, noise_px)
    return MarkerScene(left, right, left_marker, right_marker, places, perturbed(views, rng))


def _surface(rng: np.random.Generator, n: int, kind: int) -> tuple[Floats, Floats]:
    """Places and normals of markers, three radii apart or more, where the cameras look."""
    flat: list[Floats] = []
    while len(flat) < n:
        place = rng.uniform([-36.0, -22.0], [36.0, 22.0])
        if all(np.hypot(*(place - other)) > 3.0 * RADIUS_MM for other in flat):
            flat.append(place)
    xy = np.array(flat)
    slope = np.tan(np.deg2rad(rng.uniform(-18.0, 18.0, 2)))
    height, gradient = xy @ slope, np.tile(slope, (n, 1))
    if kind == 1:
        bend = np.tan(np.deg2rad(rng.uniform(10.0, 25.0)))
        height = height - bend * np.abs(xy[:, 0])
        gradient[:, 0] -= bend * np.sign(xy[:, 0])
    if kind == 2:
        for _ in range(2):
            middle, size = rng.uniform([-25.0, -15.0], [25.0, 15.0]), rng.uniform(15.0, 25.0)
            offset = (xy - middle) / size
            bump = rng.uniform(-8.0, 8.0) * np.exp(-0.5 * (offset**2).sum(axis=1))
            height = height + bump
            gradient -= bump[:, None] * offset / size
    # From the frame midway between the cameras, whose z is the bisector, to the left camera's.
    half = np.arcsin(0.5 * BASELINE_MM / CROSSING_MM)
    turn = np.array(
        [[np.cos(half), 0.0, -np.sin(half)], [0.0, 1.0, 0.0], [np.sin(half), 0.0, np.cos(half)]]
    )
    normals = np.column_stack([gradient, -np.ones(n)])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    crossing = np.array([0.0, 0.0, CROSSING_MM])
    return np.column_stack([xy, height]) @ turn.T + crossing, normals @ turn.T


def _project(camera: CameraModel, points: Floats) -> Floats:
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.column_stack([camera.fx_px * u + camera.cx_px, camera.fy_px * v + camera.cy_px])


def _images(
    views: TwoViews,
    places: Floats,
    normals: Floats,
    is_right: bool,
    rng: np.random.Generator,
    missing: float,
    noise_px: float,
) -> tuple[RingImages, Ints]:
    pose = views.right_from_left
    turn = pose.rotation if is_right else np.eye(3)
    shift = pose.translation_mm if is_right else np.zeros(3)
    camera = views.right if is_right else views.left
    points, normal = places @ turn.T + shift, normals @ turn.T
    centres = _project(camera, points)
    first = np.cross(normal, [0.3, 0.9, 0.1])
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(normal, first)
    stretch = np.stack(
        [_project(camera, points + RADIUS_MM * axis) - centres for axis in (first, second)], axis=2
    )
    axes = np.linalg.svd(stretch)
    cosine = -np.einsum("ni,ni->n", normal, points) / np.linalg.norm(points, axis=1)
    seen = rng.random(len(places)) >= missing
    seen &= (centres >= 60.0).all(axis=1) & (centres <= [WIDTH_PX - 60, HEIGHT_PX - 60]).all(axis=1)
    seen &= cosine > np.cos(np.deg2rad(60.0))
    shown = rng.permutation(np.flatnonzero(seen))
    n = len(shown)
    half = axes.S[shown][:, ::-1] + noise_px * rng.standard_normal((n, 2))
    half[:, 1] = half.max(axis=1)
    images = RingImages(
        source="right" if is_right else "left",
        centres_px=centres[shown] + noise_px * rng.standard_normal((n, 2)),
        covariance_px2=np.tile(max(noise_px, 1e-3) ** 2 * np.eye(2), (n, 1, 1)),
        outer_half_px=half,
        inner_half_px=0.5 * half,
        direction_rad=np.arctan2(axes.U[shown, 1, 0], axes.U[shown, 0, 0]),
        contrast=np.full(n, 0.5),
        perimeter_px=2.0 * np.pi * half[:, 1],
        roundness=half[:, 1] / half[:, 0],
    )
    return images, shown.astype(np.int64)
