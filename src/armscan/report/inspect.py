# SPDX-License-Identifier: Apache-2.0
"""The page of an inspection, its figures, texts and numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from numpy.typing import NDArray

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.inspection.results import (
    Deviations,
    MeasuredLength,
    PlaneInspection,
    PointCounts,
    SphereInspection,
    StepInspection,
    histogram,
    within_key,
)
from armscan.models.calibration import Provenance
from armscan.records.cloud import PointCloud
from armscan.report.drawing import ACCENT, ALERT, INK, MUTED, chart_markup, new_figure, styled
from armscan.report.page import (
    Card,
    Facts,
    Gallery,
    Page,
    Picture,
    Section,
    Text,
    footer,
    origin_section,
)
from armscan.report.quantity import Table, sentence, significant, with_sigma
from armscan.report.scene3d import SceneDots, scene_markup

MAX_SHOWN = 20_000
BAND_MM = 0.05
LEAST_HALF_WIDTH_MM = 0.01
RAMP = LinearSegmentedColormap.from_list("deviation", ("#1d4fa5", "#a9b4bd", "#c2331c"))
"""Blue below, grey at zero, red above: a white middle would vanish on the page."""


def deviation_histogram(
    deviations: Deviations,
    *,
    title: str,
    axis_label: str = "deviation, mm",
    band_mm: float = BAND_MM,
    caption: str = "",
) -> Picture:
    """Histogram of deviations with a band and the share of the points within it.

    Parameters
    ----------
    deviations
        What to count.
    title, axis_label
        Texts of the picture and of its horizontal axis.
    band_mm
        Half width of the band that is drawn and whose share is stated, one of
        `armscan.inspection.results.WITHIN_MM`.
    caption
        Put before what the picture says of itself.
    """
    values = deviations.deviations_mm
    half_width = _half_width_mm(values, band_mm)
    counted = histogram(values, half_width)
    share = deviations.value(within_key(band_mm))
    with styled():
        figure = new_figure(6.0, 3.4)
        axes = figure.add_subplot()
        _bars(axes, counted.edges_mm, counted.counts)
        axes.axvspan(-band_mm, band_mm, color=ACCENT, alpha=0.08, linewidth=0)
        for edge in (-band_mm, band_mm):
            axes.axvline(edge, color=MUTED, linewidth=0.9, linestyle="--")
        axes.axvline(0.0, color=INK, linewidth=0.7)
        axes.set_xlim(-half_width, half_width)
        axes.set_xlabel(f"{axis_label}, from the {deviations.reference} reference")
        axes.set_ylabel("points")
        axes.set_title(f"{share:.2f} % of {len(values):,} points within {band_mm:g} mm", loc="left")
    return Picture(
        chart_markup(figure, f"Histogram: {title}"),
        title=title,
        caption=_caption(deviations, caption, counted.n_below + counted.n_above, half_width),
    )


def height_histogram(
    heights_mm: FloatArray, nominal_mm: float, fitted_mm: float, *, title: str
) -> Picture:
    """Histogram of heights over the lower face (figure 5.19) with the nominal height marked."""
    mean, std = float(heights_mm.mean()), float(heights_mm.std(ddof=1))
    half_width = _half_width_mm(heights_mm - mean, 4.0 * std)
    counted = histogram(heights_mm - mean, half_width)
    with styled():
        figure = new_figure(6.0, 3.4)
        axes = figure.add_subplot()
        _bars(axes, counted.edges_mm + mean, counted.counts)
        axes.axvline(nominal_mm, color=ALERT, linewidth=1.3, label=f"nominal {nominal_mm:g} mm")
        axes.axvline(fitted_mm, color=INK, linewidth=1.0, label=f"fitted {fitted_mm:.4f} mm")
        axes.set_xlabel("height over the lower face, mm")
        axes.set_ylabel("points")
        axes.ticklabel_format(axis="x", useOffset=False)
        axes.set_title(f"mean {mean:.4f} mm, standard deviation {std:.4f} mm", loc="left")
        axes.legend(loc="upper right")
    beyond = counted.n_below + counted.n_above
    return Picture(
        chart_markup(figure, f"Histogram: {title}"),
        title=title,
        caption=f"All {len(heights_mm):,} points of the upper face, outliers included; standard "
        "deviation about their mean, divided by n - 1."
        + (f" {beyond:,} points lie beyond the axis." if beyond else ""),
    )


def deviation_view(
    points_mm: FloatArray, deviations_mm: FloatArray, *, title: str, frame: str, reference: str
) -> Picture:
    """Points in space, coloured by deviation: blue inside or below, red outside or above.

    Parameters
    ----------
    points_mm, deviations_mm
        (N, 3) and (N,).
    title
        Of the picture.
    frame
        Name of the coordinate frame.
    reference
        What the deviations are counted from, in words.
    """
    step = max(1, math.ceil(len(points_mm) / MAX_SHOWN))
    shown = deviations_mm[::step]
    limit = max(float(np.percentile(np.abs(deviations_mm), 98)), 1e-6)
    dots = SceneDots(points_mm[::step], _diverging(shown, limit))
    every = f" One point in {step} is shown." if step > 1 else ""
    return Picture(
        _diverging_ramp(limit) + scene_markup([dots], [], [], title, is_z_up=frame != "Sensor"),
        title=f"{title} ({frame} frame)",
        caption=f"Colour is the deviation from {reference}; points beyond the ramp have its end's "
        f"colour. Drag to turn; click, then scroll to zoom.{every}",
    )


def share_text(percent: float) -> str:
    """A share with two decimals that never reads 100 if something is outside."""
    return "above 99.99 %" if 99.995 <= percent < 100.0 else f"{percent:.2f} %"


def _bars(axes: Axes, edges_mm: FloatArray, counts: NDArray[np.int64]) -> None:
    axes.stairs(counts, edges_mm, fill=True, color=ACCENT)
    axes.grid(axis="y")


def _half_width_mm(values: FloatArray, least: float) -> float:
    """Half width that shows 99.5 % of the values, and the band with some room about it."""
    reach = float(np.percentile(np.abs(values), 99.5)) if len(values) else 0.0
    return max(1.15 * reach, 1.5 * least, LEAST_HALF_WIDTH_MM)


def _caption(deviations: Deviations, before: str, beyond: int, half_width_mm: float) -> str:
    parts = [before.rstrip()] if before else []
    parts.append(f"Deviations from {deviations.reference_text}; {deviations.points_text}.")
    if beyond:
        parts.append(
            f"{beyond:,} of them lie beyond {significant(half_width_mm)} mm, outside the picture; "
            "the share counts them."
        )
    return " ".join(parts)


def _diverging(values: FloatArray, limit: float) -> NDArray[np.uint8]:
    share = np.clip(0.5 + 0.5 * values / limit, 0.0, 1.0)
    return np.asarray(RAMP(share, bytes=True), dtype=np.uint8)[:, :3]


def _diverging_ramp(limit: float) -> str:
    stops = ["#{:02x}{:02x}{:02x}".format(*RAMP(k / 10, bytes=True)[:3]) for k in range(11)]
    text = significant(limit, "mm", 2)
    return (
        f'<p class="ramp">−{text}<span style="background: linear-gradient(to right, '
        f'{", ".join(stops)})"></span>+{text}</p>'
    )


def plane_data(found: PlaneInspection) -> dict[str, Any]:
    """A flat face."""
    return {
        "feature": "plane",
        "points": counts_data(found.counts),
        "fitted": {
            "plane": found.plane.coefficients.tolist(),
            **deviations_data(found.fitted),
        },
        "nominal": None
        if found.nominal is None
        else {
            "offset": None if found.offset is None else length_data(found.offset),
            "tilt_mrad": found.tilt_mrad,
            **deviations_data(found.nominal),
        },
    }


def sphere_data(found: SphereInspection) -> dict[str, Any]:
    """A ball."""
    error = found.diameter.value_mm - found.nominal_diameter_mm
    return {
        "feature": "sphere",
        "points": counts_data(found.counts),
        "diameter_error_mm": error,
        "fitted": {
            "diameter": length_data(found.diameter),
            "centre_mm": found.sphere.centre_mm.tolist(),
            "seen_cap_deg": found.seen_cap_deg,
            **deviations_data(found.fitted),
        },
        "nominal": {
            "diameter_mm": found.nominal_diameter_mm,
            **deviations_data(found.nominal),
        },
    }


def step_data(found: StepInspection) -> dict[str, Any]:
    """A step."""
    error = found.height.value_mm - found.nominal_height_mm
    mean, std = float(found.heights_mm.mean()), float(found.heights_mm.std(ddof=1))
    return {
        "feature": "step",
        "points": counts_data(found.counts),
        "height_error_mm": error,
        "fitted": {
            "height": length_data(found.height),
            "normal": found.normal.tolist(),
            "normal_from": found.normal_rule,
            **deviations_data(found.fitted),
        },
        "nominal": {
            "height_mm": found.nominal_height_mm,
            "mean_height_mm": mean,
            "std_height_mm": std,
            **deviations_data(found.nominal),
        },
    }


def length_data(length: MeasuredLength) -> dict[str, Any]:
    """A length for programs."""
    return {
        "value_mm": length.value_mm,
        "sigma_mm": length.sigma_mm,
        "sigma_scatter_mm": length.sigma_scatter_mm,
        "sigma_propagated_mm": length.sigma_propagated_mm,
    }


def deviations_data(deviations: Deviations) -> dict[str, Any]:
    """Deviations' statistics for programs, with their definitions."""
    return {
        "reference": deviations.reference,
        "counted_from": deviations.reference_text,
        "points": deviations.points_text,
        **{item.key: item.value for item in deviations.statistics},
        "definitions": {item.key: item.definition for item in deviations.statistics},
    }


def counts_data(counts: PointCounts) -> dict[str, Any]:
    """Counts for programs."""
    return {
        "n_given": counts.n_given,
        "n_region": counts.n_region,
        "n_feature": counts.n_feature,
        "n_fitted": counts.n_fitted,
        "n_outliers": counts.n_outliers,
        "feature_rule": counts.feature_rule,
        "fit_rule": counts.fit_rule,
    }


LEAST_MM = 5e-5
"""Smaller lengths, as the mean of what was fitted, are shown as zero."""
STATEMENT = (
    "Nominal means: known before the measurement. Fitted means: made from these points "
    "themselves, so it cannot show an error of size or place. Every statistic is over all points "
    "of the feature; points that a fit left out are counted. Forms are computed as ISO 10360-8 "
    "defines them; this is not an accredited test."
)


@dataclass(frozen=True, slots=True, eq=False)
class InspectionReport:
    """One inspection, ready for a page, a terminal and a program.

    Parameters
    ----------
    title, subtitle
        What was inspected.
    cards
        Key figures.
    facts
        The same for a terminal.
    references
        Deviations with a heading for each, nominal first.
    histograms, views
        Pictures.
    counts
        What became of the points.
    geometry
        The fitted feature, as (label, value).
    warnings
        Sentences that a person should read first.
    data
        All of it for programs.
    """

    title: str
    subtitle: str
    cards: tuple[Card, ...]
    facts: tuple[tuple[str, str], ...]
    references: tuple[tuple[str, Deviations], ...]
    histograms: tuple[Picture, ...]
    views: tuple[Picture, ...]
    counts: PointCounts
    geometry: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]
    data: Mapping[str, Any]

    @property
    def brief_tables(self) -> tuple[Table, ...]:
        """The statistics side by side, for a terminal."""
        names = [item.label for item in self.references[0][1].statistics]
        rows = tuple(
            (name, *(_value(deviations, k) for _, deviations in self.references))
            for k, name in enumerate(names)
        )
        heads = tuple(f"{deviations.reference} reference" for _, deviations in self.references)
        return (Table(("statistic", *heads), rows),)


def inspection_page(
    report: InspectionReport,
    provenance: Provenance,
    *,
    is_simulated: bool = False,
    first: tuple[Section, ...] = (),
) -> Page:
    """Lay out the page; ``first`` stands before its own sections."""
    statistics = tuple(
        block
        for heading, deviations in report.references
        for block in (
            Text(
                f"{sentence(heading)} Deviations are counted from {deviations.reference_text}; "
                f"{deviations.points_text}."
            ),
            definitions_table(deviations),
        )
    )
    return Page(
        title=report.title,
        subtitle=report.subtitle,
        cards=report.cards,
        warnings=tuple(sentence(warning) for warning in report.warnings),
        sections=(
            *first,
            Section("Deviations", (Gallery(report.histograms, 420),)),
            Section("In space", (Gallery(report.views, 560),)),
            Section("Statistics", (Text(STATEMENT), *statistics)),
            Section("Which points", (counts_table(report.counts),)),
            Section("The fitted feature", (Facts(report.geometry),)),
            origin_section(provenance),
        ),
        is_simulated=is_simulated,
        footer=footer(provenance),
        forced=provenance.forced,
    )


def definitions_table(deviations: Deviations) -> Table:
    """Statistics of one reference, each with its definition."""
    rows = tuple(
        (item.label, _value(deviations, k), item.formula)
        for k, item in enumerate(deviations.statistics)
    )
    return Table((f"{deviations.reference} reference", "value", "definition"), rows, "", (2,))


def counts_table(counts: PointCounts) -> Table:
    """What became of the points, with the rules."""
    return Table(
        ("points", "count", "rule"),
        (
            ("given", f"{counts.n_given:,}", "all points of the cloud"),
            ("in the region", f"{counts.n_region:,}", "inside --region; all without it"),
            ("of the feature", f"{counts.n_feature:,}", counts.feature_rule),
            ("used by the fit", f"{counts.n_fitted:,}", counts.fit_rule),
            ("left out by the fit", f"{counts.n_outliers:,}", "of the feature, minus used"),
        ),
        "",
        (2,),
    )


def _value(deviations: Deviations, k: int) -> str:
    item = deviations.statistics[k]
    if item.unit == "%":
        return share_text(item.value)
    if item.unit == "mm" and abs(item.value) < LEAST_MM:
        return "0.0000 mm"
    return significant(item.value, item.unit)


NO_SIGMA = (
    "the cloud carries no standard deviations and no exposures, so it is not known how well the "
    "fit is determined"
)
STILL_SIGMA = (
    "Sigma of the height",
    "not known from one exposure: its error is the calibration's, which shifts both faces nearly "
    "alike",
)
NARROW_CAP_DEG = 60.0
MANY_OUTLIERS = 0.01
FOREIGN_FRAME = "a frame that the file does not name"


def plane_report(found: PlaneInspection, cloud: PointCloud) -> InspectionReport:
    """Report of a flat face."""
    main = found.nominal or found.fitted
    references = [("against the fitted plane", found.fitted)]
    histograms = [
        deviation_histogram(
            found.fitted, title="Distance to the fitted plane", axis_label="distance, mm"
        )
    ]
    geometry = [
        ("Plane A, B, C, D", _coefficients(found.plane.coefficients)),
        ("Middle of the points", f"{_triple(found.plane.point_mm)} mm"),
    ]
    facts = list(_count_facts(found.counts))
    cards = [_share_card(main), _form_card(found.fitted)]
    if found.nominal is not None and found.offset is not None:
        references.insert(0, ("against the nominal plane", found.nominal))
        histograms.insert(
            0,
            deviation_histogram(
                found.nominal, title="Distance to the nominal plane", axis_label="distance, mm"
            ),
        )
        offset = length_text(found.offset)
        facts.append(("offset", f"{offset} over the nominal plane, at the middle of the points"))
        facts.append(("tilt", f"{significant(found.tilt_mrad)} mrad to the nominal plane"))
        cards.append(Card("Offset", offset, "of the fitted plane over the nominal one"))
        geometry += facts[-2:]
    cards.append(_points_card(found.counts))
    return InspectionReport(
        title="Plane inspected",
        subtitle=_subtitle(found.counts, cloud),
        cards=tuple(cards),
        facts=tuple(facts),
        references=tuple(references),
        histograms=tuple(histograms),
        views=(_view(cloud, found.rows, main),),
        counts=found.counts,
        geometry=tuple(geometry),
        warnings=_warnings(found.counts, cloud),
        data=plane_data(found),
    )


def sphere_report(found: SphereInspection, cloud: PointCloud) -> InspectionReport:
    """Report of a ball."""
    error = found.diameter.value_mm - found.nominal_diameter_mm
    diameter = length_text(found.diameter)
    geometry = (
        ("Fitted diameter", diameter),
        ("Nominal diameter", f"{found.nominal_diameter_mm:g} mm"),
        ("Fitted minus nominal", f"{error:+.4f} mm"),
        ("Centre", f"{_triple(found.sphere.centre_mm)} mm"),
        ("Seen cap", f"half opening {found.seen_cap_deg:.0f} degrees; the whole ball is 180"),
        *_sigma_facts(found.diameter, "diameter"),
    )
    warnings = list(_warnings(found.counts, cloud))
    if found.seen_cap_deg < NARROW_CAP_DEG:
        warnings.append(
            f"the points cover a cap of only {found.seen_cap_deg:.0f} degrees half opening, where "
            "centre and diameter are poorly told apart; scan more of the ball"
        )
    return InspectionReport(
        title="Ball inspected",
        subtitle=_subtitle(found.counts, cloud),
        cards=(
            Card("Fitted diameter", diameter, f"nominal {found.nominal_diameter_mm:g} mm"),
            Card("Fitted minus nominal", f"{error:+.4f} mm"),
            _share_card(found.nominal),
            _form_card(found.fitted),
            _points_card(found.counts),
        ),
        facts=(*_count_facts(found.counts), *geometry[:3]),
        references=(
            ("against the standard ball", found.nominal),
            ("against the fitted ball", found.fitted),
        ),
        histograms=(
            deviation_histogram(
                found.nominal,
                title="Distance to the centre minus the standard ball's radius",
                axis_label="difference, mm",
            ),
            deviation_histogram(
                found.fitted,
                title="Distance to the centre minus the fitted radius",
                axis_label="difference, mm",
            ),
        ),
        views=(_view(cloud, found.rows, found.nominal),),
        counts=found.counts,
        geometry=geometry,
        warnings=tuple(warnings),
        data=sphere_data(found),
    )


def step_report(found: StepInspection, cloud: PointCloud) -> InspectionReport:
    """Report of a step."""
    error = found.height.value_mm - found.nominal_height_mm
    is_still = len(np.unique(cloud.exposure[np.concatenate([found.lower, found.upper])])) == 1
    height = f"{found.height.value_mm:.4f} mm" if is_still else length_text(found.height)
    mean, std = float(found.heights_mm.mean()), float(found.heights_mm.std(ddof=1))
    geometry = (
        ("Fitted height", height),
        ("Nominal height", f"{found.nominal_height_mm:g} mm"),
        ("Fitted minus nominal", f"{error:+.4f} mm"),
        ("Heights of the points", f"mean {mean:.4f} mm, standard deviation {std:.4f} mm"),
        ("Normal", f"{_triple(found.normal, 6)}: {found.normal_rule}"),
        ("Points", f"{len(found.lower):,} on the lower face, {len(found.upper):,} on the upper"),
        *((STILL_SIGMA,) if is_still else _sigma_facts(found.height, "height")),
    )
    both = np.concatenate([found.lower, found.upper])
    return InspectionReport(
        title="Step inspected",
        subtitle=_subtitle(found.counts, cloud),
        cards=(
            Card("Fitted height", height, f"nominal {found.nominal_height_mm:g} mm"),
            Card("Fitted minus nominal", f"{error:+.4f} mm"),
            Card(
                "Standard deviation", f"{std:.4f} mm", "of the heights of the upper face's points"
            ),
            _points_card(found.counts),
        ),
        facts=(*_count_facts(found.counts), *geometry[:4]),
        references=(
            ("heights of the upper face against the nominal height", found.nominal),
            ("both faces against their fitted planes", found.fitted),
        ),
        histograms=(
            height_histogram(
                found.heights_mm,
                found.nominal_height_mm,
                found.height.value_mm,
                title="Heights of the upper face's points",
            ),
            deviation_histogram(
                found.fitted,
                title="Distance of both faces' points from their fitted planes",
                axis_label="distance, mm",
            ),
        ),
        views=(
            deviation_view(
                cloud.points_mm[both],
                found.fitted.deviations_mm,
                title="Both faces without their margins",
                frame=cloud.frame,
                reference=found.fitted.reference_text,
            ),
        ),
        counts=found.counts,
        geometry=geometry,
        warnings=_warnings(found.counts, cloud),
        data=step_data(found),
    )


def length_text(length: MeasuredLength) -> str:
    """A length with its standard deviation."""
    if math.isnan(length.sigma_mm):
        return f"{length.value_mm:.4f} mm"
    return with_sigma(length.value_mm, length.sigma_mm, "mm")


def _sigma_facts(length: MeasuredLength, name: str) -> tuple[tuple[str, str], ...]:
    return (
        (
            f"Sigma of the {name} from scatter",
            f"{significant(length.sigma_scatter_mm, 'mm')}: from what exposures, and blocks of "
            "neighbouring ones, disagree about (jackknife)",
        ),
        (
            f"Sigma of the {name} propagated",
            f"{significant(length.sigma_propagated_mm, 'mm')}: from the points' covariances, "
            "errors being common to an exposure, or to a block of neighbours: the larger",
        ),
        (
            "Not in either",
            "what a wrong calibration does alike to all exposures: `armscan verify` tests it",
        ),
    )


def _share_card(deviations: Deviations) -> Card:
    share = deviations.value(within_key(BAND_MM))
    return Card(
        f"Within {BAND_MM:g} mm", share_text(share), f"of the {deviations.reference} surface"
    )


def _form_card(fitted: Deviations) -> Card:
    note = f"95 % of the points; standard deviation {significant(fitted.value('std_mm'))} mm"
    return Card("Form, narrowest shell", significant(fitted.value("d95_mm"), "mm"), note)


def _points_card(counts: PointCounts) -> Card:
    return Card(
        "Points",
        f"{counts.n_feature:,}",
        f"of {counts.n_given:,} given; the fit left out {counts.n_outliers:,}",
    )


def _count_facts(counts: PointCounts) -> tuple[tuple[str, str], ...]:
    return (
        (
            "points",
            f"{counts.n_feature} of {counts.n_given} belong to the feature ({counts.feature_rule})",
        ),
        ("outliers", f"{counts.n_outliers} left out by the fit, counted by the statistics"),
    )


def _subtitle(counts: PointCounts, cloud: PointCloud) -> str:
    has_frame = bool(cloud.sheet_names[0]) if cloud.sheet_names else False
    frame = f"the {cloud.frame} frame" if has_frame else FOREIGN_FRAME
    return f"{counts.n_feature:,} points in {frame}"


def _warnings(counts: PointCounts, cloud: PointCloud) -> tuple[str, ...]:
    found = []
    if not cloud.covariance_mm2.any():
        found.append(NO_SIGMA)
    if counts.n_outliers > MANY_OUTLIERS * counts.n_feature:
        share = 100.0 * counts.n_outliers / counts.n_feature
        found.append(f"{share:.1f} % of the feature's points are outliers: see the pictures")
    return tuple(found)


def _view(cloud: PointCloud, rows: IntArray, deviations: Deviations) -> Picture:
    return deviation_view(
        cloud.points_mm[rows],
        deviations.deviations_mm,
        title="The feature's points",
        frame=cloud.frame,
        reference=deviations.reference_text,
    )


def _coefficients(values: FloatArray) -> str:
    a, b, c, d = (float(value) for value in values)
    return f"{a:.7f}, {b:.7f}, {c:.7f}, {d:.4f} mm"


def _triple(values: FloatArray, digits: int = 4) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)
