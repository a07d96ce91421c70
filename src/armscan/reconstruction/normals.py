# SPDX-License-Identifier: Apache-2.0
"""Surface normals of a merged cloud, from neighbouring points of all exposures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import FloatArray, IntArray

NEIGHBOURS = 32
"""Cells looked at around a point, at most: a full disc of four cells' radius holds 50."""
SMALLEST_RADIUS_MM, LARGEST_RADIUS_MM = 2.0, 20.0
"""Limits of the radius chosen by itself."""
SPACINGS = 2.5
"""It reaches that many times as far as the next exposure's stripe usually is."""
SAMPLED, LOOKED_AT = 2000, 64
"""Points whose spacing is measured, and neighbouring cells among which another exposure is sought;
cells are a quarter of the smallest radius wide."""


@dataclass(frozen=True, slots=True)
class NormalOptions:
    """What counts as a neighbourhood.

    Parameters
    ----------
    radius_mm
        Points within this distance make a point's tangent plane; None to choose it from the
        distance between the stripes of different exposures.
    min_neighbours
        Fewest cells (a quarter of the radius wide) with points in that neighbourhood.
    min_width
        The neighbourhood must be at least this wide across its longest direction, as a standard
        deviation in parts of the radius: a single stripe has no normal.
    max_thickness
        Largest ratio of its standard deviation along the normal to that width: at an edge, or
        where surfaces lie close to each other, there is no tangent plane.
    """

    radius_mm: float | None = None
    min_neighbours: int = 6
    min_width: float = 0.15
    max_thickness: float = 0.5

    def __post_init__(self) -> None:
        if self.radius_mm is not None and not 0.0 < self.radius_mm < np.inf:
            raise OptionError(f"radius of the normals {self.radius_mm} mm", remedy="give some mm")
        if self.min_neighbours < 3 or not 0.0 < self.min_width < 1.0 or self.max_thickness <= 0.0:
            raise OptionError("the normals' neighbourhood needs 3 cells, a width and a thickness")


def choose_radius_mm(points_mm: FloatArray, exposure: IntArray) -> float:
    """Radius that holds stripes of several exposures around most points.

    Parameters
    ----------
    points_mm
        (N, 3).
    exposure
        (N,) number of the exposure that each belongs to.

    Returns
    -------
    float
        `SPACINGS` times the distance to the next exposure's stripe, taken so that three points in
        four have it; within the limits above.
    """
    size = SMALLEST_RADIUS_MM / 4.0
    if len(points_mm) == 0:
        return SMALLEST_RADIUS_MM
    cells, owner = _cells_of_exposures(points_mm, exposure, size)
    sample = np.arange(0, len(cells), max(1, len(cells) // SAMPLED))
    count = min(LOOKED_AT, len(cells))
    distance, neighbour = cKDTree(cells).query(cells[sample], k=np.arange(1, count + 1))
    is_other = owner[neighbour] != owner[sample, None]
    spacing = np.where(is_other, distance, np.inf).min(axis=1)
    spacing = np.minimum(spacing, LARGEST_RADIUS_MM)
    wanted = SPACINGS * float(np.percentile(spacing, 75))
    return float(np.clip(wanted, SMALLEST_RADIUS_MM, LARGEST_RADIUS_MM))


def estimate_normals(
    points_mm: FloatArray, towards_mm: FloatArray, options: NormalOptions | None = None
) -> FloatArray:
    """Fit a tangent plane around every point.

    Points lie much closer along a stripe than across stripes. So the cloud is thinned first, to
    one mean a cell of a quarter of the radius; each point's plane is that of the cells around it.

    Parameters
    ----------
    points_mm
        (N, 3) in one frame.
    towards_mm
        (N, 3) where each point was seen from, in that frame: its normal points to that side.
    options
        Defaults if None; without a radius the smallest one is taken (see `choose_radius_mm`).

    Returns
    -------
    FloatArray
        (N, 3) unit normals; (0, 0, 0) where there is none: too few neighbours, all of them on one
        line, or no tangent plane (see `NormalOptions`).

    Raises
    ------
    InputError
        If the shapes differ.
    """
    options = options or NormalOptions()
    points = np.asarray(points_mm, dtype=np.float64)
    towards = np.asarray(towards_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or towards.shape != points.shape:
        raise InputError(f"points of shape {points.shape} seen from places {towards.shape}")
    if len(points) == 0:
        return np.zeros((0, 3))
    radius = options.radius_mm or SMALLEST_RADIUS_MM
    cells = _cell_means(points, _cell_keys(points, radius / 4.0))
    distance, neighbour = cKDTree(cells).query(points, k=NEIGHBOURS, distance_upper_bound=radius)
    around = np.where(np.isfinite(distance), np.asarray(neighbour, np.int64), -1)
    normals = _tangent_normals(points, cells, around, radius, options)
    side = np.einsum("ni,ni->n", normals, towards - points)
    return np.where(side[:, None] < 0.0, -normals, normals)


def _cell_keys(points: FloatArray, size_mm: float) -> IntArray:
    """(N,) number of the cubic cell that each point lies in."""
    cell = np.floor((points - points.min(axis=0)) / size_mm).astype(np.int64)
    spans = cell.max(axis=0) + 1
    return np.asarray((cell[:, 0] * spans[1] + cell[:, 1]) * spans[2] + cell[:, 2])


def _cell_means(points: FloatArray, keys: IntArray) -> FloatArray:
    """(M, 3) mean of the points of equal key, by rising key."""
    _, member = np.unique(keys, return_inverse=True)
    sums = [np.bincount(member, weights=points[:, k]) for k in range(3)]
    return np.stack(sums, axis=1) / np.bincount(member)[:, None]


def _cells_of_exposures(
    points: FloatArray, exposure: IntArray, size_mm: float
) -> tuple[FloatArray, IntArray]:
    """(M, 3) means of the points of one cell and one exposure, and (M,) their exposure."""
    keys = _cell_keys(points, size_mm) * (int(exposure.max()) + 1) + exposure
    return _cell_means(points, keys), np.unique(keys) % (int(exposure.max()) + 1)


def _tangent_normals(
    points: FloatArray,
    cells: FloatArray,
    neighbour: IntArray,
    radius_mm: float,
    options: NormalOptions,
) -> FloatArray:
    """(N, 3) direction of least spread of each neighbourhood, zero where it tells nothing.

    ``neighbour`` is (N, K), -1 for none.
    """
    weight = (neighbour >= 0).astype(np.float64)
    count = weight.sum(axis=1)
    around = cells[np.maximum(neighbour, 0)] - points[:, None]
    around *= weight[:, :, None]
    safe = np.maximum(count, 1.0)
    mean = around.sum(axis=1) / safe[:, None]
    spread = around.transpose(0, 2, 1) @ around / safe[:, None, None]
    spread -= mean[:, :, None] * mean[:, None, :]
    values, vectors = np.linalg.eigh(spread)
    thickness, width = np.sqrt(np.maximum(values[:, :2], 0.0)).T
    is_plane = (
        (count >= options.min_neighbours)
        & (width >= options.min_width * radius_mm)
        & (thickness <= options.max_thickness * width)
    )
    return np.where(is_plane[:, None], vectors[:, :, 0], 0.0)
