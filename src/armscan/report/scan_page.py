# SPDX-License-Identifier: Apache-2.0
"""The report of a scan that was placed into Base."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from armscan.models.calibration import Provenance
from armscan.pipeline.scan_result import ScanReconstruction
from armscan.reconstruction.result import PointFate
from armscan.records.exposure import Exposure
from armscan.report import cloud_figures as figures
from armscan.report.numbers import sentence, significant
from armscan.report.origin import footer, origin_section
from armscan.report.page import Card, Gallery, Page, Section, Text
from armscan.report.stripe_gallery import stripe_gallery
from armscan.report.summary import Table

FATE_TEXT = (
    "What became of every stripe point. Points that were flagged or left out are in no cloud; "
    "points that were measured but are wrong would be in it, and only an inspection shows them."
)


def scan_page(
    scan: ScanReconstruction,
    exposures: Mapping[str, Exposure],
    provenance: Provenance,
    notes: Sequence[str] = (),
    *,
    is_simulated: bool = False,
) -> Page:
    """Lay out the report.

    Parameters
    ----------
    scan
        The scan.
    exposures
        Images by source name; those that are missing are not shown.
    provenance
        How the cloud came to be.
    notes
        What is odd about the recording, in words.
    is_simulated
        True if the images were rendered.
    """
    cloud = scan.cloud
    sections = [
        Section("The cloud", (Gallery((figures.cloud_view(cloud),), 560),)),
        Section("What became of the points", (Text(FATE_TEXT), fate_totals(scan))),
        Section("How far to trust them", (Gallery((figures.sigma_histogram(cloud),), 420),)),
    ]
    if scan.without_pose:
        sections.append(Section("Exposures without a pose", (without_pose_table(scan),)))
    sections += [
        Section("The stripes", stripe_gallery(scan.images, cloud.sheet_names, exposures)),
        Section("Exposure by exposure", (exposure_table(scan),), is_folded=True),
        origin_section(provenance),
    ]
    return Page(
        title="Scan in Base",
        subtitle=f"{len(cloud):,} points from {len(scan.images)} exposures of a moving arm",
        cards=_cards(scan),
        warnings=tuple(sentence(warning) for warning in (*notes, *scan.warnings)),
        sections=tuple(sections),
        is_simulated=is_simulated,
        footer=footer(provenance),
        forced=provenance.forced,
    )


def fate_totals(scan: ScanReconstruction) -> Table:
    """All stripe points by what became of them."""
    counts = {fate: sum(image.count(fate) for image in scan.images) for fate in PointFate}
    n_all = max(sum(counts.values()), 1)
    rows = [
        (fate.label, f"{count:,}", f"{100.0 * count / n_all:.2f} %")
        for fate, count in counts.items()
        if count
    ]
    return Table(("stripe points", "count", "share"), tuple(rows))


def exposure_table(scan: ScanReconstruction) -> Table:
    """Every exposure with what became of its points."""
    fates = [fate for fate in PointFate if any(image.count(fate) for image in scan.images)]
    rows = tuple(
        (image.profile.source, *(str(image.count(fate)) for fate in fates)) for image in scan.images
    )
    return Table(("exposure", *(fate.label for fate in fates)), rows)


def without_pose_table(scan: ScanReconstruction) -> Table:
    """Exposures that could not be placed, and why."""
    return Table(("exposure", "why"), tuple(scan.without_pose), "", (1,))


def _cards(scan: ScanReconstruction) -> tuple[Card, ...]:
    cloud = scan.cloud
    n_stripe = sum(len(image.profile) for image in scan.images)
    size = np.ptp(cloud.points_mm, axis=0)
    return (
        Card("Points", f"{len(cloud):,}", f"of {n_stripe:,} stripe points"),
        Card(
            "Sigma of a point",
            f"{significant(float(np.median(cloud.sigma_mm)))} mm",
            f"median; 95 % below {significant(float(np.percentile(cloud.sigma_mm, 95)))} mm",
        ),
        Card(
            "Exposures placed",
            str(len(scan.images)),
            f"{len(scan.without_pose)} had no pose of the arm"
            if scan.without_pose
            else "each with a pose of the arm",
        ),
        Card(
            "Extent", " × ".join(f"{value:.0f}" for value in size) + " mm", "along X, Y, Z of Base"
        ),
    )
