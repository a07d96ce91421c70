# SPDX-License-Identifier: Apache-2.0
"""Numbering of a chessboard's corners: which is the origin, which way x goes.

The camera looks at the front of a print, so that in the image the board's y lies clockwise of
its x. Where several numberings remain, the one whose x points most to the right is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.vision.targets.chessboard_extent import Extent, Side


@dataclass(frozen=True, slots=True, eq=False)
class NumberedCorners:
    """Corners with their places on the board.

    Parameters
    ----------
    cells
        (N, 2) column and row of each.
    points_px
        (N, 2) image points.
    quarter_turns
        How far the board's x is turned against the lattice's a.
    """

    cells: IntArray
    points_px: FloatArray
    quarter_turns: int


def numberings(extent: Extent, columns: int, rows: int) -> list[NumberedCorners]:
    """All ways to number the corners of an extent, the one whose x points most to the right first.

    A count that is smaller than the board's needs one side on which the board is seen to end and
    another on which nothing looks like an end: there the missing rows lie.
    """
    found = []
    size = np.array(extent.size)
    cells, sides = extent.cells, extent.sides
    for quarter_turns in range(4):
        shift = [
            _first_number(int(n), wanted, sides[2 * axis], sides[2 * axis + 1])
            for axis, (n, wanted) in enumerate(zip(size, (columns, rows), strict=True))
        ]
        if shift[0] is not None and shift[1] is not None:
            placed = cells + np.array([shift[0], shift[1]])
            found.append(NumberedCorners(placed, extent.points_px, quarter_turns))
        # A quarter turn: a becomes b, b runs backwards along the new a.
        cells = np.stack([size[1] - 1 - cells[:, 1], cells[:, 0]], axis=-1)
        size = size[::-1]
        sides = (sides[3], sides[2], sides[0], sides[1])
    return sorted(found, key=lambda numbered: -_rightness(numbered))


def is_sure(choices: list[NumberedCorners], *, is_square: bool) -> bool:
    """Tell whether the numberings that remain are one but for a turn that the board permits."""
    turns = {numbered.quarter_turns for numbered in choices}
    return bool(turns) and (is_square or turns <= {0, 2} or turns <= {1, 3})


def _first_number(count: int, wanted: int, before: Side, after: Side) -> int | None:
    """Number on the board of the first of ``count`` rows; None if it is not known."""
    if "continues" in (before, after) or count > wanted:
        return None
    if count == wanted:
        return 0
    if before == "ends" and after == "unknown":
        return 0
    if after == "ends" and before == "unknown":
        return wanted - count
    return None


def _rightness(numbered: NumberedCorners) -> float:
    design = np.column_stack([numbered.cells, np.ones(len(numbered.cells))])
    affine = np.linalg.lstsq(design, numbered.points_px, rcond=None)[0]
    return float(affine[0, 0] / np.hypot(affine[0, 0], affine[0, 1]))
