# SPDX-License-Identifier: Apache-2.0
"""Poses in text: forms and units of their columns, and poses of a robot."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

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
from armscan.storage.tables import refuse_beyond_reach

POSITION: Final = ("x_mm", "y_mm", "z_mm")
FORM_COLUMNS: Final[dict[PoseForm, tuple[str, ...]]] = {
    "quaternion": ("qw", "qx", "qy", "qz"),
    "matrix": tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)),
    "euler": ("a_deg", "b_deg", "c_deg"),
    "joints": (),
}
NORM_TOLERANCE = 1e-6
ORTHONORMAL_TOLERANCE = 1e-5
"""Six decimals of nine numbers leave up to about 3e-6."""
FULL_TURNS_DEG = 720.0


def rotations_of_form(
    numbers: FloatArray, form: PoseForm, convention: EulerConvention, places: Sequence[str]
) -> FloatArray:
    """Rotations (N, 3, 3) of numbers (N, C) in the order of `FORM_COLUMNS`.

    A quaternion is w, x, y, z (Hamilton, active), of either sign and norm 1 within 1e-6; a matrix
    is row by row and orthonormal within 1e-5, and the nearest rotation is taken.

    Parameters
    ----------
    numbers
        Finite.
    form, convention
        How they are written.
    places
        (N,) file and line of each, for messages.

    Raises
    ------
    FileFormatError
        If a row is no rotation.
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
    wrong = np.abs(norms - 1.0) > NORM_TOLERANCE
    if wrong.any():
        row = int(np.argmax(wrong))
        raise FileFormatError(
            f"the quaternion's norm is {norms[row]:.8g}, not 1 within {NORM_TOLERANCE:g}",
            where=places[row],
            remedy="write qw,qx,qy,qz with seven decimals or more, each in its own column",
        )
    return np.asarray(Rotation.from_quat(np.roll(numbers, -1, axis=1)).as_matrix())


def _from_matrices(matrices: FloatArray, places: Sequence[str]) -> FloatArray:
    defect = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0)
    is_mirrored = np.linalg.det(matrices) < 0.0
    wrong = (defect > ORTHONORMAL_TOLERANCE) | is_mirrored
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
HEADERS = (("x", "y", "z", "w", "p", "r"), ("x", "y", "z", "a", "b", "c"))
"""Headers that are understood, without units and case."""
FULL_TURN_DEG = 720.0


def read_robot_poses(path: Path, convention: EulerConvention) -> tuple[Pose[Base, Tool], ...]:
    """Read poses ``base_from_tool``.

    A JSON object with the list ``RobPoses``, or text with one pose a line, separated by commas or
    blanks, with or without a header; ``#`` starts a comment. Each pose is x, y, z in mm and the
    angles a, b, c of the convention in degrees (FANUC: W, P, R, ``extrinsic-xyz``).

    Raises
    ------
    FileFormatError
        If the file is missing, cut, or a pose is not six finite numbers, or positions are in
        metres.
    """
    data = read_bytes(path)
    where = str(path)
    is_json = data.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{")
    table = _from_json(data, where) if is_json else _from_text(data, where)
    if not len(table):
        raise FileFormatError(
            "the file holds no pose",
            where=where,
            remedy="write six numbers a line: x, y, z in mm and three angles in degrees",
        )
    if np.abs(table[:, 3:]).max() > FULL_TURN_DEG:
        raise FileFormatError(
            f"an angle of {np.abs(table[:, 3:]).max():g} deg",
            where=where,
            remedy="write x, y, z in mm, then three angles in degrees",
        )
    refuse_beyond_reach(table[:, :3], where)
    rotations = rotations_from_euler(np.radians(table[:, 3:]), convention)
    if are_surely_metres(rotations, table[:, :3]):
        raise FileFormatError(
            "the tool turns but stays within 10 mm of Base's origin: positions look like metres",
            where=where,
            remedy=METRES_REMEDY,
        )
    return tuple(Pose(rotation, row[:3]) for rotation, row in zip(rotations, table, strict=True))


def _from_json(data: bytes, where: str) -> FloatArray:
    rows: Any = parse_json(data, where).get(JSON_KEY)
    if not isinstance(rows, list):
        raise FileFormatError(
            f"there is no list called {JSON_KEY}", where=where, remedy="name the robot's poses"
        )
    return np.array([_six(row, f"{where}, pose {k}") for k, row in enumerate(rows, start=1)])


def _from_text(data: bytes, where: str) -> FloatArray:
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise FileFormatError(
            "this is not UTF-8 text", where=where, remedy="save it as UTF-8"
        ) from error
    rows: list[list[float]] = []
    is_header_possible = True
    for number, line in enumerate(lines, start=1):
        words = re.split(r"[\s,;]+", line.split("#")[0].strip())
        if words == [""]:
            continue
        if is_header_possible and _is_header(words):
            is_header_possible = False
            continue
        is_header_possible = False
        rows.append(_six(words, f"{where}, line {number}"))
    return np.array(rows).reshape(-1, 6)


def _is_header(words: list[str]) -> bool:
    """True for the names of the six columns in the order that is understood."""
    names = tuple(re.sub(r"[_(\[].*", "", word).lower() for word in words)
    return names in HEADERS


def _six(row: Any, where: str) -> list[float]:
    try:
        values = [float(value) for value in row]
    except (TypeError, ValueError):
        values = []
    if len(values) != 6 or not bool(np.isfinite(values).all()):
        raise FileFormatError(
            "a pose is not six numbers",
            where=where,
            remedy="write x, y, z in mm and three angles in degrees, in this order",
        )
    return values
