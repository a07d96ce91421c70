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

SMALLEST_UNASKED_MM = 0.1
"""A smaller length without a unit is asked about: it was likely meant in metres."""
_UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
_MIN_COUNT = {"circle-grid": 3, "asymmetric-circle-grid": 2, "chessboard": 3, "charuco": 3}


def parse_target(text: str) -> Target:
    """Read a target's specification.

    Parameters
    ----------
    text
        ``circle-grid:COLSxROWS:PITCH_MM``, ``asymmetric-circle-grid:COLSxROWS:PITCH_MM``,
        ``chessboard:COLSxROWS:SQUARE_MM`` (inner corners) or
        ``charuco:COLSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY`` (squares). A length is in mm unless it
        bears a unit: ``13``, ``13mm``, ``1.3cm``, ``0.013m``.

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


def format_target(target: Target) -> str:
    """The specification that `parse_target` reads as this target."""
    counts = f"{target.columns}x{target.rows}"
    if isinstance(target, Charuco):
        name = target.dictionary
        return f"charuco:{counts}:{target.square_mm:.12g}:{target.marker_mm:.12g}:{name}"
    if isinstance(target, CircleGrid):
        kind = "asymmetric-circle-grid" if target.is_asymmetric else "circle-grid"
        return f"{kind}:{counts}:{target.pitch_mm:.12g}"
    return f"chessboard:{counts}:{target.square_mm:.12g}"


def describe_target(target: Target) -> str:
    """The target in words, with its size in mm, so that a wrong length or unit is noticed."""
    width, height = target.points_board_mm[-1, :2] - target.points_board_mm[0, :2]
    if isinstance(target, CircleGrid):
        reach = target.points_board_mm.max(axis=0)
        what = "circles, first to last centre"
        return f"{target.columns} x {target.rows} {what} {reach[0]:.4g} x {reach[1]:.4g} mm"
    what = "inner corners, first to last"
    n = (target.columns, target.rows)
    if isinstance(target, Charuco):
        n = (target.columns - 1, target.rows - 1)
    return f"{n[0]} x {n[1]} {what} {width:.4g} x {height:.4g} mm"


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
    number = re.fullmatch(r"(\d+\.?\d*|\.\d+) ?(mm|cm|m)?", field)
    length_mm = float(number[1]) * _UNITS_MM[number[2] or "mm"] if number else math.nan
    if not 0.0 < length_mm < math.inf:
        raise _wrong(text, kind, f"'{field}' is no {name}: give mm, or a unit as in 13mm, 1.3cm")
    if number and number[2] is None and length_mm < SMALLEST_UNASKED_MM:
        raise OptionError(
            f"a {name} of {field} mm: is it metres",
            where=f"target '{text}'",
            remedy=f"write {field}m if it is {1000.0 * length_mm:g} mm, {field}mm if it is not",
        )
    return length_mm


def _wrong(text: str, kind: str, what: str) -> OptionError:
    return OptionError(what, where=f"target '{text}'", remedy=f"write for example {EXAMPLES[kind]}")
