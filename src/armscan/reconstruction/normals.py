# SPDX-License-Identifier: Apache-2.0
"""Surface normals of a merged cloud, from neighbouring points of all exposures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray

NEIGHBOURS = 32
"""Cells looked at around a point, at most: a full disc of four cells' radius holds 50."""


@dataclass(frozen=True, slots=True)
class NormalOptions:
    """What counts as a neighbourhood.

    Parameters
    ----------
    radius_mm
        Points within this distance make a point's tangent plane.
    min_neighbours
        Fewest cells (a quarter of the radius wide) with points in that neighbourhood.
    min_width
        The neighbourhood must be at least this wide across its longest direction, as a standard
        deviation in parts of the radius: a single stripe has no normal.
    max_thickness
        Largest ratio of its standard deviation along the normal to that width: at an edge, or
        where surfaces lie close to each other, there is no tangent plane.
    """

    radius_mm: float = 2.0
    min_neighbours: int = 6
    min_width: float = 0.15
    max_thickness: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.radius_mm < np.inf:
            raise OptionError(f"radius of the normals {self.radius_mm} mm", remedy="give some mm")
        if self.min_neighbours < 3 or not 0.0 < self.min_width < 1.0 or self.max_thickness <= 0.0:
            raise OptionError("the normals' neighbourhood needs 3 cells, a width and a thickness")


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
        Defaults if None.

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
    cells = _cell_means(points, options.radius_mm / 4.0)
    distance, neighbour = cKDTree(cells).query(
        points, k=NEIGHBOURS, distance_upper_bound=options.radius_mm
    )
    is_near = np.isfinite(distance)
    normals = _tangent_normals(points, cells, np.asarray(neighbour, np.int64), is_near, options)
    side = np.einsum("ni,ni->n", normals, towards - points)
    return np.where(side[:, None] < 0.0, -normals, normals)


def _cell_means(points: FloatArray, size_mm: float) -> FloatArray:
    """(M, 3) mean of the points of every cubic cell that holds any."""
    origin = points.min(axis=0)
    cell = np.floor((points - origin) / size_mm).astype(np.int64)
    spans = cell.max(axis=0) + 1
    key = (cell[:, 0] * spans[1] + cell[:, 1]) * spans[2] + cell[:, 2]
    _, member = np.unique(key, return_inverse=True)
    count = np.bincount(member)
    sums = [np.bincount(member, weights=points[:, k]) for k in range(3)]
    return np.stack(sums, axis=1) / count[:, None]


def _tangent_normals(
    points: FloatArray,
    cells: FloatArray,
    neighbour: IntArray,
    is_near: BoolArray,
    options: NormalOptions,
) -> FloatArray:
    """(N, 3) direction of least spread of each neighbourhood, zero where it tells nothing."""
    weight = np.asarray(is_near, dtype=np.float64)
    count = weight.sum(axis=1)
    around = cells[np.where(is_near, neighbour, 0)] - points[:, None]
    around *= weight[:, :, None]
    safe = np.maximum(count, 1.0)
    mean = around.sum(axis=1) / safe[:, None]
    spread = around.transpose(0, 2, 1) @ around / safe[:, None, None]
    spread -= mean[:, :, None] * mean[:, None, :]
    values, vectors = np.linalg.eigh(spread)
    thickness, width = np.sqrt(np.maximum(values[:, :2], 0.0)).T
    is_plane = (
        (count >= options.min_neighbours)
        & (width >= options.min_width * options.radius_mm)
        & (thickness <= options.max_thickness * width)
    )
    return np.where(is_plane[:, None], vectors[:, :, 0], 0.0)
