# SPDX-License-Identifier: Apache-2.0
"""Numbers as people read them, and a report in brief: the same content as text and as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SIGMA_NOTE = "± is one standard deviation."
"""Said once on every report: no other range is written with this sign."""


def with_sigma(value: float, sigma: float, unit: str = "") -> str:
    """A value rounded to two digits of its standard deviation: ``1431.27 ± 0.85 px``.

    A standard deviation of zero or NaN means that none is known: six digits are shown.
    """
    tail = f" {unit}" if unit else ""
    if not math.isfinite(sigma) or sigma <= 0.0 or not math.isfinite(value):
        return f"{value:.6g}{tail}"
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{decimals}f} ± {sigma:.{decimals}f}{tail}"


def significant(value: float, unit: str = "", digits: int = 3) -> str:
    """A value with a few digits, never in exponents between 1e-4 and 1e6."""
    tail = f" {unit}" if unit else ""
    if not math.isfinite(value):
        return "not known"
    if value == 0.0:
        return f"0{tail}"
    magnitude = math.floor(math.log10(abs(value)))
    if not -5 < magnitude < 6:
        return f"{value:.{digits - 1}e}{tail}"
    return f"{value:.{max(0, digits - 1 - magnitude)}f}{tail}"


def sentence(text: str) -> str:
    """Text with a capital at its start and a full stop at its end.

    A first word with a dot, digit or the like inside is a name, of a file or a coefficient, and
    stays as it is.
    """
    if not text:
        return ""
    first = text.split(maxsplit=1)[0].rstrip(".,:;").replace("-", "").replace("'", "")
    start = text[:1].upper() if first.isalpha() else text[:1]
    return f"{start}{text[1:].rstrip('.')}."


def without_source(source: str, reason: str) -> str:
    """A reason without the image's name in front, for places that show the name beside it."""
    return reason.removeprefix(f"{source}: ")


@dataclass(frozen=True, slots=True)
class Table:
    """A table of ready-made texts.

    Parameters
    ----------
    columns, rows
        Heads and cells.
    title
        Above the table; empty for none.
    word_columns
        Columns of words, flush left as the first always is; numbers stand flush right.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    title: str = ""
    word_columns: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Summary:
    """What a command found.

    Parameters
    ----------
    title
        One line.
    facts
        Label and value, in the order to show.
    tables
        Tables below the facts.
    warnings
        Sentences that a person should read.
    written
        Files that now exist.
    next_step
        A command that comes next; empty for none.
    data
        The same for programs: plain values only, units in the keys; NaN stands for "not known".
    forced
        Why the result, or what it rests on, was refused and made all the same (``--force-bad``).
    """

    title: str
    facts: tuple[tuple[str, str], ...] = ()
    tables: tuple[Table, ...] = ()
    warnings: tuple[str, ...] = ()
    written: tuple[Path, ...] = ()
    next_step: str = ""
    data: Mapping[str, Any] = field(default_factory=dict)
    forced: tuple[str, ...] = ()


def summary_json(summary: Summary) -> str:
    """JSON text of a summary in ASCII; what is not known is ``null``."""
    content = {
        **summary.data,
        "forced": list(summary.forced),
        "warnings": list(summary.warnings),
        "written": [path.as_posix() for path in summary.written],
    }
    return json.dumps(_plain(content), indent=2, allow_nan=False)


def summary_text(summary: Summary) -> str:
    """Readable text of a summary."""
    lines = [summary.title, *(f"FORCED: {sentence(reason)}" for reason in summary.forced)]
    width = max((len(label) for label, _ in summary.facts), default=0)
    for label, value in summary.facts:
        first, *rest = value.splitlines() or [""]
        lines.append(f"  {label:<{width}}  {first}".rstrip())
        lines += [f"  {'':<{width}}  {line}" for line in rest]
    if any("±" in value for _, value in summary.facts):
        lines.append(f"  {SIGMA_NOTE}")
    for table in summary.tables:
        lines += ["", *_table_lines(table)]
    if summary.warnings:
        lines.append("")
    lines += [f"warning: {warning}" for warning in summary.warnings]
    if summary.written:
        lines.append("")
    lines += [f"wrote {path}" for path in summary.written]
    if summary.next_step:
        lines.append(f"next: {summary.next_step}")
    return "\n".join(lines)


def _table_lines(table: Table) -> list[str]:
    rows = [table.columns, *table.rows]
    widths = [max(len(row[k]) for row in rows) for k in range(len(table.columns))]
    lines = [f"  {table.title}"] if table.title else []
    for row in rows:
        cells = [
            f"{cell:<{width}}" if k in (0, *table.word_columns) else f"{cell:>{width}}"
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append(("  " + "  ".join(cells)).rstrip())
    return lines


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
