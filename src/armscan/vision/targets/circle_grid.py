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
from armscan.vision.targets.view import CircleEdges, OtherCountSeen, TargetView

WHOLE_FRACTION = 0.95
"""Least filled fraction of a lattice that may be a whole grid."""


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A lattice of blobs; ``grid`` is None if it is not the target's."""

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
        for candidate in _candidates(grey, exposure, target, options):
            best_seen = max(best_seen, (candidate.n_seen, candidate.size_seen))
            if candidate.grid is None:
                continue
            index = candidate.grid.blob_index
            circles = measure_circles(
                grey,
                candidate.blobs.centres_px[index],
                candidate.blobs.shapes_px2[index],
                options.min_contrast * exposure.full_scale,
            )
            if circles.is_good.mean() >= options.min_circles_fraction:
                return correct_centres(_view(exposure, target, candidate.grid, circles))
    return _failure(exposure, target, *best_seen)


def _candidates(
    grey: RawGrey, exposure: Exposure, target: CircleGrid, options: TargetOptions
) -> list[_Candidate]:
    """Lattices among the dark and among the light blobs, the target's own and the largest first.

    The thresholds also outline the ground between circles: such a lattice fits as well, but its
    rims show no edge, so that measuring it tells.
    """
    blobs = find_blobs(to_grey8(grey, exposure.full_scale), options)
    found = []
    for is_light in (False, True):
        alike = blobs.subset(blobs.is_light == is_light)
        for lattice in grow_lattices(alike):
            grid = number_grid(lattice, alike.centres_px, target, options.min_circles_fraction)
            size = lattice_size(lattice, target.is_asymmetric)
            found.append(_Candidate(alike, grid, len(lattice), size))
    return sorted(found, key=lambda c: (c.grid is None, -c.n_seen))


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
    columns, rows = size_seen
    reason = (
        f"{exposure.source}: no {wanted} in view; {n_seen} circles in a lattice of "
        f"{columns} x {rows} were seen"
    )
    remedy = "check columns and rows, and show the whole grid"
    if n_seen >= WHOLE_FRACTION * columns * rows and min(size_seen) > 1:
        return OtherCountSeen(reason, remedy, columns=columns, rows=rows)
    return FitFailure(reason, remedy)
