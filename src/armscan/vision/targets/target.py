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
    """Grid of circles; ``is_asymmetric`` shifts every second row by a pitch (as OpenCV).

    Then neighbours in a row are two pitches apart. Rows lie ``stretch`` times the pitch apart.
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
    """ChArUco board, counted in squares; its points are the inner corners.

    Its markers bear the numbers from ``first_id`` on.
    """

    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str
    layout: CharucoLayout = "either"
    first_id: int = 0
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


RowOrder = Literal["either", "up", "down"]
"""Whether the numbers of an AprilGrid's tags, which grow to the right, go on in the row above
(Kalibr's print) or below. Either: the image tells."""
KALIBR_SPACING = 0.3
APRIL_FAMILIES = {
    "tag36h11": "DICT_APRILTAG_36h11",
    "tag36h10": "DICT_APRILTAG_36h10",
    "tag25h9": "DICT_APRILTAG_25h9",
    "tag16h5": "DICT_APRILTAG_16h5",
}
"""OpenCV's names of the families of AprilTags, the usual one first."""
BORDER_BITS = (2, 1)
"""Widths of a tag's black border, in cells of its code: Kalibr prints two."""


@dataclass(frozen=True, slots=True)
class AprilGrid:
    """Grid of AprilTags, dark squares between their corners; counted in tags.

    Its points are the corners of the tags' black borders, each of which touches that of a small
    square, so that four sectors alternate as on a chessboard.

    Parameters
    ----------
    columns, rows
        Count of tags.
    tag_mm
        Side of a tag, border included.
    spacing
        Way from a tag to the next, in sides of a tag: the side of the small squares.
    family, first_id
        Code of the tags, and the smallest number: tags are numbered row by row.
    border_bits
        Width of their border, in cells of the code; 0 where the image tells.
    order
        Where the next row of numbers is.
    """

    columns: int
    rows: int
    tag_mm: float
    spacing: float = KALIBR_SPACING
    family: str = "tag36h11"
    first_id: int = 0
    border_bits: int = 0
    order: RowOrder = "either"
    symmetric_turns: ClassVar[tuple[int, ...]] = ()

    @property
    def pitch(self) -> float:
        """From a tag to the next, in sides of a tag."""
        return 1.0 + self.spacing

    @property
    def corners(self) -> FloatArray:
        """(4 * columns * rows, 2) corners of tags in sides of a tag, row by row from the top."""
        j, i = np.mgrid[: 2 * self.rows, : 2 * self.columns]
        cell = np.stack([i, j], axis=-1).reshape(-1, 2)
        return np.asarray(self.pitch * (cell // 2) + cell % 2, dtype=np.float64)

    @property
    def points_board_mm(self) -> FloatArray:
        """(4 * columns * rows, 3) corners of tags in the Board frame, row by row from the top."""
        return np.pad(self.corners * self.tag_mm, ((0, 0), (0, 1)))

    @property
    def size_mm(self) -> float:
        """The length whose wrong value scales every result."""
        return self.tag_mm


Target: TypeAlias = CircleGrid | Chessboard | Charuco | AprilGrid


EXAMPLES = {
    "circle-grid": "circle-grid:11x9:3.75",
    "asymmetric-circle-grid": "asymmetric-circle-grid:4x11:5",
    "chessboard": "chessboard:11x6:13",
    "charuco": "charuco:10x7:4:3:DICT_4X4_50",
    "aprilgrid": "aprilgrid:6x6:88:0.3",
}
"""A right specification of each kind of target."""

SMALLEST_UNASKED_MM = 0.1
"""A smaller length without a unit is asked about: it was likely meant in metres."""
_UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
MOST_STRETCH = 2.0
_UNEVEN = 1e-3
LEAST_SPACING = 0.05
"""Of an AprilGrid: between tags that are nearer to each other no corner is seen by itself."""
_MIN_COUNT = {
    "circle-grid": 3,
    "asymmetric-circle-grid": 2,
    "chessboard": 3,
    "charuco": 3,
    "aprilgrid": 2,
}


def parse_target(text: str) -> Target:
    """Read a target's specification.

    Parameters
    ----------
    text
        ``circle-grid:COLSxROWS:PITCH_MM``, ``asymmetric-circle-grid:COLSxROWS:PITCH_MM``,
        ``chessboard:COLSxROWS:SQUARE_MM`` (inner corners),
        ``charuco:COLSxROWS:SQUARE_MM:MARKER_MM:DICTIONARY`` (squares), which ``:first=ID``,
        ``:old`` or ``:new`` may follow, or ``aprilgrid:COLSxROWS:TAG_MM:SPACING`` (tags), which
        ``:first=ID``, ``:border=BITS``, ``:family=NAME``, ``:up`` or ``:down`` may follow.
        A length is in mm unless it bears a unit: ``13``, ``13mm``, ``1.3cm``, ``0.013m``.
        A print that came out longer one way than the other has two: ``13x13.1`` is
        from column to column and from row to row; not of a board with markers.

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
    n_fields = {"charuco": 4, "aprilgrid": 3}.get(kind, 2)
    may_have_more = kind in ("charuco", "aprilgrid")
    if len(fields) < n_fields or (len(fields) > n_fields and not may_have_more):
        raise _wrong(text, kind, f"needs {n_fields} fields after '{kind}', has {len(fields)}")
    columns, rows = _counts(text, kind, fields[0])
    if kind == "charuco":
        return _charuco(text, columns, rows, fields)
    if kind == "aprilgrid":
        return _april_grid(text, columns, rows, fields)
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
        first = f":first={target.first_id}" if target.first_id else ""
        return f"{text}:{target.dictionary}{first}{layout}"
    if isinstance(target, AprilGrid):
        more = {"family": target.family, "first": target.first_id, "border": target.border_bits}
        usual = {"family": "tag36h11", "first": 0, "border": 0}
        options = [f":{name}={value}" for name, value in more.items() if value != usual[name]]
        options += [] if target.order == "either" else [f":{target.order}"]
        return f"aprilgrid:{counts}:{target.tag_mm:.12g}:{target.spacing:.12g}{''.join(options)}"
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
    ways = np.diff(np.unique(points_board_mm[:, 0].round(6)))
    is_even = float(np.ptp(ways)) < _UNEVEN * pitches[0]
    if counts[0] == counts[1] or not is_even or not MOST_STRETCH**-1 < y / x < MOST_STRETCH:
        return "print another"
    return (
        f"give both lengths, {x:.6g}x{y:.5g} for its pitch or square (of a board with markers, "
        "which has one, print another)"
    )


def describe_target(target: Target) -> str:
    """The target in words, with its size in mm, so that a wrong length or unit is noticed."""
    width, height, _ = target.points_board_mm.max(axis=0) - target.points_board_mm.min(axis=0)
    size = f"{width:.4g} x {height:.4g} mm"
    if isinstance(target, CircleGrid):
        return f"{target.columns} x {target.rows} circles, first to last centre {size}"
    less = 1 if isinstance(target, Charuco) else 0
    counts = f"{target.columns - less} x {target.rows - less}"
    if isinstance(target, AprilGrid):
        last = target.first_id + target.columns * target.rows - 1
        numbers = f"{target.family}, {target.first_id} to {last}"
        return f"{counts} tags of {numbers}, first to last corner {size}"
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
    options = _options(text, kind, fields[4:], {"first": "", "layout": "old new"})
    first = _first_id(text, kind, options, name, columns * rows // 2)
    layout: CharucoLayout = "either"
    if "layout" in options:
        layout = "old" if options["layout"] == "old" else "new"
    return Charuco(columns, rows, square_mm, marker_mm, name, layout, first)


def _april_grid(text: str, columns: int, rows: int, fields: list[str]) -> AprilGrid:
    kind = "aprilgrid"
    tag_mm = _length_mm(text, kind, "tag", fields[1])
    spacing = _spacing(text, tag_mm, fields[2])
    known = {"first": "", "border": "1 2", "family": "", "order": "up down"}
    options = _options(text, kind, fields[3:], known)
    family = options.get("family", "tag36h11").lower()
    family = family if family.startswith("tag") else f"tag{family}"
    if family not in APRIL_FAMILIES:
        families = ", ".join(APRIL_FAMILIES)
        raise _wrong(text, kind, f"'{options['family']}' is no family; known are {families}")
    first = _first_id(text, kind, options, APRIL_FAMILIES[family], columns * rows)
    order: RowOrder = "either"
    if "order" in options:
        order = "up" if options["order"] == "up" else "down"
    bits = int(options.get("border", 0))
    return AprilGrid(columns, rows, tag_mm, spacing, family, first, bits, order)


def _spacing(text: str, tag_mm: float, field: str) -> float:
    """Of an AprilGrid: a part of the tag's side as of Kalibr, or a length with a unit."""
    kind = "aprilgrid"
    is_bare = re.fullmatch(r"\d+\.?\d*|\.\d+", field) is not None
    spacing = float(field) if is_bare else _length_mm(text, kind, "spacing", field) / tag_mm
    if is_bare and spacing >= 1.0:
        raise OptionError(
            f"a spacing of {field} times the tag's side: is it mm",
            where=f"target '{text}'",
            remedy=f"write {field}mm, or {spacing / tag_mm:.4g}, its part of the tag's side",
        )
    if not LEAST_SPACING <= spacing < 1.0:
        raise _wrong(
            text, kind, f"a spacing of {spacing:.3g} times the tag's side: {LEAST_SPACING} to 1"
        )
    return spacing


def _first_id(text: str, kind: str, options: dict[str, str], name: str, n_markers: int) -> int:
    """The number of the first marker; the dictionary of that name must have the last one, too."""
    field = options.get("first", "0")
    if not re.fullmatch(r"\d{1,4}", field):
        raise _wrong(text, kind, f"'{field}' is no number of a marker")
    first = int(field)
    code = int(getattr(cv2.aruco, name))
    n_known = len(cv2.aruco.getPredefinedDictionary(code).bytesList)
    if first + n_markers > n_known:
        begin = f" from {first} on" if first else ""
        raise _wrong(
            text, kind, f"the board needs {n_markers} markers{begin}, {name} has {n_known}"
        )
    return first


def _options(text: str, kind: str, fields: list[str], known: dict[str, str]) -> dict[str, str]:
    """What follows a specification: ``name=value``, or a word that tells by itself what it is.

    ``known``: Names, with the values that each may have, blanks between; any where there are none.
    """
    words = {word: name for name, values in known.items() for word in values.split()}
    options: dict[str, str] = {}
    for field in fields:
        name, equals, value = field.lower().partition("=")
        if not equals:
            name, value = ("" if name.isdigit() else words.get(name, "")), name
        if name not in known or name in options:
            usual = [f"{name}=" for name in known if name not in words.values()]
            usual += [word if word.isalpha() else f"{words[word]}={word}" for word in words]
            raise _wrong(
                text, kind, f"'{field}' may not follow; {', '.join(usual)} may, each kind once"
            )
        if known[name] and value not in known[name].split():
            allowed = known[name].replace(" ", " or ")
            raise _wrong(text, kind, f"'{value}' is no {name}: {allowed}, or leave it out")
        options[name] = value
    return options


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
        Size of the full sensor; of a window on one of unknown size, where it ends there.
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
    is_square
        True if it looks the same turned by a quarter, so that the image tells which axis is x.
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
    is_square: bool = False

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
        right = window.x_px + exposure.width_px * window.binning
        bottom = window.y_px + exposure.height_px * window.binning
        width_px, height_px = exposure.sensor_px or (right, bottom)
        return TargetView(
            source=exposure.source,
            width_px=width_px,
            height_px=height_px,
            point_index=number,
            points_px=window.to_full_sensor(image_px),
            covariance_px2=covariance_px2 * window.binning**2,
            points_board_mm=target.points_board_mm[number],
            is_ambiguous=bool(target.symmetric_turns),
            is_square=1 in target.symmetric_turns,
        )


@dataclass(frozen=True, slots=True)
class OtherCountSeen(FitFailure):
    """No such target is in view, but a full lattice of another count: ``columns`` x ``rows``.

    It may be part of the target, the rest being hidden; where several images show the same one, the
    count that was asked for is wrong.
    """

    columns: int = 0
    rows: int = 0
