# SPDX-License-Identifier: Apache-2.0
"""Crossings of two edges with alternating sectors, and the lattices they form: chessboards.

The blurred image has a saddle there, whatever the contrast. On a ring around a crossing opposite
sectors are alike, so that the ring's half-turn average keeps the contrast (an edge, the outer
corner of a square or a blob lose it), and it changes its tone twice: the two edges.

From a corner of a chessboard four edges run to its four neighbours, and each neighbour has light
and dark sectors swapped. Crossings that are the nearest such neighbours of each other are linked;
what hangs together is a lattice. Cells in which no crossing was found (a light stripe, a
reflection, a finger) are bridged by a homography of the cells around them.

A flat board seen through any lens is a homography followed by a smooth field: a polynomial of third
degree over the image holds distortion and a bow. A corner that a light stripe or a shadow pulled
lies off it by many times the scatter of the rest.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from armscan.geometry.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    RowRecord,
    apply_homography,
    floats,
    homogeneous,
)
from armscan.models.camera import FISHEYE_FOCALS, NEAR_AXIS, WIDEST_RAD, CameraModel
from armscan.vision.targets.saddle import Grey32, half_turn, ring_levels

_BLUR_PX = 1.2
_RING_PX = 4.0
_N_RING = 32
_MAX_ODD = 0.6
"""Most of the half-turn average's amplitude that may be odd: 1 at the outer corner of a square."""
_NARROWEST = 2
"""Narrowest sector in steps of the ring, 11 degrees each."""
_MAX_CROSSINGS = 3000
_SAME_PLACE_PX = 3.0
_LEVELS = (1.0, 2.0, 4.0)
"""Reductions of the image in which crossings are looked for: the coarse ones are for blur."""


class Crossings(RowRecord):
    """Crossings of two edges.

    ``points_px``: (N, 2) places, image pixels, to about half a pixel. ``rising_rad``,
    ``falling_rad``: (N,) directions of the edges, from u towards v: turning further that way, the
    image gets lighter at the rising one and darker at the falling one. Modulo half a turn.
    ``contrast``: (N,) difference in level between light and dark sectors.
    """

    points_px: FloatArray = floats("N", 2)
    rising_rad: FloatArray = floats("N")
    falling_rad: FloatArray = floats("N")
    contrast: FloatArray = floats("N")


def find_crossings(grey: Grey32, min_contrast: float) -> Crossings:
    """Find all crossings with at least ``min_contrast`` levels between light and dark."""
    found = []
    for level in _LEVELS:
        size = (round(grey.shape[1] / level), round(grey.shape[0] / level))
        if min(size) < 8 * _RING_PX:
            break
        small = grey if level == 1.0 else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        rows = _crossings_in(np.asarray(small, dtype=np.float32), min_contrast)
        rows[:, :2] = (rows[:, :2] + 0.5) * level - 0.5
        found.append(np.column_stack([rows, np.full(len(rows), level)]))
    table = np.concatenate(found)
    table = table[_first_of_each(table)]
    u_v, (rising, falling, contrast) = table[:, :2], table[:, 2:5].T
    return Crossings(points_px=u_v, rising_rad=rising, falling_rad=falling, contrast=contrast)


def _crossings_in(grey: Grey32, min_contrast: float) -> FloatArray:
    """Rows u, v, rising, falling, contrast of the crossings at one scale, strongest first."""
    blurred = np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR_PX), dtype=np.float32)
    points = _saddles(blurred, min_contrast)
    ring = ring_levels(blurred, points, _RING_PX, _N_RING)
    half = ring.shape[1] // 2
    even = 0.5 * (ring[:, :half] + ring[:, half:])
    odd = 0.5 * (ring[:, :half] - ring[:, half:])
    high, low = even.max(axis=1), even.min(axis=1)
    amplitude = 0.5 * (high - low)
    is_light = even > (0.5 * (high + low))[:, None]
    changes = np.diff(np.column_stack([is_light, is_light[:, :1]]).astype(np.int8), axis=1)
    n_light = is_light.sum(axis=1)
    is_crossing = (np.abs(changes).sum(axis=1) == 2) & (2.0 * amplitude >= min_contrast)
    is_crossing &= (n_light >= _NARROWEST) & (n_light <= half - _NARROWEST)
    is_crossing &= np.sqrt((odd**2).mean(axis=1)) < _MAX_ODD * amplitude
    even, changes, amplitude = even[is_crossing], changes[is_crossing], amplitude[is_crossing]
    middle = 0.5 * (high + low)[is_crossing]
    rising = _where_it_passes(even, middle, np.argmax(changes, axis=1))
    falling = _where_it_passes(even, middle, np.argmin(changes, axis=1))
    return np.column_stack([points[is_crossing], rising, falling, 2.0 * amplitude])


def _saddles(blurred: Grey32, min_contrast: float) -> FloatArray:
    """Saddle points (N, 2) of the blurred image, the strongest first."""
    uu = cv2.filter2D(blurred, cv2.CV_32F, np.array([[1.0, -2.0, 1.0]]))
    vv = cv2.filter2D(blurred, cv2.CV_32F, np.array([[1.0], [-2.0], [1.0]]))
    cross = np.array([[1.0, 0.0, -1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 1.0]])
    uv = cv2.filter2D(blurred, cv2.CV_32F, 0.25 * cross)
    strength = uv * uv - uu * vv
    peak = cv2.dilate(strength, np.ones((5, 5), np.uint8))
    # A sharp crossing of amplitude c has the saddle (2 c / (pi s^2))^2; defocus may take 3/4.
    least = 0.25 * 0.5 * min_contrast * 2.0 / (np.pi * (_BLUR_PX**2 + 0.3))
    is_peak = (strength >= peak) & (strength > least**2)
    margin = int(np.ceil(_RING_PX)) + 1
    is_peak[:margin] = is_peak[-margin:] = False
    is_peak[:, :margin] = is_peak[:, -margin:] = False
    v, u = np.nonzero(is_peak)
    order = np.argsort(-strength[v, u], kind="stable")[:_MAX_CROSSINGS]
    u, v = u[order], v[order]
    gradient_u = 0.5 * (blurred[v, u + 1] - blurred[v, u - 1])
    gradient_v = 0.5 * (blurred[v + 1, u] - blurred[v - 1, u])
    a, b, c, size = uu[v, u], uv[v, u], vv[v, u], strength[v, u]
    du = (c * gradient_u - b * gradient_v) / size
    dv = (a * gradient_v - b * gradient_u) / size
    is_near = np.maximum(np.abs(du), np.abs(dv)) < 1.5
    return np.column_stack([u + du, v + dv])[is_near].astype(np.float64)


def _where_it_passes(even: FloatArray, middle: FloatArray, step: IntArray) -> FloatArray:
    """Angle (N,) at which each half ring passes its middle level after the step given."""
    every = np.arange(len(even))
    before = even[every, step]
    after = even[every, (step + 1) % even.shape[1]]
    part = (middle - before) / (after - before)
    return np.asarray(np.mod((step + part) * np.pi / even.shape[1], np.pi))


def _first_of_each(table: FloatArray) -> BoolArray:
    """Keep, of crossings found at several scales, the one at the finest."""
    kept = np.ones(len(table), dtype=np.bool_)
    if not len(table):
        return kept
    pairs = cKDTree(table[:, :2]).query_pairs(_SAME_PLACE_PX * max(_LEVELS), output_type="ndarray")
    apart = np.hypot(*(table[pairs[:, 0], :2] - table[pairs[:, 1], :2]).T)
    pairs = pairs[apart < _SAME_PLACE_PX * table[pairs[:, 1], 5]]
    for fine, coarse in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].tolist():
        if kept[fine]:
            kept[coarse] = False
    return kept


Cell = tuple[int, int]
Lattice = dict[Cell, int]
"""Crossing in each cell (a, b); b lies clockwise of a in the image, as y of x."""

_NEIGHBOURS = 24
_ALONG_EDGE_RAD = 0.25
_SAME_EDGE_RAD = 0.35
_MAX_CONTRAST_RATIO = 4.0
_MIN_CELLS = 6
_MAX_LATTICES = 8
_POSITION_TOLERANCE = 0.15
"""Of a step: how far from its prediction a crossing may lie."""
_NEAR_CELLS = 14
_GAP = 2
"""Most cells without a crossing that are bridged."""
_MAX_ROUNDS = 40
_N_PARABOLA = 6
"""Terms of a parabola in two variables."""
_BENT, _HALF_BENT = 0.25, 0.5
"""Of a homography's mean square: below it a parabola is followed, as before a fisheye, and asked
whether a crossing lies on it."""
_FLAT = 0.01
"""Residuals of a homography, over the extent of the cells around, below which none is asked for."""


def find_lattices(crossings: Crossings) -> Iterator[Lattice]:
    """Yield lattices of at least `_MIN_CELLS` crossings, those of most whole squares first.

    A smaller one is extended only when it is asked for, as one that holds the board mostly is not.
    """
    seeds, held = _linked(crossings), set[int]()
    grown: list[tuple[int, Lattice]] = []
    for k, (_, lattice) in enumerate(seeds):
        if len(held.intersection(lattice.values())) < 0.5 * len(lattice):
            whole = _extended(crossings, _regular(crossings, lattice))
            held.update(whole.values())
            grown.append((_n_squares(whole), whole))
            grown.sort(key=itemgetter(0), reverse=True)
        left = seeds[k + 1][0] if k + 1 < len(seeds) else 0
        while grown and grown[0][0] >= left:
            yield grown.pop(0)[1]


def _n_squares(lattice: Lattice, links: list[list[int]] | None = None) -> int:
    """How many squares have a crossing at each corner, and the links given along each side.

    Behind a board, ribs and baskets are linked by chance to trees of more crossings than it has,
    which hardly ever close.
    """
    n_squares = 0
    for (a, b), first in lattice.items():
        ring = [lattice.get(cell, -1) for cell in ((a + 1, b), (a + 1, b + 1), (a, b + 1))]
        sides = zip([first, *ring], [*ring, first], strict=True)
        is_linked = links is None or all(end in links[start] for start, end in sides)
        n_squares += min(ring) >= 0 and is_linked
    return n_squares


def _linked(crossings: Crossings) -> list[tuple[int, Lattice]]:
    """How many squares lattices of crossings have that are each other's neighbours, most first."""
    if len(crossings) < _MIN_CELLS:
        return []
    links = _links(crossings)
    neighbours: list[list[int]] = links.tolist()
    lattices: list[tuple[int, Lattice]] = []
    taken: set[int] = set()
    first, way = np.nonzero(links >= 0)
    ones, pairs = np.ones(len(way), np.int64), (first, links[first, way])
    linked = coo_array((ones, pairs), shape=(len(links), len(links)))
    component = connected_components(linked, directed=False)[1]
    n_links = np.asarray((links >= 0).sum(axis=1))
    may_seed = (n_links >= 2) & (np.bincount(component)[component] >= _MIN_CELLS)
    for seed in np.argsort(-n_links, kind="stable").tolist():
        if may_seed[seed] and seed not in taken:
            lattice = _connected(crossings, links, seed)
            taken.update(lattice.values())
            if len(lattice) >= _MIN_CELLS:
                lattices.append((_n_squares(lattice, neighbours), lattice))
    return sorted(lattices, key=itemgetter(0), reverse=True)[:_MAX_LATTICES]


def cell_arrays(lattice: Lattice) -> tuple[IntArray, IntArray]:
    """Cells (N, 2) of a lattice and the crossing (N,) in each."""
    return (
        np.array(list(lattice), dtype=np.int64).reshape(-1, 2),
        np.array(list(lattice.values()), dtype=np.int64),
    )


def predict_cells(
    cells: IntArray | FloatArray,
    points_px: FloatArray,
    wanted: IntArray | FloatArray,
    *,
    may_bend: bool = True,
) -> FloatArray:
    """Image points (M, 2) of ``wanted`` cells (M, 2), each from the known cells nearest to it.

    ``cells``, ``points_px``: (N, 2) known cells and their image points. ``wanted``: (M, 2) cells.
    ``may_bend``: By a parabola where a homography fits much worse.

    Returns (M, 2) image points; NaN where the cells around do not fix a homography.
    """
    _, near = _nearest(cells, wanted, min(_NEAR_CELLS, len(cells)))
    around = (cells[near] - wanted[:, None, :]).astype(np.float64), points_px[near]
    places, variance = _mapped_by_homography(*around)
    if not may_bend or around[0].shape[1] <= _N_PARABOLA:
        return places
    extent = np.ptp(around[1], axis=1).max(axis=1)
    doubted = np.flatnonzero(variance > (_FLAT * extent) ** 2)
    if len(doubted):
        bent, left = _mapped_by_parabola(*(each[doubted] for each in around))
        is_bent = left < _BENT * variance[doubted]
        places[doubted[is_bent]] = bent[is_bent]
    return places


def _mapped_by_parabola(cells: FloatArray, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """As `_mapped_by_homography`, by parabolas of the cell."""
    a, b = cells[..., 0], cells[..., 1]
    terms = np.stack([np.ones_like(a), a, b, a * a, a * b, b * b], axis=-1)
    turned = terms.transpose(0, 2, 1)
    middle = points_px.mean(axis=1, keepdims=True)
    ridge = 1e-7 * np.eye(_N_PARABOLA)
    solved = np.linalg.solve(turned @ terms + ridge, turned @ (points_px - middle))
    missed = np.sum((terms @ solved + middle - points_px) ** 2, axis=(1, 2))
    return solved[:, 0] + middle[:, 0], missed / (2 * (cells.shape[1] - _N_PARABOLA))


def _mapped_by_homography(
    cells: FloatArray, points_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Image (M, 2) of the cell (0, 0) by the homographies that M sets of K pairs fix.

    And the variance (M,) that these leave of the pairs, along an axis, px^2.
    """
    middle = points_px.mean(axis=1, keepdims=True)
    scale = np.maximum(np.abs(points_px - middle).max(axis=(1, 2)), 1e-9)
    uv = (points_px - middle) / scale[:, None, None]
    own = np.concatenate([cells, np.ones_like(cells[..., :1])], axis=-1)
    design = np.zeros((len(cells), 2 * cells.shape[1], 8))
    above, below = np.split(design, 2, axis=1)
    above[..., :3], above[..., 6:] = own, -uv[..., :1] * cells
    below[..., 3:6], below[..., 6:] = own, -uv[..., 1:] * cells
    known = np.concatenate([uv[..., 0], uv[..., 1]], axis=1)
    normal = design.transpose(0, 2, 1) @ design
    normal += 1e-7 * np.eye(8)
    solved = np.linalg.solve(normal, design.transpose(0, 2, 1) @ known[..., None])[..., 0]
    spans = np.linalg.eigvalsh(
        np.einsum("mki,mkj->mij", cells - cells.mean(axis=1, keepdims=True), cells)
    )
    solved[spans[:, 0] < 0.5] = np.nan
    seen = own @ solved[:, :6].reshape(-1, 2, 3).transpose(0, 2, 1)
    depth = 1.0 + cells @ solved[:, 6:, None]
    missed = np.sum((seen / depth - uv) ** 2, axis=(1, 2)) * scale**2
    place = solved[:, [2, 5]] * scale[:, None] + middle[:, 0]
    return place, missed / max(2 * cells.shape[1] - 8, 1)


def _links(crossings: Crossings) -> IntArray:
    """Neighbour (N, 4) along the rising edge, the falling edge, and against them; -1 for none."""
    points = crossings.points_px
    count = len(points)
    distance, near = _nearest(points, points, min(_NEIGHBOURS + 1, count))
    near, distance = near[:, 1:], distance[:, 1:]
    way = np.arctan2(*np.moveaxis(points[near] - points[:, None, :], -1, 0)[::-1])
    rising, falling = crossings.rising_rad, crossings.falling_rad
    swapped = np.abs(half_turn(rising[near] - falling[:, None])) < _SAME_EDGE_RAD
    swapped &= np.abs(half_turn(falling[near] - rising[:, None])) < _SAME_EDGE_RAD
    contrast = crossings.contrast
    ratio = np.abs(np.log(contrast[near] / contrast[:, None]))
    swapped &= ratio < np.log(_MAX_CONTRAST_RATIO)
    links = np.full((count, 4), -1, dtype=np.int64)
    for k, edge in enumerate((rising, falling, rising + np.pi, falling + np.pi)):
        turn = np.mod(way - edge[:, None] + np.pi, 2.0 * np.pi) - np.pi
        fits = swapped & (np.abs(turn) < _ALONG_EDGE_RAD)
        first = np.argmin(np.where(fits, distance, np.inf), axis=1)
        has = fits.any(axis=1)
        links[has, k] = near[has, first[has]]
    return _mutual(links)


def _nearest(
    known: FloatArray | IntArray, places: FloatArray | IntArray, count: int
) -> tuple[FloatArray, IntArray]:
    """Distance and index (M, count) of the known points nearest to each place."""
    distance, index = cKDTree(known).query(places, np.arange(1, count + 1))
    return np.asarray(distance, dtype=np.float64), np.asarray(index, dtype=np.int64)


def _mutual(links: IntArray) -> IntArray:
    """Links without those that the other end does not share."""
    back = links[np.maximum(links, 0)]
    shared = (back == np.arange(len(links))[:, None, None]).any(axis=2)
    return np.where((links >= 0) & shared, links, -1)


def _connected(crossings: Crossings, links: IntArray, seed: int) -> Lattice:
    """Cells of everything linked to a seed; a crossing or cell that two claim stays the first's."""
    points = crossings.points_px
    edges = np.stack([crossings.rising_rad, crossings.falling_rad], axis=-1)
    way_a = np.array([np.cos(edges[seed, 0]), np.sin(edges[seed, 0])])
    way_b = np.array([np.cos(edges[seed, 1]), np.sin(edges[seed, 1])])
    if way_a[0] * way_b[1] - way_a[1] * way_b[0] < 0.0:
        way_b = -way_b
    lattice: Lattice = {(0, 0): seed}
    taken = {seed}
    queue: deque[tuple[Cell, FloatArray]] = deque([((0, 0), np.stack([way_a, way_b]))])
    while queue:
        cell, ways = queue.popleft()
        at = lattice[cell]
        for other in links[at].tolist():
            if other < 0 or other in taken:
                continue
            step = points[other] - points[at]
            step = step / np.hypot(*step)
            along = ways @ step
            axis = int(np.argmax(np.abs(along)))
            sign = 1 if along[axis] > 0.0 else -1
            beside = (cell[0] + sign, cell[1]) if axis == 0 else (cell[0], cell[1] + sign)
            if beside in lattice:
                continue
            lattice[beside] = other
            taken.add(other)
            queue.append((beside, _carried(edges[other], ways)))
    return lattice


def _carried(edges_rad: FloatArray, ways: FloatArray) -> FloatArray:
    """The two axes (2, 2) at a neighbour: its own edges nearest to the axes before."""
    own = np.stack([np.cos(edges_rad), np.sin(edges_rad)], axis=-1)
    along = ways @ own.T
    chosen = [0, 1] if abs(along[0, 0] * along[1, 1]) > abs(along[0, 1] * along[1, 0]) else [1, 0]
    sign = np.sign([along[0, chosen[0]], along[1, chosen[1]]])
    return np.asarray(own[chosen] * sign[:, None])


def _regular(crossings: Crossings, lattice: Lattice) -> Lattice:
    """The lattice without cells that do not lie where their neighbours say."""
    cells, index = cell_arrays(lattice)
    if len(cells) < _NEAR_CELLS:
        return lattice
    points = crossings.points_px[index]
    others = _nearest(cells, cells, _NEAR_CELLS)[1][:, 1:]
    around = (cells[others] - cells[:, None, :]).astype(np.float64), points[others]
    flat, variance = _mapped_by_homography(*around)
    bent, left = _mapped_by_parabola(*around)
    missed, beside = (np.hypot(*(each - points).T) for each in (flat, bent))
    missed = np.where(left < _HALF_BENT * variance, np.fmin(missed, beside), missed)
    step = np.linalg.norm(points[others] - points[:, None, :], axis=-1).min(axis=1)
    is_regular = ~(missed > _POSITION_TOLERANCE * step)
    return {
        (int(a), int(b)): int(k)
        for (a, b), k, keep in zip(cells, index, is_regular, strict=True)
        if keep
    }


def _extended(crossings: Crossings, lattice: Lattice) -> Lattice:
    """The lattice with crossings that lie, with the right sectors, where its cells continue."""
    lattice, may_bend = dict(lattice), _is_bent(crossings, lattice)
    for _ in range(_MAX_ROUNDS):
        cells, index = cell_arrays(lattice)
        if len(cells) < _MIN_CELLS:
            return lattice
        points = crossings.points_px[index]
        wanted = _free_cells(cells)
        places = predict_cells(cells, points, wanted, may_bend=may_bend)
        known = np.isfinite(places.sum(axis=1))
        nearest, beside_it = _nearest(crossings.points_px, np.where(known[:, None], places, 0.0), 1)
        distance, found = nearest[:, 0], beside_it[:, 0]
        fits = _is_alike(crossings, lattice, wanted, found) & known & ~np.isin(found, index)
        near = np.flatnonzero(fits)
        ahead, below = (
            predict_cells(cells, points, wanted[near] + np.array(way), may_bend=may_bend)
            for way in ((1, 0), (0, 1))
        )
        step = np.minimum(np.hypot(*(ahead - places[near]).T), np.hypot(*(below - places[near]).T))
        fits[near] = distance[near] < _POSITION_TOLERANCE * step
        if not fits.any() and not may_bend:
            return lattice
        may_bend = bool(fits.any())
        order = np.argsort(distance, kind="stable")
        used: set[int] = set()
        for k in order[fits[order]].tolist():
            if int(found[k]) not in used:
                used.add(int(found[k]))
                lattice[int(wanted[k, 0]), int(wanted[k, 1])] = int(found[k])
    return lattice


def _is_bent(crossings: Crossings, lattice: Lattice) -> bool:
    """Whether homographies of some cells' neighbours leave more than of a flat board."""
    cells, index = cell_arrays(lattice)
    if len(cells) <= _NEAR_CELLS:
        return False
    points = crossings.points_px[index]
    others = _nearest(cells, cells, _NEAR_CELLS)[1][:, 1:]
    around = (cells[others] - cells[:, None, :]).astype(np.float64), points[others]
    extent = np.ptp(points[others], axis=1).max(axis=1)
    return bool(np.any(_mapped_by_homography(*around)[1] > (_FLAT * extent) ** 2))


def _free_cells(cells: IntArray) -> IntArray:
    """Cells (M, 2) without a crossing, within a gap of one that has."""
    low = cells.min(axis=0) - _GAP
    size = np.ptp(cells, axis=0) + 1 + 2 * _GAP
    taken = np.zeros(size, np.uint8)
    taken[tuple((cells - low).T)] = 1
    near = np.asarray(cv2.dilate(taken, np.ones((2 * _GAP + 1, 2 * _GAP + 1), np.uint8)))
    free: IntArray = np.argwhere(near > taken).astype(np.int64) + low
    return free


def _is_alike(
    crossings: Crossings, lattice: Lattice, wanted: IntArray, found: IntArray
) -> BoolArray:
    """Tell whether crossings (M,) have the edges and sectors that a lattice has in cells (M, 2)."""
    cells, index = cell_arrays(lattice)
    near = _nearest(cells, wanted, 1)[1][:, 0]
    beside = index[near]
    parity = (wanted.sum(axis=1) - cells[near].sum(axis=1)) % 2
    rising, falling = crossings.rising_rad, crossings.falling_rad
    like_rising = np.where(parity == 0, rising[beside], falling[beside])
    like_falling = np.where(parity == 0, falling[beside], rising[beside])
    contrast = np.abs(np.log(crossings.contrast[found] / crossings.contrast[beside]))
    return np.asarray(
        (np.abs(half_turn(rising[found] - like_rising)) < _SAME_EDGE_RAD)
        & (np.abs(half_turn(falling[found] - like_falling)) < _SAME_EDGE_RAD)
        & (contrast < np.log(_MAX_CONTRAST_RATIO))
    )


_OUTLIER_SIGMAS = 6.0
_TUKEY = 4.7
_HOMOGRAPHIES, _ROUNDS = 3, 6
_TRUSTED = 0.1
"""Least weight with which a point helps to fix the homography."""
_POINTS_PER_TERM = 3.0
"""Fewest points per term of the polynomial; fewer let it follow a single corner."""
_MUCH_BETTER = 0.5
"""Of what a board misses a homography by: below it, it is seen through a fisheye."""
_ARC_CELLS = 0.25
"""How far to both sides of a corner points tell the curvature of its edges."""


@dataclass(frozen=True, slots=True, eq=False)
class SmoothLattice:
    """What N corners of a board agree on: a flat board before a lens, and a smooth field about it.

    ``homography``: (3, 3) from squares of the board to X/Z, Y/Z before the ``lens``, or to pixels
    without one. ``field``: what image points are shifted by about that. ``is_off``: (N,) True for
    corners that are off it. ``scatter_px``: Robust standard deviation, per axis, of the rest.
    """

    homography: FloatArray
    lens: CameraModel | None
    field: _Field
    is_off: BoolArray
    scatter_px: float

    def seen(self, board: FloatArray) -> FloatArray:
        """Image points (M, 2) of places (M, 2) on the board; not finite where none is seen."""
        flat = _through(self.homography, board, self.lens)
        with np.errstate(invalid="ignore", over="ignore"):
            return flat + self.field.at(flat)

    def curvature(self, board: FloatArray) -> FloatArray:
        """Curvature (M, 2), 1/px, of the board's lines along x and along y, as of `fit_saddles`."""
        curvature = np.zeros((len(board), 2))
        for axis, step in enumerate(_ARC_CELLS * np.eye(2)):
            before, at, after = (self.seen(board + k * step) for k in (-1.0, 0.0, 1.0))
            slope, bend = 0.5 * (after - before), after - 2.0 * at + before
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                turn = slope[:, 0] * bend[:, 1] - slope[:, 1] * bend[:, 0]
                curvature[:, axis] = turn / np.hypot(slope[:, 0], slope[:, 1]) ** 3
        return curvature


@dataclass(frozen=True, slots=True, eq=False)
class _Field:
    """Shift of image points as a polynomial over the image: coefficients (P, 2)."""

    middle_px: FloatArray
    half_px: FloatArray
    coefficients: FloatArray

    def at(self, image: FloatArray) -> FloatArray:
        return _terms(image, self.middle_px, self.half_px, len(self.coefficients)) @ (
            self.coefficients
        )


def fit_lattice(
    board: FloatArray,
    points_px: FloatArray,
    least_sigma_px: FloatArray,
    tolerance_px: float,
    size_px: tuple[int, int],
) -> SmoothLattice | None:
    """Find the lattice that N corners make, and which of them are off it.

    ``board``: (N, 2) places on the board, cells. ``points_px``: (N, 2) image points.
    ``least_sigma_px``: (N,) their standard deviations; the scatter found is not taken to be
    smaller. ``tolerance_px``: What a print's own errors may be; corners that are off by less stay,
    and a field as large asks for a fisheye. ``size_px``: Width and height of the image.

    Returns None where no homography maps the board.
    """
    plain = _smooth(board, points_px, least_sigma_px, tolerance_px, None)
    if plain is None:
        return None
    shift = plain.field.at(plain.seen(board))
    is_bent = float(np.sqrt((shift**2).mean())) > tolerance_px
    if not plain.is_off.any() and plain.scatter_px <= tolerance_px and not is_bent:
        return plain
    lens = _fisheye_before(board, points_px, size_px)
    if lens is None:
        return plain
    wide = _smooth(board, points_px, least_sigma_px, tolerance_px, lens)
    if wide is None:
        return plain
    is_better = wide.scatter_px < _MUCH_BETTER * plain.scatter_px
    return wide if is_better or wide.is_off.sum() < plain.is_off.sum() else plain


def _fisheye_before(
    board: FloatArray, points_px: FloatArray, size_px: tuple[int, int]
) -> CameraModel | None:
    """An equidistant lens before which a flat board fits; None if it does hardly better so."""
    every = np.ones(len(board), dtype=np.bool_)
    flat = _homography(board, points_px, every, None)
    if flat is None:
        return None
    missed = np.hypot(*(_through(flat, board, None) - points_px).T)
    best, least = None, _MUCH_BETTER * float(np.median(missed))
    middle = 0.5 * (np.array(size_px) - 1.0)
    for focal in FISHEYE_FOCALS * max(size_px):
        lens = CameraModel.from_parameters([focal, focal, *middle, *[0.0] * 5], *size_px, "fisheye")
        homography = _homography(board, points_px, every, lens)
        if homography is None:
            continue
        missed = np.hypot(*(_through(homography, board, lens) - points_px).T)
        if (median := float(np.median(missed))) < least:
            best, least = lens, median
    return best


def _homography(
    board: FloatArray, points_px: FloatArray, trusted: BoolArray, lens: CameraModel | None
) -> FloatArray | None:
    """From the board to X/Z before a lens, or to a pinhole's pixels, by trusted points."""
    if lens is None:
        homography, _ = cv2.findHomography(board[trusted], points_px[trusted], 0)
        return None if homography is None else np.asarray(homography)
    xy = (points_px - [lens.cx_px, lens.cy_px]) / lens.fx_px
    angle = np.hypot(*xy.T)
    if not angle.max() < WIDEST_RAD:
        return None
    xy = xy * (np.tan(angle) / np.maximum(angle, NEAR_AXIS))[:, None]
    # a pixel is worth the less of X/Z the farther from the axis
    weight = 1.0 / (1.0 + np.sum(xy[trusted] ** 2, axis=1))
    return _weighted_homography(board[trusted], xy[trusted], weight)


def _through(homography: FloatArray, board: FloatArray, lens: CameraModel | None) -> FloatArray:
    """Image points (N, 2) of a flat board before a lens or a pinhole; not finite behind it."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        mapped = apply_homography(homography, board)
        return mapped if lens is None else lens.project(homogeneous(mapped))


def _weighted_homography(board: FloatArray, xy: FloatArray, weight: FloatArray) -> FloatArray:
    middle, scale = board.mean(axis=0), max(float(np.ptp(board)), 1e-9)
    to_unit = np.array([[1.0, 0.0, -middle[0]], [0.0, 1.0, -middle[1]], [0.0, 0.0, scale]]) / scale
    rows = homogeneous((board - middle) / scale) * weight[:, None]
    none = np.zeros_like(rows)
    design = np.concatenate(
        [
            np.concatenate([rows, none, -xy[:, :1] * rows], axis=1),
            np.concatenate([none, rows, -xy[:, 1:] * rows], axis=1),
        ]
    )
    axes = np.linalg.svd(design, full_matrices=False)[2]
    return np.asarray(axes[-1].reshape(3, 3) @ to_unit)


def _smooth(
    board: FloatArray,
    points_px: FloatArray,
    least_sigma_px: FloatArray,
    tolerance_px: float,
    lens: CameraModel | None,
) -> SmoothLattice | None:
    """As `fit_lattice`, before one lens: a flat board and a smooth field about it."""
    weights = np.ones(len(board))
    lattice: SmoothLattice | None = None
    for _ in range(_HOMOGRAPHIES):
        trusted = weights > _TRUSTED
        homography = _homography(board, points_px, trusted, lens) if trusted.sum() >= 4 else None
        if homography is None:
            break
        mapped = _through(homography, board, lens)
        middle, half = 0.5 * (mapped.min(axis=0) + mapped.max(axis=0)), 0.5 * np.ptp(mapped, axis=0)
        half = np.maximum(half, 1e-9)
        terms = _terms(mapped, middle, half, _n_terms(len(mapped)))
        for _ in range(_ROUNDS):
            shift, missed = _without_itself(terms, points_px - mapped, weights)
            size = np.hypot(*missed.T)
            # The median length of a two-dimensional normal is 1.18 sigma.
            scatter = np.maximum(np.median(size) / 1.1774, least_sigma_px)
            weights = np.clip(1.0 - (size / (_TUKEY * 1.5 * scatter)) ** 2, 1e-3, None) ** 2
        is_off = size > np.maximum(_OUTLIER_SIGMAS * scatter, tolerance_px)
        scatter_px = float(np.median(size) / 1.1774)
        lattice = SmoothLattice(homography, lens, _Field(middle, half, shift), is_off, scatter_px)
    return lattice


def _without_itself(
    terms: FloatArray, residual: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Coefficients (P, 2) of the smooth field, and how far (N, 2) from it without that point."""
    root = np.sqrt(weights)[:, None]
    q, r = np.linalg.qr(terms * root)
    along = q.T @ (residual * root)
    leverage = np.einsum("np,np->n", q, q)
    missed = (residual - q @ along / root) / np.maximum(1.0 - leverage, 0.05)[:, None]
    return np.linalg.solve(r, along), np.asarray(missed)


def _n_terms(n_points: int) -> int:
    """Terms of the polynomial that so many points can bear."""
    return next((n for n in (10, 6, 3) if n_points >= _POINTS_PER_TERM * n), 1)


def _terms(image: FloatArray, middle_px: FloatArray, half_px: FloatArray, n: int) -> FloatArray:
    """The first polynomial terms (N, n) over the image."""
    x, y = ((image - middle_px) / half_px).T
    terms = [np.ones_like(x), x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3]
    return np.stack(terms[:n], axis=-1)
