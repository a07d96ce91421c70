# SPDX-License-Identifier: Apache-2.0
"""Clouds laid on the models of their parts without a guess.

    python benchmarks/cad_alignment.py --poses 20 --parts block bracket shaft housing body

Each cloud is what lies on one side of a plane of random direction, from 40 to 100 % of the part's
surface, with noise of 0.02 mm, turned and shifted at random; the points carry no normals unless
``--normals`` is given. Told are, by part: how many starts (`search_pose`, before the fit by sigmas)
put every point within 0.1 mm and 0.1 degrees of its place, how many of the wrong ones and of the
right ones named another pose, how many of the wrong ones fit as well as the true place does (the
part seen does not tell them apart), and the processor time. Simulated: points on the model itself.
With ``--foreign`` no cloud is laid: 40 % of each part's surface is compared with every other part,
in its own frame and middle on middle, and with its own part, one face worn off by 1 or 3 mm; told
is how often it is refused.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Cad, Part, Pose
from armscan.inspection.cad.alignment import align_none
from armscan.inspection.cad.comparison import CadOptions, compare_with_part
from armscan.inspection.cad.distance import PartSurface
from armscan.inspection.cad.part import PartModel
from armscan.inspection.cad.search import closer, is_significant, robust_scale, search_pose
from armscan.storage.parts.meshes import read_part
from rigs import solids
from rigs.inspection_clouds import cloud_of

NOISE_MM = 0.02
LIMIT_MM, LIMIT_DEG = 0.1, 0.1
POINTS = 40_000
PARTS = ("block", "bracket", "shaft", "housing", "body")


def model(name: str) -> PartModel:
    if name == "body":
        return solids.bent_body()
    with TemporaryDirectory() as folder:
        shape = getattr(solids, name)()
        return read_part(solids.write_step(shape, Path(folder) / f"{name}.step"))


def errors(
    found: Pose[Cad, Part], true: Pose[Cad, Part], points: np.ndarray
) -> tuple[float, float]:
    """Largest error of a point in mm, and of the turn in degrees."""
    off = np.linalg.norm(found.apply(points) - true.apply(points), axis=1).max()
    turn = Rotation.from_matrix(found.rotation @ true.rotation.T).magnitude()
    return float(off), float(np.degrees(turn))


def fits_as_well(surface: PartSurface, cloud: np.ndarray, pose: Pose, true: Pose) -> bool:
    """Whether a pose's distances are no larger than those of the true one, fitted."""
    true = closer(surface, cloud, None, true, 12)
    found, best = (surface.distance(one.apply(cloud)).signed_mm for one in (pose, true))
    return not is_significant(found, best, robust_scale(best))


def foreign(names: list[str], draws: int) -> None:
    """How often clouds of other parts, and worn ones of the right part, are refused."""
    surfaces = {name: PartSurface(model(name)) for name in names}
    kept, n, n_own, n_refused = [], 0, 0, 0
    for name, own in surfaces.items():
        for draw in range(draws):
            points, triangle = own.part.surface_points(4000, draw)
            height = points @ Rotation.random(random_state=draw).as_matrix()[0]
            seen = height >= np.quantile(height, 0.6)
            points, triangle = points[seen], triangle[seen]
            for face in np.unique(own.part.face[triangle]):
                worn = (own.part.face[triangle] == face)[:, None] * own.part.normals[triangle]
                for wear_mm in (1.0, 3.0):
                    n_own += 1
                    n_refused += is_refused(own, points - wear_mm * worn)
            for other, surface in surfaces.items():
                apart = surface.part.low_mm + surface.part.high_mm
                apart = (apart - own.part.low_mm - own.part.high_mm) / 2.0
                for shift in (np.zeros(3), apart) if other != name else ():
                    n += 1
                    if not is_refused(surface, points + shift):
                        kept.append(f"{name} on {other}")
    print(f"{n - len(kept)} of {n} foreign clouds refused; not: {', '.join(kept) or 'none'}")
    print(f"{n_refused} of {n_own} clouds of the part itself refused, one face worn by 1 or 3 mm")


def is_refused(surface: PartSurface, points: np.ndarray) -> bool:
    """Whether a cloud in the model's frame is said to be of another part."""
    cloud = cloud_of(points, sigma_mm=0.0)
    found = compare_with_part(surface, cloud, align_none(cloud), CadOptions(), errors_known=False)
    return isinstance(found, FitFailure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--overlap", type=float, nargs=2, default=(0.4, 1.0))
    parser.add_argument("--parts", nargs="+", default=PARTS)
    parser.add_argument("--normals", action="store_true")
    parser.add_argument("--foreign", action="store_true")
    arguments = parser.parse_args()
    if arguments.foreign:
        foreign(arguments.parts, arguments.poses // 4)
        return
    print(f"seed {arguments.seed}, overlap {arguments.overlap}, normals {arguments.normals}")
    print(f"{'part':8} {'poses':>5} {'right':>5} {'wrong':>5} {'of these named':>14} "
          f"{'right, named':>12} {'as well':>7} {'median mm':>9} {'worst mm':>9} "
          f"{'s each':>6}")  # fmt: skip
    for name in arguments.parts:
        part = model(name)
        surface = PartSurface(part)
        random = np.random.default_rng([arguments.seed, len(name), part.triangles.shape[0]])
        offs, right, wrong_named, right_named, as_well = [], 0, 0, 0, 0
        start = time.process_time()
        for trial in range(arguments.poses):
            points, triangle = part.surface_points(POINTS, int(random.integers(2**31)))
            height = points @ Rotation.random(random_state=random.integers(2**31)).as_matrix()[0]
            kept = height >= np.quantile(height, 1.0 - random.uniform(*arguments.overlap))
            points, normals = points[kept], part.normals[triangle[kept]]
            points = points + random.normal(0.0, NOISE_MM, points.shape)
            turn = Rotation.random(random_state=random.integers(2**31)).as_matrix()
            true: Pose[Cad, Part] = Pose(turn, random.uniform(-300.0, 300.0, 3))
            cloud = true.inverse().apply(points)
            facing = true.inverse().rotate(normals) if arguments.normals else None
            found = search_pose(surface, cloud, facing)
            off, degrees = errors(found[0].cad_from_part, true, cloud)
            if off <= LIMIT_MM and degrees <= LIMIT_DEG:
                right += 1
                right_named += len(found) > 1
                offs.append(off)
            else:
                wrong_named += len(found) > 1
                as_well += fits_as_well(surface, cloud, found[0].cad_from_part, true)
                print(f"  {name} {trial}: {off:.2f} mm, {kept.mean():.0%}, rivals {len(found) - 1}")
        each = (time.process_time() - start) / arguments.poses
        print(f"{name:8} {arguments.poses:5} {right:5} {arguments.poses - right:5} "
              f"{wrong_named:14} {right_named:12} {as_well:7} {np.median(offs or [np.nan]):9.4f} "
              f"{max(offs, default=np.nan):9.4f} {each:6.1f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
