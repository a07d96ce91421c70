# SPDX-License-Identifier: Apache-2.0
"""Where a cloud lies on a part, without a guess.

Turns spread evenly over all turns, and places in the part's box, are each carried downhill in a
grid of signed distances; the best of them are refined against the surface itself. A pose that fits
as well as the best is kept: the part is symmetric then, or the scan shows too little of it. A cloud
in another unit of length than its part fits nowhere: its size tells, or how well it fits scaled.
"""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Cad, Part, Pose
from armscan.geometry.rotations import rotation_from_vector
from armscan.inspection.cad.distance import PartSurface
from armscan.kernels.mesh_search import descend_poses
from armscan.records.cloud import PointCloud

TURNS = 700
"""Starting turns, about 24 degrees apart; half as many lost 1 of 100 poses in the study."""
PLACES = (-0.25, 0.0, 0.25)
"""Starting places of the cloud's middle along each axis, over the part's extent."""
NODES = 64
"""Of the grid of distances along its longest side."""
MARGIN = 0.2
"""Of the grid about the part, over its diagonal."""
FEW, SOME, MANY, ALL = 150, 600, 3000, 20_000
"""Points that rate all starts, the better ones, refine the last ones, and compare these."""
KEPT, LAST, FINAL = 400, 24, 6
"""Starts kept after each round."""
APART = 0.05
"""Poses that differ by less than this over the diagonal, where the points lie, are one."""
CLIPPED = 3.0
"""Deviations beyond this many robust standard deviations count as so many."""
EQUAL_SIGMAS = 4.0
NEIGHBOURS = 10
"""Points that err together at most, on a real surface, when two poses are compared."""
WIDENED = 16.0
"""Robust scales, times 4.7, within which points hold a pose as it begins to be refined."""
NEARLY = 1.5
"""A pose whose mean square is below this times the best one's fits nearly as well."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseCandidate:
    """A place of the cloud on the part.

    Parameters
    ----------
    cost
        Mean square deviation over the best pose's robust variance, each clipped at `CLIPPED`.
    scale_mm
        Robust standard deviation of the points' distances (1.48 times their median size).
    is_equal
        True if the points do not tell it from the best.
    """

    cad_from_part: Pose[Cad, Part]
    cost: float
    scale_mm: float
    is_equal: bool = False


class _DistanceGrid(NamedTuple):
    """Signed distances on a grid, (nz ny, nx) float32, and the grid as a kernel reads it."""

    shape: FloatArray
    field_mm: NDArray[np.float32]


def search_pose(
    surface: PartSurface, points_mm: FloatArray, normals: FloatArray | None = None
) -> tuple[PoseCandidate, ...]:
    """Find where a cloud lies on a part.

    ``points_mm``: (N, 3) the cloud, in a frame of its own. ``normals``: (N, 3) outward unit
    normals, or None; with them both sides of a plate are told apart.

    Returns
    -------
    tuple of PoseCandidate
        The best, then those that fit nearly as well, by rising cost.
    """
    rows = spread_rows(points_mm, MANY)
    points = points_mm[rows]
    towards = None if normals is None else normals[rows]
    middle = points.mean(axis=0)
    centred = points - middle
    grid = _distance_grid(surface)
    facing = towards if surface.is_closed else None
    poses = _starts(surface)
    diagonal = surface.diagonal_mm
    for count, kept, widths in (
        (FEW, KEPT, diagonal * np.geomspace(0.15, 0.03, 10)),
        (SOME, LAST, diagonal * np.geomspace(0.04, 0.01, 8)),
    ):
        few = _thinned(len(centred), count)
        looks = np.zeros((0, 3)) if facing is None else np.ascontiguousarray(facing[few])
        costs = _descended(centred[few], looks, grid, widths, poses)
        poses = _distinct(poses, costs, centred, APART * diagonal, kept)
    candidates = [_typed(pose, middle) for pose in poses]
    compared = spread_rows(points_mm, ALL)
    facing = None if normals is None else normals[compared]
    refined = _refined(surface, points, towards, candidates)
    return _rated(surface, points_mm[compared], facing, refined)


def spread_rows(points_mm: FloatArray, count: int, seed: int = 0) -> IntArray:
    """(M,) rows of at most ``count`` points, chosen alike over the surface however dense it is."""
    n = len(points_mm)
    if n <= count:
        return np.arange(n)
    random = np.random.default_rng(seed)
    extent = np.ptp(points_mm, axis=0)
    cell = max(float(np.sqrt(np.sort(extent)[1:].prod() / count)), 1e-9) / 2.0
    cells = np.floor((points_mm - points_mm.min(axis=0)) / cell).astype(np.int64)
    key = (cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]) * (cells[:, 2].max() + 1)
    order = random.permutation(n)
    _, first = np.unique((key + cells[:, 2])[order], return_index=True)
    chosen = order[first]
    if len(chosen) < count:
        rest = np.setdiff1d(order, chosen)
        chosen = np.concatenate([chosen, random.choice(rest, count - len(chosen), replace=False)])
    return np.asarray(np.sort(random.permutation(chosen)[:count]))


def fit_step(
    placed_mm: FloatArray,
    normals: FloatArray,
    weights: FloatArray,
    centre_mm: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """(N, 6) derivatives by a turn about a centre and a shift, and the (6, 6) normal matrix."""
    jacobian = np.concatenate([np.cross(placed_mm - centre_mm, normals), normals], axis=1)
    return jacobian, jacobian.T @ (jacobian * weights[:, None])


def robust_scale(distances_mm: FloatArray) -> float:
    """1.48 times the median size of distances; NaN of none."""
    finite = distances_mm[np.isfinite(distances_mm)]
    return 1.4826 * float(np.median(np.abs(finite))) if len(finite) else float("nan")


def tukey_weights(distances_mm: FloatArray, scale_mm: float) -> FloatArray:
    """(N,) biweights that end at 4.7 robust standard deviations; 0 where there is no distance."""
    share = np.where(np.isfinite(distances_mm), distances_mm, np.inf) / (4.685 * scale_mm)
    return np.asarray(np.clip(1.0 - np.minimum(share**2, 1.0), 0.0, 1.0) ** 2)


def is_significant(distances_mm: FloatArray, best_mm: FloatArray, scale_mm: float) -> bool:
    """Whether distances of the same points are larger than the best ones, beyond their noise."""
    more = _clipped(distances_mm, scale_mm) - _clipped(best_mm, scale_mm)
    noise = float(more.std()) * float(np.sqrt(NEIGHBOURS / max(len(more), 1)))
    return float(more.mean()) > EQUAL_SIGMAS * noise


def _clipped(distances_mm: FloatArray, scale_mm: float) -> FloatArray:
    """(N,) squares over the scale's, clipped; a point without a distance is as far as can be."""
    share = np.where(np.isfinite(distances_mm), distances_mm, np.inf) / scale_mm
    return np.minimum(np.abs(share), CLIPPED) ** 2


def closer(
    surface: PartSurface,
    points_mm: FloatArray,
    normals: FloatArray | None,
    pose: Pose[Cad, Part],
    rounds: int,
    *,
    widened: float = 1.0,
) -> Pose[Cad, Part]:
    """Carry a pose to the nearest best fit (Gauss-Newton, biweight of the robust scale).

    ``widened``: so many times the scale holds at first, and half as much each round. Where nearly
    all points lie on faces along which the part may slide, the few that hold it look like outliers.
    """
    for k in range(rounds):
        placed = pose.apply(points_mm)
        towards = None if normals is None else pose.rotate(normals)
        found = surface.distance(placed, towards=towards)
        d = found.signed_mm
        scale = max(robust_scale(d), 1e-9 * surface.diagonal_mm)
        centre = placed.mean(axis=0)
        wide = max(widened / 2.0**k, 1.0)
        weights = tukey_weights(d, wide * scale)
        jacobian, normal = fit_step(placed, found.normals, weights, centre)
        radius = float(np.sqrt(np.mean((placed - centre) ** 2) * 3.0))
        unit = np.repeat([radius, 1.0], 3)
        scaled = normal / np.outer(unit, unit)
        scaled += 1e-6 * np.trace(scaled) / 6.0 * np.eye(6)
        step = -np.linalg.solve(scaled, jacobian.T @ (weights * d) / unit) / unit
        pose = moved(pose, step, centre)
        if wide == 1.0 and np.linalg.norm(step * unit) < 1e-7 * radius:
            break
    return pose


def moved(pose: Pose[Cad, Part], step: FloatArray, centre_mm: FloatArray) -> Pose[Cad, Part]:
    """The pose after a turn vector (3,) about a centre and a shift (3,), both in Cad."""
    turn = rotation_from_vector(step[:3])
    shift = turn @ (pose.translation_mm - centre_mm) + centre_mm + step[3:]
    return Pose(_orthonormal(turn @ pose.rotation), shift)


def even_turns(count: int) -> FloatArray:
    """(count, 3, 3) turns spread evenly (super-Fibonacci spirals, Alexa 2022)."""
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(count) + 0.5
    r, big = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    a, b = 2.0 * np.pi * s / phi, 2.0 * np.pi * s / psi
    x, y, z, w = r * np.sin(a), r * np.cos(a), big * np.sin(b), big * np.cos(b)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _thinned(n: int, count: int) -> IntArray:
    random = np.random.default_rng(1)
    return np.arange(n) if n <= count else random.choice(n, count, replace=False)


def _distance_grid(surface: PartSurface) -> _DistanceGrid:
    """Distances on a grid about the part."""
    part = surface.part
    margin = MARGIN * part.diagonal_mm
    low, extent = part.low_mm - margin, part.high_mm - part.low_mm + 2.0 * margin
    spacing = float(extent.max()) / (NODES - 1)
    counts = np.ceil(extent / spacing).astype(np.int64) + 1
    axes = [low[k] + spacing * np.arange(counts[k]) for k in range(3)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    nodes = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    distance = surface.distance(nodes).signed_mm
    if not surface.is_closed:
        # beyond the rim of an open surface the sign means nothing
        distance = np.abs(distance)
    field = distance.astype(np.float32).reshape(int(counts[2] * counts[1]), int(counts[0]))
    shape = np.array([*low, spacing, *counts], dtype=np.float64)
    return _DistanceGrid(shape, np.ascontiguousarray(field))


def _starts(surface: PartSurface) -> FloatArray:
    """(S, 12) turns by places."""
    part = surface.part
    middle, extent = (part.low_mm + part.high_mm) / 2.0, part.high_mm - part.low_mm
    offsets = np.array([[x, y, z] for x in PLACES for y in PLACES for z in PLACES])
    places = middle + offsets * extent
    turns = even_turns(TURNS).reshape(-1, 9)
    return np.concatenate(
        [np.repeat(turns, len(places), axis=0), np.tile(places, (len(turns), 1))], axis=1
    )


def _descended(
    points: FloatArray,
    normals: FloatArray,
    grid: _DistanceGrid,
    widths: FloatArray,
    poses: FloatArray,
) -> FloatArray:
    """(S,) costs; the poses are carried in place."""
    costs = np.zeros(len(poses))
    radius = float(np.sqrt(np.mean(np.sum(points**2, axis=1))))
    points = np.ascontiguousarray(points)
    threads = os.cpu_count() or 1

    def work(part: slice) -> None:
        own, own_costs = poses[part].copy(), np.zeros(len(costs[part]))
        descend_poses(points, normals, grid.field_mm, grid.shape, widths, radius, own, own_costs)
        poses[part], costs[part] = own, own_costs

    size = -(-len(poses) // (4 * threads))
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, [slice(k, k + size) for k in range(0, len(poses), size)]))
    return costs


def _distinct(
    poses: FloatArray, costs: FloatArray, centred: FloatArray, apart_mm: float, most: int
) -> FloatArray:
    """(M, 12) the best poses, those that lie beside a better one left out."""
    radius = np.sqrt(np.mean(centred**2, axis=0))
    marks = np.concatenate([np.diag(radius) * 1.7, -np.diag(radius) * 1.7])
    kept: list[FloatArray] = []
    places: list[FloatArray] = []
    for k in np.argsort(costs, kind="stable").tolist():
        place = marks @ poses[k, :9].reshape(3, 3).T + poses[k, 9:]
        if places:
            off = np.linalg.norm(np.array(places) - place, axis=2).max(axis=1)
            if float(off.min()) < apart_mm:
                continue
        kept.append(poses[k])
        places.append(place)
        if len(kept) == most:
            break
    return np.array(kept)


def _typed(pose: FloatArray, middle: FloatArray) -> Pose[Cad, Part]:
    rotation = _orthonormal(pose[:9].reshape(3, 3))
    return Pose(rotation, pose[9:] - rotation @ middle)


def _orthonormal(matrix: FloatArray) -> FloatArray:
    """The turn nearest to a matrix that rounding has bent."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ vt)


def _refined(
    surface: PartSurface,
    points: FloatArray,
    normals: FloatArray | None,
    poses: list[Pose[Cad, Part]],
) -> list[Pose[Cad, Part]]:
    """Refine on the surface itself, with a few points first; the better ones with all."""
    few = _thinned(len(points), SOME)
    facing = None if normals is None else normals[few]
    poses = [closer(surface, points[few], facing, pose, 6) for pose in poses]
    sizes = [_distances(surface, points[few], facing, pose) for pose in poses]
    by_scale = np.argsort([robust_scale(d) for d in sizes])
    chosen = [poses[k] for k in by_scale[: 2 * FINAL]]
    return [closer(surface, points, normals, pose, 16, widened=WIDENED) for pose in chosen]


def _rated(
    surface: PartSurface,
    points: FloatArray,
    normals: FloatArray | None,
    poses: list[Pose[Cad, Part]],
) -> tuple[PoseCandidate, ...]:
    """The best pose, and those that fit nearly as well.

    Every point's squared deviation counts, clipped: a hole that one pose meets and another does
    not is a few points far off.
    """
    distances = [_distances(surface, points, normals, pose) for pose in poses]
    scales = [robust_scale(d) for d in distances]
    unit = max(min(scales), 1e-7 * surface.diagonal_mm)
    squares = [_clipped(d, unit) for d in distances]
    costs = np.array([float(one.mean()) for one in squares])
    order = np.argsort(costs, kind="stable")
    best = int(order[0])
    found: list[PoseCandidate] = []
    for k in order.tolist():
        is_equal = not is_significant(distances[k], distances[best], unit)
        if not found or (
            costs[k] < NEARLY * costs[best] + 1e-12 and _is_new(poses[k], found, points, surface)
        ):
            found.append(PoseCandidate(poses[k], float(costs[k]), scales[k], is_equal))
    return tuple(found[:FINAL])


def _distances(
    surface: PartSurface, points: FloatArray, normals: FloatArray | None, pose: Pose[Cad, Part]
) -> FloatArray:
    towards = None if normals is None else pose.rotate(normals)
    return surface.distance(pose.apply(points), towards=towards).signed_mm


def _is_new(
    pose: Pose[Cad, Part],
    found: list[PoseCandidate],
    points: FloatArray,
    surface: PartSurface,
) -> bool:
    """Whether a pose puts the points elsewhere than all poses found."""
    place = pose.apply(points)
    limit = APART * surface.diagonal_mm
    off = [np.linalg.norm(one.cad_from_part.apply(points) - place, axis=1).max() for one in found]
    return float(min(off)) > limit


LEAST_POINTS = 100
UNITS = (("metres", "m", 1000.0), ("inches", "inch", 25.4), ("centimetres", "cm", 10.0))
"""In words, as ``--unit`` calls it, and in mm."""
TOO_LARGE, TOO_SMALL = 6.0, 0.004
"""Extent of a cloud over the part's: a scan on a table is no six times larger than its part, nor is
a scan worth its name so small."""
LIKELY_SMALL = 0.2
"""A cloud is tried in another unit if it is larger than this over the part's extent then."""
DOUBTFUL = 0.001
"""Scatter over the cloud's extent above which other units are tried: tens of times that of a good
scan of a good part."""
MUCH_BETTER = 0.25
"""Part of that ratio which is left when the unit is the other one. Scaling alone leaves all of it:
a cloud laid on a flat face fits as well, over its extent, in any unit."""


def across_mm(points_mm: FloatArray) -> float:
    """Diagonal of the box about (N, 3) points, one of a hundred left out at either end."""
    low, high = np.percentile(points_mm, [1.0, 99.0], axis=0)
    return float(np.linalg.norm(high - low))


def scale_mismatch(surface: PartSurface, points_mm: FloatArray) -> FitFailure | None:
    """Notice a cloud or a part in another unit by comparing their sizes."""
    if len(points_mm) < LEAST_POINTS:
        return FitFailure(
            f"the cloud holds {len(points_mm)} points; {LEAST_POINTS} are needed",
            "scan more of the part",
        )
    ours, theirs = across_mm(points_mm), surface.diagonal_mm
    if TOO_SMALL * theirs < ours < TOO_LARGE * theirs:
        return None
    if UNITS[0][2] * ours < LIKELY_SMALL * theirs:
        return FitFailure(
            f"all points of the cloud lie within {ours:.2g} mm, and the part measures "
            f"{theirs:.4g} mm: in no unit they show anything of it",
            "scan more of the part",
        )
    ratio = ours / theirs
    unit = min(UNITS, key=lambda one: abs(abs(math.log(ratio)) - math.log(one[2])))
    return _refusal(unit, ours, theirs, is_model=ratio > 1.0)


def unit_mismatch(
    surface: PartSurface, cloud: PointCloud, best: PoseCandidate
) -> FitFailure | None:
    """Notice a cloud or a part in another unit by how much better the cloud fits when scaled.

    ``best`` is where the points, of a size that a scan may have, fit best as they are.
    """
    ours, theirs = across_mm(cloud.points_mm), surface.diagonal_mm
    if best.scale_mm <= DOUBTFUL * ours:
        return None
    for unit in UNITS:
        for is_model in (False, True):
            factor = 1.0 / unit[2] if is_model else unit[2]
            if not LIKELY_SMALL * theirs < factor * ours < TOO_LARGE * theirs:
                continue
            scaled = search_pose(surface, factor * cloud.points_mm, cloud.normals)[0]
            if scaled.scale_mm <= MUCH_BETTER * factor * best.scale_mm:
                return _refusal(unit, ours, theirs, is_model=is_model)
    return None


def _refusal(
    unit: tuple[str, str, float], ours: float, theirs: float, *, is_model: bool
) -> FitFailure:
    words, option, factor = unit
    other = "model" if is_model else "cloud"
    remedy = (
        f"if the model is in {words}, give --unit {option}; if the cloud is in mm and its part so "
        "large, cut it to the part with --region"
        if is_model
        else f"leave --unit {option} out if it was given; else multiply the cloud's coordinates by "
        f"{factor:g}, if they are in {words}"
    )
    return FitFailure(
        f"the cloud measures {ours:.4g} and the part {theirs:.4g} mm across: the {other} seems to "
        f"be in {words}",
        remedy,
    )
