# SPDX-License-Identifier: Apache-2.0
"""A result as people and programs read it: its quantities, its tables, and a command's summary.

A quantity is stated once. The terminal, ``--json``, the cards and the lists of a page all take it
from there.
"""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

SIGMA_NOTE = "± is one standard deviation."
"""Said once on every report: no other range is written with this sign."""
MOST_DECIMALS, MOST_DIGITS = 6, 8
"""With more decimals a sigma is written with an exponent, and its value to so many digits: a sigma
of 1e-8 mm, as of points without noise, would else make a row of zeros."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """One value of a result.

    Parameters
    ----------
    key
        Its name in ``--json``, with the unit, or a path ``a.b``; empty if it is for people only.
    label
        Its name for people; empty if it is for programs only.
    value
        A number, a text, or what JSON can hold.
    sigma
        Its standard deviation; NaN if none is known.
    unit
        Written behind the number.
    meaning
        What it says, in a few words.
    shown
        How people read the value; empty for three digits, or two of its sigma, with the unit.
    """

    key: str
    label: str
    value: Any
    sigma: float = math.nan
    unit: str = ""
    meaning: str = ""
    shown: str = ""

    @property
    def text(self) -> str:
        """The value as people read it."""
        if self.shown or isinstance(self.value, str):
            return self.shown or str(self.value)
        if isinstance(self.value, int):
            return f"{self.value:,} {self.unit}".rstrip()
        if math.isnan(self.sigma):
            return significant(self.value, self.unit)
        return with_sigma(self.value, self.sigma, self.unit)

    @property
    def line(self) -> str:
        """The value and what it says."""
        return f"{self.text}, {self.meaning}" if self.meaning else self.text


def fact(label: str, text: str, meaning: str = "") -> Quantity:
    """A quantity in words, for people only."""
    return Quantity("", label, text, meaning=meaning)


def values(quantities: Iterable[Quantity]) -> dict[str, Any]:
    """Values by their keys, for programs; a key ``a.b`` is ``b`` inside ``a``."""
    found: dict[str, Any] = {}
    for item in quantities:
        *path, last = item.key.split(".")
        place = found
        for word in path:
            place = place.setdefault(word, {})
        if last:
            place[last] = item.value
    return found


def only(quantities: Sequence[Quantity], *keys: str) -> tuple[Quantity, ...]:
    """The quantities of some keys, in the order of the keys; without those that are missing."""
    by_key = {item.key: item for item in quantities}
    return tuple(by_key[key] for key in keys if key in by_key)


def for_people(quantities: Iterable[Quantity]) -> tuple[Quantity, ...]:
    """The quantities that have a label, without their keys."""
    return tuple(replace(item, key="") for item in quantities if item.label)


@dataclass(frozen=True, slots=True)
class Table:
    """A table of ready-made texts.

    ``word_columns`` are flush left as the first always is; numbers stand flush right.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    title: str = ""
    word_columns: tuple[int, ...] = ()


def quantity_table(heads: tuple[str, str, str], quantities: Iterable[Quantity]) -> Table:
    """Label, value and meaning of quantities."""
    return Table(heads, tuple((q.label, q.text, q.meaning) for q in quantities), "", (2,))


def matrix_table(corner: str, names: Sequence[str], matrix: Iterable[Iterable[float]]) -> Table:
    """A square matrix with its names at both sides."""
    rows = ((name, *(f"{x:.3g}" for x in row)) for name, row in zip(names, matrix, strict=True))
    return Table((corner, *names), tuple(rows))


@dataclass(frozen=True, slots=True)
class Summary:
    """What a command found.

    Parameters
    ----------
    next_step
        A command that comes next; empty for none.
    extra
        More for programs: plain values only, units in the keys; NaN stands for "not known".
    forced
        Why the result, or what it rests on, was refused and made all the same (``--force-bad``).
    """

    title: str
    quantities: tuple[Quantity, ...] = ()
    tables: tuple[Table, ...] = ()
    warnings: tuple[str, ...] = ()
    written: tuple[Path, ...] = ()
    next_step: str = ""
    extra: Mapping[str, Any] = field(default_factory=dict)
    forced: tuple[str, ...] = ()

    @property
    def data(self) -> dict[str, Any]:
        """All that it holds for programs, by key."""
        return {**values(self.quantities), **self.extra}


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
    shown = [item for item in summary.quantities if item.label]
    width = max((len(item.label) for item in shown), default=0)
    for item in shown:
        first, *rest = item.line.splitlines() or [""]
        lines.append(f"  {item.label:<{width}}  {first}".rstrip())
        lines += [f"  {'':<{width}}  {line}" for line in rest]
    if any("±" in item.line for item in shown):
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
        lines.append(f"next: {_quoted(summary.next_step, summary.written)}")
    return "\n".join(lines)


def _quoted(text: str, paths: Sequence[Path]) -> str:
    """A text with its paths as a shell takes them, where that is another text."""
    names = sorted((str(path) for path in paths), key=len, reverse=True)
    if not names:
        return text
    return re.sub("|".join(map(re.escape, names)), lambda found: shlex.quote(found[0]), text)


def with_sigma(value: float, sigma: float, unit: str = "") -> str:
    """A value rounded to two digits of its standard deviation: ``1431.27 ± 0.85 px``.

    A standard deviation of zero or NaN means that none is known: six digits are shown. One that
    asks for more than `MOST_DECIMALS` is written with an exponent: ``20.000000 ± 1.2e-08 mm``.
    """
    tail = f" {unit}" if unit else ""
    if not math.isfinite(sigma) or sigma <= 0.0 or not math.isfinite(value):
        return f"{value:.6g}{tail}"
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    if decimals <= MOST_DECIMALS:
        return f"{unsigned_zero(value, decimals):.{decimals}f} ± {sigma:.{decimals}f}{tail}"
    if value == 0.0:
        return f"0 ± {sigma:.1e}{tail}"
    magnitude = math.floor(math.log10(abs(value)))
    if magnitude < -3:
        digits = min(max(0, decimals + magnitude), MOST_DIGITS - 1)
        return f"{value:.{digits}e} ± {sigma:.1e}{tail}"
    shown = min(decimals, MOST_DIGITS - 1 - magnitude)
    return f"{value:.{shown}f} ± {sigma:.1e}{tail}"


def signed_mm(value: float) -> str:
    """A deviation with its sign; 0 has +."""
    return f"{unsigned_zero(value, 4):+.4f} mm"


def unsigned_zero(value: float, decimals: int) -> float:
    """A value rounded to decimals, never -0."""
    return round(value, decimals) + 0.0


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


def share_text(percent: float) -> str:
    """A share with two decimals that never reads 100 or 0 if it is neither."""
    if 0.0 < percent < 0.005:
        return "below 0.01 %"
    return "above 99.99 %" if 99.995 <= percent < 100.0 else f"{percent:.2f} %"


def triple(values: Iterable[float], digits: int = 4) -> str:
    """Three numbers with commas between them."""
    return ", ".join(f"{unsigned_zero(value, digits):.{digits}f}" for value in values)


def sentence(text: str) -> str:
    """Text with a capital at its start and a full stop, or its question mark, at its end.

    A first word with a dot, digit or the like inside, or a colon behind it, is a name, of a file, a
    part or a coefficient, and stays as it is.
    """
    if not text:
        return ""
    first = text.split(maxsplit=1)[0].rstrip(".,;").replace("-", "").replace("'", "")
    start = text[:1].upper() if first.isalpha() else text[:1]
    return f"{start}{text[1:].rstrip('.')}{'' if text.endswith('?') else '.'}"


def sentences(texts: Iterable[str]) -> tuple[str, ...]:
    """Each text as a sentence."""
    return tuple(sentence(text) for text in texts)


def plural(n: int, noun: str) -> str:
    """A count with its noun."""
    return f"{n:,} {noun}" if n == 1 else f"{n:,} {noun}s"


def without_source(source: str, reason: str) -> str:
    """A reason without the image's name in front, for places that show the name beside it."""
    return reason.removeprefix(f"{source}: ")


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
