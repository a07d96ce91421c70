# SPDX-License-Identifier: Apache-2.0
"""Which points belong to a feature, and which of them a fit leaves out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_floats
from armscan.geometry.estimate import FitFailure
from armscan.inspection.options import InspectionOptions
from armscan.records.cloud import PointCloud

S = TypeVar("S")
MAX_ROUNDS = 20
SMALLEST_EXTENT_MM = 2.0
"""Points that all lie this near to each other are taken for metres."""

LEAST_CONCENTRATION = 0.5
"""Part of the feature's points that must lie within the search band of the surface that was found:
a shape that merely passes through the feature's shell spreads evenly over it instead."""

ROBUST_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """A box along the axes of the cloud's frame.

    Parameters
    ----------
    low_mm, high_mm
        (3,) smallest and largest coordinates.
    """

    low_mm: FloatArray
    high_mm: FloatArray

    def __post_init__(self) -> None:
        for name in ("low_mm", "high_mm"):
            object.__setattr__(self, name, frozen_floats(getattr(self, name), (3,), name))
        if not bool((self.low_mm < self.high_mm).all()):
            raise OptionError(
                "the region's lower limits are not all below the upper ones",
                remedy="give xmin,xmax,ymin,ymax,zmin,zmax in mm",
            )

    def holds(self, points_mm: FloatArray) -> BoolArray:
        """(N,) True for points inside."""
        return np.asarray(((points_mm >= self.low_mm) & (points_mm <= self.high_mm)).all(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """Points of a cloud that an inspection looks at.

    Parameters
    ----------
    cloud
        The cloud.
    rows
        (N,) rows of it.
    options
        What belongs to a feature.
    """

    cloud: PointCloud
    rows: IntArray
    options: InspectionOptions

    @property
    def points_mm(self) -> FloatArray:
        """(N, 3) their positions."""
        return np.asarray(self.cloud.points_mm[self.rows])


def select(
    cloud: PointCloud, region: Region | None, options: InspectionOptions, min_points: int
) -> Selection:
    """Take the points of a cloud inside a region.

    Raises
    ------
    InputError
        If fewer than ``min_points`` are left, or the cloud looks like metres.
    """
    extent = float(np.linalg.norm(np.ptp(cloud.points_mm, axis=0))) if len(cloud) else 0.0
    if len(cloud) >= min_points and extent < SMALLEST_EXTENT_MM:
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
    return Selection(cloud, rows, options)


def fit_robustly(
    points_mm: FloatArray,
    start: S,
    fit: Callable[[FloatArray], S | FitFailure],
    distance_mm: Callable[[S, FloatArray], FloatArray],
    options: InspectionOptions,
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
    distance_mm
        Signed distances (N,) of points from a surface.
    options
        Outlier rule.

    Returns
    -------
    surface, is_fitted
        The last fit and the (N,) points that it used.
    """
    surface, kept = start, np.zeros(len(points_mm), dtype=np.bool_)
    for _ in range(MAX_ROUNDS):
        chosen = inliers(distance_mm(surface, points_mm), options)
        if np.array_equal(chosen, kept):
            break
        kept = chosen
        fitted = fit(points_mm[kept])
        if isinstance(fitted, FitFailure):
            return fitted
        surface = fitted
    return surface, kept


def inliers(distance_mm: FloatArray, options: InspectionOptions) -> BoolArray:
    """(N,) True where a distance is no outlier: the rule that `outlier_rule` puts in words."""
    middle = float(np.median(distance_mm))
    spread = ROBUST_SIGMA * float(np.median(np.abs(distance_mm - middle)))
    limit = max(options.outlier_sigma * spread, options.kept_band_mm)
    return np.asarray(np.abs(distance_mm - middle) <= limit)


def outlier_rule(options: InspectionOptions) -> str:
    """The rule of `inliers` in words."""
    return (
        f"the fit left out points further from the median distance than {options.outlier_sigma:g} "
        f"robust standard deviations, but at least {options.kept_band_mm:g} mm (in turn with the "
        "fit); the statistics count them all the same"
    )
