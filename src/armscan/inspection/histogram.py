# SPDX-License-Identifier: Apache-2.0
"""Statistics and histograms of deviations (figures 5.12, 5.14 and 5.19)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from armscan.errors import InputError
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.inspection.results import Deviations, ReferenceKind, Statistic

WITHIN_MM = (0.03, 0.05, 0.08)
"""Half widths of the bands whose share of the points is stated; the thesis uses 0.05 and 0.08."""

SHELL_SHARE = 0.95


def within_key(limit_mm: float) -> str:
    """Key of the share of points within ``+-limit_mm``, for example ``within_50_um_percent``."""
    return f"within_{1000.0 * limit_mm:.0f}_um_percent"


@dataclass(frozen=True, slots=True, eq=False)
class Histogram:
    """Counts of deviations.

    Parameters
    ----------
    edges_mm
        (B + 1,) limits of the bins.
    counts
        (B,) points in each.
    n_below, n_above
        Points beyond the first and the last limit: shown as numbers, never dropped in silence.
    """

    edges_mm: FloatArray
    counts: IntArray
    n_below: int
    n_above: int


def histogram(values_mm: FloatArray, half_width_mm: float, n_bins: int = 81) -> Histogram:
    """Count values in equal bins over ``+-half_width_mm``; an odd count has one bin about zero."""
    if not half_width_mm > 0.0 or n_bins < 1:
        raise InputError(f"a histogram of {n_bins} bins over +-{half_width_mm} mm")
    edges = np.linspace(-half_width_mm, half_width_mm, n_bins + 1)
    counts, _ = np.histogram(values_mm, edges)
    below, above = int((values_mm < edges[0]).sum()), int((values_mm > edges[-1]).sum())
    return Histogram(edges, counts.astype(np.int64), below, above)


def narrowest_shell_mm(values_mm: FloatArray, share: float = SHELL_SHARE) -> float:
    """Width of the narrowest interval that holds a share of the values (P_Form D95 of 10360).

    It holds ``ceil(share * n)`` values; NaN for no values.
    """
    n = len(values_mm)
    if n == 0:
        return math.nan
    ordered = np.sort(values_mm)
    # 0.95 * 20 is 19.000000000000004 or 18.999...: a rounding error must not cost a whole point
    k = max(1, math.ceil(share * n - 1e-9))
    return float((ordered[k - 1 :] - ordered[: n - k + 1]).min())


def describe_deviations(
    deviations_mm: FloatArray, reference: ReferenceKind, reference_text: str, points_text: str
) -> Deviations:
    """Deviations with their statistics, each defined in words.

    Parameters
    ----------
    deviations_mm
        (N,) signed deviations.
    reference, reference_text
        What they are counted from.
    points_text
        Which points they are of.
    """
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
    return Deviations(reference, reference_text, points_text, d, statistics)


def _share(d: FloatArray, limit_mm: float) -> tuple[str, str, float, str, str]:
    share = 100.0 * float((np.abs(d) <= limit_mm).mean()) if len(d) else math.nan
    return (
        within_key(limit_mm),
        f"within {limit_mm:g} mm",
        share,
        "%",
        f"part of the points whose deviation is at most {limit_mm:g} mm either way",
    )
