# SPDX-License-Identifier: Apache-2.0
"""The pages of reconstructions, of scans, of fused and of cleaned clouds, and their numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from armscan.fusion.digest import CloudDigest
from armscan.geometry.arrays import FloatArray
from armscan.inspection.cleaning import Cleaning
from armscan.models.calibration import Provenance, SensorCalibration
from armscan.pipeline.measure import Reconstruction
from armscan.pipeline.progress import ChainProfile
from armscan.pipeline.scan import ExposureStatus, ScanReconstruction
from armscan.reconstruction.labels import LabelledProfile, PointStatus, StripeCounts
from armscan.reconstruction.pass_agreement import PassAgreement
from armscan.records.cloud import PointCloud
from armscan.records.exposure import Exposure
from armscan.report.charts import Bars, histogram_chart
from armscan.report.drawing import (
    ACCENT,
    PALETTE,
    SceneDots,
    new_figure,
    ramp_colours,
    ramp_markup,
    raster_markup,
    scene_markup,
    styled,
    uniform_dots,
)
from armscan.report.page import Gallery, Legend, Page, Picture, Section, Text, page_of
from armscan.report.photographs import evenly_chosen, stripe_gallery
from armscan.report.quantity import Quantity, Table, fact, for_people, only, plural, significant

MAX_LISTED = 2000
"""Exposures of the folded table: a scan of minutes has tens of thousands."""
MAX_PROFILES = 6
PROFILE_TEXT = "Measured profiles, seen square on to the light sheet; the camera is above."
STATUS_TEXT = (
    "What became of every stripe point. Points that were flagged or left out are in no cloud; "
    "points that were measured but are wrong would be in it, and only an inspection shows them."
)


def cloud_quantities(result: Reconstruction) -> tuple[Quantity, ...]:
    """What is told of measured points."""
    cloud, digest = result.cloud, CloudDigest.of(result.cloud)
    n_stripe = sum(len(image.profile) for image in result.images)
    names = [name for k, name in enumerate(cloud.sheet_names) if (cloud.sheet == k).any()]
    sheets = f"sheet{'s' if len(names) > 1 else ''} {', '.join(names)}"
    return (
        *_point_quantities(digest, n_stripe),
        fact("Images", str(len(result.images)), sheets),
    )


def sigma_quantities(digest: CloudDigest) -> tuple[Quantity, ...]:
    """Median and 95 % of the points' standard deviations."""
    median, high = (float(value) for value in digest.sigma_mm[:2])
    return (
        Quantity(
            "sigma_median_mm",
            "Sigma of a point",
            median,
            unit="mm",
            meaning=f"median; 95 % below {significant(high)} mm",
        ),
        Quantity("sigma_95_mm", "", high),
    )


def _point_quantities(digest: CloudDigest, n_stripe: int) -> tuple[Quantity, ...]:
    low, top, frame = digest.low_mm.tolist(), digest.high_mm.tolist(), digest.shown.frame
    return (
        Quantity(
            "n_points",
            "Points",
            digest.n_points,
            meaning=f"in the {frame} frame, of {n_stripe:,} stripe points",
        ),
        Quantity("frame", "", frame),
        *sigma_quantities(digest),
        Quantity("low_corner_mm", "", low),
        Quantity("high_corner_mm", "", top),
        *(fact(axis, f"{low[k]:.2f} to {top[k]:.2f} mm") for k, axis in enumerate("XYZ")),
    )


def scan_quantities(scan: ScanReconstruction, digest: CloudDigest) -> tuple[Quantity, ...]:
    """What is told of a scan and its points."""
    counts = {status: scan.count(status) for status in ExposureStatus}
    found = scan.doubt.agreement
    passes = None
    if found is not None:
        passes = {
            "distance_mm": found.distance_mm,
            "worst_mm": found.worst_mm,
            "claimed_mm": found.claimed_mm,
            "ratio": found.ratio,
            "worst_ratio": found.worst_ratio,
            "n_pairs": len(found.pairs),
            "cause": scan.doubt.cause,
        }
    return (
        *_point_quantities(digest, sum(map(len, scan.counts)) or digest.n_points),
        Quantity(
            "exposures",
            "Exposures",
            {status.name.lower(): count for status, count in counts.items()},
            shown=", ".join(f"{count} {one.value}" for one, count in counts.items() if count),
        ),
        Quantity("poses_by", "Poses", scan.poses.source, shown=scan.poses.how),
        Quantity("max_gap_ns", "", scan.poses.max_gap_ns),
        Quantity("passes", "Passes", passes, shown=passes_text(scan.doubt.agreement)),
        Quantity("contradictions", "", list(scan.contradictions)),
        Quantity(
            "without_pose",
            "",
            [{"source": name, "reason": why} for name, why in scan.without_pose],
        ),
    )


def passes_text(found: PassAgreement | None) -> str:
    """How far the passes of a scan agree, in words."""
    if found is None:
        return "no two of them overlap, so the scan cannot be checked against itself"
    n = len(found.pairs)
    most = f"at most {significant(found.worst_mm)} mm"
    pairs = f" (median of {n} pairs; {most})" if n > 1 else " (one pair)"
    return (
        f"{significant(found.distance_mm)} mm apart where they overlap{pairs}, "
        f"{significant(found.ratio, '', 2)} times what is expected"
    )


def cloud_page(
    result: Reconstruction,
    sensor: SensorCalibration,
    exposures: Mapping[str, Exposure],
    provenance: Provenance,
    *,
    is_simulated: bool = False,
) -> Page:
    """Lay out the report; arguments as `armscan.report.sheets.laser_page`."""
    cloud, digest = result.cloud, CloudDigest.of(result.cloud)
    told = cloud_quantities(result)
    depth = cloud.points_mm[:, 2]
    span = f"{depth.min():.1f} to {depth.max():.1f} mm"
    with_points = [k for k in range(len(cloud.exposure_sources)) if (cloud.exposure == k).any()]
    profiles = [profile_view(cloud, sensor, k) for k in evenly_chosen(with_points, MAX_PROFILES)]
    stripes = (*stripe_gallery(result.images, cloud.sheet_names, exposures), status_table(result))
    return page_of(
        provenance,
        "Measured points",
        f"{len(cloud):,} points in the {cloud.frame} frame from "
        f"{plural(len(result.images), 'image')}",
        (
            Section("The points", (Gallery((digest_view(digest),), 560),)),
            Section("Profiles", (Text(PROFILE_TEXT), Gallery(tuple(profiles)))),
            Section("The stripes", stripes),
            Section("How far to trust them", (Gallery((sigma_histogram(digest),)),)),
        ),
        cards=(
            *only(told, "n_points", "sigma_median_mm"),
            fact("Depth", span, "Z in the Sensor frame"),
            told[-1],
        ),
        warnings=result.warnings,
        is_simulated=is_simulated,
    )


def status_table(result: Reconstruction) -> Table:
    """What became of the stripe points of each image."""
    statuses = _statuses(result.images)
    rows = tuple(
        (image.profile.source, *(str(image.count(status)) for status in statuses), image.reason)
        for image in result.images
    )
    columns = ("image", *(status.label for status in statuses), "sheet chosen by")
    return Table(columns, rows, "", (len(columns) - 1,))


def _statuses(images: Sequence[LabelledProfile] | Sequence[StripeCounts]) -> list[PointStatus]:
    return [status for status in PointStatus if any(image.count(status) for image in images)]


def scan_page(
    scan: ScanReconstruction,
    exposures: Mapping[str, Exposure],
    provenance: Provenance,
    warnings: Sequence[str] = (),
    *,
    digest: CloudDigest,
    profile: ChainProfile | None = None,
    is_simulated: bool = False,
) -> Page:
    """Lay out the report.

    Parameters
    ----------
    scan
        The scan.
    digest
        Of its points.
    exposures
        Images by source name; those that are missing are not shown.
    provenance
        How the cloud came to be.
    warnings
        What is odd about the recording and the scan.
    profile
        What the stages took; None to say nothing of it.
    is_simulated
        True if the images were rendered.
    """
    size = " × ".join(f"{value:.0f}" for value in digest.high_mm - digest.low_mm)
    without = f"{len(scan.without_pose)} had no pose of the arm" if scan.without_pose else ""
    n_placed = scan.count(ExposureStatus.PLACED)
    sections = [Section("The cloud", (Gallery((digest_view(digest),), 560),))]
    if scan.counts:
        totals = (Text(STATUS_TEXT), status_totals(scan))
        sections.append(Section("What became of the points", totals))
    sections.append(Section("How far to trust them", (Gallery((sigma_histogram(digest),)),)))
    if scan.without_pose:
        table = Table(("exposure", "why"), tuple(scan.without_pose), "", (1,))
        sections.append(Section("Exposures without a pose", (table,)))
    if scan.counts:
        stripes = stripe_gallery(scan.images, scan.cloud.sheet_names, exposures, scan.counts)
        sections += [
            Section("The stripes", stripes),
            Section("Exposure by exposure", _exposure_table(scan), is_folded=True),
        ]
    if profile is not None:
        rates = profile_quantities(scan, digest, profile)
        told = "; ".join(f"{one.label.lower()} {one.text}" for one in rates if one.label)
        costs = (Text(f"{told}."), profile_table(scan, profile))
        sections.append(Section("What the stages took", costs, is_folded=True))
    return page_of(
        provenance,
        "Scan in Base",
        f"{digest.n_points:,} points from {n_placed} exposures of a moving arm",
        sections,
        cards=(
            *only(scan_quantities(scan, digest), "n_points", "sigma_median_mm"),
            fact("Exposures placed", str(n_placed), without or "each with a pose of the arm"),
            fact("Extent", f"{size} mm", "along X, Y, Z of Base"),
        ),
        warnings=warnings,
        is_simulated=is_simulated,
    )


def profile_quantities(
    scan: ScanReconstruction, digest: CloudDigest, profile: ChainProfile
) -> tuple[Quantity, ...]:
    """Rate and memory of a scan's reconstruction."""
    n_exposures = len(scan.counts)
    peak = profile.peak_mb
    return (
        Quantity("exposures_per_s", "Exposures a second", n_exposures / profile.wall_s),
        Quantity("points_per_s", "Points a second", digest.n_points / profile.wall_s),
        Quantity("wall_s", "Time", profile.wall_s, unit="s"),
        Quantity("processor_s", "Processor time", profile.processor_s, unit="s"),
        Quantity(
            "peak_memory_mb",
            "Peak memory",
            float("nan") if peak is None else peak,
            unit="MB",
            shown="not told by this system" if peak is None else f"{peak:.0f} MB",
        ),
        Quantity("stages_s", "", dict(profile.stages)),
        Quantity(
            "n_cached",
            "From the cache" if profile.n_cached else "",
            profile.n_cached,
            meaning="images whose points an earlier run found, which is in no stage; --no-cache "
            "finds all anew",
        ),
    )


def profile_table(scan: ScanReconstruction, profile: ChainProfile) -> Table:
    """Processor time by stage; the share of a core is that of the time that all took."""
    rest = profile.processor_s - sum(seconds for _, seconds in profile.stages)
    rows = tuple(
        (
            name,
            f"{seconds:.2f}",
            f"{1e3 * seconds / max(len(scan.counts), 1):.2f}",
            f"{seconds / profile.wall_s:.2f}",
        )
        for name, seconds in (*profile.stages, ("other", rest))
    )
    return Table(("stage", "processor s", "ms an exposure", "cores"), rows)


def status_totals(scan: ScanReconstruction) -> Table:
    """All stripe points by what became of them."""
    counts = {status: sum(image.count(status) for image in scan.counts) for status in PointStatus}
    n_all = max(sum(counts.values()), 1)
    rows = tuple(
        (status.label, f"{count:,}", f"{100.0 * count / n_all:.2f} %")
        for status, count in counts.items()
        if count
    )
    return Table(("stripe points", "count", "share"), rows)


def _exposure_table(scan: ScanReconstruction) -> tuple[Text | Table, ...]:
    """Every exposure with what became of its points; of a long scan some, evenly chosen."""
    statuses = _statuses(scan.counts)
    listed = evenly_chosen(scan.counts, MAX_LISTED)
    rows = tuple(
        (image.source, *(str(image.count(status)) for status in statuses)) for image in listed
    )
    table = Table(("exposure", *(status.label for status in statuses)), rows)
    if len(listed) == len(scan.counts):
        return (table,)
    return Text(f"{len(listed)} of {len(scan.counts)} exposures, evenly chosen."), table


def cloud_view(cloud: PointCloud) -> Picture:
    """The points in space, coloured by their standard deviation."""
    return digest_view(CloudDigest.of(cloud))


def digest_view(digest: CloudDigest) -> Picture:
    """As `cloud_view`, of a cloud of which some points are at hand."""
    cloud, step = digest.shown, digest.step
    sigma_um = 1000.0 * digest.shown_sigma_mm
    low, high = (float(value) for value in np.percentile(sigma_um, [2, 98]))
    dots = SceneDots(cloud.points_mm, ramp_colours(sigma_um, low, high))
    is_z_up = cloud.frame != "Sensor"
    scene = scene_markup([dots], [], [], "Measured points in space", is_z_up=is_z_up)
    shown = f" One point in {step} is shown." if step > 1 else ""
    title = f"Points in space ({cloud.frame} frame)"
    if not sigma_um.any():
        return Picture(scene, title=title, caption=f"Standard deviations are not known.{shown}")
    return Picture(
        ramp_markup(f"sigma {significant(low)} µm", f"{significant(high)} µm") + scene,
        title=title,
        caption="Colour is each point's standard deviation along its worst direction, "
        f"{'stripe noise, arm' if is_z_up else 'stripe noise'} and calibration together."
        f"{shown}",
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


def sigma_histogram(digest: CloudDigest) -> Picture:
    """How uncertain the points are, and how much of it is stripe noise."""
    edges = 1000.0 * digest.edges_mm
    middles = 0.5 * (edges[1:] + edges[:-1])
    noise = digest.noise_counts
    return histogram_chart(
        [
            Bars(middles, ACCENT, "all", counts=digest.sigma_counts),
            Bars(middles, PALETTE[1], "stripe noise", is_outline=True, counts=noise),
        ],
        edges,
        "standard deviation of a point, µm",
        title="How far to trust a point",
        caption="Stripe noise differs from point to point and averages out; the rest, from the "
        "calibration, moves neighbouring points together and does not.",
    )


NOT_KNOWN = "not known"
SIGMA_TEXT = (
    "Stripe noise averages out as points of a voxel are put together. What the points share, the "
    "calibration and the arm, does not: it stays as large as the points told it."
)


@dataclass(frozen=True, slots=True, eq=False)
class FusedCloud:
    """What fusing ``n_measured`` points came to, with voxels of edge ``size_mm``.

    ``private_mm`` is the median standard deviation of what is left of the noise; not known without
    ``has_covariance``.
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


LEFT_COLOUR = "#b9c0c6"
"""Points that are left, pale: what was taken is looked for."""
MOST_SHOWN = 12_000
"""Points of each colour in the picture; more are thinned, which the page says."""
ORDER_TEXT = (
    "Filters work in the order of the table, each on what those before it left: a point counts "
    "for the first one that took it."
)


def cleaning_quantities(found: Cleaning) -> tuple[Quantity, ...]:
    """What is told of a cleaned cloud."""
    n = len(found.taken_by)
    left = len(found.cloud)
    share = 100.0 * left / n if n else 0.0
    return (
        Quantity("points.n_given", "Points given", n),
        Quantity("points.n_left", "Points left", left, meaning=f"{share:.1f} % of them"),
        Quantity(
            "filters",
            "",
            [{"name": s.name, "n_taken": s.n_taken, "rule": s.rule} for s in found.steps],
        ),
    )


def cleaning_table(found: Cleaning) -> Table:
    """Filters with what they took."""
    n = max(len(found.taken_by), 1)
    rows = tuple(
        (step.name, f"{step.n_taken:,}", f"{100.0 * step.n_taken / n:.2f} %", step.rule)
        for step in found.steps
    )
    return Table(("filter", "points taken", "of all", "which"), rows, "", (3,))


def cleaning_page(
    found: Cleaning, points_mm: FloatArray, provenance: Provenance, *, is_simulated: bool
) -> Page:
    """Lay out the page; ``points_mm`` (N, 3) are those of the cloud that was given."""
    told = cleaning_quantities(found)
    colours = [PALETTE[k % len(PALETTE)] for k in range(len(found.steps))]
    names = [f"{step.name} ({step.n_taken:,})" for step in found.steps]
    legend = Legend(((LEFT_COLOUR, "left"), *zip(colours, names, strict=True)))
    return page_of(
        provenance,
        "Cloud cleaned",
        f"{len(found.cloud):,} of {len(points_mm):,} points in the {found.cloud.frame} frame left",
        (
            Section("What each filter took", (Text(ORDER_TEXT), cleaning_table(found))),
            Section(
                "In space", (legend, Gallery((_cleaned_view(found, points_mm, colours),), 560))
            ),
        ),
        cards=(
            *for_people(told),
            *(
                Quantity("", step.name.capitalize(), step.n_taken, meaning="points taken")
                for step in found.steps
            ),
        ),
        warnings=provenance.warnings,
        is_simulated=is_simulated,
    )


def _cleaned_view(found: Cleaning, points_mm: FloatArray, colours: list[str]) -> Picture:
    dots, thinned = [], []
    for k in range(-1, len(found.steps)):
        rows = np.flatnonzero(found.taken_by == k)
        if not len(rows):
            continue
        step = max(1, math.ceil(len(rows) / MOST_SHOWN))
        if step > 1:
            name = "left" if k < 0 else found.steps[k].name
            thinned.append(f"one point in {step} of '{name}'")
        colour = LEFT_COLOUR if k < 0 else colours[k]
        dots.append(uniform_dots(points_mm[rows[::step]], colour))
    caption = f"Shown is {', '.join(thinned)}." if thinned else ""
    title = "Points by the filter that took them"
    scene = scene_markup(dots, [], [], title, is_z_up=found.cloud.frame != "Sensor")
    return Picture(scene, caption, f"{title} ({found.cloud.frame} frame)")
