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
from armscan.report.page import Card, Gallery, Legend, Page, Section, Text
from armscan.report.stripe_figures import evenly_chosen, stripe_legend, stripe_picture
from armscan.report.summary import Table

FATE_COLOURS = {PointFate.NO_RAY: "#8a6d5a", PointFate.OUT_OF_DEPTH: "#ff7a3c"}
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
    flags = 0
    for image in result.images:
        for value in image.profile.flags[image.fate == int(PointFate.FLAGGED)]:
            flags |= int(value)
    seen = {fate for fate in FATE_COLOURS if any(image.count(fate) for image in result.images)}
    fates = {int(fate): (FATE_COLOURS[fate], fate.label) for fate in PointFate if fate in seen}
    shown = evenly_chosen([image for image in result.images if image.profile.source in exposures])
    pictures = tuple(
        stripe_picture(
            exposures[image.profile.source],
            image.profile,
            image.fate,
            image.sheet,
            {int(fate): colour for fate, colour in FATE_COLOURS.items()},
            caption=f"{image.count(PointFate.MEASURED)} of {len(image.profile)} points measured",
        )
        for image in shown
    )
    text = "Every stripe point, measured or not. Dark photographs are brightened here."
    if len(shown) < len(result.images):
        text += f" {len(shown)} of {len(result.images)} images are shown, evenly chosen."
    legend = Legend(stripe_legend(result.cloud.sheet_names, fates, flags))
    return Section("The stripes", (Text(text), legend, Gallery(pictures, 420), fate_table(result)))
