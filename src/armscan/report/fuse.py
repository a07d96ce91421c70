# SPDX-License-Identifier: Apache-2.0
"""The page of a fused cloud, and its numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from armscan.fusion.digest import CloudDigest
from armscan.models.calibration import Provenance
from armscan.report.cloud import digest_view, sigma_histogram, sigma_quantities
from armscan.report.page import Gallery, Page, Section, Text, page_of
from armscan.report.quantity import Quantity, fact, only

NOT_KNOWN = "not known"
SIGMA_TEXT = (
    "Stripe noise averages out as points of a voxel are put together. What the points share, the "
    "calibration and the arm, does not: it stays as large as the points told it."
)


@dataclass(frozen=True, slots=True, eq=False)
class FusedCloud:
    """What fusing came to.

    Parameters
    ----------
    size_mm
        Edge of a voxel.
    n_measured
        Points that went in.
    digest
        Of the fused points.
    private_mm
        Median standard deviation of what is left of the noise.
    has_covariance
        False if the points told none; no standard deviation is known then.
    """

    size_mm: float
    n_measured: int
    digest: CloudDigest
    private_mm: float
    has_covariance: bool = True


def fused_quantities(result: FusedCloud) -> tuple[Quantity, ...]:
    """What is told of a fused cloud."""
    digest = result.digest
    low, top = digest.low_mm.tolist(), digest.high_mm.tolist()
    share = result.n_measured / digest.n_points
    return (
        Quantity(
            "n_points",
            "Points",
            digest.n_points,
            meaning=f"one a voxel, of {result.n_measured:,}: {share:.1f} each",
        ),
        Quantity("n_measured", "", result.n_measured),
        Quantity("voxel_mm", "Voxel", result.size_mm, unit="mm"),
        Quantity("frame", "Frame", digest.shown.frame),
        *_sigma_quantities(result),
        Quantity("low_corner_mm", "", low),
        Quantity("high_corner_mm", "", top),
        *(fact(axis, f"{low[k]:.2f} to {top[k]:.2f} mm") for k, axis in enumerate("XYZ")),
    )


def _sigma_quantities(result: FusedCloud) -> tuple[Quantity, ...]:
    if not result.has_covariance:
        return (
            Quantity("sigma_median_mm", "Sigma of a point", None, shown=NOT_KNOWN),
            Quantity("sigma_95_mm", "", None),
            Quantity("private_median_mm", "Noise left in it", None, shown=NOT_KNOWN),
        )
    return (
        *sigma_quantities(result.digest),
        Quantity(
            "private_median_mm",
            "Noise left in it",
            result.private_mm,
            unit="mm",
            meaning="median; the rest is shared and does not average out",
        ),
    )


def fused_page(result: FusedCloud, provenance: Provenance, warnings: Sequence[str] = ()) -> Page:
    """Lay out the report."""
    told = fused_quantities(result)
    sections = [Section("The cloud", (Gallery((digest_view(result.digest),), 560),))]
    if result.has_covariance:
        sigmas = (Text(SIGMA_TEXT), Gallery((sigma_histogram(result.digest),)))
        sections.append(Section("How far to trust them", sigmas))
    return page_of(
        provenance,
        "Fused cloud",
        f"{result.digest.n_points:,} points, one a voxel of {result.size_mm:g} mm, of "
        f"{result.n_measured:,} measured ones",
        tuple(sections),
        cards=only(told, "n_points", "sigma_median_mm", "private_median_mm"),
        warnings=warnings,
        is_simulated=result.digest.shown.is_simulated,
    )
