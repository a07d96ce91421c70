# SPDX-License-Identifier: Apache-2.0
"""Targets as they are named on the command line."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

import cv2

from armscan.errors import OptionError
from armscan.vision.targets.definition import Charuco, Chessboard, CircleGrid, Target

EXAMPLES = {
    "circle-grid": "circle-grid:11x9:3.75",
    "asymmetric-circle-grid": "asymmetric-circle-grid:4x11:5",
    "chessboard": "chessboard:11x6:13",
    "charuco": "charuco:10x7:4:3:DICT_4X4_50",
}
"""A right specification of each kind of target."""

_MIN_COUNT = {"circle-grid": 3, "asymmetric-circle-grid": 2, "chessboard": 3, "charuco": 3}


def parse_target(text: str) -> Target:
    """Read a target's specification.

    Parameters
    ----------
    text
        ``circle-grid:COLSxROWS:PITCH_MM``, ``asymmetric-circle-grid:COLSxROWS:PITCH_MM``,
        ``chessboard:COLSxROWS:SQUARE_MM`` (inner corners) or
        ``charuco:COLSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY`` (squares).

    Raises
    ------
    OptionError
        If the text is none of these; the message shows a right example.
    """
    kind, *fields = text.strip().split(":")
    if kind not in _PARSERS:
        known = ", ".join(EXAMPLES)
        raise OptionError(
            f"'{kind}' is no kind of target; known are {known}",
            where=f"target '{text}'",
            remedy=f"write for example {EXAMPLES['chessboard']}",
        )
    n_fields = 4 if kind == "charuco" else 2
    if len(fields) != n_fields:
        raise _wrong(text, kind, f"needs {n_fields} fields after '{kind}', has {len(fields)}")
    return _PARSERS[kind](text, kind, fields)


def _circle_grid(text: str, kind: str, fields: list[str]) -> Target:
    columns, rows = _counts(text, kind, fields[0])
    is_asymmetric = kind == "asymmetric-circle-grid"
    return CircleGrid(columns, rows, _length_mm(text, kind, "pitch", fields[1]), is_asymmetric)


def _chessboard(text: str, kind: str, fields: list[str]) -> Target:
    columns, rows = _counts(text, kind, fields[0])
    return Chessboard(columns, rows, _length_mm(text, kind, "square", fields[1]))


def _charuco(text: str, kind: str, fields: list[str]) -> Target:
    columns, rows = _counts(text, kind, fields[0])
    square_mm = _length_mm(text, kind, "square", fields[1])
    marker_mm = _length_mm(text, kind, "marker", fields[2])
    if marker_mm >= square_mm:
        raise _wrong(text, kind, f"a marker of {marker_mm:g} mm does not fit into its square")
    name = fields[3].upper()
    name = name if name.startswith("DICT_") else f"DICT_{name}"
    code = getattr(cv2.aruco, name, None)
    if not isinstance(code, int):
        raise _wrong(text, kind, f"'{fields[3]}' is no ArUco dictionary")
    n_markers = columns * rows // 2
    n_known = len(cv2.aruco.getPredefinedDictionary(code).bytesList)
    if n_markers > n_known:
        raise _wrong(text, kind, f"the board needs {n_markers} markers, {name} has {n_known}")
    return Charuco(columns, rows, square_mm, marker_mm, name)


_PARSERS: dict[str, Callable[[str, str, list[str]], Target]] = {
    "circle-grid": _circle_grid,
    "asymmetric-circle-grid": _circle_grid,
    "chessboard": _chessboard,
    "charuco": _charuco,
}


def _counts(text: str, kind: str, field: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,4})[xX](\d{1,4})", field)
    if match is None:
        raise _wrong(text, kind, f"'{field}' is not COLUMNSxROWS")
    columns, rows = int(match[1]), int(match[2])
    if min(columns, rows) < _MIN_COUNT[kind]:
        raise _wrong(text, kind, f"{columns} x {rows} is too few: at least {_MIN_COUNT[kind]} each")
    return columns, rows


def _length_mm(text: str, kind: str, name: str, field: str) -> float:
    number = re.fullmatch(r"(\d+\.?\d*|\.\d+)(?:mm)?", field)
    length_mm = float(number[1]) if number else math.nan
    if not 0.0 < length_mm < math.inf:
        raise _wrong(text, kind, f"'{field}' is no {name} in mm")
    return length_mm


def _wrong(text: str, kind: str, what: str) -> OptionError:
    return OptionError(what, where=f"target '{text}'", remedy=f"write for example {EXAMPLES[kind]}")
