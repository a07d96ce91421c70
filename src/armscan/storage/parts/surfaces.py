# SPDX-License-Identifier: Apache-2.0
"""Triangles as STL and PLY files, both binary."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray

SURFACE_SUFFIXES = (".stl", ".ply")
_HEADER_BYTES = 80


def encoded_surface(suffix: str, vertices_mm: FloatArray, triangles: IntArray, title: str) -> bytes:
    """Content of a file of triangles.

    Parameters
    ----------
    suffix
        ``.stl``: corners of each triangle in single precision, which is 0.06 um at a metre.
        ``.ply``: vertices in double precision, each once.
    vertices_mm, triangles
        (V, 3) and (T, 3) rows of them, anticlockwise seen from outside.
    title
        What it is; STL keeps 80 letters of it.
    """
    if suffix == ".stl":
        return _stl(vertices_mm, triangles, title)
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment {title}\n"
        f"element vertex {len(vertices_mm)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(triangles)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(triangles), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    rows["count"], rows["corners"] = 3, triangles
    return header.encode("ascii", "replace") + vertices_mm.astype("<f8").tobytes() + rows.tobytes()


def _stl(vertices: FloatArray, triangles: IntArray, title: str) -> bytes:
    corners = vertices[triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=1, keepdims=True)
    facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    rows = np.zeros(len(triangles), facet)
    rows["normal"] = np.divide(across, length, out=np.zeros_like(across), where=length > 0.0)
    rows["corners"] = corners
    # a reader takes a file that begins with "solid" for text
    head = title.encode("ascii", "replace")[:_HEADER_BYTES].ljust(_HEADER_BYTES)
    return head + np.array(len(rows), "<u4").tobytes() + rows.tobytes()
