# SPDX-License-Identifier: Apache-2.0
"""Blobs that may be circles, a lattice grown over them, and the numbers of its cells.

Both kinds of circle grid are square lattices (the asymmetric one turned by 45 degrees). The ellipse
into which a circle is seen gives the local affine map up to a rotation; in coordinates that make it
round again, the four nearest neighbours are equally far and at right angles, at any tilt.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, RowRecord, bools, floats
from armscan.geometry.least_squares import MAD_TO_SIGMA
from armscan.vision.targets.saddle import MIN_CONTRAST, Grey8
from armscan.vision.targets.target import CircleGrid, rightness

MIN_CIRCLE_PX, MAX_CIRCLE_PX = 8.0, 400.0
"""Diameters of a target's circles in the image."""
BLOCK_FRACTIONS = (1 / 40, 1 / 12, 1 / 4)
"""Sides of the squares over which a threshold is the local mean, as fractions of the image."""
MAX_ROUNDNESS_ERROR = 0.12
"""Largest deviation of a contour from its ellipse of inertia, as a fraction of the radius."""
MIN_AXIS_RATIO = 0.25
SAME_LOG_AREA = 1.0
"""Blobs around one place whose areas differ by less than this, in logarithm, are one blob found at
several thresholds; a target's circles never nest."""
_PIXEL_ERROR = 1.0
_NOISE_SIGMAS = 5.0
_PARENT = 3


class Blobs(RowRecord):
    """Ellipse-shaped blobs.

    ``centres_px``: (N, 2) centres, image pixels. ``shapes_px2``: (N, 2, 2) matrices S with
    ``d' S^-1 d = 1`` on the rim, ``d`` from the centre. ``is_light``: (N,) True for a light blob on
    a dark ground.
    """

    centres_px: FloatArray = floats("N", 2)
    shapes_px2: FloatArray = floats("N", 2, 2)
    is_light: BoolArray = bools("N")


def find_blobs(
    grey8: Grey8,
    *,
    smallest_px: float = MIN_CIRCLE_PX,
    largest_px: float = MAX_CIRCLE_PX,
    min_contrast: float = MIN_CONTRAST,
    same_log_area: float = SAME_LOG_AREA,
    block_fractions: tuple[float, ...] = BLOCK_FRACTIONS,
) -> Blobs:
    """Return every contour that is an ellipse within the range of sizes, once.

    A blob found at several threshold scales is kept where its contour is roundest.

    ``grey8``: The image. ``smallest_px``, ``largest_px``: Range of the diameters. ``min_contrast``:
    Least contrast, as a fraction of full scale. ``same_log_area``: Where circles nest, less than
    `SAME_LOG_AREA`, so that their rims stay apart. ``block_fractions``: Of `BLOCK_FRACTIONS`.
    """
    rows: list[tuple[float, ...]] = []
    margin = max(255.0 * min_contrast / 2.0, _NOISE_SIGMAS * _noise(grey8))
    for fraction in block_fractions:
        block = max(11, round(fraction * max(grey8.shape)) | 1)
        mean = cv2.boxFilter(grey8, -1, (block, block), borderType=cv2.BORDER_REPLICATE)
        for is_light in (True, False):
            difference = cv2.subtract(grey8, mean) if is_light else cv2.subtract(mean, grey8)
            _, binary = cv2.threshold(difference, margin, 255, cv2.THRESH_BINARY)
            contours, hierarchy = cv2.findContours(binary, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
            # noise makes tens of thousands of the shortest
            lengths = np.fromiter(map(len, contours), np.int64, len(contours))
            is_likely = (lengths >= 2.0 * smallest_px) & (_links(hierarchy)[:, _PARENT] < 0)
            rows += [
                (*ellipse, float(is_light))
                for k in np.flatnonzero(is_likely).tolist()
                if (ellipse := _ellipse_of(np.asarray(contours[k]), smallest_px, largest_px))
                is not None
            ]
    table = np.array(rows).reshape(-1, 7)
    table = table[np.argsort(table[:, 5], kind="stable")]
    table = table[_first_of_each(table, same_log_area)]
    shapes = table[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    return Blobs(centres_px=table[:, :2], shapes_px2=shapes, is_light=table[:, 6] > 0.5)


def _links(hierarchy: object) -> IntArray:
    """OpenCV's contour hierarchy as (N, 4); empty if there is no contour."""
    return np.zeros((0, 4), np.int64) if hierarchy is None else np.asarray(hierarchy)[0]


def _noise(grey8: Grey8) -> float:
    """Standard deviation of the pixel noise, from second differences along rows."""
    second = np.abs(np.diff(grey8[::8].astype(np.int16), 2, axis=1))
    # as robust_sigma says it: whole numbers are sorted by counting them
    upto = np.cumsum(np.bincount(second.ravel()))
    middle = np.searchsorted(upto, [(second.size - 1) // 2, second.size // 2], side="right")
    return MAD_TO_SIGMA * float(middle.mean() / np.sqrt(6.0)) if second.size else 0.0


def _ellipse_of(
    contour: np.ndarray[tuple[int, ...], np.dtype[np.int32]], smallest_px: float, largest_px: float
) -> tuple[float, float, float, float, float, float] | None:
    """Centre u, v, shape uu, uv, vv and roundness error of a contour, if it is an ellipse."""
    outline = contour.reshape(-1, 2)
    extent = float(np.ptp(outline, axis=0).max())
    if not smallest_px - 2.0 <= extent <= largest_px:
        return None
    moments = cv2.moments(contour)
    area = moments["m00"]
    if area < 0.4 * smallest_px**2:
        return None
    u, v = moments["m10"] / area, moments["m01"] / area
    uu, uv, vv = (4.0 / area * moments[name] for name in ("mu20", "mu11", "mu02"))
    mean, half = 0.5 * (uu + vv), math.hypot(0.5 * (uu - vv), uv)
    least = mean - half
    if least < MIN_AXIS_RATIO**2 * (mean + half) or least < 4.0:
        return None
    du, dv = outline[:, 0] - u, outline[:, 1] - v
    square = (vv * du * du - 2.0 * uv * du * dv + uu * dv * dv) / (uu * vv - uv * uv)
    error = max(math.sqrt(square.max()) - 1.0, 1.0 - math.sqrt(square.min()))
    if error > MAX_ROUNDNESS_ERROR + _PIXEL_ERROR / math.sqrt(least):
        return None
    # The contour runs through the centres of border pixels: half a pixel inside the rim.
    grown = (1.0 + 0.5 / math.sqrt(mean)) ** 2
    return u, v, grown * uu, grown * uv, grown * vv, error


def _first_of_each(table: FloatArray, same_log_area: float) -> BoolArray:
    """Keep the first of all blobs whose centres lie within a third of its short half axis."""
    kept = np.ones(len(table), dtype=np.bool_)
    if not len(table):
        return kept
    tree = cKDTree(table[:, :2])
    area = np.sqrt(np.maximum(table[:, 2] * table[:, 4] - table[:, 3] ** 2, 0.0))
    for k, row in enumerate(table):
        if not kept[k]:
            continue
        near = np.array(tree.query_ball_point(row[:2], 0.35 * np.sqrt(area[k])), dtype=np.int64)
        same = (near > k) & (table[near, 6] == row[6])
        same &= np.abs(np.log(area[near] / area[k])) < same_log_area
        kept[near[same]] = False
    return kept


Cell = tuple[int, int]
Lattice = dict[Cell, int]

_MAX_SEEDS = 60
_NEIGHBOURS = 9
_POSITION_TOLERANCE = 0.28
_MAX_AREA_RATIO = 1.9
_SIDES: tuple[Cell, ...] = ((1, 0), (0, 1), (-1, 0), (0, -1))


def grow_lattices(blobs: Blobs) -> Iterator[Lattice]:
    """Yield lattices (cell to blob index), grown from seeds that no earlier lattice holds.

    The cells' first axis a and second axis b lie in the image so that b is clockwise of a.
    """
    if len(blobs) < 4:
        return
    grower = _Grower(blobs)
    used: set[int] = set()
    for seed in grower.seeds():
        if seed in used:
            continue
        lattice = grower.grow(seed)
        if len(lattice) >= 4:
            used.update(lattice.values())
            yield lattice


class _Grower:
    def __init__(self, blobs: Blobs) -> None:
        self._centres = blobs.centres_px
        self._shapes = blobs.shapes_px2
        self._log_area = 0.5 * np.log(np.linalg.det(blobs.shapes_px2))
        self._tree = cKDTree(self._centres)
        self._count = len(blobs)

    def seeds(self) -> list[int]:
        """Blobs nearest to the middle of all blobs first: the middle has most neighbours."""
        middle = np.median(self._centres, axis=0)
        order = np.argsort(((self._centres - middle) ** 2).sum(axis=1), kind="stable")
        chosen = np.unique(np.linspace(0, self._count - 1, _MAX_SEEDS).astype(np.int64))
        return [int(k) for k in order[chosen]]

    def grow(self, seed: int) -> Lattice:
        """Lattice from a seed, breadth first; each cell hands its basis to its neighbours."""
        basis = self._basis(seed)
        if basis is None:
            return {}
        lattice: Lattice = {(0, 0): seed}
        taken = {seed}
        bases = {(0, 0): basis}
        queue: deque[Cell] = deque([(0, 0)])
        while queue:
            cell = queue.popleft()
            for side in _SIDES:
                beside = (cell[0] + side[0], cell[1] + side[1])
                if beside in lattice:
                    continue
                found = self._neighbour(lattice[cell], bases[cell], side)
                if found is None or found in taken:
                    continue
                lattice[beside] = found
                taken.add(found)
                bases[beside] = self._carried(lattice[cell], found, bases[cell], side)
                queue.append(beside)
        return lattice

    def _basis(self, seed: int) -> FloatArray | None:
        """Two lattice steps (2, 2), rows, at a seed, from its neighbours in rounded coordinates."""
        distance, index = self._tree.query(self._centres[seed], min(self._count, 3 * _NEIGHBOURS))
        near = np.asarray(index)[np.isfinite(distance)][1:]
        similar = np.abs(self._log_area[near] - self._log_area[seed]) < np.log(_MAX_AREA_RATIO)
        near = near[similar]
        offset = self._centres[near] - self._centres[seed]
        rounded = np.linalg.solve(np.linalg.cholesky(self._shapes[seed]), offset.T).T
        length = np.hypot(rounded[:, 0], rounded[:, 1])
        order = np.argsort(length, kind="stable")[:_NEIGHBOURS]
        for first in order[:2]:
            for second in order:
                cross = (
                    rounded[first, 0] * rounded[second, 1] - rounded[first, 1] * rounded[second, 0]
                )
                sine = cross / (length[first] * length[second])
                ratio = length[second] / length[first]
                if sine > 0.94 and 0.75 < ratio < 1.33:
                    return np.stack([offset[first], offset[second]])
        return None

    def _neighbour(self, at: int, basis: FloatArray, side: Cell) -> int | None:
        step = side[0] * basis[0] + side[1] * basis[1]
        distance, found = self._tree.query(self._centres[at] + step)
        if distance > _POSITION_TOLERANCE * np.hypot(*step):
            return None
        if abs(self._log_area[found] - self._log_area[at]) > np.log(_MAX_AREA_RATIO):
            return None
        return int(found)

    def _carried(self, at: int, found: int, basis: FloatArray, side: Cell) -> FloatArray:
        """The basis at the neighbour: the step just made, and the other axis as before."""
        axis = 0 if side[0] else 1
        carried = basis.copy()
        carried[axis] = (self._centres[found] - self._centres[at]) * (side[0] + side[1])
        # The side step changes with distance too: scale it by the circle's own size.
        carried[1 - axis] *= np.exp(0.5 * (self._log_area[found] - self._log_area[at]))
        return carried


@dataclass(frozen=True, slots=True, eq=False)
class NumberedGrid:
    """Blobs with the numbers of their circles.

    ``point_index``: (M,) index into the target's points, ascending. ``blob_index``: (M,) blob of
    each.
    """

    point_index: IntArray
    blob_index: IntArray


def number_grid(
    lattice: Lattice, centres_px: FloatArray, target: CircleGrid, min_fraction: float
) -> NumberedGrid | None:
    """Lay the target over a lattice (cell to blob) of blobs with centres (N, 2).

    ``min_fraction``: Least fraction of its circles that must be there; its four border lines must
    be. Returns the numbering whose x points most to the right; None if the lattice is not this
    grid.
    """
    blobs = np.array(list(lattice.values()), dtype=np.int64)
    pitches_mm = target.pitch_mm * np.array([1.0, target.stretch])
    wanted = np.rint(target.points_board_mm[:, :2] / pitches_mm).astype(np.int64)
    number = {(x, y): k for k, (x, y) in enumerate(wanted.tolist())}
    best: tuple[float, NumberedGrid] | None = None
    for quarter_turns in range(4):
        have = _in_pitches(lattice, quarter_turns, target.is_asymmetric)
        if not np.array_equal(np.ptp(have, axis=0), np.ptp(wanted, axis=0)):
            continue
        placed = have + (wanted.min(axis=0) - have.min(axis=0))
        index = np.array([number.get((x, y), -1) for x, y in placed.tolist()], dtype=np.int64)
        if index.min() < 0 or len(index) < min_fraction * len(wanted):
            continue
        order = np.argsort(index)
        grid = NumberedGrid(index[order], blobs[order])
        board = target.points_board_mm[grid.point_index, :2]
        x_rightness = rightness(board, centres_px[grid.blob_index])
        if best is None or x_rightness > best[0]:
            best = x_rightness, grid
    return None if best is None else best[1]


def lattice_size(lattice: Lattice, is_asymmetric: bool) -> tuple[int, int]:
    """Columns and rows that a lattice spans, of a symmetric grid the larger first: for messages."""
    across, along = (np.ptp(_in_pitches(lattice, 0, is_asymmetric), axis=0) + 1).tolist()
    if not is_asymmetric:
        return max(across, along), min(across, along)
    # A row of C circles spans 2 C places, since each second row is shifted.
    sizes = [((u + 1) // 2, v) for u, v in ((across, along), (along, across))]
    return min(sizes, key=lambda size: abs(size[0] * size[1] - len(lattice)))


def _in_pitches(lattice: Lattice, quarter_turns: int, is_asymmetric: bool) -> IntArray:
    """Places (N, 2) of a lattice's cells after a turn, in pitches along the target's x and y.

    Cells step by one pitch, those of an asymmetric grid by (1, 1) and (-1, 1) pitches.
    """
    cells = np.array(list(lattice), dtype=np.int64)
    for _ in range(quarter_turns):
        cells = np.stack([-cells[:, 1], cells[:, 0]], axis=-1)
    if not is_asymmetric:
        return cells
    return np.stack([cells[:, 0] - cells[:, 1], cells[:, 0] + cells[:, 1]], axis=-1)
