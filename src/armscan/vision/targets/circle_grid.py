# SPDX-License-Identifier: Apache-2.0
"""Circle grids, symmetric and asymmetric, dark on light and light on dark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import FloatArray
from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure
from armscan.vision.targets.blobs import Blobs, find_blobs
from armscan.vision.targets.circle_centres import correct_centres
from armscan.vision.targets.circle_edges import MeasuredCircles, measure_circles
from armscan.vision.targets.definition import CircleGrid
from armscan.vision.targets.grey import RawGrey, grey_channels, to_grey8
from armscan.vision.targets.grid_numbering import (
    NumberedGrid,
    is_symmetric,
    lattice_size,
    number_grid,
)
from armscan.vision.targets.lattice_growth import grow_lattices
from armscan.vision.targets.options import TargetOptions
from armscan.vision.targets.view import CircleEdges, TargetView


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """What one channel showed: the grid, or the largest lattice that is another one."""

    blobs: Blobs
    grid: NumberedGrid | None
    n_seen: int
    size_seen: tuple[int, int]


def detect_circle_grid(
    exposure: Exposure, target: CircleGrid, options: TargetOptions
) -> TargetView | FitFailure:
    """Find a circle grid and measure its circles.

    Returns
    -------
    The view, centres corrected for eccentricity without intrinsics; or why there is none.
    """
    best_seen = (0, (0, 0))
    for grey in grey_channels(exposure):
        search = _search(grey, exposure, target, options)
        if search.grid is None:
            best_seen = max(best_seen, (search.n_seen, search.size_seen))
            continue
        index = search.grid.blob_index
        circles = measure_circles(
            grey,
            search.blobs.centres_px[index],
            search.blobs.shapes_px2[index],
            options.min_contrast * exposure.full_scale,
        )
        if circles.is_good.mean() < options.min_circles_fraction:
            best_seen = max(best_seen, (int(circles.is_good.sum()), search.size_seen))
            continue
        return correct_centres(_view(exposure, target, search.grid, circles))
    return _failure(exposure, target, *best_seen)


def _search(
    grey: RawGrey, exposure: Exposure, target: CircleGrid, options: TargetOptions
) -> _Search:
    """Number the grid among the dark or the light blobs, whichever shows more of it."""
    blobs = find_blobs(to_grey8(grey, exposure.full_scale), options)
    best = _Search(blobs, None, 0, (0, 0))
    for is_light in (False, True):
        alike = blobs.subset(blobs.is_light == is_light)
        for lattice in grow_lattices(alike):
            grid = number_grid(lattice, alike.centres_px, target, options.min_circles_fraction)
            n_seen = len(lattice)
            is_better = (grid is not None, n_seen) > (best.grid is not None, best.n_seen)
            if is_better:
                size = lattice_size(lattice, target.is_asymmetric)
                best = _Search(alike, grid, n_seen, size)
    return best


def _view(
    exposure: Exposure, target: CircleGrid, grid: NumberedGrid, circles: MeasuredCircles
) -> TargetView:
    good = np.flatnonzero(circles.is_good)
    used = np.isfinite(circles.sigma_px[good])
    binning = exposure.window.binning
    centres, covariance = circles.ellipses.centres()
    number = grid.point_index[good]
    return TargetView(
        source=exposure.source,
        width_px=exposure.window.x_px + exposure.width_px * binning,
        height_px=exposure.window.y_px + exposure.height_px * binning,
        point_index=number,
        points_px=exposure.window.to_full_sensor(centres[good]),
        covariance_px2=covariance[good] * binning**2,
        points_board_mm=target.points_board_mm[number],
        edges=CircleEdges(
            points_px=exposure.window.to_full_sensor(_flat(circles.points_px[good], used)),
            circle=np.repeat(np.arange(len(good)), used.sum(axis=1)),
            sigma_px=circles.sigma_px[good][used] * binning,
        ),
        is_ambiguous=is_symmetric(target),
    )


def _flat(points: FloatArray, used: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> FloatArray:
    return np.asarray(points[used])


def _failure(
    exposure: Exposure, target: CircleGrid, n_seen: int, size_seen: tuple[int, int]
) -> FitFailure:
    kind = "asymmetric circle grid" if target.is_asymmetric else "circle grid"
    wanted = f"{kind} of {target.columns} x {target.rows}"
    if n_seen == 0:
        return FitFailure(
            f"{exposure.source}: no {wanted} in view, no circles in rows were seen",
            "show the whole grid, sharp and evenly lit",
        )
    return FitFailure(
        f"{exposure.source}: no {wanted} in view; {n_seen} circles in a lattice of "
        f"{size_seen[0]} x {size_seen[1]} were seen",
        "check columns and rows, and show the whole grid",
    )
