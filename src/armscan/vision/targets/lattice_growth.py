# SPDX-License-Identifier: Apache-2.0
"""Grow a lattice over blobs, from one blob to its neighbours.

Both kinds of circle grid are square lattices (the asymmetric one turned by 45 degrees). The
ellipse into which a circle is seen gives the local affine map up to a rotation; in coordinates
that make it round again, the four nearest neighbours are equally far and at right angles, at any
tilt.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import FloatArray
from armscan.vision.targets.blobs import Blobs

Cell = tuple[int, int]
Lattice = dict[Cell, int]

_MAX_SEEDS = 60
_NEIGHBOURS = 9
_POSITION_TOLERANCE = 0.28
_MAX_AREA_RATIO = 1.9
_SIDES: tuple[Cell, ...] = ((1, 0), (0, 1), (-1, 0), (0, -1))


def grow_lattices(blobs: Blobs) -> Iterator[Lattice]:
    """Yield lattices (cell to blob index), grown from seeds that no earlier lattice holds.

    The cells' first axis a and second axis b lie in the image so that b is clockwise of a.
    """
    if len(blobs) < 4:
        return
    grower = _Grower(blobs)
    used: set[int] = set()
    for seed in grower.seeds():
        if seed in used:
            continue
        lattice = grower.grow(seed)
        if len(lattice) >= 4:
            used.update(lattice.values())
            yield lattice


class _Grower:
    def __init__(self, blobs: Blobs) -> None:
        self._centres = blobs.centres_px
        self._shapes = blobs.shapes_px2
        self._log_area = 0.5 * np.log(np.linalg.det(blobs.shapes_px2))
        self._tree = cKDTree(self._centres)
        self._count = len(blobs)

    def seeds(self) -> list[int]:
        """Blobs nearest to the middle of all blobs first: the middle has most neighbours."""
        middle = np.median(self._centres, axis=0)
        order = np.argsort(((self._centres - middle) ** 2).sum(axis=1), kind="stable")
        spread = np.unique(np.linspace(0, self._count - 1, _MAX_SEEDS).astype(np.int64))
        return [int(k) for k in order[spread]]

    def grow(self, seed: int) -> Lattice:
        """Lattice from a seed, breadth first; each cell hands its basis to its neighbours."""
        basis = self._basis(seed)
        if basis is None:
            return {}
        lattice: Lattice = {(0, 0): seed}
        taken = {seed}
        bases = {(0, 0): basis}
        queue: deque[Cell] = deque([(0, 0)])
        while queue:
            cell = queue.popleft()
            for side in _SIDES:
                beside = (cell[0] + side[0], cell[1] + side[1])
                if beside in lattice:
                    continue
                found = self._neighbour(lattice[cell], bases[cell], side)
                if found is None or found in taken:
                    continue
                lattice[beside] = found
                taken.add(found)
                bases[beside] = self._carried(lattice[cell], found, bases[cell], side)
                queue.append(beside)
        return lattice

    def _basis(self, seed: int) -> FloatArray | None:
        """Two lattice steps (2, 2), rows, at a seed, from its neighbours in rounded coordinates."""
        distance, index = self._tree.query(self._centres[seed], min(self._count, 3 * _NEIGHBOURS))
        near = np.asarray(index)[np.isfinite(distance)][1:]
        similar = np.abs(self._log_area[near] - self._log_area[seed]) < np.log(_MAX_AREA_RATIO)
        near = near[similar]
        offset = self._centres[near] - self._centres[seed]
        rounded = np.linalg.solve(np.linalg.cholesky(self._shapes[seed]), offset.T).T
        length = np.hypot(rounded[:, 0], rounded[:, 1])
        order = np.argsort(length, kind="stable")[:_NEIGHBOURS]
        for first in order[:2]:
            for second in order:
                cross = (
                    rounded[first, 0] * rounded[second, 1] - rounded[first, 1] * rounded[second, 0]
                )
                sine = cross / (length[first] * length[second])
                ratio = length[second] / length[first]
                if sine > 0.94 and 0.75 < ratio < 1.33:
                    return np.stack([offset[first], offset[second]])
        return None

    def _neighbour(self, at: int, basis: FloatArray, side: Cell) -> int | None:
        step = side[0] * basis[0] + side[1] * basis[1]
        distance, found = self._tree.query(self._centres[at] + step)
        if distance > _POSITION_TOLERANCE * np.hypot(*step):
            return None
        if abs(self._log_area[found] - self._log_area[at]) > np.log(_MAX_AREA_RATIO):
            return None
        return int(found)

    def _carried(self, at: int, found: int, basis: FloatArray, side: Cell) -> FloatArray:
        """The basis at the neighbour: the step just made, and the other axis as before."""
        axis = 0 if side[0] else 1
        carried = basis.copy()
        carried[axis] = (self._centres[found] - self._centres[at]) * (side[0] + side[1])
        # The side step changes with distance too: scale it by the circle's own size.
        carried[1 - axis] *= np.exp(0.5 * (self._log_area[found] - self._log_area[at]))
        return carried
