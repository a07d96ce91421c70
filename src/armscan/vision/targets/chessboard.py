# SPDX-License-Identifier: Apache-2.0
"""Chessboards: a lattice of crossings, numbered by count, ends and tone, fitted to pixels.

The border squares of a chessboard alternate, and beyond them lies a rim, a carrier or a table: one
tone. Where that is seen along a side, the outermost corners are the board's own, and the count is
known although another side is hidden or out of view. A hand or a sheet of paper that covers corners
does not end along a line of the squares and gives no such evidence.

The camera looks at the front of a print, so that in the image the board's y lies clockwise of its
x. Where several numberings remain, the one whose x points most to the right is taken.

Corners are measured twice where the lattice that they make bends: a straight edge lies beside a
bent one by a third of the arc's height within reach of the fit, 0.02 to 0.1 px before a fisheye.

The origin is the inner corner whose outer square (towards -x, -y) is dark. Part of a board is
enough where its ends tell which part it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure
from armscan.vision.targets.crossings import (
    Crossings,
    Lattice,
    SmoothLattice,
    cell_arrays,
    find_crossings,
    find_lattices,
    fit_lattice,
    predict_cells,
)
from armscan.vision.targets.saddle import (
    MAX_WINDOW_PX,
    MIN_CONTRAST,
    WINDOW_FRACTION,
    Grey32,
    RawGrey,
    Saddles,
    fit_saddles,
    grey_channels,
    sample,
    window_radius,
)
from armscan.vision.targets.target import Chessboard, OtherCountSeen, TargetView, rightness

Steps = tuple[FloatArray, FloatArray]
"""Ways (N, 2) to the next corner along x and along y, image pixels."""
Side = Literal["ends", "may end", "continues", "unknown"]
"""What is seen beyond the outermost corners; "may end" where too few of them tell."""

SMALLEST = 3
"""Fewest columns and rows of corners that are taken for a chessboard."""
_MIN_FILLED = 0.6
"""Least fraction of its cells that an outermost row needs in order not to be tried without."""
_ALONG = (0.2, 0.35)
_WHOLE = 0.95
"""Least filled fraction of a rectangle that may be a whole board."""
_PROBES = (0.12, 0.2, 0.28)
"""Steps from the corners along both lines: near, so that what covers a board has to end within
this much of one of its lines in order to be taken for its end."""
_OUTWARD = (0.2, 0.28)
"""Steps beyond the outermost corners at which their squares have to be there: the fit's reach."""
_ALTERNATES = 0.5
"""Least difference between squares, of the difference beside them, that is one."""
_ONE_TONE = 0.35
"""Largest difference beyond the border squares that is none."""
_AGREEING = 0.7
_KNOWN = 0.6
_SUSPECT = 0.4
"""Fraction of the corners in view that must look like an end to make one possible."""


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """A rectangle of corners, as they lie in the image.

    ``cells``: (N, 2) cells (a, b) of the corners found, from (0, 0); b lies clockwise of a.
    ``points_px``: (N, 2) their image points. ``size``: Counts along a and b. ``sides``: What is
    beyond: before the first and after the last a, before the first and after the last b.
    """

    cells: IntArray
    points_px: FloatArray
    size: tuple[int, int]
    sides: tuple[Side, Side, Side, Side]

    @property
    def is_whole(self) -> bool:
        """Tell whether the corners fill their rectangle and the board does not go on."""
        is_filled = len(self.cells) >= _WHOLE * self.size[0] * self.size[1]
        return is_filled and "continues" not in self.sides

    @property
    def n_ends(self) -> int:
        """Sides on which the board is seen to end."""
        return sum(side == "ends" for side in self.sides)

    @property
    def counts(self) -> tuple[int, int]:
        """Counts along a and b, with one more for a side on which the board goes on."""
        more = [side == "continues" for side in self.sides]
        return self.size[0] + more[0] + more[1], self.size[1] + more[2] + more[3]


def extents(grey: Grey32, crossings: Crossings, lattice: Lattice) -> list[Extent]:
    """Return the rectangle of a lattice, then those without its sparse outermost rows.

    Not with a row before which a whole board is seen to end: it is of a frame or of what lies
    behind, even if a count that is wrong by one asks for it.

    ``grey``: (H, W) levels of the image in which the crossings were found. ``crossings``: All of
    the image. ``lattice``: Those that make a lattice.
    """
    cells, index = cell_arrays(lattice)
    found: list[Extent] = []
    left_out: int | None = None
    while len(cells) and (np.ptp(cells, axis=0) + 1).min() >= SMALLEST:
        low = cells.min(axis=0)
        size = np.ptp(cells, axis=0) + 1
        placed = cells - low
        points = crossings.points_px[index]
        sides = _sides(grey, placed, points, size)
        extent = Extent(placed, points, (int(size[0]), int(size[1])), sides)
        if left_out is not None and extent.is_whole and sides[left_out] == "ends":
            found.clear()
        found.append(extent)
        fraction, axis, end = _sparsest(placed, size)
        if fraction >= _MIN_FILLED:
            break
        kept = np.flatnonzero(placed[:, axis] != end)
        cells, index, left_out = cells[kept], index[kept], 2 * axis + (end > 0)
    return found


def _sparsest(cells: IntArray, size: IntArray) -> tuple[float, int, int]:
    """Filled fraction, axis and number of the emptiest outermost row."""
    return min(
        (float(np.mean(np.isin(np.arange(size[1 - axis]), cells[on, 1 - axis]))), axis, end)
        for axis in (0, 1)
        for end in (0, int(size[axis]) - 1)
        for on in (cells[:, axis] == end,)
    )


def _sides(
    grey: Grey32, cells: IntArray, points: FloatArray, size: IntArray
) -> tuple[Side, Side, Side, Side]:
    grid = _with_one_row_around(cells, points, size)
    before_b, after_b = _last_side(grey, grid[::-1]), _last_side(grey, grid)
    turned = grid.transpose(1, 0, 2)
    return _last_side(grey, turned[::-1]), _last_side(grey, turned), before_b, after_b


def _with_one_row_around(cells: IntArray, points: FloatArray, size: IntArray) -> FloatArray:
    """Image points (b + 2, a + 2, 2) of the rectangle and of one row around it.

    What is not seen is predicted in the three outermost rows; elsewhere it is NaN.
    """
    grid = np.full((size[1] + 2, size[0] + 2, 2), np.nan)
    is_wanted = np.ones(grid.shape[:2], dtype=np.bool_)
    is_wanted[3:-3, 3:-3] = False
    is_wanted[cells[:, 1] + 1, cells[:, 0] + 1] = False
    b, a = np.nonzero(is_wanted)
    grid[b, a] = predict_cells(cells, points, np.stack([a - 1, b - 1], axis=-1))
    grid[cells[:, 1] + 1, cells[:, 0] + 1] = points
    return grid


def _last_side(grey: Grey32, grid: FloatArray) -> Side:
    """What lies beyond the last row; ``grid``'s outermost rows are predictions."""
    border, last, before = grid[-1, 1:-1], grid[-2, 1:-1], grid[-3, 1:-1]
    sign = (-1.0) ** np.arange(len(last))
    along_last, along = np.gradient(last, axis=0), np.gradient(border, axis=0)
    inside = sign * _difference(grey, last, along_last, before - last)
    known = np.isfinite(inside)
    if not known.any():
        return "unknown"
    contrast = float(np.median(inside[known]))
    if contrast == 0.0:
        return "unknown"
    squares = -sign * _difference(grey, border, along, last - border) / contrast
    beyond = sign * _difference(grey, border, along, border - last) / contrast
    known = np.isfinite(squares) & np.isfinite(beyond)
    if not known.any():
        return "unknown"
    alternates = squares[known] > _ALTERNATES
    is_end = alternates & (np.abs(beyond[known]) < _ONE_TONE)
    if known.sum() >= max(SMALLEST - 1, _KNOWN * len(known)):
        if np.mean(is_end) >= _AGREEING:
            return "ends"
        if np.mean(alternates & (beyond[known] > _ALTERNATES)) >= _AGREEING:
            return "continues"
    return "may end" if np.mean(is_end) >= _SUSPECT else "unknown"


def _difference(
    grey: Grey32,
    corners_px: FloatArray,
    along_px: FloatArray,
    across_px: FloatArray,
    probes: tuple[float, ...] = _PROBES,
) -> FloatArray:
    """Level (N,) ahead of each corner less that behind it, on one side; NaN out of view."""
    p, q = np.array([(p, q) for p in _ALONG for q in probes]).T[..., None, None]
    places = np.stack([corners_px + p * along_px, corners_px - p * along_px]) + q * across_px
    ahead, behind = sample(grey, places.reshape(-1, 2)).reshape(2, len(p), len(corners_px))
    return np.asarray((ahead - behind).mean(axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class NumberedCorners:
    """Corners with their places on the board.

    ``cells``: (N, 2) column and row of each. ``points_px``: (N, 2) image points. ``quarter_turns``:
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
    return sorted(found, key=lambda n: -rightness(n.cells.astype(np.float64), n.points_px))


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


SEARCH_SIZE_PX = 1400
"""Larger images are reduced to this size for the search; corners are measured in the full one."""
MIN_SEEN_FRACTION = 0.4
"""Least fraction of a board's corners that makes a view."""
MIN_GOOD_FRACTION = 0.7
"""Least fraction of the corners found that the sub-pixel fit must accept: of all, or of those
within the outermost ring, which cut squares or a clip at the board's edge may spoil."""
LEAST_JUDGED = 6
MAX_SCATTER = 0.03
"""Largest scatter about a smooth lattice, as a fraction of a step: more is no flat board."""
PRINT_ERROR = 0.02
"""Error of a corner on the board itself that is no fault of the image, as a fraction of a step."""
_BENT_SIGMAS, _FEW_BENT = 0.5, 0.1
"""An arc's height within reach of a corner's fit, in its sigmas (a third of it is the error of a
straight edge), and the share of corners that may have more."""
_MOST_BENT = 0.5
"""Angle, rad, that an edge turns by within a fit's reach at most: more is no board."""
_LEAST_REDUCED, _CLEAR_PX, _MUCH_CLEARER = 1.5, 0.05, 0.5
"""Reduction of an image below which corners are not measured in it again; their median standard
deviation, px, below which there is no need to; and the part of it below which they are taken."""
_SHORTEST_PX = 2.0
"""Step to the next corner that a lattice must have where it is believed."""
_FEWEST_FOR_LATTICE, _FEWEST_FOR_BENDS = 4, 9
_SURE_ENDS = 2
"""Sides on which a rectangle must end in order to be surely a board."""
_LOCAL = 1.0 / 50.0
"""Standard deviation of the weights of a local mean, of the image's longer side."""
_REDUCED_SIGMA_PX = 4.0
"""The same in the reduced image in which it is taken."""
_LEAST_SCATTER, _PRINTED = 0.25, 0.7
"""Scatter, of the least contrast, that is taken for noise; contrast, of the local scatter, that is
taken for print: dark and light squares make 2."""
_MANY_BAD, _FEW_BAD = 0.5, 0.95
"""With fewer of its corners measured this is no board, with more no other channel is needed."""
_MAX_TRIED = 2
"""Rectangles of one lattice that are measured."""
_PROBE = 0.3
_PROBED_CORNERS = 12
"""Corners that tell in which channel all of them are measured."""
_CLEARER = 0.75
"""A channel is measured instead of the one in which the board was found if its corners' standard
deviation is smaller than this part of theirs: noise alone changes it by less in twelve corners."""


@dataclass(frozen=True, slots=True, eq=False)
class _Corners:
    """Measured corners, and the cell (N, 2) of each."""

    cells: IntArray
    saddles: Saddles
    scatter_px: float
    step_px: float


def detect_chessboard(exposure: Exposure, target: Chessboard) -> TargetView | FitFailure:
    """Find a chessboard and measure its corners.

    Returns the view, with the corners that the fit accepted; or why there is none.
    """
    channels = grey_channels(exposure)
    seen: list[Extent] = []
    found = _found_in(channels, exposure, target, seen)
    if found is None and not any(_is_board(extent) for extent in seen):
        levelled = _levelled(channels[0], MIN_CONTRAST * exposure.full_scale)
        found = _found_in([levelled], exposure, target, seen, is_whole=True)
    return _not_found(exposure, target, seen) if found is None else found


def _found_in(
    channels: list[RawGrey],
    exposure: Exposure,
    target: Chessboard,
    seen: list[Extent],
    *,
    is_whole: bool = False,
) -> TargetView | FitFailure | None:
    """The view, or the first reason against one, or None if no board was found.

    ``seen``: Output, rectangles that are none of the board. ``is_whole``: Only boards of which
    every row and column is in view, for where their ends are not to be trusted.
    """
    why: FitFailure | None = None
    min_contrast = MIN_CONTRAST * exposure.full_scale
    for k, grey in enumerate(channels):
        others = channels[:k] + channels[k + 1 :]
        for numbered in _numbered(grey, target, min_contrast, seen):
            counts = (np.ptp(numbered.cells, axis=0) + 1).tolist()
            if is_whole and counts != [target.columns, target.rows]:
                continue
            corners = _best_measured(grey, others, target, numbered)
            refusal = _refusal(exposure, target, corners)
            if refusal is None:
                found, covariance, good = corners.saddles
                number = corners.cells[good, 1] * target.columns + corners.cells[good, 0]
                found, covariance = found[good], covariance[good]
                return TargetView.of_image(exposure, target, number, found, covariance)
            why = refusal if why is None else why
    return why


def _levelled(grey: RawGrey, min_contrast: float) -> RawGrey:
    """The image less its local mean, over its local scatter: what is printed, however lit.

    Squares before a thermal camera differ by little, on a board that is warm in its middle.
    """
    levels = np.ascontiguousarray(grey, dtype=np.float32)
    sigma = _LOCAL * max(levels.shape)
    away = levels - _local_mean(levels, sigma)
    least = _LEAST_SCATTER * min_contrast
    scatter = np.sqrt(_local_mean(away * away, sigma) + least * least)
    return np.asarray(away / scatter * (min_contrast / _PRINTED), dtype=np.float64)


def _local_mean(levels: Grey32, sigma_px: float) -> Grey32:
    """Mean under a Gaussian of many pixels, taken on a reduced image, where it costs little."""
    factor = max(sigma_px / _REDUCED_SIGMA_PX, 1.0)
    height, width = levels.shape
    size = max(round(width / factor), 1), max(round(height / factor), 1)
    small = cv2.resize(levels, size, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma_px / factor)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR))


def _numbered(
    grey: RawGrey,
    target: Chessboard,
    min_contrast: float,
    seen: list[Extent],
) -> Iterator[NumberedCorners]:
    """Yield boards of the right count in one channel; other lattices are noted in ``seen``."""
    small, factor = _search_image(grey)
    crossings = find_crossings(small, min_contrast)
    fewest = MIN_SEEN_FRACTION * target.columns * target.rows
    for lattice in find_lattices(crossings):
        n_tried = 0
        for extent in extents(small, crossings, lattice):
            if n_tried == _MAX_TRIED:
                break
            choices = numberings(extent, target.columns, target.rows)
            # the origin has a dark outer square, unless none has
            choices = [n for n in choices if _darkness(small, n) > 0.0] or choices
            is_known = is_sure(choices, is_square=target.columns == target.rows)
            if not is_known:
                seen.append(extent)
            elif len(extent.cells) >= fewest:
                n_tried += 1
                points = (choices[0].points_px + 0.5) * factor - 0.5
                yield NumberedCorners(choices[0].cells, points, choices[0].quarter_turns)


def _search_image(grey: RawGrey) -> tuple[Grey32, float]:
    """The image, reduced to at most `SEARCH_SIZE_PX`, and the factor back to full size."""
    image = np.ascontiguousarray(grey, dtype=np.float32)
    factor = max(image.shape) / SEARCH_SIZE_PX
    if factor <= 1.0:
        return image, 1.0
    size = (round(image.shape[1] / factor), round(image.shape[0] / factor))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float32), image.shape[1] / size[0]


def _darkness(grey: Grey32, numbered: NumberedCorners) -> float:
    """Contrast of the squares in levels, positive if the one before the origin is dark."""
    ahead = predict_cells(numbered.cells, numbered.points_px, numbered.cells + np.array([1, 0]))
    below = predict_cells(numbered.cells, numbered.points_px, numbered.cells + np.array([0, 1]))
    step_x, step_y = ahead - numbered.points_px, below - numbered.points_px
    total = np.zeros(len(numbered.cells))
    for along_x in (-_PROBE, _PROBE):
        for along_y in (-_PROBE, _PROBE):
            levels = sample(grey, numbered.points_px + along_x * step_x + along_y * step_y)
            total -= np.sign(along_x * along_y) * np.nan_to_num(levels)
    parity = (-1.0) ** numbered.cells.sum(axis=1)
    return float(np.median(parity * total) / 2.0)


def _best_measured(
    grey: RawGrey, others: Sequence[RawGrey], target: Chessboard, numbered: NumberedCorners
) -> _Corners:
    """The corners in the channel that shows them clearest, or in which most can be measured.

    A board that is lit in one colour is found in the mean of all, but is twice as sharp in its own.
    A laser line of one colour crosses the board in one or two channels; the others show it whole.
    """
    clearest = _clearest([grey, *others], numbered)
    best = _measured(clearest, target, numbered)
    for other in (channel for channel in (grey, *others) if channel is not clearest):
        if not _MANY_BAD < best.saddles.is_good.mean() <= _FEW_BAD:
            break
        corners = _measured(other, target, numbered)
        if corners.saddles.is_good.sum() > best.saddles.is_good.sum():
            best = corners
    return best


def _clearest(channels: Sequence[RawGrey], numbered: NumberedCorners) -> RawGrey:
    """The channel with the smallest standard deviation of some corners; the first if none is clear.

    Only channels count in which as many of these corners can be measured as in the first.
    """
    if len(channels) == 1:
        return channels[0]
    some = np.linspace(0, len(numbered.cells) - 1, _PROBED_CORNERS).round().astype(np.int64)
    cells, start = numbered.cells[some], numbered.points_px[some]
    known = numbered.cells, numbered.points_px
    step_x = predict_cells(*known, cells + np.array([1, 0])) - start
    step_y = predict_cells(*known, cells + np.array([0, 1])) - start
    clearest, least, fewest = channels[0], np.inf, 0
    for channel in channels:
        saddles = fit_saddles(channel, start, step_x, step_y)
        n_good = int(saddles.is_good.sum())
        if n_good < max(fewest, 0.5 * len(some)):
            continue
        sigma = float(np.median(saddles.sigma_px[saddles.is_good]))
        if channel is channels[0]:
            fewest, least = n_good, _CLEARER * sigma
        elif sigma < least:
            clearest, least = channel, sigma
    return clearest


def _measured(grey: RawGrey, target: Chessboard, numbered: NumberedCorners) -> _Corners:
    """All corners in view, those that the search missed among them, by the fit on raw pixels."""
    row, column = np.mgrid[: target.rows, : target.columns]
    every = np.stack([column.ravel(), row.ravel()], axis=-1)
    known, points = numbered.cells, numbered.points_px
    start = predict_cells(known, points, every)
    number = known[:, 1] * target.columns + known[:, 0]
    start[number] = points
    step_x = predict_cells(known, points, every + np.array([1, 0])) - start
    step_y = predict_cells(known, points, every + np.array([0, 1])) - start
    size = np.array(grey.shape[1::-1])
    within = np.isfinite(start + step_x + step_y).all(axis=1)
    within &= ((start > 1.0) & (start < size - 2.0)).all(axis=1)
    cells, start, step_x, step_y = every[within], start[within], step_x[within], step_y[within]
    steps = step_x, step_y
    saddles = fit_board_saddles(grey, cells, start, steps)
    is_good = _has_squares_around(grey, target, cells, saddles.points_px, steps)
    is_good &= saddles.is_good
    lattice = board_lattice(grey, cells, saddles._replace(is_good=is_good), steps)
    scatter = float("inf")
    if lattice is not None:
        scatter = lattice.scatter_px
        is_good[np.flatnonzero(is_good)[lattice.is_off]] = False
    return _Corners(cells, saddles._replace(is_good=is_good), scatter, _typical_step(steps))


def fit_board_saddles(
    grey: RawGrey,
    cells: IntArray | FloatArray,
    corners_px: FloatArray,
    steps_px: Steps,
    clear_cells: float = 1.0,
) -> Saddles:
    """Refine the corners of one board, whose edges bend as the lattice that they make.

    In an image so large and blurred that edges are as wide as a fit's window, they are measured
    again in one that is reduced as far as squares allow, and the better of the two is taken.

    ``grey``, ``corners_px``, ``steps_px``: As of `fit_saddles`. ``cells``: (N, 2) column and row.
    ``clear_cells``: Length of the steps, in squares.
    """
    saddles = _fit_bent_saddles(grey, cells, corners_px, steps_px, clear_cells)
    room = WINDOW_FRACTION * _typical_step(steps_px) / MAX_WINDOW_PX if len(cells) else 0.0
    if room < _LEAST_REDUCED or _median_sigma(saddles) < _CLEAR_PX:
        return saddles
    width, height = (round(size / room) for size in grey.shape[1::-1])
    image = np.ascontiguousarray(grey, dtype=np.float32)
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    scale = np.array([grey.shape[1] / width, grey.shape[0] / height])
    steps = steps_px[0] / scale, steps_px[1] / scale
    start = (corners_px + 0.5) / scale - 0.5
    reduced = _fit_bent_saddles(small.astype(np.float64), cells, start, steps, clear_cells)
    # pixels that overlap share their noise
    shared = scale / (scale - 1.0 / 3.0)
    covariance = reduced.covariance_px2 * np.outer(scale * shared, scale * shared)
    reduced = Saddles((reduced.points_px + 0.5) * scale - 0.5, covariance, reduced.is_good)
    is_clearer = _median_sigma(reduced) < _MUCH_CLEARER * _median_sigma(saddles)
    return reduced if is_clearer else saddles


def regular_saddles(
    grey: RawGrey,
    cells: IntArray | FloatArray,
    corners_px: FloatArray,
    steps_px: Steps,
    clear_cells: float,
) -> Saddles:
    """As `fit_board_saddles`; none is good that lies off the lattice of the others."""
    saddles = fit_board_saddles(grey, cells, corners_px, steps_px, clear_cells)
    lattice = board_lattice(grey, cells, saddles, steps_px)
    if lattice is not None:
        saddles.is_good[np.flatnonzero(saddles.is_good)[lattice.is_off]] = False
    return saddles


def _median_sigma(saddles: Saddles) -> float:
    """Of all corners, those that were not measured counting as endless."""
    return float(np.median(np.where(saddles.is_good, saddles.sigma_px, np.inf)))


def _fit_bent_saddles(
    grey: RawGrey,
    cells: IntArray | FloatArray,
    corners_px: FloatArray,
    steps_px: Steps,
    clear_cells: float,
) -> Saddles:
    """As `fit_board_saddles`, in the image as it is."""
    saddles = fit_saddles(grey, corners_px, *steps_px)
    n_good = int(saddles.is_good.sum())
    lattice = board_lattice(grey, cells, saddles, steps_px)
    if lattice is None or n_good < _FEWEST_FOR_BENDS:
        return saddles
    # rounded: linear algebra's last digits depend on where its arrays lie in memory
    board = cells.astype(np.float64)
    curvature = np.nan_to_num(lattice.curvature(board)).round(9)
    radius = window_radius(*steps_px)
    turn = radius * np.abs(curvature).max(axis=1)
    is_bent = (0.5 * radius * turn > _BENT_SIGMAS * saddles.sigma_px) & saddles.is_good
    if is_bent.sum() <= _FEW_BENT * n_good or turn[saddles.is_good].max() > _MOST_BENT:
        return saddles
    # where the search missed one, local predictions lie up to 40 px off before a fisheye
    steps = clear_cells * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    seen, ahead, below = (lattice.seen(board + step).round(6) for step in steps)
    along_x, along_y = ahead - seen, below - seen
    shortest = np.minimum(np.hypot(*along_x.T), np.hypot(*along_y.T))
    is_seen = ((shortest > _SHORTEST_PX) & np.isfinite(shortest) & (turn < _MOST_BENT))[:, None]
    start = np.where(is_seen, seen, corners_px)
    start[saddles.is_good] = saddles.points_px[saddles.is_good]
    along_x = np.where(is_seen, along_x, steps_px[0])
    along_y = np.where(is_seen, along_y, steps_px[1])
    return fit_saddles(grey, start, along_x, along_y, np.where(is_seen, curvature, 0.0))


def board_lattice(
    grey: RawGrey, cells: IntArray | FloatArray, saddles: Saddles, steps_px: Steps
) -> SmoothLattice | None:
    """The lattice of the good corners (M,); none where they are too few."""
    good = saddles.is_good
    if good.sum() < _FEWEST_FOR_LATTICE:
        return None
    board, size_px = cells[good].astype(np.float64), (grey.shape[1], grey.shape[0])
    tolerance = PRINT_ERROR * _typical_step(steps_px)
    points, sigma = saddles.points_px[good], saddles.sigma_px[good]
    return fit_lattice(board, points, sigma, tolerance, size_px)


def _typical_step(steps_px: Steps) -> float:
    return float(np.median(np.min([np.hypot(*way.T) for way in steps_px], axis=0)))


def _has_squares_around(
    grey: RawGrey,
    target: Chessboard,
    cells: IntArray,
    corners_px: FloatArray,
    steps_px: Steps,
) -> BoolArray:
    """(N,) False for corners of the outermost rows whose squares end within reach of the fit.

    An end so near is one more edge beside the corner, which pulls it: by 0.3 to 0.9 px where a
    sixth of the squares is left, and ten times what the fit claims.
    """
    image, has_squares = np.asarray(grey, np.float32), np.ones(len(cells), dtype=np.bool_)
    for axis, count in enumerate((target.columns, target.rows)):
        for end, sign in ((0, -1.0), (count - 1, 1.0)):
            last = np.flatnonzero(cells[:, axis] == end)
            along, out = steps_px[1 - axis][last], sign * steps_px[axis][last]
            for q in _OUTWARD:
                beyond, within = (
                    _difference(image, corners_px[last], along, way * out, probes=(q,))
                    for way in (1.0, -1.0)
                )
                ends = np.abs(beyond) < _ALTERNATES * np.abs(within)
                has_squares[last[ends | (beyond * within > 0.0)]] = False
    return has_squares


def _refusal(exposure: Exposure, target: Chessboard, corners: _Corners) -> FitFailure | None:
    n_good, n_all = int(corners.saddles.is_good.sum()), target.columns * target.rows
    last = (target.columns - 1, target.rows - 1)
    is_inner = ((corners.cells > 0) & (corners.cells < last)).all(axis=1)
    inner = corners.saddles.is_good[is_inner]
    n_inner = max(LEAST_JUDGED, MIN_SEEN_FRACTION * (last[0] - 1) * (last[1] - 1))
    is_inside = len(inner) >= n_inner and inner.mean() >= MIN_GOOD_FRACTION
    least = max(MIN_SEEN_FRACTION * n_all, MIN_GOOD_FRACTION * len(corners.cells))
    if n_good < least and not is_inside:
        return FitFailure(
            f"{exposure.source}: only {n_good} of {n_all} chessboard corners are "
            "crossings of two straight edges",
            "give a sharper image that shows more of the board, without light stripes on it",
        )
    if corners.scatter_px > MAX_SCATTER * corners.step_px:
        return FitFailure(
            f"{exposure.source}: the chessboard's corners scatter by {corners.scatter_px:.1f} px "
            "about a smooth lattice",
            "use a flat board",
        )
    return None


def _is_board(extent: Extent) -> bool:
    """Tell whether a rectangle is surely a board: clutter may alternate, but does not end."""
    return extent.is_whole and extent.n_ends >= _SURE_ENDS


def _not_found(exposure: Exposure, target: Chessboard, extents_seen: list[Extent]) -> FitFailure:
    wanted = f"{target.columns} x {target.rows} inner corners"
    none = f"{exposure.source}: no chessboard of {wanted} in view"
    # a tangle of a few crossings within a large rectangle says nothing of a board's counts
    filled = [e for e in extents_seen if len(e.cells) >= _MIN_FILLED * e.size[0] * e.size[1]]
    seen = max(filled, key=lambda e: (_is_board(e), e.is_whole, len(e.cells)), default=None)
    if seen is None:
        return FitFailure(
            none, f"show the board sharp and evenly lit, at least {SMALLEST} corners each way"
        )
    columns, rows = max(seen.counts), min(seen.counts)
    reason = f"{none}; {columns} x {rows} corners were seen"
    if _is_board(seen):
        return OtherCountSeen(
            reason, "count the corners where four squares meet", columns=columns, rows=rows
        )
    return FitFailure(
        reason, "show the whole board, or count again the corners where four squares meet"
    )
