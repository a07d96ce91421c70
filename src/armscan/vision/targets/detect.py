# SPDX-License-Identifier: Apache-2.0
"""Find a target in an exposure; ChArUco boards; targets that look the same after a turn.

A ChArUco board of an even count of rows has its markers on other squares in OpenCV's old layout
than in the new one. If then the count of columns is odd, both number alike but for a shift by one
column: only markers that begin or end a row tell them apart.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.poses import Board, Pose
from armscan.records.exposure import Exposure
from armscan.vision.targets.april_grid import (
    CLEARANCE,
    MIN_CORNERS,
    Markers,
    detect_april_grid,
    dictionary_of,
    read_markers,
    settle_order,
)
from armscan.vision.targets.chessboard import (
    Steps,
    detect_chessboard,
    regular_saddles,
)
from armscan.vision.targets.circle_grid import detect_circle_grid
from armscan.vision.targets.crossings import predict_cells
from armscan.vision.targets.saddle import WINDOW_FRACTION, RawGrey, grey_channels, to_grey8
from armscan.vision.targets.target import (
    AprilGrid,
    Charuco,
    Chessboard,
    CircleGrid,
    Target,
    TargetView,
    format_target,
)

DECISIVE = 4
"""So many more neighbours at their places prove a layout; a misread marker has none."""
_FITTING = 0.75
"""Least share of neighbours at their places: of a wrong count half may be."""
_MOST_READ = (0.1, 0.9)
"""Between these parts of the numbers read no marker is misread."""
_FARTHER = 0.25
"""Part of the distance to a marker farther away by which it may lie off what one marker says."""
_NEAR = 0.5
"""Farthest that a neighbour lies off its place, in squares; the nearest other place is at 1.4."""


@dataclass(frozen=True, slots=True, eq=False)
class _Neighbours:
    """Pairs of a marker and one of its nearest neighbours on a board, both read.

    ``first``, ``second``: (P,) numbers of the markers as read. ``agrees``: (P,) Whether the second
    lies where the first says.
    """

    first: IntArray
    second: IntArray
    agrees: BoolArray


@dataclass(frozen=True, slots=True)
class _Fit:
    """Neighbours that both were read on a board, and how many of them lie where it says."""

    board: Charuco
    n_agreeing: int
    n_neighbours: int

    @property
    def is_fitting(self) -> bool:
        return 0 < _FITTING * self.n_neighbours <= self.n_agreeing


def detect_charuco(exposure: Exposure, target: Charuco) -> TargetView | FitFailure:
    """Find a ChArUco board, whole or in part; the markers number its corners.

    A board that may have either layout is refused where the image does not tell which it has.
    """
    n_most, failure = -1, FitFailure("")
    for grey in grey_channels(exposure):
        markers = read_markers(to_grey8(grey, exposure.full_scale), target.dictionary)
        found = _detect_in(exposure, target, grey, markers)
        if isinstance(found, TargetView):
            return found
        if len(markers.ids) > n_most:
            n_most, failure = len(markers.ids), found
    return failure


def settle_layout(exposures: Iterable[Exposure], target: Charuco) -> Charuco:
    """The board with the layout that the first exposures show that tell; as it is if none does."""
    if not target.has_two_layouts or target.layout != "either":
        return target
    lead = 0
    for exposure in exposures:
        lead += _lead_of_old(exposure, target)
        if abs(lead) >= DECISIVE:
            return replace(target, layout="old" if lead > 0 else "new")
    return target


def _lead_of_old(exposure: Exposure, target: Charuco) -> int:
    """By how many neighbours the old layout agrees better than the new; 0 if neither fits."""
    lead = 0
    for grey in grey_channels(exposure):
        markers = read_markers(to_grey8(grey, exposure.full_scale), target.dictionary)
        own = markers.counted_from(target.first_id)
        new, old = (_fit(own, board) for board in _layouts(target))
        seen = old.n_agreeing - new.n_agreeing if old.is_fitting or new.is_fitting else 0
        lead = max(lead, seen, key=abs)
        if abs(lead) >= DECISIVE:
            break
    return lead


def _detect_in(
    exposure: Exposure, target: Charuco, grey: RawGrey, markers: Markers
) -> TargetView | FitFailure:
    """The board in one grey image whose markers are known."""
    if len(markers.ids) == 0:
        return FitFailure(
            f"{exposure.source}: no marker of {target.dictionary} in view",
            "check the dictionary's name, and that the print is neither mirrored nor blurred",
        )
    own = markers.counted_from(target.first_id)
    fitting = _fitting(own, _layouts(target))
    asked = _of_layout(fitting, target)
    if not asked and (_fit(own, target).n_neighbours > 0 or _first_ids(markers, target)):
        return _misfit(exposure, target, markers, fitting)
    board = (asked or [target])[0]
    if asked and _fits_another_first(markers, board):
        return _misfit(exposure, target, markers, [])
    if asked and _n_beyond(markers, board) >= DECISIVE:
        last = target.first_id + len(board.marker_squares) - 1
        return FitFailure(
            f"{exposure.source}: the board goes on beyond the markers {target.first_id} to {last}: "
            f"{markers.ids.min()} to {markers.ids.max()} were read",
            "count its rows of squares again, and give the number of its first marker, as in "
            f"{format_target(replace(target, first_id=int(markers.ids.min())))}",
        )
    view = _corners(exposure, board, grey, own)
    if isinstance(view, TargetView) and len(asked) > 1:
        return FitFailure(
            f"{exposure.source}: the markers in view lie alike in OpenCV's new and old layout",
            "show a whole row of the board in an image, or write :new or :old after the dictionary",
        )
    return view


def _fits_another_first(markers: Markers, board: Charuco) -> bool:
    """Whether the markers contradict the board's first number here and there, and fit another.

    Where one counts from the wrong marker, all agree but those that begin and end a row.
    """
    own = _fit(markers.counted_from(board.first_id), board)
    if own.n_neighbours - own.n_agreeing < DECISIVE:
        return False
    others = _first_ids(markers, board)
    if not others:
        return False
    other = _fit(markers.counted_from(others[0].first_id), others[0])
    return other.n_agreeing - own.n_agreeing >= DECISIVE


def _n_beyond(markers: Markers, board: Charuco) -> int:
    """Neighbours, one on the board and one that lies where the board's rows would go on."""
    n, above = len(board.marker_squares), board.first_id // board.columns
    below = max(0, -(-(int(markers.ids.max()) + 1 - board.first_id - n) // board.columns))
    first, rows = board.first_id - above * board.columns, board.rows + 2 * (above + below)
    wide = replace(board, first_id=first, rows=rows)
    counted = markers.counted_from(first)
    neighbours = _neighbours(counted, wide)
    number = counted.ids - above * board.columns
    is_own = (number >= 0) & (number < n)
    crosses = is_own[neighbours.first] & ~is_own[neighbours.second]
    return int((crosses & neighbours.agrees).sum())


def _of_layout(boards: list[Charuco], target: Charuco) -> list[Charuco]:
    if target.layout == "either" or not target.has_two_layouts:
        return boards
    return [board for board in boards if board.layout == target.layout]


def _corners(
    exposure: Exposure, board: Charuco, grey: RawGrey, markers: Markers
) -> TargetView | FitFailure:
    clear_cells = _clear_cells(board)
    cells, start_px, steps = _corners_near(markers, board, clear_cells, grey.shape[:2])
    refined, covariance, is_good = regular_saddles(grey, cells, start_px, steps, clear_cells)
    n_corners = int(is_good.sum())
    if n_corners >= MIN_CORNERS:
        column, row = (cells[is_good] - 1).T
        number = row * (board.columns - 1) + column
        return TargetView.of_image(exposure, board, number, refined[is_good], covariance[is_good])
    return FitFailure(
        f"{exposure.source}: {len(markers.ids)} markers of {board.dictionary} and {n_corners} "
        f"corners were read, at least {MIN_CORNERS} corners are needed",
        "check columns, rows and lengths of the board, and show more of it",
    )


def _trusted(markers: Markers, board: Charuco) -> IntArray:
    """Which of the markers (N,) lie where their neighbours say; of one number but one."""
    neighbours, n = _neighbours(markers, board), len(markers.ids)
    n_agreeing = np.bincount(neighbours.first[neighbours.agrees], minlength=n)
    n_seen = np.bincount(neighbours.first, minlength=n)
    known = np.flatnonzero((markers.ids < len(board.marker_squares)) & (2 * n_agreeing >= n_seen))
    known = known[np.argsort(-n_agreeing[known], kind="stable")]
    known = known[np.unique(markers.ids[known], return_index=True)[1]]
    return _of_one_board(markers, board, neighbours, known)


def _of_one_board(
    markers: Markers, board: Charuco, neighbours: _Neighbours, known: IntArray
) -> IntArray:
    """The largest group of neighbours among markers, and others that lie about where it says.

    Two copies of a board may each show what is hidden of the other.
    """
    first, second = neighbours.first[neighbours.agrees], neighbours.second[neighbours.agrees]
    n = len(markers.ids)
    links = coo_array((np.ones(len(first)), (first, second)), shape=(n, n))
    group = connected_components(links, directed=False)[1]
    is_main = group[known] == np.argmax(np.bincount(group[known], minlength=1))
    main, others = known[is_main], known[~is_main]
    if len(main) < 2 or not len(others):
        return known
    place, centre = board.marker_squares[markers.ids], markers.corners_px.mean(axis=1)
    apart = place[others][:, None] - place[main]
    nearest = np.argmin(np.abs(apart).sum(axis=-1), axis=1)
    apart = apart[np.arange(len(others)), nearest]
    away = centre[others] - centre[main[nearest]]
    squares = np.linalg.solve(_per_square(markers, board)[main[nearest]], away[:, :, None])
    off = np.hypot(*(squares[:, :, 0] - apart).T)
    is_near = off < _NEAR + _FARTHER * np.hypot(*apart.T)
    return np.sort(np.concatenate([main, others[is_near]]))


def _corners_near(
    markers: Markers, board: Charuco, clear_cells: float, shape: tuple[int, ...]
) -> tuple[IntArray, FloatArray, Steps]:
    """Inner corners (N, 2) beside markers, squares, where they should be seen, and their steps.

    Not beside a marker that is wholly in view and was not read: what hides it, or blurs it, harms
    the corner too.
    """
    none = np.zeros((0, 2))
    known = _trusted(markers, board)
    if not len(known):
        return none.astype(np.int64), none, (none, none)
    half = 0.5 * board.marker_mm / board.square_mm
    way = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    outlines = board.marker_squares[:, None] + 0.5 + way
    seen = outlines[markers.ids[known]].reshape(-1, 2), markers.corners_px[known].reshape(-1, 2)
    row, column = np.mgrid[1 : board.rows, 1 : board.columns]
    every = np.stack([column.ravel(), row.ravel()], axis=-1)
    is_beside = np.abs(every[:, None] - board.marker_squares - 0.5).max(axis=-1) < 1.0
    is_read = np.isin(np.arange(len(outlines)), markers.ids[known])
    outline_px = predict_cells(*seen, outlines.reshape(-1, 2)).reshape(-1, 4, 2)
    is_missed = ~is_read & _is_within(outline_px, shape).all(axis=1)
    near = every[(is_beside & is_read).any(axis=1) & ~(is_beside & is_missed).any(axis=1)]
    start, ahead, below = (
        predict_cells(*seen, near + clear_cells * np.array(step))
        for step in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
    )
    along_x, along_y = ahead - start, below - start
    within = np.isfinite(along_x + along_y).all(axis=1) & _is_within(start, shape)
    return near[within], start[within], (along_x[within], along_y[within])


def _is_within(points_px: FloatArray, shape: tuple[int, ...]) -> BoolArray:
    size = np.array(shape[::-1])
    return np.asarray(((points_px > 1.0) & (points_px < size - 2.0)).all(axis=-1))


def _clear_cells(target: Charuco) -> float:
    """Part of a square, such that the fit of a corner reaches no marker."""
    gap_mm = (target.square_mm - target.marker_mm) / np.sqrt(2.0)
    return float(min(1.0, CLEARANCE * gap_mm / (WINDOW_FRACTION * target.square_mm)))


def _layouts(target: Charuco) -> tuple[Charuco, ...]:
    """The board in the new and in the old layout; once where these are the same."""
    if not target.has_two_layouts:
        return (target,)
    return replace(target, layout="new"), replace(target, layout="old")


def _fitting(markers: Markers, boards: Iterable[Charuco]) -> list[Charuco]:
    """Those of the boards that the markers fit best, and no better than any other of them."""
    fits = [_fit(markers, board) for board in boards]
    best = max(fit.n_agreeing for fit in fits)
    return [fit.board for fit in fits if fit.is_fitting and best - fit.n_agreeing < DECISIVE]


def _fit(markers: Markers, board: Charuco) -> _Fit:
    neighbours = _neighbours(markers, board)
    return _Fit(board, int(neighbours.agrees.sum()), len(neighbours.first))


def _neighbours(markers: Markers, board: Charuco) -> _Neighbours:
    """Where each marker says that its nearest neighbours lie, and whether they do.

    Affine, of one marker alone: that holds under any lens and for boards that are bent.
    """
    per_square = _per_square(markers, board)
    is_known = (markers.ids < len(board.marker_squares)) & (np.abs(np.linalg.det(per_square)) > 1.0)
    known = np.flatnonzero(is_known)
    place, centre = board.marker_squares[markers.ids[known]], markers.corners_px[known].mean(axis=1)
    apart = place[None, :, :] - place[:, None, :]
    is_neighbour: BoolArray = np.abs(apart).sum(axis=-1) == 2
    first, second = np.nonzero(is_neighbour)
    away = centre[second] - centre[first]
    squares_away = np.linalg.solve(per_square[known[first]], away[:, :, None])[:, :, 0]
    off = np.hypot(*(squares_away - apart[first, second]).T)
    return _Neighbours(known[first], known[second], off < _NEAR)


def _per_square(markers: Markers, board: Charuco) -> FloatArray:
    """(N, 2, 2) ways along a square's upper and left sides, as columns, px."""
    one, two, three, four = np.moveaxis(markers.corners_px, 1, 0)
    sides = np.stack([two - one + three - four, four - one + three - two], axis=-1)
    return np.asarray(0.5 * sides * (board.square_mm / board.marker_mm))


def _first_ids(markers: Markers, target: Charuco) -> list[Charuco]:
    """Boards with another first marker that the markers fit better than any other of them."""
    low, high = np.quantile(markers.ids, _MOST_READ)
    n_known = len(dictionary_of(target.dictionary).bytesList)
    n = len(target.marker_squares)
    numbers = range(max(0, int(high) - n + 1), min(int(low), n_known - n) + 1)
    best, fits = DECISIVE - 1, list[Charuco]()
    for first in numbers:
        for board in _layouts(replace(target, first_id=first)):
            fit = _fit(markers.counted_from(first), board)
            if not fit.is_fitting or fit.n_agreeing < max(best, DECISIVE):
                continue
            fits = [*fits, board] if fit.n_agreeing == best else [board]
            best = fit.n_agreeing
    return fits


def _misfit(
    exposure: Exposure, target: Charuco, markers: Markers, fitting: list[Charuco]
) -> FitFailure:
    """The markers contradict the board; say which they fit."""
    swapped = replace(target, columns=target.rows, rows=target.columns, layout="either")
    own = markers.counted_from(target.first_id)
    others = fitting or _fitting(own, _layouts(swapped))
    reason = (
        f"{exposure.source}: {len(markers.ids)} markers of {target.dictionary} were read, which do "
        f"not lie as on a board of {target.columns} x {target.rows} squares"
    )
    if target.first_id:
        reason += f" and markers from {target.first_id} on"
    if fitting:
        reason += f" in OpenCV's {target.layout} layout"
    if not others:
        firsts = _first_ids(markers, target)
        if not firsts:
            return FitFailure(reason, "check columns, rows and lengths of the board")
        others, swapped = firsts, replace(firsts[0], layout="either")
        if len({board.first_id for board in firsts}) > 1:
            numbers = ", ".join(str(k) for k in sorted({board.first_id for board in firsts}))
            return FitFailure(
                f"{reason}, but as on one whose first marker is one of {numbers}",
                f"give the first marker's number, as in {format_target(swapped)}",
            )
    right = others[0] if len(others) == 1 else swapped
    text = format_target(right)
    return FitFailure(f"{reason}, but as on {text}", f"write {text}")


SMALLEST_IMAGE_PX = 32


def detect_target(exposure: Exposure, target: Target) -> TargetView | FitFailure:
    """Find a target and measure its points (section 2.3.1.1).

    Parameters
    ----------
    exposure
        Grey or colour, 8 to 16 bit, any sensor window.
    target
        What to look for.

    Returns
    -------
    The points in full-sensor pixels with their covariance, or the reason why there are none.
    """
    if min(exposure.width_px, exposure.height_px) < SMALLEST_IMAGE_PX:
        return FitFailure(
            f"{exposure.source}: an image of {exposure.width_px} x {exposure.height_px} px is too "
            "small to show a target",
            "give the full image",
        )
    if isinstance(target, CircleGrid):
        return detect_circle_grid(exposure, target)
    if isinstance(target, Chessboard):
        return detect_chessboard(exposure, target)
    if isinstance(target, Charuco):
        return detect_charuco(exposure, target)
    return detect_april_grid(exposure, target)


def settle_target(exposures: Iterable[Exposure], target: Target) -> Target:
    """The target with what its name leaves open, told by the first exposures that show it.

    That is the layout of a ChArUco board, and border and order of rows of an AprilGrid; the target
    as it is where none of the exposures tells.
    """
    if isinstance(target, AprilGrid):
        return settle_order(exposures, target)
    return settle_layout(exposures, target) if isinstance(target, Charuco) else target


@dataclass(frozen=True, slots=True, eq=False)
class Numbering:
    """Another numbering of a target's points.

    ``quarter_turns``: How far the target is turned, 0 to 3. ``new_index``: (N,) number that each of
    the target's points bears now. ``new_from_found``: Maps places on the board as it was found
    numbered to places by the new numbers.
    """

    quarter_turns: int
    new_index: IntArray
    new_from_found: Pose[Board, Board]


def numberings(target: Target) -> tuple[Numbering, ...]:
    """All numberings that no view can tell apart, the one as found first."""
    points = target.points_board_mm
    found = Numbering(0, np.arange(len(points)), Pose(np.eye(3), np.zeros(3)))
    return (found, *(_turned(target, turns) for turns in target.symmetric_turns))


def renumbered(view: TargetView, target: Target, numbering: Numbering) -> TargetView:
    """The view of ``target`` with other numbers; the image points stay, in their order."""
    if numbering.quarter_turns == 0:
        return view
    index = numbering.new_index[view.point_index]
    return replace(view, point_index=index, points_board_mm=target.points_board_mm[index])


def _turned(target: Target, quarter_turns: int) -> Numbering:
    points = target.points_board_mm
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rotation = np.linalg.matrix_power(quarter, quarter_turns)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    shift = middle - rotation @ middle
    pose: Pose[Board, Board] = Pose(rotation, shift)
    apart = np.abs(pose.apply(points)[:, None, :] - points[None, :, :]).max(axis=2)
    return Numbering(quarter_turns, np.argmin(apart, axis=1), pose)
