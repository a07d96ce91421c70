# SPDX-License-Identifier: Apache-2.0
"""Markers in images, and AprilGrids: tags between small squares that touch their corners, so that
each corner is a crossing of two edges as on a chessboard.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.least_squares import robust_sigma
from armscan.records.exposure import Exposure
from armscan.vision.targets.chessboard import regular_saddles
from armscan.vision.targets.crossings import predict_cells
from armscan.vision.targets.saddle import (
    WINDOW_FRACTION,
    Grey8,
    RawGrey,
    grey_channels,
    sample,
    to_grey8,
)
from armscan.vision.targets.target import (
    APRIL_FAMILIES,
    BORDER_BITS,
    AprilGrid,
    RowOrder,
    TargetView,
    format_target,
)

MIN_CORNERS = 6
"""Fewer corners make no view: four fix a homography and leave nothing to judge it by."""
CLEARANCE = 0.85
"""Part of the way to the nearest other edge that the fit of a corner reaches."""
MIN_TAGS = 2
"""Of an AprilGrid: one alone has fewer corners than a view needs."""
_STEP = (1.0, 1.9)
"""Least and largest way to the next tag, in sides of a tag. Those that are read are up to a tenth
smaller than the print; tags two apart are 2.1 sides away and more."""
_ACROSS = 0.4
_FEW_TAGS = 9
_MOST_DOUBLED = 2_500_000
"""Pixels of an image that is enlarged where few tags were read: of 36 small tags 7 were read in a
rendered one, 32 in one of twice its size; in larger images tags are large."""
_FINE_STEP_PX = 4
_SURE_TAGS = 4
"""Tags of another family or border prove that the print has it."""
_SEARCH_PX = 1600
"""Longest side of an image in which tags of other families are looked for."""
_AROUND = 0.12
"""Half side, in sides of a tag, of the window in which a read corner is brought to the crossing."""
_WIDEST_PX = 15
_LEAST_INSIDE_PX = 2.0
_ALIKE = 0.65
"""Least correlation of a tag's cells with the code that is due: other codes of a family have 0.4 at
most, the same seen through strong blur 0.8."""
_NO_SQUARE = 0.5
"""Of the contrast: as much darker than the gap beside must be what touches a tag's corner."""
_SAME_SPACING = 0.01
"""Spacings that differ by less, in sides of a tag, are the print's affair."""
_SPACING_SIGMAS = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Markers:
    """Markers read in an image.

    ``ids``: (N,) numbers. ``corners_px``: (N, 4, 2) from the first corner, clockwise on the print.
    """

    ids: IntArray
    corners_px: FloatArray

    def __getitem__(self, chosen: IntArray | BoolArray) -> Markers:
        return Markers(self.ids[chosen], self.corners_px[chosen])

    def counted_from(self, first: int) -> Markers:
        """Those with this number and larger ones, which then begin at 0."""
        own = self[self.ids >= first]
        return Markers(own.ids - first, own.corners_px)


def read_markers(
    grey8: Grey8, dictionary: str, border_bits: int = 1, threshold_step_px: int | None = None
) -> Markers:
    """Markers of one of OpenCV's dictionaries, with a black border of so many cells.

    ``threshold_step_px``: Between the windows of the thresholds that are tried; OpenCV's if None.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    if threshold_step_px is not None:
        parameters.adaptiveThreshWinSizeStep = threshold_step_px
    detector = cv2.aruco.ArucoDetector(dictionary_of(dictionary), parameters)
    corners, ids, _ = detector.detectMarkers(grey8)
    if ids is None or len(ids) == 0:
        return Markers(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)))
    return Markers(
        np.asarray(ids, dtype=np.int64).ravel(),
        np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2),
    )


def dictionary_of(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of that name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """Tags that lie beside one another, and how they are numbered.

    ``cells``: (N, 2) place of each of the ``tags``, in steps along the print's rows and down.
    ``turn``: Quarter turns from the tags' own x to the rows' direction; 0 to 3. ``stride``: By how
    much numbers grow from row to row; 0 where one row is seen. ``order``: Where they grow to.
    """

    tags: Markers
    cells: IntArray
    turn: int
    stride: int
    order: RowOrder


def detect_april_grid(exposure: Exposure, target: AprilGrid) -> TargetView | FitFailure:
    """Find an AprilGrid, whole or in part; the tags number its corners.

    Width of the border and order of the rows that the target leaves open are told by the image.
    """
    n_most, failure = -1, FitFailure("")
    for grey in grey_channels(exposure):
        tags, bits = _read_tags(to_grey8(grey, exposure.full_scale), target.family)
        found = _grid_in(exposure, target, grey, tags, bits)
        if isinstance(found, TargetView):
            return found
        if len(tags.ids) > n_most:
            n_most, failure = len(tags.ids), found
    return failure if n_most >= MIN_TAGS else _no_tags(exposure, target, n_most)


def settle_order(exposures: Iterable[Exposure], target: AprilGrid) -> AprilGrid:
    """The grid with the border and the order of rows that the first exposures show that tell."""
    for exposure in exposures:
        if target.border_bits and target.order != "either":
            break
        for grey in grey_channels(exposure):
            tags, bits = _read_tags(to_grey8(grey, exposure.full_scale), target.family)
            grid = _numbered(tags, target)
            if grid is None or len(grid.tags.ids) < _SURE_TAGS:
                continue
            order = grid.order if target.order == "either" else target.order
            target = replace(target, border_bits=target.border_bits or bits, order=order)
            break
    return target


def _read_tags(grey8: Grey8, family: str) -> tuple[Markers, int]:
    """Tags of a family, and the width of their border.

    The wide one first: of its print a reader of narrow ones takes the border's inside for a tag.
    """
    tags = Markers(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)))
    for bits in BORDER_BITS:
        tags = read_markers(grey8, APRIL_FAMILIES[family], bits)
        if len(tags.ids) < _FEW_TAGS and grey8.size < _MOST_DOUBLED:
            more = _read_doubled(grey8, family, bits)
            tags = more if len(more.ids) > len(tags.ids) else tags
        if len(tags.ids) >= MIN_TAGS:
            return tags, bits
    return tags, BORDER_BITS[-1]


def _read_doubled(grey8: Grey8, family: str, border_bits: int) -> Markers:
    """As `read_markers`, in the image enlarged to twice its size, for small tags."""
    large = cv2.resize(grey8, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC)
    name, step = APRIL_FAMILIES[family], _FINE_STEP_PX
    tags = read_markers(np.asarray(large, dtype=np.uint8), name, border_bits, step)
    return Markers(tags.ids, 0.5 * (tags.corners_px + 0.5) - 0.5)


def _grid_in(
    exposure: Exposure, target: AprilGrid, grey: RawGrey, tags: Markers, bits: int
) -> TargetView | FitFailure:
    """The grid in one grey image whose tags are known."""
    if len(tags.ids) < MIN_TAGS:
        return FitFailure(f"{exposure.source}: {len(tags.ids)} tags of {target.family} in view")
    if target.border_bits not in (0, bits):
        text = format_target(replace(target, border_bits=bits))
        return FitFailure(
            f"{exposure.source}: the tags' black border is {bits} cells of their code wide, not "
            f"{target.border_bits}",
            f"write {text}, or leave the border out",
        )
    grid = _numbered(tags, target)
    if grid is None and not len(_links(tags)[0]):
        return FitFailure(
            f"{exposure.source}: {len(tags.ids)} tags of {target.family} were read, no two of them "
            "beside each other",
            "show more of the grid, sharper and evenly lit; no other tags may be in view",
        )
    if grid is None:
        return FitFailure(
            f"{exposure.source}: {len(tags.ids)} tags of {target.family} were read, which do not "
            "show where the next row of numbers is",
            "show tags beside and above one another, or write :up (Kalibr's print) or :down",
        )
    wrong = _unlike(exposure, target, grid)
    if wrong is not None:
        return wrong
    return _tag_corners(exposure, replace(target, border_bits=bits, order=grid.order), grey, grid)


def _links(tags: Markers) -> tuple[IntArray, IntArray, IntArray]:
    """Pairs of neighbours (P,), first and second, and by how many quarter turns from the first's
    own x the second lies: each from both sides.
    """
    one, two, three, four = np.moveaxis(tags.corners_px, 1, 0)
    sides = 0.5 * np.stack([two - one + three - four, four - one + three - two], axis=-1)
    centre = tags.corners_px.mean(axis=1)
    usable = np.abs(np.linalg.det(sides)) > 1.0
    sides[~usable] = np.eye(2)
    away = (centre[None, :] - centre[:, None])[..., None]
    apart = np.linalg.solve(sides[:, None], away)[..., 0]
    found = np.full((4, len(centre)), -1)
    for turn, way in enumerate(_WAYS):
        along, across = apart @ way, np.abs(apart @ _WAYS[(turn + 1) % 4])
        is_next = (along > _STEP[0]) & (along < _STEP[1]) & (across < _ACROSS) & usable[:, None]
        nearest = np.argmin(np.where(is_next, along, np.inf), axis=1)
        found[turn] = np.where(is_next.any(axis=1), nearest, -1)
    turn_of, first = np.nonzero(found >= 0)
    second = found[turn_of, first]
    is_mutual = found[(turn_of + 2) % 4, second] == first
    return first[is_mutual], second[is_mutual], turn_of[is_mutual]


_WAYS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
"""Right, down, left and up: quarter turns of x."""


def _numbered(tags: Markers, target: AprilGrid) -> _Grid | None:
    """Neighbours among tags, the group with most of the target's numbers; None where it does not
    tell how it is numbered.

    One row of tags does not tell where the next is, nor does one column, unless the target does.
    """
    if len(tags.ids) < MIN_TAGS:
        return None
    first, second, turn_of = _links(tags)
    n = len(tags.ids)
    group = connected_components(
        coo_array((np.ones(len(first)), (first, second)), shape=(n, n)), directed=False
    )[1]
    number = tags.ids - target.first_id
    is_own = (number >= 0) & (number < target.columns * target.rows)
    size = np.bincount(group, n * is_own + 1.0)
    is_main = group == np.argmax(size)
    own = is_main[first] if len(first) else np.zeros(0, dtype=np.bool_)
    first, second, turn_of = first[own], second[own], turn_of[own]
    if not len(first):
        return None
    grown = [_usual(tags.ids[second[turn_of == k]] - tags.ids[first[turn_of == k]]) for k in (0, 1)]
    by_turn = [grown[0], grown[1], -grown[0], -grown[1]]
    if 1 in by_turn:
        turn = by_turn.index(1)
        down = by_turn[(turn + 1) % 4]
        order: RowOrder = "down" if down > 0 else "up" if down < 0 else target.order
    else:
        order = target.order
        wanted = target.columns if order == "down" else -target.columns
        if wanted not in by_turn:
            return None
        turn, down = (by_turn.index(wanted) - 1) % 4, wanted
    if order == "either":
        return None
    cells = _cells_of(first, second, turn_of, n)
    cells = np.stack([cells @ _WAYS[turn], cells @ _WAYS[(turn + 1) % 4]], axis=-1)
    return _Grid(tags[is_main], cells[is_main], turn, abs(int(down)), order)


def _usual(values: IntArray) -> int:
    """The commonest of some numbers; 0 for none."""
    if not len(values):
        return 0
    each, count = np.unique(values, return_counts=True)
    return int(each[np.argmax(count)])


def _cells_of(first: IntArray, second: IntArray, turn_of: IntArray, n: int) -> IntArray:
    """(n, 2) steps from one tag to the others that links lead to, along its own x and y."""
    cells = np.zeros((n, 2), dtype=np.int64)
    ways: dict[int, list[tuple[int, int]]] = {}
    for one, other, turn in zip(first.tolist(), second.tolist(), turn_of.tolist(), strict=True):
        ways.setdefault(one, []).append((other, turn))
    waiting = [int(first[0])]
    known = set(waiting)
    while waiting:
        one = waiting.pop()
        for other, turn in ways[one]:
            if other not in known:
                known.add(other)
                cells[other] = cells[one] + _WAYS[turn]
                waiting.append(other)
    return cells


def _places(target: AprilGrid, order: RowOrder, ids: IntArray) -> IntArray:
    """(N, 2) column and row, from the top, of tags on the print; outside it for other numbers."""
    row, column = np.divmod(ids - target.first_id, target.columns)
    return np.stack([column, row if order == "down" else target.rows - 1 - row], axis=-1)


def _unlike(exposure: Exposure, target: AprilGrid, grid: _Grid) -> FitFailure | None:
    """Say which grid the tags fit where it is not the target; None where it is."""
    ids, cells = grid.tags.ids, grid.cells
    columns, number = grid.stride or target.columns, ids - target.first_id
    offset = _places(target, grid.order, ids) - cells
    is_own = (number >= 0) & (number < target.columns * target.rows)
    is_alike = target.order in ("either", grid.order)
    if columns == target.columns and is_own.all() and is_alike and not np.ptp(offset, axis=0).any():
        return None
    width, height = np.ptp(cells, axis=0) + 1
    left = _usual(ids % columns - (cells[:, 0] - cells[:, 0].min())) % columns
    if width < columns and columns == target.columns:
        left = target.first_id % columns
    lowest, rows = int(ids.min()), target.rows
    first = target.first_id
    if not is_own.all() or (first - left) % columns:
        first = max(lowest - (lowest - left) % columns, 0)
    rows = max(
        rows if columns == target.columns else int(height), (int(ids.max()) - first) // columns + 1
    )
    right = replace(target, columns=columns, rows=rows, first_id=first, order="either")
    if not is_alike:
        right = replace(right, order=grid.order)
    text = format_target(right)
    return FitFailure(
        f"{exposure.source}: tags {lowest} to {ids.max()} of {target.family} were read, {width} x "
        f"{height} in view, which do not lie as on {format_target(target)}: numbers grow by "
        f"{columns} from row to row, {grid.order}wards",
        f"{text} fits what is seen; count columns and rows of the whole print",
    )


def _no_tags(exposure: Exposure, target: AprilGrid, n_read: int) -> FitFailure:
    """No grid of the target's family is in view; look for one of another."""
    grey = grey_channels(exposure)[0]
    whole = to_grey8(grey, exposure.full_scale)
    scale = min(1.0, _SEARCH_PX / max(whole.shape))
    reduced = cv2.resize(whole, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    for family in APRIL_FAMILIES:
        tags, bits = _read_tags(np.asarray(reduced, dtype=np.uint8), family)
        grid = None if family == target.family else _numbered(tags, replace(target, order="either"))
        if grid is not None and len(grid.tags.ids) >= _SURE_TAGS:
            text = format_target(replace(target, family=family, border_bits=0))
            return FitFailure(
                f"{exposure.source}: no grid of {target.family} in view, but {len(tags.ids)} tags "
                f"of {family}, their border {bits} cells wide",
                f"write {text}",
            )
    return FitFailure(
        f"{exposure.source}: {max(n_read, 0)} tags of {target.family} in view, at least {MIN_TAGS} "
        "beside each other are needed",
        "show more of it, sharper or nearer; check the family, and that the print is not mirrored",
    )


def _tag_corners(
    exposure: Exposure, target: AprilGrid, grey: RawGrey, grid: _Grid
) -> TargetView | FitFailure:
    """The corners of the tags that were read, measured; the grid's order and border are known."""
    grey8 = to_grey8(grey, exposure.full_scale)
    corners_px = _at_crossings(grey8, np.roll(grid.tags.corners_px, -grid.turn, axis=1))
    spacing = _spacing_seen(corners_px, grid.cells)
    if abs(spacing[0] - target.spacing) > max(_SAME_SPACING, _SPACING_SIGMAS * spacing[1]):
        right = replace(target, spacing=round(spacing[0], 3), border_bits=0, order="either")
        text = format_target(right)
        return FitFailure(
            f"{exposure.source}: tags lie {spacing[0]:.3f} of their side apart, not "
            f"{target.spacing:g}",
            f"measure a tag's side and the gap between two, with a caliper; {text} fits what is "
            "seen",
        )
    places = _places(target, grid.order, grid.tags.ids)
    places, corners_px = _with_unread(grey8, target, grid, places, corners_px)
    way_x, way_y = (
        corners_px[:, [1, 1, 2, 2]] - corners_px[:, [0, 0, 3, 3]],
        corners_px[:, [3, 2, 2, 3]] - corners_px[:, [0, 1, 1, 0]],
    )
    column, row = np.moveaxis(2 * places[:, None] + _CORNER_STEPS, -1, 0)
    number = (row * 2 * target.columns + column).ravel()
    start, along_x, along_y = (part.reshape(-1, 2) for part in (corners_px, way_x, way_y))
    touched = _touches_square(grey, target, corners_px, way_x, way_y)
    if touched.mean() < _NO_SQUARE:
        return FitFailure(
            f"{exposure.source}: {np.count_nonzero(~touched)} of {touched.size} corners of tags "
            "touch no small dark square",
            "print the grid as Kalibr does, with dark squares between the corners of tags",
        )
    chosen = np.argsort(number)
    chosen = chosen[touched.ravel()[chosen]]
    number, start = number[chosen], start[chosen]
    clear = _clear_sides(target)
    steps = clear * along_x[chosen], clear * along_y[chosen]
    cells = target.corners[number]
    points_px, covariance, is_good = regular_saddles(grey, cells, start, steps, clear)
    if is_good.sum() >= MIN_CORNERS:
        return TargetView.of_image(
            exposure, target, number[is_good], points_px[is_good], covariance[is_good]
        )
    return FitFailure(
        f"{exposure.source}: {len(places)} tags of {target.family} were read and {is_good.sum()} "
        f"of their corners measured, at least {MIN_CORNERS} are needed",
        "give a sharper image that shows more of the grid",
    )


_CORNER_STEPS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""From a tag's upper left corner, clockwise, in the order of its corners in a `_Grid`."""


def _at_crossings(grey8: Grey8, corners_px: FloatArray) -> FloatArray:
    """(N, 4, 2) corners of tags, each brought to its crossing: read ones lie up to a tenth of a
    tag inside.
    """
    side = float(np.hypot(*np.moveaxis(corners_px[:, 1] - corners_px[:, 0], -1, 0)).mean())
    half = int(np.clip(round(_AROUND * side), 2, _WIDEST_PX))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 0.01)
    start = np.ascontiguousarray(corners_px.reshape(-1, 1, 2), dtype=np.float32)
    found = cv2.cornerSubPix(grey8, start, (half, half), (-1, -1), criteria)
    return np.asarray(found, dtype=np.float64).reshape(-1, 4, 2)


def _with_unread(
    grey8: Grey8, target: AprilGrid, grid: _Grid, places: IntArray, corners_px: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Places (N, 2) and corners (N, 4, 2), as given and of tags that the reader missed.

    Those are looked for where the known ones beside say, and taken if they show the code that is
    due there.
    """
    row, column = np.mgrid[: target.rows, : target.columns]
    every = np.stack([column.ravel(), row.ravel()], axis=-1)
    last = np.array(grey8.shape[::-1]) - 1.0 - _LEAST_INSIDE_PX
    while True:
        apart = np.abs(every[:, None] - places).max(axis=-1).min(axis=1)
        beside = np.flatnonzero(apart == 1)
        if not len(beside):
            return places, corners_px
        wanted = target.pitch * every[beside][:, None] + _CORNER_STEPS
        known = (target.pitch * places[:, None] + _CORNER_STEPS).reshape(-1, 2)
        seen = predict_cells(known, corners_px.reshape(-1, 2), wanted.reshape(-1, 2))
        quads = seen.reshape(-1, 4, 2)
        with np.errstate(invalid="ignore"):
            is_seen = ((quads > _LEAST_INSIDE_PX) & (quads < last)).all(axis=(1, 2))
        beside, quads = beside[is_seen], quads[is_seen]
        if not len(beside):
            return places, corners_px
        found = _at_crossings(grey8, quads)
        shows = [
            _shows_code(grey8, quad, _code_at(target, grid, every[k]), _border_part(target))
            for k, quad in zip(beside, found, strict=True)
        ]
        if not any(shows):
            return places, corners_px
        places = np.concatenate([places, every[beside[shows]]])
        corners_px = np.concatenate([corners_px, found[shows]])


def _code_at(target: AprilGrid, grid: _Grid, place: IntArray) -> BoolArray:
    """(S, S) light cells of the tag at a place of the print, as they lie there, without border."""
    row = place[1] if grid.order == "down" else target.rows - 1 - place[1]
    number = int(target.first_id + row * target.columns + place[0])
    dictionary = dictionary_of(APRIL_FAMILIES[target.family])
    side = int(dictionary.markerSize)
    drawn = dictionary.generateImageMarker(number, side + 2)[1:-1, 1:-1]
    return np.asarray(np.rot90(drawn, grid.turn) > 0)


def _shows_code(grey8: Grey8, quad_px: FloatArray, code: BoolArray, border: float) -> bool:
    """Whether the cells within a tag's corners (4, 2) are as light and dark as they should be."""
    size = len(code)
    middles = border + (1.0 - 2.0 * border) * (np.arange(size) + 0.5) / size
    along, down = np.meshgrid(middles, middles)
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    seen = cv2.getPerspectiveTransform(unit, quad_px.astype(np.float32))
    at = cv2.perspectiveTransform(np.stack([along, down], axis=-1).astype(np.float32), seen)
    u, v = (np.ascontiguousarray(part, np.float32) for part in np.moveaxis(at, -1, 0))
    levels = cv2.remap(grey8, u, v, cv2.INTER_LINEAR).astype(np.float64)
    if not levels.std() > 0.0:
        return False
    return bool(np.corrcoef(levels.ravel(), code.ravel())[0, 1] > _ALIKE)


def _spacing_seen(corners_px: FloatArray, cells: IntArray) -> tuple[float, float]:
    """Gap between neighbours in sides of a tag, and its standard deviation."""
    at = {(int(column), int(row)): k for k, (column, row) in enumerate(cells)}
    ratios = []
    for (column, row), k in at.items():
        for step, (near, far) in (((1, 0), ([1, 2], [0, 3])), ((0, 1), ([3, 2], [0, 1]))):
            other = at.get((column + step[0], row + step[1]))
            if other is None:
                continue
            ends = [
                corners_px[tag][side].mean(axis=0) for tag in (k, other) for side in (far, near)
            ]
            first, gap, second = (float(np.hypot(*way)) for way in np.diff(ends, axis=0))
            ratios.append(2.0 * gap / (first + second))
    middle = float(np.median(ratios))
    scatter = robust_sigma(np.array(ratios) - middle) if len(ratios) > 1 else _SAME_SPACING
    return middle, float(scatter / np.sqrt(len(ratios)))


def _touches_square(
    grey: RawGrey, target: AprilGrid, corners_px: FloatArray, way_x: FloatArray, way_y: FloatArray
) -> BoolArray:
    """(N, 4) whether a small dark square is where it should touch each corner of each tag."""
    image = np.asarray(cv2.blur(np.asarray(grey, np.float32), (3, 3)), np.float32)
    out_x, out_y = (
        way * (2.0 * _CORNER_STEPS[:, k, None] - 1.0) for k, way in enumerate((way_x, way_y))
    )
    out, within = 0.5 * target.spacing, -0.5 * _border_part(target)

    def level(along_x: float, along_y: float) -> FloatArray:
        at = corners_px + along_x * out_x + along_y * out_y
        return sample(image, at.reshape(-1, 2)).reshape(at.shape[:2])

    square, dark = level(out, out), level(within, within)
    light = 0.5 * (level(out, within) + level(within, out))
    return np.asarray(light - square > _NO_SQUARE * (light - dark))


def _border_part(target: AprilGrid) -> float:
    """Width of the border, in sides of a tag."""
    code = int(dictionary_of(APRIL_FAMILIES[target.family]).markerSize)
    return target.border_bits / (code + 2.0 * target.border_bits)


def _clear_sides(target: AprilGrid) -> float:
    """Part of a tag's side, such that the fit of a corner reaches no code and no other edge."""
    nearest = min(np.sqrt(2.0) * _border_part(target), target.spacing)
    return float(min(1.0, CLEARANCE * nearest / WINDOW_FRACTION))
