# SPDX-License-Identifier: Apache-2.0
"""The fast way from an image to stripe centres: each column or row by itself, in few passes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import TypeVar, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray, given_away
from armscan.kernels.stripe.column_runs import (
    BACK,
    CELL_PX,
    POINT_CHAIN,
    POINT_COLUMNS,
    POINT_HIGH,
    POINT_LOW,
    RUN_DIPS,
    RUN_HEIGHT,
    RUN_LENGTH,
    RUN_ROWS,
    SMOOTH_ROWS,
    cut_stretches,
    find_column_runs,
    gather_chains,
    link_columns,
    mean_along,
    measure_runs,
    score_middles,
    slopes_along,
    smooth_stretches,
    sort_by_column,
)
from armscan.kernels.stripe.columns import (
    AMPLITUDE,
    CENTRE,
    FIRST_ROWS,
    HIGH_SIDE,
    LEAN,
    LEAN_NORM,
    SECOND_ROWS,
    SIGMA,
    STEEPEST,
    VARIANCE,
    fit_columns,
    flag_points,
    keep_means,
    keep_smoothed,
    look_across,
    mark_ends,
    mark_near,
    weigh_sides,
    write_points,
)
from armscan.kernels.stripe.section import (
    BACKGROUND_STEP,
    LEAST_SKEW,
    NEIGHBOUR_SIGMAS,
    SIGNIFICANT,
    SKEW_PX,
)
from armscan.records.exposure import Exposure
from armscan.records.profile import REJECTING, Profile, StripeFlag
from armscan.vision.stripe.fit import start_noise
from armscan.vision.stripe.flags import (
    MERGED_SIGMAS,
    close_gaps,
    has_laser_colour,
    is_on_known_ground,
    is_short,
)
from armscan.vision.stripe.image import NORMAL_SCALE, StripeOptions, StripePlane
from armscan.vision.stripe.ridge import (
    FAINTEST_SHARE,
    LONGEST_RUN_PX,
    SHORTEST_PX,
    SIGMA_LIMITS_PX,
    FloatImage,
    ImageLevel,
    is_of_bytes,
    strong_median,
)
from armscan.vision.stripe.smooth import (
    CONFIDENCE,
    OUTLIER_SIGMAS,
    WHITE,
    Polyline,
    inflation_of,
    noise_correlation,
    quadratic_weights,
    windows,
)

MaskImage = NDArray[np.uint8]
FLOAT_MAX = float(np.finfo(np.float32).max)
NO_BYTES = np.zeros((1, 1), np.uint8)
NO_IMAGE = np.zeros((1, 1), np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """The pixels of a plane, as the passes read them.

    ``sought``: (H, W) bytes in which lines are sought, ``sought_unit`` of them to a level of full
    scale 255. ``raw``: (H, W) bytes to be measured, ``unit`` to a level; (1, 1) where ``image``
    holds them. ``image``: (H, W) float32 of full scale 255; (1, 1) where ``raw`` does.
    ``clipped``: (H, W) 1 where the camera saturated, or (1, 1) where the level ``clip`` says so.
    """

    sought: MaskImage
    sought_unit: float
    raw: MaskImage
    unit: float
    image: FloatImage
    clipped: MaskImage
    clip: float

    @classmethod
    def of_bytes(cls, raw: MaskImage, full_scale: int) -> Pixels:
        """A grey exposure of at most eight bits."""
        unit = full_scale / NORMAL_SCALE
        return cls(raw, unit, raw, unit, NO_IMAGE, NO_BYTES, NORMAL_SCALE * (1.0 - 1e-6))

    @classmethod
    def of_plane(cls, plane: StripePlane, brightest: float) -> Pixels:
        """Any other plane; what is sought is stretched to eight bits."""
        unit = BRIGHTEST_SOUGHT / max(brightest, 1.0)
        sought = np.clip(plane.image * np.float32(unit), 0.0, 255.0).astype(np.uint8)
        return cls(sought, unit, NO_BYTES, 1.0, plane.image, plane.clipped, FLOAT_MAX)

    @property
    def transposed(self) -> Pixels:
        """The same with rows and columns exchanged."""
        sought = _turned(self.sought)
        return Pixels(
            sought=sought,
            sought_unit=self.sought_unit,
            raw=sought if self.raw is self.sought else _turned(self.raw),
            unit=self.unit,
            image=_turned(self.image),
            clipped=_turned(self.clipped),
            clip=self.clip,
        )

    def wide_enough(self) -> Pixels:
        """The same with dark columns beyond the border where there are fewer than are read."""
        missing = CELL_PX - self.sought.shape[1]
        if missing <= 0:
            return self
        return Pixels(
            sought=np.pad(self.sought, ((0, 0), (0, missing))),
            sought_unit=self.sought_unit,
            raw=_widened(self.raw, missing),
            unit=self.unit,
            image=_widened(self.image, missing),
            clipped=_widened(self.clipped, missing),
            clip=self.clip,
        )


Plane = TypeVar("Plane", MaskImage, FloatImage)


def _turned(image: Plane) -> Plane:
    """Rows and columns exchanged; of whole blocks, in a fraction of numpy's time."""
    return cast(Plane, np.ascontiguousarray(cv2.transpose(image)))


def _widened(image: Plane, columns: int) -> Plane:
    """As many columns more, alike to the last; what stands for nothing stays."""
    if image.size == 1:
        return image
    return cast(Plane, np.pad(image, ((0, 0), (0, columns)), mode="edge"))


BRIGHTEST_SOUGHT = 254.0
"""Level of bytes for the brightest pixel of a plane: thresholds stay below it."""
MOST_RUNS_A_COLUMN = 16
"""For which there is room at once."""
MEAN_HALF = 8
"""Neighbours over which width, height and background beside the line are averaged."""
MOST_OFF_SIGMAS = 2.0
"""Of a line, by which the first pass may move the middle of a run."""
LEAST_RATIO = 1.3
"""Of a line's height over the threshold, from which its width is told by the length of its runs."""
CLEAR_SIGMAS = 3.0
"""Rows that are free before another line, in sigmas: fewer are lit up by it."""
CLEAR_RATIO = 3.0
"""Of a line's height over the threshold: runs of fainter ones are parted by noise."""
WIDER_SHARE = 1.6
"""Of the lines' typical width: where it is wider, there are two."""
MOST_SLOPE = 1.3
TREND_HALF = 12
"""Neighbours over which it is told whether a line is for the columns or for the rows."""
MERGED_SHARE, MERGED_PX = 1.4, 3.0
"""Runs that are longer than their neighbours by this hold more than one line."""
LEAN_HALF = 4
"""Neighbours over which the shape of the section is averaged."""
OUTLIER_HALF = 5
NORMAL_MEDIAN = 0.6745
"""Median of the size of a normal number of variance 1."""
LEAST_SIGMA_PX = 0.002
"""What pixel locking and the shape of the profile leave without any noise."""
SINGLE_FLAGS = np.array(
    [
        StripeFlag.SATURATED,
        StripeFlag.BACKGROUND_STEP,
        StripeFlag.NEIGHBOUR,
        StripeFlag.ASYMMETRIC,
    ],
    dtype=np.int64,
)
"""Flags of a point by itself, in the order of `flag_points`."""
MOST_MEASURED = 4000
"""Points of which what all have in common is told: width, skew, scatter, correlation."""


@dataclass(frozen=True, slots=True, eq=False)
class ColumnPoints:
    """Centres of lines in the columns of an image, along their chains.

    ``points``: (N, 6) of `gather_chains`. ``table``: (8, N) of `fit_columns`. ``slope``: (N,) rows
    a column. ``trend``: (N,) the same over more neighbours. ``sigma``: (N,) standard deviation of
    the centre down the column. ``noise_length``: (N,) as in `Profile`. ``flags``: (N,) of
    `StripeFlag`.
    """

    points: NDArray[np.int32]
    table: FloatArray
    slope: FloatArray
    trend: FloatArray
    sigma: FloatArray
    noise_length: FloatArray
    flags: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class _Chains:
    """Runs of lit pixels that follow each other from column to column.

    ``points``: (N, 6) of `gather_chains`. ``start``: (C + 1,) where each chain begins.
    ``left_out``: (rows, columns) 1 for cells with runs that are in none of them.
    """

    points: NDArray[np.int32]
    start: IntArray
    left_out: MaskImage

    def mean(self, values: FloatArray, weight: FloatArray, half: int) -> FloatArray:
        """Weighted means (M, N) over the neighbours of a chain; NaN where all weights are 0."""
        mean = np.zeros(values.shape)
        mean_along(values, weight, self.start, half, mean)
        return mean


def find_columns(
    pixels: Pixels, level: ImageLevel, smoothing_px: float
) -> tuple[ColumnPoints | None, MaskImage]:
    """Centres in the columns of an image, and cells (rows, columns) with other lit pixels."""
    height, width = pixels.sought.shape
    pixels = pixels.wide_enough()
    chains = _find_chains(pixels, level)
    points, start = chains.points, chains.start
    if not len(points):
        return None, chains.left_out
    first, dips = _look(pixels, level, chains)
    noise = start_noise(level.noise).astype(np.float32)
    table = np.zeros((SECOND_ROWS, len(points)))
    fit_columns(*_read(pixels), pixels.clipped, pixels.clip, points, first, noise, table)
    # of a column that the border cuts, the run tells no middle
    is_cut = (points[:, POINT_LOW] == 0) | (points[:, POINT_HIGH] == height - 1)
    table[VARIANCE, is_cut] = 0.0
    table[VARIANCE, ~_is_bright(table, start)] = 0.0
    slope, trend = np.zeros(len(points)), np.zeros(len(points))
    slopes_along(table[CENTRE], points, start, MEAN_HALF, slope)
    slopes_along(table[CENTRE], points, start, TREND_HALF, trend)
    near = _is_near_another(chains, table, slope, dips, level.rise)
    flags = _flag(chains, table, first, near)
    mark_ends(table, points, slope, start, height, width, int(StripeFlag.END), flags)
    left_out = chains.left_out | _cells_of(points[np.abs(trend) > STEEPEST, :3], level.lit.shape)
    found = ColumnPoints(
        points=points,
        table=table,
        slope=slope,
        trend=trend,
        sigma=np.sqrt(table[VARIANCE]),
        noise_length=np.ones(len(points)),
        flags=flags,
    )
    return _smooth(chains, found, smoothing_px), left_out


def _read(pixels: Pixels) -> tuple[MaskImage, FloatImage, float]:
    return pixels.raw, pixels.image, pixels.unit


def _find_chains(pixels: Pixels, level: ImageLevel) -> _Chains:
    sought = pixels.sought
    capacity = MOST_RUNS_A_COLUMN * sought.shape[1]
    while True:
        runs = np.zeros((capacity, 3), np.int32)
        cells = (level.background, level.lit, level.rise, pixels.sought_unit)
        count = find_column_runs(sought, *cells, runs)
        if count <= capacity:
            break
        capacity = count
    runs = runs[:count]
    order, first = np.zeros(count, np.int64), np.zeros(sought.shape[1] + 1, np.int64)
    sort_by_column(runs, order, first)
    chain, size = np.zeros(count, np.int64), np.zeros(count, np.int64)
    n_chains = link_columns(runs, order, first, LONGEST_RUN_PX, chain, size)
    size = size[:n_chains]
    least = int(SHORTEST_PX)
    kept = size >= least
    points = np.zeros((int(size[kept].sum()), POINT_COLUMNS), np.int32)
    start = np.zeros(int(kept.sum()) + 1, np.int64)
    gather_chains(runs, order, chain, size, least, points, start)
    is_kept = np.zeros(count, np.bool_)
    is_kept[order] = (chain >= 0) & np.append(kept, False)[chain]
    return _Chains(points, start, _cells_of(runs[~is_kept], level.lit.shape))


def _cells_of(runs: NDArray[np.int32], shape: tuple[int, ...]) -> MaskImage:
    """Cells (rows, columns) that runs (N, 3) of more than one pixel touch."""
    runs = runs[runs[:, 2] > runs[:, 1]] // CELL_PX
    if not len(runs):
        return np.zeros(shape, np.uint8)
    change = np.zeros((shape[0] + 1, shape[1]), np.int64)
    np.add.at(change, (runs[:, 1], runs[:, 0]), 1)
    np.add.at(change, (runs[:, 2] + 1, runs[:, 0]), -1)
    return (np.cumsum(change, axis=0)[:-1] > 0).astype(np.uint8)


def _look(pixels: Pixels, level: ImageLevel, chains: _Chains) -> tuple[FloatArray, BoolArray]:
    """Results (6, N) of the first pass, averaged along the lines, and which runs (N,) dip."""
    n = len(chains.points)
    base, measured = np.zeros(n), np.zeros((RUN_ROWS, n))
    given = (level.background, level.rise, chains.points)
    measure_runs(*_read(pixels), *given, base, measured)
    mean = chains.mean(measured[:RUN_DIPS], np.ones((RUN_DIPS, n)), MEAN_HALF)
    ratio = np.maximum(mean[RUN_HEIGHT] / level.rise, LEAST_RATIO)
    sigma = mean[RUN_LENGTH] / (2.0 * np.sqrt(2.0 * np.log(ratio)))
    low, high = SIGMA_LIMITS_PX
    sigma = np.clip(sigma, low, high * np.hypot(1.0, STEEPEST))
    first = np.zeros((FIRST_ROWS, n))
    look_across(*_read(pixels), chains.points, sigma, base, first)
    weight = np.zeros((3, n))
    weigh_sides(first, chains.points, sigma, CLEAR_SIGMAS, weight)
    mean = chains.mean(first[SIGMA : HIGH_SIDE + 1], weight, MEAN_HALF)
    limits = np.array([low, 2.0 * high, MOST_OFF_SIGMAS])
    keep_means(mean, chains.points, sigma, base, measured[RUN_HEIGHT], limits, first)
    return first, measured[RUN_DIPS] > 0.0


def _is_near_another(
    chains: _Chains, table: FloatArray, slope: FloatArray, dips: BoolArray, rise: float
) -> BoolArray:
    """(N,) True where another line is so near that it pulls the centre, or runs into this one."""
    points, sigma = chains.points, table[SIGMA]
    steep = np.sqrt(1.0 + slope * slope)
    some = slice(None, None, max(len(sigma) // MOST_MEASURED, 1))
    typical = float(np.median(sigma[some] / steep[some]))
    ratio = np.maximum(table[AMPLITUDE] / rise, LEAST_RATIO)
    longest = MERGED_SHARE * 2.0 * (typical * steep) * np.sqrt(2.0 * np.log(ratio)) + MERGED_PX
    near = np.zeros(len(points), np.bool_)
    limits = np.array([NEIGHBOUR_SIGMAS, CLEAR_RATIO * rise, typical, WIDER_SHARE])
    given = (table, points, steep, longest, dips.view(np.uint8), limits)
    if mark_near(*given, near.view(np.uint8)):
        near = close_gaps(near, points[:, POINT_CHAIN].astype(np.int64), MERGED_SIGMAS * sigma)
    return np.asarray(near)


def _flag(chains: _Chains, table: FloatArray, first: FloatArray, near: BoolArray) -> IntArray:
    """Flags (N,) of each point by itself.

    ``first``: (6, N) of the first pass. ``near``: (N,) of `_is_near_another`.
    """
    flags = np.zeros(table.shape[1], np.int64)
    leans = table[LEAN : LEAN_NORM + 1]
    sums = (2 * LEAN_HALF + 1) * chains.mean(leans, np.ones(leans.shape), LEAN_HALF)
    # what all sections have in common is the line's own
    common = _typical_lean(table)
    limits = np.array([BACKGROUND_STEP, common, LEAST_SKEW, SKEW_PX, SIGNIFICANT])
    flag_points(table, first, sums, near.view(np.uint8), limits, SINGLE_FLAGS, flags)
    return flags


def _is_bright(table: FloatArray, start: IntArray) -> BoolArray:
    """(N,) False for chains of less than `FAINTEST_SHARE` of the strong ones' curvature.

    These are reflections, and what is printed.
    """
    bend = np.maximum(table[AMPLITUDE], 0.0) / np.maximum(table[SIGMA], 1e-3) ** 2
    size = np.diff(start)
    typical = np.add.reduceat(bend, start[:-1]) / size
    sample = bend[:: max(len(bend) // MOST_MEASURED, 1)]
    return np.repeat(typical >= FAINTEST_SHARE * strong_median(sample), size)


def _typical_lean(table: FloatArray) -> float:
    """Skew that the sections of a sample of the points have in common."""
    step = max(table.shape[1] // MOST_MEASURED, 1)
    lean, norm = table[LEAN, ::step], table[LEAN_NORM, ::step]
    return float(np.median(lean[norm > 0.0] / norm[norm > 0.0])) if norm.any() else 0.0


def _smooth(chains: _Chains, found: ColumnPoints, smoothing_px: float) -> ColumnPoints:
    """The points with their centres smoothed along the chains, and the sigma that this leaves.

    Fits and slopes are written over.
    """
    points, table, flags = chains.points, found.table, found.flags.copy()
    variance = np.maximum(table[VARIANCE], LEAST_SIGMA_PX**2)
    is_used = ((flags & int(REJECTING)) == 0) & (table[VARIANCE] > 0.0)
    rows, start = _stretches(points, is_used)
    chosen = _all_or(rows, len(points))
    centre, own = table[CENTRE, chosen], variance[chosen]
    score = np.zeros(len(rows))
    if score_middles(centre, own, start, _half_weights(OUTLIER_HALF), score):
        sample = score[:: max(len(score) // MOST_MEASURED, 1)]
        told = sample[sample >= 0.0]
        typical = max(1.0, float(np.median(told)) / NORMAL_MEDIAN) if len(told) else 1.0
        is_off = score > OUTLIER_SIGMAS * typical
        if is_off.any():
            flags[rows[is_off]] |= int(StripeFlag.OUTLIER)
            is_used[rows[is_off]] = False
            rows, start = _stretches(points, is_used)
            chosen = _all_or(rows, len(points))
            centre, own = table[CENTRE, chosen], variance[chosen]
    half = windows(max(smoothing_px, 1.0))
    correlation = _correlation(centre, own, start, half[-1])
    if correlation is None:
        flags |= int(StripeFlag.NOISE_ASSUMED)
        correlation = WHITE
    alike = max(1.0 + 2.0 * float(correlation[1:].sum()) / correlation[0], 1.0)
    sigma, noise_length = np.sqrt(variance * correlation[0]), np.full(len(points), alike)
    if smoothing_px > 0.0:
        halves, weights = _half_windows(max(smoothing_px, 1.0))
        inflation = np.array([inflation_of(correlation, one) for one in halves])
        smoothed = np.zeros((SMOOTH_ROWS, len(rows)))
        own = own * correlation[0]
        smooth_stretches(centre, own, start, halves, weights, inflation, CONFIDENCE, smoothed)
        keep_smoothed(rows, smoothed, own, alike, table, found.slope, sigma, noise_length)
    return replace(found, sigma=sigma, noise_length=noise_length, flags=flags)


def _stretches(points: NDArray[np.int32], is_used: BoolArray) -> tuple[IntArray, IntArray]:
    """Rows of the points that are used, and (S + 1,) where their stretches begin."""
    rows, start = np.zeros(len(points), np.int64), np.zeros(len(points) + 1, np.int64)
    n = cut_stretches(points, is_used.view(np.uint8), rows, start)
    return rows[: start[n]], start[: n + 1]


def _all_or(rows: IntArray, n: int) -> IntArray | slice:
    """Rising rows (M,) of ``n``; a slice if they are all of them, so that nothing is copied."""
    return slice(None) if len(rows) == n else rows


@cache
def _half_weights(half: int) -> FloatArray:
    """Weights (half + 1,) of a local quadratic at its middle, from there on."""
    weights = quadratic_weights(half)[half:].copy()
    weights.flags.writeable = False
    return weights


@cache
def _half_windows(largest_px: float) -> tuple[IntArray, FloatArray]:
    """Half windows (K,) in whole columns, and the weights (K, H + 1) of `_half_weights` of each."""
    halves = np.unique(np.maximum(windows(largest_px).astype(np.int64), 1))
    weights = np.zeros((len(halves), halves[-1] + 1))
    for k, one in enumerate(halves):
        weights[k, : one + 1] = _half_weights(int(one))
    halves.flags.writeable = weights.flags.writeable = False
    return halves, weights


def _correlation(
    centre: FloatArray, variance: FloatArray, start: IntArray, half_px: float
) -> FloatArray | None:
    """Covariance (LAGS,) of neighbours over their variance; None where stretches are too short."""
    stop = int(np.searchsorted(start, MOST_MEASURED))
    n = int(start[min(stop, len(start) - 1)])
    stretch = np.repeat(np.arange(len(start) - 1), np.diff(start))[:n]
    at = np.stack([np.arange(n, dtype=np.float64), centre[:n]], axis=1)
    down = np.repeat([[0.0, 1.0]], n, axis=0)
    course = Polyline(at, down, np.sqrt(variance[:n]), stretch, np.ones(n, dtype=np.bool_))
    return noise_correlation(course, half_px)


def extract_fast(
    exposure: Exposure, plane: StripePlane | None, level: ImageLevel, options: StripeOptions
) -> Profile:
    """Stripe points of a grey exposure, or of its plane: columns first, then rows.

    ``plane``: None for an exposure of eight bits, whose own pixels are read. ``level``: Of what is
    read.
    """
    image = exposure.image
    if plane is not None:
        pixels = Pixels.of_plane(plane, level.brightest)
    elif is_of_bytes(image):
        pixels = Pixels.of_bytes(image, exposure.full_scale)
    else:
        raise TypeError(f"an image of {image.dtype} needs its plane")
    down, left_out = find_columns(pixels, level, options.smoothing_px)
    found = [] if down is None else [_to_profile(exposure, plane, down, is_row=False)]
    if left_out.any():
        turned = replace(
            level,
            background=np.ascontiguousarray(level.background.T),
            lit=np.ascontiguousarray(level.lit.T),
        )
        along, _ = find_columns(pixels.transposed, turned, options.smoothing_px)
        found += [] if along is None else [_to_profile(exposure, plane, along, is_row=True)]
    found = [part for part in found if len(part)]
    if len(found) > 1:
        after = found[1].segment + found[0].segment[-1] + 1
        return Profile.concat([found[0], replace(found[1], segment=after)])
    return found[0] if found else Profile.empty(source=exposure.source)


def _to_profile(
    exposure: Exposure, plane: StripePlane | None, found: ColumnPoints, is_row: bool
) -> Profile:
    """Points in full-sensor pixels, those left out whose line is rather the other pass's.

    Left out, too, is what lacks the laser's colour, and what was white without it.
    """
    steep = np.abs(found.trend)
    keep = (steep < 1.0 / STEEPEST) if is_row else (steep <= STEEPEST)
    keep &= (found.table[VARIANCE] > 0.0) & (np.abs(found.slope) < MOST_SLOPE)
    rows, down = np.flatnonzero(keep), 0 if is_row else 1
    binning, levels = exposure.window.binning, exposure.full_scale / NORMAL_SCALE
    at, normals = np.zeros((len(rows), 2)), np.zeros((len(rows), 2))
    measures, segment = np.zeros((3, len(rows))), np.zeros(len(rows), np.int64)
    scales = np.array([LEAST_SIGMA_PX, binning, levels, BACK])
    given = (rows, found.points, found.table, found.slope, found.sigma, down, scales)
    write_points(*given, at, normals, measures, segment)
    flags = found.flags[rows]
    short = is_short(at, segment)
    if short.any():
        flags |= np.where(short, int(StripeFlag.SHORT_SEGMENT), 0)
    profile = Profile(
        source=exposure.source,
        points_px=given_away(exposure.window.to_full_sensor(at)),
        normals_px=given_away(normals),
        sigma_px=given_away(measures[0]),
        width_px=given_away(measures[1]),
        intensity=given_away(measures[2]),
        flags=given_away(flags),
        segment=given_away(segment),
        noise_length=given_away(found.noise_length[rows]),
    )
    if plane is None or not len(at):
        return profile
    across_px = float(np.median(measures[1])) / binning
    lines, keep = np.concatenate([at, normals], axis=1), np.ones(len(at), dtype=np.bool_)
    if plane.gate is not None:
        keep &= has_laser_colour(plane.gate, lines, segment, across_px)
    if plane.unknown is not None:
        keep &= is_on_known_ground(plane.unknown, lines, across_px)
    return profile.select(keep)
