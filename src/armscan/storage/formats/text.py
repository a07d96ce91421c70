# SPDX-License-Identifier: Apache-2.0
"""Points as text: XYZ and ASC with positions alone, CSV with all columns, and tables of other
programs.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from armscan.errors import FileFormatError
from armscan.geometry.arrays import FloatArray
from armscan.records.cloud import PointCloud
from armscan.storage.files import path_text
from armscan.storage.formats.columns import (
    FORCED,
    POINT,
    SIMULATED,
    WHOLE,
    CloudColumns,
    CloudPiece,
    cloud_columns,
    structured,
)
from armscan.storage.formats.headings import EMPTY_FIELD, named_columns, opening_of, words_of
from armscan.storage.tables import reads_as_float

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
    text = data.decode("utf-8-sig", errors="replace")
    lines, is_ended = text.splitlines(), text.endswith(("\n", "\r"))
    opening = opening_of(lines, path)
    body = [line.partition("#")[0] for line in lines[opening.n_lines :]]
    filled = list(islice((line for line in body if line.strip()), LOOKED_AT))
    if not filled:
        raise FileFormatError(
            "the file holds no points", where=path_text(path), remedy="write lines of x y z in mm"
        )
    for line in filled:
        _refuse_decimal_commas(line, path)
    n_named = len(words_of(opening.heading))
    if n_named > 1 and len(words_of(filled[0])) == 2 * n_named:
        raise FileFormatError(
            f"twice as many numbers as columns, as of commas in them: '{filled[0][:60]}'",
            where=path_text(path),
            remedy="write numbers with points: 1.5,2.5,3.5",
        )
    if not is_ended:
        _refuse_cut_line(body[-1], filled[0], len(lines), path)
    named = named_columns(opening, filled, path)
    numbers = tuple(named.numbers.values())
    values = _values("\n".join(body), numbers, path, opening.n_lines + 1)
    columns = {name: values[:, k] for k, name in enumerate(named.numbers)}
    notes = [line.removeprefix("# ") for line in lines if line.startswith("# ")]
    _refuse_cut(notes, len(values), len(lines), path, is_ended=is_ended)
    return CloudColumns(
        columns, _notes(notes), remarks=named.remarks, passed_over=named.passed_over
    )


def _values(body: str, columns: tuple[int, ...], path: Path, first: int) -> FloatArray:
    """(N, C) numbers of some columns of lines that are numbered from ``first``."""
    if EMPTY_FIELD.search(body):
        body = EMPTY_FIELD.sub(r"\1nan", body)
    body = body.replace(",", " ").replace(";", " ")
    try:
        return np.loadtxt(io.StringIO(body), usecols=columns, ndmin=2)
    except (ValueError, IndexError) as error:
        raise FileFormatError(
            f"the points are not understood{_first_wrong(body, columns, first)}",
            where=path_text(path),
            remedy="give one point a line: x y z in mm, with a point as decimal sign",
        ) from error


def _first_wrong(body: str, columns: tuple[int, ...], first: int) -> str:
    """Which line it is that holds no numbers in some columns."""
    for k, line in enumerate(body.split("\n")):
        words = line.split()
        try:
            for column in columns if words else ():
                float(words[column])
        except (ValueError, IndexError):
            return f": line {first + k} is '{line.strip()[:60]}'"
    return ""


def _refuse_cut_line(last: str, first: str, number: int, path: Path) -> None:
    """Raise for a last line without an end that holds less than the first one, or half a number."""
    words, wanted = words_of(last), words_of(first)
    pairs = zip(words, wanted, strict=False)
    is_half = any(reads_as_float(other) and not reads_as_float(word) for word, other in pairs)
    if words and (len(words) < len(wanted) or is_half):
        raise FileFormatError(
            f"the file seems cut: it ends within line {number}, '{last.strip()[:60]}'",
            where=path_text(path),
            remedy="copy or export it again; without that line the points before it can be read",
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
    raise FileFormatError(
        fact,
        where=path_text(path),
        remedy=f"copy it again, or delete the line '# points {wanted}' {on_purpose}",
    )


def _notes(notes: list[str]) -> tuple[str, ...]:
    """Notes of a table that armscan wrote; of an XYZ file its first line says them all."""
    if not notes or not notes[0].startswith(OWN_HEADER):
        return tuple(notes)
    words = notes[0].removeprefix(OWN_HEADER).split("; ")
    found = [f"frame {words[0]}", *([SIMULATED] if words[1:2] == [SIMULATED] else [])]
    reasons = [note.removeprefix(f"{FORCED}: ") for note in notes if note.startswith(f"{FORCED}: ")]
    return (*found, *(f"{FORCED} {k} {json.dumps(text)}" for k, text in enumerate(reasons)))


def _refuse_decimal_commas(line: str, path: Path) -> None:
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
            where=path_text(path),
            remedy="write them with points: 1.5 2.5 3.5",
        )
