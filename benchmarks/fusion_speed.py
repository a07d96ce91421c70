# SPDX-License-Identifier: Apache-2.0
"""Thinning a cloud to one point a voxel, beside small_gicp's voxel sampling of the same points.

Command: ``OMP_NUM_THREADS=1 python benchmarks/fusion_speed.py [millions] [repeats]`` (default 2
and 5; seed 0). Without small_gicp, which the package does not need, its row is left out.

Points with covariance, noise and normals lie in lines on a ball's cap of 40 mm radius, scanned
again and again. Told are medians over the repeats of processor time, in millions of points a
second, and the voxels made. small_gicp averages places alone: it knows no weights, covariances,
normals or counts. ``places and normals`` adds up places, normals and counts by armscan's grid.
``to disk`` holds a sixteenth of the voxels in memory and merges the rest from disk.
"""

from __future__ import annotations

import importlib
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from armscan.fusion.cell_sums import CellSums, cell_numbers
from armscan.fusion.voxel_map import VoxelMap
from armscan.records.cloud import PointCloud

RADIUS_MM, VOXEL_MM = 40.0, 0.2


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


def small_gicp(cloud: PointCloud) -> Callable[[], int] | None:
    try:
        library = importlib.import_module("small_gicp")
    except ImportError:
        return None
    points = library.PointCloud(np.array(cloud.points_mm))
    return lambda: int(library.voxelgrid_sampling(points, VOXEL_MM).size())


def timed(work: Callable[[], int], repeats: int) -> tuple[float, int]:
    n, times = work(), []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return float(np.median(times)), n


def main() -> None:
    millions = float(sys.argv[1]) if len(sys.argv) > 1 else 2.0
    repeats = int(sys.argv[2]) if len(sys.argv) > 2 else 5
    cloud = drawn(round(1e6 * millions))
    print("| | million points/s | voxels |")
    print("|---|--:|--:|")
    with tempfile.TemporaryDirectory() as temporary:
        n_voxels = ours(cloud)
        rows: list[tuple[str, Callable[[], int] | None]] = [
            ("armscan, with covariances", lambda: ours(cloud)),
            (
                "armscan, to disk",
                lambda: ours(cloud, Path(temporary), 33 * 8 * n_voxels // 16),
            ),
            ("armscan, places and normals", lambda: places_alone(cloud)),
            ("small_gicp voxelgrid_sampling", small_gicp(cloud)),
        ]
        for name, work in rows:
            if work is not None:
                seconds, n = timed(work, repeats)
                print(f"| {name} | {millions / seconds:.2f} | {n:,} |", flush=True)


if __name__ == "__main__":
    main()
