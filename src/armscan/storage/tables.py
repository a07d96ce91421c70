# SPDX-License-Identifier: Apache-2.0
"""Tables of text: UTF-8, comma, decimal point, ``#`` comments, columns found by their names."""

from __future__ import annotations

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import FileFormatError, InputError, shown
from armscan.geometry.arrays import FloatArray, IntArray
from armscan.records.cloud import SMALLEST_EXTENT_MM
from armscan.storage.files import path_text, read_bytes

INT64 = np.iinfo(np.int64)
WHOLE_NUMBER = re.compile(r"[-+]?[0-9]+")
NAN = re.compile(r"[-+]?nan", re.IGNORECASE)
DECIMAL = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
PLAIN_NUMBERS = re.compile(r"[-+0-9.eE\n]*")
PLAIN_INTEGERS = re.compile(r"-?[0-9]{1,18}(?:\n-?[0-9]{1,18})*")
LINE_BREAK = re.compile(r"\r\n|\n|\r")
COORDINATES = ("x_mm", "y_mm", "z_mm")
OTHER_UNITS = {
    "m": ("metres", "1000"),
    "cm": ("centimetres", "10"),
    **dict.fromkeys(("um", "\u00b5m", "\u03bcm", "\ufffdm"), ("micrometres", "0.001")),
    "in": ("inches", "25.4"),
    "inch": ("inches", "25.4"),
}
"""Units that columns of coordinates may have in place of mm, and how many mm they are.

The micro sign has two letters, and in a file that is not UTF-8 the one for what is not understood.
"""
MOST_COLUMNS, MOST_CELLS = 500, 20_000_000
"""No table of armscan has more; some gigabytes of memory hold so many cells."""
MOST_QUOTED = 60
"""Characters of a cell in a message."""

LARGEST_MM, LARGEST = 1e7, 1e12
"""Lengths beyond ten kilometres, and any numbers beyond this, are slips that overflow later."""


@dataclass(frozen=True, slots=True, eq=False)
class CsvTable:
    """A table of text, and where each row stood.

    Parameters
    ----------
    columns
        Cells of each column, stripped of blanks, in the order of the header.
    lines
        Number of the line of each row, counted from 1.
    comments
        Text after each ``#``, in order.
    is_cut
        True if the last line does not end with a line break.
    """

    where: str
    columns: Mapping[str, tuple[str, ...]]
    lines: tuple[int, ...]
    comments: tuple[str, ...] = ()
    is_cut: bool = False

    def __len__(self) -> int:
        """Count of rows."""
        return len(self.lines)

    def __contains__(self, name: str) -> bool:
        """True if there is a column of that name."""
        return name in self.columns

    def place(self, row: int) -> str:
        """File and line of a row, for messages."""
        return f"{self.where}, line {self.lines[row]}"

    def refuse_repeats(
        self, name: str, values: Sequence[Any], remedy: str = "give each line its own"
    ) -> None:
        """Raise if a value of a column occurs twice."""
        first: dict[Any, int] = {}
        for row, value in enumerate(values):
            if first.setdefault(value, row) != row:
                raise FileFormatError(
                    f"{name} {value} appears again (first in line {self.lines[first[value]]})",
                    where=self.place(row),
                    remedy=remedy,
                )

    def points(self, noun: str) -> FloatArray:
        """Coordinates (N, 3) in mm, at least one row."""
        refuse_other_units(self.columns, self.where)
        self.require(COORDINATES, noun)
        points = self.floats(COORDINATES)
        extent = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))
        if len(points) >= 3 and 0.0 < extent < SMALLEST_EXTENT_MM:
            raise FileFormatError(
                f"all {len(points)} {noun}s lie within {extent:.3g} mm: these look like metres",
                where=self.where,
                remedy="multiply x_mm, y_mm and z_mm by 1000",
            )
        return points

    def require(self, names: Sequence[str], noun: str = "") -> None:
        """Raise if a column is missing, or rows are; ``noun`` is a row's, where one is needed."""
        missing = [name for name in names if name not in self.columns]
        if not missing and noun and not len(self):
            raise FileFormatError(
                f"the table holds no {noun}", where=self.where, remedy=f"write one line a {noun}"
            )
        if not missing:
            return
        other = [name for name in self.columns if name not in names and len(name) < MOST_QUOTED]
        near = {name: get_close_matches(name, other, 1, 0.4) for name in missing}
        hints = [f"'{found[0]}' may be '{name}'" for name, found in near.items() if found]
        there = shown(", ".join(self.columns), 300)
        raise FileFormatError(
            f"no column is called {', '.join(missing)} (there are: {there})",
            where=self.where,
            remedy=f"write the header {','.join(names)}"
            + (f"; {', '.join(hints)}" if hints else ""),
        )

    def floats(self, names: Sequence[str], *, may_lack: bool = False) -> FloatArray:
        """Columns as numbers (N, len(names)); with ``may_lack`` empty cells and ``nan`` as NaN."""
        columns = [self._column(name, may_lack) for name in names]
        return np.array(columns, dtype=np.float64).reshape(len(names), len(self)).T

    def _column(self, name: str, may_lack: bool) -> FloatArray | list[float]:
        cells = self.columns[name]
        values = _plain_floats(cells, may_lack=may_lack)
        most = LARGEST_MM if name.endswith("_mm") else LARGEST
        if values is not None and not (np.abs(values) > most).any():
            return values
        return self._checked_floats(name, most, may_lack=may_lack)

    def _checked_floats(self, name: str, most: float, *, may_lack: bool) -> list[float]:
        values: list[float] = []
        for row, cell in enumerate(self.columns[name]):
            value = _number(cell)
            if not (math.isfinite(value) or (may_lack and math.isnan(value))):
                raise FileFormatError(
                    f"'{shown(cell, MOST_QUOTED)}' in column {name} is no number",
                    where=self.place(row),
                    remedy="write it as -12.5 or 1.25e-3"
                    + (", or leave it empty where it is not known" if may_lack else ""),
                )
            if abs(value) > most:
                raise FileFormatError(
                    f"{value:g} in column {name} is beyond all that is measured",
                    where=self.place(row),
                    remedy="correct the number, or leave the line out",
                )
            values.append(value)
        return values

    def ints(self, name: str, missing: int | None = None) -> IntArray:
        """A column as whole numbers (N,); ``missing`` stands for an empty cell, None refuses it."""
        cells = self.columns[name]
        if PLAIN_INTEGERS.fullmatch("\n".join(cells)):
            return np.array(list(map(int, cells)), dtype=np.int64)
        values = [self._int(cell, row, name, missing) for row, cell in enumerate(cells)]
        return np.array(values, dtype=np.int64)

    def _int(self, cell: str, row: int, name: str, missing: int | None) -> int:
        if not cell and missing is not None:
            return missing
        if not WHOLE_NUMBER.fullmatch(cell):
            raise FileFormatError(
                f"'{shown(cell, MOST_QUOTED)}' in column {name} is no whole number",
                where=self.place(row),
                remedy="write all digits, without point or exponent",
            )
        value = int(cell[:MOST_QUOTED])
        if not INT64.min <= value <= INT64.max:
            raise FileFormatError(
                f"{shown(cell, MOST_QUOTED)} in column {name} needs more than 64 bits",
                where=self.place(row),
                remedy="write fewer digits; times are whole nanoseconds",
            )
        return value


def read_csv(path: Path) -> CsvTable:
    """Read a table.

    Raises
    ------
    FileFormatError
        If the file is missing, empty, not UTF-8, has no header, a column twice, or a row of
        another length than the header.
    """
    return parse_csv(read_bytes(path), path_text(path))


def parse_csv(data: bytes, where: str) -> CsvTable:
    """Parse the content of a table; see `read_csv`."""
    text = _decoded(data, where)
    rows: list[tuple[int, list[str]]] = []
    comments: list[str] = []
    for number, line in enumerate(LINE_BREAK.split(text), start=1):
        stripped = line.strip()
        if stripped.startswith("#"):
            comments.append(stripped[1:].strip())
        elif stripped:
            rows.append((number, _cells(line, where, number)))
    if not rows:
        raise FileFormatError("the table has no header", where=where, remedy="copy the file again")
    header = _checked_header(rows[0][1], where)
    body = rows[1:]
    for number, cells in body:
        if len(cells) != len(header):
            raise _wrong_length(header, cells, where, number, is_last=number == body[-1][0])
    columns = zip(*(cells for _, cells in body), strict=True) if body else ([()] * len(header))
    return CsvTable(
        where,
        dict(zip(header, (tuple(cells) for cells in columns), strict=True)),
        tuple(number for number, _ in body),
        tuple(comments),
        not text.endswith(("\n", "\r")),
    )


def csv_bytes(columns: Mapping[str, Sequence[str]], comments: Sequence[str] = ()) -> bytes:
    """Text of a table: comments, header, rows; a cell that holds a comma is quoted.

    Raises
    ------
    InputError
        If a cell holds a line break.
    """
    for name, cells in columns.items():
        if any(LINE_BREAK.search(cell) for cell in cells):
            raise InputError(f"a cell of column {name} holds a line break")
    buffer = io.StringIO()
    for comment in comments:
        buffer.write(f"# {comment}\n")
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return buffer.getvalue().encode()


def number_columns(names: Sequence[str], values: FloatArray) -> dict[str, tuple[str, ...]]:
    """Columns of text of an array (N, len(names)); reads back as the same numbers."""
    return {name: tuple(map(number_text, values[:, k])) for k, name in enumerate(names)}


def number_text(value: float) -> str:
    """Shortest text that reads back as the same number; empty for NaN."""
    return "" if math.isnan(value) else repr(float(value))


def _decoded(data: bytes, where: str) -> str:
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(
            "this is not UTF-8 text", where=where, remedy="save it as CSV in UTF-8"
        ) from error
    if text.lstrip().startswith(("{", "[", "<")):
        raise FileFormatError(
            "this is no table: it looks like JSON or XML",
            where=where,
            remedy="give a CSV file with the names of the columns in its first line",
        )
    if "\0" in text:
        raise FileFormatError("this is no text", where=where, remedy="save it as CSV in UTF-8")
    return text


def _cells(line: str, where: str, number: int) -> list[str]:
    try:
        words = next(csv.reader([line], strict=True)) if '"' in line else line.split(",")
        return [cell.strip() for cell in words]
    except csv.Error as error:
        raise FileFormatError(
            f"the line cannot be split ({error})",
            where=f"{where}, line {number}",
            remedy='close every quotation mark, and write " inside quotes twice',
        ) from error


def _checked_header(header: list[str], where: str) -> list[str]:
    if len(header) == 1 and any(mark in header[0] for mark in ";\t"):
        raise FileFormatError(
            "columns are not separated by commas",
            where=where,
            remedy="save it with commas between columns and points in numbers",
        )
    if all(_is_number(cell) for cell in header):
        raise FileFormatError(
            "the first line holds numbers, not the names of columns",
            where=where,
            remedy="write a header with the names of the columns",
        )
    if len(header) > MOST_COLUMNS:
        raise FileFormatError(
            f"the header has {len(header)} columns",
            where=where,
            remedy=f"write at most {MOST_COLUMNS} columns, one line a row",
        )
    repeated = [name for name, count in Counter(header).items() if count > 1]
    if repeated or "" in header:
        fact = "a name is missing"
        if repeated:
            fact = f"more than one column is called {shown(repeated[0], MOST_QUOTED)}"
        raise FileFormatError(f"{fact} in the header", where=where, remedy="name each column once")
    return header


def _plain_floats(cells: Sequence[str], *, may_lack: bool) -> FloatArray | None:
    """Values of many cells at once; None if one of them needs a closer look."""
    # an array of texts is as wide as the longest
    if max(map(len, cells), default=0) > MOST_QUOTED or not PLAIN_NUMBERS.fullmatch(
        "\n".join(cells)
    ):
        return None
    try:
        return np.array([cell or "nan" for cell in cells] if may_lack else cells, dtype=np.float64)
    except ValueError:
        return None


def _number(cell: str) -> float:
    """Value of a cell; NaN for an empty one and ``nan``, infinite for what is no number."""
    if not cell or NAN.fullmatch(cell):
        return math.nan
    return float(cell) if DECIMAL.fullmatch(cell) else math.inf


def reads_as_float(word: str) -> bool:
    """Whether Python reads a word as a number; NaN and infinity are such."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_number(cell: str) -> bool:
    return bool(cell) and math.isfinite(_number(cell))


def _wrong_length(
    header: list[str], cells: list[str], where: str, number: int, *, is_last: bool
) -> FileFormatError:
    is_short = len(cells) < len(header)
    if is_short and is_last:
        remedy = "the file may be cut: copy it again or remove its last line"
    elif is_short:
        remedy = "leave unknown cells empty, but write their commas"
    else:
        remedy = "write numbers with a decimal point, not a comma"
    return FileFormatError(
        f"{len(cells)} cells, but the header has {len(header)}",
        where=f"{where}, line {number}",
        remedy=remedy,
    )


def refuse_other_units(names: Iterable[str], where: str) -> None:
    """Raise for a heading's columns of coordinates in another unit than mm."""
    for unit, (word, factor) in OTHER_UNITS.items():
        found = [name for name in names if name.lower() in {f"{axis}_{unit}" for axis in "xyz"}]
        if len(found) == len(COORDINATES):
            raise FileFormatError(
                f"the columns {', '.join(found)} are in {word}",
                where=where,
                remedy=f"multiply them by {factor} and name them {', '.join(COORDINATES)}",
            )


def refuse_beyond_reach(points_mm: FloatArray, where: str) -> None:
    """Raise for coordinates (N, 3) that no instrument reaches; gaps of NaN pass."""
    beyond = np.abs(points_mm) > LARGEST_MM
    if beyond.any():
        row, column = (int(value) for value in np.argwhere(beyond)[0])
        raise FileFormatError(
            f"coordinate {points_mm[row, column]:g} mm (entry {row + 1}) is beyond all reach",
            where=where,
            remedy="correct it, or leave the entry out",
        )


def refuse_decimal_commas(line: str, where: str) -> None:
    """Raise for a line whose commas can only be decimal signs, or may be.

    ``1,5;2,5;3,5`` and ``1,5 2,5 3,5`` hold commas and another separator between numbers; so do
    six whole numbers ``1,5,2,5,3,5`` from a table of three columns, which is not told from one of
    six: only what is certain is refused.
    """
    fields = [word for word in re.split(r"[;\s]+", line.strip().strip(",;")) if word]
    with_comma = [word for word in fields if re.fullmatch(r"[-+]?\d+,\d+([eE][-+]?\d+)?", word)]
    if len(fields) >= 2 and with_comma:
        raise FileFormatError(
            f"the numbers have commas as decimal signs: '{line.strip()[:60]}'",
            where=where,
            remedy="write them with points: 1.5 2.5 3.5",
        )
