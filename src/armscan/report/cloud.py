# SPDX-License-Identifier: Apache-2.0
"""The pages of a reconstruction and of a scan, and their figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from armscan.models.calibration import Provenance, SensorCalibration
from armscan.pipeline.measure import Reconstruction
from armscan.pipeline.scan import ScanReconstruction
from armscan.reconstruction.labels import PointStatus
from armscan.records.cloud import PointCloud
from armscan.records.exposure import Exposure
from armscan.report.drawing import ACCENT, PALETTE, chart_markup, new_figure, raster_markup, styled
from armscan.report.page import Card, Gallery, Page, Picture, Section, Text, footer, origin_section
from armscan.report.quantity import Table, sentence, significant
from armscan.report.scene3d import SceneDots, ramp_colours, ramp_markup, scene_markup
from armscan.report.stripes import evenly_chosen, stripe_gallery

MAX_SHOWN = 20_000


def cloud_view(cloud: PointCloud) -> Picture:
    """The points in space, coloured by their standard deviation."""
    step = max(1, len(cloud) // MAX_SHOWN)
    sigma_um = 1000.0 * cloud.sigma_mm[::step]
    low, high = (float(value) for value in np.percentile(sigma_um, [2, 98]))
    dots = SceneDots(cloud.points_mm[::step], ramp_colours(sigma_um, low, high))
    is_z_up = cloud.frame != "Sensor"
    scene = scene_markup([dots], [], [], "Measured points in space", is_z_up=is_z_up)
    shown = f" One point in {step} is shown." if step > 1 else ""
    return Picture(
        ramp_markup(f"sigma {significant(low)} µm", f"{significant(high)} µm") + scene,
        title=f"Points in space ({cloud.frame} frame)",
        caption="Colour is each point's standard deviation along its worst direction, "
        f"{'stripe noise, arm' if is_z_up else 'stripe noise'} and calibration together. "
        "Drag to turn; click, then scroll to zoom." + shown,
    )


def profile_view(cloud: PointCloud, sensor: SensorCalibration, exposure: int) -> Picture:
    """The points of one exposure in the plane of their sheet."""
    with styled():
        figure = new_figure(6.0, 3.6)
        axes = figure.add_subplot()
        for k, calibration in enumerate(sensor.sheets):
            name = calibration.name
            if name not in cloud.sheet_names:
                continue
            chosen = (cloud.exposure == exposure) & (cloud.sheet == cloud.sheet_names.index(name))
            if not chosen.any():
                continue
            sheet = calibration.sheet
            along, depth = ((cloud.points_mm[chosen] - sheet.origin_mm) @ sheet.axes[:2].T).T
            if sheet.axes[1][2] < 0.0:
                depth = -depth
            colour = PALETTE[k % len(PALETTE)]
            axes.plot(along, depth, ".", markersize=1.8, color=colour, label=f"sheet {name}")
        axes.set_xlabel("along the stripe, mm")
        axes.set_ylabel("depth in the sheet, mm")
        axes.set_aspect("equal", adjustable="datalim")
        axes.invert_yaxis()
        axes.grid()
        axes.legend(markerscale=5)
    return Picture(
        raster_markup(figure, "Profile in the sheet"),
        title=cloud.exposure_sources[exposure],
    )


def sigma_histogram(cloud: PointCloud) -> Picture:
    """How uncertain the points are, and how much of it is stripe noise."""
    sigma_um = 1000.0 * cloud.sigma_mm
    noise_um = 1000.0 * cloud.sigma_noise_mm
    edges = np.linspace(0.0, 1.15 * float(np.percentile(sigma_um, 99)), 61).tolist()
    with styled():
        figure = new_figure(5.0, 3.2)
        axes = figure.add_subplot()
        axes.hist(sigma_um, edges, color=ACCENT, label="all")
        axes.hist(
            noise_um, edges, histtype="step", color=PALETTE[1], linewidth=1.4, label="stripe noise"
        )
        axes.set_xlabel("standard deviation of a point, µm")
        axes.set_ylabel("points")
        axes.legend()
    return Picture(
        chart_markup(figure, "Histogram of the points' standard deviations"),
        title="How far to trust a point",
        caption="Stripe noise differs from point to point and averages out; the rest, from the "
        "calibration, moves neighbouring points together and does not.",
    )


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
    """Lay out the report; arguments as `armscan.report.sheets.laser_page`."""
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
        profile_view(cloud, sensor, k) for k in evenly_chosen(with_points, MAX_PROFILES)
    )
    return Page(
        title="Measured points",
        subtitle=f"{len(cloud):,} points in the {cloud.frame} frame from {len(result.images)} "
        f"image{'s' if len(result.images) > 1 else ''}",
        cards=cards,
        warnings=tuple(sentence(warning) for warning in result.warnings),
        sections=(
            Section("The points", (Gallery((cloud_view(cloud),), 560),)),
            Section("Profiles", (Text(PROFILE_TEXT), Gallery(profiles, 420))),
            _images_section(result, exposures),
            Section("How far to trust them", (Gallery((sigma_histogram(cloud),), 420),)),
            origin_section(provenance),
        ),
        is_simulated=is_simulated,
        footer=footer(provenance),
        forced=provenance.forced,
    )


def fate_table(result: Reconstruction) -> Table:
    """What became of the stripe points of each image."""
    states = [
        status for status in PointStatus if any(image.count(status) for image in result.images)
    ]
    rows = tuple(
        (image.profile.source, *(str(image.count(status)) for status in states), image.reason)
        for image in result.images
    )
    columns = ("image", *(status.label for status in states), "sheet chosen by")
    return Table(columns, rows, "", (len(columns) - 1,))


def _images_section(result: Reconstruction, exposures: Mapping[str, Exposure]) -> Section:
    blocks = stripe_gallery(result.images, result.cloud.sheet_names, exposures)
    return Section("The stripes", (*blocks, fate_table(result)))


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
        Section("The cloud", (Gallery((cloud_view(cloud),), 560),)),
        Section("What became of the points", (Text(FATE_TEXT), fate_totals(scan))),
        Section("How far to trust them", (Gallery((sigma_histogram(cloud),), 420),)),
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
    counts = {status: sum(image.count(status) for image in scan.images) for status in PointStatus}
    n_all = max(sum(counts.values()), 1)
    rows = [
        (status.label, f"{count:,}", f"{100.0 * count / n_all:.2f} %")
        for status, count in counts.items()
        if count
    ]
    return Table(("stripe points", "count", "share"), tuple(rows))


def exposure_table(scan: ScanReconstruction) -> Table:
    """Every exposure with what became of its points."""
    states = [status for status in PointStatus if any(image.count(status) for image in scan.images)]
    rows = tuple(
        (image.profile.source, *(str(image.count(status)) for status in states))
        for image in scan.images
    )
    return Table(("exposure", *(status.label for status in states)), rows)


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
