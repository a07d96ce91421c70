# SPDX-License-Identifier: Apache-2.0
"""Choice of the points to be inspected: options, region, robust rejection, search for the
dominant flat and for a ball.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import BoolArray, Box, FloatArray, IntArray
from armscan.geometry.estimate import Estimate, FitFailure
from armscan.geometry.least_squares import MAD_TO_SIGMA
from armscan.records.cloud import SMALLEST_EXTENT_MM, PointCloud

OUTLIER_SIGMAS = 4.0
"""A fit leaves out points further from its surface than this many robust standard deviations, in
turn with the fit: of normal noise one point in 16,000."""
KEPT_BAND_MM = 0.02
"""Points nearer to the surface than this are never left out: a scanner's own noise."""
SEARCH_BAND_MM = 0.2
"""Half width of the band in which points support a candidate while a feature is searched."""
SEARCH_SIGMAS = 2.0
"""The same in the points' stated sigmas, where these are larger: 19 of 20 points lie within."""
MIN_POINTS = 30
"""Fewest points that make a feature."""
LEAST_BESIDE = 0.2
"""Part of a face's points in other stripes than the largest that tells how it lies across that;
`MIN_POINTS` do in any case."""
LEAST_OF_SIZE = 0.7
"""Of a feature's nominal size, over which its points spread; written in metres they have 0.001."""
AT_REST_MM, SAMPLED = 0.3, 10_000
"""More than an arm at rest trembles; points of which the distance from the head is taken."""


@dataclass(frozen=True, slots=True)
class InspectionOptions:
    """Which points belong to a feature: those up to ``feature_mm`` from its surface.

    Every statistic counts them, outliers included; points further away are only counted.
    """

    feature_mm: float = 1.0

    def __post_init__(self) -> None:
        if not SEARCH_BAND_MM <= self.feature_mm < math.inf:
            raise OptionError(
                f"a feature band of {self.feature_mm} mm does not hold the search band",
                where="--feature-mm",
                remedy=f"give {SEARCH_BAND_MM:g} mm or more, as 1.0",
            )


@dataclass(frozen=True, slots=True)
class StepOptions:
    """Which points of a step's faces count.

    Parameters
    ----------
    margin_mm
        Points this near to an end of their face are left out: along each stripe its runs on the
        face are shortened by it, and left out is all that lies this near to points off the face,
        seen along the normal, or to the face's outline in a cloud of many stripes.
    """

    margin_mm: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.margin_mm < 100.0:
            raise OptionError(
                f"margin_mm is {self.margin_mm}", where="--margin", remedy="give 0 to 100 mm"
            )


class Surface(Protocol):
    """What points can be near to: a plane, a sphere."""

    def distance_mm(self, points_mm: FloatArray) -> FloatArray:
        """Signed distances (N,) of points (N, 3)."""
        ...


S = TypeVar("S", bound=Surface)
MAX_ROUNDS = 20

LEAST_CONCENTRATION = 0.5
"""Part of the feature's points that must lie within the search band of the surface that was found:
a shape that merely passes through the feature's shell spreads evenly over it instead."""

OUTLIER_RULE = (
    f"the fit left out points further from the median distance than {OUTLIER_SIGMAS:g} robust "
    f"standard deviations, but at least {KEPT_BAND_MM:g} mm (in turn with the fit); the statistics "
    "count them all the same"
)
"""The rule of `inliers` in words."""


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """Rows (N,) of a cloud that an inspection looks at, and how near its feature's points lie."""

    cloud: PointCloud
    rows: IntArray
    feature_mm: float

    @property
    def points_mm(self) -> FloatArray:
        """(N, 3) their positions."""
        return np.asarray(self.cloud.points_mm[self.rows])

    @property
    def sigma_mm(self) -> FloatArray:
        """(N,) stated standard deviation of each point an axis, common errors included."""
        variances = np.einsum("nii->n", self.cloud.covariance_mm2[self.rows]) / 3.0
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))

    @property
    def stripe(self) -> IntArray | None:
        """(N,) number of the place of the light sheet in which each point lies, from 0.

        A sheet has one place in an exposure, in the Sensor frame one in all of them, and in others
        one in those that were taken at rest. None for a cloud that does not tell sheets: a fused or
        foreign one.
        """
        cloud = self.cloud
        if cloud.is_fused or not any(cloud.sheet_names):
            return None
        number = cloud.sheet[self.rows]
        if cloud.frame != "Sensor":
            number = number + standings(cloud)[cloud.exposure[self.rows]] * len(cloud.sheet_names)
        return np.asarray(np.unique(number, return_inverse=True)[1])

    def in_one_sheet(self, chosen: BoolArray | None = None) -> FitFailure | None:
        """Why some (N,) of the points show no face: all but a few lie in one light sheet.

        None for a choice stands for all of them.
        """
        stripe = self.stripe
        if stripe is None:
            return None
        counts = np.bincount(stripe if chosen is None else stripe[chosen])
        if _are_of_several(counts):
            return None
        return FitFailure(
            f"of {counts.sum()} points all but a few lie in one light sheet: one stripe does not "
            "tell how a face lies across it",
            "measure the face from more places: exposures at rest show it in one line",
        )

    @property
    def search_band_mm(self) -> FloatArray:
        """(N,) half width of the band in which each point supports a ball.

        As far as the points' own scatter may throw them off it; half the feature's band at most, or
        any shape within it would be supported.
        """
        widest = max(SEARCH_BAND_MM, 0.5 * self.feature_mm)
        return np.clip(SEARCH_SIGMAS * self.sigma_mm, SEARCH_BAND_MM, widest)


def _are_of_several(counts: IntArray) -> bool:
    """Whether points lie in more than one stripe, all but strays, from the count of each stripe."""
    n = int(counts.sum())
    least = min(MIN_POINTS, LEAST_BESIDE * max(n, MIN_POINTS))
    return n - int(counts.max(initial=0)) >= least


def standings(cloud: PointCloud) -> IntArray:
    """(E,) number of the place of the head at each exposure, rising from 0.

    Exposures that follow each other share it while the head's origin, and marks on two of its axes
    at the points' distance, stay within `AT_REST_MM` of where they were at the first of them. Where
    the cloud does not tell where and how the head stood, each has one of its own.
    """
    seen_from_mm, errors = cloud.seen_from_mm, cloud.calibration_errors
    n = len(cloud.exposure_sources)
    if seen_from_mm is None or errors is None or not len(cloud):
        return np.arange(n)
    some = slice(None, None, max(len(cloud) // SAMPLED, 1))
    away_mm = cloud.points_mm[some] - seen_from_mm[cloud.exposure[some]]
    reach_mm = float(np.median(np.linalg.norm(away_mm, axis=1)))
    # the head's origin and two of its axes: whatever it does, one of them moves
    marks = reach_mm * np.eye(3)[:, [0, 0, 2]] * [0.0, 1.0, 1.0]
    carried = errors.turns @ marks + seen_from_mm[:, :, None]
    place, first = np.zeros(n, dtype=np.int64), 0
    for k in range(1, n):
        moved_mm = np.linalg.norm(carried[k] - carried[first], axis=0).max()
        if moved_mm > AT_REST_MM:
            first = k
        place[k] = place[k - 1] + (first == k)
    return place


def select(
    cloud: PointCloud,
    region: Box | None,
    options: InspectionOptions | None,
    min_points: int = MIN_POINTS,
    *,
    size_mm: float = math.inf,
) -> Selection:
    """Take the points of a cloud inside a region; default options if None.

    ``size_mm`` is a feature's nominal size, beside which a small cloud is not taken for metres.

    Raises
    ------
    InputError
        If fewer than ``min_points`` are left, or the cloud looks like metres.
    """
    extent = float(np.linalg.norm(np.ptp(cloud.points_mm, axis=0))) if len(cloud) else 0.0
    if len(cloud) >= min_points and extent == 0.0:
        raise InputError(
            f"all {len(cloud)} points lie in one place", remedy="give a cloud that was measured"
        )
    smallest_mm = min(SMALLEST_EXTENT_MM, LEAST_OF_SIZE * size_mm)
    if len(cloud) >= min_points and extent < smallest_mm:
        raise InputError(
            f"all {len(cloud)} points lie within {extent:.3g} mm: these look like metres",
            remedy="multiply the coordinates by 1000",
        )
    if region is None:
        rows = np.arange(len(cloud))
    else:
        rows = np.flatnonzero(region.holds(cloud.points_mm))
    if len(rows) < min_points:
        place = "the cloud holds" if region is None else "in the region lie"
        of_all = "" if region is None else f" of the cloud's {len(cloud)}"
        raise InputError(
            f"{place} {len(rows)}{of_all} points; an inspection needs {min_points}",
            remedy="measure more points" if region is None else "widen the region",
        )
    return Selection(cloud, rows, (options or InspectionOptions()).feature_mm)


MOST_CONCENTRATION = 0.9
"""Of the points within two sigmas of a surface, which hold 95 % of normal ones."""


def least_concentration(band_mm: float, feature_mm: float) -> float:
    """Part of a feature's points that must lie within a search band as wide as this.

    As far above the part of evenly spread points as within the narrowest band.
    """
    wider = (band_mm - SEARCH_BAND_MM) / feature_mm
    return min(LEAST_CONCENTRATION + wider, MOST_CONCENTRATION)


def fit_robustly(
    points_mm: FloatArray, start: S, fit: Callable[[FloatArray], Estimate[S] | FitFailure]
) -> tuple[S, BoolArray] | FitFailure:
    """Fit and leave out outliers in turn until the choice stands.

    Parameters
    ----------
    points_mm
        (N, 3) points of the feature.
    start
        Surface from which the first outliers are told.
    fit
        Least-squares fit to points.

    Returns
    -------
    surface, is_fitted
        The last fit and the (N,) points that it used.
    """
    surface, kept = start, np.zeros(len(points_mm), dtype=np.bool_)
    for _ in range(MAX_ROUNDS):
        chosen = inliers(surface.distance_mm(points_mm))
        if np.array_equal(chosen, kept):
            break
        kept = chosen
        fitted = fit(points_mm[kept])
        if isinstance(fitted, FitFailure):
            return fitted
        surface = fitted.value
    return surface, kept


def inliers(distance_mm: FloatArray) -> BoolArray:
    """(N,) True where a distance is no outlier, by `OUTLIER_RULE`."""
    from_middle = np.abs(distance_mm - float(np.median(distance_mm)))
    spread = MAD_TO_SIGMA * float(np.median(from_middle))
    return np.asarray(from_middle <= max(OUTLIER_SIGMAS * spread, KEPT_BAND_MM))


N_TRIALS = 800
N_SCORED = 3000
"""Points, drawn evenly at random, on which candidates are scored."""

BATCH = 100
POLISHING_ROUNDS = 4
MIN_SINE = 0.02
"""Flattest triangle, as height over length, that may carry a candidate."""


def dominant_flat(
    points: FloatArray, stripe: IntArray | None = None, band_mm: float = SEARCH_BAND_MM
) -> FloatArray | FitFailure:
    """Unit normal (D,) of the plane (D = 3) or line (D = 2) that most points (N, D) lie near.

    ``stripe``: (N,) number of each point's stripe. All points of one lie in its light sheet, which
    is no face: of several stripes the one that has most points on a plane does not count there, and
    more than strays of others are asked for. None, and a single stripe: all points count.
    ``band_mm``: how near they lie.
    """
    if stripe is not None and int(np.ptp(stripe)) == 0:
        stripe = None
    rng = np.random.default_rng(0)
    n, dimension = points.shape
    drawn = points[rng.integers(0, n, (N_TRIALS, dimension))]
    normals, is_valid = _normals(drawn)
    if not is_valid.any():
        return FitFailure("the points lie on one line", "give points that spread in a face")
    normals, start = normals[is_valid], drawn[is_valid, 0]
    chosen = rng.permutation(n)[:N_SCORED]
    if stripe is not None:
        chosen = chosen[np.argsort(stripe[chosen], kind="stable")]
        first = np.flatnonzero(np.diff(stripe[chosen], prepend=-1))
    scored = points[chosen]
    offsets = np.einsum("md,md->m", normals, start)
    votes = []
    for k in range(0, len(normals), BATCH):
        away = np.abs(scored @ normals[k : k + BATCH].T - offsets[k : k + BATCH])
        is_near = (away <= band_mm).astype(np.int64)
        votes.append(is_near.sum(axis=0))
        if stripe is not None:
            votes[-1] -= np.add.reduceat(is_near, first, axis=0).max(axis=0)
    best = int(np.concatenate(votes).argmax())
    if stripe is not None:
        on_it = np.abs(points @ normals[best] - offsets[best]) <= band_mm
        if not _are_of_several(np.bincount(stripe[on_it])):
            return FitFailure(
                "no face has points of several stripes, and one by itself lies in its light sheet, "
                "whatever it crosses",
                "measure the face from more places: exposures at rest show it in one line",
            )
    return _polished(points, normals[best], float(offsets[best]), band_mm)


def _normals(drawn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normals of (M, D, D) sets of points, and which of them are determined."""
    edge = drawn[:, 1] - drawn[:, 0]
    length = np.linalg.norm(edge, axis=1)
    if drawn.shape[1] == 2:
        normal = np.stack([-edge[:, 1], edge[:, 0]], axis=1)
        is_valid = length > 0.0
    else:
        other = drawn[:, 2] - drawn[:, 0]
        normal = np.cross(edge, other)
        is_valid = np.linalg.norm(normal, axis=1) > MIN_SINE * length * np.linalg.norm(
            other, axis=1
        )
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    return normal / np.where(size > 0.0, size, 1.0), is_valid


def _polished(points: FloatArray, normal: FloatArray, offset: float, band_mm: float) -> FloatArray:
    for _ in range(POLISHING_ROUNDS):
        near = points[np.abs(points @ normal - offset) <= band_mm]
        if len(near) < points.shape[1]:
            break
        centre = near.mean(axis=0)
        normal = np.linalg.svd(near - centre, full_matrices=False)[2][-1]
        offset = float(normal @ centre)
    return normal


def find_ball(
    points_mm: FloatArray, radius_mm: float, band_mm: FloatArray
) -> tuple[FloatArray, int] | FitFailure:
    """Centre (3,) of the ball of known radius that most points lie on, and their count.

    Candidates pass through three points of one neighbourhood each, as a ball may be a small part
    of the cloud; each has two centres.

    Parameters
    ----------
    points_mm
        (N, 3) points.
    radius_mm
        Radius of the ball.
    band_mm
        (N,) how far off it each of them may lie.
    """
    rng = np.random.default_rng(0)
    chosen = rng.permutation(len(points_mm))[:N_SCORED]
    scored = points_mm[chosen]
    centres = _ball_candidates(scored, radius_mm, rng)
    if len(centres) == 0:
        return FitFailure(
            f"no three points could lie on a ball of radius {radius_mm:g} mm",
            "check the diameter and the unit (mm)",
        )
    votes = np.concatenate(
        [
            _ball_votes(scored, centres[k : k + BATCH], radius_mm, band_mm[chosen])
            for k in range(0, len(centres), BATCH)
        ]
    )
    centre = centres[int(votes.argmax())]
    near = np.abs(np.linalg.norm(points_mm - centre, axis=1) - radius_mm) <= band_mm
    return centre, int(near.sum())


def _ball_candidates(scored: FloatArray, radius_mm: float, rng: np.random.Generator) -> FloatArray:
    found = []
    for first in scored[rng.integers(0, len(scored), N_TRIALS)]:
        offset = np.linalg.norm(scored - first, axis=1)
        near = scored[(offset <= 1.6 * radius_mm) & (offset > 0.2 * radius_mm)]
        if len(near) >= 2:
            found.append([first, *near[rng.choice(len(near), 2, replace=False)]])
    if not found:
        return np.zeros((0, 3))
    corners = np.array(found)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(a, b)
    size2 = np.einsum("ij,ij->i", across, across)
    aa, bb = np.einsum("ij,ij->i", a, a), np.einsum("ij,ij->i", b, b)
    is_wide = size2 > (0.1 * np.sqrt(aa * bb)) ** 2
    a, b, across, size2, aa, bb = (item[is_wide] for item in (a, b, across, size2, aa, bb))
    # circumcentre of each triangle, seen from its first corner
    middle = np.cross(aa[:, None] * b - bb[:, None] * a, across) / (2.0 * size2)[:, None]
    rise2 = radius_mm**2 - np.einsum("ij,ij->i", middle, middle)
    is_possible = rise2 > 0.0
    middle, start = middle[is_possible], corners[is_wide, 0][is_possible]
    up = across[is_possible] / np.sqrt(size2[is_possible])[:, None]
    rise = np.sqrt(rise2[is_possible])[:, None] * up
    return np.concatenate([start + middle + rise, start + middle - rise])


def _ball_votes(
    scored: FloatArray, centres: FloatArray, radius_mm: float, band_mm: FloatArray
) -> FloatArray:
    # |p - c|^2 by its parts: no (M, N, 3) array; about the mean, so that digits are kept
    mean = scored.mean(axis=0)
    p, c = scored - mean, centres - mean
    squared = (c**2).sum(axis=1)[:, None] + (p**2).sum(axis=1)[None, :] - 2.0 * c @ p.T
    distance = np.sqrt(np.maximum(squared, 0.0))
    return np.asarray((np.abs(distance - radius_mm) <= band_mm).sum(axis=1))
