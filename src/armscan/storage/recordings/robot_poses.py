# SPDX-License-Identifier: Apache-2.0
"""How rotations are written in tables, and tables of a robot's poses."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product, takewhile
from pathlib import Path, PureWindowsPath
from typing import Any, Final, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from armscan.errors import FileFormatError
from armscan.geometry.arrays import BoolArray, FloatArray
from armscan.geometry.poses import Base, Pose, Tool
from armscan.geometry.rotations import (
    EulerConvention,
    euler_from_rotations,
    rotations_from_euler,
    vector_from_rotation,
)
from armscan.records.recording import PoseForm
from armscan.storage.codec import parse_json
from armscan.storage.files import read_bytes
from armscan.storage.tables import reads_as_float, refuse_beyond_reach

USUAL_EULER: EulerConvention = "extrinsic-xyz"
"""Of angles in a table where nobody says what they mean."""
POSITION: Final = ("x_mm", "y_mm", "z_mm")
FORM_COLUMNS: Final[dict[PoseForm, tuple[str, ...]]] = {
    "quaternion": ("qw", "qx", "qy", "qz"),
    "matrix": tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)),
    "euler": ("a_deg", "b_deg", "c_deg"),
    "joints": (),
}
NORM_TOLERANCE = 1e-6
ORTHONORMAL_TOLERANCE = 1e-5
"""Six decimals of nine numbers leave up to about 3e-6, more than a `Pose` allows; what passes is
made exact before it becomes one."""
FULL_TURNS_DEG = 720.0
FEWEST_DECIMALS = 4
"""With which rotations are read as they are rounded: their last digit is 0.1 mrad."""


def _last_digit(numbers: FloatArray) -> float:
    """1e-4 or less: the size of the last decimal that any of the numbers has."""
    for decimals in range(FEWEST_DECIMALS, 9):
        if np.array_equal(np.round(numbers, decimals), numbers):
            return float(10.0**-decimals)
    return 0.0


def rotations_of_form(
    numbers: FloatArray, form: PoseForm, convention: EulerConvention, places: Sequence[str]
) -> FloatArray:
    """Rotations (N, 3, 3) of numbers (N, C) in the order of `FORM_COLUMNS`.

    A quaternion is w, x, y, z (Hamilton, active), of either sign and norm 1 within 1e-6; a matrix
    is row by row and orthonormal within 1e-5, and the nearest rotation is taken; where all numbers
    are rounded to less, to four decimals at least, within what rounding does.

    Numbers are finite; ``places`` (N,) name file and line of each, for messages.
    """
    if form == "quaternion":
        return _from_quaternions(numbers, places)
    if form == "matrix":
        return _from_matrices(numbers.reshape(-1, 3, 3), places)
    largest = np.abs(numbers).max(axis=1, initial=0.0)
    if (largest > FULL_TURNS_DEG).any():
        row = int(np.argmax(largest > FULL_TURNS_DEG))
        raise FileFormatError(
            f"an angle of {largest[row]:g} deg",
            where=places[row],
            remedy="check that positions and angles are in their columns",
        )
    return rotations_from_euler(np.radians(numbers), convention)


def pose_numbers(
    rotations: FloatArray, is_known: BoolArray, form: PoseForm, convention: EulerConvention
) -> FloatArray:
    """Numbers (N, C) in the order of `FORM_COLUMNS`, NaN where the pose is not known."""
    numbers = np.full((len(rotations), len(FORM_COLUMNS[form])), np.nan)
    known = rotations[is_known]
    if not len(known):
        return numbers
    if form == "quaternion":
        numbers[is_known] = np.roll(Rotation.from_matrix(known).as_quat(canonical=True), 1, axis=1)
    elif form == "matrix":
        numbers[is_known] = known.reshape(-1, 9)
    else:
        numbers[is_known] = np.degrees(euler_from_rotations(known, convention))
    return numbers


def _from_quaternions(numbers: FloatArray, places: Sequence[str]) -> FloatArray:
    if not len(numbers):
        return np.zeros((0, 3, 3))
    norms = np.linalg.norm(numbers, axis=1)
    # half a digit of each, times at most the sum of all four: 2
    tolerance = max(NORM_TOLERANCE, 1.01 * _last_digit(numbers))
    wrong = np.abs(norms - 1.0) > tolerance
    if wrong.any():
        row = int(np.argmax(wrong))
        raise FileFormatError(
            f"the quaternion's norm is {norms[row]:.8g}, not 1 within {tolerance:.0e}",
            where=places[row],
            remedy="write qw,qx,qy,qz with seven decimals or more, each in its own column",
        )
    return np.asarray(Rotation.from_quat(np.roll(numbers, -1, axis=1)).as_matrix())


def _from_matrices(matrices: FloatArray, places: Sequence[str]) -> FloatArray:
    defect = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0)
    is_mirrored = np.linalg.det(matrices) < 0.0
    # of two rows, half a digit of each number, times at most the sum of three: 1.8
    tolerance = max(ORTHONORMAL_TOLERANCE, 1.8 * _last_digit(matrices))
    wrong = (defect > tolerance) | is_mirrored
    if wrong.any():
        row = int(np.argmax(wrong))
        fact = (
            "mirrors" if is_mirrored[row] else f"is not orthonormal: |R R' - 1| = {defect[row]:.2g}"
        )
        raise FileFormatError(
            f"the matrix {fact}",
            where=places[row],
            remedy="write r11,r12,r13,r21 and so on, row by row, with seven decimals or more",
        )
    left, _, right = np.linalg.svd(matrices)
    is_exact = defect < 1e-14
    return np.where(is_exact[:, None, None], matrices, left @ right)


REACH_MM = 10.0
"""No arm keeps its last link this near to the origin of Base; in metres, no arm gets farther."""
MOVED_MM = 0.01
TURNED_RAD = math.radians(3.0)

METRES_REMEDY = (
    "multiply x, y and z by 1000; if they are millimetres, add 1000 to each x, for Base may lie "
    "anywhere"
)


def are_within_reach_of_base(translations_mm: FloatArray) -> bool:
    """True if all (N, 3) positions lie within 10 mm of Base's origin, and not all at it."""
    if not len(translations_mm):
        return False
    distance = np.linalg.norm(translations_mm, axis=1)
    return bool(0.0 < distance.max() < REACH_MM)


def are_surely_metres(rotations: FloatArray, translations_mm: FloatArray) -> bool:
    """True if the poses of an arm make no sense in millimetres.

    They do not where the tool stays within 10 mm of Base's origin and moves, while it turns about
    two axes: a stage of small travel does not turn, and a turntable turns about one axis only.

    Parameters
    ----------
    rotations
        (N, 3, 3) of ``base_from_tool``.
    translations_mm
        (N, 3) as written under the name of millimetres.
    """
    if len(rotations) < 3 or not are_within_reach_of_base(translations_mm):
        return False
    moved = np.linalg.norm(translations_mm - translations_mm.mean(axis=0), axis=1).max()
    chosen = np.unique(np.linspace(0, len(rotations) - 1, 200).astype(np.int64))
    turns = np.array([vector_from_rotation(rotations[0].T @ rotations[k]) for k in chosen])
    _, _, axes = np.linalg.svd(turns, full_matrices=False)
    about_second = np.abs(turns @ axes[1]).max()
    return bool(moved > MOVED_MM and about_second > TURNED_RAD)


JSON_KEY = "RobPoses"
QUATERNION = FORM_COLUMNS["quaternion"]
HEADERS = (
    ("x", "y", "z", "w", "p", "r"),
    ("x", "y", "z", "a", "b", "c"),
    ("x", "y", "z", "rx", "ry", "rz"),
    *(("x", "y", "z", *order) for order in (QUATERNION, (*QUATERNION[1:], QUATERNION[0]))),
)
"""Headers that are understood, without units and case."""
METRES = re.compile(r"^x[_ (\[]*m\b", re.IGNORECASE)
"""The first word of a header whose positions are in metres."""
METRES_COMMENT = re.compile(
    rb"^[ \t]*(?!.*(?:\b(?:in|is|are|to)|[:=(\[])[ \t]*(?:mm\b|millimet))"
    rb"#(?:.*(?:\b(?:in|are|units?|positions?|places?|[xyz])|[:=(\[]))?[ \t]*met(?:re|er)s\b",
    re.IGNORECASE | re.MULTILINE,
)
"""A comment which says that positions are in metres; others tell of metres beside the subject."""
NAME_TITLES = {"file", "filename", "file_name", "image", "image_name", "img", "name", "photo"}
"""What the column of files' names is called, before those of the poses."""
OF_MATRIX = re.compile(r"^[a-z]+_?[0-4]_?[0-4]$", re.IGNORECASE)
"""Names of a matrix's numbers, which stand row by row."""
NUMBER = re.compile(r"^[+-]?\.?\d|^[+-]?(nan|inf)", re.IGNORECASE)
UNIT = re.compile(r"[_ (\[]+([a-z°]+)", re.IGNORECASE)
PLACE_UNITS, TURN_UNITS = {"mm", "m"}, {"deg", "rad", "°"}
UNIT_OF_ANGLE = re.compile(r"[_ (\[](rad|deg)", re.IGNORECASE)
WITH_COMMA = re.compile(r"[+-]?\d+(,\d+)?(e[+-]?\d+)?", re.IGNORECASE)
N_LEAST = 4
"""Numbers in a line of a pose: a matrix's row has the fewest."""
N_ANGLES, N_QUATERNION, N_ROWS, N_MATRIX = 6, 7, 12, 16
HOW_TO_WRITE = (
    "write x, y, z in mm and three angles in degrees, in this order; or a matrix of 3 x 4 or 4 x 4 "
    "numbers row by row; or, under the header x,y,z,qw,qx,qy,qz or x,y,z,qx,qy,qz,qw, a quaternion"
)
BLOCK_TOLERANCE = 1e-4
"""A printed matrix of four decimals is made exact when it is this near to a rotation."""


def read_robot_poses(
    path: Path, convention: EulerConvention, files: Sequence[Path] = ()
) -> tuple[Pose[Base, Tool], ...]:
    """Read poses ``base_from_tool``.

    Text with one pose a line, separated by commas or blanks, with or without a header; ``#`` starts
    a comment. Or JSON: a list of poses, or an object with such a list called ``RobPoses``. A pose
    is x, y, z in mm and the angles a, b, c of the convention in degrees (FANUC: W, P, R,
    ``extrinsic-xyz``), or a rotation vector in rad, or as a header's ``a_rad`` or ``rx [deg]``
    says; or the matrix of ``base_from_tool``, 3 x 4 or 4 x 4, in one line or one line
    a row; or x, y, z and a quaternion, whose order the header says. Positions are in metres under a
    header that begins with ``x_m`` or ``x [m]``, and where no header states a unit and a comment
    says ``metres``, ``in metres`` or ``unit: metres``, and nothing of millimetres.

    Where a line begins with the name of a file, poses are given to ``files`` by their names, and
    come in the order of these; other lines are left. Else they come as they stand.

    Raises
    ------
    FileFormatError
        If the file is missing, cut, or a pose is none of these or not finite, or positions are in
        metres under the name of millimetres, or names are missing or given twice.
    """
    table, where = _read_table(path, files), str(path)
    positions, rotations = table.poses(convention)
    refuse_beyond_reach(positions, where)
    if are_surely_metres(rotations, positions):
        raise FileFormatError(
            "the tool turns but stays within 10 mm of Base's origin: positions look like metres",
            where=where,
            remedy=f"say so in a header, x_m,y_m,z_m and so on, or above matrices in a comment "
            f"(# metres), or {METRES_REMEDY}",
        )
    return tuple(Pose(one, place) for one, place in zip(rotations, positions, strict=True))


def other_table_readings(
    path: Path, convention: EulerConvention, files: Sequence[Path] = ()
) -> Iterator[tuple[str, str, FloatArray, FloatArray]]:
    """Other ways to read a table that `read_robot_poses` has read with a convention.

    What is read otherwise, what to type, and (N, 3, 3) and (N, 3) of ``base_from_tool`` then.
    """
    table = _read_table(path, files)
    if len(table.rows[0]) != N_ANGLES:
        if not table.is_metres:
            rotations, positions = table.poses(convention)[::-1]
            words = "reading the positions as metres"
            yield words, "write # metres above the matrices", rotations, 1000.0 * positions
        return
    numbers = np.array(table.rows)
    first = (convention, *(one for one in get_args(EulerConvention) if one != convention))
    for meant, is_rad, is_metres in product(first, (False, True), (False, True)):
        if (meant, is_rad, is_metres) == (convention, table.is_rad(convention), table.is_metres):
            continue
        angles = numbers[:, 3:] if is_rad else np.radians(numbers[:, 3:])
        units = f"{'metres' if is_metres else 'mm'} and {'radians' if is_rad else 'degrees'}"
        header = ("x_m,y_m,z_m," if is_metres else "x,y,z,") + (
            "a_rad,b_rad,c_rad" if is_rad else "a_deg,b_deg,c_deg"
        )
        yield (
            f"reading the table in {units}, its angles as {meant},",
            f"put the header {header} above the table, in place of any, and give --euler {meant}",
            rotations_from_euler(angles, meant),
            (1000.0 if is_metres else 1.0) * numbers[:, :3],
        )


@dataclass(frozen=True, slots=True, eq=False)
class _PoseTable:
    """Numbers of poses as they are written; ``places`` are their lines, for messages.

    ``names`` are those of files with which the lines begin; empty where they begin with numbers.
    """

    header: list[str]
    rows: list[list[float]]
    places: list[str]
    is_metres: bool
    names: list[str]

    def is_rad(self, convention: EulerConvention) -> bool:
        """Whether angles are in radians; rotation vectors are, unless the header says else."""
        unit = UNIT_OF_ANGLE.search(self.header[3]) if len(self.header) > 3 else None
        return convention == "rotation-vector" if unit is None else unit[1].lower() == "rad"

    def poses(self, convention: EulerConvention) -> tuple[FloatArray, FloatArray]:
        """Positions (N, 3) in mm, and rotations (N, 3, 3)."""
        positions, rotations = _poses_of(self, convention)
        return (1000.0 if self.is_metres else 1.0) * positions, rotations

    def of_files(self, files: Sequence[Path], where: str) -> _PoseTable:
        """The lines that name these files, in their order; all of them where none is named."""
        if not self.names or not files:
            return self
        parts = [PureWindowsPath(name).parts for name in self.names]
        lines = [_line_of(file, parts, where) for file in files]
        if len(set(lines)) < len(lines):
            twice = next(line for line in lines if lines.count(line) > 1)
            both = [str(file) for file, line in zip(files, lines, strict=True) if line == twice]
            raise FileFormatError(
                f"{self.names[twice]} may be {' or '.join(both[:2])}",
                where=self.places[twice],
                remedy="name each file with the folder that it is in",
            )
        rows, places = [self.rows[k] for k in lines], [self.places[k] for k in lines]
        return _PoseTable(self.header, rows, places, self.is_metres, self.names)


def _line_of(file: Path, names: Sequence[tuple[str, ...]], where: str) -> int:
    """The one line whose name is that of a file, with most folders alike."""
    alike = [_n_alike(file, name) for name in names]
    most = max(alike)
    if most > 0 and alike.count(most) == 1:
        return alike.index(most)
    if most > 0:
        raise FileFormatError(
            f"there are two poses of {'/'.join(names[alike.index(most)])}",
            where=where,
            remedy="name each file once, with its folder where two are called alike",
        )
    raise FileFormatError(
        f"there is no pose of {file.name}",
        where=where,
        remedy="name each file in the table as it is called, or leave the names out and give one "
        "pose a file, in the files' order",
    )


def _n_alike(file: Path, name: tuple[str, ...]) -> int:
    """Last parts of a path that a name has, too; its ending may be left out.

    Folders before may differ: they are called otherwise on another machine.
    """
    if not name or name[-1] not in (file.name, file.stem):
        return 0
    pairs = zip(reversed(name[:-1]), reversed(file.absolute().parent.parts), strict=False)
    return 1 + sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _read_table(path: Path, files: Sequence[Path]) -> _PoseTable:
    data, where = read_bytes(path), str(path)
    is_json = data.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"{", b"[")
    table = _from_json(data, where) if is_json else _from_text(data, where)
    if not table.rows:
        raise FileFormatError("the file holds no pose", where=where, remedy=HOW_TO_WRITE)
    return table.of_files(files, where)


def _poses_of(given: _PoseTable, convention: EulerConvention) -> tuple[FloatArray, FloatArray]:
    """Positions (N, 3) as written, and rotations (N, 3, 3)."""
    rows, places = given.rows, given.places
    n, names = len(rows[0]), _plain(given.header)
    counts = (N_QUATERNION,) if names[3:4] in (("qw",), ("qx",)) else (N_ANGLES, N_ROWS, N_MATRIX)
    for row, place in zip(rows, places, strict=True):
        if len(row) != n or n not in counts:
            kind = "seven" if N_QUATERNION in counts else "six"
            count = f": here are {len(row)}" if len(row) != 1 else ""
            raise FileFormatError(
                f"a pose is not {kind} numbers{count}", where=place, remedy=HOW_TO_WRITE
            )
    table = np.array(rows)
    if n == N_ANGLES:
        angles = np.degrees(table[:, 3:]) if given.is_rad(convention) else table[:, 3:]
        return table[:, :3], rotations_of_form(angles, "euler", convention, places)
    if n == N_QUATERNION:
        turn = table[:, 3:] if names[3] == "qw" else np.roll(table[:, 3:], 1, axis=1)
        norm = np.linalg.norm(turn, axis=1, keepdims=True)
        near = np.abs(norm - 1.0) < BLOCK_TOLERANCE
        turn = np.where(near, turn / np.where(near, norm, 1.0), turn)
        return table[:, :3], rotations_of_form(turn, "quaternion", convention, places)
    if n == N_MATRIX:
        last = np.abs(table[:, N_ROWS:] - [0.0, 0.0, 0.0, 1.0]).max(axis=1)
        if last.max() > BLOCK_TOLERANCE:
            raise FileFormatError(
                "the last row of a 4 x 4 matrix is not 0, 0, 0, 1",
                where=places[int(np.argmax(last))],
                remedy="write matrices row by row, the position in the last column",
            )
    matrices = table[:, :N_ROWS].reshape(-1, 3, 4)
    turns = matrices[:, :, :3]
    left, _, right = np.linalg.svd(turns)
    near_mm = np.abs(left @ right - turns).max(axis=(1, 2)) < BLOCK_TOLERANCE
    turns = np.where(near_mm[:, None, None], left @ right, turns)
    return matrices[:, :, 3], _from_matrices(turns, places)


def _from_json(data: bytes, where: str) -> _PoseTable:
    text = data.decode("utf-8-sig", errors="replace").lstrip()
    if text.startswith("["):
        data = f'{{"{JSON_KEY}": {text}}}'.encode()
    rows: Any = parse_json(data, where).get(JSON_KEY)
    if not isinstance(rows, list):
        raise FileFormatError(
            f"there is no list called {JSON_KEY}", where=where, remedy="name the robot's poses"
        )
    places = [f"{where}, pose {k}" for k in range(1, len(rows) + 1)]
    flat = [_numbers(_flat(row), place) for row, place in zip(rows, places, strict=True)]
    return _PoseTable([], flat, places, False, [])


def _flat(row: Any) -> list[Any]:
    """Numbers of a pose that is a list, or a list of a matrix's rows."""
    if not isinstance(row, list):
        return [row]
    return [value for item in row for value in (item if isinstance(item, list) else [item])]


def _from_text(data: bytes, where: str) -> _PoseTable:
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise FileFormatError(
            "this is not UTF-8 text", where=where, remedy="save it as UTF-8"
        ) from error
    header: list[str] = []
    rows: list[list[float]] = []
    places: list[str] = []
    names: list[str] = []
    is_named = False
    for number, whole in enumerate(lines, start=1):
        quoted, line = _quoted_name(whole)
        place, words = f"{where}, line {number}", _words(line)
        if not words and not quoted:
            continue
        if not (quoted or rows or header) and not any(map(NUMBER.match, words)):
            line = line.partition("#")[0].strip()
            is_named = words[0].lower() in NAME_TITLES
            line = _after_first(line) if is_named else line
            header = _header(line.rstrip(",;"), _words(line), place)
            continue
        if quoted or is_named or not (rows or reads_as_float(words[0])):
            is_named = True
            names.append(quoted or _file_of(line))
            line = line if quoted else _after_first(line)
        if _has_decimal_commas(line.rstrip(",;")):
            raise FileFormatError(
                "the numbers have commas as decimal signs",
                where=place,
                remedy="write them with decimal points, as 12.5",
            )
        places.append(place)
        rows.append(_numbers(_words(line), place))
    if rows and not names and all(len(row) == 4 for row in rows):
        rows, places = _joined(rows, places)
    return _PoseTable(header, rows, places, _is_in_metres(header, data), names)


def _is_in_metres(header: Sequence[str], data: bytes) -> bool:
    """Whether positions are in metres: a header that states a unit goes before any comment."""
    if header and UNIT.search(header[0]):
        return METRES.match(header[0]) is not None
    return METRES_COMMENT.search(data) is not None


def _words(line: str) -> list[str]:
    return [word for word in re.split(r"[\s,;\[\]]+", line) if word]


_QUOTED = re.compile(r'\s*"((?:[^"]|"")*)"\s*[,;]?')
"""A field in quotes with which a line begins, and what parts it from the next."""


def _quoted_name(line: str) -> tuple[str, str]:
    """The name in quotes with which a pose's line begins, or none, and the rest of the line.

    The rest has no quotes and no comment: that begins with a # at its start, behind what parts
    fields or behind a number; a # within a name is part of it.
    """
    first, name = _QUOTED.match(line), ""
    if first and NUMBER.match(line[first.end() :].strip().lstrip('"')):
        told = first[1].replace('""', '"').strip()
        if not reads_as_float(told):
            name, line = told, line[first.end() :]
    for mark in re.finditer("#", line):
        before = re.split(r'[\s,;\[\]"]', line[: mark.start()])[-1]
        if not before or reads_as_float(before):
            line = line[: mark.start()]
            break
    return name, line.replace('"', "").strip()


_FIRST = re.compile(r"([^,;]*[^,;\s])\s*[,;]\s*|(\S+)\s+")
"""A name with which a line begins: to its first comma or semicolon, else to its first blank."""


def _file_of(line: str) -> str:
    """The file's name with which a line begins."""
    first = _FIRST.match(line)
    return ((first[1] or first[2]) if first else line).strip()


def _after_first(line: str) -> str:
    first = _FIRST.match(line)
    return line[first.end() :] if first else ""


def _has_decimal_commas(line: str) -> bool:
    """True if semicolons or blanks part what then are numbers with at most one comma each."""
    fields = re.split(r"[\s;]+", line)
    if len(fields) < N_LEAST or not any("," in field for field in fields):
        return False
    return all(WITH_COMMA.fullmatch(field) for field in fields)


def _header(line: str, words: list[str], where: str) -> list[str]:
    """Names of columns, whose units are known ones and alike."""
    titles = re.split(r"\s*[,;]\s*|\s+(?![(\[])", line)
    if all(map(OF_MATRIX.match, words)):
        return words
    if _plain(titles) not in HEADERS:
        raise FileFormatError(
            f"the header {line} is not understood", where=where, remedy=HOW_TO_WRITE
        )
    units = [UNIT.search(title) for title in titles]
    places, turns = ({unit[1].lower() for unit in some if unit} for some in (units[:3], units[3:]))
    if len(places) > 1 or len(turns) > 1 or places - PLACE_UNITS or turns - TURN_UNITS:
        raise FileFormatError(
            f"the units of the header {line} are not understood",
            where=where,
            remedy="write positions in mm or m and angles in deg or rad, all in the same",
        )
    return titles


def _joined(rows: list[list[float]], places: list[str]) -> tuple[list[list[float]], list[str]]:
    """Matrices of four numbers a line, with or without their last rows, one pose each."""
    has_last = all(row == [0.0, 0.0, 0.0, 1.0] for row in rows[3::4])
    step = 4 if has_last and len(rows) % 4 == 0 else 3
    if len(rows) % step:
        raise FileFormatError(
            f"{len(rows)} lines of four numbers are no matrices of 3 or 4 rows",
            where=places[-1],
            remedy=HOW_TO_WRITE,
        )
    joined = np.array(rows).reshape(-1, 4 * step).tolist()
    return joined, places[::step]


def _plain(words: Sequence[str]) -> tuple[str, ...]:
    """Names of columns without units and case."""
    return tuple(re.sub(r"[_ (\[].*", "", word).lower() for word in words)


def _numbers(row: Sequence[Any], where: str) -> list[float]:
    try:
        values = [float(value) for value in row]
    except (TypeError, ValueError):
        values = []
    if not values or not bool(np.isfinite(values).all()):
        fact = "a pose is not six numbers"
        raise FileFormatError(fact, where=where, remedy=HOW_TO_WRITE)
    return values
