# SPDX-License-Identifier: Apache-2.0
"""Blobs that nest around one place: what may be a ring."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.vision.targets.blobs import Blobs

MAX_CENTRE_SHIFT = 0.12
"""Largest distance between the centres of two nested outlines, over the outer's shorter half axis.

Perspective shifts them by less than a hundredth; the rest is for outlines found by a threshold."""
_SHIFT_PX = 1.5
_MAX_AXIS_MISMATCH = 0.3
_MIN_RADIUS_RATIO = 1.1


def concentric_pairs(blobs: Blobs) -> tuple[IntArray, IntArray]:
    """Rows of the blobs of each pair that nests, the outer one first, of any polarity.

    Parameters
    ----------
    blobs
        N blobs.
    """
    if len(blobs) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    half = np.sqrt(np.linalg.eigvalsh(blobs.shapes_px2))
    reach = MAX_CENTRE_SHIFT * half[:, 0] + _SHIFT_PX
    tree = cKDTree(blobs.centres_px)
    near = [tree.query_ball_point(c, r) for c, r in zip(blobs.centres_px, reach, strict=True)]
    outer = np.repeat(np.arange(len(blobs)), [len(found) for found in near])
    inner = np.array([k for found in near for k in found], dtype=np.int64)
    nests = (half[outer] > _MIN_RADIUS_RATIO * half[inner]).all(axis=1)
    nests &= _axis_mismatch(blobs.shapes_px2, outer, inner) < _MAX_AXIS_MISMATCH
    return outer[nests], inner[nests]


def clusters(n: int, pairs: tuple[IntArray, IntArray]) -> IntArray:
    """Number (N,) of the cluster to which each of ``n`` blobs belongs."""
    links = coo_array((np.ones(len(pairs[0])), pairs), shape=(n, n))
    _, labels = connected_components(links, directed=False)
    return np.asarray(labels, dtype=np.int64)


def _axis_mismatch(shapes_px2: FloatArray, outer: IntArray, inner: IntArray) -> FloatArray:
    """How far two shapes are from scaled copies: half the log of one's axes' ratio in the other."""
    relative = np.linalg.solve(shapes_px2[outer], shapes_px2[inner])
    ratio = np.sort(np.linalg.eigvals(relative).real, axis=1)
    return np.asarray(0.5 * np.log(np.maximum(ratio[:, 1], 1e-9) / np.maximum(ratio[:, 0], 1e-9)))
