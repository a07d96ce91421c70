# SPDX-License-Identifier: Apache-2.0
"""Pages of ring markers: found in images or measured by two cameras, and scans joined by them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.markers.stereo_matching import RingStatus, StereoMatches
from armscan.models.calibration import Provenance
from armscan.pipeline.register import MarkerResiduals
from armscan.records.cloud import PointCloud
from armscan.records.exposure import Exposure
from armscan.records.points import RingImages
from armscan.report.charts import named_columns
from armscan.report.drawing import (
    ACCENT,
    ALERT,
    MUTED,
    PALETTE,
    Labels,
    Marks,
    SceneLines,
    chart_markup,
    new_figure,
    photo_markup,
    round_below,
    scene_markup,
    styled,
    uniform_dots,
)
from armscan.report.page import Gallery, Legend, Page, Picture, Section, Text, page_of
from armscan.report.quantity import Quantity, Table, fact, plural, significant
from armscan.vision.rings import RingDetection

FOUND, LEFT_ALONE = "#12b5dd", "#f2a33a"
"""Marks on grey photographs: rings taken, and rings that no pair was made of."""
SEGMENTS = 40
LABEL_ABOVE_PX = 4.0


def ring_quantities(detections: Sequence[RingDetection]) -> tuple[Quantity, ...]:
    """What is told of rings in images."""
    n_rings = sum(len(found.rings) for found in detections)
    n_dropped = sum(len(found.reasons) for found in detections)
    variances = [np.einsum("nii->n", found.rings.covariance_px2) / 2.0 for found in detections]
    flat = np.concatenate([*variances, np.zeros(0)])
    sigma = significant(float(np.sqrt(np.median(flat))), "px") if len(flat) else "not known"
    return (
        fact("Rings", str(n_rings), f"in {plural(len(detections), 'image')}"),
        fact("Centre sigma", sigma, "an axis, median"),
        fact("Filtered out", str(n_dropped), _reasons(detections) or "two rims, but no ring"),
    )


def marker_quantities(
    matches: StereoMatches, detections: Sequence[RingDetection]
) -> tuple[Quantity, ...]:
    """What is told of markers that two cameras saw."""
    markers = matches.markers
    n_left, n_right = (len(found.rings) for found in detections)
    sigma = np.sqrt(np.einsum("nii->ni", markers.covariance_mm2))
    depth_um = significant(1000.0 * float(np.median(sigma[:, 2])), "µm")
    places = zip(markers.ids, markers.points_mm, sigma, strict=True)
    statuses = {status.name.lower(): matches.counts[status] for status in RingStatus}
    return (
        Quantity(
            "markers",
            "Markers",
            [
                {"id": int(number), "xyz_mm": place.tolist(), "sigma_mm": sigmas.tolist()}
                for number, place, sigmas in places
            ],
            shown=str(len(markers)),
            meaning=f"of {n_left} rings left and {n_right} right",
        ),
        Quantity("frame", "", markers.frame),
        Quantity(
            "epipolar_rms_px",
            "Epipolar distance",
            float(np.sqrt(np.mean(matches.distance_px**2))),
            unit="px",
            meaning="rms (eq. 4.26)",
        ),
        fact(
            "Depth sigma",
            depth_um,
            "median, of the centres; the calibration's share is common to all",
        ),
        Quantity(
            "n_planes",
            "Flat faces",
            matches.n_planes,
            meaning="on which six markers or more agree",
        ),
        Quantity("n_candidates", "", matches.n_candidates),
        Quantity("left_rings", "", statuses),
    )


def detection_page(
    exposures: Sequence[Exposure],
    detections: Sequence[RingDetection],
    warnings: Sequence[str],
    provenance: Provenance,
    *,
    is_simulated: bool,
) -> Page:
    """Page of rings in images."""
    pictures = tuple(
        _picture(exposure, found, np.ones(len(found.rings), np.bool_), _numbers(found))
        for exposure, found in zip(exposures, detections, strict=True)
    )
    legend = Legend(((FOUND, "both rims and centre"), (ALERT, "two rims that a filter dropped")))
    return page_of(
        provenance,
        "Ring markers",
        plural(len(exposures), "image"),
        (
            Section("Rings in the images", (legend, Gallery(pictures, 900))),
            Section("Every ring", (_ring_table(detections),), is_folded=True),
        ),
        cards=ring_quantities(detections),
        warnings=warnings,
        is_simulated=is_simulated,
    )


def marker_page(
    exposures: Sequence[Exposure],
    detections: Sequence[RingDetection],
    matches: StereoMatches,
    warnings: Sequence[str],
    provenance: Provenance,
    *,
    is_simulated: bool,
) -> Page:
    """Page of markers that two cameras saw."""
    pictures = []
    for exposure, found, rows in zip(
        exposures, detections, (matches.left, matches.right), strict=True
    ):
        names = [""] * len(found.rings)
        for row, number in zip(rows, matches.markers.ids, strict=True):
            names[row] = str(number)
        is_taken = np.isin(np.arange(len(found.rings)), rows)
        pictures.append(_picture(exposure, found, is_taken, names))
    legend = Legend(
        (
            (FOUND, "both rims and centre of a marker"),
            (LEFT_ALONE, "a ring without a partner"),
            (ALERT, "two rims that a filter dropped"),
        )
    )
    text = Text(
        f"{plural(matches.n_candidates, 'pair')} lay within the epipolar threshold (eq. 4.27). "
        "What stays ambiguous is not matched."
    )
    became = (status_table(matches), text)
    return page_of(
        provenance,
        "Ring markers in space",
        f"{exposures[0].source} and {exposures[1].source}",
        (
            Section("Rings in the images", (legend, Gallery(tuple(pictures), 640))),
            Section("What became of the rings of the left image", became),
            Section("Every marker", (_marker_table(matches),)),
            Section("Every ring", (_ring_table(detections),), is_folded=True),
        ),
        cards=[item for item in marker_quantities(matches, detections) if item.label],
        warnings=warnings,
        is_simulated=is_simulated,
    )


def status_table(matches: StereoMatches) -> Table:
    """What became of the rings of the left image."""
    rows = tuple((status.value, str(n)) for status, n in matches.counts.items() if n)
    return Table(("rings of the left image", "count"), rows)


def _marker_table(matches: StereoMatches) -> Table:
    """Places and sigmas of the markers."""
    markers = matches.markers
    sigma = np.sqrt(np.einsum("nii->ni", markers.covariance_mm2))
    rows = tuple(
        (
            str(markers.ids[k]),
            *(f"{value:.4f}" for value in markers.points_mm[k]),
            *(significant(1000.0 * value) for value in sigma[k]),
            f"{matches.distance_px[k]:+.3f}",
        )
        for k in np.argsort(markers.ids)
    )
    axes = ("x mm", "y mm", "z mm", "σx µm", "σy µm", "σz µm")
    return Table(("marker", *axes, "epipolar px"), rows, "Markers, frame Sensor")


def _ring_table(detections: Sequence[RingDetection]) -> Table:
    """Size, shape and centre of each ring."""
    rows = []
    for found in detections:
        rings = found.rings
        sigma = np.sqrt(np.einsum("nii->n", rings.covariance_px2) / 2.0)
        rows += [
            (
                rings.source,
                str(k),
                f"{rings.centres_px[k, 0]:.3f}",
                f"{rings.centres_px[k, 1]:.3f}",
                f"{sigma[k]:.4f}",
                f"{rings.perimeter_px[k]:.1f}",
                f"{rings.roundness[k]:.2f}",
                f"{rings.contrast[k]:.2f}",
            )
            for k in range(len(rings))
        ]
    heads = ("image", "ring", "x px", "y px", "σ px", "perimeter px", "roundness", "contrast")
    return Table(heads, tuple(rows))


def _picture(
    exposure: Exposure, found: RingDetection, is_taken: BoolArray, names: Sequence[str]
) -> Picture:
    rings = found.rings
    marks = [
        Marks(_outlines(rings, is_taken), FOUND, "line", 1.6),
        Marks(rings.centres_px[is_taken], FOUND, "dot", 3.0),
        Marks(_outlines(rings, ~is_taken), LEFT_ALONE, "line", 1.6),
        Marks(found.dropped_px, ALERT, "ring", 14.0),
    ]
    height = rings.outer_half_px[:, 1] + LABEL_ABOVE_PX
    above = rings.centres_px - np.column_stack([np.zeros(len(rings)), height])
    caption = f"{plural(int(is_taken.sum()), 'ring')} taken"
    if (~is_taken).any():
        caption += f", {int((~is_taken).sum())} without a partner"
    if found.reasons:
        caption += f", {len(found.reasons)} filtered out ({_reasons([found])})"
    markup = photo_markup(
        exposure,
        marks,
        f"{exposure.source} with its rings",
        labels=(Labels(above, tuple(names), "white", 13.0),),
        longest_px=1600,
        is_grey=True,
    )
    return Picture(markup, caption + ".", exposure.source)


def _outlines(rings: RingImages, chosen: BoolArray) -> FloatArray:
    """Both rims of the chosen rings as line segments (M, 2), two rows a segment."""
    angle = np.linspace(0.0, 2.0 * np.pi, SEGMENTS + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    along = np.stack([np.cos(rings.direction_rad), np.sin(rings.direction_rad)], axis=1)
    axes = np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=1)], axis=2)
    lines = []
    for half in (rings.outer_half_px, rings.inner_half_px):
        of_axes = half[:, ::-1, None] * circle
        points = rings.centres_px[:, None] + (axes @ of_axes).transpose(0, 2, 1)
        pairs = np.stack([points[:, :-1], points[:, 1:]], axis=2)
        lines.append(pairs[chosen].reshape(-1, 2))
    return np.concatenate(lines)


def _numbers(found: RingDetection) -> list[str]:
    return [str(k) for k in range(len(found.rings))]


def _reasons(detections: Sequence[RingDetection]) -> str:
    counts = Counter(reason for found in detections for reason in found.reasons)
    return ", ".join(f"{n} by {reason}" for reason, n in counts.items())


HOW_TO_READ = (
    "A residual is how far a marker, carried to the common frame, lies from where the others say. "
    "It shows how well markers were measured, and markers that moved. It does not show how well "
    "the frames agree: that is the uncertainty, which is larger far from the markers."
)
RESIDUAL_HEADS = ("scan", "its id", "marker", "dx mm", "dy mm", "dz mm", "length mm", "")
MAX_CLOUD_DOTS = 12_000
CLOUD_GREY = "#c3ccd4"
RING_STEPS = 24
SHOWN_SHARE = 0.12
"""Length of the longest drawn residual as a share of the scene's extent."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerScene:
    """What to draw, all of it in the common frame.

    Parameters
    ----------
    points_mm, residual_mm
        (K, 3) markers and their residuals.
    is_used
        (K,) False where a marker moved.
    lonely_mm
        (L, 3) markers without partner.
    stations
        Labels with (3,) positions: where views were taken from, or the bases of the arm.
    is_z_up
        True for Base.
    """

    points_mm: FloatArray
    residual_mm: FloatArray
    is_used: BoolArray
    lonely_mm: FloatArray
    stations: Sequence[tuple[str, FloatArray]]
    clouds: Sequence[PointCloud]
    is_z_up: bool


@dataclass(frozen=True, slots=True, eq=False)
class RegisterReport:
    """One registration, ready for a page and a terminal.

    Parameters
    ----------
    title, subtitle
        What was joined.
    quantities, cards
        All that is told of it, and the key figures.
    scans
        Table of what was carried.
    residuals, residuals_are
        Of the markers, and what minus what they are.
    scene
        What to draw in space.
    drift
        Chart of the uncertainty along a chain of views; None for one step.
    warnings
        Sentences that a person should read first.
    """

    title: str
    subtitle: str
    quantities: tuple[Quantity, ...]
    cards: tuple[Quantity, ...]
    scans: Table
    residuals: MarkerResiduals
    residuals_are: str
    scene: MarkerScene
    drift: Picture | None
    warnings: tuple[str, ...]


def registration_page(
    report: RegisterReport, provenance: Provenance, *, is_simulated: bool
) -> Page:
    """Lay out the page."""
    charts = [_residual_chart(report.residuals)]
    if report.drift is not None:
        charts.insert(0, report.drift)
    table = _residual_table(report.residuals, report.residuals_are)
    return page_of(
        provenance,
        report.title,
        report.subtitle,
        (
            Section("In space", (Gallery((_marker_view(report.scene),), 560),)),
            Section("Scans", (report.scans,)),
            Section("How well the markers fit", (Text(HOW_TO_READ), Gallery(tuple(charts)))),
            Section("Marker by marker", (table,), is_folded=report.drift is not None),
        ),
        cards=report.cards,
        warnings=report.warnings,
        is_simulated=is_simulated,
    )


def _residual_table(found: MarkerResiduals, title: str) -> Table:
    rows = tuple(
        (
            found.scans[k],
            str(int(found.ids[k])),
            str(int(found.common_ids[k])),
            *(f"{value:+.4f}" for value in found.residual_mm[k]),
            f"{found.length_mm[k]:.4f}",
            "" if found.is_used[k] else "does not fit or moved, left out",
        )
        for k in np.argsort(-found.length_mm)
    )
    return Table(RESIDUAL_HEADS, rows, title, (7,))


def _residual_chart(found: MarkerResiduals) -> Picture:
    """Lengths of the residuals in order, beside what the covariances let expect."""
    order = np.argsort(found.length_mm)
    length, used = found.length_mm[order], found.is_used[order]
    place = np.arange(1, len(order) + 1)
    expected = float(np.sqrt(np.mean(found.expected_mm**2)))
    with styled():
        figure = new_figure(6.0, 3.2)
        axes = figure.add_subplot()
        axes.plot(place[used], length[used], "o", markersize=3.5, color=ACCENT)
        if not used.all():
            axes.plot(place[~used], length[~used], "o", markersize=4.5, color=ALERT, label="moved")
        axes.axhline(expected, color=MUTED, linewidth=0.9, linestyle="--", label="expected rms")
        if float(length.max(initial=0.0)) > 20.0 * expected:
            axes.set_yscale("log")
        axes.set_xlabel("markers, the best fitting first")
        axes.set_ylabel("residual, mm")
        axes.grid(axis="y")
        axes.legend()
    return Picture(
        chart_markup(figure, "Residuals of the markers in order of size"),
        title="Residuals",
        caption="Dashed: root mean square that the markers' covariances let expect, "
        f"{significant(expected, 'mm')}.",
    )


def drift_chart(names: Sequence[str], sigma_mm: FloatArray, rms_mm: FloatArray) -> Picture:
    """How uncertain each view's place is, in the order in which views were placed."""
    with styled():
        figure = new_figure(6.0, 3.2)
        axes = figure.add_subplot()
        place = np.arange(len(names))
        axes.bar(place, sigma_mm, width=0.6, color=ACCENT, label="uncertainty of its place")
        axes.plot(place, rms_mm, "o", color=ALERT, markersize=4, label="rms of its residuals")
        named_columns(axes, names)
        axes.set_ylabel("mm")
        axes.grid(axis="y")
        axes.legend()
    return Picture(
        chart_markup(figure, "Uncertainty of each view's place"),
        title="How far the chain drifts",
        caption="Standard deviation (three axes together) with which a view's markers lie in the "
        "frame of the first view. It grows along a chain; the residuals do not show it.",
    )


def _marker_view(scene: MarkerScene) -> Picture:
    """Markers in space, residuals drawn much longer than they are."""
    extent = float(np.linalg.norm(np.ptp(scene.points_mm, axis=0)))
    longest = float(np.linalg.norm(scene.residual_mm, axis=1).max(initial=0.0))
    factor = round_below(SHOWN_SHARE * extent / longest) if longest > 0.0 else 1.0
    dots = []
    if scene.clouds:
        step = max(1, -(-sum(map(len, scene.clouds)) // MAX_CLOUD_DOTS))
        shown = np.concatenate([cloud.points_mm[::step] for cloud in scene.clouds])
        dots.append(uniform_dots(shown, CLOUD_GREY))
    lines = []
    for chosen, colour in ((scene.is_used, ACCENT), (~scene.is_used, ALERT)):
        if chosen.any():
            points = scene.points_mm[chosen]
            ends = points + factor * scene.residual_mm[chosen]
            dots.append(uniform_dots(points, colour))
            lines.append(_rings(points, 0.012 * extent, colour))
            pairs = np.stack([points, ends], axis=1).reshape(-1, 3)
            lines.append(SceneLines(pairs, colour))
    if len(scene.lonely_mm):
        dots.append(uniform_dots(scene.lonely_mm, MUTED))
        lines.append(_rings(scene.lonely_mm, 0.008 * extent, MUTED))
    labels = []
    for text, place in scene.stations:
        x, y, z = (float(value) for value in place)
        dots.append(uniform_dots(place[None], PALETTE[2]))
        lines.append(_rings(place[None], 0.008 * extent, PALETTE[2]))
        labels.append((text, (x, y, z)))
    markup = scene_markup(dots, lines, labels, "Markers in space", is_z_up=scene.is_z_up)
    return Picture(
        markup,
        title="Markers in the common frame",
        caption=f"Blue: common markers, with their residuals drawn {factor:g} times as long. "
        "Orange: markers that moved. Grey: markers without partner, and the clouds. Violet: "
        "where the measurements were made from.",
    )


def _rings(centres_mm: FloatArray, radius_mm: float, colour: str) -> SceneLines:
    """Three circles about each centre: a mark that is seen from every side."""
    angle = np.linspace(0.0, 2.0 * np.pi, RING_STEPS + 1)
    circle = radius_mm * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    rings = np.stack([circle, circle[:, [0, 2, 1]], circle[:, [2, 0, 1]]])
    pieces = np.stack([rings[:, :-1], rings[:, 1:]], axis=2).reshape(-1, 3)
    return SceneLines((centres_mm[:, None] + pieces[None]).reshape(-1, 3), colour)
