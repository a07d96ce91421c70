# SPDX-License-Identifier: Apache-2.0
"""The page of a registration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from armscan.models.calibration import Provenance
from armscan.report.numbers import sentence
from armscan.report.origin import footer, origin_section
from armscan.report.page import Card, Gallery, Page, Picture, Section, Text
from armscan.report.summary import Table
from armscan.storage.registration_files import (
    MovedBody,
    NotJoinedBody,
    ResidualBody,
    TransformBody,
)

HOW_TO_READ = (
    "A residual is how far a marker, carried to the common frame, lies from where the others say. "
    "It shows how well markers were measured, and markers that moved. It does not show how well "
    "the frames agree: that is the uncertainty, which is larger far from the markers."
)


@dataclass(frozen=True, slots=True, eq=False)
class RegisterReport:
    """One registration, ready for a page, a terminal, a document and a program.

    Parameters
    ----------
    title, subtitle
        What was joined.
    common_frame, common_frame_of
        Name of the common frame, and the list that defines it.
    cards, facts
        Key figures, for the page and for a terminal.
    scans, residuals_table
        Tables of scans and of markers.
    pictures
        The view in space first.
    warnings
        Sentences that a person should read first.
    transforms, residuals, moved, not_joined, chi2, degrees_of_freedom
        Of the document.
    data
        For programs.
    """

    title: str
    subtitle: str
    common_frame: str
    common_frame_of: str
    cards: tuple[Card, ...]
    facts: tuple[tuple[str, str], ...]
    scans: Table
    residuals_table: Table
    pictures: tuple[Picture, ...]
    warnings: tuple[str, ...]
    transforms: tuple[TransformBody, ...]
    residuals: tuple[ResidualBody, ...]
    moved: tuple[MovedBody, ...]
    not_joined: tuple[NotJoinedBody, ...]
    chi2: float
    degrees_of_freedom: int
    data: Mapping[str, Any]


def registration_page(
    report: RegisterReport, provenance: Provenance, *, is_simulated: bool
) -> Page:
    """Lay out the page."""
    view, *charts = report.pictures
    return Page(
        title=report.title,
        subtitle=report.subtitle,
        cards=report.cards,
        warnings=tuple(sentence(warning) for warning in report.warnings),
        sections=(
            Section("In space", (Gallery((view,), 560),)),
            Section("Scans", (report.scans,)),
            Section(
                "How well the markers fit",
                (Text(HOW_TO_READ), Gallery(tuple(charts), 420)),
            ),
            Section("Marker by marker", (report.residuals_table,), is_folded=len(charts) > 1),
            origin_section(provenance),
        ),
        is_simulated=is_simulated,
        footer=footer(provenance),
        forced=provenance.forced,
    )
