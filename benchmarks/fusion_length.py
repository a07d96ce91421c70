# SPDX-License-Identifier: Apache-2.0
"""Fusing more points than memory holds, made on the fly: time, memory, disk, and the truth of them.

Command: ``OMP_NUM_THREADS=1 python benchmarks/fusion_length.py [millions ...]`` (default 10 100; a
billion is 1000). Seed 0.

A tilted panel of 2 x 1 m is scanned patch after patch of 100 x 100 mm, a million points with
covariances, noise and normals each, and thinned to voxels of 0.5 mm. Told are the whole time, the
processor time of fusing without that of making points, the largest memory of the process, the
most that lay on disk, the voxels, and how far the mean distance from the panel, weighted by count,
is from 0 over what the fused points' own noise allows (`z`). It is an error if the counts of the
fused points are not those of the points.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from armscan.fusion.voxel_map import VoxelMap
from armscan.geometry.arrays import FloatArray
from armscan.records.cloud import PointCloud

SIZE_MM, PATCH_MM = (2000.0, 1000.0), 100.0
VOXEL_MM, SIGMA_MM = 0.5, 0.02
SLOPES = np.array([0.13, -0.07])
NORMAL: FloatArray = np.array([*-SLOPES, 1.0]) / np.hypot(1.0, np.hypot(*SLOPES))
AT_ONCE = 1_000_000


def patch(rng: np.random.Generator) -> PointCloud:
    """A million points of one patch of the panel, in the order of the scan."""
    corner = rng.uniform(0.0, np.array(SIZE_MM) - PATCH_MM)
    along, across = rng.random(AT_ONCE), np.sort(rng.random(AT_ONCE))
    places = np.stack([along, across, np.zeros(AT_ONCE)], axis=1) * PATCH_MM
    places[:, :2] += corner
    places[:, 2] = places[:, :2] @ SLOPES
    places += SIGMA_MM * rng.standard_normal(AT_ONCE)[:, None] * NORMAL
    zeros = np.zeros(AT_ONCE, dtype=np.int64)
    return PointCloud(
        frame="Base",
        points_mm=places,
        covariance_mm2=np.tile(SIGMA_MM**2 * np.outer(NORMAL, NORMAL), (AT_ONCE, 1, 1)),
        sigma_noise_mm=np.full(AT_ONCE, SIGMA_MM),
        sheet=zeros,
        sheet_names=("A",),
        exposure=zeros,
        exposure_sources=("a.png",),
        segment=zeros,
        intensity=np.full(AT_ONCE, 100.0),
        normals=np.tile(NORMAL, (AT_ONCE, 1)),
        noise_length=np.ones(AT_ONCE),
    )


def on_disk(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def fuse(millions: int) -> str:
    rng = np.random.default_rng(0)
    began, seconds, most_disk = time.monotonic(), 0.0, 0
    n_voxels = n_points = 0
    distance = variance = 0.0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        voxels = VoxelMap(VOXEL_MM, folder)
        for k in range(millions):
            cloud = patch(rng)
            start = time.process_time()
            voxels.add(cloud)
            seconds += time.process_time() - start
            most_disk = max(most_disk, on_disk(folder))
            if k % 20 == 19:
                print(f"{k + 1} million points", end="\r", file=sys.stderr, flush=True)
        start = time.process_time()
        for piece in voxels.fused():
            n_voxels += len(piece.cloud)
            n_points += int(piece.n_points.sum())
            distance += float(piece.n_points @ (piece.cloud.points_mm @ NORMAL))
            variance += float(((piece.n_points * piece.cloud.sigma_noise_mm) ** 2).sum())
        seconds += time.process_time() - start
        voxels.close()
    if n_points != millions * AT_ONCE:
        raise AssertionError(f"{n_points} points came out of {millions * AT_ONCE}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return (
        f"| {millions:,} | {time.monotonic() - began:.0f} | {seconds:.0f} | {peak:,.0f} | "
        f"{most_disk / 2**20:,.0f} | {n_voxels:,} | {distance / variance**0.5:.2f} |"
    )


def main() -> None:
    print("| million points | s | s of processor fusing | peak MB | MB on disk | voxels | z |")
    print("|--:|--:|--:|--:|--:|--:|--:|")
    for millions in [int(word) for word in sys.argv[1:]] or [10, 100]:
        print(fuse(millions), flush=True)


if __name__ == "__main__":
    main()
