# SPDX-License-Identifier: Apache-2.0
"""Noise-weighted profile fits at ridge points, and the noise model from their residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from armscan.geometry.arrays import BoolArray, FloatArray, IntArray
from armscan.geometry.least_squares import robust_sigma
from armscan.kernels.chains import find_other_lines
from armscan.kernels.profile_fit import (
    AMPLITUDE,
    CENTRE,
    FIT_COLUMNS,
    REACH_SIGMAS,
    SIDE_SPAN,
    SIGMA,
    VARIANCE,
    fit_profiles,
    read_sides,
)
from armscan.vision.stripe.image import StripePlane
from armscan.vision.stripe.ridge import (
    SHORTEST_PX,
    FloatImage,
    RidgePoints,
    chain_bounds,
    chain_lengths_px,
    mean_along,
)

START_CONTRAST2 = 0.03
START_PER_GAIN = 0.1
BIN_EDGES = np.array([0.0, 0.01, 0.03, 0.07, 0.13, 0.22, 0.33, 0.46, 0.6, 0.75, 0.9, 1.2])
LEAST_PER_BIN = 30
LEAST_VARIANCE = 0.02
FIT_PARAMETERS = 3.0


def start_noise(background_noise: float) -> FloatArray:
    """A first guess (3,) of ``C^2``, ``1 / gain``, ``read^2`` from the background's noise."""
    return np.array([START_CONTRAST2, START_PER_GAIN, max(background_noise**2, LEAST_VARIANCE)])


def estimate_noise(
    image: FloatImage,
    points: FloatArray,
    sides: FloatArray,
    fits: FloatArray,
    fallback: FloatArray,
) -> FloatArray:
    """Fit ``v = C^2 m^2 + (m + background) / gain + read^2`` to squared residuals.

    The residuals are binned by the line's own grey level ``m``; each bin gives a robust variance,
    and non-negative least squares gives the three terms.

    ``image``: (H, W) float32. ``points``: (N, 6) ridge points. ``sides``: (N, 2) background on both
    sides. ``fits``: (N, 8) from the profile fit with any sensible weights. ``fallback``: (3,) what
    to return if there are too few residuals.
    """
    good = fits[:, VARIANCE] > 0.0
    if good.sum() < LEAST_PER_BIN:
        return fallback
    level, total, residual = _residuals(image, points[good], sides[good], fits[good])
    peak = float(np.quantile(fits[good, AMPLITUDE], 0.9))
    bins = np.digitize(level / peak, BIN_EDGES)
    rows, variances, counts = [], [], []
    for b in range(1, len(BIN_EDGES)):
        inside = bins == b
        if inside.sum() < LEAST_PER_BIN:
            continue
        m = level[inside]
        rows.append([np.mean(m * m), np.mean(np.maximum(total[inside], 0.0)), 1.0])
        typical = robust_sigma(residual[inside])
        clipped = np.minimum(residual[inside] ** 2, (3.5 * typical) ** 2)
        variances.append(max(float(clipped.mean()), LEAST_VARIANCE))
        counts.append(inside.sum())
    if len(rows) < 4:
        return fallback
    variance = np.array(variances)
    weight = np.sqrt(np.array(counts)) / variance
    terms, _ = nnls(np.array(rows) * weight[:, None], variance * weight)
    terms[2] = max(terms[2], LEAST_VARIANCE)
    return np.asarray(terms)


def _residuals(
    image: FloatImage, points: FloatArray, sides: FloatArray, fits: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Model level, model plus background, and residual of every pixel of the fitted profiles."""
    height, width = image.shape
    is_column = points[:, 5] == 0
    line = np.where(is_column, points[:, 0], points[:, 1]).astype(np.int64)
    start = np.where(is_column, points[:, 1], points[:, 0])
    sigma = fits[:, SIGMA]
    reach = int(np.ceil(np.quantile(sigma, 0.9) * SIDE_SPAN / 2.0))
    k: IntArray = np.rint(start).astype(np.int64)[:, None] + np.arange(-reach, reach + 1)
    size = np.asarray(np.where(is_column, height, width)).reshape(-1, 1)
    safe = np.clip(k, 0, size - 1)
    y = np.where(is_column[:, None], safe, line[:, None])
    x = np.where(is_column[:, None], line[:, None], safe)
    u = (k - fits[:, CENTRE][:, None]) / sigma[:, None]
    model = fits[:, AMPLITUDE][:, None] * np.exp(-0.5 * u * u)
    ramp = (sides[:, 1] - sides[:, 0]) / (SIDE_SPAN * sigma)
    background = sides.mean(axis=1)[:, None] + ramp[:, None] * (k - start[:, None])
    residual = image[y, x] - background - model
    pixels = (np.abs(u) < REACH_SIGMAS) & (k == safe)
    n = pixels.sum(axis=1, keepdims=True)
    freedom = np.sqrt(n / np.maximum(n - FIT_PARAMETERS, 1.0))
    is_side = (np.abs(u) > 3.4) & (np.abs(u) < 4.2) & (k == safe)
    residual = np.where(pixels, residual * freedom, residual)
    use = pixels | is_side
    return model[use], (model + background)[use], residual[use]


NOISE_SAMPLE = 1500
NOISE_ROUNDS = 2
SIDE_HALF = 8
"""Neighbours over which the background beside the line is averaged."""
CLEAR_SIGMAS = 11.0
"""Another line within this many sigmas may light up the background beside a slanted line."""
LEAST_REACH_PX = 6.0
FOOT_SIGMAS = 3.2
LEAST_REACH_SIGMAS = 1.4
"""The window shrinks beside another line, so that its foot stays outside."""


@dataclass(frozen=True, slots=True, eq=False)
class ProfileFits:
    """Result of fitting the cross-section at each ridge point.

    ``ridge``: The ridge points, only those whose fit succeeded. ``values``: (N, 8) columns as named
    in `armscan.kernels.profile_fit`. ``sides``: (N, 2) background on the lower and upper side,
    averaged along the line. ``side_sigma``: (N,) standard deviation of the difference of the two
    sides. ``neighbour``: (N, 2) distance to the nearest other line on the lower and upper side, in
    px. ``noise``: (3,) ``C^2``, ``1 / gain``, ``read^2``. ``is_noise_assumed``: True if there were
    too few residuals to estimate it, so that it is the first guess.
    """

    ridge: RidgePoints
    values: FloatArray
    sides: FloatArray
    side_sigma: FloatArray
    neighbour: FloatArray
    noise: FloatArray
    is_noise_assumed: bool


def axis_component(table: FloatArray) -> FloatArray:
    """(N,) size of the normal's component along the fitted column or row."""
    rows = np.arange(len(table))
    return np.abs(table[rows, 3 - table[:, 5].astype(np.int64)])


def fit_ridge(
    plane: StripePlane,
    ridge: RidgePoints,
    line_sigma_px: float,
    background_noise: float,
) -> ProfileFits:
    """Fit a Gaussian with weights from the noise model at every ridge point.

    The noise model is estimated from a sample of the points first. Chains shorter than
    `SHORTEST_PX` are fitted, but do not count as lines beside others.
    """
    table = ridge.table
    sigma = line_sigma_px / np.maximum(axis_component(table), 0.5)
    neighbour = _neighbours(plane, ridge, line_sigma_px)
    room = neighbour.min(axis=1) / line_sigma_px - FOOT_SIGMAS
    reach = np.clip(room, LEAST_REACH_SIGMAS, REACH_SIGMAS)
    is_clear = neighbour > CLEAR_SIGMAS * line_sigma_px
    sides, side_sigma = _sides(plane, ridge, sigma, is_clear, background_noise)
    guess = noise = start_noise(background_noise)
    pick = np.arange(0, len(table), max(len(table) // NOISE_SAMPLE, 1))
    for _ in range(NOISE_ROUNDS):
        sample = np.zeros((len(pick), FIT_COLUMNS))
        fit_profiles(
            plane.image,
            plane.clipped,
            table[pick],
            sigma[pick],
            sides[pick],
            noise,
            reach[pick],
            sample,
        )
        noise = estimate_noise(plane.image, table[pick], sides[pick], sample, noise)
    values = np.zeros((len(table), FIT_COLUMNS))
    fit_profiles(plane.image, plane.clipped, table, sigma, sides, noise, reach, values)
    good = values[:, VARIANCE] > 0.0
    return ProfileFits(
        ridge.select(good),
        values[good],
        sides[good],
        side_sigma[good],
        neighbour[good],
        noise,
        is_noise_assumed=noise is guess,
    )


def _neighbours(plane: StripePlane, ridge: RidgePoints, line_sigma_px: float) -> FloatArray:
    height, width = plane.image.shape
    length = chain_lengths_px(ridge.table[:, :2], ridge.chain)
    distance = np.zeros((len(ridge), 2))
    reach = max(CLEAR_SIGMAS * line_sigma_px, LEAST_REACH_PX)
    is_line = (length >= SHORTEST_PX).astype(np.int64)
    bounds = chain_bounds(ridge.chain)
    find_other_lines(ridge.table, ridge.chain, *bounds, is_line, height, width, reach, distance)
    return distance


def _sides(
    plane: StripePlane,
    ridge: RidgePoints,
    sigma: FloatArray,
    is_clear: BoolArray,
    background_noise: float,
) -> tuple[FloatArray, FloatArray]:
    """Background on both sides, averaged along the line, and the sigma of their difference.

    A side that another line lights up takes the value of the other side.
    """
    raw = np.zeros((len(ridge), 4))
    read_sides(plane.image, ridge.table, sigma, raw)
    level, count = raw[:, 0::2], raw[:, 1::2] * is_clear
    stretch = _axis_runs(ridge)
    places = np.minimum(np.subtract(*chain_bounds(stretch)[::-1]), 2 * SIDE_HALF + 1)
    total = np.stack([mean_along(np.ones(len(ridge)), c, stretch, SIDE_HALF) for c in count.T], 1)
    mean = np.stack(
        [mean_along(v, c, stretch, SIDE_HALF) for v, c in zip(level.T, count.T, strict=True)], 1
    )
    has_own = (total > 0.0) & is_clear
    lowest = np.where(raw[:, 1::2] > 0.0, level, np.inf).min(axis=1)
    lowest = np.where(np.isfinite(lowest), lowest, 0.0)[:, None]
    sides = np.where(has_own, mean, np.where(has_own[:, ::-1], mean[:, ::-1], lowest))
    pixels = np.where(has_own.all(axis=1), count.min(axis=1), 1.0) * places
    return sides, background_noise * np.sqrt(2.0 / np.maximum(pixels, 1.0))


def _axis_runs(ridge: RidgePoints) -> IntArray:
    """Number the stretches of a chain that keep the same axis, so that sides do not swap."""
    axis = ridge.table[:, 5]
    is_new = np.concatenate([[0], (np.diff(ridge.chain) != 0) | (np.diff(axis) != 0)])
    return np.cumsum(is_new).astype(np.int64)
