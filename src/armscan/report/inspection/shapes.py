# SPDX-License-Identifier: Apache-2.0
"""The page of an inspection, and its numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.inspection.conformity import COVERAGE
from armscan.inspection.doubts import (
    face_warnings,
    lean_warnings,
    outlier_warnings,
    shape_warnings,
    sigma_warnings,
)
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
from armscan.report.charts import deviation_view
from armscan.report.drawing import (
    ACCENT,
    ALERT,
    INK,
    MUTED,
    chart_markup,
    new_figure,
    styled,
)
from armscan.report.page import Facts, Gallery, Page, Picture, Section, Text, page_of
from armscan.report.quantity import (
    Quantity,
    Table,
    fact,
    for_people,
    only,
    sentence,
    share_text,
    signed_mm,
    significant,
    triple,
    with_sigma,
)

LEAST_MM = 5e-5
"""Smaller lengths, as the mean of what was fitted, are shown as zero."""
STATEMENT = (
    "Nominal means: known before the measurement. Fitted means: made from these points "
    "themselves, so it cannot show an error of size or place. Every statistic is over all points "
    "of the feature; points that a fit left out are counted. Forms are computed as ISO 10360-8 "
    "defines them; this is not an accredited test."
)
NO_SHEETS = (
    "the cloud does not tell which points lie in one (fused, XYZ, STL or foreign): one may be "
    "taken for a face"
)
MUCH_BEYOND = 0.05
"""Part of the points on a fitted plane that may lie too far from the nominal one to count."""
SCATTER_IN_PROPAGATED = (
    "though the other is larger: a jackknife counts as new in each block what blocks share, and is "
    "the largest of three; what exposures disagree about has weighed in this one"
)
STILL_SIGMA = fact(
    "Sigma of the height",
    "not known from one exposure: its error is the calibration's, which shifts both faces nearly "
    "alike",
)
SHEET_SIGMA = fact(
    "Sigma of the height",
    "not known from one light sheet: how far it leans on the faces none of its exposures tells",
)
NARROW_CAP_DEG = 60.0
UNNAMED = "Part"
AS_NAMED = ", as it is called where a file names none"
BAND_MM = 0.05
LEAST_HALF_WIDTH_MM = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class InspectionReport:
    """One inspection, ready for a page, a terminal and a program.

    ``references`` are deviations with a heading for each, nominal first; ``counts`` is what became
    of the points.
    """

    title: str
    subtitle: str
    quantities: tuple[Quantity, ...]
    cards: tuple[Quantity, ...]
    references: tuple[tuple[str, Deviations], ...]
    histograms: tuple[Picture, ...]
    views: tuple[Picture, ...]
    counts: PointCounts
    warnings: tuple[str, ...]

    @property
    def brief_table(self) -> Table:
        """The statistics side by side, for a terminal."""
        names = [item.label for item in self.references[0][1].statistics]
        rows = tuple(
            (name, *(_value(deviations, k) for _, deviations in self.references))
            for k, name in enumerate(names)
        )
        heads = [f"{deviations.reference} reference" for _, deviations in self.references]
        if len(set(heads)) < len(heads):
            heads = [heading for heading, _ in self.references]
        return Table(("statistic", *heads), rows)


def plane_report(found: PlaneInspection, cloud: PointCloud) -> InspectionReport:
    """Report of a flat face."""
    main = found.nominal or found.fitted
    a, b, c, d = found.plane.coefficients.tolist()
    references = [("against the fitted plane", found.fitted)]
    told = [
        Quantity("feature", "", "plane"),
        *count_quantities(found.counts),
        Quantity(
            "fitted.plane",
            "Plane A, B, C, D",
            [a, b, c, d],
            shown=f"{triple((a, b, c), 7)}, {d:.4f} mm",
        ),
        fact("Middle of the points", f"{triple(found.plane.point_mm)} mm"),
        fact("Positive", found.side_text),
        *_sheet_facts(cloud),
        *deviation_quantities("fitted", found.fitted),
    ]
    if found.nominal is None or found.offset is None:
        told.append(Quantity("nominal", "", None))
    else:
        references.insert(0, ("against the nominal plane", found.nominal))
        where = "of the fitted plane over the nominal one, at the middle of the points"
        where += _own_text(found.reference_sigma_mm)
        told += [
            *length_quantities("nominal.offset", "Offset", found.offset, where),
            Quantity("nominal.offset_sigma_plate_mm", "", found.reference_sigma_mm),
            Quantity(
                "nominal.tilt_mrad",
                "Tilt",
                found.tilt_mrad,
                unit="mrad",
                meaning="to the nominal plane",
            ),
            *deviation_quantities("nominal", found.nominal),
        ]
    return InspectionReport(
        title="Plane inspected",
        subtitle=point_subtitle(found.counts, cloud),
        quantities=tuple(told),
        cards=(
            share_card(main),
            form_card(found.fitted),
            *only(told, "nominal.offset", "points.n_feature"),
        ),
        references=tuple(references),
        histograms=tuple(
            deviation_histogram(
                deviations,
                title=f"Distance to the {deviations.reference} plane",
                axis_label="distance, mm",
            )
            for _, deviations in references
        ),
        views=(feature_view(cloud, found.rows, main),),
        counts=found.counts,
        warnings=(*point_warnings(found.counts, cloud), *_beyond_warnings(found)),
    )


def _own_text(sigma_mm: float) -> str:
    """How far the sigma of an offset holds what the nominal plane errs itself."""
    if math.isnan(sigma_mm):
        return "; without the plate's own uncertainty"
    return f"; ± holds {significant(sigma_mm, 'mm', 2)} of the plate itself" if sigma_mm else ""


def _sheet_facts(cloud: PointCloud) -> tuple[Quantity, ...]:
    """Of a search for faces in a cloud that does not tell its sheets."""
    if any(cloud.sheet_names) and not cloud.is_fused:
        return ()
    return (fact("Light sheets", NO_SHEETS),)


def _beyond_warnings(found: PlaneInspection) -> tuple[str, ...]:
    """Warn of a face that goes on where it is too far from the nominal plane to count."""
    share = found.n_beyond / max(found.counts.n_feature + found.n_beyond, 1)
    if share <= MUCH_BEYOND:
        return ()
    return (
        f"{found.n_beyond:,} points ({100.0 * share:.0f} %) lie on the fitted plane too, but too "
        "far from the nominal one to count: what is told is of a strip of the face; see whether "
        "the nominal plane is the right one, or widen --feature-mm",
    )


def sphere_report(found: SphereInspection, cloud: PointCloud) -> InspectionReport:
    """Report of a ball."""
    nominal_mm = found.nominal_diameter_mm
    error = found.diameter.value_mm - nominal_mm
    told = (
        Quantity("feature", "", "sphere"),
        *count_quantities(found.counts),
        *length_quantities(
            "fitted.diameter", "Fitted diameter", found.diameter, f"nominal {nominal_mm:g} mm"
        ),
        Quantity("nominal.diameter_mm", "", nominal_mm),
        Quantity("diameter_error_mm", "Fitted minus nominal", error, shown=signed_mm(error)),
        place_quantity("fitted.centre_mm", "Centre", found.sphere.centre_mm, found.centre_sigma_mm),
        Quantity("fitted.centre_u_mm", "", COVERAGE * found.centre_sigma_mm),
        Quantity(
            "other_balls",
            "",
            [
                {"diameter_mm": 2.0 * one.radius_mm, "centre_mm": one.centre_mm.tolist()}
                for one in found.others
            ],
        ),
        Quantity(
            "fitted.seen_cap_deg",
            "Seen cap",
            found.seen_cap_deg,
            shown=f"half opening {found.seen_cap_deg:.0f} degrees; the whole ball is 180",
        ),
        fact("Positive", "outside the ball, farther from its centre"),
        *sigma_facts(found.diameter, "diameter"),
        *deviation_quantities("fitted", found.fitted),
        *deviation_quantities("nominal", found.nominal),
    )
    return InspectionReport(
        title="Ball inspected",
        subtitle=point_subtitle(found.counts, cloud),
        quantities=told,
        cards=(
            *only(told, "fitted.diameter", "diameter_error_mm"),
            share_card(found.nominal),
            form_card(found.fitted),
            *only(told, "points.n_feature"),
        ),
        references=(
            ("against the standard ball", found.nominal),
            ("against the fitted ball", found.fitted),
        ),
        histograms=tuple(
            deviation_histogram(
                deviations,
                title=f"Distance to the centre minus {radius}",
                axis_label="difference, mm",
            )
            for deviations, radius in (
                (found.nominal, "the standard ball's radius"),
                (found.fitted, "the fitted radius"),
            )
        ),
        views=(feature_view(cloud, found.rows, found.nominal),),
        counts=found.counts,
        warnings=(
            *point_warnings(found.counts, cloud),
            *shape_warnings(found, cloud, "ball"),
            *_ball_warnings(found),
        ),
    )


def _ball_warnings(found: SphereInspection) -> tuple[str, ...]:
    """Warn of a small cap, and of other balls of that diameter."""
    told = []
    if found.seen_cap_deg < NARROW_CAP_DEG:
        told.append(
            f"the points cover a cap of only {found.seen_cap_deg:.0f} degrees half opening, where "
            "centre and diameter are poorly told apart; scan more of the ball"
        )
    others = [
        f"another ball, of {2.0 * one.radius_mm:.4g} mm, is centred at {triple(one.centre_mm)} mm"
        for one in found.others
    ]
    if others:
        told.append(
            f"{', '.join(others)}; measured was the one on which most points lie: show which is "
            "meant with --region"
        )
    return tuple(told)


def _step_quantities(found: StepInspection, cloud: PointCloud) -> tuple[Quantity, ...]:
    """What is told of a step."""
    nominal_mm = found.nominal_height_mm
    error = found.height.value_mm - nominal_mm
    both = np.concatenate([found.lower, found.upper])
    is_still = not _sheet_facts(cloud) and len(np.unique(cloud.exposure[both])) == 1
    known = sigma_facts(found.height, "height")
    if is_still or found.is_lean_assumed:
        known = (STILL_SIGMA if is_still else SHEET_SIGMA,)
    mean, std = float(found.heights_mm.mean()), float(found.heights_mm.std(ddof=1))
    return (
        Quantity("feature", "", "step"),
        *count_quantities(found.counts),
        *length_quantities(
            "fitted.height",
            "Fitted height",
            found.height,
            f"nominal {nominal_mm:g} mm",
            f"{found.height.value_mm:.4f} mm" if is_still else "",
        ),
        Quantity("nominal.height_mm", "", nominal_mm),
        Quantity("height_error_mm", "Fitted minus nominal", error, shown=signed_mm(error)),
        Quantity(
            "nominal.mean_height_mm",
            "Heights of the points",
            mean,
            shown=f"mean {mean:.4f} mm, standard deviation {std:.4f} mm",
        ),
        Quantity("nominal.std_height_mm", "", std),
        Quantity(
            "fitted.normal",
            "Normal",
            found.normal.tolist(),
            shown=f"{triple(found.normal, 6)}: {found.normal_rule}",
        ),
        Quantity("fitted.normal_from", "", found.normal_rule),
        fact(
            "On each face",
            f"{len(found.lower):,} points on the lower face, {len(found.upper):,} on the upper",
        ),
        *_sheet_facts(cloud),
        *known,
        *deviation_quantities("fitted", found.fitted),
        *deviation_quantities("nominal", found.nominal),
    )


def step_report(found: StepInspection, cloud: PointCloud) -> InspectionReport:
    """Report of a step."""
    both = np.concatenate([found.lower, found.upper])
    told = _step_quantities(found, cloud)
    std = float(found.heights_mm.std(ddof=1))
    spread = "of the heights of the upper face's points"
    return InspectionReport(
        title="Step inspected",
        subtitle=point_subtitle(found.counts, cloud),
        quantities=told,
        cards=(
            *only(told, "fitted.height", "height_error_mm"),
            fact("Standard deviation", f"{std:.4f} mm", spread),
            *only(told, "points.n_feature"),
        ),
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
        warnings=(
            *point_warnings(found.counts, cloud),
            *lean_warnings(found),
            *face_warnings(found, cloud),
        ),
    )


def length_quantities(
    key: str, label: str, length: MeasuredLength, meaning: str, shown: str = ""
) -> tuple[Quantity, Quantity]:
    """A length with its standard deviation, and its expanded uncertainty."""
    data = {
        "value_mm": length.value_mm,
        "sigma_mm": length.sigma_mm,
        "sigma_scatter_mm": length.sigma_scatter_mm,
        "sigma_propagated_mm": length.sigma_propagated_mm,
    }
    if not shown and math.isnan(length.sigma_mm):
        shown = f"{length.value_mm:.4f} mm"
    shown = shown or with_sigma(length.value_mm, length.sigma_mm, "mm")
    name = label.removeprefix("Fitted ").lower()
    return (
        Quantity(key, label, data, meaning=meaning, shown=shown),
        expanded(f"{key}_u_mm", name, length.sigma_mm, "mm"),
    )


def expanded(key: str, name: str, sigma: float, unit: str) -> Quantity:
    """The expanded uncertainty of what has a standard deviation; NaN where that is not known."""
    u = COVERAGE * sigma
    meaning = "" if math.isnan(u) else "twice what stands after ±: 95 % of normal errors are less"
    label = f"U (k = {COVERAGE:g}) of the {name}"
    return Quantity(key, label, u, meaning=meaning, shown=significant(u, unit, 2))


def place_quantity(key: str, label: str, point: FloatArray, sigma_mm: float) -> Quantity:
    """A point (3,) with its expanded uncertainty along the worst way, where that is known."""
    u = significant(COVERAGE * sigma_mm, "mm", 2)
    known = "" if math.isnan(sigma_mm) else f", U (k = {COVERAGE:g}) {u} along the worst way"
    return Quantity(key, label, point.tolist(), shown=f"{triple(point)} mm{known}")


def sigma_facts(length: MeasuredLength, name: str) -> tuple[Quantity, ...]:
    """Where the standard deviation of a length comes from; nothing of one that is not known."""
    if math.isnan(length.sigma_mm):
        return ()
    origin, why = "from scatter", ""
    if math.isfinite(length.sigma_propagated_mm):
        larger = length.sigma_scatter_mm > length.sigma_propagated_mm
        origin, why = "propagated", SCATTER_IN_PROPAGATED if larger else ""
    return (
        fact(
            f"Sigma of the {name} from scatter",
            f"{significant(length.sigma_scatter_mm, 'mm')}: from what exposures, and blocks of "
            "neighbouring ones, disagree about (jackknife)",
        ),
        fact(
            f"Sigma of the {name} propagated",
            f"{significant(length.sigma_propagated_mm, 'mm')}: from the points' covariances, "
            "common to exposures as far as what these disagree about tells",
        ),
        fact("Shown after ±", f"the sigma {origin}", why),
        fact(
            "Not in either",
            "what a calibration errs more than it says: `armscan verify` tests it",
        ),
    )


def deviation_quantities(place: str, deviations: Deviations) -> tuple[Quantity, ...]:
    """Statistics with their definitions, for programs; the tables show them to people."""
    data: dict[str, Any] = {
        "reference": deviations.reference,
        "counted_from": deviations.reference_text,
        "points": deviations.points_text,
        **{item.key: item.value for item in deviations.statistics},
        "definitions": {item.key: item.definition for item in deviations.statistics},
    }
    return tuple(Quantity(f"{place}.{key}", "", value) for key, value in data.items())


def count_quantities(counts: PointCounts) -> tuple[Quantity, ...]:
    """What became of the points."""
    return (
        Quantity("points.n_given", "", counts.n_given),
        Quantity("points.n_region", "", counts.n_region),
        Quantity(
            "points.n_feature",
            "Points",
            counts.n_feature,
            meaning=f"of {counts.n_given:,} given; the fit left out {counts.n_outliers:,}, which "
            "the statistics count",
        ),
        Quantity("points.n_fitted", "", counts.n_fitted),
        Quantity("points.n_outliers", "", counts.n_outliers),
        Quantity("points.feature_rule", "Of the feature", counts.feature_rule),
        Quantity("points.fit_rule", "", counts.fit_rule),
    )


def share_card(deviations: Deviations) -> Quantity:
    """Share of the points within the band."""
    share = share_text(deviations.value(within_key(BAND_MM)))
    return fact(f"Within {BAND_MM:g} mm", share, f"of the {deviations.reference} surface")


def form_card(fitted: Deviations) -> Quantity:
    """Form as 95 % of the points show it."""
    note = f"95 % of the points; standard deviation {significant(fitted.value('std_mm'))} mm"
    return fact("Form, narrowest shell", significant(fitted.value("d95_mm"), "mm"), note)


def point_subtitle(counts: PointCounts, cloud: PointCloud) -> str:
    """How many points, and in which frame."""
    is_named = cloud.frame != UNNAMED or any(cloud.sheet_names)
    return f"{counts.n_feature:,} points in the {cloud.frame} frame{'' if is_named else AS_NAMED}"


def point_warnings(
    counts: PointCounts, cloud: PointCloud, whose: str = "feature"
) -> tuple[str, ...]:
    """What is weak about the points of a feature."""
    return (*sigma_warnings(cloud), *outlier_warnings(counts, whose))


def inspection_page(
    report: InspectionReport,
    provenance: Provenance,
    *,
    is_simulated: bool = False,
    first: Sequence[Section] = (),
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
            _definitions_table(deviations),
        )
    )
    return page_of(
        provenance,
        report.title,
        report.subtitle,
        (
            *first,
            Section("Deviations", (Gallery(report.histograms),)),
            Section("In space", (Gallery(report.views, 560),)),
            Section("Statistics", (Text(STATEMENT), *statistics)),
            Section("Which points", (_counts_table(report.counts),)),
            Section("The fitted feature", (Facts(for_people(report.quantities)),)),
        ),
        cards=report.cards,
        warnings=report.warnings,
        is_simulated=is_simulated,
    )


def _definitions_table(deviations: Deviations) -> Table:
    """Statistics of one reference, each with its definition."""
    rows = tuple(
        (item.label, _value(deviations, k), item.formula)
        for k, item in enumerate(deviations.statistics)
    )
    return Table((f"{deviations.reference} reference", "value", "definition"), rows, "", (2,))


def _counts_table(counts: PointCounts) -> Table:
    """What became of the points, with the rules."""
    rows = (
        ("given", f"{counts.n_given:,}", "all points of the cloud"),
        ("in the region", f"{counts.n_region:,}", "inside --region; all without it"),
        ("of the feature", f"{counts.n_feature:,}", counts.feature_rule),
        ("used by the fit", f"{counts.n_fitted:,}", counts.fit_rule),
        ("left out by the fit", f"{counts.n_outliers:,}", "of the feature, minus used"),
    )
    return Table(("points", "count", "rule"), rows, "", (2,))


def _value(deviations: Deviations, k: int) -> str:
    item = deviations.statistics[k]
    if item.unit == "%":
        return share_text(item.value)
    if item.unit == "mm" and abs(item.value) < LEAST_MM:
        return "0.0000 mm"
    return significant(item.value, item.unit)


def deviation_histogram(
    deviations: Deviations,
    *,
    title: str,
    axis_label: str = "deviation, mm",
) -> Picture:
    """Histogram of deviations with a band and the share of the points within it.

    As the thesis's figures 5.12 and 5.14.
    """
    values = deviations.deviations_mm
    half_width = _half_width_mm(values, BAND_MM)
    counted = histogram(values, half_width)
    share = deviations.value(within_key(BAND_MM))
    with styled():
        figure = new_figure(6.0, 3.4)
        axes = figure.add_subplot()
        axes.stairs(counted.counts, counted.edges_mm, fill=True, color=ACCENT)
        axes.axvspan(-BAND_MM, BAND_MM, color=ACCENT, alpha=0.08, linewidth=0)
        for edge in (-BAND_MM, BAND_MM):
            axes.axvline(edge, color=MUTED, linewidth=0.9, linestyle="--")
        axes.axvline(0.0, color=INK, linewidth=0.7)
        axes.set_xlim(-half_width, half_width)
        axes.set_xlabel(f"{axis_label}, from the {deviations.reference} reference")
        axes.set_ylabel("points")
        axes.grid(axis="y")
        told = f"{share_text(share)} of {len(values):,} points within {BAND_MM:g} mm"
        axes.set_title(told, loc="left")
    parts = [f"Deviations from {deviations.reference_text}; {deviations.points_text}."]
    if beyond := counted.n_below + counted.n_above:
        parts.append(
            f"{beyond:,} of them lie beyond {significant(half_width)} mm, outside the picture; "
            "the share counts them."
        )
    return Picture(chart_markup(figure, f"Histogram: {title}"), " ".join(parts), title)


def height_histogram(
    heights_mm: FloatArray, nominal_mm: float, fitted_mm: float, *, title: str
) -> Picture:
    """Histogram of heights over the lower face (figure 5.19) with the nominal height marked."""
    mean, std = float(heights_mm.mean()), float(heights_mm.std(ddof=1))
    counted = histogram(heights_mm - mean, _half_width_mm(heights_mm - mean, 4.0 * std))
    with styled():
        figure = new_figure(6.0, 3.4)
        axes = figure.add_subplot()
        axes.stairs(counted.counts, counted.edges_mm + mean, fill=True, color=ACCENT)
        axes.axvline(nominal_mm, color=ALERT, linewidth=1.3, label=f"nominal {nominal_mm:g} mm")
        axes.axvline(fitted_mm, color=INK, linewidth=1.0, label=f"fitted {fitted_mm:.4f} mm")
        axes.set_xlabel("height over the lower face, mm")
        axes.set_ylabel("points")
        axes.grid(axis="y")
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


def _half_width_mm(values: FloatArray, least: float) -> float:
    """Half width that shows 99.5 % of the values, and the band with some room about it."""
    reach = float(np.percentile(np.abs(values), 99.5)) if len(values) else 0.0
    return max(1.15 * reach, 1.5 * least, LEAST_HALF_WIDTH_MM)


def feature_view(cloud: PointCloud, rows: IntArray, deviations: Deviations) -> Picture:
    """The feature's points (rows (N,) of a cloud) coloured by deviation."""
    return deviation_view(
        cloud.points_mm[rows],
        deviations.deviations_mm,
        title="The feature's points",
        frame=cloud.frame,
        reference=deviations.reference_text,
    )
