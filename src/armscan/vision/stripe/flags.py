# SPDX-License-Identifier: Apache-2.0
"""What is doubtful about each stripe point, its colour and ground, and ends cut at a slant."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.least_squares import robust_sigma
from armscan.kernels.chains import REACH_PX, set_between
from armscan.kernels.stripe.profile_fit import REACH_SIGMAS
from armscan.kernels.stripe.section import (
    MARK_COLUMNS,
    MARK_LEAN,
    MARK_MEAN_WIDTH,
    MARK_SINE,
    MARK_WIDTH,
    SHAPE_HALF,
    mark_points,
)
from armscan.records.profile import StripeFlag
from armscan.vision.stripe.fit import ProfileFits
from armscan.vision.stripe.image import (
    LINE_SHARE,
    RIDGE_QUANTILE,
    RIDGE_STEP_PX,
    MaskImage,
    ridge_height,
)
from armscan.vision.stripe.ridge import (
    SHORTEST_PX,
    FloatImage,
    chain_extents,
    mean_along,
    strong_median,
)

MERGED_SIGMAS = 20.0
"""Where two lines cross at a small angle they run as one over about this many sigmas."""


MARKS = (
    StripeFlag.SATURATED,
    StripeFlag.BACKGROUND_STEP,
    StripeFlag.ASYMMETRIC,
    StripeFlag.NEIGHBOUR,
    StripeFlag.PULLED,
)


def mark(fits: ProfileFits, saturated: NDArray[np.uint8]) -> tuple[FloatArray, IntArray]:
    """Fitted centres (N, 8) of `mark_points`, and the flags (N,) of each alone.

    ``saturated``: (H, W) 1 where the laser's channel is; (1, 1) zero if it is nowhere.
    """
    n = len(fits.ridge)
    marks, flags = np.zeros((n, MARK_COLUMNS)), np.zeros(n, np.int64)
    bits = np.array([int(flag) for flag in MARKS])
    given = (fits.ridge.table, fits.values, fits.sides, fits.side_sigma, fits.neighbour)
    mark_points(*given, fits.ridge.chain, saturated, bits, marks, flags)
    return marks, flags


def is_saturated(points: FloatArray, saturated: NDArray[np.uint8]) -> BoolArray:
    """(N,) True where one of the 3 x 3 pixels around a point (N, 2) is clipped."""
    found = np.zeros(len(points), dtype=np.bool_)
    if saturated.size == 1:
        return found
    height, width = saturated.shape
    x, y = np.rint(points).astype(np.int64).T
    columns = [np.clip(x + dx, 0, width - 1) for dx in (-1, 0, 1)]
    masks = saturated.ravel()
    for dy in (-1, 0, 1):
        row = np.clip(y + dy, 0, height - 1) * width
        for column in columns:
            found |= masks.take(row + column) > 0
    return found


def close_gaps(flags: BoolArray, chain: IntArray, span: FloatArray) -> BoolArray:
    """Set also the points between two flagged ones of a chain that are within ``span`` (N,)."""
    closed = flags.copy()
    set_between(flags.view(np.uint8), chain, span, closed.view(np.uint8))
    return closed


def is_short(points: FloatArray, chain: IntArray) -> BoolArray:
    """(N,) True where the point's chain is shorter than `SHORTEST_PX`."""
    return np.asarray(chain_extents(points, chain)[2] < SHORTEST_PX)


LEAST_SINE = 0.25
"""Cuts at a smaller angle to the line are followed no farther than those of this sine."""
STEEPEST_SINE = 0.87
REFERENCE_SIGMAS = 15.0
"""The line farther in, over this length, is what the end is compared with."""
LEAST_REFERENCE = 8
SKEW_SCORE = 4.0
SCATTERS = 3.5
LEAST_SHRINKING = 0.04
GAP_SIGMAS = 1.5
"""A sound stretch longer than this (and a link) is the line itself."""
MARGIN_SIGMAS = 1.0
BLUR_PX = 1.0
"""The cut's own blur, which matters beside narrow lines."""
BORDER_SIGMAS = 1.0
BORDER_PX = 2.0


def is_cut_off(marks: FloatArray, chain: IntArray, shape: tuple[int, ...]) -> BoolArray:
    """(N,) True where a line's end inside the image truncates the fitted column or row.

    Where an edge cuts a slanted line, part of the profile lies beyond the cut: it is narrower than
    the line farther in or leans, and its centre follows the edge. From each end these signs are
    followed inwards, at least as far as a cut at right angles to the line takes effect (2.7 sigma
    times the slant's tangent) and at most as far as one along the rows or columns. Ends at the
    image's border and closed loops have none.

    ``marks``: (N, 8) of `mark`. ``chain``: (N,) numbers. ``shape``: Rows and columns of the image.
    """
    found = np.zeros(len(chain), dtype=np.bool_)
    starts = np.flatnonzero(np.concatenate([[True], np.diff(chain) != 0]))
    for first, stop in zip(starts, np.append(starts[1:], len(chain)), strict=True):
        own, cut = marks[first:stop], found[first:stop]
        sigma = float(np.median(own[:, MARK_WIDTH]))
        gap = float(np.hypot(*(own[0, :2] - own[-1, :2])))
        if len(own) > 2 * LEAST_REFERENCE and gap <= REACH_PX:
            continue
        for inwards, is_cut in ((own, cut), (own[::-1], cut[::-1])):
            if not _is_at_border(inwards[0], sigma, shape):
                is_cut[: _count_cut(inwards, sigma)] = True
    return found


def _is_at_border(point: FloatArray, sigma_px: float, shape: tuple[int, ...]) -> bool:
    room = min(point[0], point[1], shape[1] - 1 - point[0], shape[0] - 1 - point[1])
    return bool(room < BORDER_SIGMAS * sigma_px + BORDER_PX)


def _count_cut(inwards: FloatArray, sigma_px: float) -> int:
    """How many points from the end, of marks (N, 8) from there on, have a truncated profile."""
    step_x, step_y = np.diff(inwards[:, 0]), np.diff(inwards[:, 1])
    arc = np.concatenate([[0.0], np.cumsum(np.sqrt(step_x**2 + step_y**2))])
    width, mean_width = inwards[:, MARK_WIDTH], inwards[:, MARK_MEAN_WIDTH]
    leans, sines = inwards[:, MARK_LEAN], inwards[:, MARK_SINE]
    reach = REACH_SIGMAS * sigma_px
    is_near = arc <= 2.0 * reach / LEAST_SINE
    sine = max(float(np.median(sines[is_near])), LEAST_SINE)
    farthest = min(2.0 * reach / (sine * np.sqrt(1.0 - sine**2)), 0.5 * float(arc[-1]))
    beyond = (arc >= farthest) & (arc <= farthest + REFERENCE_SIGMAS * sigma_px)
    chosen = np.flatnonzero(beyond)
    if len(chosen) < LEAST_REFERENCE:
        chosen = np.arange(len(arc))
    slant = min(float(np.median(sines[chosen])), STEEPEST_SINE)
    last = (reach + BLUR_PX) * slant / np.sqrt(1.0 - slant**2)
    typical = float(np.median(width[chosen]))
    scatter = max(
        _robust_std(width[chosen]) / np.sqrt(2 * SHAPE_HALF + 1),
        _robust_std(mean_width[chosen]),
    )
    narrow = typical - max(LEAST_SHRINKING * typical, SCATTERS * scatter)
    lean = np.abs(leans - np.median(leans[chosen]))
    leaning = SKEW_SCORE * max(1.0, _robust_std(leans[chosen]))
    is_cut = (mean_width < narrow) | (lean > leaning)
    for at in arc[is_cut & (arc < farthest)]:
        if at - last > GAP_SIGMAS * sigma_px + REACH_PX:
            break
        last = max(last, float(at) + MARGIN_SIGMAS * sigma_px)
    return int(np.searchsorted(arc, last))


def _robust_std(values: FloatArray) -> float:
    """Standard deviation of most of the values."""
    return robust_sigma(values - np.median(values))


CORE_SIGMAS = 3.0
BESIDE_SIGMAS = (5.0, 8.0)
LEAST_CORE_PX = 3.0
COLOUR_HALF = 4
"""Neighbours over which the excess of the laser's colour is averaged."""
NOISE_FACTOR = 4.0
LEAST_SHARE = 0.25


def near_laser_colour(gate: FloatImage | None) -> MaskImage | None:
    """Mask (H, W), 1 near the strongest thin lines of the laser's colour; None if it is not known.

    The white core of an over-exposed line has no colour, but a halo near it that has.

    ``gate``: (H, W) colour excess.
    """
    height = np.zeros((0, 0), np.float32) if gate is None else ridge_height(gate)
    if gate is None or not height.size:
        return None
    s = RIDGE_STEP_PX
    near = np.zeros(gate.shape, np.uint8)
    near[s:-s, s:-s] = height > LINE_SHARE * float(np.quantile(height, RIDGE_QUANTILE))
    return np.asarray(cv2.dilate(near, np.ones((2 * s + 1, 2 * s + 1), np.uint8)), np.uint8)


def colour_contrast(gate: FloatImage, table: FloatArray, line_sigma_px: float) -> FloatArray:
    """(N,) by how much the colour excess near the ridge stands out from both sides.

    The core of a saturated line is white; its halo keeps the colour. So the strongest excess within
    three sigmas is compared with the excess farther out.

    ``gate``: (H, W) colour excess. ``table``: Ridge points (N, 4 or more), their places in the
    image and normals first. ``line_sigma_px``: Typical sigma of the lines.
    """
    core = max(CORE_SIGMAS * line_sigma_px, LEAST_CORE_PX)
    inside = _across(gate, table, np.arange(-core, core + 0.5, 1.0)).max(axis=1)
    far = np.linspace(BESIDE_SIGMAS[0], BESIDE_SIGMAS[1], 4) * max(line_sigma_px, 1.0)
    beside = np.maximum(
        np.median(_across(gate, table, -far), axis=1), np.median(_across(gate, table, far), axis=1)
    )
    return np.asarray(inside - beside)


def has_laser_colour(
    gate: FloatImage, table: FloatArray, chain: IntArray, line_sigma_px: float
) -> BoolArray:
    """(N,) True where `colour_contrast`, averaged along the line, is no noise and no fringe.

    ``chain``: (N,) of the ridge points; the others as for `colour_contrast`.
    """
    contrast = colour_contrast(gate, table, line_sigma_px)
    contrast = mean_along(contrast, np.ones(len(table)), chain, COLOUR_HALF)
    step = np.abs(np.diff(gate[::7, :], axis=1))
    noise = 1.05 * float(np.median(step)) if step.size else 0.0
    return np.asarray(contrast > max(NOISE_FACTOR * noise, least_contrast(contrast)))


def least_contrast(contrast: FloatArray) -> float:
    """What of the contrasts (N,) of ridges has the laser's colour: a share of the strong ones'."""
    return LEAST_SHARE * strong_median(np.maximum(contrast, 0.0))


def is_on_known_ground(unknown: MaskImage, table: FloatArray, line_sigma_px: float) -> BoolArray:
    """(N,) False where the view without laser was saturated within three sigmas of the ridge."""
    if unknown.size == 1:
        return np.ones(len(table), dtype=np.bool_)
    core = max(CORE_SIGMAS * line_sigma_px, LEAST_CORE_PX)
    return np.asarray(_across(unknown, table, np.arange(-core, core + 0.5, 1.0)).max(axis=1) == 0)


def _across(gate: FloatImage | MaskImage, table: FloatArray, offsets: FloatArray) -> FloatArray:
    height, width = gate.shape
    x = np.rint(table[:, :1] + table[:, 2:3] * offsets).astype(np.int64)
    y = np.rint(table[:, 1:2] + table[:, 3:4] * offsets).astype(np.int64)
    return gate[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(np.float64)
