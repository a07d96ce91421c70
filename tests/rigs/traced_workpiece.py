# SPDX-License-Identifier: Apache-2.0
"""A workpiece of exact shapes, scanned by a twin's arm and light without images.

Ways of the hand, errors of the arm, camera and light are the twin's own; shapes are met by rays
here. What is measured of them goes through the software's calibration, triangulation and placing.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.models.calibration import ScannerCalibration
from armscan.reconstruction.place import (
    BaseTransform,
    errors_of_calibration,
    merge_clouds,
    propagate_to_base,
)
from armscan.reconstruction.triangulate import triangulate_stripe
from armscan.records.cloud import PointCloud
from armscan.records.profile import Profile
from rigs.true_scanner import camera_model

PLATE_MM, PAD_MM = 8.0, 13.0
PLATE_HALF, PAD_BOX = (35.0, 24.0), (-32.0, 2.0, -22.0, -6.0)
BORE_AT, BORE_MM, BORE_END_MM = np.array([-18.0, 12.0]), 20.0, -4.0
BOSS_AT, BOSS_MM, BOSS_END_MM = np.array([12.0, 11.0]), 16.0, 18.0
BALL_AT, BALL_MM = np.array([18.0, -12.0, 15.0]), 14.0
NAMES = ("plate", "pad", "bore", "boss", "top", "ball")
NOISE_PX = 0.07
FAN_RAYS = 1600
MOST_SLANTED = 0.15
"""Least cosine between a surface's normal and light or sight."""


def traced(origin: FloatArray, rays: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
    """Length (N,), index into `NAMES` (-1 for none) and normal (N, 3) where rays first meet it."""
    hits = [_flat(origin, rays, PLATE_MM), _flat(origin, rays, PAD_MM)]
    x, y = (origin + hits[0][:, None] * rays)[:, :2].T
    low_x, high_x, low_y, high_y = PAD_BOX
    is_plate = (np.abs(x) < PLATE_HALF[0]) & (np.abs(y) < PLATE_HALF[1])
    is_plate &= ~((x > low_x) & (x < high_x) & (y > low_y) & (y < high_y))
    is_plate &= np.hypot(x - BORE_AT[0], y - BORE_AT[1]) > BORE_MM / 2
    hits[0][~is_plate] = np.inf
    x, y = (origin + hits[1][:, None] * rays)[:, :2].T
    hits[1][~((x > low_x) & (x < high_x) & (y > low_y) & (y < high_y))] = np.inf
    hits.append(_round(origin, rays, (BORE_AT, BORE_MM / 2, BORE_END_MM, PLATE_MM), is_far=True))
    hits.append(_round(origin, rays, (BOSS_AT, BOSS_MM / 2, PLATE_MM, BOSS_END_MM), is_far=False))
    top = _flat(origin, rays, BOSS_END_MM)
    x, y = (origin + top[:, None] * rays)[:, :2].T
    top[np.hypot(x - BOSS_AT[0], y - BOSS_AT[1]) > BOSS_MM / 2] = np.inf
    hits += [top, _ball(origin, rays)]
    length = np.array(hits)
    first = np.argmin(length, axis=0)
    found = length[first, np.arange(len(rays))]
    what = np.where(np.isfinite(found), first, -1)
    p = origin + np.where(np.isfinite(found), found, 0.0)[:, None] * rays
    normal = np.tile([0.0, 0.0, 1.0], (len(rays), 1))
    for k, at, sign in ((2, BORE_AT, -1.0), (3, BOSS_AT, 1.0)):
        out = np.column_stack([p[:, :2] - at, np.zeros(len(p))])
        normal[what == k] = sign * out[what == k] / np.linalg.norm(out[what == k], axis=1)[:, None]
    normal[what == 5] = (p[what == 5] - BALL_AT) / (BALL_MM / 2)
    return found, what, normal


def _flat(origin: FloatArray, rays: FloatArray, z: float) -> FloatArray:
    with np.errstate(divide="ignore"):
        length = (z - origin[2]) / rays[:, 2]
    return np.where(length > 0.0, length, 1e9)


def _round(
    origin: FloatArray,
    rays: FloatArray,
    shape: tuple[FloatArray, float, float, float],
    *,
    is_far: bool,
) -> FloatArray:
    at, radius, low, high = shape
    o, d = origin[:2] - at, rays[:, :2]
    a, b, c = (d**2).sum(axis=1), d @ o, float(o @ o) - radius**2
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    length = (-b + (root if is_far else -root)) / np.maximum(a, 1e-15)
    z = origin[2] + length * rays[:, 2]
    is_met = (b * b > a * c) & (length > 0.0) & (z > low) & (z < high)
    return np.where(is_met, length, np.inf)


def _ball(origin: FloatArray, rays: FloatArray) -> FloatArray:
    o = origin - BALL_AT
    b, c = rays @ o, float(o @ o) - (BALL_MM / 2) ** 2
    return np.where(b * b > c, -b - np.sqrt(np.maximum(b * b - c, 0.0)), np.inf)


def scan_of(twin: Any, document: ScannerCalibration, seed: int) -> tuple[PointCloud, IntArray, Any]:
    """Cloud in Base, what each point is of, and the true place of the workpiece in Base.

    The scanner is the twin's as it truly is, off by errors drawn from the document's covariance.
    """
    rng = np.random.default_rng([seed, 77])
    scanner = drawn_scanner(twin, document, rng)
    transform, sensor = BaseTransform.of(scanner), scanner.sensor
    assert sensor is not None
    scan = twin.scan("workpiece")
    track, head = scan.arm, scan.head
    base_from_part = twin.truth.base_from_workpiece
    light, window = head.lasers[0], head.scan_window
    fan = light.rays(np.linspace(-light.half_angle_rad, light.half_angle_rad, FAN_RAYS))
    clouds, kinds, sensors = [], [], []
    for row in scan.rows:
        part_from_sensor = base_from_part.inverse() @ scan.true_pose(row.index)
        source = part_from_sensor.apply(light.source_mm[None])[0]
        eye = part_from_sensor.translation_mm
        points, what = seen(source, eye, part_from_sensor.rotate(fan))
        pixels = head.camera.project(part_from_sensor.inverse().apply(points))
        inside = (pixels[:, 0] > window.x_px) & (pixels[:, 0] < window.x_px + window.width_px)
        inside &= (pixels[:, 1] > window.y_px) & (pixels[:, 1] < window.y_px + window.height_px)
        pixels, what = pixels[inside], what[inside]
        if len(pixels) < 10:
            continue
        profile = _profile(pixels, rng, row.source)
        stripe = triangulate_stripe(profile, np.zeros(len(pixels), dtype=np.int64), sensor)
        k = int(np.flatnonzero(track.trigger_ids == row.trigger_id)[0])
        pose: Pose[Base, Tool] = Pose(track.rotations[k], track.translations_mm[k])
        clouds.append(propagate_to_base(stripe, profile, pose, transform))
        kinds.append(what[stripe.row])
        sensors.append(pose @ scanner.hand_eye.tool_from_sensor)
    turns = np.array([one.rotation for one in sensors])
    cloud = replace(
        merge_clouds(clouds),
        seen_from_mm=np.array([one.translation_mm for one in sensors]),
        calibration_errors=errors_of_calibration(scanner, turns),
    )
    return cloud, np.concatenate(kinds), base_from_part


def seen(source: FloatArray, eye: FloatArray, rays: FloatArray) -> tuple[FloatArray, IntArray]:
    """Points (N, 3) that light meets first and the eye sees, and what they are of."""
    length, what, normal = traced(source, rays)
    lit = (what >= 0) & (np.einsum("ni,ni->n", normal, -rays) > MOST_SLANTED)
    rays, what, normal = rays[lit], what[lit], normal[lit]
    points = source + length[lit, None] * rays
    sight = points - eye
    away = np.linalg.norm(sight, axis=1)
    sight /= away[:, None]
    first, same, _ = traced(eye, sight)
    free = (same == what) & (np.abs(first - away) < 1e-6)
    free &= np.einsum("ni,ni->n", normal, -sight) > MOST_SLANTED
    return points[free], what[free]


def _profile(pixels: FloatArray, rng: np.random.Generator, source: str) -> Profile:
    n = len(pixels)
    along = np.gradient(pixels, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-12)[:, None]
    across = np.column_stack([-along[:, 1], along[:, 0]])
    return Profile(
        source=source,
        points_px=pixels + NOISE_PX * rng.standard_normal(n)[:, None] * across,
        normals_px=across,
        sigma_px=np.full(n, NOISE_PX),
        width_px=np.full(n, 2.0),
        intensity=np.full(n, 100.0),
        flags=np.zeros(n, dtype=np.int64),
        segment=np.zeros(n, dtype=np.int64),
    )


def drawn_scanner(
    twin: Any, document: ScannerCalibration, rng: np.random.Generator
) -> ScannerCalibration:
    """The twin's scanner as a calibration might find it that is as certain as the document's."""
    joint, sensor, truth = document.covariance, document.sensor, twin.truth
    assert sensor is not None
    values, vectors = np.linalg.eigh(joint)
    error = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
    sheet = sensor.sheets[0].sheet
    n_free = int((np.diag(sensor.covariance)[9:17] > 0.0).sum())
    points = next(iter(truth.sheet_points_mm.values()))
    for _ in range(4):
        height, _, by_parameters = sheet.height_with_jacobian(points)
        step = np.zeros(8)
        step[:n_free] = np.linalg.lstsq(by_parameters[:, :n_free], -height, rcond=None)[0]
        sheet = sheet.updated(step)
    camera = camera_model(np.asarray(truth.camera_parameters) + error[:9])
    hand = truth.tool_from_sensor
    turn = Rotation.from_rotvec(error[-6:-3]).as_matrix()
    off: Pose[Any, Any] = Pose(turn @ hand.rotation, hand.translation_mm + error[-3:])
    calibrated = replace(
        sensor,
        camera=replace(sensor.camera, camera=camera),
        sheets=(replace(sensor.sheets[0], sheet=sheet.updated(error[9:17])),),
    )
    hand_eye = replace(document.hand_eye, tool_from_sensor=off)
    return replace(document, sensor=calibrated, hand_eye=hand_eye)
