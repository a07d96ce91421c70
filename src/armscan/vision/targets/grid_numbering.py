# SPDX-License-Identifier: Apache-2.0
"""From lattice cells to the numbers of a circle grid's circles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.vision.targets.definition import CircleGrid
from armscan.vision.targets.lattice_growth import Lattice


@dataclass(frozen=True, slots=True, eq=False)
class NumberedGrid:
    """Blobs with the numbers of their circles.

    Parameters
    ----------
    point_index
        (M,) index into the target's points, ascending.
    blob_index
        (M,) blob of each.
    """

    point_index: IntArray
    blob_index: IntArray


def is_symmetric(target: CircleGrid) -> bool:
    """Tell whether the grid looks the same after half a turn.

    A symmetric grid always does; an asymmetric one does if its count of rows is even.
    """
    return not target.is_asymmetric or target.rows % 2 == 0


def number_grid(
    lattice: Lattice, centres_px: FloatArray, target: CircleGrid, min_fraction: float
) -> NumberedGrid | None:
    """Lay the target over a lattice.

    Parameters
    ----------
    lattice
        Cell to blob.
    centres_px
        (N, 2) blob centres.
    target
        The grid.
    min_fraction
        Least fraction of its circles that must be there; its four border lines must be.

    Returns
    -------
    The numbering whose x points most to the right; None if the lattice is not this grid.
    """
    wanted = _target_cells(target)
    have = np.array(list(lattice), dtype=np.int64)
    blobs = np.array(list(lattice.values()), dtype=np.int64)
    best: tuple[float, NumberedGrid] | None = None
    for quarter_turns in range(4):
        placed = _placed(_turned(have, quarter_turns), blobs, wanted, target.is_asymmetric)
        if placed is None or len(placed.point_index) < min_fraction * len(wanted):
            continue
        rightness = _rightness(placed, centres_px, target)
        if best is None or rightness > best[0]:
            best = rightness, placed
    return None if best is None else best[1]


def lattice_size(lattice: Lattice, is_asymmetric: bool) -> tuple[int, int]:
    """Columns and rows that a lattice spans, of a symmetric grid the larger first: for messages."""
    cells = np.array(list(lattice), dtype=np.int64)
    if is_asymmetric:
        across, along = (
            int(span) + 1 for span in np.ptp(_border(cells, is_asymmetric=True), axis=0)
        )
        # A row of C circles spans 2 C places of the turned lattice, since each second is shifted.
        sizes = [((u + 1) // 2, v) for u, v in ((across, along), (along, across))]
        return min(sizes, key=lambda size: abs(size[0] * size[1] - len(cells)))
    spans = np.ptp(cells, axis=0) + 1
    return int(spans.max()), int(spans.min())


def _target_cells(target: CircleGrid) -> IntArray:
    """Lattice cells (N, 2) of the target's points; y is clockwise of x, b of a."""
    unit = np.rint(target.points_board_mm[:, :2] / target.pitch_mm).astype(np.int64)
    if not target.is_asymmetric:
        return unit
    # Steps of the turned lattice: a = (1, 1) and b = (-1, 1) pitches.
    return np.stack([unit[:, 0] + unit[:, 1], unit[:, 1] - unit[:, 0]], axis=-1) // 2


def _turned(cells: IntArray, quarter_turns: int) -> IntArray:
    turned = cells
    for _ in range(quarter_turns):
        turned = np.stack([-turned[:, 1], turned[:, 0]], axis=-1)
    return turned


def _placed(
    cells: IntArray, blobs: IntArray, wanted: IntArray, is_asymmetric: bool
) -> NumberedGrid | None:
    """Shift the cells onto the target; None unless the borders agree and no cell is left over."""
    have, want = (_border(c, is_asymmetric) for c in (cells, wanted))
    if not np.array_equal(np.ptp(have, axis=0), np.ptp(want, axis=0)):
        return None
    shift = want.min(axis=0) - have.min(axis=0)
    if is_asymmetric:
        if (shift[0] + shift[1]) % 2:
            return None
        shift = np.array([shift[0] + shift[1], shift[1] - shift[0]]) // 2
    number = {(int(a), int(b)): k for k, (a, b) in enumerate(wanted)}
    points = [number.get((int(a), int(b)), -1) for a, b in cells + shift]
    if min(points) < 0:
        return None
    order = np.argsort(points)
    return NumberedGrid(np.array(points, dtype=np.int64)[order], blobs[order])


def _border(cells: IntArray, is_asymmetric: bool) -> IntArray:
    """Coordinates in which the target's border is a rectangle."""
    if not is_asymmetric:
        return cells
    return np.stack([cells[:, 0] - cells[:, 1], cells[:, 0] + cells[:, 1]], axis=-1)


def _rightness(placed: NumberedGrid, centres_px: FloatArray, target: CircleGrid) -> float:
    board = target.points_board_mm[placed.point_index, :2]
    design = np.column_stack([board, np.ones(len(board))])
    affine = np.linalg.lstsq(design, centres_px[placed.blob_index], rcond=None)[0]
    return float(affine[0, 0] / np.hypot(affine[0, 0], affine[0, 1]))
