# SPDX-License-Identifier: Apache-2.0
"""How good the points of a running scan are: seen square on, evenly covered, on the earlier passes,
on the model of the part.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from armscan.console.work import Worker
from armscan.errors import ArmscanError, EstimationError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Cad, Part, Pose
from armscan.inspection.cad.alignment import align_best
from armscan.inspection.cad.distance import PartSurface
from armscan.pipeline.live.session import ShownCloud
from armscan.pipeline.progress import Progress, silent
from armscan.records.cloud import PointCloud
from armscan.storage.parts.meshes import read_part

DRIFT_MM = 1.5
"""Points of an earlier pass within this distance carry the comparison of passes."""
LEAST_SHARED = 60
NEAR_MM, NEIGHBOURS, LEAST_OTHERS = 5.0, 24, 3
"""A surface is told from so many points so near, of them so many from other exposures: the live
cloud has a point every 0.5 mm of a line, so that a line alone never fills the number."""
THIN, FLAT = 0.01, 0.2
"""Squared widths of neighbours that tell a surface: across over along at least, off it over across
at most."""
PROVISIONAL = 4
"""The latest exposures have neighbours on one side only, and are asked again."""
MOST_ASKED = 100_000
"""Points whose surface is sought at a time: about a second of processor time."""
ALIGNED_POINTS, REACH_MM = 20_000, 5.0
GROWN = 1.5
"""The cloud is laid on its model anew when it has so many times the points."""


def coverage(points_mm: FloatArray, cell_mm: float) -> IntArray:
    """(N,) how many points lie in the cell of each point (N, 3)."""
    cells = np.floor(points_mm / cell_mm).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    widths = cells.max(axis=0, initial=0) + 1
    keys = np.ravel_multi_index(tuple(cells.T), tuple(widths.tolist()))
    _, place, count = np.unique(keys, return_inverse=True, return_counts=True)
    return np.asarray(count[place], dtype=np.int64)


def passes_apart_mm(earlier_mm: FloatArray, latest_mm: FloatArray) -> float | None:
    """Median distance of points (M, 3) from planes through their neighbours of (N, 3).

    None where too few of them lie near each other. A pass that lies apart from an earlier one by
    more than both scatter shows that arm, plate or scanner moved meanwhile.
    """
    if len(earlier_mm) < LEAST_SHARED or len(latest_mm) < LEAST_SHARED:
        return None
    step = max(1, len(latest_mm) // 2000)
    chosen = latest_mm[::step]
    low, high = chosen.min(axis=0) - DRIFT_MM, chosen.max(axis=0) + DRIFT_MM
    earlier_mm = earlier_mm[((earlier_mm >= low) & (earlier_mm <= high)).all(axis=1)]
    if len(earlier_mm) < LEAST_SHARED:
        return None
    distance, near = cKDTree(earlier_mm).query(chosen, k=12)
    met: BoolArray = np.asarray(distance)[:, 7] < DRIFT_MM
    if met.sum() < LEAST_SHARED // 4:
        return None
    neighbours = earlier_mm[np.asarray(near)[met]]
    middle = neighbours.mean(axis=1)
    spread = np.einsum("nki,nkj->nij", neighbours - middle[:, None], neighbours - middle[:, None])
    values, vectors = np.linalg.eigh(spread)
    is_flat = values[:, 1] > 25.0 * np.maximum(values[:, 0], 1e-9)
    if is_flat.sum() < LEAST_SHARED // 4:
        return None
    normals = vectors[is_flat, :, 0]
    apart = np.einsum("ni,ni->n", chosen[met][is_flat] - middle[is_flat], normals)
    # normals have no common side on an open surface: what counts is how far, not where to
    return float(np.median(np.abs(apart)))


@dataclass(slots=True)
class Incidence:
    """Angles between surface and line of sight in a cloud that grows; what is known is kept."""

    _known: dict[int, FloatArray] = field(default_factory=dict)

    def angles_deg(self, cloud: ShownCloud, seen_from_mm: Mapping[int, FloatArray]) -> FloatArray:
        """(N,) for each point; nan where its neighbours tell no surface, or it was not asked yet.

        A call asks for the newest exposures that are not known, up to 100,000 points: a large cloud
        is known after some calls.

        ``seen_from_mm``: (3,) where the sensor stood, by exposure.
        """
        number, start, count = np.unique(cloud.exposure, return_index=True, return_counts=True)
        if not len(number):
            return np.zeros(0)
        latest = number.max() - PROVISIONAL
        is_new = np.array(
            [
                one > latest or len(self._known.get(one, ())) != n
                for one, n in zip(number.tolist(), count.tolist(), strict=True)
            ]
        )
        later = np.cumsum((count * is_new)[::-1])[::-1]
        fresh = is_new & (later <= max(MOST_ASKED, count[-1]))
        self._ask(cloud, number[fresh], seen_from_mm)
        angles = np.full(len(cloud.points_mm), np.nan)
        for one, first, n in zip(number.tolist(), start.tolist(), count.tolist(), strict=True):
            if len(self._known.get(one, ())) == n:
                angles[first : first + n] = self._known[one]
        return angles

    def _ask(
        self, cloud: ShownCloud, fresh: IntArray, seen_from_mm: Mapping[int, FloatArray]
    ) -> None:
        low, high = fresh.min() - 2 * PROVISIONAL, fresh.max() + 2 * PROVISIONAL
        is_pool = (cloud.exposure >= low) & (cloud.exposure <= high)
        points, exposure = cloud.points_mm[is_pool], cloud.exposure[is_pool]
        is_asked = np.isin(exposure, fresh)
        normals = surface_normals(points, exposure, is_asked)
        asked, own = points[is_asked], exposure[is_asked]
        nowhere = np.full(3, np.nan)
        places = np.array([seen_from_mm.get(one, nowhere) for one in fresh.tolist()])
        sight = places[np.searchsorted(fresh, own)] - asked
        cosine = np.einsum("ni,ni->n", sight, normals) / np.linalg.norm(sight, axis=1)
        angles = np.degrees(np.arccos(np.clip(np.abs(cosine), 0.0, 1.0)))
        for one in fresh.tolist():
            self._known[one] = angles[own == one]


def surface_normals(points_mm: FloatArray, exposure: IntArray, is_asked: BoolArray) -> FloatArray:
    """(M, 3) unit normals, of either side, at the points asked for; nan where there is no surface.

    ``points_mm``: (N, 3) points, on lines. ``exposure``: (N,) which line.
    """
    normals = np.full((int(is_asked.sum()), 3), np.nan)
    if len(points_mm) <= NEIGHBOURS:
        return normals
    distance, near = cKDTree(points_mm).query(points_mm[is_asked], k=NEIGHBOURS)
    is_near = np.asarray(distance) < NEAR_MM
    is_other = is_near & (exposure[near] != exposure[is_asked][:, None])
    weight = is_near / np.maximum(is_near.sum(axis=1), 1)[:, None]
    neighbours = points_mm[near]
    offset = neighbours - np.einsum("nk,nki->ni", weight, neighbours)[:, None]
    values, vectors = np.linalg.eigh(np.einsum("nk,nki,nkj->nij", weight, offset, offset))
    is_surface = is_other.sum(axis=1) >= LEAST_OTHERS
    is_surface &= values[:, 1] > THIN * values[:, 2]
    is_surface &= values[:, 0] < FLAT * values[:, 1]
    normals[is_surface] = vectors[is_surface, :, 0]
    return normals


@lru_cache(maxsize=2)
def _surface(path: str, changed_ns: int) -> PartSurface:
    """The model; ``changed_ns`` is the file's time."""
    return PartSurface(read_part(Path(path)))


def deviations_mm(
    part: Path, points_mm: FloatArray, pose: Pose[Cad, Part] | None, progress: Progress = silent
) -> tuple[Pose[Cad, Part], FloatArray]:
    """Signed distances of a cloud from the model of its part, positive outside.

    Parameters
    ----------
    part
        The model.
    points_mm
        (N, 3) points.
    pose
        Where they lie on it; None to lay them as `armscan.inspection.cad.alignment.align_best`.
    progress
        Not told.

    Returns
    -------
    pose
        As given or found.
    deviation
        (N,) mm; nan beyond 5 mm, as of a table beside the part.

    Raises
    ------
    ArmscanError
        If the model is unreadable, or the points do not fit it.
    """
    surface = _surface(str(part), part.stat().st_mtime_ns)
    if pose is None:
        chosen = points_mm[:: -(-len(points_mm) // ALIGNED_POINTS)]
        found = align_best(surface, _bare_cloud(chosen), errors_known=False)
        if isinstance(found, FitFailure):
            raise EstimationError(found.reason, remedy="scan more of the part")
        pose = found.cad_from_part
    distance = surface.distance(pose.apply(points_mm), reach_mm=REACH_MM).signed_mm
    return pose, np.where(np.abs(distance) < REACH_MM, distance, np.nan)


def _bare_cloud(points_mm: FloatArray) -> PointCloud:
    n = len(points_mm)
    none = np.zeros(n, dtype=np.int64)
    return PointCloud(
        frame="Base",
        points_mm=points_mm,
        covariance_mm2=np.zeros((n, 3, 3)),
        sigma_noise_mm=np.zeros(n),
        sheet=none,
        sheet_names=("live",),
        exposure=none,
        exposure_sources=("live",),
        segment=none,
        intensity=np.zeros(n),
    )


class ModelWatch:
    """Compares a cloud that grows with the model of its part, without making anyone wait.

    While ``worker`` does other work, nothing is compared.
    """

    def __init__(self, worker: Worker, part: Path) -> None:
        self.problem = ""
        self._worker, self._part = worker, part
        self._thread: threading.Thread | None = None
        self._lock, self._is_over = threading.Lock(), False
        self._pose: Pose[Cad, Part] | None = None
        self._n_laid = 0
        nothing = np.zeros(0, dtype=np.int64)
        empty = ShownCloud(np.zeros((0, 3)), nothing, np.zeros(0), nothing)
        self._found: tuple[ShownCloud, FloatArray] = empty, np.zeros(0)

    def latest(self, cloud: ShownCloud) -> tuple[ShownCloud, FloatArray]:
        """What was compared last, and its (N,) deviations; asks for those of a newer cloud."""
        with self._lock:
            is_free = self._thread is None or not self._thread.is_alive()
            if is_free and not self._is_over and len(cloud.points_mm) != len(self._found[1]):
                self._thread = threading.Thread(target=self._ask, args=(cloud,), daemon=True)
                self._thread.start()
        return self._found

    def end(self) -> None:
        """Wait for what is being compared, and compare no more: the worker is free then."""
        with self._lock:
            self._is_over = True
        if self._thread is not None:
            self._thread.join()

    def _ask(self, cloud: ShownCloud) -> None:
        n = len(cloud.points_mm)
        is_laid = self._pose is not None and n < GROWN * self._n_laid
        pose = self._pose if is_laid else None
        try:
            self._pose, found = self._worker.run(deviations_mm, self._part, cloud.points_mm, pose)
        except (ArmscanError, OSError) as error:
            self.problem = str(error)
            return
        self._n_laid = self._n_laid if is_laid else n
        self._found, self.problem = (cloud, found), ""
