# SPDX-License-Identifier: Apache-2.0
"""The ways in which a target that looks the same after a turn may be numbered."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.geometry.frames import Board
from armscan.geometry.poses import Pose
from armscan.vision.targets.chessboard import is_symmetric as is_symmetric_chessboard
from armscan.vision.targets.definition import Charuco, CircleGrid, Target
from armscan.vision.targets.grid_numbering import is_symmetric as is_symmetric_grid
from armscan.vision.targets.view import TargetView

QUARTER_TURNS = {
    1: np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    2: np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]),
    3: np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}


@dataclass(frozen=True, slots=True, eq=False)
class Numbering:
    """Another numbering of a target's points.

    Parameters
    ----------
    quarter_turns
        How far the target is turned, 0 to 3.
    new_index
        (N,) number that each of the target's points bears now.
    new_from_found
        Maps places on the board as it was found numbered to places by the new numbers.
    """

    quarter_turns: int
    new_index: IntArray
    new_from_found: Pose[Board, Board]


def numberings(target: Target) -> tuple[Numbering, ...]:
    """All numberings that no view can tell apart, the one as found first."""
    points = target.points_board_mm
    found = Numbering(0, np.arange(len(points)), Pose(np.eye(3), np.zeros(3)))
    return (found, *(_turned(target, turns) for turns in _symmetries(target)))


def renumbered(view: TargetView, target: Target, numbering: Numbering) -> TargetView:
    """The view of ``target`` with other numbers; the image points stay, in their order."""
    if numbering.quarter_turns == 0:
        return view
    index = numbering.new_index[view.point_index]
    return replace(view, point_index=index, points_board_mm=target.points_board_mm[index])


def _symmetries(target: Target) -> tuple[int, ...]:
    """Quarter turns after which the target looks the same."""
    if isinstance(target, Charuco):
        return ()
    is_square = target.columns == target.rows
    if isinstance(target, CircleGrid):
        if not is_symmetric_grid(target):
            return ()
        return (1, 2, 3) if is_square and not target.is_asymmetric else (2,)
    if not is_symmetric_chessboard(target):
        return ()
    # A quarter turn of a board with an odd count of inner corners a side swaps its colours.
    return (1, 2, 3) if is_square and target.columns % 2 == 0 else (2,)


def _turned(target: Target, quarter_turns: int) -> Numbering:
    points = target.points_board_mm
    rotation = QUARTER_TURNS[quarter_turns]
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    shift = middle - rotation @ middle
    places: FloatArray = points @ rotation.T + shift
    apart = np.abs(places[:, None, :] - points[None, :, :]).max(axis=2)
    return Numbering(quarter_turns, np.argmin(apart, axis=1), Pose(rotation, shift))
