# SPDX-License-Identifier: Apache-2.0
"""The model of a part: triangles with shared corners, and the faces that they belong to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from armscan.errors import InputError
from armscan.geometry.arrays import ArrayRecord, FloatArray, IntArray, floats, ints

CREASE_DEG = 25.0
"""Triangles that meet at a lesser angle belong to one face, where a file names no faces: a cylinder
of 16 sides stays one face, and a chamfer of 30 degrees is one of its own."""
SAME_PLACE = 1e-7
"""Corners this near, over the part's diagonal, are one: STL files hold each corner once a triangle,
rounded to seven digits."""
LEAST_HEIGHT = 1e-9
"""Triangles flatter than this over the diagonal have no normal and are left out."""
LEAST_TRIANGLES = 4


class PartModel(ArrayRecord):
    """The surface that a part should have, in the Cad frame.

    Parameters
    ----------
    vertices_mm
        (V, 3) corners, each once.
    triangles
        (F, 3) rows of ``vertices_mm``, anticlockwise seen from outside.
    face
        (F,) index into ``face_names``.
    """

    vertices_mm: FloatArray = floats("V", 3)
    triangles: IntArray = ints("F", 3)
    face: IntArray = ints("F")
    face_names: tuple[str, ...]
    source: str
    notes: tuple[str, ...] = ()

    @property
    def corners_mm(self) -> FloatArray:
        """(F, 3, 3) corners of each triangle."""
        return np.asarray(self.vertices_mm[self.triangles])

    @property
    def areas_mm2(self) -> FloatArray:
        """(F,) areas of the triangles."""
        return np.asarray(0.5 * np.linalg.norm(_crosses(self.corners_mm), axis=1))

    @property
    def normals(self) -> FloatArray:
        """(F, 3) unit normals of the triangles."""
        cross = _crosses(self.corners_mm)
        return np.asarray(cross / np.linalg.norm(cross, axis=1)[:, None])

    @property
    def low_mm(self) -> FloatArray:
        """(3,) low corner of the box about the part."""
        return np.asarray(self.vertices_mm.min(axis=0))

    @property
    def high_mm(self) -> FloatArray:
        """(3,) high corner of the box about the part."""
        return np.asarray(self.vertices_mm.max(axis=0))

    @property
    def diagonal_mm(self) -> float:
        """Length of the box's diagonal."""
        return float(np.linalg.norm(self.high_mm - self.low_mm))

    def surface_points(self, count: int, seed: int = 0) -> tuple[FloatArray, IntArray]:
        """(count, 3) points spread evenly over the surface, and the triangle of each."""
        random = np.random.default_rng(seed)
        areas = self.areas_mm2
        chosen = random.choice(len(areas), count, p=areas / areas.sum())
        s, t = random.random((2, count))
        beyond = s + t > 1.0
        s, t = np.where(beyond, 1.0 - s, s), np.where(beyond, 1.0 - t, t)
        a, b, c = (self.corners_mm[chosen, k] for k in range(3))
        return a + s[:, None] * (b - a) + t[:, None] * (c - a), chosen.astype(np.int64)


def part_of(
    corners_mm: FloatArray,
    *,
    source: str,
    face: IntArray | None = None,
    face_names: Sequence[str] = (),
) -> PartModel:
    """Join loose triangles to a part.

    ``corners_mm``: (F, 3, 3) corners of each triangle. ``face``, ``face_names``: (F,) face of each
    triangle and the faces' names; None to group them by creases.
    """
    if not np.isfinite(corners_mm).all():
        bad = int((~np.isfinite(corners_mm).all(axis=(1, 2))).sum())
        raise InputError(
            f"{bad} of {len(corners_mm)} triangles have corners that are no numbers",
            where=source,
            remedy="export the model again",
        )
    if len(corners_mm) == 0:
        raise InputError(
            "the model holds no triangles", where=source, remedy="export it as a surface mesh"
        )
    span = corners_mm.max(axis=(0, 1)) - corners_mm.min(axis=(0, 1))
    diagonal = float(np.linalg.norm(span))
    sides = np.linalg.norm(corners_mm - np.roll(corners_mm, 1, axis=1), axis=2).max(axis=1)
    double = np.linalg.norm(_crosses(corners_mm), axis=1)
    is_sound = double > LEAST_HEIGHT * diagonal * np.maximum(sides, np.finfo(np.float64).tiny)
    n_flat = int((~is_sound).sum())
    corners = corners_mm[is_sound]
    if len(corners) < LEAST_TRIANGLES:
        raise InputError(
            f"the model holds {len(corners)} triangles with an area",
            where=source,
            remedy="export it as a surface mesh",
        )
    vertices, triangles = _welded(corners, SAME_PLACE * diagonal)
    notes = list(_odd_edges(triangles, source))
    here = corners - corners.mean(axis=(0, 1))
    volumes = np.einsum("ij,ij->", here[:, 0], np.cross(here[:, 1], here[:, 2]))
    if not notes and float(volumes) < 0.0:
        # closed, and every triangle looks into the part: there is one way to mend it
        corners, triangles = corners[:, ::-1], triangles[:, ::-1]
        notes.append(f"{source}: the surface was turned inside out; its triangles are turned back")
    if n_flat:
        notes.append(f"{source}: {n_flat:,} triangles have no area and are left out")
    if face is None:
        groups = _groups_by_crease(corners, triangles)
        names = tuple(f"face {k + 1}" for k in range(int(groups.max()) + 1))
    else:
        groups, names = face[is_sound], tuple(face_names)
    return PartModel(
        vertices_mm=vertices,
        triangles=triangles,
        face=groups,
        face_names=names,
        source=source,
        notes=tuple(notes),
    )


def edges_of(triangles: IntArray) -> tuple[IntArray, IntArray]:
    """(E, 2) edges, each once, and (F, 3) the edges ab, bc, ca of each triangle."""
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    ends = np.sort(ends, axis=1)
    key = ends[:, 0] * (int(ends.max()) + 1) + ends[:, 1]
    _, first, number = np.unique(key, return_index=True, return_inverse=True)
    return ends[first], number.reshape(-1, 3).astype(np.int64)


def _crosses(corners: FloatArray) -> FloatArray:
    """(F, 3) cross products of both sides at the first corner."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _welded(corners: FloatArray, tolerance: float) -> tuple[FloatArray, IntArray]:
    """Corners that lie in one place become one; triangles that this flattens are kept."""
    flat = corners.reshape(-1, 3)
    grid = np.round((flat - flat.min(axis=0)) / tolerance).astype(np.int64)
    _, first, number = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    return flat[first], number.reshape(-1, 3).astype(np.int64)


def _odd_edges(triangles: IntArray, source: str) -> tuple[str, ...]:
    """Warn of a surface that does not close, or whose sides are not all turned alike."""
    found = []
    _, number = edges_of(triangles)
    count = np.bincount(number.ravel())
    forward = triangles < np.roll(triangles, -1, axis=1)
    balance = np.bincount(number.ravel(), np.where(forward, 1.0, -1.0).ravel())
    open_edges = int((count == 1).sum())
    turned = int(((count == 2) & (balance != 0.0)).sum())
    if open_edges:
        found.append(
            f"{source}: the surface is open ({open_edges:,} edges have one triangle only); inside "
            "and outside are told by the triangles' own sides"
        )
    if turned:
        found.append(
            f"{source}: {turned:,} edges join triangles that are turned to opposite sides; signs "
            "near them may be wrong: repair the model"
        )
    return tuple(found)


def _groups_by_crease(corners: FloatArray, triangles: IntArray) -> IntArray:
    """(F,) number of the smooth region of each triangle, largest region first."""
    cross = _crosses(corners)
    area = np.linalg.norm(cross, axis=1)
    normal = cross / area[:, None]
    number = edges_of(triangles)[1].ravel()
    order = np.argsort(number, kind="stable")
    owner = order // 3
    same = number[order][1:] == number[order][:-1]
    a, b = owner[:-1][same], owner[1:][same]
    smooth = np.einsum("ij,ij->i", normal[a], normal[b]) > np.cos(np.radians(CREASE_DEG))
    n = len(triangles)
    graph = coo_matrix((np.ones(int(smooth.sum())), (a[smooth], b[smooth])), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    size = np.bincount(label, area)
    rank = np.zeros(len(size), dtype=np.int64)
    rank[np.argsort(-size, kind="stable")] = np.arange(len(size))
    return rank[label]
