# SPDX-License-Identifier: Apache-2.0
"""Points taken out of a cloud by filters, each of which says how many it took."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial import cKDTree

from armscan.errors import InputError, OptionError
from armscan.geometry.arrays import ArrayRecord, BoolArray, Box, FloatArray, IntArray, ints
from armscan.records.cloud import PointCloud

FEWEST_NEIGHBOURS = 6
"""A point with fewer others within the radius stands alone."""
LINE_REACH = 5
"""Points on either side of one to which the line is drawn that it should lie on."""
LEAST_LINE = 4
"""Fewest of them that make a line."""
MUCH, THINNING = 0.5, ("region", "lines too near", "overlap", "density")
"""A filter that takes more than half of the points is told of, but for those that thin."""
PASS_GAP = 6
"""Exposures in one place whose numbers are further apart are of different passes."""
LINE_SAMPLE = 60
"""Points of a stripe whose distance from the stripe before is looked at."""
DEFAULT_HOLE_MM = 1.0
"""Gap that ends a piece of a stripe where nobody said: some spacings of any scanner's points."""


@dataclass(frozen=True, slots=True)
class CleaningOptions:
    """Which filters take points out, in the order in which they do; None for off.

    Parameters
    ----------
    max_incidence_deg
        Largest angle between the surface's normal and the direction to the sensor.
    isolated_mm
        Take out points with fewer than `FEWEST_NEIGHBOURS` others within this radius.
    hole_mm
        A gap along a stripe wider than this ends a piece of it; narrower ones do not.
    line_spacing_mm
        Largest distance to the nearer neighbour along the stripe: sparse points are dust.
    edge_mm
        Take out this much at both ends of every piece: half a stripe lies beside an edge there.
    line_to_line_mm
        Least distance between successive stripes of a sheet; stripes nearer to the last one that
        was kept are taken out as a whole.
    overlap_mm
        Where passes overlap within cells of this size, keep the points of the best pass only: that
        of the smallest sigma.
    density_mm
        Keep one point a cell of this size, that nearest to the middle of its points.
    """

    region: Box | None = None
    max_incidence_deg: float | None = None
    isolated_mm: float | None = None
    hole_mm: float | None = None
    line_deviation_mm: float | None = None
    line_spacing_mm: float | None = None
    edge_mm: float | None = None
    line_to_line_mm: float | None = None
    overlap_mm: float | None = None
    density_mm: float | None = None

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            most = 90.0 if item.name == "max_incidence_deg" else 1e4
            if isinstance(value, int | float) and not 0.0 < value < most:
                option = item.name.removesuffix("_mm").removesuffix("_deg").replace("_", "-")
                raise OptionError(
                    f"{value:g} is not between 0 and {most:g}",
                    where=f"--{option}",
                    remedy="give a number in between",
                )
        on = [item.name for item in fields(self) if getattr(self, item.name) is not None]
        if not set(on) - {"hole_mm"}:
            raise OptionError(
                "no filter is given, so nothing would be taken out",
                remedy="give --max-incidence, --isolated, --line-deviation, --edge or another",
            )
        pieces = {"line_deviation_mm", "line_spacing_mm", "edge_mm"}
        if self.hole_mm is not None and not pieces & set(on):
            raise OptionError(
                "a hole size takes nothing out by itself",
                where="--hole",
                remedy="give --line-deviation, --line-spacing or --edge with it",
            )


@dataclass(frozen=True, slots=True)
class CleaningStep:
    """What one filter did: its name, the points it took, and its rule in words."""

    name: str
    n_taken: int
    rule: str


class Cleaning(ArrayRecord):
    """A cleaned cloud.

    Parameters
    ----------
    cloud
        What is left; points keep their covariances, but share their noise with fewer neighbours
        where some of these were taken.
    taken_by
        (N,) of each point of the cloud that was given, the index of the step that took it; -1 for
        those that are left.
    steps
        The filters in the order in which they worked.
    """

    cloud: PointCloud
    taken_by: IntArray = ints("N")
    steps: tuple[CleaningStep, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Filters that took more than a cleaning should, in words."""
        left, found = len(self.taken_by), []
        for step in self.steps:
            if step.n_taken > MUCH * left and step.name not in THINNING:
                found.append(
                    f"the filter '{step.name}' took {100.0 * step.n_taken / left:.0f} % of the "
                    "points before it: check its number, and that points stand in the file in "
                    "their order along each stripe"
                )
            left -= step.n_taken
        return tuple(found)


def clean_cloud(cloud: PointCloud, options: CleaningOptions) -> Cleaning:
    """Take points out of a cloud, each filter of what those before it left.

    Raises
    ------
    InputError
        If a filter needs what the cloud does not carry, or no point is there or left.
    """
    if len(cloud) == 0:
        raise InputError("the cloud holds no point", remedy="give a cloud that was measured")
    taken_by = np.full(len(cloud), -1, dtype=np.int64)
    steps: list[CleaningStep] = []
    for name, (label, rule, is_taken) in FILTERS.items():
        value = getattr(options, name)
        if value is None:
            continue
        left = np.flatnonzero(taken_by < 0)
        out = is_taken(cloud.select(left), value, options)
        taken_by[left[out]] = len(steps)
        steps.append(CleaningStep(label, int(out.sum()), rule.format(value)))
        if out.all():
            raise InputError(
                f"after the filter '{label}' no point is left of {len(left)}",
                remedy="give it a number that lets more pass",
            )
    kept = taken_by < 0
    left_over = cloud.select(kept)
    if cloud.noise_length is not None and not cloud.is_fused:
        left_over = replace(left_over, noise_length=_length_left(cloud, kept)[kept])
    return Cleaning(cloud=left_over, taken_by=taken_by, steps=tuple(steps))


def _length_left(cloud: PointCloud, kept: BoolArray) -> FloatArray:
    """(N,) neighbours along the stripe that share a point's noise, as many as are kept.

    A point shares the noise of L neighbours, itself among them: of those as far along the stripe
    as L reaches, the part that is left.
    """
    length = np.ones(len(cloud)) if cloud.noise_length is None else cloud.noise_length
    stripe = cloud.exposure * len(cloud.sheet_names) + cloud.sheet
    order = np.argsort(stripe, kind="stable")
    at, ordered = np.arange(len(order)), stripe[order]
    first = np.searchsorted(ordered, ordered, side="left")
    last = np.searchsorted(ordered, ordered, side="right") - 1
    reach = np.maximum(np.rint((length[order] - 1.0) / 2.0).astype(np.int64), 1)
    low, high = np.maximum(at - reach, first), np.minimum(at + reach, last)
    sums = np.concatenate([[0], np.cumsum(kept[order])])
    others = sums[high + 1] - sums[low] - kept[order]
    share = others / np.maximum(high - low, 1)
    found = np.ones(len(order))
    found[order] = 1.0 + (length[order] - 1.0) * share
    return found


def _outside(cloud: PointCloud, region: Box, options: CleaningOptions) -> BoolArray:
    return ~region.holds(cloud.points_mm)


def _grazing(cloud: PointCloud, most_deg: float, options: CleaningOptions) -> BoolArray:
    """(N,) points seen at a larger angle; those without a normal are left."""
    if cloud.normals is None:
        raise InputError(
            "the cloud has no normals, so no angle of incidence is known",
            remedy="reconstruct the scan with normals, or leave out --max-incidence",
        )
    if cloud.seen_from_mm is not None:
        towards = cloud.seen_from_mm[cloud.exposure] - cloud.points_mm
    elif cloud.frame == "Sensor":
        towards = -cloud.points_mm
    else:
        raise InputError(
            "the cloud does not say where the sensor stood",
            remedy="reconstruct the scan again, or leave out --max-incidence",
        )
    length = np.linalg.norm(towards, axis=1)
    cosine = np.einsum("ni,ni->n", cloud.normals, towards) / np.maximum(length, 1e-12)
    has_normal = cloud.normals.any(axis=1)
    return np.asarray(has_normal & (cosine < math.cos(math.radians(most_deg))))


def _isolated(cloud: PointCloud, radius_mm: float, options: CleaningOptions) -> BoolArray:
    if len(cloud) <= FEWEST_NEIGHBOURS:
        return np.ones(len(cloud), dtype=np.bool_)
    # the point itself is the nearest of all
    nearest = cKDTree(cloud.points_mm).query(
        cloud.points_mm, [FEWEST_NEIGHBOURS + 1], distance_upper_bound=radius_mm
    )
    return np.asarray(~np.isfinite(nearest[0])).ravel()


@dataclass(frozen=True, slots=True, eq=False)
class _Stripes:
    """Points in their order along stripes.

    ``order``: (N,) rows of the cloud; ``piece``: (N,) number of the piece of each in that order;
    ``gap_mm``: (N,) distance from the point before on the stripe, infinite at its start.
    """

    order: IntArray
    piece: IntArray
    gap_mm: FloatArray

    def mask(self, in_order: BoolArray) -> BoolArray:
        """(N,) in the cloud's order."""
        found = np.zeros(len(self.order), dtype=np.bool_)
        found[self.order] = in_order
        return found


def _stripes(cloud: PointCloud, hole_mm: float | None) -> _Stripes:
    _refuse_without_stripes(cloud)
    stripe = cloud.exposure * len(cloud.sheet_names) + cloud.sheet
    order = np.argsort(stripe, kind="stable")
    step = np.linalg.norm(np.diff(cloud.points_mm[order], axis=0), axis=1)
    gap = np.concatenate([[np.inf], np.where(np.diff(stripe[order]) != 0, np.inf, step)])
    is_new = gap > (DEFAULT_HOLE_MM if hole_mm is None else hole_mm)
    piece = np.cumsum(is_new.astype(np.int64))
    return _Stripes(order, piece, gap)


def _refuse_without_stripes(cloud: PointCloud) -> None:
    if cloud.is_fused:
        raise InputError(
            "the cloud is a fused one, whose points are of no stripe any more",
            remedy="clean the clouds before they are fused, or leave out the filters of lines",
        )
    if len(cloud.exposure_sources) < 2 and not cloud.covariance_mm2.any():
        raise InputError(
            "the cloud does not say which points are of one stripe",
            remedy="use a cloud of `armscan reconstruct`, or leave out the filters of lines",
        )


def _sparse(cloud: PointCloud, most_mm: float, options: CleaningOptions) -> BoolArray:
    stripes = _stripes(cloud, options.hole_mm)
    behind = np.concatenate([stripes.gap_mm[1:], [np.inf]])
    return stripes.mask(np.minimum(stripes.gap_mm, behind) > most_mm)


def _off_line(cloud: PointCloud, most_mm: float, options: CleaningOptions) -> BoolArray:
    """(N,) points off the straight line through the neighbours of their piece, themselves left out.

    The line is that between the middles of the neighbours before and behind: it follows a curve.
    """
    stripes = _stripes(cloud, options.hole_mm)
    points, n = cloud.points_mm[stripes.order], len(cloud)
    middles, counts = [], []
    for side in (-1, 1):
        total, count = np.zeros((n, 3)), np.zeros(n)
        for step in range(1, LINE_REACH + 1):
            at = np.arange(n) + side * step
            is_there = (at >= 0) & (at < n)
            at = np.clip(at, 0, n - 1)
            is_there &= stripes.piece[at] == stripes.piece
            total[is_there] += points[at[is_there]]
            count += is_there
        middles.append(total / np.maximum(count, 1)[:, None])
        counts.append(count)
    along = middles[1] - middles[0]
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-12)
    offset = points - middles[0]
    share = np.clip(np.einsum("ni,ni->n", offset, along) / length**2, 0.0, 1.0)
    off = np.linalg.norm(offset - share[:, None] * along, axis=1)
    has_line = (counts[0] + counts[1] >= LEAST_LINE) & (counts[0] > 0) & (counts[1] > 0)
    return stripes.mask(has_line & (off > most_mm))


def _at_edge(cloud: PointCloud, margin_mm: float, options: CleaningOptions) -> BoolArray:
    stripes = _stripes(cloud, options.hole_mm)
    begins = np.concatenate([[True], np.diff(stripes.piece) != 0])
    run = np.cumsum(np.where(begins, 0.0, stripes.gap_mm))
    first = np.flatnonzero(begins)
    number = np.cumsum(begins) - 1
    from_start = run - run[first][number]
    last = np.concatenate([first[1:] - 1, [len(run) - 1]])
    to_end = run[last][number] - run
    return stripes.mask(np.minimum(from_start, to_end) < margin_mm)


def _dense_stripe(cloud: PointCloud, least_mm: float, options: CleaningOptions) -> BoolArray:
    _refuse_without_stripes(cloud)
    out = np.zeros(len(cloud), dtype=np.bool_)
    for sheet in np.unique(cloud.sheet):
        rows = np.flatnonzero(cloud.sheet == sheet)
        rows = rows[np.argsort(cloud.exposure[rows], kind="stable")]
        cuts = np.flatnonzero(np.diff(cloud.exposure[rows])) + 1
        kept: cKDTree | None = None
        for stripe in np.split(rows, cuts):
            points = cloud.points_mm[stripe]
            sample = points[:: max(1, len(points) // LINE_SAMPLE)]
            if kept is not None and float(np.median(kept.query(sample)[0])) < least_mm:
                out[stripe] = True
            else:
                kept = cKDTree(points)
    return out


def _overlapped(cloud: PointCloud, cell_mm: float, options: CleaningOptions) -> BoolArray:
    """(N,) points of all passes through a cell but that of the smallest sigma, then of most points.

    A pass in a cell is a run of exposures with numbers near to each other.
    """
    _refuse_without_stripes(cloud)
    cell = _cells(cloud.points_mm, cell_mm)
    order = np.lexsort((cloud.exposure, cell))
    is_new_cell = np.concatenate([[True], np.diff(cell[order]) != 0])
    is_new_pass = is_new_cell | np.concatenate([[True], np.diff(cloud.exposure[order]) > PASS_GAP])
    part, of_cell = np.cumsum(is_new_pass) - 1, np.cumsum(is_new_cell) - 1
    count = np.bincount(part)
    sigma = np.bincount(part, cloud.sigma_mm[order]) / count
    cell_of = of_cell[is_new_pass]
    ranked = np.lexsort((-count, sigma, cell_of))
    best = ranked[np.concatenate([[True], np.diff(cell_of[ranked]) != 0])]
    is_best = np.zeros(len(count), dtype=np.bool_)
    is_best[best] = True
    out = np.zeros(len(cloud), dtype=np.bool_)
    out[order] = ~is_best[part]
    return out


def _thinned(cloud: PointCloud, cell_mm: float, options: CleaningOptions) -> BoolArray:
    cell = _cells(cloud.points_mm, cell_mm)
    count = np.bincount(cell)
    middle = np.stack([np.bincount(cell, cloud.points_mm[:, k]) / count for k in range(3)], axis=1)
    far = np.linalg.norm(cloud.points_mm - middle[cell], axis=1)
    order = np.lexsort((far, cell))
    out = np.ones(len(cloud), dtype=np.bool_)
    out[order[np.concatenate([[True], np.diff(cell[order]) != 0])]] = False
    return out


def _cells(points_mm: FloatArray, cell_mm: float) -> IntArray:
    """(N,) number of the cell of each point (N, 3), from 0 without gaps."""
    keys = np.floor((points_mm - points_mm.min(axis=0)) / cell_mm).astype(np.int64)
    widths = keys.max(axis=0) + 1
    if float(np.prod(widths.astype(np.float64))) > 2.0**62:
        raise InputError(
            f"cells of {cell_mm:g} mm are too small for so large a cloud",
            remedy="give larger ones, or a --region",
        )
    flat = (keys[:, 0] * widths[1] + keys[:, 1]) * widths[2] + keys[:, 2]
    return np.unique(flat, return_inverse=True)[1].ravel().astype(np.int64)


FILTERS: dict[str, tuple[str, str, Callable[..., BoolArray]]] = {
    "region": ("region", "outside the box {}", _outside),
    "max_incidence_deg": (
        "grazing incidence",
        "seen at more than {:g} degrees from the normal; points without a normal are left",
        _grazing,
    ),
    "isolated_mm": (
        "isolated points",
        f"fewer than {FEWEST_NEIGHBOURS} others within {{:g}} mm",
        _isolated,
    ),
    "line_spacing_mm": (
        "sparse on the line",
        "further than {:g} mm from both neighbours along the stripe",
        _sparse,
    ),
    "line_deviation_mm": (
        "off the line",
        f"further than {{:g}} mm from the line through up to {LINE_REACH} neighbours either way",
        _off_line,
    ),
    "edge_mm": ("edges", "within {:g} mm of the end of a piece of a stripe", _at_edge),
    "line_to_line_mm": (
        "lines too near",
        "on stripes that lie nearer than {:g} mm (median) to the last stripe that was kept",
        _dense_stripe,
    ),
    "overlap_mm": (
        "overlap",
        "in cells of {:g} mm that a pass of smaller sigma went through too",
        _overlapped,
    ),
    "density_mm": ("density", "not the one nearest to the middle of a cell of {:g} mm", _thinned),
}
"""Option, name, rule in words and work of each filter, in the order in which they work."""
