# SPDX-License-Identifier: Apache-2.0
"""Stripes over a ball's cap in Base, exposure by exposure, and a spool that holds them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from armscan.fusion.point_spool import PointSpool
from armscan.geometry.arrays import FloatArray
from armscan.records.cloud import PointCloud

RADIUS_MM, POINTS = 40.0, 150


def stripe(k: int, rng: np.random.Generator, *, n: int = POINTS) -> PointCloud:
    """One line over the cap, 0.6 mm beside the one before, with noise and covariances."""
    x = np.linspace(-12.0, 12.0, n)
    y = -9.0 + 0.6 * (k % 30) + rng.normal(0.0, 0.02)
    z = np.sqrt(RADIUS_MM**2 - x**2 - y**2) + rng.normal(0.0, 0.01, n)
    half = rng.normal(0.0, 0.01, (n, 3, 3))
    return PointCloud(
        frame="Base",
        points_mm=np.stack([x, np.full(n, y), z], axis=1),
        covariance_mm2=half @ half.transpose(0, 2, 1),
        sigma_noise_mm=rng.uniform(0.001, 0.01, n),
        sheet=np.full(n, k % 2),
        sheet_names=("A", "B"),
        exposure=np.zeros(n, dtype=np.int64),
        exposure_sources=(f"{k}.png",),
        segment=np.arange(n) // 50,
        intensity=rng.uniform(50.0, 200.0, n),
        noise_length=rng.uniform(1.0, 4.0, n),
    )


def stripes(count: int, seed: int = 0) -> list[PointCloud]:
    """Exposures in order; the fourth has no point."""
    rng = np.random.default_rng(seed)
    found = [stripe(k, rng) for k in range(count)]
    if count > 3:
        found[3] = found[3].select(slice(0))
    return found


def spool_of(clouds: list[PointCloud], folder: Path | None = None) -> PointSpool:
    """A spool with two exposures an instant, as of two cameras."""
    spool = PointSpool("Base", ("A", "B"), folder)
    for k, cloud in enumerate(clouds):
        spool.add(cloud, pixels_of(cloud, k), instant=k // 2)
    return spool


def pixels_of(cloud: PointCloud, k: int) -> FloatArray:
    """Pixels that tell which point they are of."""
    return np.column_stack([np.arange(len(cloud)), np.full(len(cloud), k)]).astype(np.float64)
