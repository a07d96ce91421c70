# SPDX-License-Identifier: Apache-2.0
"""A report in brief: the same content as text for people and as JSON for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from armscan.report.numbers import SIGMA_NOTE, sentence


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
