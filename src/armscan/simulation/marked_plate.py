# SPDX-License-Identifier: Apache-2.0
"""A stepped plate with ring markers strewn over its faces, as somebody sticks them on a part.

Frame: z up, x along the plate, its foot on z = 0 in the middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.poses import Pose
from armscan.simulation.ring_markers import RING_DIAMETER_MM, RingMarker
from armscan.simulation.shapes import Box, Placed
from armscan.simulation.surfaces import Surface

N_MARKERS = 30
SLAB_MM = (96.0, 62.0, 6.0)
BLOCKS_MM = (
    (-33.0, 17.0, 22.0, 18.0, 13.0),
    (-8.0, -16.0, 20.0, 22.0, 10.0),
    (15.0, 16.0, 24.0, 20.0, 16.0),
    (37.0, -14.0, 15.0, 26.0, 11.5),
)
"""Middle x and y, length, width and height over the foot of each block on the slab."""
_GREY = (0.55, 0.55, 0.55)
_CLEAR_MM = 0.6
"""Between a marker's rim and an edge or a wall's foot."""
_APART_MM = 7.0
_TRIES = 4000


@dataclass(frozen=True, slots=True, eq=False)
class MarkedPlate:
    """The plate's shapes and its markers, in its own frame.

    Parameters
    ----------
    markers
        (N,) on upward faces, no two nearer than a marker's width.
    """

    markers: tuple[RingMarker, ...]

    @staticmethod
    def draw(rng: np.random.Generator) -> MarkedPlate:
        """Strew the markers: a place is taken if it keeps clear of edges and of other markers."""
        half = 0.5 * np.array(SLAB_MM[:2])
        taken: list[FloatArray] = []
        for place in rng.uniform(-half, half, (_TRIES, 2)):
            is_apart = all(np.hypot(*(place - other[:2])) > _APART_MM for other in taken)
            height = face_height_mm(place)
            if is_apart and height is not None:
                taken.append(np.array([*place, height]))
            if len(taken) == N_MARKERS:
                break
        up = np.array([0.0, 0.0, 1.0])
        return MarkedPlate(tuple(RingMarker(centre, up) for centre in taken))

    @property
    def centres_mm(self) -> FloatArray:
        """(N, 3) middles of the discs."""
        return np.array([marker.centre_mm for marker in self.markers])

    @property
    def shapes(self) -> tuple[Surface, ...]:
        """The slab and the blocks."""
        slab = Box(np.array(SLAB_MM), _GREY)
        blocks = [
            Placed(Box(np.array([length, width, height]), _GREY), _at(x, y))
            for x, y, length, width, height in BLOCKS_MM
        ]
        return (slab, *blocks)


def face_height_mm(place_mm: FloatArray) -> float | None:
    """Height of the face on which a marker at (2,) lies as a whole; None if it meets an edge."""
    reach = 0.5 * RING_DIAMETER_MM + _CLEAR_MM
    if not _is_inside(place_mm, np.zeros(2), np.array(SLAB_MM[:2]), -reach):
        return None
    for x, y, length, width, height in BLOCKS_MM:
        middle, size = np.array([x, y]), np.array([length, width])
        if _is_inside(place_mm, middle, size, -reach):
            return height
        if _is_inside(place_mm, middle, size, reach):
            return None
    return SLAB_MM[2]


def _is_inside(place: FloatArray, middle: FloatArray, size: FloatArray, wider: float) -> bool:
    beyond: BoolArray = np.abs(place - middle) > 0.5 * size + wider
    return not bool(beyond.any())


def _at(x_mm: float, y_mm: float) -> Pose[Any, Any]:
    return Pose(np.eye(3), np.array([x_mm, y_mm, 0.0]))
