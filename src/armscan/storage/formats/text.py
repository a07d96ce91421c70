# SPDX-License-Identifier: Apache-2.0
"""Points as text: XYZ and ASC with positions alone, CSV with all columns, and tables of other
programs.

Of these a heading is a bare line of names, or a ``#`` or ``//`` line with one name a column that is
no prose. Where the lines leave open which columns are meant the table is refused: a point's number
taken for its x is not seen in the result.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from armscan.errors import FileFormatError
from armscan.geometry.arrays import FloatArray
from armscan.records.cloud import PointCloud
from armscan.storage.files import path_text
from armscan.storage.formats.columns import (
    COVARIANCE,
    FORCED,
    NOISE_LENGTH,
    NORMAL,
    POINT,
    SIMULATED,
    WHOLE,
    CloudColumns,
    CloudPiece,
    cloud_columns,
    structured,
)
from armscan.storage.tables import (
    OTHER_UNITS,
    reads_as_float,
    refuse_decimal_commas,
    refuse_other_units,
)

SIGMA_LOSS = "sigma_mm and covariance"
XYZ_LOSES = (
    "normals",
    SIGMA_LOSS,
    "sheet, exposure and segment",
    "intensity",
    "where the sensor stood",
    "which calibration",
    "n_points of a fused cloud",
    "digits beyond 0.1 nm",
)
"""What an XYZ file does not hold."""
CSV_LOSES = ("digits beyond 0.1 nm of a position, and beyond nine of anything else",)

LOOKED_AT = 1000
"""Lines in which decimal commas are sought: a table that has them has them everywhere."""
KNOWN = {
    **{name: name for name in (*POINT, *NORMAL, *COVARIANCE, *WHOLE, NOISE_LENGTH)},
    **{name: name for name in ("sigma_noise_mm", "intensity")},
    **{f"{name}_mm": name for name in POINT},
    **{f"points{mark}{k}": name for mark in ":_" for k, name in enumerate(POINT)},
}
"""Columns that are read, by their names in a heading; ``Points:0`` is ParaView's."""
FIRST_THREE: Mapping[str, int] = {name: k for k, name in enumerate(POINT)}
COMMENT_MARKS = ("#", "//")
SEPARATORS = (",", ";", "\t")
PADDED = "\t\t"
"""Separator of rows in which one tab or several stand between two fields."""
PADS, MARKS = re.compile(r"\t[ \t]*"), re.compile(r"[,;\t]")
QUOTED = re.compile(r'(^|[,;\t]) *"(?! *[,;\t])((?:[^"]|"")*)"(?= *(?:[,;\t]|$))')
"""A field between quotation marks, of which ditto marks are none: ``P1;";";1.5``."""
COLUMNS_ARE = re.compile(r"^(columns?|fields?|format|header)\s*[:=\s]\s*", re.IGNORECASE)
"""Before the names of columns in a comment: ``# columns: id x y z``."""
NAMES_FOLLOW = re.compile(r"(columns?|fields?)\s*[:=]", re.IGNORECASE)
INTRODUCING = (
    *("are", "as", "columns", "coordinates", "coords", "data", "fields", "format"),
    *("in", "is", "lines", "of", "order", "rows"),
)
"""Words of prose before x, y and z, which name no column: ``# export of x y z intensity``."""
FIRST_COLUMNS = re.compile(r"1(-|\.\.)3|0(-|\.\.)2")
AXES = {"axes", "axis", "directions"}
POINT_NUMBER = re.compile(
    r"((points?|pt|vertex|row)[ _.-]*)?(id|nr|no|num|number|index|idx|name)?\.?", re.IGNORECASE
)
"""Names of a column that says which point it is; without the last part they are words of prose."""
EMPTY_FIELD = re.compile(r"(^|[,;])[ \t]*(?=[,;])")
"""Nothing between two separators: a value that is missing, which must not move the next ones."""
UNIT_IN_BRACKETS = re.compile(r"(\w)[ \t]*[\[(][ \t]*([A-Za-z\u00b5\u03bc\ufffd]+)[ \t]*[\])]")
"""A column's name, its last character, and its unit: ``X [mm]``, ``y(m)``."""
LEAST_COUNTED = 3
"""Rows from which numbers that go up by one are taken for numbers of points."""
NAME_THEM = "name the columns x, y, z in that line, or delete it if the first three are these"
LONGEST_SHOWN = 60
OWN_HEADER, OWN_NOTE = "x_mm y_mm z_mm in frame ", "written by armscan"
COUNT = re.compile(r"points (\d+)")
"""Note of a file that armscan wrote: of how many points, so that one that was cut is told."""


def xyz_bytes(points: PointCloud | CloudPiece) -> bytes:
    """Content of an XYZ text file; it lacks `XYZ_LOSES`."""
    piece = points if isinstance(points, CloudPiece) else CloudPiece(points)
    return b"".join(xyz_parts(piece.cloud, len(piece.cloud), [piece]))


def xyz_parts(marks: PointCloud, n_points: int, pieces: Iterable[CloudPiece]) -> Iterator[bytes]:
    """As `xyz_bytes`, of a cloud that comes in pieces; ``marks`` are its names and marks."""
    frame = f"{marks.frame}; {SIMULATED}" if marks.is_simulated else marks.frame
    header = f"{OWN_HEADER}{frame}; not in this file: {'; '.join(XYZ_LOSES)}"
    header = "\n".join(
        (header, f"points {n_points}", *(f"{FORCED}: {reason}" for reason in marks.forced))
    )
    for k, piece in enumerate(pieces):
        buffer = io.StringIO()
        np.savetxt(buffer, piece.cloud.points_mm, fmt="%.7f", header=header if k == 0 else "")
        yield buffer.getvalue().encode()


def csv_bytes(piece: CloudPiece) -> bytes:
    """Content of a table with a heading, notes in ``#`` lines below it, and all columns."""
    found = cloud_columns(piece)
    heading = ",".join(f"{name}_mm" if name in POINT else name for name in found.columns)
    formats = {**dict.fromkeys(POINT, "%.7f"), **dict.fromkeys(WHOLE, "%d")}
    notes = "".join(f"# {note}\n" for note in (*found.notes, f"points {len(piece.cloud)}"))
    buffer = io.StringIO()
    row = ",".join(formats.get(name, "%.9g") for name in found.columns)
    np.savetxt(buffer, structured(found.columns), fmt=row)
    return f"{heading}\n{notes}{buffer.getvalue()}".encode()


def text_columns(data: bytes, path: Path) -> CloudColumns:
    """Columns of a table of numbers: those that its heading names, else the first three as xyz."""
    if b"\0" in data[:LONGEST_SHOWN]:
        raise _refusal("this is not UTF-8 text", path, "save it as text in UTF-8")
    text = data.decode("utf-8-sig", errors="replace")
    lines, is_ended = text.splitlines(), text.endswith(("\n", "\r"))
    opening = opening_of(lines, path)
    body = [_unquoted(line.partition("#")[0]) for line in lines[opening.n_lines :]]
    filled = [line for line in body if line.strip()]
    if not filled:
        raise _refusal("the file holds no points", path, "write lines of x y z in mm")
    for line in filled[:LOOKED_AT]:
        refuse_decimal_commas(line, path_text(path))
    n_named = len(words_of(opening.heading))
    may_have_commas = "," in filled[0] and "." not in filled[0]
    if may_have_commas and n_named > 2 and len(_fields(filled[0], ",")) == 2 * n_named:
        fact = f"twice as many numbers as columns, as of commas in them: '{filled[0][:60]}'"
        raise _refusal(fact, path, "write numbers with points: 1.5,2.5,3.5")
    named = named_columns(opening, filled[:LOOKED_AT], path)
    separator = _separator(named, filled, path)
    if not is_ended:
        last, first = (_fields(line, separator) for line in (body[-1], filled[0]))
        _refuse_cut_line(last, first, f"line {len(lines)}, '{lines[-1].strip()[:60]}'", path)
    filled_body = "\n".join(line if line.strip() else "" for line in body)
    read = tuple(named.numbers.values())
    values = _values(filled_body, separator, read, path, opening.n_lines + 1)
    columns = {name: values[:, k] for k, name in enumerate(named.numbers)}
    notes = [line.removeprefix("# ") for line in lines if line.startswith("# ")]
    _refuse_cut(notes, len(values), len(lines), path, is_ended=is_ended)
    return CloudColumns(
        columns, _notes(notes), remarks=named.remarks, passed_over=named.passed_over
    )


@dataclass(frozen=True, slots=True)
class Opening:
    """Lines of a table before its first row.

    ``heading`` is the bare line of names, empty without one, and ``comments`` is the text of the
    ``#`` and ``//`` lines.
    """

    n_lines: int
    heading: str
    comments: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class NamedColumns:
    """Numbers of the columns that are read, by name, and what to say of the others.

    ``mark`` stands between the ``n_names`` names, which may hold blanks; it is empty where these
    are words. Without names there are 0.
    """

    numbers: Mapping[str, int]
    passed_over: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    mark: str = ""
    n_names: int = 0


def opening_of(lines: Sequence[str], path: Path) -> Opening:
    """What stands before the first row: comments, a count of points, and names of columns."""
    heading, has_count, comments = "", False, list[str]()
    for k, line in enumerate(lines):
        text = line.strip()
        if text.startswith(COMMENT_MARKS):
            comments.append(text.lstrip("#/ "))
            continue
        words = words_of(line)
        if not words:
            continue
        if not has_count and len(words) == 1 and words[0].isdecimal():
            has_count = True
        elif not heading and _names_columns(line, k, path):
            heading = _unquoted(line)
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
        fact = f"{number} is neither a point nor a heading: '{line[:LONGEST_SHOWN]}'"
        raise _refusal(fact, path, "correct the line, or put # before it")
    return True


def named_columns(opening: Opening, rows: Sequence[str], path: Path) -> NamedColumns:
    """Which columns are read, by what stands before the first of some rows.

    Raises
    ------
    FileFormatError
        If it leaves open which columns are x, y and z, or they are in another unit than mm.
    """
    found = _named(opening.heading, rows)
    if found and not _is_prose(opening.heading, found.numbers, rows):
        return found
    for text in reversed(opening.comments):
        found = _named(COLUMNS_ARE.sub("", text), rows)
        if found and _are_names(text, found.numbers, rows):
            return _remarked(found, text)
    for text in (opening.heading, *opening.comments):
        _refuse_units(words_of(text), path)
    if opening.heading:
        return _by_heading(opening.heading, rows, path)
    return _by_comments(opening.comments, rows, path)


def _named(text: str, rows: Sequence[str]) -> NamedColumns | None:
    """Columns by a line with as many names as these, x, y and z among them; else None."""
    counts = _counts(rows[0])
    names, mark = _names(text, counts)
    numbers = _numbers(names)
    if not set(POINT) <= set(numbers) or len(names) not in counts:
        return None
    read = set(numbers.values())
    passed_over = (word for k, word in enumerate(names) if k not in read and word)
    return NamedColumns(numbers, tuple(passed_over), mark=mark, n_names=len(names))


def _is_prose(heading: str, numbers: Mapping[str, int], rows: Sequence[str]) -> bool:
    """Whether a bare line between blanks says ``Data X Y Z``, which is one word more."""
    if _names(heading, _counts(rows[0]))[1]:
        return False
    before = words_of(heading)[: min(numbers[name] for name in POINT)]
    return any(_introduces(word, rows) for word in before)


def _are_names(comment: str, numbers: Mapping[str, int], rows: Sequence[str]) -> bool:
    """Whether a comment of as many words as columns names these.

    Prose may have as many by chance, as ``# points: x y z`` over four columns has.
    """
    names, mark = _names(COLUMNS_ARE.sub("", comment), _counts(rows[0]))
    before = names[: max(numbers[name] for name in POINT)]
    if all(_is_name(name, k, rows, is_sure=bool(mark)) for k, name in enumerate(before)):
        return True
    if mark:
        return all(len(name.split()) <= 1 for name in names)
    return bool(NAMES_FOLLOW.match(comment)) and not any(_introduces(w, rows) for w in before)


def _is_name(name: str, k: int, rows: Sequence[str], *, is_sure: bool) -> bool:
    """Whether a word is the name of a known column, or of points' numbers, that fits column k."""
    plain = _plain(name)
    known, number = KNOWN.get(plain), POINT_NUMBER.fullmatch(plain)
    if is_sure:
        return bool(known or number)
    if known:
        return known not in WHOLE or _are_whole(rows, k)
    return number is not None and (bool(number[3]) or (k == 0 and _are_counted(rows)))


def _remarked(found: NamedColumns, text: str) -> NamedColumns:
    """The same, with a remark where x, y and z are not the first three columns."""
    at = [found.numbers[name] for name in POINT]
    if at == list(FIRST_THREE.values()):
        return found
    columns = "columns {}, {} and {}".format(*(k + 1 for k in at))
    return replace(found, remarks=(f"x, y and z are {columns}, as {_quoted(text)} names them",))


def _by_heading(heading: str, rows: Sequence[str], path: Path) -> NamedColumns:
    """Columns of a bare heading that does not give x, y, z and all others one name each."""
    n_columns, words = len(words_of(rows[0])), words_of(heading)
    for mark in SEPARATORS:
        names = _fields(UNIT_IN_BRACKETS.sub(r"\1_\2", heading), mark)
        numbers = _numbers(names)
        if set(POINT) <= set(numbers):
            if numbers["x"] == 0:
                _refuse_numbers_first(heading, words, rows, path)
            return NamedColumns(numbers, mark=mark, n_names=len(names))
    numbers = _numbers(words)
    if set(POINT) <= set(numbers):
        if any(numbers[name] != k for name, k in FIRST_THREE.items()):
            raise _unclear(heading, words, n_columns, path)
        _refuse_numbers_first(heading, words, rows, path)
        return NamedColumns(numbers)
    if len(words) > 1:
        _refuse_unknown(heading, _names(heading, _counts(rows[0]))[0], rows, path)
        if n_columns > len(POINT):
            raise _no_names(heading, n_columns, path)
    return NamedColumns(FIRST_THREE, remarks=_taken(heading))


def _by_comments(comments: Sequence[str], rows: Sequence[str], path: Path) -> NamedColumns:
    """Columns of a table without a heading, where no comment gives each column its name."""
    n_columns = len(words_of(rows[0]))
    remarks: tuple[str, ...] = ()
    for text in comments:
        told = _told_in_prose(text, rows, path)
        if told == ():
            return NamedColumns(FIRST_THREE)
        remarks = remarks or told or ()
    last = COLUMNS_ARE.sub("", comments[-1]) if comments else ""
    if remarks or _may_be_names(last, rows, path):
        return NamedColumns(FIRST_THREE, remarks=remarks or _taken(comments[-1]))
    if n_columns > len(POINT) and len(rows) >= LEAST_COUNTED and _are_counted(rows):
        return NamedColumns(
            FIRST_THREE,
            remarks=(
                "the first column counts the lines and was taken for x: if it numbers the points, "
                "write a first line with the names of the columns, as 'id x y z'",
            ),
        )
    return NamedColumns(FIRST_THREE)


def _told_in_prose(comment: str, rows: Sequence[str], path: Path) -> tuple[str, ...] | None:
    """Remarks on a comment that has x, y and z in it, after which the first three columns are read.

    None where it has not.
    """
    words, n_columns = words_of(COLUMNS_ARE.sub("", comment)), len(words_of(rows[0]))
    order = [KNOWN.get(_plain(word.strip("()[]:.")), "") for word in words]
    if not set(POINT) <= set(order):
        return None
    runs = [k for k in range(len(order) - 2) if set(order[k : k + 3]) == set(POINT)]
    start, end = (runs[0], runs[0] + 3) if runs else (len(words), len(words))
    before, has_more = words[:start], n_columns > len(POINT)
    is_ordered = not runs or order[start:end] == list(POINT)
    is_numbered = has_more and _are_counted(rows)
    if has_more or _are_counted(rows):
        is_numbered = is_numbered or _speak_of_numbers(before, rows)
    if is_numbered or not (is_ordered or " ".join(words[end : end + 1]).lower() in AXES):
        raise _unclear(comment, words, n_columns, path)
    if is_ordered and (start == 0 or not has_more):
        return ()
    is_named = bool(runs) and start > 0 and has_more and words[start][0] not in "(["
    if is_named and not _introduces(before[-1], rows):
        raise _unclear(comment, words, n_columns, path)
    return _taken(comment, n_columns)


def _speak_of_numbers(words: Sequence[str], rows: Sequence[str]) -> bool:
    """Whether some words before x, y and z name points' numbers, which the first column may be."""
    named = [_is_sure_number(word) for word in words]
    return any(named) and (named[-1] or _are_whole(rows, 0))


def _may_be_names(last: str, rows: Sequence[str], path: Path) -> bool:
    """Whether a comment without x, y and z may name the columns.

    Raises
    ------
    FileFormatError
        If these may be others than x, y and z in the first three.
    """
    counts = _counts(rows[0])
    names, mark = _names(last, counts)
    if len(names) not in counts or len(names) < len(POINT):
        return False
    # prose has colons and numbers, names of columns have none
    if not all(re.fullmatch(r"[\W_]*[A-Za-z][^:]*", word) for word in words_of(last)):
        return False
    _refuse_unknown(last, names, rows, path, is_prose=not mark and not _numbers(names))
    return True


def _introduces(word: str, rows: Sequence[str]) -> bool:
    """Whether a word before x, y and z belongs to prose and names no column."""
    plain = _plain(word).strip("([:=")
    if any(letter.isdecimal() for letter in plain):
        return FIRST_COLUMNS.fullmatch(plain) is not None
    if word.endswith((":", "=", "(")) or plain in INTRODUCING:
        return True
    number = POINT_NUMBER.fullmatch(plain)
    return number is not None and not number[3] and not _are_whole(rows, 0)


def _is_sure_number(word: str) -> bool:
    """Whether a word names points' numbers, as ``point``, a word of prose, does not."""
    number = POINT_NUMBER.fullmatch(_plain(word).strip("([:="))
    return number is not None and bool(number[3])


def _refuse_unknown(
    text: str, names: Sequence[str], rows: Sequence[str], path: Path, *, is_prose: bool = False
) -> None:
    """Raise where names without x, y and z are not those of three coordinates in their order.

    Of what may be prose only where something in it, or in the rows, speaks for other columns.
    """
    n_columns = len(words_of(rows[0]))
    if len(names) not in _counts(rows[0]):
        return
    plain = [_plain(name) for name in names]
    has_more = n_columns > len(POINT)
    if has_more and (not is_prose or _are_counted(rows)):
        raise _no_names(text, n_columns, path)
    is_word_of_prose = POINT_NUMBER.fullmatch(plain[0]) and not _is_sure_number(plain[0])
    if plain[0] and (_is_sure_number(plain[0]) or (is_word_of_prose and _are_whole(rows, 0))):
        raise _no_names(text, n_columns, path)
    for at in (0, -1):
        letters = "".join(name[at] for name in plain if name)
        triples = [letters[k : k + 3] for k in range(len(letters) - 2)]
        others = [three for three in triples if sorted(three) == list("xyz")]
        if others and triples[0] != "xyz":
            raise _no_names(text, n_columns, path)


def _refuse_numbers_first(text: str, words: Sequence[str], rows: Sequence[str], path: Path) -> None:
    """Raise for rows that begin with the number of their point, which the heading does not name."""
    n_columns = len(words_of(rows[0]))
    if n_columns == len(words) + 1 and _are_counted(rows):
        raise _not_one_each(text, n_columns, path)


def _are_counted(rows: Sequence[str]) -> bool:
    """Whether rows begin with whole numbers that go up by one."""
    if len(rows) < 2 or not _are_whole(rows, 0):
        return False
    first = [float(_words(row)[0]) for row in rows]
    return all(after - before == 1.0 for before, after in pairwise(first))


def _are_whole(rows: Sequence[str], k: int) -> bool:
    """Whether column k holds whole numbers alone, however they are written, none below 0."""
    words = [_words(row)[k : k + 1] for row in rows]
    return all(
        word and reads_as_float(word[0]) and float(word[0]).is_integer() and float(word[0]) >= 0.0
        for word in words
    )


def _refuse_units(words: Iterable[str], path: Path) -> None:
    """Raise for coordinates in another unit than mm, which may stand behind the last one alone."""
    names = [_plain(word) for word in words]
    if {"x", "y"} <= set(names):
        told = [unit for unit in OTHER_UNITS if f"z_{unit}" in names]
        names = [f"{axis}_{unit}" for unit in told for axis in POINT]
    refuse_other_units(names, path_text(path))


def _taken(text: str, n_columns: int = 0) -> tuple[str, ...]:
    """Of a line without the names of x, y and z, or without those of all of some columns."""
    lacks = f"give one name to each of {n_columns} columns" if n_columns else "name x, y and z"
    taken = "the first three columns were taken for x, y and z, in mm"
    return (f"{_quoted(text)} does not {lacks}: {taken}",)


def _refusal(fact: str, path: Path, remedy: str) -> FileFormatError:
    return FileFormatError(fact, where=path_text(path), remedy=remedy)


def _quoted(text: str) -> str:
    return f"'{text[:LONGEST_SHOWN].strip()}'"


def _unclear(text: str, words: Sequence[str], n_columns: int, path: Path) -> FileFormatError:
    """Of a comment that has as many words as there are columns, or another count."""
    if len(words) != n_columns:
        return _not_one_each(text, n_columns, path)
    return _refusal(
        f"{_quoted(text)} may be prose or the names of {n_columns} columns",
        path,
        "write commas between the names, as 'id,x,y,z', or delete the line if the first "
        "three columns are x, y and z",
    )


def _no_names(text: str, n_columns: int, path: Path) -> FileFormatError:
    return _refusal(
        f"{_quoted(text)} does not say which of {n_columns} columns are x, y and z", path, NAME_THEM
    )


def _not_one_each(text: str, n_columns: int, path: Path) -> FileFormatError:
    fact = f"{_quoted(text)} does not give one name to each of {n_columns} columns"
    return _refusal(fact, path, "name every column in that line, x, y and z among them")


def _numbers(names: Iterable[str]) -> dict[str, int]:
    """Numbers of the columns that are known, by their names."""
    found: dict[str, int] = {}
    for k, name in enumerate(names):
        if known := KNOWN.get(_plain(name)):
            found.setdefault(known, k)
    return found


def _plain(name: str) -> str:
    return name.strip(" \t#/%;\"'").lower()


def _names(text: str, counts: set[int]) -> tuple[list[str], str]:
    """Names in a heading, and the mark between them, which gives each of some columns one.

    They are words where there is none, or where only the words are x, y and z: ``name\\tx y z``.
    """
    text = UNIT_IN_BRACKETS.sub(r"\1_\2", text).strip(" \r\n")
    words, point = words_of(text), set(POINT)
    for mark in SEPARATORS:
        for names in (_fields(text, mark), text.split(mark)):
            is_meant = point <= set(_numbers(names)) or not point <= set(_numbers(words))
            if 1 < len(names) in counts and is_meant:
                return [name.strip() for name in names], mark
    return words, ""


def _separator(named: NamedColumns, rows: Sequence[str], path: Path) -> str:
    """What stands between the fields of rows, by the names of their columns; empty for blanks.

    The mark between the names comes first, for fields of text may hold the others. It gives the
    columns that are read numbers, or nothing.
    """
    read, last = named.numbers.values(), max(named.numbers.values())
    marks = sorted(SEPARATORS, key=lambda mark: mark != named.mark) if named.n_names else []
    fallback = ""
    for mark in (mark for mark in marks if rows[0].count(mark) >= last):
        found = _tabs(named, rows, path) if mark == "\t" else mark
        if mark == named.mark:
            fallback = found  # refused by its line: words of text might be numbers
        fields = _fields(rows[0], found)
        is_wide = mark != named.mark and len(fields) > named.n_names
        if not is_wide and all(reads_as_float("".join(fields[k : k + 1]) or "nan") for k in read):
            return found
    return fallback


def _tabs(named: NamedColumns, rows: Sequence[str], path: Path) -> str:
    """A tab, `PADDED` where some tabs only pad, or nothing where the words are as many as names.

    Where rows have more fields than names, and empty ones before those that are read, tabs pad.
    """
    n_names, last = named.n_names, max(named.numbers.values())
    wide = [row for row in rows if row.rstrip().count("\t") >= n_names]
    wide = [row for row in wide if not all(map(str.strip, row.split("\t")[: last + 1]))]
    if not wide:
        return "\t"
    n_fields = {len(PADS.findall(row.strip())) + 1 for row in rows}
    if n_fields == {n_names} or (len(n_fields) == 1 and last == 2 < max(n_fields)):
        return PADDED
    is_as_ever = last == 2 and named.mark != "\t"
    if is_as_ever or all(len(words_of(row)) == n_names for row in rows):
        return ""
    fact = f"a line has more tabs than stand between {n_names} columns: {_quoted(wide[0])}"
    raise _refusal(fact, path, "write one tab between two columns")


def _unquoted(line: str) -> str:
    """A line without the quotation marks around fields, in which no mark separates any more."""
    if '"' not in line:
        return line
    return QUOTED.sub(lambda found: found[1] + MARKS.sub("\u201a", found[2]), line)


def _fields(row: str, separator: str) -> list[str]:
    """Fields of a row up to the last that is not empty; words where there is no separator."""
    if not separator:
        return words_of(row)
    if separator == PADDED:
        row = PADS.sub("\t", row.strip())
    fields = [field.strip() for field in row.split(separator[0])]
    while fields and not fields[-1]:
        fields.pop()
    return fields


def _words(row: str) -> list[str]:
    """Words of a row, of which missing ones are kept."""
    return words_of(EMPTY_FIELD.sub(r"\1nan", row.strip()))


def _counts(row: str) -> set[int]:
    """How many columns a row may be said to have: empty ones at its end count or not."""
    row = row.strip(" \r\n")
    full = {row.count(mark) + 1 for mark in SEPARATORS if mark in row}
    filled = {len(_fields(row, mark)) for mark in (*SEPARATORS, PADDED) if mark[0] in row}
    return {len(_words(row)), *full, *filled}


def words_of(line: str) -> list[str]:
    """Words of a line, between blanks, commas and semicolons; units are part of their names."""
    line = UNIT_IN_BRACKETS.sub(r"\1_\2", line)
    return [word for word in re.split(r"[,;\s]+", line.strip()) if word]


def _values(
    body: str, separator: str, columns: tuple[int, ...], path: Path, first: int
) -> FloatArray:
    """(N, C) numbers of some columns of lines that are numbered from ``first``."""
    if separator == PADDED:
        body = PADS.sub("\t", "\n".join(map(str.strip, body.split("\n"))))
        if not body.isascii():
            body = "\n".join("\t".join(_fields(line, "\t")) for line in body.split("\n"))
        separator = "\t"
    elif separator != "\t":
        body = body.replace("\t", " ")
    # an empty field is a value that is missing, which must not move the next ones
    mark = f"[{separator or ',;'}]"
    body = re.sub(rf"^ *(?={mark})|(?<={mark}) *(?={mark}|$)", "nan", body, flags=re.MULTILINE)
    if not separator:
        body = body.replace(",", " ").replace(";", " ")
    try:
        return np.loadtxt(io.StringIO(body), delimiter=separator or None, usecols=columns, ndmin=2)
    except (ValueError, IndexError) as error:
        fact = f"the points are not understood{_first_wrong(body, separator, columns, first)}"
        remedy = "give one point a line: x y z in mm, with a point as decimal sign"
        raise _refusal(fact, path, remedy) from error


def _first_wrong(body: str, separator: str, columns: tuple[int, ...], first: int) -> str:
    """Which line it is that holds no numbers in some columns."""
    for k, line in enumerate(body.split("\n")):
        fields = line.split(separator or None) if line.strip() else []
        try:
            for column in columns if fields else ():
                float(fields[column])
        except (ValueError, IndexError):
            return f": line {first + k} is '{line.strip()[:60]}'"
    return ""


def _refuse_cut_line(fields: Sequence[str], wanted: Sequence[str], place: str, path: Path) -> None:
    """Raise for a last line without an end that holds less than the first one, or half a number."""
    pairs = zip(fields, wanted, strict=False)
    is_half = any(reads_as_float(other) and not reads_as_float(one) for one, other in pairs)
    if fields and (len(fields) < len(wanted) or is_half):
        raise _refusal(
            f"the file seems cut: it ends within {place}",
            path,
            "copy or export it again; without that line the points before it can be read",
        )


def _refuse_cut(
    notes: list[str], n_points: int, n_lines: int, path: Path, *, is_ended: bool
) -> None:
    """Raise for a table of armscan's that says in its notes that it held other points."""
    stated = [found[1] for note in notes if (found := COUNT.fullmatch(note))]
    is_own = bool(notes) and (notes[0].startswith(OWN_HEADER) or OWN_NOTE in notes)
    if not (is_own and stated):
        return
    wanted = int(stated[0])
    if n_points == wanted and is_ended:
        return
    on_purpose = "if points were left out or added on purpose"
    fact = f"its header tells of {wanted:,} points, and it holds {n_points:,}"
    if n_points < wanted:
        fact = f"the file seems cut: {fact}, the last in line {n_lines}"
    elif n_points == wanted:
        fact = f"the file seems cut within its last point: line {n_lines} has no end"
        on_purpose = "if that line is whole"
    raise _refusal(
        fact, path, f"copy it again, or delete the line '# points {wanted}' {on_purpose}"
    )


def _notes(notes: list[str]) -> tuple[str, ...]:
    """Notes of a table that armscan wrote; of an XYZ file its first line says them all."""
    if not notes or not notes[0].startswith(OWN_HEADER):
        return tuple(notes)
    words = notes[0].removeprefix(OWN_HEADER).split("; ")
    found = [f"frame {words[0]}", *([SIMULATED] if words[1:2] == [SIMULATED] else [])]
    reasons = [note.removeprefix(f"{FORCED}: ") for note in notes if note.startswith(f"{FORCED}: ")]
    return (*found, *(f"{FORCED} {k} {json.dumps(text)}" for k, text in enumerate(reasons)))
