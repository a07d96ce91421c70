# SPDX-License-Identifier: Apache-2.0
"""What tables and pages tell of a cloud, from one in memory or piece by piece from disk."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armscan.fusion.point_spool import PointSpool
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.records.cloud import PointCloud

SHOWN_POINTS = 20_000
"""Points that a page draws, evenly chosen."""
HISTOGRAM_BINS, HISTOGRAM_REACH = 60, 1.15
"""The histogram of standard deviations ends this many times beyond their 99th percentile."""
PERCENTILES = (50.0, 95.0, 99.0)
MOST_SORTED = 2_000_000
"""Values of which percentiles are taken by sorting; those of more are counted into bins first."""
PERCENTILE_BINS = 2**16


@dataclass(frozen=True, slots=True, eq=False)
class CloudDigest:
    """Size, uncertainty and some points of a cloud.

    Parameters
    ----------
    n_points
        Of the whole cloud.
    low_mm, high_mm
        (3,) its corners.
    sigma_mm
        (3,) percentiles 50, 95 and 99 of the points' standard deviations.
    edges_mm
        (B + 1,) bins of a histogram of standard deviations.
    sigma_counts, noise_counts
        (B,) points by `PointCloud.sigma_mm`, and by their noise alone.
    shown
        Every ``step``-th point.
    shown_sigma_mm
        (S,) standard deviations of these.
    step
        One point in so many is shown.
    """

    n_points: int
    low_mm: FloatArray
    high_mm: FloatArray
    sigma_mm: FloatArray
    edges_mm: FloatArray
    sigma_counts: IntArray
    noise_counts: IntArray
    shown: PointCloud
    shown_sigma_mm: FloatArray
    step: int

    @staticmethod
    def of(cloud: PointCloud) -> CloudDigest:
        """Of a cloud in memory that has a point."""
        sigmas = np.stack([cloud.sigma_mm, cloud.sigma_noise_mm], axis=1)
        step = max(1, len(cloud) // SHOWN_POINTS)
        corners = np.stack([cloud.points_mm.min(axis=0), cloud.points_mm.max(axis=0)])
        shown = cloud.select(slice(None, None, step))
        return _digest(len(cloud), corners, lambda: [sigmas], (shown, sigmas[::step, 0], step))

    @staticmethod
    def of_spool(points: PointSpool, marks: PointCloud) -> CloudDigest:
        """Of a cloud on disk that has a point; ``marks`` has its names and marks."""
        n = len(points)
        step = max(1, n // SHOWN_POINTS)
        clouds, sigmas = [], []
        for piece in points.pieces():
            chosen = slice(-piece.start % step, None, step)
            clouds.append(piece.cloud.select(chosen))
            # a view would hold all of the piece's
            sigmas.append(piece.sigma_mm[chosen].copy())
        shown = replace(
            PointCloud.concat(clouds), is_simulated=marks.is_simulated, forced=marks.forced
        )
        return _digest(n, points.corners_mm, points.sigmas, (shown, np.concatenate(sigmas), step))


Sigmas = Callable[[], Iterable[FloatArray]]


def _digest(
    n: int, corners_mm: FloatArray, sigmas: Sigmas, shown: tuple[PointCloud, FloatArray, int]
) -> CloudDigest:
    found = percentiles(lambda: (part[:, 0] for part in sigmas()), PERCENTILES, n)
    edges = np.linspace(0.0, HISTOGRAM_REACH * float(found[2]), HISTOGRAM_BINS + 1)
    counts = np.zeros((2, HISTOGRAM_BINS), dtype=np.int64)
    for part in sigmas():
        for k in range(2):
            counts[k] += np.histogram(part[:, k], edges)[0]
    low, high = corners_mm
    return CloudDigest(n, low, high, found, edges, counts[0], counts[1], *shown)


def percentiles(
    parts: Callable[[], Iterable[FloatArray]], wanted: Sequence[float], n: int
) -> FloatArray:
    """Percentiles of n values that come in parts (M,), as often as asked: as `numpy.percentile`.

    Of many values those in the bins of the wanted ranks alone are sorted.
    """
    if n <= MOST_SORTED:
        return np.asarray(np.percentile(np.concatenate(list(parts())), list(wanted)))
    extremes = [(part.min(), part.max()) for part in parts() if len(part)]
    low, high = min(one for one, _ in extremes), max(one for _, one in extremes)
    if high == low:
        return np.full(len(wanted), low)
    scale = PERCENTILE_BINS / (high - low)

    def bins(part: FloatArray) -> IntArray:
        number = ((part - low) * scale).astype(np.int64)
        return np.asarray(np.minimum(number, PERCENTILE_BINS - 1))

    counts = np.zeros(PERCENTILE_BINS, dtype=np.int64)
    for part in parts():
        counts += np.bincount(bins(part), minlength=PERCENTILE_BINS)
    below = np.concatenate([[0], np.cumsum(counts)])
    ranks = np.array(wanted) / 100.0 * (n - 1)
    floor = np.floor(ranks).astype(np.int64)
    both = np.minimum(np.stack([floor, floor + 1]), n - 1)
    bin_of = np.searchsorted(below, both, side="right") - 1
    asked = np.unique(bin_of)
    kept = [part[np.isin(bins(part), asked)] for part in parts()]
    values = np.sort(np.concatenate(kept))
    # ranks among the values of the asked bins alone
    first = np.concatenate([[0], np.cumsum(counts[asked])])
    place = np.searchsorted(asked, bin_of)
    chosen = values[both - below[bin_of] + first[place]]
    share = ranks - floor
    return np.asarray(chosen[0] + (chosen[1] - chosen[0]) * share)
