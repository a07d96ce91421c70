# SPDX-License-Identifier: Apache-2.0
"""Where in a cloud a feature is: candidates through a few points, judged by how many lie on them.

Points are thinned evenly in space and given normals: their own, or those of their neighbourhoods.
A candidate goes through one, two or three of them with their normals (Schnabel, Wahl, Klein,
Comput. Graph. Forum 26 (2007) 214). On walls that few stripes cross there are no normals: there a
cylinder goes through three points, square to a face of the part or along the axis that was given.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from armscan.errors import OptionError
from armscan.geometry.arrays import BoolArray, Box, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.features import (
    SHAPE_KINDS,
    Shape,
    ShapeKind,
    across,
    fit_shape,
    starts_of,
)
from armscan.inspection.selection import MIN_POINTS, SEARCH_BAND_MM, Selection

N_SAMPLE = 6000
"""Points that candidates are made of and judged by."""
N_NEIGHBOURS = 14
"""Points whose plane gives a normal."""
N_TRIALS = {
    "plane": 300,
    "line": 600,
    "circle": 1500,
    "sphere": 600,
    "cylinder": 1200,
    "cone": 1500,
}
THINNEST_LINE = 0.1
"""Breadth of a neighbourhood, as a part of its length, below which it is a line without a normal:
at a tenth the same noise tilts the normal ten times more about the long axis than about the short.
"""
THICKEST_FACE = 0.2
"""Thickness of a neighbourhood, as a part of its breadth, above which it is no face: it may tilt
the normal by atan(0.2), 11 degrees, half of what a rough axis may be wrong."""
ALONG_STRIPE = 12
"""Points of one exposure that give the direction of the stripe."""
SPARSER = 2
"""How many times fewer points are looked at where neighbours lie in a line."""
BISECTIONS = 16
"""Halvings of the side of the cubes by which a cloud is thinned."""
THICKEST_STRIPE = 0.15
"""Breadth of these, as a part of their length, above which they are in no line."""
FACES = 3
"""Faces of a part that a cylinder is tried square to."""
NOISE_BAND, LEAST_BAND_MM = 4.0, 0.02
"""A candidate's band, in thicknesses of neighbourhoods: a wide one would be filled by flat faces
that a large cylinder touches.
"""
SAME_SIDE = math.cos(math.radians(30.0))
"""Normals of a point and of the surface that differ by more than 30 degrees are of two faces."""
ACROSS = math.sqrt(1.0 - SAME_SIDE**2)
"""The same of a direction that lies in the surface."""
SAME_FACE, NEXT_FACE = math.cos(math.radians(2.0)), math.cos(math.radians(10.0))
"""Normals within 2 degrees make a face's; within 10 degrees of it no other is looked for."""
SAME_AXIS = math.cos(math.radians(20.0))
"""How far a candidate's axis may be off the one that was given: it is a rough direction."""
RADIUS_SLACK = 0.1
"""How far a diameter may be from the nominal one, as a part of it, where no range is given."""
LEAST_HALF_ANGLE_DEG = 0.5
"""Half angle below which a cone is a cylinder, or the points are of neither."""
SEED_POINTS = 120
"""Sample points about a seed from which candidates are made."""
NEAR_POINTS = 150
"""Points of the neighbourhood from which a candidate is made."""
SIDE_POINTS = 60
"""The same where only points that may be of the cylinder are looked at."""
N_POLISHED = 10
"""Best candidates that are fitted to the points on them before one is chosen."""
FULLY_BENT = 0.05
"""Second moment of normals, 0 of a flat face and 0.5 of half a cylinder: an arc of 45 degrees."""
SHELL_BANDS = 5.0
"""Half width, in bands, of the shell in which points beside a shape count against it."""
ROUNDS = 3
N_ASKED, BROAD_FACE = 2000, 0.3
"""Points whose normals are held against their neighbours' faces; and breadth of those over their
length, for a few stripes side by side tell a normal poorly."""
LEAST_UPRIGHT, MOST_OFF = math.cos(math.radians(45.0)), 0.2
"""Normals more than 45 degrees off their face are not of it; part of them that edges explain."""


@dataclass(frozen=True, slots=True)
class WantedFeature:
    """What is looked for, and what is known of it.

    Parameters
    ----------
    diameter_mm
        Nominal diameter of a circle, sphere or cylinder; None if there is none.
    diameter_range_mm
        Least and largest diameter that it may have; None for 10 % about the nominal one.
    half_angle_deg
        Nominal half angle of a cone; None if there is none.
    axis
        Rough direction of the axis, line or normal; None for any.
    seed_mm
        A point on it; None to look everywhere. With it only what hangs together with it counts.
    region
        Only points inside are looked at; None for all.
    """

    kind: ShapeKind
    diameter_mm: float | None = None
    diameter_range_mm: tuple[float, float] | None = None
    half_angle_deg: float | None = None
    axis: tuple[float, ...] | None = None
    seed_mm: tuple[float, ...] | None = None
    region: Box | None = field(default=None)

    def __post_init__(self) -> None:
        is_round = self.kind in ("circle", "sphere", "cylinder")
        low, high = self.diameter_range_mm or (1.0, 2.0)
        faults = (
            (self.kind not in SHAPE_KINDS, f"there is no feature '{self.kind}'",
             f"give one of {', '.join(SHAPE_KINDS)}"),
            (not is_round and (self.diameter_mm or self.diameter_range_mm) is not None,
             f"a {self.kind} has no diameter", "leave it out"),
            (self.kind != "cone" and self.half_angle_deg is not None,
             f"a {self.kind} has no half angle", "leave it out"),
            (self.diameter_mm is not None and not 0.0 < self.diameter_mm < 1e4,
             f"a diameter of {self.diameter_mm} mm", "give it in mm, above 0"),
            (not 0.0 < low < high < 1e4, f"diameters from {low:g} to {high:g} mm",
             "give the least and the largest diameter"),
            (self.diameter_range_mm is not None and not low <= (self.diameter_mm or low) <= high,
             f"a diameter of {self.diameter_mm} mm is not within the range of {low:g} to {high:g}",
             "give a range that holds it, or one of them"),
            (self.half_angle_deg is not None and not 0.0 < self.half_angle_deg < 85.0,
             f"a half angle of {self.half_angle_deg} degrees", "give 0 to 85"),
            (self.axis is not None and not (_are_three(self.axis) and any(self.axis)),
             "the axis is no direction", "give three numbers x,y,z, not all 0"),
            (self.seed_mm is not None and not _are_three(self.seed_mm),
             "the seed is no point", "give three numbers x,y,z in mm"),
            (self.kind in ("line", "circle") and (self.seed_mm or self.region) is None,
             f"a {self.kind} is not looked for in a whole cloud: any face holds some",
             "show its edge, rim or thin section with --region, or a point on it with --seed"),
        )  # fmt: skip
        for is_wrong, what, remedy in faults:
            if is_wrong:
                raise OptionError(what, remedy=remedy)

    @property
    def radii_mm(self) -> tuple[float, float]:
        """Least and largest radius that is looked for."""
        if self.diameter_range_mm is not None:
            return self.diameter_range_mm[0] / 2.0, self.diameter_range_mm[1] / 2.0
        if self.diameter_mm is None:
            return 0.0, math.inf
        half = self.diameter_mm / 2.0
        return half * (1.0 - RADIUS_SLACK), half * (1.0 + RADIUS_SLACK)

    def may_be(self, shape: Shape) -> bool:
        """Whether a shape fits what is known."""
        if self.axis is not None:
            direction = np.asarray(self.axis) / np.linalg.norm(self.axis)
            if abs(float(shape.direction @ direction)) < SAME_AXIS:
                return False
        if self.kind == "cone":
            wanted = self.half_angle_deg
            found = math.degrees(shape.half_angle_rad)
            is_near = wanted is None or abs(found - wanted) <= max(3.0, RADIUS_SLACK * wanted)
            return found >= LEAST_HALF_ANGLE_DEG and is_near
        low, high = self.radii_mm
        return self.kind in ("plane", "line") or low <= shape.radius_mm <= high

    def __str__(self) -> str:
        size = "" if self.diameter_mm is None else f" of {self.diameter_mm:g} mm"
        if self.half_angle_deg is not None:
            size = f" of {self.half_angle_deg:g} degrees"
        return f"{self.kind}{size}"


def _are_three(values: tuple[float, ...]) -> bool:
    return len(values) == 3 and all(math.isfinite(value) for value in values)


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """Points drawn evenly in space, with normals and directions of their stripes.

    Parameters
    ----------
    points_mm, normals
        (M, 3) each; a normal's sign is any. It is 0 where there is none: about a lone stripe.
    along
        (M, 3) unit directions of the stripes, of any sign; 0 where points lie in no line.
    band_mm
        (M,) how far off the shape each may lie by its own sigma.
    scatter_mm
        What neighbourhoods are thick; NaN where none is flat.
    spacing_mm
        Typical distance of neighbours.
    """

    points_mm: FloatArray
    normals: FloatArray
    along: FloatArray
    band_mm: FloatArray
    scatter_mm: float
    spacing_mm: float

    @property
    def noise_mm(self) -> float:
        """How far off a candidate of a surface they may lie."""
        return min(float(np.fmax(NOISE_BAND * self.scatter_mm, LEAST_BAND_MM)), SEARCH_BAND_MM)

    def nearest(self, points_mm: FloatArray) -> IntArray:
        """(N,) rows of the sample points nearest to points (N, 3)."""
        return np.asarray(cKDTree(self.points_mm).query(points_mm)[1])

    def facing(
        self, shape: Shape, points_mm: FloatArray, nearest: IntArray | None = None
    ) -> BoolArray:
        """(N,) whether points (N, 3) look as the surface does there, as far as that is known.

        What is known is that of the sample points ``nearest``, of themselves if None. The surface
        is square to a normal, and along a stripe, to 30 degrees.
        """
        which = slice(None) if nearest is None else nearest
        outward, normals = shape.outward(points_mm), self.normals[which]
        cosine = np.abs(np.einsum("ni,ni->n", outward, normals))
        sine = np.abs(np.einsum("ni,ni->n", outward, self.along[which]))
        is_square = (cosine >= SAME_SIDE) | ~normals.any(axis=1)
        return np.asarray(is_square & (sine <= ACROSS))


def normals_are_of_points(points_mm: FloatArray, normals: FloatArray) -> bool:
    """Whether normals (N, 3) stand on the faces that neighbours among points (N, 3) make.

    Other programs write the same one at every point, or leave those of another cloud. True where
    too few neighbourhoods are flat to tell; zeros are no normals and do not count.

    Where a scanner paused, nearest points are of one light sheet, and flat in it: normals that
    stand on the faces of evenly thinned points are not off either.
    """
    given = np.flatnonzero(np.isfinite(normals).all(axis=1) & normals.any(axis=1))
    if len(given) < MIN_POINTS:
        return True
    points = points_mm[given]
    asked = np.random.default_rng(0).permutation(len(given))[:N_ASKED]
    is_flat, is_upright = _on_faces(points, points[asked], normals[given[asked]])
    told = asked[is_flat]
    if len(told) < MIN_POINTS:
        return True
    is_off = ~is_upright[is_flat]
    if float(is_off.mean()) > MOST_OFF:
        even = points[_thinned(points, min(N_ASKED, len(points) // SPARSER))]
        is_off &= ~np.logical_and(*_on_faces(even, points[told], normals[given[told]]))
    return float(is_off.mean()) <= MOST_OFF


def _on_faces(
    points: FloatArray, at_mm: FloatArray, normals: FloatArray
) -> tuple[BoolArray, BoolArray]:
    """(N,) whether points nearest to places (N, 3) are flat, and whether normals stand on them."""
    near = cKDTree(points).query(at_mm, min(N_NEIGHBOURS, len(points)))[1]
    about = points[near] - points[near].mean(axis=1, keepdims=True)
    values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", about, about))
    thickness, breadth, length = np.sqrt(np.maximum(values, 0.0)).T
    is_flat = (breadth >= BROAD_FACE * length) & (thickness <= THICKEST_FACE * breadth)
    cosine = np.abs(np.einsum("ni,ni->n", normals, axes[:, :, 0]))
    return is_flat, cosine >= LEAST_UPRIGHT * np.linalg.norm(normals, axis=1)


def scatter_about_mm(selection: Selection, rows: IntArray) -> float:
    """What points (N,) of a cloud scatter by off the faces that neighbours among them make.

    NaN where no neighbours make one.
    """
    return sample_of(replace(selection, rows=rows)).scatter_mm


def sample_of(selection: Selection) -> Sample:
    """Thin the points that are looked at, and estimate normals."""
    chosen = _thinned(selection.points_mm, N_SAMPLE)
    drawn, along = selection.points_mm[chosen], _along_stripes(selection, chosen)
    normals, thickness, spacing = _normals(drawn, along)
    own = selection.cloud.normals
    if own is not None:
        given = own[selection.rows[chosen]]
        is_given = np.isfinite(given).all(axis=1) & given.any(axis=1)
        normals[is_given] = given[is_given]
    scatter = float(np.maximum(thickness, LEAST_BAND_MM / NOISE_BAND))
    return Sample(drawn, normals, along, selection.search_band_mm[chosen], scatter, spacing)


def _normals(points: FloatArray, along: FloatArray) -> tuple[FloatArray, float, float]:
    """Normals (M, 3) of neighbourhoods, 0 where there is none, their thickness, and how wide.

    The thickness is NaN if none is flat.

    Where the nearest points lie along one stripe they are taken of ever fewer, until they span
    several stripes.
    """
    normals, is_line = np.zeros_like(points), np.ones(len(points), dtype=np.bool_)
    thick: list[FloatArray] = []
    wide: list[FloatArray] = []
    most = len(points)
    while is_line.any() and most >= MIN_POINTS:
        sparse = points[_thinned(points, most)]
        rows = np.flatnonzero(is_line)
        near = cKDTree(sparse).query(points[rows], min(N_NEIGHBOURS, len(sparse)))[1]
        about = sparse[near] - sparse[near].mean(axis=1, keepdims=True)
        values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", about, about))
        thickness, breadth, length = np.sqrt(np.maximum(values, 0.0)).T
        is_flat = (breadth >= THINNEST_LINE * length) & (thickness <= THICKEST_FACE * breadth)
        # a stripe lies in its face
        is_flat &= np.abs(np.einsum("ni,ni->n", axes[:, :, 0], along[rows])) <= ACROSS
        normals[rows[is_flat]] = axes[is_flat, :, 0]
        thick.append(thickness[is_flat] / math.sqrt(max(about.shape[1] - 3, 1)))
        wide.append(np.linalg.norm(about, axis=2).max(axis=1)[is_flat])
        is_line[rows] = breadth < THINNEST_LINE * length
        most //= SPARSER
    if not normals.any():
        return normals, math.nan, float(np.ptp(points, axis=0).max()) / math.sqrt(len(points))
    return normals, float(np.median(np.concatenate(thick))), float(np.median(np.concatenate(wide)))


def _thinned(points: FloatArray, most: int) -> IntArray:
    """Rows of points (N, 3), one of each cube of space, so that they are ``most`` or a few less.

    Dense stripes far apart would else take every place, and steep walls have few points.
    """
    order = np.random.default_rng(0).permutation(len(points))
    if len(points) <= most or not np.ptp(points, axis=0).any():
        return np.asarray(order[:most])
    low, high = 0.0, float(np.ptp(points, axis=0).max())
    placed = np.ascontiguousarray((points[order] - points.min(axis=0)).T)
    widest = None
    for _ in range(BISECTIONS):
        side = 0.5 * (low + high)
        numbers = _cells(placed, side)
        # counted without their places, which costs a third of the time
        if np.count_nonzero(np.diff(np.sort(numbers))) + 1 > most:
            low = side
        else:
            high, widest = side, numbers
    if widest is None:
        return np.asarray(order[:most])
    return np.asarray(order[np.sort(np.unique(widest, return_index=True)[1])])


def _cells(placed: FloatArray, side: float) -> IntArray:
    """(N,) number of the cube in which each of points (3, N), none below 0, lies."""
    cells = (placed / side).astype(np.int64)
    n_y, n_z = (int(one) + 1 for one in cells[1:].max(axis=1))
    return np.asarray((cells[0] * n_y + cells[1]) * n_z + cells[2])


def _along_stripes(selection: Selection, chosen: IntArray) -> FloatArray:
    """(M, 3) directions of the stripes at chosen points; 0 where an exposure's are in no line."""
    points, exposure = selection.points_mm, selection.cloud.exposure[selection.rows]
    apart = 1e3 * float(np.ptp(points, axis=0).max())
    # no point of another exposure is ever nearer than one of the same
    placed = np.column_stack([points, apart * exposure])
    near = cKDTree(placed).query(placed[chosen], min(ALONG_STRIPE, len(points)))[1]
    about = points[near] - points[near].mean(axis=1, keepdims=True)
    values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", about, about))
    is_line = values[:, 1] <= THICKEST_STRIPE**2 * values[:, 2]
    is_line &= (exposure[near] == exposure[chosen][:, None]).all(axis=1)
    return np.where(is_line[:, None], axes[:, :, 2], 0.0)


def find_shape(sample: Sample, wanted: WantedFeature) -> Shape | FitFailure:
    """The shape of a kind that most points lie on, as far as it fits what is known of it."""
    scored = [
        (_score(sample, shape), -k, shape)
        for k, shape in enumerate(_candidates(sample, wanted, _pool(sample, wanted)))
        if wanted.may_be(shape)
    ]
    scored = sorted((item for item in scored if item[0] > 0.0), reverse=True)
    scored = _through_seed(sample, wanted, scored)[:N_POLISHED]
    if not scored:
        return FitFailure(
            f"there is no {wanted}: no candidate fits what is known of it",
            "check the nominal values, or show where it is with --region or --seed",
        )
    return max((_polished(sample, wanted, item[2]) for item in scored), key=lambda one: one[0])[1]


def _through_seed(
    sample: Sample, wanted: WantedFeature, scored: list[tuple[float, int, Shape]]
) -> list[tuple[float, int, Shape]]:
    """Candidates on which the point nearest to the seed may lie; all of them where none is.

    The seed is as far off the feature as it was read off, never nearer to another one.
    """
    if wanted.seed_mm is None:
        return scored
    seed = np.asarray(wanted.seed_mm)[None, :]
    is_thin = wanted.kind in ("line", "circle")
    band = float(sample.band_mm.max()) if is_thin else sample.noise_mm
    far = float(np.linalg.norm(sample.points_mm - seed, axis=1).min()) + band
    return [one for one in scored if abs(float(one[2].distance_mm(seed)[0])) <= far] or scored


def _polished(sample: Sample, wanted: WantedFeature, shape: Shape) -> tuple[float, Shape]:
    """A candidate fitted to what lies on it, and its score; as it was where that is no better."""
    best = _score(sample, shape), shape
    for _ in range(ROUNDS):
        is_near = _support(sample, best[1])
        if int(is_near.sum()) < MIN_POINTS // 3:
            break
        fit = fit_shape(wanted.kind, sample.points_mm[is_near], best[1])
        if isinstance(fit, FitFailure) or not wanted.may_be(fit.value):
            break
        score = _score(sample, fit.value)
        if score <= best[0]:
            break
        best = score, fit.value
    return best


def _score(sample: Sample, shape: Shape) -> float:
    """Count of the points on a shape, less where they hardly show that it is curved.

    A strip of a flat face lies on any large cylinder that touches it; its normals are all alike.
    A cylinder that cuts through faces has as many points just beside it as on it.
    """
    is_near = _support(sample, shape)
    n = float(is_near.sum())
    if shape.kind in ("plane", "line", "circle") or n == 0.0:
        return n
    normals = shape.outward(sample.points_mm[is_near])
    bent = float(np.linalg.eigvalsh(normals.T @ normals)[1]) / n
    off = np.abs(shape.distance_mm(sample.points_mm))
    beside = (off <= SHELL_BANDS * sample.noise_mm) & sample.facing(shape, sample.points_mm)
    return n * min(1.0, bent / FULLY_BENT) * n / float(beside.sum())


def _pool(sample: Sample, wanted: WantedFeature) -> IntArray:
    """Sample points that candidates go through."""
    if wanted.seed_mm is None:
        return np.arange(len(sample.points_mm))
    far = np.linalg.norm(sample.points_mm - np.asarray(wanted.seed_mm), axis=1)
    return np.argsort(far)[:SEED_POINTS]


def _support(sample: Sample, shape: Shape) -> BoolArray:
    """(M,) sample points on a shape that look the way its surface does there."""
    off = np.abs(shape.distance_mm(sample.points_mm))
    if shape.kind in ("line", "circle"):
        return np.asarray(off <= sample.band_mm)
    is_near = off <= sample.noise_mm
    return np.asarray(is_near & sample.facing(shape, sample.points_mm))


def _candidates(sample: Sample, wanted: WantedFeature, pool: IntArray) -> Iterator[Shape]:
    rng = np.random.default_rng(0)
    p, n = sample.points_mm, sample.normals
    yield from _by_all(p[pool], wanted)
    if wanted.kind == "cylinder":
        yield from _square_to_faces(sample, wanted, pool)
    first = rng.integers(0, len(pool), N_TRIALS[wanted.kind])
    # every other one from a neighbourhood: a feature may be a small part of the whole
    near = np.asarray(cKDTree(p[pool]).query(p[pool[first]], min(NEAR_POINTS, len(pool)))[1])
    for trial, at in enumerate(first.tolist()):
        others = near[trial] if trial % 2 else np.arange(len(pool))
        i, j, k = pool[[at, *others[rng.integers(0, len(others), 2)]]].tolist()
        shape = _through(wanted.kind, p[[i, j, k]], n[[i, j, k]])
        if shape is not None:
            yield shape


def _square_to_faces(sample: Sample, wanted: WantedFeature, pool: IntArray) -> Iterator[Shape]:
    """Cylinders along the axis that was given or square to a face, through three points nearby.

    Only points that may look away from the axis are tried: on a part most are of flat faces.
    """
    rng = np.random.default_rng(1)
    given = np.zeros((0, 3)) if wanted.axis is None else np.array([wanted.axis])
    for axis in (*given, *_face_normals(sample.normals)):
        axes = across(axis)
        normal, along = sample.normals[pool] @ axes[2], sample.along[pool]
        is_side = np.abs(normal) <= ACROSS
        is_side &= sample.normals[pool].any(axis=1) | (np.abs(along @ axes[2]) >= ACROSS)
        side = sample.points_mm[pool[is_side]]
        if len(side) < 3:
            continue
        flat = np.column_stack([side @ axes[:2].T, np.zeros(len(side))])
        first = rng.integers(0, len(side), N_TRIALS["cylinder"])
        tree = cKDTree(flat)
        near = np.asarray(tree.query(flat[first], min(SIDE_POINTS, len(side)))[1])
        for trial, at in enumerate(first.tolist()):
            j, k = near[trial, rng.integers(0, near.shape[1], 2)].tolist()
            circle = _circle_through(flat[[at, j, k]])
            if circle is not None:
                middle = circle.point_mm @ np.vstack([axes[:2], np.zeros(3)])
                middle += float(side[at] @ axes[2]) * axes[2]
                radius = circle.radius_mm
                yield Shape(kind="cylinder", point_mm=middle, axes=axes, radius_mm=radius)


def _face_normals(normals: FloatArray) -> list[FloatArray]:
    """Directions (3,) that most known normals share, the commonest first."""
    left = normals[normals.any(axis=1)]
    found: list[FloatArray] = []
    while len(left) >= MIN_POINTS and len(found) < FACES:
        tried = left[:: max(1, len(left) // 200)]
        best = tried[int(np.argmax((np.abs(tried @ left.T) >= SAME_FACE).sum(axis=1)))]
        is_alike = np.abs(left @ best) >= SAME_FACE
        found.append(np.linalg.eigh(left[is_alike].T @ left[is_alike])[1][:, 2])
        left = left[np.abs(left @ found[-1]) < NEXT_FACE]
    return found


def _by_all(points: FloatArray, wanted: WantedFeature) -> Iterator[Shape]:
    """Where nothing else is in the region or about the seed: all points at once."""
    middle = points.mean(axis=0)
    for shape in starts_of(wanted.kind, points - middle):
        yield Shape(
            kind=shape.kind,
            point_mm=shape.point_mm + middle,
            axes=shape.axes,
            radius_mm=shape.radius_mm,
            half_angle_rad=shape.half_angle_rad,
        )


def _through(kind: ShapeKind, p: FloatArray, n: FloatArray) -> Shape | None:
    """The shape through up to three points (3, 3) with normals (3, 3); None if there is none."""
    if kind in ("plane", "line"):
        along = n[0] if kind == "plane" else p[1] - p[0]
        return Shape(kind=kind, point_mm=p[0], axes=across(along)) if along.any() else None
    if kind in ("circle", "cone"):
        return _circle_through(p) if kind == "circle" else _cone_through(p, n)
    axis = np.cross(n[0], n[1])
    if float(np.linalg.norm(axis)) < 0.1:
        return None
    axes = across(axis)
    # where both normals meet: across the axis for a cylinder, nearest to each other for a ball
    middle, radius = _meeting(p[:2] - p[0], n[:2])
    if radius is None:
        return None
    return Shape(kind=kind, point_mm=p[0] + middle, axes=axes, radius_mm=radius)


def _meeting(p: FloatArray, n: FloatArray) -> tuple[FloatArray, float | None]:
    """Where two lines (2, 3) along normals (2, 3) come nearest, and how far that is from both."""
    cosine = float(n[0] @ n[1])
    between = p[1] - p[0]
    determinant = 1.0 - cosine**2
    if determinant < 1e-6:
        return np.zeros(3), None
    s = (float(between @ n[0]) - cosine * float(between @ n[1])) / determinant
    t = (cosine * float(between @ n[0]) - float(between @ n[1])) / determinant
    if s * t * cosine < 0.0 and abs(cosine) > 0.5:
        return np.zeros(3), None
    middle = 0.5 * (p[0] + s * n[0] + p[1] + t * n[1])
    radius = 0.5 * (abs(s) + abs(t))
    if abs(abs(s) - abs(t)) > 0.2 * radius:
        return np.zeros(3), None
    return middle, radius


def _circle_through(p: FloatArray) -> Shape | None:
    a, b = p[1] - p[0], p[2] - p[0]
    normal = np.cross(a, b)
    square = float(normal @ normal)
    if square < 1e-4 * float(a @ a) * float(b @ b) or square == 0.0:
        return None
    middle = np.cross(float(a @ a) * b - float(b @ b) * a, normal) / (2.0 * square)
    radius = float(np.linalg.norm(middle))
    return Shape(kind="circle", point_mm=p[0] + middle, axes=across(normal), radius_mm=radius)


def _cone_through(p: FloatArray, n: FloatArray) -> Shape | None:
    """Its tip is where the three tangent planes meet."""
    if abs(float(np.linalg.det(n))) < 1e-3:
        return None
    tip = p[0] + np.linalg.solve(n, np.einsum("ij,ij->i", n, p - p[0]))
    rays = p - tip
    length = np.linalg.norm(rays, axis=1)
    if not length.min() > 0.0:
        return None
    rays /= length[:, None]
    normal = np.cross(rays[1] - rays[0], rays[2] - rays[0])
    size = float(np.linalg.norm(normal))
    if size < 1e-4:
        return None
    axis = normal / size
    cosine = float(rays[0] @ axis)
    axis, cosine = (axis, cosine) if cosine > 0.0 else (-axis, -cosine)
    angle = math.acos(min(1.0, cosine))
    if not 0.01 < angle < 1.45:
        return None
    along = float(((p - tip) @ axis).mean())
    return Shape(
        kind="cone",
        point_mm=tip + along * axis,
        axes=across(axis),
        radius_mm=along * math.tan(angle),
        half_angle_rad=angle,
    )


def connected(points_mm: FloatArray, seed_mm: FloatArray, step_mm: float) -> BoolArray:
    """(N,) points (N, 3) that hang together with the one nearest to a seed, gaps up to a step."""
    cells, cell = np.unique(
        np.floor(points_mm / step_mm).astype(np.int64), axis=0, return_inverse=True
    )
    cell = cell.ravel()
    first = int(cell[int(np.argmin(np.linalg.norm(points_mm - seed_mm, axis=1)))])
    tree = cKDTree(cells.astype(np.float64))
    reached = np.zeros(len(cells), dtype=np.bool_)
    reached[first] = True
    edge = np.array([first])
    while len(edge):
        near = np.concatenate(tree.query_ball_point(cells[edge].astype(np.float64), 1.8))
        edge = np.unique(near[~reached[near.astype(np.int64)]].astype(np.int64))
        reached[edge] = True
    return np.asarray(reached[cell])
