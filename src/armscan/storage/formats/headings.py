# SPDX-License-Identifier: Apache-2.0
"""Which columns of a table of text are x, y and z, by the lines before its first row.

A heading is a bare line of names, or a ``#`` or ``//`` line with one name a column. Where the lines
leave open which columns are meant the table is refused: a point's number taken for its x is not
seen in the result.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from armscan.errors import FileFormatError
from armscan.storage.files import path_text
from armscan.storage.formats.columns import COVARIANCE, NOISE_LENGTH, NORMAL, POINT, WHOLE
from armscan.storage.tables import OTHER_UNITS, reads_as_float, refuse_other_units

KNOWN = {
    **{name: name for name in (*POINT, *NORMAL, *COVARIANCE, *WHOLE, NOISE_LENGTH)},
    **{name: name for name in ("sigma_noise_mm", "intensity")},
    **{f"{name}_mm": name for name in POINT},
}
"""Columns that are read, by their names in a heading."""
FIRST_THREE: Mapping[str, int] = {name: k for k, name in enumerate(POINT)}
COMMENT_MARKS = ("#", "//")
COLUMNS_ARE = re.compile(r"^(columns?|fields?|format|header)\s*[:=\s]\s*", re.IGNORECASE)
"""Before the names of columns in a comment: ``# columns: id x y z``."""
POINT_NUMBER = re.compile(
    r"((points?|pt|vertex|row)[ _.-]*)?(id|nr|no|num|number|index|idx|name)?\.?", re.IGNORECASE
)
"""Names of a column that says which point it is."""
EMPTY_FIELD = re.compile(r"(^|[,;])[ \t]*(?=[,;])", re.MULTILINE)
"""Nothing between two separators: a value that is missing, which must not move the next ones."""
UNIT_IN_BRACKETS = re.compile(r"(\w)[ \t]*[\[(][ \t]*([A-Za-z]+)[ \t]*[\])]")
"""A column's name, its last character, and its unit: ``X [mm]``, ``y(m)``."""
LEAST_COUNTED = 3
"""Rows from which numbers that go up by one are taken for numbers of points."""
NAME_THEM = "name the columns x, y, z in that line, or delete it if the first three are these"
LONGEST_SHOWN = 60


@dataclass(frozen=True, slots=True)
class Opening:
    """Lines of a table before its first row.

    Parameters
    ----------
    n_lines
        How many they are.
    heading
        The bare line of names; empty without one.
    comments
        Text of the ``#`` and ``//`` lines, without words such as ``columns:`` before it.
    """

    n_lines: int
    heading: str
    comments: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class NamedColumns:
    """Numbers of the columns that are read, by name, and what to say of the others."""

    numbers: Mapping[str, int]
    passed_over: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


def opening_of(lines: Sequence[str], path: Path) -> Opening:
    """What stands before the first row: comments, a count of points, and names of columns."""
    heading, has_count, comments = "", False, list[str]()
    for k, line in enumerate(lines):
        text = line.strip()
        if text.startswith(COMMENT_MARKS):
            comments.append(COLUMNS_ARE.sub("", text.lstrip("#/ ")))
            continue
        words = words_of(line)
        if not words:
            continue
        if not has_count and len(words) == 1 and words[0].isdecimal():
            has_count = True
        elif not heading and _names_columns(line, k, path):
            heading = line
        else:
            return Opening(k, heading, tuple(comments))
    return Opening(len(lines), heading, tuple(comments))


def _names_columns(line: str, k: int, path: Path) -> bool:
    """Whether line ``k``, from 0, is no point but names of columns."""
    words = words_of(line)
    if all(reads_as_float(word) for word in words_of(line.partition("#")[0])):
        return False
    if not all(re.match(r"[\W_]*[A-Za-z]", word) for word in words):
        number = f"line {k + 1}" if k else "the first line"
        raise FileFormatError(
            f"{number} is neither a point nor a heading: '{line[:LONGEST_SHOWN]}'",
            where=path_text(path),
            remedy="correct the line, or put # before it",
        )
    return True


def named_columns(opening: Opening, rows: Sequence[str], path: Path) -> NamedColumns:
    """Which columns are read, by what stands before the first of some rows.

    Raises
    ------
    FileFormatError
        If it leaves open which columns are x, y and z, or they are in another unit than mm.
    """
    counts = _counts(rows[0])
    headings = [opening.heading] if opening.heading else []
    for text in (*headings, *reversed(opening.comments)):
        names = _names(text, counts)
        numbers = _numbers(names)
        if set(POINT) <= set(numbers) and len(names) in counts:
            read = set(numbers.values())
            passed_over = (word for k, word in enumerate(names) if k not in read and word)
            return NamedColumns(numbers, tuple(passed_over))
    for text in (*headings, *opening.comments):
        _refuse_units(words_of(text), path)
    if opening.heading:
        return _by_heading(opening.heading, rows, path)
    return _by_comments(opening.comments, rows, path)


def _by_heading(heading: str, rows: Sequence[str], path: Path) -> NamedColumns:
    """Columns of a bare heading that does not give x, y, z and all others one name each."""
    counts = _counts(rows[0])
    n_columns, words = len(words_of(rows[0])), words_of(heading)
    for separator in (",", ";", "\t"):
        numbers = _numbers(UNIT_IN_BRACKETS.sub(r"\1_\2", heading).split(separator))
        if set(POINT) <= set(numbers):
            if numbers["x"] == 0:
                _refuse_numbers_first(heading, words, rows, path)
            return NamedColumns(numbers)
    numbers = _numbers(words)
    if set(POINT) <= set(numbers):
        if any(numbers[name] != k for name, k in FIRST_THREE.items()):
            raise _not_one_each(heading, n_columns, path)
        _refuse_numbers_first(heading, words, rows, path)
        return NamedColumns(numbers)
    is_title = len(words) == 1
    if not is_title:
        _refuse_unknown(heading, _names(heading, counts), rows, path)
    if n_columns > len(POINT) and not is_title:
        raise _no_names(heading, n_columns, path)
    return NamedColumns(FIRST_THREE, remarks=_taken(heading))


def _by_comments(comments: Sequence[str], rows: Sequence[str], path: Path) -> NamedColumns:
    """Columns of a table without a heading, where no comment gives each column its name."""
    counts, n_columns = _counts(rows[0]), len(words_of(rows[0]))
    for text in comments:
        words = words_of(text)
        order = [KNOWN.get(_plain(word), "") for word in words]
        runs = [k for k in range(len(order) - 2) if set(order[k : k + 3]) == set(POINT)]
        if not runs:
            continue
        is_in_order = order[runs[0] : runs[0] + 3] == list(POINT)
        if not is_in_order or (n_columns > len(POINT) and runs[0] > 0):
            raise _not_one_each(text, n_columns, path)
        _refuse_numbers_first(text, words, rows, path)
        return NamedColumns(FIRST_THREE)
    last = comments[-1] if comments else ""
    names = _names(last, counts)
    is_heading = len(names) in counts and len(names) >= len(POINT)
    # prose has colons and numbers, names of columns have none
    if is_heading and all(re.fullmatch(r"[\W_]*[A-Za-z][^:]*", word) for word in words_of(last)):
        _refuse_unknown(last, names, rows, path)
        return NamedColumns(FIRST_THREE, remarks=_taken(last))
    if n_columns > len(POINT) and len(rows) >= LEAST_COUNTED and _are_counted(rows):
        return NamedColumns(
            FIRST_THREE,
            remarks=(
                "the first column counts the lines and was taken for x: if it numbers the points, "
                "write a first line with the names of the columns, as 'id x y z'",
            ),
        )
    return NamedColumns(FIRST_THREE)


def _refuse_unknown(text: str, names: Sequence[str], rows: Sequence[str], path: Path) -> None:
    """Raise where names without x, y and z are not those of three coordinates in their order."""
    n_columns = len(words_of(rows[0]))
    if len(names) not in _counts(rows[0]):
        return
    plain = [_plain(name) for name in names]
    if n_columns > len(POINT) or (plain[0] and POINT_NUMBER.fullmatch(plain[0])):
        raise _no_names(text, n_columns, path)
    for at in (0, -1):
        letters = "".join(name[at] for name in plain if name)
        if letters != "xyz" and sorted(letters) == list("xyz"):
            raise _no_names(text, n_columns, path)


def _refuse_numbers_first(text: str, words: Sequence[str], rows: Sequence[str], path: Path) -> None:
    """Raise for rows that begin with the number of their point, which the heading does not name."""
    n_columns = len(words_of(rows[0]))
    if n_columns == len(words) + 1 and _are_counted(rows):
        raise _not_one_each(text, n_columns, path)


def _are_counted(rows: Sequence[str]) -> bool:
    """Whether rows begin with whole numbers that go up by one."""
    first = [words_of(row)[0] for row in rows]
    if not all(word.isdecimal() and len(word) < 16 for word in first):
        return False
    numbers = [int(word) for word in first]
    return len(numbers) > 1 and numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def _refuse_units(words: Iterable[str], path: Path) -> None:
    """Raise for coordinates in another unit than mm, which may stand behind the last one alone."""
    names = [_plain(word) for word in words]
    if {"x", "y"} <= set(names):
        told = [unit for unit in OTHER_UNITS if f"z_{unit}" in names]
        names = [f"{axis}_{unit}" for unit in told for axis in POINT]
    refuse_other_units(names, path_text(path))


def _taken(text: str) -> tuple[str, ...]:
    return (
        f"'{text[:LONGEST_SHOWN].strip()}' does not name x, y and z: the first three columns were "
        "taken for these, in mm",
    )


def _no_names(text: str, n_columns: int, path: Path) -> FileFormatError:
    return FileFormatError(
        f"'{text[:LONGEST_SHOWN].strip()}' does not say which of {n_columns} columns are x, y "
        "and z",
        where=path_text(path),
        remedy=NAME_THEM,
    )


def _not_one_each(text: str, n_columns: int, path: Path) -> FileFormatError:
    return FileFormatError(
        f"'{text[:LONGEST_SHOWN].strip()}' does not give one name to each of {n_columns} columns",
        where=path_text(path),
        remedy="name every column in that line, x, y and z among them",
    )


def _numbers(names: Iterable[str]) -> dict[str, int]:
    """Numbers of the columns that are known, by their names."""
    found: dict[str, int] = {}
    for k, name in enumerate(names):
        if known := KNOWN.get(_plain(name)):
            found.setdefault(known, k)
    return found


def _plain(name: str) -> str:
    return name.strip(" \t#/%;\"'").lower()


def _names(text: str, counts: set[int]) -> list[str]:
    """Names in a heading, which may hold blanks where a separator gives each column its own."""
    text = UNIT_IN_BRACKETS.sub(r"\1_\2", text).strip(" \r\n")
    for separator in (",", ";", "\t"):
        fields = [field.strip() for field in text.split(separator)]
        while len(fields) > 1 and len(fields) not in counts and not fields[-1]:
            fields.pop()
        if len(fields) > 1 and len(fields) in counts:
            return fields
    return words_of(text)


def _counts(row: str) -> set[int]:
    """How many columns a row may be said to have: empty ones at its end count or not."""
    filled = EMPTY_FIELD.sub(r"\1nan", row.strip())
    separated = {filled.count(mark) + 1 for mark in ",;" if mark in filled}
    return {len(words_of(filled)), *separated}


def words_of(line: str) -> list[str]:
    """Words of a line, between blanks, commas and semicolons; units are part of their names."""
    line = UNIT_IN_BRACKETS.sub(r"\1_\2", line)
    return [word for word in re.split(r"[,;\s]+", line.strip()) if word]
