# SPDX-License-Identifier: Apache-2.0
"""The pages of a recipe: of one part, and of all parts with the trend of each quantity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from urllib.parse import quote

import numpy as np
from matplotlib.axes import Axes

from armscan.inspection.cad.comparison import RULE
from armscan.inspection.recipe import FollowedRecipe, PartQuantity, PartRow
from armscan.models.calibration import Provenance
from armscan.report.charts import PAGE_WIDTH, named_columns
from armscan.report.drawing import ACCENT, ALERT, INK, LINE, MUTED, chart_markup, new_figure, styled
from armscan.report.inspection.features import feature_quantities
from armscan.report.page import Facts, Gallery, Links, Page, Picture, Section, Text, page_of
from armscan.report.quantity import Quantity, Table, fact, for_people, plural

COLUMNS = 4
"""Quantities of one table of the page: more would not fit on paper."""
OPEN_CHARTS = 12
"""Faces whose trends are shown at once; the others open on a click."""
MOST_NAMES = 40
"""Parts named below a chart."""
NAMED_WRONG = 4
"""Quantities that did not pass and are named in a part's row."""
MARKS = {"pass": ("o", ACCENT), "undecided": ("D", MUTED), "fail": ("s", ALERT), "": ("o", INK)}
"""Shape and colour of a decision: the shape tells it in grey print."""
COLOURS_TEXT = (
    "Each part's deviation from the nominal value in the order of the parts, with its U (k = 2) as "
    "a bar; dashed lines are the limits. A disc passed (black: not "
    "judged), a diamond is undecided, a square failed. "
)


def part_page(run: FollowedRecipe, row: PartRow, page: Page) -> Page:
    """The page of one part: its features before what ``page``, that of a comparison, shows."""
    sections = list(page.sections)
    values = [one for one in row.quantities if one.kind == "feature"]
    if values:
        each = tuple(
            Facts(for_people(feature_quantities(found)), title=name)
            for name, found in run.features.items()
        )
        sections.insert(0, Section("Features", (feature_table(values),)))
        sections.insert(-1, Section("Features in full", each, is_folded=True))
    if run.cleaning is not None:
        steps = tuple((one.name, f"{one.n_taken:,}", one.rule) for one in run.cleaning.steps)
        table = Table(("filter", "points taken", "rule"), steps, "", (2,))
        sections.insert(-1, Section("Cleaning", (table,), is_folded=True))
    of_faces = tuple(
        replace(card, label="Faces") if card.key == "verdict" else card for card in page.cards
    )
    verdict = fact("Verdict of the part", row.verdict or "measured", wrong_text(row, 1))
    return replace(page, cards=(verdict, *of_faces), sections=tuple(sections))


def feature_table(values: Sequence[PartQuantity]) -> Table:
    """A row a feature: decision, value, U, nominal and tolerance."""
    rows = tuple(
        (
            one.name,
            one.decision or "-",
            _number(one.value, one.unit),
            _number(one.u_value, one.unit),
            "-" if math.isnan(one.nominal) else f"{one.nominal:g}",
            "-" if math.isnan(one.tolerance) else f"{one.tolerance:g}",
            one.unit,
        )
        for one in values
    )
    heads = ("feature", "decision", "value", "U", "nominal", "tolerance", "unit")
    return Table(heads, rows, "", (1, 6))


def wrong_text(row: PartRow, most: int = NAMED_WRONG) -> str:
    """What did not pass, ``most`` of it named, or why the part was not inspected."""
    if row.reason:
        return row.reason
    # of a face the worse of mean and spot
    worst = {(one.name, one.kind == "feature"): one for one in reversed(row.wrong)}
    wrong = [one for one in row.wrong if worst[one.name, one.kind == "feature"] is one]
    named = [
        f"{one.label} {one.decision}"
        + ("" if math.isnan(one.value) else f" ({one.deviation:+.4f} {one.unit})")
        for one in wrong[:most]
    ]
    more = len(wrong) - len(named)
    return "; ".join(named) + (f" and {more} more" if more else "")


def _number(value: float, unit: str) -> str:
    digits = 4 if unit == "mm" else 3
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def recipe_quantities(title: str, rows: Sequence[PartRow]) -> tuple[Quantity, ...]:
    """What is told of all parts."""
    counts = dict.fromkeys(("pass", "undecided", "fail", "not inspected"), 0)
    for row in rows:
        counts[row.verdict or "pass"] += 1
    has_limits = any(one.decision for row in rows for one in row.quantities)
    words = dict(counts) if has_limits else {"measured": counts["pass"], **counts, "pass": 0}
    text = ", ".join(f"{n} {word}" for word, n in words.items() if n)
    return (
        Quantity("title", "Recipe", title),
        Quantity("parts.n", "Parts", len(rows), meaning=text),
        Quantity("parts.counts", "", counts),
        Quantity("all_passed", "", all(row.is_passed for row in rows)),
        Quantity("parts.each", "", [_row_data(row) for row in rows]),
    )


def _row_data(row: PartRow) -> dict[str, object]:
    return {
        "part": row.name,
        "cloud": row.cloud,
        "verdict": row.verdict,
        "reason": row.reason,
        "quantities": [
            {
                "name": one.name,
                "kind": one.kind,
                "unit": one.unit,
                "value": one.value,
                "u": one.u_value,
                "nominal": one.nominal,
                "tolerance": one.tolerance,
                "decision": one.decision,
            }
            for one in row.quantities
        ],
    }


def parts_table(rows: Sequence[PartRow]) -> Table:
    """A row a part: verdict, and what did not pass or why."""
    return Table(
        ("part", "verdict", "what stands against it"),
        tuple((row.name, row.verdict or "measured", wrong_text(row) or "-") for row in rows),
        "",
        (1, 2),
    )


def recipe_page(title: str, rows: Sequence[PartRow], provenance: Provenance) -> Page:
    """Lay out the page of all parts."""
    told = recipe_quantities(title, rows)
    counts = told[2].value
    labels = list({(one.name, one.kind): None for row in rows for one in row.quantities})
    features = [name for name, kind in labels if kind == "feature"]
    faces = sorted(
        {name: None for name, kind in labels if kind != "feature"},
        key=lambda name: -_nearness(rows, name),
    )
    links = tuple((f"{quote(row.name)}/part.html", row.name) for row in rows if not row.reason)
    sections = [
        Section("Parts", (parts_table(rows), Links(links))),
        *_chart_sections(rows, features, faces),
    ]
    if labels:
        tables = _tables(rows, features, faces)
        sections.append(Section("Every quantity", (Text(f"A deviation is {RULE}."), *tables)))
    notes = [f"{row.name}: {note}" for row in rows for note in row.notes]
    if notes:
        sections.append(Section("Notes", tuple(Text(note) for note in notes), is_folded=True))
    cards = [fact("Parts", str(len(rows)))] + [
        fact(word.capitalize(), str(n)) for word, n in counts.items() if n
    ]
    return page_of(
        provenance,
        title,
        f"{plural(len(rows), 'part')} by one recipe",
        sections,
        cards=cards,
        is_simulated=any(row.is_simulated for row in rows),
    )


def _of(row: PartRow, name: str, kinds: Sequence[str]) -> list[PartQuantity]:
    return [one for one in row.quantities if one.name == name and one.kind in kinds]


def _nearness(rows: Sequence[PartRow], name: str) -> float:
    """How near a face comes to its limits on any part; 0 where not judged, -1 where not shown."""
    ratios = [
        0.0 if one.decision == "not seen" else abs(one.deviation) / one.tolerance
        for row in rows
        for one in _of(row, name, ("mean", "spot"))
        if math.isfinite(one.value)
    ]
    return max(ratios, default=-1.0)


def _chart_sections(
    rows: Sequence[PartRow], features: Sequence[str], faces: Sequence[str]
) -> list[Section]:
    limited = [
        name
        for name in features
        for one in [one for row in rows for one in _of(row, name, ("feature",))]
        if math.isfinite(one.tolerance) and math.isfinite(one.value)
    ]
    limited = list(dict.fromkeys(limited))
    seen = [name for name in faces if _nearness(rows, name) >= 0.0]
    found = []
    if limited:
        charts = tuple(trend_chart(rows, name, ("feature",)) for name in limited)
        found.append(Section("Trend of features", (Text(COLOURS_TEXT), Gallery(charts, 420))))
    words = COLOURS_TEXT + (
        "Of a face the mean is filled and the spot that decides hollow; faces that come "
        "nearest to their limits stand first."
    )
    for title, names, is_folded in (
        ("Trend of faces", seen[:OPEN_CHARTS], False),
        ("Trend of the other faces", seen[OPEN_CHARTS:], True),
    ):
        if names:
            charts = tuple(trend_chart(rows, name, ("mean", "spot")) for name in names)
            found.append(Section(title, (Text(words), Gallery(charts, 420)), is_folded=is_folded))
    return found


def trend_chart(rows: Sequence[PartRow], name: str, kinds: Sequence[str]) -> Picture:
    """Deviations of one feature or face over the parts, with U and limits.

    ``kinds``: of its quantities, drawn beside each other.
    """
    with styled():
        figure = new_figure(PAGE_WIDTH / 2.0, 2.9)
        axes = figure.add_subplot()
        shift = 0.22 if len(kinds) > 1 else 0.0
        shown: list[PartQuantity] = []
        for k, kind in enumerate(kinds):
            each = [next(iter(_of(row, name, (kind,))), None) for row in rows]
            shown += [one for one in each if one is not None]
            _draw_series(axes, each, (k - 0.5) * shift if shift else 0.0, is_hollow=k > 0)
        limit, unit = shown[0].tolerance, shown[0].unit
        for edge in (-limit, limit):
            axes.axhline(edge, color=ALERT, linestyle="--", linewidth=1.2)
        axes.axhline(0.0, color=LINE, linewidth=1.0)
        reach = [1.3 * limit]
        reach += [1.15 * (abs(one.deviation) + _finite(one.u_value)) for one in shown]
        most = float(np.nanmax(reach))
        axes.set_ylim(-most, most)
        axes.set_xlim(-0.6, len(rows) - 0.4)
        step = max(1, math.ceil(len(rows) / MOST_NAMES))
        named_columns(axes, [row.name for row in rows[::step]])
        axes.set_xticks(
            range(0, len(rows), step), [label.get_text() for label in axes.get_xticklabels()]
        )
        axes.set_ylabel(f"deviation, {unit}")
    nominal = "" if kinds[0] != "feature" else f"nominal {shown[0].nominal:g} {unit}, "
    return Picture(
        chart_markup(figure, f"Trend: {name}"), f"{nominal}limits ±{limit:g} {unit}", name
    )


def _draw_series(
    axes: Axes, each: Sequence[PartQuantity | None], shift: float, *, is_hollow: bool
) -> None:
    x = [k + shift for k, one in enumerate(each) if one is not None]
    y = [one.deviation for one in each if one is not None]
    if not is_hollow:
        axes.plot(x, y, color=LINE, linewidth=1.0, zorder=1)
    for k, one in enumerate(each):
        if one is None or math.isnan(one.value):
            continue
        marker, colour = MARKS.get(one.decision, MARKS[""])
        inside = "white" if is_hollow else colour
        axes.errorbar(
            k + shift, one.deviation, yerr=_finite(one.u_value) or None, fmt=marker, color=colour,
            markersize=5, capsize=2, linewidth=1.0, markerfacecolor=inside,
        )  # fmt: skip


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _tables(
    rows: Sequence[PartRow], features: Sequence[str], faces: Sequence[str]
) -> tuple[Table, ...]:
    """A row a part and a column a quantity, a few columns a table."""
    pairs = [(name, "feature") for name in features]
    pairs += [(name, kind) for name in faces for kind in ("mean", "spot")]
    found = []
    for first in range(0, len(pairs), COLUMNS):
        chosen = pairs[first : first + COLUMNS]
        heads = ("part", *(_head(rows, name, kind) for name, kind in chosen))
        cells = tuple(
            (row.name, *(_cell(row, name, kind) for name, kind in chosen))
            for row in rows
            if not row.reason
        )
        found.append(Table(heads, cells))
    return tuple(found)


def _head(rows: Sequence[PartRow], name: str, kind: str) -> str:
    one = next(one for row in rows for one in _of(row, name, (kind,)))
    limits = "" if math.isnan(one.tolerance) else f" ±{one.tolerance:g}"
    nominal = "" if kind != "feature" or math.isnan(one.nominal) else f" {one.nominal:g}"
    return f"{one.label},{nominal}{limits} {one.unit}"


def _cell(row: PartRow, name: str, kind: str) -> str:
    """Value, U and decision; a dash where there is none."""
    one = next(iter(_of(row, name, (kind,))), None)
    if one is None or math.isnan(one.value):
        return "-" if one is None else one.decision or "-"
    sign = "" if kind == "feature" else "+"
    digits = 4 if one.unit == "mm" else 3
    u = "" if math.isnan(one.u_value) else f" (U {one.u_value:.{digits}f})"
    mark = {"": "", "pass": "", "not seen": " not judged"}.get(one.decision, f" {one.decision}")
    return f"{one.value:{sign}.{digits}f}{u}{mark}"
