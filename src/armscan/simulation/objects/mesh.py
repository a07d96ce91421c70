# SPDX-License-Identifier: Apache-2.0
"""Parts made of triangles, and the compiled search for where a ray meets them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, IntArray, frozen_floats
from armscan.simulation.kernels import Floats, Three, compiled
from armscan.simulation.optics.scene import OneColour

_LEAF = 4
"""Triangles that are not divided any further."""
_NODE, _TRIANGLE = 9, 9
"""Columns of a node: its box, the node after all below it, first triangle and count; of a
triangle: a corner and two edges."""
_EDGE = 1e-9
"""A ray may pass beside a triangle by this part of its size: no light falls between neighbours."""
_NEAR_MM = 1e-4
"""A point of the surface lies nearer than this to its triangle."""


@compiled
def _enters(data: Floats, box: int, start: Three, ray: Three, nearest: float) -> bool:
    """Whether a ray crosses a box before it has gone ``nearest``."""
    low, high = 0.0, nearest
    for k in range(3):
        first, last = data[box + k] - start[k], data[box + 3 + k] - start[k]
        if ray[k] == 0.0:
            if first > 0.0 or last < 0.0:
                return False
            continue
        one, other = first / ray[k], last / ray[k]
        low, high = max(low, min(one, other)), min(high, max(one, other))
    return low <= high


@compiled
def _hit(data: Floats, at: int, start: Three, ray: Three) -> float:
    """Distance along a ray to one triangle, by Moeller and Trumbore; infinite for none."""
    ax, ay, az = start[0] - data[at], start[1] - data[at + 1], start[2] - data[at + 2]
    ex, ey, ez = data[at + 3], data[at + 4], data[at + 5]
    fx, fy, fz = data[at + 6], data[at + 7], data[at + 8]
    px, py, pz = ray[1] * fz - ray[2] * fy, ray[2] * fx - ray[0] * fz, ray[0] * fy - ray[1] * fx
    size = ex * px + ey * py + ez * pz
    if size == 0.0:
        return np.inf
    u = (ax * px + ay * py + az * pz) / size
    qx, qy, qz = ay * ez - az * ey, az * ex - ax * ez, ax * ey - ay * ex
    v = (ray[0] * qx + ray[1] * qy + ray[2] * qz) / size
    if u < -_EDGE or v < -_EDGE or u + v > 1.0 + _EDGE:
        return np.inf
    away = (fx * qx + fy * qy + fz * qz) / size
    return float(away) if away > 0.0 else np.inf


@compiled
def meet_mesh(data: Floats, at: int, start: Three, ray: Three) -> float:
    """Distance along a ray to a mesh, both in its frame; infinite for none."""
    n = int(data[at])
    first = at + 2 + n * _NODE
    nearest, node = np.inf, 0
    while node < n:
        here = at + 2 + node * _NODE
        if not _enters(data, here, start, ray, nearest):
            node = int(data[here + 6])
            continue
        for k in range(int(data[here + 8])):
            triangle = first + (int(data[here + 7]) + k) * _TRIANGLE
            nearest = min(nearest, _hit(data, triangle, start, ray))
        node += 1
    return float(nearest)


@compiled
def _foot(data: Floats, at: int, x: float, y: float, z: float) -> float:
    """Distance of a point to one triangle."""
    ex, ey, ez = data[at + 3], data[at + 4], data[at + 5]
    fx, fy, fz = data[at + 6], data[at + 7], data[at + 8]
    px, py, pz = x - data[at], y - data[at + 1], z - data[at + 2]
    ee, ef, ff = (
        ex * ex + ey * ey + ez * ez,
        ex * fx + ey * fy + ez * fz,
        fx * fx + fy * fy + fz * fz,
    )
    pe, pf = px * ex + py * ey + pz * ez, px * fx + py * fy + pz * fz
    size = ee * ff - ef * ef
    if size <= 0.0:
        return np.inf
    u, v = (ff * pe - ef * pf) / size, (ee * pf - ef * pe) / size
    if u < 0.0 or v < 0.0 or u + v > 1.0:
        # on the border: the best of the three edges
        u, v = _on_border(ee, ef, ff, pe, pf)
    dx, dy, dz = px - u * ex - v * fx, py - u * ey - v * fy, pz - u * ez - v * fz
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@compiled
def _on_border(ee: float, ef: float, ff: float, pe: float, pf: float) -> tuple[float, float]:
    """Coordinates of the point of a triangle's border that is nearest to a point."""
    u1 = min(max(pe / ee, 0.0), 1.0)
    v2 = min(max(pf / ff, 0.0), 1.0)
    gg = ee - 2.0 * ef + ff
    w = min(max((pf - pe + ee - ef) / gg, 0.0), 1.0)
    best, found = np.inf, (0.0, 0.0)
    for u, v in ((u1, 0.0), (0.0, v2), (1.0 - w, w)):
        square = u * u * ee + 2.0 * u * v * ef + v * v * ff - 2.0 * (u * pe + v * pf)
        if square < best:
            best, found = square, (u, v)
    return found


@compiled
def _nearest(data: Floats, at: int, point: Three, reach: float) -> tuple[float, int]:
    """Distance to the nearest triangle within a reach, and where its numbers are; -1 for none."""
    n = int(data[at])
    first = at + 2 + n * _NODE
    best, found, node = reach, -1, 0
    while node < n:
        here = at + 2 + node * _NODE
        square = 0.0
        for k in range(3):
            beside = max(data[here + k] - point[k], point[k] - data[here + 3 + k], 0.0)
            square += beside * beside
        if square > best * best:
            node = int(data[here + 6])
            continue
        for k in range(int(data[here + 8])):
            triangle = first + (int(data[here + 7]) + k) * _TRIANGLE
            away = _foot(data, triangle, point[0], point[1], point[2])
            if away < best:
                best, found = away, triangle
        node += 1
    return best, found


@compiled
def mesh_normal(data: Floats, at: int, x: float, y: float, z: float) -> Three:
    """Normal, not of unit length, of the triangle on which a point lies."""
    _, found = _nearest(data, at, (x, y, z), _NEAR_MM)
    if found < 0:
        return 0.0, 0.0, 1.0
    ex, ey, ez = data[found + 3], data[found + 4], data[found + 5]
    fx, fy, fz = data[found + 6], data[found + 7], data[found + 8]
    return ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx


@compiled
def _meet_all(data: Floats, starts: Floats, rays: Floats, away: Floats) -> None:
    for i in range(len(away)):
        start = (starts[i, 0], starts[i, 1], starts[i, 2])
        away[i] = meet_mesh(data, 0, start, (rays[i, 0], rays[i, 1], rays[i, 2]))


@compiled
def _normals_of(data: Floats, points: Floats, normals: Floats) -> None:
    for i in range(len(points)):
        x, y, z = mesh_normal(data, 0, points[i, 0], points[i, 1], points[i, 2])
        length = math.sqrt(x * x + y * y + z * z)
        normals[i, 0], normals[i, 1], normals[i, 2] = x / length, y / length, z / length


@compiled
def _distances(data: Floats, points: Floats, away: Floats) -> None:
    for i in range(len(points)):
        away[i], _ = _nearest(data, 0, (points[i, 0], points[i, 1], points[i, 2]), np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Mesh(OneColour):
    """A closed surface of triangles in its own frame.

    Parameters
    ----------
    triangles_mm
        (T, 3, 3) corners, anticlockwise as seen from outside.
    colour
        (3,) albedo.

    Raises
    ------
    InputError
        If there are no triangles, or a corner is not finite.
    """

    triangles_mm: FloatArray
    colour: tuple[float, float, float] = (0.7, 0.7, 0.7)
    _numbers: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        triangles = frozen_floats(self.triangles_mm, (None, 3, 3), "triangles_mm")
        if len(triangles) == 0 or not bool(np.isfinite(triangles).all()):
            raise InputError("a part of no triangles, or with a corner that is no number")
        object.__setattr__(self, "triangles_mm", triangles)
        numbers = _numbers_of(triangles)
        object.__setattr__(self, "_numbers", frozen_floats(numbers, (None,), "numbers"))

    @property
    def numbers(self) -> FloatArray:
        """(D,) counts, nodes of the tree of boxes, triangles, for the compiled loops."""
        return self._numbers

    @property
    def bounds_mm(self) -> FloatArray:
        """(2, 3) least and largest coordinates."""
        corners = self.triangles_mm.reshape(-1, 3)
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    def intersect(self, origins_mm: FloatArray, directions: FloatArray) -> FloatArray:
        """As for `Surface`."""
        rays = np.ascontiguousarray(directions, dtype=np.float64)
        starts = np.array(np.broadcast_to(origins_mm, rays.shape), dtype=np.float64)
        away = np.zeros(len(rays))
        _meet_all(self._numbers, starts, rays, away)
        return away

    def normals(self, points_mm: FloatArray) -> FloatArray:
        """As for `Surface`: of the triangle, so that a round face has facets."""
        points = np.ascontiguousarray(points_mm, dtype=np.float64)
        normals = np.zeros(points.shape)
        _normals_of(self._numbers, points, normals)
        return normals

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """(N,) distance of points (N, 3) from the surface, without a sign."""
        points = np.ascontiguousarray(points_mm, dtype=np.float64)
        away = np.zeros(len(points))
        _distances(self._numbers, points, away)
        return away


def _numbers_of(triangles: FloatArray) -> FloatArray:
    """Tree of boxes over triangles (T, 3, 3), halved at the median, as one row of numbers."""
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    middle = 0.5 * (low + high)
    order: list[IntArray] = []
    nodes: list[list[float]] = []
    n_placed = 0
    waiting: list[IntArray | int] = [np.arange(len(triangles))]
    while waiting:
        item = waiting.pop()
        if isinstance(item, int):
            nodes[item][6] = len(nodes)
            continue
        is_leaf = len(item) <= _LEAF
        box = [*low[item].min(axis=0), *high[item].max(axis=0)]
        nodes.append([*box, 0.0, float(n_placed), float(len(item)) if is_leaf else 0.0])
        waiting.append(len(nodes) - 1)
        if is_leaf:
            order.append(item)
            n_placed += len(item)
            continue
        spread = np.ptp(middle[item], axis=0)
        half = len(item) // 2
        halves = item[np.argpartition(middle[item, int(np.argmax(spread))], half)]
        waiting += [halves[half:], halves[:half]]
    corners = triangles[np.concatenate(order)]
    edges = corners[:, 1:] - corners[:, :1]
    rows = np.concatenate([corners[:, 0], edges[:, 0], edges[:, 1]], axis=1)
    counts = [float(len(nodes)), float(len(triangles))]
    return np.concatenate([counts, np.ravel(nodes), rows.ravel()])
