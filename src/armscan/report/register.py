# SPDX-License-Identifier: Apache-2.0
"""The page of scans that were joined by markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.models.calibration import Provenance
from armscan.pipeline.register import MarkerResiduals
from armscan.records.cloud import PointCloud
from armscan.report.charts import named_columns
from armscan.report.drawing import (
    ACCENT,
    ALERT,
    MUTED,
    PALETTE,
    SceneLines,
    chart_markup,
    new_figure,
    round_below,
    scene_markup,
    styled,
    uniform_dots,
)
from armscan.report.page import Gallery, Page, Picture, Section, Text, page_of
from armscan.report.quantity import Quantity, Table, significant

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
