# SPDX-License-Identifier: Apache-2.0
"""From a cloud to triangles that lie where points were measured, and nowhere else.

The surface is where a grid of heights over the points' tangent planes (Hoppe and others, "Surface
reconstruction from unorganized points", 1992) changes its sign, each plane weighted by its point's
variance and by a Gaussian of the distance (Kolluri, "Provably good moving least squares", 2008).
It lies ``sigma**2 / R`` too high over a face of radius R, sigma being 0.75 cells, and is rounded
over edges by about a cell.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from armscan.errors import EstimationError, OptionError
from armscan.geometry.arrays import ArrayRecord, BoolArray, FloatArray, IntArray, floats, ints
from armscan.kernels.grids import add_heights
from armscan.records.cloud import PointCloud

SIGMA_CELLS = 0.75
"""Of the Gaussian by which a point's plane is weighted."""
REACH_CELLS = 3.0 * SIGMA_CELLS
"""Nodes farther from every point than this are not known. A surface may cut the corner of a cell:
the corner opposite is 1.73 cells away."""
BLOCK_NODES = 64
"""Cells along the side of what is held in memory at a time."""
MOST_BLOCKS = 4000
"""Of cells near points: they take a minute or two."""
MOST_OF_TREE, MOST_EXPOSURES = 50_000, 100
"""Points and exposures that tell how far the lines of a scan lie apart."""
LARGEST_CELL = 0.2
"""Over the extent of the cloud."""
COVERED = 95.0
"""Percentage of the points that have another line within a cell."""
NEIGHBOURS = 64
"""Points, thinned to two a cell, within the reach of a flat face's cells."""
BORDER_SIGMAS = 0.9
"""As far aside the mean of the neighbours may lie; see `_is_among`."""
SAME_VERTEX_CELLS = 1e-4
LEAST_SIGMA_MM = 1e-4
LEAST_POINTS = 10


@dataclass(frozen=True, slots=True)
class SurfaceOptions:
    """How finely a surface is drawn.

    Parameters
    ----------
    cell_mm
        Size of a cell: what is smaller is smoothed. None for the distance within which
        95 % of the points have one of another exposure; of one exposure, twice that to the nearest.
    reach_mm
        No corner of a triangle lies farther than this from a measured point. None for a cell.

    Raises
    ------
    OptionError
        If one of them is not positive.
    """

    cell_mm: float | None = None
    reach_mm: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("--cell", self.cell_mm), ("--reach", self.reach_mm)):
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise OptionError(f"{name} is {value} mm", remedy="give a length above 0")


class ScannedSurface(ArrayRecord):
    """Triangles over measured points, in the frame of the cloud.

    Parameters
    ----------
    vertices_mm
        (V, 3) corners, each once.
    triangles
        (T, 3) rows of ``vertices_mm``, anticlockwise seen from the side of the scanner.
    cell_mm, reach_mm
        What it was drawn with.
    spacing_mm
        Distance within which most points have one of another exposure.
    n_points, n_without_normal
        Points that it rests on, and points that were left out because they have no normal.
    """

    vertices_mm: FloatArray = floats("V", 3)
    triangles: IntArray = ints("T", 3)
    cell_mm: float
    reach_mm: float
    spacing_mm: float
    n_points: int
    n_without_normal: int

    @property
    def area_mm2(self) -> float:
        """Sum of the triangles' areas."""
        a, b, c = (self.vertices_mm[self.triangles[:, k]] for k in range(3))
        return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())

    @property
    def n_border_edges(self) -> int:
        """Edges of one triangle only: rims of holes, and of what was scanned."""
        edges = np.sort(self.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        _, counts = np.unique(edges, axis=0, return_counts=True)
        return int((counts == 1).sum())


def draw_surface(cloud: PointCloud, options: SurfaceOptions | None = None) -> ScannedSurface:
    """Triangles over a cloud whose points have normals.

    Parameters
    ----------
    cloud
        Points with normals towards the scanner; those of (0, 0, 0) or NaN are left out.
    options
        Cell and reach.

    Raises
    ------
    EstimationError
        If no point has a normal, points are too few or too far apart for a surface, or the cell is
        so small that the grid would not fit.
    """
    options = options or SurfaceOptions()
    normals = cloud.normals
    has_normal = np.zeros(len(cloud), bool)
    if normals is not None:
        has_normal = np.abs(np.linalg.norm(normals, axis=1) - 1.0) < 1e-2
    if normals is None or not has_normal.any():
        raise EstimationError(
            "no point has a normal: which side of them is outside is not known",
            remedy="reconstruct the scan again; its clouds have normals where passes lie closely",
        )
    points = cloud.points_mm[has_normal]
    spacing = _cell_of(points, cloud.exposure[has_normal])
    cell = options.cell_mm or spacing
    extent = float(np.ptp(points, axis=0).max())
    if cell > LARGEST_CELL * extent:
        raise EstimationError(
            f"a cell of {cell:.3g} mm is large beside the {extent:.3g} mm of the cloud",
            remedy="give a smaller --cell, or leave it out and scan more densely",
        )
    reach = options.reach_mm or cell
    sigma = np.maximum(np.nan_to_num(cloud.sigma_noise_mm[has_normal]), LEAST_SIGMA_MM)
    grid = _Grid(points / cell, normals[has_normal], np.median(sigma) ** 2 / sigma**2)
    vertices, triangles = grid.crossed()
    is_held = _is_among(vertices * cell, points, cell, reach)
    vertices, triangles = _kept(vertices * cell, triangles, is_held)
    if len(triangles) == 0:
        raise EstimationError(
            f"no surface at a cell of {cell:.3g} mm and a reach of {reach:.3g} mm: the points lie "
            "too far apart",
            remedy="give a larger --cell",
        )
    return ScannedSurface(
        vertices_mm=vertices,
        triangles=triangles,
        cell_mm=float(cell),
        reach_mm=float(reach),
        spacing_mm=spacing,
        n_points=len(points),
        n_without_normal=int((~has_normal).sum()),
    )


def thinned_surface(
    surface: ScannedSurface, n_triangles: int, points_mm: FloatArray
) -> ScannedSurface:
    """The surface with about so many triangles (quadric errors, Garland and Heckbert 1997).

    Corners that come to lie farther than the reach from ``points_mm`` (N, 3) go with their
    triangles.
    """
    simplify = _package("fast_simplification").simplify
    found = simplify(
        np.array(surface.vertices_mm),
        np.array(surface.triangles, dtype=np.int32),
        target_count=n_triangles,
    )
    vertices, triangles = found[0].astype(np.float64), found[1].astype(np.int64)
    away = np.asarray(cKDTree(points_mm).query(vertices)[0])
    vertices, triangles = _kept(vertices, triangles, away <= surface.reach_mm)
    return replace(surface, vertices_mm=vertices, triangles=triangles)


def _package(name: str) -> Any:
    """An optional package.

    Raises
    ------
    OptionError
        If it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise OptionError(
            f"meshes need the package {name.partition('.')[0].replace('_', '-')}",
            remedy='install it: pip install "armscan[mesh]"',
        ) from error


def _is_among(vertices: FloatArray, points: FloatArray, cell: float, reach: float) -> BoolArray:
    """(V,) True where points lie near a vertex, and on all sides of it, or it on their border.

    Beyond a straight border the mean of the points, weighted by a Gaussian, lies farther away than
    0.8 of its sigma.
    """
    if len(vertices) == 0:
        return np.zeros(0, bool)
    thinned = points[_one_a_cell(np.floor(2.0 * points / cell).astype(np.int64))[0]]
    nearest_few = np.arange(1, min(NEIGHBOURS, len(thinned)) + 1)
    away, index = cKDTree(thinned).query(vertices, k=nearest_few)
    sigma = SIGMA_CELLS * cell
    weights = np.where(away < REACH_CELLS * cell, np.exp(-0.5 * (away / sigma) ** 2), 0.0)
    mean = np.einsum("vk,vkx->vx", weights, thinned[index])
    total = np.maximum(weights.sum(axis=1), 1e-300)
    aside = np.linalg.norm(mean / total[:, None] - vertices, axis=1)
    nearest = np.asarray(cKDTree(points).query(vertices, distance_upper_bound=reach)[0])
    return np.asarray((nearest <= reach) & (aside <= BORDER_SIGMAS * sigma))


def _cell_of(points: FloatArray, exposure: IntArray) -> float:
    """The distance to the nearest point of another exposure that most points have."""
    if len(points) < LEAST_POINTS:
        raise EstimationError(
            f"{len(points)} points with a normal are no surface",
            remedy="give the cloud of a whole scan",
        )
    thinned = np.arange(0, len(points), max(1, len(points) // MOST_OF_TREE))
    here, of = points[thinned], exposure[thinned]
    names = np.unique(of)
    if len(names) == 1:
        return 2.0 * float(np.median(np.asarray(cKDTree(here).query(here, k=2)[0])[:, 1]))
    chosen = np.random.default_rng(0).permutation(names)[:MOST_EXPOSURES]
    away = [cKDTree(here[of != one]).query(here[of == one])[0] for one in chosen]
    return float(np.percentile(np.concatenate(away), COVERED))


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """Points (N, 3) in cells, normals (N, 3) and weights (N,) over a grid of nodes."""

    points: FloatArray
    normals: FloatArray
    weights: FloatArray

    def crossed(self) -> tuple[FloatArray, IntArray]:
        """(V, 3) vertices in cells and (T, 3) triangles where the height changes its sign."""
        vertices: list[FloatArray] = []
        triangles: list[IntArray] = []
        n_before = 0
        for corner, chosen in self._blocks():
            found = self._block(corner, chosen)
            if found is not None:
                vertices.append(found[0])
                triangles.append(found[1] + n_before)
                n_before += len(found[0])
        if not vertices:
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
        return _welded(np.concatenate(vertices), np.concatenate(triangles))

    def _blocks(self) -> Iterator[tuple[IntArray, IntArray]]:
        """First node of each block near points, and the rows (K,) of the points near it."""
        low = np.floor((self.points - REACH_CELLS) / BLOCK_NODES).astype(np.int64)
        high = np.floor((self.points + REACH_CELLS) / BLOCK_NODES).astype(np.int64)
        first = low.min(axis=0)
        size = high.max(axis=0) - first + 1
        n = len(self.points)
        if float(np.prod(size.astype(np.float64))) * n > 2.0**62:
            raise _too_fine()
        keys = []
        for corner in np.ndindex(2, 2, 2):
            block = np.where(np.array(corner, bool), high, low) - first
            number = (block[:, 0] * size[1] + block[:, 1]) * size[2] + block[:, 2]
            keys.append(number * n + np.arange(n))
        number, rows = np.divmod(np.unique(np.concatenate(keys)), n)
        starts = np.flatnonzero(np.diff(number, prepend=-1))
        if len(starts) > MOST_BLOCKS:
            raise _too_fine()
        for start, stop in zip(starts, [*starts[1:], len(rows)], strict=True):
            place = np.array(np.unravel_index(number[start], size)) + first
            yield place * BLOCK_NODES, np.ascontiguousarray(rows[start:stop])

    def _block(self, corner: IntArray, chosen: IntArray) -> tuple[FloatArray, IntArray] | None:
        shape = np.full(3, BLOCK_NODES + 1)
        heights, totals = np.zeros(int(np.prod(shape))), np.zeros(int(np.prod(shape)))
        add_heights(
            np.ascontiguousarray(self.points),
            np.ascontiguousarray(self.normals),
            self.weights,
            chosen,
            corner,
            shape,
            REACH_CELLS,
            heights,
            totals,
        )
        is_known = (totals > 0.0).reshape(shape)
        height = np.divide(heights, totals, out=np.ones_like(heights), where=totals > 0.0)
        # the search looks at the cell below the node that the mask names
        is_cell = np.zeros(tuple(shape), bool)
        is_cell[1:, 1:, 1:] = _all_corners(is_known)
        signs = height.reshape(shape)
        if not is_cell.any() or not (signs.min() < 0.0 < signs.max()):
            return None
        try:
            found = _package("skimage.measure").marching_cubes(
                signs.astype(np.float32), 0.0, mask=is_cell, gradient_direction="descent"
            )
        except RuntimeError:  # no crossing among the cells that are known
            return None
        return found[0].astype(np.float64) + corner, found[1].astype(np.int64)


def _too_fine() -> EstimationError:
    return EstimationError(
        f"more than {MOST_BLOCKS * BLOCK_NODES**3:.1g} cells lie near the points",
        remedy="give a larger --cell",
    )


def _all_corners(is_known: BoolArray) -> BoolArray:
    """True for cells all of whose eight corners are known."""
    along = is_known[1:] & is_known[:-1]
    along = along[:, 1:] & along[:, :-1]
    return np.asarray(along[:, :, 1:] & along[:, :, :-1])


def _one_a_cell(cells: IntArray) -> tuple[IntArray, IntArray]:
    """First row of each distinct (3,) of ``cells`` (N, 3), and (N,) which of them each row has."""
    order = np.lexsort(cells.T)
    is_new = np.any(np.diff(cells[order], axis=0, prepend=cells[order[:1]] - 1) != 0, axis=1)
    index = np.zeros(len(cells), np.int64)
    index[order] = np.cumsum(is_new) - 1
    return order[is_new], index


def _welded(vertices: FloatArray, triangles: IntArray) -> tuple[FloatArray, IntArray]:
    """Vertices of neighbouring blocks made one, and triangles without an area left out."""
    first, index = _one_a_cell(np.rint(vertices / SAME_VERTEX_CELLS).astype(np.int64))
    joined = index[triangles]
    a, b, c = joined.T
    return vertices[first], joined[(a != b) & (b != c) & (c != a)]


def _kept(
    vertices: FloatArray, triangles: IntArray, is_near: BoolArray
) -> tuple[FloatArray, IntArray]:
    """The triangles all of whose corners are kept, and the vertices that they use."""
    triangles = triangles[is_near[triangles].all(axis=1)]
    used, index = np.unique(triangles, return_inverse=True)
    return vertices[used], index.reshape(-1, 3).astype(np.int64)
