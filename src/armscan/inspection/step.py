# SPDX-License-Identifier: Apache-2.0
"""Height of a step: parallel faces found in the cloud, and their distance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from armscan.errors import InputError
from armscan.geometry.arrays import BoolArray, Box, FloatArray, IntArray
from armscan.geometry.estimate import FitFailure
from armscan.geometry.shapes import fit_plane
from armscan.inspection.results import (
    MeasuredLength,
    PointCounts,
    StepInspection,
    describe_deviations,
)
from armscan.inspection.search import scatter_about_mm
from armscan.inspection.selection import (
    MIN_POINTS,
    OUTLIER_RULE,
    SEARCH_BAND_MM,
    InspectionOptions,
    Selection,
    StepOptions,
    dominant_flat,
    inliers,
    select,
)
from armscan.inspection.uncertainty import FitLinearised, measured_length
from armscan.records.cloud import PointCloud

LEVEL_BANDS = 8.0
"""Heights over the band in which points support a level or a face: at a quarter of the height, a
plane that crosses both faces would hold as many points as either."""
BINS, MAX_BINS = 2.0, 1e6
"""Bins in a band; and in all, however far strays lie."""
MAX_PEAKS = 60
MAX_EXTENT_MM = 1e5
"""Heights about their median among which faces are looked for."""
LEAST_INSIDE = 0.5
LEAST_GATHERED, FEW_GATHERED, MOST_GATHERED = 0.15, 0.3, 0.9
"""What a face's points near to it are more than of points that fill its thickness evenly, as those
of a ball or a ramp do at any level; the same of few points, which may gather by chance; and the
part of them that is always enough."""
BY_CHANCE = 3.0
"""Standard deviations by which evenly spread points may seem to gather."""
HEIGHT_TOLERANCE = 0.05
"""Faces are searched up to this part of the nominal height from it."""
MOST_OFF = 2.0 * HEIGHT_TOLERANCE
"""What faces once fitted may be off: more was no step, but a ball or a ramp."""


@dataclass(frozen=True, slots=True, eq=False)
class ParallelFaces:
    """``normal @ p = lower_mm`` and ``= upper_mm`` in D dimensions; upper > lower."""

    normal: FloatArray
    lower_mm: float
    upper_mm: float


def find_levels(
    points: FloatArray,
    normal: FloatArray,
    height_mm: float,
    tolerance_mm: float,
) -> ParallelFaces | FitFailure:
    """The two best filled levels along a normal that stand a nominal height apart.

    Parameters
    ----------
    points
        (N, D) points.
    normal
        (D,) common normal.
    height_mm, tolerance_mm
        Nominal height, and how far from it the levels may be.
    """
    levels, counts = _levels(points @ normal, _band_mm(height_mm))
    apart = levels[None, :] - levels[:, None]
    fits = np.abs(apart - height_mm) <= tolerance_mm
    if not fits.any():
        return FitFailure(
            f"there are no two parallel faces {height_mm:g} mm apart, to {tolerance_mm:.2g} mm; "
            + _found(levels, counts),
            "check the height, or show where the step is with --region",
        )
    votes = np.where(fits, np.minimum(counts[None, :], counts[:, None]), -1)
    lower, upper = (int(k) for k in np.unravel_index(int(votes.argmax()), votes.shape))
    return ParallelFaces(normal, float(levels[lower]), float(levels[upper]))


def _band_mm(height_mm: float) -> float:
    """How near to a level points support it."""
    return min(SEARCH_BAND_MM, height_mm / LEVEL_BANDS)


def _levels(heights: FloatArray, band_mm: float) -> tuple[FloatArray, IntArray]:
    """Local maxima of the heights' density, best filled first, and the points about each."""
    # a stray far away would make too many bins
    middle = np.partition(heights, len(heights) // 2)[len(heights) // 2]
    heights = heights[np.abs(heights - middle) <= MAX_EXTENT_MM / 2.0]
    low = float(heights.min())
    bin_mm = max(band_mm / BINS, (float(heights.max()) - low) / MAX_BINS)
    bins = np.bincount(((heights - low) / bin_mm).astype(np.int64))
    width = max(1, round(band_mm / bin_mm))
    filled = np.convolve(bins, np.ones(2 * width + 1), "same").astype(np.int64)
    levels, counts = [], []
    for _ in range(MAX_PEAKS):
        top = int(filled.argmax())
        if filled[top] < MIN_POINTS:
            break
        about = low + (top + 0.5) * bin_mm
        near = heights[np.abs(heights - about) <= band_mm + bin_mm]
        levels.append(float(np.median(near)))
        counts.append(len(near))
        filled[max(0, top - 2 * width - 1) : top + 2 * width + 2] = 0
    return np.array(levels), np.array(counts, dtype=np.int64)


def _found(levels: FloatArray, counts: IntArray) -> str:
    if len(levels) < 2:
        return "only one face was found" if len(levels) else "no face was found"
    apart = abs(float(levels[0] - levels[1]))
    return f"the two largest ({counts[0]} and {counts[1]} points) stand {apart:.3f} mm apart"


def fit_parallel(lower: FloatArray, upper: FloatArray, towards: FloatArray) -> ParallelFaces:
    """Two parallel planes (D = 3) or lines (D = 2) by least squares, fitted together.

    Parameters
    ----------
    lower, upper
        (N, D) and (M, D) points of either face.
    towards
        (D,) direction to which the normal shall point.
    """
    low, high = lower.mean(axis=0), upper.mean(axis=0)
    spread = np.concatenate([lower - low, upper - high])
    # the smallest eigenvector of a D x D matrix: an SVD of 100,000 rows would cost 100 times more
    normal = np.linalg.eigh(spread.T @ spread)[1][:, 0]
    if float(normal @ towards) < 0.0:
        normal = -normal
    return ParallelFaces(normal, float(normal @ low), float(normal @ high))


def away_from_ends(
    points: FloatArray,
    normal: FloatArray,
    is_face: BoolArray,
    stripe: IntArray | None,
    margin_mm: float,
) -> BoolArray:
    """Points of a face that are not within a margin of its ends.

    Parameters
    ----------
    points
        (N, D) all points that are looked at.
    normal
        (D,) of the face.
    is_face
        (N,) True for points of the face.
    stripe
        (N,) number of the stripe that each point is of, None for points without stripes.
    margin_mm
        Left out: points this near, seen along the normal, to a point off the face; of each run
        of a stripe on the face (points with no gap wider than the margin, nor than a few of their
        spacings) this much at either end; and in a cloud this much along the face's outline, where
        a stripe that lies along an edge is half on the face only. A face of few stripes, more than
        half of which would go with its outline, keeps it.
    """
    kept = is_face.copy()
    if margin_mm == 0.0:
        return kept
    across = np.linalg.svd(normal[None, :])[2][1:]
    flat = points @ across.T
    if (~is_face).any():
        # a cloud of another pass above the face lies off it too: it is left out alike
        nearest, _ = cKDTree(flat[~is_face]).query(
            flat[is_face], distance_upper_bound=margin_mm, workers=1
        )
        kept[is_face] &= ~np.isfinite(nearest)
    if stripe is not None:
        kept[is_face] &= _inner(flat[is_face], stripe[is_face], margin_mm)
    if flat.shape[1] == 2:
        kept[is_face] &= _off_outline(flat[is_face], margin_mm)
    return kept


def _off_outline(flat: FloatArray, margin_mm: float) -> BoolArray:
    """(N,) points (N, 2) that are further than a margin inside the outline of them all."""
    try:
        sides = ConvexHull(flat).equations
    except (QhullError, ValueError):
        return np.ones(len(flat), dtype=np.bool_)
    is_inside = (flat @ sides[:, :2].T + sides[:, 2]).max(axis=1) <= -margin_mm
    if is_inside.mean() < LEAST_INSIDE:
        return np.ones(len(flat), dtype=np.bool_)
    return np.asarray(is_inside)


WIDEST_GAP = 3.0
"""Spacings of a stripe's points beyond which a gap ends a run: one of them may be missing."""


def _inner(flat: FloatArray, stripe: IntArray, margin_mm: float) -> BoolArray:
    number = np.unique(stripe, return_inverse=True)[1]
    along = np.zeros(len(flat))
    order = np.argsort(number, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(number[order])) + 1):
        local = flat[rows] - flat[rows].mean(axis=0)
        direction = np.linalg.eigh(local.T @ local)[1][:, -1]
        along[rows] = local @ direction
    order = np.lexsort((along, number))
    s, k = along[order], number[order]
    step, is_next = np.diff(s), np.diff(k) == 0
    # coarse stripes would else be all ends
    spacing = float(np.median(step[is_next])) if is_next.any() else 0.0
    gap_mm = max(margin_mm, WIDEST_GAP * spacing)
    begins = np.concatenate([[True], (step > gap_mm) | ~is_next])
    run = np.cumsum(begins) - 1
    first = s[begins]
    last = s[np.concatenate([np.flatnonzero(begins)[1:] - 1, [len(s) - 1]])]
    inner = np.zeros(len(flat), dtype=np.bool_)
    inner[order] = (s - first[run] >= margin_mm) & (last[run] - s >= margin_mm)
    return inner


ROUNDS = 6
FLAT_PROFILE_MM = 0.3
"""Points of one stripe that keep this near to a plane are one profile in one light sheet."""
COLUMNS, MOST_STEEP = 30, 4.0
"""A flat cloud is cut into columns; in half of them a profile without its strays rises by less than
so many of their widths, where an area is as high as it is broad."""
STRAYS = 0.1
"""Part of a column's points on either side that may be strays, which fill a light sheet's plane."""


@dataclass(frozen=True, slots=True, eq=False)
class _Section:
    """Coordinates in which the faces are looked for.

    Parameters
    ----------
    axes
        (D, 3) rows: all of space, or the two directions within a light sheet.
    flat_mm
        (N, D) the points in them, about their mean.
    sheet_normal
        (3,) of the light sheet of a single profile; None for a cloud.
    out_mm
        (N,) distance of the points from that sheet's plane; zero for a cloud.
    """

    axes: FloatArray
    flat_mm: FloatArray
    sheet_normal: FloatArray | None
    out_mm: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """What is looked for, and in what."""

    selection: Selection
    section: _Section
    height_mm: float
    margin_mm: float

    @property
    def thickness_mm(self) -> float:
        """Points up to this far from a face belong to it."""
        return min(self.selection.feature_mm, self.height_mm / 4.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Chosen:
    """Fitted faces with their points: (N,) masks over the points that were looked at."""

    faces: ParallelFaces
    is_lower: BoolArray
    is_upper: BoolArray
    is_fitted: BoolArray


def inspect_step(
    cloud: PointCloud,
    height_mm: float,
    *,
    normal: FloatArray | None = None,
    region: Box | None = None,
    options: InspectionOptions | None = None,
    step_options: StepOptions | None = None,
) -> StepInspection | FitFailure:
    """Find two parallel faces a nominal height apart and measure the distance between them.

    Points of many stripes determine the faces' common normal. Points of one light sheet, of a
    single exposure or of several at rest, show two parallel lines; their distance d within the
    sheet is the height only if the sheet stands square on the faces. How far it leans, e, no single
    sheet can tell: the height is ``d cos(e)``, with e from ``normal`` if that is given, else zero.
    By how much that is wrong is not known then, and neither is the height's standard deviation.
    Only e is taken from ``normal``: a direct projection on it would turn an error of 0.1 degrees
    into 0.03 mm.

    Parameters
    ----------
    cloud
        Points in any frame.
    height_mm
        Nominal height.
    normal
        (3,) normal of the faces in the cloud's frame, from the arm's pose and a plate; used for
        points of one light sheet only.
    region
        Only points inside are looked at.
    options, step_options
        What belongs to the faces; the defaults if None.

    Raises
    ------
    InputError
        If there are too few points, the height is not positive, or the normal is zero.
    """
    if not 0.0 < height_mm < 1e4:
        raise InputError(f"a step {height_mm} mm high", remedy="give the height in mm")
    selection = select(cloud, region, options, 2 * MIN_POINTS, size_mm=height_mm)
    section = _section(selection)
    if isinstance(section, FitFailure):
        return section
    start = dominant_flat(section.flat_mm, selection.stripe, _band_mm(height_mm))
    if isinstance(start, FitFailure):
        return start
    if float(start @ section.axes @ _upwards(selection)) < 0.0:
        start = -start
    lean, _ = _lean(section, start @ section.axes, normal)
    # points of a bowed sheet are moved along the faces, on which they lie, into the sheet's plane
    moved = section.flat_mm + math.tan(lean) * section.out_mm[:, None] * start
    section = replace(section, flat_mm=moved)
    # faces stand further apart within a sheet that leans
    within = height_mm / math.cos(lean)
    faces = find_levels(section.flat_mm, start, within, HEIGHT_TOLERANCE * within)
    if isinstance(faces, FitFailure):
        return _explained(faces, section, normal)
    margin = (step_options or StepOptions()).margin_mm
    search = _Search(selection, section, height_mm, margin)
    chosen = _fitted(search, faces)
    if isinstance(chosen, FitFailure):
        return chosen
    apart = chosen.faces.upper_mm - chosen.faces.lower_mm
    if abs(apart - within) > MOST_OFF * within:
        return FitFailure(
            f"there are no two parallel faces {height_mm:g} mm apart: fitted to what lies about "
            f"the best place for them, they stand {apart:.4g} mm apart",
            "check the height, or show where the step is with --region",
        )
    lean, rule = _lean(section, chosen.faces.normal @ section.axes, normal)
    is_assumed = section.sheet_normal is not None and normal is None
    return _measured(search, chosen, lean, rule, is_lean_assumed=is_assumed)


def _explained(failure: FitFailure, section: _Section, normal: FloatArray | None) -> FitFailure:
    if section.sheet_normal is None or normal is not None:
        return failure
    return FitFailure(
        f"{failure.reason}. These are distances within one light sheet; in a sheet "
        "that leans they are larger than the height",
        "check the height, or give the faces' --normal if the sheet leans",
    )


def _section(selection: Selection) -> _Section | FitFailure:
    cloud, rows, points = selection.cloud, selection.rows, selection.points_mm
    middle = points.mean(axis=0)
    whole = _Section(np.eye(3), points - middle, None, np.zeros(len(points)))
    # foreign points may be of one profile, whatever number they bear
    is_foreign = selection.stripe is None
    stripe = cloud.exposure[rows] if selection.stripe is None else selection.stripe
    if int(np.ptp(stripe)) > 0:
        return whole
    fit = fit_plane(points)
    if isinstance(fit, FitFailure):
        return FitFailure("all points lie on one line: there is no step", fit.remedy)
    if float(np.abs(fit.residuals).max()) > FLAT_PROFILE_MM:
        return whole
    axes = fit.value.axes
    within = (points - middle) @ axes[:2].T
    if is_foreign and _covers_an_area(within):
        return whole
    return _Section(axes[:2], within, axes[2], fit.residuals)


def _covers_an_area(within: FloatArray) -> bool:
    """Whether points (N, 2) of a flat cloud, long axis first, are of a low step, not a profile."""
    width = float(np.ptp(within[:, 0])) / COLUMNS
    if not width > 0.0:
        return False
    column = ((within[:, 0] - within[:, 0].min()) / width).astype(np.int64)
    order = np.lexsort((within[:, 1], column))
    starts = np.flatnonzero(np.diff(column[order], prepend=-1))
    n_strays = (STRAYS * np.diff(starts, append=len(order))).astype(np.int64)
    ends = np.append(starts[1:], len(order)) - 1
    across = within[order, 1]
    high = across[ends - n_strays] - across[starts + n_strays]
    return bool(np.median(high) > MOST_STEEP * width)


def _stripes(search: _Search) -> IntArray | None:
    """Number of each point's stripe; None for a cloud that knows none."""
    cloud, rows = search.selection.cloud, search.selection.rows
    if search.section.sheet_normal is None and len(np.unique(cloud.exposure[rows])) == 1:
        return None
    return np.asarray(cloud.exposure[rows] * len(cloud.sheet_names) + cloud.sheet[rows])


def _upwards(selection: Selection) -> FloatArray:
    """Direction in which the upper face is called upper: to the side that was scanned."""
    cloud, rows = selection.cloud, selection.rows
    # normals are zero where none could be estimated, as on a single stripe
    if cloud.normals is not None and cloud.normals[rows].any():
        return np.asarray(cloud.normals[rows].mean(axis=0))
    if cloud.frame == "Sensor":
        return np.asarray(-cloud.points_mm[rows].mean(axis=0))
    return np.array([0.0, 0.0, 1.0])


def _fitted(search: _Search, faces: ParallelFaces) -> _Chosen | FitFailure:
    """Choose the faces' points and fit, in turn."""
    flat, stripe, margin = search.section.flat_mm, _stripes(search), search.margin_mm
    used = np.zeros(len(flat), dtype=np.bool_)
    masks: list[BoolArray] = []
    near: list[BoolArray] = []
    for _ in range(ROUNDS):
        masks, kept, near = [], [], []
        for level in (faces.lower_mm, faces.upper_mm):
            distance = flat @ faces.normal - level
            is_face = np.abs(distance) <= search.thickness_mm
            mask = away_from_ends(flat, faces.normal, is_face, stripe, margin)
            if int(mask.sum()) < MIN_POINTS:
                failure = _no_face(search, distance, is_face)
                if failure is not None:
                    return failure
                return FitFailure(
                    f"a face of the step keeps {int(mask.sum())} of {int(is_face.sum())} points "
                    f"after {margin:g} mm at its ends are left out; {MIN_POINTS} are "
                    "needed",
                    "measure more of the face"
                    if int(is_face.sum()) < MIN_POINTS
                    else "give a smaller --margin, or measure more of the face",
                )
            fitted = mask.copy()
            fitted[mask] = inliers(distance[mask])
            masks.append(mask)
            near.append(is_face)
            kept.append(fitted)
        faces = fit_parallel(flat[kept[0]], flat[kept[1]], faces.normal)
        if np.array_equal(used, kept[0] | kept[1]):
            break
        used = kept[0] | kept[1]
    # the margin cuts a strip of a ramp down to points that lie near to its middle
    for k, mask in ((k, mask) for of in (near, masks) for k, mask in enumerate(of)):
        level = faces.upper_mm if k else faces.lower_mm
        failure = _no_face(search, flat @ faces.normal - level, mask)
        if failure is not None:
            return failure
    return _Chosen(faces, masks[0], masks[1], used)


def _no_face(search: _Search, distance: FloatArray, is_face: BoolArray) -> FitFailure | None:
    """Why points (N,) that lie about a level are of no face there; None if they are of one."""
    thickness_mm = search.thickness_mm
    bands_mm = np.minimum(search.selection.search_band_mm[is_face], thickness_mm / 2.0)
    band_mm = float(np.median(bands_mm))
    n_near, n = int((np.abs(distance[is_face]) <= bands_mm).sum()), int(is_face.sum())
    even = band_mm / thickness_mm
    by_chance = BY_CHANCE * math.sqrt(even * (1.0 - even) / max(n, 1))
    more = min(max(LEAST_GATHERED, by_chance), FEW_GATHERED)
    if n_near >= min(even + more, MOST_GATHERED) * n:
        return None
    return FitFailure(
        f"there are no two parallel faces {search.height_mm:g} mm apart: at the best place for "
        f"one, only {n_near} of {n} points within {thickness_mm:.3g} mm lie within {band_mm:.2g} "
        "mm of it",
        "check the height, or show where the step is with --region",
    )


def _lean(section: _Section, upwards: FloatArray, normal: FloatArray | None) -> tuple[float, str]:
    """Angle in rad of the faces' normal out of the light sheet, and where it came from."""
    if section.sheet_normal is None:
        return 0.0, "the faces' common normal, fitted to their points"
    if normal is None:
        return 0.0, (
            "one stripe: the light sheet is taken to stand square on the faces. If it leans by "
            "an angle e, the true height is the one given here times cos(e): 0.015 % less at "
            "1 degree"
        )
    size = float(np.linalg.norm(normal))
    if not size > 0.0:
        raise InputError("the normal of the step's faces is zero")
    sign = 1.0 if float(normal @ upwards) >= 0.0 else -1.0
    sine = sign * float(normal @ section.sheet_normal) / size
    lean = math.asin(max(-1.0, min(1.0, sine)))
    return lean, (
        f"one stripe: the light sheet leans by {math.degrees(abs(lean)):.3f} degrees against "
        "the given normal of the faces, which the height allows for"
    )


def _measured(
    search: _Search, chosen: _Chosen, lean: float, rule: str, *, is_lean_assumed: bool
) -> StepInspection:
    section, nominal = search.section, search.height_mm
    full = math.cos(lean) * (chosen.faces.normal @ section.axes)
    if section.sheet_normal is not None:
        full = full + math.sin(lean) * section.sheet_normal
    along = section.flat_mm @ chosen.faces.normal * math.cos(lean)
    low = float(along[chosen.is_lower & chosen.is_fitted].mean())
    height = float(along[chosen.is_upper & chosen.is_fitted].mean()) - low
    heights = along[chosen.is_upper] - low
    own = np.concatenate([along[chosen.is_lower] - low, heights - height])
    flats = "planes" if section.sheet_normal is None else "lines"
    n_low, n_up = int(chosen.is_lower.sum()), int(chosen.is_upper.sum())
    lower, upper = (search.selection.rows[face] for face in (chosen.is_lower, chosen.is_upper))
    # exposures of one sheet lean alike: what they disagree about would pass for all of the error
    known = (
        MeasuredLength(height, math.nan, math.nan)
        if is_lean_assumed
        else _height(search, chosen, height, full, math.cos(lean))
    )
    # one light sheet holds no neighbourhoods that are faces
    scatter_mm = math.nan
    if section.sheet_normal is None:
        scatter_mm = scatter_about_mm(search.selection, np.concatenate([lower, upper]))
    return StepInspection(
        lower=lower,
        upper=upper,
        normal=full,
        nominal_height_mm=nominal,
        height=known,
        counts=_counts(search, chosen),
        fitted=describe_deviations(
            own,
            "fitted",
            f"the point's own one of the two parallel {flats} fitted together",
            f"all {n_low} points of the lower and {n_up} of the upper face, outliers included",
        ),
        nominal=describe_deviations(
            heights - nominal,
            "nominal",
            f"the nominal height of {nominal:g} mm over the lower of the two fitted parallel "
            f"{flats}",
            f"all {n_up} points of the upper face, outliers included",
        ),
        heights_mm=heights,
        normal_rule=rule,
        scatter_mm=scatter_mm,
        is_lean_assumed=is_lean_assumed,
    )


def _counts(search: _Search, chosen: _Chosen) -> PointCounts:
    return PointCounts(
        n_given=len(search.selection.cloud),
        n_region=len(search.selection.rows),
        n_feature=int(chosen.is_lower.sum() + chosen.is_upper.sum()),
        n_fitted=int(chosen.is_fitted.sum()),
        feature_rule=f"points within {search.thickness_mm:g} mm of either face, without "
        f"{search.margin_mm:g} mm at the ends of each stripe's runs, along the outline and "
        "next to points off the face",
        fit_rule=OUTLIER_RULE,
    )


def _height(
    search: _Search, chosen: _Chosen, height_mm: float, normal: FloatArray, cosine: float
) -> MeasuredLength:
    """Parameters: turns of the normal, then both faces' distances from the origin."""
    used, faces = chosen.is_fitted, chosen.faces
    flat = search.section.flat_mm[used]
    is_upper = chosen.is_upper[used]
    across = np.linalg.svd(faces.normal[None, :])[2][1:]
    turns = (flat - flat.mean(axis=0)) @ across.T
    jacobian = np.column_stack([turns, -1.0 * ~is_upper, -1.0 * is_upper])
    by_parameters = np.zeros(jacobian.shape[1])
    by_parameters[-2:] = -cosine, cosine
    residuals = flat @ faces.normal - np.where(is_upper, faces.upper_mm, faces.lower_mm)
    directions = np.tile(normal, (len(flat), 1))
    fit = FitLinearised(jacobian, directions, residuals)
    rows = search.selection.rows[used]
    return measured_length(height_mm, by_parameters, fit, search.selection.cloud, rows)
