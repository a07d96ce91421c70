# SPDX-License-Identifier: Apache-2.0
"""Chessboards: found by OpenCV, numbered by the tone of the first square, measured on raw pixels.

The origin is the inner corner whose outer square (towards -x, -y) is dark.
"""

from __future__ import annotations

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure
from armscan.vision.targets.board_lattice import lattice_steps, numberings
from armscan.vision.targets.chessboard_extent import true_size
from armscan.vision.targets.chessboard_search import rough_corners, seen_size
from armscan.vision.targets.definition import Chessboard
from armscan.vision.targets.grey import RawGrey, sample
from armscan.vision.targets.options import TargetOptions
from armscan.vision.targets.saddle import fit_saddles
from armscan.vision.targets.view import TargetView

MIN_GOOD_FRACTION = 0.8
"""Least fraction of corners that the sub-pixel fit must accept."""
_PROBE = 0.3


def detect_chessboard(
    exposure: Exposure, target: Chessboard, options: TargetOptions
) -> TargetView | FitFailure:
    """Find a chessboard and measure its corners.

    Returns
    -------
    The view, with the corners that the fit on raw pixels accepted; or why there is none.
    """
    why: FitFailure | None = None
    size = (target.columns, target.rows)
    for grey, rough_px in rough_corners(exposure, *size, options.search_size_px):
        view = _measure(exposure, target, options, grey, rough_px)
        if isinstance(view, TargetView):
            return view
        why = view if why is None else why
    seen = seen_size(exposure, options.search_size_px)
    if why is not None and (seen is None or sorted(seen) == sorted(size)):
        return why
    return _not_found(exposure, target, seen)


def is_symmetric(target: Chessboard) -> bool:
    """Tell whether the board looks the same after half a turn (columns + rows even)."""
    return (target.columns + target.rows) % 2 == 0


def _measure(
    exposure: Exposure,
    target: Chessboard,
    options: TargetOptions,
    grey: RawGrey,
    rough_px: FloatArray,
) -> TargetView | FitFailure:
    grid, contrast = _numbered(grey, rough_px, target)
    if contrast < options.min_contrast * exposure.full_scale:
        return FitFailure(
            f"{exposure.source}: the chessboard's contrast is {contrast:.1f} of "
            f"{exposure.full_scale} grey levels",
            "expose longer or light the board",
        )
    size = true_size(grey, grid)
    if size != (target.columns, target.rows):
        return _not_found(exposure, target, (max(size), min(size)))
    step_x, step_y = lattice_steps(grid)
    flat = grid.reshape(-1, 2)
    corners, covariance, is_good = fit_saddles(
        grey, flat, step_x.reshape(-1, 2), step_y.reshape(-1, 2)
    )
    if is_good.mean() < MIN_GOOD_FRACTION:
        return FitFailure(
            f"{exposure.source}: only {int(is_good.sum())} of {len(flat)} chessboard corners are "
            "crossings of two straight edges",
            "give a sharper image without light stripes on the board",
        )
    binning = exposure.window.binning
    return TargetView(
        source=exposure.source,
        width_px=exposure.window.x_px + exposure.width_px * binning,
        height_px=exposure.window.y_px + exposure.height_px * binning,
        point_index=np.flatnonzero(is_good),
        points_px=exposure.window.to_full_sensor(corners[is_good]),
        covariance_px2=covariance[is_good] * binning**2,
        points_board_mm=target.points_board_mm[is_good],
        is_ambiguous=is_symmetric(target),
    )


def _numbered(grey: RawGrey, rough_px: FloatArray, target: Chessboard) -> tuple[FloatArray, float]:
    """The lattice (rows, columns, 2) from its dark-cornered origin, and its contrast in levels."""
    grids = numberings(rough_px, target.columns, target.rows)
    contrasts = [_dark_first(grey, grid) for grid in grids]
    dark = [k for k, contrast in enumerate(contrasts) if contrast > 0.0]
    chosen = dark[0] if dark else 0
    return grids[chosen], abs(contrasts[chosen])


def _dark_first(grey: RawGrey, grid: FloatArray) -> float:
    """Contrast of the squares, positive if the one before the origin is dark."""
    step_x, step_y = lattice_steps(grid)
    total = np.zeros(grid.shape[:2])
    for along_x in (-_PROBE, _PROBE):
        for along_y in (-_PROBE, _PROBE):
            points = grid + along_x * step_x + along_y * step_y
            levels = sample(grey, points.reshape(-1, 2)).reshape(total.shape)
            total -= np.sign(along_x * along_y) * np.nan_to_num(levels)
    rows, columns = grid.shape[0], grid.shape[1]
    parity = (-1.0) ** np.add.outer(np.arange(rows), np.arange(columns))
    return float(np.median(parity * total) / 2.0)


def _not_found(exposure: Exposure, target: Chessboard, seen: tuple[int, int] | None) -> FitFailure:
    wanted = f"{target.columns} x {target.rows}"
    if seen is None:
        return FitFailure(
            f"{exposure.source}: no chessboard of {wanted} inner corners in view",
            "show the whole board with its light rim, sharp and evenly lit",
        )
    return FitFailure(
        f"{exposure.source}: no chessboard of {wanted} inner corners in view; "
        f"{seen[0]} x {seen[1]} corners were seen",
        "count the corners where four squares meet, or show the whole board",
    )
