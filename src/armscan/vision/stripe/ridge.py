# SPDX-License-Identifier: Apache-2.0
"""Linked ridge points: candidates, then the Hessian at the candidates, then chains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.kernels.stripe_hessian import gaussian_taps, refine_candidates
from armscan.kernels.stripe_links import REACH_PX, find_neighbours, place_points, walk_chains
from armscan.kernels.stripe_runs import find_runs
from armscan.vision.stripe.chains import strong_median
from armscan.vision.stripe.level import CELL_PX, ImageLevel

LONGEST_RUN_PX = 90
HESSIAN_SIGMA_LIMITS_PX = (1.0, 8.0)


@dataclass(frozen=True, slots=True, eq=False)
class RidgePoints:
    """Points on ridges, ordered along chains.

    Parameters
    ----------
    table
        (N, 6) x, y, normal x, normal y (image pixels), negative second derivative across the line,
        axis (0: at an integer column, 1: at an integer row).
    chain
        (N,) number of the chain; a chain's points are consecutive.
    """

    table: FloatArray
    chain: IntArray

    def __len__(self) -> int:
        """Count of points."""
        return len(self.table)

    def select(self, keep: NDArray[np.bool_]) -> RidgePoints:
        """Return the points where ``keep`` (N,) is True; chains are cut where a gap opens."""
        table, chain = self.table[keep], self.chain[keep]
        if len(table) == 0:
            return RidgePoints(table, chain)
        step = np.hypot(*np.diff(table[:, :2], axis=0).T)
        is_new = (np.diff(chain) != 0) | (step > REACH_PX)
        return RidgePoints(table, np.concatenate([[0], np.cumsum(is_new)]).astype(np.int64))


def find_candidates(image: NDArray[np.float32], level: ImageLevel) -> FloatArray:
    """Centroids (N, 3) of the runs above the background: x, y, axis."""
    height, width = image.shape
    capacity = max(1000, height * width // 32)
    while True:
        runs = np.zeros((capacity, 3))
        count = find_runs(image, level.background, CELL_PX, level.rise, LONGEST_RUN_PX, runs)
        if count <= capacity:
            return runs[:count]
        capacity = count


def least_bend(height: float, sigma_px: float, scale_px: float) -> float:
    """Second derivative at scale ``scale_px`` of a line of this height and sigma."""
    return float(height * sigma_px / (sigma_px**2 + scale_px**2) ** 1.5)


def hessian_sigma(line_sigma_px: float) -> float:
    """Scale of the Hessian for lines of this sigma."""
    return float(np.clip(line_sigma_px, *HESSIAN_SIGMA_LIMITS_PX))


def trace_ridges(
    image: NDArray[np.float32], runs: FloatArray, line_sigma_px: float, rise: float
) -> RidgePoints:
    """Ridge points at the candidates, linked into chains.

    Parameters
    ----------
    image
        (H, W) float32.
    runs
        (N, 3) from `find_candidates`.
    line_sigma_px
        Typical sigma of the lines.
    rise
        Least height of a line above its background.
    """
    scale = hessian_sigma(line_sigma_px)
    found = np.zeros((max(len(runs), 1), 6))
    bend = least_bend(rise, line_sigma_px, scale)
    n = refine_candidates(image, runs, len(runs), gaussian_taps(scale), bend, found)
    return link(found[:n], image.shape)


def link(points: FloatArray, shape: tuple[int, ...]) -> RidgePoints:
    """Order points (N, 6) along chains; points without a neighbour are dropped.

    Parameters
    ----------
    points
        Rows as in `RidgePoints.table`.
    shape
        Rows and columns of the image.
    """
    n = len(points)
    owner = np.full(shape, -1, np.int32)
    is_kept = np.zeros(n, np.int64)
    place_points(points, owner, is_kept)
    ahead = np.full(n, -1, np.int64)
    behind = np.full(n, -1, np.int64)
    find_neighbours(points, owner, ahead, behind)
    order = np.zeros(n, np.int64)
    chain = np.zeros(n, np.int64)
    count = walk_chains(ahead, behind, order, chain)
    return RidgePoints(points[order[:count]], chain[:count])


def is_bright(ridge: RidgePoints, least_share: float) -> NDArray[np.bool_]:
    """(N,) False for the chains whose median curvature is below a share of the strong ones'."""
    if not len(ridge):
        return np.zeros(0, dtype=np.bool_)
    bend = ridge.table[:, 4]
    starts = np.flatnonzero(np.concatenate([[True], np.diff(ridge.chain) != 0]))
    sizes = np.diff(np.concatenate([starts, [len(ridge)]]))
    medians = np.array([np.median(bend[a : a + n]) for a, n in zip(starts, sizes, strict=True)])
    return np.asarray(np.repeat(medians, sizes) >= least_share * strong_median(bend))
