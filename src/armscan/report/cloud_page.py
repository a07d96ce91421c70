# SPDX-License-Identifier: Apache-2.0
"""The report of a reconstruction."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from armscan.models.calibration import Provenance, SensorCalibration
from armscan.reconstruction.result import PointFate, Reconstruction
from armscan.records.exposure import Exposure
from armscan.report import cloud_figures as figures
from armscan.report.numbers import sentence, significant
from armscan.report.origin import footer, origin_section
from armscan.report.page import Card, Gallery, Page, Section, Text
from armscan.report.stripe_figures import evenly_chosen
from armscan.report.stripe_gallery import stripe_gallery
from armscan.report.summary import Table

MAX_PROFILES = 6
PROFILE_TEXT = "Measured profiles, seen square on to the light sheet; the camera is above."


def cloud_page(
    result: Reconstruction,
    sensor: SensorCalibration,
    exposures: Mapping[str, Exposure],
    provenance: Provenance,
    *,
    is_simulated: bool = False,
) -> Page:
    """Lay out the report; arguments as `armscan.report.laser_page.laser_page`."""
    cloud = result.cloud
    depth = cloud.points_mm[:, 2]
    n_stripe = sum(len(image.profile) for image in result.images)
    used = [name for k, name in enumerate(cloud.sheet_names) if (cloud.sheet == k).any()]
    cards = (
        Card("Points", f"{len(cloud):,}", f"of {n_stripe:,} stripe points"),
        Card(
            "Sigma of a point",
            f"{significant(float(np.median(cloud.sigma_mm)))} mm",
            f"median; 95 % below {significant(float(np.percentile(cloud.sigma_mm, 95)))} mm",
        ),
        Card("Depth", f"{depth.min():.1f} to {depth.max():.1f} mm", "Z in the Sensor frame"),
        Card(
            "Images",
            str(len(result.images)),
            f"sheet{'s' if len(used) > 1 else ''} {', '.join(used)}",
        ),
    )
    with_points = [k for k in range(len(cloud.exposure_sources)) if (cloud.exposure == k).any()]
    profiles = tuple(
        figures.profile_view(cloud, sensor, k) for k in evenly_chosen(with_points, MAX_PROFILES)
    )
    return Page(
        title="Measured points",
        subtitle=f"{len(cloud):,} points in the {cloud.frame} frame from {len(result.images)} "
        f"image{'s' if len(result.images) > 1 else ''}",
        cards=cards,
        warnings=tuple(sentence(warning) for warning in result.warnings),
        sections=(
            Section("The points", (Gallery((figures.cloud_view(cloud),), 560),)),
            Section("Profiles", (Text(PROFILE_TEXT), Gallery(profiles, 420))),
            _images_section(result, exposures),
            Section("How far to trust them", (Gallery((figures.sigma_histogram(cloud),), 420),)),
            origin_section(provenance),
        ),
        is_simulated=is_simulated,
        footer=footer(provenance),
        forced=provenance.forced,
    )


def fate_table(result: Reconstruction) -> Table:
    """What became of the stripe points of each image."""
    fates = [fate for fate in PointFate if any(image.count(fate) for image in result.images)]
    rows = tuple(
        (image.profile.source, *(str(image.count(fate)) for fate in fates), image.naming)
        for image in result.images
    )
    columns = ("image", *(fate.label for fate in fates), "sheet chosen by")
    return Table(columns, rows, "", (len(columns) - 1,))


def _images_section(result: Reconstruction, exposures: Mapping[str, Exposure]) -> Section:
    blocks = stripe_gallery(result.images, result.cloud.sheet_names, exposures)
    return Section("The stripes", (*blocks, fate_table(result)))
