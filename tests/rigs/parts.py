# SPDX-License-Identifier: Apache-2.0
"""Parts and scans of them, made by code: a block with features, and points on a surface."""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.inspection.cad.part import PartModel, part_of


def box_corners(low: object, high: object) -> FloatArray:
    """(12, 3, 3) triangles of a box, outside up."""
    a, b = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    v = np.array([[x, y, z] for x in (a[0], b[0]) for y in (a[1], b[1]) for z in (a[2], b[2])])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return np.array([v[list(t)] for q in quads for t in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))])


def extruded(outline: FloatArray, height: float) -> FloatArray:
    """(F, 3, 3) triangles of a star-shaped outline (N, 2), anticlockwise, pulled up along z."""
    low = np.column_stack([outline, np.zeros(len(outline))])
    up = np.array([0.0, 0.0, height])
    high, low_next = low + up, np.roll(low, -1, axis=0)
    high_next = low_next + up
    middle = np.broadcast_to(low.mean(axis=0), low.shape)
    return np.concatenate(
        [
            np.stack([low, low_next, high_next], axis=1),
            np.stack([low, high_next, high], axis=1),
            np.stack([middle, low_next, low], axis=1),
            np.stack([middle + up, high, high_next], axis=1),
        ]
    )


def turned(profile: FloatArray, sides: int = 90) -> FloatArray:
    """(F, 3, 3) triangles of a profile (N, 2) of radius and height, from the axis to the axis."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    rings = np.stack(
        [np.outer(profile[:, 0], np.cos(angle)), np.outer(profile[:, 0], np.sin(angle)),
         np.repeat(profile[:, 1:], sides, axis=1)], axis=2,
    )  # fmt: skip
    after = np.roll(rings, -1, axis=1)
    a, b, c, d = rings[:-1], after[:-1], after[1:], rings[1:]
    quads = np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)])
    flat = quads.reshape(-1, 3, 3)
    area = np.linalg.norm(np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]), axis=1)
    return flat[area > 1e-9]


def wedge_part() -> PartModel:
    """A block 80 x 50 x 20 with a step, a leaning side and a boss: no symmetry."""
    return part_of(
        np.concatenate([
            extruded(np.array([[0, 0], [80, 0], [80, 30], [62, 50], [0, 50.0]]), 20.0),
            box_corners([8, 8, 20.0], [30, 40, 32]),
            box_corners([50, 6, 20.0], [60, 20, 26]),
        ]),
        source="wedge",
    )  # fmt: skip


def sphere_part(radius: float = 20.0, sides: int = 120) -> PartModel:
    angle = np.linspace(-np.pi / 2, np.pi / 2, sides // 2)
    return part_of(
        turned(radius * np.column_stack([np.cos(angle), np.sin(angle)]), sides), source="ball"
    )
