# SPDX-License-Identifier: Apache-2.0
"""The page of a cleaned cloud: what each filter took, by colour."""

from __future__ import annotations

import math

import numpy as np

from armscan.geometry.arrays import FloatArray, IntArray
from armscan.inspection.cleaning import Cleaning
from armscan.models.calibration import Provenance
from armscan.report.drawing import PALETTE, SceneDots, scene_markup
from armscan.report.page import Gallery, Legend, Page, Picture, Section, Text, page_of
from armscan.report.quantity import Quantity, Table, for_people

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
            Section("In space", (legend, Gallery((_view(found, points_mm, colours),), 560))),
        ),
        cards=(
            *for_people(told),
            *(
                Quantity("", step.name.capitalize(), step.n_taken, meaning="points taken")
                for step in found.steps
            ),
        ),
        warnings=found.warnings,
        is_simulated=is_simulated,
    )


def _view(found: Cleaning, points_mm: FloatArray, colours: list[str]) -> Picture:
    dots, thinned = [], []
    for k in range(-1, len(found.steps)):
        rows = np.flatnonzero(found.taken_by == k)
        if not len(rows):
            continue
        step = max(1, math.ceil(len(rows) / MOST_SHOWN))
        if step > 1:
            name = "left" if k < 0 else found.steps[k].name
            thinned.append(f"one point in {step} of '{name}'")
        dots.append(_dots(points_mm, rows[::step], LEFT_COLOUR if k < 0 else colours[k]))
    caption = f"Shown is {', '.join(thinned)}." if thinned else ""
    title = "Points by the filter that took them"
    scene = scene_markup(dots, [], [], title, is_z_up=found.cloud.frame != "Sensor")
    return Picture(scene, caption, f"{title} ({found.cloud.frame} frame)")


def _dots(points_mm: FloatArray, rows: IntArray, colour: str) -> SceneDots:
    rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], dtype=np.uint8)
    return SceneDots(points_mm[rows], np.tile(rgb, (len(rows), 1)))
