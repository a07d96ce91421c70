# SPDX-License-Identifier: Apache-2.0
"""Tables of robot poses: six numbers a pose, position and three angles."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from armscan.errors import FileFormatError
from armscan.geometry.arrays import FloatArray
from armscan.geometry.euler import EulerConvention, rotations_from_euler
from armscan.geometry.frames import Base, Tool
from armscan.geometry.poses import Pose
from armscan.storage.images import read_bytes
from armscan.storage.json_text import parse_json
from armscan.storage.pose_units import METRES_REMEDY, are_surely_metres, refuse_beyond_reach

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
