# SPDX-License-Identifier: Apache-2.0
"""A workpiece with a bore, a boss, a cone and a ball, scanned in strokes that err as a whole."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.records.cloud import PointCloud
from rigs.inspection_clouds import cloud_of

BORE_MM, BOSS_MM, BALL_MM, CONE_DEG = 12.0, 20.0, 16.0, 25.0
BORE_AT, BOSS_AT = np.array([20.0, 15.0]), np.array([60.0, 15.0])
BALL_AT = np.array([20.0, 50.0, 10.0])
CONE_AT = np.array([60.0, 50.0])
STROKES = 6


def workpiece(
    seed: int, *, n: int = 30_000, arm_mm: float = 0.008, noise_mm: float = 0.006
) -> PointCloud:
    """A plate z = 0 of 80 x 70 mm with a bore down to -10, a boss to 12, a ball and a cone on it.

    Each of six strokes is shifted by an error of its own; each point moves along its normal.
    """
    rng = np.random.default_rng(seed)
    parts: list[tuple[FloatArray, FloatArray]] = []
    flat = np.stack([rng.uniform(0, 80, n), rng.uniform(0, 70, n), np.zeros(n)], axis=1)
    xy = flat[:, :2]
    is_free = np.linalg.norm(xy - BORE_AT, axis=1) > BORE_MM / 2
    for at, radius in ((BOSS_AT, BOSS_MM / 2), (BALL_AT[:2], 8.0), (CONE_AT, 10.0)):
        is_free &= np.linalg.norm(xy - at, axis=1) > radius
    flat = flat[is_free]
    parts.append((flat, np.tile([0.0, 0.0, 1.0], (len(flat), 1))))
    for at, radius, low, high, side in (
        (BORE_AT, BORE_MM / 2, -10.0, 0.0, -1.0),
        (BOSS_AT, BOSS_MM / 2, 0.0, 12.0, 1.0),
    ):
        m = int(n * radius * (high - low) / 900)
        turn = rng.uniform(-np.pi, np.pi, m)
        out = np.stack([np.cos(turn), np.sin(turn), np.zeros(m)], axis=1)
        points = out * radius + np.stack(
            [np.full(m, at[0]), np.full(m, at[1]), rng.uniform(low, high, m)], axis=1
        )
        parts.append((points, side * out))
    m = n // 8
    out = rng.normal(size=(m, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    out = out[out[:, 2] > -0.2]
    parts.append((BALL_AT + out * BALL_MM / 2, out))
    turn, height = rng.uniform(-np.pi, np.pi, m), rng.uniform(0.0, 12.0, m)
    angle = np.radians(CONE_DEG)
    wide = 10.0 - height * np.tan(angle)
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros(m)], axis=1)
    points = ring * wide[:, None] + np.stack(
        [np.full(m, CONE_AT[0]), np.full(m, CONE_AT[1]), height], axis=1
    )
    parts.append((points, np.cos(angle) * ring + np.sin(angle) * np.array([0.0, 0.0, 1.0])))
    points = np.concatenate([item[0] for item in parts])
    normals = np.concatenate([item[1] for item in parts])
    # strokes along y, side by side with overlap, in 8 exposures each
    stroke = np.clip((points[:, 0] / 80 * STROKES + rng.uniform(-0.6, 0.6, len(points))), 0, 5.99)
    block = np.clip(points[:, 1] / 70 * 8, 0, 7.99).astype(np.int64)
    exposure = stroke.astype(np.int64) * 8 + block
    errors = rng.normal(0.0, arm_mm, (STROKES, 3))[stroke.astype(np.int64)]
    points = points + errors + normals * rng.normal(0.0, noise_mm, (len(points), 1))
    return cloud_of(points, exposure, sigma_mm=arm_mm, noise_mm=noise_mm, noise_along=normals)
