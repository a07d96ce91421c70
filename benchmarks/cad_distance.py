# SPDX-License-Identifier: Apache-2.0
"""Distances of points from a mesh: armscan beside other libraries, in one run.

Each library answers the same points on the same mesh of a bent sphere, its tree built before; the
processor time of all threads is told, and how far the distances differ. trimesh is asked a share
of the points only. Libraries that are not installed are left out (trimesh, libigl, open3d).

    python benchmarks/cad_distance.py --points 1000000
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from armscan.inspection.cad.distance import PartSurface
from armscan.inspection.cad.part import PartModel, part_of
from rigs.parts import sphere_part

SHARE_OF_TRIMESH = 50
SIDES = 450
"""Of the sphere: 200,700 triangles."""


def bent_part() -> PartModel:
    corners = sphere_part(40.0, SIDES).corners_mm
    bent = corners * [1.0, 0.8, 1.3] + 3.0 * np.sin(corners[:, :, ::-1] / 6.0)
    return part_of(bent, source="bent sphere")


def timed(work: Callable[[], np.ndarray]) -> tuple[np.ndarray, float, float]:
    wall, processor = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - wall, time.process_time() - processor


def rivals(part: PartModel) -> dict[str, tuple[Callable[[np.ndarray], np.ndarray], int]]:
    """Unsigned distances by name, and of every how many points they are asked."""
    found: dict[str, tuple[Callable[[np.ndarray], np.ndarray], int]] = {}
    vertices, triangles = part.vertices_mm, part.triangles
    try:
        import trimesh

        mesh = trimesh.Trimesh(vertices, triangles, process=False)
        query = trimesh.proximity.ProximityQuery(mesh)
        query.on_surface(vertices[:2])
        found["trimesh"] = (lambda points: query.on_surface(points)[1], SHARE_OF_TRIMESH)
    except ImportError:
        pass
    try:
        import igl

        tree = igl.AABB()
        tree.init(vertices, triangles)
        found["libigl"] = (
            lambda points: np.sqrt(tree.squared_distance(vertices, triangles, points)[0]),
            1,
        )
    except (ImportError, AttributeError):
        pass
    try:
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor(vertices.astype(np.float32)),
            o3d.core.Tensor(triangles.astype(np.uint32)),
        )
        found["open3d"] = (
            lambda points: scene.compute_distance(
                o3d.core.Tensor(points.astype(np.float32))
            ).numpy(),
            1,
        )
    except ImportError:
        pass
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--noise", type=float, default=0.05)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    part = bent_part()
    random = np.random.default_rng(arguments.seed)
    points = part.surface_points(arguments.points, arguments.seed)[0]
    points = points + random.normal(0.0, arguments.noise, points.shape)
    start = time.process_time()
    surface = PartSurface(part)
    built = time.process_time() - start
    surface.distance(points[:10_000])
    print(f"{len(part.triangles):,} triangles, {len(points):,} points off by {arguments.noise} mm")
    print(f"armscan builds its tree in {built:.2f} s")
    print(f"{'library':10} {'processor s':>12} {'wall s':>8} {'largest difference, mm':>24}")
    own, wall, processor = timed(lambda: np.abs(surface.distance(points).signed_mm))
    print(f"{'armscan':10} {processor:12.2f} {wall:8.2f} {'signed':>24}")
    for name, (ask, every) in rivals(part).items():
        chosen = points[::every]
        answer, wall, processor = timed(lambda ask=ask, chosen=chosen: ask(chosen))
        off = float(np.abs(np.asarray(answer).ravel() - own[::every]).max())
        note = f" (from every {every}th point)" if every > 1 else ""
        print(f"{name:10} {processor * every:12.2f} {wall * every:8.2f} {off:24.2e}{note}")


if __name__ == "__main__":
    main()
