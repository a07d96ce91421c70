# SPDX-License-Identifier: Apache-2.0
"""Deviations of a cloud from the model of its part: per point, per face, and against tolerances."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.stats import t as student

from armscan.errors import OptionError
from armscan.geometry.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    RowRecord,
    bools,
    floats,
    ints,
)
from armscan.geometry.estimate import FitFailure
from armscan.inspection.cad.alignment import TYPICAL, Alignment, measured, sight_of
from armscan.inspection.cad.distance import PartSurface, SurfaceDistance
from armscan.inspection.cad.point_errors import PointErrors, scatter_of_means
from armscan.inspection.cad.search import across_mm
from armscan.inspection.conformity import COVERAGE, judge
from armscan.inspection.conformity import Verdict as Validity
from armscan.records.cloud import PointCloud

Decision = Literal["pass", "fail", "undecided"]
DECISIONS: tuple[Decision, ...] = ("pass", "undecided", "fail")
"""In the order of their numbers in files, 0, 1, 2, and from best to worst."""
FAIL = DECISIONS.index("fail")
OF_VALIDITY: Mapping[Validity, Decision] = {
    "still valid": "pass",
    "not valid": "fail",
    "inconclusive": "undecided",
}
RULE = (
    "passed if the deviation's size is at most the tolerance minus U, failed if it is above the "
    "tolerance plus U, else undecided (ISO 14253-1); U is the deviation's expanded uncertainty "
    "(k = 2); what no two exposures show is undecided, not failed"
)
SPOT_SHARE = 0.02
"""Width of a spot over the part's diagonal: small enough to show a dent, large enough for noise to
average out. Of thin clouds spots are larger, so that they hold points enough."""
LEAST_SPOT_POINTS = 10
"""A face none of whose spots has so many is not seen, and not judged."""
MANY_BEYOND = 0.2
"""Part of the points beyond the reach from which on the typical distance is looked at, too: a worn
or raw part lies within the reach where it is off, another part only where it does by chance."""
MOST_TYPICAL = 0.25
"""Typical (median) distance, over the reach, that such a cloud may have; `TYPICAL` of its size if
that is more."""
ALONG_FACE = 0.98
"""Cosine between a deviation and the normal of its face, below which the closest point is on an
edge: the facets of a round face are up to 10 degrees apart, and the point may be of either face."""
MOST_BEYOND = 0.5
"""Part of the points that may lie beyond the reach: the best fit, too, rests on most points."""
PARALLEL = 0.7
"""Cosine between the surface of points off a face and that face, from which on they may be a dent
or a boss of it: a table beside a wall stands across it."""
HIGHEST_BOSS = 0.05
"""Over the part's diagonal: what lies higher over a face is a fixture."""
AS_DENSE = 0.2
"""Points of a spot beyond the reach, over those of the same face there, and over those of the usual
spot, from which on they are a surface and no strays."""


@dataclass(frozen=True, slots=True)
class CadOptions:
    """What belongs to the part, and what is allowed.

    Parameters
    ----------
    reach_mm
        Points farther than this from the model are not of the part: table, fixtures, strays.
    tolerance_mm
        Largest deviation allowed either way; NaN for none.
    face_tolerances_mm
        The same for single faces by their names.
    uncertainty_mm
        U (k = 2) of a deviation, for clouds that carry no standard deviations; NaN for none.
    """

    reach_mm: float = 2.0
    tolerance_mm: float = math.nan
    face_tolerances_mm: Mapping[str, float] = field(default_factory=dict)
    uncertainty_mm: float = math.nan

    def __post_init__(self) -> None:
        named = [
            ("--reach-mm", self.reach_mm, False),
            ("--tolerance", self.tolerance_mm, True),
            ("--uncertainty-mm", self.uncertainty_mm, True),
            *(
                (f"tolerance of {name}", one, False)
                for name, one in self.face_tolerances_mm.items()
            ),
        ]
        for name, value, may_miss in named:
            if not (0.0 < value < math.inf) and not (may_miss and math.isnan(value)):
                raise OptionError(f"a length of {value:g} mm", where=name, remedy="give it above 0")

    @property
    def has_tolerance(self) -> bool:
        """True if anything is to be decided."""
        return math.isfinite(self.tolerance_mm) or bool(self.face_tolerances_mm)

    def tolerance_of(self, face: str) -> float:
        """Tolerance of a face in mm; NaN for none."""
        return self.face_tolerances_mm.get(face, self.tolerance_mm)


@dataclass(frozen=True, slots=True)
class DeviationStatistics:
    """Of signed deviations of points from the model; see `DEFINITIONS`."""

    n: int
    mean_mm: float
    std_mm: float
    rms_mm: float
    p05_mm: float
    p95_mm: float
    min_mm: float
    max_mm: float


DEFINITIONS: Mapping[str, tuple[str, str]] = {
    "n": (
        "points",
        "points whose closest surface is this one and nearer than the reach; of a face without "
        "those beyond its edges, which may be of either face",
    ),
    "mean_mm": ("mean", "arithmetic mean, with sign"),
    "std_mm": ("std", "standard deviation about their mean, divided by n - 1"),
    "rms_mm": ("rms", "deviation rms: root mean square about the model, divided by n"),
    "p05_mm": ("5 %", "value that 5 % of the points lie below, linear between points"),
    "p95_mm": ("95 %", "value that 95 % of the points lie below, linear between points"),
    "min_mm": ("min", "smallest, with sign: the farthest inside"),
    "max_mm": ("max", "largest, with sign: the farthest outside"),
}
"""Label and meaning of each statistic, everywhere the same."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceComparison:
    """One face of the part.

    Parameters
    ----------
    u_mean_mm
        U (k = 2) of the mean, of the points' errors or of how far exposures disagree, the larger;
        NaN where not known, and of a face without points.
    spot_mm, u_spot_mm, spot_place_mm
        Median deviation of the spot that decides, of those the one that deviates most, its U, and
        (3,) where in Cad it is; NaN where no spot has enough points.
    decision
        The worse of those on the mean and on every spot; empty without a tolerance.
    is_seen_once
        What would fail it was shown by no two exposures, so it is undecided: a stripe along an
        edge, or half in a shadow, errs by tenths of a millimetre, and alone.
    beyond_mm, beyond_place_mm
        Median deviation of the spot beyond the reach that is farthest off the face, and (3,) where
        in Cad; NaN for none. It may be a dent, a boss, a fixture or a reflection, and the face does
        not pass.
    """

    name: str
    statistics: DeviationStatistics
    u_mean_mm: float
    spot_mm: float
    u_spot_mm: float
    spot_place_mm: FloatArray
    tolerance_mm: float
    decision: Decision | Literal["", "not seen"]
    is_seen_once: bool = False
    beyond_mm: float = math.nan
    beyond_place_mm: FloatArray = field(default_factory=lambda: np.full(3, math.nan))


class CadComparison(RowRecord):
    """A cloud against the model of its part.

    Parameters
    ----------
    rows
        (N,) rows of the cloud within reach; the rest of the fields are of these.
    points_mm, closest_mm, normals
        (N, 3) places in Cad, closest points of the surface, and outward directions there.
    deviation_mm
        (N,) signed distance, positive outside.
    u_mm
        (N,) expanded uncertainty (k = 2) of each; NaN where not known.
    face
        (N,) number of the face.
    is_beside_edge
        (N,) True beyond the edges of a face: the closest point is on the edge, and the point may
        be of either face. It counts in ``overall`` alone.
    decision
        (N,) number in `DECISIONS`; -1 without a tolerance, or beside an edge.
    is_fused
        True if the cloud no longer tells its exposures apart.
    """

    alignment: Alignment
    options: CadOptions
    rows: IntArray = ints("N")
    points_mm: FloatArray = floats("N", 3)
    closest_mm: FloatArray = floats("N", 3)
    normals: FloatArray = floats("N", 3)
    deviation_mm: FloatArray = floats("N")
    u_mm: FloatArray = floats("N", nan=True)
    face: IntArray = ints("N")
    is_beside_edge: BoolArray = bools("N")
    decision: IntArray = ints("N")
    overall: DeviationStatistics
    faces: tuple[FaceComparison, ...]
    n_given: int
    spot_width_mm: float
    is_fused: bool = False

    @property
    def verdict(self) -> Decision | Literal[""]:
        """The worst decision of all faces that were seen; empty without a tolerance."""
        found = [one.decision for one in self.faces if one.decision in DECISIONS]
        if not found:
            return ""
        return max((d for d in DECISIONS if d in found), key=DECISIONS.index)


def deviation_statistics(deviations_mm: FloatArray) -> DeviationStatistics:
    """Statistics of (N,) deviations; NaN where there are none."""
    d = deviations_mm
    n = len(d)
    if n == 0:
        return DeviationStatistics(0, *(math.nan,) * 7)
    low, high = np.percentile(d, [5.0, 95.0])
    return DeviationStatistics(
        n=n,
        mean_mm=float(d.mean()),
        std_mm=float(d.std(ddof=1)) if n > 1 else math.nan,
        rms_mm=float(np.sqrt(d @ d / n)),
        p05_mm=float(low),
        p95_mm=float(high),
        min_mm=float(d.min()),
        max_mm=float(d.max()),
    )


def compare_with_part(
    surface: PartSurface,
    cloud: PointCloud,
    alignment: Alignment,
    options: CadOptions,
    errors_known: bool,
) -> CadComparison | FitFailure:
    """Deviations of an aligned cloud.

    Returns
    -------
    FitFailure
        If there are no points, or fewer than half of them lie near the model.
    """
    part = surface.part
    found = measured(surface, cloud, alignment.cad_from_part)
    near = np.abs(found.signed_mm) <= options.reach_mm
    rows = np.flatnonzero(near)
    failure = _elsewhere(surface, cloud, alignment, options.reach_mm, np.abs(found.signed_mm))
    if failure is not None:
        return failure
    placed = alignment.cad_from_part.apply(cloud.points_mm)
    normals, d = found.normals, found.signed_mm
    along = np.abs(np.einsum("nk,nk->n", surface.part.normals[found.triangle], normals))
    is_off_face = (along < ALONG_FACE) | _seen_from_behind(surface, cloud, alignment, found)
    is_beside = near & is_off_face
    face = np.where(near & ~is_off_face, part.face[found.triangle], -1)
    by_density = math.sqrt(2 * LEAST_SPOT_POINTS * float(part.areas_mm2.sum()) / len(rows))
    spot_width = max(SPOT_SHARE * part.diagonal_mm, by_density)
    spot, n_spots = _spots(found.closest_mm, face, spot_width)
    jacobian = np.concatenate([np.cross(placed - alignment.centre_mm, normals), normals], axis=1)
    n_faces = len(part.face_names)
    if errors_known:
        u_point, u_face, u_spot = _uncertainties(
            cloud, alignment, normals, jacobian, ((face, n_faces), (spot, n_spots))
        )
        scatter = scatter_of_means(face, n_faces, d, cloud.exposure)
        u_face = np.maximum(u_face, COVERAGE * scatter)
        u_spot = np.maximum(u_spot, median_uncertainty(spot, n_spots, d))
    else:
        u = options.uncertainty_mm
        u_point, u_face, u_spot = (np.full(n, u) for n in (len(cloud), n_faces, n_spots))
    limits = np.array([options.tolerance_of(name) for name in part.face_names])
    of_spot = np.zeros(n_spots, np.int64)
    of_spot[spot[face >= 0]] = face[face >= 0]
    once = _shown_once(spot, cloud, d, limits[of_spot] + u_spot)
    spots = _spot_results(spot, face, d, found.closest_mm, u_spot, is_once=once)
    far = np.flatnonzero(~near & ~is_off_face)
    is_beyond = np.zeros(len(cloud), dtype=np.bool_)
    is_beyond[far] = _may_be_of_part(
        surface, cloud, alignment, found.select(far), far, reach_mm=options.reach_mm
    )
    of_either = np.where(is_beyond, part.face[found.triangle], face)
    beyond = _spots_beyond(is_beyond, of_either, cloud, found, spot_width)
    once = _shown_once(face, cloud, d, limits + u_face)
    by_face = _rows_by(face, n_faces)
    faces = tuple(
        _face(
            name,
            float(limits[k]),
            d[by_face[k]],
            float(u_face[k]),
            (spots.select(spots.face == k), beyond.select(beyond.face == k)),
            is_once=bool(once[k]),
        )
        for k, name in enumerate(part.face_names)
    )
    limit = np.where(is_beside[rows], np.nan, limits[part.face[found.triangle[rows]]])
    return CadComparison(
        alignment=alignment,
        options=options,
        rows=rows,
        points_mm=placed[rows],
        closest_mm=found.closest_mm[rows],
        normals=normals[rows],
        deviation_mm=d[rows],
        u_mm=u_point[rows],
        face=part.face[found.triangle[rows]],
        is_beside_edge=is_beside[rows],
        decision=_decisions(d[rows], limit, u_point[rows]),
        overall=deviation_statistics(d[rows]),
        faces=faces,
        n_given=len(cloud),
        spot_width_mm=spot_width,
        is_fused=cloud.is_fused,
    )


def _elsewhere(
    surface: PartSurface,
    cloud: PointCloud,
    alignment: Alignment,
    reach_mm: float,
    away_mm: FloatArray,
) -> FitFailure | None:
    """Why a cloud whose points are (N,) from the model is not of it; None if it may be."""
    n_near = int((away_mm <= reach_mm).sum())
    lead = "leave --align none out, " if alignment.method == "none" else ""
    remedy = (
        f"{lead}give the model of this part, cut table and fixtures away with --region, or give a "
        "larger --reach-mm"
    )
    if n_near == 0 or n_near < (1.0 - MOST_BEYOND) * len(cloud):
        # rounded down: half of the points would not be refused
        permille = 1000 * n_near // max(len(cloud), 1)
        share = f"only {permille / 10:g} % of the" if n_near else "no"
        what = f"the cloud does not lie on the model: {share} points come within {reach_mm:g} mm"
        return FitFailure(f"{what} of it", remedy)
    typical, size = float(np.median(away_mm)), min(across_mm(cloud.points_mm), surface.diagonal_mm)
    least = max(TYPICAL * size, MOST_TYPICAL * reach_mm, 5.0 * float(np.median(cloud.sigma_mm)))
    beyond = 1.0 - n_near / len(cloud)
    if typical <= least or beyond <= MANY_BEYOND:
        return None
    return FitFailure(
        f"the cloud does not lie on the model: half of its points lie more than {typical:.3g} mm "
        f"off it, {100 * beyond:.0f} % more than {reach_mm:g} mm",
        remedy,
    )


ONE_SIDE = 0.02275
"""Chance beyond two standard deviations of a normal error, on one side: k = 2."""
MEDIAN_OVER_MEAN = math.sqrt(math.pi / 2.0)
"""Standard deviation of the median of many normal errors, over that of their mean."""
QUARTILES_OVER_SIGMA = 1.349
"""Distance of the quartiles of a normal distribution, over its standard deviation."""
EFFICIENCY = 0.37
"""Degrees of freedom of a standard deviation by quartiles, over those of the usual one."""


def median_uncertainty(label: IntArray, count: int, values: FloatArray) -> FloatArray:
    """(count,) U of groups' medians by how far their points scatter; 0 of fewer than four points.

    The standard deviation of a median of few points is known no better than these tell it: U is
    Student's factor for what quartiles of as many points tell and a level of 95.45 %, times it.
    Neighbours that err alike are taken as independent, so that it is a least U, not the whole one.

    Parameters
    ----------
    label, count
        (N,) group of each point, -1 for none, and how many groups there are.
    values
        (N,) of the points.
    """
    n = np.bincount(label[label >= 0], minlength=count)
    order = np.lexsort((values, label))[int((label < 0).sum()) :]
    start = np.concatenate([[0], np.cumsum(n)[:-1]])
    many = np.flatnonzero(n >= 4)
    last = n[many] - 1
    quartiles = []
    for part in (1, 3):
        before, rest = np.divmod(part * last, 4)
        below, above = (values[order[start[many] + before + k * (rest > 0)]] for k in (0, 1))
        quartiles.append(below + (above - below) * rest / 4.0)
    spread = (quartiles[1] - quartiles[0]) / QUARTILES_OVER_SIGMA
    sigma = MEDIAN_OVER_MEAN * spread / np.sqrt(n[many])
    found = np.zeros(count)
    found[many] = student.isf(ONE_SIDE, EFFICIENCY * last) * sigma
    return found


FROM_BEHIND = -0.05
"""Cosine of the angle between a face's normal and the direction to the sensor below which the face
was out of sight: 93 degrees, as facets of a curved face lean by some."""


def _seen_from_behind(
    surface: PartSurface, cloud: PointCloud, alignment: Alignment, found: SurfaceDistance
) -> BoolArray:
    """(N,) points next to a face that the sensor could not see from where it stood.

    They are of the face beyond the edge: a stripe along a rim, half of which falls beside it.
    """
    sight = sight_of(cloud, alignment.cad_from_part)
    if sight is None or not surface.is_closed:
        return np.zeros(len(cloud), dtype=np.bool_)
    cosine = np.einsum("ni,ni->n", sight, surface.part.normals[found.triangle])
    return np.asarray(cosine < FROM_BEHIND)


def _may_be_of_part(
    surface: PartSurface,
    cloud: PointCloud,
    alignment: Alignment,
    found: SurfaceDistance,
    rows: IntArray,
    *,
    reach_mm: float,
) -> BoolArray:
    """(M,) rows of a cloud that may be a dent or a boss of the face next to them.

    Inside a part is nothing but a dent, or what is seen through a thin wall. A table under a brim
    is next to its upper face only where normals chose that face (`PartSurface.distance`); what is
    next to it by itself tells. Above a face is a boss, if it is not too high. Both lie along the
    face, as far as normals tell.
    """
    is_below = found.signed_mm < 0.0
    if cloud.normals is None:
        return is_below & surface.is_closed
    pose = alignment.cad_from_part
    normals = pose.rotate(cloud.normals[rows])
    cosine = np.einsum("ni,ni->n", normals, surface.part.normals[found.triangle])
    by_itself = surface.distance(pose.apply(cloud.points_mm[rows])).signed_mm
    is_low = found.signed_mm < HIGHEST_BOSS * surface.diagonal_mm
    return np.asarray((cosine > PARALLEL) & np.where(is_below, by_itself < reach_mm, is_low))


def _spots_beyond(
    is_beyond: BoolArray,
    face: IntArray,
    cloud: PointCloud,
    found: SurfaceDistance,
    width_mm: float,
) -> _Spots:
    """Spots beyond the reach that more than one exposure shows, of a cloud of several.

    ``face``: (N,) face of each point that is on one or beyond its reach, -1 for others. A spot must
    be about as dense as the part is where it was seen, or strays of a dense scan would make one.
    """
    label, count = _spots(found.closest_mm, face, width_mm)
    inside = label >= 0
    n_near, n_beyond = (
        np.bincount(label[inside & chosen], minlength=count) for chosen in (~is_beyond, is_beyond)
    )
    usual = float(np.median(n_near[n_near > 0])) if n_near.any() else 0.0
    is_dense = n_beyond >= AS_DENSE * np.maximum(n_near, usual)
    of_beyond = np.flatnonzero(is_beyond)
    kept = of_beyond[is_dense[label[of_beyond]]]
    label = np.where(np.isin(np.arange(len(label)), kept), label, -1)
    once = np.zeros(count, dtype=np.bool_)
    if not cloud.is_fused:
        once = _shown_once(label, cloud, found.signed_mm, np.zeros(count))
    unknown = np.full(count, math.nan)
    spots = _spot_results(label, face, found.signed_mm, found.closest_mm, unknown, is_once=once)
    return spots.select(~spots.is_once)


class _Spots(RowRecord):
    """Spots with enough points: face, median deviation, U, where, and if seen by one exposure."""

    face: IntArray = ints("N")
    deviation_mm: FloatArray = floats("N")
    u_mm: FloatArray = floats("N", nan=True)
    place_mm: FloatArray = floats("N", 3)
    is_once: BoolArray = bools("N")


def _spots(closest_mm: FloatArray, face: IntArray, width_mm: float) -> tuple[IntArray, int]:
    """(N,) number of the spot of each point, -1 for points of no face, and how many there are.

    A spot is what one face has in a cube of the width.
    """
    inside = np.flatnonzero(face >= 0)
    if len(inside) == 0:
        return np.full(len(face), -1, dtype=np.int64), 0
    cells = np.floor(closest_mm[inside] / width_mm).astype(np.int64)
    cells -= cells.min(axis=0)
    size = cells.max(axis=0) + 1
    key = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    key = key * (int(face.max()) + 1) + face[inside]
    label = np.full(len(face), -1, dtype=np.int64)
    used, number = np.unique(key, return_inverse=True)
    label[inside] = number
    return label, len(used)


def _rows_by(label: IntArray, count: int) -> list[IntArray]:
    """Rows of each label, 0 to count - 1; rows of label -1 are in none."""
    order = np.argsort(label, kind="stable")
    ends = np.searchsorted(label[order], np.arange(count + 1))
    return [order[ends[k] : ends[k + 1]] for k in range(count)]


def _shown_once(
    label: IntArray, cloud: PointCloud, d: FloatArray, least_mm: FloatArray
) -> BoolArray:
    """(L,) labels that no two exposures of a cloud of several show to deviate.

    An exposure shows it if the mean of what it saw there deviates by more than ``least_mm`` (L,).
    Of a fused cloud, whose exposures are forgotten, these are all labels.
    """
    count, exposure = len(least_mm), cloud.exposure
    if cloud.is_fused:
        return np.ones(count, bool)
    if len(exposure) == 0 or exposure.min() == exposure.max():
        return np.zeros(count, bool)
    inside = label >= 0
    n_all = int(exposure.max()) + 1
    pairs, index = np.unique(label[inside] * n_all + exposure[inside], return_inverse=True)
    mean = np.bincount(index, d[inside]) / np.bincount(index)
    of = pairs // n_all
    shows = np.abs(mean) > least_mm[of]
    return np.asarray(np.bincount(of[shows], minlength=count) < 2)


def _spot_results(
    spot: IntArray,
    face: IntArray,
    d: FloatArray,
    closest_mm: FloatArray,
    u: FloatArray,
    *,
    is_once: BoolArray,
) -> _Spots:
    """Spots with enough points; the median, so that a stray point makes no dent."""
    count = np.bincount(spot[spot >= 0], minlength=len(u))
    order = np.lexsort((d, spot))[int((spot < 0).sum()) :]
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    enough = np.flatnonzero(count >= LEAST_SPOT_POINTS)
    low = order[start[enough] + (count[enough] - 1) // 2]
    high = order[start[enough] + count[enough] // 2]
    return _Spots(
        face=face[low],
        deviation_mm=(d[low] + d[high]) / 2.0,
        u_mm=u[enough],
        place_mm=closest_mm[low],
        is_once=is_once[enough],
    )


def _uncertainties(
    cloud: PointCloud,
    alignment: Alignment,
    normals: FloatArray,
    jacobian: FloatArray,
    groups: tuple[tuple[IntArray, int], ...],
) -> list[FloatArray]:
    """U of each point's deviation, and of the mean deviation of each group of points.

    A point's is of its own covariance and the alignment's, as if these were independent: the
    alignment takes part of what the points have in common away, so that it is rather too large.
    """
    pose = alignment.cad_from_part
    covariance = pose.rotate_covariance(cloud.covariance_mm2)
    own = np.einsum("ni,nij,nj->n", normals, covariance, normals)
    by_pose = np.einsum("nk,kl,nl->n", jacobian, alignment.step_covariance, jacobian)
    found = [COVERAGE * np.sqrt(np.maximum(own + by_pose, 0.0))]
    influence = np.zeros((6, len(cloud)))
    influence[:, alignment.rows] = alignment.influence
    along = normals.copy()
    along[alignment.rows] = alignment.normals
    errors = PointErrors.of(cloud, pose, along)
    # an alignment that does not rest on points one by one errs apart from them
    apart = alignment.step_covariance if len(alignment.rows) == 0 else np.zeros((6, 6))
    for label, count in groups:
        inside = label >= 0
        n = np.maximum(np.bincount(label[inside], minlength=count), 1)
        mean = np.stack(
            [np.bincount(label[inside], jacobian[inside, k], count) / n for k in range(6)], axis=1
        )
        variance = errors.group_variances(label, count, mean, influence)
        variance = variance + np.einsum("fk,kl,fl->f", mean, apart, mean)
        found.append(COVERAGE * np.sqrt(variance))
    return found


def _decisions(d: FloatArray, limit: FloatArray, u: FloatArray) -> IntArray:
    """(N,) numbers in `DECISIONS` by `RULE`; -1 without a limit."""
    size = np.abs(d)
    decided = np.where(size > limit + u, 2, np.where(size <= limit - u, 0, 1))
    return np.where(np.isfinite(limit), decided, -1).astype(np.int64)


def _deciding(spots: _Spots, local: IntArray) -> int:
    """Row of the spot that decides a face, -1 without spots; ``local`` are the spots' decisions.

    Of the spots of the worst decision it is the one that deviates most. A spot that fails, but was
    shown by no two exposures, comes after those that were.
    """
    if not len(spots):
        return -1
    is_excused = spots.is_once & (local == FAIL)
    return int(np.lexsort((np.abs(spots.deviation_mm), ~is_excused, local))[-1])


def _face(
    name: str,
    limit: float,
    d: FloatArray,
    u_mean: float,
    found: tuple[_Spots, _Spots],
    *,
    is_once: bool,
) -> FaceComparison:
    """``found``: the spots within the reach, and those beyond it."""
    spots, beyond = found
    statistics = deviation_statistics(d)
    local = _decisions(spots.deviation_mm, np.full(len(spots), limit), spots.u_mm)
    shown = _deciding(spots, local)
    decision: Decision | Literal["", "not seen"] = ""
    is_excused = False
    if shown < 0:
        decision = "not seen"
    elif math.isfinite(limit):
        whole = DECISIONS.index(OF_VALIDITY[judge(statistics.mean_mm, limit, u_mean)])
        fails = np.array([whole, *local]) == FAIL
        once = np.array([is_once, *spots.is_once])
        is_excused = bool(fails.any() and once[fails].all())
        decided = max(whole, int(local.max(initial=0)))
        decision = DECISIONS[decided - is_excused]
    if len(beyond) and math.isfinite(limit) and decision != "fail":
        decision = "undecided"
    farthest = int(np.argmax(np.abs(beyond.deviation_mm))) if len(beyond) else -1
    return FaceComparison(
        name=name,
        statistics=statistics,
        u_mean_mm=u_mean if statistics.n else math.nan,
        spot_mm=float(spots.deviation_mm[shown]) if shown >= 0 else math.nan,
        u_spot_mm=float(spots.u_mm[shown]) if shown >= 0 else math.nan,
        spot_place_mm=spots.place_mm[shown] if shown >= 0 else np.full(3, math.nan),
        tolerance_mm=limit,
        decision=decision,
        is_seen_once=is_excused,
        beyond_mm=float(beyond.deviation_mm[farthest]) if len(beyond) else math.nan,
        beyond_place_mm=beyond.place_mm[farthest] if len(beyond) else np.full(3, math.nan),
    )
