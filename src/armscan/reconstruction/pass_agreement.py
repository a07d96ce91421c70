# SPDX-License-Identifier: Apache-2.0
"""Whether the passes of a scan show one surface: what a track or a clock cannot tell of itself.

A pass is what was scanned without a pause, in one direction. Its own stripes lie side by side, so
a wrong clock or pose bends it smoothly and nothing shows; where two passes cross, they then lie
apart. So each pass makes local quadrics of its own stripes, and points of other passes that fall
among those stripes are compared with them, in units of what both claim of themselves. Near an edge
a pass may have seen one face and another pass the next one: such points are not compared.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from itertools import pairwise

import numpy as np

from armscan.geometry.arrays import BoolArray, Box, FloatArray, IntArray, extents
from armscan.geometry.least_squares import robust_sigma
from armscan.kernels.faces import quadric_offsets
from armscan.kernels.grids import first_in_cells
from armscan.reconstruction.place import NeighbourBins, free_slots, spacings_mm

PAUSE_PERIODS = 4.0
"""A pause of so many median periods between exposures begins a new pass."""
LONGEST_PASS = 24
"""Longer passes are cut: a hand that goes to and fro without a pause turns round in between."""
CELL_MM = 0.5
"""Points of one exposure are thinned to one a cell of this size."""
MOST_QUERIES, MOST_OWN = 2000, 150
"""Points that are compared with other passes, and of each pass with itself."""
NEIGHBOURS, FEWEST_NEIGHBOURS, FEWEST_STRIPES = 60, 12, 3
"""Cells of the other pass about a point; the fewest of them, and of their exposures, that make a
quadric of six unknowns with something to check it."""
SPACINGS = 2.4
"""The neighbourhood reaches so many times as far as the next stripe of the pass usually is: two
stripes on either side of a point between them."""
SAMPLED, LOOKED_AT = 100, 64
"""Points of a pass whose distance to the next stripe is measured, and nearest points among which
that stripe must be."""
LEAST_RADIUS_MM, LARGEST_RADIUS_MM = 1.5, 40.0
CELLS = 6.0
"""Cells to its radius: stripes then count alike however dense their points are."""
CENTRED = 0.4
"""The neighbours' middle lies within this part of their radius: a point is among the stripes."""
SAME_FACE = 0.94
"""Normals of two passes on one face differ by less than 20 degrees."""
RIDGE = 1e-6
"""Far below any scatter; it only keeps neighbourhoods on one line from failing."""
FEWEST_POINTS = 20
"""Points that a pair of passes must have in common to be compared."""
AGREES = 5.0
"""A point agrees with another pass within so many of their joint standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class Stripes:
    """Thinned points of all exposures, in the Sensor frame of each.

    Parameters
    ----------
    points_sensor_mm
        (M, 3).
    covariance_mm2
        (M, 3, 3) in Base, as the scan placed them.
    exposure
        (M,) number of their exposure, from 0.
    pass_of
        (E,) number of the pass that each exposure belongs to.
    rotations, translations_mm
        (E, 3, 3) and (E, 3): ``base_from_sensor`` of each exposure.
    """

    points_sensor_mm: FloatArray
    covariance_mm2: FloatArray
    exposure: IntArray
    pass_of: IntArray
    rotations: FloatArray
    translations_mm: FloatArray

    @property
    def points_base_mm(self) -> FloatArray:
        """(M, 3)."""
        turned = np.einsum("mij,mj->mi", self.rotations[self.exposure], self.points_sensor_mm)
        return np.asarray(turned + self.translations_mm[self.exposure])

    def placed(self, rotations: FloatArray, translations_mm: FloatArray) -> Stripes:
        """The same stripes at other poses of the sensor."""
        return replace(self, rotations=rotations, translations_mm=translations_mm)

    def with_points(self, points_sensor_mm: FloatArray) -> Stripes:
        """Other points (M, 3) in their place."""
        return replace(self, points_sensor_mm=points_sensor_mm)

    def of_rows(self, rows: IntArray) -> Stripes:
        """Some of the points."""
        return replace(
            self,
            points_sensor_mm=self.points_sensor_mm[rows],
            covariance_mm2=self.covariance_mm2[rows],
            exposure=self.exposure[rows],
        )


@dataclass(frozen=True, slots=True)
class PassPair:
    """How far points of the pass ``other`` lie from the surface of the pass ``surface``.

    ``distance_mm`` is their median distance and ``ratio`` that over what is expected.
    """

    surface: int
    other: int
    distance_mm: float
    ratio: float


@dataclass(frozen=True, slots=True, eq=False)
class PassDistances:
    """Points of passes among the stripes of other passes.

    Parameters
    ----------
    row, nearest
        (N,) rows of `Stripes`: the point, and its nearest neighbour in the other pass.
    surface
        (N,) number of the other pass.
    normal
        (N, 3) of its surface, in Base.
    distance_mm, sigma_mm
        (N,) signed distance from it, and the standard deviation that both claim, with what quadrics
        between stripes leave out.
    claimed_mm
        (N,) the same without the latter.
    """

    row: IntArray
    nearest: IntArray
    surface: IntArray
    normal: FloatArray
    distance_mm: FloatArray
    sigma_mm: FloatArray
    claimed_mm: FloatArray

    def of_rows(self, rows: BoolArray) -> PassDistances:
        """Some of the points."""
        return PassDistances(*(getattr(self, item.name)[rows] for item in fields(self)))


@dataclass(frozen=True, slots=True)
class PassAgreement:
    """How far passes lie from each other where they overlap.

    Parameters
    ----------
    pairs
        Of passes of which one lies among the stripes of the other.
    n_points
        Points that were compared; a point counts for each pass that it lies among.
    agreeing
        Part of the compared points that agree with the other pass within `AGREES`.
    distance_mm, worst_mm
        Median over pairs of their distances, and the largest.
    claimed_mm
        Median standard deviation that the points claim for such a distance.
    ratio, worst_ratio
        Root mean square over pairs of distance over what is expected, and the largest.
    """

    pairs: tuple[PassPair, ...]
    n_points: int
    agreeing: float
    distance_mm: float
    worst_mm: float
    claimed_mm: float
    ratio: float
    worst_ratio: float


def passes_of(t_ns: IntArray) -> IntArray:
    """(E,) number of the pass of each exposure, from their times in order."""
    n = len(t_ns)
    if n < 2:
        return np.zeros(n, dtype=np.int64)
    step = np.diff(t_ns)
    is_pause = step > PAUSE_PERIODS * float(np.median(step))
    start = np.concatenate([[0], 1 + np.flatnonzero(is_pause), [n]])
    numbers = np.zeros(n, dtype=np.int64)
    count = 0
    for first, end in pairwise(start):
        n_parts = max(1, int(np.ceil((end - first) / LONGEST_PASS)))
        for part in np.array_split(np.arange(first, end), n_parts):
            numbers[part] = count
            count += 1
    return numbers


def thinned_rows(
    points_mm: FloatArray,
    exposure: IntArray,
    size_mm: float = CELL_MM,
    *,
    low_mm: FloatArray | None = None,
) -> IntArray:
    """Rows of one point for each cell of each exposure.

    ``low_mm`` (3,) is the lowest corner of the cloud of which the points are a part; None if they
    are all of it.
    """
    n, low = len(points_mm), extents(points_mm)[0] if low_mm is None else low_mm
    slots = np.full(free_slots(n), -1)
    keys, rows = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    count = first_in_cells(
        np.ascontiguousarray(points_mm), exposure, low, size_mm, slots, keys, rows
    )
    return rows[:count]


def pass_agreement(stripes: Stripes) -> PassAgreement | None:
    """Compare every pass with the surfaces of the others; None where no two passes overlap."""
    found = pass_distances(stripes)
    if found is None:
        return None
    owner = stripes.pass_of[stripes.exposure][found.row]
    pairs = []
    for surface, other in np.unique(np.stack([found.surface, owner], axis=1), axis=0).tolist():
        own = (found.surface == surface) & (owner == other)
        if int(own.sum()) >= FEWEST_POINTS:
            distance = float(np.median(np.abs(found.distance_mm[own])))
            expected = float(np.median(found.sigma_mm[own]))
            pairs.append(PassPair(surface, other, distance, distance / expected))
    if not pairs:
        return None
    distances = np.array([pair.distance_mm for pair in pairs])
    ratios = np.array([pair.ratio for pair in pairs])
    return PassAgreement(
        pairs=tuple(pairs),
        n_points=len(found.row),
        agreeing=float((np.abs(found.distance_mm) <= AGREES * found.sigma_mm).mean()),
        distance_mm=float(np.median(distances)),
        worst_mm=float(distances.max()),
        claimed_mm=float(np.median(found.claimed_mm)),
        ratio=float(np.sqrt(np.mean(ratios**2))),
        worst_ratio=float(ratios.max()),
    )


def pass_distances(stripes: Stripes) -> PassDistances | None:
    """Distances of the points of passes from the surfaces of the others; None if there are none."""
    n_passes = int(stripes.pass_of.max()) + 1 if len(stripes.pass_of) else 0
    if n_passes < 2 or len(stripes.exposure) < FEWEST_POINTS:
        return None
    points, owner = stripes.points_base_mm, stripes.pass_of[stripes.exposure]
    chosen = np.arange(0, len(points), max(1, len(points) // MOST_QUERIES))
    surfaces = _PassSurfaces(stripes, points, owner)
    parts = []
    for number in range(n_passes):
        near = surfaces.reached(number, chosen[owner[chosen] != number])
        # where no other pass comes near, nobody asks what surface there is
        surface = surfaces.of(number) if len(near) else None
        if surface is not None:
            parts.append(surface.distances(near, number))
    if not sum(len(part.row) for part in parts):
        return None
    names = [item.name for item in fields(PassDistances)]
    found = PassDistances(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))
    # NaN, where a point's own pass shows no surface, is no other face
    own_normal = np.full_like(points, np.nan)
    for number in np.unique(owner[found.row]).tolist():
        surface = surfaces.of(number)
        if surface is not None:
            rows = np.unique(found.row[owner[found.row] == number])
            about = surface.distances(rows, number)
            own_normal[about.row] = about.normal
    alike = np.abs(np.einsum("ni,ni->n", found.normal, own_normal[found.row]))
    is_one_face = ~(alike < SAME_FACE)
    return found.of_rows(is_one_face) if is_one_face.any() else None


@dataclass(frozen=True, slots=True, eq=False)
class _PassSurfaces:
    """The surfaces of passes, each built when it is first asked for.

    ``points`` (M, 3) are in Base, ``owner`` (M,) the pass of each.
    """

    stripes: Stripes
    points: FloatArray
    owner: IntArray
    radii_mm: dict[int, float] = field(default_factory=dict)
    built: dict[int, _PassSurface | None] = field(default_factory=dict)

    def reached(self, number: int, rows: IntArray) -> IntArray:
        """Those of the rows that may lie within the radius of a point of the pass."""
        own = np.flatnonzero(self.owner == number)
        if len(own) < FEWEST_NEIGHBOURS or not len(rows):
            return rows[:0]
        points = self.points[own]
        radius = _radius_mm(points, self.stripes.exposure[own])
        self.radii_mm[number] = radius
        low, high = extents(points)
        return np.asarray(rows[Box(low - radius, high + radius).holds(self.points[rows])])

    def of(self, number: int) -> _PassSurface | None:
        """The surface of a pass; None if it has none."""
        if number not in self.built:
            own, radius = np.flatnonzero(self.owner == number), self.radii_mm.get(number)
            self.built[number] = None
            if radius is not None:
                surface = _PassSurface.of(self.stripes, self.points, own, radius)
                self.built[number] = surface
        return self.built[number]


@dataclass(frozen=True, slots=True, eq=False)
class _PassSurface:
    """The stripes of one pass as a surface.

    ``near`` holds its thinned points with their exposures and rows, ``misfit_mm`` is how far its
    own stripes lie off the surface of their neighbours: what quadrics between stripes leave out.
    """

    stripes: Stripes
    points: FloatArray
    near: NeighbourBins
    misfit_mm: float = 0.0

    @staticmethod
    def of(
        stripes: Stripes, points: FloatArray, own: IntArray, radius: float
    ) -> _PassSurface | None:
        """The surface of the points ``own``; None if its stripes do not lie side by side."""
        rows = own[thinned_rows(points[own], stripes.exposure[own], radius / CELLS)]
        table = np.column_stack([points[rows], stripes.exposure[rows], rows])
        near = NeighbourBins.of(table, extents(points[rows])[0], radius)
        bare = _PassSurface(stripes, points, near)
        some = rows[:: max(1, len(rows) // MOST_OWN)]
        left_out = bare.distances(some, -1, is_own=True).distance_mm
        if len(left_out) < FEWEST_POINTS:
            return None
        return replace(bare, misfit_mm=robust_sigma(left_out))

    def distances(self, asked: IntArray, number: int, *, is_own: bool = False) -> PassDistances:
        """Of the points that lie among its stripes; ``is_own`` leaves out a point's own stripe."""
        stripes, near, radius = self.stripes, self.near, self.near.radius_mm
        without = stripes.exposure[asked] if is_own else np.full(len(asked), -1)
        found = np.zeros((len(asked), 9))
        quadric_offsets(
            np.column_stack([self.points[asked], without]),
            near.low_mm,
            radius,
            near.slots,
            near.keys,
            near.starts,
            near.cells,
            np.array([NEIGHBOURS, FEWEST_NEIGHBOURS, FEWEST_STRIPES, RIDGE]),
            found,
        )
        is_among = (found[:, 0] > 0.0) & (found[:, 8] >= 0.0) & (found[:, 8] <= CENTRED)
        is_among &= found[:, 7] < 1.0
        asked, found = asked[is_among], found[is_among]
        nearest, normal = found[:, 1].astype(np.int64), found[:, 3:6]
        claimed = np.zeros(len(asked))
        for one in (asked, nearest):
            claimed += np.einsum("ni,nij,nj->n", normal, stripes.covariance_mm2[one], normal)
        scatter = radius * found[:, 6] * np.sqrt(1.0 + found[:, 7])
        return PassDistances(
            asked,
            nearest,
            np.full(len(asked), number),
            normal,
            radius * found[:, 2],
            np.maximum(np.sqrt(claimed + scatter**2 + self.misfit_mm**2), 1e-9),
            np.sqrt(np.maximum(claimed, 0.0)),
        )


def _radius_mm(points: FloatArray, exposure: IntArray) -> float:
    """Reach that holds the next stripes of the same pass."""
    places = np.column_stack([points, exposure])
    asked = places[:: max(1, len(points) // SAMPLED)]
    own_first = places[np.argsort(exposure, kind="stable")]
    spacing = spacings_mm(asked, [own_first], LOOKED_AT, LARGEST_RADIUS_MM)
    wanted = SPACINGS * float(np.median(np.minimum(spacing, LARGEST_RADIUS_MM)))
    return float(np.clip(wanted, LEAST_RADIUS_MM, LARGEST_RADIUS_MM))
