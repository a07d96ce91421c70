# SPDX-License-Identifier: Apache-2.0
"""Clouds of exact shapes, with noise if asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.records.cloud import FIELD_POWERS, CalibrationErrors, CloudFrame, PointCloud

RADIUS_MM = 17.48


def cloud_of(
    points: FloatArray,
    exposure: IntArray | None = None,
    *,
    frame: CloudFrame = "Base",
    sigma_mm: float = 0.01,
    noise_mm: float = 0.0,
    noise_along: FloatArray | None = None,
    normals: FloatArray | None = None,
) -> PointCloud:
    """A cloud with isotropic covariances and, in them, the stripe's noise along unit vectors.

    As in a placed cloud, the noise's length stands beside the covariance that holds it. Without
    exposures it does not tell of which light sheet its points are.
    """
    n = len(points)
    own = np.broadcast_to(
        np.zeros(3) if noise_along is None else noise_mm * noise_along, points.shape
    )
    numbers = np.zeros(n, dtype=np.int64) if exposure is None else exposure
    return PointCloud(
        frame=frame,
        points_mm=points,
        covariance_mm2=np.eye(3) * sigma_mm**2 + own[:, :, None] * own[:, None, :],
        sigma_noise_mm=np.full(n, noise_mm),
        sheet=np.zeros(n, dtype=np.int64),
        sheet_names=("" if exposure is None else "A",),
        exposure=numbers,
        exposure_sources=tuple(f"e{k}.png" for k in range(int(numbers.max(initial=0)) + 1)),
        segment=np.zeros(n, dtype=np.int64),
        intensity=np.full(n, 100.0),
        normals=normals,
    )


def seen_from(cloud: PointCloud, places_mm: FloatArray, turns: FloatArray) -> PointCloud:
    """The cloud with where its sensor stood (E, 3) and how (E, 3, 3), and errors of size zero."""
    modes = np.zeros((len(cloud.sheet_names), len(FIELD_POWERS), 3, 1))
    middle = np.zeros((len(cloud.sheet_names), 2))
    errors = CalibrationErrors(
        turns=turns, middle=middle, half_width=middle + 1.0, modes_mm=modes, arm_mm=0.0
    )
    return replace(cloud, seen_from_mm=places_mm, calibration_errors=errors)


def ball_stripes(n_stripes: int, n_points: int, half_deg: float = 70.0) -> FloatArray:
    """(n_stripes * n_points, 3) unit directions: stripes over the upper part of a ball."""
    reach = np.deg2rad(half_deg)
    a = np.repeat(np.linspace(-reach, reach, n_stripes), n_points)
    b = np.tile(np.linspace(-reach, reach, n_points), n_stripes)
    return np.stack([np.sin(b), np.cos(b) * np.sin(a), np.cos(b) * np.cos(a)], axis=1)


def block_stripes(
    height_mm: float, n_stripes: int = 40, n_points: int = 300
) -> tuple[FloatArray, IntArray]:
    """Stripes along x, 1 mm apart, over a table and a block with a shadow beside it.

    The block stands at 5 < x < 25 and 10 < y < 30; its shadow is at 25 < x < 28.
    """
    x = np.linspace(-30.0, 40.0, n_points)
    found, numbers = [], []
    for k in range(n_stripes):
        is_over = 10.0 < k < 30.0
        on_block = is_over & (x > 5.0) & (x < 25.0)
        seen = ~(is_over & (x >= 25.0) & (x < 28.0))
        points = np.stack([x, np.full_like(x, float(k)), np.where(on_block, height_mm, 0.0)], 1)
        found.append(points[seen])
        numbers.append(np.full(int(seen.sum()), k))
    return np.concatenate(found), np.concatenate(numbers)


def paused_scan(
    n_paused: int, n_moving: int, noise_mm: float = 0.01, *, step_mm: float = 0.05
) -> tuple[FloatArray, IntArray]:
    """Stripes along x over the face z = 0: some where the head trembles by 1 um, then one a 0.5 mm.

    Points are ``step_mm`` apart on them, and there nearest ones are flat in the light sheet.
    """
    rng = np.random.default_rng(0)
    x = np.arange(0.0, 200.0 * step_mm, step_mm)
    exposure = np.repeat(np.arange(n_paused + n_moving), len(x))
    y = 0.5 * np.maximum(np.arange(n_paused + n_moving) - n_paused, 0)
    y = y + rng.normal(0.0, 0.001, len(y))
    places = np.tile(x, len(y)) + np.repeat(rng.uniform(0.0, step_mm, len(y)), len(x))
    heights = rng.normal(0.0, noise_mm, len(places))
    return np.stack([places, y[exposure], heights], axis=1), exposure


def random_motion(seed: int) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) and shift (3,) in mm up to a metre."""
    rng = np.random.default_rng(seed)
    q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return q * np.linalg.det(q), rng.uniform(-1000.0, 1000.0, 3)
