# SPDX-License-Identifier: Apache-2.0
"""Two parallel faces in a cloud or a profile: where they are, and which points are theirs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.inspection.options import InspectionOptions

BIN_MM = 0.1
MAX_PEAKS = 60
MAX_EXTENT_MM = 1e5
LEAST_INSIDE = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class ParallelFaces:
    """``normal @ p = lower_mm`` and ``= upper_mm`` in D dimensions; upper > lower."""

    normal: FloatArray
    lower_mm: float
    upper_mm: float

    @property
    def height_mm(self) -> float:
        """Distance between the faces."""
        return self.upper_mm - self.lower_mm


def find_levels(
    points: FloatArray,
    normal: FloatArray,
    height_mm: float,
    tolerance_mm: float,
    options: InspectionOptions,
) -> ParallelFaces | FitFailure:
    """The two best filled levels along a normal that stand a nominal height apart.

    Parameters
    ----------
    points
        (N, D) points.
    normal
        (D,) common normal.
    height_mm, tolerance_mm
        Nominal height, and how far from it the levels may be.
    options
        Band and fewest points of a level.
    """
    levels, counts = _levels(points @ normal, options)
    apart = levels[None, :] - levels[:, None]
    fits = np.abs(apart - height_mm) <= tolerance_mm
    if not fits.any():
        return FitFailure(
            f"there are no two parallel faces {height_mm:g} mm apart, to {tolerance_mm:.2g} mm; "
            + _found(levels, counts),
            "check the height, or show where the step is with --region",
        )
    votes = np.where(fits, np.minimum(counts[None, :], counts[:, None]), -1)
    lower, upper = (int(k) for k in np.unravel_index(int(votes.argmax()), votes.shape))
    return ParallelFaces(normal, float(levels[lower]), float(levels[upper]))


def _levels(heights: FloatArray, options: InspectionOptions) -> tuple[FloatArray, IntArray]:
    """Local maxima of the heights' density, best filled first, and the points about each."""
    low = float(heights.min())
    if np.ptp(heights) > MAX_EXTENT_MM:
        return np.zeros(0), np.zeros(0, dtype=np.int64)
    bins = np.bincount(((heights - low) / BIN_MM).astype(np.int64))
    width = max(1, round(options.search_band_mm / BIN_MM))
    filled = np.convolve(bins, np.ones(2 * width + 1), "same").astype(np.int64)
    levels, counts = [], []
    for _ in range(MAX_PEAKS):
        top = int(filled.argmax())
        if filled[top] < options.min_points:
            break
        about = low + (top + 0.5) * BIN_MM
        near = heights[np.abs(heights - about) <= options.search_band_mm + BIN_MM]
        levels.append(float(np.median(near)))
        counts.append(len(near))
        filled[max(0, top - 2 * width - 1) : top + 2 * width + 2] = 0
    return np.array(levels), np.array(counts, dtype=np.int64)


def _found(levels: FloatArray, counts: IntArray) -> str:
    if len(levels) < 2:
        return "only one face was found" if len(levels) else "no face was found"
    apart = abs(float(levels[0] - levels[1]))
    return f"the two largest ({counts[0]} and {counts[1]} points) stand {apart:.3f} mm apart"


def fit_parallel(lower: FloatArray, upper: FloatArray, towards: FloatArray) -> ParallelFaces:
    """Two parallel planes (D = 3) or lines (D = 2) by least squares, fitted together.

    Parameters
    ----------
    lower, upper
        (N, D) and (M, D) points of either face.
    towards
        (D,) direction to which the normal shall point.
    """
    low, high = lower.mean(axis=0), upper.mean(axis=0)
    spread = np.concatenate([lower - low, upper - high])
    # the smallest eigenvector of a D x D matrix: an SVD of 100,000 rows would cost 100 times more
    normal = np.linalg.eigh(spread.T @ spread)[1][:, 0]
    if float(normal @ towards) < 0.0:
        normal = -normal
    return ParallelFaces(normal, float(normal @ low), float(normal @ high))


def away_from_ends(
    points: FloatArray,
    normal: FloatArray,
    is_face: BoolArray,
    stripe: IntArray | None,
    margin_mm: float,
) -> BoolArray:
    """Points of a face that are not within a margin of its ends.

    Parameters
    ----------
    points
        (N, D) all points that are looked at.
    normal
        (D,) of the face.
    is_face
        (N,) True for points of the face.
    stripe
        (N,) number of the stripe that each point is of, None for points without stripes.
    margin_mm
        Left out: points this near, seen along the normal, to a point off the face; of each run
        of a stripe on the face (points with no gap wider than the margin) this much at either
        end; and in a cloud this much along the face's outline, where a stripe that lies along an
        edge is half on the face only. A face of few stripes, more than half of which would go
        with its outline, keeps it.
    """
    kept = is_face.copy()
    if margin_mm == 0.0:
        return kept
    across = np.linalg.svd(normal[None, :])[2][1:]
    flat = points @ across.T
    if (~is_face).any():
        # a cloud of another pass above the face lies off it too: it is left out alike
        nearest, _ = cKDTree(flat[~is_face]).query(
            flat[is_face], distance_upper_bound=margin_mm, workers=1
        )
        kept[is_face] &= ~np.isfinite(nearest)
    if stripe is not None:
        kept[is_face] &= _inner(flat[is_face], stripe[is_face], margin_mm)
    if flat.shape[1] == 2:
        kept[is_face] &= _off_outline(flat[is_face], margin_mm)
    return kept


def _off_outline(flat: FloatArray, margin_mm: float) -> BoolArray:
    """(N,) points (N, 2) that are further than a margin inside the outline of them all."""
    try:
        sides = ConvexHull(flat).equations
    except (QhullError, ValueError):
        return np.ones(len(flat), dtype=np.bool_)
    is_inside = (flat @ sides[:, :2].T + sides[:, 2]).max(axis=1) <= -margin_mm
    if is_inside.mean() < LEAST_INSIDE:
        return np.ones(len(flat), dtype=np.bool_)
    return np.asarray(is_inside)


def _inner(flat: FloatArray, stripe: IntArray, margin_mm: float) -> BoolArray:
    number = np.unique(stripe, return_inverse=True)[1]
    along = np.zeros(len(flat))
    order = np.argsort(number, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(number[order])) + 1):
        local = flat[rows] - flat[rows].mean(axis=0)
        direction = np.linalg.eigh(local.T @ local)[1][:, -1]
        along[rows] = local @ direction
    order = np.lexsort((along, number))
    s, k = along[order], number[order]
    begins = np.concatenate([[True], (np.diff(s) > margin_mm) | (np.diff(k) != 0)])
    run = np.cumsum(begins) - 1
    first = s[begins]
    last = s[np.concatenate([np.flatnonzero(begins)[1:] - 1, [len(s) - 1]])]
    inner = np.zeros(len(flat), dtype=np.bool_)
    inner[order] = (s - first[run] >= margin_mm) & (last[run] - s >= margin_mm)
    return inner
