# SPDX-License-Identifier: Apache-2.0
"""How long a cloud takes to be written and read in each format, and what comes back of it.

    python benchmarks/cloud_formats.py [POINTS]

Elapsed and processor seconds of the better of two rounds, the size of the file, and the largest
difference of a position. Binary formats take the whole count, text a tenth of it.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from armscan.records.cloud import PointCloud
from armscan.storage.clouds import FORMATS, read_cloud, write_cloud

T = TypeVar("T")
SEED = 20261123
TEXT = {"CSV", "XYZ", "OBJ"}
LIMITS_S = {"PLY": 1.0, "E57": 3.0, "LAZ": 3.0}
"""Processor seconds for a million points, to write and to read: on an idle machine no fewer than
the elapsed ones."""


def scanned(n: int) -> PointCloud:
    """Points in stripes over a wavy face, with all that a scan carries."""
    rng = np.random.default_rng(SEED)
    exposure = np.arange(n) * 1000 // n
    x, y = rng.uniform(-150.0, 150.0, n), exposure * 0.3
    slope = np.cos(x / 30.0)
    factor = rng.normal(size=(n, 3, 3)) * 0.005
    normals = np.stack([-slope / 6.0, np.zeros(n), np.ones(n)], axis=1)
    return PointCloud(
        frame="Base",
        points_mm=np.stack([x, y, 5.0 * np.sin(x / 30.0) + rng.normal(0, 0.01, n)], axis=1),
        covariance_mm2=factor @ np.swapaxes(factor, 1, 2),
        sigma_noise_mm=rng.uniform(0.002, 0.02, n),
        sheet=rng.integers(0, 11, n),
        sheet_names=tuple(f"A.{k}" for k in range(11)),
        exposure=exposure,
        exposure_sources=tuple(f"images/{k:04d}.png" for k in range(1000)),
        segment=rng.integers(0, 9, n),
        intensity=rng.uniform(20.0, 255.0, n),
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        noise_length=rng.uniform(1.0, 12.0, n),
    )


def better(work: Callable[[], T]) -> tuple[float, float, T]:
    """Elapsed and processor seconds of the better of two rounds, and what came out."""
    rounds = []
    for _ in range(2):
        start, used = time.perf_counter(), time.process_time()
        result = work()
        rounds.append((time.perf_counter() - start, time.process_time() - used, result))
    return min(rounds, key=lambda item: item[0])


def main() -> None:
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    whole = scanned(n)
    part = whole.select(slice(0, n // 10))
    print(f"seed {SEED}; seconds elapsed (processor)")
    print(f"{'format':<8}{'points':>10}{'write':>16}{'read':>16}{'MB':>8}{'worst mm':>10}  limit")
    with tempfile.TemporaryDirectory() as folder:
        for item in FORMATS:
            if item.write is None:
                continue
            cloud = part if item.name in TEXT else whole
            path = Path(folder) / f"cloud{item.suffixes[0]}"

            def write(path: Path = path, cloud: PointCloud = cloud) -> None:
                write_cloud(path, cloud, is_overwriting=True)

            def read(path: Path = path) -> PointCloud:
                return read_cloud(path)

            write_s, write_cpu, _ = better(write)
            read_s, read_cpu, back = better(read)
            worst = float(np.abs(back.points_mm - cloud.points_mm).max())
            limit = LIMITS_S.get(item.name)
            told = "" if limit is None else f"{limit:g} s: "
            if limit is not None:
                told += "kept" if max(write_cpu, read_cpu) <= limit * n / 1e6 else "missed"
            print(
                f"{item.name:<8}{len(cloud):>10,}{write_s:>9.2f} ({write_cpu:.2f})"
                f"{read_s:>9.2f} ({read_cpu:.2f}){path.stat().st_size / 1e6:>8.1f}{worst:>10.1e}"
                f"  {told}"
            )


if __name__ == "__main__":
    main()
