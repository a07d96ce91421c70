# SPDX-License-Identifier: Apache-2.0
"""Results of an inspection: plane, sphere and step with their statistics, and the histogram of
deviations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import (
    ArrayRecord,
    BoolArray,
    FloatArray,
    IntArray,
    bools,
    floats,
    ints,
)
from armscan.geometry.features import Shape
from armscan.geometry.shapes import Plane, Sphere

ReferenceKind = Literal["nominal", "fitted"]
"""``nominal``: known before the measurement; ``fitted``: made from the points themselves."""


@dataclass(frozen=True, slots=True)
class Statistic:
    """One number and what it means.

    Parameters
    ----------
    key
        Name for programs, with its unit.
    formula
        How it follows from the deviations, in words.
    definition
        The same with the reference and the points: complete in itself.
    """

    key: str
    label: str
    value: float
    unit: str
    reference: ReferenceKind
    formula: str
    definition: str


class Deviations(ArrayRecord):
    """Deviations (N,) of points from one reference, signed, in the order of the points."""

    reference: ReferenceKind
    reference_text: str
    points_text: str
    deviations_mm: FloatArray = floats(None)
    statistics: tuple[Statistic, ...]

    def value(self, key: str) -> float:
        """Value of one statistic; KeyError if there is none of that name."""
        return {item.key: item.value for item in self.statistics}[key]


@dataclass(frozen=True, slots=True)
class PointCounts:
    """What became of the points of a cloud.

    Parameters
    ----------
    n_given
        Points of the cloud.
    n_region
        Of these, points inside the region that was asked for.
    n_feature
        Of these, points that belong to the feature: all statistics are over them.
    n_fitted
        Of these, points that the fit used.
    feature_rule, fit_rule
        How the last two were chosen, in words.
    """

    n_given: int
    n_region: int
    n_feature: int
    n_fitted: int
    feature_rule: str
    fit_rule: str

    @property
    def n_outliers(self) -> int:
        """Points of the feature that the fit left out; the statistics count them."""
        return self.n_feature - self.n_fitted


@dataclass(frozen=True, slots=True)
class MeasuredLength:
    """A fitted length and how well it is known.

    Parameters
    ----------
    sigma_scatter_mm
        Standard deviation from what differs between exposures (jackknife over them, and over
        blocks of neighbours: the larger); NaN where there are too few.
    sigma_propagated_mm
        Standard deviation from the points' own covariances, errors being common to exposures as
        far as what these disagree about tells, and larger than stated if that is; NaN where the
        cloud carries none, or for one exposure.
    """

    value_mm: float
    sigma_scatter_mm: float
    sigma_propagated_mm: float

    @property
    def sigma_mm(self) -> float:
        """The propagated one, else that of scatter; NaN without either.

        Not the larger of the two: what exposures disagree about has weighed in the propagated one,
        and the jackknife's is the largest of three of it, by chance or where exposures err alike
        up to twice the true one.
        """
        if math.isfinite(self.sigma_propagated_mm):
            return self.sigma_propagated_mm
        return self.sigma_scatter_mm

    def with_independent(self, sigma_mm: float) -> MeasuredLength:
        """The same less or plus a length that errs by itself, by a standard deviation in mm."""
        scatter, propagated = (
            math.hypot(one, sigma_mm) for one in (self.sigma_scatter_mm, self.sigma_propagated_mm)
        )
        return MeasuredLength(self.value_mm, scatter, propagated)


class PlaneInspection(ArrayRecord):
    """A flat face.

    Parameters
    ----------
    reference
        The plane that was to be met, or None.
    rows
        (N,) rows of the feature's points in the cloud.
    is_fitted
        (N,) True for those that the fit used.
    offset
        Height of ``plane`` over ``reference`` at the middle of the points, with what the reference
        itself errs there as far as that is known; None without one.
    reference_sigma_mm
        Standard deviation of the reference's own height there; 0 where it is exact, NaN where that
        is not known, or without one.
    tilt_mrad
        Angle between the two; NaN without a reference.
    side_text
        On which side deviations are positive, in words.
    n_beyond
        Points on ``plane`` that are no feature's, as they lie farther than that from ``reference``.
    """

    plane: Plane
    reference: Plane | None
    rows: IntArray = ints("N")
    is_fitted: BoolArray = bools("N")
    counts: PointCounts
    fitted: Deviations
    nominal: Deviations | None
    offset: MeasuredLength | None
    tilt_mrad: float
    side_text: str
    n_beyond: int
    reference_sigma_mm: float = math.nan


class SphereInspection(ArrayRecord):
    """A ball.

    Parameters
    ----------
    diameter
        Fitted, with its standard deviation.
    fitted
        Distances from the fitted sphere: distance to its centre minus the fitted radius.
    nominal
        Distance to the same centre minus the nominal radius (figure 5.14).
    seen_cap_deg
        Half opening of the smallest cap about the mean direction that holds the points; 180 is
        the whole ball.
    centre_sigma_mm
        Standard deviation of the centre along the worst way in space; NaN where not known.
    others
        Other balls of that diameter among the points that were looked at.
    post
        A cylinder of the ball's diameter to which its points are as near: they may be of a disc or
        a post; None if there is none.
    scatter_mm
        What neighbouring points scatter by off the faces that they make; NaN where not known.
    """

    sphere: Sphere
    nominal_diameter_mm: float
    diameter: MeasuredLength
    rows: IntArray = ints("N")
    is_fitted: BoolArray = bools("N")
    counts: PointCounts
    fitted: Deviations
    nominal: Deviations
    seen_cap_deg: float
    centre_sigma_mm: float = math.nan
    others: tuple[Sphere, ...] = ()
    post: Shape | None = None
    scatter_mm: float = math.nan


class StepInspection(ArrayRecord):
    """Two parallel faces.

    Parameters
    ----------
    lower, upper
        Rows of both faces' points in the cloud, margins taken off.
    normal
        (3,) common unit normal, from the lower face to the upper one.
    height
        Distance between the parallel planes that were fitted jointly.
    fitted
        Distances of the points of both faces from their own fitted plane.
    nominal
        Heights of the upper face's points over the fitted lower plane, minus the nominal height.
    heights_mm
        (U,) the same heights themselves (figure 5.19).
    normal_rule
        Where the normal came from, in words.
    scatter_mm
        What neighbouring points scatter by off the faces that they make; NaN where not known.
    is_lean_assumed
        True where all points lie in one light sheet and nobody gave the normal of the faces: the
        sheet is taken to stand square, so that no standard deviation of the height is known.
    """

    lower: IntArray = ints(None)
    upper: IntArray = ints(None)
    normal: FloatArray = floats(3)
    nominal_height_mm: float
    height: MeasuredLength
    counts: PointCounts
    fitted: Deviations
    nominal: Deviations
    heights_mm: FloatArray = floats(None)
    normal_rule: str
    scatter_mm: float = math.nan
    is_lean_assumed: bool = False


WITHIN_MM = (0.03, 0.05, 0.08)
"""Half widths of the bands whose share of the points is stated; the thesis uses 0.05 and 0.08."""

SHELL_SHARE = 0.95


def within_key(limit_mm: float) -> str:
    """Key of the share of points within ``+-limit_mm``, for example ``within_50_um_percent``."""
    return f"within_{1000.0 * limit_mm:.0f}_um_percent"


class Histogram(ArrayRecord):
    """Counts of deviations: (B + 1,) limits of the bins, (B,) points in each, and those beyond."""

    edges_mm: FloatArray = floats(None)
    counts: IntArray = ints(None)
    n_below: int
    n_above: int


def histogram(values_mm: FloatArray, half_width_mm: float, n_bins: int = 81) -> Histogram:
    """Count values in equal bins over ``+-half_width_mm``; an odd count has one bin about zero."""
    if not half_width_mm > 0.0 or n_bins < 1:
        raise InputError(f"a histogram of {n_bins} bins over +-{half_width_mm} mm")
    edges = np.linspace(-half_width_mm, half_width_mm, n_bins + 1)
    counts, _ = np.histogram(values_mm, edges)
    below, above = int((values_mm < edges[0]).sum()), int((values_mm > edges[-1]).sum())
    return Histogram(edges_mm=edges, counts=counts.astype(np.int64), n_below=below, n_above=above)


def narrowest_shell_mm(values_mm: FloatArray) -> float:
    """Width of the narrowest interval that holds 95 % of the values (P_Form D95 of 10360).

    It holds ``ceil(0.95 * n)`` values; NaN for no values.
    """
    n = len(values_mm)
    if n == 0:
        return math.nan
    ordered = np.sort(values_mm)
    # 0.95 * 20 is 19.000000000000004 or 18.999...: a rounding error must not cost a whole point
    k = max(1, math.ceil(SHELL_SHARE * n - 1e-9))
    return float((ordered[k - 1 :] - ordered[: n - k + 1]).min())


def describe_deviations(
    deviations_mm: FloatArray, reference: ReferenceKind, reference_text: str, points_text: str
) -> Deviations:
    """Deviations (N,), signed, with their statistics, each defined in words."""
    d = np.asarray(deviations_mm, dtype=np.float64)
    n = len(d)
    mean, rms = (float(d.mean()), float(np.sqrt(d @ d / n))) if n else (math.nan, math.nan)
    std = float(d.std(ddof=1)) if n > 1 else math.nan
    extent = float(np.ptp(d)) if n else math.nan
    rows = [
        ("mean_mm", "mean", mean, "mm", "arithmetic mean, with sign"),
        (
            "std_mm",
            "standard deviation",
            std,
            "mm",
            f"about their mean, divided by n - 1 = {n - 1}",
        ),
        ("rms_mm", "rms", rms, "mm", f"root mean square about the reference, divided by n = {n}"),
        ("range_mm", "range", extent, "mm", "largest minus smallest"),
        (
            "d95_mm",
            "narrowest shell with 95 %",
            narrowest_shell_mm(d),
            "mm",
            "width of the narrowest shell that holds 95 %, rounded up to a whole point (form D95 "
            "as ISO 10360-8 defines it)",
        ),
        *(_share(d, limit) for limit in WITHIN_MM),
    ]
    about = f"deviations from {reference_text}, {points_text}"
    statistics = tuple(
        Statistic(key, label, value, unit, reference, formula, f"{label} of {about}: {formula}")
        for key, label, value, unit, formula in rows
    )
    return Deviations(
        reference=reference,
        reference_text=reference_text,
        points_text=points_text,
        deviations_mm=d,
        statistics=statistics,
    )


def _share(d: FloatArray, limit_mm: float) -> tuple[str, str, float, str, str]:
    share = 100.0 * float((np.abs(d) <= limit_mm).mean()) if len(d) else math.nan
    return (
        within_key(limit_mm),
        f"within {limit_mm:g} mm",
        share,
        "%",
        f"part of the points whose deviation is at most {limit_mm:g} mm either way",
    )
