# SPDX-License-Identifier: Apache-2.0
"""Chessboards: a lattice of crossings, numbered by count, ends and tone, measured on raw pixels.

The origin is the inner corner whose outer square (towards -x, -y) is dark. Part of a board is
enough where its ends tell which part it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure
from armscan.vision.targets.board_lattice import NumberedCorners, is_sure, numberings
from armscan.vision.targets.board_regularity import off_lattice
from armscan.vision.targets.chessboard_extent import SMALLEST, Extent, extents
from armscan.vision.targets.crossing_lattice import find_lattices, predict_cells
from armscan.vision.targets.crossings import find_crossings
from armscan.vision.targets.definition import Chessboard
from armscan.vision.targets.grey import Grey32, RawGrey, grey_channels, sample
from armscan.vision.targets.options import TargetOptions
from armscan.vision.targets.saddle import fit_saddles
from armscan.vision.targets.view import OtherCountSeen, TargetView

MIN_SEEN_FRACTION = 0.4
"""Least fraction of a board's corners that makes a view."""
MIN_GOOD_FRACTION = 0.7
"""Least fraction of the corners found that the sub-pixel fit must accept."""
MAX_SCATTER = 0.03
"""Largest scatter about a smooth lattice, as a fraction of a step: more is no flat board."""
PRINT_ERROR = 0.02
"""Error of a corner on the board itself that is no fault of the image, as a fraction of a step."""
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
    """Corners measured on raw pixels: cells (N, 2), points (N, 2), covariances, use (N,)."""

    cells: IntArray
    points_px: FloatArray
    covariance_px2: FloatArray
    is_good: BoolArray
    scatter_px: float
    step_px: float


def detect_chessboard(
    exposure: Exposure, target: Chessboard, options: TargetOptions
) -> TargetView | FitFailure:
    """Find a chessboard and measure its corners.

    Returns
    -------
    The view, with the corners that the fit on raw pixels accepted; or why there is none.
    """
    channels = grey_channels(exposure)
    min_contrast = options.min_contrast * exposure.full_scale
    why: FitFailure | None = None
    seen: list[Extent] = []
    for number, grey in enumerate(channels):
        others = channels[:number] + channels[number + 1 :]
        for numbered in _numbered(grey, target, options.search_size_px, min_contrast, seen):
            corners = _best_measured(grey, others, target, numbered)
            refusal = _refusal(exposure, target, corners)
            if refusal is None:
                return _view(exposure, target, corners)
            why = refusal if why is None else why
    return _not_found(exposure, target, seen) if why is None else why


def is_symmetric(target: Chessboard) -> bool:
    """Tell whether the board looks the same after half a turn (columns + rows even)."""
    return (target.columns + target.rows) % 2 == 0


def _numbered(
    grey: RawGrey,
    target: Chessboard,
    size_px: int,
    min_contrast: float,
    seen: list[Extent],
) -> Iterator[NumberedCorners]:
    """Yield boards of the right count in one channel; other lattices are noted in ``seen``."""
    small, factor = _search_image(grey, size_px)
    crossings = find_crossings(small, min_contrast)
    fewest = MIN_SEEN_FRACTION * target.columns * target.rows
    for lattice in find_lattices(crossings):
        n_tried = 0
        for extent in extents(small, crossings, lattice):
            if n_tried == _MAX_TRIED:
                break
            choices = _dark_first(small, numberings(extent, target.columns, target.rows))
            is_known = is_sure(choices, is_square=target.columns == target.rows)
            if not is_known:
                seen.append(extent)
            elif len(extent.cells) >= fewest:
                n_tried += 1
                points = (choices[0].points_px + 0.5) * factor - 0.5
                yield NumberedCorners(choices[0].cells, points, choices[0].quarter_turns)


def _search_image(grey: RawGrey, size_px: int) -> tuple[Grey32, float]:
    """The image, reduced to at most ``size_px``, and the factor back to full size."""
    image = np.ascontiguousarray(grey, dtype=np.float32)
    factor = max(image.shape) / size_px
    if factor <= 1.0:
        return image, 1.0
    size = (round(image.shape[1] / factor), round(image.shape[0] / factor))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float32), image.shape[1] / size[0]


def _dark_first(grey: Grey32, choices: Sequence[NumberedCorners]) -> list[NumberedCorners]:
    """Those numberings whose origin has a dark outer square; all if none has."""
    dark = [numbered for numbered in choices if _darkness(grey, numbered) > 0.0]
    return dark if dark else list(choices)


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
        if not _MANY_BAD < best.is_good.mean() <= _FEW_BAD:
            break
        corners = _measured(other, target, numbered)
        if corners.is_good.sum() > best.is_good.sum():
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
        _, covariance, is_good = fit_saddles(channel, start, step_x, step_y)
        if is_good.sum() < max(fewest, 0.5 * len(some)):
            continue
        sigma = float(np.sqrt(np.median(np.trace(covariance[is_good], axis1=1, axis2=2))))
        if channel is channels[0]:
            fewest, least = int(is_good.sum()), _CLEARER * sigma
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
    corners, covariance, is_good = fit_saddles(grey, start, step_x, step_y)
    sigma = np.sqrt(0.5 * np.trace(covariance, axis1=1, axis2=2))
    scatter = float("inf")
    step = float(np.median(np.minimum(np.hypot(*step_x.T), np.hypot(*step_y.T))))
    if is_good.sum() >= 4:
        good = np.flatnonzero(is_good)
        board = cells[good].astype(np.float64)
        is_off, scatter = off_lattice(board, corners[good], sigma[good], PRINT_ERROR * step)
        is_good[good[is_off]] = False
    return _Corners(cells, corners, covariance, is_good, scatter, step)


def _refusal(exposure: Exposure, target: Chessboard, corners: _Corners) -> FitFailure | None:
    n_good, n_all = int(corners.is_good.sum()), target.columns * target.rows
    if n_good < MIN_SEEN_FRACTION * n_all or n_good < MIN_GOOD_FRACTION * len(corners.cells):
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


def _view(exposure: Exposure, target: Chessboard, corners: _Corners) -> TargetView:
    good = corners.is_good
    binning = exposure.window.binning
    number = corners.cells[good, 1] * target.columns + corners.cells[good, 0]
    return TargetView(
        source=exposure.source,
        width_px=exposure.window.x_px + exposure.width_px * binning,
        height_px=exposure.window.y_px + exposure.height_px * binning,
        point_index=number,
        points_px=exposure.window.to_full_sensor(corners.points_px[good]),
        covariance_px2=corners.covariance_px2[good] * binning**2,
        points_board_mm=target.points_board_mm[number],
        is_ambiguous=is_symmetric(target),
    )


def _not_found(exposure: Exposure, target: Chessboard, extents_seen: list[Extent]) -> FitFailure:
    wanted = f"{target.columns} x {target.rows}"
    seen = max(extents_seen, key=lambda e: (e.is_whole, len(e.cells)), default=None)
    if seen is None:
        return FitFailure(
            f"{exposure.source}: no chessboard of {wanted} inner corners in view",
            f"show the board sharp and evenly lit, at least {SMALLEST} corners each way",
        )
    columns, rows = max(seen.counts), min(seen.counts)
    reason = (
        f"{exposure.source}: no chessboard of {wanted} inner corners in view; "
        f"{columns} x {rows} corners were seen"
    )
    if seen.is_whole:
        return OtherCountSeen(
            reason, "count the corners where four squares meet", columns=columns, rows=rows
        )
    return FitFailure(
        reason, "show the whole board, or count again the corners where four squares meet"
    )
