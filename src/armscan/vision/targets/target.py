# SPDX-License-Identifier: Apache-2.0
"""Calibration targets: what they are, how they are named, what is known of one in an exposure."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import ClassVar, Literal, TypeAlias

import cv2
import numpy as np

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import (
    ArrayRecord,
    FloatArray,
    IntArray,
    RowRecord,
    floats,
    homogeneous,
    ints,
)
from armscan.geometry.estimate import FitFailure
from armscan.records.exposure import Exposure


@dataclass(frozen=True, slots=True)
class CircleGrid:
    """Grid of circles; ``is_asymmetric`` shifts every second row by half a pitch (as OpenCV).

    Rows lie ``stretch`` times the pitch apart.
    """

    columns: int
    rows: int
    pitch_mm: float
    is_asymmetric: bool = False
    stretch: float = 1.0

    @property
    def points_board_mm(self) -> FloatArray:
        """(columns * rows, 3) circle centres in the Board frame, row by row."""
        j, i = np.mgrid[: self.rows, : self.columns]
        x = (2 * i + j % 2) * self.pitch_mm if self.is_asymmetric else i * self.pitch_mm
        y = j * self.pitch_mm * self.stretch
        return np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3)

    @property
    def size_mm(self) -> float:
        """The length whose wrong value scales every result."""
        return self.pitch_mm

    @property
    def symmetric_turns(self) -> tuple[int, ...]:
        """Quarter turns, of 1 to 3, after which the target looks the same."""
        if self.is_asymmetric:
            return (2,) if self.rows % 2 == 0 else ()
        return (1, 2, 3) if self.columns == self.rows else (2,)


@dataclass(frozen=True, slots=True)
class Chessboard:
    """Chessboard, counted in inner corners; rows lie ``stretch`` times a square's width apart."""

    columns: int
    rows: int
    square_mm: float
    stretch: float = 1.0

    @property
    def points_board_mm(self) -> FloatArray:
        """(columns * rows, 3) inner corners in the Board frame, row by row."""
        j, i = np.mgrid[: self.rows, : self.columns]
        return np.stack([i, self.stretch * j, 0 * i], axis=-1).reshape(-1, 3) * self.square_mm

    @property
    def size_mm(self) -> float:
        """The length whose wrong value scales every result."""
        return self.square_mm

    @property
    def symmetric_turns(self) -> tuple[int, ...]:
        """As of `CircleGrid`; a quarter turn of an odd count of corners a side swaps the tones."""
        if (self.columns + self.rows) % 2:
            return ()
        return (1, 2, 3) if self.columns == self.rows and self.columns % 2 == 0 else (2,)


CharucoLayout = Literal["either", "new", "old"]
"""On which squares of a ChArUco board its markers lie: in the new layout (OpenCV since 4.6) the
first square of the board is dark, in the old one that of the last row. Either: the image tells."""


@dataclass(frozen=True, slots=True)
class Charuco:
    """ChArUco board, counted in squares; its points are the inner corners."""

    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str
    layout: CharucoLayout = "either"
    symmetric_turns: ClassVar[tuple[int, ...]] = ()

    @property
    def has_two_layouts(self) -> bool:
        """Whether old and new layout differ."""
        return self.rows % 2 == 0

    @property
    def marker_squares(self) -> IntArray:
        """(M, 2) column and row of the square of each marker; of the new layout if it is open."""
        j, i = np.mgrid[: self.rows, : self.columns]
        is_old = self.has_two_layouts and self.layout == "old"
        row, column = np.nonzero((i + j) % 2 == (0 if is_old else 1))
        return np.stack([column, row], axis=-1)

    @property
    def points_board_mm(self) -> FloatArray:
        """((columns - 1) * (rows - 1), 3) inner corners in the Board frame, row by row."""
        j, i = np.mgrid[1 : self.rows, 1 : self.columns]
        return np.stack([i, j, 0 * i], axis=-1).reshape(-1, 3) * self.square_mm

    @property
    def size_mm(self) -> float:
        """The length whose wrong value scales every result."""
        return self.square_mm


Target: TypeAlias = CircleGrid | Chessboard | Charuco


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
MOST_STRETCH = 2.0
_MIN_COUNT = {"circle-grid": 3, "asymmetric-circle-grid": 2, "chessboard": 3, "charuco": 3}


def parse_target(text: str) -> Target:
    """Read a target's specification.

    Parameters
    ----------
    text
        ``circle-grid:COLSxROWS:PITCH_MM``, ``asymmetric-circle-grid:COLSxROWS:PITCH_MM``,
        ``chessboard:COLSxROWS:SQUARE_MM`` (inner corners) or
        ``charuco:COLSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY`` (squares), which ``:old`` or ``:new``
        may follow. A length is in mm unless it bears a unit: ``13``, ``13mm``, ``1.3cm``,
        ``0.013m``. A print that came out longer one way than the other has two: ``13x13.1`` is
        from column to column and from row to row; not of a ChArUco board.

    Raises
    ------
    OptionError
        If the text is none of these; the message shows a right example.
    """
    kind, *fields = text.strip().split(":")
    if kind not in EXAMPLES:
        raise OptionError(
            f"'{kind}' is no kind of target; known are {', '.join(EXAMPLES)}",
            where=f"target '{text}'",
            remedy=f"write for example {EXAMPLES['chessboard']}",
        )
    n_fields = 4 if kind == "charuco" else 2
    has_layout = kind == "charuco" and len(fields) == n_fields + 1
    if len(fields) != n_fields and not has_layout:
        raise _wrong(text, kind, f"needs {n_fields} fields after '{kind}', has {len(fields)}")
    columns, rows = _counts(text, kind, fields[0])
    if kind == "charuco":
        return _charuco(text, columns, rows, fields)
    name = "square" if kind == "chessboard" else "pitch"
    lengths = [
        _length_mm(text, kind, name, part) for part in re.split("[xX]", fields[1], maxsplit=1)
    ]
    stretch = lengths[-1] / lengths[0]
    if not MOST_STRETCH**-1 <= stretch <= MOST_STRETCH:
        raise _wrong(text, kind, f"lengths of {lengths[0]:g} and {lengths[1]:g} mm are too unlike")
    if stretch != 1.0 and columns == rows:
        raise _wrong(text, kind, "of as many columns as rows no image tells which length is which")
    if kind == "chessboard":
        return Chessboard(columns, rows, lengths[0], stretch)
    return CircleGrid(columns, rows, lengths[0], kind == "asymmetric-circle-grid", stretch)


def rightness(board: FloatArray, points_px: FloatArray) -> float:
    """Cosine of the angle between the board's x, places (N, 2), and the image's, points (N, 2)."""
    design = homogeneous(board)
    affine = np.linalg.lstsq(design, points_px, rcond=None)[0]
    return float(affine[0, 0] / np.hypot(affine[0, 0], affine[0, 1]))


def format_target(target: Target) -> str:
    """The specification that `parse_target` reads as this target."""
    counts = f"{target.columns}x{target.rows}"
    if isinstance(target, Charuco):
        text = f"charuco:{counts}:{target.square_mm:.12g}:{target.marker_mm:.12g}"
        layout = "" if target.layout == "either" else f":{target.layout}"
        return f"{text}:{target.dictionary}{layout}"
    if isinstance(target, CircleGrid):
        kind = "asymmetric-circle-grid" if target.is_asymmetric else "circle-grid"
        return f"{kind}:{counts}:{_pitches(target)}"
    return f"chessboard:{counts}:{_pitches(target)}"


def _pitches(target: CircleGrid | Chessboard) -> str:
    pitch_mm = target.size_mm
    second = "" if target.stretch == 1.0 else f"x{pitch_mm * target.stretch:.12g}"
    return f"{pitch_mm:.12g}{second}"


def as_two_lengths(points_board_mm: FloatArray, stretch: float) -> str:
    """How to describe a target with these points (N, 3) whose rows lie further apart than said."""
    counts, pitches = [], []
    for k in range(2):
        lines = np.unique(points_board_mm[:, k].round(6))
        counts.append(len(lines))
        pitches.append(float(np.diff(lines).min()))
    x, y = pitches[0], pitches[1] * (1.0 + stretch)
    if counts[0] == counts[1] or not MOST_STRETCH**-1 < y / x < MOST_STRETCH:
        return "print another"
    return (
        f"give both lengths, {x:.6g}x{y:.5g} for its pitch or square (of ChArUco, which has one, "
        "print another)"
    )


def describe_target(target: Target) -> str:
    """The target in words, with its size in mm, so that a wrong length or unit is noticed."""
    width, height, _ = target.points_board_mm.max(axis=0) - target.points_board_mm.min(axis=0)
    size = f"{width:.4g} x {height:.4g} mm"
    if isinstance(target, CircleGrid):
        return f"{target.columns} x {target.rows} circles, first to last centre {size}"
    less = 1 if isinstance(target, Charuco) else 0
    counts = f"{target.columns - less} x {target.rows - less}"
    is_old = isinstance(target, Charuco) and target.layout == "old"
    layout = ", old layout (OpenCV before 4.6)" if is_old else ""
    return f"{counts} inner corners, first to last {size}{layout}"


def _charuco(text: str, columns: int, rows: int, fields: list[str]) -> Charuco:
    kind = "charuco"
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
    return Charuco(columns, rows, square_mm, marker_mm, name, _layout(text, fields[4:]))


def _layout(text: str, fields: list[str]) -> CharucoLayout:
    match [field.lower() for field in fields]:
        case []:
            return "either"
        case ["old"]:
            return "old"
        case ["new"]:
            return "new"
    raise _wrong(text, "charuco", f"'{fields[0]}' is no layout: old or new, or leave it out")


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


class CircleEdges(ArrayRecord):
    """Sub-pixel edge points of circles, kept so that centres can be recomputed with intrinsics.

    Parameters
    ----------
    points_px
        (K, 2) edge points, full-sensor pixels.
    circle
        (K,) row of the `TargetView`'s arrays to which an edge point belongs.
    sigma_px
        (K,) standard deviation along the edge's normal.
    """

    points_px: FloatArray = floats("K", 2)
    circle: IntArray = ints("K")
    sigma_px: FloatArray = floats("K")


class TargetView(RowRecord):
    """Target points found in one exposure.

    Parameters
    ----------
    source
        The exposure's source name.
    width_px, height_px
        Size of the image, in full-sensor pixels.
    point_index
        (N,) index into the target's points.
    points_px
        (N, 2) image points, full-sensor pixels.
    covariance_px2
        (N, 2, 2) covariance of each image point.
    points_board_mm
        (N, 3) the same points in the Board frame.
    edges
        Edge points, for circle targets.
    is_ambiguous
        True if the target looks the same turned by half a turn, so that the numbering may be too.
    """

    source: str
    width_px: int
    height_px: int
    point_index: IntArray = ints("N")
    points_px: FloatArray = floats("N", 2)
    covariance_px2: FloatArray = floats("N", 2, 2)
    points_board_mm: FloatArray = floats("N", 3)
    edges: CircleEdges | None = None
    is_ambiguous: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self) and float(np.linalg.eigvalsh(self.covariance_px2).min()) <= 0.0:
            raise InputError("covariance_px2 is not positive definite", where=self.source)

    @staticmethod
    def of_image(
        exposure: Exposure,
        target: Target,
        number: IntArray,
        image_px: FloatArray,
        covariance_px2: FloatArray,
    ) -> TargetView:
        """Points (N, 2) of these numbers (N,), measured in the pixels of the exposure's image."""
        window = exposure.window
        return TargetView(
            source=exposure.source,
            width_px=window.x_px + exposure.width_px * window.binning,
            height_px=window.y_px + exposure.height_px * window.binning,
            point_index=number,
            points_px=window.to_full_sensor(image_px),
            covariance_px2=covariance_px2 * window.binning**2,
            points_board_mm=target.points_board_mm[number],
            is_ambiguous=bool(target.symmetric_turns),
        )


@dataclass(frozen=True, slots=True)
class OtherCountSeen(FitFailure):
    """No such target is in view, but a full lattice of another count: ``columns`` x ``rows``.

    It may be part of the target, the rest being hidden; where several images show the same one, the
    count that was asked for is wrong.
    """

    columns: int = 0
    rows: int = 0
