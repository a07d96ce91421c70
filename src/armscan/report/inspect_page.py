# SPDX-License-Identifier: Apache-2.0
"""The page of an inspection."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from armscan.inspection.results import Deviations, PointCounts
from armscan.models.calibration import Provenance
from armscan.report.deviation_figures import share_text
from armscan.report.numbers import sentence, significant
from armscan.report.origin import footer, origin_section
from armscan.report.page import Card, Facts, Gallery, Page, Picture, Section, Text
from armscan.report.summary import Table

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
