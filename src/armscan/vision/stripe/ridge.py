# SPDX-License-Identifier: Apache-2.0
"""Ridge points linked into chains, from the image's noise level and its lines' width."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeGuard

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import BoolArray, FloatArray, ImageArray, IntArray
from armscan.geometry.least_squares import MAD_TO_SIGMA, robust_sigma
from armscan.kernels.chains import REACH_PX as CHAINS_REACH_PX
from armscan.kernels.chains import (
    find_neighbours,
    measure_chains,
    middle_of_squares,
    place_points,
    span_of,
    sum_windows,
    walk_chains,
)
from armscan.kernels.stripe.ridge import (
    ROUNDING,
    count_bright,
    find_runs,
    gaussian_taps,
    rank_cells,
    read_steps,
    refine_candidates,
    sample_across,
)

FloatImage: TypeAlias = NDArray[np.float32]

CELL_PX = 64
AROUND = np.ones((3, 3), np.uint8)
SQRT2 = math.sqrt(2.0)
SAMPLE_STEP_PX = 4
"""What holds for the whole image is told from every fourth row and column."""
CLUTTER_LAG_PX = 12
BACKGROUND_QUANTILE = 0.4
LEAST_NOISE = 0.35
"""Rounding to whole grey levels hides smaller noise."""
THRESHOLD_SIGMAS = 6.0
LEAST_PEAK_SHARE = 0.06
"""Lines fainter than this share of the brightest ones are reflections, not stripes."""
PEAK_QUANTILE = 0.999
NOISY_SHARE = 0.25
"""Of the brightest lines' height. In 40 photographs of ten strangers the threshold that the noise
of single pixels sets is 0.01 to 0.11 of it, in those of an eleventh 0.41 to 0.57."""
NOISY = 3.3
"""Least noise of 255 levels: smaller is that of dark frames and of cameras that need no help."""
BLUR_PX, BLURRED_SIGMAS = 1.5, 5.0
"""A blurred image has a thirtieth as many places that could be bright by chance."""
BLURRED_LAGS_PX = (8, 12, 18)


@dataclass(frozen=True, slots=True, eq=False)
class ImageLevel:
    """What the pixels beside the lines look like.

    ``background``: (rows, columns) float32 background level per cell of `CELL_PX` pixels.
    ``noise``: Standard deviation of a background pixel against its neighbour. ``clutter``: The same
    at a distance of `CLUTTER_LAG_PX`, where compression blocks, chroma subsampling and surface
    texture show; never less than ``noise``. ``rise``: Height above the background at which a line
    begins. ``lit``: (rows, columns) uint8, 1 for the cells that have a pixel so far above the
    background. ``brightest``: Level of the brightest pixel, as the image has it. ``is_noisy``: The
    noise of single pixels would hide lines that are a good part as high as the brightest.
    """

    background: FloatImage
    noise: float
    clutter: float
    rise: float
    lit: NDArray[np.uint8]
    brightest: float
    is_noisy: bool


def measure_level(
    image: FloatImage | ImageArray, threshold: float | None, scale: float = 1.0, sparse: int = 1
) -> ImageLevel:
    """Estimate background and noise from a sample of the pixels.

    ``image``: (H, W) float32, or as the camera delivered it. ``threshold``: Least height of a line
    above the background, or None to set it from the noise. ``scale``: What ``image`` is to be
    multiplied by; level and threshold are then of that. ``sparse``: By which the distances between
    sampled rows and columns of bytes are multiplied; 1, 2 or 4.
    """
    factor = np.float32(scale)
    background = np.asarray(_cell_quantiles(image, sparse) * factor, dtype=np.float32)
    noise = _noise(image, 1, factor, sparse)
    clutter = max(_noise(image, CLUTTER_LAG_PX, factor, sparse), noise)
    peaks = _cell_peaks(image)
    is_noisy = False
    if threshold is None:
        peak = _brightest(image, peaks, factor, sparse) - float(np.median(background))
        threshold = max(THRESHOLD_SIGMAS * clutter, LEAST_PEAK_SHARE * peak)
        is_noisy = noise > NOISY and THRESHOLD_SIGMAS * noise > NOISY_SHARE * peak
    # between cells the background is linear: never below the least of them
    least = cv2.erode(background, AROUND) + (threshold - ROUNDING)
    lit = np.asarray(peaks * factor > least).astype(np.uint8)
    brightest = float(peaks.max())
    return ImageLevel(background, noise, clutter, threshold, lit, brightest, is_noisy)


def less_noisy(image: FloatImage) -> tuple[FloatImage, ImageLevel]:
    """A noisy image (H, W) blurred, and its level: what lines are sought in, not measured in.

    Texture, and rows that a lamp or the sensor's read-out makes brighter, are left by the blur: the
    threshold follows whatever differs most along rows and down columns.
    """
    blurred = np.asarray(cv2.GaussianBlur(image, (0, 0), BLUR_PX), np.float32)
    one, turned = np.float32(1.0), np.ascontiguousarray(blurred.T)
    left = max(_noise(way, lag, one, 1) for way in (blurred, turned) for lag in BLURRED_LAGS_PX)
    level = measure_level(blurred, None)
    peak = level.brightest - float(np.median(level.background))
    rise = max(BLURRED_SIGMAS * left, LEAST_PEAK_SHARE * peak)
    return blurred, measure_level(blurred, rise)


BAND_PX, BAND_SIGMAS = 40, 8.0
"""Farthest from a run that extraction looks: to tell a line's width, and beside a line of a width,
which it follows along rows or columns that cut it at 45 degrees."""
NEARLY_LIT = 0.98
"""Of the rise: what rounding could lift is kept."""


def near_lines(image: FloatImage) -> BoolArray:
    """Pixels (H, W) that `extract_stripes` looks at with its defaults; all others may be zero.

    These are a band around all that rises above the background as a line does, and the rows and
    columns from which background and noise are told.

    ``image``: (H, W) float32, full scale 255.
    """
    level = measure_level(image, None)
    if level.is_noisy:
        return np.ones(image.shape, dtype=np.bool_)
    height, width = image.shape
    rows, columns = level.background.shape
    ground = cv2.resize(level.background, (columns * CELL_PX, rows * CELL_PX))[:height, :width]
    lit = (image > ground + np.float32(NEARLY_LIT * level.rise)).astype(np.uint8)
    sigma = find_line_sigma(image, find_candidates(image, level), level)
    side = 2 * max(BAND_PX, math.ceil(BAND_SIGMAS * sigma)) + 1
    keep: BoolArray = cv2.dilate(lit, np.ones((side, side), np.uint8)).astype(np.bool_)
    keep[::SAMPLE_STEP_PX, ::SAMPLE_STEP_PX] = True
    keep[:: 2 * SAMPLE_STEP_PX] = True
    return keep


def _cell_peaks(image: FloatImage | ImageArray) -> FloatImage:
    """(rows, columns) brightest pixel of each cell."""
    height, width = image.shape
    whole = height // CELL_PX
    bands = image[: whole * CELL_PX].reshape(whole, CELL_PX, width).max(axis=1)
    if whole * CELL_PX < height:
        bands = np.concatenate([bands, image[whole * CELL_PX :].max(axis=0, keepdims=True)])
    return np.maximum.reduceat(bands, np.arange(0, width, CELL_PX), axis=1).astype(np.float32)


def is_of_bytes(image: FloatImage | ImageArray) -> TypeGuard[NDArray[np.uint8]]:
    """True for images of eight bits, which are counted rather than sorted."""
    return image.dtype == np.uint8 and image.flags.c_contiguous


def _cell_quantiles(image: FloatImage | ImageArray, sparse: int) -> FloatImage:
    height, width = image.shape
    rows, columns = -(-height // CELL_PX), -(-width // CELL_PX)
    if is_of_bytes(image):
        levels, step = np.zeros((rows, columns), np.float32), sparse * SAMPLE_STEP_PX
        rank_cells(image, CELL_PX, step, int(BACKGROUND_QUANTILE * (CELL_PX // step) ** 2), levels)
        return levels
    steps = CELL_PX // SAMPLE_STEP_PX
    k = int(BACKGROUND_QUANTILE * steps * steps)
    # of single precision: smaller numbers are sorted more slowly
    sample = image[::SAMPLE_STEP_PX, ::SAMPLE_STEP_PX].astype(np.float32)
    missing = (rows * steps - sample.shape[0], columns * steps - sample.shape[1])
    filled = (
        np.pad(sample, ((0, missing[0]), (0, missing[1])), mode="edge") if any(missing) else sample
    )
    cells = filled.reshape(rows, steps, columns, steps).swapaxes(1, 2)
    ordered = np.partition(cells.reshape(rows, columns, steps * steps), k, axis=2)
    return np.ascontiguousarray(ordered[:, :, k])


PEAK_STEP_PX = 2


def _brightest(
    image: FloatImage | ImageArray, peaks: FloatImage, factor: np.float32, sparse: int
) -> float:
    """The level that a share of `PEAK_QUANTILE` of the pixels stays below, times a factor.

    ``peaks``: (rows, columns) of `_cell_peaks`.
    """
    pixel_step = PEAK_STEP_PX * sparse if is_of_bytes(image) else PEAK_STEP_PX
    sample = image[::pixel_step, ::pixel_step]
    few = sample[:: 16 // pixel_step, :: 16 // pixel_step].ravel()
    # nearly all pixels are dark: the bright ones are sorted alone
    k = int(0.98 * (len(few) - 1))
    n_above = (1.0 - PEAK_QUANTILE) * (sample.size - 1)
    if is_of_bytes(image):
        (limit,) = map(float, _levels_at(np.bincount(few), [k]))
        counts = np.zeros(256, np.int64)
        is_bright_cell = (peaks > limit).view(np.uint8)
        count_bright(image, is_bright_cell, CELL_PX, pixel_step, int(limit), counts)
        n_bright = int(counts.sum())
        if n_bright - 1 > n_above:
            place = n_bright - 1 - n_above
            low, high = _levels_at(counts, [int(place), int(place) + 1])
            return float(factor) * (low + (place - int(place)) * (high - low))
    else:
        limit = float(np.partition(few.astype(np.float32), k)[k])
        bright = sample[sample > limit].astype(np.float32) * factor
        if len(bright) - 1 > n_above:
            return float(np.quantile(bright, 1.0 - n_above / (len(bright) - 1)))
    return float(np.quantile(sample.astype(np.float32) * factor, PEAK_QUANTILE))


def _levels_at(counts: IntArray, places: list[int]) -> list[int]:
    """Levels at places, from 0 on, in the order of levels of which there are so many."""
    found: list[int] = np.searchsorted(np.cumsum(counts), places, side="right").tolist()
    return found


NOISE_STEP_PX, NOISE_ROW_STEP_PX = 3, 2 * SAMPLE_STEP_PX


def _noise(image: FloatImage | ImageArray, lag: int, factor: np.float32, sparse: int) -> float:
    """Standard deviation of pixels against others of their row at a distance."""
    if image.shape[1] <= lag:
        return LEAST_NOISE
    if is_of_bytes(image):
        height, width = image.shape
        row_step = sparse * NOISE_ROW_STEP_PX
        rows, columns = -(-height // row_step), -(-(width - lag) // NOISE_STEP_PX)
        step, counts = np.zeros((rows, columns), np.float32), np.zeros(256, np.int64)
        read_steps(image, row_step, NOISE_STEP_PX, lag, step, counts)
        if factor != 1.0:
            step *= factor
        middle = sum(_levels_at(counts, [(step.size - 1) // 2, step.size // 2]))
        typical = MAD_TO_SIGMA * 0.5 * middle * float(factor)
    else:
        levels = image[::NOISE_ROW_STEP_PX].astype(np.float32) * factor
        step = np.abs(
            levels[:, lag::NOISE_STEP_PX] - levels[:, : levels.shape[1] - lag : NOISE_STEP_PX]
        )
        typical = robust_sigma(step)
    mean = float(np.minimum(step, max(2.5 * typical, 2.0), out=step).mean())
    trimmed = mean * math.sqrt(math.pi / 2.0)
    return max(typical, trimmed, LEAST_NOISE * SQRT2) / SQRT2


def chain_bounds(chain: IntArray) -> tuple[IntArray, IntArray]:
    """First index, and index after the last, of each point's chain: two (N,) arrays.

    ``chain``: (N,) numbers; a chain's points are consecutive.
    """
    is_first = np.ones(len(chain), dtype=np.bool_)
    is_first[1:] = chain[1:] != chain[:-1]
    starts = np.flatnonzero(is_first)
    sizes = np.diff(starts, append=len(chain))
    return np.repeat(starts, sizes), np.repeat(starts + sizes, sizes)


def sum_along(values: FloatArray, chain: IntArray, half: int) -> FloatArray:
    """Sums, (M, N) or (N,), over the neighbours within ``half`` places on the same chain."""
    rows = np.ascontiguousarray(np.atleast_2d(values), dtype=np.float64)
    sums = np.zeros(rows.shape)
    sum_windows(rows, chain, half, sums)
    return sums.reshape(np.shape(values))


def mean_along(values: FloatArray, weights: FloatArray, chain: IntArray, half: int) -> FloatArray:
    """Weighted means, (M, N) or (N,), over the neighbours; 0 where the weights sum to 0."""
    total = sum_along(weights, chain, half)
    mean = sum_along(weights * values, chain, half)
    return np.asarray(np.where(total > 0.0, mean / np.where(total > 0.0, total, 1.0), 0.0))


def median_along(values: FloatArray, chain: IntArray, at: IntArray, half: int) -> FloatArray:
    """Medians (M,) of values (N,) within ``half`` places of some, ``at`` (M,), on the same chain.

    Of an even count, the upper of the two in the middle. NaN where ``half`` places or fewer hold a
    number.
    """
    first, stop = (bound[at, None] for bound in chain_bounds(chain))
    near = at[:, None] + np.arange(-half, half + 1)
    is_near = (near >= first) & (near < stop)
    # what is NaN comes last
    ordered = np.sort(np.where(is_near, values[near.clip(0, len(values) - 1)], np.nan), axis=1)
    count = np.isfinite(ordered).sum(axis=1)
    middle = ordered[np.arange(len(at)), count // 2]
    return np.where(count > half, middle, np.nan)


def chain_extents(points: FloatArray, chain: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
    """First index, index after the last, and arc length in px of each point's chain: (N,) each.

    ``points``: (N, >= 2) x, y. ``chain``: (N,) numbers; a chain's points are consecutive.
    """
    n = len(chain)
    start, stop, length = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n)
    measure_chains(np.ascontiguousarray(points), chain, start, stop, length)
    return start, stop, length


def strong_median(values: FloatArray) -> float:
    """Median of values (N,) >= 0 weighted by their squares: typical of the strong ones."""
    return middle_of_squares(np.array(values)) if values.any() else 0.0


SCALES_PX = (3.0, 8.0)
RIDGE_POWER = 1.5
"""Of the scale, by which second derivatives of ridges are compared (Lindeberg 1998): lines of sigma
above 5 px are sought at the wider scale."""
SAMPLE = 3000
LOOKED_AT = 8
NEARLY = 0.8
"""Of the narrow scale's strength: less at the wide one leaves no doubt."""
SPOTS = 4.0
"""Times as many strong points at the wide scale: what is strong at the narrow one is no line."""
CLIPPED = 250.0
"""Of 255, `NORMAL_SCALE`: a little less where a view without laser was taken off."""
MEASURED = 300
MOST, WIDER = 0.5, 1.5
"""More than this part of lines are most of them. Lines without the laser's colour are wider by this
factor at least where those that have it tell the width: they are fewer and less certain."""
STRONG_SHARE = 0.4
REACH_PX = 30.0
STEP_PX = 0.5
FWHM_PER_SIGMA = 2.3548
SIGMA_LIMITS_PX = (0.7, 10.0)
FALLBACK_PX = 2.0
ALONG_PX = np.array([-2.0, 0.0, 2.0])
LOPSIDED = 1.8


def find_line_sigma(
    image: FloatImage,
    runs: FloatArray,
    level: ImageLevel,
    blur_px: float = 0.0,
    near: NDArray[np.uint8] | None = None,
) -> float:
    """Median sigma of the brighter lines from their full width at half height, in px.

    Where most of the brighter lines have not the laser's colour and are wider than those that have
    it, as sheets of paper and folds of cloth in the room, the latter tell.

    ``image``: (H, W) float32. ``runs``: (N, 3) candidates; a sample of them is measured across the
    local ridge direction. ``level``: Background and threshold. ``blur_px``: Sigma by which the
    image was blurred. ``near``: (H, W) 1 near what has the laser's colour; None if not known.
    """
    points = _strongest(image, runs)
    if not len(points):
        return FALLBACK_PX
    points = points[:: max(len(points) // MEASURED, 1)]
    profiles = _across(image, points)
    half_widths, heights = _half_widths(profiles)
    bright = heights >= max(STRONG_SHARE * strong_median(heights), level.rise)
    bright &= half_widths < REACH_PX
    if not bright.any():
        return FALLBACK_PX
    sigma = float(_sigmas(np.median(half_widths[bright], keepdims=True), blur_px)[0])
    if near is None or _at(near, points[bright]).mean() > MOST:
        return sigma
    own = find_line_sigma(image, runs[_at(near, runs) > 0], level, blur_px)
    return own if sigma > WIDER * own else sigma


def _at(image: NDArray[Any], points: FloatArray) -> NDArray[Any]:
    """Pixels (N,) of an image (H, W) at points (N, 2 or more)."""
    last = np.array(image.shape[::-1]) - 1
    column, row = np.rint(points[:, :2]).astype(np.int64).clip(0, last).T
    return np.asarray(image[row, column])


def _sigmas(half_widths: FloatArray, blur_px: float = 0.0) -> FloatArray:
    """Sigmas (N,) of lines from half their width (N,) at half height, within the limits."""
    blur = STEP_PX**2 / 3.0 + blur_px**2
    square = (2.0 * half_widths / FWHM_PER_SIGMA) ** 2 - blur
    return np.asarray(np.clip(np.sqrt(np.maximum(square, 0.0)), *SIGMA_LIMITS_PX))


def widths_at(image: FloatImage, points: FloatArray) -> FloatArray:
    """(N,) sigma in px of the line at each ridge point (N, 6); NaN where it is not told."""
    half_widths, heights = _half_widths(_across(image, points))
    is_told = (heights > 0.0) & (half_widths < REACH_PX)
    return np.where(is_told, _sigmas(half_widths), np.nan)


def _strongest(image: FloatImage, runs: FloatArray) -> FloatArray:
    """(N, 6) ridge points of the stronger lines, at the scale that suits them better.

    A wide line that saturates is flat where a narrow filter looks, and what little is narrow beside
    it would be taken for the line. Reflections bend more than such a line, but are few: the wide
    scale has SPOTS times as many strong points then.
    """
    sample = np.ascontiguousarray(runs[:: max(len(runs) // SAMPLE, 1)])
    narrow, wide = SCALES_PX
    points, strength = _at_scale(image, sample, narrow)
    strong = _strong(points)
    # wide filters take long, and few lines need them: some candidates tell
    few = np.ascontiguousarray(sample[::LOOKED_AT])
    some, strength_wide = _at_scale(image, few, wide)
    if strength_wide > NEARLY * strength or LOOKED_AT * len(_strong(some)) > SPOTS * len(strong):
        points, strength_wide = _at_scale(image, sample, wide)
        wider = _strong(points)
        are_spots = len(wider) > SPOTS * len(strong) and strength_wide > STRONG_SHARE * strength
        are_spots = are_spots and _is_clipped(image, wider)
        strong = wider if strength_wide > strength or are_spots else strong
    return strong


def _is_clipped(image: FloatImage, points: FloatArray) -> bool:
    """Whether most of the points (N, 6) lie where the camera is at its white: of print few do."""
    return float((_at(image, points) >= CLIPPED).mean()) > MOST


def _strong(points: FloatArray) -> FloatArray:
    return points[points[:, 4] >= STRONG_SHARE * strong_median(points[:, 4])]


def _at_scale(image: FloatImage, sample: FloatArray, scale_px: float) -> tuple[FloatArray, float]:
    """(N, 6) ridge points of candidates at a scale, and how strong they are."""
    points = np.zeros((len(sample), 6))
    n = refine_candidates(image, sample, len(sample), gaussian_taps(scale_px), 0.0, points)
    return points[:n], scale_px**RIDGE_POWER * strong_median(points[:n, 4])


def _across(image: FloatImage, points: FloatArray) -> FloatArray:
    """Profiles (N, K) across the ridges, averaged over a few places along them."""
    t = np.arange(-REACH_PX, REACH_PX + STEP_PX, STEP_PX)
    profiles = np.zeros((len(points), len(t)))
    sample_across(image, np.ascontiguousarray(points), t, ALONG_PX, profiles)
    return profiles


def _half_widths(profiles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean distance (N,) from the centre to half height, and height (N,).

    The height counts from the higher of the two feet, and is 0 where one side is much wider than
    the other: an edge between two areas is no line.
    """
    middle = profiles.shape[1] // 2
    near = profiles[:, middle - 2 : middle + 3].mean(axis=1)
    foot = np.maximum(profiles[:, :middle].min(axis=1), profiles[:, middle:].min(axis=1))
    height = near - foot
    level = foot + 0.5 * height
    sides = [_first_below(side, level) for side in (profiles[:, middle:], profiles[:, middle::-1])]
    narrow, wide = np.minimum(*sides), np.maximum(*sides)
    is_line = wide < LOPSIDED * narrow + STEP_PX
    return 0.5 * (narrow + wide), np.where(is_line, height, 0.0)


def _first_below(side: FloatArray, level: FloatArray) -> FloatArray:
    """Distance (N,) at which each profile (N, K), read outwards, first falls below its level."""
    rows = np.arange(len(side))
    below = side < level[:, None]
    first = np.where(below.any(axis=1), np.argmax(below, axis=1), side.shape[1] - 1)
    first = np.maximum(first, 1)
    inner, outer = side[rows, first - 1], side[rows, first]
    fraction = np.clip((inner - level) / np.maximum(inner - outer, 1e-6), 0.0, 1.0)
    return np.asarray((first - 1 + fraction) * STEP_PX)


LONGEST_RUN_PX = 90
SHORTEST_PX = 15.0
"""A shorter chain is no stripe."""
FAINTEST_SHARE = 0.1
"""Chains with less of the strong ones' curvature are reflections."""
HESSIAN_SIGMA_LIMITS_PX = (1.0, 8.0)


@dataclass(frozen=True, slots=True, eq=False)
class RidgePoints:
    """Points on ridges, ordered along chains.

    ``table``: (N, 6) x, y, normal x, normal y (image pixels), negative second derivative across the
    line, axis (0: at an integer column, 1: at an integer row). ``chain``: (N,) number of the chain;
    a chain's points are consecutive.
    """

    table: FloatArray
    chain: IntArray

    def __len__(self) -> int:
        """Count of points."""
        return len(self.table)

    def select(self, keep: NDArray[np.bool_]) -> RidgePoints:
        """Return the points where ``keep`` (N,) is True; chains are cut where a gap opens."""
        if keep.all():
            return self
        table, chain = self.table[keep], self.chain[keep]
        if len(table) == 0:
            return RidgePoints(table, chain)
        step = np.hypot(*np.diff(table[:, :2], axis=0).T)
        is_new = (np.diff(chain) != 0) | (step > CHAINS_REACH_PX)
        return RidgePoints(table, np.concatenate([[0], np.cumsum(is_new)]).astype(np.int64))


def find_candidates(image: FloatImage, level: ImageLevel) -> FloatArray:
    """Centroids (N, 3) of the runs above the background: x, y, axis."""
    height, width = image.shape
    capacity = max(1000, height * width // 32)
    while True:
        runs = np.zeros((capacity, 3))
        cells = (level.background, level.lit, CELL_PX)
        count = find_runs(image, *cells, level.rise, LONGEST_RUN_PX, runs)
        if count <= capacity:
            return runs[:count]
        capacity = count


def least_bend(height: float, sigma_px: float, scale_px: float) -> float:
    """Second derivative at scale ``scale_px`` of a line of this height and sigma."""
    return float(height * sigma_px / (sigma_px**2 + scale_px**2) ** 1.5)


def hessian_sigma(line_sigma_px: float) -> float:
    """Scale of the Hessian for lines of this sigma."""
    return float(np.clip(line_sigma_px, *HESSIAN_SIGMA_LIMITS_PX))


def trace_ridges(
    image: FloatImage, runs: FloatArray, line_sigma_px: float, rise: float
) -> RidgePoints:
    """Ridge points at the candidates, linked into chains.

    ``image``: (H, W) float32. ``runs``: (N, 3) from `find_candidates`. ``line_sigma_px``: Typical
    sigma of the lines. ``rise``: Least height of a line above its background.
    """
    scale = hessian_sigma(line_sigma_px)
    found = np.zeros((max(len(runs), 1), 6))
    bend = least_bend(rise, line_sigma_px, scale)
    n = refine_candidates(image, runs, len(runs), gaussian_taps(scale), bend, found)
    return link(found[:n])


def link(points: FloatArray) -> RidgePoints:
    """Order points (N, 6), as in `RidgePoints.table`; those without a neighbour are dropped."""
    n = len(points)
    # a map of the part of the image that has points
    span = np.zeros(4, np.int64)
    span_of(points, span)
    left, top, columns, rows = span.tolist()
    owner = np.zeros((rows, columns), np.int32)
    place_points(points, left, top, owner)
    ahead = np.full(n, -1, np.int64)
    behind = np.full(n, -1, np.int64)
    find_neighbours(points, left, top, owner, ahead, behind)
    order = np.zeros(n, np.int64)
    chain = np.zeros(n, np.int64)
    count = walk_chains(ahead, behind, order, chain)
    table, chain = np.take(points, order[:count], axis=0), chain[:count]
    _turn_normals(table, chain)
    return RidgePoints(table, chain)


def _turn_normals(table: FloatArray, chain: IntArray) -> None:
    """Point the normals of a chain to one side: each is known but for its sign."""
    normals = table[:, 2:4]
    is_same = chain[1:] == chain[:-1]
    is_against = is_same & (np.einsum("ni,ni->n", normals[1:], normals[:-1]) < 0.0)
    if not is_against.any():
        return
    n_turns = np.concatenate([[0], np.cumsum(is_against)])
    first = np.maximum.accumulate(np.where(np.append(True, ~is_same), np.arange(len(chain)), 0))
    normals[(n_turns - n_turns[first]) % 2 == 1] *= -1.0


def is_bright(ridge: RidgePoints) -> NDArray[np.bool_]:
    """(N,) False for the chains whose median curvature is below `FAINTEST_SHARE`."""
    if not len(ridge):
        return np.zeros(0, dtype=np.bool_)
    bend = ridge.table[:, 4]
    starts = np.flatnonzero(np.concatenate([[True], np.diff(ridge.chain) != 0]))
    sizes = np.diff(np.concatenate([starts, [len(ridge)]]))
    medians = np.array([np.median(bend[a : a + n]) for a, n in zip(starts, sizes, strict=True)])
    return np.asarray(np.repeat(medians, sizes) >= FAINTEST_SHARE * strong_median(bend))
