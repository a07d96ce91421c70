# SPDX-License-Identifier: Apache-2.0
"""Thinning a cloud to one point a voxel: the part ``fusion`` of ``speed.py``, one thread, seed 0.

Points with covariance, noise and normals lie in lines on a ball's cap of 40 mm radius, scanned
again and again. small_gicp (if it is installed) and NumPy average places alone: they know no
weights, covariances, normals or counts.
"""

from __future__ import annotations

import importlib
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from timing import Comparison, compare

from armscan.fusion.cell_sums import CellSums, cell_numbers
from armscan.fusion.voxel_map import VoxelMap
from armscan.records.cloud import PointCloud

RADIUS_MM, VOXEL_MM, MANY = 40.0, 0.2, 1_000_000
SMALL_GICP, NUMPY = "small_gicp, places", "NumPy `unique` and `add.at`, places"


def drawn(n: int) -> PointCloud:
    """N points on the cap."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-25.0, 25.0, n)
    y = np.sort(rng.uniform(-25.0, 25.0, n))
    z = np.sqrt(RADIUS_MM**2 - x**2 - y**2)
    true = np.stack([x, y, z], axis=1)
    normals = true / RADIUS_MM
    sigma = rng.uniform(0.005, 0.02, n)
    covariance = 1e-4 * np.eye(3) + sigma[:, None, None] ** 2 * (
        normals[:, :, None] * normals[:, None, :]
    )
    zeros = np.zeros(n, dtype=np.int64)
    return PointCloud(
        frame="Base",
        points_mm=true + (sigma * rng.normal(size=n))[:, None] * normals,
        covariance_mm2=covariance,
        sigma_noise_mm=sigma,
        sheet=zeros,
        sheet_names=("A",),
        exposure=zeros,
        exposure_sources=("a.png",),
        segment=zeros,
        intensity=np.full(n, 100.0),
        normals=normals,
        noise_length=np.full(n, 2.0),
    )


def ours(cloud: PointCloud, folder: Path | None = None, most_bytes: int = 2**31) -> int:
    voxels = VoxelMap(VOXEL_MM, folder, most_bytes)
    voxels.add(cloud)
    n = sum(len(piece.cloud) for piece in voxels.fused())
    voxels.close()
    return n


def places_alone(cloud: PointCloud) -> int:
    sums = CellSums(7)
    cell = np.floor(cloud.points_mm / VOXEL_MM).astype(np.int64) + 2**20
    assert cloud.normals is not None  # noqa: S101
    values = np.column_stack([cloud.points_mm, cloud.normals, np.ones(len(cloud))])
    sums.add(cell_numbers(cell), values)
    return sum(len(keys) for keys, _ in sums.merged())


def by_numpy(cloud: PointCloud) -> int:
    cells = np.floor(cloud.points_mm / VOXEL_MM).astype(np.int64)
    found, owner, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(found), 3))
    np.add.at(sums, owner.ravel(), cloud.points_mm)
    return len(sums / counts[:, None])


def small_gicp(cloud: PointCloud) -> Callable[[], int] | None:
    try:
        library = importlib.import_module("small_gicp")
    except ImportError:
        return None
    points = library.PointCloud(np.array(cloud.points_mm))
    return lambda: int(library.voxelgrid_sampling(points, VOXEL_MM).size())


def fusion(repeats: int) -> Comparison:
    """A million points to voxels of 0.2 mm."""
    cloud = drawn(MANY)
    n_voxels = ours(cloud)
    with tempfile.TemporaryDirectory() as temporary:
        ways: dict[str, Callable[[], int]] = {
            "**armscan: covariances, normals, counts**": lambda: ours(cloud),
            "**armscan: the same, a sixteenth in memory**": lambda: ours(
                cloud, Path(temporary), 33 * 8 * n_voxels // 16
            ),
            "armscan: places and normals": lambda: places_alone(cloud),
            NUMPY: lambda: by_numpy(cloud),
        }
        if (sampled := small_gicp(cloud)) is not None:
            ways[SMALL_GICP] = sampled
        return compare(
            f"{MANY:,} points to voxels of {VOXEL_MM} mm",
            ways,
            repeats,
            usual=SMALL_GICP if SMALL_GICP in ways else NUMPY,
            tell=lambda n: (f"{n:,} voxels", ""),
        )
