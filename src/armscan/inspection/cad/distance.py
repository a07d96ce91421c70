# SPDX-License-Identifier: Apache-2.0
"""Signed distance of points from the surface of a part, by the true closest point."""

from __future__ import annotations

import math
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray, RowRecord, floats, ints
from armscan.inspection.cad.part import PartModel, edges_of
from armscan.kernels.mesh_search import (
    AT_A,
    AT_B,
    AT_C,
    ON_AB,
    ON_BC,
    ON_CA,
    build_tree,
    find_closest,
)

NEIGHBOUR_BITS = 10
"""Cells an axis, as a power of two, by which points are sorted so that neighbours come together."""
OPPOSITE = -0.5
"""Cosine below which a surface looks away from a point's normal: the other side of a wall is at -1,
and normals that were estimated beside an edge may be 90 degrees off."""
LEAST_CHUNK = 2000
"""Points a thread takes at least."""


class SurfaceDistance(RowRecord):
    """Where on a part N points belong.

    Parameters
    ----------
    signed_mm
        (N,) distance, positive outside; NaN where no surface is within reach.
    closest_mm
        (N, 3) closest points of the surface; the points themselves where there is none.
    normals
        (N, 3) outward unit direction in which the distance grows: from the closest point to the
        point, or the other way inside; the surface's normal for points on it.
    triangle
        (N,) triangle of the part, -1 for none.
    """

    signed_mm: FloatArray = floats("N", nan=True)
    closest_mm: FloatArray = floats("N", 3)
    normals: FloatArray = floats("N", 3)
    triangle: IntArray = ints("N")


class PartSurface:
    """A part that distances can be asked of.

    Points beside an edge or a corner are inside or outside by the angle-weighted normal there,
    which is right for every closed surface (Baerentzen and Aanaes 2005).

    Attributes
    ----------
    diagonal_mm
        Of the box about the part.
    """

    def __init__(self, part: PartModel) -> None:
        self.part = part
        self.diagonal_mm = part.diagonal_mm
        corners, self._normals = part.corners_mm, part.normals
        boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
        n = len(corners)
        order = np.arange(n, dtype=np.int64)
        nodes, links = np.zeros((2 * n, 6)), np.zeros((2 * n, 2))
        count = build_tree(np.ascontiguousarray(boxes), order, nodes, links)
        self._nodes, self._links = nodes[:count].copy(), links[:count].astype(np.int64)
        self._order = order
        a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        products = [np.einsum("ij,ij->i", p, q) for p, q in ((u, u), (u, v), (v, v))]
        rows = np.concatenate([a, u, v, self._normals, np.stack(products, axis=1)], axis=1)
        self._triangles = np.ascontiguousarray(rows[order])
        counts = np.bincount(edges_of(part.triangles)[1].ravel())
        self.is_closed = bool((counts == 2).all())
        self._edge_normals, self._edge_number, self._vertex_normals = _pseudo_normals(part)

    def distance(
        self,
        points_mm: FloatArray,
        *,
        reach_mm: float = math.inf,
        towards: FloatArray | None = None,
        sight: FloatArray | None = None,
    ) -> SurfaceDistance:
        """Distances of points.

        Parameters
        ----------
        points_mm
            (N, 3) in the Cad frame.
        reach_mm
            Nothing is sought farther.
        towards
            (N, 3) outward unit normals of the points, or None. With them a point belongs to a
            surface that looks its way: the two sides of a thin wall are told apart, also where
            the wall is displaced by more than half of its thickness. Where none within reach
            does, the closest surface counts.
        sight
            (N, 3) directions to where the points were seen from, or None. With them the closest
            surface counts also where it could be seen from there, whatever ``towards`` says:
            normals of a lone stripe on a wall may point to any side.
        """
        points = np.ascontiguousarray(points_mm, dtype=np.float64)
        order = neighbour_order(points)
        found = self._closest(points, order, np.zeros((0, 3)), reach_mm)
        if towards is not None:
            rows = found[0].copy()
            rows[rows >= 0] = self._order[rows[rows >= 0]]
            looks_away = (rows >= 0) & (
                np.einsum("ij,ij->i", self._normals[rows], towards) < OPPOSITE
            )
            if sight is not None:
                looks_away &= np.einsum("ij,ij->i", self._normals[rows], sight) < 0.0
            again = order[looks_away[order]]
            second = self._closest(points, again, np.ascontiguousarray(towards), reach_mm)
            replaced = looks_away & (second[0] >= 0)
            for first, other in zip(found, second, strict=True):
                first[replaced] = other[replaced]
        return self._signed(points, *found)

    def _closest(
        self, points: FloatArray, order: IntArray, towards: FloatArray, reach_mm: float
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Row in the tree's order, place on the triangle, and closest point of each."""
        n = len(points)
        face, place = np.full(n, -1, dtype=np.int64), np.zeros(n, dtype=np.int64)
        closest = points.copy()

        def work(rows: IntArray) -> None:
            find_closest(
                points, rows, towards, 0.0, reach_mm, self._nodes, self._links,
                self._triangles, face, place, closest,
            )  # fmt: skip

        threads = min(os.cpu_count() or 1, max(1, len(order) // LEAST_CHUNK))
        if threads == 1:
            work(order)
        else:
            # more chunks than threads: points far from the surface take longer
            chunks = np.array_split(order, 4 * threads)
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(work, chunks))
        return face, place, closest

    def _signed(
        self, points: FloatArray, row: IntArray, place: IntArray, closest: FloatArray
    ) -> SurfaceDistance:
        triangle = np.where(row >= 0, self._order[row], -1)
        pseudo = self._normals_at(triangle, place)
        offset = points - closest
        length = np.linalg.norm(offset, axis=1)
        sign = np.where(np.einsum("ij,ij->i", offset, pseudo) < 0.0, -1.0, 1.0)
        is_off = length > 1e-9 * self.diagonal_mm
        direction = offset * (sign / np.where(is_off, length, 1.0))[:, None]
        return SurfaceDistance(
            signed_mm=np.where(triangle >= 0, sign * length, np.nan),
            closest_mm=closest,
            normals=np.where(is_off[:, None], direction, pseudo),
            triangle=triangle,
        )

    def _normals_at(self, triangle: IntArray, place: IntArray) -> FloatArray:
        """(N, 3) unit normals of the surface where the closest points lie."""
        normals = self._normals[triangle]
        for code, column in ((ON_AB, 0), (ON_BC, 1), (ON_CA, 2)):
            at = np.flatnonzero(place == code)
            normals[at] = self._edge_normals[self._edge_number[triangle[at], column]]
        for code, column in ((AT_A, 0), (AT_B, 1), (AT_C, 2)):
            at = np.flatnonzero(place == code)
            normals[at] = self._vertex_normals[self.part.triangles[triangle[at], column]]
        return normals


def neighbour_order(points_mm: FloatArray) -> IntArray:
    """(N,) rows of points along a curve that fills space, so that neighbours follow each other."""
    if len(points_mm) == 0:
        return np.zeros(0, dtype=np.int64)
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    step = max(float((high - low).max()), 1e-12) / (2**NEIGHBOUR_BITS - 1)
    cells = ((points_mm - low) / step).astype(np.int64)
    key = np.zeros(len(points_mm), dtype=np.int64)
    for bit in range(NEIGHBOUR_BITS):
        for axis in range(3):
            key |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(key, kind="stable")


def _pseudo_normals(part: PartModel) -> tuple[FloatArray, IntArray, FloatArray]:
    """(E, 3) normals of edges, (F, 3) edges of each triangle, (V, 3) normals of corners."""
    normals = part.normals
    edges, number = edges_of(part.triangles)
    by_edge = _summed(number.ravel(), np.repeat(normals, 3, axis=0), len(edges))
    corners = part.corners_mm
    forward = np.roll(corners, -1, axis=1) - corners
    forward = forward / np.linalg.norm(forward, axis=2, keepdims=True)
    backward = -np.roll(forward, 1, axis=1)
    angle = np.arccos(np.clip(np.einsum("fij,fij->fi", forward, backward), -1.0, 1.0))
    weighted = (angle[:, :, None] * normals[:, None, :]).reshape(-1, 3)
    by_vertex = _summed(part.triangles.ravel(), weighted, len(part.vertices_mm))
    return by_edge, number, by_vertex


def _summed(index: IntArray, vectors: FloatArray, count: int) -> FloatArray:
    """(count, 3) unit sums of vectors by their index; of a sum of zero the last vector."""
    total = np.stack([np.bincount(index, vectors[:, k], count) for k in range(3)], axis=1)
    size = np.linalg.norm(total, axis=1)
    last = np.zeros((count, 3))
    last[index] = vectors
    total = np.where((size > 1e-9)[:, None], total, last)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None])
